"""Fixtures of all tests; numpy errors raise."""

from collections.abc import Iterator

import numpy as np
import pytest

from mpmopt.design.problem import Problem
from mpmopt.optimisation.loop import begin, optimise
from mpmopt.optimisation.settings import Settings, Stage
from mpmopt.results import runfile
from mpmopt.scene import Actuator, Design, Grid, Material, Scene, Solid, Wall


@pytest.fixture(autouse=True)
def numpy_errors_raise() -> Iterator[None]:
    with np.errstate(divide="raise", over="raise", invalid="raise"):
        yield


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(20260101)


def small_scene(**changes) -> Scene:
    """A walker of 48 particles with two actuators, on a floor with friction and beside a wall."""
    c = 1 / 16
    scene = {
        "grid": Grid(cells=(16, 16), dx=c),
        "time_step": 4e-3,
        "steps": 40,
        "material": Material(void_density=1e-2, void_stiffness=1e-3),
        "gravity": (0.5, -10.0),
        "walls": (Wall("y", 4 * c, friction=0.3), Wall("x", 3 * c)),
        "body": (
            Design((3 * c, 4 * c), (7 * c, 6 * c)),
            Actuator((3 * c, 6 * c), (4 * c, 7 * c), stress=((2.0, 0.5), (0.5, 1.0))),
            Solid((4 * c, 6 * c), (6 * c, 7 * c)),
            Actuator((6 * c, 6 * c), (7 * c, 7 * c), angular_frequency=50.0),
        ),
    }
    return Scene(**{**scene, **changes})


def worst(test) -> float:
    """The largest error of a `complex_step_test`."""
    return max(result.error for result in test.values())


@pytest.fixture
def scene() -> Scene:
    return small_scene()


SHORT = Settings(
    (Stage(4.0, 1e-2, 1e-3, 4e-3, solid=True),), window=1, least_iterations=2, most_iterations=2
)


@pytest.fixture(scope="session")
def short_path(tmp_path_factory):
    """The run file of two evaluations of the small scene."""
    scene = small_scene()
    path = tmp_path_factory.mktemp("short") / "run.h5"
    runfile.write(path, optimise(scene, SHORT, Problem(scene).join(0.3, 1.0, -0.3, -0.5)))
    return path


@pytest.fixture(scope="session")
def short_run(short_path):
    return runfile.read_run(short_path).run


def empty(scene: Scene):
    """A run of a scene before its first evaluation."""
    return begin(scene, SHORT, Problem(scene).join(0.3, 1.0, -0.3, -0.5))
