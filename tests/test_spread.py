"""One robot from several starts and with other rounding; and in several scenes at once."""

import csv
import dataclasses
import json
import os
import subprocess
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import results
import robots
import spread
from conftest import SHORT, small_scene
from PIL import Image
from test_robustness import on_ground, robot_in

from mpmopt.__main__ import main
from mpmopt.assess import robustness
from mpmopt.design.problem import Problem
from mpmopt.design.task import Task
from mpmopt.design.variation import Variation
from mpmopt.errors import DesignError, SimulationError
from mpmopt.optimisation.loop import optimise
from mpmopt.results import runfile
from mpmopt.view import ensemble, gait

SUMMARY = {
    "speed": 0.1, "speed_by_friction": {"0.2": 0.01, "0.35": 0.08, "0.5": 0.1, "0.8": 0.09},
    "kept": {"half_step": 0.9, "finer_cells": 0.7}, "driven_share": 1.1, "components": 1,
    "evaluations": 20,
}  # fmt: skip


@pytest.fixture(scope="module")
def a_run():
    scene = on_ground(steps=10)
    return optimise(scene, SHORT, Problem(scene).join(0.3, 1.0, -0.3, -0.5))


def test_the_worst_friction_counts_from_a_third_to_eight_tenths(tmp_path):
    (tmp_path / "summary.json").write_text(json.dumps(SUMMARY))
    assert spread.row(tmp_path)["worst at friction 0.3 to 0.8"] == 0.08
    torn = {**SUMMARY, "speed_by_friction": {"0.35": None, "0.5": 0.1}}
    (tmp_path / "summary.json").write_text(json.dumps(torn))
    assert np.isnan(spread.row(tmp_path)["worst at friction 0.3 to 0.8"])


def test_a_table_of_robots_says_nothing_where_a_summary_does(tmp_path, capsys):
    solid = {"post_processed": 0.4, "reference": 0.3, "failed_evaluations": 0}
    study = {"followed": {"seconds": 7.5, "end": "falls"}}
    for name, summary in (
        ("full", {**SUMMARY, **solid, **study}),
        ("walls", {**solid, "evaluations": 5}),
    ):
        (tmp_path / name).mkdir()
        (tmp_path / name / "summary.json").write_text(json.dumps(summary))
    table = tmp_path / "robots.csv"
    assert robots.main([str(tmp_path / "full"), str(tmp_path / "walls"), "--out", str(table)]) == 0
    full, walls = csv.DictReader(table.read_text().splitlines())
    assert (full["mean speed"], full["kept at half the step"]) == ("0.100", "90%")
    assert (full["goes on for"], full["a quarter as wide"]) == ("7.50, falls", "-")
    assert (walls["mean speed"], walls["without grey, over the solid block"]) == ("-", "0.100")


def test_a_spread_tells_median_worst_and_other_rounding():
    rows = [{"run": f"start-{k}", "speed": speed} for k, speed in enumerate((0.1, np.nan, 0.08))]
    text = spread.spread([*rows, {"run": "rounding", "speed": 0.09}])
    assert "3 starts: median 0.0800, worst 0.00, best 0.100" in text
    assert "with other rounding: 0.0900, -10%" in text


def test_other_rounding_is_that_of_a_plain_processor(tmp_path, monkeypatch):
    asked: list[Any] = []
    monkeypatch.setattr(subprocess, "run", lambda command, **how: asked.append((command, how)))
    spread.other_rounding("crawler", "preview", tmp_path)
    ((command, how),) = asked
    assert command[1:] == [
        str(Path(spread.__file__).with_name("crawler.py")), "--preview", "--out",
        str(tmp_path / "rounding"),
    ]  # fmt: skip
    assert how["check"]
    assert how["env"] == {**os.environ, "NUMBA_CPU_NAME": "generic", "NUMBA_CPU_FEATURES": ""}


def test_a_table_and_a_picture_have_all_robots(a_run, tmp_path, monkeypatch, capsys):
    def leave(folder):
        folder.mkdir()
        runfile.write(folder / "run.h5", a_run)
        (folder / "summary.json").write_text(json.dumps(SUMMARY))

    def multistart(case, out, starts, force):
        for seed in (0, 2):  # one failed
            leave(out / f"start-{seed}")
        return "told"

    monkeypatch.setattr(spread, "multistart", multistart)
    monkeypatch.setattr(spread, "other_rounding", lambda *where: leave(tmp_path / "rounding"))
    assert spread.main(["walker", "--starts", "3", "--out", str(tmp_path)]) == 0
    assert "speed of 2 starts" in capsys.readouterr().out
    rows = list(csv.DictReader((tmp_path / "spread.csv").read_text().splitlines()))
    assert [row["run"] for row in rows] == ["start-0", "start-2", "rounding"]
    assert rows[0]["kept at half the step"] == "0.9"
    assert (tmp_path / "spread.png").read_bytes().startswith(b"\x89PNG")


