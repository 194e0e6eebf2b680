"""A plane of symmetry: half of the body is the same solution."""

import dataclasses
from typing import Any

import numpy as np
import pytest
from conftest import small_scene, worst
from crawler import crawler

from mpmopt.assess.trajectory import with_image
from mpmopt.assess.verify import COMPLEX_TOLERANCE, complex_step_test, kernel_mismatches
from mpmopt.design.problem import Problem
from mpmopt.errors import SceneError
from mpmopt.scene import Actuator, Design, Mirror, Scene, Solid, Wall
from mpmopt.scene.particles import discretise, mirror_images

C = 1 / 16


def channel(axis="y", **changes) -> Scene:
    """A symmetric body that fills a channel along the other axis, and is squeezed in its middle."""
    boxes: list[Any] = [
        (Design, (4, 5), (6, 11)),
        (Actuator, (6, 7), (8, 9)),
        (Solid, (6, 5), (8, 7)),
        (Solid, (6, 9), (8, 11)),
    ]
    flip = slice(None, None, 1 if axis == "y" else -1)
    body = tuple(
        kind(tuple(C * k for k in low[flip]), tuple(C * k for k in high[flip]))
        for kind, low, high in boxes
    )
    direction = (1.0, 0.0) if axis == "y" else (0.0, 1.0)
    walls = (Wall(axis, 5 * C, friction=0.4), Wall(axis, 11 * C, "above", friction=0.4))
    scene = {"body": body, "walls": walls, "gravity": (0.0, 0.0), "direction": direction}
    return small_scene(**{**scene, "mirror": Mirror(axis, 8 * C), **changes})


def both(half, steps):
    """Problems of the half and the whole, and a random symmetric design for each."""
    half = dataclasses.replace(half, steps=steps)
    problems = [Problem(scene, 2.0) for scene in (half, dataclasses.replace(half, mirror=None))]
    parts = [p.particles.subset(p.particles.designed) for p in problems]
    image = mirror_images(half, *parts)
    phi = np.random.default_rng(5).uniform(-0.7, 0.7, len(parts[0].position))
    designs = [p.join(v, 0.9, -0.3, -0.5) for p, v in zip(problems, (phi, phi[image]))]
    return problems, designs, image


@pytest.mark.parametrize(
    ("scene", "steps"),
    [
        (crawler(64, 8e-4).vary(void_density=1e-2), 600),
        (channel("y", time_step=2e-3), 500),
        (channel("x", time_step=2e-3), 500),
    ],
)
def test_half_the_body_is_the_same_solution(scene, steps):
    (half, whole), (x_half, x_whole), image = both(scene, steps)
    assert 2 * len(half.particles.position) == len(whole.particles.position)
    assert half.gamma(x_half)[image] == pytest.approx(whole.gamma(x_whole), abs=1e-14)
    value, gradient = half.value_and_gradient(x_half)
    other, full = whole.value_and_gradient(x_whole)
    assert value == pytest.approx(other, rel=1e-11)
    # A half's variable stands for two of the whole's.
    folded = np.concatenate([np.bincount(image, whole.split(full).phi), full[-3:]])
    assert np.abs(gradient - folded).max() <= 1e-11 * np.abs(folded).max()


@pytest.mark.parametrize("axis", ["x", "y"])
def test_four_steps_of_a_half_are_those_of_the_whole_and_their_gradient_is_exact(axis):
    scene = channel(axis)
    (half, whole), (x_half, x_whole), image = both(scene, 4)
    value, gradient = half.value_and_gradient(x_half)
    other, full = whole.value_and_gradient(x_whole)
    assert value == pytest.approx(other, rel=1e-12)
    folded = np.concatenate([np.bincount(image, whole.split(full).phi), full[-3:]])
    assert np.abs(gradient - folded).max() <= 1e-11 * np.abs(folded).max()
    assert worst(complex_step_test(half, x_half)) <= COMPLEX_TOLERANCE
    assert max(kernel_mismatches(scene).values()) <= 1e-13


@pytest.mark.parametrize("axis", ["x", "y"])
def test_gradient_and_kernels_of_a_half(axis):
    scene = channel(axis)
    (half, _), (x, _), _ = both(scene, 40)
    assert worst(complex_step_test(half, x)) <= COMPLEX_TOLERANCE
    mismatches = kernel_mismatches(scene)
    assert mismatches["mirror"] <= 1e-13
    assert max(mismatches.values()) <= 1e-13


def test_the_state_and_its_image_are_the_whole_state():
    (half, whole), (x_half, x_whole), _ = both(channel("y"), 60)
    image = with_image(half.simulation(x_half).run(), half.scene.mirror)
    state = whole.simulation(x_whole).run()
    order = [np.lexsort(np.round(s[:2], 6)) for s in (image, state)]
    assert image[:, order[0]] == pytest.approx(state[:, order[1]], abs=1e-9)


def test_a_mirrored_scene_survives_json():
    scene = channel("x")
    assert Scene.from_json(scene.to_json()) == scene
    assert Scene.from_json(crawler(64, 8e-4).to_json()).mirror == Mirror("y", 0.5)


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({"mirror": Mirror("y", 0.51)}, r"no line of nodes; the nearest is at 0\.5"),
        ({"mirror": Mirror("y", 9 * C)}, "no mirror image in the body"),
        ({"mirror": 0.5}, "must be a Mirror"),
        ({"gravity": (0.0, -1.0)}, r"gravity \(0\.0, -1\.0\) has a component across"),
        ({"direction": (0.0, 1.0)}, "direction"),
        ({"walls": (Wall("y", 5 * C),)}, r"no mirror image at 0\.6875"),
        (
            {"walls": (Wall("y", 5 * C), Wall("y", 11 * C, "above", friction=0.1))},
            "no mirror image",
        ),
        (
            {"body": (Actuator((6 * C, 7 * C), (8 * C, 9 * C), ((1.0, 0.5), (0.5, 1.0))),)},
            "S_xy = 0",
        ),
        (
            {
                "body": (
                    Actuator((6 * C, 6 * C), (8 * C, 7 * C)),
                    Actuator((6 * C, 9 * C), (8 * C, 10 * C)),
                )
            },
            "its own mirror image",
        ),
    ],
)
def test_what_is_not_symmetric_is_refused(changes, says):
    with pytest.raises(SceneError, match=says):
        channel(**changes)


def test_only_the_half_is_laid_out():
    scene = channel("y")
    half, whole = discretise(scene), discretise(scene, whole=True)
    assert half.position[:, 1].max() < 0.5
    assert 2 * half.volume.sum() == pytest.approx(whole.volume.sum())


@pytest.mark.parametrize("axis", ["x", "y"])
def test_the_subpixel_projection_of_half_a_body_is_that_of_the_whole(axis):
    half = channel(axis)
    whole = dataclasses.replace(half, mirror=None)
    problems = [Problem(scene, 100.0, subpixel=True) for scene in (half, whole)]
    parts = [p.particles.subset(p.particles.designed) for p in problems]
    image = mirror_images(half, *parts)
    phi = np.where(parts[0].position.sum(axis=1) < 12 * C, 1.0, -1.0)
    gamma, gamma_whole = (
        p.gamma(p.join(f, 1.0, 0.0, 0.0)) for p, f in zip(problems, (phi, phi[image]))
    )
    assert np.ptp(gamma) > 0.5
    assert gamma[image] == pytest.approx(gamma_whole, abs=1e-12)
