"""Kernels: identities of one step. All of these also run with the JIT switched off."""

import math
from fractions import Fraction

import numpy as np
import pytest
from conftest import small_scene, worst
from numba import config

from mpmopt import kernels
from mpmopt.assess.verify import (
    COMPLEX_TOLERANCE,
    DOT_TOLERANCE,
    complex_step_test,
    kernel_mismatches,
)
from mpmopt.design.problem import Problem
from mpmopt.scene import Actuator, Design, Grid, Scene, Solid, Wall
from mpmopt.scene.particles import discretise
from mpmopt.simulation.reference import step
from mpmopt.simulation.simulation import Simulation
from mpmopt.simulation.surroundings import parameters_of


def one_step(scene, state, signal=0.0, dtype=float):
    """Advance a state by one step; new state, nodes and window."""
    particles = discretise(scene)
    ones = np.ones(len(particles.position), dtype)
    simulation = Simulation(
        scene, particles, ones, ones,
        np.full((scene.steps, len(scene.actuators)), signal), state,
    )  # fmt: skip
    groups, nodes = len(simulation.data.mass), 400
    states = np.zeros((2, kernels.STATE_SIZE * groups, 4), dtype)
    states[0] = kernels.grouped(state)
    grids = np.zeros((1, nodes, kernels.NODE_SIZE), dtype)
    windows = np.zeros((1, 2, 4), np.int64)
    logs = np.zeros((1, groups, 4), dtype)
    data, parameters = simulation.data, simulation.parameters
    scratch = kernels.Scratch.make(nodes, 1, nodes, dtype)
    reached, end, particle = kernels.advance(
        states,
        grids,
        windows,
        logs,
        0,
        1,
        data,
        parameters,
        simulation.signal,
        scratch,
        np.zeros(24, np.int64),
        0,
        1,
    )
    assert (reached, end, particle) == (1, kernels.DONE, -1)
    # A is dropped when nodes have it; the same kernel gives it again.
    tile = kernels.make_tile(groups, states)
    kernels.stress(
        states[0], states[1], logs[0], data, parameters, simulation.signal[0], tile, 0, groups
    )
    affine = kernels.ungrouped(tile.affine, 4, state.shape[1]) / parameters.dx
    return kernels.ungrouped(states[1], *state.shape), grids[0], windows[0, 1], affine


@pytest.fixture
def free():
    """A scene with nothing to touch and no gravity."""
    return small_scene(walls=(), gravity=(0.0, 0.0))


@pytest.fixture
def state(free, rng):
    """A rough state of all its particles."""
    position = discretise(free).position.T
    state = np.zeros((12, position.shape[1]))
    state[0:2] = position
    state[2:4] = rng.standard_normal(position.shape)
    state[4:8] = 10.0 * rng.standard_normal((4, position.shape[1]))
    state[8:12] = 0.1 * rng.standard_normal((4, position.shape[1]))
    state[[8, 11]] += 1.0
    return state


@pytest.mark.parametrize("off", [1e-8, 1e-10, -1e-10, 1e-12])
def test_nodes_that_are_hardly_touched_spoil_nothing(state, off):
    # Particles this close to where their cell ends put 1e-16 of their mass or less on outer nodes.
    scene = small_scene(walls=())
    state[0] += (0.25 + off) * scene.grid.dx
    ones = np.ones(state.shape[1])
    signal = np.full((scene.steps, 2), 0.5)
    particles = discretise(scene)
    simulation = Simulation(scene, particles, ones, ones, signal, state)
    expected = step(simulation, state, 0)
    found = simulation.run([1])[0]
    assert np.abs(found - expected).max() <= 1e-12 * np.abs(expected).max()


@pytest.mark.parametrize("x", [0.5, 0.51, 0.75, 1.0, 1.3, 1.4999])
def test_weights_interpolate_linear_fields_and_know_the_second_moment(x):
    dx = 0.1
    w, d = kernels.weights(x), [(node - x) * dx for node in range(3)]
    assert sum(w) == pytest.approx(1.0, abs=1e-15)
    assert sum(a * b for a, b in zip(w, d, strict=True)) == pytest.approx(0.0, abs=1e-16)
    moment = sum(a * b**2 for a, b in zip(w, d, strict=True))
    assert moment == pytest.approx(dx**2 / 4, rel=1e-13)  # why C' is scaled by 4 / dx^2


