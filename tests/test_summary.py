"""What a study tells of a finished run, on numbers that are told instead of simulated."""

import dataclasses
import re
from math import inf
from typing import Any

import numpy as np
import pytest
from conftest import SHORT, small_scene

from mpmopt.app import case, ending, summary
from mpmopt.app.case import Case
from mpmopt.app.summary import summarise
from mpmopt.assess import refinement, robustness, threshold
from mpmopt.assess.refinement import Variant
from mpmopt.assess.verdict import DRIVEN, KEPT, verdict
from mpmopt.design.driven import Driven
from mpmopt.design.objective import Objective
from mpmopt.design.problem import Problem
from mpmopt.design.task import DEFAULT_TASK, AtMost, Task
from mpmopt.design.terms import Displacement, Height, Speed, Volume
from mpmopt.design.variation import refined
from mpmopt.errors import SimulationError
from mpmopt.optimisation import presets
from mpmopt.optimisation.history import Candidate, Optimisation

SCENE = small_scene()
STAGE = SHORT.stages[0]
PROBLEM = STAGE.problem(SCENE)
NAMES = ("as designed", "half the step", "twice the step", "cells half as wide")


def candidate(phi, a, **changes):
    x = PROBLEM.join(phi, a, -0.3, -0.5)
    values = {
        "stage": 0, "beta": 4.0, "time_step": 4e-3, "move_limit": 0.1,
        "objective": 0.5, "non_discreteness": 0.25, "projected_gradient": 0.0, "step": 0.0,
        "seconds": 7.0,
    }  # fmt: skip
    return Candidate(x=x, gamma=PROBLEM.gamma(x), **{**values, **changes})


def finished(best_phi=1.0):
    """A run that began with a = 1 and ended with a = 0.75."""
    first, best = candidate(0.0, 1.0, objective=0.1), candidate(best_phi, 0.75)
    history = [first, dataclasses.replace(first, failure="torn"), dataclasses.replace(best)]
    return Optimisation(
        SCENE, SHORT, DEFAULT_TASK, first.x, best={0: best}, history=history, first=first,
        last=best, stop_reason="It ended.",
    )  # fmt: skip


@pytest.fixture
def told(monkeypatch):
    """Lets simulations of solid bodies be these numbers; what references were asked with."""
    asked: list[Any] = []
    rows: list[Variant] = []
    block = [0.3]

    def best_actuated(scene, baseline, *actuations, task):
        keep = baseline(np.zeros((32, 2)))
        asked.append((int(np.sum(keep)), [float(v.a[0]) for v in actuations]))
        if not np.all(keep):
            return 0.2
        if np.isnan(block[0]):
            raise SimulationError("made to fail", 3, 1, (0.0, 0.0), "none")
        return block[0]

    monkeypatch.setattr(summary, "best_actuated", best_actuated)
    monkeypatch.setattr(summary, "study", lambda problem, x: rows)
    monkeypatch.setattr(summary, "cost_of_transport", lambda simulation: 1.5)
    monkeypatch.setattr(summary, "post_processed", lambda problem, x: 0.45)
    monkeypatch.setattr(summary, "unactuated", lambda problem, x: 0.05)

    def tell(references, distances, of_block=0.3, failed=""):
        block[0] = of_block
        numbers = zip(NAMES, zip(references, distances))
        rows[:] = [
            Variant(name, (16, 16), 4e-3, failure="torn")
            if name == failed
            else Variant(name, (16, 16), 4e-3, r, d, retained=0.9)
            for name, (r, d) in numbers
        ]
        return asked

    return tell


def test_a_gain_is_over_the_solid_reference_design_where_that_goes_farthest(told):
    # The block's best is 0.3; in the rows it goes 0.1, 0.4, not at all, and 0.3.
    told((0.1, 0.4, np.nan, 0.3), (0.5, 0.5, 0.5, np.nan))
    gain = summarise(finished())["gain"]
    assert gain == pytest.approx(
        {"as designed": 0.2, "half the step": 0.1, "twice the step": 0.2, NAMES[3]: None}
    )
    # Where the block never ran with the run's actuation, the rows' own counts.
    told((0.1, 0.4, 0.2, 0.3), (0.5, 0.5, 0.1, 0.5), of_block=np.nan)
    summary = summarise(finished())
    assert summary["reference"] is None
    assert list(summary["gain"].values()) == pytest.approx([0.4, 0.1, -0.1, 0.2])


