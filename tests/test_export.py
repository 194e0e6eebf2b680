"""Designs as files: read back by other people's libraries, and measured."""

import dataclasses
import subprocess
import sys
import zipfile
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import pytest
import svgelements
import trimesh
from conftest import small_scene
from crawler import crawler
from scipy.ndimage import label
from scipy.spatial import KDTree
from vtkmodules.util.numpy_support import vtk_to_numpy
from vtkmodules.vtkIOHDF import vtkHDFReader
from walker import CASES, walker

from mpmopt.__main__ import main
from mpmopt.assess.threshold import kept, pieces, solid_body
from mpmopt.design.problem import Problem
from mpmopt.design.task import DEFAULT_TASK
from mpmopt.errors import (
    DesignError,
    ExportError,
    MissingLibraryError,
    SimulationError,
    StorageError,
)
from mpmopt.optimisation.history import Candidate, Optimisation
from mpmopt.optimisation.settings import Settings, Stage
from mpmopt.results import export as exporting
from mpmopt.results import runfile
from mpmopt.results.export import export, in_millimetres, stl, widths
from mpmopt.results.outline import outline
from mpmopt.scene import Design, Grid, Mirror, Scene, Solid
from mpmopt.scene.particles import discretise, mirror_images

WIDTH = 60.0  # mm
C = 1 / 32


def block(**changes) -> Scene:
    """A bar on a block of design, of 48 x 40 particles together."""
    body = Solid((4 * C, 20 * C), (28 * C, 24 * C)), Design((4 * C, 4 * C), (28 * C, 20 * C))
    return Scene(Grid((32, 32), C), 1e-3, 5, body, **changes)


def discs(problem, *circles, inside=-1.0):
    """A design that is solid (or void) but in circles of (x, y, radius), in units of C."""
    position = problem.particles.position[problem.particles.designed] / C
    phi = np.full(len(position), -inside)
    for x, y, radius in circles:
        phi[np.hypot(*(position - (x, y)).T) < radius] = inside
    return problem.join(phi, 0.0, 0.0, 0.0)


@pytest.fixture(scope="module")
def holed():
    """Two holes, and a notch in the lower edge in which a loose disc lies."""
    problem = Problem(block(), beta=16.0)
    x = discs(problem, (8, 15, 3), (22, 15, 2.5), (16, 6, 5.5))
    disc = discs(problem, (16, 6.5, 1.6), inside=1.0)
    return problem, np.maximum(x, disc)


def mask(problem, x):
    """Which cells of the particles' lattice are solid, with a ring of empty ones around them."""
    body = discretise(problem.scene, whole=True)
    there = problem.particles.completed(problem.gamma(x) >= 0.3)
    there = there[mirror_images(problem.scene, problem.particles, body)]
    i, j = np.floor(body.position / (0.5 * problem.scene.grid.dx)).astype(int).T
    lattice = np.zeros((i.max() + 2, j.max() + 2), dtype=bool)
    lattice[i[there], j[there]] = True
    return lattice


def counted(problem, x):
    """Pieces and holes of the lattice."""
    lattice = mask(problem, x)
    return label(lattice)[1], label(~lattice, np.ones((3, 3)))[1] - 1


def particles_area(problem, x, drop_components=False):
    """Of the bar and what is kept of the block, in square millimetres."""
    piece = pieces(problem.scene, problem.gamma(x) >= 0.3)
    kept = (piece == 0) if drop_components else (piece >= 0)
    return (48 * 8 + kept.sum()) * (WIDTH / 48) ** 2


def shoelace(ring):
    (x, y), (x1, y1) = np.asarray(ring).T, np.roll(ring, -1, axis=0).T
    return 0.5 * np.sum(x * y1 - x1 * y)


def test_the_outline_passes_between_particles_that_stay_and_particles_that_go(holed):
    problem, x = holed
    gamma = problem.particles.completed(problem.gamma(x))
    for threshold in (0.1, 0.3, 0.7):
        clear = np.abs(gamma - threshold) > 0.01  # not on the line, but for rounding
        assert clear.mean() >= 0.99
        points = problem.particles.position[clear]
        inside = np.any([polygon.contains(points) for polygon in outline(problem, x, threshold)], 0)
        assert np.array_equal(inside, gamma[clear] >= threshold)


