"""The outline of a design without grey: polygons with holes."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import contourpy
import numpy as np
from matplotlib.path import Path
from numpy.typing import NDArray

from mpmopt.assess.threshold import THRESHOLD, kept
from mpmopt.design.chain import filter_matrix
from mpmopt.design.problem import Problem
from mpmopt.design.projection import edge, edge_at
from mpmopt.scene.particles import discretise, mirror_images

# The filtered design is sampled at so many intervals per particle spacing.
SAMPLES = 4
# Coordinates are whole numbers of this part of a particle spacing, so that what is straight is so
# exactly.
GRAIN = 1024
# So much, in these parts, is cut off a corner that would touch another one.
CUT = 8
# In units of the filtered design, which is within [-1, 1].
SOLID, OUTSIDE = 2.0, -4.0


Part = Literal["body", "passive", "actuator"]


@dataclass(frozen=True)
class Polygon:
    """A piece of a body.

    Attributes
    ----------
    rings : tuple of (n, 2) arrays
        The outer one, anticlockwise, then its holes, clockwise; none repeats its first point.
    """

    rings: tuple[NDArray[np.float64], ...]

    @property
    def area(self) -> float:
        """Area less that of the holes."""
        return sum(signed_area(ring) for ring in self.rings)

    def contains(self, points: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Whether points (M, 2) lie inside, and in none of the holes."""
        inside = [Path(ring).contains_points(points) for ring in self.rings]
        return inside[0] & ~np.any(inside[1:], axis=0)


def signed_area(ring: NDArray) -> float:
    """Area of a ring (n, 2), negative if it is clockwise."""
    (x, y), (x1, y1) = ring.T, np.roll(ring, -1, axis=0).T
    return float(0.5 * np.sum(x * y1 - x1 * y))


def outline(
    problem: Problem,
    x: NDArray[np.float64],
    threshold: float = THRESHOLD,
    keep: NDArray[np.bool_] | None = None,
    part: Part = "body",
) -> list[Polygon]:
    """Where a design is solid: gamma >= threshold, and all regions that are not designed.

    Gamma is a monotonic function of the filtered design, and this a smooth function of position,
    not of particles only. So the outline is one of its level lines, which passes between particles
    that stay and particles that go. With a subpixel projection gamma depends on slopes too: then it
    is the line of the mean slope of edges, and the few particles on its wrong side are drawn or cut
    out with their squares. At the edges of regions it is cut straight. What holds no
    particle is not drawn. Nothing hangs together by a point, and no two edges touch: where corners
    of the body would meet, they are cut by less than a hundredth of a particle's spacing.

    Parameters
    ----------
    problem : Problem
    x : (n,) array
    threshold : float, optional
        Of gamma, between 0 and 1.
    keep : (D,) array of bool, optional
        Design particles that may be drawn; the others are cut out, each with its square.
    part : {"body", "passive", "actuator"}, optional
        What is drawn: the whole body, all of it but its actuators, or its actuators. The last two
        meet along the edges of the actuators' regions.

    Returns
    -------
    list of Polygon
        Largest first, in the scene's unit of length. Of a scene with a mirror, the whole body.

    Raises
    ------
    DesignError
        If x does not fit, or the threshold makes no sense.
    """
    solid = kept(problem, x, threshold)
    drawn = solid if keep is None else solid & keep
    phi, chain = problem.split(x).phi, problem.chain
    level = np.arctanh((2.0 * threshold - 1.0) * np.tanh(chain.beta)) / chain.beta
    wrong = np.zeros(len(solid), dtype=bool)
    if chain.subpixel:
        filtered = chain.filter @ phi
        width, _, _ = edge(filtered, 0.5, chain.differences)
        edges = np.abs(filtered) < width
        level = edge_at(threshold) * float(np.mean(width[edges])) if edges.any() else 0.0
        wrong = solid != (filtered >= level)
    scene, particles = problem.scene, problem.particles
    spacing = scene.grid.dx / scene.particles_per_cell
    body = discretise(scene, whole=True)
    cell = np.floor(body.position / spacing).astype(int)
    low, high = cell.min(axis=0) - 1, cell.max(axis=0) + 2
    image = mirror_images(scene, particles, body)

    def of_all(designed: NDArray[np.bool_], others: bool) -> NDArray[np.bool_]:
        values = np.full(len(particles.position), others)
        values[particles.designed] = designed
        return values[image]

    # Every particle's cell is sampled with both its edges, so that edges between cells are there
    # twice and what differs on their two sides changes over no distance.
    def samples(values: NDArray) -> NDArray:
        return np.repeat(np.repeat(values, SAMPLES + 1, axis=0), SAMPLES + 1, axis=1)

    empty = np.full(high - low, OUTSIDE)
    i, j = (cell - low).T
    empty[i, j] = np.where(body.designed, np.nan, SOLID)
    cut = of_all(solid & ~drawn, False)
    drives = body.actuator >= 0
    shown = {"body": drives | ~drives, "passive": ~drives, "actuator": drives}[part]
    cut |= ~shown
    put = of_all(wrong & drawn, False)
    empty[i[put], j[put]] = SOLID
    cut |= of_all(wrong & ~solid, False)
    empty[i[cut], j[cut]] = OUTSIDE
    field = samples(empty)
    lines = [
        np.add.outer(np.arange(low[k], high[k]), np.arange(SAMPLES + 1) / SAMPLES).ravel()
        for k in (0, 1)
    ]
    row, column = np.nonzero(np.isnan(field))
    points = np.stack([lines[0][row], lines[1][column]], axis=1) * spacing
    field[row, column] = filter_matrix(scene, particles, points) @ phi

    contours = contourpy.contour_generator(
        lines[0] * GRAIN, lines[1] * GRAIN, field.T, fill_type=contourpy.FillType.OuterOffset
    )
    loops = [
        loop
        for coordinates, offsets in zip(*contours.filled(level, 2.0 * SOLID), strict=True)
        for loop in np.split(coordinates, offsets[1:-1])
    ]
    centres = body.position[of_all(drawn, True) & shown]
    polygons = _polygons([ring * (spacing / GRAIN) for ring in _parted(loops)])
    held = [polygon for polygon in polygons if polygon.contains(centres).any()]
    return sorted(held, key=lambda polygon: -polygon.area)


