"""Objective and gradient of the whole chain."""

import dataclasses
from typing import Any

import numpy as np
import pytest
from conftest import small_scene, worst
from walker import walker

from mpmopt.assess.threshold import best_actuated, distance, pieces, post_processed, solid_reference
from mpmopt.assess.verify import COMPLEX_STEP, COMPLEX_TOLERANCE, complex_step_test
from mpmopt.design.objective import Objective
from mpmopt.design.problem import Problem
from mpmopt.errors import DesignError, SimulationError
from mpmopt.simulation.checkpoints import Checkpointing


@pytest.fixture
def problem(scene):
    return Problem(scene, beta=2.0)


@pytest.fixture
def x(problem, rng):
    return problem.join(rng.uniform(-0.8, 0.8, 32), [0.9, 0.5], [-0.3, 0.2], [-0.5, 0.1])


def test_gradient_of_the_preview_walker_over_all_its_steps(rng):
    problem = Problem(walker(64, 8e-4).vary(void_density=1e-2, void_stiffness=1e-3), beta=2.0)
    x = problem.join(rng.uniform(-1.0, 1.0, problem.size - 3), 0.9, -0.3, -0.5)
    errors = complex_step_test(problem, x)
    assert set(errors) == {
        "phi along direction 0", "phi along direction 1",
        "a of actuator 0", "theta of actuator 0", "b of actuator 0",
    }  # fmt: skip
    assert worst(errors) <= COMPLEX_TOLERANCE
    # The complex run's real part is the run itself.
    value, _ = problem.value_and_gradient(x)
    assert problem.value(x + 1j * COMPLEX_STEP).real == pytest.approx(value, rel=1e-14)


@pytest.mark.parametrize("beta", [0.5, 8.0])
def test_gradient_with_friction_two_walls_and_two_actuators(problem, x, beta):
    problem = Problem(problem.scene, beta)
    assert worst(complex_step_test(problem, x, directions=3)) <= COMPLEX_TOLERANCE


def test_gradient_in_a_slanted_direction_and_three_particles_a_cell():
    scene = small_scene(direction=(0.6, -0.8), particles_per_cell=3)
    problem = Problem(scene)
    x = problem.join(0.1, [0.9, 0.5], [-0.3, 0.2], [-0.5, 0.1])
    assert worst(complex_step_test(problem, x)) <= COMPLEX_TOLERANCE


@pytest.mark.parametrize("first", [1, 7, 20, 29])
def test_after_a_transient_only_what_follows_counts_and_the_gradient_is_exact(first, x):
    scene = small_scene(steps=30, direction=(0.6, -0.8))
    whole = Problem(scene, beta=2.0)
    part = Problem(dataclasses.replace(scene, transient=first * scene.time_step), beta=2.0)
    simulation = whole.simulation(x)
    start, before, end = map(
        Objective.of(scene, simulation.particles).centroid, simulation.run([0, first, 30])
    )
    value, gradient = part.value_and_gradient(x)
    assert value == part.value(x) == pytest.approx(end - before + start, abs=1e-15)
    assert abs(value - whole.value(x)) > 1e-5
    assert worst(complex_step_test(part, x)) <= COMPLEX_TOLERANCE
    assert part.at(scene.time_step / 2.0).value(x) == pytest.approx(value, abs=1e-2)
    single = Problem(part.scene, 2.0, precision="single").value_and_gradient(x)[1]
    assert np.linalg.norm(single - gradient) <= 1e-4 * np.linalg.norm(gradient)
    for every in (1, 7, 10, "all"):
        other = Problem(part.scene, 2.0, Checkpointing(every, store="memory"))
        assert np.array_equal(other.value_and_gradient(x)[1], gradient)


def test_void_that_is_left_out_is_not_simulated_and_the_gradient_stays_exact(problem, x):
    gamma = problem.gamma(x)
    void_cutoff = float(np.median(gamma))
    part = Problem(problem.scene, problem.chain.beta, void_cutoff=void_cutoff)
    simulation = part.simulation(x)
    fewer = (gamma < void_cutoff).sum()
    assert len(simulation.particles.position) == len(part.particles.position) - fewer
    assert 10 <= fewer < gamma.size
    assert worst(complex_step_test(part, x, directions=3)) <= COMPLEX_TOLERANCE
    # Void that weighs nothing does nothing; left out, it changes nothing.
    light = problem.scene.vary(void_density=1e-9, void_stiffness=1e-9)
    sharp = problem.join(np.where(gamma > void_cutoff, 1.0, -1.0), [0.9, 0.5], 0.2, 0.1)
    with_void = Problem(dataclasses.replace(light, steps=5), 32.0)
    without = Problem(dataclasses.replace(light, steps=5), 32.0, void_cutoff=1e-4)
    assert without.simulation(sharp).initial.size < with_void.simulation(sharp).initial.size
    assert without.value(sharp) == pytest.approx(with_void.value(sharp), rel=1e-7)


