"""Terms of objectives and constraints, each with its value and its derivatives."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from mpmopt.design.driven import Driven
from mpmopt.design.objective import check_region
from mpmopt.design.one_piece import OnePiece
from mpmopt.design.places import Distance, Height, PeakHeight, centroid_of, region_number
from mpmopt.design.term import Adjoints, Outcome, Sum, Term
from mpmopt.errors import DesignError
from mpmopt.scene import Scene
from mpmopt.scene.parts import Checked, Vector, vector
from mpmopt.validation import number

# A mean over a period is over so many instants: exact for all harmonics below this one.
LOOKS = 16


def _unit(owner: str, direction: Vector | None) -> Vector | None:
    if direction is None:
        return None
    e = vector(owner, "direction", direction)
    if not abs(np.hypot(*e) - 1.0) <= 1e-9:
        raise DesignError(f"{owner}: direction = {e} has length {np.hypot(*e):.6g}, must have 1")
    return e


@dataclass(frozen=True)
class Displacement(Term, Checked):
    """Where the centroid of solid and actuators ends (`Objective`): the paper's.

    Parameters
    ----------
    direction : (float, float), optional
        Unit vector; default: the scene's. What comes before the scene's transient does not count.
    region : int, optional
        Number in the scene's body of the one region whose centroid it is, no `Design`.
    """

    direction: Vector | None = None
    region: int | None = None

    def __post_init__(self) -> None:
        self._set(
            direction=_unit("Displacement", self.direction),
            region=region_number("Displacement", self.region),
        )

    def instants(self, scene: Scene) -> tuple[int, ...]:
        check_region("Displacement", scene, self.region)
        return (scene.transient_steps,) if scene.transient_steps else ()

    def value(self, outcome: Outcome) -> Any:
        return centroid_of(outcome, self.direction, self.region).value(outcome.states)

    def adjoints(self, outcome: Outcome) -> Adjoints:
        objective = centroid_of(outcome, self.direction, self.region)
        return Adjoints(objective.terminal_adjoints(outcome.states))


@dataclass(frozen=True)
class Speed(Term, Checked):
    """Mean velocity of the same centroid after a transient: (c(T) - c(after)) / (T - after).

    Parameters
    ----------
    after : float
        Time from which it counts; rounded to a whole step.
    direction, region : optional
        As in `Displacement`.
    period : float, optional
        Instead of c(after) and c(T) take the means over the period after the one and before the
        other, so that it does not matter at which phase of its gait a body ends; the time between
        is then T - period - after. Zero: no means.
    """

    after: float = 0.0
    direction: Vector | None = None
    region: int | None = None
    period: float = 0.0

    def __post_init__(self) -> None:
        for name in ("after", "period"):
            value = number("Speed", name, getattr(self, name), error=DesignError)
            if value < 0.0:
                raise DesignError(f"Speed: {name} = {value:g} must not be negative")
            self._set(**{name: value})
        self._set(
            direction=_unit("Speed", self.direction), region=region_number("Speed", self.region)
        )

    def _steps(self, scene: Scene) -> tuple[list[int], list[int]]:
        """Where the motion that counts begins, and where it ends if that is not the end."""
        begin, period = (
            round(min(time / scene.time_step, scene.steps)) for time in (self.after, self.period)
        )
        if begin + max(2 * period, 1) > scene.steps:
            periods = f" and two periods of {self.period:g}" if period else ""
            raise DesignError(
                f"Speed: after = {self.after:g}{periods} takes all of the scene's "
                f"{scene.duration:g}; take less, or more steps"
            )
        if not period:
            return [begin], []
        looks = [k * period // LOOKS for k in range(LOOKS)]
        return [begin + k for k in looks], [scene.steps - period + k for k in looks]

    def instants(self, scene: Scene) -> tuple[int, ...]:
        check_region("Speed", scene, self.region)
        first, last = self._steps(scene)
        return tuple(sorted({*first, *last}))

    def _between(self, outcome: Outcome) -> tuple[list[int], list[int], float]:
        """Where it begins and ends, and the time from there to there."""
        scene = outcome.simulation.scene
        first, last = self._steps(scene)
        last = last or [outcome.end]
        return first, last, max(last[0] - first[0], 1) * scene.time_step  # at the first: 0

    def value(self, outcome: Outcome) -> Any:
        centroid = centroid_of(outcome, self.direction, self.region).centroid
        first, last, time = self._between(outcome)
        begin, end = (
            sum(centroid(outcome.states[step]) for step in steps) / len(steps)
            for steps in (first, last)
        )
        return (end - begin) / time

    def adjoints(self, outcome: Outcome) -> Adjoints:
        adjoint = centroid_of(outcome, self.direction, self.region).centroid_adjoint
        first, last, time = self._between(outcome)
        weights = dict.fromkeys((*first, *last), 0.0)
        for steps, sign in ((first, -1.0), (last, 1.0)):
            for step in steps:
                weights[step] += sign / (time * len(steps))
        return Adjoints({step: w * adjoint(outcome.states[step]) for step, w in weights.items()})


@dataclass(frozen=True)
class Effort(Term, Checked):
    """Mean square of the actuators' signals, over steps and actuators: between 0 and 4."""

    def value(self, outcome: Outcome) -> Any:
        signal = outcome.simulation.signal
        return (signal**2).sum() / max(signal.size, 1)

    def adjoints(self, outcome: Outcome) -> Adjoints:
        signal = outcome.simulation.signal
        return Adjoints(signal=2.0 * signal / max(signal.size, 1))


@dataclass(frozen=True)
class Volume(Term, Checked):
    """Share of the design domain that is material: the mean of gamma, between 0 and 1."""

    def value(self, outcome: Outcome) -> Any:
        return outcome.gamma.sum() / max(outcome.gamma.size, 1)

    def adjoints(self, outcome: Outcome) -> Adjoints:
        return Adjoints(gamma=np.full(outcome.gamma.size, 1.0 / max(outcome.gamma.size, 1)))


# What a run file can name.
TERMS: tuple[type[Term], ...] = (
    Displacement,
    Speed,
    Height,
    PeakHeight,
    Distance,
    Driven,
    Effort,
    Volume,
    OnePiece,
    Sum,
)
