"""Clamps hold nodes fixed or move them, exactly, and their gradient is that."""

import dataclasses
from typing import Any

import numpy as np
import pytest
from conftest import small_scene, worst
from exact import at_rest, solid_simulation

from mpmopt.assess.verify import DOT_TOLERANCE, complex_step_test, kernel_mismatches
from mpmopt.design.problem import Problem
from mpmopt.errors import SceneError
from mpmopt.kernels import plain
from mpmopt.kernels.contact import clamp_of
from mpmopt.scene import Actuator, Clamp, Design, Grid, Ground, Mirror, Scene, Solid
from mpmopt.scene.particles import discretise
from mpmopt.simulation.reference import step
from mpmopt.simulation.surroundings import parameters_of

C = 1 / 16
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


def moving():
    return finger(Clamp((1 * C, 5 * C), (6 * C, 10 * C), PATH))


def held(state):
    """Particles that are a cell and a half inside the clamp."""
    low, high = np.array([[2.5 * C], [6.5 * C]]), np.array([[4.5 * C], [8.5 * C]])
    return ((low < state[:2]) & (state[:2] < high)).all(axis=0)


def test_what_is_a_cell_and_a_half_inside_a_clamp_does_not_move():
    scene = finger()
    start = at_rest(discretise(scene))
    problem = Problem(scene)
    simulation = problem.simulation(problem.join(0.5, 1.0, 0.5, 0.0))
    end = simulation.run()
    inside = held(start)
    assert inside.sum() >= 16
    assert np.array_equal(end[:2, inside], start[:2, inside])
    assert np.abs(end[2:, inside] - start[2:, inside]).max() <= 1e-14
    assert np.abs(end[:2, ~inside] - start[:2, ~inside]).max() > 0.005


def test_what_is_inside_a_moving_clamp_follows_its_path():
    scene = moving()
    start = at_rest(discretise(scene))
    inside = held(start)
    frames = [0, 10, 20, 37, 60]
    states = solid_simulation(scene).run(frames)
    moved = scene.clamps[0].displacement(scene.time_step * np.array(frames))
    assert moved[-1] == pytest.approx((0.02, -0.01))
    found = states[:, :2, inside] - start[:2, inside]
    assert np.abs(found - moved[:, :, None]).max() <= 1e-14
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


def test_a_gradient_over_segments_that_are_recomputed_knows_the_step(rng):
    scene = moving()
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
    def symmetric(clamp):
        return finger(clamp, body=(Solid((6 * C, 6 * C), (14 * C, 9 * C)),),
                      mirror=Mirror("x", 10 * C))  # fmt: skip

    up = ((0.0, (0.0, 0.0)), (0.1, (0.0, C)))
    symmetric(Clamp((9 * C, 6 * C), (11 * C, 9 * C), up))
    for clamp in (
        Clamp((8 * C, 6 * C), (11 * C, 9 * C)),
        Clamp((9 * C, 6 * C), (11 * C, 9 * C), ((0.0, (0.0, 0.0)), (0.1, (C, 0.0)))),
    ):
        with pytest.raises(SceneError, match="must be its own mirror image"):
            symmetric(clamp)
