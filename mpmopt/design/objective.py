"""How far the body went: the centroid of its undesigned part in the current configuration."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mpmopt.errors import DesignError
from mpmopt.kernels import parts
from mpmopt.scene import Design, Scene
from mpmopt.scene.particles import Particles, own

States = Mapping[int, NDArray]  # (12, N) each, by the number of steps before it


@dataclass(frozen=True)
class Objective:
    """Where the centroid c = sum_p V_p J_p x_p.e / sum_p V_p J_p of a body ends.

    The sums are over solid and actuator particles, or over those of one region. L is c at the end
    (paper, sec. 2.4). With a transient, L = start + c(end) - c(settled), as if the body had stayed
    where it was till then.

    Attributes
    ----------
    direction : (2,) array
        Unit vector e.
    weight : (N,) array
        Reference volume of the particles that count, zero for others.
    start : float
        Their centroid in the reference configuration.
    instants : tuple of int
        Steps before the states that it looks at, besides the last: the transient's, or none.
    """

    direction: NDArray[np.float64]
    weight: NDArray[np.float64]
    start: float
    instants: tuple[int, ...] = ()

    def __post_init__(self) -> None:
        own(self, "direction", "weight")

    @classmethod
    def of(
        cls,
        scene: Scene,
        particles: Particles,
        direction: tuple[float, float] | None = None,
        region: int | None = None,
    ) -> Objective:
        """The objective of a body that shall go along the scene's, or another, direction.

        Parameters
        ----------
        scene : Scene
        particles : Particles
        direction : (float, float), optional
        region : int, optional
            Number in the scene's body of the region that counts (`check_region`); default: all that
            are not designed.
        """
        e = np.array(scene.direction if direction is None else direction)
        counts = ~particles.designed if region is None else particles.region == region
        weight = np.where(counts, particles.volume, 0.0)
        start = float(weight @ (particles.position @ e) / weight.sum())
        return cls(e, weight, start, (scene.transient_steps,) if scene.transient_steps else ())

    def value(self, states: States) -> Any:
        """L of the states at all instants and at the end, which is the last of them.

        Parameters
        ----------
        states : mapping of int to (12, N) array
            Real or complex.
        """
        value = self.centroid(states[max(states)])
        for settled in self.instants:
            value = value - (self.centroid(states[settled]) - self.start)
        return value

    def terminal_adjoints(self, states: States) -> dict[int, NDArray[np.float64]]:
        """Derivatives of L by the same states, which the reverse loop adds on its way."""
        last = max(states)
        bars = {settled: -self.centroid_adjoint(states[settled]) for settled in self.instants}
        return {**bars, last: self.centroid_adjoint(states[last])}

    def centroid(self, state: NDArray) -> Any:
        """Where a state (12, N) has the centroid, along e."""
        volume = self.weight * _jacobian(state)
        return volume @ (self.direction @ parts(state).position) / volume.sum()

    def centroid_adjoint(self, state: NDArray[np.float64]) -> NDArray[np.float64]:
        """Derivative of c with respect to a state (12, N)."""
        volume = self.weight * _jacobian(state)
        along = self.direction @ parts(state).position
        total = volume.sum()
        bar = np.zeros_like(state)
        parts(bar).position[:] = self.direction[:, None] * volume / total
        J_bar = self.weight * (along - volume @ along / total) / total
        (f00, f01), (f10, f11) = parts(state).deformation
        parts(bar).deformation[:] = J_bar * np.array([[f11, -f10], [-f01, f00]])
        return bar


def check_region(owner: str, scene: Scene, region: int | None) -> None:
    """A region that has a centroid whatever the design, or a DesignError."""
    if region is None:
        return
    last = len(scene.body) - 1
    if not 0 <= region <= last:
        raise DesignError(
            f"{owner}: region = {region} must be the number of a region of the scene's body, from "
            f"0 to {last}"
        )
    if isinstance(scene.body[region], Design):
        raise DesignError(
            f"{owner}: region {region} is a {scene.body[region]}, whose material may go; name a "
            "Solid or an Actuator"
        )
    mirror = scene.mirror
    if mirror is not None and scene.body[region].lower[mirror.normal] >= mirror.position:
        raise DesignError(
            f"{owner}: region {region}, {scene.body[region]}, is beyond the mirror at "
            f"{mirror.axis} = {mirror.position:g} and not simulated; name its image"
        )


def _jacobian(state: NDArray) -> NDArray:
    (f00, f01), (f10, f11) = parts(state).deformation
    return f00 * f11 - f01 * f10
