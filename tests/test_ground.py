"""Ground is a signed distance; a scene checks it, knows its defaults, and keeps it in JSON."""

import dataclasses
import json
import math
from itertools import pairwise

import numpy as np
import pytest
from conftest import small_scene
from walker import walker

from mpmopt import kernels
from mpmopt.assess.verify import COMPLEX_STEP
from mpmopt.errors import SceneError
from mpmopt.kernels import ground as kernel
from mpmopt.scene import Actuator, Ground, Material, Mirror, Scene, Solid
from mpmopt.simulation.surroundings import parameters_of

C = 1 / 16
STEPS = (
    (1 * C, 2 * C),
    (4 * C, 3 * C),
    (5 * C, 1 * C),
    (8 * C, 1 * C),
    (8.5 * C, 3 * C),
    (16 * C, 2 * C),
)


def standing(*ground, **changes):
    """The small scene without walls, on ground."""
    return small_scene(**{"walls": (), "ground": ground, "time_step": 2e-3, **changes})


def low_ground():
    """A rough one, all of it below the small scene's body."""
    return Ground(STEPS, thickness=C)


def tables(ground):
    return parameters_of(standing(ground)).ground


def test_a_distance_is_that_of_the_nearest_point_and_positive_on_the_left(rng):
    ground = low_ground()
    points = np.array([(-9.0, -10 * C / 3 + 2 * C - 8 / 3), *STEPS, (9.0, 2 * C - (9 - 1) / 7.5)])
    points[0] = np.add(STEPS[0], -20.0 * np.subtract(STEPS[1], STEPS[0]))
    points[-1] = np.add(STEPS[-1], 20.0 * np.subtract(STEPS[-1], STEPS[-2]))
    fine = np.concatenate([np.linspace(a, b, 2000) for a, b in pairwise(points[1:-1])])
    x = rng.uniform(0.1, 0.9, (2, 400))
    d, n = ground.distance(x)
    nearest = np.hypot(*(x[:, :, None] - fine.T[:, None])).min(axis=1)
    assert np.abs(np.abs(d) - nearest).max() <= 1e-3
    # A closed polygon far below; its crossings above a place tell its side.
    top = np.interp(x[0], points[:, 0], points[:, 1])
    assert np.array_equal(d > 0.0, x[1] > top)
    assert np.abs(np.hypot(*n) - 1.0).max() <= 1e-14


@pytest.mark.parametrize("points", [STEPS, STEPS[:2], STEPS[:3]])
def test_the_normal_is_the_gradient_and_its_adjoint_is_transposed(rng, points):
    ground = Ground(points, thickness=C)
    data = tables(ground)
    law, adjoint = kernels.plain(kernel.distance), kernels.plain(kernel.distance_adjoint)
    corners = 0
    for x in rng.uniform(0.0, 0.6, (200, 2)):
        d, nx, ny, bend = law(*x, data, 0)
        other_d, other_n = ground.distance(x)
        assert [d, nx, ny] == pytest.approx([float(other_d), *other_n], abs=1e-14)
        corners += bend != 0.0
        w = rng.standard_normal(3)
        found = adjoint(nx, ny, bend, *w)
        for k in (0, 1):
            moved = [v + 1j * COMPLEX_STEP * (k == axis) for axis, v in enumerate(x)]
            varied = np.imag(law(*moved, data, 0)[:3]) / COMPLEX_STEP
            assert varied[0] == pytest.approx((nx, ny)[k], abs=1e-14)
            size = np.abs(w * varied).sum() + 1.0
            assert abs(w @ varied - found[k]) <= 1e-13 * size
    assert corners > 0 or len(points) == 2


def test_at_a_corner_itself_the_normal_is_that_of_a_side():
    data = tables(low_ground())
    d, nx, ny, bend = kernels.plain(kernel.distance)(*STEPS[1], data, 0)
    assert (d, bend) == (0.0, 0.0)
    assert nx**2 + ny**2 == pytest.approx(1.0)


def test_a_ceiling_is_a_floor_the_other_way_round():
    floor, ceiling = Ground.floor(0.2), Ground(((1.0, 0.2), (0.0, 0.2)))
    x = np.array([[0.3, 5.0, -7.0], [0.5, 0.1, 0.2]])
    assert floor.distance(x)[0] == pytest.approx([0.3, -0.1, 0.0])
    assert ceiling.distance(x)[0] == pytest.approx([-0.3, 0.1, 0.0])
    assert ceiling.distance(x)[1] == pytest.approx(np.array([[0.0] * 3, [-1.0] * 3]))


