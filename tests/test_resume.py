"""A run that is stopped anywhere goes on, bit for bit, as if it had not been."""

import ctypes
import dataclasses
import os
import random
import signal
import subprocess
import sys
import time
from pathlib import Path
from uuid import uuid4

import faults
import h5py
import numpy as np
import pytest
from conftest import small_scene

from mpmopt.app.script import main
from mpmopt.design.problem import Problem
from mpmopt.errors import SimulationError, StorageError
from mpmopt.io.checksums import sealed
from mpmopt.io.console import Interrupted, how_to_go_on, interruptible, reported
from mpmopt.io.files import locked, replace_file
from mpmopt.optimisation.loop import go_on, optimise
from mpmopt.optimisation.settings import Settings, Stage
from mpmopt.results import runfile

STAGES = (
    Stage(0.5, 1e-2, 1e-3, 4e-3),
    Stage(2.0, 1e-2, 1e-3, 4e-3, solid=True),
    Stage(8.0, 1e-2, 1e-3, 2e-3, solid=True, void_cutoff=0.1),
)
SETTINGS = Settings(STAGES, window=1, least_iterations=4, most_iterations=4)


@pytest.fixture
def fails(monkeypatch):
    """Evaluations fail by their design, so that a second process sees the same: some in the middle,
    and the first of the last stage until its step is halved."""
    real = Problem.evaluate

    def evaluate(self, x):
        first_of_last = self.chain.beta == 8.0 and self.scene.time_step > 1e-3
        if first_of_last or int(1e6 * abs(x[5])) % 5 == 1:
            raise SimulationError("made to fail", 3, 1, (0.0, 0.0), "none")
        return real(self, x)

    monkeypatch.setattr(Problem, "evaluate", evaluate)


@pytest.mark.case
def test_an_optimisation_goes_on_from_any_evaluation(fails, tmp_path):
    scene = small_scene(steps=30)
    problem = Problem(scene)
    start = problem.join(0.01, 1.0, 0.2, -0.5)
    paths: list[Path] = []

    def save(run):
        paths.append(tmp_path / f"{len(paths)}.h5")
        runfile.write(paths[-1], run)

    whole = optimise(scene, SETTINGS, start, [save])
    assert 0 < whole.failed_evaluations < len(whole.history)
    assert whole.history[-1].time_step == 1e-3
    wanted = faults.content(paths[-1])
    for path in paths:
        back = runfile.read_run(path)
        again = go_on(back.run)
        runfile.write(tmp_path / "again.h5", again)
        assert faults.content(tmp_path / "again.h5") == wanted, path.name
        seconds = [item.seconds for item in again.history]
        assert seconds == sorted(seconds)


def test_all_that_a_run_is_comes_back_from_its_file(fails, tmp_path):
    scene = small_scene(steps=30)
    run = optimise(scene, SETTINGS, Problem(scene).join(0.0, 1.0, 0.1, 0.0))
    runfile.write(tmp_path / "run.h5", run)
    runfile.write(tmp_path / "again.h5", runfile.read_run(tmp_path / "run.h5").run)
    assert (tmp_path / "run.h5").read_bytes() == (tmp_path / "again.h5").read_bytes()


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    return faults.finished(tmp_path_factory.mktemp("whole") / "out")


@pytest.mark.process
def test_a_killed_run_ends_as_it_would_have(whole, tmp_path):
    rows = faults.kills(tmp_path, whole, 3, random.Random(1))
    assert sum(row.done for row in rows) == 3
    assert all(row.survived == row.done for row in rows), rows


@pytest.mark.process
def test_a_run_in_three_scenes_ends_as_it_would_have_for_any_threads_and_kills(tmp_path):
    rows = faults.ensembles(tmp_path, 2, random.Random(3))
    assert sum(row.done for row in rows) == 2 + 2
    assert all(row.survived == row.done for row in rows), rows


