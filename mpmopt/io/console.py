"""How a command ends: SIGINT and SIGTERM end it and say how to go on, errors are one line."""

from __future__ import annotations

import io
import os
import shlex
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from pickle import UnpicklingError
from types import FrameType
from typing import TextIO

from mpmopt.errors import MpmoptError

SIGNALS = (signal.SIGINT, signal.SIGTERM)


class Interrupted(KeyboardInterrupt):
    """A signal that asks the process to end.

    Attributes
    ----------
    code : int
        The exit code that shells give for it: 128 and its number.
    """

    def __init__(self, number: int) -> None:
        super().__init__(f"stopped by {signal.Signals(number).name}")
        self.code = 128 + number


@contextmanager
def interruptible() -> Iterator[None]:
    """Raise `Interrupted` in the main thread at a signal; a second one ends the process at once.

    What is saved is saved at all times (`files.replace_file`), so nothing is lost by either.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return

    heard: list[int] = []

    def raise_it(number: int, frame: FrameType | None) -> None:
        heard.append(number)
        for each in SIGNALS:
            signal.signal(each, signal.SIG_DFL)
        raise Interrupted(number)

    complain = sys.unraisablehook

    again: list[threading.Timer] = []

    def swallowed(what: sys.UnraisableHookArgs) -> None:
        if not isinstance(what.exc_value, Interrupted):
            complain(what)
            return
        # A library's callback swallowed it. It is raised again a moment later.
        for each in SIGNALS:
            signal.signal(each, raise_it)
        main = threading.main_thread().ident
        timer = threading.Timer(0.1, signal.pthread_kill, (main, heard[-1]))
        timer.daemon = True
        timer.start()
        again.append(timer)

    sys.unraisablehook = swallowed
    handlers = {number: signal.signal(number, raise_it) for number in SIGNALS}
    try:
        yield
    except Exception as error:
        # A compiler swallows what is raised in its callbacks, and stumbles over what they left out.
        if heard:
            raise Interrupted(heard[0]) from error
        raise
    else:
        if heard:  # and swallowed, and the work ended before it could be raised again
            raise Interrupted(heard[0])
    finally:
        for timer in again:
            timer.cancel()
            timer.join()
        sys.unraisablehook = complain
        for number, handler in handlers.items():
            signal.signal(number, handler)


def reported(work: Callable[[], int | None], advice: Callable[[], str]) -> int:
    """Do a command's work, or say in a line on standard error why it ended.

    Where standard output has no reader, or there is no memory or no disk, that is said too.
    Characters that standard output cannot have are escaped.

    Parameters
    ----------
    work : callable
        Its exit code, if it returns one, is that of the command.
    advice : callable
        Gives what to do after a signal.

    Returns
    -------
    int
        Exit code: the work's, 1 after an error, or 128 and the number of a signal.
    """
    if isinstance(sys.stdout, io.TextIOWrapper) and sys.stdout.errors == "strict":
        sys.stdout.reconfigure(errors="backslashreplace")
    try:
        with interruptible():
            code = work() or 0
            print(end="", flush=True)  # what has no reader fails here
            return code
    except (EOFError, UnpicklingError) as error:
        say(
            f"{type(error).__name__}: {error}: probably the compiled kernels that Numba kept are "
            "damaged; remove its *.nbi files, in __pycache__ of the package, ~/.cache/numba or "
            "NUMBA_CACHE_DIR"
        )
        return 1
    except (MpmoptError, OSError, MemoryError) as error:
        say(f"{type(error).__name__}: {error}")
        return 1
    except Interrupted as interrupted:
        say(f"\n{interrupted}. {advice()}")
        return interrupted.code
    finally:
        _close(sys.stdout)


def say(line: str) -> None:
    """Print a line on standard error, if anybody can read it: no run ends for want of a reader."""
    if sys.stderr is not None:  # None: it was closed
        with suppress(OSError):
            print(line, file=sys.stderr, flush=True)


def _close(stream: TextIO | None) -> None:
    """Write what a stream still holds, or, if it is broken, let nothing more go there."""
    if stream is None:
        return
    try:
        stream.flush()
    except OSError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), stream.fileno())


def how_to_go_on(path: Path) -> str:
    """Advice to someone whose run was interrupted."""
    if not os.access(path, os.F_OK):
        return "Nothing was computed yet; the same command begins anew."
    again = command("-m", "mpmopt", "resume", str(path))
    return f"Every evaluation is saved; go on with: {again}"


def command(*words: str) -> str:
    """A line to paste into a shell, with the interpreter that runs now."""
    return shlex.join([sys.executable or "python", *words])
