"""Ways to climb compared: each run once, and their table."""

from dataclasses import replace

import numpy as np
import optimisers
from test_robustness import on_ground

from mpmopt.app.case import Case
from mpmopt.design.task import Task
from mpmopt.optimisation.settings import Settings, Stage


def test_every_way_is_the_cases_but_for_what_its_name_says():
    settings, task = optimisers.WAYS["as the case"]
    assert (settings, task) == (optimisers.CASE.settings, optimisers.CASE.task)
    for name, (other, others_task) in optimisers.WAYS.items():
        evaluations = other.most_iterations * len(other.stages)
        assert evaluations == settings.most_iterations, name
        assert (other, others_task) != (settings, task) or name == "as the case"


def test_starts_differ_from_the_cases_by_a_smooth_field(rng):
    positions = rng.uniform(0.2, 0.4, (50, 2))
    own, other = (optimisers.start_of(seed)["phi"](positions) for seed in (0, 1))
    assert np.array_equal(own, optimisers.CASE.start["phi"](positions))
    assert 0.02 < np.abs(own - other).mean() < 0.5
    assert np.abs(other).max() <= 1.0


def test_a_run_that_is_there_is_not_made_again(tmp_path, monkeypatch):
    case = Case(
        on_ground(steps=10),
        Settings((Stage(8.0, solid=True),), most_iterations=2),
        lambda positions: positions[:, 0] > 0.0,
        {"phi": lambda positions: 0.3 * np.cos(40.0 * positions[:, 0])},
    )
    monkeypatch.setattr(optimisers, "CASE", case)
    longer = replace(case.settings, most_iterations=3)
    monkeypatch.setattr(
        optimisers, "WAYS", {"short": (case.settings, Task()), "longer": (longer, Task())}
    )
    table = optimisers.compare(["short", "longer"], 2, tmp_path)
    lines = [line.split(",") for line in table.splitlines()]
    assert [line[:2] for line in lines[1:]] == [[w, s] for w in ("short", "longer") for s in "01"]
    assert [line[-1] for line in lines] == ["evaluations", "2", "2", "3", "3"]
    written = {path: path.stat().st_mtime_ns for path in tmp_path.glob("*.h5")}
    assert len(written) == 4
    assert optimisers.compare(["short", "longer"], 2, tmp_path) == table
    assert written == {path: path.stat().st_mtime_ns for path in tmp_path.glob("*.h5")}
