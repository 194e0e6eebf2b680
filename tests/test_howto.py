"""The how-to pages: their lines run, on a coarser worm and for a few evaluations, and do it."""

import re
import runpy
import sys
import textwrap
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest

from mpmopt.design.problem import Problem
from mpmopt.optimisation import presets
from mpmopt.optimisation.settings import Settings, Stage
from mpmopt.scene import Grid

DOCS = Path(__file__).parent.parent / "docs"
PAGES = sorted(path.stem for path in (DOCS / "howto").glob("*.rst"))
OPTIONAL = ("torch", "jax", "nlopt")


def blocks(page: str) -> list[str]:
    """The code of a page, block by block."""
    text = (DOCS / "howto" / f"{page}.rst").read_text()
    found = re.findall(r"^\.\. code-block:: python\n\n((?:   .*\n|\n)+)", text, re.MULTILINE)
    return [textwrap.dedent(block) for block in found]


def few(time_step: float | None = None, most_iterations: int = 4) -> Settings:
    """One stage of few evaluations, instead of a preset's."""
    return Settings((Stage(2.0, 1e-2, 1e-3, time_step, move_limit=0.1),), most_iterations=4)


@pytest.fixture
def run_page(monkeypatch, tmp_path):
    worm = runpy.run_path(str(DOCS / "tutorial" / "robot.py"))["worm"]
    coarse: Any = ModuleType("robot")
    coarse.worm = replace(worm, grid=Grid((64, 16), 1 / 32), time_step=2e-3, steps=500)
    monkeypatch.setitem(sys.modules, "robot", coarse)
    monkeypatch.setattr(presets, "continuation", few)
    monkeypatch.chdir(tmp_path)

    def run(page: str) -> dict[str, Any]:
        names: dict[str, Any] = {}
        for block in blocks(page):
            missing = [n for n in OPTIONAL if f"import {n}" in block and not find_spec(n)]
            if not missing:
                exec(compile(block, f"{page}.rst", "exec"), names)
        return names

    return run


def test_every_page_is_listed_and_has_code():
    listed = re.findall(r"^   howto/(\w+)$", (DOCS / "howto.rst").read_text(), re.MULTILINE)
    assert sorted(listed) == PAGES
    assert all(blocks(page) for page in PAGES)


@pytest.mark.case
@pytest.mark.parametrize("page", [page for page in PAGES if page != "torch_and_jax"])
def test_the_lines_of_a_page_run(page, run_page):
    names = run_page(page)
    if "run" in names:
        run = names["run"]
        values = [item.objective for item in run.history]
        assert len(values) == 4 and not run.failed_evaluations
        if not run.task.subject_to:
            assert run.result.objective == max(values) > values[0]
    if page == "anti_phase":
        assert names["best"].a.tolist() == [names["best"].a[0], -names["best"].a[0]] != [0.0, 0.0]
    if page == "from_a_picture":
        assert np.array_equal(run.problem().split(names["start"]).a, [1.0, 1.0])
        assert set(run.problem().split(names["start"]).phi) == {-0.5, 0.5}
    if page == "finger":
        assert 0.0 < -run.result.objective < -values[0]
    if page == "to_the_left":
        right = replace(names["left"], direction=(1.0, 0.0))
        value = Problem(right, task=names["task"]).value(names["start"])
        assert value == Problem(names["left"]).value(names["start"]) < -1.0
    if page in ("minimize", "other_optimisers"):
        problem = names["problem"]
        start = names.get("start", problem.join(-0.2, 1.0, [-0.3, 0.3], -0.5))
        first = problem.value(start)
        assert -names["result"].fun > first
        if "optimiser" in names:
            assert problem.value(names["x"]) == names["optimiser"].last_optimum_value() > first


@pytest.mark.slow
@pytest.mark.parametrize("library", ["torch", "jax"])
def test_the_gradient_is_that_of_the_task(library, run_page):
    pytest.importorskip(library)
    names = run_page("torch_and_jax")
    evaluation = names["problem"].evaluate(names["start"])
    (volume,) = evaluation.constraints
    expected = evaluation.gradient - 0.2 * volume * evaluation.jacobian[0]
    found = names["x"].grad.numpy() if library == "torch" else np.asarray(names["slope"])
    assert found == pytest.approx(expected, rel=1e-12, abs=1e-300)
