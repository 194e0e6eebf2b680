"""What users hand over: other kinds work where they can only mean one thing, or are named."""

import copy
import dataclasses
import doctest
import json
import pickle
from inspect import signature
from typing import Any

import numpy as np
import pytest
from conftest import SHORT, small_scene

from mpmopt.app.case import Case, baseline_particles, resume, run
from mpmopt.app.multistart import multistart
from mpmopt.app.summary import summarise
from mpmopt.assess.refinement import study
from mpmopt.assess.threshold import solid_reference
from mpmopt.design.problem import Problem
from mpmopt.design.task import Task
from mpmopt.design.terms import Effort, Speed, Volume
from mpmopt.errors import DesignError, SceneError, SweepError
from mpmopt.optimisation.loop import begin, check_body_fits, go_on, optimise
from mpmopt.optimisation.presets import continuation
from mpmopt.optimisation.settings import STAGES, Settings, Stage
from mpmopt.results import runfile
from mpmopt.scene import Actuator, Design, Grid, Ground, Material, Mirror, Scene, Solid
from mpmopt.simulation.checkpoints import Checkpointing
from mpmopt.view.live import ProgressBar

C = 1 / 16
SCENE = small_scene(steps=4)
ON_GROUND = small_scene(
    walls=(), ground=(Ground.floor(3.5 * C, thickness=C),), steps=8, time_step=2e-3
)
PROBLEM = Problem(SCENE)
START = PROBLEM.join(0.0, 1.0, -0.3, -0.5)
STAGE = SHORT.stages[0]
CASE = Case(SCENE, SHORT, solid_reference)


def test_one_stage_one_list_of_numbers_and_one_callback_are_enough():
    settings = dataclasses.replace(SHORT, stages=STAGE)
    assert settings == SHORT == dataclasses.replace(SHORT, stages=iter([STAGE]))
    calls: list[Any] = []
    for start in (list(START), tuple(START)):
        optimise(SCENE, settings, start, calls.append)
        assert np.array_equal(calls[-1].first.x, START)
    assert len(calls) == 2 * (2 + 1)


@pytest.mark.parametrize(
    ("formulation", "floors"), [("updated", (1e-2, 1e-3)), ("total", (2e-3, 2e-4))]
)
def test_a_stage_names_what_differs_from_the_scene_and_its_formulation(formulation, floors):
    scene = dataclasses.replace(ON_GROUND, formulation=formulation)
    posed = Stage(2.0).scene(scene)
    assert (posed.time_step, posed.steps) == (scene.time_step, scene.steps)
    assert (posed.material.void_density, posed.material.void_stiffness) == floors
    assert posed == Stage(2.0, floors[0], floors[1], scene.time_step).scene(scene)
    other = Stage(2.0, void_stiffness=5e-4, time_step=1e-3).scene(scene)
    assert (other.time_step, other.material.void_density) == (1e-3, floors[0])
    assert other.material.void_stiffness == 5e-4
    assert Stage(2.0, void_density=5e-3).scene(scene).material.void_density == 5e-3


def test_a_scene_alone_can_be_optimised():
    run = optimise(SCENE, Settings(most_iterations=1))
    assert [item.beta for item in run.history] == [stage.beta for stage in STAGES]
    assert run.first is not None and np.array_equal(run.first.x, START)
    assert np.isfinite(run.result.counted)
    assert signature(optimise).parameters["settings"].default == Settings()


def test_another_formulation_has_floors_of_its_own_unless_they_are_named():
    settings = Settings((Stage(1.0), Stage(1.0, 2e-3, 2e-4)))
    case = Case(dataclasses.replace(ON_GROUND, formulation="total"), settings, solid_reference)
    assert case.in_formulation("total").settings == settings
    other = case.in_formulation("updated")
    bare, named = other.settings.stages
    assert bare.scene(other.scene) == named.scene(other.scene) == Stage(1.0).scene(ON_GROUND)


