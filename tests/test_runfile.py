"""The file that a run leaves: complete, readable, or refused."""

import dataclasses
import resource
import subprocess
import sys
from pathlib import Path

import h5py
import numpy as np
import pytest
from conftest import small_scene

from mpmopt.__main__ import main
from mpmopt.app.case import resume
from mpmopt.assess.threshold import post_processed
from mpmopt.design.problem import Problem
from mpmopt.errors import DesignError, RunFileError, StorageError
from mpmopt.io.checksums import sealed
from mpmopt.optimisation.loop import optimise
from mpmopt.optimisation.settings import Settings, Stage
from mpmopt.results import runfile

STAGES = (Stage(0.5, 1e-2, 1e-3, 4e-3), Stage(2.0, 5e-3, 1e-3, 4e-3, solid=True))


@pytest.fixture(scope="module")
def run():
    scene = small_scene(steps=20)
    settings = Settings(STAGES, window=2, least_iterations=3, most_iterations=4)
    return optimise(scene, settings, Problem(scene).join(0.0, 1.0, -0.3, -0.5))


@pytest.fixture
def path(run, tmp_path):
    path = tmp_path / "run.h5"
    runfile.write(path, run)
    return path


def test_a_run_is_read_back_as_it_was(run, path):
    found = runfile.read_run(path)
    assert found.summary == {}
    assert set(found.versions) == {"mpmopt", "python", "numba", "numpy", "scipy", "h5py"}
    back = found.run
    assert back.scene == run.scene
    assert back.settings == run.settings
    assert back.stop_reason == run.stop_reason
    for one, other in zip(back.history, run.history, strict=True):
        assert repr(one) == repr(other)
    assert set(back.best) == {0, 1}
    for stage, item in run.best.items():
        assert np.array_equal(back.best[stage].x, item.x)
    assert back.problem().value(back.result.x) == run.result.objective


def test_a_halved_time_step_is_remembered(run, tmp_path):
    best = {0: dataclasses.replace(run.best[0], time_step=2e-3)}
    runfile.write(tmp_path / "run.h5", dataclasses.replace(run, best=best))
    assert runfile.read_run(tmp_path / "run.h5").run.problem().scene.time_step == 2e-3


def test_the_best_design_is_there_by_name(run, path):
    with h5py.File(path) as file:
        best = {name: values[()] for name, values in file["best"].items()}
    assert np.array_equal(np.concatenate([best[k] for k in ("phi", "a", "theta", "b")]),
                          run.result.x)  # fmt: skip
    assert np.array_equal(best["gamma"], run.result.gamma)
    assert all(values.dtype == np.float64 for values in best.values())


def test_an_unfinished_run_can_be_read(run, tmp_path):
    path = tmp_path / "run.h5"
    stopped = dataclasses.replace(run, history=run.history[:1], best={}, stop_reason="")
    runfile.write(path, stopped)
    back = runfile.read_run(path).run
    assert back.best == {}
    assert back.stop_reason == ""
    with pytest.raises(DesignError, match="no design: no evaluation succeeded"):
        _ = back.result


def test_writing_again_replaces_the_file_and_leaves_nothing_else(run, path):
    runfile.write(path, run)
    assert [file.name for file in path.parent.iterdir()] == ["run.h5"]


def damaged(path, change, seal=True):
    """A run file that was changed; sealed again, so that its digest does not tell."""
    with h5py.File(path, "r+") as file:
        change(file)
    if seal:
        path.write_bytes(sealed(path.read_bytes()))
    return path


@pytest.mark.parametrize(
    "change",
    [
        lambda f: f.attrs.update(format="other"),
        lambda f: f.attrs.update(version=99),
        lambda f: f.attrs.update(scene="{}"),
        lambda f: f.attrs.update(scene="no JSON"),
        lambda f: f.attrs.update(settings="[]"),
        lambda f: f.attrs.update(settings='{"stages": []}'),
        lambda f: f.attrs.update(settings='{"stages": [], "speed": 3}'),
        lambda f: f.attrs.update(settings=f.attrs["settings"].replace("0.5", '"x"')),
        lambda f: f.move("stages/1", "stages/7"),
        lambda f: (f["history"].pop("beta"), f.create_dataset("history/beta", data=[1.0])),
        lambda f: f.attrs.pop("settings"),
        lambda f: f.pop("history/objective"),
        lambda f: f.create_group("stages/x"),
        lambda f: f["stages/0"].pop("x"),
        lambda f: (
            f["stages/0"].pop("x"),
            f.create_dataset("stages/0/x", data=["a"]),
        ),
        lambda f: (f["history"].pop("beta"), f.create_dataset("history/beta", data=[[1.0]])),
    ],
)
def test_a_damaged_run_file_is_refused(path, change):
    with pytest.raises(RunFileError, match=r"run\.h5"):
        runfile.read_run(damaged(path, change))


