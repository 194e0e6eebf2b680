"""The method of moving asymptotes, for any problem with bounds and few constraints.

    minimise f(x)  subject to  g_i(x) <= 0,  i = 1..m,  and  lower <= x <= upper

At the iterate x every function is replaced by a separable convex one with poles at the
asymptotes x_j - d_j and x_j + d_j. The asymptotes of one variable keep equal distances d_j,
so with t_j = (x'_j - x_j) / d_j in (-1, 1) it reads

    f~_i(t) = f_i + sum_j d_j (P_ij t_j / (1 - t_j) - Q_ij t_j / (1 + t_j)),

where P_ij - Q_ij = df_i/dx_j. Its minimiser is the next iterate.

Three sources are cited by number:

1. K. Svanberg, The method of moving asymptotes - a new method for structural optimization,
   Int. J. Numer. Meth. Eng. 24 (1987) 359-373: the approximation, the moving asymptotes.
2. K. Svanberg, A class of globally convergent optimization methods based on conservative
   convex separable approximations, SIAM J. Optim. 12 (2002) 555-573: the inner iterations.
3. K. Svanberg, MMA and GCMMA - two methods for nonlinear optimization, KTH (2007):
   the constants, and the elastic variables that keep every subproblem feasible.
"""

import copy
import inspect
import reprlib
from collections.abc import Callable, Iterable, Mapping
from numbers import Real
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.optimize import Bounds, LinearConstraint, NonlinearConstraint, OptimizeResult
from scipy.optimize._numdiff import approx_derivative

from mpmopt.errors import MpmoptError

Array = npt.NDArray[np.float64]
Evaluate = Callable[[Array], tuple[float, npt.ArrayLike]]

ASYMPTOTE_MARGIN = 0.9  # how far towards an asymptote a step may go: alpha, beta of [3]
GRADIENT_SHARE = 1e-3  # of |df/dx| that both P and Q receive, so that none is zero [3]
ELASTIC_COST = 1e3  # c_i of [3], for functions scaled to gradients of size one
INNER_ITERATIONS = 30  # of the globally convergent variant; convexity grows up to 10 times in each
PRECISION = 1e-12  # of the subproblem's solution, relative to the change over one step
HOPELESS = 1e-8  # a constraint whose gradient is so much smaller than its value loses weight
TINY = 1e-150  # gradients below would overflow in quotients
FADED = 1e-6  # a gradient so much smaller than the largest seen moves x little: raa0
EPSILON = float(np.finfo(np.float64).eps)


class MMAError(MpmoptError, ValueError):
    """An argument that the method of moving asymptotes cannot work with."""


