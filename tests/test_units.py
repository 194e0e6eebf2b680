"""No absolute length, mass or time decides anything, or is lost where it is printed."""

import dataclasses
import re

import numpy as np
import pytest
from conftest import small_scene
from exact import at_rest, solid_simulation

from mpmopt import __main__ as commands
from mpmopt.app.multistart import report
from mpmopt.app.summary import summarise, table
from mpmopt.assess import threshold
from mpmopt.design.problem import Problem
from mpmopt.optimisation.loop import optimise
from mpmopt.optimisation.settings import Settings, Stage
from mpmopt.optimisation.starts import random_start
from mpmopt.results import runfile
from mpmopt.scene import Actuator, Grid, Ground, Material, Solid
from mpmopt.scene.particles import discretise
from mpmopt.view.live import ProgressBar

# What is a length; the rest has no unit.
LENGTHS = ("objective", "post_processed", "refined", "projected_gradient")


def scaled(scene, length, mass, time):
    """The same scene in other units."""
    stress = mass / time**2

    def solid(material):
        return dataclasses.replace(
            material,
            density=mass / length**2 * material.density,
            lame_lambda=stress * material.lame_lambda,
            lame_mu=stress * material.lame_mu,
            viscosity=stress * time * material.viscosity,
        )

    def region(part):
        changes = {
            name: tuple(length * v for v in getattr(part, name)) for name in ("lower", "upper")
        }
        if part.material is not None:
            changes["material"] = solid(part.material)
        if isinstance(part, Actuator):
            changes["stress"] = tuple(tuple(stress * s for s in row) for row in part.stress)
            changes["angular_frequency"] = part.angular_frequency / time
        return dataclasses.replace(part, **changes)

    return dataclasses.replace(
        scene,
        grid=Grid(scene.grid.cells, length * scene.grid.dx),
        time_step=time * scene.time_step,
        body=tuple(region(part) for part in scene.body),
        walls=tuple(dataclasses.replace(w, position=length * w.position) for w in scene.walls),
        ground=tuple(
            dataclasses.replace(g, points=tuple((length * x, length * y) for x, y in g.points))
            for g in scene.ground
        ),
        material=solid(scene.material),
        gravity=tuple(length / time**2 * g for g in scene.gravity),
        filter_length=length * scene.filter_length,
        transient=time * scene.transient,
    )


def optimised(length=1.0, mass=1.0, time=1.0):
    """An optimisation that its stop rule ends, in other units, and all designs."""
    scene = small_scene(steps=20, filter_length=2 / 16, transient=2 * 4e-3, particles_per_cell=3)
    scene = scaled(scene, length, mass, time)
    stages = (
        Stage(0.5, 1e-2, 1e-3, 4e-3 * time),
        Stage(8.0, 1e-2, 1e-3, 4e-3 * time, solid=True, refined=True, void_cutoff=0.05),
    )
    settings = Settings(stages, window=3, tolerance=1e-4, least_iterations=4, most_iterations=40)
    designs = []
    start = Problem(stages[0].scene(scene)).join(0.0, 1.0, -0.3, -0.5)
    done = optimise(scene, settings, start, [lambda run: designs.append(run.last)])
    return done, designs


def test_a_random_start_is_the_same_in_all_units():
    scene = small_scene(steps=1)
    position = Problem(scene).particles.position
    other = random_start(scaled(scene, 2.0**-9, 2.0, 2.0**5), 3)
    assert np.array_equal(other(2.0**-9 * position), random_start(scene, 3)(position))


@pytest.fixture(scope="module")
def plain():
    return optimised()


@pytest.mark.parametrize(
    ("length", "mass", "time"),
    [
        (2.0**-9, 1.0, 1.0),
        (1.0, 2.0**19, 1.0),
        (1.0, 1.0, 2.0**-7),
        (2.0**-27, 2.0**30, 2.0**20),
        (2.0**11, 2.0**-12, 2.0**5),
    ],
)
def test_other_units_lead_to_the_same_steps_bit_for_bit(plain, length, mass, time):
    (one, designs), (other, others) = plain, optimised(length, mass, time)
    assert len(one.history) == len(other.history)
    assert "iterations changed by" in one.stop_reason
    units = {**dict.fromkeys(LENGTHS, length), "time_step": time}
    for item, there in zip(designs, others):
        assert np.array_equal(item.x, there.x)
        assert np.array_equal(item.gamma, there.gamma)
        for name, value in item.numbers().items():
            if value == ():  # no constraints
                continue
            if name not in ("seconds", "failure"):
                found = getattr(there, name)
                assert np.array_equal(units.get(name, 1.0) * value, found, equal_nan=True), name
    one, two = summarise(one), summarise(other)
    for name in ("start", "reference", "optimised", "post_processed", "post_processed_half_step"):
        assert two[name] == (None if one[name] is None else length * one[name])
    assert [two[name] for name in ("retained_gain", "non_discreteness", "a", "theta", "b")] == [
        one[name] for name in ("retained_gain", "non_discreteness", "a", "theta", "b")
    ]
    assert one["post_processed_half_step"] is not None


