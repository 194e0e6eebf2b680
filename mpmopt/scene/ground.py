"""Ground: a polyline that bodies stand on, and the layer above it that bears them."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from mpmopt.errors import SceneError
from mpmopt.scene.parts import Checked, Vector, vector
from mpmopt.validation import number, shown

if TYPE_CHECKING:
    from mpmopt.scene.scene import Scene

Array = NDArray[Any]

MOST_POINTS = 1000
MOST_TOLD = 5  # segments, each of which a scene's text tells
# Directions that differ by less, and lengths in units of the whole polyline's, are the same.
SAME = 1e-9
# What a layer has unless it is given (docs: theory, "Ground"): its thickness over the body's
# shorter side, what it bears over the wave modulus, and the creeping speed and the inverse of the
# damping over the speed of a fall through half of that side.
THICKNESS, BEARING, CREEPING, DAMPING = 0.1, 2.0 / 3.0, 1.0 / 64.0, 1.25


@dataclass(frozen=True)
class Ground(Checked):
    """Rigid ground behind a polyline, which carries bodies by a layer of a physical thickness.

    A particle at a distance d from the ground, less than the thickness, is pushed along the normal
    by `stiffness` (1 - d / thickness) per volume, times its share of the solid's stiffness, so that
    void does not stand; in the total Lagrangian formulation by the mean of that over its width.
    Friction and damping act on the nodes that it moves. A body rests within the layer: place it at
    least a thickness above the points, or the layer throws it off.

    Parameters
    ----------
    points : tuple of (float, float)
        At least two. The solid lies to the right-hand side of the way from the first to the last,
        so a floor goes from left to right, and a ceiling from right to left. The first and the last
        segment have no end.
    friction : float or "stick"
        Coulomb's coefficient; infinite is "stick". What sticks makes objectives rough: prefer a
        finite one.
    thickness : float, optional
        Of the layer; default: a tenth of the body's shorter side.
    stiffness : float, optional
        Pressure over length; default: such that the layer bears a pressure, `stiffness` times
        `thickness` / 2, of two thirds of the wave modulus lambda + 2 mu.
    damping : float, optional
        Inverse speed alpha: a node whose momentum the layer changes by a speed u loses
        alpha u / (1 + alpha u) of its normal velocity. Default: 1.25 / U with U = sqrt(g b) for the
        gravity g and the body's shorter side b, or without gravity a quarter of the wave speed.
    creeping_speed : float, optional
        Below it friction grows with the sliding speed instead of being Coulomb's; default: U / 64.
    """

    points: tuple[Vector, ...]
    friction: float | Literal["stick"] = 0.5
    thickness: float | None = None
    stiffness: float | None = None
    damping: float | None = None
    creeping_speed: float | None = None

    def __post_init__(self) -> None:
        try:
            points = tuple(self.points)
        except TypeError:
            points = ()
        if not 2 <= len(points) <= MOST_POINTS:
            raise SceneError(
                f"Ground: {len(points)} points, must have from 2 to {MOST_POINTS}; take fewer, or "
                "several grounds"
            )
        self._set(points=tuple(vector("Ground", "points", point) for point in points))
        if self.friction != "stick":
            if self.friction == math.inf:
                self._set(friction="stick")
            else:
                self._not_negative('friction (or "stick")', "friction")
        for name in ("thickness", "stiffness", "creeping_speed"):
            value = getattr(self, name)
            if value is not None:
                self._set(**{name: number("Ground", name, value, above=0.0)})
        if self.damping is not None:
            self._not_negative("damping", "damping")
        _check_line(self.line)

    def _not_negative(self, said: str, name: str) -> None:
        value = number("Ground", said, getattr(self, name))
        if value < 0.0:
            raise SceneError(f"Ground: {name} = {value!r} must not be negative")
        self._set(**{name: value})

    @classmethod
    def floor(cls, y: float, friction: float | Literal["stick"] = 0.5, **others: Any) -> Ground:
        """Level ground at a height y; the others are parameters of `Ground`."""
        return cls(((0.0, y), (1.0, y)), friction, **others)

    @classmethod
    def slope(cls, point: Vector, degrees: float, **others: Any) -> Ground:
        """A plane through a point that rises to the right by an angle between -90 and 90."""
        x, y = vector("Ground", "point", point)
        angle = number("Ground", "degrees", degrees)
        if not -90.0 < angle < 90.0:
            raise SceneError(f"Ground: a slope of {angle:g} degrees must be between -90 and 90")
        along = math.cos(math.radians(angle)), math.sin(math.radians(angle))
        return cls(((x, y), (x + along[0], y + along[1])), **others)

    @classmethod
    def heights(cls, x: Sequence[float], heights: Sequence[float], **others: Any) -> Ground:
        """Rough ground: heights at places x, which increase, and straight between them."""
        if len(x) != len(heights) or any(b <= a for a, b in pairwise(x)):
            raise SceneError(
                f"Ground: {len(heights)} heights at {len(x)} places x, which must be as many and "
                "increase"
            )
        return cls(tuple(zip(x, heights)), **others)

    @property
    def line(self) -> Line:
        """The polyline as arrays of its segments."""
        return Line.of(np.array(self.points))

    @property
    def profile(self) -> str:
        """Its shape in words: what each segment does, or how many there are and how high."""
        y = [point[1] for point in self.points]
        if len(y) > MOST_TOLD + 1:
            return f"{len(y) - 1} segments between y = {min(y):.4g} and y = {max(y):.4g}"
        return ", ".join(_told(*ends) for ends in pairwise(self.points))

    def distance(self, place: NDArray) -> tuple[NDArray, NDArray]:
        """Signed distances, positive outside, and unit normals, their gradients.

        Parameters
        ----------
        place : (2, ...) array
            Real or complex.

        Returns
        -------
        (...) array, and (2, ...) array
        """
        return self.line.distance(place)

    def image(self, axis: int, position: float) -> Ground:
        """The mirror image across a plane; the way goes on having the solid on its right."""
        points = np.array(self.points)
        points[:, axis] = 2.0 * position - points[:, axis]
        return dataclasses.replace(self, points=tuple(map(tuple, points[::-1].tolist())))

    def same(self, other: Ground) -> bool:
        """Whether it is the same ground: its ends have no length."""
        if dataclasses.replace(self, points=other.points) != other:
            return False
        if len(self.points) != len(other.points):
            return False
        one, two = self.line, other.line
        ends = [0, -1]
        apart = np.array(one.start[1:]) - two.start[1:]
        if len(self.points) == 2:
            apart = one.normal @ (one.start - two.start).T
        size = SAME * max(1.0, float(np.abs(one.start).max()))
        turned = np.abs(one.along[ends] - two.along[ends]).max()
        return bool(turned <= SAME and np.abs(apart).max(initial=0.0) <= size)


@dataclass(frozen=True)
class Line:
    """S segments of a polyline whose first and last have no end.

    Attributes
    ----------
    start, along, normal : (S, 2) arrays
        First point, unit vectors to the second point and to the free side.
    low, high : (S,) arrays
        Where a segment begins and ends, as distances from its first point.
    corner : (S + 1, 2) array
        At each point the direction that parts its free side from its solid one.
    """

    start: NDArray[np.float64]
    along: NDArray[np.float64]
    normal: NDArray[np.float64]
    low: NDArray[np.float64]
    high: NDArray[np.float64]
    corner: NDArray[np.float64]

    @classmethod
    def of(cls, points: NDArray[np.float64]) -> Line:
        """The segments between points (S + 1, 2)."""
        steps = np.diff(points, axis=0)
        lengths = np.hypot(steps[:, 0], steps[:, 1])
        with np.errstate(invalid="ignore", divide="ignore"):
            along = steps / lengths[:, None]
        normal = np.stack([-along[:, 1], along[:, 0]], axis=1)
        low, high = np.zeros(len(steps)), lengths.copy()
        low[0], high[-1] = -np.inf, np.inf
        corner = np.concatenate([normal[:1], normal[:-1] + normal[1:], normal[-1:]])
        return cls(points[:-1], along, normal, low, high, corner)

    def distance(self, place: NDArray) -> tuple[NDArray, NDArray]:
        """As `Ground.distance`."""
        best = np.full(place.shape[1:], np.inf)
        d, n = np.zeros(place.shape[1:], place.dtype), np.zeros_like(place)
        for k, (a, t, normal) in enumerate(zip(self.start, self.along, self.normal)):
            r = place - a.reshape(2, *(1,) * (place.ndim - 1))
            along = np.real(t[0] * r[0] + t[1] * r[1])
            nearest = np.clip(along, self.low[k], self.high[k])
            gap = np.hypot(np.real(r[0]) - nearest * t[0], np.real(r[1]) - nearest * t[1])
            closer = gap < best
            best = np.where(closer, gap, best)
            # On a segment the distance is that from its line, at a corner that from a point.
            s = [r[0] - nearest * t[0], r[1] - nearest * t[1]]
            corner = self.corner[k + (along > self.high[k])]
            side = np.sign(np.real(corner[..., 0] * s[0] + corner[..., 1] * s[1]))
            flat = (along == nearest) | (gap == 0.0)
            length = np.sqrt(np.where(flat, 1.0, s[0] ** 2 + s[1] ** 2)) * np.where(flat, 1.0, side)
            here = np.where(flat, normal[0] * r[0] + normal[1] * r[1], length)
            d = np.where(closer, here, d)
            for axis in (0, 1):
                away = s[axis] / np.where(length == 0.0, 1.0, length)
                n[axis] = np.where(closer, np.where(flat, normal[axis], away), n[axis])
        return d, n


def _told(start: Vector, end: Vector) -> str:
    """What a segment does, in words."""
    along, rise = end[0] - start[0], end[1] - start[1]
    if abs(rise) <= SAME * abs(along):
        return f"level at y = {start[1]:.4g}"
    if abs(along) <= SAME * abs(rise):
        return f"a step of {abs(rise):.4g} {'up' if rise > 0.0 else 'down'} at x = {start[0]:.4g}"
    angle = math.degrees(math.atan2(rise, abs(along)))
    return f"{'rising' if rise > 0.0 else 'falling'} by {abs(angle):.3g} degrees"


def _check_line(line: Line) -> None:
    """Whether a polyline parts the plane in two."""
    doubled = np.flatnonzero(~np.isfinite(line.along).all(axis=1))
    if doubled.size:
        k = int(doubled[0])
        raise SceneError(
            f"Ground: points {k} and {k + 1} are the same, {shown(tuple(line.start[k]))}; leave "
            "one out"
        )
    back = np.flatnonzero(np.hypot(*line.corner.T) < SAME)
    if back.size:
        k = int(back[0])
        raise SceneError(
            f"Ground: the way turns back at point {k}, {shown(tuple(line.start[k]))}; give what "
            "is there a width"
        )
    count = len(line.start)
    for k in range(count - 2):
        a, t = line.start[k], line.along[k]
        others = slice(k + 2, count)
        between, u = line.start[others] - a, line.along[others]
        cross = t[0] * u[:, 1] - t[1] * u[:, 0]
        offset = t[0] * between[:, 1] - t[1] * between[:, 0]
        with np.errstate(divide="ignore", invalid="ignore"):
            own = (between[:, 0] * u[:, 1] - between[:, 1] * u[:, 0]) / cross
            other = -offset / cross
        meets = (line.low[k] <= own) & (own <= line.high[k])
        meets &= (line.low[others] <= other) & (other <= line.high[others])
        # Segments of one line meet where their ranges do.
        ends = (between @ t)[:, None] + np.stack([line.low[others], line.high[others]], axis=1) * (
            u @ t
        )[:, None]
        same = (np.abs(cross) < SAME) & (np.abs(offset) < SAME * np.abs(between).max(axis=1))
        same &= (ends.min(axis=1) <= line.high[k]) & (ends.max(axis=1) >= line.low[k])
        crossed = np.flatnonzero(np.where(np.abs(cross) < SAME, same, meets))
        if crossed.size:
            other_one = k + 2 + int(crossed[0])
            raise SceneError(
                f"Ground: its segments {k} and {other_one} cross, the first and last of which have "
                "no end; let the way part the plane in two, free on its left and solid on its right"
            )


class Layer(NamedTuple):
    """A ground in its scene: numbers for all that `Ground` leaves open."""

    line: Line
    thickness: float
    stiffness: float
    friction: float  # infinite: sticks
    damping: float
    creeping_speed: float

    @classmethod
    def of(cls, ground: Ground, scene: Scene) -> Layer:
        """With what follows from the scene's body, material and gravity."""
        given, speed = ground.thickness, _speed(scene)
        thickness = THICKNESS * min(scene.extent) if given is None else given
        # The stiffest counts: a layer shall not give way where the body does not.
        modulus = max(each.density * each.wave_speed**2 for each in scene.materials)
        bearing = 2.0 * BEARING * modulus / thickness
        damping, creeping = ground.damping, ground.creeping_speed
        return cls(
            line=ground.line,
            thickness=thickness,
            stiffness=bearing if ground.stiffness is None else ground.stiffness,
            friction=math.inf if ground.friction == "stick" else ground.friction,
            damping=DAMPING / speed if damping is None else damping,
            creeping_speed=CREEPING * speed if creeping is None else creeping,
        )

    def bearing(self, d: Array, width: float) -> Array:
        """Force over capacity of particles at d: the mean over their width, which may be zero."""
        if width == 0.0:
            return np.maximum(1.0 - d / self.thickness, 0.0)
        deepest, inside = self._reach(d, width)
        return inside * (deepest - 0.5 * inside) / (width * self.thickness)

    def stored(self, d: Array, width: float) -> Array:
        """The energy of which `bearing` is the force."""
        if width == 0.0:
            return 0.5 * self.thickness * self.bearing(d, width) ** 2
        deepest, inside = self._reach(d, width)
        return (deepest**3 - (deepest - inside) ** 3) / (6.0 * width * self.thickness)

    def _reach(self, d: Array, width: float) -> tuple[Array, Array]:
        deepest = np.maximum(self.thickness - d + 0.5 * width, 0.0)
        return deepest, np.minimum(deepest, width)


