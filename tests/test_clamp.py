"""Clamps hold nodes fixed or move them, exactly, and their gradient is that."""

import dataclasses
from typing import Any

import numpy as np
import pytest
from conftest import small_scene, worst
from exact import at_rest, solid_simulation

from mpmopt.assess.forces import books
from mpmopt.assess.refinement import variants
from mpmopt.assess.verify import DOT_TOLERANCE, complex_step_test, kernel_mismatches
from mpmopt.design.problem import Problem
from mpmopt.errors import SceneError
from mpmopt.kernels import plain
from mpmopt.kernels.contact import clamp_of
from mpmopt.scene import (
    Actuator,
    Clamp,
    Design,
    Grid,
    Ground,
    Material,
    Mirror,
    Scene,
    Solid,
    Wall,
)
from mpmopt.scene.particles import discretise
from mpmopt.scene.scene import Formulation
from mpmopt.simulation.checkpoints import Checkpointing
from mpmopt.simulation.formulations import simulation_of
from mpmopt.simulation.reference import step
from mpmopt.simulation.surroundings import parameters_of

C = 1 / 16
FORMULATIONS: tuple[Formulation, ...] = "updated", "total"
both = pytest.mark.parametrize("formulation", FORMULATIONS)
PATH = ((0.02, (0.0, 0.0)), (0.06, (0.02, 0.0)), (0.09, (0.02, -0.01)))


def finger(*clamps, **changes):
    """A finger whose left end is held in a wall, with an actuator along its upper side."""
    scene = {
        "grid": Grid((24, 16), C), "time_step": 2e-3, "steps": 60, "gravity": (0.0, -1.0),
        "body": (
            Solid((2 * C, 6 * C), (7 * C, 9 * C)),
            Design((7 * C, 6 * C), (13 * C, 8 * C)),
            Actuator((7 * C, 8 * C), (13 * C, 9 * C)),
        ),
        "clamps": clamps or (Clamp((1 * C, 5 * C), (6 * C, 10 * C)),),
        "direction": (0.0, 1.0),
    }  # fmt: skip
    return Scene(**{**scene, **changes})


def moving(**changes):
    return finger(Clamp((1 * C, 5 * C), (6 * C, 10 * C), PATH), **changes)


def at_ease(scene, zero=0.0) -> Any:
    """A simulation of all that is solid, whose actuators do nothing; of numbers like zero."""
    particles = discretise(scene)
    ones = np.ones(len(particles.position)) + zero
    return simulation_of(
        scene, particles, ones, ones, np.zeros((scene.steps, len(scene.actuators)))
    )


def held(state):
    """Particles that are a cell and a half inside the clamp."""
    low, high = np.array([[2.5 * C], [6.5 * C]]), np.array([[4.5 * C], [8.5 * C]])
    return ((low < state[:2]) & (state[:2] < high)).all(axis=0)


@both
def test_what_is_a_cell_and_a_half_inside_a_clamp_does_not_move(formulation):
    scene = finger(formulation=formulation)
    start = at_rest(discretise(scene))
    problem = Problem(scene)
    simulation = problem.simulation(problem.join(0.5, 1.0, 0.5, 0.0))
    end = simulation.run()
    inside = held(start)
    assert inside.sum() >= 16
    assert np.array_equal(end[:2, inside], start[:2, inside])
    assert np.abs(end[2:, inside] - start[2:, inside]).max() <= 1e-14
    assert np.abs(end[:2, ~inside] - start[:2, ~inside]).max() > 0.005


@both
def test_what_is_inside_a_moving_clamp_follows_its_path(formulation):
    scene = moving(formulation=formulation)
    start = at_rest(discretise(scene))
    inside = held(start)
    frames = [0, 10, 20, 37, 60]
    states = at_ease(scene).run(frames)
    moved = scene.clamps[0].displacement(scene.time_step * np.array(frames))
    assert moved[-1] == pytest.approx((0.02, -0.01))
    found = states[:, :2, inside] - start[:2, inside]
    assert np.abs(found - moved[:, :, None]).max() <= 1e-14
    before = scene.clamps[0].displacement(scene.time_step * np.maximum(np.array(frames) - 1, 0))
    speed = ((moved - before) / scene.time_step)[:, :, None]
    assert np.abs(speed).max() > 0.2
    assert np.abs(states[:, 2:4, inside] - speed).max() <= 1e-12
    assert np.abs(states[:, 8:, inside] - start[8:, inside]).max() <= 1e-12