def test_a_film_shows_a_robot_in_all_scenes_of_its_task(
    a_run, tmp_path, monkeypatch, caplog, capsys
):
    monkeypatch.setattr(ensemble, "SHOWN", 2.0)
    names: list[Any] = []

    class Screen(ensemble.Screen):
        def __init__(self, motions, slow):
            super().__init__(motions, slow)
            names.extend(motion.name for motion in motions)

    monkeypatch.setattr(ensemble, "Screen", Screen)
    body_of = ensemble.body_of

    def fails(robot, scene, name):
        too_long = name == "friction 0.25" and scene.time_step > 0.6 * a_run.scene.time_step
        if "strength" in name or too_long:
            raise SimulationError("it burst", 3, -1, (0.0, 0.0), "none")
        return body_of(robot, scene, name)

    monkeypatch.setattr(ensemble, "body_of", fails)
    scenes = Variation(friction=0.25), Variation(refinement=2), Variation(strength=1.1)
    scene = dataclasses.replace(a_run.scene, transient=0.02)
    run = dataclasses.replace(a_run, scene=scene, task=Task(scenes=scenes))
    filmed = ensemble.film_scenes(tmp_path / "scenes.gif", run, 0.2)
    assert filmed.slow == pytest.approx(0.2 / 0.04)  # two transients
    assert names == ["friction 0.25", "refinement 2"]
    assert "without the scene of strength 1.1" in caplog.text
    with Image.open(BytesIO((tmp_path / "scenes.gif").read_bytes())) as film:
        assert film.n_frames == filmed.frames == 5
    names.clear()
    monkeypatch.setattr(ensemble, "SHOWN", 0.04)
    runfile.write(tmp_path / "run.h5", a_run)
    assert main(["scenes", str(tmp_path / "run.h5"), "--seconds", "0.2"]) == 0
    assert f"{tmp_path / 'scenes.gif'}: 5 frames" in capsys.readouterr().out
    assert names == [f"friction {value:g}" for value in robustness.FEW_FRICTIONS]
    with pytest.raises(DesignError, match=r"ends in '\.avi'"):
        ensemble.film_scenes(tmp_path / "scenes.avi", a_run, 0.2)
    on_walls = dataclasses.replace(a_run, scene=small_scene(steps=10))
    with pytest.raises(DesignError, match="only robots on ground"):
        ensemble.film_scenes(tmp_path / "scenes.gif", on_walls)


def test_a_stride_is_one_period_and_a_gait_has_its_feet(tmp_path, monkeypatch):
    """Drawn early; a robot that stands has its feet on the ground at all times."""
    for module in (robustness, gait):
        monkeypatch.setattr(module, "SETTLED", 0.02)
    monkeypatch.setattr(gait, "SEEN", 0.1)
    monkeypatch.setattr(gait, "PERIODS", 1)
    monkeypatch.setattr(gait, "PER_PERIOD", 8)
    figures: list[Any] = []
    monkeypatch.setattr(gait, "png", figures.append)
    monkeypatch.setattr(gait, "replace_file", lambda path, content: None)
    monkeypatch.setattr(robustness.Robot, "period", lambda self, scene: 0.04)
    robot = robot_in(on_ground())
    gait.plot_stride(tmp_path / "a.png", robot)
    gait.plot_gait(tmp_path / "b.png", robot)
    stride, diagram = figures
    titles = [axes.get_title() for axes in stride.axes]
    assert titles == [f"{k}/8 of the period" for k in range(8)]
    assert stride.get_suptitle().startswith("One period of 0.04 from t = 0.02")
    way, place, *_ = diagram.axes
    time = way.lines[0].get_xdata()
    assert time[0] == 0.0
    assert 0.09 < time[-1] <= 0.1
    assert "centroid" in [text.get_text() for text in place.get_legend().get_texts()]


def test_the_page_of_results_is_made_of_what_its_command_leaves(tmp_path):
    scripts = [Path(command[0]) for command in results.commands(tmp_path)]
    assert all(script.is_file() for script in scripts if script != Path("-m"))
    named = " ".join(" ".join(command) for command in results.commands(tmp_path))
    for source, page in results.PAGES.items():
        assert (results.ROOT / page).is_file()
        assert str(tmp_path / source.partition("/")[0]) in named
    read = (results.ROOT / "docs" / "results.rst").read_text()
    read += (results.ROOT / "README.md").read_text()
    assert all(page.removeprefix("docs/") in read for page in results.PAGES.values())


def test_the_page_of_results_is_copied_once_all_is_there(tmp_path, monkeypatch):
    monkeypatch.setattr(results, "ROOT", tmp_path)
    monkeypatch.setattr(results, "commands", lambda out: iter([["-c", "import sys; sys.exit(3)"]]))
    out = tmp_path / "out"
    assert results.main(["--out", str(out), "--docs"]) == 3
    monkeypatch.setattr(results, "commands", lambda out: iter([["-c", "pass"]]))
    for source, page in results.PAGES.items():
        for place in (out / source, tmp_path / page):
            place.parent.mkdir(parents=True, exist_ok=True)
        (out / source).write_text(source)
    assert results.main(["--out", str(out)]) == 0
    assert not any((tmp_path / page).exists() for page in results.PAGES.values())
    assert results.main(["--out", str(out), "--docs"]) == 0
    for source, page in results.PAGES.items():
        assert (tmp_path / page).read_text() == source