@pytest.mark.parametrize("threshold", [0.3, 0.5, 0.7])
def test_the_outline_of_a_subpixel_design_parts_the_same_particles(threshold):
    problem = Problem(CASES["preview"].scene, 100.0, subpixel=True)
    x = problem.join(**CASES["preview"].start)
    there = problem.particles.completed(kept(problem, x, threshold))
    assert 0.2 < there.mean() < 0.9
    points = problem.particles.position
    inside = np.any([polygon.contains(points) for polygon in outline(problem, x, threshold)], 0)
    assert np.array_equal(inside, there)


def test_a_solid_reference_design_is_its_rectangle_and_an_empty_one_what_is_solid():
    problem = Problem(walker(64, 8e-4), beta=4.0)
    for phi, low in ((1.0, 4), (-1.0, 11)):
        (polygon,) = outline(problem, problem.join(phi, 1.0, 0.0, 0.0))
        (ring,) = polygon.rings
        assert ring * 64 == pytest.approx(
            np.array([(23, low), (23, 14), (3, 14), (3, low)])[_order(ring)], abs=1e-12
        )


def _order(ring):
    """How to turn the corners of a rectangle, given from its lower right one on."""
    first = np.argmin(ring[:, 1] - ring[:, 0])
    return (np.arange(len(ring)) - first) % len(ring)


def test_a_disc_is_smooth_and_has_the_area_of_a_disc():
    problem = Problem(block(), beta=16.0)
    (_, disc) = outline(problem, discs(problem, (16, 11, 4), inside=1.0), threshold=0.5)
    (ring,) = disc.rings
    radius = np.hypot(*(ring / C - (16, 11)).T)
    assert radius == pytest.approx(4.0, abs=0.15)  # 0.3 of a particle spacing
    assert disc.area / C**2 == pytest.approx(np.pi * 16, rel=0.02)
    edges = np.roll(ring, -1, axis=0) - ring
    turn = np.angle(np.exp(1j * np.diff(np.unwrap(np.arctan2(edges[:, 1], edges[:, 0])))))
    assert np.abs(turn).max() <= np.radians(15)  # stairs would turn by 45 or 90 degrees


def test_straight_sides_stay_straight(holed):
    """The bar's sides and the block's are single edges, but where the notch is."""
    (body, _) = outline(*holed)
    ring = body.rings[0] / C
    edges = np.roll(ring, -1, axis=0) - ring
    straight = edges[np.abs(edges).max(axis=1) > 2.0]
    assert len(straight) == 5
    assert np.count_nonzero(straight) == 5
    assert sorted(np.abs(straight).max(axis=1))[-3:] == [20.0, 20.0, 24.0]


def test_a_loose_ring_around_what_is_solid_is_dropped():
    scene = block()
    core = Solid((14 * C, 14 * C), (18 * C, 18 * C))
    around: Any = ((4, 4), (28, 14)), ((4, 14), (14, 18)), ((18, 14), (28, 18)), ((4, 18), (28, 24))
    design = (Design(*(tuple(C * k for k in corner) for corner in box)) for box in around)
    problem = Problem(dataclasses.replace(scene, body=(core, *design)), beta=16.0)
    ring = discs(problem, (16, 16, 7), inside=1.0)
    x = np.minimum(ring, discs(problem, (16, 16, 4.5)))
    assert [len(polygon.rings) for polygon in outline(problem, x)] == [2, 1]
    held = pieces(problem.scene, problem.gamma(x) >= 0.3) == 0
    (left,) = outline(problem, x, keep=held)
    assert left.area == pytest.approx(16 * C**2)


@pytest.mark.parametrize("loose", [False, True])
def test_an_svg_is_read_back_with_area_pieces_holes_and_size(holed, tmp_path, loose):
    problem, x = holed
    export(problem, x, tmp_path, ["svg"], width=WIDTH, drop_components=loose)
    image = svgelements.SVG.parse(str(tmp_path / "design.svg"), ppi=25.4)  # one pixel is 1 mm
    paths = [element for element in image.elements() if isinstance(element, svgelements.Path)]
    holes = area = 0
    for path in paths:
        subpaths = (svgelements.Path(subpath) for subpath in path.as_subpaths())
        rings = [np.array([(p.x, p.y) for p in one.as_points()]) for one in subpaths]
        areas = [abs(shoelace(ring)) for ring in rings]
        holes += len(rings) - 1
        area += areas[0] - sum(areas[1:])
    assert counted(problem, x) == (2, 2)
    assert (len(paths), holes) == (2 - loose, 2)
    assert area == pytest.approx(particles_area(problem, x, loose), rel=0.02)
    assert (image.width, image.height) == pytest.approx((WIDTH, WIDTH * 40 / 48))
    boxes = np.array([path.bbox() for path in paths])
    box = [*boxes[:, :2].min(axis=0), *boxes[:, 2:].max(axis=0)]
    assert box == pytest.approx([0.0, 0.0, WIDTH, WIDTH * 40 / 48], abs=1e-4)
    # The bar is at the top: the axis of an SVG points down.
    top = {round(p.x) for path in paths for p in path.as_points() if abs(p.y) < 1e-6}
    assert top == {0, round(WIDTH)}


