"""How far the body went: the centroid of its undesigned part in the current configuration."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mpmopt.particles import Particles, own


@dataclass(frozen=True)
class Objective:
    """Where the centroid c = sum_p V_p J_p x_p.e / sum_p V_p J_p of a body ends.

    The sums are over solid and actuator particles. L is c at the end (paper, sec. 2.4). With a
    transient, L = start + c(end) - c(settled), as if the body had stayed where it was till then.

    Attributes
    ----------
    direction : (2,) array
        Unit vector e.
    weight : (N,) array
        Reference volume of the particles that count, zero for designed ones.
    start : float
        Their centroid in the reference configuration.
    """

    direction: NDArray[np.float64]
    weight: NDArray[np.float64]
    start: float

    def __post_init__(self) -> None:
        own(self, "direction", "weight")

    @classmethod
    def of(cls, particles: Particles, direction: tuple[float, float]) -> Objective:
        """The objective of a body that shall go along `direction`."""
        weight = np.where(particles.designed, 0.0, particles.volume)
        along = particles.position @ np.array(direction)
        return cls(np.array(direction), weight, float(weight @ along / weight.sum()))

    def value(self, state: NDArray, settled: NDArray | None = None) -> Any:
        """L of a final state and, if there is one, of that after the transient.

        Parameters
        ----------
        state, settled : (12, N) arrays
            Real or complex.
        """
        if settled is not None:
            return self.value(state) - (self.value(settled) - self.start)
        volume = self.weight * (state[8] * state[11] - state[9] * state[10])
        return volume @ (self.direction @ state[0:2]) / volume.sum()

    def seed(self, state: NDArray[np.float64]) -> NDArray[np.float64]:
        """Derivative of c with respect to a state (12, N): where the reverse loop starts.

        That of L with respect to the state after the transient is minus this.
        """
        volume = self.weight * (state[8] * state[11] - state[9] * state[10])
        along = self.direction @ state[0:2]
        total = volume.sum()
        bar = np.zeros_like(state)
        bar[0:2] = self.direction[:, None] * volume / total
        J_bar = self.weight * (along - volume @ along / total) / total
        bar[8:12] = J_bar * np.stack([state[11], -state[10], -state[9], state[8]])
        return bar