class MovingAsymptotes:
    """The method of moving asymptotes and everything it remembers between steps.

    Parameters
    ----------
    lower, upper : array_like, shape (n,)
        Finite bounds, in the unit of x. A variable with equal bounds stays where it is.
    move_limit : float
        Greatest step of a variable, as a fraction of its range. May be changed between steps.
    asymptote_initial : float
        Distance of the asymptotes in the first two steps, as a fraction of the range.
    asymptote_increase, asymptote_decrease : float
        Factors on the distance of a variable that goes on or turns back.
    asymptote_min, asymptote_max : float
        Least and greatest distance, as fractions of the range. A least distance of 0.01, which
        is often used, can end in cycles of that size.
    raa0 : float
        Least convexity of the approximations. It is relative to the largest gradient of f seen
        since the last reset, and to that of g_i at x, so that the iterates do not depend on the
        scale of f or g.

    Attributes
    ----------
    multipliers : ndarray, shape (m,)
        Lagrange multipliers (>= 0) of the last subproblem.
    violations : ndarray, shape (m,)
        Violations of the constraints at the x of the last step, in units of the largest gradient
        entry of each *at that x* times range: about the fraction of a range to a feasible point.
        Infinite where a violated constraint has no gradient.
    kkt_residual : float
        How far the x of the last step was from a Karush-Kuhn-Tucker point: the greatest of
        projected gradient of the Lagrangian, violations, and complementarity (multiplier times
        value). Dimensionless: x is measured in ranges, and the first and the third, which have
        the unit of f, by the largest gradient entry of f at x times range. At a minimum within
        the bounds that gradient vanishes: there the measure is the largest seen since the last
        reset, and the squares of the last step and of the distance to the minimum that the
        curvature over this step tells must not be larger either.
    step_size : float
        Greatest change of a variable in the last step, as a fraction of its range.

    Raises
    ------
    MMAError
        If bounds or parameters cannot be used.
    """

    def __init__(
        self,
        lower: npt.ArrayLike,
        upper: npt.ArrayLike,
        *,
        move_limit: float = 0.5,
        asymptote_initial: float = 0.5,
        asymptote_increase: float = 1.2,
        asymptote_decrease: float = 0.7,
        asymptote_min: float = 1e-6,
        asymptote_max: float = 10.0,
        raa0: float = 1e-5,
    ) -> None:
        n = np.size(lower)
        self.lower = _checked("lower bound", lower, (n,), "give every variable finite bounds")
        self.upper = _checked("upper bound", upper, (n,), "give every variable finite bounds")
        if np.any(self.lower > self.upper):
            j = int(np.argmax(self.lower > self.upper))
            raise MMAError(
                f"lower bound {self.lower[j]} of variable {j} is above its upper bound "
                f"{self.upper[j]}: exchange them"
            )
        self.move_limit = move_limit
        self.asymptote_initial = asymptote_initial
        self.asymptote_increase = asymptote_increase
        self.asymptote_decrease = asymptote_decrease
        self.asymptote_min = asymptote_min
        self.asymptote_max = asymptote_max
        self.raa0 = raa0
        self._check_parameters()
        self.reset()

    def _check_parameters(self) -> None:
        for name in PARAMETERS:
            value = getattr(self, name)
            number = isinstance(value, Real)
            if not (number and 0 < value < np.inf):
                raise MMAError(f"{name} is {value!r}: it must be a positive finite number")
        if not self.asymptote_decrease <= 1 <= self.asymptote_increase:
            raise MMAError(
                f"asymptote_decrease, asymptote_increase are {self.asymptote_decrease}, "
                f"{self.asymptote_increase}: take the first at most and the second at least 1"
            )
        if self.asymptote_min > self.asymptote_max:
            raise MMAError(
                f"asymptote_min {self.asymptote_min} is above asymptote_max {self.asymptote_max}"
            )

    def reset(self) -> None:
        """Forget all earlier iterates and gradients; the parameters stay."""
        self.iteration = 0
        self.x_previous = self.lower.copy()
        self.x_before_previous = self.lower.copy()
        self.asymptote_distance = np.full(self.lower.size, self.asymptote_initial)
        self.gradient_scale: Array = np.zeros(0)
        self.multipliers: Array = np.zeros(0)
        self.violations: Array = np.zeros(0)
        self._slopes: Array | None = None  # of the last step; only the residual needs them
        self.kkt_residual = np.inf
        self.step_size = np.inf

    def state(self) -> dict[str, npt.NDArray[Any] | float | int]:
        """All that the next step depends on, as arrays and numbers, for `restore`."""
        arrays = {name: getattr(self, name).copy() for name in STATE_ARRAYS}
        numbers = {name: getattr(self, name) for name in PARAMETERS}
        return {**arrays, **numbers, "iteration": self.iteration}

    def restore(self, state: Mapping[str, Any]) -> None:
        """Take up a `state`: the steps that follow are bit for bit those of the original.

        Raises
        ------
        MMAError
            If an entry is missing or belongs to another number of variables or other bounds.
        """
        missing = [k for k in (*STATE_ARRAYS, *PARAMETERS, "iteration") if k not in state]
        if missing:
            raise MMAError(f"the state lacks {', '.join(missing)}: pass what state() returned")
        for name, bound in (("lower", self.lower), ("upper", self.upper)):
            if not np.array_equal(state[name], bound):
                raise MMAError(f"the state has another {name} bound: construct with its bounds")
        for name in STATE_ARRAYS:
            setattr(self, name, np.array(state[name], dtype=np.float64))
        for name in PARAMETERS:
            setattr(self, name, float(state[name]))
        self.iteration = int(state["iteration"])
        self._slopes = None

    def step(
        self,
        x: npt.ArrayLike,
        f: float,
        dfdx: npt.ArrayLike,
        g: npt.ArrayLike | None = None,
        dgdx: npt.ArrayLike | None = None,
        evaluate: Evaluate | None = None,
    ) -> Array:
        """The next iterate.

        Parameters
        ----------
        x : array_like, shape (n,)
            The iterate, within the bounds.
        f : float
            Objective at x.
        dfdx : array_like, shape (n,)
            Its gradient.
        g : array_like, shape (m,), optional
            Constraints g <= 0 at x; x may violate them.
        dgdx : array_like, shape (m, n), optional
            Their Jacobian matrix.
        evaluate : callable, optional
            ``evaluate(x) -> (f, g)``. With it the step is that of the globally convergent
            variant: the approximations are made more convex until they lie above f and g at
            the next iterate, which then is the last point evaluated [2].

        Returns
        -------
        ndarray, shape (n,)
            The next iterate, a new array.

        Raises
        ------
        MMAError
            If a value is not finite, a shape does not fit, or x is out of bounds.
        """
        self._check_parameters()
        n = self.lower.size
        x = _checked("x", x, (n,), "start from a finite x")
        self._refuse_outside("x", x)
        if (g is None) != (dgdx is None):
            raise MMAError("g and dgdx belong together: pass both or none")
        if g is None or dgdx is None:
            g, dgdx = np.zeros(0), np.zeros((0, n))
        m = np.size(g)
        values = _checked_values(f, g, m)
        gradients = np.vstack(
            [_checked("dfdx", dfdx, (n,), REJECT), _checked("dgdx", dgdx, (m, n), REJECT)]
        )
        if self.iteration and self.gradient_scale.size != 1 + m:
            raise MMAError(
                f"{m} constraints after steps with {self.gradient_scale.size - 1}: call reset()"
            )

        free = self.upper > self.lower  # fixed variables take no part
        span = (self.upper - self.lower)[free]
        slopes = gradients[:, free] * span
        size = np.abs(slopes).max(axis=1, initial=0.0)
        seen = np.maximum(self.gradient_scale, size) if self.iteration else size
        scale = np.where(seen > 0, seen, 1.0)
        # A constraint is measured by its gradient at x: one seen long ago may be larger by any
        # factor. One that no step within the bounds can meet must not hinder the rest.
        scale[1:] = np.maximum(size, np.maximum(HOPELESS * np.abs(values), TINY))[1:]

        all_distances = self._next_distance(x)
        distance = all_distances[free]
        below, above = (x - self.lower)[free] / span, (self.upper - x)[free] / span
        limit = np.minimum(ASYMPTOTE_MARGIN, self.move_limit / distance)
        low = -np.minimum(limit, below / distance)
        high = np.minimum(limit, above / distance)
        # Violating a constraint must cost more than its multiplier, which is about df / dg.
        cost = ELASTIC_COST * scale[0] / scale[1:]

        convexity = self.raa0 * scale
        if evaluate is not None:  # the starting value of [3]
            mean_slope = np.abs(slopes).sum(axis=1) / max(span.size, 1)
            convexity = np.maximum(convexity, 0.1 * mean_slope)
        for inner in range(INNER_ITERATIONS):
            shared = GRADIENT_SHARE * np.abs(slopes) + convexity[:, None]
            rise = distance * (np.maximum(slopes, 0) + shared)
            fall = distance * (np.maximum(-slopes, 0) + shared)
            t, lam = _solve_subproblem(rise, fall, values[1:], low, high, cost)
            if inner == 0:  # added convexity distorts them
                multipliers = lam
            x_next = x.copy()
            x_next[free] += span * distance * t
            x_next = np.clip(x_next, self.lower, self.upper)
            if evaluate is None:
                break
            actual = _checked_values(*_pair("evaluate", evaluate(x_next.copy())), m)
            excess = actual - (values + rise @ (t / (1 - t)) - fall @ (t / (1 + t)))
            noise = 10 * EPSILON * (np.abs(values) + np.abs(actual) + np.abs(slopes).sum(axis=1))
            growth = float(distance @ (2 * t**2 / (1 - t**2)))  # df~/d convexity
            if growth == 0 or np.all(excess <= noise):
                break
            # the update of [2], for those that lie below their function
            raised = np.minimum(1.1 * (convexity + excess / growth), 10 * convexity)
            convexity = np.where(excess > noise, raised, convexity)

        # Not counted: what the rounding of x does to g. Without gradient there is no unit.
        beyond = values[1:] - 10 * EPSILON * (np.abs(gradients[1:]) @ np.abs(x))
        beyond = np.where(values[1:] > 0, np.maximum(beyond, 0.0), values[1:])
        moved = float((np.abs(x - self.x_previous)[free] / span).max(initial=0.0))
        with np.errstate(over="ignore", divide="ignore", invalid="ignore"):
            self.violations = np.where(beyond > 0, beyond / size[1:], 0.0)
            gap = float((multipliers * np.abs(beyond)).max(initial=0.0))
            optimality = self._optimality(below, moved, slopes, multipliers, gap, scale[0])
        self.kkt_residual = max(optimality, float(self.violations.max(initial=0.0)))
        self._slopes = slopes
        self.step_size = float((np.abs(x_next - x)[free] / span).max(initial=0.0))
        self.multipliers = multipliers
        self.gradient_scale = seen
        self.asymptote_distance = all_distances
        self.x_before_previous, self.x_previous = self.x_previous, x
        self.iteration += 1
        return x_next

    def _optimality(
        self,
        below: Array,
        moved: float,
        slopes: Array,
        multipliers: Array,
        gap: float,
        largest: float,
    ) -> float:
        """Projected gradient and complementarity, in the unit that `MovingAsymptotes` tells."""
        lagrangian = slopes[0] + multipliers @ slopes[1:]
        size = float(np.abs(slopes[0]).max(initial=0.0)) or 1.0
        by_gradient = max(_projected(below, lagrangian / size), gap / size)
        if self._slopes is None:
            return by_gradient
        # The step of Newton's method, with the curvature that the last step showed.
        before = self._slopes[0] + multipliers @ self._slopes[1:]
        change = float(np.abs(lagrangian - before).max(initial=0.0))
        newton = _projected(below, lagrangian * moved / change) if moved and change else np.inf
        by_largest = max(_projected(below, lagrangian / largest), gap / largest)
        return min(by_gradient, max(by_largest, moved**2, newton**2))

    def _refuse_outside(self, name: str, x: Array) -> None:
        outside = np.maximum(self.lower - x, x - self.upper)
        if np.any(outside > 0):
            j = int(np.argmax(outside))
            raise MMAError(
                f"{name}[{j}] = {x[j]} is outside its bounds [{self.lower[j]}, {self.upper[j]}]: "
                f"clip {name} to the bounds"
            )

    def _next_distance(self, x: Array) -> Array:
        """Distances of the asymptotes from x as fractions of the range, rule of [3]."""
        if self.iteration < 2:
            return np.full(x.size, self.asymptote_initial)
        turn = (x - self.x_previous) * (self.x_previous - self.x_before_previous)
        factor = np.where(
            turn > 0, self.asymptote_increase, np.where(turn < 0, self.asymptote_decrease, 1.0)
        )
        return np.clip(factor * self.asymptote_distance, self.asymptote_min, self.asymptote_max)


