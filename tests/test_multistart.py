"""Several starts: the field they begin with, what they leave, and which is the best."""

import collections
import contextlib
import csv
import dataclasses
import json
import math
import shutil
import signal
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import climber
import numpy as np
import pytest
from walker import slanted_legs, walker

from mpmopt.app import multistart
from mpmopt.app.case import Case, run
from mpmopt.app.multistart import best_of, report
from mpmopt.app.script import main
from mpmopt.app.sweeps import sweep
from mpmopt.assess.refinement import study
from mpmopt.errors import StorageError, SweepError
from mpmopt.io.console import Interrupted
from mpmopt.io.files import locked
from mpmopt.optimisation.settings import Settings, Stage
from mpmopt.optimisation.starts import random_start
from mpmopt.results import runfile

SCENE = walker(64, 8e-4)
SIDE = 20 / 64  # the longest of the walker's design domain


def row(start, gain, refined):
    return {
        "start": start, "post_processed": 0.2 + gain, "gain": gain, "retained_half_step": 1.0,
        "retained_half_cells": refined / gain, "refined_gain": refined, "disconnected_particles": 0,
        "failed_evaluations": 0, "seconds": 1.0,
    }  # fmt: skip


def test_the_best_is_named_after_its_refinement_study():
    rows = [row(0, 0.3, 0.1), row(1, 0.2, 0.19), row(2, 0.4, math.nan), row(3, 0.1, 0.1)]
    assert best_of(rows)["start"] == 1
    assert best_of(rows[2:3])["start"] == 2
    lines = report(rows).splitlines()
    assert lines[-1] == "best after its refinement study: start-1, gain 0.190"
    assert lines[-3].startswith("gain: 0.100 to 0.400, median 0.250")
    assert lines[-2].startswith("refined gain: 0.100 to 0.190, median 0.100")
    assert len({len(line) for line in lines[:5]}) == 1


TINY = Case(
    dataclasses.replace(SCENE, steps=60),
    Settings(
        (Stage(4.0, 1e-2, 1e-3, 8e-4, solid=True),),
        window=1, least_iterations=2, most_iterations=2,
    ),
    slanted_legs,
)  # fmt: skip


@pytest.fixture
def here(monkeypatch):
    """Starts run in a thread of this process."""
    with ThreadPoolExecutor(1) as executor:
        monkeypatch.setattr(multistart, "connected", lambda _: contextlib.nullcontext(executor))
        yield


