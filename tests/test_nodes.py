"""What happens on nodes: walls and friction branch by branch, and next to no mass."""

import itertools

import numpy as np
import pytest
from conftest import small_scene

from mpmopt import kernels
from mpmopt.assess.verify import (
    COMPLEX_STEP,
    DOT_TOLERANCE,
    kernel_mismatches,
)
from mpmopt.scene import Solid, Wall
from mpmopt.scene.particles import discretise
from mpmopt.simulation.checkpoints import Checkpointing
from mpmopt.simulation.reference import step
from mpmopt.simulation.simulation import Simulation
from mpmopt.simulation.surroundings import parameters_of

C = 1 / 16
FRICTION = (0.0, 0.4, 1.5, "stick")


def wall_law(walls, node, velocity, seen=None):
    """The walls as docs/theory.rst has them, for real and complex velocities."""
    v = list(velocity)
    for wall in walls:
        k = "xy".index(wall.axis)
        out = 1.0 if wall.solid_side == "below" else -1.0  # of the wall, along its axis
        if out * (wall.position - node[k] * C) < 1e-9:
            branch = "in front"
        elif out * v[k].real >= 0.0:
            branch = "leaves"
        else:
            into, along = -out * v[k], v[1 - k]
            sign = 1.0 if along.real > 0.0 else -1.0
            v[k] = 0.0 * v[k]
            if wall.friction == "stick" or abs(along.real) <= wall.friction * into.real:
                branch, v[1 - k] = "sticks", 0.0 * along
            else:
                branch, v[1 - k] = f"slides {sign:+.0f}", along - sign * wall.friction * into
        if seen is not None:
            seen.add((wall.axis, wall.solid_side, branch))
    return v


def world_with(*walls):
    """The parameters of a scene with such walls at 4 or 12 cells, and a body between them."""
    body = (Solid((7 * C, 7 * C), (8 * C, 8 * C)),)
    return parameters_of(small_scene(walls=walls, body=body))


def at(axis, side, friction):
    return Wall(axis, (4 if side == "below" else 12) * C, side, friction=friction)


def check(walls, rng, samples, seen):
    """Velocities after the walls and their adjoint against `wall_law`, on all sides of them."""
    parameters = world_with(*walls)
    behind_or_not = itertools.product((2, 3, 4, 12, 13, 14), repeat=2)
    for node in behind_or_not:
        for _ in range(samples):
            v, bar = rng.standard_normal((2, 2))
            expected = wall_law(walls, node, v, seen)
            assert np.abs(np.subtract(kernels.wall(*node, *v, parameters), expected)).max() <= 1e-15
            columns = [
                np.imag(wall_law(walls, node, v + 1j * COMPLEX_STEP * direction)) / COMPLEX_STEP
                for direction in np.eye(2)
            ]
            found = kernels.wall_adjoint(*node, *v, parameters, *bar)
            assert np.abs(found - np.array(columns) @ bar).max() <= 1e-14


def test_every_branch_of_a_wall_and_of_its_adjoint(rng):
    seen: set[tuple[str, ...]] = set()
    for axis, side, friction in itertools.product("xy", ("below", "above"), FRICTION):
        check([at(axis, side, friction)], rng, 8, seen)
    branches = ("in front", "leaves", "sticks", "slides -1", "slides +1")
    assert seen == set(itertools.product("xy", ("below", "above"), branches))


@pytest.mark.parametrize("axis", ["x", "y"])
def test_without_friction_nothing_sticks_at_rest_either(axis):
    # Every body that starts at rest on such a wall asks for this derivative.
    parameters = world_with(at(axis, "below", 0.0))
    rest = (-1.0 + 0.0j, 1j * COMPLEX_STEP)[:: 1 if axis == "x" else -1]
    along = (0.0, 1.0) if axis == "x" else (1.0, 0.0)
    assert np.imag(kernels.wall(2, 2, *rest, parameters)) / COMPLEX_STEP == pytest.approx(along)
    assert kernels.wall_adjoint(2, 2, *np.real(rest), parameters, 1.0, 1.0) == along


