"""What is tied, frozen or bounded, own starts, and signals of several sines."""

import dataclasses
import math
from pathlib import Path

import numpy as np
import pytest
from conftest import small_scene, worst
from PIL import Image

from mpmopt.app.case import Case
from mpmopt.app.summary import summarise, table
from mpmopt.assess.threshold import solid_body, solid_reference
from mpmopt.assess.verify import COMPLEX_TOLERANCE, complex_step_test, kernel_mismatches
from mpmopt.design.actuation import frequencies, labels, signal, signal_adjoint, sizes
from mpmopt.design.problem import Evaluation, Problem
from mpmopt.design.task import AtMost, Task
from mpmopt.design.terms import Effort, Volume
from mpmopt.design.variables import Bounded, Freedom, Frozen, Tied, Variables
from mpmopt.design.variation import Variation
from mpmopt.errors import DesignError, SceneError
from mpmopt.io.pictures import read_picture
from mpmopt.optimisation.loop import begin, go_on, optimise
from mpmopt.optimisation.settings import Settings, Stage
from mpmopt.results import runfile
from mpmopt.scene import Actuator, Scene
from mpmopt.simulation.indicators import Indicators

STAGE = Stage(2.0, 1e-2, 1e-3, 4e-3, move_limit=0.2)
SETTINGS = Settings((STAGE,), tolerance=0.0, most_iterations=4)


def rich_scene(**changes) -> Scene:
    """The small scene with two sines in the first actuator, and frequencies that may change."""
    scene = small_scene(**changes)
    kinds = iter(((2, 0.5), (1, 0.25)))

    def rich(part):
        harmonics, detuning = next(kinds)
        return dataclasses.replace(part, harmonics=harmonics, detuning=detuning)

    body = (rich(part) if isinstance(part, Actuator) else part for part in scene.body)
    return dataclasses.replace(scene, body=tuple(body))


SCENE, RICH = small_scene(), rich_scene()
ANTI_PHASE = Tied("a", 1, to=0, factor=-1.0), Tied("theta", 1, to=0)


def test_a_signal_is_a_sum_of_sines_of_a_frequency_that_may_change():
    a, theta, b, omega = [0.9, -0.4, 0.5], [0.25, 0.1, -0.5], [0.1, -0.2], [0.8, -1.0]
    found = signal(RICH, *map(np.array, (a, theta, b, omega)))
    assert frequencies(RICH, np.array(omega)) == pytest.approx([30.0 * 1.4, 50.0 * 0.75])
    for n in (0, 1, 17):
        t = n * RICH.time_step
        first = 0.9 * math.sin(42.0 * t + math.pi * 0.25) - 0.4 * math.sin(84.0 * t + math.pi * 0.1)
        assert found[n, 0] == pytest.approx(first + 0.1, rel=1e-13)
        second = 0.5 * math.sin(37.5 * t - 0.5 * math.pi) - 0.2
        assert found[n, 1] == pytest.approx(second, rel=1e-13)


def test_the_adjoint_of_signals_is_that_of_the_complex_step(rng):
    parts = [rng.uniform(-1.0, 1.0, size) for size in sizes(RICH)]
    bar = rng.standard_normal((RICH.steps, 2))
    a, theta, _, omega = parts
    gradient = np.concatenate(signal_adjoint(RICH, a, theta, bar, omega))
    x, cuts = np.concatenate(parts), np.cumsum(sizes(RICH))[:-1]
    for k, name in enumerate(labels(RICH)):
        shifted = x + 1e-30j * (np.arange(x.size) == k)
        exact = (bar * signal(RICH, *np.split(shifted, cuts)).imag).sum() / 1e-30
        assert gradient[k] == pytest.approx(exact, rel=1e-12), name


