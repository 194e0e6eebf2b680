"""The walker on slopes, steps and rough ground."""

from dataclasses import replace

import numpy as np
import pytest
import terrain

from mpmopt.assess.threshold import solid_body
from mpmopt.design.problem import Problem
from mpmopt.kernels import parts
from mpmopt.scene import Grid, Scene

PUSHED = 0.2  # seconds of a body that a slanted gravity pushes along the ground
LAYER = terrain.FLAT.ground[0].thickness


def pushed(scene, seconds=PUSHED):
    """Solid body on coarse cells and on that ground, pushed to the right: gaps and positions."""
    scene = replace(
        scene,
        time_step=1.6e-3,
        formulation="updated",  # coarse cells, whose step is longer
        grid=Grid(tuple(n // 2 for n in scene.grid.cells), 2 * scene.grid.dx),
        steps=round(seconds / 1.6e-3),
        transient=0.0,
        gravity=(10.0, -10.0),
    )
    problem = Problem(scene)
    variables = problem.split(problem.join(1.0, 0.0, 0.0, 0.0))
    keep = np.ones(int(problem.particles.designed.sum()), dtype=bool)
    simulation = solid_body(scene, keep, variables)
    position = parts(simulation.run([scene.steps])[-1]).position
    gap, _ = scene.ground[0].distance(position)
    return gap, position


@pytest.mark.parametrize("make", [terrain.slope, terrain.step, terrain.rough])
def test_json_gives_back_the_same_ground(make):
    assert Scene.from_json(make().to_json()) == make()


@pytest.mark.parametrize("make", [terrain.slope, terrain.step, terrain.rough])
def test_other_ground_bears_the_body_and_is_felt(make):
    gap, position = pushed(make())
    assert 0.0 < gap.min() < LAYER
    _, flat = pushed(terrain.FLAT)
    assert np.abs(position - flat).max() > 1e-3


def test_a_body_goes_up_a_slope_more_slowly_than_down():
    up, down = (pushed(terrain.slope(angle))[1].mean(axis=1) for angle in (10.0, -10.0))
    assert up[0] < down[0]
    assert up[1] > down[1]


def test_a_step_stops_what_slides_against_it():
    _, over = pushed(terrain.FLAT)
    _, against = pushed(terrain.step(2 / 64))
    assert against[0].mean() < over[0].mean() - 0.01


def test_a_robot_is_judged_on_ground_that_its_design_has_not_seen():
    for case in terrain.CASES.values():
        judged, *seen = (
            np.array(scene.ground[0].points)[:20, 1]
            for scene in (case.scene, *(each.scene(case.scene) for each in case.task.scenes[::2]))
        )
        assert np.ptp(judged) > 0.75 * terrain.C
        assert len(seen) == 2
        for heights in seen:
            assert heights.shape == judged.shape
            assert np.abs(heights - judged).max() > 0.5 * terrain.C
