"""A scene is checked on construction and survives JSON exactly."""

import dataclasses
import json
import math
from itertools import count
from typing import Any

import numpy as np
import pytest
from conftest import small_scene
from walker import CASES, walker

from mpmopt.design.chain import DesignChain
from mpmopt.errors import SceneError
from mpmopt.scene import Actuator, Design, Grid, Material, Mirror, Region, Scene, Solid, Wall
from mpmopt.scene.particles import discretise


@pytest.mark.parametrize("case", CASES)
def test_json_gives_back_exactly_the_same_scene(case):
    scene = CASES[case].scene
    assert Scene.from_json(scene.to_json()) == scene


def test_json_may_leave_out_what_has_a_default(scene):
    data = json.loads(scene.to_json())
    del data["transient"]
    assert Scene.from_json(json.dumps(data)) == scene


def test_json_keeps_every_bit_of_odd_numbers():
    scene = small_scene(time_step=math.pi * 1e-3, gravity=(1 / 3, -9.80665), direction=(0.6, 0.8))
    again = Scene.from_json(scene.to_json())
    assert again == scene
    assert again.time_step.hex() == scene.time_step.hex()


@pytest.mark.parametrize(
    "damage",
    [
        lambda d: d.update(timestep=1.0),
        lambda d: d.pop("grid"),
        lambda d: d.update(grid=[16, 16]),
        lambda d: d["grid"].update(dz=1.0),
        lambda d: d["body"][0].update(kind="liquid"),
        lambda d: d["body"][0].pop("kind"),
        lambda d: d["body"][0].update(kind=["design"]),
        lambda d: d["walls"][0].update(axis="z"),
        lambda d: d.update(body={}),
        lambda d: d.update(walls=[1]),
        lambda d: d.update(steps=2.5),
        lambda d: d.update(steps=True),
        lambda d: d.update(time_step="0.001"),
        lambda d: d.update(time_step=float("nan")),
        lambda d: d.update(gravity=[0.0, float("inf")]),
        lambda d: d.update(gravity=[0.0]),
        lambda d: d.update(direction="ab"),
    ],
)
def test_json_that_is_no_scene_is_refused(damage, scene):
    data = json.loads(scene.to_json())
    damage(data)
    with pytest.raises(SceneError):
        Scene.from_json(json.dumps(data))


@pytest.mark.parametrize("text", ["", "{", "[]", "null", "3", '"scene"', "[" * 100000])
def test_text_that_is_no_json_object_is_refused(text):
    with pytest.raises(SceneError):
        Scene.from_json(text)


C = 1 / 16


WRONG: Any = ((1.0, 2.0), "left")  # of types that mypy refuses


