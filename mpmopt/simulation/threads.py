"""Threads that run one compiled loop together."""

from __future__ import annotations

import logging
import os
import threading
from collections.abc import Callable
from functools import cache
from typing import Any

import numpy as np
from numba import config

from mpmopt.errors import MpmoptError

logger = logging.getLogger(__name__)


MEETING = 24  # numbers in the array at which threads meet
GAVE_UP = 16  # the one of them that says that a thread gave up (`kernels.meet`)


def threads() -> int:
    """Threads to use: ``MPMOPT_THREADS``, or one.

    Threads wait for each other in every step, so that one processor which others use makes all of
    them slow. One if Numba's compiler is off: only compiled loops can wait for each other.

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
    return int(wish or 1)


def processors() -> int:
    """Processors that this process may use."""
    allowed = getattr(os, "sched_getaffinity", None)  # not on macOS
    return len(allowed(0)) if allowed else os.cpu_count() or 1


def in_parallel(most: int, loop: Callable[..., Any], *arguments: Any) -> Any:
    """Call ``loop(*arguments, meeting, thread, threads)`` in several threads, `most` at most.

    Returns the result of the first; all must return the same. If one fails, the others give up
    where they wait for it (`kernels.meet`), and its exception is raised.
    """
    wanted = min(most, threads())
    barrier_state = np.zeros(MEETING, np.int64)
    ready = threading.Event()
    started = 0
    failures: list[BaseException] = []

    def take_part(thread: int) -> Any:
        try:
            return loop(*arguments, barrier_state, thread, started)
        except BaseException as error:
            failures.append(error)
            barrier_state[GAVE_UP] = 1

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
        barrier_state[GAVE_UP] = 1
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
