"""Threads that run one compiled loop together."""

from __future__ import annotations

import logging
import os
import threading
import time
from collections.abc import Callable
from functools import cache
from typing import Any

import numpy as np
from numba import config

from mpmopt.errors import MpmoptError

logger = logging.getLogger(__name__)


MEETING = 24  # numbers in the array at which threads meet
GAVE_UP = 16  # the one of them that says that a thread gave up (`mpm.meet`)


# How many calls of a loop pass between tries of what was slower: one thread, or all.
SOON, LATE = 16, 512


class Pace:
    """Is a loop faster with one thread or with all, on a machine that others use too?

    Threads wait for each other, so a processor that is busy elsewhere can make all of them slower
    than one alone. As the number of threads changes no result, it may change at any time.
    """

    def __init__(self) -> None:
        self.seconds: dict[bool, float] = {}  # per unit of work, of all (True) or one (False)
        self.pause, self.since = SOON, -1  # the first call compiles and does not count

    def choose(self) -> bool:
        """Whether the next call gets all threads."""
        if self.since < 0 or True not in self.seconds:
            return True
        if False not in self.seconds:
            return False
        faster = self.seconds[True] <= self.seconds[False]
        return faster if self.since < self.pause else not faster

    def note(self, with_all: bool, seconds: float) -> None:
        """Remember what a unit of work took."""
        if self.since >= 0:
            self.seconds[with_all] = seconds
            if self.since >= self.pause:
                other = self.seconds.get(not with_all, np.inf)
                self.pause = SOON if seconds < other else min(2 * self.pause, LATE)
                self.since = 0
        self.since += 1


_paces: dict[str, Pace] = {}


def threads() -> int:
    """Threads to use: ``MPMOPT_THREADS``, or as many as there are processors for this process.

    One if Numba's compiler is off: only compiled loops can wait for each other.

    Raises
    ------
    MpmoptError
        If the environment variable is not a whole number above zero.
    """
    wish = os.environ.get("MPMOPT_THREADS", "")
    if wish and (not wish.isdecimal() or int(wish) < 1):
        raise MpmoptError(f"MPMOPT_THREADS = {wish!r} must be a whole number, at least 1")
    if getattr(config, "DISABLE_JIT", 0):
        return 1
    return int(wish) if wish else processors()


def processors() -> int:
    """How many processors there are for this process."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def together(most: int, work: int, loop: Callable[..., Any], *arguments: Any) -> Any:
    """Call ``loop(*arguments, meeting, thread, threads)`` in several threads, `most` at most.

    Returns the result of the first; all must return the same. If one fails, the others give up
    where they wait for it (`mpm.meet`), and its exception is raised. How many there are is decided
    by ``MPMOPT_THREADS``, or, if that is not set, by which number did such `work` faster lately.
    """
    wanted = min(most, threads())
    if wanted == 1 or os.environ.get("MPMOPT_THREADS"):
        return _call(wanted, loop, *arguments)
    pace = _paces.setdefault(loop.__name__, Pace())
    with_all = pace.choose()
    began = time.perf_counter()
    result = _call(wanted if with_all else 1, loop, *arguments)
    pace.note(with_all, (time.perf_counter() - began) / work)
    return result


def _call(wanted: int, loop: Callable[..., Any], *arguments: Any) -> Any:
    """Call the loop with so many threads, or as many as start."""
    meeting = np.zeros(MEETING, np.int64)
    ready = threading.Event()
    started = 0
    failures: list[BaseException] = []

    def take_part(thread: int) -> Any:
        try:
            return loop(*arguments, meeting, thread, started)
        except BaseException as error:
            failures.append(error)
            meeting[GAVE_UP] = 1

    def help_with(thread: int) -> None:
        ready.wait()
        if thread < started:
            take_part(thread)

    helpers = [threading.Thread(target=help_with, args=(k,), daemon=True) for k in range(1, wanted)]
    why, result = "", None
    try:
        try:
            for helper in helpers:
                helper.start()
        except RuntimeError as error:  # the system gives no more of them
            why = str(error)
        started = 1 + sum(helper.is_alive() for helper in helpers)
        if started < wanted:
            _say_once(f"{started} of {wanted} threads run: {why}")
        ready.set()
        result = take_part(0)
    except BaseException:
        meeting[GAVE_UP] = 1
        raise
    finally:
        ready.set()
        for helper in helpers:
            if helper.is_alive():
                helper.join()
    if failures:
        raise failures[0]
    return result


@cache
def _say_once(text: str) -> None:
    logger.warning(text)
