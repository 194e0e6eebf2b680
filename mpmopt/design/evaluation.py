"""A design evaluated: value, gradients, and how close the run came to failure."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mpmopt.simulation.indicators import Indicators


@dataclass(frozen=True)
class Evaluation:
    """A design evaluated, and how.

    Attributes
    ----------
    value : float or complex
        Objective L.
    gradient : (n,) array
        Empty if only the value was asked for.
    indicators : Indicators
        Of the run that counts.
    time_step : float
        Of that run.
    halved : int
        How often the step was halved to get there.
    constraints : (m,) array
        Values of the constraints' terms, in the task's order.
    jacobian : (m, n) array
        Their gradients; empty if only values were asked for.
    scenes : tuple of float
        The objective in each scene of the task; empty if it has one.
    """

    value: Any
    gradient: NDArray[np.float64]
    indicators: Indicators
    time_step: float
    halved: int = 0
    constraints: NDArray = field(default_factory=lambda: np.empty(0))
    jacobian: NDArray[np.float64] = field(default_factory=lambda: np.empty((0, 0)))
    scenes: tuple[float, ...] = ()

    @property
    def gradients(self) -> NDArray[np.float64]:
        """Those of the objective and of the constraints' terms (1 + m, n)."""
        return np.vstack([self.gradient, *self.jacobian])
