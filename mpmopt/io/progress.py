"""How far a long command is: a bar on a terminal or below a cell, lines elsewhere.

Bars of a terminal and lines are on standard error.
"""

from __future__ import annotations

import logging
import sys
import time
import weakref
from contextlib import ExitStack, redirect_stderr
from typing import Any, TextIO

from tqdm import tqdm

from mpmopt.io.console import say
from mpmopt.io.notebook import Line, in_notebook

LINES = 10  # of a work whose size is known; of another, one in so many steps


class _Bar(tqdm):  # type: ignore[misc]
    """A bar that has nothing to remove if a Ctrl-C comes while it is made."""

    disable = True  # what tqdm's own, below 4.70, has no value for until then


class Progress:
    """A bar that shows steps of work; off terminals and notebooks, a line now and then.

    While there is a bar on a terminal, log lines and what else goes to standard error are written
    above it.

    Parameters
    ----------
    unit : str
        What is counted, in the plural.
    total : int, optional
        How many there will be.

    Attributes
    ----------
    count : int
        How many are done.
    total : int or None
        How many there will be, as far as it is known.
    """

    def __init__(self, unit: str, total: int | None = None) -> None:
        self._unit, self.total, self.count = unit, total, 0
        self._every = max(1, total // LINES) if total else LINES
        self._began = time.monotonic()
        below_cell = in_notebook()
        stream: Any = Line() if below_cell else sys.stderr
        terminal = not below_cell and stream is not None and stream.isatty()
        self._stream = stream
        self._bar = _Bar(
            total=total,
            unit=f" {unit}",
            disable=not (below_cell or terminal),
            leave=below_cell,
            file=self._stream,
            mininterval=1.0 if below_cell else 0.1,
            ncols=120 if below_cell else None,
        )
        undo = ExitStack()
        if terminal:
            _write_above(self._stream, undo)
        undo.callback(self._bar.close)
        self._end = weakref.finalize(self, undo.close)  # also after an error

    def __enter__(self) -> Progress:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def step(self, text: str = "") -> None:
        """One step more is done; `text` says what it gave."""
        if self._bar.n == 0:  # what was done before took its time before
            self._bar.initial = self._bar.last_print_n = self.count
        self._bar.n, self._bar.total = self.count, self.total
        self.count += 1
        self._bar.set_postfix_str(text, refresh=False)
        self._bar.update()
        if self._bar.disable and self.count % self._every == 0:
            of = f" of {self.total}" if self.total else ""
            seconds = time.monotonic() - self._began
            line = f"{self.count}{of} {self._unit}, {seconds:.0f} s"
            say(f"{line}: {text}" if text else line)

    def close(self) -> None:
        """Remove the bar from a terminal; below a cell it stays as it is."""
        self._end()

    def print(self, line: str) -> None:
        """Print a line of results on standard output, above the bar."""
        with self._bar.external_write_mode(self._stream):
            print(line, flush=True)


def _write_above(terminal: TextIO, undo: ExitStack) -> None:
    """Let whole lines on standard error, those of loggers too, stand above all bars."""
    from tqdm.contrib import DummyTqdmFile  # in a notebook the import warns of missing widgets

    stream: Any = DummyTqdmFile(terminal)
    for logger in (logging.getLogger(), logging.getLogger("mpmopt")):
        for handler in logger.handlers:
            if isinstance(handler, logging.StreamHandler) and handler.stream is terminal:
                undo.callback(handler.setStream, handler.setStream(stream))
    undo.enter_context(redirect_stderr(stream))