def test_a_dxf_is_read_back_with_area_pieces_holes_and_size(holed, tmp_path):
    problem, x = holed
    export(problem, x, tmp_path, ["dxf"], width=WIDTH)
    with (tmp_path / "design.dxf").open("rb") as file:
        drawing = trimesh.load_path(file, file_type="dxf")
    assert drawing.units == "millimeters"
    layers = [entity.layer.lower() for entity in drawing.entities]
    rings = [entity.discrete(drawing.vertices) for entity in drawing.entities]
    assert all(np.array_equal(ring[0], ring[-1]) for ring in rings)
    assert (layers.count("outline"), layers.count("holes")) == counted(problem, x)
    areas = [
        abs(shoelace(ring[:-1])) * (-1) ** (layer == "holes") for ring, layer in zip(rings, layers)
    ]
    assert sum(areas) == pytest.approx(particles_area(problem, x), rel=0.02)
    box = np.array([[0.0, 0.0], [WIDTH, WIDTH * 40 / 48]])
    assert drawing.bounds == pytest.approx(box, abs=1e-9)


def test_an_stl_is_watertight_and_has_volume_pieces_holes_and_size(holed, tmp_path):
    problem, x = holed
    done = export(problem, x, tmp_path, ["stl"], scale=80.0, thickness=7.0)
    mesh = trimesh.load_mesh(str(tmp_path / "design.stl"))
    assert mesh.is_watertight
    assert mesh.is_winding_consistent
    drawn = sum(polygon.area for polygon in done.polygons)
    assert mesh.volume == pytest.approx(7.0 * drawn, rel=1e-5)
    assert drawn == pytest.approx(particles_area(problem, x), rel=0.02)  # 60 mm = 0.75 * 80 mm
    count, holes = counted(problem, x)
    assert mesh.body_count == count
    assert mesh.euler_number == 2 * (count - holes)
    box = np.array([[0.0, 0.0, 0.0], [60.0, 50.0, 7.0]])
    assert mesh.bounds == pytest.approx(box, abs=1e-5)


@pytest.mark.parametrize("seed", range(4))
def test_random_designs_are_watertight_too(seed, tmp_path):
    """Ragged outlines with many holes, flat feet on one line and loose crumbs."""
    problem = Problem(block(), beta=8.0)
    x = np.random.default_rng(seed).choice([-1.0, 1.0], size=problem.size)
    done = export(problem, x, tmp_path, ["stl"], width=40.0)
    mesh = trimesh.load_mesh(str(tmp_path / "design.stl"))
    assert mesh.is_watertight
    assert mesh.body_count == len(done.polygons)
    holes = sum(len(polygon.rings) - 1 for polygon in done.polygons)
    assert holes >= 3
    assert mesh.euler_number == 2 * (len(done.polygons) - holes)


