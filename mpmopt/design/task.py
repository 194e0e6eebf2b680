"""What an optimisation does: objective, constraints, scenes they hold in, what is not free."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mpmopt.design.driven import Driven
from mpmopt.design.term import Sum, Term
from mpmopt.design.terms import TERMS, Displacement, Speed
from mpmopt.design.variables import Bounded, Frozen, Restriction, Tied
from mpmopt.design.variation import Variation
from mpmopt.errors import DesignError
from mpmopt.scene import Ground, Scene
from mpmopt.scene.parts import Checked, Vector
from mpmopt.validation import instance, number, shown

# A constraint counts as met up to this, in its own scale: moving asymptotes come from outside.
FEASIBLE = 1e-3


@dataclass(frozen=True)
class AtMost(Checked):
    """A constraint: a term that must not be above a bound.

    Parameters
    ----------
    term : Term
    bound : float
        In the term's unit.
    """

    term: Term
    bound: float

    def __post_init__(self) -> None:
        instance("AtMost", "term", self.term, Term, "such as Volume()")
        self._set(bound=number("AtMost", "bound", self.bound, error=DesignError))

    def __str__(self) -> str:
        return f"{self.term} at most {self.bound:g}"

    @property
    def scale(self) -> float:
        """What g is measured in: the size of the bound, or 1 where that is 0."""
        return abs(self.bound) or 1.0

    def g(self, value: Any) -> Any:
        """(value - bound) / scale, which must be <= 0."""
        return (value - self.bound) / self.scale


@dataclass(frozen=True)
class Task(Checked):
    """An objective and constraints, in one scene or in an ensemble of scenes.

    In an ensemble each scene has its own value L of the objective. What is maximised is their soft
    minimum, -log(mean(exp(-k L))) / k, and a constraint holds in all scenes: its value is that of
    the scene that meets it worst.

    Parameters
    ----------
    maximise : Term, optional
        Default: the displacement.
    subject_to : tuple of AtMost, optional
        Or a single one.
    scenes : tuple of Variation, optional
        The ensemble, by what differs from the scene; none: the scene as it is.
    soft_minimum : float, optional
        Sharpness k, in units of 1 / L: 0 is the mean, large ones tend to the worst scene.
    variables : tuple of Frozen, Bounded or Tied, optional
        Which variables an optimiser may not choose within all of [-1, 1]. It moves its start there
        (`Freedom`).

    Raises
    ------
    DesignError
        If one is no term, constraint, scene or restriction, or the sharpness is negative.

    Examples
    --------
    >>> from mpmopt.design.task import AtMost, Task
    >>> from mpmopt.design.terms import Effort, Speed, Volume
    >>> task = Task(Speed(after=0.5) - 0.01 * Effort(), AtMost(Volume(), 0.4))
    >>> Task.from_json(task.to_json()) == task
    True
    """

    maximise: Term = field(default_factory=Displacement)
    subject_to: tuple[AtMost, ...] = ()
    scenes: tuple[Variation, ...] = ()
    soft_minimum: float = 0.0
    variables: tuple[Restriction, ...] = ()

    def __post_init__(self) -> None:
        instance("Task", "maximise", self.maximise, Term, "such as Displacement()")
        for name, kind, such in (
            ("subject_to", AtMost, "such as AtMost(Volume(), 0.4)"),
            ("scenes", Variation, "such as Variation(friction=0.3)"),
            ("variables", Restriction, 'such as Frozen("theta")'),
        ):
            given: Any = getattr(self, name)
            items = tuple(given) if isinstance(given, Iterable) else (given,)
            for item in items:
                instance("Task", name, item, kind, such)
            self._set(**{name: items})
        sharpness = number("Task", "soft_minimum", self.soft_minimum, error=DesignError)
        if sharpness < 0.0:
            raise DesignError(f"Task: soft_minimum = {sharpness:g} must not be negative")
        self._set(soft_minimum=sharpness)

    @property
    def terms(self) -> tuple[Term, ...]:
        """The objective and the constraints' terms."""
        return (self.maximise, *(constraint.term for constraint in self.subject_to))

    def instants(self, scene: Scene) -> tuple[int, ...]:
        """Steps before the states that any term looks at, besides the last."""
        return tuple(sorted({step for term in self.terms for step in term.instants(scene)}))

    @property
    def alone(self) -> Task:
        """The same in a single scene."""
        return Task(self.maximise, self.subject_to)

    def travels(self, scene: Scene) -> bool:
        """Whether it is travel along the scene's direction that it maximises, among others."""
        return _travels(self.maximise, scene.direction)

    def soft(self, values: NDArray) -> tuple[Any, NDArray]:
        """The soft minimum of the objective's values in all scenes, and its derivatives by them."""
        lowest = values[np.argmin(values.real)]
        shares = np.exp(-self.soft_minimum * (values - lowest))
        weights = shares / shares.sum()
        if self.soft_minimum == 0.0:
            return values.sum() / values.size, weights
        return lowest - np.log(shares.sum() / values.size) / self.soft_minimum, weights

    def violation(self, values: Iterable[float]) -> float:
        """The largest g of constraints with these values, or 0 if all are met (`FEASIBLE`)."""
        g = [constraint.g(value) for constraint, value in zip(self.subject_to, values)]
        worst = max(g, default=0.0)
        return 0.0 if worst <= FEASIBLE else float(worst)

    def to_json(self) -> str:
        """The task as JSON text.

        Raises
        ------
        DesignError
            If a term is of no class that `terms.TERMS` names.
        """
        return json.dumps(_plain(self))

    @staticmethod
    def from_json(text: str) -> Task:
        """The task that `to_json` wrote.

        Raises
        ------
        DesignError
            If the text is no JSON, or no task.
        """
        try:
            task = _made(json.loads(text))
        except (ValueError, TypeError, RecursionError) as error:
            raise DesignError(f"Task: {shown(text)} is no task: {error}") from error
        instance("Task", "text", task, Task)
        made: Task = task
        return made


DEFAULT_TASK = Task()
_KINDS = {
    kind.__name__: kind for kind in (Task, AtMost, Variation, Ground, Frozen, Bounded, Tied, *TERMS)
}


def _travels(term: Term, direction: Vector) -> bool:
    if isinstance(term, Sum):
        return any(weight > 0.0 and _travels(part, direction) for weight, part in term.terms)
    if isinstance(term, Driven):
        return _travels(term.term, direction)
    return isinstance(term, (Displacement, Speed)) and term.direction in (None, direction)


def _plain(value: Any) -> Any:
    """What JSON knows, of dataclasses with the names of their classes."""
    if isinstance(value, tuple):
        return [_plain(item) for item in value]
    if not dataclasses.is_dataclass(value):
        return value
    kind = type(value).__name__
    if _KINDS.get(kind) is not type(value):
        raise DesignError(
            f"{kind} is not known to run files: add it to TERMS in mpmopt/design/terms.py"
        )
    names = (item.name for item in dataclasses.fields(value))
    return {"kind": kind, **{name: _plain(getattr(value, name)) for name in names}}


def _made(data: Any) -> Any:
    if isinstance(data, list):
        return tuple(_made(item) for item in data)
    if not isinstance(data, dict):
        return data
    values = {name: _made(value) for name, value in data.items()}
    kind = values.pop("kind", None)
    if not isinstance(kind, str) or kind not in _KINDS:
        raise DesignError(f"Task: kind = {shown(kind)} must be one of {', '.join(sorted(_KINDS))}")
    return _KINDS[kind](**values)