def test_references_take_the_better_of_the_first_and_the_best_actuation(told):
    asked = told((0.1,) * 4, (0.5,) * 4)
    summary = summarise(finished(), np.arange(32) < 20)
    assert asked == [(32, [1.0, 0.75]), (20, [1.0, 0.75])]
    assert (summary["reference"], summary["baseline"]) == (0.3, 0.2)
    assert summarise(finished())["baseline"] is None


def test_a_summary_is_of_the_best_design_and_counts_all_evaluations(told):
    told((0.1,) * 4, (0.6, 0.35, 0.5, 0.7))
    summary = summarise(finished())
    wanted = {
        "start": 0.1, "optimised": 0.5, "post_processed": 0.6, "actuation_off": 0.05,
        "post_processed_half_step": 0.35, "non_discreteness": 0.25, "a": [0.75, 0.75],
        "theta": [-0.3, -0.3], "b": [-0.5, -0.5], "evaluations": 3, "failed_evaluations": 1,
        "halved_evaluations": 0, "seconds": 7.0, "stop_reason": "It ended.",
    }  # fmt: skip
    assert {name: summary[name] for name in wanted} == wanted
    assert summary["retained_gain"] == {name: 0.9 for name in NAMES[1:]}


def test_a_body_without_void_is_simulated_again_only_where_its_reference_failed(told):
    told((0.1,) * 4, (0.6, 0.35, 0.5, 0.7), failed=NAMES[0])
    assert summarise(finished())["post_processed"] == 0.45


def test_a_cost_of_transport_is_that_of_the_body_without_grey(told, monkeypatch):
    told((0.1,) * 4, (0.5,) * 4)
    assert summarise(finished())["cost_of_transport"] == 1.5
    monkeypatch.setattr(summary, "cost_of_transport", lambda simulation: inf)
    assert summarise(finished())["cost_of_transport"] is None

    def count(simulation):
        return len(simulation.particles.position)

    monkeypatch.setattr(summary, "cost_of_transport", count)
    low = np.where(np.arange(32) < 8, 1.0, -1.0)
    best = candidate(low, 0.75).x
    there = len(PROBLEM.particles.position) - 32 + threshold.kept(PROBLEM, best).sum()
    assert summarise(finished(low))["cost_of_transport"] == there


def test_a_step_that_was_halved_is_told(told, monkeypatch):
    told((0.1,) * 4, (0.5,) * 4)
    rows: Any = summary.study
    halved = [*rows(0, 0)[:3], dataclasses.replace(rows(0, 0)[3], time_step=1e-3, halved=1)]
    assert summarise(finished())["shorter_steps"] == {}
    monkeypatch.setattr(summary, "study", lambda problem, x: halved)
    found = summarise(finished())
    assert found["shorter_steps"] == {NAMES[3]: 1e-3}
    assert "90% with half the step, " in ending._gain(found)
    assert ending._gain(found).endswith(f"90% with {NAMES[3]} (step 0.0010)")


def test_loose_particles_are_those_that_hang_on_nothing(told):
    told((0.1,) * 4, (0.5,) * 4)
    height = PROBLEM.particles.position[PROBLEM.particles.designed][:, 1]
    low = np.where(height < 4.6 / 16, 1.0, -1.0)  # the lowest row; solid begins at 6 / 16
    kept = threshold.kept(PROBLEM, candidate(low, 0.75).x).sum()
    assert 8 <= kept <= 24
    assert summarise(finished(low))["disconnected_particles"] == kept
    assert summarise(finished(1.0))["disconnected_particles"] == 0
    assert summarise(finished(-1.0))["disconnected_particles"] == 0


def test_a_case_starts_where_it_says(tmp_path, monkeypatch):
    monkeypatch.setattr(case, "_go_on", lambda path, kept, *_: kept.run.x)
    start = {"theta": (0.9, -0.75), "a": 0.5, "b": 0.25}
    study = Case(SCENE, SHORT, lambda position: position[:, 0] > 0.0, start)
    x: Any = case.run(study, tmp_path / "one")
    found = PROBLEM.split(x)
    assert found.theta.tolist() == [0.9, -0.75]
    assert {(*found.a, *found.b, *found.phi)} == {(0.5, 0.5, 0.25, 0.25, *32 * (0.0,))}


def test_a_baseline_is_kept(tmp_path, monkeypatch):
    monkeypatch.setattr(case, "_go_on", lambda path, kept, *_: kept.baseline)
    study = Case(SCENE, SHORT, lambda position: position[:, 1] < 5 / 16)
    baseline: Any = case.run(study, tmp_path)
    assert (baseline.size, baseline.sum()) == (32, 16)


