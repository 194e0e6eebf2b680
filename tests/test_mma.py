"""The method of moving asymptotes: published optima, laws, refusals."""

import time
from typing import Any

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from scipy import sparse
from scipy.optimize import Bounds, LinearConstraint, NonlinearConstraint, basinhopping
from scipy.optimize import minimize as scipy_minimize

from mpmopt.optimisation import mma
from mpmopt.optimisation.minimize import minimize
from mpmopt.optimisation.mma import MMAError, MovingAsymptotes

pytestmark = pytest.mark.filterwarnings("error")
VARIANTS = pytest.mark.parametrize("globally_convergent", [False, True])


# Each problem returns f, its gradient, g and the Jacobian matrix of g.
def cantilever(x):
    c = np.array([61.0, 37.0, 19.0, 7.0, 1.0])
    return 0.0624 * x.sum(), np.full(5, 0.0624), [np.sum(c / x**3) - 1], [-3 * c / x**4]


def two_balls(x):
    a, b = np.array([5.0, 2.0, 1.0]), np.array([3.0, 4.0, 3.0])
    g = [(x - a) @ (x - a) - 9, (x - b) @ (x - b) - 9]
    return x @ x, 2 * x, g, [2 * (x - a), 2 * (x - b)]


def two_bar_truss(x):
    a, b = x
    length = np.sqrt(1 + b**2)
    g, dgdx = [], []
    for sign in (1, -1):
        force = 8 / a + sign / (a * b)
        g.append(0.124 * length * force - 1)
        dgdx.append(
            [
                0.124 * length * (-8 / a**2 - sign / (a**2 * b)),
                0.124 * (b / length * force - length * sign / (a * b**2)),
            ]
        )
    return a * length, np.array([length, a * b / length]), g, dgdx


def three_bar_truss(z):
    """Least greatest compliance: areas x = z[:3], bound on the compliances t = z[3].

    Bars of unit stiffness per area from the loaded node along (1, 0), (1, 1)/sqrt 2, (0, 1):
    K = sum_j x_j r_j r_j^T. Loads (1, 0), (1, 1), (0, 1). At x = (3/4, 3/2, 3/4),
    K = [[3/2, 3/4], [3/4, 3/2]] and each load has compliance 8/9, which is the published optimum.
    """
    x, t = z[:3], z[3]
    r = np.array([[1, 0], [np.sqrt(0.5), np.sqrt(0.5)], [0, 1]])
    stiffness = (r.T * x) @ r
    g, dgdx = [x.sum() - 3], [np.array([1.0, 1.0, 1.0, 0.0])]
    for load in np.array([[1.0, 0.0], [1.0, 1.0], [0.0, 1.0]]):
        u = np.linalg.solve(stiffness, load)
        g.append(load @ u - t)
        dgdx.append(np.append(-((r @ u) ** 2), -1.0))
    return t, np.array([0.0, 0.0, 0.0, 1.0]), g, dgdx


def half_plane(x):
    return np.sum((x - 1) ** 2), 2 * (x - 1), [x.sum() - 1], [[1.0, 1.0]]


def parabola(x):
    return float((x[0] - 50) ** 2 + 25), 2 * (x - 50), [], np.zeros((0, 1))


def rosenbrock(x):
    a, b = x
    f = 100 * (b - a**2) ** 2 + (1 - a) ** 2
    return f, np.array([-400 * a * (b - a**2) - 2 * (1 - a), 200 * (b - a**2)])


def run(problem, x, lower, upper, globally_convergent=False, **options):
    constraint = NonlinearConstraint(
        lambda x: -np.array(problem(x)[2]), 0, np.inf, jac=lambda x: -np.array(problem(x)[3])
    )
    return minimize(
        lambda x: problem(x)[:2],
        x,
        jac=True,
        bounds=Bounds(np.full(len(x), lower), np.full(len(x), upper)),
        constraints=[constraint] if len(problem(np.asarray(x))[2]) else [],
        globally_convergent=globally_convergent,
        **{"tol": 1e-10, **options},
    )


def follow(optimiser, problem, x, steps):
    """The iterates of `steps` steps."""
    iterates = []
    for _ in range(steps):
        f, dfdx, g, dgdx = problem(x)
        x = optimiser.step(x, f, dfdx, g, dgdx)
        iterates.append(x)
    return np.array(iterates)


@VARIANTS
@pytest.mark.parametrize(
    ("problem", "start", "lower", "upper", "f", "x", "multipliers"),
    [
        # The constraint is homogeneous of degree -3, so that f = 3 multiplier at the optimum.
        (
            cantilever,
            [5.0] * 5,
            1,
            10,
            1.339956360599075,
            [6.016015894, 5.309173857, 4.494329573, 3.501474970, 2.152665330],
            [1.339956360599075 / 3],
        ),
        (
            two_balls,
            [4.0, 3.0, 2.0],
            0,
            5,
            8.770245902792,
            [2.017518586, 1.780011437, 1.237507148],
            [0.42623975, 0.75957309],
        ),
        # f and the active constraint + 1 scale as x1 and 1/x1: f = multiplier.
        (
            two_bar_truss,
            [1.5, 0.5],
            [0.2, 0.1],
            [4, 1.6],
            1.5086524175,
            [1.411631137, 0.377072434],
            [1.5086524175, 0],
        ),
        # 2 (1 - x_j) = multiplier
        (half_plane, [0.25, 1.0], 0, 1, 0.5, [0.5, 0.5], [1]),
        # Compliances scale as 1/x: 3 times the first multiplier is t. By symmetry the others
        # are p, 1 - 2 p, p, and stationarity in x2 gives p = 1/6.
        (
            three_bar_truss,
            [1.0, 1.0, 1.0, 5.0],
            [0.01, 0.01, 0.01, 0],
            [3, 3, 3, 10],
            8 / 9,
            [0.75, 1.5, 0.75, 8 / 9],
            [8 / 27, 1 / 6, 2 / 3, 1 / 6],
        ),
    ],
)
def test_published_optimum(problem, start, lower, upper, f, x, multipliers, globally_convergent):
    result = run(problem, start, lower, upper, globally_convergent)
    assert result.success and result.status == 0, result.message
    assert result.fun == pytest.approx(f, rel=1e-9, abs=0)
    np.testing.assert_allclose(result.x, x, rtol=1e-8)
    np.testing.assert_allclose(result.multipliers, multipliers, rtol=1e-7, atol=1e-9)
    assert result.maxcv < 1e-9
    assert result.kkt_residual <= 1e-10


def test_three_bar_truss_is_where_an_independent_solver_ends():
    bounds = [(0.01, 3)] * 3 + [(0, 10)]
    constraint = {"type": "ineq", "fun": lambda z: -np.array(three_bar_truss(z)[2])}
    other = scipy_minimize(
        lambda z: z[3], [1, 1, 1, 5.0], bounds=bounds, constraints=constraint, method="SLSQP"
    )
    np.testing.assert_allclose(other.x, [0.75, 1.5, 0.75, 8 / 9], rtol=1e-5)


@VARIANTS
@pytest.mark.parametrize("start", [1.0, 2.0, 13.0, 30.0, 99.0])
def test_bounds_only_converges(start, globally_convergent):
    # Values of f, which the globally convergent variant compares, resolve x to 1e-7 only.
    tol = 1e-8 if globally_convergent else 1e-10
    result = run(parabola, [start], 1, 100, globally_convergent, tol=tol)
    assert result.success
    assert abs(result.x[0] - 50) < 1e-6


def test_wide_asymptotes_cycle_and_are_not_taken_for_convergence():
    """Asymptotes no closer than 0.01 of the range leave steps of 0.9 % of the range for ever."""
    result = run(parabola, [13.0], 1, 100, asymptote_min=0.01, maxiter=300)
    assert not result.success and result.status == 1
    assert result.step_size == pytest.approx(0.009, rel=0.05)
    assert result.kkt_residual > 1e-3
    iterates = follow(
        MovingAsymptotes([1], [100], asymptote_min=0.01), parabola, np.array([13.0]), 300
    )
    np.testing.assert_allclose(iterates[-1], iterates[-3], atol=1e-9)
    assert abs(iterates[-1] - iterates[-2])[0] > 0.8


