"""No absolute length, mass or time decides anything, or is lost where it is printed."""

import dataclasses

import numpy as np
import pytest
from conftest import small_scene

from mpmopt.case import summarise
from mpmopt.optimize import Settings, Stage, optimise
from mpmopt.problem import Problem
from mpmopt.scene import Actuator, Grid

# What is a length; the rest has no unit.
LENGTHS = ("objective", "post_processed", "audited", "projected_gradient")


def scaled(scene, length, mass, time):
    """The same scene in other units."""
    stress = mass / time**2

    def region(part):
        changes = {
            name: tuple(length * v for v in getattr(part, name)) for name in ("lower", "upper")
        }
        if isinstance(part, Actuator):
            changes["stress"] = tuple(tuple(stress * s for s in row) for row in part.stress)
            changes["angular_frequency"] = part.angular_frequency / time
        return dataclasses.replace(part, **changes)

    material = scene.material
    return dataclasses.replace(
        scene,
        grid=Grid(scene.grid.cells, length * scene.grid.dx),
        time_step=time * scene.time_step,
        body=tuple(region(part) for part in scene.body),
        walls=tuple(dataclasses.replace(w, position=length * w.position) for w in scene.walls),
        material=dataclasses.replace(
            material,
            density=mass / length**2 * material.density,
            lame_lambda=stress * material.lame_lambda,
            lame_mu=stress * material.lame_mu,
        ),
        gravity=tuple(length / time**2 * g for g in scene.gravity),
        filter_length=length * scene.filter_length,
        blend_time=time * scene.blend_time,
        transient=time * scene.transient,
    )


def optimised(length=1.0, mass=1.0, time=1.0):
    """An optimisation that its stop rule ends, in other units, and all designs."""
    scene = small_scene(
        steps=20, filter_length=2 / 16, blend_time=0.05, transient=2 * 4e-3, particles_per_cell=3
    )
    scene = scaled(scene, length, mass, time)
    stages = (
        Stage(0.5, 1e-2, 1e-3, 4e-3 * time),
        Stage(8.0, 1e-2, 1e-3, 4e-3 * time, solid=True, audited=True, leave_out=0.05),
    )
    settings = Settings(stages, window=3, tolerance=1e-4, least_iterations=4, most_iterations=40)
    designs = []
    start = Problem(stages[0].scene(scene)).join(0.0, 1.0, -0.3, -0.5)
    run = optimise(scene, settings, start, [lambda run: designs.append(run.last)])
    return run, designs


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
    (run, designs), (other, others) = plain, optimised(length, mass, time)
    assert len(run.history) == len(other.history)
    assert "iterations changed by" in run.stop_reason
    units = {**dict.fromkeys(LENGTHS, length), "time_step": time}
    for item, there in zip(designs, others):
        assert np.array_equal(item.x, there.x)
        assert np.array_equal(item.gamma, there.gamma)
        for name, value in item.numbers().items():
            if name not in ("seconds", "failure"):
                found = getattr(there, name)
                assert np.array_equal(units.get(name, 1.0) * value, found, equal_nan=True), name
    one, two = summarise(run, {}), summarise(other, {})
    for name in ("start", "reference", "optimised", "post_processed", "post_processed_half_step"):
        assert two[name] == (None if one[name] is None else length * one[name])
    assert [two[name] for name in ("gain_kept", "greyness", "a", "theta", "b")] == [
        one[name] for name in ("gain_kept", "greyness", "a", "theta", "b")
    ]
    assert one["post_processed_half_step"] is not None
