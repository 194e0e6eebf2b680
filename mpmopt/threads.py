"""Threads that run one compiled loop together."""

from __future__ import annotations

import logging
import os
import threading
from collections.abc import Callable
from functools import cache
from typing import Any

from mpmopt.errors import MpmoptError

logger = logging.getLogger(__name__)


def threads() -> int:
    """Threads to use: ``MPMOPT_THREADS``, or as many as there are processors for this process.

    Raises
    ------
    MpmoptError
        If the environment variable is not a whole number above zero.
    """
    wish = os.environ.get("MPMOPT_THREADS", "")
    if not wish:
        if hasattr(os, "sched_getaffinity"):
            return len(os.sched_getaffinity(0))
        return os.cpu_count() or 1
    if not wish.isdecimal() or int(wish) < 1:
        raise MpmoptError(f"MPMOPT_THREADS = {wish!r} must be a whole number, at least 1")
    return int(wish)


def together(most: int, loop: Callable[..., Any], *arguments: Any) -> Any:
    """Call ``loop(*arguments, thread, threads)`` in several threads at once, `most` at most.

    Returns the result of the first; all must return the same.
    """
    wanted = min(most, threads())
    ready = threading.Event()
    started = 0

    def help_with(thread: int) -> None:
        ready.wait()
        loop(*arguments, thread, started)

    helpers = [threading.Thread(target=help_with, args=(k,), daemon=True) for k in range(1, wanted)]
    why = ""
    try:
        for helper in helpers:
            helper.start()
    except RuntimeError as error:  # the system gives no more of them
        why = str(error)
    helpers = [helper for helper in helpers if helper.is_alive()]
    started = 1 + len(helpers)
    if started < wanted:
        _say_once(f"{started} of {wanted} threads run: {why}")
    ready.set()
    result = loop(*arguments, 0, started)
    for helper in helpers:
        helper.join()
    return result


@cache
def _say_once(text: str) -> None:
    logger.warning(text)
