"""A finished robot elsewhere: what is tried, and what is told of it."""

import dataclasses
import json
import math
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from conftest import SHORT, empty, small_scene

from mpmopt.app import ending
from mpmopt.app.study import full_study
from mpmopt.app.summary import table
from mpmopt.assess import robustness
from mpmopt.assess.feet import feet
from mpmopt.assess.robustness import (
    FRICTIONS,
    Robot,
    Trial,
    can_be_studied,
    components,
    follow,
    lasting,
    speed,
    whole_periods,
    with_cells,
    with_frequency,
)
from mpmopt.assess.threshold import kept
from mpmopt.assess.verdict import verdict
from mpmopt.design.problem import Problem
from mpmopt.design.variation import Variation
from mpmopt.errors import DesignError, SceneError, SimulationError
from mpmopt.kernels import parts
from mpmopt.optimisation.loop import optimise
from mpmopt.results import runfile
from mpmopt.scene import (
    Actuator,
    Clamp,
    Design,
    Grid,
    Ground,
    Material,
    Mirror,
    Scene,
    Solid,
    Wall,
)
from mpmopt.scene.particles import discretise
from mpmopt.view import gait
from mpmopt.view.gait import plot_robustness

C = 1 / 16


def on_ground(formulation="updated", **changes) -> Scene:
    """The small walker in either formulation, on ground."""
    scene: dict[str, Any] = {
        "walls": (),
        "gravity": (0.0, -10.0),
        "ground": (Ground.floor(3 * C, friction=0.4, thickness=C),),
        "material": Material(void_density=1e-2, void_stiffness=1e-3, viscosity=0.02),
        "formulation": formulation,
    }
    return small_scene(**{**scene, **changes})


def robot_in(scene: Scene) -> Robot:
    problem = Problem(scene, 4.0)
    return Robot.of(problem, problem.join(1.0, 0.5, -0.3, -0.5))


@pytest.fixture
def soon(monkeypatch):
    """Speeds are seen after hundredths of a unit of time."""
    for name, time in (("SETTLED", 0.02), ("SEEN", 0.16), ("PUSHED", 0.02), ("RECOVERED", 0.03)):
        monkeypatch.setattr(robustness, name, time)


@pytest.mark.parametrize("formulation", ["updated", "total"])
def test_a_body_that_is_not_pushed_goes_on_as_if_nothing_had_been(formulation):
    whole = robot_in(on_ground(formulation, steps=12)).body(on_ground(formulation, steps=12))
    wanted = whole.run()
    assert np.array_equal(whole.pushed(5, (0.0, 0.0)).run(), wanted)
    assert np.array_equal(whole.run(), wanted)  # which it left alone
    with pytest.raises(DesignError, match="step = 12 must be from 0 to 11"):
        whole.pushed(12, (0.0, 0.0))


@pytest.mark.parametrize("formulation", ["updated", "total"])
def test_a_push_adds_a_velocity_to_all_of_a_body(formulation):
    below = (Ground.floor(2.5 * C, friction=0.4, thickness=C),)
    scene = on_ground(formulation, steps=10, gravity=(0.0, 0.0), ground=below)
    simulation = robot_in(scene).body(scene)
    before, after = simulation.run([6, 10])
    pushed = simulation.pushed(6, (0.25, -0.125))
    first, last = pushed.run([0, 4])
    assert np.allclose(parts(first).velocity - parts(before).velocity, [[0.25], [-0.125]])
    moved = 4 * scene.time_step * np.array([[0.25], [-0.125]])
    assert np.allclose(parts(first).position, parts(before).position, atol=1e-15)
    # Nothing is touched, so the motion within the body is the same.
    tolerance = 1e-3 * scene.grid.dx if formulation == "updated" else 1e-13
    assert np.allclose(parts(last).position - parts(after).position, moved, atol=tolerance)