@pytest.mark.parametrize("name", ["held", "moving"])
def test_the_gradient_of_what_is_clamped_is_exact(rng, name):
    scene = finger() if name == "held" else moving()
    problem = Problem(scene, 2.0, halvings=0, limits=None)
    count = int(problem.particles.designed.sum())
    x = problem.join(rng.uniform(-1.0, 1.0, count), 0.9, -0.3, -0.5)
    assert worst(complex_step_test(problem, x)) <= 1e-12
    assert max(kernel_mismatches(scene).values()) <= DOT_TOLERANCE
    simulation = problem.simulation(x)
    for n in (0, 15, 40):
        states = simulation.run([n, n + 1])
        expected = step(simulation, states[0], n)
        assert np.abs(states[1] - expected).max() <= 1e-12 * np.abs(expected).max()


def on_ground(friction, *clamps):
    """The finger on a layer that is as near to what is held as to the rest."""
    floor = (Ground.floor(5.9 * C, friction=friction, thickness=C),)
    return finger(*clamps, ground=floor, time_step=1e-3, steps=40)


def symmetric(clamp, **changes):
    return finger(
        clamp, mirror=Mirror("x", 10 * C),
        **{"body": (Solid((6 * C, 6 * C), (14 * C, 9 * C)),), **changes},
    )  # fmt: skip


@pytest.mark.parametrize(
    "scene",
    [
        on_ground(0.4),
        finger(steps=30),
        moving(steps=30),
        on_ground("stick", Clamp((1 * C, 5 * C), (6 * C, 10 * C), ((0.0, (0.0, 0.0)), PATH[1]))),
        symmetric(
            Clamp((9 * C, 5 * C), (11 * C, 9 * C), ((0.0, (0.0, 0.0)), (0.1, (0.0, 0.5 * C)))),
            body=(
                Design((6 * C, 6 * C), (14 * C, 8 * C)),
                Actuator((6 * C, 8 * C), (14 * C, 9 * C)),
            ),
        ),
    ],
    ids=["on ground", "held", "moving", "sticks", "mirror"],
)
def test_the_gradient_of_a_lattice_that_is_clamped_is_exact(rng, scene):
    scene = dataclasses.replace(scene, formulation="total", material=Material(viscosity=0.02))
    problem = Problem(scene, 2.0, halvings=0, limits=None)
    count = int(problem.particles.designed.sum())
    x = problem.join(rng.uniform(-1.0, 1.0, count), 0.9, -0.3, -0.5)
    assert worst(complex_step_test(problem, x)) <= 1e-12


def test_where_held_nodes_begin_matters_as_far_as_they_move_others(rng):
    # Beside a corner of ground, which would turn what holds nodes if they stuck to it.
    corner = (Ground(((0.0, 0.0), (4.6 * C, 5.9 * C), (24 * C, 0.0)), friction="stick",
                     thickness=C),)  # fmt: skip
    scene = moving(
        ground=corner, formulation="total", material=Material(viscosity=0.02), time_step=1e-3,
        steps=40,
    )  # fmt: skip
    simulation = at_ease(scene)
    terminal = rng.standard_normal(simulation.initial.shape)
    terminal[4:8] = 0.0
    with simulation.checkpoints(Checkpointing()) as checkpoints:
        gradient = simulation.forward(checkpoints).reverse({40: terminal})
    direction = np.zeros(gradient.state.shape)
    held = simulation.lattice.held
    direction[:, held] = rng.standard_normal((4, len(held)))
    moved = at_ease(scene, 0j)
    moved.start[:] = simulation.start + 1e-30j * direction
    found = (terminal * moved.run()).sum().imag / 1e-30
    assert found == pytest.approx((gradient.state * direction).sum(), rel=1e-11)