@pytest.mark.parametrize("wrong", [np.nan, -1.0, 1.0, "a"])
def test_a_senseless_limit_of_what_is_left_out_is_refused(scene, wrong):
    with pytest.raises(DesignError, match="void_cutoff"):
        Problem(scene, void_cutoff=wrong)


def test_value_is_that_of_value_and_gradient(problem, x):
    value, gradient = problem.value_and_gradient(x)
    assert problem.value(x) == value
    assert gradient.shape == x.shape
    assert problem.value_and_gradient(x)[0] == value


def test_the_gradient_points_uphill(problem, x):
    value, gradient = problem.value_and_gradient(x)
    step = 1e-4 * gradient / np.abs(gradient).max()
    assert problem.value(np.clip(x + step, -1, 1)) > value > problem.value(np.clip(x - step, -1, 1))


def test_a_body_at_rest_stays_where_it_is():
    scene = small_scene(gravity=(0.0, 0.0), walls=())
    problem = Problem(scene)
    x = problem.join(0.3, 0.0, 0.2, 0.0)
    value, gradient = problem.value_and_gradient(x)
    c = 1 / 16
    assert value == pytest.approx(5 * c, rel=1e-14)  # centre of the row above the design domain
    theta = problem.split(gradient).theta
    assert np.all(theta == 0.0)  # with a = 0 the phase does not matter


def test_a_scene_without_actuators_still_has_a_gradient():
    scene = small_scene()
    scene = dataclasses.replace(scene, body=(scene.body[0], scene.body[2]))
    problem = Problem(scene, beta=1.0)
    x = problem.join(np.linspace(-0.5, 0.5, 32), 0.0, 0.0, 0.0)
    assert problem.size == 32
    assert worst(complex_step_test(problem, x)) <= COMPLEX_TOLERANCE


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (lambda x: x[:-1], r"\(37,\).*\(38,\)"),
        (lambda x: np.where(np.arange(x.size) == 4, np.nan, x), r"1 of 38 .* x\[4\] = nan"),
        (lambda x: np.where(np.arange(x.size) == 5, 1.1, x), r"1 of 38 .* x\[5\] = 1.1"),
        (lambda x: x[:, None], r"\(38, 1\)"),
    ],
)
def test_designs_that_do_not_fit_are_refused(problem, x, change, says):
    for function in (problem.value, problem.value_and_gradient, problem.gamma):
        with pytest.raises(DesignError, match=says):
            function(change(x))


def test_whole_and_single_precision_numbers_are_designs_too(problem):
    x = problem.join(0.0, 1.0, 0.0, -1.0)
    expected = problem.value_and_gradient(x)
    for other in (x.astype(int), x.astype(np.float32), list(x)):
        assert problem.value(other) == expected[0]
        assert np.array_equal(problem.value_and_gradient(other)[1], expected[1])
    assert np.array_equal(problem.join(0, 1, 0, -1), x)


@pytest.mark.parametrize("value", ["a", 1j, None, np.zeros(3), np.zeros((32, 1))])
def test_variables_that_are_no_real_numbers_of_the_right_shape_are_refused(problem, value):
    with pytest.raises(DesignError, match="phi"):
        problem.join(value, 0.0, 0.0, 0.0)


def test_a_gradient_at_a_complex_design_is_refused(problem, x):
    with pytest.raises(DesignError, match="complex128, must hold real"):
        problem.value_and_gradient(x + 0j)
    with pytest.raises(DesignError, match="must hold real"):
        problem.value(np.array(["a"] * x.size))


@pytest.mark.parametrize("wrong", ["half", None, 64])
def test_a_precision_that_does_not_exist_is_refused_at_once(scene, wrong):
    with pytest.raises(DesignError, match='"double" or "single"'):
        Problem(scene, precision=wrong)


