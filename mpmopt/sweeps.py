"""Many points, each computed once, in local processes or on a cluster, kept in one HDF5 file.

Layout (version 2)::

    attributes          format, version, function; versions of packages as JSON
    points/K/           point as JSON with sorted keys; error, empty if there is none
    points/K/result/    one number, text or array for each entry

A point is known by its content: K is the SHA-256 of that JSON, shortened. The file is sealed with
a digest of all its bytes (`seals`), and replaced by a complete one whenever results arrive: a
killed program loses the points that were under way.
"""

from __future__ import annotations

import csv
import functools
import hashlib
import io
import json
import logging
import multiprocessing
import os
import signal
import sys
import threading
import traceback
from collections import deque
from collections.abc import Callable, Generator, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import (
    FIRST_COMPLETED,
    BrokenExecutor,
    Executor,
    Future,
    ProcessPoolExecutor,
    wait,
)
from contextlib import closing, contextmanager
from dataclasses import dataclass, field
from multiprocessing.reduction import ForkingPickler
from pathlib import Path
from pickle import PicklingError
from queue import SimpleQueue
from typing import Any
from uuid import uuid4

import h5py
import numpy as np

from mpmopt.checks import count
from mpmopt.errors import MissingLibraryError, SweepError
from mpmopt.files import locked, replace_file
from mpmopt.progress import Progress
from mpmopt.seals import refusing, sealed, unsealed

logger = logging.getLogger(__name__)

FORMAT, VERSION, KIND = "mpmopt sweep", 2, "sweep's file"

DIED = "SweepError: its process died twice, the second time alone; it may lack memory\n"

Point = Mapping[str, Any]
Answer = tuple[dict[str, Any], str]  # result, and the error if there is none
Arrivals = Generator[list[tuple[str, Answer]], None, None]


@dataclass(frozen=True)
class Outcome:
    """What came of a point.

    Attributes
    ----------
    point : dict
    result : dict
        Of numbers, texts and arrays; empty if the point failed.
    error : str
        Why it failed, first the exception, then where; or empty.
    """

    point: dict[str, Any]
    result: dict[str, Any] = field(default_factory=dict)
    error: str = ""


def sweep(
    function: Callable[..., Mapping[str, Any]],
    points: Iterable[Point],
    store: Path,
    executor: Executor | None = None,
    workers: int | None = None,
) -> list[Outcome]:
    """Call ``function(**point)`` once for each point and keep what it returns in one file.

    What the file holds already is not computed again. A point that fails is recorded with its
    error, the others go on; the next sweep tries it again. If the process that computes a point
    dies, the point is tried once more, alone; if it dies again, the point has failed. Progress is
    shown on standard error.

    Parameters
    ----------
    function : callable
        Of a module, so that other processes find it; ``functools.partial`` binds arguments that
        do not make another point. Returns numbers, texts and small arrays by name.
    points : iterable of mapping
        Arguments by name, of what JSON knows. Equal points are computed once.
    store : Path
        File that is made or continued.
    executor : concurrent.futures.Executor, optional
        Who computes. By default processes of this machine with one thread each, which end with
        this program.
    workers : int, optional
        How many such processes; by default one for each processor.

    Returns
    -------
    list of Outcome
        In the order of the points.

    Raises
    ------
    SweepError
        If a point is no JSON, the file is another one or damaged, no other process finds the
        function, or the executor gives up.
    StorageError
        If the file cannot be written, or another program is at work in its folder; an older file
        is still whole.
    """
    from mpmopt.threads import processors  # slow to import, and those that compute need it not

    store = Path(store)
    keys = [_canonical(point) for point in points]
    run = functools.partial(_run, function)
    if workers is not None:
        count("sweep", "workers", workers, 1, error=SweepError)
    if executor is None:
        refuse_stuck(function)
    with locked(store), _open(store, _inner(function).__qualname__) as file:
        kept = file["points"]
        wanted = list(dict.fromkeys(keys))
        missing = [key for key in wanted if not _is_done(kept, key)]
        if missing:
            _save(file, store)  # a place that cannot be written to is found now
            progress = Progress("points", len(wanted))
            progress.count = len(wanted) - len(missing)
            if progress.count:
                logger.info("%s holds %d of %d points", store, progress.count, len(wanted))
            arrivals = (
                _processes(run, missing, workers or processors())
                if executor is None
                else _submitted(run, missing, executor)
            )
            with closing(arrivals), progress:
                for batch in arrivals:
                    for key, answer in batch:
                        _put(kept, key, *answer)
                        if answer[1]:
                            why = answer[1].splitlines()[0]
                            logger.warning("failed: %s: %s", _brief(json.loads(key)), why)
                        progress.step()
                    _save(file, store)
        return [_outcome(kept[_digest(key)]) for key in keys]


