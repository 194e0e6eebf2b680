"""How far the body went: the centroid of its undesigned part in the current configuration."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mpmopt.particles import Particles


@dataclass(frozen=True)
class Objective:
    """L = sum_p V_p J_p x_p.e / sum_p V_p J_p over solid and actuator particles (paper, sec. 2.4).

    Attributes
    ----------
    direction : (2,) array
        Unit vector e.
    weight : (N,) array
        Reference volume of the particles that count, zero for designed ones.
    """

    direction: NDArray[np.float64]
    weight: NDArray[np.float64]

    @classmethod
    def of(cls, particles: Particles, direction: tuple[float, float]) -> Objective:
        """The objective of a body that shall go along `direction`."""
        return cls(np.array(direction), np.where(particles.designed, 0.0, particles.volume))

    def value(self, state: NDArray) -> Any:
        """L of a state (12, N), real or complex."""
        volume = self.weight * (state[8] * state[11] - state[9] * state[10])
        return volume @ (self.direction @ state[0:2]) / volume.sum()

    def seed(self, state: NDArray[np.float64]) -> NDArray[np.float64]:
        """Derivative of L with respect to the state (12, N): where the reverse loop starts."""
        volume = self.weight * (state[8] * state[11] - state[9] * state[10])
        along = self.direction @ state[0:2]
        total = volume.sum()
        bar = np.zeros_like(state)
        bar[0:2] = self.direction[:, None] * volume / total
        J_bar = self.weight * (along - volume @ along / total) / total
        bar[8:12] = J_bar * np.stack([state[11], -state[10], -state[9], state[8]])
        return bar
