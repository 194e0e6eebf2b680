"""Refinement studies: the same robot in other discretisations."""

import dataclasses

import numpy as np
import pytest
from climber import climber
from conftest import SHORT, small_scene
from crawler import crawler
from walker import slanted_legs, walker

from mpmopt.__main__ import main
from mpmopt.assess import refinement
from mpmopt.assess.refinement import study, variants, with_twice_the_step
from mpmopt.assess.threshold import distance, retained_share
from mpmopt.design.problem import Problem
from mpmopt.design.variation import refined
from mpmopt.errors import FractureError, SceneError, SimulationError
from mpmopt.optimisation.loop import optimise
from mpmopt.results import runfile
from mpmopt.scene import Actuator, Ground
from mpmopt.scene.particles import discretise


def baseline(scene):
    """The legs baseline by hand as a design of a problem."""
    problem = Problem(scene, 32.0)
    position = problem.particles.position[problem.particles.designed]
    return problem, problem.join(np.where(slanted_legs(position), 1.0, -1.0), 1.0, -0.3, -0.5)


def test_a_refinement_study_simulates_the_same_robot_with_other_steps_and_cells():
    problem, x = baseline(walker(64, 4e-4))
    scene = problem.scene
    rows = {row.name: row for row in study(problem, x)}
    assert list(rows) == ["as designed", "half the step", "twice the step", "cells half as wide"]
    assert [row.time_step for row in rows.values()] == [4e-4, 2e-4, 8e-4, 2e-4]
    assert rows["cells half as wide"].cells == (128, 128)
    assert rows["as designed"].retained == 1.0
    keep = problem.gamma(x) >= 0.3
    half = scene.vary(time_step=2e-4)
    assert rows["half the step"].distance == distance(half, keep, problem.split(x))
    gains = {name: row.distance - row.reference for name, row in rows.items()}
    for name, row in rows.items():
        assert row.retained == pytest.approx(gains[name] / gains["as designed"])
        assert 0.3 < row.retained < 1.6


def test_on_ground_the_other_formulation_is_tried_too():
    c = 1 / 16
    scene = small_scene(walls=(), steps=10, ground=(Ground(((0.0, 4 * c), (1.0, 4 * c)), 0.4, c),))
    for there in (scene, dataclasses.replace(scene, formulation="total")):
        problem = Problem(there)
        rows = study(problem, problem.join(0.5, 0.5, 0.2, 0.1))
        assert rows[-1].name == "other formulation"
        assert not rows[-1].failure
        assert rows[-1].distance == pytest.approx(rows[0].distance, rel=0.3)


def test_the_finer_robot_has_the_same_shape():
    for scene in (walker(64, 8e-4), crawler(64, 8e-4), small_scene()):
        fine = refined(scene, 2)
        assert fine.courant == pytest.approx(scene.courant)
        assert fine.duration == pytest.approx(scene.duration)
        areas = [discretise(each).volume.sum() for each in (scene, fine)]
        assert areas[0] == pytest.approx(areas[1])


@pytest.mark.parametrize("formulation", ["updated", "total"])
def test_finer_cells_of_a_viscous_body_take_a_shorter_step(formulation):
    """Viscosity bounds the step by the square of the width: a climber on 96 cells had no study."""
    scene = dataclasses.replace(climber(64, 1e-3, 4.0), formulation=formulation)
    step = scene.largest_time_step / 1.05
    scene = dataclasses.replace(scene, time_step=step, steps=10, transient=0.0)
    fine = refined(scene, 4)
    assert 0.5 < fine.time_step / fine.largest_time_step <= 1.0 < step / 4 / fine.largest_time_step
    assert fine.duration == pytest.approx(scene.duration, rel=1e-12)


def test_a_step_over_the_stability_limit_is_left_out():
    scene = small_scene()
    for share in (0.45, 0.9):
        step = scene.duration / np.ceil(scene.duration / (share * scene.largest_time_step))
        there = scene.vary(time_step=step)
        longer = with_twice_the_step(there)
        assert (longer is None) == ("twice the step" not in variants(there)) == (share > 0.5)
        if longer is not None:
            assert longer.time_step == 2.0 * step
            assert longer.steps == there.steps // 2