@pytest.mark.parametrize("mirror", [False, True])
@pytest.mark.parametrize("designed", [False, True])
def test_what_meets_in_corners_is_parted(mirror, designed, tmp_path):
    """Random patches of solid, and of design of which random particles are cut out."""
    touching = 0
    for seed in range(12):
        rng = np.random.default_rng(seed)
        patches = rng.choice(3 if designed else 2, size=(4, 4))
        patches[0, 0] = 1
        body = [
            (Solid, Design)[patches[i, j] - 1](
                ((8 + i) * C, (8 + j) * C), ((9 + i) * C, (9 + j) * C)
            )
            for i, j in zip(*np.nonzero(patches))
        ]
        if mirror:
            plane = Mirror("y", 12 * C)
            body += [
                type(region)(
                    (region.lower[0], plane.image(region.upper)[1]),
                    (region.upper[0], plane.image(region.lower)[1]),
                )
                for region in body
            ]
            patches = np.concatenate([patches, patches[:, ::-1]], axis=1)
        scene = Scene(
            Grid((32, 32), C), 1e-3, 5, tuple(body), particles_per_cell=2,
            mirror=plane if mirror else None,
        )  # fmt: skip
        problem = Problem(scene, beta=8.0)
        count = problem.particles.designed.sum()
        x = problem.join(rng.choice([-1.0, 1.0], size=count), [], [], [])
        polygons = outline(problem, x, keep=rng.random(count) < 0.7)
        rings = [ring for polygon in polygons for ring in polygon.rings]
        points = np.round(np.concatenate(rings) / C, 9)
        assert len(np.unique(points, axis=0)) == len(points)
        (tmp_path / "a.stl").write_bytes(stl(in_millimetres(polygons, width=20.0), 2.0))
        mesh = trimesh.load_mesh(str(tmp_path / "a.stl"))
        assert mesh.is_watertight and mesh.is_winding_consistent
        holes = len(rings) - len(polygons)
        assert (mesh.body_count, mesh.euler_number) == (
            len(polygons), 2 * (len(polygons) - holes),
        )  # fmt: skip
        if not designed:
            there = np.pad(patches == 1, 1)
            joined = label(there, np.ones((3, 3)))[1]
            touching += joined != label(there)[1]
            assert len(polygons) == label(there)[1]
            assert holes == label(~there, np.ones((3, 3)))[1] - 1
            area = sum(polygon.area for polygon in polygons) / C**2
            assert area == pytest.approx(there.sum(), rel=1e-3)
    assert designed or touching >= 3


@pytest.fixture(scope="module")
def driven():
    """A crawler whose actuator lies in the middle of a design with a hole beside it."""
    problem = Problem(crawler(64, 8e-4), beta=8.0)
    position = problem.particles.position[problem.particles.designed]
    phi = np.where(np.hypot(*(position * 64 - (29, 30)).T) < 1.6, -1.0, 1.0)
    return problem, problem.join(phi, 1.0, 0.0, 0.0)


def test_actuators_and_passive_body_are_drawn_apart_and_fill_the_body_together(driven):
    problem, x = driven
    whole, passive, actuator = (
        outline(problem, x, part=part) for part in ("body", "passive", "actuator")
    )
    (square,) = actuator
    wanted = np.array([(26, 29), (26, 35), (20, 35), (20, 29)]) / 64
    assert square.rings[0] == pytest.approx(wanted[_order(square.rings[0])], abs=1e-12)
    areas = [sum(polygon.area for polygon in part) for part in (whole, passive, actuator)]
    assert areas[0] == pytest.approx(areas[1] + areas[2], rel=1e-9)
    assert [len(polygon.rings) for polygon in whole] == [3]
    assert [len(polygon.rings) for polygon in passive] == [4]  # and one for the actuator


def test_parts_are_layers_of_drawings(driven, tmp_path):
    problem, x = driven
    done = export(problem, x, tmp_path, ["svg", "dxf"], width=20.0, parts=True)
    assert [path.name for path in done.paths] == ["design.svg", "design.dxf"]
    image = svgelements.SVG.parse(str(tmp_path / "design.svg"), ppi=25.4)
    groups = [each for each in image if isinstance(each, svgelements.Group)]
    assert [group.id for group in groups] == ["passive", "actuator"]
    box = groups[1].bbox()
    assert box == pytest.approx((7.0, 3.0, 13.0, 9.0), abs=1e-4)  # one cell is 1 mm
    assert groups[0].bbox() == pytest.approx((0.0, 0.0, 20.0, 12.0), abs=1e-4)
    with (tmp_path / "design.dxf").open("rb") as file:
        drawing = trimesh.load_path(file, file_type="dxf")
    layers = [str(entity.layer).lower() for entity in drawing.entities]
    assert sorted(layers) == ["actuator", "passive", *3 * ["passive_holes"]]


def test_parts_are_solids_that_touch_and_nowhere_overlap(driven, tmp_path):
    problem, x = driven
    export(problem, x, tmp_path, ["stl", "3mf"], width=20.0, thickness=3.0, parts=True)
    names = {path.name for path in tmp_path.iterdir()}
    assert names == {"design_passive.stl", "design_actuator.stl", "design.3mf"}
    passive, actuator = (
        trimesh.load_mesh(str(tmp_path / f"design_{part}.stl")) for part in ("passive", "actuator")
    )
    assert passive.is_watertight and actuator.is_watertight
    assert actuator.volume == pytest.approx(6 * 6 * 3.0, rel=1e-5)
    assert actuator.bounds == pytest.approx(np.array([(7, 3, 0), (13, 9, 3)]), abs=1e-5)
    export(problem, x, tmp_path, ["stl"], width=20.0, thickness=3.0)
    whole = trimesh.load_mesh(str(tmp_path / "design.stl"))
    assert whole.volume == pytest.approx(passive.volume + actuator.volume, rel=1e-5)
    solids = objects_of(tmp_path / "design.3mf")
    for (name, mesh), other in zip(solids.items(), (passive, actuator), strict=True):
        assert name in ("passive", "actuator")
        assert mesh.is_watertight
        assert mesh.volume == pytest.approx(other.volume, rel=1e-5)
        assert mesh.bounds == pytest.approx(other.bounds, abs=1e-4)


