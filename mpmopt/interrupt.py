"""How a command ends: SIGINT and SIGTERM end it within a second and say how to go on."""

from __future__ import annotations

import os
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from types import FrameType

from mpmopt.errors import MpmoptError

SIGNALS = (signal.SIGINT, signal.SIGTERM)
# Seconds in which the process may leave what it is at; some of a compiler's calls take longer.
GRACE = 0.7


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
def interruptible(advice: str) -> Iterator[None]:
    """Raise `Interrupted` where the main thread is at a signal, and end the process if that hangs.

    What is saved is saved at all times (`files.replace_file`), so nothing is lost by an end where
    the main thread is inside a compiler or a library.

    Parameters
    ----------
    advice : str
        What to print if the process is ended from outside the main thread.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return

    def raise_it(number: int, frame: FrameType | None) -> None:
        raise Interrupted(number)

    reader, writer = os.pipe()
    os.set_blocking(writer, False)
    over = threading.Event()

    def watch() -> None:
        number = os.read(reader, 1)
        while number and number[0] not in SIGNALS:
            number = os.read(reader, 1)
        if not number or over.wait(GRACE):
            return
        interrupted = Interrupted(number[0])
        print(f"\n{interrupted}. {advice}", file=sys.stderr, flush=True)
        os._exit(interrupted.code)

    handlers = {number: signal.signal(number, raise_it) for number in SIGNALS}
    before = signal.set_wakeup_fd(writer, warn_on_full_buffer=False)
    watcher = threading.Thread(target=watch, daemon=True)
    watcher.start()
    try:
        yield
    finally:
        over.set()
        signal.set_wakeup_fd(before)
        for number, handler in handlers.items():
            signal.signal(number, handler)
        os.close(writer)
        watcher.join()
        os.close(reader)


def reported(work: Callable[[], int | None], advice: str) -> int:
    """Do a command's work, or say in a line on standard error why it ended.

    Parameters
    ----------
    work : callable
        Its exit code, if it returns one, is that of the command.
    advice : str
        What to do after a signal.

    Returns
    -------
    int
        Exit code: the work's, 1 after an error of this package, or 128 and the number of a signal.
    """
    try:
        with interruptible(advice):
            return work() or 0
    except MpmoptError as error:
        print(f"{type(error).__name__}: {error}", file=sys.stderr)
        return 1
    except Interrupted as interrupted:
        print(f"\n{interrupted}. {advice}", file=sys.stderr)
        return interrupted.code


def how_to_go_on(path: Path) -> str:
    """Advice to someone whose run was interrupted."""
    return f"Every evaluation is saved; go on with: python -m mpmopt resume {path}"
