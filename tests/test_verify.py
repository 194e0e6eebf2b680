"""The checks pass what is right, and fail what is wrong."""

import dataclasses
import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from conftest import small_scene
from fuzz import plausible
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from walker import walker
from wrong_adjoints import GROUND_FAULTS

from mpmopt.assess.verify import (
    DOT_TOLERANCE,
    contact_free,
    dot_product_mismatch,
    report,
    taylor_test,
)
from mpmopt.design.problem import Problem
from mpmopt.errors import DesignError, MpmoptError
from mpmopt.scene import Actuator, Grid, Scene

ROOT = Path(__file__).parent.parent


def test_a_report_passes_on_a_rough_scene(rng):
    scene = small_scene()
    problem = Problem(scene, beta=2.0)
    x = problem.join(rng.uniform(-1.0, 1.0, 32), [0.9, 0.5], [-0.3, 0.2], [-0.5, 0.1])
    checks = report(problem, x)
    assert {check.name.split(":")[0] for check in checks} == {
        "dot product", "complex step", "Taylor order, contact-free",
    }  # fmt: skip
    assert [check for check in checks if not check.passed] == []


@pytest.mark.parametrize("parts", [slice(1, None), slice(0, 3, 2)])
def test_a_report_passes_without_design_or_without_actuators(parts):
    scene = small_scene()
    problem = Problem(dataclasses.replace(scene, body=scene.body[parts]))
    checks = report(problem, problem.join(0.2, 0.9, -0.3, -0.5))
    assert [check for check in checks if not check.passed] == []


