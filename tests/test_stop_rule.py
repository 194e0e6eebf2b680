"""Stop rule, move limit and asymptotes, on objectives that are told instead of simulated."""

import copy
import dataclasses
import itertools

import numpy as np
import pytest
from conftest import small_scene

from mpmopt.design.evaluation import Evaluation
from mpmopt.design.problem import Problem
from mpmopt.errors import SimulationError
from mpmopt.optimisation.loop import Optimisation, begin, go_on, optimise
from mpmopt.optimisation.mma import MovingAsymptotes
from mpmopt.optimisation.settings import Settings, Stage
from mpmopt.simulation.indicators import Indicators

LIMIT = 0.05
STAGE = Stage(0.5, 1e-2, 1e-3, 4e-3, move_limit=LIMIT)
# Stops by its count only.
COUNTED = Settings((STAGE,), window=1000, least_iterations=1)
FAILS = None


def uphill(x):
    return np.ones(x.size)


@pytest.fixture
def told(monkeypatch):
    """Runs an optimisation whose evaluations give these objectives: the run, and its designs."""

    def run(values, settings, gradient=uphill, starts=None, halved=0):
        left, seen = iter(values), []

        def evaluate(problem, x):
            value = next(left)
            if value is FAILS:
                raise SimulationError("made to fail", 3, 1, (0.0, 0.0), "none")
            time_step = problem.scene.time_step / 2.0**halved
            return Evaluation(value, gradient(x), Indicators(), time_step, halved)

        monkeypatch.setattr(Problem, "evaluate", evaluate)
        scene = small_scene()
        start = Problem(scene).join(0.0, 0.5, -0.3, -0.5) if starts is None else starts
        found = optimise(scene, settings, start, [lambda run: seen.append(run.last)])
        return found, seen[:-1]

    return run


def counted(values):
    """Settings of one stage that takes so many objectives, failures not counted."""
    most = sum(value is not FAILS for value in values)
    return dataclasses.replace(COUNTED, most_iterations=most)


# (objectives, move limit of each evaluation over the stage's, with and without adapting)
MOVES = {
    "a decrease shortens, ascents lengthen up to the stage's": (
        [0.0, 1.0, 2.0, 1.0, 2.0, 3.0, 4.0, 5.0],
        [1.0, 1.0, 1.0, 1.0, 0.6, 0.72, 0.864, 1.0],
        [1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0],
    ),
    "what stays equal has not gone back": ([1.0, 1.0, 1.0], [1.0, 1.0, 1.0], [1.0, 1.0, 1.0]),
    "decreases add up": ([3.0, 2.0, 1.0, 0.0], [1.0, 1.0, 0.6, 0.36], [1.0, 1.0, 1.0, 1.0]),
    "a failure halves, and ascents recover": (
        [0.0, 1.0, FAILS, 2.0, 3.0, 4.0, 5.0, 6.0],
        [1.0, 1.0, 1.0, 0.5, 0.6, 0.72, 0.864, 1.0],
        [1.0, 1.0, 1.0, 0.5, 0.6, 0.72, 0.864, 1.0],
    ),
    "failures add up": (
        [0.0, 1.0, FAILS, FAILS, FAILS, 2.0, 3.0],
        [1.0, 1.0, 1.0, 0.5, 0.25, 0.125, 0.15],
        [1.0, 1.0, 1.0, 0.5, 0.25, 0.125, 0.15],
    ),
    "a decrease after a failure counts from the last success": (
        [0.0, 2.0, FAILS, 1.0, 1.5],
        [1.0, 1.0, 1.0, 0.5, 0.3],
        [1.0, 1.0, 1.0, 0.5, 0.6],
    ),
}


@pytest.mark.parametrize("adapt", [True, False])
@pytest.mark.parametrize("name", MOVES)
def test_the_move_limit_follows_the_objective(told, name, adapt):
    values, adapted, steady = MOVES[name]
    settings = dataclasses.replace(counted(values), adapt_move_limit=adapt)
    run, _ = told(values, settings)
    moves = [item.move_limit / LIMIT for item in run.history]
    assert moves == pytest.approx(adapted if adapt else steady, rel=1e-12)


