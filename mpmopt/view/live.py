"""What is seen of an optimisation while it runs."""

from __future__ import annotations

import time
from importlib import import_module
from typing import Any

from mpmopt.io.notebook import Place, in_notebook
from mpmopt.io.progress import Progress
from mpmopt.optimisation.history import Optimisation
from mpmopt.validation import digits

# Pictures come no sooner after each other than this, in seconds, and take no more than this share
# of the time.
PAUSE, SHARE = 1.0, 0.1


class ProgressBar:
    """Callback of `optimise` that shows how far it is.

    On a terminal that is a bar; in a notebook also the best design so far and the history, below
    it; elsewhere a line in ten evaluations. Each says what the last evaluation was and what the
    best is that meets all constraints.
    """

    def __init__(self) -> None:
        self._progress = Progress("evaluations")
        self._origin: float | None = None
        self._picture = None
        if in_notebook():
            self._picture = Place()
            import_module("mpmopt.view.plot")  # which would count as the first picture's time
        self._next = 0.0

    def __call__(self, run: Optimisation) -> None:
        if run.stop_reason:
            self._progress.close()
            self._draw(run)
            return
        if self._origin is None:
            self._origin = run.origin
        self._progress.count = len(run.history) - 1
        self._progress.total = most_evaluations(run)
        self._progress.step(_said(run, self._origin))
        if time.monotonic() >= self._next:
            self._draw(run)

    def _draw(self, run: Optimisation) -> None:
        if self._picture is None or not run.best:
            return
        began = time.monotonic()
        self._picture.show(run)
        ended = time.monotonic()
        self._next = ended + max(PAUSE, (ended - began) / SHARE)


def _said(run: Optimisation, origin: float) -> str:
    """The last evaluation, and the best that meets all constraints: what the run would give now."""
    last = run.history[-1]
    now = "failed" if last.failure else f"{run.measure} {digits(last.objective - origin, 3)}"
    best = "none feasible"
    if run.best and run.result.violation == 0.0:
        best = f"best {digits(run.result.objective - origin, 3)}"
    return f"{now}, {best}, beta {last.beta:g}, grey {last.non_discreteness:.2f}"


def watched(callbacks: list[Any]) -> list[Any]:
    """The callbacks, and in a notebook a `ProgressBar`, if there is none yet."""
    if not in_notebook() or any(isinstance(each, ProgressBar) for each in callbacks):
        return callbacks
    return [*callbacks, ProgressBar()]


def most_evaluations(run: Optimisation) -> int:
    """How many evaluations a run will have had if no stage ends early from now on."""
    settings, now = run.settings, run.stage
    limits = [stage.most_iterations or settings.most_iterations for stage in settings.stages]
    done = sum(item.stage == now and not item.failure for item in run.history)
    return len(run.history) + max(limits[now] - done, 0) + sum(limits[now + 1 :])