@pytest.mark.parametrize(
    "change",
    [
        lambda f: f["stages/0/x"].write_direct(np.nextafter(f["stages/0/x"][:], 2.0)),
        lambda f: f.attrs.update(stop_reason="other"),
        lambda f: f["last"].attrs.update(objective=9.0),
        lambda f: f.pop("best"),
        lambda f: f.create_group("new"),
    ],
)
def test_whatever_changed_since_it_was_written_is_noticed(path, change):
    with pytest.raises(RunFileError, match=r"run\.h5.*dig"):
        runfile.read_run(damaged(path, change, seal=False))


def test_hdf5_never_sees_a_file_of_which_a_byte_changed(path, monkeypatch):
    content = path.read_bytes()
    monkeypatch.setattr(h5py, "File", lambda *_, **__: pytest.fail("it was opened"))
    for place in range(0, len(content), 997):
        changed = bytearray(content)
        changed[place] ^= 1 << (place % 8)
        path.write_bytes(changed)
        with pytest.raises(RunFileError, match=r"run\.h5.*digest"):
            runfile.read_run(path)


def replaced(name, *arguments, **options):
    def change(file):
        file.pop(name)
        file.create_dataset(name, *arguments, **options)

    return change


def linked(name, link):
    def change(file):
        file.pop(name)
        file[name] = link

    return change


def virtual(file):
    layout = h5py.VirtualLayout(shape=(3,), dtype="f8")
    layout[:] = h5py.VirtualSource("elsewhere.h5", "x", shape=(3,))
    file.pop("last/x")
    file.create_virtual_dataset("last/x", layout)


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (linked("last/x", h5py.SoftLink("/first/x")), "/last/x leads elsewhere: SoftLink"),
        (linked("last", h5py.ExternalLink("o.h5", "/")), "/last leads elsewhere: ExternalLink"),
        (lambda f: f.update({"last/again": f["stages"]}), "has another name too"),
        (replaced("last/x", (3,), h5py.ref_dtype), "/last/x holds neither numbers nor text"),
        (replaced("last/x", (3,), h5py.vlen_dtype(float)), "neither numbers nor text"),
        (replaced("last/x", data=np.zeros(3, [("a", "f8")])), "neither numbers nor text"),
        (replaced("last/x", (10**12,), "f8", chunks=(1024,)), "not stored in one piece"),
        (replaced("last/x", (10**12,), "f8"), "claims 8000000000000 bytes of a file that has"),
        (replaced("last/x", (3,), "f8", external=[("/etc/passwd", 0, 24)]), "in another file"),
        (virtual, "not stored in one piece"),
        (lambda f: f.attrs.update(scene=np.zeros(9)), "attribute scene of / is neither"),
        (lambda f: f.attrs.create("stage", f.ref, dtype=h5py.ref_dtype), "attribute stage of / is"),
        (lambda f: f.attrs.update(settings=100000 * "["), "recursion"),
        (
            lambda f: (
                f.create_group("stage").attrs.update(time_step=1.0, failures=0),
                f["stage"].update(
                    {"values": [], "gradients": [[1.0]], "incumbent_gradients": [[]]}
                ),
                f["stage"].create_group("mma"),
            ),
            "do not fit together",
        ),
    ],
)
def test_what_no_run_file_holds_is_refused_before_it_is_read(path, change, says):
    with pytest.raises(RunFileError, match=says):
        runfile.read_run(damaged(path, change))


def test_a_file_that_is_far_too_large_is_not_read(path):
    with path.open("r+b") as file:
        file.truncate(10**13)  # without content
    with pytest.raises(RunFileError, match="has 10000000000000 bytes, more than 1e"):
        runfile.read_run(path)