@pytest.mark.parametrize(
    "start, lower, upper",
    [([1.0] * 5, 1, 10), ([1.01, 1.0, 9.0, 1.0, 1.0], 1, 10)],
)
@VARIANTS
def test_infeasible_start(start, lower, upper, globally_convergent):
    assert cantilever(np.array(start))[2][0] > 1
    result = run(cantilever, start, lower, upper, globally_convergent)
    assert result.success
    assert result.fun == pytest.approx(1.339956360599075, rel=1e-9)


def test_constraints_that_cannot_be_met_are_reported():
    def impossible(x):
        return x @ x, 2 * x, [3 - x.sum()], [[-1.0, -1.0]]

    result = run(impossible, [0.2, 0.3], 0, 1)
    assert not result.success and result.status == 2
    assert result.maxcv == pytest.approx(1)
    assert "constraints[0][0] violates its lower limit 0 by 1:" in result.message
    np.testing.assert_allclose(result.x, 1)


def test_violated_constant_constraint_does_not_spoil_the_rest():
    x = follow(
        MovingAsymptotes([0, 0], [1, 1]),
        lambda x: (x @ x, 2 * x, [1.0], [[0.0, 0.0]]),
        np.array([0.7, 0.6]),
        60,
    )[-1]
    np.testing.assert_allclose(x, 0, atol=1e-9)


@pytest.mark.parametrize("scale_f", [1e-8, 1.0, 1e8])
@pytest.mark.parametrize("scale_g", [1e-8, 1.0, 1e8])
def test_scaling_of_objective_and_constraints_is_immaterial(scale_f, scale_g):
    def scaled(x):
        f, dfdx, g, dgdx = cantilever(x)
        return scale_f * f, scale_f * dfdx, scale_g * np.array(g), scale_g * np.array(dgdx)

    result = run(scaled, [5.0] * 5, 1, 10)
    assert result.success
    assert result.fun == pytest.approx(scale_f * 1.339956360599075, rel=1e-9, abs=0)
    expected = scale_f / scale_g * 1.339956360599075 / 3
    assert result.multipliers[0] == pytest.approx(expected, rel=1e-7, abs=0)


def test_closed_form_of_the_first_step():
    """x = (L sqrt p + U sqrt q) / (sqrt p + sqrt q), within the limits of the step."""
    lower, upper, x = np.array([0.0, -1.0]), np.array([2.0, 3.0]), np.array([1.1, 0.5])
    dfdx, span, raa0 = np.array([1e-5, -1e-5]), upper - lower, 0.1
    optimiser = MovingAsymptotes(lower, upper, raa0=raa0, asymptote_initial=0.5)
    low, high = x - 0.5 * span, x + 0.5 * span
    least = raa0 * np.max(np.abs(dfdx) * span) / span
    p = (high - x) ** 2 * (np.maximum(dfdx, 0) + 1e-3 * abs(dfdx) + least)
    q = (x - low) ** 2 * (np.maximum(-dfdx, 0) + 1e-3 * abs(dfdx) + least)
    expected = (low * np.sqrt(p) + high * np.sqrt(q)) / (np.sqrt(p) + np.sqrt(q))
    np.testing.assert_allclose(optimiser.step(x, 1.0, dfdx), expected, rtol=1e-13)


def test_move_limit_binds_and_can_be_changed():
    optimiser = MovingAsymptotes([0.0, 0.0], [1.0, 10.0], move_limit=0.05)
    x = np.array([0.5, 5.0])
    new = optimiser.step(x, 0.0, [1.0, -1.0])
    np.testing.assert_allclose(new - x, [-0.05, 0.5], rtol=1e-12)
    assert optimiser.step_size == pytest.approx(0.05)
    optimiser.move_limit /= 2
    np.testing.assert_allclose(optimiser.step(x, 0.0, [1, -1]) - x, [-0.025, 0.25], rtol=1e-12)


def test_asymptotes_close_in_on_oscillation_and_part_on_progress():
    optimiser = MovingAsymptotes([0.0, 0.0], [1.0, 1.0])
    for x in ([0.5, 0.5], [0.6, 0.6], [0.5, 0.7]):
        optimiser.step(x, 0.0, [1.0, 1.0])
    np.testing.assert_allclose(optimiser.asymptote_distance, [0.5 * 0.7, 0.5 * 1.2])
    optimiser.reset()
    optimiser.step([0.5, 0.5], 0.0, [1.0, 1.0])
    np.testing.assert_allclose(optimiser.asymptote_distance, 0.5)


@pytest.mark.parametrize("seed", range(20))
def test_subproblem_has_no_duality_gap(seed):
    """For any multipliers the dual is a lower bound: equality proves both solutions."""
    rng = np.random.default_rng(seed)
    n, m = int(rng.integers(1, 60)), int(rng.integers(1, 8))
    slopes = rng.standard_normal((1 + m, n)) * 10 ** rng.uniform(-6, 6, (1 + m, 1))
    slopes[rng.random(slopes.shape) < 0.2] = 0
    size = np.abs(slopes).max(axis=1) + 1e-6
    distance = 10 ** rng.uniform(-3, 1, n)
    limit = np.minimum(0.9, 0.5 / distance)
    low, high = -limit * rng.uniform(0, 1, n) ** 4, limit * rng.uniform(0.01, 1, n)
    shared = 1e-3 * np.abs(slopes) + 10 ** rng.uniform(-5, 1) * size[:, None]
    rise = distance * (np.maximum(slopes, 0) + shared)
    fall = distance * (np.maximum(-slopes, 0) + shared)
    g = size[1:] * rng.standard_normal(m) * 10 ** rng.uniform(-4, 0, m)
    cost = 1e3 * size[0] / size[1:]

    def approximations(t):
        return rise @ (t / (1 - t)) - fall @ (t / (1 + t))

    t, lam = mma._solve_subproblem(rise, fall, g, low, high, cost)
    assert np.all((t >= low) & (t <= high)) and np.all((lam >= 0) & (lam <= cost))
    at_t = approximations(t)
    primal = at_t[0] + cost @ np.maximum(at_t[1:] + g, 0)
    p, q = np.sqrt(rise[0] + lam @ rise[1:]), np.sqrt(fall[0] + lam @ fall[1:])
    at_best = approximations(np.clip((q - p) / (q + p), low, high))
    dual = at_best[0] + lam @ (at_best[1:] + g)
    natural = np.abs(slopes[0] * distance * (high - low)).sum() + cost @ np.abs(at_t[1:] + g)
    assert abs(primal - dual) < 1e-10 * natural


@VARIANTS
def test_agrees_with_an_independent_solver_on_a_random_convex_problem(globally_convergent):
    rng = np.random.default_rng(7)
    n, m = 12, 3
    root = rng.standard_normal((n, n))
    matrix, b = root.T @ root / n + np.eye(n), rng.standard_normal(n)
    a, center = rng.uniform(0.5, 2, (m, n)), rng.uniform(-1, 1, (m, n))

    def problem(x):
        shift = x - center
        g = np.sum(a * shift**2, axis=1) - 7
        return 0.5 * x @ matrix @ x - 3 * b @ x, matrix @ x - 3 * b, g, 2 * a * shift

    result = run(problem, [0.1] * n, -1, 1, globally_convergent)
    other = scipy_minimize(
        lambda x: problem(x)[:2],
        np.full(n, 0.1),
        jac=True,
        bounds=[(-1, 1)] * n,
        constraints={
            "type": "ineq",
            "fun": lambda x: -problem(x)[2],
            "jac": lambda x: -problem(x)[3],
        },
        method="SLSQP",
        options={"ftol": 1e-14, "maxiter": 500},
    )
    assert result.success and other.success
    assert result.fun == pytest.approx(other.fun, rel=1e-9)
    np.testing.assert_allclose(result.x, other.x, atol=1e-5)
    active = np.count_nonzero(result.multipliers > 1e-6)
    assert active > 0 and np.any(np.abs(result.x) > 1 - 1e-9)


@VARIANTS
def test_thousands_of_variables_with_a_volume_constraint(globally_convergent):
    """min sum c / x with mean x <= v has x = v sqrt c / mean sqrt c where no bound is active."""
    n, volume = 5000, 0.3
    c = np.random.default_rng(0).uniform(0.5, 2, n)

    def problem(x):
        return np.sum(c / x), -c / x**2, [x.mean() - volume], np.full((1, n), 1 / n)

    start = time.perf_counter()
    result = run(problem, [volume] * n, 1e-3, 1, globally_convergent, tol=1e-8)
    elapsed = time.perf_counter() - start
    assert result.success
    np.testing.assert_allclose(result.x, volume * np.sqrt(c) / np.sqrt(c).mean(), rtol=1e-6)
    assert result.nfev <= 60
    assert elapsed < 20  # measured: 1 s; a quadratic cost in n would take minutes


