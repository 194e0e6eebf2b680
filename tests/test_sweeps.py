"""Sweeps: each point once, in local processes and on a real Dask cluster, whoever is killed."""

import fcntl
import functools
import os
import signal
import subprocess
import sys
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from conftest import small_scene
from swept import deadly, gradient, held_square, note, noted, picky, square, surroundings, whatever

import mpmopt
from mpmopt.app.sweeps import connected, results, sweep
from mpmopt.design.problem import Problem
from mpmopt.errors import StorageError, SweepError
from mpmopt.io.checksums import sealed
from mpmopt.results.sweepfile import Outcome, read

ROOT = Path(__file__).parent.parent


def designs():
    scene = small_scene(steps=5)
    count = int(Problem(scene).particles.designed.sum())
    rng = np.random.default_rng(3)
    return [
        {"scene": scene.to_json(), "phi": rng.uniform(-0.5, 0.5, count).tolist()} for _ in range(3)
    ]


def points(count):
    return [{"x": x} for x in range(count)]


def squares(outcomes):
    return {outcome.point["x"]: outcome.result.get("square") for outcome in outcomes}


@pytest.fixture
def store(tmp_path):
    return tmp_path / "sweep.h5"


@pytest.fixture
def threads():
    with ThreadPoolExecutor(2) as executor:
        yield executor


@pytest.fixture(scope="module")
def cluster(tmp_path_factory):
    """A Dask cluster of two worker processes on this machine."""
    distributed = pytest.importorskip("distributed")
    with distributed.LocalCluster(
        processes=True, n_workers=2, threads_per_worker=1, dashboard_address=None,
        local_directory=str(tmp_path_factory.mktemp("dask")),
    ) as cluster:  # fmt: skip
        yield cluster.scheduler_address


# One file, whatever the executor.


def test_results_come_back_as_they_were(store, threads):
    kinds = {"float": 0.1, "int": 3, "flag": True, "text": "h\u00e9", "nan": np.nan, "inf": -np.inf}
    arrays: dict[str, Any] = {
        "array": np.arange(6.0).reshape(2, 3),
        "empty": np.empty(0),
        "list": [1j, 2],
    }
    (outcome,) = sweep(lambda x: {**kinds, **arrays}, [{"x": 1}], store, threads)
    assert list(outcome.result) == [*kinds, *arrays]
    for name, value in kinds.items():
        assert type(outcome.result[name]) is type(value)
        assert outcome.result[name] == value or name == "nan"
    assert np.isnan(outcome.result["nan"])
    for name, value in arrays.items():
        assert np.array_equal(outcome.result[name], value)
    assert outcome.point == {"x": 1}
    (again,) = read(store)
    assert again.result["array"].tobytes() == arrays["array"].tobytes()


def test_the_file_is_plain_hdf5(store, threads):
    sweep(square, points(3), store, threads)
    with h5py.File(store) as file:
        assert file.attrs["function"] == "square"
        assert "numpy" in file.attrs["versions"]
        found = {g["point"].asstr()[()]: g["result/square"][()] for g in file["points"].values()}
    assert found == {'{"x":0}': 0, '{"x":1}': 1, '{"x":2}': 4}


def test_a_point_is_known_by_its_content_not_by_its_place(store, threads, tmp_path):
    log = tmp_path / "log"

    def add(x, y):
        note(log, f"{x}{y}")
        return {"sum": x + y}

    first = [{"x": 1, "y": 2}, {"y": 2, "x": 1}, {"x": 2, "y": 1}]
    assert [row["sum"] for row in results(sweep(add, first, store, threads))] == [3, 3, 3]
    assert sorted(noted(log)) == ["12", "21"]
    second = [{"x": 5, "y": 5}, {"y": 1, "x": 2}, {"x": 1, "y": 2}]
    assert [row["sum"] for row in results(sweep(add, second, store, threads))] == [10, 3, 3]
    assert sorted(noted(log)) == ["12", "21", "55"]
    assert len(read(store)) == 3


def test_a_failed_point_is_recorded_and_tried_again_at_the_next_start(store, threads, tmp_path):
    log = tmp_path / "log"
    outcomes = sweep(functools.partial(picky, log=log, refused=[1]), points(3), store, threads)
    assert squares(outcomes) == {0: 0, 1: None, 2: 4}
    assert outcomes[1].error.startswith("ValueError: 1 is refused")
    assert "in picky" in outcomes[1].error  # where
    with pytest.raises(SweepError, match=r"1 of 3 points failed.*ValueError: 1 is refused"):
        results(outcomes)
    assert [outcome.error for outcome in read(store)].count("") == 2
    outcomes = sweep(functools.partial(picky, log=log, refused=[]), points(3), store, threads)
    assert squares(outcomes) == {0: 0, 1: 1, 2: 4}
    assert sorted(noted(log)) == ["0", "1", "1", "2"]
    assert [outcome.error for outcome in read(store)] == ["", "", ""]


