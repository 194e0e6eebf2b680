"""Terms of objectives and constraints, each with its value and its derivatives."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from mpmopt.design.objective import Objective
from mpmopt.design.one_piece import OnePiece
from mpmopt.design.term import Adjoints, Outcome, Sum, Term
from mpmopt.errors import DesignError
from mpmopt.scene import Scene
from mpmopt.scene.parts import Checked, Vector, vector
from mpmopt.validation import number


def _centroid(outcome: Outcome, direction: Vector | None) -> Objective:
    simulation = outcome.simulation
    return Objective.of(simulation.scene, simulation.particles, direction)


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
    """

    direction: Vector | None = None

    def __post_init__(self) -> None:
        self._set(direction=_unit("Displacement", self.direction))

    def instants(self, scene: Scene) -> tuple[int, ...]:
        return (scene.transient_steps,) if scene.transient_steps else ()

    def value(self, outcome: Outcome) -> Any:
        return _centroid(outcome, self.direction).value(outcome.states)

    def adjoints(self, outcome: Outcome) -> Adjoints:
        return Adjoints(_centroid(outcome, self.direction).terminal_adjoints(outcome.states))


@dataclass(frozen=True)
class Speed(Term, Checked):
    """Mean velocity of the same centroid after a transient: (c(T) - c(after)) / (T - after).

    Parameters
    ----------
    after : float
        Time from which it counts; rounded to a whole step.
    direction : (float, float), optional
        As in `Displacement`.
    """

    after: float = 0.0
    direction: Vector | None = None

    def __post_init__(self) -> None:
        after = number("Speed", "after", self.after, error=DesignError)
        if after < 0.0:
            raise DesignError(f"Speed: after = {after:g} must not be negative")
        self._set(after=after, direction=_unit("Speed", self.direction))

    def instants(self, scene: Scene) -> tuple[int, ...]:
        first = round(min(self.after / scene.time_step, scene.steps))
        if first == scene.steps:
            raise DesignError(
                f"Speed: after = {self.after:g} takes all of the scene's {scene.duration:g}; take "
                "less, or more steps"
            )
        return (first,)

    def _between(self, outcome: Outcome) -> tuple[int, float]:
        """The first step, and the time from there to the end."""
        scene = outcome.simulation.scene
        (first,) = self.instants(scene)
        return first, max(outcome.end - first, 1) * scene.time_step  # at the first: no speed yet

    def value(self, outcome: Outcome) -> Any:
        centroid = _centroid(outcome, self.direction).centroid
        first, time = self._between(outcome)
        return (centroid(outcome.states[outcome.end]) - centroid(outcome.states[first])) / time

    def adjoints(self, outcome: Outcome) -> Adjoints:
        adjoint = _centroid(outcome, self.direction).centroid_adjoint
        first, time = self._between(outcome)
        end, states = outcome.end, outcome.states
        return Adjoints({first: -adjoint(states[first]) / time, end: adjoint(states[end]) / time})


@dataclass(frozen=True)
class Effort(Term):
    """Mean square of the actuators' signals, over steps and actuators: between 0 and 4."""

    def value(self, outcome: Outcome) -> Any:
        signal = outcome.simulation.signal
        return (signal**2).sum() / max(signal.size, 1)

    def adjoints(self, outcome: Outcome) -> Adjoints:
        signal = outcome.simulation.signal
        return Adjoints(signal=2.0 * signal / max(signal.size, 1))


@dataclass(frozen=True)
class Volume(Term):
    """Share of the design domain that is material: the mean of gamma, between 0 and 1."""

    def value(self, outcome: Outcome) -> Any:
        return outcome.gamma.sum() / max(outcome.gamma.size, 1)

    def adjoints(self, outcome: Outcome) -> Adjoints:
        return Adjoints(gamma=np.full(outcome.gamma.size, 1.0 / max(outcome.gamma.size, 1)))


# What a run file can name.
TERMS: tuple[type[Term], ...] = (Displacement, Speed, Effort, Volume, OnePiece, Sum)
