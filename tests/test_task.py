"""Optimisations with constraints: feasible where that can be, resumed to the bit, and told."""

import dataclasses
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from conftest import small_scene

from mpmopt.app.summary import summarise, table
from mpmopt.design.evaluation import Evaluation
from mpmopt.design.problem import Problem
from mpmopt.design.task import FEASIBLE, AtMost, Task
from mpmopt.design.terms import Displacement, Effort, OnePiece, Volume
from mpmopt.errors import SimulationError
from mpmopt.optimisation.loop import go_on, optimise
from mpmopt.optimisation.settings import Settings, Stage
from mpmopt.results import runfile
from mpmopt.simulation.indicators import Indicators

STAGE = Stage(2.0, 1e-2, 1e-3, 4e-3, move_limit=0.2)
SETTINGS = Settings((STAGE,), most_iterations=12, tolerance=0.0)
SCENE = small_scene(steps=25)
START = Problem(SCENE).join(0.0, 1.0, -0.3, -0.5)


def test_a_volume_bound_is_met_and_active():
    task = Task(subject_to=(AtMost(Volume(), 0.2),))
    run = optimise(SCENE, SETTINGS, START, task=task)
    free = optimise(SCENE, SETTINGS, START)
    volume = Problem(SCENE, 2.0, task=Task(Volume()))
    assert run.history[0].violation == pytest.approx(1.5)  # (0.5 - 0.2) / 0.2
    assert volume.value(free.result.x) > 0.25
    assert 0.18 < volume.value(run.result.x) <= 0.2 * (1 + FEASIBLE)
    assert run.result.constraints == (volume.value(run.result.x),)
    assert run.result.violation == 0.0
    assert run.result.multipliers[0] > 0.0
    # And no feasible design that was seen goes farther.
    met = [item.objective for item in run.history if item.violation == 0.0]
    assert run.result.objective == max(met)
    assert "No design" not in run.stop_reason


def test_a_constraint_that_cannot_be_met_is_named_with_its_lack():
    task = Task(subject_to=(AtMost(Volume(), -1.0), AtMost(Effort(), 9.0)))
    settings = dataclasses.replace(SETTINGS, most_iterations=3)
    run = optimise(SCENE, settings, START, task=task)
    value = run.result.constraints[0]
    assert run.result.constraints[0] == min(item.constraints[0] for item in run.history)
    assert run.stop_reason.endswith(
        f"No design met all constraints: the best breaks Volume() at most -1, is {value:.4g}."
    )


def told(monkeypatch, rows, task, settings):
    """A run whose evaluations give these objectives and values of one constraint."""
    left = iter(rows)

    def evaluate(problem, x):
        row = next(left)
        if row is None:
            raise SimulationError("made to fail", 3, 1, (0.0, 0.0), "none")
        ones = np.ones(x.size)
        return Evaluation(row[0], ones, Indicators(), problem.scene.time_step,
                          constraints=np.array([row[1]]), jacobian=0.5 * ones[None])  # fmt: skip

    monkeypatch.setattr(Problem, "evaluate", evaluate)
    return optimise(SCENE, settings, START, task=task)


BOUND = Task(subject_to=(AtMost(Volume(), 0.5),))
FIVE = dataclasses.replace(SETTINGS, most_iterations=5)


def test_a_design_that_meets_constraints_is_better_than_any_that_does_not(monkeypatch):
    rows = [(9.0, 0.8), (8.0, 0.7), (1.0, 0.5), (7.0, 0.6), (2.0, 0.5 * (1 + 0.9 * FEASIBLE))]
    run = told(monkeypatch, rows, BOUND, FIVE)
    assert run.result.objective == 2.0
    assert [round(item.violation, 9) for item in run.history] == [0.6, 0.4, 0.0, 0.2, 0.0]
    # To come nearer is no step back; to leave is one.
    limits = [item.move_limit / 0.2 for item in run.history]
    assert limits == pytest.approx([1.0, 1.0, 1.0, 1.0, 0.6])


