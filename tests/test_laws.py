"""Laws of motion over many steps, and an exact solution."""

import math

import numpy as np
import pytest
from exact import at_rest, manufactured_error, solid_simulation

from mpmopt.scene import Grid, Material, Scene, Solid, Wall
from mpmopt.scene.particles import Particles, discretise


def energy(scene, m, V, state):
    """Kinetic (with the affine part) and stored neo-Hookean energy."""
    inertia = scene.grid.dx**2 / 4
    kinetic = 0.5 * (m * ((state[2:4] ** 2).sum(axis=0) + inertia * (state[4:8] ** 2).sum(axis=0)))
    J = state[8] * state[11] - state[9] * state[10]
    material = scene.material
    stored = V * (
        material.lame_mu / 2 * ((state[8:12] ** 2).sum(axis=0) - 2)
        - material.lame_mu * np.log(J)
        + material.lame_lambda / 2 * np.log(J) ** 2
    )
    return kinetic.sum(), stored.sum()


def test_spinning_disc_keeps_momentum_and_angular_momentum():
    n, radius, omega = 64, 0.15, 10.0
    dx = 1 / n
    scene = Scene(
        Grid((n, n), dx), time_step=2e-4, steps=5000,
        body=(Solid((0.25, 0.25), (0.75, 0.75)),),
    )  # fmt: skip
    everything = discretise(scene)
    arm = everything.position - 0.5
    disc = everything.subset(np.hypot(*arm.T) < radius)
    state = at_rest(disc)
    arm = disc.position.T - 0.5
    state[2], state[3] = -omega * arm[1], omega * arm[0]
    state[5], state[6] = -omega, omega
    m = disc.volume
    states = solid_simulation(scene, disc, state).run([0, 2500, 5000])

    def angular(s):
        return (m * (s[0] * s[3] - s[1] * s[2] + dx**2 / 4 * (s[6] - s[5]))).sum()

    for later in states[1:]:
        assert angular(later) == pytest.approx(angular(states[0]), rel=1e-13)
        assert np.abs((m * later[2:4]).sum(axis=1)).max() <= 1e-14
    kinetic = [sum(energy(scene, m, disc.volume, s)) for s in states]
    assert 0.98 <= kinetic[-1] / kinetic[0] <= 1.0


def test_free_fall_is_exact():
    # Constant acceleration: x_n = x_0 + g dt^2 n (n + 1) / 2 for a symplectic step.
    scene = Scene(
        Grid((32, 32), 1 / 32), time_step=2e-3, steps=100, gravity=(1.0, -10.0),
        body=(Solid((0.25, 0.625), (0.5, 0.75)),),
    )  # fmt: skip
    simulation = solid_simulation(scene)
    end = simulation.run()
    fall = scene.time_step**2 * 100 * 101 / 2
    moved = end[0:2] - simulation.initial[0:2]
    assert moved == pytest.approx(fall * np.array([[1.0], [-10.0]]) * np.ones_like(moved))
    assert end[8:12] == pytest.approx(np.array([[1], [0], [0], [1]]) * np.ones(end.shape[1]))


def test_self_weight_column_carries_what_lies_above():
    # Without lateral stress (lambda = 0) the strain is uniaxial, and at rest the first
    # Piola-Kirchhoff stress is P_yy(Y) = -rho g (l0 - Y) whatever the law.
    n, g, length, mu = 32, 1.0, 0.5, 10.0
    dx = 1 / n
    scene = Scene(
        Grid((n, n), dx), time_step=2e-3, steps=60000, gravity=(0.0, -g),
        material=Material(lame_lambda=0.0, lame_mu=mu),
        body=(Solid((0.25, 0.125), (0.375, 0.125 + length)),),
        walls=(Wall("y", 0.125, friction=0.0),),
    )  # fmt: skip
    particles = discretise(scene)
    end = solid_simulation(scene, particles).run()
    height = particles.position[:, 1] - 0.125
    excess = -mu * (end[11] ** 2 - 1.0) / end[11] - g * (length - height)
    # Means over rows of cells: the two particles in a cell's column share what its nodes resolve.
    row = (height / dx).astype(int)
    mean = np.bincount(row, excess) / np.bincount(row)
    assert np.abs(mean[6:]).max() <= 0.01 * g * length  # below, contact is smeared over kernels
    assert np.abs(end[2:4]).max() <= 1e-3 * math.sqrt(2 * g * length)


