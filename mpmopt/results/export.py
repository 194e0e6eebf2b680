"""A design taken out: drawings, a solid for a printer, and the motion, as files others read."""

from __future__ import annotations

import io
import logging
import os
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mpmopt.assess.threshold import THRESHOLD, kept, pieces
from mpmopt.assess.trajectory import Motion, equal_steps, solid
from mpmopt.assess.width import thinnest_gap, thinnest_member
from mpmopt.design.problem import Problem
from mpmopt.errors import ExportError, MissingLibraryError, MpmoptError, StorageError
from mpmopt.io.files import make_folder, replace_file
from mpmopt.results.outline import Polygon, outline
from mpmopt.results.vtkhdf import content
from mpmopt.validation import number

logger = logging.getLogger(__name__)

FILES = {"svg": "design.svg", "dxf": "design.dxf", "stl": "design.stl", "vtk": "motion.vtkhdf"}
EXTRAS = {"dxf": "ezdxf", "stl": "manifold3d"}
FRAMES = 101  # of a motion, unless there are fewer steps
# Millimetres: what is smaller or larger is taken for a mistake.
SMALLEST, LARGEST = 1e-3, 1e6


@dataclass(frozen=True)
class Exported:
    """What was written.

    Attributes
    ----------
    paths : tuple of Path
    polygons : list of Polygon
        In millimetres; empty if only the motion was written.
    loose : int
        Particles of the whole body that hang on nothing (`threshold.pieces`).
    failed : tuple of str
        Formats that could not be written; a warning says why.
    detail : float
        Spacing of particles in millimetres: nothing finer is known of the outline.
    """

    paths: tuple[Path, ...]
    polygons: list[Polygon]
    loose: int
    failed: tuple[str, ...] = ()
    detail: float = 0.0


def widths(polygons: Sequence[Polygon], detail: float = 0.0) -> tuple[float, float]:
    """Width of the thinnest member and of the narrowest gap (`width.thinnest_member`).

    Raises
    ------
    MissingLibraryError
        If manifold3d is not installed.
    """
    rings = [ring for polygon in polygons for ring in polygon.rings]
    return thinnest_member(rings, detail), thinnest_gap(rings, detail)


