"""A case from start to end, small: what it leaves in its folder."""

import dataclasses
import json
import os
import re
import shlex
import shutil
import subprocess
import sys
import textwrap
from pathlib import Path

import climber
import crawler
import numpy as np
import pytest
from walker import CASES, slanted_legs, walker

from mpmopt.app import case as one_case
from mpmopt.app.case import Case, resume, run
from mpmopt.app.script import main
from mpmopt.assess.threshold import pieces
from mpmopt.design.one_piece import OnePiece
from mpmopt.design.problem import Problem
from mpmopt.design.task import AtMost, Task
from mpmopt.design.terms import Volume
from mpmopt.design.variables import START
from mpmopt.errors import DesignError, RunFileError, StorageError
from mpmopt.optimisation.loop import optimise
from mpmopt.optimisation.presets import gait
from mpmopt.optimisation.settings import Settings, Stage
from mpmopt.results import runfile
from mpmopt.validation import digits
from mpmopt.view import plot
from mpmopt.view.live import ProgressBar, most_evaluations

SMALL = Case(
    walker(64, 8e-4),
    Settings(
        (Stage(0.5, 1e-2, 1e-3, 8e-4), Stage(4.0, 1e-2, 1e-3, 8e-4, solid=True)),
        least_iterations=12,
        most_iterations=15,
    ),
    slanted_legs,
)
TINY = Case(
    dataclasses.replace(SMALL.scene, steps=10),
    Settings(SMALL.settings.stages[:1], window=1, least_iterations=2, most_iterations=2),
    slanted_legs,
)
ROOT = Path(__file__).parent.parent


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    out = tmp_path_factory.mktemp("case") / "new" / "walker"
    return out, run(SMALL, out)


@pytest.mark.case
def test_a_small_walker_walks_even_without_its_void(folder):
    out, summary = folder
    assert summary["start"] == pytest.approx(13 / 64, abs=1e-9)
    assert summary["reference"] == pytest.approx(
        13 / 64, abs=1e-3
    )  # a solid reference design stays
    assert summary["baseline"] >= summary["reference"] + 0.05  # slanted legs do travel
    assert summary["optimised"] - summary["reference"] >= 0.08
    assert summary["post_processed"] - summary["reference"] >= 0.07
    assert summary["gain"]["as designed"] == pytest.approx(
        summary["post_processed"] - summary["reference"]
    )
    assert summary["actuation_off"] < summary["post_processed"]
    assert summary["failed_evaluations"] == 0
    kept = runfile.read_run(out / "run.h5").run
    there = kept.problem().gamma(kept.result.x) >= 0.3
    assert (
        summary["disconnected_particles"] == (pieces(kept.problem().scene, there) > 0).sum() <= 12
    )
    assert summary["evaluations"] <= 30


@pytest.mark.case
def test_a_small_crawler_crawls_even_without_its_void(tmp_path):
    case = Case(crawler.crawler(64, 8e-4), SMALL.settings, crawler.slanted_legs)
    summary = run(case, tmp_path)
    assert summary["start"] == pytest.approx(23 / 64, abs=1e-9)
    assert summary["actuation_off"] == pytest.approx(23 / 64, abs=1e-9)  # no gravity, no fall
    assert summary["reference"] == pytest.approx(23 / 64, abs=1e-3)
    assert summary["baseline"] >= summary["reference"] + 0.02
    assert summary["optimised"] - summary["reference"] >= 0.07
    assert summary["post_processed"] - summary["reference"] >= 0.06
    assert summary["failed_evaluations"] == 0