def test_a_file_that_would_be_too_large_to_be_read_is_not_written(run, path, monkeypatch):
    before = path.read_bytes()
    monkeypatch.setattr(runfile, "LARGEST", len(before))
    runfile.write(path, run)
    monkeypatch.setattr(runfile, "LARGEST", len(before) - 1)
    with pytest.raises(StorageError, match="nothing reads back"):
        runfile.write(path, run)
    assert path.read_bytes() == before


@pytest.mark.parametrize("share", [0.0, 0.3, 0.9, 0.999])
def test_a_truncated_run_file_is_refused(path, share):
    data = path.read_bytes()
    path.write_bytes(data[: int(share * len(data))])
    with pytest.raises(RunFileError, match=r"run\.h5"):
        runfile.read_run(path)


def test_what_is_no_run_file_is_refused(tmp_path):
    with pytest.raises(RunFileError, match="not there"):
        runfile.read_run(tmp_path / "run.h5")
    with h5py.File(tmp_path / "other.h5", "w") as file:
        file["x"] = 1.0
    with pytest.raises(RunFileError, match="no run file"):
        runfile.read_run(tmp_path / "other.h5")


@pytest.mark.skipif(not hasattr(resource, "RLIMIT_FSIZE"), reason="needs a file-size limit")
def test_a_full_disk_loses_nothing_that_was_written(run, path):
    before = path.read_bytes()
    limit = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (6000, limit[1]))
    try:
        with pytest.raises(StorageError, match="make room"):
            runfile.write(path, run)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limit)
    assert path.read_bytes() == before
    assert [file.name for file in path.parent.iterdir()] == ["run.h5"]


def test_a_folder_that_is_not_there_is_a_storage_error(run, tmp_path):
    with pytest.raises(StorageError, match="nowhere"):
        runfile.write(tmp_path / "nowhere" / "run.h5", run)


def command(*arguments):
    """``python -m mpmopt`` as a process of its own."""
    return subprocess.run(
        [sys.executable, "-m", "mpmopt", *map(str, arguments)],
        capture_output=True, text=True, timeout=120, cwd=Path(__file__).parent.parent,
    )  # fmt: skip


@pytest.mark.process
def test_verify_prints_its_checks_and_passes(path):
    done = command("verify", path)
    assert done.returncode == 0, done.stderr
    lines = done.stdout.splitlines()
    assert lines[-1] == f"{len(lines) - 1} of {len(lines) - 1} checks passed"
    for name in ("dot product: p2g", "complex step: phi along direction 0", "Taylor order"):
        assert any(line.startswith(name) for line in lines)


@pytest.mark.process
def test_verify_of_no_run_file_says_so_and_fails(tmp_path):
    done = command("verify", tmp_path / "run.h5")
    assert done.returncode == 1
    assert done.stderr.startswith("RunFileError: ")
    assert "Traceback" not in done.stderr


@pytest.mark.process
def test_postprocess_prints_the_share_of_the_retained_gain(run, path):
    done = command("postprocess", path, "--threshold", "0.4")
    assert done.returncode == 0, done.stderr
    assert f"optimised                {run.result.objective:.4f}" in done.stdout
    problem = run.problem()
    value = post_processed(problem, run.result.x, 0.4)
    assert f"post-processed           {value:.4f}  (gamma >= 0.4" in done.stdout
    assert f"{(problem.gamma(run.result.x) >= 0.4).sum()} of 32" in done.stdout
    assert "retained gain" in done.stdout
    assert "hanging on nothing" in done.stdout


@pytest.mark.parametrize("threshold", ["nan", "2", "0", "-1"])
def test_postprocess_refuses_a_threshold_that_makes_no_sense(path, capsys, threshold):
    assert main(["postprocess", str(path), "--threshold", threshold]) == 1
    said = capsys.readouterr()
    assert said.out == ""
    assert said.err == f"DesignError: threshold = {threshold} must be between 0 and 1\n"


@pytest.mark.process
def test_an_unknown_command_is_not_understood():
    assert command("fly").returncode == 2
    assert "verify" in command("--help").stdout


def test_what_is_no_run_file_or_not_there_says_so(tmp_path):
    text = tmp_path / "robot.py"
    text.write_text("scene = None\n" * 20)
    with pytest.raises(RunFileError, match="it is no HDF5 file: give the path of a run file"):
        runfile.read_run(text)
    with pytest.raises(RunFileError, match=r"run\.h5 is not there"):
        resume(tmp_path / "gone" / "run.h5")