def _parted(loops: list[NDArray[np.float64]]) -> list[NDArray[np.float64]]:
    """Rings of which none touches itself or another, from closed loops with the body on their left.

    Coordinates are rounded to whole numbers. At a point through which several loops pass, or one
    several times, each piece of the body gets a corner of its own, which is cut if it is convex;
    all but one are.
    """
    after: dict[tuple, list[tuple]] = {}
    for loop in loops:
        points = [tuple(point) for point in np.rint(loop).tolist()]
        for start, end in zip(points, points[1:] + points[:1]):
            if start in after.get(end, ()):  # there and back: nothing is between
                after[end].remove(start)
            elif start != end:
                after.setdefault(start, []).append(end)
    edges = {(start, end): None for start, ends in after.items() for end in ends}
    rings = []
    while edges:
        start, end = next(iter(edges))
        ring = []
        while (start, end) in edges:
            del edges[start, end]
            ring.append(start)
            start, end = end, _next(start, end, after[end])
        rings.append(_tidy(np.array(ring)))
    touched = {point for point, ends in after.items() if len(ends) > 1}
    return [_cut(ring, touched) for ring in rings if len(ring)]


def _next(start: tuple, point: tuple, ends: list[tuple]) -> tuple:
    """Where to go on from a point so that what is on the left stays one corner of the body."""

    def direction(other: tuple) -> float:
        return math.atan2(other[1] - point[1], other[0] - point[0])

    return min(ends, key=lambda end: (direction(start) - direction(end)) % (2.0 * math.pi))


def _cut(ring: NDArray[np.float64], touched: set[tuple]) -> NDArray[np.float64]:
    """A ring without its convex corners at points that others touch."""
    to, on = ring - np.roll(ring, 1, axis=0), np.roll(ring, -1, axis=0) - ring
    convex = to[:, 0] * on[:, 1] > to[:, 1] * on[:, 0]
    cut = convex & [tuple(point) in touched for point in ring.tolist()]
    short, long = (
        side * np.minimum(CUT / np.hypot(*side.T), 1.0 / 3.0)[:, None] for side in (to, on)
    )
    points = np.stack([np.where(cut[:, None], ring - short, ring), ring + long], axis=1)
    return points[np.stack([np.ones_like(cut), cut], axis=1)]


def _polygons(rings: list[NDArray[np.float64]]) -> list[Polygon]:
    """Rings that do not touch: each clockwise one is a hole of the least one around it."""
    outer = sorted((ring for ring in rings if signed_area(ring) > 0.0), key=signed_area)
    holes: list[list[NDArray[np.float64]]] = [[] for _ in outer]
    for hole in (ring for ring in rings if signed_area(ring) < 0.0):
        around = (k for k, ring in enumerate(outer) if Path(ring).contains_point(hole[0]))
        if (least := next(around, None)) is not None:  # else a sliver's, thinner than a grain
            holes[least].append(hole)
    return [Polygon((ring, *inside)) for ring, inside in zip(outer, holes)]


def _tidy(ring: NDArray[np.float64]) -> NDArray[np.float64]:
    """A closed ring of whole numbers without repeated points and those on straight lines.

    What is left of one that is thinner than that is nothing.
    """
    points, count = ring, 0
    while count != len(points):
        count = len(points)
        points = points[np.any(points != np.roll(points, 1, axis=0), axis=1)]
        (ax, ay), (bx, by) = (
            (points - np.roll(points, 1, axis=0)).T,
            (np.roll(points, -1, axis=0) - points).T,
        )
        points = points[ax * by != ay * bx]
    return points