def test_settings_of_a_run_file_are_read_whether_stages_name_all_or_little():
    stage = {
        "beta": 2.0, "void_density": 1e-2, "void_stiffness": 1e-3, "time_step": 4e-3,
        "solid": False, "refined": False, "move_limit": 0.05, "void_cutoff": 0.0,
        "most_iterations": None, "halvings": 2, "limited": True,
    }  # fmt: skip
    written = {
        "adapt_move_limit": True, "sharpen_asymptotes": True, "best_first": True, "window": 10,
        "tolerance": 2e-4, "least_iterations": None, "most_iterations": 200, "most_failures": 8,
    }  # fmt: skip
    settings = Settings(Stage(2.0, 1e-2, 1e-3, 4e-3))
    text = json.dumps({"stages": [stage], **written})
    assert Settings.from_dict(json.loads(text)) == settings
    for each in (settings, Settings()):
        text = json.dumps(dataclasses.asdict(each))
        assert Settings.from_dict(json.loads(text)) == each


def test_few_iterations_need_no_word_about_the_least():
    few = Settings(STAGE, most_iterations=10)
    assert (few.least, Settings(STAGE).least) == (10, 20)
    assert dataclasses.replace(continuation(8e-4), most_iterations=5).least == 5
    assert Settings.from_dict(dataclasses.asdict(few)) == few
    with pytest.raises(DesignError, match="least_iterations = 11 is above most_iterations = 10"):
        dataclasses.replace(few, least_iterations=11)
    still = dataclasses.replace(few, tolerance=1.0, window=1, most_iterations=3)
    assert len(optimise(SCENE, still, START).history) == 3


@pytest.mark.parametrize(
    ("kind", "named", "error", "says"),
    [
        (
            Scene,
            {"gravty": (0.0, 0.0)},
            SceneError,
            "Scene has no field gravty; did you mean gravity",
        ),
        (Solid, {"materal": None}, SceneError, "Solid has no field materal; did you mean material"),
        (Material, {"colour": 1}, SceneError, "Material has no field colour; it has lame_lambda, "),
        (Solid, {"lower": (0.0, 0.0)}, SceneError, "Solid: missing .* 'upper'; it has lower, upp"),
        (Stage, {"betta": 1.0}, DesignError, "Stage has no field betta; did you mean beta"),
        (Settings, {"most_iteration": 5}, DesignError, "did you mean most_iterations"),
        (Task, {"maximize": None}, DesignError, "did you mean maximise"),
        (Speed, {"aftr": 1.0}, DesignError, "Speed has no field aftr; did you mean after"),
        (Volume, {"most": 0.4}, DesignError, "Volume has no field most; it has no fields"),
        (Checkpointing, {"memry": 3}, DesignError, "no field memry; did you mean memory"),
        (Scene, {}, SceneError, "Scene: missing .* 'grid'; it has grid, "),
        (Grid, {}, SceneError, "Grid: missing .* 'cells'; it has cells, dx"),
        (Stage, {}, DesignError, "Stage: missing .* 'beta'; it has beta, "),
        (Case, {"setings": None}, DesignError, "Case has no field setings; did you mean settings"),
    ],
)
def test_a_field_that_is_misspelt_or_missing_is_named(kind, named, error, says):
    with pytest.raises(error, match=says):
        kind(**named)


@pytest.mark.parametrize("made", [SCENE, STAGE, CASE, Speed(1.0), Effort(), Checkpointing(3)])
def test_what_is_checked_can_be_copied_and_pickled(made):
    for again in (copy.copy(made), copy.deepcopy(made), pickle.loads(pickle.dumps(made))):
        assert again == made and again is not made and type(again) is type(made)
    with pytest.raises(DesignError, match=r"Volume: too many .* it has no fields"):
        Volume(0.4)


