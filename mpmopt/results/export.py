"""A design taken out: drawings, a solid for a printer, and the motion, as files others read."""

from __future__ import annotations

import io
import logging
import os
import zipfile
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mpmopt.assess.threshold import THRESHOLD, kept, pieces
from mpmopt.assess.trajectory import Motion, equal_steps, solid
from mpmopt.design.problem import Problem
from mpmopt.errors import ExportError, MissingLibraryError, MpmoptError, StorageError
from mpmopt.io.files import make_folder, replace_file
from mpmopt.results.outline import Part, Polygon, outline
from mpmopt.results.vtkhdf import content
from mpmopt.validation import number

logger = logging.getLogger(__name__)

FILES = {
    "svg": "design.svg",
    "dxf": "design.dxf",
    "stl": "design.stl",
    "3mf": "design.3mf",
    "vtk": "motion.vtkhdf",
}
EXTRAS = {"dxf": "ezdxf", "stl": "manifold3d", "3mf": "manifold3d"}
SOLIDS = "stl", "3mf"
PARTS: tuple[Part, ...] = ("passive", "actuator")
# Colours of the parts, in drawings and for printers.
COLOURS = {"body": "#000000", "passive": "#000000", "actuator": "#d91a1a"}
MAKER = b"mpmopt"  # stands near the beginning or the end of every file of ours
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
        Of the whole body, in millimetres; empty if only the motion was written.
    loose : int
        Particles of the whole body that hang on nothing (`threshold.pieces`).
    failed : tuple of str
        Formats that could not be written; a warning says why.
    """

    paths: tuple[Path, ...]
    polygons: list[Polygon]
    loose: int
    failed: tuple[str, ...] = ()


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
    parts: bool = False,
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
        "svg", "dxf", "stl", "3mf" (which need a size) and "vtk" (the motion, in the scene's units).
    width : float, optional
        Of the drawing along x, in millimetres.
    scale : float, optional
        Instead: millimetres for one unit of length of the scene.
    thickness : float, optional
        Of the solid, in millimetres; a tenth of the width unless given.
    threshold : float, optional
    drop_components : bool, optional
        Leave out pieces that hang on nothing (`threshold.pieces`), in drawings, solid and motion.
    parts : bool, optional
        Actuators and the passive body apart, as for casting in two materials: layers of drawings,
        objects of 3MF, and a file of each as STL.

    Raises
    ------
    ExportError
        If nothing is asked for, or a size is missing, makes no sense or has no effect; nothing is
        written then.
    MissingLibraryError
        If ezdxf or manifold3d is needed and not installed; nothing is written then.
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
    solids = [name for name in formats if name in SOLIDS]
    if thickness is not None and not solids:
        raise ExportError("only a solid has a thickness: ask for stl too, or give no thickness")
    drawn = set(formats) != {"vtk"}
    if parts and not drawn:
        raise ExportError("the motion has no parts: ask for svg, dxf, stl or 3mf, or for no parts")
    if not drawn and (width, scale) != (None, None):
        raise ExportError(
            "the motion is in the scene's units: ask for svg, dxf or stl too, or give neither "
            "width nor scale"
        )
    keep = kept(problem, x, threshold)
    loose = pieces(problem.scene, keep) > 0
    if drop_components:
        keep &= ~loose
    polygons: list[Polygon] = []
    drawings: dict[str, list[Polygon]] = {}
    if drawn:
        whole = outline(problem, x, threshold, keep)
        polygons = in_millimetres(whole, width, scale)
        drawings = {"body": polygons}
        if parts:
            apart = {part: outline(problem, x, threshold, keep, part) for part in PARTS}
            if not all(apart.values()):
                raise ExportError("the body has no actuator, or nothing else: ask for no parts")
            drawings = {
                name: in_millimetres(each, width, scale, whole) for name, each in apart.items()
            }
        if thickness is None:
            thickness = 0.1 * size(polygons)[0]
        if solids:
            _check_length("thickness", thickness)

    def written(name: str, part: str) -> bytes:
        if name == "vtk":
            frames = np.unique(equal_steps(problem.scene, FRAMES))
            return content(Motion.of(solid("design", problem, x, keep), frames))
        if name in SOLIDS:
            assert thickness is not None
            return stl(drawings[part], thickness) if part else threemf(drawings, thickness)
        return {"svg": svg, "dxf": dxf}[name](drawings)

    for name in EXTRAS.keys() & formats:
        _extra(name)
    contents: dict[str, bytes] = {}
    wanted = files(formats, parts)
    failed: dict[str, MpmoptError] = {}
    for file, (name, part) in wanted.items():
        try:
            contents[file] = written(name, part)
        except MpmoptError as error:
            failed[file] = error
    if contents:
        make_folder(out)
    paths = []
    for file, text in contents.items():
        try:
            replace_file(out / file, text)
            paths.append(out / file)
        except StorageError as error:
            failed[file] = error
    if not paths:
        raise next(iter(failed.values()))
    for file, reason in failed.items():
        logger.warning("no %s: %s", file, reason)
    halves = 1 if problem.scene.mirror is None else 2
    lost = dict.fromkeys(wanted[file][0] for file in failed)
    return Exported(tuple(paths), polygons, halves * int(loose.sum()), tuple(lost))


def files(formats: Iterable[str], parts: bool = False) -> dict[str, tuple[str, str]]:
    """The files that `export` writes, each with its format and, if it holds one part, with that."""
    found = {}
    for name, file in FILES.items():
        if name not in formats:
            continue
        if name == "stl" and parts:
            found.update({f"design_{part}.stl": (name, str(part)) for part in PARTS})
        else:
            found[file] = (name, "body" if name == "stl" else "")
    return found


def ours(path: Path) -> bool:
    """Whether a file is one that `export` made, so that it may be replaced."""
    try:
        if path.is_symlink() or not path.is_file():
            return False
        content = path.read_bytes()
    except OSError:  # a name that is too long, say
        return False
    return MAKER in content[:4096] + content[-4096:]


def size(polygons: Sequence[Polygon]) -> NDArray[np.float64]:
    """Width and height (2,) of the bounding box."""
    return np.ptp(np.concatenate([polygon.rings[0] for polygon in polygons]), axis=0)


def in_millimetres(
    polygons: Sequence[Polygon],
    width: float | None = None,
    scale: float | None = None,
    whole: Sequence[Polygon] | None = None,
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
    whole : sequence of Polygon, optional
        Whose bounding box counts; default: these.

    Raises
    ------
    ExportError
        If not one of the two is given, or the drawing would be smaller than 1 micrometre or larger
        than 1 kilometre.
    """
    if (width is None) == (scale is None):
        raise ExportError("a drawing needs a size: give its width in mm, or a scale, one of them")
    whole = polygons if whole is None else whole
    if width is not None:
        width = number("export", "width", width, above=0.0, error=ExportError)
        scale = width / size(whole)[0]
    scale = number("export", "scale", scale, above=0.0, error=ExportError)
    for name, length in zip(("width", "height"), scale * size(whole), strict=True):
        _check_length(name, length)
    corner = np.min([polygon.rings[0].min(axis=0) for polygon in whole], axis=0)
    return [Polygon(tuple((r - corner) * scale for r in polygon.rings)) for polygon in polygons]


