"""Many points, each computed once, in local processes or on a cluster, kept in one file.

Whenever results arrive, the file is replaced (`sweepfile`): a killed program loses the points that
were under way.
"""

from __future__ import annotations

import functools
import itertools
import json
import logging
import os
import signal
import threading
import time
import traceback
from collections.abc import Callable, Generator, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import BrokenExecutor, CancelledError, Executor, Future
from contextlib import closing, contextmanager
from pathlib import Path
from pickle import PicklingError
from queue import SimpleQueue
from typing import Any

import numpy as np

from mpmopt.errors import MissingLibraryError, SweepError
from mpmopt.io.console import SIGNALS
from mpmopt.io.files import locked
from mpmopt.io.progress import Progress
from mpmopt.results.sweepfile import Outcome, SweepFile
from mpmopt.validation import count

logger = logging.getLogger(__name__)

ONE_THREAD = ("MPMOPT_THREADS", "OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")

Point = Mapping[str, Any]
Answer = tuple[dict[str, Any], str]  # result, and the error if there is none


def sweep(
    function: Callable[..., Mapping[str, Any]],
    points: Iterable[Point],
    store: Path,
    executor: Executor | None = None,
    workers: int | None = None,
) -> list[Outcome]:
    """Call ``function(**point)`` once for each point and keep what it returns in one file.

    What the file holds already is not computed again. A point that fails is recorded with its
    error, the others go on; the next sweep tries it again. Progress is shown on standard error.

    Parameters
    ----------
    function : callable
        Returns numbers, texts and small arrays by name; ``functools.partial`` binds arguments that
        do not make another point. The file knows it by its name.
    points : iterable of mapping
        Arguments by name, of what JSON knows. Equal points are computed once.
    store : Path
        File that is made or continued.
    executor : concurrent.futures.Executor, optional
        Who computes: that of a cluster (`connected`). By default processes of this machine with one
        thread each, which end with this sweep.
    workers : int, optional
        How many such processes; by default one for each processor.

    Returns
    -------
    list of Outcome
        In the order of the points.

    Raises
    ------
    SweepError
        If a point is no JSON, the file is another one or damaged, or those who compute give up: a
        process died, or the function cannot travel to them. What arrived is kept.
    StorageError
        If the file cannot be written, or another program is at work in its folder; an older file
        is still whole.
    """
    store = Path(store)
    keys = [_canonical(point) for point in points]
    if workers is not None:
        count("sweep", "workers", workers, 1, error=SweepError)
    with locked(store), closing(SweepFile(store, _name(function))) as file:
        wanted = list(dict.fromkeys(keys))
        missing = [key for key in wanted if not file.has(key)]
        if missing:
            file.save()  # a place that cannot be written to is found now
            progress = Progress("points", len(wanted))
            progress.count = len(wanted) - len(missing)
            if progress.count:
                logger.info("%s holds %d of %d points", store, progress.count, len(wanted))
            run = functools.partial(_run, function)
            with closing(_arrivals(run, missing, executor, workers)) as arrivals, progress:
                for batch in arrivals:
                    for key, (result, error) in batch:
                        file.put(key, result, error)
                        if error:
                            why = error.splitlines()[0]
                            logger.warning("failed: %s: %s", _brief(json.loads(key)), why)
                        progress.step()
                    file.save()
        return [file[key] for key in keys]


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
    # Not joblib's Dask backend, which waits for ever for a point whose worker died too often, and
    # computes here if the cluster has one worker. Not pure: what failed is computed anew.
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


def _name(function: Callable) -> str:
    while isinstance(function, functools.partial):
        function = function.func
    return function.__qualname__


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


def _arrivals(
    run: Callable[[str], Answer], keys: list[str], executor: Executor | None, workers: int | None
) -> Generator[list[tuple[str, Answer]], None, None]:
    """What those who compute answer, as many at a time as have arrived."""
    from joblib.externals.loky import ProcessPoolExecutor, cpu_count  # they need it not

    width = min(workers or cpu_count(), len(keys))
    pool: Any = executor or ProcessPoolExecutor(
        width, initializer=_begin, initargs=(os.getpid(),), env=dict.fromkeys(ONE_THREAD, "1")
    )
    # Processes that are to end must have no long queue before them: loky stumbles over it.
    most = 2 * width if executor is None else len(keys)
    waiting = iter(keys)
    arrived: SimpleQueue[Future[Answer]] = SimpleQueue()
    futures: dict[Future[Answer], str] = {}
    try:
        while True:
            with _signals_wait():
                for key in itertools.islice(waiting, most - len(futures)):
                    future = pool.submit(run, key)
                    futures[future] = key
                    future.add_done_callback(arrived.put)
            if not futures:
                return
            batch = [arrived.get(), *(arrived.get() for _ in range(arrived.qsize()))]
            with _signals_wait():
                lost = {future for future in batch if _is_lost(future)}
                answers = [(futures.pop(f), _answer(f)) for f in batch if f not in lost]
            yield answers
            for future in lost:
                future.result()  # raises why
    except (BrokenExecutor, CancelledError, PicklingError, RuntimeError) as error:
        first = "; ".join(_brief(json.loads(key)) for key in [*futures.values()][:width])
        raise SweepError(
            f"those who compute gave up: {type(error).__name__}: {error}\nFirst in line: {first}. "
            "What arrived is kept; start again for the others"
        ) from error
    finally:
        if executor is None:
            pool.shutdown(kill_workers=bool(futures))
        for future in futures:
            future.cancel()


@contextmanager
def _signals_wait() -> Iterator[None]:
    """Signals are heard at the end.

    An executor's locks are taken in Python: one that an exception leaves just then stays locked,
    and those who wait for it wait for ever.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    heard: list[int] = []
    handlers = {
        number: signal.signal(number, lambda number, _: heard.append(number)) for number in SIGNALS
    }
    try:
        yield
    finally:
        for number, handler in handlers.items():
            signal.signal(number, handler)
        for one in heard:
            signal.raise_signal(one)


def _is_lost(future: Future[Answer]) -> bool:
    """Whether it is the executor that failed, and not the point."""
    return future.cancelled() or isinstance(future.exception(), (BrokenExecutor, PicklingError))


def _answer(future: Future[Answer]) -> Answer:
    error = future.exception()
    return future.result() if error is None else ({}, _text(error))


def _begin(parent: int) -> None:
    """In a new process: no word at an interrupt, and an end when the parent ends, however."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_follow, args=(parent,), daemon=True).start()


def _follow(parent: int) -> None:
    while os.getppid() == parent:
        time.sleep(0.2)
    os._exit(1)
