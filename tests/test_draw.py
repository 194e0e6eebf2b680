"""Bodies and walls are drawn where they are, as what they are."""

import numpy as np
import pytest
from conftest import small_scene
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import to_rgb
from matplotlib.patches import Rectangle

from mpmopt.assess.trajectory import Motion, optimised, reference
from mpmopt.design.problem import Problem
from mpmopt.scene import Grid, Ground, Scene, Solid, Wall
from mpmopt.view.draw import (
    BLUE,
    LAYER,
    RED,
    Squares,
    draw_walls,
    format_of,
    new_figure,
    set_view,
)


def drawn(motion, box, frame=0):
    """A picture (height, width, 3) of a motion in a box, and a function from points to colours."""
    figure = new_figure(4.0, 4.0 * (box[1][1] - box[0][1]) / (box[1][0] - box[0][0]))
    figure.set_layout_engine("none")
    axes = figure.add_axes((0.0, 0.0, 1.0, 1.0))
    axes.set_axis_off()
    set_view(axes, np.array(box))
    axes.add_collection(Squares(motion, frame), autolim=False)
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    picture = np.array(canvas.buffer_rgba())[..., :3] / 255.0

    def colour(points):
        x, y = np.floor(axes.transData.transform(points)).astype(int).T
        return picture[len(picture) - 1 - y, x]

    return picture, colour


def made_up(position, deformation, gamma, actuation):
    """A motion of one instant from arrays with one row for each particle."""
    count = len(gamma)
    return Motion(
        name="made up",
        scene=small_scene(),
        frames=np.array([0]),
        position=np.array(position, np.float32).reshape(count, 2).T[None],
        velocity=np.zeros((1, 2, count), np.float32),
        deformation=np.array(deformation, np.float32).reshape(count, 4).T[None],
        gamma=np.array(gamma, float),
        actuation=np.array(actuation, np.float32)[None],
        largest=1.0,
        objective=np.zeros(1),
    )


def test_a_particle_is_the_square_that_its_deformation_makes(rng):
    position = np.array([(x, y) for x in (0.2, 0.4, 0.6) for y in (0.2, 0.4, 0.6)])
    F = np.eye(2) + rng.uniform(-0.4, 0.4, (9, 2, 2))
    motion = made_up(position, F, np.ones(9), np.zeros(9))
    _, colour = drawn(motion, [(0.1, 0.1), (0.7, 0.7)])
    corners = 0.5 * motion.spacing * np.array([[-1, -1], [1, -1], [1, 1], [-1, 1], [1, 0], [0, 1]])
    for centre, gradient in zip(position, F):
        edge = corners @ gradient.T
        assert np.all(colour(centre + 0.9 * edge) == 0.0)
        assert np.all(colour(centre + 1.4 * edge) == 1.0)


def test_grey_is_gamma_and_red_and_blue_are_the_sign_of_the_signal():
    position = [(0.2 + 0.1 * k, 0.2) for k in range(6)]
    gamma, actuation = [0.0, 0.5, 1.0, 1.0, 1.0, 1.0], [0.0, 0.0, 0.0, 1.0, -1.0, 0.5]
    motion = made_up(position, np.tile(np.eye(2), (6, 1, 1)), gamma, actuation)
    _, colour = drawn(motion, [(0.1, 0.1), (0.8, 0.3)])
    wanted = np.array([(1, 1, 1), (0.5, 0.5, 0.5), (0, 0, 0), RED, BLUE, 0.5 * np.array(RED)])
    assert np.allclose(colour(position), wanted, atol=1 / 255)


def test_actuators_have_the_colour_of_their_signal_at_each_instant():
    scene = small_scene()
    problem = Problem(scene)
    a, theta, b = np.array([0.6, 0.4]), np.array([-0.3, 0.2]), np.array([-0.2, 0.1])
    body = reference(problem, problem.join(0.0, a, theta, b))
    frames = np.array([0, 7, 20])
    motion = Motion.of(body, frames)
    steps = np.arange(scene.steps)[:, None] * scene.time_step
    signal = a * np.sin(np.array([30.0, 50.0]) * steps + np.pi * theta) + b
    for k in (0, 1):
        there = body.simulation.particles.actuator == k
        wanted = signal[frames, k] / np.abs(signal).max()
        assert np.allclose(motion.actuation[:, there], wanted[:, None], atol=1e-6)
    assert np.all(motion.actuation[:, body.simulation.particles.actuator < 0] == 0.0)


def test_a_motion_tells_how_far_it_counts_at_each_instant():
    scene = small_scene(steps=30, transient=10 * 4e-3)
    problem = Problem(scene)
    x = problem.join(0.3, 1.0, -0.3, -0.5)
    start, *before, last = Motion.of(optimised(problem, x), [0, 4, 10, 17, 30]).objective
    assert before[:2] == [start, start]
    assert before[2] != start
    assert last == problem.value(x)


def test_solid_is_drawn_above_void():
    motion = made_up([(0.2, 0.2), (0.2, 0.2)], 2 * [np.eye(2)], [1.0, 0.1], [0.0, 0.0])
    _, colour = drawn(motion, [(0.1, 0.1), (0.3, 0.3)])
    assert np.all(colour([(0.2, 0.2)]) == 0.0)