@both
def test_a_gradient_over_segments_that_are_recomputed_knows_the_step(rng, formulation):
    scene = moving(formulation=formulation)
    problem = Problem(scene, 2.0, halvings=0, limits=None)
    x = problem.join(rng.uniform(-1.0, 1.0, int(problem.particles.designed.sum())), 0.9, 0.3, 0.5)
    expected = problem.value_and_gradient(x)[1]
    few = dataclasses.replace(problem.checkpointing, every=7)
    other = Problem(scene, 2.0, halvings=0, limits=None, checkpointing=few)
    assert other.value_and_gradient(x)[1] == pytest.approx(expected, rel=1e-12, abs=1e-18)


def test_a_clamp_holds_what_stands_on_ground_and_comes_first():
    scene = small_scene(
        walls=(), ground=(Ground.floor(3.9 * C, thickness=C),), time_step=2e-3,
        clamps=(Clamp((2 * C, 3 * C), (5 * C, 5 * C)),),
    )  # fmt: skip
    assert max(kernel_mismatches(scene).values()) <= DOT_TOLERANCE
    end = solid_simulation(scene).run()
    start = at_rest(discretise(scene))
    corner = (start[0] < 3.5 * C) & (start[1] < 4.5 * C)
    assert corner.sum() >= 1
    # Their nodes reach no farther up than the clamp.
    low = (start[0] < 3.5 * C) & (start[1] < 3.5 * C + 0.5 * C)
    assert np.abs(end[:2, low] - start[:2, low]).max(initial=0.0) <= 1e-14


@both
def test_a_motion_that_is_pushed_goes_on_with_its_clamp(formulation):
    simulation = at_ease(moving(formulation=formulation))
    end = simulation.run()
    assert simulation.pushed(15, (0.0, 0.0)).run() == pytest.approx(end, rel=1e-12, abs=1e-15)


def test_a_lattice_is_held_in_all_cells_of_a_clamp_and_the_first_clamp_has_it():
    right = ((0.0, (0.0, 0.0)), (0.1, (0.5 * C, 0.0)))
    scene = finger(
        Clamp((2 * C, 6 * C), (4 * C, 9 * C)), Clamp((2 * C, 6 * C), (7 * C, 9 * C), right),
        formulation="total",
    )  # fmt: skip
    start, end = at_ease(scene).run([0, 60])
    x = start[0] / C
    first, second = x < 4.0, (x > 6.0) & (x < 7.0)  # cells between have nodes of both
    assert np.array_equal(end[:2, first], start[:2, first])
    assert end[0, second] == pytest.approx(start[0, second] + 0.5 * C, abs=1e-14)
    assert end[1, second] == pytest.approx(start[1, second], abs=1e-14)


def test_a_clamp_that_holds_nothing_of_a_lattice_is_refused():
    away = Clamp((12 * C, 12 * C), (14 * C, 14 * C))
    with pytest.raises(SceneError, match=r"clamp 1, .* holds nothing of the body.*updated"):
        finger(Clamp((2 * C, 6 * C), (4 * C, 9 * C)), away, formulation="total")


def where_it_is_held(per_cell):
    """How far out of its clamp a bar is as if held, in cells: of its lattice in one dimension."""
    cells, t = 20, (np.arange(per_cell) + 0.5) / per_cell
    stiffness, pull = np.zeros((cells + 2, cells + 2)), np.zeros(cells + 2)
    for c in range(cells):
        for slopes in np.stack([t - 1.0, 1.0 - 2.0 * t, t], axis=1):
            stiffness[c : c + 3, c : c + 3] += np.outer(slopes, slopes) / per_cell
    pull[-2:] = 0.5
    moved = np.linalg.solve(stiffness[2:, 2:], pull[2:])  # both nodes beside the edge are held
    return cells - moved[-2:].mean()