def objects_of(path):
    """The solids of a 3MF file by name, and what its specification asks of the package."""
    space = {"m": "http://schemas.microsoft.com/3dmanufacturing/core/2015/02"}
    with zipfile.ZipFile(path) as package:
        assert package.testzip() is None
        assert package.namelist()[0] == "[Content_Types].xml"
        links = ElementTree.fromstring(package.read("_rels/.rels"))
        model = ElementTree.fromstring(package.read(links[0].attrib["Target"].lstrip("/")))
    assert model.attrib["unit"] == "millimeter"
    items = [item.attrib["objectid"] for item in model.iterfind("m:build/m:item", space)]
    colours = model.findall("m:resources/m:basematerials/m:base", space)
    found: dict[str, Any] = {}
    for each in model.iterfind("m:resources/m:object", space):
        assert each.attrib["id"] == items[len(found)]
        assert colours[int(each.attrib["pindex"])].attrib["name"] == each.attrib["name"]
        vertices = [
            [float(vertex.attrib[k]) for k in "xyz"]
            for vertex in each.iterfind(".//m:vertex", space)
        ]
        triangles = [
            [int(face.attrib[f"v{k}"]) for k in (1, 2, 3)]
            for face in each.iterfind(".//m:triangle", space)
        ]
        found[each.attrib["name"]] = trimesh.Trimesh(vertices, triangles)
    return found


@pytest.mark.parametrize("name", ["svg", "dxf", "stl", "3mf", "vtk"])
def test_what_was_exported_is_known_again_and_what_others_made_is_not(holed, tmp_path, name):
    width = None if name == "vtk" else 60.0
    problem, x = holed
    (path,) = export(problem, x, tmp_path, [name], width=width).paths
    assert exporting.ours(path)
    (tmp_path / "link").symlink_to(path)
    (tmp_path / "other.svg").write_text("<svg></svg>")
    for file in ("link", "other.svg", "nothing"):
        assert not exporting.ours(tmp_path / file)


def test_the_command_replaces_its_own_files_and_no_others(holed, tmp_path, capsys):
    path, out = run_file(tmp_path / "run.h5", *holed), tmp_path / "out"
    words = ["export", str(path), "--svg", "--stl", "--width", "60", "--out", str(out)]
    assert main(words) == main(words) == 0
    (out / "design.stl").write_text("somebody's")
    assert main(words) == 1
    assert "design.stl is there already" in capsys.readouterr().err
    assert (out / "design.stl").read_text() == "somebody's"


def test_of_a_mirror_scene_the_whole_body_is_exported(tmp_path):
    half = crawler(64, 8e-4)
    rng = np.random.default_rng(1)
    problem = Problem(half, beta=4.0)
    x = problem.join(rng.uniform(-1.0, 1.0, problem.size - 3), 1.0, -0.3, -0.5)
    done = export(problem, x, tmp_path, ["stl"], width=20.0)
    ys = np.concatenate([polygon.rings[0][:, 1] for polygon in done.polygons])
    assert (ys.min(), ys.max()) == (0.0, pytest.approx(12.0))
    mesh = trimesh.load_mesh(str(tmp_path / "design.stl"))
    image = mesh.vertices * (1.0, -1.0, 1.0) + (0.0, 12.0, 0.0)
    assert KDTree(mesh.vertices).query(image)[0].max() <= 2e-3  # 1/250 of a particle spacing
    assert mesh.volume / 2.0 == pytest.approx(mask(problem, x).sum() * 0.5**2, rel=0.05)


def read_motion(path):
    """Times, and points, and data of the cells at each, as VTK reads them."""
    reader = vtkHDFReader()
    reader.SetFileName(str(path))
    reader.UpdateInformation()
    times, frames = [], []
    for step in range(reader.GetNumberOfSteps()):
        reader.SetStep(step)
        reader.Update()
        grid = reader.GetOutput()
        times.append(reader.GetTimeValue())
        data = grid.GetCellData()
        arrays = [data.GetArray(k) for k in range(data.GetNumberOfArrays())]
        frames.append({array.GetName(): vtk_to_numpy(array).copy() for array in arrays})
        cells = vtk_to_numpy(grid.GetCells().GetConnectivityArray()).reshape(-1, 4)
        frames[-1]["corners"] = vtk_to_numpy(grid.GetPoints().GetData())[cells]
        assert {grid.GetCellType(cell) for cell in range(grid.GetNumberOfCells())} == {9}
    return np.array(times), frames