def test_a_share_of_the_gain_is_over_the_block_in_the_same_discretisation(monkeypatch):
    # (block, design) in each row; the gain as designed is 0.4.
    values = iter((0.1, 0.5, 0.2, 0.4, 0.3, 0.2, 0.0, 0.5))
    monkeypatch.setattr(refinement, "distance", lambda *_: next(values))
    x = PROBLEM.join(1.0, 0.5, 0.0, 0.0)
    rows = refinement.study(PROBLEM, x)
    assert [row.retained for row in rows] == pytest.approx([1.0, 0.5, -0.25, 1.25])
    for design in (0.5, 0.4):  # no gain, and a loss
        values = iter((0.5, design, 0.2, 0.4, 0.3, 0.2, 0.0, 0.5))
        assert all(np.isnan(row.retained) for row in refinement.study(PROBLEM, x))


def test_the_least_of_a_refinement_study_is_of_half_the_step_and_half_the_cells(monkeypatch):
    asked = []

    def distance(scene, keep, variables, objective):
        asked.append((scene.time_step, scene.steps, scene.grid.cells, keep.size))
        return values[len(asked) % 2]

    monkeypatch.setattr(refinement, "distance", distance)
    x = PROBLEM.join(1.0, 0.5, 0.0, 0.0)
    for values in ((0.4, 0.2), (0.1, 0.3)):
        assert refinement.least(PROBLEM, x) == min(values)
    assert asked[:2] == [(2e-3, 80, (16, 16), 32), (2e-3, 80, (32, 32), 128)]


def test_a_design_on_finer_cells_takes_each_particle_from_the_nearest():
    phi = np.where(PROBLEM.particles.position[PROBLEM.particles.designed][:, 0] < 5 / 16, 1.0, -1.0)
    x = PROBLEM.join(phi, 0.5, 0.0, 0.0)
    fine = Problem(refined(SCENE, 2))
    there = refinement.mapped(fine.scene, PROBLEM, x)
    keep = threshold.kept(PROBLEM, x)
    assert 0 < keep.sum() < keep.size
    assert there.sum() == 4 * keep.sum()
    position = fine.particles.position[fine.particles.designed]
    coarse = PROBLEM.particles.position[PROBLEM.particles.designed]
    moved = fine.split(fine.transfer(PROBLEM, x)).phi
    for point, is_there, value in zip(position, there, moved):
        nearest = np.hypot(*(coarse - point).T).argmin()
        assert (is_there, value) == (keep[nearest], phi[nearest])


def test_what_is_kept_includes_the_threshold():
    rng = np.random.default_rng(3)
    x = PROBLEM.join(rng.uniform(-1.0, 1.0, 32), 0.5, 0.0, 0.0)
    gamma = np.sort(PROBLEM.gamma(x))
    assert threshold.kept(PROBLEM, x, threshold=float(gamma[20])).sum() == 12
    assert np.array_equal(threshold.kept(PROBLEM, x), PROBLEM.gamma(x) >= 0.3)
    part = Problem(SCENE, 4.0, void_cutoff=float(gamma[20]))
    assert part.present(part.split(x).phi).sum() == 16 + 12


def test_pieces_hold_together_over_edges_not_over_corners():
    index = np.rint(PROBLEM.particles.position[PROBLEM.particles.designed] * 32 - 0.5).astype(int)
    i, j = (index - index.min(axis=0)).T
    stairs = (i == j) & (i < 3)  # three particles, corner to corner, below the solid
    assert sorted(threshold.pieces(SCENE, stairs)[stairs]) == [1, 2, 3]
    row = (j == 0) & (i < 3)
    assert set(threshold.pieces(SCENE, row)[row]) == {1}


def test_without_actuation_nothing_works_on(monkeypatch):
    asked: list[Any] = []

    def distance(scene, keep, v, _):
        asked.append((keep, v))
        return 0.125

    monkeypatch.setattr(threshold, "distance", distance)
    x = PROBLEM.join(np.linspace(-1.0, 1.0, 32), 0.5, 0.25, 0.75)
    assert threshold.unactuated(PROBLEM, x) == 0.125
    ((keep, v),) = asked
    assert np.array_equal(keep, PROBLEM.gamma(x) >= 0.3)
    assert (v.a.tolist(), v.theta.tolist(), v.b.tolist()) == ([0.0, 0.0], [0.25, 0.25], [0.0, 0.0])