def test_a_dropped_block_rests_above_the_floor():
    # Nodes j < 3 are clamped. Contact begins when the lowest particles' kernels reach row 2, at
    # 3.5 dx, and the block rests near 3.1 dx.
    n = 32
    dx = 1 / n
    scene = Scene(
        Grid((n, n), dx), time_step=2e-3, steps=15000, gravity=(0.0, -1.0),
        body=(Solid((8 * dx, 4 * dx), (16 * dx, 10 * dx)),), walls=(Wall("y", 3 * dx),),
    )  # fmt: skip
    simulation = solid_simulation(scene)
    states = simulation.run(range(0, 200, 1))
    lowest = states[:, 1].min(axis=1) / dx
    fall = scene.time_step**2 / dx * np.arange(200) * (np.arange(200) + 1) / 2
    free = np.abs(lowest - (4.25 - fall)) < 1e-9
    assert 3.45 <= lowest[free].min() <= 3.55
    end = simulation.run()
    assert 2.9 <= end[1].min() / dx <= 3.3
    assert np.abs(end[2:4]).max() <= 0.01


@pytest.mark.parametrize("friction", [0.0, 0.2])
def test_a_sliding_block_loses_friction_times_the_normal_impulse(friction):
    # While every touched node slides, Coulomb's law is exact step by step:
    # change of p_x = -mu_f (change of p_y + m g t).
    n, g = 32, 2.0
    dx = 1 / n
    scene = Scene(
        Grid((2 * n, n), dx), time_step=2e-3, steps=400, gravity=(0.0, -g),
        body=(Solid((8 * dx, 3 * dx), (16 * dx, 7 * dx)),),
        walls=(Wall("y", 3 * dx, friction=friction),),
    )  # fmt: skip
    particles = discretise(scene)
    state = at_rest(particles)
    state[2] = 1.0
    end = solid_simulation(scene, particles, state).run()
    m = particles.volume
    lost, (_, rise) = (m * state[2]).sum() - (m * end[2]).sum(), (m * end[2:4]).sum(axis=1)
    normal_impulse = rise + m.sum() * g * scene.duration
    assert normal_impulse >= 0.8 * m.sum() * g * scene.duration
    assert lost == pytest.approx(friction * normal_impulse, rel=1e-10, abs=1e-14)


def test_manufactured_solution_converges_with_order_two():
    errors = np.array([manufactured_error(n, 1e-3) for n in (8, 16, 32)])
    order = np.log2(errors[:-1] / errors[1:])
    assert order.min() >= 1.9
    assert np.all(errors <= 1.15 * np.array([3.61e-2, 8.98e-3, 2.24e-3]))


def test_particles_of_another_order_give_the_same_motion(rng):
    scene = Scene(
        Grid((32, 32), 1 / 32), time_step=2e-3, steps=100, gravity=(0.0, -10.0),
        body=(Solid((0.25, 0.125), (0.5, 0.25)),), walls=(Wall("y", 0.125),),
    )  # fmt: skip
    particles = discretise(scene)
    order = rng.permutation(len(particles.position))
    shuffled = Particles(*(np.ascontiguousarray(a[order]) for a in vars(particles).values()))
    one = solid_simulation(scene, particles).run()
    other = solid_simulation(scene, shuffled).run()
    assert other == pytest.approx(one[:, order], abs=1e-11)
