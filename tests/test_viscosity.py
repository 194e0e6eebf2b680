"""Kelvin-Voigt viscosity: its stress and adjoint, the power it takes, and the laws it obeys."""

import dataclasses

import numpy as np
import pytest
from conftest import small_scene, worst
from exact import Bar, at_rest, solid_simulation
from stability import time_step

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
    assert max(kernel_mismatches(scene).values()) <= DOT_TOLERANCE
    problem = Problem(scene, 2.0, halvings=0, limits=None)
    x = problem.join(rng.uniform(-1.0, 1.0, 32), [0.9, 0.5], [-0.3, 0.2], [-0.5, 0.1])
    assert worst(complex_step_test(problem, x)) <= 1e-12


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


def test_a_bar_vibrates_with_the_damping_that_eta_says():
    # Its own damping, that of the transfers, is that of the bar without viscosity.
    plain, viscous = Bar(16, 0.25), Bar(16, 0.25, viscosity=20.0)
    own, found = (b.value_and_gradient()[0] for b in (plain, viscous))
    assert viscous.damped() < 0.7
    assert found / own == pytest.approx(viscous.damped(), rel=0.01)


def test_the_courant_number_follows_stretch(rng):
    # The step over the longest stable one, of moduli from the maps of strain rates to stress.
    scene = viscous_scene()
    particles = discretise(scene)
    state = at_rest(particles)
    state[8:12, 0] += rng.uniform(-0.4, 0.6, 4)
    simulation = solid_simulation(scene, particles, state)
    F, mu, la = state[8:12, 0].reshape(2, 2), scene.material.lame_mu, scene.material.lame_lambda
    b = F @ F.T
    basis = [np.diag([1.0, 0.0]), np.diag([0.0, 1.0]), np.array([[0.0, 1.0], [1.0, 0.0]]) / 2**0.5]

    def modulus(change):
        return np.linalg.eigvalsh([[np.sum(E * change(D)) for D in basis] for E in basis]).max()

    elastic = modulus(lambda D: mu * (D @ b + b @ D) + la * np.trace(D) * np.eye(2))
    viscous = modulus(lambda D: ETA * b @ D @ b)
    dt, per = scene.time_step, 4.0 / scene.grid.dx**2  # rho = 1
    longest = 4.0 / (per * viscous + np.sqrt((per * viscous) ** 2 + 4.0 * per * elastic))
    found = simulation.indicators(kernels.grouped(state)).courant
    assert found == pytest.approx(dt / longest, rel=1e-12)
    assert found > scene.time_step / scene.largest_time_step


def test_the_limit_on_the_step_is_that_of_the_isolated_particle_and_blocks_bear_more():
    for eta in (0.3, 10.0):
        material = Material(1.0, 1.0, viscosity=eta)
        legal = material.largest_time_step(1.0)
        # c dt + omega^2 dt^2 / 2 = 2 with c = 4 eta / (rho dx^2), omega^2 = 8 (lambda + mu) / ...
        assert 4.0 * eta * legal + 8.0 * legal**2 == pytest.approx(2.0, rel=1e-12)
        scene = dataclasses.replace(
            time_step.block_scene(steps=1000), material=material, time_step=0.9 * legal
        )  # fmt: skip
        courant = legal * material.wave_speed

        def stable(particles, share, scene=scene, courant=courant):
            ones = np.ones(len(particles.position))
            return time_step.stays_small(scene, particles, ones, share * courant)

        one, block = time_step.isolated(scene), discretise(scene)
        assert stable(one, 0.98) and not stable(one, 1.02)
        assert stable(block, 1.2) and not stable(block, 1.6)