def test_a_reference_takes_the_best_actuation_of_those_that_run(monkeypatch):
    found = {0.25: 0.1, 0.5: 0.3, 0.75: 0.2}

    def distance(scene, keep, variables, objective):
        a = float(variables.a[0])
        if a not in found:
            raise SimulationError("made to fail", 3, 1, (0.0, 0.0), "none")
        return found[a]

    monkeypatch.setattr(threshold, "distance", distance)

    def best_actuated(*amplitudes):
        actuations = [PROBLEM.split(PROBLEM.join(0.0, a, 0.0, 0.0)) for a in amplitudes]
        return threshold.best_actuated(SCENE, threshold.solid_reference, *actuations)

    assert best_actuated(0.25, 0.5, 0.75) == 0.3
    assert best_actuated(1.0, 0.25) == best_actuated(0.25, 1.0) == 0.1
    with pytest.raises(SimulationError, match="made to fail"):
        best_actuated(1.0, 0.0)


def test_a_distance_after_a_transient_counts_from_there():
    # The body falls to one side at once.
    scene = small_scene(steps=6, transient=3 * 4e-3, gravity=(5.0, 0.0), walls=())
    keep, variables = np.ones(32, dtype=bool), PROBLEM.split(PROBLEM.join(1.0, 0.5, 0.0, 0.0))
    simulation = threshold.solid_body(scene, keep, variables)
    objective = Objective.of(scene, simulation.particles)
    states = simulation.run([3, 6])
    settled, end = (objective.centroid(state) for state in states)
    expected = objective.start + end - settled
    assert threshold.distance(scene, keep, variables) == pytest.approx(expected, rel=1e-13)
    assert abs(expected - end) > 1e-6


def test_the_presets_are_what_they_say():
    sharp = presets.continuation(1e-3)
    assert [stage.beta for stage in sharp.stages] == [0.5, 1.0, 2.0, 4.0, 8.0, 16.0, 32.0]
    late = [False] * 4 + [True] * 3
    assert [stage.solid for stage in sharp.stages] == late
    assert [stage.refined for stage in sharp.stages] == late
    assert [stage.void_cutoff > 0.0 for stage in sharp.stages] == late
    assert (sharp.adapt_move_limit, sharp.sharpen_asymptotes, sharp.best_first) == 3 * (True,)

    gait = presets.gait(12)
    (stage,) = gait.stages
    assert (stage.subpixel, stage.solid, stage.refined) == (True, True, True)
    assert (stage.move_limit, stage.time_step) == (0.02, None)
    assert (gait.adapt_move_limit, gait.tolerance, gait.most_iterations) == (False, 0.0, 12)

    paper = presets.paper_preset(1e-3)
    assert [stage.beta for stage in paper.stages] == [0.5, 1.0, 2.0, 4.0, 8.0, 16.0]
    assert {(s.void_density, s.void_stiffness, s.move_limit) for s in paper.stages} == {
        (1e-3, 1e-3, 0.5)
    }
    assert {(s.halvings, s.limited) for s in paper.stages} == {(0, False)}
    assert (paper.adapt_move_limit, paper.sharpen_asymptotes, paper.best_first) == 3 * (False,)
    assert (paper.window, paper.tolerance) == (10, 2e-4)


def test_the_table_at_the_end_says_what_a_number_is_of():
    summary: dict[str, Any] = {
        "disconnected_particles": 6, "components": 2, "speed": 1e-4, "driven_share": None,
        "speed_by_friction": {}, "failures": {}, "way": "stands",
    }  # fmt: skip
    assert "they count in displacement, not in speed" in ending._pieces(summary)
    assert "it stands" in ending._elsewhere(summary)["speed"]
    back = {**summary, "speed": -0.3, "way": "goes back"}
    assert "it goes back" in ending._elsewhere(back)["speed"]
    moved = {**summary, "way": "goes", "followed": {"end": "falls", "seconds": 9.06}}
    assert "at 9.06: falls" in ending._elsewhere(moved)["speed"]


WALKER = {
    "speed": 0.1, "way": "goes", "post_processed": 0.6, "disconnected_particles": 0,
    "gain": {"as designed": 0.2}, "driven_share": 1.0, "failures": {},
    "kept": {"half_step": 0.97, "finer_cells": 0.9},
}  # fmt: skip
FINGER = {
    "post_processed": 0.6, "disconnected_particles": 0, "gain": {"as designed": 0.2},
    "retained_gain": {"half the step": 0.97, "twice the step": None, "cells half as wide": 0.85},
}  # fmt: skip