def test_slopes_and_heights_are_what_they_say():
    slope = Ground.slope((1.0, 2.0), 30.0)
    d, n = slope.distance(np.array([1.0, 3.0]))
    assert d == pytest.approx(math.cos(math.pi / 6))
    assert n == pytest.approx([-0.5, math.sqrt(0.75)])
    rough = Ground.heights((0.0, 1.0, 2.0), (0.0, 1.0, 1.0), friction=0.1)
    assert rough == Ground(((0.0, 0.0), (1.0, 1.0), (2.0, 1.0)), friction=0.1)


def test_nodes_know_the_ground_that_they_are_the_deepest_in():
    floor = Ground.floor(2 * C, friction=0.25, thickness=C)
    wall = Ground(((2 * C, 9 * C), (2 * C, 0.0)), friction=math.inf, thickness=2 * C, damping=3.0)
    scene = standing(floor, wall)
    data, rows = parameters_of(scene).ground, scene.grid.cells[1] + 1
    low, left = data.nodes[[9 * rows + 1, 1 * rows + 9]]
    assert low[:3] == pytest.approx((0.0, 1.0, 0.25))
    assert left[:4] == pytest.approx((1.0, 0.0, math.inf, 3.0))
    assert data.clearance[9 * rows + 9] == pytest.approx(5 * C)
    assert data.clearance[9 * rows + 1] == pytest.approx(-2 * C)


def test_defaults_follow_from_the_body_its_weight_and_its_stiffness():
    (layer,) = dataclasses.replace(
        walker(64, 8e-4), walls=(), ground=(Ground.floor(3 / 64),)
    ).layers
    assert layer.thickness == pytest.approx(1 / 64)
    assert layer.stiffness == pytest.approx(2560.0)
    assert layer.damping == pytest.approx(1.0)
    assert layer.creeping_speed == pytest.approx(0.0195, abs=1e-4)
    weightless = standing(low_ground(), gravity=(0.0, 0.0))
    assert weightless.layers[0].creeping_speed == pytest.approx(
        weightless.material.wave_speed / 256
    )


def test_a_layer_shortens_the_time_step():
    free, held = standing(), standing(Ground.floor(2 * C, thickness=C, stiffness=1e3))
    elastic = (2.0 * C / free.largest_time_step) ** 2
    rate = elastic / (4.0 * C**2) + 1e3 / C / 4.0 * 1.0
    assert free.material.density == 1.0
    assert held.largest_time_step == pytest.approx(1.0 / math.sqrt(rate))


def test_json_gives_back_the_same_ground():
    scene = standing(low_ground(), Ground.floor(1 * C, friction=math.inf, thickness=C, damping=0.5))
    assert scene.ground[1].friction == "stick"
    assert Scene.from_json(scene.to_json()) == scene
    data = json.loads(scene.to_json())
    data["ground"][0]["slope"] = 3.0
    with pytest.raises(SceneError, match="unknown keys"):
        Scene.from_json(json.dumps(data))


def test_a_scene_says_what_it_stands_on():
    floor = Ground.floor(2 * C, thickness=C)
    assert "on ground from (0.0, 0.1" in str(standing(floor))
    for points, told in (
        (floor.points, "level at y = 0.125 (friction"),
        (((0.0, 0.1), (0.7, 0.1), (0.7, 0.12), (1.0, 0.12)),
         "level at y = 0.1, a step of 0.02 up at x = 0.7, level at y = 0.12 (friction"),
        (((0.0, 0.1), (0.7, 0.1), (1.0, -0.2)), "level at y = 0.1, falling by 45 degrees"),
        (tuple((0.1 * k, 0.01 * (k % 2)) for k in range(9)),
         "8 segments between y = 0 and y = 0.01"),
    ):  # fmt: skip
        assert told in str(standing(dataclasses.replace(floor, points=points)))


