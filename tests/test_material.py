"""The stress is the derivative of the energy density, and the energy balance counts that energy."""

import numpy as np
import pytest
from conftest import small_scene

from mpmopt import kernels
from mpmopt.assess.verify import COMPLEX_STEP
from mpmopt.kernels import material
from mpmopt.scene.particles import discretise
from mpmopt.simulation import energy
from mpmopt.simulation.simulation import Simulation


def density(F, lam, mu, sS):
    """Of what tau in docs/theory.rst derives from, for tensors (2, 2, N) at a fixed signal."""
    J = F[0, 0] * F[1, 1] - F[0, 1] * F[1, 0]
    trace, C = (F * F).sum(axis=(0, 1)), np.einsum("kip,kjp->ijp", F, F)
    passive = mu / 2.0 * (trace - 2.0) - mu * np.log(J) + lam / 2.0 * np.log(J) ** 2
    return passive + 0.5 * (sS * C).sum(axis=(0, 1))


@pytest.fixture
def simulation(rng):
    """A rough state at rest, of particles of different material, and two unlike signals."""
    scene = small_scene(walls=(), gravity=(3.0, -7.0))
    particles = discretise(scene)
    count = len(particles.position)
    state = np.zeros((12, count))
    state[0:2] = particles.position.T
    state[8:12] = 0.25 * rng.uniform(-1.0, 1.0, (4, count))
    state[[8, 11]] += 1.0
    signal = np.tile([1.3, -0.7], (scene.steps, 1))
    density, stiffness = rng.uniform(0.1, 2.0, (2, count))
    made = Simulation(scene, particles, density, stiffness, signal, state)
    unlike = made.data.constants * rng.uniform(0.5, 2.0, made.data.constants.shape)
    made.data = made.data._replace(constants=unlike)
    return made


def materials(simulation):
    """lambda, mu, m and V of the particles, and s S (2, 2, N)."""
    data, count = simulation.data, simulation.initial.shape[1]
    fields = (*data.stiffness * data.constants[:2], data.mass, data.volume)
    sS = np.zeros((2, 2, count))
    for k, actuator in enumerate(simulation.scene.actuators):
        there = simulation.particles.actuator == k
        sS[:, :, there] = simulation.signal[0, k] * np.array(actuator.stress)[:, :, None]
    return [kernels.ungrouped(values, 1, count)[0] for values in fields], sS


def law(name):
    """A function of the law for single numbers, real or complex, as it is written."""
    return kernels.plain(getattr(material, name))


def moved(F, lam, mu):
    """What the law's functions take, from F (2, 2)."""
    return tuple(F.ravel()), np.log(F[0, 0] * F[1, 1] - F[0, 1] * F[1, 0]), (lam, mu)


def test_the_stress_of_the_law_derives_from_its_energy(rng):
    # tau = dPsi/dF F^T, by the complex step: asked of any law.
    for _ in range(5):
        F, (lam, mu) = np.eye(2) + rng.uniform(-0.4, 0.4, (2, 2)), rng.uniform(0.5, 20.0, 2)
        P = np.zeros((2, 2))
        for i, j in np.ndindex(2, 2):
            shift = np.zeros((2, 2), complex)
            shift[i, j] = 1j * COMPLEX_STEP
            P[i, j] = law("energy_density")(*moved(F + shift, lam, mu)).imag / COMPLEX_STEP
        t00, t01, t11 = law("kirchhoff")(*moved(F, lam, mu))
        assert pytest.approx(np.array([[t00, t01], [t01, t11]]), rel=1e-13, abs=1e-13) == P @ F.T


def test_the_adjoint_of_the_law_is_the_transpose_of_its_derivative(rng):
    # Asked of any law: T : dtau = F_bar : dF, dtau by the complex step.
    for _ in range(5):
        F, constants = np.eye(2) + rng.uniform(-0.4, 0.4, (2, 2)), rng.uniform(0.5, 20.0, 2)
        T = rng.standard_normal(3)
        F_bar = law("kirchhoff_adjoint")(*moved(F, *constants), T)
        for k, bar in enumerate(F_bar):
            shift = np.zeros(4, complex)
            shift[k] = 1j * COMPLEX_STEP
            tau = law("kirchhoff")(*moved(F + shift.reshape(2, 2), *constants))
            assert T @ np.imag(tau) / COMPLEX_STEP == pytest.approx(bar, rel=1e-12)