@pytest.mark.parametrize("order", [1, -1])
def test_two_walls_with_friction_meet_in_a_corner_one_after_the_other(rng, order):
    seen: set[tuple[str, ...]] = set()
    for one, other in itertools.product(("below", "above"), repeat=2):
        for friction in itertools.product(FRICTION, repeat=2):
            walls = [at("x", one, friction[0]), at("y", other, friction[1])]
            check(walls[::order], rng, 2, seen)
    assert len(seen) == 2 * 2 * 5


def test_a_body_in_a_corner_with_friction_does_what_the_walls_say():
    # Each wall's friction counts, and that of the second one from what the first one leaves.
    walls = (at("x", "below", 0.5), at("y", "below", 0.25))
    assert kernels.wall(2, 2, -2.0, -4.0, world_with(*walls)) == pytest.approx((0.0, 0.0))
    assert kernels.wall(2, 2, -2.0, -3.0, world_with(*walls)) == pytest.approx((0.0, 0.0))
    assert kernels.wall(2, 2, -2.0, 3.0, world_with(*walls)) == pytest.approx((0.0, 2.0))
    assert kernels.wall(2, 2, 3.0, -4.0, world_with(*walls)) == pytest.approx((2.0, 0.0))
    assert kernels.wall(2, 2, 3.0, -4.0, world_with(*walls[::-1])) == pytest.approx((2.0, 0.0))
    lifts = (at("x", "above", 0.5), at("y", "below", 0.25))
    assert kernels.wall(13, 2, 2.0, -4.0, world_with(*lifts)) == pytest.approx((0.0, 0.0))


def test_adjoints_of_a_corner_with_friction_on_both_walls():
    walls = (Wall("y", 4 * C, friction=0.3), Wall("x", 3 * C, friction=0.6))
    scene = small_scene(walls=walls)
    for seed in range(3):
        assert max(kernel_mismatches(scene, seed).values()) <= DOT_TOLERANCE


def barely_touching(seed, change=0.0):
    """A step of particles that end so near the ends of their cells that some nodes get nothing.

    Where two such weights meet, a node has 1e-30 of a particle's mass: less than rounding of it.
    """
    scene = small_scene(walls=(), steps=1)
    rng = np.random.default_rng(seed)
    particles = discretise(scene)
    count = len(particles.position)
    state = np.zeros((12, count))
    off = 10.0 ** rng.uniform(-12.0, -6.0, (2, count)) * rng.choice([-1.0, 1.0], (2, count))
    state[0:2] = particles.position.T + (0.25 + off) * scene.grid.dx
    state[2:4] = rng.standard_normal((2, count))
    state[4:8] = 10.0 * rng.standard_normal((4, count))
    state[8:12] = 0.1 * rng.standard_normal((4, count))
    state[[8, 11]] += 1.0
    ones = np.ones(count)
    signal = np.full((scene.steps, 2), 0.5)
    return Simulation(scene, particles, ones, ones, signal, state + change)


# Of the first hundred, those where such a node would spoil something, compiled or not.
SEEDS = (31, 41, 49, 54, 59, 65, 71, 91, 100)


def test_nodes_with_next_to_no_mass_spoil_no_velocity():
    for seed in SEEDS:
        simulation = barely_touching(seed)
        expected = step(simulation, simulation.initial, 0)
        assert np.abs(simulation.run() - expected).max() <= 1e-12 * np.abs(expected).max(), seed


def test_nodes_with_next_to_no_mass_spoil_no_gradient(rng):
    for seed in SEEDS:
        simulation = barely_touching(seed)
        bar, direction = rng.standard_normal((2, *simulation.initial.shape))
        with simulation.checkpoints(Checkpointing()) as checkpoints:
            gradient = simulation.forward(checkpoints).reverse({simulation.steps: bar}).state
        change = 1j * COMPLEX_STEP * direction
        moved = barely_touching(seed, change).run().imag / COMPLEX_STEP
        terms = np.abs(gradient * direction).sum() + np.abs(bar * moved).sum()
        assert abs((gradient * direction).sum() - (bar * moved).sum()) <= 1e-9 * terms, seed