@pytest.mark.parametrize("formulation", ["updated", "total"])
def test_a_speed_is_the_way_over_the_time_in_whole_periods(formulation, soon):
    """A body that falls along its direction of travel: g times the middle of the time."""
    g, omega = 0.5, 100.0
    body = (Actuator((3 * C, 5 * C), (6 * C, 7 * C), angular_frequency=omega),)
    scene = on_ground(formulation, gravity=(g, 0.0), body=body, time_step=2e-3)
    problem = Problem(scene)
    robot = Robot.of(problem, problem.join(np.empty(0), 0.0, 0.0, 0.0))
    end = whole_periods(robot.period(scene), 0.02, 0.16)
    assert end == pytest.approx(0.02 + 2 * (2.0 * np.pi / omega))
    assert speed(robot, Trial(lambda: scene)) == pytest.approx(g * (0.02 + end) / 2, rel=0.02)
    pushed = speed(robot, Trial(lambda: scene, pushed=True))
    back = robustness.PUSH * scene.wave_speed
    later = whole_periods(robot.period(scene), 0.03, 0.16)
    assert pushed + back == pytest.approx(g * (0.03 + later) / 2, rel=0.02)
    with pytest.raises(SceneError, match="particles times steps"):
        speed(robot, Trial(lambda: scene), most_work=100.0)
    quick = dataclasses.replace(scene, steps=1500, transient=2.0)
    end = whole_periods(robot.period(quick), 0.04, 0.32)
    assert speed(robot, Trial(lambda: quick)) == pytest.approx(g * (0.04 + end) / 2, rel=0.02)


def test_an_actuation_that_is_held_is_the_same_till_then(soon, monkeypatch):
    scene = on_ground()
    signals = []
    monkeypatch.setattr(robustness, "check_indicators", lambda _, simulation, __: signals.append(
        simulation.signal
    ))  # fmt: skip
    robot = robot_in(scene)
    for frozen in (False, True):
        speed(robot, Trial(lambda: scene, frozen=frozen))
    driven, held = signals
    first = round(0.02 / scene.time_step)
    assert np.array_equal(held[:first], driven[:first])
    assert np.ptp(held[first:], axis=0).max() == 0.0
    assert np.array_equal(held[first], driven[first])


def test_scenes_are_what_their_names_say():
    scene = on_ground()
    longer = lasting(scene, 1.0)
    assert longer.duration == pytest.approx(1.0)
    assert longer.grid.cells == (16 + 48, 16)
    fine = with_cells(scene, 2.0, "total")
    assert (fine.grid.cells, fine.formulation) == ((32, 32), "total")
    assert fine.time_step == pytest.approx(2e-3)
    assert with_cells(on_ground("total"), 1.0).formulation == "total"
    viscous = dataclasses.replace(
        scene, material=dataclasses.replace(scene.material, viscosity=0.1)
    )
    assert with_cells(on_ground(filter_length=3 * C), 2.0).filter_length == 0.0
    assert with_cells(viscous, 4.0).time_step == 5e-4  # a quarter would be too long there
    assert [ground.friction for ground in Variation(friction=0.7).scene(scene).ground] == [0.7]
    strong = with_frequency(Variation(strength=1.2).scene(scene), 0.8).actuators
    assert strong[0].stress == ((2.4, 0.6), (0.6, 1.2))
    assert [each.angular_frequency for each in strong] == [24.0, 40.0]
    assert robot_in(scene).period(scene) == pytest.approx(2 * np.pi / 30.0)
    tuned = tuple(
        dataclasses.replace(region, detuning=0.5) if isinstance(region, Actuator) else region
        for region in scene.body
    )
    problem = Problem(dataclasses.replace(scene, body=tuned))
    slower = Robot.of(problem, problem.join(1.0, 0.5, 0.0, 0.0, (-1.0, 0.0)))
    assert slower.period(problem.scene) == pytest.approx(2 * np.pi / 15.0)
    with pytest.raises(SceneError, match="no whole number"):
        with_cells(on_ground(grid=Grid((17, 16), C)), 0.5)
    assert not can_be_studied(small_scene())
    still = tuple(region for region in scene.body if not isinstance(region, Actuator))
    assert can_be_studied(scene) and not can_be_studied(dataclasses.replace(scene, body=still))


