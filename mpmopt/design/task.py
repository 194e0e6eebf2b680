"""What an optimisation does: an objective to maximise, and constraints."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Any

from mpmopt.design.term import Term
from mpmopt.design.terms import TERMS, Displacement
from mpmopt.errors import DesignError
from mpmopt.scene import Scene
from mpmopt.scene.parts import Checked
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
    """An objective and constraints.

    Parameters
    ----------
    maximise : Term, optional
        Default: the displacement.
    subject_to : tuple of AtMost, optional
        Or a single one.

    Raises
    ------
    DesignError
        If one is no term, or no constraint.

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

    def __post_init__(self) -> None:
        instance("Task", "maximise", self.maximise, Term, "such as Displacement()")
        given: Any = self.subject_to
        constraints = tuple(given) if isinstance(given, Iterable) else (given,)
        for constraint in constraints:
            instance("Task", "subject_to", constraint, AtMost, "such as AtMost(Volume(), 0.4)")
        self._set(subject_to=constraints)

    @property
    def terms(self) -> tuple[Term, ...]:
        """The objective and the constraints' terms."""
        return (self.maximise, *(constraint.term for constraint in self.subject_to))

    def instants(self, scene: Scene) -> tuple[int, ...]:
        """Steps before the states that any term looks at, besides the last."""
        return tuple(sorted({step for term in self.terms for step in term.instants(scene)}))

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
_KINDS = {kind.__name__: kind for kind in (Task, AtMost, *TERMS)}


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
