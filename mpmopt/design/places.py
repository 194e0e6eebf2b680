"""Terms of where a part of a body is: its height, how high it gets, its distance to a target."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mpmopt.design.objective import Objective, check_region
from mpmopt.design.term import Adjoints, Outcome, Term
from mpmopt.errors import DesignError
from mpmopt.scene import Scene
from mpmopt.scene.parts import Checked, Vector, vector
from mpmopt.validation import count, number

# A greatest height is sought at so many instants at equal intervals.
LOOKS = 32
# Over the body's height: how soft that maximum is.
SOFTNESS = 0.01
# Over the grid's longer side: a distance is smooth within this.
NEAR = 1e-3

UP = (0.0, 1.0)


def centroid_of(outcome: Outcome, direction: Vector | None, region: int | None) -> Objective:
    """The centroid, along a direction, of all that is not designed or of one region."""
    simulation = outcome.simulation
    return Objective.of(simulation.scene, simulation.particles, direction, region)


def region_number(owner: str, region: int | None) -> int | None:
    """A whole number from 0, or None, or a DesignError."""
    return None if region is None else count(owner, "region", region, 0, error=DesignError)


def _time(owner: str, name: str, value: float | None) -> float | None:
    if value is None:
        return None
    time = number(owner, name, value, error=DesignError)
    if time < 0.0:
        raise DesignError(f"{owner}: {name} = {time:g} must not be negative")
    return time


def _instants(owner: str, scene: Scene, at: float | None) -> tuple[int, ...]:
    """The step at a time; none for the end."""
    if at is None:
        return ()
    step = round(min(at / scene.time_step, scene.steps + 1))
    if step > scene.steps:
        raise DesignError(
            f"{owner}: at = {at:g} is after the scene's end at {scene.duration:g}; take less, or "
            "more steps"
        )
    return (step,)


def _look(outcome: Outcome, instants: tuple[int, ...]) -> int:
    return instants[0] if instants else outcome.end


@dataclass(frozen=True)
class Height(Term, Checked):
    """Height y of the centroid of solid and actuators.

    Parameters
    ----------
    at : float, optional
        Time, rounded to a whole step; default: the end.
    region : int, optional
        Number in the scene's body of the one region whose centroid it is, no `Design`.
    """

    at: float | None = None
    region: int | None = None

    def __post_init__(self) -> None:
        self._set(at=_time("Height", "at", self.at), region=region_number("Height", self.region))

    def instants(self, scene: Scene) -> tuple[int, ...]:
        check_region("Height", scene, self.region)
        return _instants("Height", scene, self.at)

    def value(self, outcome: Outcome) -> Any:
        step = _look(outcome, self.instants(outcome.simulation.scene))
        return centroid_of(outcome, UP, self.region).centroid(outcome.states[step])

    def adjoints(self, outcome: Outcome) -> Adjoints:
        step = _look(outcome, self.instants(outcome.simulation.scene))
        adjoint = centroid_of(outcome, UP, self.region).centroid_adjoint
        return Adjoints({step: adjoint(outcome.states[step])})


@dataclass(frozen=True)
class PeakHeight(Term, Checked):
    """How high the same centroid gets: s log of the mean of exp(y / s) over instants.

    A soft maximum over 32 instants, with s a hundredth of the body's height: at most s log 32 less
    than the highest of them, and the same if all are one.

    Parameters
    ----------
    after : float, optional
        Time before which it does not count.
    region : int, optional
        As in `Height`.
    """

    after: float = 0.0
    region: int | None = None

    def __post_init__(self) -> None:
        self._set(
            after=_time("PeakHeight", "after", self.after),
            region=region_number("PeakHeight", self.region),
        )

    def _looks(self, scene: Scene) -> list[int]:
        (first,) = _instants("PeakHeight", scene, self.after)
        return sorted({round(step) for step in np.linspace(first, scene.steps, LOOKS + 1)[1:]})

    def instants(self, scene: Scene) -> tuple[int, ...]:
        check_region("PeakHeight", scene, self.region)
        return tuple(step for step in self._looks(scene) if step < scene.steps)

    def _shares(self, outcome: Outcome) -> tuple[dict[int, Any], Any]:
        """Derivative of the peak by the height at each instant, and the peak."""
        scene = outcome.simulation.scene
        softness = SOFTNESS * scene.extent[1]
        centroid = centroid_of(outcome, UP, self.region).centroid
        looks = [step for step in self._looks(scene) if step in outcome.states]
        y = np.array([centroid(outcome.states[step]) for step in looks])
        top = y.real.max()
        share = np.exp((y - top) / softness)
        peak = top + softness * np.log(share.mean())
        return dict(zip(looks, share / share.sum())), peak

    def value(self, outcome: Outcome) -> Any:
        return self._shares(outcome)[1]

    def adjoints(self, outcome: Outcome) -> Adjoints:
        adjoint = centroid_of(outcome, UP, self.region).centroid_adjoint
        shares, _ = self._shares(outcome)
        return Adjoints({s: share * adjoint(outcome.states[s]) for s, share in shares.items()})


@dataclass(frozen=True)
class Distance(Term, Checked):
    """How far the centroid of solid and actuators is from a target, to be made small.

    sqrt(d^2 + s^2) - s of the distance d, which is smooth at the target; s is a thousandth of the
    grid's longer side. Way-points are several, each at its time, added.

    Parameters
    ----------
    target : (float, float)
    at : float, optional
        Time, rounded to a whole step; default: the end.
    region : int, optional
        As in `Height`.
    """

    target: Vector
    at: float | None = None
    region: int | None = None

    def __post_init__(self) -> None:
        self._set(
            target=vector("Distance", "target", self.target),
            at=_time("Distance", "at", self.at),
            region=region_number("Distance", self.region),
        )

    def instants(self, scene: Scene) -> tuple[int, ...]:
        check_region("Distance", scene, self.region)
        return _instants("Distance", scene, self.at)

    def _offset(self, outcome: Outcome) -> tuple[int, NDArray, Any]:
        """The step, the way from the target (2,), and sqrt(d^2 + s^2)."""
        scene = outcome.simulation.scene
        step = _look(outcome, self.instants(scene))
        state = outcome.states[step]
        way = np.array([
            centroid_of(outcome, axis, self.region).centroid(state) - target
            for axis, target in zip(((1.0, 0.0), UP), self.target)
        ])  # fmt: skip
        return step, way, np.sqrt((way**2).sum() + (NEAR * max(scene.grid.size)) ** 2)

    def value(self, outcome: Outcome) -> Any:
        return self._offset(outcome)[2] - NEAR * max(outcome.simulation.scene.grid.size)

    def adjoints(self, outcome: Outcome) -> Adjoints:
        step, way, length = self._offset(outcome)
        # That of the centroid along way / length, whose length need not be 1.
        x, y = way / length
        adjoint = centroid_of(outcome, (x, y), self.region).centroid_adjoint
        return Adjoints({step: adjoint(outcome.states[step])})
