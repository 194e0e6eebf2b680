"""Feet of a body in motion, and its motion as a table."""

import csv
import dataclasses

import numpy as np
import pytest
from conftest import small_scene
from test_mirror import channel

from mpmopt.__main__ import main
from mpmopt.assess.feet import feet
from mpmopt.assess.trajectory import Motion, optimised, post_processed
from mpmopt.design.problem import Problem
from mpmopt.results.trajectory import table
from mpmopt.scene import Ground


def moving(heights, x=(0.0, 1.0, 6.0, 7.0), **changes):
    """A motion of four particles in a row, with these heights (F, 4) over ground at 4 cells."""
    c = 1 / 16
    floor = Ground.floor(4 * c, thickness=c)
    scene = small_scene(walls=(), ground=(floor,), **changes)
    heights = np.asarray(heights, float)
    position = np.zeros((len(heights), 2, len(x)), np.float32)
    position[:, 0] = (4.25 + 0.5 * np.array(x)) * c
    position[:, 1] = (4.0 + heights) * c
    return Motion(
        "it", scene, np.arange(len(heights)), position, 0.0 * position,
        np.zeros((len(heights), 4, len(x)), np.float32), np.ones(len(x)),
        np.zeros((len(heights), len(x)), np.float32), 1.0, np.zeros(len(heights)),
    )  # fmt: skip


def test_feet_are_neighbours_that_touch_and_stand_in_a_row():
    motion = moving([(1.5, 1.5, 1.5, 1.5), (1.5, 0.5, 2.0, 2.0), (1.5, 2.0, 0.9, 0.5)])
    back, front = feet(motion)
    assert (back.name, front.name) == ("foot 1", "foot 2")
    assert (back.particles.tolist(), front.particles.tolist()) == ([1], [2, 3])
    assert back.height * 16 == pytest.approx([1.5, 0.5, 2.0])
    assert front.height * 16 == pytest.approx([1.5, 2.0, 0.5])
    assert back.stands.tolist() == [False, True, False]
    assert front.stands.tolist() == [False, False, True]
    west = dataclasses.replace(motion, scene=dataclasses.replace(motion.scene, direction=(-1, 0)))
    assert [foot.particles.tolist() for foot in feet(west)] == [[2, 3], [1]]


def test_a_lattice_touches_with_its_edge_and_not_by_rounding():
    # Particles are half a cell wide: the second reaches a tenth of one into the layer.
    motion = moving(
        [(1.5, 1.5, 1.2499, 1.5), (1.5, 1.15, 1.25, 1.25)],
        (0.0, 1.0, 2.0, 7.0),
        formulation="total",
    )
    (foot,) = feet(motion)
    assert foot.particles.tolist() == [1]
    assert foot.height * 16 == pytest.approx([1.25, 0.9])
    assert foot.load == pytest.approx([0.0, 0.1**2 / (2 * 0.5)], rel=1e-4)


def test_what_never_touches_or_is_void_is_no_foot():
    motion = moving([(1.5, 1.5, 1.5, 1.5), (0.5, 2.0, 2.0, 2.0)])
    assert len(feet(motion)) == 1
    assert feet(dataclasses.replace(motion, gamma=np.array([0.2, 1.0, 1.0, 1.0]))) == []
    assert feet(moving([(1.5, 1.5, 1.5, 1.5)])) == []


def test_a_foot_stands_where_it_bears_a_tenth_of_the_largest_load():
    # Loads of one foot 0.4 + 0.4, 0.04 + 0.05, 0.06 + 0.04; of the other nothing, 0.2, 0.
    motion = moving([(0.6, 0.6, 1.5, 1.5), (0.96, 0.95, 0.8, 1.5), (0.94, 0.95, 1.5, 1.5)])
    one, other = feet(motion)
    assert one.load == pytest.approx([0.8, 0.09, 0.11], abs=1e-5)
    assert one.stands.tolist() == [True, True, True]
    assert other.stands.tolist() == [False, True, False]
    lighter = moving([(0.6, 0.6, 1.5, 1.5), (0.97, 0.96, 0.9, 1.5), (0.94, 0.95, 1.5, 1.5)])
    assert feet(lighter)[0].stands.tolist() == [True, False, True]


@pytest.mark.parametrize("axis", ["x", "y"])
def test_feet_of_a_channel_are_those_of_the_simulated_half(axis):
    scene = dataclasses.replace(channel(axis), steps=20)
    problem = Problem(scene)
    phi = np.ones(int(problem.particles.designed.sum()))
    body = optimised(problem, problem.join(phi, 1.0, 0.0, 0.0))
    motion = Motion.of(body, [0, 10, 20])
    half = len(motion.gamma) // 2
    found = feet(motion)
    assert found
    for foot in found:
        assert foot.particles.max() < half
        assert foot.stands.any()


def test_a_table_tells_where_the_body_is_and_what_drives_it(short_run, short_path, tmp_path):
    target = tmp_path / "new" / "a.csv"
    assert main(["trajectory", str(short_path), "--out", str(target)]) == 0
    body = post_processed(short_run.problem(), short_run.result.x)
    assert target.read_text() == table(body)
    with target.open() as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == short_run.scene.steps + 1
    column = {name: np.array([float(row[name]) for row in rows]) for name in rows[0]}
    dt = short_run.scene.time_step
    assert column["time"] == pytest.approx(dt * np.arange(41), abs=1e-12)
    states = body.simulation.run(range(41))
    assert column["y"] == pytest.approx([state[1].mean() for state in states], abs=1e-6)
    assert column["vx"] == pytest.approx([state[2].mean() for state in states], abs=1e-5)
    moved = np.array([column[k] - column[k][0] for k in "xy"]).T @ short_run.scene.direction
    assert column["travel"] == pytest.approx(moved, abs=1e-8)
    for k in (0, 1):
        signal = body.simulation.signal[:, k]
        assert column[f"signal {k}"][:40] == pytest.approx(signal, abs=1e-8)
    stands = [name for name in column if name.endswith("stands")]
    assert stands and all(set(column[name]) <= {0.0, 1.0} for name in stands)
