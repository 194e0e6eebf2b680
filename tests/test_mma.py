"""The method of moving asymptotes: published optima, laws, refusals."""

import time

import numpy as np
import pytest
from scipy.optimize import Bounds, LinearConstraint, NonlinearConstraint
from scipy.optimize import minimize as scipy_minimize

from mpmopt import mma
from mpmopt.mma import MMAError, MovingAsymptotes

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
    g, dgdx = [x.sum() - 3], [[1.0, 1.0, 1.0, 0.0]]
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
    constraint = {
        "type": "ineq",
        "fun": lambda x: -np.array(problem(x)[2]),
        "jac": lambda x: -np.array(problem(x)[3]),
    }
    return mma.minimize(
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
    assert "violation 1.00e+00" in result.message
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
    result = mma.minimize(
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
    mma.minimize(
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


def test_fixed_variable_in_a_constraint_without_jacobian():
    """min x + y + z with x y z >= 2 and z = 1: finite differences have no room in z."""
    result = mma.minimize(
        lambda x: (x.sum(), np.ones(3)),
        [1.0, 2.5, 1.0],
        jac=True,
        bounds=[(0.1, 5), (0.1, 5), (1, 1)],
        constraints=NonlinearConstraint(np.prod, 2, np.inf),
        tol=1e-7,
    )
    assert result.success
    np.testing.assert_allclose(result.x, [np.sqrt(2), np.sqrt(2), 1], rtol=1e-6)


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
    "dict": {
        "type": "ineq",
        "fun": lambda x, top: [x[0] * x[1] - 2, top - x[0] * x[1]],
        "jac": lambda x, top: [[x[1], x[0]], [-x[1], -x[0]]],
        "args": (3.0,),
    },
    "dict without jac": {"type": "ineq", "fun": lambda x: [x[0] * x[1] - 2, 3 - x[0] * x[1]]},
    "nonlinear": NonlinearConstraint(lambda x: x[0] * x[1], 2.0, 3.0, jac=lambda x: [x[1], x[0]]),
    "nonlinear without jac": NonlinearConstraint(lambda x: x[0] * x[1], 2.0, 3.0),
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
        method=mma.minimize,
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
        method=mma.minimize,
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
        method=mma.minimize,
        callback=callback,
    )
    assert len(seen) == result.nit == 4 and result.status == 3 and not result.success
    assert np.array_equal(seen[-1], result.x)


def test_wrong_gradient_is_not_taken_for_convergence():
    """With the sign of the gradient reversed no step can be conservative."""
    result = mma.minimize(
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
        ({"bounds": [(0, None), (0, 1)]}, r"upper bound\[0\] is nan: give"),
        ({"bounds": [(0, 1)] * 3}, "x has shape"),
        ({"hess": lambda x: np.eye(2)}, "no Hessian"),
        ({"options": {"ftol": 1.0}}, "unknown option ftol: the options are maxiter"),
        ({"constraints": {"type": "eq", "fun": np.sum}}, "eliminate a variable"),
        ({"constraints": LinearConstraint([1, 1], 1, 1)}, "eliminate a variable"),
        ({"constraints": NonlinearConstraint(np.sum, 1, 1)}, "eliminate a variable"),
        ({"constraints": {"type": "box", "fun": np.sum}}, "'box'"),
        ({"constraints": [np.sum]}, "pass a LinearConstraint"),
        ({"x0": [2.0, 0.0]}, "outside its bounds"),
    ],
)
def test_minimize_refuses_what_it_cannot_do(arguments, message):
    good = {"x0": [0.5, 0.5], "jac": True, "bounds": [(0, 1)] * 2}
    with pytest.raises(MMAError, match=message):
        scipy_minimize(lambda x: (x @ x, 2 * x), method=mma.minimize, **{**good, **arguments})
