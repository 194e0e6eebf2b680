"""Ascents compared: the present one is the package's, and what the others do otherwise."""

from dataclasses import replace

import numpy as np
import optimisers
import pytest
from optimisers import ASCENTS, PRESENT, SmoothAsymptotes
from test_robustness import on_ground

from mpmopt.optimisation.loop import optimise
from mpmopt.optimisation.mma import MovingAsymptotes
from mpmopt.optimisation.presets import gait


@pytest.fixture(scope="module")
def scene():
    return on_ground(steps=10)


def test_the_present_ascent_is_the_optimisers(scene):
    start = {"phi": lambda position: 0.3 * np.cos(40.0 * position[:, 0]), "a": 0.5}
    run = optimise(scene, gait(4), start, task=PRESENT.task)
    mine = optimisers.climb(scene, PRESENT, start, 4)
    assert [value for value, _ in mine.history] == [item.objective for item in run.history]
    assert mine.best is not None
    np.testing.assert_array_equal(mine.best[1], run.result.x)
    assert mine.best[0] == run.result.post_processed


def test_an_ascent_goes_as_many_evaluations_whatever_its_stages(scene):
    start = {"phi": 0.2, "a": 0.5}
    ascent = ASCENTS["beta 4 to 32"]
    doubled = replace(ascent, betas=(4.0, 8.0), memory=0.5, restart=0.9, adapt=True)
    assert len(optimisers.climb(scene, doubled, start, 4).history) == 4


def test_each_scene_is_there_a_little_weaker_and_a_little_stronger():
    strengths = [each.strength for each in ASCENTS["gradient over strengths"].scenes]
    assert strengths == pytest.approx([0.882, 0.918, 0.98, 1.02, 1.078, 1.122])


def test_smooth_asymptotes_hardly_see_moves_at_the_level_of_rounding():
    """And follow long ones as the published rule does; in between they go over continuously."""

    def distance(kind: type[MovingAsymptotes], turn: float) -> float:
        mma = kind([-1.0], [1.0])
        mma.iteration = 2
        mma.x_before_previous, mma.x_previous = np.array([0.0]), np.array([0.2])
        return float(mma._next_distance(np.array([0.2 + turn]))[0])

    for turn in (1e-12, -1e-12):
        assert distance(SmoothAsymptotes, turn) == pytest.approx(0.5, rel=1e-8)
        assert distance(MovingAsymptotes, turn) in (0.6, 0.35)
    assert distance(SmoothAsymptotes, 0.6) == pytest.approx(0.6, rel=0.02)
    assert distance(SmoothAsymptotes, -0.6) == pytest.approx(0.35, rel=0.02)
    half = 2.0 * optimisers.STILL / 0.1  # of the range, 2: where half of its logarithm is left
    assert distance(SmoothAsymptotes, half) == pytest.approx(0.5 * 1.2**0.5)


def test_a_robot_that_fails_stands_still_in_the_summary():
    row = {
        "ascent": "present", "speed": 0.2, "worst": 0.1, "loss": 0.0, "evaluations": 40,
        "processor seconds": 60.0,
    }  # fmt: skip
    (found,) = optimisers.summary([row, {**row, "speed": float("nan")}, {**row, "speed": 0.1}])
    assert (found["median speed"], found["least speed"], found["starts"]) == (0.1, 0.0, 3)
