"""Kelvin-Voigt viscosity: its stress and adjoint, the power it takes, and the laws it obeys."""

import numpy as np
import pytest
from conftest import small_scene, worst
from exact import at_rest, solid_simulation

from mpmopt import kernels
from mpmopt.assess.verify import COMPLEX_STEP, DOT_TOLERANCE, complex_step_test, kernel_mismatches
from mpmopt.design.problem import Problem
from mpmopt.kernels import viscosity
from mpmopt.scene import Material, Solid
from mpmopt.scene.particles import discretise
from mpmopt.simulation.reference import step
from mpmopt.simulation.simulation import Simulation

ETA = 0.03


def viscous_scene(**changes):
    material = Material(void_density=1e-2, void_stiffness=1e-3, viscosity=ETA)
    return small_scene(**{"material": material, "time_step": 2e-3, "steps": 80, **changes})


def law(name):
    return kernels.plain(getattr(viscosity, name))


def stress(F, C, eta):
    """eta B D B, of the law as it is written, as a matrix."""
    t00, t01, t11 = law("add_viscosity")(F.ravel(), C.ravel(), (0.0, 0.0, eta), (0.0, 0.0, 0.0))
    return np.array([[t00, t01], [t01, t11]])


def test_the_power_of_the_stress_is_eta_times_the_square_of_the_rate_of_strain(rng):
    for _ in range(5):
        F, C = np.eye(2) + rng.uniform(-0.4, 0.4, (2, 2)), rng.standard_normal((2, 2))
        strain_rate = F.T @ (C + C.T) @ F / 2.0  # dE/dt where dF/dt = C F
        tau = stress(F, C, ETA)
        assert np.sum(tau * C) == pytest.approx(ETA * np.sum(strain_rate**2), rel=1e-13)
        assert tau == pytest.approx(F @ (ETA * strain_rate) @ F.T, rel=1e-12)


def test_rigid_motion_has_no_viscous_stress_and_turns_that_of_strain(rng):
    F, C = np.eye(2) + rng.uniform(-0.4, 0.4, (2, 2)), rng.standard_normal((2, 2))
    spin = np.array([[0.0, -3.0], [3.0, 0.0]])
    assert np.abs(stress(F, spin, ETA)).max() <= 1e-15
    R = np.array([[0.6, -0.8], [0.8, 0.6]])
    turned = stress(R @ F, R @ C @ R.T + spin, ETA)
    assert turned == pytest.approx(R @ stress(F, C, ETA) @ R.T, rel=1e-12)


def test_the_adjoint_is_the_transpose_of_the_derivative(rng):
    for _ in range(5):
        x = np.concatenate([np.eye(2).ravel() + rng.uniform(-0.4, 0.4, 4), rng.standard_normal(4)])
        T = rng.standard_normal(3)
        (d00, d01, d11), F_bar = law("viscosity_adjoint")(x[:4], x[4:], (0.0, 0.0, ETA), T)
        for k, bar in enumerate((*F_bar, d00, d01, d01, d11)):
            moved = x.astype(complex)
            moved[k] += 1j * COMPLEX_STEP
            tau = stress(moved[:4].reshape(2, 2), moved[4:].reshape(2, 2), ETA).imag
            derivative = T @ [tau[0, 0], tau[0, 1], tau[1, 1]] / COMPLEX_STEP
            assert derivative == pytest.approx(bar, rel=1e-12)


@pytest.mark.parametrize("dtype", [float, complex])
def test_kernels_do_what_the_equations_say(rng, dtype):
    scene = viscous_scene(steps=3)
    particles = discretise(scene)
    count = len(particles.position)
    state = at_rest(particles).astype(dtype)
    state[2:4] = rng.uniform(-0.1, 0.1, (2, count))
    state[4:8] = rng.uniform(-20.0, 20.0, (4, count))
    state[8:12] += rng.uniform(-0.2, 0.2, (4, count))
    stiffness = rng.uniform(0.1, 1.0, count)
    simulation = Simulation(
        scene, particles, np.ones(count), stiffness, np.full((3, 2), 0.5), state
    )  # fmt: skip
    expected = step(simulation, state, 0)
    assert np.abs(simulation.run([1])[0] - expected).max() <= 1e-12 * np.abs(expected).max()


def test_every_kernel_is_transposed_and_the_whole_gradient_is_exact(rng):
    scene = viscous_scene()
    assert worst_of(kernel_mismatches(scene)) <= DOT_TOLERANCE
    problem = Problem(scene, 2.0, halvings=0, limits=None)
    x = problem.join(rng.uniform(-1.0, 1.0, 32), [0.9, 0.5], [-0.3, 0.2], [-0.5, 0.1])
    assert worst(complex_step_test(problem, x)) <= 1e-12


def worst_of(mismatches):
    return max(mismatches.values())


def test_a_solid_in_uniform_strain_loses_what_viscosity_takes():
    # One step of a block in affine motion, which transfers keep: the kinetic energy that the
    # viscous stress takes is V dt eta |dE/dt|^2, to the order of the step.
    lost = []
    for eta in (0.0, ETA):
        material = Material(viscosity=eta)
        scene = small_scene(
            material=material, walls=(), gravity=(0.0, 0.0), steps=1, time_step=1e-5,
            body=(Solid((5 / 16, 5 / 16), (9 / 16, 9 / 16)),),
        )  # fmt: skip
        particles = discretise(scene)
        state = at_rest(particles)
        rate = np.array([[0.3, 0.2], [-0.1, 0.4]])
        state[2:4] = rate @ (particles.position.T - 7 / 16)
        state[4:8] = rate.reshape(4, 1)
        simulation = solid_simulation(scene, particles, state)
        records = [kernels.grouped(s) for s in simulation.run([0, 1])]
        before, after = (
            sum(kernels.energy(r, simulation.data, simulation.parameters)) for r in records
        )
        lost.append(before - after)
    D = (rate + rate.T) / 2.0
    taken = particles.volume.sum() * 1e-5 * ETA * np.sum(D**2)
    assert lost[1] - lost[0] == pytest.approx(taken, rel=1e-3)