def test_globally_convergent_variant_descends_monotonically():
    values = []
    result = minimize(
        rosenbrock,
        [-1.2, 1.0],
        jac=True,
        bounds=[(-2, 2), (-2, 2)],
        callback=lambda intermediate_result: values.append(intermediate_result.fun),
        globally_convergent=True,
        maxiter=300,
    )
    assert len(values) == 300 and result.status == 1
    assert np.all(np.diff(values) < 0)
    assert values[-1] < 0.01 * rosenbrock([-1.2, 1.0])[0]
    # The ordinary variant does not have this property, so that the test can fail.
    values.clear()
    minimize(
        rosenbrock,
        [-1.2, 1.0],
        jac=True,
        bounds=[(-2, 2), (-2, 2)],
        callback=lambda intermediate_result: values.append(intermediate_result.fun),
        maxiter=100,
    )
    assert np.any(np.diff(values) > 0)


def test_globally_convergent_step_stays_feasible():
    """Conservative approximations of the constraints: from a feasible start all is feasible."""
    x = np.array([4.0, 3.0, 2.0])
    optimiser = MovingAsymptotes(np.zeros(3), np.full(3, 5.0))
    for _ in range(15):
        f, dfdx, g, dgdx = two_balls(x)
        assert np.max(g) < 1e-9
        x = optimiser.step(x, f, dfdx, g, dgdx, evaluate=lambda x: two_balls(x)[::2])
    assert two_balls(x)[0] == pytest.approx(8.770245902792, rel=1e-8)


def test_restore_continues_bit_for_bit(tmp_path):
    def fresh(**options):
        return MovingAsymptotes(np.full(5, 1.0), np.full(5, 10.0), **options)

    whole = fresh(move_limit=0.3, asymptote_min=1e-5)
    first = follow(whole, cantilever, np.full(5, 5.0), 6)
    np.savez(tmp_path / "state.npz", **whole.state())
    rest = follow(whole, cantilever, first[-1], 8)

    continued = fresh()
    with np.load(tmp_path / "state.npz", allow_pickle=False) as state:
        continued.restore(state)
    assert continued.move_limit == 0.3
    assert np.array_equal(follow(continued, cantilever, first[-1], 8), rest)
    # The state matters: without it the same x goes elsewhere.
    forgetful = fresh(move_limit=0.3, asymptote_min=1e-5)
    assert not np.array_equal(follow(forgetful, cantilever, first[-1], 8), rest)


def test_state_is_a_copy():
    optimiser = MovingAsymptotes([0.0, 0.0], [1.0, 1.0])
    optimiser.step([0.2, 0.3], 1.0, [1.0, 2.0])
    state = optimiser.state()
    before = {key: np.copy(value) for key, value in state.items()}
    optimiser.step([0.3, 0.4], 1.0, [3.0, 2.0])
    assert all(np.array_equal(state[key], before[key]) for key in before)


def test_state_of_other_bounds_is_refused():
    state = MovingAsymptotes([0.0], [1.0]).state()
    with pytest.raises(MMAError, match="another upper bound"):
        MovingAsymptotes([0.0], [2.0]).restore(state)
    del state["iteration"]
    with pytest.raises(MMAError, match="lacks iteration"):
        MovingAsymptotes([0.0], [1.0]).restore(state)


@VARIANTS
def test_fixed_variables_stay(globally_convergent):
    lower, upper = np.full(5, 1.0), np.full(5, 10.0)
    lower[2] = upper[2] = 4.0
    result = run(cantilever, [5.0, 5, 4, 5, 5], lower, upper, globally_convergent)
    assert result.success and result.x[2] == 4.0
    # Of the free ones x_j^4 / c_j is one number: stationarity.
    free = [0, 1, 3, 4]
    ratio = result.x[free] ** 4 / np.array([61, 37, 7, 1])
    np.testing.assert_allclose(ratio, ratio[0], rtol=1e-6)


def test_all_variables_fixed():
    result = run(half_plane, [0.25, 0.5], [0.25, 0.5], [0.25, 0.5])
    assert result.success and result.nit == 0
    assert np.array_equal(result.x, [0.25, 0.5])


def good_arguments():
    return {"x": [0.5, 0.5], "f": 1.0, "dfdx": [1.0, 1.0], "g": [0.0], "dgdx": [[1.0, 2.0]]}


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize(
    ("name", "value", "named"),
    [
        ("f", lambda b: b, "f is"),
        ("dfdx", lambda b: [1.0, b], r"dfdx\[1\] is"),
        ("g", lambda b: [b], r"g\[0\] is"),
        ("dgdx", lambda b: [[b, 1.0]], r"dgdx\[0, 0\] is"),
        ("x", lambda b: [b, 0.5], r"x\[0\] is"),
    ],
)
def test_values_that_are_not_finite_are_refused(name, value, bad, named):
    optimiser = MovingAsymptotes([0.0, 0.0], [1.0, 1.0])
    with pytest.raises(MMAError, match=named):
        optimiser.step(**{**good_arguments(), name: value(bad)})
    # A refused call leaves no trace.
    assert optimiser.iteration == 0
    optimiser.step(**good_arguments())


def test_value_that_is_not_finite_in_an_inner_iteration_is_refused_without_trace():
    optimiser = MovingAsymptotes([0.0, 0.0], [1.0, 1.0])
    before = optimiser.state()
    with pytest.raises(MMAError, match="f is nan"):
        optimiser.step(**good_arguments(), evaluate=lambda x: (np.nan, [0.0]))
    assert all(np.array_equal(before[k], v) for k, v in optimiser.state().items())


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"x": [0.5]}, "x has shape"),
        ({"x": [0.5, 1.5]}, r"x\[1\] = 1.5 is outside its bounds \[0.0, 1.0\]"),
        ({"f": [1.0, 2.0]}, "f has shape"),
        ({"dfdx": [[1.0, 1.0]]}, "dfdx has shape"),
        ({"dgdx": [1.0, 2.0]}, "dgdx has shape"),
        ({"dgdx": [[1.0, 2.0], [1.0, 2.0]]}, "dgdx has shape"),
        ({"dgdx": None}, "belong together"),
        ({"g": None}, "belong together"),
    ],
)
def test_arguments_that_do_not_fit_are_refused(changed, message):
    with pytest.raises(MMAError, match=message):
        MovingAsymptotes([0.0, 0.0], [1.0, 1.0]).step(**{**good_arguments(), **changed})


def test_number_of_constraints_may_change_only_after_reset():
    optimiser = MovingAsymptotes([0.0, 0.0], [1.0, 1.0])
    optimiser.step(**good_arguments())
    with pytest.raises(MMAError, match="reset"):
        optimiser.step([0.5, 0.5], 1.0, [1.0, 1.0])
    optimiser.reset()
    optimiser.step([0.5, 0.5], 1.0, [1.0, 1.0])


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"upper": [1.0, np.inf]}, r"upper bound\[1\] is inf"),
        ({"lower": [np.nan, 0.0]}, r"lower bound\[0\] is nan"),
        ({"upper": [1.0, -1.0]}, "variable 1 is above its upper bound -1.0"),
        ({"upper": [1.0]}, "upper bound has shape"),
        ({"move_limit": 0.0}, "move_limit is 0.0"),
        ({"move_limit": np.nan}, "move_limit is nan"),
        ({"asymptote_decrease": 1.1}, "asymptote_decrease"),
        ({"asymptote_min": 20.0}, "asymptote_min"),
    ],
)
def test_bounds_and_parameters_that_cannot_be_used_are_refused(arguments, message):
    with pytest.raises(MMAError, match=message):
        MovingAsymptotes(**{"lower": [0.0, 0.0], "upper": [1.0, 1.0], **arguments})


TWO_SIDED = {
    "two limits": NonlinearConstraint(lambda x: x[0] * x[1], 2.0, 3.0, jac=lambda x: [x[1], x[0]]),
    "two components": NonlinearConstraint(
        lambda x: [x[0] * x[1] - 2, 3 - x[0] * x[1]],
        0.0,
        np.inf,
        jac=lambda x: [[x[1], x[0]], [-x[1], -x[0]]],
    ),
}