PARAMETERS = (
    "move_limit",
    "asymptote_initial",
    "asymptote_increase",
    "asymptote_decrease",
    "asymptote_min",
    "asymptote_max",
    "raa0",
)
STATE_ARRAYS = (
    "lower",
    "upper",
    "x_previous",
    "x_before_previous",
    "asymptote_distance",
    "gradient_scale",
)
REJECT = "reject this point, and go back to the last good one with half the move_limit"


def _checked(name: str, value: npt.ArrayLike, shape: tuple[int, ...], cure: str) -> Array:
    """A new float array of that shape, or the named error."""
    array = _real(name, value)
    if array.shape != shape:
        raise MMAError(f"{name} has shape {array.shape} where {shape} is needed")
    if not np.all(np.isfinite(array)):
        j = tuple(int(k) for k in np.argwhere(~np.isfinite(array))[0])
        where = str(list(j)) if j else ""
        raise MMAError(f"{name}{where} is {array[j]}: {cure}")
    return array


def _projected(below: Array, gradient: Array) -> float:
    """Greatest step against the gradient that the bounds 0 and 1 leave at `below`."""
    return float(np.abs(below - np.clip(below - gradient, 0.0, 1.0)).max(initial=0.0))


def _real(name: str, value: Any) -> Array:
    """A new float array. NumPy would drop imaginary parts, and make NaN of None."""
    try:
        array = np.array(value)
        if array.dtype.kind == "O":  # of numbers that NumPy does not know
            array = np.array([float(v) for v in array.flat]).reshape(array.shape)
        if array.dtype.kind not in "biuf":
            raise TypeError
    except (TypeError, ValueError):
        raise MMAError(f"{name} is {reprlib.repr(value)}: pass real numbers") from None
    return array.astype(np.float64)