@pytest.mark.parametrize("kind", ["none", "nested", "slash", "no"])
def test_what_the_file_cannot_hold_is_a_failed_point(store, threads, kind):
    (outcome,) = sweep(whatever, [{"kind": kind}], store, threads)
    assert outcome.error
    assert not outcome.result


def test_what_is_no_point_is_refused_before_anything_runs(store, threads):
    for point in ({"x": {1, 2}}, {"x": np.nan}, {"x": np.float32(1)}):
        with pytest.raises(SweepError, match="no JSON"):
            sweep(square, [{"x": 1}, point], store, threads)
    assert not store.exists()


def test_another_file_is_refused_and_left_alone(tmp_path, threads):
    other = tmp_path / "other.h5"
    with h5py.File(other, "w") as file:
        file.attrs["format"] = "mpmopt run"
    other.write_bytes(sealed(other.read_bytes()))
    damaged = tmp_path / "damaged.h5"
    damaged.write_bytes(b"\x89HDF\r\n")
    sweep(square, points(1), tmp_path / "sweep.h5", threads)
    for path, said in (
        (other, "holds 'mpmopt run'"),
        (damaged, "damaged"),
        (tmp_path / "sweep.h5", "of function 'square'"),
    ):
        before = path.read_bytes()
        with pytest.raises(SweepError, match=said):
            sweep(whatever, [{"kind": "no"}], path, threads)
        assert path.read_bytes() == before
    with pytest.raises(SweepError, match="not there"):
        read(tmp_path / "nothing.h5")


def test_a_place_that_cannot_be_written_to_is_found_before_anything_runs(tmp_path, threads):
    log = tmp_path / "log"
    with pytest.raises(StorageError, match="cannot open the folder"):
        sweep(functools.partial(square, log=log), points(2), tmp_path / "no" / "s.h5", threads)
    assert noted(log) == []


def test_progress_is_told_and_so_is_what_fails(store, threads, capsys, caplog):
    refusing = functools.partial(picky, log=os.devnull, refused=[7])
    sweep(refusing, points(8), store, threads)
    lines = capsys.readouterr().err.splitlines()
    assert [line.split(",")[0] for line in lines if " of 8 points" in line] == [
        f"{k} of 8 points" for k in range(1, 9)
    ]
    assert "failed: x = 7: ValueError: 7 is refused" in caplog.messages
    sweep(refusing, points(9), store, threads)  # 7 again, and 8
    lines = capsys.readouterr().err.splitlines()
    assert [line.split(",")[0] for line in lines] == ["8 of 9 points", "9 of 9 points"]
    willing = functools.partial(picky, log=os.devnull, refused=[])
    sweep(willing, points(9), store, threads)
    capsys.readouterr()
    sweep(willing, points(9), store, threads)
    assert capsys.readouterr().err == ""


def test_sweep_is_a_name_of_the_package():
    assert mpmopt.sweep is sweep
    assert Outcome({}).error == ""


def test_an_interrupt_waits_until_the_executor_has_let_go_of_its_locks(store, request):
    handler = signal.signal(signal.SIGINT, signal.default_int_handler)  # may be ignored
    request.addfinalizer(lambda: signal.signal(signal.SIGINT, handler))
    left = []

    class Interrupted(ThreadPoolExecutor):
        def submit(self, fn, /, *args, **kwargs):
            signal.raise_signal(signal.SIGINT)
            left.append(1)  # a lock, in the real one
            return super().submit(fn, *args, **kwargs)

    with Interrupted(1) as executor, pytest.raises(KeyboardInterrupt):
        sweep(square, points(3), store, executor)
    assert left == [1, 1, 1]
    with ThreadPoolExecutor(1) as others:
        assert squares(sweep(square, points(3), store, others)) == {0: 0, 1: 1, 2: 4}


# Processes of this machine.


@pytest.mark.process
def test_processes_compute_with_one_thread_each(store):
    (where,) = results(sweep(surroundings, [{}], store, workers=1))
    assert where["threads"] == "['1', '1']"
    assert where["process"] != os.getpid()


@pytest.mark.process
@pytest.mark.slow
def test_processes_give_the_bits_of_this_one(store):
    here = [gradient(**point) for point in designs()]
    there = results(sweep(gradient, designs(), store))
    for one, other in zip(here, there, strict=True):
        assert one["value"] == other["value"]
        assert one["gradient"].tobytes() == other["gradient"].tobytes()


