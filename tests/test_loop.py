"""Stages, stop rule, the best design, and evaluations that fail."""

import copy
import dataclasses
import itertools
from typing import Any

import numpy as np
import pytest
from conftest import small_scene

from mpmopt.assess import refinement
from mpmopt.design import chain
from mpmopt.design.problem import Problem
from mpmopt.design.task import DEFAULT_TASK
from mpmopt.design.variables import Frozen
from mpmopt.errors import DesignError, SceneError, SimulationError
from mpmopt.optimisation.history import Candidate, Optimisation
from mpmopt.optimisation.loop import go_on, optimise
from mpmopt.optimisation.settings import Settings, Stage
from mpmopt.optimisation.starts import random_start

STAGES = (Stage(0.5, 1e-2, 1e-3, 4e-3), Stage(2.0, 5e-3, 1e-3, 2e-3, solid=True))
QUICK = Settings(STAGES, least_iterations=12, most_iterations=15)


@pytest.fixture
def scene():
    return small_scene(steps=60, gravity=(0.0, -10.0))


@pytest.fixture
def start(scene):
    return Problem(scene).join(0.0, 1.0, -0.3, -0.5)


def tried(scene, settings, start):
    """An optimisation, and all designs that it evaluated."""
    candidates: list[Any] = []
    run = optimise(scene, settings, start, [lambda run: candidates.append(run.last)])
    assert [item.seconds for item in candidates[:-1]] == [item.seconds for item in run.history]
    return run, candidates[:-1]  # the last report is of the end


def fail_on(monkeypatch, numbers):
    """Let the evaluations of these numbers fail, and count all."""
    calls = []
    real = Problem.evaluate

    def evaluate(self, x):
        calls.append((self.scene.time_step, x.copy()))
        if len(calls) - 1 in numbers:
            raise SimulationError("made to fail", 3, 1, (0.0, 0.0), "none")
        return real(self, x)

    monkeypatch.setattr(Problem, "evaluate", evaluate)
    return calls


def test_an_optimisation_goes_farther_and_remembers_how(scene, start):
    seen = []
    run = optimise(scene, QUICK, start, [lambda run: seen.append(len(run.history))])
    assert seen == [*range(1, len(run.history) + 1), len(run.history)]  # and once at the end
    first = run.history[0]
    assert first.objective == Problem(STAGES[0].scene(scene), 0.5).value(start)
    assert run.best[0].objective > first.objective + 1e-3
    assert run.failed_evaluations == 0
    assert {item.stage for item in run.history} == {0, 1}
    assert next(item.beta for item in run.history if item.stage == 1) == 2.0
    assert run.stop_reason.startswith("Stage 2 of 2 was the last: ")
    for item in run.history:
        assert item.step <= STAGES[item.stage].move_limit + 1e-12


def test_the_best_design_is_the_stages_best_and_reproduces_its_value(scene, start):
    run = optimise(scene, QUICK, start)
    first = [item for item in run.history if item.stage == 0]
    assert run.best[0].objective == max(item.objective for item in first)
    last = [item for item in run.history if item.stage == 1]
    assert run.result.post_processed == max(item.post_processed for item in last)
    problem = Problem(STAGES[1].scene(scene), 2.0)
    assert problem.value(run.result.x) == run.result.objective
    assert run.result.gamma == pytest.approx(problem.gamma(run.result.x), abs=0.0)


def test_each_stage_starts_from_the_last_ones_best(scene, start):
    run, designs = tried(scene, QUICK, start)
    second = next(item for item in designs if item.stage == 1)
    assert np.array_equal(second.x, run.best[0].x)
    on = dataclasses.replace(QUICK, best_first=False)
    run, designs = tried(scene, on, start)
    assert all(np.abs(item.x).max() <= 1.0 for item in designs)
    last_of_first = [item for item in designs if item.stage == 0][-1]
    second = next(item for item in designs if item.stage == 1)
    assert np.array_equal(second.x, last_of_first.x)


