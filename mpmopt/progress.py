"""How far a long command is: a bar on a terminal, lines elsewhere; both on standard error."""

from __future__ import annotations

import sys
import time

from tqdm import tqdm

from mpmopt.interrupt import say

LINES = 10  # of a work whose size is known; of another, one in so many steps


class Progress:
    """A bar that shows steps of work; off a terminal, a line now and then.

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
    """

    def __init__(self, unit: str, total: int | None = None) -> None:
        self._unit, self._total, self.count = unit, total, 0
        self._began = time.monotonic()
        shown = sys.stderr is not None and sys.stderr.isatty()
        self._bar = tqdm(total=total, unit=f" {unit}", disable=not shown, leave=False)

    def __enter__(self) -> Progress:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def step(self, text: str = "") -> None:
        """One step more is done; `text` says what it gave."""
        self._bar.n = self.count
        self.count += 1
        self._bar.set_postfix_str(text, refresh=False)
        self._bar.update()
        if self._bar.disable and self.count % self._every() == 0:
            of = f" of {self._total}" if self._total else ""
            seconds = time.monotonic() - self._began
            line = f"{self.count}{of} {self._unit}, {seconds:.0f} s"
            say(f"{line}: {text}" if text else line)

    def close(self) -> None:
        """Remove the bar."""
        self._bar.close()

    def print(self, line: str) -> None:
        """Print a line of results on standard output, above the bar."""
        with self._bar.external_write_mode(sys.stdout):
            print(line, flush=True)

    def _every(self) -> int:
        return max(1, self._total // LINES) if self._total else LINES