@pytest.mark.parametrize(
    ("points", "said"),
    [
        (((0.0, 0.0),), "1 points"),
        (5, "0 points"),
        (((0.0, 0.0), (0.0, 0.0)), "0 and 1 are the same"),
        (((0.0, 0.0), (1.0, 0.0), (0.5, 0.0)), "turns back at point 1"),
        (((0.0, 0.0), (1.0, 0.0), (1.0, 1.0), (0.5, -1.0)), "segments 0 and 2 cross"),
        (((0.0, 0.0), (1.0, 1.0), (2.0, 0.5), (2.0, 1.0), (0.5, 0.9)), "segments 0 and 3 cross"),
        (((0.0, 0.0), (1.0, 0.0), (1.0, 1.0), (0.0, 0.0), (0.5, -1.0)), "cross"),
        (((0.0, 0.0), (1.0, 0.0), (1.5, 1.0), (2.0, 0.0), (1.2, 0.0)), "segments 0 and 3 cross"),
        (((0.0, math.nan), (1.0, 0.0)), "points"),
    ],
)
def test_a_line_that_does_not_part_the_plane_is_none(points, said):
    with pytest.raises(SceneError, match=said):
        Ground(points)


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"friction": -0.1}, "friction = -0.1 must not be negative"),
        ({"friction": "slip"}, "friction"),
        ({"damping": -1.0}, "damping"),
        ({"thickness": 0.0}, "thickness"),
        ({"stiffness": -2.0}, "stiffness"),
        ({"creeping_speed": 0.0}, "creeping_speed"),
    ],
)
def test_numbers_of_a_ground_are_checked(changes, said):
    with pytest.raises(SceneError, match=said):
        Ground.floor(0.0, **changes)


def test_slopes_and_heights_are_checked():
    with pytest.raises(SceneError, match="90"):
        Ground.slope((0.0, 0.0), 90.0)
    with pytest.raises(SceneError, match="increase"):
        Ground.heights((0.0, 0.0), (1.0, 2.0))
    with pytest.raises(SceneError, match="as many"):
        Ground.heights((0.0, 1.0), (1.0,))


def test_a_layer_thinner_than_half_a_cell_says_the_cure():
    with pytest.raises(SceneError, match=r"less than half a cell, 0.03125; take thickness=0.03125"):
        standing(Ground.floor(2 * C))
    standing(Ground.floor(2 * C, thickness=C / 2))


def test_a_layer_too_soft_for_three_times_the_weight_says_the_cure():
    weight = 10.0 * 3 * C + 0.5 * 4 * C
    bears = 6.0 * weight / C
    with pytest.raises(SceneError, match=f"take stiffness={bears:g} or more"):
        standing(Ground.floor(2 * C, thickness=C, stiffness=0.999 * bears))
    standing(Ground.floor(2 * C, thickness=C, stiffness=bears))


@pytest.mark.parametrize(
    "ground",
    [
        Ground.floor(4.1 * C, thickness=C),
        Ground.floor(9.0 * C, thickness=C),
        Ground(((7.5 * C, 0.0), (4.0 * C, 5.0 * C), (4.5 * C, 0.0))[::-1], thickness=C),
        Ground(((4.2 * C, 0.0), (4.2 * C, 9.0)), thickness=C),
    ],
)
def test_a_body_that_starts_inside_the_ground_is_refused(ground):
    with pytest.raises(SceneError, match="reaches into ground 0"):
        standing(ground)


def test_a_body_may_start_on_the_ground():
    standing(Ground.floor(4 * C, thickness=C))
    standing(Ground(((3 * C, 9 * C), (3 * C, 4 * C), (9 * C, 4 * C)), thickness=C))


def mirrored(*ground):
    body = (
        Actuator((3 * C, 4 * C), (5 * C, 7 * C)),
        Solid((1 * C, 4 * C), (3 * C, 7 * C)),
        Solid((5 * C, 4 * C), (7 * C, 7 * C)),
    )
    return standing(
        *ground, body=body, mirror=Mirror("x", 4 * C), gravity=(0.0, -10.0), direction=(0.0, 1.0)
    )


def test_grounds_have_mirror_images():
    flat = Ground.floor(3 * C, thickness=C)
    hill = Ground(((1 * C, 0.0), (4 * C, 3 * C), (7 * C, 0.0)), thickness=C)
    roof = Ground(((-2 * C, -3 * C), (4 * C, 3 * C), (5 * C, 2 * C)), thickness=C)
    slope = Ground.slope((4 * C, 3 * C), -10.0, thickness=C)
    other = Ground.slope((4 * C, 3 * C), 10.0, thickness=C)
    for grounds in ((flat,), (hill,), (roof,), (slope, other)):
        mirrored(*grounds)
    for grounds in ((slope,), (slope, dataclasses.replace(other, friction=0.3))):
        with pytest.raises(SceneError, match="ground 0 has no mirror image"):
            mirrored(*grounds)


def test_a_coarser_scene_keeps_its_ground():
    scene = dataclasses.replace(
        walker(128, 5e-4), walls=(), ground=(Ground.floor(3 / 64),), material=Material()
    )
    coarser = dataclasses.replace(scene, grid=walker(64, 5e-4).grid)
    assert coarser.layers[0][1:] == scene.layers[0][1:]