def export(
    problem: Problem,
    x: NDArray[np.float64],
    out: str | os.PathLike[str],
    formats: Iterable[str],
    *,
    width: float | None = None,
    scale: float | None = None,
    thickness: float | None = None,
    threshold: float = THRESHOLD,
    drop_components: bool = False,
    kerf: float | None = None,
) -> Exported:
    """Write a design without grey, as drawing, solid and motion, into a folder.

    Particles with gamma >= threshold and the regions that are not designed are there, as in
    `threshold.post_processed`. What cannot be written is warned of, and the rest is written.

    Parameters
    ----------
    problem : Problem
    x : (n,) array
    out : path
        Folder, made if it is not there. Older exports in it are replaced.
    formats : iterable of str
        "svg", "dxf", "stl" (which need a size) and "vtk" (the motion, in the scene's units).
    width : float, optional
        Of the drawing along x, in millimetres.
    scale : float, optional
        Instead: millimetres for one unit of length of the scene.
    thickness : float, optional
        Of the solid, in millimetres; a tenth of the width unless given.
    threshold : float, optional
    drop_components : bool, optional
        Leave out pieces that hang on nothing (`threshold.pieces`), in drawings, solid and motion.
    kerf : float, optional
        Width of the cut or of the nozzle, in millimetres: a warning tells of a member or a gap that
        is thinner.

    Raises
    ------
    ExportError
        If nothing is asked for, or a size is missing, makes no sense or has no effect; nothing is
        written then.
    MissingLibraryError
        If ezdxf or manifold3d (for stl and a kerf) is needed and not installed; nothing is written
        then.
    DesignError
        If x or the threshold does not fit.
    SimulationError
        If only the motion is asked for, and the body without void cannot be simulated.
    StorageError
        If the folder, or no file, can be written.
    """
    formats, out = list(formats), Path(out)
    unknown = [name for name in formats if name not in FILES]
    if unknown or not formats:
        what = f"formats {unknown} are unknown" if unknown else "no format is asked for"
        raise ExportError(f"{what}; ask for some of {', '.join(FILES)}")
    if thickness is not None and "stl" not in formats:
        raise ExportError("only a solid has a thickness: ask for stl too, or give no thickness")
    drawn = set(formats) != {"vtk"}
    if not drawn and (width, scale) != (None, None):
        raise ExportError(
            "the motion is in the scene's units: ask for svg, dxf or stl too, or give neither "
            "width nor scale"
        )
    if kerf is not None:
        number("export", "kerf", kerf, above=0.0, error=ExportError)
        if not drawn:
            raise ExportError("a kerf is that of a drawing or a solid: ask for one, or give none")
    keep = kept(problem, x, threshold)
    loose = pieces(problem.scene, keep) > 0
    if drop_components:
        keep &= ~loose
    polygons: list[Polygon] = []
    detail = 0.0
    writers: dict[str, Callable[[], bytes]] = {}
    if drawn:
        plain = outline(problem, x, threshold, keep)
        polygons = in_millimetres(plain, width, scale)
        spacing = problem.scene.grid.dx / problem.scene.particles_per_cell
        detail = spacing * size(polygons)[0] / size(plain)[0]
        if kerf is not None:
            _warn_of_thin(polygons, detail, kerf)
        if thickness is None:
            thickness = 0.1 * size(polygons)[0]
        if "stl" in formats:
            _check_length("thickness", thickness)
        writers = {
            "svg": lambda: svg(polygons),
            "dxf": lambda: dxf(polygons),
            "stl": lambda: stl(polygons, thickness),
        }

    def motion() -> bytes:
        frames = np.unique(equal_steps(problem.scene, FRAMES))
        return content(Motion.of(solid("design", problem, x, keep), frames))

    writers["vtk"] = motion
    for name in EXTRAS.keys() & formats:
        _extra(name)
    contents: dict[str, bytes] = {}
    failed: dict[str, MpmoptError] = {}
    for name in (name for name in writers if name in formats):
        try:
            contents[name] = writers[name]()
        except MpmoptError as error:
            failed[name] = error
    if contents:
        make_folder(out)
    paths = []
    for name, written in contents.items():
        try:
            replace_file(out / FILES[name], written)
            paths.append(out / FILES[name])
        except StorageError as error:
            failed[name] = error
    if not paths:
        raise next(iter(failed.values()))
    for name, reason in failed.items():
        logger.warning("no %s: %s", FILES[name], reason)
    halves = 1 if problem.scene.mirror is None else 2
    return Exported(tuple(paths), polygons, halves * int(loose.sum()), tuple(failed), detail)


def _warn_of_thin(polygons: Sequence[Polygon], detail: float, kerf: float) -> None:
    for what, thinnest in zip(("member", "gap"), widths(polygons, detail), strict=True):
        if thinnest < kerf:
            logger.warning(
                "the thinnest %s is %.3g mm wide, less than the kerf of %.3g mm: draw it larger, "
                "or optimise with a longer filter_length",
                what,
                thinnest,
                kerf,
            )


def size(polygons: Sequence[Polygon]) -> NDArray[np.float64]:
    """Width and height (2,) of the bounding box."""
    return np.ptp(np.concatenate([polygon.rings[0] for polygon in polygons]), axis=0)