@pytest.mark.parametrize("value", [[[1.0], [1.0, 2.0]], 32 * [10**400], {}])
def test_what_is_no_array_of_numbers_is_refused(problem, value):
    with pytest.raises(DesignError, match=r"x (is no array|holds object)"):
        problem.value(value)
    with pytest.raises(DesignError, match=r"phi (is no array|holds object)"):
        problem.join(value, 0.0, 0.0, 0.0)


def test_masked_entries_have_no_value(problem):
    hidden = np.ma.masked_less(np.zeros(problem.size), 1.0)
    with pytest.raises(DesignError, match="x has masked entries"):
        problem.value(hidden)
    assert problem.value(np.ma.array(np.zeros(problem.size))) == problem.value(np.zeros(38))


def test_pieces_that_hang_on_nothing_are_numbered(problem):
    position = problem.particles.position[problem.particles.designed] * 32  # in spacings
    x, y = position.T
    column = (x > 6) & (x < 7)
    assert set(pieces(problem.scene, column)[column]) == {0}  # reaches up to the actuator
    low = y < 9
    assert np.array_equal(pieces(problem.scene, low), np.where(low, 1, -1))
    two = low & ((x < 8) | (x > 12))
    assert np.array_equal(np.unique(pieces(problem.scene, two)), [-1, 1, 2])
    assert set(pieces(problem.scene, low | column)) == {-1, 0}
    everything = np.ones(32, dtype=bool)
    assert np.all(pieces(problem.scene, everything) == 0)
    assert np.all(pieces(problem.scene, ~everything) == -1)


def test_a_result_that_is_not_finite_never_leaves(problem, x, monkeypatch):
    monkeypatch.setattr("mpmopt.design.objective.Objective.value", lambda *_: np.nan)
    with pytest.raises(SimulationError, match="1 of 1 results are not finite"):
        problem.value_and_gradient(x)


def test_a_black_design_without_its_void_is_the_solid_body(problem):
    black = problem.join(1.0, [0.9, 0.5], [-0.3, 0.2], [-0.5, 0.1])
    everything = np.ones(32, dtype=bool)
    value = distance(problem.scene, everything, problem.split(black))
    assert problem.value(black) == pytest.approx(value, rel=1e-13)
    assert post_processed(problem, black) == pytest.approx(value, rel=1e-13)
    still, moving = (problem.split(problem.join(0.0, a, -0.3, 0.0)) for a in (0.0, 0.9))
    values = [best_actuated(problem.scene, solid_reference, v) for v in (still, moving)]
    assert best_actuated(problem.scene, solid_reference, still, moving) == max(values)
    assert distance(problem.scene, everything, moving) == values[1]


def test_a_design_is_transferred_to_another_grid_as_it_looks():
    coarse = Problem(walker(64, 8e-4))
    fine = Problem(walker(128, 4e-4))
    centre = coarse.particles.position[coarse.particles.designed] - [13 / 64, 7.5 / 64]
    phi = np.where(np.hypot(*centre.T) < 4 / 64, 1.0, -1.0)
    x = fine.transfer(coarse, coarse.join(phi, 0.9, -0.3, -0.5))
    parts = fine.split(x)
    assert [*parts.a, *parts.theta, *parts.b] == [0.9, -0.3, -0.5]
    assert parts.phi.size == 4 * phi.size
    assert parts.phi.mean() == pytest.approx(phi.mean(), abs=1e-14)
    assert np.array_equal(coarse.split(coarse.transfer(fine, x)).phi, phi)


def test_removing_void_keeps_what_is_above_the_threshold(problem):
    half = np.where(np.arange(32) < 16, 1.0, -1.0)
    x = problem.join(half, [0.9, 0.5], [-0.3, 0.2], [-0.5, 0.1])
    gamma = problem.gamma(x)
    expected = distance(problem.scene, gamma >= 0.3, problem.split(x))
    assert post_processed(problem, x) == expected
    assert post_processed(problem, x, threshold=gamma.min()) != expected
    senseless: Any
    for senseless in (0.0, 1.0, 2.0, -0.3, np.nan, "0.3"):
        with pytest.raises(DesignError, match="must be between 0 and 1"):
            post_processed(problem, x, senseless)
    with pytest.raises(DesignError, match=r"\(31,\)"):
        distance(problem.scene, np.ones(31, dtype=bool), problem.split(x))