def test_a_robot_that_goes_to_the_left_has_room_there():
    scene = on_ground(direction=(-1.0, 0.0), steps=20)
    robot = robot_in(scene)
    robot.keep[:5] = False
    longer = lasting(scene, 20 * scene.time_step)
    assert longer.grid.cells == (16 + 48, 16)
    assert np.array_equal(robot.in_scene(longer), robot.keep)
    ends = [parts(robot.body(each).run()).position for each in (scene, longer)]
    assert np.allclose(ends[1] - ends[0], [[48 * C], [0.0]], atol=1e-9)
    assert longer.ground[0].points[0] == (3.0, 3 * C)
    mirrored = lasting(
        small_scene(
            body=(Solid((4 * C, 4 * C), (6 * C, 8 * C)),), walls=(), gravity=(0.0, 0.0),
            direction=(0.0, -1.0), mirror=Mirror("x", 5 * C),
        ), 0.1,
    )  # fmt: skip
    assert (mirrored.mirror, mirrored.grid.cells) == (Mirror("x", 5 * C), (16, 64))
    walls, hand = (Wall("x", 2 * C), Wall("y", 4 * C)), Clamp((3 * C, 5 * C), (4 * C, 6 * C))
    held = small_scene(direction=(-1.0, 0.0), walls=walls, clamps=(hand,))
    longer = lasting(held, 0.1)
    way = longer.body[0].lower[0] - held.body[0].lower[0]
    assert way > 0.5
    assert [wall.position for wall in longer.walls] == [2 * C + way, 4 * C]
    assert longer.clamps[0].lower == (3 * C + way, 5 * C)


def test_a_robot_is_in_one_piece_and_the_same_on_other_cells():
    scene = on_ground()
    problem = Problem(scene, 8.0)
    x, y = problem.particles.position[problem.particles.designed].T
    foot = y < 4.6 * C  # a row of particles that hangs on nothing, below legs of another
    phi = np.where(foot | ((x < 4 * C) & (y > 5.4 * C)), 1.0, -1.0)
    design = problem.join(phi, 0.5, 0.0, 0.0)
    there = kept(problem, design)
    assert components(scene, there) == 2
    robot = Robot.of(problem, design)
    assert 0 < robot.keep.sum() < there.sum()
    assert components(scene, robot.keep) == 1
    assert robot.in_scene(with_cells(scene, 2.0)).sum() == 4 * robot.keep.sum()


def test_components_are_those_of_the_whole_body_over_edges():
    low, high = Design((4 * C, 4 * C), (6 * C, 6 * C)), Design((4 * C, 8 * C), (6 * C, 10 * C))
    body = (low, Solid((4 * C, 6 * C), (6 * C, 8 * C)), high)
    scene = small_scene(body=body, walls=(), gravity=(0.0, 0.0), steps=5, mirror=Mirror("y", 7 * C))
    problem = Problem(scene)
    i, j = np.floor(problem.particles.position[problem.particles.designed] * 32).astype(int).T
    assert components(scene, j == 11) == 1  # the row below the solid, and its image
    assert components(scene, j == 8) == 3  # a row at each end hangs on nothing
    assert components(scene, (j == 11) | ((j == 10) & (i == 8)) | ((j == 9) & (i == 9))) == 3


TOLD = {
    "nominal": 0.1, "frozen": 0.02, "step 0.5": 0.09, "cells 2": 0.08, "cells 4": 0.06,
    "other 2": 0.05, "other 1": 0.11, "pushed": 0.07, "strength 0.8": -0.01,
}  # fmt: skip


@pytest.fixture
def told(monkeypatch):
    """Lets every run tell a number; those that have none fail."""

    def tells(numbers):
        def one(robot, trial, most):
            name = names.get(id(trial.scene()), "with half its step")
            if name not in numbers and not name.startswith("friction"):
                raise SimulationError("it burst", 3, -1, (0.0, 0.0), "none")
            return numbers.get(name, 0.03)

        names, scenes = {}, []
        trials = robustness._trials

        def with_own_scene(name, trial):
            def scene():
                scenes.append(dataclasses.replace(trial.scene()))  # so that no other has its id
                names[id(scenes[-1])] = name
                return scenes[-1]

            return trial._replace(scene=scene)

        def remembered(scene, full):
            found = trials(scene, full)
            return {name: with_own_scene(name, trial) for name, trial in found.items()}

        monkeypatch.setattr(robustness, "_trials", remembered)
        monkeypatch.setattr(robustness, "speed", one)
        monkeypatch.setattr(robustness, "follow", lambda *_: robustness.Followed(20.0, "goes on"))

    return tells


def study_of(scene, full=True):
    problem = Problem(scene, 4.0)
    return robustness.study(problem, problem.join(1.0, 0.5, -0.3, -0.5), full)