@pytest.mark.case
def test_a_small_climber_climbs_even_without_its_void(tmp_path):
    """By its own recipe, which is black and white: grey feet do not press enough to hold it."""
    scene = climber.climber(64, 1e-3, 2.0)
    recipe = gait(10, 0.005), climber.three_pairs, climber.START, climber.TASK
    summary = run(Case(scene, *recipe), tmp_path)
    assert 0.0 <= summary["start"] - 30 / 64 <= 0.03  # it stays where it is put
    assert summary["post_processed"] >= summary["start"] + 0.02
    assert summary["optimised"] - summary["reference"] >= 0.02
    assert summary["post_processed"] - summary["reference"] >= 0.015
    assert summary["disconnected_particles"] == 0
    assert summary["failed_evaluations"] == 0
    assert np.shape(summary["theta"]) == (3,)  # each core kept a phase of its own
    assert np.ptp(summary["theta"]) >= 0.15


def test_the_folder_holds_run_summary_and_pictures(folder):
    out, summary = folder
    names = {path.name for path in out.iterdir()}
    assert names == {"run.h5", "summary.json", "design.png", "history.png", "report.html"}
    assert json.loads((out / "summary.json").read_text()) == summary
    assert set(summary) >= {
        "start", "reference", "baseline", "optimised", "post_processed", "a", "theta", "b",
        "evaluations", "failed_evaluations", "halved_evaluations", "seconds", "stop_reason",
    }  # fmt: skip
    for picture in ("design.png", "history.png"):
        data = (out / picture).read_bytes()
        assert data.startswith(b"\x89PNG")
        assert len(data) >= 20_000
    kept = runfile.read_run(out / "run.h5")
    assert kept.summary == summary
    assert kept.run.scene == SMALL.scene
    assert kept.run.stop_reason == summary["stop_reason"]
    assert kept.run.problem().value(kept.run.result.x) == summary["optimised"]


def test_a_finished_run_is_left_as_it_is(folder):
    out, summary = folder
    before = (out / "run.h5").read_bytes()
    assert run(SMALL, out) == summary
    assert resume(out / "run.h5") == summary
    assert (out / "run.h5").read_bytes() == before


def test_a_run_of_another_case_is_never_overwritten(folder):
    out, _ = folder
    before = (out / "run.h5").read_bytes()
    another_start = dataclasses.replace(SMALL, start={"phi": 0.1, "a": 1.0, "theta": 0.0, "b": 0.0})
    with pytest.raises(StorageError, match="earlier run of another case"):
        run(another_start, out)
    other = dataclasses.replace(SMALL, scene=dataclasses.replace(SMALL.scene, steps=10))
    with pytest.raises(StorageError, match="earlier run of another case"):
        run(other, out)
    assert (out / "run.h5").read_bytes() == before


@pytest.mark.parametrize("how", ["the picture fails", "matplotlib cannot be imported"])
def test_a_picture_that_fails_spoils_no_run(tmp_path, caplog, monkeypatch, how):
    def fails(path, motion):
        raise RuntimeError("latex was not able to process the string\nwith a log\nof many lines")

    with monkeypatch.context() as patch:
        if how == "the picture fails":
            patch.setattr(plot, "_plot_motion", fails)
        else:
            patch.setitem(sys.modules, "mpmopt.view.plot", None)
        summary = run(TINY, tmp_path)
    first, *others = (message for message in caplog.messages if "png" in message)
    if how == "the picture fails":
        assert first == "no design.png: RuntimeError: latex was not able to process the string"
        assert not others and (tmp_path / "history.png").exists()
    else:
        assert first.startswith("no design.png: ModuleNotFoundError: ")
        assert len(others) == 1
    assert not (tmp_path / "design.png").exists()
    assert json.loads((tmp_path / "summary.json").read_text()) == summary
    assert runfile.read_run(tmp_path / "run.h5").summary == summary
    assert run(TINY, tmp_path) == resume(tmp_path / "run.h5") == summary