@pytest.mark.parametrize("mirror", [False, True])
def test_the_motion_is_read_back_by_vtk(tmp_path, mirror):
    scene = dataclasses.replace(crawler(64, 8e-4) if mirror else small_scene(), steps=40)
    problem = Problem(scene, beta=4.0)
    n = problem.size - 3 * len(scene.actuators)
    phi = np.where(np.arange(n) % 7 < 5, 1.0, -1.0)
    x = problem.join(phi, 1.0, -0.3, -0.5)
    export(problem, x, tmp_path, ["vtk"])
    times, frames = read_motion(tmp_path / "motion.vtkhdf")
    assert times == pytest.approx(np.arange(41) * scene.time_step)
    simulation = solid_body(scene, problem.gamma(x) >= 0.3, problem.split(x))
    states = simulation.run(range(41))
    count = states.shape[2]
    spacing = scene.grid.dx / scene.particles_per_cell
    for step in (0, 17, 40):
        frame, state = frames[step], states[step]
        assert len(frame["corners"]) == count * (1 + mirror)
        centre = frame["corners"].mean(axis=1)
        assert centre[:count, :2] == pytest.approx(state[0:2].T, abs=1e-6)
        assert frame["velocity"][:count, :2] == pytest.approx(state[2:4].T, abs=1e-5)
        areas = [abs(shoelace(quad[:, :2])) for quad in frame["corners"]]
        assert areas == pytest.approx(frame["jacobian"] * spacing**2, rel=1e-3)
        assert np.all(frame["stretch"] >= np.sqrt(frame["jacobian"]) - 1e-6)
        actuator = simulation.particles.actuator
        expected = np.where(actuator >= 0, simulation.signal[min(step, 39)][actuator], 0.0)
        assert frame["signal"][:count] == pytest.approx(expected, abs=1e-6)
        if mirror:
            assert scene.mirror is not None
            velocity = frame["velocity"][count:, :2] * (1.0, -1.0)
            assert velocity == pytest.approx(frame["velocity"][:count, :2], abs=1e-6)
            assert np.array_equal(frame["signal"][count:], frame["signal"][:count])
            image = centre[count:, :2] * (1.0, -1.0) + (0.0, 2 * scene.mirror.position)
            assert image == pytest.approx(centre[:count, :2], abs=1e-6)
            assert areas[count:] == pytest.approx(areas[:count], rel=1e-3)


@pytest.mark.parametrize("seed", [2, 4, 7])
def test_drawing_motion_and_count_agree_on_what_is_loose(tmp_path, seed):
    """Ragged designs, whose outlines part and join what neighbours on the lattice do not."""
    problem = Problem(block(), beta=8.0)
    x = np.random.default_rng(seed).choice([-1.0, 1.0], size=problem.size)
    done = export(problem, x, tmp_path, ["svg", "vtk"], scale=1.0, drop_components=True)
    _, frames = read_motion(tmp_path / "motion.vtkhdf")
    moving = frames[0]["corners"].mean(axis=1)[:, :2]
    position = problem.particles.position
    distance, index = KDTree(position).query(moving)
    assert distance.max() <= 1e-6
    there = np.zeros(len(position), dtype=bool)
    there[index] = True
    gamma = problem.particles.completed(problem.gamma(x))
    assert done.loose == (gamma >= 0.3).sum() - len(moving) >= 100
    upper = np.max([polygon.rings[0].max(axis=0) for polygon in done.polygons], axis=0)
    shift = upper - (28 * C, 24 * C)  # the bar's corner
    inside = [polygon.contains(position + shift) for polygon in done.polygons]
    clear = np.abs(gamma - 0.3) > 1e-2  # void on the line may be on either side
    drawn = np.any(inside, axis=0)
    assert np.array_equal(drawn[clear | there], there[clear | there])
    assert not drawn[(gamma >= 0.3) & ~there].any()
    assert np.all([(one & there).any() for one in inside])


