"""What a cell of a notebook shows while it runs. IPython is asked only where it runs already."""

from __future__ import annotations

import sys
from typing import Any


def in_notebook() -> bool:
    """Whether a kernel runs this, whose cells show pictures and can change them."""
    ipython = sys.modules.get("IPython")
    shell = ipython.get_ipython() if ipython is not None else None
    return getattr(shell, "kernel", None) is not None


class Place:
    """A place below a cell, for one thing at a time."""

    def __init__(self) -> None:
        self._handle: Any = None

    def show(self, thing: Any) -> None:
        """Show a thing, as it would be shown at a cell's end, instead of what was there."""
        if self._handle is None:
            display = sys.modules["IPython"].display.display
            self._handle = display(thing, display_id=True)
        else:
            self._handle.update(thing)


class Line:
    """A stream of which a place shows the last line, as terminals do after a carriage return."""

    encoding = "utf-8"

    def __init__(self) -> None:
        self._place = Place()

    def write(self, text: str) -> None:
        """Show what is written; moves of a cursor and blanks are left out."""
        if line := text.replace("\x1b[A", "").strip():
            self._place.show(Text(line))

    def flush(self) -> None:
        """Nothing waits."""


class Text(str):
    """A string that a cell shows as it is, without quotation marks."""

    __slots__ = ()

    def __repr__(self) -> str:
        return str(self)