@pytest.mark.parametrize("t", [-0.5, -0.13, 0.0, 0.4, 0.499])
def test_the_weights_are_quadratic_in_a_cell(t):
    # The Taylor expansion of a field that is one at one node is the weight of that node.
    for node in range(3):
        value, slope, curvature = kernels.expand(*np.eye(3)[node])
        expansion = value + t * slope + 0.5 * t**2 * curvature
        assert expansion == pytest.approx(kernels.weights(1.0 + t)[node], abs=3e-16)
        assert kernels.expand_adjoint(1.0, t, 0.5 * t**2)[node] == pytest.approx(
            expansion, abs=3e-16
        )


@pytest.mark.parametrize("dtype", [float, complex])
def test_kernels_do_what_the_equations_say_node_by_node(state, dtype):
    scene = small_scene()
    expected = state.astype(dtype)
    particles = discretise(scene)
    ones = np.ones(len(particles.position), dtype)
    signal = np.full((scene.steps, 2), 0.5)
    simulation = Simulation(scene, particles, ones, 0.8 * ones, signal, expected)
    for n, found in zip(range(4), simulation.run(range(5))):
        assert np.abs(found - expected).max() <= 1e-13 * np.abs(expected).max()
        expected = step(simulation, expected, n)


@pytest.mark.parametrize("dx", [8.0, 7.0, 0.15, 1 / 22])
@pytest.mark.parametrize(("per_cell", "columns"), [(1, 2), (1, 4), (1, 8), (3, 4), (5, 2)])
def test_particles_on_the_edge_of_two_cells_get_their_own_nodes_velocities(dx, per_cell, columns):
    # In the middle between two nodes, where rounding may find either cell; but only one of them.
    body = (Actuator((dx, dx), ((1 + columns) * dx, 2 * dx)),)
    scene = Scene(Grid((12, 4), dx), 1e-2 * dx, 2, body, particles_per_cell=per_cell)
    particles = discretise(scene)
    ones = np.ones(len(particles.position))
    signal = np.full((scene.steps, 1), 0.3)
    simulation = Simulation(scene, particles, ones, ones, signal)
    expected = simulation.initial
    for n, found in enumerate(simulation.run([1, 2])):
        expected = step(simulation, expected, n)
        assert np.abs(found[2:4] - expected[2:4]).max() <= 1e-12 * np.abs(expected[2:4]).max()


@pytest.mark.skipif(
    bool(getattr(config, "DISABLE_JIT", 0)), reason="NumPy rounds a product and a sum twice"
)
def test_a_velocity_that_all_but_vanishes_has_the_sign_that_is_exact(rng):
    # Walls ask for it, forward and adjoint, so that neither may round it in its own way.
    parameters = parameters_of(small_scene())
    pull = parameters.dt * parameters.gravity_y
    for per_m in rng.uniform(1.0, 2.0, 200):
        q = -pull / per_m
        found = kernels.free_velocity(np.array([[q, q, 0.0, 0.0]]), 0, per_m, parameters)[1]
        assert found == float(Fraction(q) * Fraction(per_m) + Fraction(pull))


@pytest.mark.parametrize(("per_cell", "dx"), [(1, 7.0), (3, 0.15)])
def test_the_gradient_is_right_where_particles_are_on_the_edge_of_two_cells(per_cell, dx, rng):
    body = (
        Design((2 * dx, 2 * dx), (6 * dx, 4 * dx)),
        Actuator((2 * dx, 4 * dx), (6 * dx, 5 * dx)),
    )
    scene = Scene(
        Grid((12, 8), dx), 2e-2 * dx, 20, body, (Wall("y", 2 * dx),), gravity=(0.0, -0.1 / dx),
        particles_per_cell=per_cell,
    )  # fmt: skip
    problem = Problem(scene, halvings=0, limits=None)
    x = problem.join(rng.uniform(-0.5, 0.5, 8 * per_cell**2), 0.9, -0.3, -0.5)
    assert worst(complex_step_test(problem, x)) <= COMPLEX_TOLERANCE