def test_the_gradient_by_harmonics_and_frequencies_is_exact(rng):
    problem = Problem(RICH, beta=2.0)
    phi = rng.uniform(-0.8, 0.8, 32)
    x = problem.join(phi, [0.6, 0.4, 0.5], [-0.3, 0.6, 0.2], [-0.5, 0.1], [0.3, -0.7])
    assert problem.size == x.size == 32 + 3 + 3 + 2 + 2
    errors = complex_step_test(problem, x, directions=1)
    assert {"a of actuator 0, harmonic 2", "a of actuator 1", "omega of actuator 1"} <= set(errors)
    assert worst(errors) <= COMPLEX_TOLERANCE
    assert problem.split(x).omega.tolist() == [0.3, -0.7]
    assert kernel_mismatches(RICH)["signal"] <= 1e-12


def test_more_sines_reach_further_and_scenes_know_it():
    body = Actuator((0, 0), (1, 1), harmonics=3)
    assert body.largest_signal == 4.0
    strong = [
        dataclasses.replace(part, stress=((3.0, 0.0), (0.0, 3.0)), harmonics=3)
        if isinstance(part, Actuator)
        else part
        for part in SCENE.body
    ]
    with pytest.raises(SceneError, match="can reach -12 at a signal of 4;"):
        dataclasses.replace(SCENE, body=tuple(strong))
    with pytest.raises(SceneError, match=r"detuning = 1\.0 must be"):
        Actuator((0, 0), (1, 1), detuning=1.0)
    with pytest.raises(SceneError, match="harmonics = 0 must be"):
        Actuator((0, 0), (1, 1), harmonics=0)
    assert Scene.from_json(RICH.to_json()) == RICH


def test_an_actuation_of_another_scene_is_refused():
    with pytest.raises(DesignError, match=r"omega has shape \(0,\), must have \(2,\)"):
        solid_body(
            RICH, np.ones(32, bool), Variables(np.zeros(0), np.zeros(3), np.zeros(3), np.zeros(2))
        )


def test_free_variables_are_what_is_left_and_the_others_follow(rng):
    restrictions = (
        *ANTI_PHASE, Bounded("b", lower=-0.5, upper=0.25), Frozen("b", 0), Frozen("phi", value=0.5),
    )  # fmt: skip
    freedom = Freedom(SCENE, 38, restrictions)
    assert freedom.lower.tolist() == [-1.0, -1.0, -0.5]  # a, theta, and b of one actuator
    assert freedom.upper.tolist() == [1.0, 1.0, 0.25]
    start = freedom.started(rng.uniform(-1.0, 1.0, 38))
    whole = freedom.whole(start, np.array([0.7, -0.2, 0.1]))
    variables = Variables.of(whole, SCENE)
    assert variables.phi.tolist() == 32 * [0.5]
    assert (variables.a.tolist(), variables.theta.tolist()) == ([0.7, -0.7], [-0.2, -0.2])
    assert variables.b.tolist() == [start[36], 0.1]
    assert freedom.reduced(whole).tolist() == [0.7, -0.2, 0.1]
    left, right = variables.signal(SCENE.vary(time_step=4e-3)).T
    assert left[0] - variables.b[0] == pytest.approx(variables.b[1] - right[0])


def test_what_is_tied_narrows_the_range_of_what_it_follows():
    later = Tied("theta", 1, to=0, shift=0.5)
    freedom = Freedom(SCENE, 38, (later, Bounded("theta", 1, upper=0.75)))
    assert freedom.upper[-3] == 0.25  # phi, a, theta of the first, b
    assert Variables.of(freedom.started(np.ones(38)), SCENE).theta.tolist() == [0.25, 0.75]
    equal = Freedom(SCENE, 38, (Tied("b", to=1), Bounded("b", 1, upper=-0.5)))
    assert Variables.of(equal.started(np.ones(38)), SCENE).b.tolist() == [-0.5, -0.5]
    reverse = Freedom(SCENE, 38, (Tied("b", to=1, factor=-0.5, shift=0.75),))
    assert (reverse.lower[-1], reverse.upper[-1]) == (-0.5, 1.0)


def test_the_pullback_is_the_transpose_of_what_follows(rng):
    restrictions = (*ANTI_PHASE, Tied("b", to=1, factor=0.5, shift=0.1), Frozen("phi"))
    freedom = Freedom(SCENE, 38, restrictions)
    x = freedom.started(rng.uniform(-0.5, 0.5, 38))
    y = freedom.reduced(x)
    bars, change = rng.standard_normal((2, 38)), 0.1 * rng.standard_normal(y.size)
    moved = freedom.whole(x, y + change) - x
    assert freedom.pullback(bars) @ change == pytest.approx(bars @ moved, rel=1e-12)


