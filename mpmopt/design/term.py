"""What an objective or a constraint is made of: a number of a design and of how its body moved."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from mpmopt.scene import Scene
from mpmopt.simulation.simulation import Simulation

if TYPE_CHECKING:
    from mpmopt.design.terms import Sum


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
    """

    states: dict[int, NDArray[np.float64]] = field(default_factory=dict)
    signal: NDArray[np.float64] | float = 0.0
    gamma: NDArray[np.float64] | float = 0.0


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
        from mpmopt.design.terms import Sum

        return Sum(((1.0, self), (1.0, other)))

    def __mul__(self, weight: float) -> Sum:
        from mpmopt.design.terms import Sum

        return Sum(((weight, self),))

    def __sub__(self, other: Term) -> Sum:
        return self + -1.0 * other

    __rmul__ = __mul__