@pytest.mark.parametrize(
    ("whole", "changes", "says"),
    [
        (WALKER, {}, "goes: 90% or more of its speed"),
        (WALKER, {"followed": {"end": "goes on", "seconds": 20.0}}, "goes: .* discretisations$"),
        (WALKER, {"followed": {"end": "falls", "seconds": 9.06}}, "falls: at t = 9.06"),
        (WALKER, {"followed": {"end": "stops", "seconds": 9.06}}, "stops: at t = 9.06"),
        (WALKER, {"followed": {"end": "it tore", "seconds": 9.0}}, "fails: at t = 9.00, it tore"),
        (WALKER, {"speed": None, "failures": {"nominal": "it tore"}}, "fails: it tore"),
        (WALKER, {"speed": 1e-4, "way": "stands"}, "stands: .* 0.000100"),
        (WALKER, {"speed": -1e-4, "way": "stands"}, "stands: .* -0.000100"),
        (
            WALKER,
            {"speed": -0.3, "way": "goes back"},
            r"goes back: its speed along the way is -0\.300$",
        ),
        (WALKER, {"driven_share": DRIVEN - 0.01}, "slides: only 49%"),
        (WALKER, {"disconnected_particles": 6}, "loose pieces: 6 particles"),
        (
            WALKER,
            {"kept": {"half_step": KEPT - 0.01, "finer_cells": 1.0}},
            "doubtful: .*with half the step$",
        ),
        (WALKER, {"kept": {"half_step": KEPT, "finer_cells": 1.0}}, "goes: 80% or more"),
        (
            WALKER,
            {"kept": {"half_step": 1.0, "finer_cells": None}},
            "doubtful: no speed with cells half as wide$",
        ),
        (
            WALKER,
            {
                "kept": {"half_step": 1.0, "finer_cells": None},
                "failures": {"cells 2": f"2e+08 {robustness.TOO_LONG} 1.5e+08"},
            },
            "goes: 100% or more",
        ),
        (
            WALKER,
            {"kept": {"finer_cells": None}, "failures": {"cells 2": robustness.TOO_LONG}},
            "goes: not compared; mpmopt study compares other discretisations$",
        ),
        (
            WALKER,
            {
                "kept": {"finer_cells": None},
                "failures": {"cells 2": robustness.TOO_LONG},
                "followed": {"end": "goes on", "seconds": 20.0},
            },
            "goes: not compared$",
        ),
        (FINGER, {}, "gains: 85% or more of its gain"),
        (FINGER, {"post_processed": None}, "fails: .* without its void"),
        (FINGER, {"gain": {"as designed": 0.0}}, "no gain: the solid block does as well"),
        (FINGER, {"retained_gain": {"other formulation": 0.5}}, "doubtful: .* the other form"),
        (FINGER, {"disconnected_particles": 1}, "loose pieces"),
        (FINGER, {"retained_gain": {"half the step": 0.5}}, "doubtful: only 50% of its gain with"),
    ],
)
def test_a_run_has_a_verdict_in_one_word(whole, changes, says):
    assert re.match(says, verdict({**whole, **changes}))


def test_what_is_not_to_travel_is_judged_by_its_gain():
    jumper = {
        **WALKER, **FINGER, "speed": 1e-4, "driven_share": None, "way": "stands",
        "followed": {"end": "falls", "seconds": 3.0},
    }  # fmt: skip
    assert verdict(jumper).startswith("stands")
    assert verdict(jumper, travels=False) == verdict(FINGER)
    for terms in (
        DEFAULT_TASK.maximise,
        Speed(direction=SCENE.direction),
        Height() + 2.0 * Driven(Displacement()),
    ):
        assert Task(terms).travels(SCENE)
    for terms in (Height(), Displacement((0.0, 1.0)), Height() - 0.1 * Speed()):
        assert not Task(terms).travels(SCENE)
    run = dataclasses.replace(finished(), task=Task(Height()))
    assert summary.verdict_of(jumper, run) == verdict(FINGER)


def test_a_design_that_breaks_a_constraint_has_that_as_its_verdict(told):
    told((0.1,) * 4, (0.5,) * 4)
    assert summarise(finished())["verdict"].startswith("gains: 90%")
    task = Task(subject_to=(AtMost(Volume(), 0.4),))
    run = dataclasses.replace(finished(), task=task)
    for value, says in ((0.5, "breaks a constraint: Volume.* at most 0.4, is 0.5"), (0.4, "gains")):
        run.best[0] = dataclasses.replace(run.best[0], constraints=(value,), multipliers=(0.0,))
        assert re.match(says, summarise(run)["verdict"])