@pytest.mark.parametrize("per_cell", [2, 3])
def test_a_hanging_bar_is_as_long_as_it_should_be(per_cell):
    # E = rho = 1, and a damping that lets it swing as little as can be.
    omega, g, errors = np.pi / 2.0, 1e-4, []
    for n in (8, 16):
        dx = 1.0 / n
        step = 0.17 * dx**2 * omega
        scene = Scene(
            Grid((8, n + 10), dx), time_step=step, steps=round(20.0 / omega / step),
            body=(Solid((3 * dx, 4 * dx), (5 * dx, 1.0 + 6 * dx)),), gravity=(0.0, -g),
            clamps=(Clamp((2 * dx, 1.0 + 4 * dx), (6 * dx, 1.0 + 7 * dx)),),
            material=Material(0.0, 0.5, viscosity=2.0 / omega), formulation="total",
            particles_per_cell=per_cell,
        )  # fmt: skip
        simulation = at_ease(scene)
        lowest = simulation.particles.position[:, 1] < (4 + 1 / per_cell) * dx
        start, end = simulation.run([0, scene.steps])[:, 1, lowest].mean(axis=1)
        length = 1.0 - where_it_is_held(per_cell) * dx
        depth = length - 0.5 * dx / per_cell
        errors.append((start - end) / (g * (length * depth - 0.5 * depth**2)) - 1.0)
    assert np.abs(errors[1]) <= 5e-4
    assert errors[0] / errors[1] == pytest.approx(4.0, rel=0.15)


@pytest.mark.parametrize(("per_cell", "expected"), [(1, 0.0), (2, 0.25)])
def test_where_a_bar_is_held_is_a_known_place(per_cell, expected):
    assert where_it_is_held(per_cell) == pytest.approx(expected, abs=1e-12)


def test_both_formulations_bend_a_held_beam_alike_the_more_so_the_finer_cells_are():
    tips = np.array([[tip(n, formulation) for formulation in FORMULATIONS] for n in (2, 4)])
    assert (tips < -1.5).all()
    coarse, fine = np.abs(tips[:, 1] / tips[:, 0] - 1.0)
    assert fine <= 0.65 * coarse <= 0.02


def tip(n, formulation):
    """How far the end of a beam of 8 C x 2 C sinks that is n times as fine."""
    scene = Scene(
        Grid((16 * n, 16 * n), C / n), time_step=4e-3 / n, steps=150 * n, gravity=(0.0, -0.5),
        body=(Solid((3 * C, 8 * C), (13 * C, 10 * C)),), formulation=formulation,
        clamps=(Clamp((2 * C, 7 * C), (5 * C, 11 * C)),), material=Material(viscosity=0.02),
    )  # fmt: skip
    simulation = at_ease(scene)
    last = simulation.particles.position[:, 0] > 12.5 * C
    start, end = simulation.run([0, scene.steps])[:, 1, last].mean(axis=1)
    return (end - start) / C


@both
def test_the_books_have_the_force_and_the_work_of_clamps(formulation):
    still = Clamp((9 * C, 5 * C), (14 * C, 10 * C))
    scene = finger(
        Clamp((1 * C, 5 * C), (6 * C, 10 * C), PATH), still, formulation=formulation,
        gravity=(0.3, -1.0), material=Material(viscosity=0.02),
    )  # fmt: skip
    coarse, fine = (
        books(at_ease(dataclasses.replace(scene, time_step=2e-3 / n, steps=60 * n))) for n in (1, 2)
    )
    simulation = at_ease(scene)
    last = simulation.run()
    mass = simulation.data.volume.sum() / len(last[0]) * np.ones(len(last[0]))  # density is 1
    momentum, weight = last[2:4] @ mass, mass.sum() * np.array(scene.gravity)
    given = scene.time_step * coarse.force.sum(axis=(0, 1)) + coarse.time[-1] * weight
    assert given == pytest.approx(momentum, rel=1e-9, abs=1e-12)
    assert coarse.supports == ("clamp 0", "clamp 1")
    assert not coarse.work["walls"].any()
    # What moves the finger against what holds it pulls it apart.
    assert coarse.work["clamps"][-1] > 0.2 * coarse.turnover
    for k, (low, high) in enumerate([(1, 6.5), (8.5, 14)]):
        x = coarse.place[1:, k, 0]
        assert np.all((low * C < x) & (x < high * C + 0.02))
    assert np.abs(coarse.residual).max() <= 2e-3 * coarse.turnover
    assert np.abs(fine.residual).max() <= 0.35 * np.abs(coarse.residual).max()
    assert fine.work["clamps"][-1] == pytest.approx(coarse.work["clamps"][-1], rel=0.05)