@pytest.mark.parametrize("full", [True, False])
def test_a_run_that_was_stopped_is_studied_as_it_would_have_been(tmp_path, monkeypatch, full):
    def stopped(begun, callbacks, checkpointing):
        callbacks[0](begun)
        raise KeyboardInterrupt

    def noted(result, baseline, full_study):
        asked.append(full_study)
        return {"evaluations": 0}

    asked: list[bool] = []
    monkeypatch.setattr(one_case, "RESULTS", ())
    monkeypatch.setattr(one_case, "summarise", noted)
    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr(one_case, "go_on", stopped)
        run(TINY, tmp_path, full_study=full)
    resume(tmp_path / "run.h5")
    assert asked == [full]


def test_a_start_is_filled_up_and_knows_its_names():
    assert dataclasses.replace(TINY, start={"b": 0.1}).start == {**START, "b": 0.1}
    with pytest.raises(DesignError, match="start has gamma"):
        dataclasses.replace(TINY, start={"gamma": 0.1})


def test_what_a_folder_holds_is_overwritten_only_by_force(tmp_path):
    (tmp_path / "design.png").write_text("somebody's")
    with pytest.raises(StorageError, match=r"design\.png is there already.*--force"):
        run(TINY, tmp_path)
    assert (tmp_path / "design.png").read_text() == "somebody's"
    assert [path.name for path in tmp_path.iterdir()] == ["design.png"]
    run(TINY, tmp_path, force=True)
    assert (tmp_path / "design.png").read_bytes().startswith(b"\x89PNG")
    (tmp_path / "run.h5").write_text("somebody's too")
    with pytest.raises(RunFileError, match="--force to replace it"):
        run(TINY, tmp_path)
    assert run(TINY, tmp_path, force=True)["evaluations"] == 2


def test_a_linked_run_is_written_where_the_link_leads(tmp_path):
    there, here = tmp_path / "there", tmp_path / "here"
    there.mkdir()
    here.mkdir()
    (here / "run.h5").symlink_to(there / "run.h5")
    (there / "design.png").write_text("somebody's")
    with pytest.raises(StorageError, match=r"there/design\.png is there already"):
        run(TINY, here)
    (there / "design.png").unlink()
    assert run(TINY, here) == resume(here / "run.h5")
    assert [path.name for path in here.iterdir()] == ["run.h5"]
    assert len(list(there.iterdir())) == 5
    assert (here / "run.h5").is_symlink()