@pytest.mark.parametrize(
    ("build", "says"),
    [
        (lambda: Grid((16, 0), C), ["0"]),
        (lambda: Grid((16, 16), -1.0), ["-1.0", "above 0"]),
        (lambda: Material(density=0.0), ["density", "0.0"]),
        (lambda: Material(lame_lambda=-1.0), ["-1.0"]),
        (lambda: Material(void_density=2.0), ["2.0", "at most 1"]),
        (lambda: Design((0.2, 0.2), (0.1, 0.3)), ["0.2", "0.1"]),
        (lambda: Actuator((0, 0), (1, 1), stress=((1.0, 2.0), (3.0, 1.0))), ["2.0", "3.0"]),
        (lambda: Actuator((0, 0), (1, 1), stress=WRONG[0]), ["2 entries"]),
        (lambda: Solid((1, 0), (1, 2)), ["(1.0, 0.0)", "left of and below", "(1.0, 2.0)"]),
        (lambda: Solid((0, 2), (1, 2)), ["(0.0, 2.0)", "left of and below", "(1.0, 2.0)"]),
        (lambda: Wall("y", 0.1, friction=-0.5), ["-0.5"]),
        (lambda: Mirror("y", math.nan), ["Mirror", "position", "nan"]),
        (lambda: Wall("y", 0.1, solid_side=WRONG[1]), ["left"]),
        (lambda: small_scene(direction=(1.0, 1.0)), ["1.41421356", "length 1"]),
        (lambda: small_scene(filter_weights=(0.5, 0.1, 0.1)), ["1.3", "sum to 1"]),
        (lambda: small_scene(filter_length=-0.1), ["filter_length", "-0.1"]),
        (lambda: small_scene(transient=-0.1), ["transient", "-0.1"]),
        (lambda: small_scene(steps=30, transient=0.119), ["0.119", "30 steps", "take more"]),
        (lambda: small_scene(filter_length=2.0), ["5118 passes", "200"]),
        (lambda: small_scene(body=()), ["no Solid and no Actuator"]),
        (lambda: small_scene(body=(Design((3 * C, 4 * C), (6 * C, 6 * C)),)), ["objective"]),
        (lambda: small_scene(body=(Solid((0.0, 4 * C), (C, 5 * C)),)), ["0.0625", "0.9375"]),
        (lambda: small_scene(body=(Solid((4 * C, 5 * C), (5 * C, 0.99)),)), ["0.99", "0.9375"]),
        (
            lambda: small_scene(body=(Solid((0.26, 4 * C), (0.5, 0.5)),)),
            ["0.26", "0.03125", "0.25"],
        ),
        (
            lambda: small_scene(
                body=(
                    Solid((4 * C, 5 * C), (6 * C, 7 * C)),
                    Solid((5 * C, 6 * C), (7 * C, 8 * C)),
                )
            ),
            ["overlaps"],
        ),
        (lambda: small_scene(walls=(Wall("y", 5 * C),)), ["0.0625 into the wall", "0.3125"]),
        (lambda: small_scene(walls=(Wall("y", 1.5),)), ["1.5", "within [0.0625, 0.9375]"]),
        (lambda: small_scene(walls=(Wall("y", 0.0),)), ["y = 0 ", "nodes behind it"]),
        (
            lambda: small_scene(walls=(Wall("y", 2.25 * C),)),
            ["no line of nodes", "nearest", "0.125"],
        ),
        (lambda: small_scene(steps=10**30), ["from 1 to 1e+08"]),
        (lambda: small_scene().vary(time_step=1e-20), ["more than 1e+08 steps"]),
        (lambda: small_scene(time_step=0.1), ["0.1", "0.00988", "stability"]),
        (lambda: small_scene(material=Material(void_density=1e-4)), ["0.004", "0.0031"]),
        (lambda: small_scene(material=Material(lame_mu=4.0)), ["above -4", "reach -4"]),
        (lambda: small_scene(particles_per_cell=0), ["0", "from 1 to"]),
        (lambda: small_scene(particles_per_cell=101), ["101", "from 1 to 100"]),
        (lambda: small_scene(time_step=10**5000), ["a int must be finite"]),
        (lambda: small_scene(steps=10**5000), ["a int must be from 1"]),
        (lambda: small_scene(time_step=1e-31), ["1e-31", "from 1e-30 to 1e+30"]),
        (lambda: small_scene(gravity=(0.0, -1e31)), ["-1e+31", "from 1e-30 to 1e+30"]),
        (lambda: small_scene(direction=1000 * [0.0]), ["0.0, ", "...", "2 entries"]),
        (lambda: small_scene(direction=count()), ["2 entries"]),
        (lambda: small_scene(walls=1001 * (Wall("y", 4 * C),)), ["1001 parts", "1000"]),
        (lambda: small_scene(grid=16), ["Grid"]),
        (lambda: small_scene(body=(1,)), ["Region"]),
    ],
)
def test_what_cannot_be_simulated_is_refused_with_the_numbers(build, says):
    with pytest.raises(SceneError) as error:
        build()
    for part in says:
        assert part in str(error.value)


def test_stability_limit_is_that_of_an_isolated_particle():
    # dx sqrt(rho / (2 (mu + lambda))) is 0.866 dx / c_p for lambda = mu.
    scene = walker(64, 8e-4)
    limit = math.sqrt(3.0) / 2.0 * scene.grid.dx / scene.material.wave_speed
    assert scene.largest_time_step == pytest.approx(limit, rel=1e-14)
    assert walker(128, 2e-4).courant == pytest.approx(0.140, abs=5e-4)


def test_light_stiff_void_lowers_the_stability_limit(scene):
    light = scene.vary(void_density=1e-3, void_stiffness=2e-3)
    assert light.largest_time_step == pytest.approx(scene.largest_time_step / math.sqrt(2.0))