@pytest.mark.parametrize("form", TWO_SIDED)
def test_method_of_scipy_minimize_takes_every_form_of_constraint(form):
    """min x + y with x y >= 2 is at x = y = sqrt 2; the multiplier is 1 / sqrt 2."""
    calls = []

    def fun(x):
        calls.append(x)
        return x.sum(), np.ones(2)

    result = scipy_minimize(
        fun,
        [1.0, 2.5],
        jac=True,
        bounds=Bounds(0.1, 5.0),
        constraints=TWO_SIDED[form],
        method=minimize,
        tol=1e-7,
        options={"maxiter": 60},
    )
    assert result.success
    np.testing.assert_allclose(result.x, np.sqrt(2), rtol=1e-6)
    np.testing.assert_allclose(result.multipliers, [np.sqrt(0.5), 0], rtol=1e-6, atol=1e-8)
    assert result.nfev == len(calls) == result.nit + 1


def test_linear_constraint_with_args_and_separate_gradient():
    """The nearest point of 1 <= x + y <= 2, x - y <= 0.5 to (3, 0) is (1.25, 0.75)."""
    result = scipy_minimize(
        lambda x, a: np.sum((x - a) ** 2),
        [0.0, 0.0],
        args=(np.array([3.0, 0.0]),),
        jac=lambda x, a: 2 * (x - a),
        bounds=[(-5, 5), (-5, 5)],
        constraints=[
            LinearConstraint([[1, 1]], 1, 2),
            LinearConstraint([1, -1], ub=0.5),
        ],
        method=minimize,
        options={"tol": 1e-10, "globally_convergent": True},
    )
    assert result.success
    np.testing.assert_allclose(result.x, [1.25, 0.75], rtol=1e-8)
    # -grad f = (3.5, -1.5) = 1 (1, 1) + 2.5 (1, -1); the lower limit of the first is idle
    np.testing.assert_allclose(result.multipliers, [0, 1, 2.5], rtol=1e-7, atol=1e-9)


def test_callback_sees_every_iterate_and_can_stop():
    seen = []

    def callback(x):
        seen.append(x)
        if len(seen) == 4:
            raise StopIteration

    result = scipy_minimize(
        rosenbrock,
        [-1.2, 1.0],
        jac=True,
        bounds=[(-2, 2)] * 2,
        method=minimize,
        callback=callback,
    )
    assert len(seen) == result.nit == 4 and result.status == 3 and not result.success
    assert np.array_equal(seen[-1], result.x)


def test_wrong_gradient_is_not_taken_for_convergence():
    """With the sign of the gradient reversed no step can be conservative."""
    result = minimize(
        lambda x: (float(x @ x), -2 * x),
        [0.5, 0.25],
        jac=True,
        bounds=[(-1, 1)] * 2,
        globally_convergent=True,
    )
    assert not result.success and result.status == 2 and "gradients" in result.message


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"jac": None}, "jac is missing"),
        ({"bounds": None}, "bounds are missing"),
        ({"bounds": [(0, None), (0, 1)]}, r"upper bound\[0\] is inf: give"),
        ({"bounds": [(0, 1)] * 3}, "3 pairs of bounds for 2 variables"),
        ({"hess": lambda x: np.eye(2)}, "no Hessian"),
        ({"options": {"ftol": 1.0}}, "unknown option ftol: the options are maxiter"),
        ({"constraints": LinearConstraint([1, 1], 1, 1)}, "eliminate a variable"),
        (
            {"constraints": NonlinearConstraint(np.sum, 1, 1, jac=np.ones_like)},
            "eliminate a variable",
        ),
        ({"constraints": NonlinearConstraint(np.sum, 0, 1)}, "no finite differences"),
        ({"constraints": {"type": "ineq", "fun": np.sum}}, "pass a LinearConstraint"),
        ({"constraints": [np.sum]}, "pass a LinearConstraint"),
        ({"x0": [2.0, 0.0]}, "outside its bounds"),
    ],
)
def test_minimize_refuses_what_it_cannot_do(arguments, message):
    good = {"x0": [0.5, 0.5], "jac": True, "bounds": [(0, 1)] * 2}
    with pytest.raises(MMAError, match=message):
        scipy_minimize(lambda x: (x @ x, 2 * x), method=minimize, **{**good, **arguments})


def sphere(x):
    return float(x @ x), 2 * x


@VARIANTS
def test_success_is_feasible_where_the_constraint_was_steep_once(globally_convergent):
    """min x with exp(20 x) >= exp(-6) is at -0.3: the gradient falls by 1e10 on the way."""
    result = minimize(
        lambda x: (x[0], [1.0]),
        [0.9],
        jac=True,
        bounds=[(-1, 1)],
        constraints=NonlinearConstraint(
            lambda x: np.exp(20 * x), np.exp(-6), np.inf, jac=lambda x: [20 * np.exp(20 * x)]
        ),
        globally_convergent=globally_convergent,
    )
    assert result.success
    assert result.x[0] == pytest.approx(-0.3, abs=1e-7)
    # f' = 1 = multiplier times 20 exp(-6)
    assert result.multipliers[0] == pytest.approx(np.exp(6) / 20, rel=1e-5)


@VARIANTS
@pytest.mark.parametrize("k", [10, 20, 60])
def test_success_is_a_minimum_where_the_objective_was_steep_once(k, globally_convergent):
    """exp(k x) on [-1, 1] from 0.9 has its minimum at -1, whatever the first gradient was."""
    x, done = [0.9], False
    for _ in range(8):  # a search that did not succeed says how to go on
        result = minimize(
            lambda x: (np.exp(k * x[0]), k * np.exp(k * x)),
            x,
            jac=True,
            bounds=[(-1, 1)],
            globally_convergent=globally_convergent,
        )
        assert result.success == (result.x[0] == -1)
        done = done or result.success
        assert done or "start again from this x" in result.message
        x = result.x
    assert done


def test_flat_minimum_counts_as_one():
    """At that of x^4 the curvature vanishes with the gradient."""
    result = minimize(
        lambda x: (np.sum(x**4), 4 * x**3), [0.7, -0.6], jac=True, bounds=[(-1, 1)] * 2
    )
    assert result.success
    assert np.abs(result.x).max() < 1e-3


WILD = st.tuples(
    st.floats(-40, 40).filter(lambda k: abs(k) > 0.1), st.floats(-1, 1), st.floats(-0.9, 0.9)
)


@settings(max_examples=6, deadline=None, derandomize=True)
@given(
    wild=st.lists(WILD, min_size=1, max_size=1),
    weights=st.lists(st.floats(-1, 1), min_size=2, max_size=2),
    start=st.lists(st.floats(-1, 1), min_size=2, max_size=2),
    scale=st.sampled_from([1e-6, 1.0, 1e6]),
    globally_convergent=st.booleans(),
)
@example([(20.0, 0.0, -0.3)], [1.0, 0.0], [0.9, 0.0], 1.0, False)
@example([(-40.0, 0.5, 0.3)], [-1.0, 0.1], [-0.9, 0.1], 1.0, False)
def test_success_means_feasible_in_units_of_the_gradient_at_the_end(
    wild, weights, start, scale, globally_convergent
):
    """exp(k (x0 + a x1)) on one side of exp(k b): the slope varies by up to exp(160)."""
    k, a, b = np.array(wild).T

    def fun(x):
        return scale * np.sign(k) * (np.exp(k * b) - np.exp(k * (x[0] + a * x[1])))

    def jac(x):
        slope = -scale * np.abs(k) * np.exp(k * (x[0] + a * x[1]))
        return np.stack([slope, a * slope], axis=1)

    result = minimize(
        lambda x: (np.dot(weights, x) + 0.1 * float(x @ x), weights + 0.2 * x),
        start,
        jac=True,
        bounds=[(-1, 1)] * 2,
        constraints=NonlinearConstraint(fun, 0, np.inf, jac=jac),
        globally_convergent=globally_convergent,
        maxiter=30,
    )
    unit = 2 * np.abs(jac(result.x)).max(axis=1)
    assert result.maxcv == pytest.approx(max(0, -fun(result.x).min()))
    if result.success:
        assert np.all(-fun(result.x) <= 1.001e-8 * unit)
    elif result.maxcv > 1e-6 * unit.max():
        assert "violates its lower limit 0 by" in result.message