def test_the_move_limit_in_force_is_the_step_of_what_is_free(told):
    values = [0.0, 1.0, 0.5, 1.0, 2.0]
    run, designs = told(values, counted(values))
    for before, item in itertools.pairwise(designs):
        moved = np.abs(item.x - before.x)[:32] / 2.0  # phi, far from its bounds
        assert moved == pytest.approx(item.move_limit, rel=1e-9)
        assert item.step == pytest.approx(np.abs(item.x - before.x).max() / 2.0, rel=1e-12)
    assert run.history[0].step == 0.0


def test_a_failure_goes_back_to_the_farthest_design_and_forgets_the_asymptotes(told):
    # Near the top asymptotes close in, which at beta = 32 are nearer than the move limit.
    stage = dataclasses.replace(STAGE, beta=32.0)
    values = [0.0, 1.0, 2.0, 3.0, 9.0, 4.0, 5.0, FAILS, 6.0, FAILS, FAILS, 7.0]

    def gradient(x):
        return np.where(np.arange(x.size) % 2, 1.0, 0.02 - x)

    settings = dataclasses.replace(counted(values), stages=(stage,))
    run, designs = told(values, settings, gradient)
    incumbent = designs[4]
    for k in (8, 10, 11):
        fresh = MovingAsymptotes(
            *(sign * np.ones(incumbent.x.size) for sign in (-1.0, 1.0)),
            move_limit=designs[k - 1].move_limit / 2.0,
            asymptote_initial=0.5 / 33.0,
        )
        expected = fresh.step(incumbent.x, -9.0, -gradient(incumbent.x))
        assert np.array_equal(designs[k].x, expected)
        assert run.history[k].move_limit == designs[k - 1].move_limit / 2.0


@pytest.mark.parametrize(("sharpen", "expected"), [(True, 0.9 * 0.5 / 33.0), (False, LIMIT)])
def test_initial_asymptotes_are_sharper_where_the_projection_is(told, sharpen, expected):
    stage = dataclasses.replace(STAGE, beta=32.0)
    settings = dataclasses.replace(COUNTED, stages=(stage,), sharpen_asymptotes=sharpen)
    run, _ = told([0.0, 1.0], dataclasses.replace(settings, most_iterations=2))
    assert run.history[1].step == pytest.approx(expected, rel=1e-9)


def test_a_first_design_that_fails_is_tried_with_half_the_step(told):
    run, designs = told([FAILS, FAILS, 1.0, 2.0], counted([1.0, 2.0]))
    # A failure's step is that of its last attempt, of two that halve it.
    assert [item.time_step for item in run.history] == [1e-3, 5e-4, 1e-3, 1e-3]
    assert [item.halved for item in run.history] == [2, 2, 0, 0]
    assert all(np.array_equal(item.x, designs[0].x) for item in designs[:3])
    assert [item.move_limit for item in run.history] == 4 * [LIMIT]


def test_only_failures_in_a_row_give_up(told):
    values = [0.0, FAILS, FAILS, 1.0, FAILS, FAILS, 2.0, FAILS, FAILS, FAILS]
    settings = dataclasses.replace(COUNTED, most_failures=3)
    run, _ = told(values, settings)
    assert len(run.history) == len(values)
    assert "gave up after 3 failed evaluations in a row" in run.stop_reason
    assert run.gave_up
    assert run.stop_reason.startswith("Stage 1 of 1 was the last: ")
    assert run.first.objective == 0.0


def stopped_at(values, window, tolerance, least):
    """How many objectives the paper's rule takes (sec. 2.5), word by word."""
    for count in range(1, len(values) + 1):
        seen = values[:count]
        if count >= least and count > window:
            now, before = sum(seen[-window:]) / window, sum(seen[-window - 1 : -1]) / window
            if abs(now - before) <= tolerance:
                return count
    return len(values)