def test_of_designs_that_miss_a_constraint_the_nearest_is_the_best(monkeypatch):
    rows = [(9.0, 0.8), (1.0, 0.6), (7.0, 0.7), (8.0, 0.75), (9.0, 0.9)]
    run = told(monkeypatch, rows, BOUND, FIVE)
    assert run.result.objective == 1.0
    assert re.search(r"breaks Volume\(\) at most 0.5, is 0.6\.$", run.stop_reason)


def test_the_result_meets_constraints_though_a_sharper_stage_goes_farther(monkeypatch):
    settings = Settings((STAGE, STAGE), most_iterations=2, tolerance=0.0)
    run = told(monkeypatch, [(1.0, 0.5), (2.0, 0.6), (3.0, 0.6), (4.0, 0.6)], BOUND, settings)
    assert set(run.best) == {0, 1}
    assert (run.result.stage, run.result.objective) == (0, 1.0)


def test_a_failure_goes_back_to_the_best_that_meets_the_constraints(monkeypatch):
    rows = [(9.0, 0.8), (1.0, 0.4), None, (2.0, 0.4), (3.0, 0.4), (3.0, 0.4)]
    run = told(monkeypatch, rows, BOUND, FIVE)
    assert np.isnan(run.history[2].violation)
    assert np.isnan(run.history[2].constraints[0])
    assert run.history[3].step <= 2 * 0.1 + 1e-12


def test_a_stage_does_not_end_before_constraints_are_met(monkeypatch):
    rows = [(1.0, 0.6)] * 4 + [(1.0, 0.5)] + [(1.0, 0.5)] * 9
    settings = dataclasses.replace(SETTINGS, window=1, least_iterations=2)
    run = told(monkeypatch, rows, BOUND, settings)
    assert len(run.history) == 5


def test_a_run_with_constraints_goes_on_from_its_file_to_the_bit(tmp_path):
    task = Task(Displacement() - 0.01 * Effort(), (AtMost(Volume(), 0.4), AtMost(OnePiece(), 1.4)))
    settings = Settings((STAGE, dataclasses.replace(STAGE, beta=4.0)), most_iterations=4)
    paths: list[Path] = []

    def save(run):
        paths.append(tmp_path / f"{len(paths)}.h5")
        runfile.write(paths[-1], run)

    whole = optimise(SCENE, settings, START, save, task=task)
    for path in paths[::2]:
        again = go_on(runfile.read_run(path).run)
        assert again.task == task
        assert again.last is not None and whole.last is not None
        assert np.array_equal(again.last.x, whole.last.x)
        for one, other in zip(again.history, whole.history, strict=True):
            assert repr(dataclasses.replace(one, seconds=other.seconds)) == repr(other)


def test_a_summary_tells_value_and_multiplier_of_each_constraint():
    task = Task(subject_to=(AtMost(Volume(), 0.4),))
    run = optimise(SCENE, dataclasses.replace(SETTINGS, most_iterations=2), START, task=task)
    summary = summarise(run)
    expected = [run.result.constraints[0], run.result.multipliers[0]]
    assert summary["constraints"] == {"Volume() at most 0.4: value, multiplier": expected}
    assert "constraints, Volume() at most 0.4: value, multiplier" in table(summary)


def test_the_multiplier_is_what_the_bound_is_worth(monkeypatch):
    def evaluate(problem, x):
        """L is the sum of x, and the constraint's value half of that: a bound is worth two."""
        ones = np.ones(x.size)
        values: Any = {"constraints": np.array([0.5 * x.sum()]), "jacobian": 0.5 * ones[None]}
        return Evaluation(x.sum(), ones, Indicators(), problem.scene.time_step, **values)

    monkeypatch.setattr(Problem, "evaluate", evaluate)
    run = optimise(SCENE, SETTINGS, START, task=BOUND)
    assert run.result.constraints[0] == pytest.approx(0.5, rel=FEASIBLE)
    assert run.history[0].multipliers == (0.0,)
    assert run.result.multipliers[0] == pytest.approx(2.0, rel=1e-2)