def _check_length(name: str, length: float) -> float:
    length = number("export", name, length, above=0.0, error=ExportError)
    if not SMALLEST <= length <= LARGEST:
        raise ExportError(
            f"a {name} of {length:g} mm must be from {SMALLEST:g} to {LARGEST:g} mm; choose "
            "another size"
        )
    return length


def svg(drawings: Mapping[str, Sequence[Polygon]]) -> bytes:
    """A drawing of polygons in millimetres: one path for each, filled, holes by even-odd.

    Each part is a group, which Inkscape shows as a layer.
    """
    width, height = size([polygon for part in drawings.values() for polygon in part])
    lines = [
        '<?xml version="1.0" encoding="UTF-8"?>',
        "<!-- mpmopt, millimetres -->",
        '<svg xmlns="http://www.w3.org/2000/svg" '
        'xmlns:inkscape="http://www.inkscape.org/namespaces/inkscape" '
        f'width="{width:.9g}mm" height="{height:.9g}mm" '
        f'viewBox="0 0 {width:.9g} {height:.9g}" fill-rule="evenodd">',
    ]
    for name, polygons in drawings.items():
        lines.append(
            f'<g id="{name}" inkscape:groupmode="layer" inkscape:label="{name}" '
            f'fill="{COLOURS[name]}">'
        )
        for polygon in polygons:
            path = " ".join(
                "M" + " L".join(f"{x:.9g},{height - y:.9g}" for x, y in ring) + " Z"
                for ring in polygon.rings
            )
            lines.append(f'<path d="{path}"/>')
        lines.append("</g>")
    return "\n".join([*lines, "</svg>", ""]).encode()


def dxf(drawings: Mapping[str, Sequence[Polygon]]) -> bytes:
    """A drawing of polygons in millimetres: closed polylines, outer ones and holes by layer.

    Of the whole body the layers are ``outline`` and ``holes``, of its parts ``passive``,
    ``passive_holes``, ``actuator`` and ``actuator_holes``.

    Raises
    ------
    MissingLibraryError
        If ezdxf is not installed.
    """
    document = _extra("dxf").new("R2000", units=4)  # millimetres
    for name, polygons in drawings.items():
        layers = ("outline", "holes") if name == "body" else (name, f"{name}_holes")
        for layer in layers:
            document.layers.add(layer, color=1 if name == "actuator" else 7)
        for polygon in polygons:
            for index, ring in enumerate(polygon.rings):
                document.modelspace().add_lwpolyline(
                    ring, close=True, dxfattribs={"layer": layers[index > 0]}
                )
    text = io.StringIO()
    document.write(text)
    # A comment, which readers leave out.
    content: bytes = b"999\nmpmopt, millimetres\n" + document.encode(text.getvalue())
    return content