def test_another_time_step_keeps_the_duration(scene):
    finer = scene.vary(time_step=1e-3)
    assert (finer.steps, finer.time_step) == (160, 1e-3)
    with pytest.raises(SceneError, match=r"0\.16 is no multiple of time_step = 0\.003"):
        scene.vary(time_step=3e-3)


WIDE = Grid((10**8, 10**8), C)


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (
            {"grid": WIDE, "body": (Solid((C, C), (1e5 * C + C, 1e5 * C + C)),), "walls": ()},
            ["40000000000 particles", "4.8e+11 numbers", "1e+08", "larger cells"],
        ),
        (
            {
                "grid": WIDE,
                "body": (
                    Solid((4 * C, 4 * C), (5 * C, 5 * C)),
                    Solid((1e6 * C, 1e6 * C), (1e6 * C + C, 1e6 * C + C)),
                ),
                "walls": (),
            },
            ["spans 1000002000001 nodes", "1e+08", "larger cells"],
        ),
        (
            {"grid": WIDE, "body": (Actuator((4 * C, 4 * C), (5 * C, 5 * C)),), "steps": 10**8},
            None,  # just as much as there may be
        ),
        (
            {"steps": 10**8},
            ["100000000 signals of 2 actuators", "2e+08", "fewer steps"],
        ),
        (
            {
                "grid": WIDE,
                "body": (
                    Design((4 * C, 4 * C), (504 * C, 504 * C)),
                    Solid((504 * C, 4 * C), (505 * C, 5 * C)),
                ),
                "filter_length": 5 * C,
            },
            ["1000000 particles to", "a shorter filter_length"],
        ),
    ],
)
def test_a_scene_that_takes_too_much_memory_is_refused_before_it_is_taken(change, says):
    if says is None:
        assert small_scene(**change).steps == 10**8
        return
    with pytest.raises(SceneError) as error:
        small_scene(**change)
    for part in says:
        assert part in str(error.value)


@pytest.mark.parametrize("extent", [8, 16])
def test_the_filter_is_never_larger_than_what_is_refused(extent):
    # The estimate bounds the filter's entries per particle from above.
    scene = walker(64, 8e-4)
    scene = dataclasses.replace(scene, filter_length=extent / 8 * scene.grid.dx)
    entries = DesignChain(scene, discretise(scene), 1.0).filter.nnz
    assert entries <= scene.filter_neighbours * discretise(scene).designed.sum()


def test_a_scene_cannot_be_changed(scene):
    with pytest.raises(dataclasses.FrozenInstanceError):
        scene.steps = 1


def test_edges_that_touch_but_for_rounding_do_not_overlap():
    grid = Grid((20, 20), 0.05)
    left, right = Design((0.1, 0.1), (3 * 0.1, 0.5)), Solid((0.3, 0.1), (0.5, 0.5))
    assert left.upper[0] > right.lower[0]
    scene = Scene(grid, time_step=1e-3, steps=1, body=(left, right))
    assert len(discretise(scene).position) == 4 * 4 * 8 * 2


def test_a_region_that_is_neither_design_nor_solid_nor_actuator_is_refused():
    with pytest.raises(SceneError, match="a Region must be"):
        small_scene(body=(Solid((3 * C, 4 * C), (4 * C, 5 * C)), Region((0.5, 0.5), (0.6, 0.6))))


@pytest.mark.parametrize(
    "text",
    [
        '{"steps": 1, "steps": 2}',
        '{"steps": 1' + 400 * "0" + "}",
        '{"steps": 1' + 5000 * "0" + "}",
        '{"grid": {"cells": [16, 16], "dx": 1'
        + 400 * "0"
        + '}, "time_step": 1, "steps": 1, "body": []}',
        "{" + ", ".join(f'"a{k % 20000}": 1' for k in range(40000)) + "}",
        '{"steps": 1' + 10**6 * " " + "}",
        '{"time_step": NaN}',
        '{"time_step": -Infinity}',
        '{"grid":' * 100000,
        3,
        b"{}",
        None,
    ],
)
def test_numbers_and_keys_that_json_allows_but_a_scene_does_not(text):
    with pytest.raises(SceneError):
        Scene.from_json(text)


@pytest.mark.parametrize("value", [np.complex128(1 + 2j), True, "1", None, [1.0]])
def test_only_real_numbers_are_numbers(value):
    with pytest.raises(SceneError, match="must be a number"):
        Material(density=value)