RAMP = [k / 1024 for k in range(40)]
# Exact in binary, so that a mean that changes by the tolerance does stop.
STOPS = {
    "a ramp that ends": (RAMP + 60 * RAMP[-1:], 8, 2 / 8192, 2, 46),
    "exactly the tolerance": (RAMP, 4, 1 / 1024, 2, 5),
    "a little less than the change": (RAMP, 4, 0.999 / 1024, 2, 40),
    "a fall is a change": (RAMP[::-1], 4, 0.5 / 1024, 2, 40),
    "two equal ones are no plateau": ([0.0, 1.0, 1.0, 2.0, 2.0, 3.0, 3.0, 4.0], 2, 0.25, 2, 8),
    "a swing of the window's length is a plateau": (20 * [0.0, 1.0], 2, 0.0, 2, 3),
    "the least number counts": (40 * [1.0], 3, 0.0, 17, 17),
    "a mean needs its window and one more": (40 * [1.0], 9, 0.0, 2, 10),
    "the paper's window": (RAMP + 60 * RAMP[-1:], 10, 2e-4, 20, 48),
}


@pytest.mark.parametrize("name", STOPS)
def test_the_moving_average_stops_a_stage_where_the_paper_says(told, name):
    values, window, tolerance, least, expected = STOPS[name]
    assert stopped_at(values, window, tolerance, least) == expected
    settings = Settings(
        (STAGE,), window=window, tolerance=tolerance, least_iterations=least,
        most_iterations=len(values),
    )  # fmt: skip
    run, _ = told(values, settings)
    assert len(run.history) == expected
    assert ("mean objective" in run.stop_reason) == (expected < len(values))


def test_the_stop_rule_of_the_paper_is_the_default():
    settings = Settings((STAGE,))
    assert (settings.window, settings.tolerance, settings.least) == (10, 2e-4, 20)


def test_the_stop_rule_counts_what_succeeded_and_each_stage_for_itself(told):
    settings = Settings(
        (STAGE, STAGE), window=3, tolerance=0.0, least_iterations=5, most_iterations=50
    )
    run, _ = told([1.0, FAILS, 1.0, 1.0, FAILS, 1.0, 1.0, *5 * [1.0]], settings)
    assert [item.stage for item in run.history] == 7 * [0] + 5 * [1]


def test_the_next_stage_begins_with_its_own_move_limit_and_no_memory(told):
    # A decrease at the end of a stage is none of the next one's.
    first, second = STAGE, dataclasses.replace(STAGE, move_limit=0.02)
    settings = dataclasses.replace(COUNTED, stages=(first, second), most_iterations=3)
    run, designs = told([5.0, 4.0, 3.0, 1.0, 2.0, 3.0], settings)
    moves = [item.move_limit for item in run.history]
    assert moves == pytest.approx([0.05, 0.05, 0.03, 0.02, 0.02, 0.02], rel=1e-12)
    assert np.array_equal(designs[3].x, designs[0].x)  # the incumbent of the first
    assert [run.best[0].objective, run.best[1].objective] == [5.0, 3.0]


def test_the_last_design_goes_on_where_the_farthest_is_not_asked_for(told):
    settings = dataclasses.replace(
        COUNTED, stages=(STAGE, STAGE), most_iterations=3, best_first=False
    )
    _, designs = told([5.0, 4.0, 3.0, 1.0, 2.0, 3.0], settings)
    assert np.array_equal(designs[3].x, designs[2].x)


def test_the_projected_gradient_is_what_the_bounds_leave_free(told):
    problem = Problem(small_scene())

    def at(a, gradient):
        x = problem.join(0.0, a, 0.1, 0.2)
        run, _ = told([0.0], counted([0.0]), lambda x: gradient, starts=x)
        return run.history[0].projected_gradient

    for sign in (1.0, -1.0):
        slope = 0.25 * np.ones(problem.size)
        slope[32] = sign * 5.0  # of the first actuator's amplitude
        assert at(0.5, slope) == 5.0
        assert at(sign, slope) == 0.25
        assert at(-sign, slope) == 5.0


def test_greyness_in_the_history_is_that_of_the_design(told):
    run, designs = told([0.0, 1.0], counted([0.0, 1.0]))
    problem = STAGE.problem(small_scene())
    for item, design in zip(run.history, designs):
        gamma = problem.gamma(design.x)
        assert np.array_equal(design.gamma, gamma)
        assert item.non_discreteness == pytest.approx(
            np.mean(4.0 * gamma * (1.0 - gamma)), rel=1e-12
        )