@pytest.mark.process
def test_a_process_that_dies_is_named_and_the_same_call_goes_on(store, tmp_path):
    log = tmp_path / "log"
    function = functools.partial(deadly, log=log, once=4)
    with pytest.raises(SweepError, match=r"(?s)TerminatedWorkerError.*in line: .*x = 4.*is kept"):
        sweep(function, points(8), store, workers=2)
    kept = squares(read(store))
    assert kept
    assert kept.items() <= {x: x * x for x in range(8) if x != 4}.items()
    assert squares(sweep(function, points(8), store, workers=2)) == {x: x * x for x in range(8)}
    assert all(noted(log).count(str(x)) == 1 for x in kept)


@pytest.mark.process
def test_functions_that_were_typed_in_reach_other_processes(tmp_path):
    program = (
        "from pathlib import Path; import mpmopt\n"
        "def typed(x): return {'square': x * x}\n"
        "print(mpmopt.sweep(typed, [{'x': 3}], Path('s.h5'))[0].result)\n"
        "print(mpmopt.sweep(lambda x: {'cube': x**3}, [{'x': 3}], Path('l.h5'))[0].result)"
    )
    done = subprocess.run(
        [sys.executable, "-c", program], cwd=tmp_path, capture_output=True, text=True,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
    )  # fmt: skip
    assert done.stdout.split("\n")[:2] == ["{'square': 9}", "{'cube': 27}"], done.stderr


@pytest.mark.process
def test_what_cannot_travel_to_other_processes_is_an_error_and_no_failed_point(store):
    with pytest.raises(SweepError, match="PicklingError"):
        sweep(functools.partial(square, log=threading.Lock()), points(3), store)
    assert read(store) == []
    assert squares(sweep(square, points(3), store)) == {0: 0, 1: 1, 2: 4}


@pytest.mark.parametrize("workers", [-1, 0, 1.5])
def test_processes_are_a_whole_number(store, workers):
    with pytest.raises(SweepError, match=f"workers = {workers} must be"):
        sweep(square, points(1), store, workers=workers)
    assert not store.exists()


# A Dask cluster.


@pytest.mark.process
def test_a_cluster_gives_the_bits_of_this_process(store, cluster):
    here = [gradient(**point) for point in designs()]
    with connected(cluster) as executor:
        there = results(sweep(gradient, designs(), store, executor))
    for one, other in zip(here, there, strict=True):
        assert one["value"] == other["value"]
        assert one["gradient"].tobytes() == other["gradient"].tobytes()


@pytest.mark.process
def test_a_worker_of_a_cluster_that_is_killed_costs_no_point(store, tmp_path, cluster):
    function = functools.partial(deadly, log=tmp_path / "log", once=3)
    with connected(cluster) as executor:
        outcomes = sweep(function, points(8), store, executor)
    assert squares(outcomes) == {x: x * x for x in range(8)}
    assert noted(tmp_path / "log").count("3") == 2


@pytest.mark.process
def test_no_address_means_processes_and_a_wrong_one_is_an_error():
    with connected(None) as executor:
        assert executor is None
    pytest.importorskip("distributed")
    with pytest.raises(SweepError, match="nonsense"), connected("nonsense://here:1"):
        pass


CLIENT = """
import functools, signal, sys
from pathlib import Path
from mpmopt.app.sweeps import connected, sweep
from swept import held_square
signal.signal(signal.SIGINT, signal.default_int_handler)  # a script in the background ignores it
store, log, go, scheduler = sys.argv[1:]
with connected(scheduler or None) as executor:
    function = functools.partial(held_square, log=log, go=go)
    sweep(function, [{"x": x} for x in range(25)], Path(store), executor, workers=2)
"""


def alive(process):
    try:
        return Path(f"/proc/{process}/stat").read_text().split()[2] != "Z"
    except FileNotFoundError:
        return False


def until(condition, seconds=60.0):
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, "nothing happened"
        time.sleep(0.02)