@pytest.mark.parametrize(
    ("call", "says"),
    [
        (lambda: Settings(5), "stages = 5 must be Stages"),
        (lambda: Settings(Stage), "must be Stages"),
        (lambda: Settings(STAGE, tolerance=np.nan), "tolerance = nan must be finite"),
        (lambda: Stage(1.0, 2.0, 1e-3, 1e-3), "void_density = 2.0 must be at most 1"),
        (lambda: Stage(1.0, 1e-3, 2.0, 1e-3), "void_stiffness = 2.0 must be at most 1"),
        (lambda: optimise(Scene, SHORT, START), "scene = .* class Scene"),
        (
            lambda: optimise(SCENE, continuation, START),
            "settings = .*continuation.* such as continuation",
        ),
        (lambda: optimise(SCENE, (STAGE,), START), "settings = .* write Settings"),
        (lambda: optimise(SCENE, SHORT, None), "x holds object"),
        (lambda: optimise(SCENE, SHORT, 0.3), "x has shape .*Problem.join"),
        (lambda: optimise(SCENE, SHORT, PROBLEM.split(START)), "x is no array"),
        (lambda: optimise(SCENE, SHORT, START, [ProgressBar]), r"such as ProgressBar\(\)"),
        (lambda: optimise(SCENE, SHORT, START, ProgressBar), r"such as ProgressBar\(\)"),
        (lambda: optimise(SCENE, SHORT, START, 5), "callback 5 must be a function"),
        (lambda: optimise(SCENE, SHORT, START, (), "disk"), "class Checkpointing"),
        (lambda: optimise(SCENE, SHORT, START, (), Checkpointing), "class Checkpointing"),
        (lambda: go_on(CASE), "run = .* class Optimisation"),
        (lambda: Problem(Scene), "scene = .* class Scene"),
        (lambda: Problem(SCENE, 1.0, 0), "checkpointing = 0 .* class Checkpointing"),
        (lambda: PROBLEM.transfer(SCENE, START), "class Problem"),
        (lambda: study(SCENE, START), "class Problem"),
        (lambda: summarise(CASE, {}), "class Optimisation"),
        (lambda: dataclasses.replace(CASE, settings=continuation), "such as continuation"),
        (lambda: dataclasses.replace(CASE, scene=Scene), "class Scene"),
        (lambda: dataclasses.replace(CASE, baseline=np.ones(32, bool)), "function of positions"),
        (lambda: dataclasses.replace(CASE, start=START), "class Mapping"),
    ],
)
def test_what_is_of_another_kind_is_named(call, says):
    with pytest.raises(DesignError, match=says):
        call()


@pytest.mark.parametrize(
    ("call", "says"),
    [
        (lambda out: run(SCENE, out), "class Case"),
        (lambda out: run(CASE, None), "out = None must be a path"),
        (lambda out: run(CASE, out, "disk"), "class Checkpointing"),
        (lambda out: run(CASE, out, phi=0.5), "phi = 0.5 must be a function"),
        (lambda out: run(dataclasses.replace(CASE, start={"theta": "a"}), out), "theta holds"),
        (lambda out: run(dataclasses.replace(CASE, start={"theta": np.nan}), out), "nan"),
        (lambda out: resume(None), "path = None must be a path"),
        (lambda out: runfile.read_run(None), "path = None must be a path"),
        (lambda out: runfile.write(out / "run.h5", CASE), "class Optimisation"),
        (lambda out: runfile.write(5, begin(SCENE, SHORT, START)), "path = 5 must be a path"),
        (lambda out: multistart(CASE, out, 1.5), "starts = 1.5 must be a whole number"),
        (lambda out: multistart(CASE, out, 0), "starts = 0 must be from 1"),
        (lambda out: multistart(SCENE, out, 1), "class Case"),
    ],
)
def test_what_is_of_another_kind_is_named_before_anything_is_written(tmp_path, call, says):
    with pytest.raises((DesignError, SweepError), match=says):
        call(tmp_path)
    assert list(tmp_path.iterdir()) == []


def test_texts_are_paths_too(tmp_path, monkeypatch):
    monkeypatch.setattr("mpmopt.app.case._draw", lambda *_: None)
    summary = run(CASE, str(tmp_path / "out"))
    path = str(tmp_path / "out" / "run.h5")
    assert resume(path) == summary
    runfile.write(path, runfile.read_run(path).run)
    assert runfile.read_run(path).summary == {}


@pytest.mark.parametrize(
    ("baseline", "says"),
    [
        (lambda position: np.ones(31, bool), r"bool of shape \(31,\).* \(32, 2\).*\(32,\)"),
        (lambda position: np.ones((32, 1), bool), r"shape \(32, 1\)"),
        (lambda position: None, "NoneType of shape"),
        (lambda position: np.ones(len(position)), r"float of shape \(32,\)"),
        (lambda position: [[True], [True, False]], "list of shape"),
    ],
)
def test_a_baseline_that_is_none_is_found_before_anything_is_written(tmp_path, baseline, says):
    case = dataclasses.replace(CASE, baseline=baseline)
    for call in (lambda: run(case, tmp_path / "out"), lambda: multistart(case, tmp_path, 1)):
        with pytest.raises(DesignError, match=says):
            call()
    assert list(tmp_path.iterdir()) == []


