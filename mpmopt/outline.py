"""The outline of a design without grey: polygons with holes."""

from __future__ import annotations

from dataclasses import dataclass

import contourpy
import numpy as np
from matplotlib.path import Path
from numpy.typing import NDArray

from mpmopt.binary import THRESHOLD, kept
from mpmopt.design import filter_matrix
from mpmopt.particles import lay_out, mirror_images
from mpmopt.problem import Problem

# The filtered design is sampled at so many intervals per particle spacing.
SAMPLES = 4
# Coordinates are whole numbers of this part of a particle spacing, so that what is straight is so
# exactly.
GRAIN = 1024
# In units of the filtered design, which is within [-1, 1].
SOLID, OUTSIDE = 2.0, -4.0


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
) -> list[Polygon]:
    """Where a design is solid: gamma >= threshold, and all regions that are not designed.

    Gamma is a monotonic function of the filtered design, and this a smooth function of position,
    not of particles only. So the outline is one of its level lines, which passes between particles
    that stay and particles that go. At the edges of regions it is cut straight. What holds no
    particle is not drawn.

    Parameters
    ----------
    problem : Problem
    x : (n,) array
    threshold : float, optional
        Of gamma, between 0 and 1.
    keep : (D,) array of bool, optional
        Design particles that may be drawn; the others are cut out, each with its square.

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
    phi, beta = problem.split(x).phi, problem.chain.beta
    level = np.arctanh((2.0 * threshold - 1.0) * np.tanh(beta)) / beta
    scene, particles = problem.scene, problem.particles
    spacing = scene.grid.dx / scene.particles_per_cell
    body = lay_out(scene, whole=True)
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
    centres = body.position[of_all(drawn, True)]
    polygons = []
    for coordinates, offsets in zip(*contours.filled(level, 2.0 * SOLID), strict=True):
        rings = [_tidy(ring) * (spacing / GRAIN) for ring in np.split(coordinates, offsets[1:-1])]
        polygon = Polygon(tuple(ring for ring in rings if len(ring)))
        if len(rings[0]) and polygon.contains(centres).any():
            polygons.append(polygon)
    return sorted(polygons, key=lambda polygon: -polygon.area)


def _tidy(ring: NDArray[np.float64]) -> NDArray[np.float64]:
    """A closed ring rounded to whole numbers, without repeated points and those on straight lines.

    What is left of one that is thinner than that is nothing.
    """
    points = np.rint(ring)
    count = 0
    while count != len(points):
        count = len(points)
        points = points[np.any(points != np.roll(points, 1, axis=0), axis=1)]
        (ax, ay), (bx, by) = (
            (points - np.roll(points, 1, axis=0)).T,
            (np.roll(points, -1, axis=0) - points).T,
        )
        points = points[ax * by != ay * bx]
    return points
