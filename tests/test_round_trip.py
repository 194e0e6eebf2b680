"""Every field of what a run is comes back from its file: none may be forgotten."""

import dataclasses
import itertools

import h5py
import numpy as np
import pytest
from conftest import small_scene

from mpmopt.design.problem import Problem
from mpmopt.design.task import AtMost, Task
from mpmopt.design.terms import Effort, OnePiece, Speed, Volume
from mpmopt.design.variation import Variation
from mpmopt.optimisation.history import Candidate, Iteration, Optimisation, StageState
from mpmopt.optimisation.loop import begin
from mpmopt.optimisation.mma import MovingAsymptotes
from mpmopt.optimisation.settings import Settings, Stage
from mpmopt.results import runfile
from mpmopt.scene import Ground, Material, Mirror, Scene, Wall

numbers = itertools.count(2)


def distinct(kind, **given):
    """An instance in which no field has its default and no two fields have the same value."""
    values = dict(given)
    for field in dataclasses.fields(kind):
        if field.name not in values:
            n = next(numbers)
            values[field.name] = {
                "int": lambda n=n: n,
                "int | None": lambda n=n: n,
                "float": lambda n=n: 1.0 / n,
                "float | None": lambda n=n: 1.0 / n,
                "tuple[float, ...]": lambda n=n: (1.0 / n, -float(n)),
                "str": lambda n=n: f"text {n}",
                "bool": lambda field=field: field.default is not True,
                "NDArray[np.float64]": lambda n=n: 1.0 / (n + np.arange(3.0)),
            }[str(field.type)]()
        assert not same(values[field.name], field.default), field.name
    return kind(**values)


def same(one, other):
    """Whether all that two values are is equal, field by field."""
    if type(one) is not type(other):
        return False
    if dataclasses.is_dataclass(one):
        names = [field.name for field in dataclasses.fields(one)]
        return all(same(getattr(one, name), getattr(other, name)) for name in names)
    if isinstance(one, dict):
        return one.keys() == other.keys() and all(same(one[key], other[key]) for key in one)
    if isinstance(one, list | tuple):
        return len(one) == len(other) and all(map(same, one, other))
    if isinstance(one, np.ndarray):
        return np.array_equal(one, other)
    return one == other


def asymptotes():
    """Moving asymptotes after three steps."""
    mma = MovingAsymptotes(-np.ones(3), np.ones(3), move_limit=0.1)
    x = np.zeros(3)
    for k in range(3):
        x = mma.step(x, 0.0, np.array([1.0, (-1.0) ** k, -2.0]))
    return {name: np.asarray(value, dtype=float)[()] for name, value in mma.state().items()}


@pytest.fixture
def run():
    first, second = (distinct(Stage, refined=True, solid=True) for _ in range(2))
    stages = [dataclasses.replace(first, disturbed=None), second]  # the first must not be
    settings = distinct(Settings, stages=tuple(stages), least_iterations=3, most_iterations=5)
    state = distinct(
        StageState, mma=asymptotes(), incumbent=distinct(Candidate),
        gradients=np.ones((3, 3)), incumbent_gradients=np.arange(9.0).reshape(3, 3),
    )  # fmt: skip
    return distinct(
        Optimisation,
        scene=small_scene(),
        settings=settings,
        task=Task(
            Speed(0.01) - 0.5 * Effort(),
            (AtMost(Volume(), 0.5), AtMost(OnePiece(), 1.0)),
            2 * (Variation(friction=0.2, ground=(Ground.floor(0.1),)),),
        ),
        x=np.array([0.5, -0.25]),
        stage=1,
        gave_up=True,
        best={1: distinct(Candidate, stage=1)},
        history=[distinct(Iteration) for _ in range(3)],
        designs=[np.array([k, 255], np.uint8) for k in range(3)],
        first=distinct(Candidate),
        last=distinct(Candidate),
        stage_state=state,
    )


def test_every_field_of_a_run_comes_back_from_its_file(run, tmp_path):
    baseline = np.array([True, False, True])
    runfile.write(tmp_path / "run.h5", run, {"start": 0.25, "a": [1.0, None]}, baseline, True)
    back = runfile.read_run(tmp_path / "run.h5")
    for field in dataclasses.fields(Optimisation):
        assert same(getattr(back.run, field.name), getattr(run, field.name)), field.name
    assert same(back.summary, {"start": 0.25, "a": [1.0, None]})
    assert same(back.baseline, baseline)
    assert back.full_study


def test_every_number_of_an_evaluation_is_a_column_of_the_history(run, tmp_path):
    runfile.write(tmp_path / "run.h5", run)
    with h5py.File(tmp_path / "run.h5") as file:
        assert set(file["history"]) == {field.name for field in dataclasses.fields(Iteration)}


def test_a_run_that_has_nothing_yet_comes_back_too(tmp_path):
    scene = small_scene()
    stage = Stage(1.0, 1e-2, 1e-3, 4e-3)
    run = begin(scene, Settings((stage,)), Problem(scene).join(0.1, 1.0, 0.2, 0.3))
    runfile.write(tmp_path / "run.h5", run)
    assert same(runfile.read_run(tmp_path / "run.h5").run, run)


def test_all_that_moving_asymptotes_remember_is_in_their_state():
    mma = MovingAsymptotes(
        -np.ones(3), np.ones(3), move_limit=0.11, asymptote_initial=0.12, asymptote_increase=1.3,
        asymptote_decrease=0.4, asymptote_min=1e-5, asymptote_max=6.0, raa0=1e-4,
    )  # fmt: skip
    x = np.zeros(3)
    for k in range(4):
        x = mma.step(x, 0.0, np.array([1.0, (-1.0) ** k, -2.0 / (k + 1)]))
    other = MovingAsymptotes(-np.ones(3), np.ones(3))
    other.restore(mma.state())
    slope = np.array([-1.0, 1.0, 3.0])
    assert np.array_equal(other.step(x, 0.0, slope), mma.step(x, 0.0, slope))
    forgotten = {"multipliers", "kkt_residual", "step_size"}  # of the last step, for who asks
    for name, value in vars(mma).items():
        if name not in forgotten:
            assert same(getattr(other, name), value), name


def test_every_field_of_a_scene_comes_back_from_its_text():
    c = 1 / 16
    scene = small_scene(
        material=Material(30.0, 20.0, density=2.0, void_stiffness=0.25, void_density=0.5),
        time_step=5e-4, gravity=(0.0, -3.0),
        walls=(Wall("y", 4 * c, friction=0.25), Wall("x", 13 * c, "above")),
        direction=(0.6, 0.8), particles_per_cell=4, filter_weights=(0.5, 0.1, 0.025),
        filter_length=0.125, transient=8e-3,
    )  # fmt: skip
    defaults = {
        field.name for field in dataclasses.fields(Scene)
        if same(getattr(scene, field.name), field.default)
    }  # fmt: skip
    assert defaults == {"mirror", "ground", "clamps", "formulation"}
    assert same(Scene.from_json(scene.to_json()), scene)
    half = small_scene(
        body=small_scene().body[2:3], walls=(), gravity=(0.0, -1.0), direction=(0.0, 1.0),
        mirror=Mirror("x", 5 * c),
    )  # fmt: skip
    assert same(Scene.from_json(half.to_json()), half)