def _checked_values(f: float, g: npt.ArrayLike, m: int) -> Array:
    """(f, g_1, ..., g_m)."""
    return np.append(_checked("f", f, (), REJECT), _checked("g", np.ravel(g), (m,), REJECT))


def _minimiser(p: Array, q: Array, low: Array, high: Array) -> Array:
    """Where sum_j p_j t_j / (1 - t_j) - q_j t_j / (1 + t_j) is least within its limits [1]."""
    root_p, root_q = np.sqrt(p), np.sqrt(q)
    return np.clip((root_q - root_p) / (root_q + root_p), low, high)


def _barrier_minimiser(
    p: Array, q: Array, low: Array, width: Array, mu: float, tau: Array
) -> tuple[Array, Array]:
    """The same with - mu log(tau) - mu log(1 - tau) added, where t = low + width tau.

    `tau` is the first guess. Returns tau and the second derivatives with respect to it.
    """
    left, right = np.full(tau.size, EPSILON), np.full(tau.size, 1 - EPSILON)
    for _ in range(100):
        t = low + width * tau
        slope = width * (p / (1 - t) ** 2 - q / (1 + t) ** 2)
        curvature = 2 * width**2 * (p / (1 - t) ** 3 + q / (1 + t) ** 3)
        # The derivative times tau (1 - tau) has the same root but no poles: Newton's method
        # finds it in a few steps, bisection where it does not.
        value = tau * (1 - tau) * slope - mu * (1 - 2 * tau)
        rate = tau * (1 - tau) * curvature + (1 - 2 * tau) * slope + 2 * mu
        left, right = np.where(value < 0, tau, left), np.where(value > 0, tau, right)
        newton = np.clip(tau - value / np.where(rate > 0, rate, 1.0), EPSILON, 1 - EPSILON)
        inside = (rate > 0) & (newton >= left) & (newton <= right)
        old, tau = tau, np.where(inside, newton, 0.5 * (left + right))
        if np.all(np.abs(tau - old) <= 1e-13 * old):
            break
    return tau, curvature + mu / tau**2 + mu / (1 - tau) ** 2