def test_a_folder_that_cannot_be_made_is_a_storage_error(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(StorageError, match="cannot write to"):
        run(SMALL, tmp_path / "file" / "folder")


def test_the_command_prints_the_summary_or_an_error(tmp_path, capsys):
    cases = {"default": SMALL, "tiny": TINY}
    assert main("A case.", cases, ["--tiny", "--out", str(tmp_path)]) == 0
    printed = capsys.readouterr().out.splitlines()
    words = ["verdict", "displacement", "gain", "pieces", "chosen", "stopped", "files", "next"]
    assert [line.split()[0] for line in printed] == words
    assert all(len(line.split("  ")[0]) <= len("displacement") for line in printed)
    run = runfile.read_run(tmp_path / "run.h5").run
    assert run.origin == pytest.approx(13 / 64)
    assert f"evaluation {run.chosen} of 2, stage 1 of 1, beta 0.5" in printed[4]
    assert printed[6].endswith("report.html, run.h5, summary.json, design.png, history.png")
    assert shlex.split(printed[7].removeprefix("next"))[:4] == [
        sys.executable,
        "-m",
        "mpmopt",
        "film",
    ]
    assert main("A case.", cases, ["--out", str(tmp_path)]) == 1
    assert capsys.readouterr().err.startswith("StorageError: ")


def test_progress_becomes_log_lines_off_a_terminal(capsys):
    settings = Settings(SMALL.settings.stages[:1], window=1, most_iterations=20, tolerance=0.0)
    scene = dataclasses.replace(SMALL.scene, steps=10)
    start = Problem(scene).join(0.0, 1.0, -0.3, -0.5)
    optimise(scene, settings, start, [ProgressBar()])
    lines = capsys.readouterr().err.splitlines()
    assert [line.split(",")[0] for line in lines] == [
        "10 of 20 evaluations",
        "20 of 20 evaluations",
    ]
    assert "displacement" in lines[0] and "best" in lines[0] and "grey" in lines[0]


@pytest.mark.parametrize(
    ("bound", "said"), [(0.9, r"displacement (\S+), best (\S+),"), (1e-3, "none feasible, beta")]
)
def test_progress_tells_the_best_that_meets_all_constraints_in_a_short_line(bound, said, capsys):
    settings = Settings(SMALL.settings.stages[:1], window=1, most_iterations=10, tolerance=0.0)
    scene = dataclasses.replace(SMALL.scene, steps=10)
    task = Task(subject_to=(AtMost(Volume(), bound),))
    run = optimise(scene, settings, {}, [ProgressBar()], task=task)
    (line,) = capsys.readouterr().err.splitlines()
    found = re.search(said, line)
    assert found and len(line) + 10 < 100  # a thousand evaluations, for hours
    if found.groups():
        values = [i.objective for i in run.history if not i.violation]
        assert float(found[2]) == pytest.approx(max(values) - run.origin, rel=1e-2)


def test_progress_counts_what_was_before_and_tells_displacements(short_run, capsys):
    first = short_run.history[0]
    begun = dataclasses.replace(short_run, stop_reason="", stage=0, history=[first] * 10)
    ProgressBar()(begun)  # of a run that is gone on with
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith(f"10 of {most_evaluations(begun)} evaluations, ")
    assert f"displacement {digits(first.objective - begun.origin, 3)}, best " in line


def test_the_number_of_evaluations_is_known_from_the_stages(short_run):
    stages = SMALL.settings.stages
    stages = (*stages, dataclasses.replace(stages[1], most_iterations=7))
    settings = Settings(stages, least_iterations=5, most_iterations=20)
    first = short_run.history[0]
    history = [first, dataclasses.replace(first, failure="torn")]
    begun = dataclasses.replace(short_run, stage=0, settings=settings, history=history)
    assert most_evaluations(begun) == 2 + 19 + 20 + 7  # what failed is done again
    early = dataclasses.replace(begun, stage=1, history=[first] * 9)
    assert most_evaluations(early) == 9 + 20 + 7
    over = dataclasses.replace(begun, history=[first] * 25)  # five too many
    assert most_evaluations(over) == 25 + 20 + 7


def test_the_walkers_settings_are_those_of_the_design():
    preview, default, paper = (CASES[name] for name in ("preview", "default", "paper"))
    for case in (preview, default):
        assert (case.scene.grid.dx, case.scene.time_step) == (1 / 64, 1e-3)
        assert not case.scene.walls
        assert case.scene.ground
        (bound,) = case.task.subject_to
        assert isinstance(bound.term, OnePiece)
        assert len(case.task.scenes) == 3
        assert case.scene.formulation == "total"
        assert all(stage.subpixel for stage in case.settings.stages)
    assert [len(case.settings.stages) for case in (preview, default)] == [1, 3]
    assert default.scene.steps > preview.scene.steps
    assert not paper.scene.ground
    assert (paper.scene, paper.task) == (walker(128, 2e-4), Task())
    assert (paper.scene.grid.cells[0], paper.scene.steps) == (128, 5000)
    assert {(s.void_density, s.void_stiffness) for s in paper.settings.stages} == {(1e-3, 1e-3)}
    assert [s.beta for s in paper.settings.stages] == [0.5, 1.0, 2.0, 4.0, 8.0, 16.0]
    for case in CASES.values():
        for stage in case.settings.stages:
            stage.scene(case.scene)


def start_up(tmp_path, what, root=ROOT):
    environment = {**os.environ, "PYTHONPATH": f"{root}:{ROOT}/cases"}
    done = subprocess.run(
        [sys.executable, "-c", what], capture_output=True, text=True, env=environment,
        timeout=120, cwd=tmp_path,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    return done.stdout.split()


@pytest.mark.process
def test_importing_the_package_imports_nothing_heavy(tmp_path):
    modules = start_up(
        tmp_path, "import sys, mpmopt; from mpmopt import scene; print(*sys.modules)"
    )
    assert not {"numba", "scipy", "h5py", "matplotlib"} & set(modules)


FALL = """
import sys
import numpy as np
from mpmopt import kernels
from mpmopt.io.console import reported
from mpmopt.scene.particles import discretise
from mpmopt.design.problem import Problem
from mpmopt.scene import Grid, Scene, Solid
scene = Scene(Grid((8, 8), 0.125), 1e-2, 10, gravity=(1.0, 0.0),
              body=(Solid((0.25, 0.25), (0.5, 0.5)),))
start = discretise(scene).position[:, 0].mean()
stats = kernels.advance.stats
def value():
    return Problem(scene, halvings=0, limits=None).value(np.empty(0))
sys.exit(reported(lambda: print((value() - start).hex(),
                                sum(stats.cache_hits.values()), sum(stats.cache_misses.values())),
                  lambda: ""))
"""


@pytest.mark.cache
def test_kernels_come_from_the_cache_to_the_same_bits_but_never_once_edited(tmp_path, monkeypatch):
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "cache"))
    shutil.copytree(ROOT / "mpmopt", tmp_path / "mpmopt")
    cold, *compiled = start_up(tmp_path, FALL, tmp_path)
    assert compiled == ["0", "1"]
    warm, *loaded = start_up(tmp_path, FALL, tmp_path)
    assert loaded == ["1", "0"]
    assert warm == cold
    kernels = tmp_path / "mpmopt" / "kernels" / "grid.py"
    text = kernels.read_text()
    gravity = "fused(grid[node, 0], per_m, parameters.dt * parameters.gravity_x),\n"
    assert text.count(gravity) == 1
    kernels.write_text(
        text.replace(gravity, gravity.replace("parameters.dt *", "2.0 * parameters.dt *"))
    )
    edited, *_ = start_up(tmp_path, FALL, tmp_path)
    assert float.fromhex(cold) > 0.0
    assert float.fromhex(edited) == pytest.approx(2.0 * float.fromhex(cold), rel=1e-12)
    for index in (tmp_path / "cache").rglob("*.nbi"):
        os.truncate(index, 0)
    with pytest.raises(AssertionError, match=r"^EOFError: .* remove its \*\.nbi files"):
        start_up(tmp_path, FALL, tmp_path)