def test_the_result_is_of_the_sharpest_stage_or_counts_most_without_void(told, monkeypatch):
    settings = dataclasses.replace(COUNTED, stages=(STAGE, STAGE), most_iterations=2)
    run, _ = told([8.0, 9.0, 2.0, 3.0], settings)
    assert (run.result.stage, run.result.objective) == (1, 3.0)
    without_void = iter((0.5, 0.7, 0.6, 0.1))
    monkeypatch.setattr("mpmopt.optimisation.loop.post_processed", lambda *_: next(without_void))
    solid = dataclasses.replace(STAGE, solid=True)
    run, _ = told([8.0, 9.0, 2.0, 3.0], dataclasses.replace(settings, stages=(solid, solid)))
    assert (run.result.stage, run.result.post_processed) == (0, 0.7)
    assert run.best[1].post_processed == 0.6


@pytest.mark.parametrize("processors", [1, 2])
def test_bodies_without_void_are_judged_in_the_step_of_their_evaluation(
    told, monkeypatch, processors
):
    monkeypatch.setattr("mpmopt.design.ensemble.processors", lambda: processors)
    asked = []

    def judged(problem, x):
        asked.append(problem.scene.time_step)
        return 0.1 if asked[-1] == 1e-3 else 9.0

    monkeypatch.setattr("mpmopt.optimisation.loop.post_processed", judged)
    monkeypatch.setattr("mpmopt.assess.refinement.least", judged)
    stage = dataclasses.replace(STAGE, solid=True, refined=True)
    settings = dataclasses.replace(COUNTED, stages=(stage,), most_iterations=1)
    run, _ = told([1.0], settings, halved=2)
    assert asked == [4e-3] * (processors - 1) + [1e-3, 1e-3]  # the first was begun beside it
    assert (run.result.time_step, run.result.post_processed) == (1e-3, 0.1)


def test_a_design_that_no_refinement_saw_is_no_best_however_far_it_goes(told, monkeypatch):
    # It counts no more than the best, so that it is not refined.
    monkeypatch.setattr("mpmopt.optimisation.loop.post_processed", lambda *_: 0.3)
    monkeypatch.setattr("mpmopt.assess.refinement.least", lambda *_: 0.35)
    stage = dataclasses.replace(STAGE, solid=True, refined=True)
    settings = dataclasses.replace(COUNTED, stages=(stage,), most_iterations=2)
    run, _ = told([1.0, 2.0], settings)
    assert np.isnan(run.history[1].refined)
    assert run.result.objective == 1.0


# Failures at the start of a stage, in the middle, and in a row.
WAY = [FAILS, FAILS, 0.0, 1.0, 0.5, 2.0, FAILS, FAILS, 1.5, 3.0, FAILS, FAILS, FAILS, 1.0, 4.0, 2.0]


def test_what_was_stopped_anywhere_goes_the_same_way(monkeypatch):
    settings = Settings(
        (STAGE, dataclasses.replace(STAGE, beta=32.0)), window=2, tolerance=0.0,
        least_iterations=1, most_iterations=6, most_failures=3,
    )  # fmt: skip
    current: list[Optimisation] = []

    def evaluate(problem, x):
        value = WAY[len(current[-1].history)]
        if value is FAILS:
            raise SimulationError("made to fail", 3, 1, (0.0, 0.0), "none")
        gradient = np.where(np.arange(x.size) % 2, 1.0, 0.02 - x)
        return Evaluation(value, gradient, Indicators(), problem.scene.time_step)

    monkeypatch.setattr(Problem, "evaluate", evaluate)
    scene, stops = small_scene(), []
    current.append(begin(scene, settings, Problem(scene).join(0.0, 0.5, -0.3, -0.5)))
    whole = go_on(current[-1], [lambda run: stops.append(copy.deepcopy(run))])
    assert len(whole.history) == 13
    assert "gave up after 3 failed" in whole.stop_reason
    for stop in stops[:-1]:
        stop.history[-1] = dataclasses.replace(stop.history[-1], seconds=1000.0)
        current.append(stop)
        again = go_on(stop)
        assert again.stop_reason == whole.stop_reason
        assert again.last is not None and whole.last is not None
        assert np.array_equal(again.last.x, whole.last.x)
        assert again.history[-1].seconds >= 1000.0
        for one, other in zip(again.history, whole.history, strict=True):
            assert repr(dataclasses.replace(one, seconds=other.seconds)) == repr(other)