def test_no_light_shows_between_the_particles_of_a_solid(rng):
    scene = small_scene()
    problem = Problem(scene)
    body = reference(problem, problem.join(0.0, 0.0, 0.0, 0.0))
    motion = Motion.of(body, [0])
    box = motion.box
    _, colour = drawn(motion, [(0.1, 0.2), (0.6, 0.5)])
    assert np.all(colour(rng.uniform(*box, (2000, 2))) == 0.0)


@pytest.mark.parametrize("place", [4.0, 5.0])
@pytest.mark.parametrize("side", ["below", "above"])
@pytest.mark.parametrize("gravity", [2.0, 10.0])
def test_walls_are_drawn_where_bodies_rest_on_them(place, side, gravity):
    dx = 1 / 32
    up = 1.0 if side == "below" else -1.0  # away from the wall

    def height(cells):
        return cells * dx if side == "below" else 1.0 - cells * dx

    low, high = sorted([height(5), height(9)])
    scene = Scene(
        Grid((32, 32), dx), 2e-3, 1500, gravity=(0.0, -up * gravity),
        walls=(Wall("y", height(place), side),),
        body=(Solid((8 * dx, low), (16 * dx, high)),),
    )  # fmt: skip
    body = optimised(Problem(scene), np.empty(0))
    motion = Motion.of(body, range(scene.steps // 2, scene.steps + 1, 10))
    half = 0.5 * motion.spacing * motion.deformation[:, 3]
    edge = up * (up * motion.position[:, 1] - half).min(axis=1).mean()
    axes = new_figure(4.0, 4.0).add_subplot()
    set_view(axes, np.array([(0.0, 0.0), (1.0, 1.0)]))
    draw_walls(axes, scene, moving=True)
    (wall,) = axes.patches
    assert isinstance(wall, Rectangle)
    line = wall.get_y() + (wall.get_height() if side == "below" else 0.0)
    assert abs(edge - line) <= 0.2 * dx


@pytest.mark.parametrize(
    ("values", "shown"),
    [
        ([0.0, 0.0123, 0.16], ["0.000", "0.012", "0.160"]),
        ([0.0, 1.6, 4.0], ["0.00", "1.60", "4.00"]),
        ([0.2031, np.nan, 0.3242], ["0.203", "nan", "0.324"]),
        ([0.00203, 0.00324], ["0.00203", "0.00324"]),
        ([2.031e-8, 3.242e-8], ["2.03e-08", "3.24e-08"]),
        ([203.1, 324.2], ["203", "324"]),
        ([0.0, 1024000.0, 5.123e8], ["0", "1.02e+06", "5.12e+08"]),
        ([12.3451, 12.3459], ["12.3451", "12.3459"]),
        ([0.2031, 0.2031], ["0.203100", "0.203100"]),
        ([0.0, 0.0], ["0", "0"]),
        ([np.nan], ["nan"]),
        ([-0.02, 0.01], ["-0.0200", "0.0100"]),
    ],
)
def test_numbers_have_three_digits_of_their_range_in_any_unit(values, shown):
    assert [f"{value:{format_of(values)}}" for value in values] == shown


def test_the_layer_of_the_ground_is_shaded_as_far_as_it_bears(rng):
    c = 1 / 16
    points = ((0.0, 3 * c), (0.5, 2 * c), (0.5, 5 * c), (1.0, 4 * c))
    scene = small_scene(walls=(), ground=(Ground(points, thickness=c),))
    figure = new_figure(4.0, 4.0)
    figure.set_layout_engine("none")
    axes = figure.add_axes((0.0, 0.0, 1.0, 1.0))
    axes.set_axis_off()
    set_view(axes, np.array([(0.0, 0.0), (1.0, 1.0)]))
    draw_walls(axes, scene)
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    image = np.asarray(canvas.buffer_rgba())[::-1, :, :3] / 255.0
    place = rng.uniform(0.02, 0.98, (2, 4000))
    colour = image[tuple(np.floor(place[::-1] * len(image)).astype(int))]
    d, _ = scene.ground[0].distance(place)
    within, outside = (d > 0.2 * c) & (d < 0.9 * c), d > 1.1 * c
    assert within.sum() > 100 and outside.sum() > 100
    assert np.all(abs(colour[within] - to_rgb(LAYER)) < 0.01)
    assert np.all(colour[outside] == 1.0)
    assert not np.any(np.all(abs(colour[d < -0.2 * c] - to_rgb(LAYER)) < 0.01, axis=1))


def test_a_small_step_of_the_ground_has_a_dark_outline():
    c = 1 / 16
    points = ((0.0, 2 * c), (0.5, 2 * c), (0.5, 2.2 * c), (1.0, 2.2 * c))
    scene = small_scene(walls=(), ground=(Ground(points, thickness=c),))
    figure = new_figure(4.0, 4.0)
    figure.set_layout_engine("none")
    axes = figure.add_axes((0.0, 0.0, 1.0, 1.0))
    set_view(axes, np.array([(0.0, 0.0), (1.0, 1.0)]))
    draw_walls(axes, scene, moving=True)
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    image = np.asarray(canvas.buffer_rgba())[::-1, :, 0]
    size = len(image)
    for x, y in ((0.25, 2 * c), (0.5, 2.1 * c), (0.75, 2.2 * c)):
        i, j = round(y * size), round(x * size)
        assert image[i - 2 : i + 3, j - 2 : j + 3].min() < 80
        assert image[i - 8 : i - 3, j - 8 : j - 3].min() > 80 or x == 0.5