def test_a_study_tells_speeds_and_shares(told):
    told(TOLD)
    found = study_of(on_ground())
    assert list(found["speed_by_friction"]) == [f"{mu:g}" for mu in FRICTIONS]
    assert found["kept"] == pytest.approx(
        {"half_step": 0.9, "finer_cells": 0.8, "finest_cells": 0.6, "other_formulation": 0.5}
    )
    assert (found["speed"], found["way"], found["components"]) == (0.1, "goes", 1)
    assert (found["driven_share"], found["after_push"]) == pytest.approx((0.8, 0.7))
    assert found["speed_by_strength"] == {"0.8": -0.01, "1": 0.1, "1.2": None}
    assert found["speed_by_cells"] == {
        "updated": {"8": None, "16": 0.1, "32": 0.08, "64": 0.06},
        "total": {"8": None, "16": 0.11, "32": 0.05},
    }
    assert found["failures"]["strength 1.2"] == "it burst"
    assert found["followed"] == {"seconds": 20.0, "end": "goes on"}
    assert set(found) == {*robustness.NAMES, "failures", "shorter_steps_of_speed"}
    assert json.loads(json.dumps(found)) == found
    assert "speed by cells, total, 32" in table(found)
    few = study_of(on_ground(), full=False)
    assert list(few["kept"]) == ["half_step", "finer_cells"]
    assert "followed" not in few


def test_a_run_on_other_cells_that_fails_is_made_again_with_half_its_step(monkeypatch):
    scene = on_ground()
    fine = scene.time_step / 2.0

    def fails(robot, trial, most):
        there = trial.scene()
        if there.grid.cells == (32, 32) and there.time_step > fine / 2.0:
            raise SimulationError("it inverted", 3, -1, (0.0, 0.0), "none")
        if there.time_step < 0.6 * scene.time_step and there.grid.cells == (16, 16):
            raise SimulationError("it burst", 3, -1, (0.0, 0.0), "none")
        return 0.1

    monkeypatch.setattr(robustness, "speed", fails)
    found = study_of(scene, full=False)
    assert found["shorter_steps_of_speed"] == {"cells 2": fine / 2.0}
    assert found["kept"] == {"half_step": None, "finer_cells": 1.0}
    assert found["failures"] == {"step 0.5": "it burst"}


def test_no_share_of_a_robot_that_stays_where_it_is(told):
    ways = ((1e-4, "stands"), (-1e-4, "stands"), (-0.1, "goes back"), (None, None))
    for nominal, way in ways:
        rest = {name: value for name, value in TOLD.items() if name != "nominal"}
        told(rest if nominal is None else {**rest, "nominal": nominal})
        found = study_of(on_ground())
        assert (found["speed"], found["way"]) == (nominal, way)
        if nominal is not None:
            assert found["failures"]["shares"].startswith(f"the robot {way}: ")
            said = verdict({**found, "post_processed": 0.6, "retained_gain": {}})
            assert said.startswith(f"{way}: its speed along the way is {nominal:.3f}")
            assert f"; it {way}; " in ending._elsewhere(found)["speed"]
        assert {*found["kept"].values(), found["driven_share"], found["after_push"]} == {None}


def test_a_robot_on_walls_has_no_study():
    assert study_of(small_scene()) == {"components": 1}


@pytest.mark.parametrize(
    "end, way, height, angle",
    [
        ("goes on", lambda t: 0.1 * t, lambda t: 1.0 + 0 * t, lambda t: 0.2 * np.sin(t)),
        ("goes on", lambda t: 0.1 * t, lambda t: np.where(t < 0.5, 3.0, 1.0), lambda t: 0 * t),
        ("goes on", lambda t: 0.1 * (t - np.clip(t - 9, 0, 1.5)), np.ones_like, np.zeros_like),
        ("goes on", lambda t: 0.1 * np.maximum(t - 1.9, 0.0), np.ones_like, np.zeros_like),
        ("falls", lambda t: 0.1 * t, lambda t: np.where(t < 6.0, 1.0, 0.4), lambda t: 0 * t),
        ("falls", lambda t: 0.1 * t, lambda t: 1.0 + 0 * t, lambda t: np.where(t < 6.0, 0.0, -0.8)),
        ("stops", lambda t: 0.1 * np.minimum(t, 6.0), lambda t: 1.0 + 0 * t, lambda t: 0 * t),
        ("stops", lambda t: -0.1 * t, lambda t: 1.0 + 0 * t, lambda t: 0 * t),
    ],
)
def test_a_robot_is_followed_until_it_falls_or_stops(monkeypatch, end, way, height, angle):
    scene = on_ground()
    monkeypatch.setattr(robustness, "FOLLOWED", 20.0)
    robot = robot_in(scene)
    every = round(0.25 * robot_in(scene).period(scene) / scene.time_step) * scene.time_step

    class Still:
        particles = None

        def run(self, frames):
            return np.zeros(len(frames))

    def track(scene, particles, states):
        t = every * np.arange(len(states))
        return way(t), height(t), angle(t)

    monkeypatch.setattr(robustness, "track", track)
    monkeypatch.setattr(Robot, "body", lambda self, scene: Still())
    found = follow(robot, scene)
    assert found.end == end
    wanted = {"goes on": 20.0, "falls": 6.0, "stops": 6.0}[end]
    if way(1.0) < 0.0:
        wanted = robustness.SETTLED
    assert found.seconds == pytest.approx(wanted, abs=0.3)