def test_a_stage_hands_its_farthest_design_to_the_next(scene, start, monkeypatch):
    without_void = itertools.count(0.3, -0.1)  # unlike the objective, which rises
    monkeypatch.setattr(
        "mpmopt.optimisation.loop.post_processed", lambda problem, x: next(without_void)
    )
    stages = (dataclasses.replace(STAGES[0], solid=True), STAGES[1])
    settings = Settings(stages, window=1, least_iterations=3, most_iterations=3)
    run, designs = tried(scene, settings, start)
    second = next(item for item in designs if item.stage == 1)
    # The incumbent as it is goes on, though the best is the incumbent without void.
    incumbent = max((i for i in designs if i.stage == 0), key=lambda item: item.objective)
    assert incumbent is not run.best[0]
    assert np.array_equal(second.x, incumbent.x)
    assert second.step == 0.0


ANEW = tuple(dataclasses.replace(STAGES[1], disturbed=seed) for seed in (None, 3, 4))


def test_a_disturbed_stage_begins_at_the_start_with_a_field_added(scene, start):
    settings = Settings(ANEW, most_iterations=3)
    run, candidates = tried(scene, settings, start)
    problem = run.problem()
    where = problem.particles.position[problem.particles.designed]
    assert np.array_equal(candidates[0].x, start)
    for item, seed in zip(candidates[3::3], (3, 4), strict=True):
        field = random_start(scene, seed)(where)
        assert np.array_equal(item.x, np.concatenate([field, start[len(where) :]]))
    assert run.result.counted == max(item.counted for item in run.best.values())
    with pytest.raises(DesignError, match="the first stage begins at the start"):
        Settings(ANEW[1:])


def test_a_disturbed_stage_leaves_what_is_frozen(scene, start):
    task = dataclasses.replace(DEFAULT_TASK, variables=(Frozen("phi"), Frozen("b")))
    run = optimise(scene, Settings(ANEW[:2], most_iterations=2), start, task=task)
    begun = run.problem().split(start)
    for item in run.best.values():
        found = run.problem().split(item.x)
        assert np.array_equal(found.phi, begun.phi) and np.array_equal(found.b, begun.b)
        assert not np.array_equal(item.x, start)


def test_a_run_that_was_stopped_at_a_disturbed_stage_goes_the_same_way(scene, start):
    states: list[Optimisation] = []
    settings = Settings(ANEW[:2], most_iterations=2)
    run = optimise(scene, settings, start, lambda run: states.append(copy.deepcopy(run)))
    for state in states[1:3]:  # before its first evaluation, and after it
        again = go_on(state)
        assert np.array_equal(again.result.x, run.result.x)
        assert [item.objective for item in again.history] == [
            item.objective for item in run.history
        ]


def test_what_fails_in_one_ascent_is_no_matter_to_the_next(scene, start, monkeypatch):
    calls = fail_on(monkeypatch, {1, 2, 3})
    run = optimise(scene, Settings(ANEW, most_iterations=2, most_failures=2), start)
    assert not run.gave_up
    steps = [step for step, _ in calls]
    assert [item.stage for item in run.history] == [0, 0, 0, 1, 1, 1, 2, 2]
    assert np.array_equal(calls[3][1], calls[4][1])  # the start of the second, in half the step
    assert steps[4] == steps[3] / 2.0


def test_what_runs_side_by_side_has_the_same_bits(scene, start, monkeypatch):
    settings = Settings((dataclasses.replace(STAGES[1], refined=True),), most_iterations=3)
    found = []
    for count in (1, 2):
        monkeypatch.setattr("mpmopt.design.ensemble.processors", lambda count=count: count)
        _, items = tried(scene, settings, start)
        found.append([(item.objective, item.post_processed, item.refined) for item in items])
    assert found[0] == found[1]