@pytest.mark.process
def test_starts_leave_their_runs_and_are_run_once(tmp_path, capsys, caplog):
    def command(starts):
        assert main("A case.", {"default": TINY}, ["--out", str(tmp_path), *starts]) == 0
        return capsys.readouterr().out

    first = command(["--starts", "1"])
    kept = [tmp_path / f"start-{k}" / "run.h5" for k in range(2)]
    before = kept[0].stat().st_mtime_ns
    second = command(["--starts", "2"])
    assert kept[0].stat().st_mtime_ns == before
    assert second.splitlines()[1] == first.splitlines()[1]
    with (tmp_path / "starts.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [line["start"] for line in rows] == ["0", "1"]
    for number, line in enumerate(rows):
        summary = json.loads((kept[number].parent / "summary.json").read_text())
        assert runfile.read_run(kept[number]).summary == summary
        gain = summary["post_processed"] - summary["reference"]
        assert float(line["gain"]) == pytest.approx(gain, rel=1e-3)
    last = runfile.read_run(kept[1]).run
    gains = {
        row.name: row.distance - max(row.reference, summary["reference"])
        for row in study(last.problem(), last.result.x)
    }
    del gains["twice the step"]
    assert float(line["refined gain"]) == pytest.approx(min(gains.values()), rel=1e-3)
    assert len({line["optimised"] for line in rows}) == 2
    (tmp_path / "starts.png").unlink()
    shutil.rmtree(tmp_path / "start-0")
    assert command(["--starts", "2"]) == second
    assert (tmp_path / "starts.png").read_bytes().startswith(b"\x89PNG")
    assert "no picture of start 0's design" in caplog.text
    assert "start 1" not in caplog.text


@pytest.mark.case
def test_the_plain_start_is_that_of_the_case(tmp_path, here):
    case = Case(
        dataclasses.replace(climber.climber(64, 8e-4, 2.0), steps=5, transient=0.0), TINY.settings,
        climber.three_pairs, climber.START,
    )  # fmt: skip
    run(case, tmp_path / "alone")
    multistart.multistart(case, tmp_path, 1)
    firsts: list[Any] = [
        runfile.read_run(tmp_path / name / "run.h5").run.first for name in ("alone", "start-0")
    ]
    alone, start = (first.x for first in firsts)
    assert np.array_equal(start, alone)
    assert {-0.8, -0.5, -0.7} <= set(start)


def test_only_random_starts_are_disturbed(tmp_path, monkeypatch, rng):
    gain = dict.fromkeys(("as designed", "half the step", "cells half as wide"), 0.1)
    summary: Any = collections.defaultdict(float, gain=gain, retained_gain=gain)
    given: list[Any] = []

    def run(case, folder, phi=None):
        given.append(phi)
        return summary

    monkeypatch.setattr(multistart, "run", run)
    for seed in (0, 1):
        multistart.one_start(
            SCENE.to_json(), dataclasses.asdict(TINY.settings), {**TINY.start, "phi": 0.25},
            TINY.task.to_json(), seed,
            baseline=slanted_legs, out=tmp_path,
        )  # fmt: skip
    own, disturbed = given
    position = rng.uniform(0.2, 0.4, (20, 2))
    assert own is None
    noise = random_start(SCENE, 1)(position)
    assert np.array_equal(disturbed(position), np.clip(0.25 + noise, -1.0, 1.0))


def test_a_loss_is_not_scaled(tmp_path, monkeypatch):
    gain: dict[str, Any] = {"as designed": -0.1, "half the step": -0.05, "twice the step": -9.0,
            "cells half as wide": -0.2}  # fmt: skip
    summary: Any = collections.defaultdict(float, gain=gain, retained_gain=gain)
    monkeypatch.setattr(multistart, "run", lambda *_, **__: summary)

    def refined():
        return multistart.one_start(
            SCENE.to_json(), dataclasses.asdict(TINY.settings), dict(TINY.start),
            TINY.task.to_json(), 0,
            baseline=slanted_legs, out=tmp_path,
        )["refined_gain"]  # fmt: skip

    assert refined() == -0.2
    gain["half the step"] = None
    assert math.isnan(refined())


@pytest.mark.case
def test_force_begins_anew_once_however_often_a_start_is_tried(tmp_path, here, monkeypatch):
    multistart.multistart(TINY, tmp_path, 1)
    log = tmp_path / "start-0" / "log.txt"
    assert "finished run" not in log.read_text()

    def tried_twice(function, points, *others):
        function(**points[0])  # in a process that dies before it can answer
        return sweep(function, points, *others)

    monkeypatch.setattr(multistart, "sweep", tried_twice)
    multistart.multistart(TINY, tmp_path, 1, force=True)
    assert log.read_text().count("holds a finished run") == 1


def test_force_removes_nothing_that_it_cannot_replace(tmp_path):
    files = [tmp_path / "starts.h5", tmp_path / "start-1" / "run.h5"]
    files[1].parent.mkdir()
    for file in files:
        file.write_text("somebody's work")
    for file in files:
        with locked(file), pytest.raises(StorageError, match="another process is at work"):
            multistart.multistart(TINY, tmp_path, 2, force=True)
    pytest.importorskip("distributed")
    with pytest.raises(SweepError, match="nonsense"):
        multistart.multistart(TINY, tmp_path, 2, scheduler="nonsense://here:1", force=True)
    assert [file.read_text() for file in files] == 2 * ["somebody's work"]


def test_tables_without_their_starts_are_replaced_only_by_force(tmp_path):
    table = tmp_path / "starts.csv"
    table.write_text("somebody's")
    with pytest.raises(StorageError, match=r"starts\.csv is there already.*--force"):
        multistart.multistart(TINY, tmp_path, 1)
    assert [(path.name, path.read_text()) for path in tmp_path.iterdir()] == [
        ("starts.csv", "somebody's")
    ]


def test_who_interrupts_is_told_to_go_on_without_force(tmp_path, capsys, monkeypatch):
    def stopped(*_):
        raise Interrupted(signal.SIGINT)

    monkeypatch.setattr(multistart, "multistart", stopped)
    arguments = ["--out", str(tmp_path), "--starts", "2", "--force"]
    assert main("A case.", {"default": TINY}, arguments) == 130
    assert "the same command without --force goes on" in capsys.readouterr().err


@pytest.mark.parametrize("wrong", [["--starts", "0"], ["--scheduler", "tcp://here:1"]])
def test_starts_and_scheduler_must_make_sense(tmp_path, capsys, wrong):
    with pytest.raises(SystemExit, match="2"):
        main("A case.", {"default": TINY}, ["--out", str(tmp_path), *wrong])
    assert wrong[0] in capsys.readouterr().err


def test_what_is_no_number_is_shown_as_none():
    without = {**row(0, 0.3, math.nan), "retained_half_step": math.nan}
    lines = report([without]).splitlines()
    assert "nan" not in "".join(lines)
    assert lines[1].count(" -") == 3
    assert len(lines[0]) == len(lines[1])
    assert lines[-1] == "best after its refinement study: start-0, which has no refined gain"
