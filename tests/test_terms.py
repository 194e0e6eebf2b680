"""Objectives and constraints: values by hand, gradients by the complex step, JSON and back."""

import json
import math
from dataclasses import dataclass

import numpy as np
import pytest
from conftest import small_scene, worst

from mpmopt.assess.verify import complex_step_test, report
from mpmopt.design.driven import Driven
from mpmopt.design.places import Distance, Height, PeakHeight
from mpmopt.design.problem import Problem
from mpmopt.design.task import DEFAULT_TASK, AtMost, Task
from mpmopt.design.term import Adjoints, Outcome, Term
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
        Displacement(region=2),
        Speed(after=0.02),
        Speed(after=0.004, direction=(0.0, 1.0), region=1, period=0.02),
        Height(),
        Height(at=0.024, region=3),
        PeakHeight(after=0.008),
        PeakHeight(region=2),
        Distance((0.3, 0.5)),
        Driven(Displacement()),
        Driven(PeakHeight() - 0.1 * Effort() + Volume()) + 0.5 * Driven(Speed(0.02)),
        Distance((0.31, 0.42), at=0.02, region=2) + Distance((0.3, 0.5), region=1),
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


def test_what_no_actuator_earns_is_not_driven(x):
    problem = Problem(SCENE, 2.0, task=Task(Driven(Displacement())))
    plain, variables = Problem(SCENE, 2.0), problem.split(x)
    still = problem.join(variables.phi, 0.0, variables.theta, 0.0)
    assert problem.value(still) == 0.0
    assert problem.value(x) == pytest.approx(plain.value(x) - plain.value(still), abs=1e-15)
    assert np.any(plain.evaluate(still).gradient[:32] != 0.0)
    assert problem.evaluate(still).gradient[:32] == pytest.approx(0.0, abs=1e-15)


def test_a_driven_term_is_of_what_is_simulated(x):
    problem = Problem(SCENE, 2.0, void_cutoff=0.5, task=Task(Driven(Displacement())))
    there = problem.present(problem.split(x).phi)
    assert 16 < there.sum() < there.size
    assert worst(complex_step_test(problem, x)) <= 1e-12


def still(term: Term, rows: dict[int, tuple[float, float]]) -> float:
    """The value of a term of a body that is moved as a whole, by so much at steps."""
    simulation = Problem(SCENE).simulation(Problem(SCENE).join(0.0, 0.5, 0.0, 0.0))
    states = {step: simulation.initial.copy() for step in rows}
    for step, moved in rows.items():
        states[step][:2] += np.array(moved)[:, None]
    return term.value(Outcome(simulation, np.zeros(32), states))


def test_a_region_is_where_its_rectangle_is():
    beam, wide = (5 * C, 6.5 * C), (6.5 * C, 6.5 * C)  # centres of regions 2 and 3
    for region, (x, y) in ((2, beam), (3, wide)):
        moved = {12: (0.1, 0.2)}
        assert still(Displacement(region=region), moved) == pytest.approx(x + 0.1)
        assert still(Height(region=region), moved) == pytest.approx(y + 0.2)
        near = Distance((x + 0.1 - 0.3, y + 0.2 - 0.4), region=region)
        assert still(near, moved) == pytest.approx(0.5, abs=1e-3)
        there = Distance((x + 0.1, y + 0.2), region=region)
        assert still(there, moved) == pytest.approx(0.0, abs=1e-12)
    assert still(Height(at=0.02), {5: (0.0, 0.1), 12: (0.0, 9.0)}) == pytest.approx(6.5 * C + 0.1)


def test_a_peak_is_the_highest_instant_and_not_more():
    height = 3 * C
    soft = 0.01 * height
    level = {step: (0.0, 0.25) for step in range(13)}
    assert still(PeakHeight(), level) == pytest.approx(6.5 * C + 0.25, abs=1e-14)
    bump = {**level, 7: (0.0, 0.75)}
    peak = still(PeakHeight(), bump)
    assert peak == pytest.approx(6.5 * C + 0.75 - soft * math.log(13), abs=1e-12)
    assert still(PeakHeight(after=0.03), bump) == pytest.approx(6.5 * C + 0.25, abs=1e-14)