def test_the_moving_average_ends_a_stage(scene, start):
    still = Settings(STAGES[:1], tolerance=1.0, least_iterations=13, most_iterations=100)
    run = optimise(scene, still, start)
    assert len(run.history) == 13
    assert "mean objective over 10 iterations changed by" in run.stop_reason
    assert "after 13 of them" in run.stop_reason
    never = dataclasses.replace(still, tolerance=0.0, most_iterations=17)
    run = optimise(scene, never, start)
    assert len(run.history) == 17
    assert "limit of 17 iterations" in run.stop_reason


def test_a_failure_goes_back_to_the_best_design_and_shortens_the_move(scene, start, monkeypatch):
    fail_on(monkeypatch, {5})
    run, designs = tried(scene, dataclasses.replace(QUICK, stages=STAGES[:1]), start)
    assert run.failed_evaluations == 1
    failed, after = designs[5], designs[6]
    assert np.isnan(failed.objective)
    assert "made to fail" in failed.failure
    best = max(designs[:5], key=lambda item: item.objective)
    assert after.move_limit <= failed.move_limit / 2
    assert np.abs(after.x - best.x).max() <= 2.0 * after.move_limit + 1e-12
    assert np.isfinite(after.objective)
    assert len(run.history) == QUICK.most_iterations + 1


def test_a_gradient_that_chaos_blew_up_shortens_no_later_step(scene, start, monkeypatch):
    """Measured on the crawler: one of 4e9 among ones of 4 froze the 105 evaluations after it."""
    still = dataclasses.replace(QUICK, stages=STAGES[:1], adapt_move_limit=False, tolerance=0.0)
    real, calls = Problem.evaluate, []

    def evaluate(self, x):
        calls.append(x)
        found = real(self, x)
        factor = 1e9 if len(calls) == 6 else 1.0
        return dataclasses.replace(found, gradient=factor * found.gradient)

    plain = optimise(scene, still, start).history
    monkeypatch.setattr(Problem, "evaluate", evaluate)
    for item, other in zip(optimise(scene, still, start).history, plain, strict=True):
        assert item.step == pytest.approx(other.step, rel=1e-6)


def test_a_stage_whose_first_design_fails_halves_its_step(scene, start, monkeypatch):
    calls = fail_on(monkeypatch, {0, 1})
    run = optimise(scene, dataclasses.replace(QUICK, stages=STAGES[:1]), start)
    assert [step for step, _ in calls[:3]] == [4e-3, 2e-3, 1e-3]
    assert all(np.array_equal(x, start) for _, x in calls[:3])
    assert run.result.time_step == 1e-3
    assert run.problem().scene.time_step == 1e-3
    assert run.problem().value(run.result.x) == run.result.objective
    assert run.failed_evaluations == 2


def test_a_stage_whose_first_design_fails_takes_the_best_of_the_one_before(
    scene, start, monkeypatch
):
    without_void = iter((0.4, 0.1, 0.2))  # so that the best is not the incumbent
    monkeypatch.setattr(
        "mpmopt.optimisation.loop.post_processed", lambda problem, x: next(without_void)
    )
    calls = fail_on(monkeypatch, {3, 4})
    stages = (dataclasses.replace(STAGES[0], solid=True), dataclasses.replace(STAGES[0], beta=2.0))
    settings = Settings(stages, window=1, least_iterations=3, most_iterations=3)
    run = optimise(scene, settings, start)
    incumbent = max(run.history[:3], key=lambda item: item.objective)
    assert incumbent.objective > run.best[0].objective
    assert not np.array_equal(calls[3][1], run.best[0].x)
    assert [step for step, _ in calls[3:6]] == [4e-3, 4e-3, 2e-3]
    assert all(np.array_equal(x, run.best[0].x) for _, x in calls[4:6])


def test_repeated_failure_gives_up_with_everything_kept(scene, start, monkeypatch):
    fail_on(monkeypatch, set(range(6, 1000)))
    run = optimise(scene, dataclasses.replace(QUICK, most_failures=4), start)
    assert len(run.history) == 10
    assert run.failed_evaluations == 4
    assert "gave up after 4 failed evaluations in a row" in run.stop_reason
    assert run.stop_reason.startswith("Stage 1 of 2 was the last")
    assert run.result.objective == max(item.objective for item in run.history[:6])