def test_a_step_conserves_mass_momentum_and_angular_momentum(free, state):
    new, grid, _, _ = one_step(free, state, signal=1.5)
    m = discretise(free).volume
    dx = free.grid.dx

    def momenta(s):
        # APIC's angular momentum counts the particles' own spin, m dx^2 / 4 (C10 - C01).
        spin = dx**2 / 4 * (s[6] - s[5])
        return (m * s[2:4]).sum(axis=1), (m * (s[0] * s[3] - s[1] * s[2] + spin)).sum()

    scale = np.abs(m * state[2:4]).sum()
    assert grid[:, 2].sum() == pytest.approx(m.sum(), rel=1e-14)
    assert grid[:, 0].sum() == pytest.approx(momenta(state)[0][0], abs=1e-14 * scale)
    assert momenta(new)[0] == pytest.approx(momenta(state)[0], abs=1e-14 * scale)
    assert momenta(new)[1] == pytest.approx(momenta(state)[1], abs=1e-14 * scale)


@pytest.mark.parametrize("angle", [0.0, 0.3, 2.0])
def test_rigid_rotation_and_translation_are_stress_free(free, state, angle):
    c, s = math.cos(angle), math.sin(angle)
    state[2:4] = np.array([[0.3], [-0.2]])
    state[4:8] = 0.0
    state[8:12] = np.array([[c], [-s], [s], [c]])
    new, _, _, affine = one_step(free, state)
    # A = -dt V (4/dx^2) tau; the terms that cancel in tau are about mu = 10.
    impulse = free.time_step * discretise(free).volume.max() * 4 / free.grid.dx**2
    assert np.abs(affine).max() <= 1e-14 * 10.0 * impulse
    assert new[2:4] == pytest.approx(state[2:4], abs=1e-14)
    assert new[0:2] - state[0:2] == pytest.approx(free.time_step * state[2:4], abs=1e-14)


def test_linear_velocity_fields_pass_the_grid_unchanged(free, state, rng):
    # With v = v0 + L x and no stress, C' = L and v' = v: the affine transfer is exact.
    L = rng.standard_normal((2, 2))
    state[2:4] = L @ state[0:2]
    state[4:8] = L.reshape(4, 1)
    # F' = (I + dt L) F = I
    state[8:12] = np.linalg.inv(np.eye(2) + free.time_step * L).reshape(4, 1)
    new, *_ = one_step(free, state)
    assert new[2:4] == pytest.approx(state[2:4], abs=1e-12)
    assert new[4:8] == pytest.approx(state[4:8], abs=1e-11)


def test_small_strain_gives_linear_elasticity(free, state, rng):
    strain = 1e-7 * rng.standard_normal((2, 2))
    strain = strain + strain.T
    state[2:8] = 0.0
    state[8:12] = (np.eye(2) + strain).reshape(4, 1)
    *_, affine = one_step(free, state)
    impulse = free.time_step * discretise(free).volume[0] * 4 / free.grid.dx**2
    tau = -affine[:, 0].reshape(2, 2) / impulse
    assert tau == pytest.approx(20.0 * strain + 10.0 * np.trace(strain) * np.eye(2), rel=1e-5)


def test_actuation_adds_the_pushed_forward_stress(free, state):
    *_, rest = one_step(free, state, signal=0.0)
    new, _, _, squeezed = one_step(free, state, signal=1.5)
    particles = discretise(free)
    impulse = free.time_step * particles.volume[0] * 4 / free.grid.dx**2
    difference = -(squeezed - rest).T.reshape(-1, 2, 2) / impulse
    F = new[8:12].T.reshape(-1, 2, 2)
    S = np.zeros_like(F)
    for k, actuator in enumerate(free.actuators):
        S[particles.actuator == k] = actuator.stress
    assert difference == pytest.approx(1.5 * F @ S @ F.transpose(0, 2, 1), abs=1e-12)