def test_means_over_a_period_leave_no_trace_of_an_oscillation():
    scene = small_scene(steps=100, time_step=2e-3)
    simulation = Problem(scene).simulation(Problem(scene).join(0.0, 0.5, 0.0, 0.0))
    term = Speed(after=0.02, period=0.064)
    states = {step: simulation.initial.copy() for step in {*term.instants(scene), 100}}
    for step, state in states.items():
        t = 2e-3 * step
        state[0] += (
            0.3 * t
            + 0.1 * np.sin(2 * np.pi * t / 0.064 + 0.7)
            + 0.05 * np.cos(6 * np.pi * t / 0.064)
        )
    outcome = Outcome(simulation, np.zeros(32), states)
    assert term.value(outcome) == pytest.approx(0.3, rel=1e-12)
    assert abs(Speed(after=0.02).value(outcome) - 0.3) > 0.1


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
    made[Distance] = Distance((0.5, 0.25), at=0.5, region=2)
    made[Driven] = Driven(Speed(0.25))
    made[Sum] = Sum(((1.0, Speed(0.25)), (-0.5, Sum(((2.0, Effort()),)))))
    for kind in TERMS:
        term = made.get(kind) or kind()
        task = Task(term, (AtMost(Volume(), 0.4), AtMost(term, -1.0)))
        assert Task.from_json(task.to_json()) == task
    assert Task.from_json(DEFAULT_TASK.to_json()) == Task()


@dataclass(frozen=True)
class Corner(Term):
    """How high the first particle ends: a term of one's own."""

    def value(self, outcome):
        return outcome.states[outcome.end][1, 0]

    def adjoints(self, outcome):
        bar = np.zeros(outcome.states[outcome.end].shape)
        bar[1, 0] = 1.0
        return Adjoints({outcome.end: bar})


def test_an_own_term_needs_two_methods(x):
    problem = Problem(SCENE, 2.0, task=Task(Displacement(), (AtMost(Corner(), 0.3),)))
    assert worst(complex_step_test(problem, x, directions=1)) <= 1e-12
    with pytest.raises(DesignError, match=r"Corner is not known to run files: .*terms\.py"):
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
        (lambda: Speed(period=-1.0), "period = -1 must not be negative"),
        (lambda: Driven(0.4), "term = 0.4 .* class Term; such as"),
        (lambda: Height(at=-1.0), "Height: at = -1 must not be negative"),
        (lambda: Height(region=-1), "region = -1 must"),
        (lambda: Displacement(region=1.5), "region = 1.5 must be a whole number"),
        (lambda: Distance(0.5), "target = 0.5"),
        (lambda: Problem(SCENE, task=Task(Height(region=4))), "region = 4 must .* from 0 to 3"),
        (lambda: Problem(SCENE, task=Task(Speed(region=0))), "region 0 is a Design .* name a S"),
        (lambda: Problem(SCENE, task=Task(Distance((0, 0), at=1.0))), "at = 1 is after .* 0.048"),
        (
            lambda: Problem(SCENE, task=Task(Speed(0.012, period=0.02))),
            "after = 0.012 and two periods of 0.02 takes all",
        ),
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
        (lambda: Task.from_json('{"kind": "os"}'), "kind = 'os' must be one of AtMost, Bou"),
        (
            lambda: Task.from_json('{"kind": "Task", "minimise": 3}'),
            "no field minimise; did you mean maximise",
        ),
    ],
)
def test_what_makes_no_sense_is_named(make, says):
    with pytest.raises(ValueError, match=says):
        make()


def test_json_holds_numbers_and_names_only():
    task = Task(Speed(0.5), (AtMost(Volume(), 0.4),))
    assert json.loads(task.to_json()) == {
        "kind": "Task",
        "maximise": {
            "kind": "Speed",
            "after": 0.5,
            "direction": None,
            "region": None,
            "period": 0.0,
        },
        "subject_to": [{"kind": "AtMost", "term": {"kind": "Volume"}, "bound": 0.4}],
        "scenes": [],
        "soft_minimum": 0.0,
        "variables": [],
    }