def _solve_subproblem(
    rise: Array, fall: Array, g: Array, low: Array, high: Array, cost: Array
) -> tuple[Array, Array]:
    """Minimise the approximation of f within low <= t <= high, the others kept <= 0.

    The elastic variables y of [3] keep it feasible:

        min f~_0(t) + cost . y   subject to   f~_i(t) <= y_i,  y >= 0.

    Its concave dual, over 0 <= lam <= cost, is maximised by Newton's method along the path of
    the logarithmic barrier. For given multipliers each t_j is found alone, so that the linear
    systems are m x m, and the nonlinearity of f~ cannot hold up the search.

    rise, fall: shape (1 + m, n), the d_j P_ij and d_j Q_ij of the module's formula.
    Returns t and the multipliers, shape (m,).
    """
    if not g.size:
        return _minimiser(rise[0], fall[0], low, high), np.zeros(0)

    # Scale so that every function varies by about one as tau runs over its box [0, 1].
    width = high - low
    size = np.maximum(np.abs(rise - fall), 1e-4 * (rise + fall))
    size = (size * width).max(axis=1, initial=0.0)
    size = np.where(size > 0, size, 1.0)
    rise, fall = rise / size[:, None], fall / size[:, None]
    g, cost = g / size[1:], cost * size[1:] / size[0]

    def dual(lam: Array, surplus: Array, mu: float, tau: Array) -> tuple[Array, Array, Array]:
        """Gradient of the dual with its barriers, and the tau and curvatures behind it."""
        p, q = rise[0] + lam @ rise[1:], fall[0] + lam @ fall[1:]
        tau, curvature = _barrier_minimiser(p, q, low, width, mu, tau)
        t = low + width * tau
        value = g + rise[1:] @ (t / (1 - t)) - fall[1:] @ (t / (1 + t))
        return value + mu / lam - mu / surplus, tau, curvature

    tau = np.full(width.size, 0.5)
    lam = np.minimum(1.0, 0.5 * cost)
    surplus = cost - lam  # carried along, not recomputed: it may become tiny
    mu = 1.0
    slack, elastic = mu / lam, mu / surplus
    while True:
        gradient, tau, curvature = dual(lam, surplus, mu, tau)
        for _ in range(50):
            t = low + width * tau
            slope = width * (rise[1:] / (1 - t) ** 2 - fall[1:] / (1 + t) ** 2)
            matrix = (slope / curvature) @ slope.T + np.diag(slack / lam + elastic / surplus)
            d = np.linalg.solve(matrix, gradient)
            ascent = float(gradient @ d)
            close = ascent <= 1e-3 * mu
            if mu <= PRECISION:
                close = close and float(np.abs(gradient).max()) <= 10 * PRECISION
            if close or np.all(np.abs(d) <= EPSILON * lam):
                break
            length = 1 / max(1.0, float(np.max([-d / lam, d / surplus])) / 0.99)
            for _ in range(30):  # halve the step while the dual falls at its end
                new = dual(lam + length * d, surplus - length * d, mu, tau)
                if new[0] @ d >= -0.5 * ascent:
                    break
                length /= 2
            gradient, tau, curvature = new
            # Primal-dual estimates of mu / lam and mu / surplus: the matrix then keeps its
            # quality when mu falls.
            slack = slack + length * (mu / lam - slack - slack / lam * d)
            elastic = elastic + length * (mu / surplus - elastic + elastic / surplus * d)
            lam, surplus = lam + length * d, surplus - length * d
            slack = np.clip(slack, 0.01 * mu / lam, 100 * mu / lam)
            elastic = np.clip(elastic, 0.01 * mu / surplus, 100 * mu / surplus)
        if mu <= PRECISION:
            return low + width * tau, lam * size[0] / size[1:]
        mu = max(0.1 * mu, PRECISION)


