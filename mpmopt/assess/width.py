"""How thin the members of an outline are, and how narrow its gaps: the length scale that it has."""

from __future__ import annotations

import math
from collections.abc import Sequence
from importlib import import_module
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import brentq
from scipy.special import ndtr, ndtri

from mpmopt.errors import DesignError, MissingLibraryError
from mpmopt.scene import Scene

# Widths are sought from this share of the outline's diagonal on, in steps of this ratio.
LEAST, RATIO = 1e-3, 1.15
HALVINGS = 14  # of the last step
SEGMENTS = 64  # of a disc
GROWN = 1.02  # so that a disc of straight segments fills what a round one would
# In which offsets are taken: the library rounds to a millionth of one.
DIAGONAL = 1000.0


def least_width(scene: Scene, threshold: float) -> float:
    """Width of the thinnest straight bar that is there when the design is eroded.

    The filter spreads a bar as a Gaussian of the same variance would (theory, eq. bar): so this is
    the width, at a threshold of 1/2, of a bar whose filtered density just reaches `threshold`
    (Wang, Lazarov and Sigmund, 2011; for a Gaussian). Of a gap that is there when the design is
    dilated it is that of 1 - threshold. Along an edge of a design region both may be about half as
    wide, since the filter sees nothing beyond.

    Parameters
    ----------
    scene : Scene
        Whose filter it is.
    threshold : float
        Of the eroded design, between 1/2 and 1.

    Returns
    -------
    float
        In the scene's unit of length.

    Raises
    ------
    DesignError
        If the threshold is not between 1/2 and 1.
    """
    if not 0.5 < threshold < 1.0:
        raise DesignError(f"least_width: threshold = {threshold:g} must be between 1/2 and 1")
    half = float(ndtri(0.5 * (1.0 + threshold)))  # of the bar before it is filtered

    def beyond(edge: float) -> float:
        return float(ndtr(edge + half) - ndtr(edge - half)) - 0.5

    return 2.0 * scene.filter_spread * float(brentq(beyond, 0.0, half + 1.0, xtol=1e-14))


def thinnest_member(rings: Sequence[NDArray[np.float64]], detail: float = 0.0) -> float:
    """Width of the thinnest member of a body.

    A body is w wide if a disc of that diameter reaches all of it but parts that are no larger than
    w^2, and if each of its pieces, when w / 2 is taken off its boundary, stays one piece with as
    many holes. So necks and walls count, and legs and slots that are longer than one and a half
    times their width; corners do not, down to 22 degrees. The width is the least at which one of
    the two fails.

    Parameters
    ----------
    rings : sequence of (n, 2) arrays
        Boundaries, of which none touches itself or another; holes are found by even-odd.
    detail : float, optional
        Parts may be larger by its square: tips of sharper corners.

    Returns
    -------
    float
        In the unit of the rings.

    Raises
    ------
    DesignError
        If there is no ring.
    MissingLibraryError
        If manifold3d is not installed.
    """
    body, unit, _ = _section(rings)
    return unit * _thinnest(body, detail / unit)


def thinnest_gap(rings: Sequence[NDArray[np.float64]], detail: float = 0.0) -> float:
    """Width of the narrowest gap of a body, within a piece or between two: `thinnest_member` of
    all that is not there.

    Returns
    -------
    float
        In the unit of the rings; infinite if there is no gap.
    """
    body, unit, library = _section(rings)
    around = library.CrossSection.square((7.0 * DIAGONAL, 7.0 * DIAGONAL))
    void = around.translate((-3.0 * DIAGONAL, -3.0 * DIAGONAL)) - body
    return unit * _thinnest(void, detail / unit)


def _section(rings: Sequence[NDArray[np.float64]]) -> tuple[Any, float, Any]:
    """The body with its diagonal 1000 long and its corner at the origin, the unit, the library."""
    try:
        library = import_module("manifold3d")
    except ImportError as error:
        raise MissingLibraryError(
            'widths need the package manifold3d: pip install "mpmopt[export]"'
        ) from error
    if not len(rings):
        raise DesignError("width: there is no ring; give the rings of an outline's polygons")
    points = np.concatenate(rings)
    unit = float(np.hypot(*np.ptp(points, axis=0))) / DIAGONAL
    moved = [(ring - points.min(axis=0)) / unit for ring in rings]
    return library.CrossSection(moved, library.FillRule.EvenOdd), unit, library


def _thinnest(section: Any, detail: float) -> float:
    return min(_width(piece, detail) for piece in section.decompose())


def _width(piece: Any, detail: float) -> float:
    """The least width that a piece does not have; infinite if it is as wide as the diagonal."""
    low, high = 0.0, LEAST * DIAGONAL
    while _has(piece, high, detail):
        low, high = high, RATIO * high
        if high > DIAGONAL:
            return math.inf
    for _ in range(HALVINGS):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if _has(piece, middle, detail) else (low, middle)
    return 0.5 * (low + high)


def _has(piece: Any, width: float, detail: float) -> bool:
    """Whether a piece is so wide."""
    # All arguments, since older manifold3d has no default for the second.
    rounded = import_module("manifold3d").JoinType.Round, 2.0, SEGMENTS
    left = piece.offset(-0.5 * width, *rounded)
    if len(left.decompose()) != 1 or left.num_contour() != piece.num_contour():
        return False
    lost = piece - left.offset(0.5 * GROWN * width, *rounded)
    return max((part.area() for part in lost.decompose()), default=0.0) <= width**2 + detail**2