@pytest.mark.case
def test_the_example_of_the_dozen_names_goes_farther(capsys):
    text = (ROOT / "docs" / "api.rst").read_text()
    example = re.split(r"^\S", text.split(".. code-block:: python\n")[1], flags=re.MULTILINE)[0]
    exec(compile(textwrap.dedent(example), "api.rst", "exec"), {})
    before, after = (float(part) for part in capsys.readouterr().out.split(" -> "))
    assert after >= before + 0.05


PAPER = """
from pathlib import Path
from walker import CASES
from mpmopt.design.problem import Problem
stage = CASES["paper"].settings.stages[0]
problem = Problem(stage.scene(CASES["paper"].scene), stage.beta)
problem.value_and_gradient(problem.join(0.1, 1.0, -0.3, -0.5))
# Not ru_maxrss, which a process inherits from the one that started it.
status = Path("/proc/self/status").read_text().splitlines()
peak = next(int(line.split()[1]) for line in status if line.startswith("VmHWM"))
print(problem.scene.steps, peak // 1000)
"""


@pytest.mark.process
@pytest.mark.skipif(not Path("/proc/self/status").exists(), reason="only Linux tells")
def test_a_gradient_of_the_papers_size_needs_less_than_half_a_gigabyte(tmp_path):
    steps, megabytes = start_up(tmp_path, PAPER)
    assert int(steps) == 5000
    assert int(megabytes) <= 500