class _Rows:
    """A constraint of scipy.optimize as rows g(x) <= 0: lower limits first, then upper."""

    def __init__(self, name: str, constraint: Any, x0: Array, lower: Array, upper: Array) -> None:
        self.name, self.lower, self.upper = name, lower, upper
        self.jac: Any = "2-point"
        self.rel_step: Any = None
        limits: tuple[Any, Any]
        if isinstance(constraint, LinearConstraint):
            matrix = np.atleast_2d(_dense(f"the matrix of {name}", constraint.A))
            if matrix.shape[1] != x0.size:
                raise MMAError(
                    f"the matrix of {name} has shape {matrix.shape}, but there are {x0.size} "
                    "variables: give it one column for each"
                )
            self.fun: Any = lambda x: matrix @ x
            self.jac = lambda x: matrix
            limits = constraint.lb, constraint.ub
        elif isinstance(constraint, NonlinearConstraint):
            self.fun, self.jac = constraint.fun, constraint.jac
            self.rel_step = constraint.finite_diff_rel_step
            limits = constraint.lb, constraint.ub
        elif isinstance(constraint, Mapping) and "type" in constraint and "fun" in constraint:
            self.fun, self.jac, upper_limit = self._of_mapping(constraint)
            limits = 0.0, upper_limit
        else:
            raise MMAError(
                f"{name} is {reprlib.repr(constraint)}: pass a LinearConstraint, a "
                "NonlinearConstraint, or a dict with 'type': 'ineq' and 'fun'"
            )
        if np.any(getattr(constraint, "keep_feasible", False)):
            raise MMAError(
                f"{name} has keep_feasible=True, but moving asymptotes may violate a constraint "
                "on their way: leave it out, and let the functions stand such points"
            )
        if not callable(self.fun):
            raise MMAError(f"the fun of {name} is {self.fun!r}: pass a callable")
        if not (callable(self.jac) or str(self.jac) in ("2-point", "3-point", "cs")):
            raise MMAError(
                f"the jac of {name} is {reprlib.repr(self.jac)}: pass a callable, or '2-point', "
                "'3-point' or 'cs'"
            )
        self.size = np.size(self.fun(x0.copy()))
        self.components(x0)  # refuses what is no vector
        self.low, self.high = (
            _spread(f"the {side} limit of {name}", value, self.size, "components")
            for side, value in zip(("lower", "upper"), limits, strict=True)
        )
        if np.any(self.low >= self.high):
            i = int(np.argmax(self.low >= self.high))
            raise MMAError(
                f"the limits {self.low[i]}, {self.high[i]} of {name}[{i}] are equal or reversed, "
                "but moving asymptotes need inequalities: eliminate a variable, or widen the "
                "limits to a tolerance"
            )
        self.has_low, self.has_high = np.isfinite(self.low), np.isfinite(self.high)
        self.count = int(np.sum(self.has_low) + np.sum(self.has_high))

    def _of_mapping(self, constraint: Mapping[str, Any]) -> tuple[Any, Any, float]:
        """Its function, Jacobian matrix and upper limit."""
        kind = str(constraint["type"]).lower()
        if kind not in ("ineq", "eq"):
            raise MMAError(
                f"the type of {self.name} is {constraint['type']!r}: 'ineq' is what there is"
            )
        unknown = sorted(str(key) for key in set(constraint) - {"type", "fun", "jac", "args"})
        if unknown:
            raise MMAError(
                f"{self.name} has the unknown key {', '.join(unknown)}: the keys are type, fun, "
                "jac, args"
            )
        args = constraint.get("args", ())
        if not isinstance(args, tuple | list):
            raise MMAError(f"the args of {self.name} are {reprlib.repr(args)}: pass a tuple")
        function: Any = constraint["fun"]
        derivative: Any = constraint.get("jac")
        if not callable(function):
            raise MMAError(f"the fun of {self.name} is {function!r}: pass a callable")

        def differentiated(x: Array) -> Any:
            return derivative(x, *args)

        jac: Any = differentiated if callable(derivative) else derivative
        jac = "2-point" if jac is None or jac is False else jac
        return lambda x: function(x, *args), jac, np.inf if kind == "ineq" else 0.0

    def components(self, x: Array) -> Array:
        """The values of its function, one for each component."""
        values = np.atleast_1d(_real(f"the value of {self.name}", self.fun(x.copy())))
        if values.shape != (self.size,):
            raise MMAError(
                f"the value of {self.name} has shape {values.shape} where ({self.size},) is "
                "needed: return a vector, of the same length everywhere"
            )
        if not np.all(np.isfinite(values)):
            i = int(np.argmin(np.isfinite(values)))
            raise MMAError(
                f"{self.name}[{i}] is {values[i]} at x = {reprlib.repr(x.tolist())}: give bounds "
                "within which it is finite"
            )
        return values

    def value(self, x: Array) -> Array:
        c = self.components(x)
        return np.append((self.low - c)[self.has_low], (c - self.high)[self.has_high])

    def jacobian(self, x: Array) -> Array:
        name, m, n = f"the Jacobian matrix of {self.name}", self.size, x.size
        matrix = self._differences(x) if not callable(self.jac) else self.jac(x.copy())
        matrix = _dense(name, matrix)
        # A vector is one row, or one column, where it cannot be anything else.
        if matrix.ndim < 2 and 1 in (m, n) and matrix.size == m * n:
            matrix = matrix.reshape(m, n)
        if matrix.shape != (m, n):
            hint = "transpose it" if matrix.shape == (n, m) else "one row for each component"
            raise MMAError(f"{name} has shape {matrix.shape} where {m, n} is needed: {hint}")
        if not np.all(np.isfinite(matrix)):
            i, j = (int(k) for k in np.argwhere(~np.isfinite(matrix))[0])
            raise MMAError(f"{name} is {matrix[i, j]} at [{i}, {j}]: {REJECT}")
        return np.vstack([-matrix[self.has_low], matrix[self.has_high]])

    def _differences(self, x: Array) -> Array:
        """By finite differences within the bounds; a fixed variable, which has no room, has 0."""
        free = self.lower < self.upper

        def function(part: Any) -> Any:
            whole = x.astype(part.dtype)
            whole[free] = part
            return np.atleast_1d(np.array(self.fun(whole)))  # a copy: it may be a buffer

        matrix = np.zeros((self.size, x.size))
        if np.any(free) and self.size:
            step = self.rel_step
            matrix[:, free] = approx_derivative(
                function,
                x[free],
                method=self.jac,
                rel_step=step if step is None or np.ndim(step) == 0 else np.asarray(step)[free],
                bounds=(self.lower[free], self.upper[free]),
            )
        return matrix

    def violated(self, row: int, amount: float) -> str:
        """Which limit the row is, and that it is violated by that amount."""
        lower = np.flatnonzero(self.has_low)
        if row < lower.size:
            i, side, limit = lower[row], "lower", self.low
        else:
            i, side, limit = np.flatnonzero(self.has_high)[row - lower.size], "upper", self.high
        return f"{self.name}[{i}] violates its {side} limit {limit[i]:g} by {amount:.6g}"


def _dense(name: str, matrix: Any) -> Array:
    return _real(name, matrix.toarray() if hasattr(matrix, "toarray") else matrix)


def _pair(name: str, value: Any) -> tuple[Any, Any]:
    """The first two, as scipy.optimize takes them."""
    try:
        return value[0], value[1]
    except (TypeError, IndexError, KeyError):
        raise MMAError(f"{name} gave {reprlib.repr(value)}: it must return a pair") from None


def _spread(name: str, value: Any, n: int, what: str) -> Array:
    """A number, or one for each of the n."""
    array = _real(name, value)
    if array.shape not in ((), (1,), (n,)):
        raise MMAError(f"{name} has shape {array.shape}, but there are {n} {what}: give it ({n},)")
    if np.any(np.isnan(array)):
        i = int(np.argmax(np.isnan(array))) if array.size > 1 else 0
        raise MMAError(f"{name} is nan at [{i}]: leave out a limit with inf")
    return np.broadcast_to(array, (n,)).copy()