def test_failure_from_the_start_is_an_error_that_can_be_read(scene, start, monkeypatch):
    fail_on(monkeypatch, set(range(1000)))
    run = optimise(scene, dataclasses.replace(QUICK, most_failures=3), start)
    assert "gave up after 3" in run.stop_reason
    with pytest.raises(DesignError, match=r"no evaluation succeeded yet; the last: .*made to fail"):
        _ = run.result


def test_a_stage_that_cannot_run_is_refused_before_any_evaluation(scene, start, monkeypatch):
    calls = fail_on(monkeypatch, set())
    too_light = dataclasses.replace(STAGES[1], void_density=1e-5)
    with pytest.raises(SceneError, match="stability limit"):
        optimise(scene, dataclasses.replace(QUICK, stages=(STAGES[0], too_light)), start)
    assert calls == []


def test_a_scene_with_nothing_to_design_is_refused(scene):
    bare = dataclasses.replace(scene, body=scene.body[2:3])
    with pytest.raises(DesignError, match="nothing to design"):
        optimise(bare, QUICK, np.zeros(0))


def test_the_result_is_the_design_that_goes_farthest_without_void(scene, start):
    both = [dataclasses.replace(stage, solid=True) for stage in STAGES]
    run = optimise(scene, dataclasses.replace(QUICK, stages=tuple(both)), start)
    assert run.result.post_processed == max(item.post_processed for item in run.history)


def test_a_design_counts_with_the_least_of_its_refinement_study(scene, start, monkeypatch):
    solid = iter((0.1, 0.4, 0.2, 0.15, 0.3, np.nan, 0.5))
    found = iter((0.05, 0.15, 0.3, SimulationError("torn", 1, -1, (0.0, 0.0), "none"), 0.45))
    asked = []

    def post_processed(problem, x):
        return next(solid)

    def least(problem, x):
        asked.append(x)
        value = next(found)
        if isinstance(value, Exception):
            raise value
        return value

    monkeypatch.setattr("mpmopt.optimisation.loop.post_processed", post_processed)
    monkeypatch.setattr("mpmopt.assess.refinement.least", least)
    stage = dataclasses.replace(STAGES[1], refined=True)
    settings = Settings((stage,), window=1, least_iterations=7, most_iterations=7)
    run, designs = tried(scene, settings, start)
    counted = [item.counted for item in run.history]
    assert counted == [0.05, 0.15, 0.2, 0.15, -np.inf, -np.inf, 0.45]
    assert [len(asked), run.result.post_processed, run.result.refined] == [5, 0.5, 0.45]
    assert np.array_equal(run.result.x, designs[6].x)


def test_what_a_refined_stage_asks_is_what_the_study_tells(scene, start):
    stage = dataclasses.replace(STAGES[1], refined=True)
    settings = Settings((stage,), window=1, least_iterations=4, most_iterations=4)
    run = optimise(scene, settings, start)
    rows = {row.name: row for row in refinement.study(run.problem(), run.result.x)}
    others = rows["half the step"].distance, rows["cells half as wide"].distance
    assert run.result.refined == min(others)
    assert others[0] != others[1]
    assert run.result.post_processed == rows["as designed"].distance
    assert run.result.counted == min(run.result.refined, run.result.post_processed)


def candidate(stage, objective, post_processed=np.nan, refined=np.nan):
    return Candidate(
        stage=stage, beta=1.0, time_step=1e-3, move_limit=0.1, objective=objective,
        non_discreteness=0.0, projected_gradient=0.0, step=0.0, seconds=0.0, x=np.zeros(1),
        gamma=np.zeros(1), post_processed=post_processed, refined=refined,
    )  # fmt: skip


