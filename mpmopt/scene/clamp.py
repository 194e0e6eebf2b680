"""Clamps: rectangles whose nodes are held fixed, or moved along a path."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from mpmopt.errors import SceneError
from mpmopt.scene.parts import Checked, Vector, entries, vector
from mpmopt.validation import number, shown

if TYPE_CHECKING:
    from mpmopt.scene.scene import Scene

MOST_POINTS = 1000
# Cells that a clamp may move by in a step.
FASTEST = 0.2
ROUNDING = 1e-6  # of a cell


@dataclass(frozen=True)
class Clamp(Checked):
    """Rectangle whose nodes, those on its edges too, have the velocity of its path.

    A particle is held to rounding where all of its nodes are: a cell and a half inside. In the
    formulation "total" nodes are material points in the middles of cells, and those that begin at
    most half a cell outside are held for good: so is every cell that is in the rectangle.

    Parameters
    ----------
    lower, upper : (float, float)
        Lower left and upper right corner before it moves.
    path : tuple of (float, (float, float)), optional
        Times, which increase, and how far the rectangle has moved then; straight between them, and
        at rest before the first and after the last. Default: it is held fixed.
    """

    lower: Vector
    upper: Vector
    path: tuple[tuple[float, Vector], ...] = ()

    def __post_init__(self) -> None:
        self._set(
            lower=vector("Clamp", "lower", self.lower), upper=vector("Clamp", "upper", self.upper)
        )
        if not (self.lower[0] < self.upper[0] and self.lower[1] < self.upper[1]):
            raise SceneError(
                f"Clamp: lower corner {self.lower} must be left of and below upper {self.upper}"
            )
        if not isinstance(self.path, (tuple, list)) or len(self.path) > MOST_POINTS:
            raise SceneError(
                f"Clamp: path = {shown(self.path)} must be a tuple of at most {MOST_POINTS} points "
                "(time, (dx, dy))"
            )
        path = [entries("Clamp", "path", point, lambda item: item, 2) for point in self.path]
        path = [(number("Clamp", "path", t), vector("Clamp", "path", d)) for t, d in path]
        if any(b[0] <= a[0] for a, b in pairwise(path)):
            raise SceneError(f"Clamp: times of the path {shown(self.path)} must increase")
        self._set(path=tuple(path))

    def displacement(self, times: Any) -> NDArray[np.float64]:
        """How far it has moved at times (n,): (n, 2)."""
        if not self.path:
            return np.zeros((*np.shape(times), 2))
        at = [t for t, _ in self.path]
        return np.stack(
            [np.interp(times, at, [d[axis] for _, d in self.path]) for axis in (0, 1)], axis=-1
        )

    def rows(self, scene: Scene) -> NDArray[np.float64]:
        """Of every step: the rectangle at its start, a bit wider, and its velocity: (steps, 6)."""
        moved = self.displacement(scene.time_step * np.arange(scene.steps + 1))
        slack = ROUNDING * scene.grid.dx
        corners = np.array(self.lower) - slack, np.array(self.upper) + slack
        velocity = np.diff(moved, axis=0) / scene.time_step
        return np.concatenate([*(corner + moved[:-1] for corner in corners), velocity], axis=1)


def check_clamps(scene: Scene) -> None:
    """Whether clamps stay on the grid, move slowly, and are their own mirror images."""
    dx, size, mirror = scene.grid.dx, scene.grid.size, scene.mirror
    for k, clamp in enumerate(scene.clamps):
        moved = np.array([(0.0, 0.0), *(d for _, d in clamp.path)])
        low, high = moved.min(axis=0) + clamp.lower, moved.max(axis=0) + clamp.upper
        if (low < -ROUNDING * dx).any() or (high > np.array(size) + ROUNDING * dx).any():
            raise SceneError(
                f"Scene: clamp {k} moves within {tuple(low.tolist())} to {tuple(high.tolist())}, "
                f"must stay within (0, 0) to {size}"
            )
        times = np.array([t for t, _ in clamp.path])
        if len(times) > 1:
            speed = float((np.hypot(*np.diff(moved[1:], axis=0).T) / np.diff(times)).max())
            fastest = FASTEST * dx / scene.time_step
            if speed > fastest:
                raise SceneError(
                    f"Scene: clamp {k} moves at {speed:g}, more than {FASTEST:g} cells a step, "
                    f"{fastest:g}; give its path more time, or take a smaller time step"
                )
        if mirror is not None:
            normal = mirror.normal
            image = 2.0 * mirror.position - clamp.upper[normal]
            if abs(image - clamp.lower[normal]) > ROUNDING * dx or moved[:, normal].any():
                raise SceneError(
                    f"Scene: clamp {k} from {clamp.lower} to {clamp.upper} must be its own mirror "
                    f"image about {mirror.axis} = {mirror.position:g} and move along the plane "
                    "alone; simulate the whole body instead"
                )