def _extruded(
    polygons: Sequence[Polygon], thickness: float
) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Points (P, 3) and triangles (T, 3) of polygons extruded along z."""
    thickness = _check_length("thickness", thickness)
    library = _extra("stl")
    rings = [ring for polygon in polygons for ring in polygon.rings]
    section = library.CrossSection(rings, library.FillRule.EvenOdd)
    mesh = section.extrude(thickness).to_mesh()
    points = np.asarray(mesh.vert_properties, float)[:, :3]
    return points, np.asarray(mesh.tri_verts, np.int64)


def stl(polygons: Sequence[Polygon], thickness: float) -> bytes:
    """A watertight solid in millimetres: polygons extruded along z, as binary STL.

    Raises
    ------
    ExportError
        If the thickness makes no sense.
    MissingLibraryError
        If manifold3d is not installed.
    """
    points, triangles = _extruded(polygons, thickness)
    corners = points[triangles]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    facets = np.zeros(
        len(corners), [("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")]
    )
    length = np.linalg.norm(normal, axis=1, keepdims=True)
    facets["normal"] = normal / np.where(length > 0.0, length, 1.0)
    facets["corners"] = corners
    header = b"mpmopt, millimetres".ljust(80) + np.uint32(len(facets)).astype("<u4").tobytes()
    return header + facets.tobytes()


CORE = "http://schemas.microsoft.com/3dmanufacturing/core/2015/02"
# What a package must hold besides its model (3MF Core Specification; ECMA-376, part 2).
PACKAGE = {
    "[Content_Types].xml": '<?xml version="1.0" encoding="UTF-8"?>\n<Types '
    'xmlns="http://schemas.openxmlformats.org/package/2006/content-types"><Default '
    'Extension="rels" ContentType="application/vnd.openxmlformats-package.relationships+xml"/>'
    '<Default Extension="model" '
    'ContentType="application/vnd.ms-package.3dmanufacturing-3dmodel+xml"/></Types>',
    "_rels/.rels": '<?xml version="1.0" encoding="UTF-8"?>\n<Relationships '
    'xmlns="http://schemas.openxmlformats.org/package/2006/relationships"><Relationship '
    'Target="/3D/3dmodel.model" Id="rel0" '
    'Type="http://schemas.microsoft.com/3dmanufacturing/2013/01/3dmodel"/></Relationships>',
}


def threemf(drawings: Mapping[str, Sequence[Polygon]], thickness: float) -> bytes:
    """Watertight solids in millimetres as 3MF: an object for each part, with a name and a colour.

    Raises
    ------
    ExportError
        If the thickness makes no sense.
    MissingLibraryError
        If manifold3d is not installed.
    """
    bases = "".join(
        f'<base name="{name}" displaycolor="{COLOURS[name].upper()}"/>' for name in drawings
    )
    objects = []
    for index, (name, polygons) in enumerate(drawings.items()):
        points, triangles = _extruded(polygons, thickness)
        vertices = "".join(f'<vertex x="{x:.9g}" y="{y:.9g}" z="{z:.9g}"/>' for x, y, z in points)
        faces = "".join(f'<triangle v1="{a}" v2="{b}" v3="{c}"/>' for a, b, c in triangles)
        objects.append(
            f'<object id="{index + 2}" type="model" name="{name}" pid="1" pindex="{index}"><mesh>'
            f"<vertices>{vertices}</vertices><triangles>{faces}</triangles></mesh></object>"
        )
    items = "".join(f'<item objectid="{index + 2}"/>' for index in range(len(drawings)))
    model = (
        f'<?xml version="1.0" encoding="UTF-8"?>\n<model unit="millimeter" xmlns="{CORE}">'
        '<metadata name="Application">mpmopt</metadata>'
        f'<resources><basematerials id="1">{bases}</basematerials>{"".join(objects)}</resources>'
        f"<build>{items}</build></model>"
    )
    content = io.BytesIO()
    with zipfile.ZipFile(content, "w", zipfile.ZIP_DEFLATED) as package:
        package.comment = MAKER
        for name, text in (*PACKAGE.items(), ("3D/3dmodel.model", model)):
            # Without the time, so that the same design gives the same file.
            entry = zipfile.ZipInfo(name)
            package.writestr(entry, text, zipfile.ZIP_DEFLATED)
    return content.getvalue()


def _extra(name: str) -> Any:
    """The package that a format needs."""
    try:
        return import_module(EXTRAS[name])
    except ImportError as error:
        raise MissingLibraryError(
            f'{name.upper()} needs the package {EXTRAS[name]}: pip install "mpmopt[export]", or '
            "leave that format out"
        ) from error