def _bounds(bounds: Any, n: int) -> tuple[Array, Array]:
    """Lower and upper, from any form that scipy.optimize takes."""
    if isinstance(bounds, Bounds):
        return (
            _spread("the lower bound", bounds.lb, n, "variables"),
            _spread("the upper bound", bounds.ub, n, "variables"),
        )
    try:
        pairs = [(low, high) for low, high in bounds]
    except (TypeError, ValueError):
        raise MMAError(
            f"bounds are {reprlib.repr(bounds)}: pass Bounds, or a pair (lower, upper) for each "
            "variable"
        ) from None
    if len(pairs) != n:
        raise MMAError(f"{len(pairs)} pairs of bounds for {n} variables: give one for each")
    lower = [-np.inf if low is None else low for low, _ in pairs]
    upper = [np.inf if high is None else high for _, high in pairs]
    return _real("the lower bound", lower), _real("the upper bound", upper)


class _Problem:
    """f, g and their gradients; the last point's values are kept, as copies."""

    def __init__(self, fun: Any, jac: Any, args: tuple[Any, ...], rows: list[_Rows]) -> None:
        self.fun, self.jac, self.args, self.rows = fun, jac, args, rows
        self.nfev = self.njev = 0
        self.x: Array | None = None

    def values(self, x: Array) -> tuple[float, Array]:
        if self.x is None or not np.array_equal(x, self.x):
            self.nfev += 1
            f = self.fun(x.copy(), *self.args)
            if self.jac is True:
                self.njev += 1
                f, gradient = _pair("fun", f)
                self.gradient = self._gradient(gradient, x.size)
            value = _real("the value of fun", f)
            if value.size != 1:
                raise MMAError(f"the value of fun has shape {value.shape}: return one number")
            self.f = float(value.item())
            self.g = np.concatenate([np.zeros(0), *(r.value(x) for r in self.rows)])
            self.x = x.copy()
        return self.f, self.g

    def gradients(self, x: Array) -> tuple[Array, Array]:
        if self.jac is not True:
            self.njev += 1
            self.gradient = self._gradient(self.jac(x.copy(), *self.args), x.size)
        dgdx = np.vstack([np.zeros((0, x.size)), *(r.jacobian(x) for r in self.rows)])
        return self.gradient, dgdx

    @staticmethod
    def _gradient(value: Any, n: int) -> Array:
        gradient = np.atleast_1d(_real("the gradient", value))
        return _checked("the gradient", gradient, (n,), REJECT)