def results(outcomes: Sequence[Outcome]) -> list[dict[str, Any]]:
    """The results of a sweep of which no point may fail.

    Raises
    ------
    SweepError
        If one did.
    """
    failed = [outcome for outcome in outcomes if outcome.error]
    if failed:
        raise SweepError(
            f"{len(failed)} of {len(outcomes)} points failed, the first with "
            f"{_brief(failed[0].point)}: {failed[0].error.rstrip()}\nThe others are kept; start "
            "again to try these again"
        )
    return [outcome.result for outcome in outcomes]


def read(store: Path) -> list[Outcome]:
    """All that a sweep's file holds, in order of arrival.

    Raises
    ------
    SweepError
        If it is not there, is of another kind or damaged.
    """
    store = Path(store)
    if not store.is_file():
        raise SweepError(f"{store} is not there; give the path of a sweep's file")
    with _open(store, None) as file:
        return [_outcome(group) for group in file["points"].values()]


def as_csv(rows: Sequence[Mapping[str, Any]], digits: int = 6) -> str:
    """Rows of the same names as comma-separated values, numbers with so many digits."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(rows[0])
    for row in rows:
        cells = row.values()
        writer.writerow(f"{v:.{digits}g}" if isinstance(v, float) else v for v in cells)
    return text.getvalue()


def refuse_stuck(function: Callable) -> None:
    """Refuse a function that cannot travel to other processes, with all that is bound to it.

    Raises
    ------
    SweepError
    """
    inner = _inner(function)
    if _is_typed_in(inner):
        raise SweepError(
            f"{inner.__qualname__} was typed in, so no other process finds it; put it into a file, "
            "or give an executor such as a ThreadPoolExecutor"
        )
    try:
        ForkingPickler.dumps(function)
    except (PicklingError, AttributeError, TypeError) as error:
        raise SweepError(
            f"{inner.__qualname__}, or what is bound to it, cannot travel to other processes: "
            f"{error}; make each function one of a module or script, with `def` and not within "
            "another"
        ) from error


@contextmanager
def connected(scheduler: str | None) -> Iterator[Executor | None]:
    """The executor of a running Dask cluster, or None, for local processes, without an address.

    Parameters
    ----------
    scheduler : str or None
        Address such as ``tcp://host:8786``.

    Raises
    ------
    MissingLibraryError
        Without dask.distributed.
    SweepError
        If nothing answers.
    """
    if scheduler is None:
        yield None
        return
    try:
        from distributed import Client
    except ImportError as error:
        raise MissingLibraryError(f"{error}: pip install 'mpmopt[cluster]'") from error
    try:
        client = Client(scheduler)
    except (OSError, ValueError) as error:
        raise SweepError(f"no Dask scheduler answers at {scheduler}: {error}") from error
    # Not pure: what failed is computed anew, not remembered.
    with client, client.get_executor(pure=False) as executor:
        yield executor


def _canonical(point: Point) -> str:
    try:
        return json.dumps(dict(point), sort_keys=True, separators=(",", ":"), allow_nan=False)
    except (TypeError, ValueError) as error:
        raise SweepError(f"point {point!r} is no JSON: {error}") from error


def _brief(point: Point) -> str:
    """What is short about a point."""
    texts = {name: str(value) for name, value in point.items()}
    return ", ".join(f"{name} = {text}" for name, text in texts.items() if len(text) <= 80)


def _inner(function: Callable) -> Callable:
    while isinstance(function, functools.partial):
        function = function.func
    return function


def _is_typed_in(function: Callable) -> bool:
    return function.__module__ == "__main__" and not hasattr(sys.modules["__main__"], "__file__")


def _run(function: Callable[..., Mapping[str, Any]], key: str) -> Answer:
    """In the process that computes: the result, or the error as text, which always travels."""
    try:
        return _checked(function(**json.loads(key))), ""
    except Exception as error:
        return {}, _text(error)


def _text(error: BaseException) -> str:
    text = f"{type(error).__name__}: {error}\n" + "".join(traceback.format_exception(error))
    return text.replace("\0", "")  # HDF5 ends a text there


def _checked(result: Mapping[str, Any]) -> dict[str, Any]:
    """A result as texts and arrays of numbers."""
    checked: dict[str, Any] = {}
    for name, value in dict(result).items():
        if isinstance(value, str) and "\0" not in value:
            checked[name] = value
            continue
        array = np.asarray(value)
        named = isinstance(name, str) and name.strip(".") and "/" not in name
        if not named or array.dtype.kind not in "biufc":
            raise SweepError(
                f"result {name!r} is a {type(value).__name__}; return numbers, texts and arrays of "
                "numbers, by names without a slash"
            )
        checked[name] = array
    return checked


def _open(store: Path, function: str | None) -> h5py.File:
    """The file in memory; what is changed there stays there."""
    from mpmopt.runfile import versions  # as above

    if not store.exists():
        file = h5py.File(f"sweep-{uuid4()}", "w", driver="core", backing_store=False)
        file.attrs["format"], file.attrs["version"] = FORMAT, VERSION
        file.attrs["function"], file.attrs["versions"] = function, json.dumps(versions())
        file.create_group("points", track_order=True)
        return file
    with refusing(store, KIND, SweepError):
        file = unsealed(store, KIND, writable=True)
        found = tuple(file.attrs.get(name) for name in ("format", "version", "function"))
        if found != (FORMAT, VERSION, function or found[2]):
            raise SweepError(
                f"{store} holds {found[0]!r}, version {found[1]}, of function {found[2]!r}, not "
                f"{FORMAT!r}, version {VERSION}, of {function!r}; choose another file"
            )
        for group in file["points"].values():
            _outcome(group)  # what cannot be read is found now
        before = json.loads(file.attrs["versions"])
        changed = {name: now for name, now in versions().items() if before.get(name) != now}
    if function and changed:
        logger.warning("%s was begun with %s; now it is %s", store, before, changed)
    return file


def _save(file: h5py.File, store: Path) -> None:
    file.flush()
    replace_file(store, sealed(file.id.get_file_image()))


def _digest(key: str) -> str:
    return hashlib.sha256(key.encode()).hexdigest()[:20]


def _is_done(points: h5py.Group, key: str) -> bool:
    name = _digest(key)
    return name in points and not points[name]["error"].asstr()[()]


def _put(points: h5py.Group, key: str, result: Mapping[str, Any], error: str) -> None:
    name = _digest(key)
    if name in points:  # failed in an earlier sweep
        del points[name]
    group = points.create_group(name)
    group["point"], group["error"] = key, error
    inside = group.create_group("result", track_order=True)
    for entry, value in result.items():
        inside[entry] = value


def _outcome(group: h5py.Group) -> Outcome:
    result = {}
    for name, dataset in group["result"].items():
        if h5py.check_string_dtype(dataset.dtype):
            result[name] = dataset.asstr()[()]
        else:
            result[name] = dataset[()] if dataset.ndim else dataset[()].item()
    point = json.loads(group["point"].asstr()[()])
    return Outcome(dict(point), result, group["error"].asstr()[()])


def _submitted(run: Callable[[str], Answer], keys: list[str], executor: Executor) -> Arrivals:
    """What a given executor answers, as many at a time as have arrived."""
    arrived: SimpleQueue[Future[Answer]] = SimpleQueue()
    futures: dict[Future[Answer], str] = {}
    try:
        try:
            for key in keys:
                futures[executor.submit(run, key)] = key
        except (BrokenExecutor, RuntimeError) as error:
            raise SweepError(f"the executor takes no points: {error}; give another one") from error
        for future in list(futures):
            future.add_done_callback(arrived.put)
        while futures:
            batch = [arrived.get(), *(arrived.get() for _ in range(arrived.qsize()))]
            lost = [future for future in batch if _is_lost(future)]
            yield [(futures.pop(future), _answer(future)) for future in batch if future not in lost]
            if lost:
                why = "cancelled" if lost[0].cancelled() else repr(lost[0].exception())
                raise SweepError(
                    f"the executor gave up {len(futures)} points: {why}; what arrived is kept, "
                    "start again for the others"
                )
    finally:
        for future in futures:
            future.cancel()


def _is_lost(future: Future[Answer]) -> bool:
    """Whether it is the executor that failed, and not the point."""
    return future.cancelled() or isinstance(future.exception(), BrokenExecutor)


def _answer(future: Future[Answer]) -> Answer:
    error = future.exception()
    return future.result() if error is None else ({}, _text(error))


def _processes(run: Callable[[str], Answer], keys: list[str], workers: int) -> Arrivals:
    """What processes of this machine answer.

    If one dies, its pool is lost. The points that were under way are then computed one at a time,
    so that a second death tells which of them it was.
    """
    context = multiprocessing.get_context("spawn")
    waiting, suspects = deque(keys), deque[str]()
    while waiting or suspects:
        alone = bool(suspects)
        queue = suspects if alone else waiting
        width = 1 if alone else min(workers, len(queue))
        # One point is ahead, so that no process waits while results are written.
        most = 1 if alone else width + 1
        with ProcessPoolExecutor(width, context, _begin) as pool:
            running: dict[Future[Answer], str] = {}
            broken = False
            while not broken and (queue or running):
                try:
                    while queue and len(running) < most:
                        running[pool.submit(run, queue[0])] = queue[0]
                        queue.popleft()
                    done = wait(running, return_when=FIRST_COMPLETED).done
                except BrokenExecutor:
                    done = set()
                broken = not done or any(_is_lost(future) for future in done)
                if broken:
                    done = wait(running).done
                batch = []
                for future in done:
                    key = running.pop(future)
                    if not _is_lost(future):
                        batch.append((key, _answer(future)))
                    elif alone:
                        batch.append((key, ({}, DIED)))
                    else:
                        suspects.append(key)
                        logger.warning("a process died; tried again: %s", _brief(json.loads(key)))
                yield batch


def _begin() -> None:
    """In a new process: one thread, no word at an interrupt, and an end when the parent ends."""
    os.environ["MPMOPT_THREADS"] = "1"
    signal.signal(signal.SIGINT, signal.SIG_DFL)
    threading.Thread(target=_follow, daemon=True).start()


def _follow() -> None:
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)
