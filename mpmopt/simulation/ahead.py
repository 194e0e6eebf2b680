"""The first start in two processes: Numba compiles one function at a time, and there are two cores.

What one has compiled, the other reads from the disk's cache. So what runs is what would run if each
loop were compiled when it is first called, as it is wherever this cannot help.
"""

from __future__ import annotations

import os
import pickle
import signal
import subprocess
import sys
import threading
from collections.abc import Callable, Sequence
from importlib import import_module
from typing import Any

from mpmopt.kernels.compiler import is_to_compile, types_of
from mpmopt.simulation.threads import processors

# A compiled loop, and arguments of the types that it will be called with.
Call = tuple[Any, tuple[Any, ...]]
# What is compiled here, and meanwhile by the helper.
Round = tuple[Sequence[Call], Sequence[Call]]

_HELPER = (
    "import pickle, sys; sys.path[:] = pickle.load(sys.stdin.buffer); "
    "from mpmopt.simulation.ahead import help_out; help_out()"
)
_lock = threading.Lock()
_asked: set[str] = set()


def compile_in_two(what: str, rounds: Callable[[], Sequence[Round]]) -> None:
    """Compile loops in rounds, here and in a helper; once in a process.

    Not if the helper's last one is compiled already or the disk cannot keep it; nor with one
    processor, or where one thread is asked for, as in the processes of a sweep. What a helper that
    fails leaves is compiled here when it is called.
    """
    if what in _asked:
        return
    with _lock:
        if what not in _asked and processors() > 1 and os.environ.get("MPMOPT_THREADS") != "1":
            _compile(rounds())
        _asked.add(what)


def _compile(rounds: Sequence[Round]) -> None:
    if not is_to_compile(*rounds[-1][1][-1]):
        return
    orders = [
        [(kernel.__module__, kernel.__name__, types_of(kernel, given)) for kernel, given in theirs]
        for _, theirs in rounds
    ]
    command, pipe = [sys.executable, "-c", _HELPER], subprocess.PIPE
    try:
        with subprocess.Popen(
            command, stdin=pipe, stdout=pipe, stderr=subprocess.DEVNULL
        ) as helper:
            assert helper.stdin and helper.stdout
            try:
                helper.stdin.write(pickle.dumps(sys.path) + pickle.dumps(orders))
                helper.stdin.flush()
                for mine, _ in rounds:
                    for kernel, given in mine:
                        kernel.compile(types_of(kernel, given))
                    helper.stdout.readline()
            finally:
                helper.kill()
    except OSError:  # no process, or one that ended before it heard what to do
        return


def help_out() -> None:
    """In the helper: compile what its input asks for, and answer after each round.

    It ends when its input does, which is when the other process ends, in whatever way.
    """
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the other process hears it too, and decides
    orders = pickle.load(sys.stdin.buffer)
    threading.Thread(target=lambda: os._exit(len(os.read(0, 1))), daemon=True).start()
    for order in orders:
        for module, name, types in order:
            getattr(import_module(module), name).compile(types)
        print(flush=True)
