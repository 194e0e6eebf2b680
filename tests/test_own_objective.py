"""A problem with an objective of its own: all that is given the problem measures that."""

from dataclasses import replace

import numpy as np
import pytest
from conftest import small_scene

from mpmopt.assess import refinement, threshold, trajectory
from mpmopt.assess.discretisation import Discretisation, cheapest, measure
from mpmopt.assess.trajectory import Motion
from mpmopt.assess.verify import report
from mpmopt.design.driven import Driven
from mpmopt.design.places import Distance, Height, PeakHeight
from mpmopt.design.problem import Problem
from mpmopt.design.task import Task
from mpmopt.design.terms import Displacement, Speed

SCENE = small_scene(steps=16)
UP = (0.6, 0.8)


# Another way than the scene says.
OWN = Task(Displacement(UP))


def smooth(problem):
    x, y = problem.particles.position[problem.particles.designed].T
    return problem.join(0.3 * np.sin(40 * x + 25 * y), 0.5, -0.3, -0.5)


@pytest.fixture
def pair():
    """A task, and the same by a scene."""
    return Problem(SCENE, 2.0, task=OWN), Problem(replace(SCENE, direction=UP), 2.0)


def test_bodies_without_void_go_its_way(pair):
    x = smooth(pair[0])
    for distance in (threshold.post_processed, threshold.unactuated, refinement.least):
        own, same = (distance(problem, x) for problem in pair)
        assert own == same
    block, split = threshold.solid_reference, pair[0].split(x)
    own = threshold.best_actuated(SCENE, block, split, task=OWN)
    assert own == threshold.best_actuated(pair[1].scene, block, split)


def test_pictures_and_studies_show_it(pair):
    x = smooth(pair[0])
    for body in (trajectory.optimised, trajectory.post_processed, trajectory.reference):
        own, same = (Motion.of(body(problem, x), [0, 8, 16]) for problem in pair)
        assert np.array_equal(own.objective, same.objective)
    studies = [refinement.study(problem, x) for problem in pair]
    own_rows, same_rows = ([(row.reference, row.distance) for row in rows] for rows in studies)
    assert own_rows == same_rows


@pytest.mark.parametrize(
    "term",
    [
        Speed(after=0.008, period=0.016),
        Height(at=0.03, region=2),
        PeakHeight(),
        -1.0 * Distance((0.3, 0.5), at=0.04) - Distance((0.5, 0.5)),
        Driven(Displacement()),
    ],
    ids=str,
)
def test_pictures_and_measurements_take_every_term(term):
    problem = Problem(SCENE, 2.0, task=Task(term))
    x = smooth(problem)
    motion = Motion.of(trajectory.optimised(problem, x), [0, 3, 8, 16])
    assert motion.objective[-1] == problem.value(x)
    assert np.all(np.isfinite(motion.objective))
    measured = measure(SCENE, Discretisation.of(SCENE), smooth, 2.0, 1 / 16, task=problem.task)
    assert np.isfinite(measured.distance)


def test_checks_and_measurements_are_of_it(pair):
    x = smooth(pair[0])
    own, same = (report(problem, x) for problem in pair)
    assert all(check.passed for check in own)
    complex_steps = [[c.value for c in checks if "complex" in c.name] for checks in (own, same)]
    assert complex_steps[0] == complex_steps[1]
    here = Discretisation.of(SCENE)
    measured = measure(SCENE, here, smooth, 2.0, 1 / 16, task=OWN)
    expected = measure(pair[1].scene, here, smooth, 2.0, 1 / 16)
    assert measured.distance == expected.distance
    assert np.array_equal(measured.gradient, expected.gradient)
    found = cheapest(SCENE, x, 1e9, beta=2.0, task=OWN, seconds=1e-2)
    assert found.best in {row.measured.discretisation for row in found.rows}