def test_of_a_mirror_scene_all_loose_particles_are_counted(tmp_path):
    problem = Problem(dataclasses.replace(crawler(64, 8e-4), steps=1), beta=8.0)
    rng = np.random.default_rng(1)
    x = problem.join(rng.choice([-1.0, 1.0], size=problem.size - 3), 1.0, -0.3, -0.5)
    counts = []
    for drop in (False, True):
        done = export(problem, x, tmp_path, ["vtk"], drop_components=drop)
        counts.append(len(read_motion(tmp_path / "motion.vtkhdf")[1][0]["corners"]))
    assert done.loose == counts[0] - counts[1] >= 2


@pytest.mark.parametrize(
    ("formats", "options", "what"),
    [
        ([], {"width": 60.0}, "ask for some of svg, dxf, stl, 3mf, vtk"),
        (["step"], {"width": 60.0}, "unknown"),
        (["svg"], {}, "width in mm, or a scale"),
        (["svg"], {"width": 60.0, "scale": 80.0}, "one of them"),
        (["svg"], {"width": 0.0}, "width"),
        (["svg"], {"width": -3.0}, "width"),
        (["svg"], {"width": np.nan}, "width"),
        (["dxf"], {"scale": np.inf}, "scale"),
        (["dxf"], {"width": 1e-6}, "from 0.001 to"),
        (["stl"], {"scale": 1e9}, "choose another size"),
        (["stl"], {"width": 60.0, "thickness": 0.0}, "thickness"),
        (["svg", "stl"], {"width": 60.0, "thickness": 1e9}, "thickness"),
        (["vtk"], {"width": 60.0}, "ask for svg, dxf or stl too"),
        (["vtk"], {"scale": 80.0}, "neither width nor scale"),
        (["svg", "dxf", "vtk"], {"width": 60.0, "thickness": 3.0}, "ask for stl too"),
        (["vtk"], {"kerf": 1.0}, "kerf is that of a drawing or a solid"),
        (["svg"], {"width": 60.0, "kerf": 0.0}, "kerf"),
        (["vtk"], {"parts": True}, "the motion has no parts"),
        (["svg"], {"width": 60.0, "parts": True}, "no actuator"),
    ],
)
def test_sizes_that_make_no_sense_are_refused_and_nothing_is_written(
    holed, tmp_path, formats, options, what
):
    with pytest.raises(ExportError, match=what):
        export(holed[0], holed[1], tmp_path, formats, **options)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("threshold", [0.0, 1.0, -0.3, np.nan])
def test_a_threshold_outside_0_to_1_is_refused(holed, tmp_path, threshold):
    with pytest.raises(DesignError, match="between 0 and 1"):
        export(holed[0], holed[1], tmp_path, ["vtk"], threshold=threshold)


@pytest.mark.parametrize(("name", "package"), [("dxf", "ezdxf"), ("stl", "manifold3d")])
def test_a_missing_extra_says_what_to_install(holed, tmp_path, monkeypatch, name, package):
    monkeypatch.setitem(sys.modules, package, None)
    with pytest.raises(MissingLibraryError, match=rf'{package}: pip install "mpmopt\[export\]"'):
        export(holed[0], holed[1], tmp_path, ["svg", name], width=60.0)
    assert not list(tmp_path.iterdir())
    export(holed[0], holed[1], tmp_path, ["svg"], width=60.0)


def test_a_kerf_wider_than_a_member_or_a_gap_is_warned_of(holed, tmp_path, caplog):
    problem, x = holed
    polygons = in_millimetres(outline(problem, x, keep=problem.gamma(x) >= 0.3), width=60.0)
    member, gap = widths(polygons, 60.0 / 48)
    assert 0.5 < member < gap < 20.0
    done = export(problem, x, tmp_path, ["svg"], width=60.0, kerf=0.5 * (gap + member))
    assert done.detail == pytest.approx(60.0 / 48)
    (warning,) = caplog.messages
    assert warning.startswith(
        f"the thinnest member is {member:.3g} mm wide, less than the kerf of "
    )