@pytest.mark.parametrize(
    ("restrictions", "message"),
    [
        ((Frozen("b", 2),), r"b\[2\] as it starts: b has 2 entries, 2 is none"),
        ((Tied("b", 1, to=2),), "b has 2 entries, 2 is none"),
        ((Frozen("omega", 0),), "omega has 0 entries"),
        ((Tied("a", 1), Frozen("a", 1)), r"a\[1\] = a\[0\]: it is tied or frozen already"),
        ((Tied("a", 1), Tied("a", 1, factor=-1.0)), "tied or frozen already"),
        ((Tied("a", 1, to=0), Tied("a", 0, to=1)), "which is tied itself"),
        ((Frozen("a", 0, 0.5), Bounded("a", lower=0.75)), "leaves no value, from 0.75 to 0.5"),
        ((Frozen("theta", 0, 0.75), Tied("theta", 1, shift=0.5)), "leaves no value"),
    ],
)
def test_restrictions_that_contradict_each_other_are_refused(restrictions, message):
    with pytest.raises(DesignError, match=message):
        Freedom(SCENE, 38, restrictions)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Frozen("gamma"), "must be one of phi, a, theta, b, omega"),
        (lambda: Frozen("phi", 3), "leave entry out"),
        (lambda: Frozen("a", value=1.5), r"1.5 must be within \[-1, 1\]"),
        (lambda: Bounded("a", lower=0.5, upper=0.5), "take Frozen"),
        (lambda: Tied("phi"), "take a Mirror"),
        (lambda: Tied("a", 1, factor=0.0), "take Frozen"),
        (lambda: Tied("a", 0), "follow itself"),
        (lambda: Task(variables=("theta",)), "Frozen"),
        (lambda: begin(SCENE, SETTINGS, {"c": 1.0}), "start has c; its names are phi, a,"),
        (
            lambda: begin(
                SCENE, SETTINGS, {},
                Task(variables=tuple(Frozen(name) for name in ("phi", "a", "theta", "b"))),
            ),
            "leave none free",
        ),
    ],
)  # fmt: skip
def test_restrictions_and_starts_that_make_no_sense_are_refused(make, message):
    with pytest.raises(DesignError, match=message):
        make()


def test_an_optimisation_keeps_what_is_restricted_and_goes_on_to_the_bit(tmp_path):
    kept = (*ANTI_PHASE[1:], Tied("a", 2, to=1, factor=-1.0), Frozen("b", value=-0.25))
    task = Task(
        subject_to=AtMost(Effort(), 1.0),
        scenes=(Variation(threshold=0.4), Variation(threshold=0.6)),
        variables=(*kept, Bounded("omega", 1, upper=0.5)),
    )
    assert Task.from_json(task.to_json()) == task
    stages = STAGE, dataclasses.replace(STAGE, beta=4.0)
    settings = dataclasses.replace(SETTINGS, stages=stages, most_iterations=2)
    paths: list[Path] = []

    def save(run):
        paths.append(tmp_path / f"{len(paths)}.h5")
        runfile.write(paths[-1], run)

    whole = optimise(RICH, settings, {"a": 0.5, "omega": 1.0}, save, task=task)
    for path in paths:
        last = runfile.read_run(path).run.last
        assert last is not None
        variables = Variables.of(last.x, RICH)
        assert variables.a[2] == -variables.a[1]
        assert variables.theta[1] == variables.theta[0]
        assert variables.b.tolist() == [-0.25, -0.25]
        assert variables.omega[1] <= 0.5
    assert whole.last is not None
    assert np.ptp(Variables.of(whole.last.x, RICH).omega) > 0.0
    for path in paths[1::2]:
        again = go_on(runfile.read_run(path).run)
        assert again.last is not None
        assert np.array_equal(again.last.x, whole.last.x)
    summary = summarise(whole)
    assert len(summary["angular_frequency"]) == 2
    assert summary["variables"][0] == "theta[1] = theta[0]"
    assert "omega[1] from -1 to 0.5" in table(summary)


