"""Objectives and constraints: values by hand, gradients by the complex step, JSON and back."""

import json
import math
from dataclasses import dataclass

import numpy as np
import pytest
from conftest import small_scene, worst

from mpmopt.assess.verify import complex_step_test, report
from mpmopt.design.problem import Problem
from mpmopt.design.task import DEFAULT_TASK, AtMost, Task
from mpmopt.design.term import Adjoints, Term
from mpmopt.design.terms import TERMS, Displacement, Effort, OnePiece, Speed, Sum, Volume
from mpmopt.errors import DesignError
from mpmopt.scene import Actuator, Design, Grid, Scene, Solid

SCENE = small_scene(steps=12)
C = 1 / 16


@pytest.fixture
def x(rng):
    problem = Problem(SCENE)
    return problem.join(rng.uniform(-0.8, 0.8, 32), [0.9, 0.5], [-0.3, 0.2], [-0.1, 0.1])


@pytest.mark.parametrize(
    "term",
    [
        Displacement(direction=(0.6, 0.8)),
        Speed(after=0.02),
        Effort(),
        Volume(),
        OnePiece(),
        Displacement() - 0.3 * Effort() + 2.0 * Speed(0.016, (0.0, 1.0)),
    ],
    ids=str,
)
def test_the_gradient_of_a_term_is_exact(term, x):
    problem = Problem(SCENE, 2.0, task=Task(term))
    assert worst(complex_step_test(problem, x)) <= 1e-12


def test_gradients_of_constraints_are_exact_whatever_they_look_at(x):
    terms = Speed(0.02), Effort(), Volume(), OnePiece(), Displacement((0.0, 1.0))
    problem = Problem(SCENE, 2.0, task=Task(subject_to=[AtMost(term, 0.3) for term in terms]))
    errors = complex_step_test(problem, x, directions=1)
    assert len(errors) == (1 + 3 * 2) * (1 + len(terms))
    assert worst(errors) <= 1e-12
    evaluation = problem.evaluate(x)
    assert np.array_equal(evaluation.constraints, problem.constraints(x))
    for term, value, row in zip(terms, evaluation.constraints, evaluation.jacobian, strict=True):
        alone = Problem(SCENE, 2.0, task=Task(term)).evaluate(x)
        assert (value, row.tolist()) == (alone.value, alone.gradient.tolist())
    plain = Problem(SCENE, 2.0).evaluate(x)
    assert (evaluation.value, evaluation.gradient.tolist()) == (
        plain.value,
        plain.gradient.tolist(),
    )


@pytest.mark.parametrize("every", [1, "all", 250])
def test_two_adjoint_sweeps_take_what_is_stored(every, x):
    from mpmopt.simulation.checkpoints import Checkpointing

    task = Task(subject_to=(AtMost(Speed(0.02), 0.3), AtMost(Displacement((0.0, 1.0)), 0.3)))
    problem = Problem(SCENE, 2.0, Checkpointing(every), task=task)
    assert worst(complex_step_test(problem, x, directions=1)) <= 1e-12


def test_verify_checks_constraints(x):
    task = Task(subject_to=(AtMost(Volume(), 0.5), AtMost(Effort(), 1.0)))
    checks = report(Problem(SCENE, 2.0, task=task), x)
    assert all(check.passed for check in checks)
    names = [check.name for check in checks]
    assert "complex step: a of actuator 1, Effort()" in names
    assert "complex step: phi along direction 0, Volume()" in names


def test_verify_finds_a_wrong_adjoint_of_a_constraint(x, monkeypatch):
    right = OnePiece.adjoints

    def wrong(self, outcome):
        return Adjoints(gamma=1.001 * right(self, outcome).gamma)

    monkeypatch.setattr(OnePiece, "adjoints", wrong)
    checks = report(Problem(SCENE, 2.0, task=Task(subject_to=(AtMost(OnePiece(), 1.0),))), x)
    assert {check.name.split(", ")[-1] for check in checks if not check.passed} == {"OnePiece()"}