def test_a_folder_that_cannot_be_made_is_a_storage_error(holed, tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(StorageError, match="another folder"):
        export(holed[0], holed[1], tmp_path / "file" / "folder", ["svg"], width=60.0)


def run_file(path, problem, x):
    """A run file with a design, as if it had been found."""
    stage = Stage(problem.chain.beta, 1e-2, 1e-3, problem.scene.time_step)
    run = Optimisation(problem.scene, Settings((stage,)), DEFAULT_TASK, x)
    numbers: Any = dict.fromkeys(
        ("move_limit", "non_discreteness", "projected_gradient", "step"), 0.1
    )
    item = Candidate(
        stage=0, beta=stage.beta, time_step=problem.scene.time_step, objective=0.5,
        seconds=1.0, x=x, gamma=problem.gamma(x), **numbers,
    )  # fmt: skip
    run.best[0] = run.first = run.last = item
    run.history.append(item)
    runfile.write(path, run)
    return path


@pytest.mark.process
def test_the_command_writes_all_four_and_says_how_large_it_all_is(holed, tmp_path):
    path = run_file(tmp_path / "run.h5", *holed)
    (tmp_path / "design.svg").write_text("an older one")
    options = ["--svg", "--dxf", "--stl", "--vtk", "--width", "60", "--drop-components", "--force"]
    done = subprocess.run(
        [sys.executable, "-m", "mpmopt", "export", str(path), *options],
        capture_output=True, text=True, timeout=120, cwd=Path(__file__).parent.parent,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    names = {file.name for file in tmp_path.iterdir()}
    assert names == {"run.h5", "design.svg", "design.dxf", "design.stl", "motion.vtkhdf"}
    assert (tmp_path / "design.svg").read_text().startswith("<?xml")
    for file in ("design.svg", "design.dxf", "design.stl", "motion.vtkhdf"):
        assert f"{tmp_path / file}  {(tmp_path / file).stat().st_size} bytes" in done.stdout
    assert "60 x 50 mm" in done.stdout
    assert "pieces  1, with 2 holes" in done.stdout
    assert "widths  thinnest member " in done.stdout
    assert "particles hang on nothing, left out" in done.stdout
    mesh = trimesh.load_mesh(str(tmp_path / "design.stl"))
    assert mesh.bounds[1] == pytest.approx([60.0, 50.0, 6.0], abs=1e-5)
    assert mesh.body_count == 1
    _, frames = read_motion(tmp_path / "motion.vtkhdf")
    assert len(frames[0]["corners"]) == round(
        particles_area(holed[0], holed[1], True) / (WIDTH / 48) ** 2
    )


def test_a_motion_that_fails_takes_nothing_else_with_it(
    holed, tmp_path, capsys, caplog, monkeypatch
):
    def bursts(body, frames):
        raise SimulationError("it burst", 3, -1, (np.nan, np.nan), "take another")

    monkeypatch.setattr(exporting.Motion, "of", bursts)
    path, out = run_file(tmp_path / "run.h5", *holed), tmp_path / "out"
    options = ["--svg", "--dxf", "--stl", "--vtk", "--width", "60", "--drop-components"]
    assert main(["export", str(path), *options, "--out", str(out)]) == 1
    assert {file.name for file in out.iterdir()} == {"design.svg", "design.dxf", "design.stl"}
    printed = capsys.readouterr().out
    assert "design.stl  " in printed and "60 x 50 mm" in printed and "vtkhdf" not in printed
    (warning,) = caplog.messages
    assert warning.startswith("no motion.vtkhdf: step 3, body: it burst")
    with pytest.raises(SimulationError, match="it burst"):
        export(holed[0], holed[1], tmp_path / "none", ["vtk"])
    assert not (tmp_path / "none").exists()


def test_a_file_that_cannot_be_written_takes_nothing_else_with_it(holed, tmp_path, caplog):
    (tmp_path / "design.svg").mkdir()
    done = export(holed[0], holed[1], tmp_path, ["svg", "stl"], width=60.0)
    assert done.paths == (tmp_path / "design.stl",)
    assert done.failed == ("svg",)
    assert caplog.messages[0].startswith("no design.svg: cannot write")
    with pytest.raises(StorageError, match=r"design\.svg"):
        export(holed[0], holed[1], tmp_path, ["svg"], width=60.0)


def test_the_command_says_what_is_missing(holed, tmp_path, capsys):
    path = run_file(tmp_path / "run.h5", *holed)
    assert main(["export", str(path), "--svg"]) == 1
    assert capsys.readouterr().err.startswith("ExportError: a drawing needs a size")
    assert main(["export", str(path), "--width", "60"]) == 1
    assert capsys.readouterr().err.startswith("ExportError: no format is asked for")
    assert main(["export", str(path), "--vtk", "--width", "5"]) == 1
    assert "ask for svg, dxf or stl too" in capsys.readouterr().err
    assert main(["export", str(path), "--svg", "--width", "5", "--thickness", "3"]) == 1
    assert "ask for stl too" in capsys.readouterr().err
    assert [file.name for file in tmp_path.iterdir()] == ["run.h5"]