@pytest.mark.process
@pytest.mark.parametrize(("number", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_a_signal_ends_a_run_with_its_code_and_says_how_to_go_on(whole, tmp_path, number, code):
    process = faults.Process(tmp_path / "out")
    assert process.wait_for("reverse")
    found, text = process.end(number)
    assert found == code
    assert (
        f"{number.name}. Every evaluation is saved; go on with: {sys.executable} -m mpmopt resume"
        in text
    )
    assert "Traceback" not in text
    assert faults.resumed(tmp_path / "out") == whole


LEAVES = """
import time
from mpmopt.io.console import interruptible
with interruptible():
    try:
        print("at work", flush=True)
        time.sleep(60)
    finally:
        print("leaving", flush=True)
        time.sleep(60)
"""


@pytest.mark.process
@pytest.mark.parametrize("second", [signal.SIGINT, signal.SIGTERM])
def test_a_second_signal_ends_the_process_at_once(second):
    process = subprocess.Popen([sys.executable, "-c", LEAVES], stdout=subprocess.PIPE, text=True)
    assert process.stdout is not None
    for said, number in (("at work\n", signal.SIGTERM), ("leaving\n", second)):
        assert process.stdout.readline() == said
        process.send_signal(number)
    process.communicate(timeout=50)
    assert process.returncode == -second


@ctypes.CFUNCTYPE(None)
def callback():  # as a compiler has them
    os.kill(os.getpid(), signal.SIGTERM)


def test_a_signal_that_a_library_swallows_comes_again(capfd):
    with pytest.raises(Interrupted, match="SIGTERM"), interruptible():
        callback()
        time.sleep(20)
    assert capfd.readouterr().err == ""


def test_a_signal_that_a_library_swallows_is_not_lost(capfd):
    with pytest.raises(Interrupted, match="SIGTERM"), interruptible():
        callback()
        raise RuntimeError("no compiled object yet")
    assert capfd.readouterr().err == ""


def test_a_signal_that_a_library_swallows_counts_if_the_work_ends_at_once(capfd):
    with pytest.raises(Interrupted, match="SIGTERM"), interruptible():
        callback()
    assert capfd.readouterr().err == ""


@pytest.mark.process
def test_a_signal_ends_going_on_too_and_says_how_to_go_on(whole, tmp_path):
    process = faults.Process(tmp_path / "out")
    assert process.wait_for("reverse")
    process.end(signal.SIGKILL)
    file = tmp_path / "out" / "run.h5"
    before = file.stat().st_mtime_ns
    command = [sys.executable, "-m", "mpmopt", "resume", str(file)]
    going_on = subprocess.Popen(command, stderr=subprocess.PIPE, text=True)
    until = time.monotonic() + 50.0
    while file.stat().st_mtime_ns == before and time.monotonic() < until:
        time.sleep(0.01)
    going_on.send_signal(signal.SIGTERM)
    _, text = going_on.communicate(timeout=50)
    assert going_on.returncode == 143
    assert f"go on with: {sys.executable} -m mpmopt resume {file}\n" in text
    assert faults.resumed(tmp_path / "out") == whole


def test_the_advice_can_be_typed_and_is_true(tmp_path):
    path = tmp_path / "my run" / "run.h5"
    assert how_to_go_on(path) == "Nothing was computed yet; the same command begins anew."
    path.parent.mkdir()
    path.touch()
    assert how_to_go_on(path).endswith(f"mpmopt resume '{path}'")


def test_signals_are_given_back():
    before = signal.getsignal(signal.SIGINT), signal.getsignal(signal.SIGTERM)
    with pytest.raises(Interrupted, match="SIGTERM"), interruptible():
        os.kill(os.getpid(), signal.SIGTERM)
    assert (signal.getsignal(signal.SIGINT), signal.getsignal(signal.SIGTERM)) == before


def test_an_error_is_one_line_and_exit_code_one(capsys):
    def refuse():
        raise StorageError("no room")

    assert reported(refuse, lambda: "Go on.") == 1
    assert capsys.readouterr().err == "StorageError: no room\n"


@pytest.mark.process
def test_a_write_that_fails_loses_nothing_that_was_saved(whole, tmp_path):
    rows = faults.full_disk(tmp_path, whole, 1, random.Random(2))
    assert all(row.survived == row.done for row in rows), rows


@pytest.mark.process
def test_scratch_files_on_disk_have_no_name_and_know_when_they_are_damaged(whole, tmp_path):
    rows = faults.scratch(tmp_path, whole)
    assert all(row.survived == row.done for row in rows), rows


@pytest.mark.process
def test_a_second_process_on_a_run_is_refused(whole, tmp_path):
    first = faults.Process(tmp_path / "out")
    assert first.wait_for("forward")
    code, text = faults.Process(tmp_path / "out").end()
    assert code == 1
    assert "StorageError: another process is at work" in text
    assert first.end()[0] == 0
    assert faults.content(tmp_path / "out" / "run.h5") == whole


def test_a_lock_ends_and_leaves_nothing(tmp_path):
    (tmp_path / f".run.h5-{uuid4().hex}").write_text("half a file")
    for name in (f".other.h5-{uuid4().hex}", ".run.h5-backup"):
        (tmp_path / name).write_text("somebody's")
    path = tmp_path / "run.h5"
    with locked(path), pytest.raises(StorageError, match="another process"), locked(path):
        pass
    with locked(path):
        replace_file(path, b"1")
    *others, mine = sorted(item.name for item in tmp_path.iterdir())
    assert [name.partition("-")[0] for name in others] == [".other.h5", ".run.h5"]
    assert (others[1], mine) == (".run.h5-backup", "run.h5")


@pytest.mark.parametrize(("umask", "mode"), [(0o022, 0o644), (0o077, 0o600)])
def test_files_are_as_private_as_the_user_has_them(tmp_path, umask, mode):
    before = os.umask(umask)
    try:
        replace_file(tmp_path / "run.h5", b"1")
    finally:
        os.umask(before)
    assert (tmp_path / "run.h5").stat().st_mode & 0o777 == mode


@pytest.mark.process
def test_resume_of_no_run_is_an_error(tmp_path, capsys):
    command = [sys.executable, "-m", "mpmopt", "resume", str(tmp_path / "no" / "run.h5")]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 1
    assert done.stderr.startswith("RunFileError: ") and "is not there" in done.stderr


def test_other_versions_are_warned_of(tmp_path, caplog, monkeypatch):
    tiny = dataclasses.replace(
        faults.SMALL,
        scene=dataclasses.replace(faults.SMALL.scene, steps=10),
        settings=Settings((Stage(1.0, 1e-2, 1e-3, 8e-4),), window=1, least_iterations=2,
                          most_iterations=2),
    )  # fmt: skip
    arguments = ["--out", str(tmp_path)]
    assert main("A case.", {"default": tiny}, arguments) == 0
    path = tmp_path / "run.h5"
    with h5py.File(path, "r+") as file:
        file.attrs["summary"] = "{}"
        file.attrs["versions"] = '{"numba": "0.1"}'
    path.write_bytes(sealed(path.read_bytes()))
    assert main("A case.", {"default": tiny}, arguments) == 0
    assert "digits may differ" in caplog.text
    assert np.isfinite(runfile.read_run(tmp_path / "run.h5").summary["optimised"])