def minimize(
    fun: Callable[..., Any],
    x0: npt.ArrayLike,
    args: Any = (),
    jac: Callable[..., Any] | bool | None = None,
    bounds: Bounds | Iterable[tuple[float, float]] | None = None,
    constraints: Any = (),
    callback: Callable[..., Any] | None = None,
    *,
    hess: None = None,
    hessp: None = None,
    maxiter: int = 200,
    tol: float = 1e-8,
    disp: bool = False,
    globally_convergent: bool = False,
    **parameters: float,
) -> OptimizeResult:
    """Minimise a function by moving asymptotes; a `method` of `scipy.optimize.minimize`.

    ``scipy.optimize.minimize(fun, x0, jac=True, bounds=..., constraints=...,
    method=mpmopt.mma.minimize, options={...})`` and a direct call do the same.

    Parameters
    ----------
    fun : callable
        ``fun(x, *args) -> float``, or ``-> (float, gradient)`` if jac is True.
    x0 : array_like, shape (n,)
        Start, within the bounds up to rounding. It may violate the constraints.
    args : tuple, optional
        Passed on to fun and jac. Anything else is taken for the only argument.
    jac : callable or True
        ``jac(x, *args) -> ndarray, shape (n,)``, the gradient.
    bounds : scipy.optimize.Bounds or sequence of (lower, upper)
        All finite. No function is evaluated outside.
    constraints : LinearConstraint, NonlinearConstraint, dict, or a list of these
        In the conventions of scipy.optimize; inequalities only. Their Jacobian matrices are
        found by finite differences where none is given.
    callback : callable, optional
        ``callback(x)`` or ``callback(intermediate_result=...)`` after each iteration, with
        copies. It stops the search by raising StopIteration.
    hess, hessp : None
        Not used by this method, nor is the Hessian of a NonlinearConstraint.
    maxiter : int
        Greatest number of iterations.
    tol : float
        Stop when the KKT residual (see `MovingAsymptotes`) is at most this. Success then means
        in particular that no constraint is violated by more than tol times its largest gradient
        entry times range at x.
    disp : bool
        Print the message at the end.
    globally_convergent : bool
        Take only steps on which the approximations lie above the functions [2].
    **parameters
        Those of `MovingAsymptotes`: move_limit, asymptote_initial and so on.

    Returns
    -------
    scipy.optimize.OptimizeResult
        With x, fun, jac, success, status (0 converged, 1 iteration limit, 2 stalled, 3 stopped
        by the callback), message, nit, nfev, njev, and besides

        - multipliers: ndarray (>= 0), one for each finite limit of the constraints in the order
          given; within a constraint, lower limits come before upper ones
        - kkt_residual, step_size: as in `MovingAsymptotes`, at x
        - maxcv: greatest violation of a constraint

    Raises
    ------
    MMAError
        If an argument, or a value of fun or of a constraint, cannot be used.
    """
    unknown = sorted(set(parameters) - set(PARAMETERS))
    if unknown:
        known = ", ".join(("maxiter", "tol", "disp", "globally_convergent", *PARAMETERS))
        raise MMAError(f"unknown option {', '.join(unknown)}: the options are {known}")
    if hess is not None or hessp is not None:
        raise MMAError("moving asymptotes use no Hessian: leave hess and hessp out")
    if not callable(fun):
        raise MMAError(f"fun is {reprlib.repr(fun)}: pass a callable")
    if not (callable(jac) or jac is True):
        raise MMAError(
            "jac is missing: pass the gradient, or jac=True if fun returns both; there are no "
            "finite differences of fun"
        )
    if not (callback is None or callable(callback)):
        raise MMAError(f"callback is {reprlib.repr(callback)}: pass a callable")
    if bounds is None:
        raise MMAError("bounds are missing: give every variable finite bounds")
    for name, value in (("maxiter", maxiter), ("tol", tol)):
        number = isinstance(value, Real)
        if not (number and value >= 0):
            raise MMAError(f"{name} is {value!r}: it must be a number, at least 0")
    x = np.atleast_1d(_real("x0", x0))
    if x.ndim > 1:
        raise MMAError(f"x0 has shape {x.shape}: it must have one dimension")
    x = _checked("x0", x, x.shape, "start from finite values")
    mma = MovingAsymptotes(*_bounds(bounds, x.size), **parameters)
    # Rounding may put a start on a bound just outside it; further out is a mistake.
    rounding = 4 * EPSILON * np.maximum(np.abs(mma.lower), np.abs(mma.upper))
    inside = np.clip(x, mma.lower, mma.upper)
    x = np.where(np.abs(x - inside) <= rounding, inside, x)
    mma._refuse_outside("x0", x)
    if isinstance(constraints, LinearConstraint | NonlinearConstraint | Mapping):
        constraints = [constraints]
    try:
        constraints = [] if constraints is None else list(constraints)
    except TypeError:
        constraints = [constraints]  # refused by the next line
    rows = [
        _Rows(f"constraints[{k}]", c, x, mma.lower, mma.upper) for k, c in enumerate(constraints)
    ]
    problem = _Problem(fun, jac, args if isinstance(args, tuple) else (args,), rows)
    by_name = callback is not None and _takes_result(callback)

    nit = 0
    while True:
        f, g = problem.values(x)
        dfdx, dgdx = problem.gradients(x)
        evaluate = problem.values if globally_convergent else None
        x_next = mma.step(x, f, dfdx, g, dgdx, evaluate)
        result: Any = OptimizeResult()
        result.update(x=x, fun=f, jac=dfdx, maxcv=float(g.max(initial=0.0)), nit=nit)
        result.update(nfev=problem.nfev, njev=problem.njev, multipliers=mma.multipliers)
        result.update(kkt_residual=mma.kkt_residual, step_size=mma.step_size)
        residual = f"KKT residual {mma.kkt_residual:.2e}"
        interrupted = False
        if callback is not None and nit:
            try:
                if by_name:
                    callback(intermediate_result=copy.deepcopy(result))
                else:
                    callback(x.copy())
            except StopIteration:
                interrupted = True
        status, message = -1, ""
        trouble = _trouble(mma, rows, g, dfdx, tol)
        at_end = f"{residual}. {trouble}".rstrip()
        if mma.kkt_residual <= tol:
            status, message = 0, f"Converged: the {residual} is at most tol = {tol:g}."
        elif interrupted:
            status, message = 3, f"Stopped by the callback with {at_end}"
        elif mma.step_size <= 1e-4 * tol:
            status = 2
            message = (
                f"Stalled: the step fell to {mma.step_size:.2e} of the range, but the {residual} "
                f"is above tol = {tol:g}. {trouble or 'Check the gradients.'}"
            )
        elif nit >= maxiter:
            status, message = 1, f"Stopped after maxiter = {maxiter} iterations with {at_end}"
        if message:
            result.update(status=status, message=message, success=status == 0)
            if disp:
                print(message)
            return result
        x = x_next
        nit += 1


def _trouble(mma: MovingAsymptotes, rows: list[_Rows], g: Array, dfdx: Array, tol: float) -> str:
    """What a search that did not converge should be told about its last x."""
    row = int(np.argmax(mma.violations)) if g.size else 0
    if g.size and mma.violations[row] > tol:
        amount, owner = float(g[row]), iter(rows)
        while row >= (rows_of := next(owner)).count:
            row -= rows_of.count
        return (
            f"{rows_of.violated(row, amount)}: see whether it can be met within the bounds and "
            "the other constraints, and check its gradient."
        )
    slope = float(np.abs(dfdx * (mma.upper - mma.lower)).max(initial=0.0))
    if 0 < slope < FADED * mma.gradient_scale[0]:
        return (
            f"The gradient fell to {slope / mma.gradient_scale[0]:.0e} of the largest on the way, "
            "which holds the steps back: start again from this x."
        )
    return ""


def _takes_result(callback: Callable[..., Any]) -> bool:
    try:
        return set(inspect.signature(callback).parameters) == {"intermediate_result"}
    except (TypeError, ValueError):  # some built-in functions have no signature
        return False