def test_constraint_that_cannot_be_met_is_named_in_the_units_of_the_user():
    result = minimize(
        lambda x: (x.sum(), np.ones(10)),
        np.ones(10),
        jac=True,
        bounds=[(0, 35)] * 10,
        constraints=[
            LinearConstraint(np.eye(10)[:1], -5, 1e3),
            LinearConstraint(np.vstack([np.eye(10)[1], np.ones(10)]), [-np.inf, 500], [30, 900]),
        ],
    )
    assert result.status == 2 and not result.success
    assert "constraints[1][1] violates its lower limit 500 by 155:" in result.message
    assert result.maxcv == pytest.approx(155)  # 500 - 30 - 9 * 35
    upper = minimize(
        sphere,
        [0.5, 0.5],
        jac=True,
        bounds=[(0, 1)] * 2,
        constraints=[
            LinearConstraint([1, 1], -1, 5),
            NonlinearConstraint(lambda x: x, [-2, -9], [1, -3], jac=lambda x: np.eye(2)),
        ],
        maxiter=3,
    )
    assert not upper.success
    assert "constraints[1][1] violates its upper limit -3 by 3" in upper.message


@pytest.mark.parametrize("value", [1e-9, 1e-300])
def test_violated_constraint_without_gradient_is_never_success(value):
    result = minimize(
        sphere,
        [0.5, 0.5],
        jac=True,
        bounds=[(-1, 1)] * 2,
        constraints=NonlinearConstraint(lambda x: -value, 0, np.inf, jac=lambda x: [0.0, 0.0]),
    )
    assert not result.success and result.kkt_residual == np.inf
    assert "violates its lower limit 0 by" in result.message
    np.testing.assert_allclose(result.x, 0, atol=1e-6)


def test_rounding_of_fixed_variables_is_no_violation():
    """0.1 + 0.2 <= 0.3 fails by one rounding, and nothing can be done about it."""
    result = minimize(
        lambda x: (x[2], [0.0, 0.0, 1.0]),
        [0.1, 0.2, 0.5],
        jac=True,
        bounds=[(0.1, 0.1), (0.2, 0.2), (0, 1)],
        constraints=LinearConstraint([1, 1, 0], -np.inf, 0.3),
    )
    assert result.maxcv > 0 and result.success and result.x[2] < 1e-8


def solved(**changes):
    """min (x - 2)^2 + (y - 2)^2 on [0, 1] x [0, 3], by way of scipy.optimize.minimize."""
    arguments = {
        "fun": lambda x: (np.sum((x - 2) ** 2), 2 * (x - 2)),
        "x0": [0.5, 0.5],
        "jac": True,
        "bounds": [(0, 1), (0, 3)],
        "method": minimize,
    }
    return scipy_minimize(**{**arguments, **changes})


def gradient_of_solved(x):
    return 2 * (x - 2)


def of_buffer(function):
    """The function with its values in one array, as codes in C and Fortran return them."""
    buffer: dict[str, np.ndarray] = {}

    def filled(x):
        value = np.asarray(function(x), dtype=float)
        buffer.setdefault("array", np.empty_like(value))[...] = value
        return buffer["array"]

    return filled


def spoiling(function):
    def spoilt(x):
        value = function(x.copy())
        x[...] = np.nan
        return value

    return spoilt


HALF = {  # x + y <= 2.5, or more than that, in every form
    "vector": lambda wrap: NonlinearConstraint(
        wrap(lambda x: [x.sum(), x[0]]), -9, [2.5, 9], jac=wrap(lambda x: [[1, 1], [1, 0]])
    ),
    "number": lambda wrap: NonlinearConstraint(
        wrap(np.sum), -9, 2.5, jac=wrap(lambda x: [1.0, 1.0])
    ),
}


@VARIANTS
@pytest.mark.parametrize("wrap", [of_buffer, spoiling])
@pytest.mark.parametrize("form", HALF)
@pytest.mark.parametrize("with_gradient", [True, False])
def test_memory_of_the_caller_is_neither_kept_nor_trusted(
    wrap, form, with_gradient, globally_convergent
):
    """Functions that reuse their result, or overwrite their argument, as solvers allow."""
    value = wrap(lambda x: [np.sum((x - 2) ** 2)])
    gradient = wrap(gradient_of_solved)
    both = {"fun": lambda x: (value(x.copy()), gradient(x)), "jac": True}
    result = minimize(
        **(both if with_gradient else {"fun": value, "jac": gradient}),
        x0=[0.5, 0.5],
        bounds=[(0, 1), (0, 3)],
        globally_convergent=globally_convergent,
        tol=1e-6,
        constraints=HALF[form](wrap),
    )
    assert result.success
    np.testing.assert_allclose(result.x, [1, 1.5], atol=1e-5)
    assert result.fun == pytest.approx(np.sum((result.x - 2) ** 2), rel=1e-14)
    np.testing.assert_allclose(result.jac, 2 * (result.x - 2), rtol=1e-14)
    kept = result.jac.copy()
    gradient(np.array([0.1, 0.2]))
    assert np.array_equal(result.jac, kept)


@pytest.mark.parametrize("by_name", [True, False])
def test_callback_that_changes_what_it_is_given_changes_nothing(by_name):
    def of_result(intermediate_result):
        for value in intermediate_result.values():
            if isinstance(value, np.ndarray):
                value[...] = np.nan

    def of_x(x):
        x[...] = np.nan

    constraints = LinearConstraint(np.array([[1.0, 1.0]]), -9, 2.5)
    spoilt = solved(constraints=constraints, callback=of_result if by_name else of_x)
    plain = solved(constraints=constraints)
    assert plain.success and spoilt.nit == plain.nit
    for name in ("x", "jac", "multipliers"):
        assert np.array_equal(spoilt[name], plain[name])


def test_callback_without_a_signature_is_given_x():
    seen: list[np.ndarray] = []
    assert solved(callback=seen.append).nit == len(seen)


def test_start_outside_its_bounds_by_rounding_is_moved_to_them():
    low, high = 0.1, 0.1 + 0.2
    for x0 in (np.nextafter(low, 0), np.nextafter(high, 1)):
        seen: list[float] = []

        def noted(x, seen=seen):
            seen.append(x[0])
            return x

        result = minimize(
            lambda x: (float(noted(x) @ x), 2 * x),
            [x0],
            jac=True,
            bounds=[(low, high)],
            constraints=NonlinearConstraint(noted, -1, 1, jac=lambda x: [1.0]),
        )
        assert result.success and min(seen) >= low and max(seen) <= high
    assert solved(x0=[-1e-17, 0.5]).success
    with pytest.raises(MMAError, match=r"x0\[0\] = 1.000001 is outside its bounds \[0.0, 1.0\]"):
        solved(x0=[1.000001, 0.5])


def test_basinhopping_takes_it_for_its_searches():
    """The lower of the two minima of (x^2 - 1)^2 + 0.3 x, from a start in the other."""
    rng = np.random.default_rng(0)
    low, high = np.array([-1.7]), np.array([1.7])
    result = basinhopping(
        lambda x: (float((x[0] ** 2 - 1) ** 2 + 0.3 * x[0]), 4 * x * (x**2 - 1) + 0.3),
        [1.0],
        niter=8,
        take_step=lambda x: low + (high - low) * rng.random(1),
        minimizer_kwargs={"method": minimize, "jac": True, "bounds": Bounds(low, high)},
    )
    assert result.lowest_optimization_result.success
    best = min(np.roots([4, 0, -4, 0.3]).real)  # Newton's own polynomial: 4 x^3 - 4 x + 0.3 = 0
    assert best < 0
    np.testing.assert_allclose(4 * result.x**3 - 4 * result.x + 0.3, 0, atol=1e-6)
    assert result.x[0] < 0