def test_the_result_is_never_a_design_that_no_refinement_saw_if_there_is_one(scene):
    solid = dataclasses.replace(STAGES[0], solid=True)
    stages = (solid, dataclasses.replace(solid, refined=True))
    best = {0: candidate(0, 0.6, 0.55), 1: candidate(1, 0.6, 0.54, 0.5)}
    run = Optimisation(scene, Settings(stages), DEFAULT_TASK, np.zeros(1), best=best)
    assert run.result is best[1]
    best[1] = candidate(1, 0.6, 0.54, -np.inf)  # it has no refinement study that ran
    assert run.result is best[0]


def test_a_run_that_was_changed_is_refused(scene, start):
    run = optimise(
        scene, Settings(STAGES[:1], window=1, least_iterations=2, most_iterations=2), start
    )
    changes: list[dict[str, Any]] = [{"stage": -1}, {"stage": 2}]
    for change in changes:
        with pytest.raises(DesignError, match="it was changed"):
            go_on(dataclasses.replace(run, stop_reason="", **change))


def test_a_start_that_does_not_fit_is_refused(scene):
    with pytest.raises(DesignError, match="variables"):
        optimise(scene, QUICK, np.zeros(3))


def test_a_stage_may_have_its_own_limit_of_iterations(scene, start):
    stages = (dataclasses.replace(STAGES[0], most_iterations=7), STAGES[1])
    settings = dataclasses.replace(
        QUICK, stages=stages, least_iterations=5, most_iterations=5, tolerance=0.0
    )
    run = optimise(scene, settings, start)
    assert [sum(item.stage == stage for item in run.history) for stage in (0, 1)] == [7, 5]


def test_a_stage_that_never_runs_gives_up_after_three_halvings(scene, start, monkeypatch):
    calls = fail_on(monkeypatch, set(range(1000)))
    run = optimise(scene, QUICK, start)
    assert [step for step, _ in calls] == [4e-3, 2e-3, 1e-3, 5e-4]
    assert "gave up after 4 failed" in run.stop_reason


@pytest.mark.parametrize(
    "wrong",
    [
        {"beta": -1.0},
        {"beta": "a"},
        {"void_density": 0.0},
        {"time_step": 0.0},
        {"void_stiffness": np.nan},
        {"move_limit": 0.0},
        {"move_limit": 1.5},
        {"move_limit": "a"},
        {"most_iterations": 1.5},
        {"void_cutoff": -0.1},
        {"void_cutoff": 1.0},
        {"refined": True},
        {"solid": "no"},
        {"most_iterations": 0},
    ],
)
def test_senseless_stages_are_refused(wrong):
    with pytest.raises(DesignError, match=next(iter(wrong))):
        dataclasses.replace(STAGES[0], **wrong)


@pytest.mark.parametrize(
    "wrong",
    [
        {"stages": ()},
        {"stages": (1,)},
        {"window": 2.5},
        {"most_iterations": np.inf},
        {"window": 0},
        {"least_iterations": 300},
        {"tolerance": -1.0},
        {"best_first": "false"},
        {"most_failures": 0},
    ],
)
def test_senseless_settings_are_refused(wrong):
    with pytest.raises(DesignError, match=next(iter(wrong))):
        dataclasses.replace(QUICK, **wrong)


def test_the_same_start_gives_the_same_run_bit_for_bit(scene, start):
    one, two = (optimise(scene, QUICK, start) for _ in range(2))
    assert [item.objective for item in one.history] == [item.objective for item in two.history]
    assert np.array_equal(one.result.x, two.result.x)


def test_a_step_filters_and_projects_its_design_once_however_it_is_judged(start, monkeypatch):
    # As it is, without its void, and in other discretisations.
    projected, real = [], chain.project

    def project(phi, beta, threshold):
        projected.append(phi)
        return real(phi, beta, threshold)

    monkeypatch.setattr(chain, "project", project)
    stage = Stage(4.0, 1e-2, 1e-3, 4e-3, solid=True, refined=True, void_cutoff=0.05)
    settings = Settings((stage,), least_iterations=3, most_iterations=3)
    run = optimise(small_scene(steps=6), settings, start)
    assert len(run.history) == len(projected) == 3
    assert np.isfinite(run.history[0].refined)