def test_viscous_regions_are_the_same_in_all_units_bit_for_bit():
    soft = Material(viscosity=0.02)
    body = small_scene().body
    body = (*body[:2], dataclasses.replace(body[2], material=soft), body[3])
    scene = small_scene(body=body, time_step=2e-3, material=Material(20.0, 15.0, viscosity=0.01))
    x = Problem(scene).join(0.3, 1.0, -0.3, -0.5)
    value, gradient = Problem(scene).value_and_gradient(x)
    other = scaled(scene, 2.0**-9, 2.0**5, 2.0**-3)
    found, bar = Problem(other).value_and_gradient(x)
    assert found == 2.0**-9 * value
    assert np.array_equal(bar, 2.0**-9 * gradient)


def finished(path, scene):
    """The run file of a few evaluations of a scene, with what they print, and its summary."""
    stages = (Stage(4.0, 1e-2, 1e-3, 4e-3, solid=True),)
    settings = Settings(stages, window=1, least_iterations=10, most_iterations=10, tolerance=0.0)
    done = optimise(scene, settings, Problem(scene).join(0.0, 1.0, -0.3, -0.5), [ProgressBar()])
    summary = summarise(done)
    runfile.write(path, done, summary)
    return summary


def are_told(text, count):
    """All numbers of a text that are not whole: so many, with three significant digits or more."""
    numbers = re.findall(r"(?<![\w.])-?\d+\.\d+(?:e-\d+)?(?![\w%])", text)
    assert len(numbers) == count, text
    for number in numbers:
        assert len(re.sub(r"e.*|\D", "", number).lstrip("0")) >= 3, text


def test_what_is_printed_of_a_small_robot_has_digits(tmp_path, capsys):
    # Half a millimetre long, in metres.
    summary = finished(tmp_path / "run.h5", scaled(small_scene(steps=20), 2e-3, 1.0, 1.0))
    (progress,) = capsys.readouterr().err.splitlines()
    are_told(re.findall(r"displacement ([^,]+),", progress)[0], 1)
    lengths = {name: summary[name] for name in ("start", "reference", "optimised", "gain")}
    are_told(table(lengths), 7)
    kept = runfile.read_run(tmp_path / "run.h5").run
    are_told(re.findall(r"best L = (\S+)", repr(kept))[0], 1)
    assert commands.main(["postprocess", str(tmp_path / "run.h5")]) == 0
    are_told("\n".join(line.split("(gamma")[0] for line in capsys.readouterr().out.split("\n")), 3)
    assert commands.main(["study", str(tmp_path / "run.h5")]) == 0
    _, *lines = capsys.readouterr().out.splitlines()
    assert len(lines) == 4
    for line in lines:
        are_told(line.split("16 ")[-1].split("32 ")[-1].split(None, 1)[1], 2)


def test_what_is_printed_of_several_small_starts_has_digits():
    row = {
        "post_processed": 6.1e-4, "gain": 1.234e-4, "retained_half_step": 1.0,
        "retained_half_cells": 0.5,
        "refined_gain": 6e-5, "disconnected_particles": 0, "failed_evaluations": 0, "seconds": 1.0,
    }  # fmt: skip
    text = report([{"start": 0, **row}, {"start": 1, **row, "gain": 1.3e-4, "refined_gain": 5e-5}])
    lines = text.splitlines()
    assert len({len(line) for line in lines[:3]}) == 1
    are_told(text, 6 + 8 + 1)


def test_a_gain_that_is_rounding_is_none():
    assert threshold.beyond_rounding(small_scene(), -4e-19) == 0.0
    assert threshold.beyond_rounding(small_scene(), 4e-9) == 4e-9
    assert table({"gain": {"as designed": 0.0, "half the step": None}}).split("  ")[-1] == "-"


@pytest.mark.parametrize("gravity", [(0.5, -10.0), (0.0, 0.0)])
def test_what_a_layer_takes_from_its_scene_has_the_right_units(gravity):
    ground = Ground.slope((5 / 16, 3.7 / 16), 3.0)
    scene = small_scene(
        walls=(), gravity=gravity, time_step=2e-3, ground=(ground,), body=(
            Solid((3 / 16, 4 / 16), (9 / 16, 14 / 16)),
        ),
    )  # fmt: skip
    ends = []
    for units in ((1.0, 1.0, 1.0), (1e3, 1e-6, 1e2)):
        other = scaled(scene, *units)
        particles = discretise(other)
        state = at_rest(particles)
        state[2:4] = units[0] / units[2] * np.array([[0.3], [-0.5]])
        state = solid_simulation(other, particles, state).run()
        ends.append(state[:2] / units[0])
    assert ends[1] == pytest.approx(ends[0], rel=1e-9)