def test_an_odd_number_of_steps_can_be_halved_as_well():
    longer = with_twice_the_step(small_scene(time_step=1e-3, steps=501))
    assert longer is not None
    assert (longer.time_step, longer.steps) == (2e-3, 251)


def test_what_cannot_be_simulated_says_why(monkeypatch):
    problem = Problem(small_scene())
    real = refinement.distance

    def fails(scene, *rest):
        if scene.time_step < problem.scene.time_step:
            raise SimulationError("made to fail", 3, 1, (0.0, 0.0), "none")
        return real(scene, *rest)

    monkeypatch.setattr(refinement, "distance", fails)
    rows = {row.name: row for row in study(problem, problem.join(0.5, 0.1, 0.2, 0.1))}
    assert "made to fail" in rows["half the step"].failure
    assert np.isnan(rows["half the step"].retained)
    assert not rows["as designed"].failure


def test_a_step_that_fails_elsewhere_is_halved_and_told(monkeypatch, short_path, capsys):
    asked = []
    where = [SimulationError("it inverted", 3, 1, (0.0, 0.0), "none")]

    def fails(scene, *_):
        asked.append((scene.grid.cells, scene.time_step, scene.steps))
        if scene.time_step == 2e-3:  # half the step, and that of half the cells
            raise where[0]
        return 0.5 if len(asked) % 2 else 0.6

    monkeypatch.setattr(refinement, "distance", fails)
    assert main(["study", str(short_path)]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert [line for line in lines if "fails with a step" in line] == [lines[-1]]
    assert lines[-1].startswith("cells half as wide") and lines[-1].endswith(
        "(fails with a step of 0.002)"
    )
    assert "0.001 " in lines[-1]
    assert "half the step          no value" in lines[2]
    assert {each for each in asked if each[0] == (32, 32)} == {
        ((32, 32), 2e-3, 80), ((32, 32), 1e-3, 160),
    }  # fmt: skip
    # What tears, tears with any step.
    where[0] = FractureError("it tore", 3, 1, (0.0, 0.0), "none")
    asked.clear()
    assert main(["study", str(short_path)]) == 0
    assert "it tore" in capsys.readouterr().out.splitlines()[-1]
    assert ((32, 32), 1e-3, 160) not in asked


def test_a_body_without_design_is_audited_too():
    c = 1 / 16
    problem = Problem(small_scene(body=(Actuator((3 * c, 5 * c), (6 * c, 7 * c)),)))
    rows = study(problem, problem.join(np.empty(0), 0.2, 0.1, 0.1))
    assert rows[1].distance == rows[1].reference
    assert np.isnan(rows[1].retained)


def test_a_wide_filter_is_no_obstacle_to_finer_cells():
    """Refined once more it would be too large for a scene, but solid bodies need none."""
    scene = dataclasses.replace(climber(128, 2e-4, 4.0), filter_length=1.5 / 64)
    with pytest.raises(SceneError, match="shorter filter_length"):
        dataclasses.replace(refined(scene, 2), filter_length=scene.filter_length)
    assert refined(scene, 2).grid.cells == (256, 640)


def test_no_share_of_a_gain_that_is_rounding(tmp_path, capsys):
    """A body without design is the reference itself: nothing is gained, and nothing retained."""
    for kept, gain in ((0.0, 0.0), (3e-17, 1e-17), (1e-17, -1e-17), (0.1, -0.1)):
        assert np.isnan(retained_share(small_scene(), kept, gain))
    assert retained_share(small_scene(), 0.05, 0.1) == 0.5
    c = 1 / 16
    scene = small_scene(steps=5, body=(Actuator((3 * c, 5 * c), (6 * c, 7 * c)),))
    x = Problem(scene).join(np.empty(0), 0.2, 0.1, 0.1)
    path = tmp_path / "run.h5"
    runfile.write(path, optimise(scene, SHORT, x))
    for name in ("postprocess", "study"):
        assert main([name, str(path)]) == 0
        said = capsys.readouterr()
        assert "nan" not in said.out + said.err
        assert "Warning" not in said.err
    assert main(["postprocess", str(path)]) == 0
    assert "retained gain            no gain to keep" in capsys.readouterr().out