def test_a_baseline_may_be_a_list():
    listed = dataclasses.replace(CASE, baseline=lambda position: [True] * len(position))
    assert baseline_particles(listed).tolist() == 32 * [True]


def pieces(*body, **changes):
    return small_scene(steps=4, walls=(), body=body, gravity=(0.0, 0.0), **changes)


DESIGN = Design((3 * C, 4 * C), (5 * C, 6 * C))


LOOSE = Solid((6 * C, 7.5 * C), (7 * C, 8 * C))


@pytest.mark.parametrize(
    ("scene", "says"),
    [
        (
            pieces(Actuator((10 * C, 4 * C), (12 * C, 5 * C)), DESIGN),
            ["Design (0.1875, ", "is 0.3125 (5 cells) from Actuator (0.625, ", "an edge"],
        ),
        (
            pieces(DESIGN, Actuator((5 * C, 6 * C), (6 * C, 7 * C))),
            ["Actuator (0.3125, 0.375)", "only touches Design", "at a corner"],
        ),
        (
            pieces(DESIGN, Actuator((3 * C, 6 * C), (5 * C, 7 * C)), LOOSE),
            ["Solid (0.375, 0.46875)", "is 0.06988 (1.118 cells) from Actuator"],
        ),
        (pieces(DESIGN, Actuator((3 * C, 6.5 * C), (5 * C, 7 * C))), ["0.03125 (0.5 cells)"]),
        (small_scene(steps=4, particles_per_cell=1), ["particles_per_cell = 1", "2 or more"]),
        (pieces(DESIGN, Solid((3 * C, 6 * C), (5 * C, 7 * C))), ["no Actuator", "add one"]),
        (
            pieces(DESIGN, Actuator((3 * C, 6 * C), (5 * C, 7 * C), stress=((0, 0), (0, 0)))),
            ["no Actuator with a stress"],
        ),
    ],
)
def test_a_body_that_makes_no_robot_can_be_simulated_but_not_optimised(tmp_path, scene, says):
    problem = Problem(scene)
    x = problem.join(0.0, 0.0, 0.0, 0.0)
    assert np.isfinite(problem.value(x))
    case = Case(scene, SHORT, solid_reference)
    for call in (
        lambda: optimise(scene, SHORT, x),
        lambda: run(case, tmp_path),
        lambda: multistart(case, tmp_path, 1),
    ):
        with pytest.raises(SceneError) as error:
            call()
        for part in says:
            assert part in str(error.value)
    assert list(tmp_path.iterdir()) == []


def test_a_body_that_hangs_together_through_others_is_optimised():
    around = pieces(
        Actuator((3 * C, 4 * C), (4 * C, 6 * C)),
        Solid((6 * C, 4 * C), (7 * C, 5 * C)),
        Design((4 * C, 4 * C), (6 * C, 4.5 * C)),
        mirror=None,
    )
    check_body_fits(around)
    halves = pieces(
        Design((3 * C, 6 * C), (5 * C, 7 * C)),
        Actuator((3 * C, 7 * C), (5 * C, 9 * C)),
        Design((3 * C, 9 * C), (5 * C, 10 * C)),
        mirror=Mirror("y", 8 * C),
    )
    check_body_fits(halves)


def test_phi_is_told_where_its_entries_are():
    with pytest.raises(DesignError, match=r"\(31,\), must have \(32,\) or \(\), or be a picture"):
        PROBLEM.join(np.zeros(31), 0.0, 0.0, 0.0)
    with pytest.raises(DesignError, match=r"b has shape \(3,\), must have \(2,\) or \(\)$"):
        PROBLEM.join(0.0, 0.0, 0.0, [0.0, 0.1, 0.2])
    found = doctest.DocTestFinder().find(Problem.join, "join", globs={})
    assert [doctest.DocTestRunner().run(test).failed for test in found] == [0]
    assert found[0].examples
    # What the example says of the order: of each column of the lattice, the lowest first.
    x, y = PROBLEM.particles.position[PROBLEM.particles.designed].T
    assert np.array_equal(np.lexsort((y, x)), np.arange(x.size))