ACCEPTED = {
    "bounds of length one": {"bounds": Bounds([0], [1])},
    "bounds as numbers": {"bounds": Bounds(0, 1)},
    "bounds to be kept": {"bounds": Bounds(0, 1, keep_feasible=True)},
    "a generator of bounds": {"bounds": ((0, 1) for _ in range(2))},
    "a matrix of bounds": {"bounds": np.array([[0, 1], [0, 1]])},
    "whole numbers": {"x0": [0, 1]},
    "constraints of none": {"constraints": ()},
    "a limit for each": {
        "constraints": NonlinearConstraint(lambda x: x, [-9, -9], [1, 1], jac=lambda x: np.eye(2))
    },
    "a limit in a list": {
        "constraints": NonlinearConstraint(lambda x: x, [-9], [1], jac=lambda x: np.eye(2))
    },
    "a sparse matrix": {
        "constraints": LinearConstraint(sparse.csr_matrix([[1, 0], [0, 1]]), -9, 1)
    },
    "a sparse Jacobian matrix": {
        "constraints": NonlinearConstraint(lambda x: x, -9, 1, jac=lambda x: sparse.eye(2))
    },
    "a Jacobian matrix of one row": {
        "constraints": NonlinearConstraint(lambda x: x[1], -9, 1, jac=lambda x: [0.0, 1.0])
    },
    "an argument that is no tuple": {
        "fun": lambda x, a: (np.sum((x - a) ** 2), 2 * (x - a)),
        "args": 2.0,
    },
    "a value in an array": {"fun": lambda x: (np.array([np.sum((x - 2) ** 2)]), 2 * (x - 2))},
    "more than a pair": {"fun": lambda x: (np.sum((x - 2) ** 2), 2 * (x - 2), None)},
    "a tolerance": {"tol": 1e-6},
    "iterations as a float": {"options": {"maxiter": 1e3}},
}


@pytest.mark.parametrize("direct", [True, False])
@pytest.mark.parametrize("form", ACCEPTED)
def test_forms_that_scipy_takes_are_taken(form, direct):
    """Each makes (1, 1) the nearest point to (2, 2) on [0, 1]^2."""
    arguments = {"bounds": [(0, 1)] * 2, **ACCEPTED[form]}
    if form == "a generator of bounds":
        arguments["bounds"] = ((0, 1) for _ in range(2))
    if "constraints" in arguments and arguments["constraints"] != ():
        arguments["bounds"] = [(0, 3)] * 2
        if "one row" in form:
            arguments["bounds"] = [(0, 1), (0, 3)]
    if direct:
        arguments |= arguments.pop("options", {})
        start = {"fun": lambda x: (np.sum((x - 2) ** 2), 2 * (x - 2)), "x0": [0.5, 0.5]}
        result = minimize(**{**start, "jac": True, **arguments})
    else:
        result = solved(**arguments)
    assert result.success, result.message
    np.testing.assert_allclose(result.x, 1, atol=1e-5)


def test_message_is_printed_if_asked(capsys):
    assert solved(options={"disp": True}).message + "\n" == capsys.readouterr().out
    solved()
    assert capsys.readouterr().out == ""


def nonlinear(*limits, fun=lambda x: x, jac=lambda x: np.eye(2), **options):
    return {
        "constraints": [
            LinearConstraint([1, 1], -9, 9),
            NonlinearConstraint(fun, *limits, jac=jac, **options),
        ]
    }


def calls():
    """A value whose length changes."""
    lengths = iter([2, 2, 3])
    return lambda x: np.zeros(next(lengths, 3))


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        # limits
        (nonlinear(-np.inf, np.nan), r"upper limit of constraints\[1\] is nan at \[0\]"),
        (nonlinear([0, np.nan], 1), r"lower limit of constraints\[1\] is nan at \[1\]"),
        ({"constraints": LinearConstraint([1, 1], np.nan, 1)}, "lower limit .* is nan"),
        (nonlinear([0, 0, 0], 1), r"has shape \(3,\), but there are 2 components"),
        (nonlinear([[0], [0]], 1), r"has shape \(2, 1\), but there are 2 components"),
        (nonlinear(2, [3, 1]), r"limits 2.0, 1.0 of constraints\[1\]\[1\] are equal or reversed"),
        (nonlinear(np.inf, np.inf), "equal or reversed"),
        (nonlinear(-np.inf, -np.inf), "equal or reversed"),
        # values and matrices
        (
            {"constraints": LinearConstraint(np.ones((2, 3)), 0, 1)},
            r"matrix of constraints\[0\] has shape \(2, 3\), but there are 2 variables",
        ),
        (
            nonlinear(-9, 9, fun=lambda x: [x[0], x[1], 1], jac=lambda x: [[1, 0, 0], [0, 1, 0]]),
            r"has shape \(2, 3\) where \(3, 2\) is needed: transpose it",
        ),
        (
            nonlinear(-9, 9, fun=lambda x: [x[0], x[1], 1], jac=lambda x: [1, 0, 0, 1, 0, 0]),
            r"has shape \(6,\) where \(3, 2\) is needed",
        ),
        (
            nonlinear(-9, 9, jac=lambda x: [[1, np.nan], [0, 1]]),
            r"Jacobian matrix of constraints\[1\] is nan at \[0, 1\]",
        ),
        (nonlinear(-9, 9, fun=lambda x: x[:, None]), r"has shape \(2, 1\) where \(2,\) is needed"),
        (nonlinear(-9, 9, fun=lambda x: x + 1j), r"value of constraints\[1\] is .*real numbers"),
        (nonlinear(-9, 9, fun=lambda x: [0, np.nan]), r"constraints\[1\]\[1\] is nan at x = "),
        (nonlinear(-9, 9, fun=lambda x: None), "real numbers"),
        (nonlinear(-9, 9, fun=calls()), r"has shape \(3,\) where \(2,\) is needed"),
        # the other fields of constraints
        (nonlinear(-9, 9, keep_feasible=True), "keep_feasible"),
        (
            {"constraints": LinearConstraint([1, 1], 0, 1, keep_feasible=True)},
            r"constraints\[0\] has keep_feasible=True",
        ),
        (nonlinear(-9, 9, jac=None), "jac of constraints"),
        (nonlinear(-9, 9, jac="4-point"), "jac of constraints.* '4-point'"),
        (nonlinear(-9, 9, fun=3.0), "fun of constraints.* 3.0: pass a callable"),
        ({"constraints": 5}, r"constraints\[0\] is 5: pass a LinearConstraint"),
        ({"constraints": Bounds(0, 1)}, "pass a LinearConstraint"),
        # bounds
        ({"bounds": Bounds([0] * 3, [1] * 3)}, r"shape \(3,\), but there are 2 variables"),
        ({"bounds": Bounds([[0], [0]], 1)}, r"shape \(2, 1\), but there are 2 variables"),
        ({"bounds": Bounds([0, np.nan], 1)}, r"lower bound is nan at \[1\]"),
        ({"bounds": Bounds(0, np.inf)}, r"upper bound\[0\] is inf: give every variable finite"),
        ({"bounds": [(-np.inf, 1), (0, 1)]}, r"lower bound\[0\] is -inf"),
        ({"bounds": [(None, 1), (0, 1)]}, r"lower bound\[0\] is -inf"),
        ({"bounds": [0, 1, 0, 1]}, r"bounds are \[0, 1, 0, 1\]: pass Bounds, or a pair"),
        ({"bounds": [(0, 1, 0), (1, 0, 1)]}, "pass Bounds, or a pair"),
        ({"bounds": [(0, 1)]}, "1 pairs of bounds for 2 variables"),
        ({"bounds": [(0, "1"), (0, 1)]}, "upper bound is .*: pass real numbers"),
        # start
        ({"x0": [0.5, np.nan]}, r"x0\[1\] is nan"),
        ({"x0": [0.5, 0.5 + 1j]}, "x0 is .*real numbers"),
        ({"x0": ["a", "b"]}, "x0 is .*real numbers"),
        # values of fun, with and without its gradient
        ({"fun": lambda x: (x, 2 * x)}, r"value of fun has shape \(2,\): return one number"),
        ({"fun": lambda x: (None, 2 * x)}, "value of fun is None: pass real numbers"),
        ({"fun": lambda x: (1j, 2 * x)}, "value of fun is 1j: pass real numbers"),
        ({"fun": lambda x: (np.nan, 2 * x)}, "f is nan"),
        ({"fun": lambda x: (1.0, 2j * x)}, "gradient is .*real numbers"),
        ({"fun": lambda x: (1.0, (2 * x)[None])}, r"gradient has shape \(1, 2\) where \(2,\)"),
        ({"fun": lambda x: (1.0, [1.0, np.nan])}, r"gradient\[1\] is nan"),
        ({"fun": np.sum, "jac": lambda x: [1.0]}, r"gradient has shape \(1,\) where \(2,\)"),
        # others
        ({"jac": False}, "jac is missing"),
        ({"jac": "2-point"}, "jac is missing"),
        ({"callback": 3}, "callback is 3: pass a callable"),
        ({"options": {"maxiter": -1}}, "maxiter is -1"),
        ({"options": {"maxiter": "9"}}, "maxiter is '9'"),
        ({"options": {"maxiter": np.nan}}, "maxiter is nan"),
        ({"tol": -1e-8}, "tol is -1e-08"),
        ({"tol": np.nan}, "tol is nan"),
        ({"options": {"move_limit": "0.5"}}, "move_limit is '0.5'"),
        ({"options": {"gtol": 1.0, "maxfev": 3}}, "unknown option gtol, maxfev: the options are"),
    ],
)
def test_nothing_is_dropped_or_misread_in_silence(arguments, message):
    with pytest.raises(MMAError, match=message):
        solved(**arguments)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        # scipy.optimize.minimize refuses these itself, or not at all
        ({"x0": [[0.5, 0.5]]}, r"x0 has shape \(1, 2\): it must have one dimension"),
        ({"fun": lambda x: 1.0}, "fun gave 1.0: it must return a pair"),
        ({"fun": 3}, "fun is 3: pass a callable"),
        ({"tol": None}, "tol is None"),
    ],
)
def test_direct_call_is_as_strict(arguments, message):
    good = {"fun": sphere, "x0": [0.5, 0.5], "jac": True, "bounds": [(0, 1)] * 2}
    with pytest.raises(MMAError, match=message):
        minimize(**{**good, **arguments})