def test_values_are_those_by_hand(x):
    problem = Problem(SCENE, 2.0)
    variables = problem.split(x)
    gamma = problem.gamma(x)
    signals = np.array([
        variables.a * np.sin(np.array([30.0, 50.0]) * step * 4e-3 + np.pi * variables.theta)
        + variables.b
        for step in range(12)
    ])  # fmt: skip

    def value(term):
        return Problem(SCENE, 2.0, task=Task(term)).value(x)

    assert value(Volume()) == pytest.approx(np.mean(gamma), rel=1e-14)
    assert value(Effort()) == pytest.approx(np.mean(signals**2), rel=1e-14)
    assert value(Displacement()) == problem.value(x)
    part = small_scene(steps=12, transient=5 * 4e-3)
    start = Problem(part, 2.0).value(x) - 7 * 4e-3 * value(Speed(after=5 * 4e-3))
    corner = np.mean([3 * C, 7 * C])  # the middle of beam and actuators
    assert start == pytest.approx(corner, abs=1e-14)
    whole = value(Displacement() - 0.5 * Effort())
    assert whole == pytest.approx(problem.value(x) - 0.5 * value(Effort()), abs=1e-15)


def beam(*regions) -> Scene:
    """A row of cells that are designed under a beam, of one particle each."""
    return Scene(Grid((16, 16), C), 4e-3, 4, regions, particles_per_cell=1)


def test_heat_of_one_particle_flows_through_one_edge():
    scene = beam(Design((4 * C, 4 * C), (5 * C, 5 * C)), Solid((4 * C, 5 * C), (5 * C, 6 * C)))
    problem = Problem(scene, task=Task(OnePiece()))
    x = problem.join(0.4, [], [], [])
    (gamma,) = problem.gamma(x)
    # (k + (1 - k) gamma) T = gamma, and the compliance of the full one is 1.
    assert problem.value(x) == pytest.approx(
        math.log(gamma**2 / (1e-3 + (1 - 1e-3) * gamma) + 1e-12), rel=1e-12
    )


def test_heat_in_a_column_is_that_of_a_bar():
    scene = beam(Design((4 * C, 4 * C), (5 * C, 9 * C)), Solid((4 * C, 9 * C), (5 * C, 10 * C)))
    problem = Problem(scene, task=Task(OnePiece()))
    n = 5
    # T_j = sum of the flows below, so sum T = 1^2 + ... + n^2; half of gamma conducts a quarter.
    assert sum(k * k for k in range(1, n + 1)) == n * (n + 1) * (2 * n + 1) / 6
    x = problem.join(0.0, [], [], [])
    assert problem.gamma(x) == pytest.approx(0.5)
    inner, last = (1e-3 + (1 - 1e-3) * g for g in (0.25, 0.5))
    expected = 0.25 * (sum(k * k for k in range(1, n)) / inner + n * n / last) / 55
    assert problem.value(x) == pytest.approx(math.log(expected + 1e-12), rel=1e-12)


def test_a_loose_piece_is_told_from_one_that_hangs_together():
    scene = small_scene(particles_per_cell=4)
    problem = Problem(scene, 32.0, task=Task(OnePiece()))
    height = problem.particles.position[problem.particles.designed][:, 1]
    side = problem.particles.position[problem.particles.designed][:, 0]

    def value(there):
        return problem.value(problem.join(np.where(there, 1.0, -1.0), 0.0, 0.0, 0.0))

    assert value(height > 0.0) == pytest.approx(0.0, abs=1e-9)
    assert value(height < 0.0) < -20.0  # nothing is there, and nothing is loose
    assert value(side < 5 * C) < math.log(4.0)
    assert value((height < 4.5 * C) | (height > 5.5 * C)) > math.log(4.0)


