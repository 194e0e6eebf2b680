"""Sweeps: each point once, in local processes and on a real Dask cluster, whoever is killed."""

import functools
import os
import subprocess
import sys
import threading
import time
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor
from multiprocessing import get_context
from pathlib import Path

import h5py
import numpy as np
import pytest
from conftest import small_scene
from swept import deadly, gradient, note, noted, picky, slow_square, square, surroundings, whatever

import mpmopt
from mpmopt.errors import StorageError, SweepError
from mpmopt.problem import Problem
from mpmopt.sweeps import Outcome, connected, read, results, sweep

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
    arrays = {"array": np.arange(6.0).reshape(2, 3), "empty": np.empty(0), "list": [1, 2]}
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


# Processes of this machine.


def test_processes_compute_with_one_thread_each(store):
    (where,) = results(sweep(surroundings, [{}], store, workers=1))
    assert where["threads"] == "1"
    assert where["process"] != os.getpid()


@pytest.mark.slow
def test_processes_give_the_bits_of_this_one(store):
    here = [gradient(**point) for point in designs()]
    there = results(sweep(gradient, designs(), store))
    for one, other in zip(here, there, strict=True):
        assert one["value"] == other["value"]
        assert one["gradient"].tobytes() == other["gradient"].tobytes()


def test_a_process_that_dies_costs_no_point_and_a_point_that_kills_only_itself(store, tmp_path):
    log = tmp_path / "log"
    # The slow ones are under way when others kill their processes, and must not be blamed.
    function = functools.partial(deadly, log=log, once=[1], always=[4], slow=[2, 5])
    outcomes = sweep(function, points(8), store, workers=2)
    assert squares(outcomes) == {x: None if x == 4 else x * x for x in range(8)}
    assert outcomes[4].error.startswith("SweepError: its process died twice")
    assert noted(log).count("4") == 2
    assert noted(log).count("1") == 2


def test_an_executor_that_breaks_leaves_what_arrived(store, tmp_path):
    function = functools.partial(deadly, log=tmp_path / "log", always=[5])
    refusal = pytest.raises(SweepError, match=r"gave up \d points: BrokenProcessPool.*start again")
    with ProcessPoolExecutor(1, get_context("spawn")) as pool, refusal:
        sweep(function, points(8), store, pool)
    kept = squares(read(store))
    assert set(kept) <= {0, 1, 2, 3, 4}


def test_a_function_that_no_other_process_finds_is_refused_at_once(tmp_path):
    program = (
        "from pathlib import Path; import mpmopt\n"
        "def typed(x): return {}\n"
        "mpmopt.sweep(typed, [{'x': 1}], Path('s.h5'))"
    )
    done = subprocess.run(
        [sys.executable, "-c", program], cwd=tmp_path, capture_output=True, text=True,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
    )  # fmt: skip
    assert "SweepError: typed was typed in" in done.stderr
    assert not list(tmp_path.iterdir())


# A Dask cluster.


def test_a_cluster_gives_the_bits_of_this_process(store, cluster):
    here = [gradient(**point) for point in designs()]
    with connected(cluster) as executor:
        there = results(sweep(gradient, designs(), store, executor))
    for one, other in zip(here, there, strict=True):
        assert one["value"] == other["value"]
        assert one["gradient"].tobytes() == other["gradient"].tobytes()


def test_a_worker_of_a_cluster_that_is_killed_costs_no_point(store, tmp_path, cluster):
    function = functools.partial(deadly, log=tmp_path / "log", once=[3])
    with connected(cluster) as executor:
        outcomes = sweep(function, points(8), store, executor)
    assert squares(outcomes) == {x: x * x for x in range(8)}
    assert noted(tmp_path / "log").count("3") == 2


def test_no_address_means_processes_and_a_wrong_one_is_an_error():
    with connected(None) as executor:
        assert executor is None
    pytest.importorskip("distributed")
    with pytest.raises(SweepError, match="nonsense"), connected("nonsense://here:1"):
        pass


CLIENT = """
import functools, sys
from pathlib import Path
from mpmopt.sweeps import connected, sweep
from swept import slow_square
store, log, scheduler = sys.argv[1:]
with connected(scheduler or None) as executor:
    function = functools.partial(slow_square, log=log)
    sweep(function, [{"x": x} for x in range(25)], Path(store), executor)
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


def kill_a_client(store, log, scheduler=""):
    """Start a sweep in a process of its own and kill it once three results are kept."""
    path = os.pathsep.join([str(ROOT), str(ROOT / "tests")])
    client = subprocess.Popen(
        [sys.executable, "-c", CLIENT, str(store), str(log), scheduler],
        env={**os.environ, "PYTHONPATH": path}, stderr=subprocess.DEVNULL,
    )  # fmt: skip
    try:
        until(lambda: store.exists() and len(read(store)) >= 3)
    finally:
        client.kill()
        client.wait()
    return squares(read(store))


@pytest.mark.parametrize("where", ["processes", "cluster"])
def test_after_the_client_is_killed_the_next_start_computes_what_is_missing(
    store, tmp_path, where, request
):
    address = request.getfixturevalue("cluster") if where == "cluster" else ""
    first, second = tmp_path / "first", tmp_path / "second"
    kept = kill_a_client(store, first, address)
    assert 3 <= len(kept) < 25
    if where == "processes" and Path("/proc").exists():
        until(lambda: not any(alive(process) for process in noted(first)))
    with connected(address or None) as executor:
        function = functools.partial(slow_square, log=second)
        outcomes = sweep(function, points(25), store, executor)
    assert squares(outcomes) == {x: x * x for x in range(25)}
    assert len(noted(second)) == 25 - len(kept)
    assert len(read(store)) == 25


def test_no_reader_ever_sees_half_a_file(store, threads):
    seen, stop = [], threading.Event()

    def look():
        while not stop.is_set():
            if store.exists():
                seen.append(len(read(store)))

    reader = threading.Thread(target=look)
    reader.start()
    try:
        sweep(square, points(60), store, threads)
    finally:
        stop.set()
        reader.join()
    assert seen == sorted(seen)
    assert seen[-1] <= 60