def test_gradient_of_one_variable_may_be_a_number():
    result = minimize(
        lambda x: (x[0] - 2) ** 2, [0.5], jac=lambda x: 2 * (x[0] - 2), bounds=[(0, 1)]
    )
    assert result.success and result.x[0] == 1


def test_evaluate_must_return_a_pair_of_real_numbers():
    value: Any
    for value, message in ((1.0, "evaluate gave 1.0"), ((1.0, [1j]), "g is .*real numbers")):
        with pytest.raises(MMAError, match=message):
            MovingAsymptotes([0.0, 0.0], [1.0, 1.0]).step(
                **good_arguments(),
                evaluate=lambda x: value,  # noqa: B023
            )


def test_constants_are_the_published_ones():
    """Of [3], but the least distance, for which see the test of cycles."""
    optimiser = MovingAsymptotes([0.0], [1.0])
    assert optimiser.move_limit == optimiser.asymptote_initial == 0.5
    assert (optimiser.asymptote_decrease, optimiser.asymptote_increase) == (0.7, 1.2)
    assert (optimiser.asymptote_min, optimiser.asymptote_max) == (1e-6, 10)
    assert optimiser.raa0 == 1e-5
    assert (mma.ASYMPTOTE_MARGIN, mma.GRADIENT_SHARE, mma.ELASTIC_COST) == (0.9, 1e-3, 1e3)


def test_distances_stay_within_their_limits():
    optimiser = MovingAsymptotes([0.0] * 3, [1.0] * 3)
    for k in range(60):  # one goes on, one turns back, one stands still
        optimiser.step([0.01 * k, 0.5 + 0.1 * (k % 2), 0.5], 0.0, [1.0] * 3)
    assert optimiser.asymptote_distance.tolist() == [10, 1e-6, 0.5]


def test_step_keeps_away_from_the_asymptotes():
    """Nine tenths of the way at most, where neither bound nor move limit is nearer."""
    optimiser = MovingAsymptotes([0.0], [1.0], asymptote_initial=0.1, raa0=1e-12)
    assert optimiser.step([0.5], 0.0, [1.0])[0] == pytest.approx(0.5 - 0.9 * 0.1, rel=1e-12)


def test_least_convexity_of_the_objective_is_that_of_the_largest_gradient_seen():
    """Until it is to be forgotten: the closed form with raa0 times 5, then times 0.01."""
    optimiser = MovingAsymptotes([0.0], [1.0], raa0=0.1)
    for k, largest in enumerate((5.0, 5.0, 0.01, 0.01)):
        if k == 2:
            optimiser.forget_gradients()
        if k == 3:
            optimiser.reset()
        slope = 5.0 if k == 0 else 0.01
        x = optimiser.step([0.5], 0.0, [slope])
        p, q = 1.001 * slope + 0.1 * largest, 0.001 * slope + 0.1 * largest
        expected = (np.sqrt(q) - np.sqrt(p)) / (np.sqrt(q) + np.sqrt(p))
        assert x[0] == pytest.approx(0.5 + 0.5 * expected, rel=1e-12)


def trial(slope, convexity):
    """The first step t in units of the distance, for one variable on [0, 1] at 0.5."""
    p = max(slope, 0) + 1e-3 * abs(slope) + convexity
    q = max(-slope, 0) + 1e-3 * abs(slope) + convexity
    t = np.clip((np.sqrt(q) - np.sqrt(p)) / (np.sqrt(q) + np.sqrt(p)), -0.9, 0.9)
    return t, 0.5 * (p * t / (1 - t) - q * t / (1 + t))


@pytest.mark.parametrize("excess", [0.01, 0.3, 1e9])
def test_inner_iterations_follow_the_published_rule(excess):
    """rho is a tenth of the mean slope at first, then min(1.1 (rho + excess / w), 10 rho) [2]."""
    slope, f, seen = -2.0, 3.0, []

    def evaluate(x):
        seen.append((x[0] - 0.5) / 0.5)
        return (f + trial(slope, 0.2)[1] + excess, []) if len(seen) == 1 else (-1e9, [])

    MovingAsymptotes([0.0], [1.0]).step([0.5], f, [slope], evaluate=evaluate)
    t = trial(slope, 0.2)[0]
    w = 0.5 * 2 * t**2 / (1 - t**2)
    expected = trial(slope, min(1.1 * (0.2 + excess / w), 2.0))[0]
    np.testing.assert_allclose(seen, [t, expected], rtol=1e-12)


def test_only_functions_that_lie_below_are_made_more_convex():
    """A constraint that is far from active has no influence on the step, raised or not."""
    seen = []

    def evaluate(x):
        seen.append(x[0])
        return -1e9, [-4.0 if len(seen) < 4 else -1e9]

    MovingAsymptotes([0.0], [1.0]).step([0.5], 3.0, [-2.0], [-5.0], [[0.1]], evaluate=evaluate)
    assert len(seen) == 4
    np.testing.assert_allclose(seen, 0.5 + 0.5 * trial(-2.0, 0.2)[0], rtol=1e-6)


@pytest.mark.parametrize(("excess", "calls"), [(5e-15, 1), (5e-14, 2)])
def test_excess_of_the_size_of_rounding_raises_nothing(excess, calls):
    """Rounding of f = 3, twice, and of a slope of 2: 10 times 8 times 2.2e-16 = 1.8e-14."""
    seen = []

    def evaluate(x):
        seen.append(x)
        return (3.0 + trial(-2.0, 0.2)[1] + excess, []) if len(seen) == 1 else (-1e9, [])

    MovingAsymptotes([0.0], [1.0]).step([0.5], 3.0, [-2.0], evaluate=evaluate)
    assert len(seen) == calls


def test_multipliers_do_not_depend_on_the_convexity_that_was_added():
    multipliers = []
    for excess in (0.0, 10.0):
        optimiser, left = MovingAsymptotes([0.0, 0.0], [1.0, 1.0]), [excess, excess, 0.0]

        def evaluate(x):
            more = left.pop(0) if left else 0.0  # noqa: B023
            return (100.0, [100.0]) if more else (-1e9, [-1e9])

        x = optimiser.step([0.5, 0.5], 1.0, [-2.0, -1.0], [0.0], [[1.0, 1.0]], evaluate=evaluate)
        assert np.all(np.isfinite(x))
        multipliers.append(optimiser.multipliers)
    np.testing.assert_allclose(multipliers[0], multipliers[1], rtol=1e-12)
    assert multipliers[0][0] > 0.1