def end_a_client(number, store, log, go, scheduler):
    """Start a sweep in a process of its own and end it once three results are kept.

    A terminal sends Ctrl-C to all processes, and so it is done here.
    """
    path = os.pathsep.join([str(ROOT), str(ROOT / "tests")])
    client = subprocess.Popen(
        [sys.executable, "-c", CLIENT, str(store), str(log), str(go), scheduler],
        env={**os.environ, "PYTHONPATH": path}, stderr=subprocess.PIPE, text=True,
        start_new_session=True,
    )  # fmt: skip
    assert client.stderr is not None
    try:
        until(lambda: len(noted(log)) >= 5 and len(read(store)) >= 3)  # two are under way
        os.killpg(client.pid, number) if number == signal.SIGINT else client.kill()
        said = client.communicate(timeout=60)[1]
    finally:
        client.kill()
        client.wait()
        client.stderr.close()
        go.touch()  # a cluster is still at it
    assert client.returncode == -number
    if number == signal.SIGINT:
        assert said.endswith("KeyboardInterrupt\n")
        assert said.count("Traceback") == 1
        assert "interrupted" not in noted(log)  # it is for the client alone to end
    return squares(read(store))


@pytest.mark.process
@pytest.mark.parametrize(
    ("where", "number"),
    [
        ("processes", signal.SIGKILL),
        ("processes", signal.SIGINT),
        ("cluster", signal.SIGKILL),
    ],
)
def test_after_the_client_is_ended_the_next_start_computes_what_is_missing(
    store, tmp_path, where, number, request
):
    address = request.getfixturevalue("cluster") if where == "cluster" else ""
    first, second = tmp_path / "first", tmp_path / "second"
    go = tmp_path / "go"
    assert end_a_client(number, store, first, go, address) == {0: 0, 1: 1, 2: 4}
    if where == "processes" and Path("/proc").exists():
        until(lambda: not any(alive(process) for process in noted(first)))
    with connected(address or None) as executor:
        function = functools.partial(held_square, log=second, go=go)
        outcomes = sweep(function, points(25), store, executor)
    assert squares(outcomes) == {x: x * x for x in range(25)}
    assert len(noted(second)) == 22
    assert len(read(store)) == 25


def test_no_reader_ever_sees_half_a_file(store):
    seen = []

    def look(x):  # while the results of others are written
        seen.append(len(read(store)))
        return {}

    with ThreadPoolExecutor(1) as executor:
        results(sweep(look, points(30), store, executor))
    assert len(seen) == 30
    assert seen == sorted(seen)
    assert seen[-1] <= 29


def test_readers_and_sweeps_do_not_wait_for_each_other(store, threads):
    sweep(square, points(2), store, threads)
    with h5py.File(store) as held:  # with the lock of a reader
        assert len(read(store)) == 2
        assert squares(sweep(square, points(3), store, threads)) == {0: 0, 1: 1, 2: 4}
        assert len(held["points"]) == 2
    with store.open("rb") as held:
        fcntl.flock(held, fcntl.LOCK_EX)
        assert len(read(store)) == 3


# Files of others.


def refused(store, threads, says):
    """Both who read a file and who would go on with it are told, and it stays as it is."""
    before = store.read_bytes()
    with pytest.raises(SweepError, match=says):
        read(store)
    with pytest.raises(SweepError, match=says):
        sweep(square, points(3), store, threads)
    assert store.read_bytes() == before


def test_hdf5_never_sees_a_sweep_of_which_a_byte_changed(store, threads, monkeypatch):
    sweep(square, points(3), store, threads)
    content = store.read_bytes()
    monkeypatch.setattr(h5py.h5f, "open_file_image", lambda *_: pytest.fail("it was opened"))
    for place in range(0, len(content), 997):
        changed = bytearray(content)
        changed[place] ^= 1 << (place % 8)
        store.write_bytes(changed)
        refused(store, threads, r"sweep\.h5.*digest")


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (lambda f, k: f.pop("points"), "points"),
        (lambda f, k: f.update({"points/other": 1.0}), "sweep.h5 is no sweep's file, or damaged"),
        (lambda f, k: f[k].pop("result"), "result"),
        (lambda f, k: f[k].pop("error"), "error"),
        (lambda f, k: (f[k].pop("point"), f[k].update({"point": "no JSON"})), "damaged"),
        (lambda f, k: (f[k].pop("point"), f[k].update({"point": "3"})), "damaged"),
        (lambda f, k: (f[k].pop("error"), f[k].update({"error": 0.0})), "damaged"),
        (lambda f, k: f.attrs.update(versions="[]"), "damaged"),
        (lambda f, k: f[k].update({"result/x": h5py.SoftLink("/points")}), "leads elsewhere"),
        (lambda f, k: f[k].create_dataset("result/x", (10**12,), "f8"), "claims 8000000000000"),
    ],
)
def test_what_no_sweep_writes_is_refused_even_if_it_is_sealed(store, threads, change, says):
    sweep(square, points(3), store, threads)
    with h5py.File(store, "r+") as file:
        change(file, f"points/{next(iter(file['points']))}")
    store.write_bytes(sealed(store.read_bytes()))
    refused(store, threads, says)
