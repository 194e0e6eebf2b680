"""Tasks in several scenes: values, gradients, constraints, and that threads change nothing."""

import dataclasses
import threading

import numpy as np
import pytest
from conftest import worst

from mpmopt.assess.threshold import distance, kept
from mpmopt.assess.verify import complex_step_test
from mpmopt.design.ensemble import meanwhile
from mpmopt.design.problem import Problem
from mpmopt.design.projection import project, project_adjoint
from mpmopt.design.task import AtMost, Task
from mpmopt.design.terms import Displacement, Effort, OnePiece, Volume
from mpmopt.design.variation import Variation
from mpmopt.errors import DesignError
from mpmopt.optimisation.loop import begin, go_on, optimise
from mpmopt.optimisation.settings import Settings, Stage
from mpmopt.results.runfile import read_run, write
from mpmopt.scene import Actuator, Design, Grid, Ground, Material, Scene, Solid
from mpmopt.simulation.threads import processors

C = 1 / 16
SCENE = Scene(
    Grid((16, 12), C),
    time_step=2e-3,
    steps=20,
    body=(
        Design((3 * C, 4 * C), (7 * C, 6 * C)),
        Actuator((3 * C, 6 * C), (6 * C, 7 * C)),
        Solid((6 * C, 6 * C), (7 * C, 7 * C)),
    ),
    gravity=(0.0, -10.0),
    ground=(Ground.floor(3.2 * C, thickness=C),),
    material=Material(viscosity=0.02, void_density=1e-2),
)
SCENES = (
    Variation(friction=0.3, strength=0.9, threshold=0.4),
    Variation(thickness=1.25, viscosity=2.0, formulation="total"),
    Variation(friction="stick", strength=1.1, threshold=0.6),
)
TASK = Task(
    Displacement() - 0.01 * Effort(),
    (AtMost(OnePiece(), -0.3), AtMost(Volume(), 0.4)),
    SCENES,
    soft_minimum=30.0,
)
SETTINGS = Settings(
    (
        Stage(2.0, 1e-2, 1e-2, 2e-3, move_limit=0.1),
        Stage(4.0, 1e-2, 1e-2, 2e-3, move_limit=0.1, solid=True),
    ),
    most_iterations=2,
)


@pytest.fixture
def x(rng):
    problem = Problem(SCENE)
    size = int(problem.particles.designed.sum())
    return problem.join(rng.uniform(-0.8, 0.8, size), 0.9, -0.3, -0.1)


@pytest.mark.parametrize("threshold", [0.2, 0.5, 0.7])
def test_the_projection_goes_from_zero_to_one_and_its_adjoint_is_exact(threshold):
    phi = np.linspace(-1.0, 1.0, 9)
    gamma = project(phi, 3.0, threshold)
    assert gamma[0] == pytest.approx(0.0, abs=1e-15)
    assert gamma[-1] == pytest.approx(1.0, abs=1e-15)
    steepest = np.argmax(np.diff(project(np.linspace(-1.0, 1.0, 2001), 3.0, threshold)))
    assert (steepest + 0.5) / 2000 == pytest.approx(threshold, abs=1e-3)
    slope = project(phi + 1e-30j, 3.0, threshold).imag / 1e-30
    assert project_adjoint(phi, 3.0, np.ones(9), threshold) == pytest.approx(slope, rel=1e-13)


@pytest.mark.parametrize("sharpness", [0.0, 30.0])
def test_gradients_of_an_ensemble_are_exact(sharpness, x):
    task = dataclasses.replace(TASK, soft_minimum=sharpness)
    assert worst(complex_step_test(Problem(SCENE, 2.0, task=task), x)) <= 1e-12


def test_the_gradient_of_a_subpixel_design_is_exact_in_all_scenes(x):
    task = dataclasses.replace(TASK, scenes=(*SCENES, Variation(refinement=2)))
    problem = Problem(SCENE, 50.0, task=task, subpixel=True)
    assert worst(complex_step_test(problem, x)) <= 1e-12


def test_finer_cells_take_their_design_from_the_others(x):
    task = Task(subject_to=(AtMost(Volume(), 0.5),), scenes=(Variation(refinement=2), Variation()))
    problem = Problem(SCENE, 2.0, task=task)
    assert worst(complex_step_test(problem, x, directions=1)) <= 1e-12
    fine, same = problem.members
    assert fine.gamma(x).size == 4 * same.gamma(x).size
    assert fine.gamma(x).mean() == pytest.approx(same.gamma(x).mean(), rel=1e-14)


def test_an_ensemble_is_its_scenes(x):
    problem = Problem(SCENE, 2.0, task=TASK)
    evaluation = problem.evaluate(x)
    alone = []
    for member, variation in zip(problem.members, SCENES, strict=True):
        there = variation.scene(SCENE)
        assert member.scene == there
        if variation.threshold == 0.5:
            one = Problem(there, 2.0, task=TASK.alone).evaluate(x)
            assert one.value == member.value(x)
        alone.append(member.evaluate(x))
    values = np.array([one.value for one in alone])
    assert evaluation.scenes == tuple(values.tolist())
    soft = -np.log(np.mean(np.exp(-30.0 * values))) / 30.0
    assert evaluation.value == pytest.approx(soft, rel=1e-14)
    assert values.min() <= evaluation.value <= values.mean()
    for k in (0, 1):
        worst = max(alone, key=lambda one: one.constraints[k])
        assert evaluation.constraints[k] == worst.constraints[k]
        assert np.array_equal(evaluation.jacobian[k], worst.jacobian[k])
    assert evaluation.constraints[1] == alone[0].constraints[1]  # the dilated one has most volume