def test_the_books_of_half_a_clamped_lattice_are_those_of_the_whole():
    up = ((0.0, (0.0, 0.0)), (0.1, (0.0, 0.5 * C)))
    half = symmetric(Clamp((9 * C, 6 * C), (11 * C, 9 * C), up), direction=(0.0, 1.0))
    half = dataclasses.replace(half, formulation="total")
    ours, expected = (
        books(at_ease(each)) for each in (half, dataclasses.replace(half, mirror=None))
    )
    for name, values in expected.work.items():
        assert ours.work[name] == pytest.approx(values, abs=1e-12 * expected.turnover)
    assert ours.work["clamps"][-1] > 0.1 * ours.turnover
    assert ours.force == pytest.approx(expected.force, abs=1e-10)
    assert ours.place == pytest.approx(expected.place, nan_ok=True)


@both
def test_ground_takes_nothing_from_what_is_held(formulation):
    scene = finger(
        Clamp((1 * C, 4 * C), (8 * C, 10 * C), PATH), body=(Solid((3 * C, 6 * C), (6 * C, 8 * C)),),
        ground=(Ground.floor(5.9 * C, friction=0.4, thickness=C),), formulation=formulation,
    )  # fmt: skip
    found = books(at_ease(scene))
    assert found.supports == ("ground 0", "clamp 0")
    assert not found.work["friction"].any() and not found.work["damping"].any()
    ground, clamp = found.force[:10].mean(axis=0)  # before it moves
    assert ground[0] == 0.0 < ground[1]
    assert clamp == pytest.approx((0.0, found.weight - ground[1]), abs=1e-9 * ground[1])


def test_what_is_clamped_is_studied_in_the_other_formulation_but_for_walls():
    assert variants(finger())["other formulation"]().formulation == "total"
    assert "other formulation" not in variants(finger(walls=(Wall("y", 2 * C),)))


def test_nodes_inside_a_clamp_and_on_its_edges_are_held():
    (row,) = parameters_of(finger(Clamp((2 * C, 3 * C), (4 * C, 6 * C)))).clamps[:1]
    held = np.array([[plain(clamp_of)(i, j, row, C) == 0 for j in range(17)] for i in range(25)])
    i, j = np.indices(held.shape)
    assert np.array_equal(held, (i >= 2) & (i <= 4) & (j >= 3) & (j <= 6))


def test_a_scene_with_clamps_is_the_same_from_json_and_says_so():
    scene = moving()
    assert Scene.from_json(scene.to_json()) == scene
    assert "1 clamps, of which 1 move" in str(scene)


CORNERS = (0.0, 0.0), (C, C)
NO_PATHS: list[Any] = [3.0, ((0.0, 1.0),), ((0.0, (0.0, 0.0)), (0.0, (1.0, 0.0)))]


@pytest.mark.parametrize("path", NO_PATHS)
def test_a_path_is_points_in_time(path):
    with pytest.raises(SceneError, match="Clamp: "):
        Clamp(*CORNERS, path)


def test_clamps_are_rectangles_on_the_grid_that_move_slowly():
    with pytest.raises(SceneError, match="must be left of and below"):
        Clamp((0.2, 0.1), (0.1, 0.3))
    with pytest.raises(SceneError, match="must stay within"):
        finger(Clamp(*CORNERS, ((0.0, (0.0, -C)),)))
    # A fifth of a cell a step is 6.25.
    finger(Clamp(*CORNERS, ((0.0, (0.0, 0.0)), (1e-2, (0.99 * C, 0.0)))))
    with pytest.raises(SceneError, match=r"moves at 6\.3125, more than 0\.2 cells a step, 6\.25"):
        finger(Clamp(*CORNERS, ((0.0, (0.0, 0.0)), (1e-2, (1.01 * C, 0.0)))))


def test_a_clamp_is_its_own_mirror_image():
    up = ((0.0, (0.0, 0.0)), (0.1, (0.0, C)))
    symmetric(Clamp((9 * C, 6 * C), (11 * C, 9 * C), up))
    for clamp in (
        Clamp((8 * C, 6 * C), (11 * C, 9 * C)),
        Clamp((9 * C, 6 * C), (11 * C, 9 * C), ((0.0, (0.0, 0.0)), (0.1, (C, 0.0)))),
    ):
        with pytest.raises(SceneError, match="must be its own mirror image"):
            symmetric(clamp)
    mirror: Any = 3.0  # where it is, but no Mirror
    with pytest.raises(SceneError, match="must be a Mirror or None"):
        finger(mirror=mirror)