@pytest.mark.parametrize(
    ("wall", "before", "after"),
    [
        # approaching a floor: sticks, slides freely, or slides with Coulomb's friction
        (Wall("y", 0.25), (2.0, -1.0), (0.0, 0.0)),
        (Wall("y", 0.25, friction=0.0), (2.0, -1.0), (2.0, 0.0)),
        (Wall("y", 0.25, friction=0.5), (2.0, -1.0), (1.5, 0.0)),
        (Wall("y", 0.25, friction=0.5), (-2.0, -1.0), (-1.5, 0.0)),
        (Wall("y", 0.25, friction=3.0), (2.0, -1.0), (0.0, 0.0)),
        # leaving it: free
        (Wall("y", 0.25), (2.0, 1.0), (2.0, 1.0)),
        (Wall("y", 0.25, friction=0.5), (2.0, 0.0), (2.0, 0.0)),
        # ceiling and side walls
        (Wall("y", 0.125, "above"), (2.0, 1.0), (0.0, 0.0)),
        (Wall("y", 0.125, "above"), (2.0, -1.0), (2.0, -1.0)),
        (Wall("x", 0.25, friction=0.5), (-1.0, 2.0), (0.0, 1.5)),
        (Wall("x", 0.125, "above", friction=0.5), (1.0, -2.0), (0.0, -1.5)),
    ],
)
def test_wall_law(wall, before, after):
    assert kernels.wall(3, 3, *before, world_with(wall)) == pytest.approx(after)


def world_with(wall):
    """The parameters of a scene with one wall and a body out of its way."""
    size = 1 / 16
    low = 0.75 if wall.solid_side == "below" else size
    where = (low, 0.5) if wall.axis == "x" else (0.5, low)
    body = (Solid(where, (where[0] + size, where[1] + size)),)
    return parameters_of(small_scene(walls=(wall,), body=body))


def test_wall_clamps_the_nodes_strictly_behind_it():
    for wall, behind, before_it in (
        (Wall("y", 0.25), 3, 4),
        (Wall("y", 0.25 * (1.0 + 1e-9)), 3, 4),
        (Wall("y", 0.25, "above"), 5, 4),
        (Wall("y", 0.25 * (1.0 - 1e-9), "above"), 5, 4),
    ):
        parameters = world_with(wall)
        into = -1.0 if wall.solid_side == "below" else 1.0
        assert kernels.wall(7, behind, 0.0, into, parameters)[1] == 0.0
        assert kernels.wall(7, before_it, 0.0, into, parameters)[1] == into


def test_window_is_the_smallest_that_holds_all_touched_nodes(free, state):
    _, grid, (i0, j0, ni, nj), _ = one_step(free, state)
    mass = grid[: ni * nj, 2].reshape(ni, nj)
    assert (i0, j0) == (2, 3)
    for edge in (mass[0], mass[-1], mass[:, 0], mass[:, -1]):
        assert edge.max() > 0.0


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf, -0.1, 0.03, 0.97, 1e300])
def test_a_particle_off_the_grid_is_found_before_anything_is_written(free, state, bad):
    for axis in (0, 1):
        broken = state.copy()
        broken[axis, 5] = bad
        records, groups = kernels.grouped(broken), -(-state.shape[1] // 4)
        assert not kernels.find_window(records, parameters_of(free), 0, groups)[4]
        assert kernels.first_outside(records, parameters_of(free), 0, groups) == 5


def test_complex_kernels_have_the_same_real_part(free, state):
    real, *_ = one_step(free, state, signal=0.5)
    both, *_ = one_step(free, state + 1e-30j, signal=0.5, dtype=complex)
    assert np.abs(both.real - real).max() <= 1e-15 * np.abs(real).max()


@pytest.mark.parametrize("seed", range(5))
def test_every_adjoint_is_the_transpose_of_its_kernel(seed):
    mismatches = kernel_mismatches(small_scene(), seed)
    expected = {"deform", "stress", "p2g", "grid_update", "g2p", "design", "signal", "objective"}
    assert set(mismatches) == expected
    assert max(mismatches.values()) <= DOT_TOLERANCE