def in_millimetres(
    polygons: Sequence[Polygon], width: float | None = None, scale: float | None = None
) -> list[Polygon]:
    """Polygons at their physical size, the lower left corner of their bounding box at (0, 0).

    Parameters
    ----------
    polygons : sequence of Polygon
        In the scene's unit of length.
    width : float, optional
        Of the bounding box, in millimetres.
    scale : float, optional
        Instead: millimetres for one unit of length of the scene.

    Raises
    ------
    ExportError
        If not one of the two is given, or the drawing would be smaller than 1 micrometre or larger
        than 1 kilometre.
    """
    if (width is None) == (scale is None):
        raise ExportError("a drawing needs a size: give its width in mm, or a scale, one of them")
    if width is not None:
        width = number("export", "width", width, above=0.0, error=ExportError)
        scale = width / size(polygons)[0]
    scale = number("export", "scale", scale, above=0.0, error=ExportError)
    for name, length in zip(("width", "height"), scale * size(polygons), strict=True):
        _check_length(name, length)
    corner = np.min([polygon.rings[0].min(axis=0) for polygon in polygons], axis=0)
    return [Polygon(tuple((r - corner) * scale for r in polygon.rings)) for polygon in polygons]


def _check_length(name: str, length: float) -> float:
    length = number("export", name, length, above=0.0, error=ExportError)
    if not SMALLEST <= length <= LARGEST:
        raise ExportError(
            f"a {name} of {length:g} mm must be from {SMALLEST:g} to {LARGEST:g} mm; choose "
            "another size"
        )
    return length


def svg(polygons: Sequence[Polygon]) -> bytes:
    """A drawing of polygons in millimetres: one path for each, filled, holes by even-odd."""
    width, height = size(polygons)
    lines = [
        '<?xml version="1.0" encoding="UTF-8"?>',
        f'<svg xmlns="http://www.w3.org/2000/svg" width="{width:.9g}mm" height="{height:.9g}mm" '
        f'viewBox="0 0 {width:.9g} {height:.9g}" fill="black" fill-rule="evenodd">',
    ]
    for polygon in polygons:
        path = " ".join(
            "M" + " L".join(f"{x:.9g},{height - y:.9g}" for x, y in ring) + " Z"
            for ring in polygon.rings
        )
        lines.append(f'<path d="{path}"/>')
    return "\n".join([*lines, "</svg>", ""]).encode()


def dxf(polygons: Sequence[Polygon]) -> bytes:
    """A drawing of polygons in millimetres: closed polylines, outer ones and holes by layer.

    Raises
    ------
    MissingLibraryError
        If ezdxf is not installed.
    """
    document = _extra("dxf").new("R2000", units=4)  # millimetres
    layers = "outline", "holes"
    for name in layers:
        document.layers.add(name)
    for polygon in polygons:
        for index, ring in enumerate(polygon.rings):
            document.modelspace().add_lwpolyline(
                ring, close=True, dxfattribs={"layer": layers[index > 0]}
            )
    text = io.StringIO()
    document.write(text)
    return document.encode(text.getvalue())


def stl(polygons: Sequence[Polygon], thickness: float) -> bytes:
    """A watertight solid in millimetres: polygons extruded along z, as binary STL.

    Raises
    ------
    ExportError
        If the thickness makes no sense.
    MissingLibraryError
        If manifold3d is not installed.
    """
    thickness = _check_length("thickness", thickness)
    library = _extra("stl")
    rings = [ring for polygon in polygons for ring in polygon.rings]
    section = library.CrossSection(rings, library.FillRule.EvenOdd)
    mesh = section.extrude(thickness).to_mesh()
    corners = np.asarray(mesh.vert_properties)[:, :3][np.asarray(mesh.tri_verts)]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    facets = np.zeros(
        len(corners), [("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")]
    )
    length = np.linalg.norm(normal, axis=1, keepdims=True)
    facets["normal"] = normal / np.where(length > 0.0, length, 1.0)
    facets["corners"] = corners
    header = b"mpmopt, millimetres".ljust(80) + np.uint32(len(facets)).astype("<u4").tobytes()
    return header + facets.tobytes()


def _extra(name: str) -> Any:
    """The package that a format needs."""
    try:
        return import_module(EXTRAS[name])
    except ImportError as error:
        raise MissingLibraryError(
            f'{name.upper()} needs the package {EXTRAS[name]}: pip install "mpmopt[export]", or '
            "leave that format out"
        ) from error