def _speed(scene: Scene) -> float:
    """Of a fall through half of the body's shorter side; without gravity of a slow wave."""
    fall = math.sqrt(math.hypot(*scene.gravity) * min(scene.extent))
    return fall or 0.25 * scene.wave_speed


def check_ground(scene: Scene) -> None:
    """Whether layers are thick and stiff enough, and no body starts inside the ground."""
    dx = scene.grid.dx
    if not scene.ground:
        return
    extent, (gx, gy) = scene.extent, scene.gravity
    # What is let go at the layer's end is pressed, at the deepest, three times as hard as at rest.
    densest = max(material.density for material in scene.materials)
    pressure = densest * (abs(gx) * extent[0] + abs(gy) * extent[1])
    for k, layer in enumerate(scene.layers):
        thickness, bears = layer.thickness, 0.5 * layer.stiffness * layer.thickness
        if thickness < 0.5 * dx * (1.0 - SAME):
            raise SceneError(
                f"Scene: ground {k} has a layer of thickness {thickness:g}, less than half a cell, "
                f"{0.5 * dx:g}; take thickness={0.5 * dx:g} or smaller cells"
            )
        if 3.0 * pressure > bears * (1.0 + SAME):
            raise SceneError(
                f"Scene: the layer of ground {k} bears a pressure of {bears:g}, but a body of this "
                f"height presses with up to {3.0 * pressure:g} when it comes down; take stiffness="
                f"{6.0 * pressure / thickness:g} or more"
            )
        for region in scene.body:
            if _is_inside(layer.line, region.lower, region.upper, 1e-6 * dx):
                raise SceneError(
                    f"Scene: {region} reaches into ground {k}, which is solid to the right of its "
                    f"points; let it start outside, best {thickness:g} above"
                )


def _is_inside(line: Line, lower: Vector, upper: Vector, slack: float) -> bool:
    """Whether some of a rectangle is inside the ground: a corner, or what a segment cuts off."""
    corners = np.array([(x, y) for x in (lower[0], upper[0]) for y in (lower[1], upper[1])])
    d, _ = line.distance(corners.T)
    if d.min() < -slack:
        return True
    low, high = line.low.copy(), line.high.copy()
    for axis in (0, 1):
        start, along = line.start[:, axis], line.along[:, axis]
        first, last = lower[axis] + slack, upper[axis] - slack
        with np.errstate(divide="ignore", invalid="ignore"):
            a, b = (first - start) / along, (last - start) / along
        beside = (start <= first) | (start >= last)
        parallel = along == 0.0
        near = np.where(parallel, np.where(beside, np.inf, -np.inf), np.minimum(a, b))
        far = np.where(parallel, np.where(beside, -np.inf, np.inf), np.maximum(a, b))
        low, high = np.maximum(low, near), np.minimum(high, far)
    return bool((low < high).any())