def test_the_kirchhoff_stress_is_the_derivative_of_the_energy_density(simulation):
    (lam, mu, _, V), sS = materials(simulation)
    data, parameters, count = simulation.data, simulation.parameters, simulation.initial.shape[1]
    F = simulation.initial[8:12].reshape(2, 2, count)
    P = np.zeros_like(F)
    for i, j in np.ndindex(2, 2):
        moved = F.astype(complex)
        moved[i, j] += 1j * COMPLEX_STEP
        P[i, j] = density(moved, lam, mu, sS).imag / COMPLEX_STEP
    expected = np.einsum("ikp,jkp->ijp", P, F)

    records, groups = kernels.grouped(simulation.initial), len(data.mass)
    tile, log_J = kernels.make_tile(groups, records), np.zeros((groups, 4))
    new = records.copy()
    assert kernels.deform(records, new, parameters, log_J, 0, groups)
    kernels.stress(records, new, log_J, data, parameters, simulation.signal[0], tile, 0, groups)
    affine = kernels.ungrouped(tile.affine, 4, count).reshape(2, 2, count) / parameters.dx
    tau = -affine / (parameters.dt * V * 4.0 / parameters.dx**2)  # C = 0
    assert np.abs(tau - expected).max() <= 1e-13 * np.abs(expected).max()


def test_the_balance_counts_the_energy_that_the_stress_derives_from(simulation):
    (lam, mu, m, V), _ = materials(simulation)
    F = simulation.initial[8:12].reshape(2, 2, -1)
    weight = m @ (np.array(simulation.scene.gravity) @ simulation.initial[0:2])
    kinetic, potential = energy.energy(
        kernels.grouped(simulation.initial), simulation.data, simulation.parameters
    )
    assert kinetic == 0.0
    assert potential == pytest.approx(V @ density(F, lam, mu, 0.0 * F) - weight, rel=1e-13)


def test_kinetic_energy_is_that_of_the_velocity_and_of_its_gradient(simulation, rng):
    # The affine momentum has the inertia m dx^2 / 4; F and x are taken half a step away.
    (lam, mu, m, V), _ = materials(simulation)
    state, (dt, dx) = simulation.initial, simulation.parameters[:2]
    state[2:8] = rng.uniform(-1.0, 1.0, (6, state.shape[1]))
    found = energy.energy(kernels.grouped(state), simulation.data, simulation.parameters)
    C, F = state[4:8].reshape(2, 2, -1), state[8:12].reshape(2, 2, -1)
    half = F + dt / 2.0 * np.einsum("ijp,jkp->ikp", C, F)
    at = state[0:2] - dt / 2.0 * state[2:4]
    weight = m @ (np.array(simulation.scene.gravity) @ at)
    kinetic = 0.5 * m @ ((state[2:4] ** 2).sum(axis=0) + dx**2 / 4.0 * (C**2).sum(axis=(0, 1)))
    potential = V @ density(half, lam, mu, 0.0 * F) - weight
    assert found == pytest.approx((kinetic, potential), rel=1e-13)


def test_what_actuators_squeeze_is_what_their_signals_multiply(simulation):
    # d(sum V Psi) / ds, actuator by actuator.
    (lam, mu, _, V), sS = materials(simulation)
    held = np.zeros((1, 2))
    records = kernels.grouped(simulation.initial)[None]
    energy.grips(records, np.zeros(1, np.int64), simulation.data, simulation.parameters, held)
    F = simulation.initial[8:12].reshape(2, 2, -1)
    for k in (0, 1):
        own = np.where(simulation.particles.actuator == k, sS, 0.0) / simulation.signal[0, k]
        stored = density(F, lam, mu, own) - density(F, lam, mu, 0.0 * own)
        assert held[0, k] == pytest.approx(V @ stored, rel=1e-12)