def test_a_report_on_a_sharp_stiff_design_knows_what_rounding_does(rng):
    # All steps of the preview's walker, nearly black and white, at beta = 32.
    problem = Problem(walker(64, 8e-4).vary(void_density=1e-2), beta=32.0)
    blocks = problem.particles.position[problem.particles.designed] * 64
    phi = np.where((blocks // 3).astype(int).sum(axis=1) % 2 == 0, 0.2, -0.2)
    checks = report(problem, problem.join(phi, 1.0, -0.7, -1.0))
    assert [check for check in checks if not check.passed] == []


def test_taylor_remainders_fall_with_the_square_of_the_step(rng):
    problem = Problem(contact_free(small_scene()))
    x = problem.join(rng.uniform(-0.5, 0.5, 32), [0.6, 0.5], [-0.3, 0.2], [-0.5, 0.1])
    taylor = taylor_test(problem, x, rng.uniform(-1.0, 1.0, x.size))
    assert taylor.order == pytest.approx(2.0, abs=0.1)
    assert np.all(np.diff(taylor.remainder) < 0.0)


def test_contact_free_windows_touch_nothing():
    scene = contact_free(small_scene(), steps=10)
    assert (scene.walls, scene.gravity, scene.steps) == ((), (0.0, 0.0), 10)


def test_dot_product_of_a_known_matrix(rng):
    matrix = rng.standard_normal((3, 4))

    def mismatch(adjoint):
        return dot_product_mismatch(
            lambda v: {"y": matrix @ v["x"]},
            lambda v, w: {"x": adjoint @ w["y"]},
            {"x": rng.standard_normal(4)},
            rng,
        )

    assert mismatch(matrix.T) <= 1e-15
    assert mismatch(matrix.T + 1e-9) >= 1e-12


def without_jit(*arguments, **more):
    """A Python process with the JIT switched off."""
    environment = {**os.environ, "NUMBA_DISABLE_JIT": "1", "PYTHONPATH": f"{ROOT}:{ROOT}/cases"}
    return subprocess.run(
        [sys.executable, *arguments],
        capture_output=True, text=True, cwd=ROOT, env=environment, timeout=300, **more,
    )  # fmt: skip


@pytest.fixture(scope="module")
def verdicts():
    done = without_jit(ROOT / "tests" / "wrong_adjoints.py")
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)


@pytest.mark.process
def test_the_right_adjoint_passes_all_checks(verdicts):
    assert verdicts["nothing"] == {"dot": True, "complex step": True, "Taylor": True}


@pytest.mark.process
def test_every_wrong_adjoint_fails_every_check_that_can_see_it(verdicts):
    wrong = {name: verdict for name, verdict in verdicts.items() if name != "nothing"}
    assert len(wrong) >= 15
    # Taylor's window has no walls and no ground.
    for name in ("wall forgotten", *GROUND_FAULTS):
        assert wrong.pop(name) == {"dot": False, "complex step": False, "Taylor": True}, name
    # No kernel knows of it.
    forgotten = {"dot": True, "complex step": False, "Taylor": False}
    assert wrong.pop("transient forgotten") == forgotten
    passed = {
        name: [check for check, ok in verdict.items() if ok]
        for name, verdict in wrong.items()
        if any(verdict.values())
    }
    assert passed == {}


@pytest.mark.process
def test_kernels_behave_the_same_without_the_jit():
    done = without_jit("-m", "pytest", "-q", "-p", "no:cacheprovider", "tests/test_kernels.py")
    assert done.returncode == 0, done.stdout


def passes(scene, *x, seed=0):
    """Whether all checks of a scene pass."""
    problem = Problem(scene)
    return [c for c in report(problem, problem.join(*x), seed) if not c.passed] == []


def block(*size, lower=(4, 4), **changes):
    """An actuator alone, of so many cells, without walls and gravity."""
    dx = changes.pop("dx", 1 / 16)
    upper = [a + b for a, b in zip(lower, size)]
    body = (Actuator(tuple(dx * k for k in lower), tuple(dx * k for k in upper)),)
    return small_scene(**{"grid": Grid((16, 16), dx), "body": body, "walls": (), **changes})


def test_a_report_passes_whatever_number_of_particles():
    # No multiple of four: 15 and 1.
    for size in ((5, 3), (1, 1)):
        scene = block(*size, particles_per_cell=1, gravity=(0.3, 0.0), steps=5)
        assert passes(scene, np.zeros(0), 0.9, -0.3, -0.5)


@pytest.mark.parametrize("x", [(np.zeros(0), 0.9, -0.3, -0.5), (np.zeros(0), 0.0, 0.0, 0.0)])
@pytest.mark.parametrize("unit", [1e-3, 1.0, 1e3])
def test_a_report_passes_where_derivatives_are_zero_by_symmetry(x, unit):
    # The block stays where it is whatever its actuator does; or nothing moves at all.
    dx, dt = unit / 16, 4e-3 * unit
    for changes in ({}, {"transient": 3 * dt}, {"steps": 1}):
        scene = block(4, 3, dx=dx, gravity=(0.0, 0.0), **{"time_step": dt, "steps": 12, **changes})
        assert passes(scene, *x)


def test_a_report_passes_on_scenes_of_all_kinds():
    @settings(max_examples=30, deadline=None, database=None, derandomize=True)
    @given(plausible(), st.sampled_from([0.0, 1e-9, 0.5, 1.0]), st.integers(0, 6))
    def check(data, size, seed):
        # Signals that the steps resolve.
        assume(all(r.get("angular_frequency", 0) * data["time_step"] < 3 for r in data["body"]))
        try:
            problem = Problem(Scene.from_json(json.dumps(data)), 2.0)
            x = size * np.random.default_rng(seed).uniform(-1.0, 1.0, problem.size)
            checks = report(problem, x, seed)
        except MpmoptError:
            assume(False)
        assert [check for check in checks if not check.passed] == []

    check()


def test_single_precision_is_not_put_to_the_test():
    problem = Problem(small_scene(steps=2), precision="single")
    with pytest.raises(DesignError, match="precision"):
        report(problem, problem.join(0.0, 0.5, 0.0, 0.0))


@pytest.mark.parametrize("spoilt", [np.nan, np.inf])
def test_what_is_no_number_passes_no_check(spoilt, rng):
    forward, back = (lambda v: {"y": 2.0 * v["x"]}), (lambda v, w: {"x": spoilt * w["y"]})
    mismatch = dot_product_mismatch(forward, back, {"x": np.ones(3)}, rng)
    assert not mismatch <= DOT_TOLERANCE