@pytest.mark.parametrize(
    ("regions", "says"),
    [
        ((Design((4 * C, 4 * C), (5 * C, 5 * C)),), "no Design touches"),
        (
            (
                Design((4 * C, 4 * C), (5 * C, 5 * C)),
                Design((4 * C, 6 * C), (5 * C, 7 * C)),
                Actuator((4 * C, 5 * C), (5 * C, 6 * C)),
                Design((8 * C, 5 * C), (9 * C, 6 * C)),
            ),
            "apart from all",
        ),
    ],
)
def test_a_design_that_can_hang_on_nothing_is_named(regions, says):
    problem = Problem(
        beam(*regions, Solid((11 * C, 9 * C), (12 * C, 10 * C))), task=Task(OnePiece())
    )
    with pytest.raises(DesignError, match=says):
        problem.value(problem.join(0.2, 0.1, 0.0, 0.0))


def test_every_term_comes_back_from_json():
    made = {Displacement: Displacement((0.6, 0.8)), Speed: Speed(0.5, (0.0, -1.0))}
    made[Sum] = Sum(((1.0, Speed(0.25)), (-0.5, Sum(((2.0, Effort()),)))))
    for kind in TERMS:
        term = made.get(kind) or kind()
        task = Task(term, (AtMost(Volume(), 0.4), AtMost(term, -1.0)))
        assert Task.from_json(task.to_json()) == task
    assert Task.from_json(DEFAULT_TASK.to_json()) == Task()


@dataclass(frozen=True)
class Height(Term):
    """How high the first particle ends: a term of one's own."""

    def value(self, outcome):
        return outcome.states[outcome.end][1, 0]

    def adjoints(self, outcome):
        bar = np.zeros(outcome.states[outcome.end].shape)
        bar[1, 0] = 1.0
        return Adjoints({outcome.end: bar})


def test_an_own_term_needs_two_methods(x):
    problem = Problem(SCENE, 2.0, task=Task(Displacement(), (AtMost(Height(), 0.3),)))
    assert worst(complex_step_test(problem, x, directions=1)) <= 1e-12
    with pytest.raises(DesignError, match=r"Height is not known to run files: .*terms\.py"):
        problem.task.to_json()


@pytest.mark.parametrize(
    ("make", "says"),
    [
        (lambda: Task(0.4), "maximise = 0.4 .* class Term; such as"),
        (lambda: Task(subject_to=0.4), "subject_to = 0.4 .* class AtMost"),
        (lambda: Task(subject_to=Volume()), "class AtMost; such as"),
        (lambda: AtMost(0.4, Volume()), "term = 0.4 .* class Term"),
        (lambda: AtMost(Volume(), np.nan), "bound = nan must be finite"),
        (lambda: Displacement((1.0, 1.0)), r"has length 1.41421, must have 1"),
        (lambda: Speed(after=-1.0), "after = -1 must not be negative"),
        (lambda: Speed(after="late"), "after = 'late' must be a number"),
        (lambda: Sum(()), r"terms = \(\) must be pairs"),
        (lambda: Sum(((1.0, 2.0),)), "must be pairs"),
        (lambda: Sum(5), "must be pairs"),
        (lambda: Sum((("x", Volume()),)), "weight = 'x' must be a number"),
        (lambda: Problem(SCENE, task=Volume()), "task = .* class Task"),
        (lambda: Problem(SCENE, task=Task(Speed(after=1.0))), "takes all of the scene's 0.048"),
        (lambda: Task.from_json("no"), "is no task"),
        (lambda: Task.from_json("3"), "text = 3 .* class Task"),
        (lambda: Task.from_json('{"kind": "Speed"}'), "class Task"),
        (lambda: Task.from_json('{"kind": "os"}'), "kind = 'os' must be one of AtMost, Disp"),
        (lambda: Task.from_json('{"kind": "Task", "minimise": 3}'), "unexpected keyword"),
    ],
)
def test_what_makes_no_sense_is_named(make, says):
    with pytest.raises(ValueError, match=says):
        make()


def test_json_holds_numbers_and_names_only():
    task = Task(Speed(0.5), (AtMost(Volume(), 0.4),))
    assert json.loads(task.to_json()) == {
        "kind": "Task",
        "maximise": {"kind": "Speed", "after": 0.5, "direction": None},
        "subject_to": [{"kind": "AtMost", "term": {"kind": "Volume"}, "bound": 0.4}],
        "scenes": [],
        "soft_minimum": 0.0,
    }