def test_a_sharp_soft_minimum_is_the_least_and_a_dull_one_the_mean():
    values = np.array([0.3, 0.1, 0.2])
    assert Task(soft_minimum=1e4).soft(values)[0] == pytest.approx(0.1, abs=2e-4)
    assert Task(soft_minimum=1e-6).soft(values)[0] == pytest.approx(0.2, abs=1e-6)
    assert Task().soft(values)[0] == pytest.approx(0.2)
    for sharpness in (0.0, 20.0):
        value, weights = Task(soft_minimum=sharpness).soft(values + 1e-30j * np.eye(3)[1])
        assert value.imag / 1e-30 == pytest.approx(weights[1].real, rel=1e-12)


def test_scenes_side_by_side_give_the_same_bits(x, monkeypatch):
    problem = Problem(SCENE, 2.0, task=TASK)
    both = problem.evaluate(x)
    monkeypatch.setattr("os.sched_getaffinity", lambda _: {0}, raising=False)
    alone = problem.evaluate(x)
    assert (both.value, both.gradients.tolist()) == (alone.value, alone.gradients.tolist())


def test_what_runs_meanwhile_is_there_when_it_is_asked_for(monkeypatch):
    begun = threading.Event()

    def fail():
        raise OSError("made to fail")

    def other() -> int:
        begun.set()
        return 2

    if processors() > 1:  # the first waits for the other, which has begun
        assert meanwhile(lambda: begun.wait(60.0), other)[0]
    monkeypatch.setattr("mpmopt.design.ensemble.processors", lambda: 1)
    begun.clear()
    first, given = meanwhile(lambda: begun.is_set(), other)
    assert (first, given()) == (False, 2)
    for count in (1, 2):
        monkeypatch.setattr("mpmopt.design.ensemble.processors", lambda count=count: count)
        number, given = meanwhile(lambda: 1, fail)
        assert number == 1
        with pytest.raises(OSError, match="made to fail"):
            given()
        with pytest.raises(OSError, match="made to fail"):
            meanwhile(fail, other)


def test_bodies_without_grey_count_with_all_scenes(x):
    problem = Problem(SCENE, 2.0, task=TASK)
    keep, variables = kept(problem, x), problem.split(x)
    values = [distance(each.scene(SCENE), keep, variables, TASK.alone) for each in SCENES]
    whole = distance(SCENE, keep, variables, TASK)
    assert whole == pytest.approx(float(TASK.soft(np.array(values))[0]), rel=1e-14)


def test_a_run_with_scenes_and_constraints_goes_on_where_it_was(x, tmp_path):
    path = tmp_path / "run.h5"
    whole = optimise(SCENE, SETTINGS, x, task=TASK)
    assert [len(item.scenes) for item in whole.history] == 4 * [3]

    class StopError(Exception):
        pass

    def stop(run):
        write(path, run)
        if len(run.history) == 3:
            raise StopError

    with pytest.raises(StopError):
        go_on(begin(SCENE, SETTINGS, x, TASK), stop)
    again = read_run(path).run
    assert again.task == TASK
    go_on(again)
    assert np.array_equal(again.result.x, whole.result.x)
    assert [item.scenes for item in again.history] == [item.scenes for item in whole.history]


def test_variations_change_what_they_say():
    softer = Variation(thickness=2.0).scene(SCENE).ground[0]
    hard, soft = SCENE.layers[0], Variation(thickness=2.0).scene(SCENE).layers[0]
    assert softer.points[0][1] == pytest.approx(SCENE.ground[0].points[0][1] - C)
    assert soft.thickness * soft.stiffness == pytest.approx(hard.thickness * hard.stiffness)
    assert (soft.damping, soft.creeping_speed) == (hard.damping, hard.creeping_speed)
    strong = Variation(strength=2.0).scene(SCENE).actuators[0].stress
    assert strong == ((4.0, 0.0), (0.0, 4.0))
    rough = Ground.heights([0.0, 0.5, 1.0], [0.1, 0.15, 0.1], thickness=C)
    assert Variation(ground=(rough,), friction=0.1).scene(SCENE).ground[0].friction == 0.1
    assert str(Variation(friction=0.3, strength=0.9)) == "friction 0.3, strength 0.9"
    assert str(Variation()) == "as it is"


@pytest.mark.parametrize(
    "wrong",
    [
        {"strength": 0.0},
        {"thickness": -1.0},
        {"viscosity": -1.0},
        {"threshold": 1.0},
        {"refinement": 0},
        {"ground": (1,)},
    ],
)
def test_variations_that_make_no_sense(wrong):
    with pytest.raises(DesignError, match=next(iter(wrong))):
        Variation(**wrong)
    with pytest.raises(DesignError, match="soft_minimum"):
        Task(soft_minimum=-1.0)


def test_json_and_back():
    task = dataclasses.replace(
        TASK, scenes=(*SCENES, Variation(ground=(Ground.floor(0.1, friction="stick"),)))
    )
    assert Task.from_json(task.to_json()) == task