def test_a_robot_is_tracked_by_what_is_not_designed_above_the_nearest_ground():
    ceiling = Ground(((1.0, 12 * C), (0.0, 12 * C)), thickness=C)
    scene = on_ground(ground=(Ground.floor(3 * C, thickness=C), ceiling))
    particles = discretise(scene)
    state = robot_in(scene).body(scene).initial.copy()
    assert state.shape[1] == len(particles.position)
    F = parts(state).deformation
    for angle, which in ((0.3, ~particles.designed), (1.5, particles.designed)):
        turn = [[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]
        F[:, :, which] = np.array(turn)[:, :, None]
    above = state.copy()
    parts(above).position[1] += 4 * C
    centre = particles.position[~particles.designed].mean(axis=0)
    way, height, lean = robustness.track(scene, particles, [state, above])
    assert way == pytest.approx([centre[0], centre[0]])
    assert height == pytest.approx([centre[1] - 3 * C, 8 * C - centre[1]])
    assert lean == pytest.approx([0.3, 0.3])


def test_twice_the_step_is_tried_where_it_is_stable():
    for scene in (on_ground(), on_ground(time_step=on_ground().largest_time_step)):
        stable = 2.0 * scene.time_step <= scene.largest_time_step
        assert ("step 2" in robustness._trials(scene, full=True)) is stable


@pytest.mark.parametrize("stops, end", [(6.0, "stops"), (9.0, "it burst")])
def test_what_a_robot_did_before_it_failed_counts(monkeypatch, stops, end):
    scene = small_scene(
        body=(Solid((4 * C, 4 * C), (6 * C, 8 * C)),), walls=(), gravity=(0.0, 0.0),
        direction=(0.0, 1.0), mirror=Mirror("x", 5 * C),
    )  # fmt: skip
    burst = round(9.5 / scene.time_step)

    def run(frames):
        if frames[-1] >= burst:
            raise SimulationError("it burst", burst, -1, (0.0, 0.0), "none")
        return np.array(frames) * scene.time_step

    def track(scene, particles, t):
        return 0.1 * np.minimum(t, stops), np.ones_like(t), np.ones_like(t)  # half of it leans

    monkeypatch.setattr(robustness, "track", track)
    body = SimpleNamespace(run=run, particles=None)
    robot: Any = SimpleNamespace(body=lambda scene: body, period=lambda scene: 0.2)
    found = follow(robot, scene)
    assert found.end == end
    assert found.seconds == pytest.approx(6.0 if end == "stops" else 9.5, abs=0.3)


def test_a_full_study_may_take_longer(told, monkeypatch):
    told(TOLD)
    allowed: set[float] = set()

    def one(robot, trial, most):
        allowed.add(most)
        return 0.1

    monkeypatch.setattr(robustness, "speed", one)
    study_of(on_ground(), full=False)
    assert allowed == {robustness.MOST_WORK}
    allowed.clear()
    study_of(on_ground(), full=True)
    assert allowed == {robustness.MOST_WORK_FULL}


def test_a_robot_that_cannot_be_simulated_was_followed_until_then(monkeypatch):
    scene = on_ground("total", steps=10)
    monkeypatch.setattr(robustness, "FOLLOWED", 0.3)
    monkeypatch.setattr(robustness, "ROOM", 0.0)
    updated = dataclasses.replace(scene, formulation="updated", gravity=(20.0, 0.0))
    found = follow(robot_in(updated), updated)  # it leaves the grid in that time
    assert 0.1 < found.seconds < 0.3
    assert "left the grid" in found.end


def test_a_body_that_is_turned_leans_by_that_angle():
    scene = on_ground()
    simulation = robot_in(scene).body(scene)
    turn, moved = 0.3, np.array([0.05, 0.02])
    state = simulation.initial.copy()
    cos, sin = math.cos(turn), math.sin(turn)
    parts(state).deformation[:] = np.array([[cos, -sin], [sin, cos]])[:, :, None]
    parts(state).position[:] += moved[:, None]
    way, height, angle = robustness.track(scene, simulation.particles, [simulation.initial, state])
    assert np.diff(way) == pytest.approx(0.05)
    assert np.diff(height) == pytest.approx(0.02)
    assert angle == pytest.approx([0.0, turn])


def test_feet_are_what_touches_ground_apart_from_each_other(monkeypatch):
    scene = on_ground(body=(
        Solid((3 * C, 6 * C), (9 * C, 7 * C)), Actuator((3 * C, 4 * C), (4 * C, 6 * C)),
        Solid((7 * C, 4 * C), (9 * C, 6 * C)),
    ))  # fmt: skip
    problem = Problem(scene)
    robot = Robot.of(problem, problem.join(np.empty(0), 0.0, 0.0, 0.0))
    motion = gait.Motion.of(gait.body_of(robot, scene), [0, 1, 2])
    position = np.repeat(motion.position[:1], 3, axis=0)
    position[1, 1] -= 0.5 * C  # both feet are half a layer deep, less half a particle
    right = position[0, 0] > 6 * C
    position[2, 1, right] -= 0.5 * C
    found = feet(dataclasses.replace(motion, position=position))
    assert [foot.place[0] for foot in found] == pytest.approx([3.5 * C, 8 * C])
    loads = np.array([foot.load for foot in found])
    assert loads == pytest.approx(np.array([[0.0, 2 * 0.25, 0.0], [0.0, 4 * 0.25, 4 * 0.25]]))
    assert found[0].height == pytest.approx([1.25 * C, 0.75 * C, 1.25 * C])
    high = dataclasses.replace(motion, position=position + 1.0)
    assert feet(high) == []


def test_a_picture_of_robustness_has_all_speeds_and_marks_what_fails(told, tmp_path, monkeypatch):
    told(TOLD)
    figures: list[Any] = []
    monkeypatch.setattr(gait, "png", lambda figure: figures.append(figure))
    monkeypatch.setattr(gait, "replace_file", lambda path, content: None)
    for full in (True, False):
        plot_robustness(tmp_path / "a.png", study_of(on_ground(), full))
    first, second = figures
    assert (len(first.axes), len(second.axes)) == (4, 2)
    friction = next(line for line in first.axes[0].lines if line.get_marker() == "o")
    assert friction.get_xdata().tolist() == sorted(FRICTIONS)
    crosses = [line for line in first.axes[2].lines if line.get_marker() == "x"]
    assert [line.get_xdata().tolist() for line in crosses] == [[8.0], [8.0]]
    shown = [text.get_text() for text in first.axes[1].texts]
    assert shown == ["90%", "80%", "60%", "50%", "80%", "70%"]


def test_a_full_study_is_kept_with_its_run(told, tmp_path, capsys):
    told(TOLD)
    scene = on_ground(steps=10)
    path = tmp_path / "run.h5"
    runfile.write(path, empty(scene))
    with pytest.raises(DesignError, match="unfinished run"):
        full_study(path)
    run = optimise(scene, SHORT, Problem(scene).join(0.3, 1.0, -0.3, -0.5))
    steps = {"shorter_steps": {"cells half as wide": 1e-3}}
    runfile.write(path, run, {"evaluations": 2, **steps, "shorter_steps_of_speed": {"cells 2": 1}})
    text = full_study(path)
    assert "kept, finest cells" in text
    summary = json.loads((tmp_path / "summary.json").read_text())
    assert runfile.read_run(path).summary == summary
    assert (summary["evaluations"], summary["speed"]) == (2, 0.1)
    assert summary["shorter_steps"] == {"cells half as wide": 1e-3}
    assert summary["shorter_steps_of_speed"] == {}  # cells 2 needed none now
    assert (tmp_path / "robustness.png").read_bytes().startswith(b"\x89PNG")
    told({})
    assert full_study(path) == text  # it is not made again