def test_two_actuators_stay_in_anti_phase_and_a_phase_stays_frozen(monkeypatch):
    def evaluate(problem, x):
        """L is what pulls a and theta of the second actuator against those of the first."""
        slope = np.zeros(x.size)
        slope[32:36] = 1.0, -2.0, 5.0, 1.0
        return Evaluation(slope @ x, slope, Indicators(), problem.scene.time_step)

    monkeypatch.setattr(Problem, "evaluate", evaluate)
    task = Task(variables=(ANTI_PHASE[0], Frozen("theta", 1, 0.75)))
    settings = dataclasses.replace(SETTINGS, most_iterations=12)
    run = optimise(SCENE, settings, {"a": 0.0}, task=task)
    found = Variables.of(run.result.x, SCENE)
    assert found.a.tolist() == [1.0, -1.0]  # by 1 + 2, not by 1
    assert found.theta.tolist() == [1.0, 0.75]
    assert run.history[0].projected_gradient == 5.0
    assert run.history[-1].projected_gradient == 0.0


def test_a_picture_is_looked_up_by_position_whatever_its_resolution(tmp_path):
    problem = Problem(SCENE)
    x, y = problem.particles.position[problem.particles.designed].T
    picture = np.array([[0.1, 0.2, 0.3, 0.4], [-0.1, -0.2, -0.3, -0.4]])  # a cell each
    phi = problem.split(problem.join(picture, 1.0, 0.0, 0.0)).phi
    column, row = np.floor((x - 3 / 16) * 16).astype(int), np.floor((6 / 16 - y) * 16).astype(int)
    assert np.array_equal(phi, picture[row, column])
    for fine in (np.repeat(np.repeat(picture, 2, 0), 2, 1), np.repeat(picture, 7, 1)):
        assert np.array_equal(problem.join(fine, 1.0, 0.0, 0.0)[:32], phi)
    assert np.array_equal(problem.join(lambda _: phi, 1.0, 0.0, 0.0)[:32], phi)
    assert problem.join([[0.5]], 1.0, 0.0, 0.0)[:32].tolist() == 32 * [0.5]
    with pytest.raises(DesignError, match=r"picture of shape \(0, 3\)"):
        problem.join(np.zeros((0, 3)), 1.0, 0.0, 0.0)


def test_a_case_and_an_optimisation_start_from_a_picture(tmp_path):
    image = Image.new("LA", (2, 1), (255, 255))
    image.putpixel((0, 0), (0, 255))
    image.save(tmp_path / "left.png")
    case = Case(SCENE, SETTINGS, solid_reference, {"phi": tmp_path / "left.png"})
    run = begin(case.scene, case.settings, case.start)
    x, _ = Problem(SCENE).particles.position[Problem(SCENE).particles.designed].T
    assert np.array_equal(run.x[:32], np.where(x < 5 / 16, 1.0, -1.0))
    assert run.x[32:].tolist() == [1.0, 1.0, -0.3, -0.3, -0.5, -0.5]
    image.putpixel((0, 0), (0, 0))  # clear
    image.save(tmp_path / "left.png")
    assert read_picture(tmp_path / "left.png").tolist() == [[-1.0, -1.0]]
    (tmp_path / "text.png").write_text("no picture")
    with pytest.raises(DesignError, match=r"text\.png is no picture: .*; give a PNG"):
        Case(SCENE, SETTINGS, solid_reference, {"phi": str(tmp_path / "text.png")})


def test_frozen_material_and_a_bound_on_it_leave_a_mean_that_is_known():
    task = Task(Volume(), variables=(Frozen("phi"), Bounded("a", upper=0.5)))
    run = optimise(SCENE, SETTINGS, {"phi": lambda position: position[:, 0] - 0.25}, task=task)
    assert np.array_equal(run.result.x[:32], run.x[:32])
    assert Variables.of(run.x, SCENE).a.tolist() == [0.5, 0.5]
