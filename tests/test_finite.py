"""What is not finite never reaches the optimiser: the evaluation has failed, and says why."""

import numpy as np
import pytest
from conftest import small_scene

from mpmopt.design.evaluation import Evaluation
from mpmopt.design.objective import Objective
from mpmopt.design.problem import Problem
from mpmopt.errors import DesignError
from mpmopt.optimisation.loop import optimise
from mpmopt.optimisation.mma import MMAError, MovingAsymptotes
from mpmopt.optimisation.settings import Settings, Stage
from mpmopt.simulation.indicators import Indicators

SETTINGS = Settings(
    (Stage(1.0, 1e-2, 1e-3, 4e-3),), window=2, least_iterations=4, most_iterations=4
)
START = (0.0, 1.0, -0.3, -0.5)


@pytest.fixture
def spoil(monkeypatch):
    """Let some results of a method, by their number, hold something that is not finite."""

    def install(owner, name, numbers, value):
        real, calls = getattr(owner, name), []

        def method(*arguments):
            calls.append(arguments)
            result = real(*arguments)
            if len(calls) - 1 in numbers:
                result = value if np.ndim(result) == 0 else np.where(result == 0.0, result, value)
            return result

        monkeypatch.setattr(owner, name, method)
        return calls

    return install


@pytest.fixture
def steps(monkeypatch):
    """What the moving asymptotes were given."""
    real, given = MovingAsymptotes.step, []

    def step(self, x, f, dfdx):
        given.append((f, dfdx))
        return real(self, x, f, dfdx)

    monkeypatch.setattr(MovingAsymptotes, "step", step)
    return given


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("method", ["value", "centroid_adjoint"])
def test_an_evaluation_that_is_not_finite_is_a_failed_one(spoil, steps, method, value):
    scene = small_scene(steps=20)
    # Each evaluation is tried with three steps, the third of them all in vain.
    spoil(Objective, method, {2, 3, 4}, value)
    with np.errstate(invalid="ignore"):
        run = optimise(scene, SETTINGS, Problem(scene).join(*START))
    assert [bool(item.failure) for item in run.history] == [False, False, True, False, False]
    assert "results are not finite" in run.history[2].failure
    assert np.isnan(run.history[2].objective)
    assert len(steps) == 4
    for f, dfdx in steps:
        assert np.isfinite(f)
        assert np.all(np.isfinite(dfdx))
    assert np.isfinite(run.result.objective)


def test_if_none_is_finite_there_is_no_result(spoil, steps):
    scene = small_scene(steps=20)
    spoil(Objective, "centroid_adjoint", range(100), np.nan)
    run = optimise(scene, SETTINGS, Problem(scene).join(*START))
    assert steps == []
    assert "gave up" in run.stop_reason
    with pytest.raises(DesignError, match="not finite"):
        _ = run.result


@pytest.mark.parametrize(("value", "entry"), [(np.nan, 0.0), (0.0, np.inf)])
def test_moving_asymptotes_refuse_what_a_wrong_problem_gives(monkeypatch, value, entry):
    # Problem never returns this; if it did, the run would end, not go astray.
    def evaluate(self, x):
        return Evaluation(value, np.full(x.size, entry), Indicators(), self.scene.time_step)

    monkeypatch.setattr(Problem, "evaluate", evaluate)
    scene = small_scene(steps=20)
    with np.errstate(invalid="ignore"), pytest.raises(MMAError, match=r"nan|inf"):
        optimise(scene, SETTINGS, Problem(scene).join(*START))