def test_residual_weighs_an_idle_constraint_by_its_multiplier():
    """Complementarity: with f' = -1 and one step from the bound of g the multiplier is not 0."""
    optimiser = MovingAsymptotes([0.0], [1.0])
    optimiser.step([0.5], 0.0, [-1.0], [-0.1], [[1.0]])
    # stationary to first order, feasible, but g = -0.1 is not active
    assert optimiser.multipliers[0] > 0.5
    assert optimiser.kkt_residual >= 0.1 * optimiser.multipliers[0] * (1 - 1e-12)


def test_residual_in_the_unit_of_today_and_of_history():
    """f = 50 (x - 1/2)^2 on [0, 1]: gradient, last step, distance by the last curvature."""
    optimiser = MovingAsymptotes([0.0], [1.0])
    points = [0.9, 0.5 + 1e-3, 0.5 - 1e-5]
    residuals = []
    for x in points:
        optimiser.step([x], 50 * (x - 0.5) ** 2, [100 * (x - 0.5)])
        residuals.append(optimiser.kkt_residual)
    # at first the gradient at x is the unit; then the step of 0.399 is far from small, and at
    # last the gradient is 1e-3 of the largest, 40
    assert residuals[0] == pytest.approx(0.9)
    assert residuals[1] == pytest.approx(0.399**2)
    assert residuals[2] == pytest.approx(1e-3 / 40)


def test_residual_after_restore_knows_no_last_step():
    first = MovingAsymptotes([0.0], [1.0])
    first.step([0.5 + 1e-5], 0.0, [1e-3])
    second = MovingAsymptotes([0.0], [1.0])
    second.step([0.2], 0.0, [1.0])
    second.restore(first.state())
    second.step([0.5], 0.0, [1e-9])
    assert second.kkt_residual == pytest.approx(0.5)  # in units of the gradient at x


def test_state_holds_everything_that_the_next_steps_need():
    """Each entry, changed, changes the steps that follow."""
    optimiser = MovingAsymptotes(np.zeros(2), np.ones(2), raa0=0.1)
    for x in ([0.5, 0.5], [0.6, 0.4], [0.55, 0.35]):
        optimiser.step(x, 0.0, [3.0, 1.0])

    def following(state):
        other = MovingAsymptotes(np.zeros(2), np.ones(2))
        other.restore(state)
        x = other.step([0.57, 0.3], 0.0, [0.2, -0.1])
        return np.append(x, other.step(0.1 + 0.7 * x, 0.0, [-0.02, 0.05]))

    state = optimiser.state()
    expected = following(state)
    changes = {
        "x_previous": np.array([0.9, 0.1]),
        "x_before_previous": np.array([0.1, 0.9]),
        "asymptote_distance": np.array([0.2, 0.2]),
        "gradient_scale": np.array([30.0]),
        "iteration": 1,
        "move_limit": 0.01,
        "asymptote_initial": 0.3,
        "asymptote_increase": 2.0,
        "asymptote_decrease": 0.1,
        "asymptote_min": 0.9,
        "asymptote_max": 0.1,
        "raa0": 1.0,
    }
    assert set(changes) | {"lower", "upper"} == set(state)
    for name, value in changes.items():
        before = {**state, "iteration": 0} if name == "asymptote_initial" else state
        more = {"asymptote_max": 1.0} if name == "asymptote_min" else {}
        more = {"asymptote_min": 1e-9} if name == "asymptote_max" else more
        reference = following({**before, **more})
        assert not np.array_equal(following({**before, **more, name: value}), reference), name
    assert np.array_equal(following(state), expected)


def test_reset_forgets_all():
    """What follows is what a new optimiser does, bit for bit."""
    used, new = (MovingAsymptotes(np.full(5, 1.0), np.full(5, 10.0)) for _ in range(2))
    follow(used, cantilever, np.full(5, 5.0), 7)
    used.reset()
    x = np.array([2.0, 9.0, 4.0, 3.0, 2.0])
    assert np.array_equal(follow(used, cantilever, x, 7), follow(new, cantilever, x, 7))
    assert used.kkt_residual == new.kkt_residual and used.step_size == new.step_size


def test_constraint_that_no_step_can_meet_does_not_hinder_the_rest():
    """One whose slope is 1e13 times smaller than its violation has no say: f decides."""
    alone, beside = (MovingAsymptotes([0.0], [1.0]) for _ in range(2))
    x = alone.step([0.5], 0.0, [1.0])
    for g, slope in ((1.0, 0.0), (0.0, 0.0), (1.0, -1e-13), (1e9, -1e-4)):
        beside.reset()
        y = beside.step([0.5], 0.0, [1.0], [g], [[slope]])
        np.testing.assert_allclose(y, x, atol=0.1)
    for slope in (-1e-2, -1e-6):  # one that gains from the step goes before f
        beside.reset()
        assert beside.step([0.5], 0.0, [1.0], [1.0], [[slope]])[0] > 0.9


@pytest.mark.parametrize("side", [1, -1])
def test_subproblem_knows_the_bounds(side):
    """What x0 cannot take of a constraint, because of its bound, x1 takes: g~ is used up."""
    optimiser = MovingAsymptotes([-1.0, -1.0], [1.0, 1.0])
    x = side * np.array([0.99, 0.1])
    new = optimiser.step(x, 0.0, [-side * 2.0, -side * 1.0], [-0.1], [[side * 1.0, side * 1.0]])
    assert new[0] == pytest.approx(side, rel=1e-9)
    t = side * (new - x)  # the distance of the asymptotes is 0.5 of 2
    slope = 2.0  # times the range
    p, q = 1.001 * slope + 1e-5 * slope, 0.001 * slope + 1e-5 * slope
    assert np.sum(0.5 * (p * t / (1 - t) - q * t / (1 + t))) == pytest.approx(0.1, rel=1e-8)


def test_steps_stay_within_the_bounds_to_the_last_bit(rng):
    for _ in range(200):
        low = rng.uniform(-1, 1, 3)
        high = low + 10 ** rng.uniform(-6, 2, 3)
        optimiser = MovingAsymptotes(low, high, move_limit=1.0, asymptote_initial=1.3)
        x = low + rng.random(3) * (high - low)
        new = optimiser.step(np.clip(x, low, high), 0.0, rng.choice([-1, 1], 3) / (high - low))
        assert np.all(new >= low) and np.all(new <= high)


def test_step_of_length_zero_is_not_repeated():
    seen = []

    def evaluate(x):
        seen.append(x)
        return 5.0, []  # above any approximation, although x is the same

    new = MovingAsymptotes([0.0], [1.0]).step([0.0], 0.0, [1.0], evaluate=evaluate)
    assert new[0] == 0 and len(seen) == 1


def test_optimality_counts_the_gap_and_the_curvature_of_the_lagrangian():
    """The greatest of gradient and gap, in the unit of today; or in that of history if near."""
    optimiser, below, one = MovingAsymptotes([0.0], [1.0]), np.array([0.5]), np.ones(1)
    balanced = np.array([[2.0], [-2.0]])
    assert optimiser._optimality(below, 0.0, balanced, one, 0.3, 2.0) == 0.3 / 2
    optimiser._slopes = np.array([[3.0], [-2.0]])
    assert optimiser._optimality(below, 1e-3, balanced, one, 0.3, 10.0) == 0.3 / 10
    # The gradient of the Lagrangian fell from 0.15 to 0.1 over 0.2: it vanishes 0.4 further on.
    optimiser._slopes = np.array([[1.0], [-0.85]])
    far = optimiser._optimality(below, 0.2, np.array([[1.0], [-0.9]]), one, 5.0, 100.0)
    assert far == pytest.approx(0.4**2)


def test_evaluate_may_overwrite_its_argument():
    def evaluate(x):
        x[...] = np.nan
        return -1e9, []

    new = MovingAsymptotes([0.0], [1.0]).step([0.5], 3.0, [-2.0], evaluate=evaluate)
    assert new[0] == pytest.approx(0.5 + 0.5 * trial(-2.0, 0.2)[0])


def test_violation_is_measured_by_the_gradient_at_x():
    optimiser = MovingAsymptotes([0.0], [1.0])
    optimiser.step([0.9], 0.0, [1.0], [-1.0], [[1e8]])
    optimiser.step([0.8], 0.0, [1.0], [20.0], [[-1e-2]])
    assert optimiser.violations[0] == pytest.approx(20 / 1e-2)
    assert optimiser.kkt_residual >= optimiser.violations[0]
