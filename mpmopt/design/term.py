"""What an objective or a constraint is made of: a number of a design and of how its body moved."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mpmopt.errors import DesignError
from mpmopt.scene import Scene
from mpmopt.scene.parts import Checked
from mpmopt.simulation.simulation import Simulation
from mpmopt.validation import number, shown


@dataclass(frozen=True)
class Outcome:
    """All that a term may look at.

    Attributes
    ----------
    simulation : Simulation
        With scene, particles (N that were simulated) and ``signal``, the actuators' (steps, K).
    gamma : (D,) array
        Material density of all design particles, simulated or not.
    states : mapping of int to (12, N) array
        By the number of steps before them: those at the instants that terms ask for, and the end.
    """

    simulation: Simulation
    gamma: NDArray
    states: Mapping[int, NDArray]

    @property
    def end(self) -> int:
        """Number of steps before the last state."""
        return max(self.states)


@dataclass(frozen=True)
class Adjoints:
    """Derivatives of a term by what it looked at; what is not there is zero.

    Attributes
    ----------
    states : dict of int to (12, N) array
        Where the adjoint sweep begins; without any there is no sweep.
    signal : (steps, K) array or 0.0
    gamma : (D,) array or 0.0
    density, stiffness : (N,) arrays or 0.0
        Of the particles that were simulated: of a term that simulates by itself.
    """

    states: dict[int, NDArray[np.float64]] = field(default_factory=dict)
    signal: NDArray[np.float64] | float = 0.0
    gamma: NDArray[np.float64] | float = 0.0
    density: NDArray[np.float64] | float = 0.0
    stiffness: NDArray[np.float64] | float = 0.0


class Term:
    """A number of a design and of how its body moved.

    Those of the package are in `terms`. One of your own is a frozen dataclass that has the methods
    `value` and `adjoints`, and `instants` if it looks at more than the end. Terms are added and
    multiplied with numbers: ``Displacement() - 0.1 * Effort()``.
    """

    def instants(self, scene: Scene) -> tuple[int, ...]:
        """Steps before the states that it looks at, besides the last."""
        return ()

    def value(self, outcome: Outcome) -> Any:
        """Its value; complex if the outcome is."""
        raise NotImplementedError

    def adjoints(self, outcome: Outcome) -> Adjoints:
        """Its derivatives, of a real outcome."""
        raise NotImplementedError

    def __add__(self, other: Term) -> Sum:
        return Sum(((1.0, self), (1.0, other)))

    def __mul__(self, weight: float) -> Sum:
        return Sum(((weight, self),))

    def __sub__(self, other: Term) -> Sum:
        return self + -1.0 * other

    __rmul__ = __mul__


@dataclass(frozen=True)
class Sum(Term, Checked):
    """Terms times weights, added.

    Parameters
    ----------
    terms : tuple of (float, Term)
        Weights and terms.
    """

    terms: tuple[tuple[float, Term], ...]

    def __post_init__(self) -> None:
        pairs: Any = self.terms
        try:
            whole = [(weight, term) for weight, term in pairs if isinstance(term, Term)]
        except (TypeError, ValueError):
            whole = []
        if not whole or len(whole) != len(pairs):
            raise DesignError(f"Sum: terms = {shown(pairs)} must be pairs of a weight and a Term")
        weights = [number("Sum", "weight", weight, error=DesignError) for weight, _ in whole]
        self._set(terms=tuple(zip(weights, (term for _, term in whole))))

    def instants(self, scene: Scene) -> tuple[int, ...]:
        return tuple(sorted({step for _, term in self.terms for step in term.instants(scene)}))

    def value(self, outcome: Outcome) -> Any:
        return sum(weight * term.value(outcome) for weight, term in self.terms)

    def adjoints(self, outcome: Outcome) -> Adjoints:
        states: dict[int, NDArray[np.float64]] = {}
        others = dict.fromkeys(("signal", "gamma", "density", "stiffness"), 0.0)
        for weight, term in self.terms:
            bars = term.adjoints(outcome)
            for step, bar in bars.states.items():
                states[step] = weight * bar + states.get(step, 0.0)
            for name in others:
                others[name] = others[name] + weight * getattr(bars, name)
        return Adjoints(states, **others)
