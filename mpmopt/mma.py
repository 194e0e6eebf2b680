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

import inspect
from collections.abc import Callable, Iterable, Mapping
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
        Least convexity of the approximations. It is relative to the largest gradient seen since
        the last reset, so that the iterates do not depend on the scale of f or g.

    Attributes
    ----------
    multipliers : ndarray, shape (m,)
        Lagrange multipliers (>= 0) of the last subproblem.
    kkt_residual : float
        How far the x of the last step was from a Karush-Kuhn-Tucker point: the greatest of
        projected gradient of the Lagrangian, violation and complementarity. Dimensionless:
        x is measured in ranges, f and g_i in units of their largest gradient entry times range.
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
            if not 0 < getattr(self, name) < np.inf:
                raise MMAError(f"{name} is {getattr(self, name)}: it must be positive and finite")
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
        outside = np.maximum(self.lower - x, x - self.upper)
        if np.any(outside > 0):
            j = int(np.argmax(outside))
            raise MMAError(
                f"x[{j}] = {x[j]} is outside its bounds [{self.lower[j]}, {self.upper[j]}]: "
                "clip x to the bounds"
            )
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

        all_distances = self._next_distance(x)
        distance = all_distances[free]
        below, above = (x - self.lower)[free] / span, (self.upper - x)[free] / span
        limit = np.minimum(ASYMPTOTE_MARGIN, self.move_limit / distance)
        low = -np.minimum(limit, below / distance)
        high = np.minimum(limit, above / distance)
        # Violating a constraint must cost more than its multiplier, which is about df / dg.
        # A constraint without gradient cannot be met by any step and must not hinder the rest.
        cost = ELASTIC_COST * scale[0] / np.where(size > 1e-8 * scale, size, scale)[1:]

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
            actual = _checked_values(*evaluate(x_next.copy()), m)
            excess = actual - (values + rise @ (t / (1 - t)) - fall @ (t / (1 + t)))
            noise = 10 * EPSILON * (np.abs(values) + np.abs(actual) + np.abs(slopes).sum(axis=1))
            growth = float(distance @ (2 * t**2 / (1 - t**2)))  # df~/d convexity
            if growth == 0 or np.all(excess <= noise):
                break
            # the update of [2], for those that lie below their function
            raised = np.minimum(1.1 * (convexity + excess / growth), 10 * convexity)
            convexity = np.where(excess > noise, raised, convexity)

        gradient = (slopes[0] + multipliers @ slopes[1:]) / scale[0]
        self.kkt_residual = float(
            max(
                np.abs(below - np.clip(below - gradient, 0.0, 1.0)).max(initial=0.0),
                (values[1:] / scale[1:]).max(initial=0.0),
                (multipliers * np.abs(values[1:])).max(initial=0.0) / scale[0],
            )
        )
        self.step_size = float((np.abs(x_next - x)[free] / span).max(initial=0.0))
        self.multipliers = multipliers
        self.gradient_scale = seen
        self.asymptote_distance = all_distances
        self.x_before_previous, self.x_previous = self.x_previous, x
        self.iteration += 1
        return x_next

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
    array = np.array(value, dtype=np.float64)
    if array.shape != shape:
        raise MMAError(f"{name} has shape {array.shape} where {shape} is needed")
    if not np.all(np.isfinite(array)):
        j = tuple(int(k) for k in np.argwhere(~np.isfinite(array))[0])
        where = str(list(j)) if j else ""
        raise MMAError(f"{name}{where} is {array[j]}: {cure}")
    return array


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

    def __init__(self, constraint: Any, x0: Array, lower: Array, upper: Array) -> None:
        self.jac: Any = "2-point"
        self.rel_step: Any = None
        limits: tuple[Any, Any]
        if isinstance(constraint, LinearConstraint):
            matrix = _dense(constraint.A)
            self.fun: Callable[[Array], Any] = lambda x: matrix @ x
            self.jac = lambda x: matrix
            limits = constraint.lb, constraint.ub
        elif isinstance(constraint, NonlinearConstraint):
            self.fun = constraint.fun
            self.jac = constraint.jac
            self.rel_step = constraint.finite_diff_rel_step
            limits = constraint.lb, constraint.ub
        elif isinstance(constraint, Mapping) and "type" in constraint and "fun" in constraint:
            kind = str(constraint["type"]).lower()
            if kind not in ("ineq", "eq"):
                raise MMAError(f"constraint type {constraint['type']!r}: 'ineq' is what there is")
            args = constraint.get("args", ())
            function, derivative = constraint["fun"], constraint.get("jac")
            self.fun = lambda x: function(x, *args)
            if callable(derivative):
                self.jac = lambda x: derivative(x, *args)
            elif derivative:
                self.jac = derivative
            limits = 0.0, (np.inf if kind == "ineq" else 0.0)
        else:
            raise MMAError(
                f"constraint {constraint!r}: pass a LinearConstraint, a NonlinearConstraint, or "
                "a dict with 'type': 'ineq' and 'fun'"
            )
        if not callable(self.jac) and self.jac not in ("2-point", "3-point", "cs"):
            raise MMAError(f"constraint jac {self.jac!r}: pass a callable or '2-point'")
        m = np.asarray(self.fun(x0.copy())).size
        self.low, self.high = (np.broadcast_to(np.asarray(v, dtype=float), (m,)) for v in limits)
        if np.any(self.low >= self.high):
            raise MMAError(
                "the limits of a constraint are equal or reversed, but moving asymptotes need "
                "inequalities: eliminate a variable, or widen the limits to a tolerance"
            )
        self.has_low, self.has_high = np.isfinite(self.low), np.isfinite(self.high)
        # Finite differences stay within the bounds; a fixed variable has no room for that.
        fixed = lower == upper
        self.box = np.where(fixed, -np.inf, lower), np.where(fixed, np.inf, upper)

    def value(self, x: Array) -> Array:
        c = np.ravel(self.fun(x.copy()))
        return np.append((self.low - c)[self.has_low], (c - self.high)[self.has_high])

    def jacobian(self, x: Array) -> Array:
        if callable(self.jac):
            matrix = self.jac(x.copy())
        else:
            matrix = approx_derivative(
                self.fun, x, method=self.jac, rel_step=self.rel_step, bounds=self.box
            )
        matrix = np.reshape(_dense(matrix), (self.low.size, x.size))
        return np.vstack([-matrix[self.has_low], matrix[self.has_high]])


def _dense(matrix: Any) -> Array:
    return np.asarray(matrix.toarray() if hasattr(matrix, "toarray") else matrix, dtype=float)


class _Problem:
    """f, g and their gradients; the last point's values are kept."""

    def __init__(self, fun: Any, jac: Any, args: tuple[Any, ...], rows: list[_Rows]) -> None:
        self.fun, self.jac, self.args, self.rows = fun, jac, args, rows
        self.nfev = self.njev = 0
        self.x: Array | None = None

    def values(self, x: Array) -> tuple[Any, Array]:
        if self.x is None or not np.array_equal(x, self.x):
            self.nfev += 1
            f = self.fun(x.copy(), *self.args)
            if self.jac is True:
                self.njev += 1
                f, self.gradient = f
            self.f = np.squeeze(f)
            self.g = np.concatenate([np.zeros(0), *(r.value(x) for r in self.rows)])
            self.x = x.copy()
        return self.f, self.g

    def gradients(self, x: Array) -> tuple[Array, Array]:
        if self.jac is not True:
            self.njev += 1
            self.gradient = self.jac(x.copy(), *self.args)
        dgdx = np.vstack([np.zeros((0, x.size)), *(r.jacobian(x) for r in self.rows)])
        return np.asarray(self.gradient), dgdx


def minimize(
    fun: Callable[..., Any],
    x0: npt.ArrayLike,
    args: tuple[Any, ...] = (),
    jac: Callable[..., Any] | bool | None = None,
    bounds: Bounds | Iterable[tuple[float, float]] | None = None,
    constraints: Any = (),
    callback: Callable[..., Any] | None = None,
    *,
    hess: None = None,
    hessp: None = None,
    maxiter: int = 200,
    tol: float = 1e-8,
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
        Start, within the bounds. It may violate the constraints.
    args : tuple, optional
        Passed on to fun and jac.
    jac : callable or True
        ``jac(x, *args) -> ndarray, shape (n,)``, the gradient.
    bounds : scipy.optimize.Bounds or sequence of (lower, upper)
        All finite.
    constraints : LinearConstraint, NonlinearConstraint, dict, or a list of these
        In the conventions of scipy.optimize; inequalities only. Their Jacobian matrices are
        found by finite differences where none is given.
    callback : callable, optional
        ``callback(x)`` or ``callback(intermediate_result=...)`` after each iteration. It stops
        the search by raising StopIteration.
    hess, hessp : None
        Not used by this method.
    maxiter : int
        Greatest number of iterations.
    tol : float
        Stop when the KKT residual (see `MovingAsymptotes`) is at most this.
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
        known = ", ".join(("maxiter", "tol", "globally_convergent", *PARAMETERS))
        raise MMAError(f"unknown option {', '.join(unknown)}: the options are {known}")
    if hess is not None or hessp is not None:
        raise MMAError("moving asymptotes use no Hessian: leave hess and hessp out")
    if not (callable(jac) or jac is True):
        raise MMAError("jac is missing: pass the gradient, or jac=True if fun returns both")
    if bounds is None:
        raise MMAError("bounds are missing: give every variable finite bounds")
    x = np.atleast_1d(np.array(x0, dtype=np.float64))
    if isinstance(bounds, Bounds):
        lower, upper = (np.broadcast_to(b, x.shape) for b in (bounds.lb, bounds.ub))
    else:
        lower, upper = np.array(list(bounds), dtype=float).reshape(-1, 2).T
    mma = MovingAsymptotes(lower, upper, **parameters)
    if isinstance(constraints, LinearConstraint | NonlinearConstraint | Mapping):
        constraints = [constraints]
    rows = [_Rows(c, x, mma.lower, mma.upper) for c in constraints or ()]
    problem = _Problem(fun, jac, args, rows)
    by_name = callback is not None and set(inspect.signature(callback).parameters) == {
        "intermediate_result"
    }

    nit = 0
    while True:
        f, g = problem.values(x)
        dfdx, dgdx = problem.gradients(x)
        evaluate = problem.values if globally_convergent else None
        x_next = mma.step(x, f, dfdx, g, dgdx, evaluate)
        result: Any = OptimizeResult()
        result.update(x=x, fun=float(f), jac=dfdx, maxcv=float(g.max(initial=0.0)), nit=nit)
        result.update(nfev=problem.nfev, njev=problem.njev, multipliers=mma.multipliers)
        result.update(kkt_residual=mma.kkt_residual, step_size=mma.step_size)
        residual = f"KKT residual {mma.kkt_residual:.2e}"
        interrupted = False
        if callback is not None and nit:
            try:
                if by_name:
                    callback(intermediate_result=result)
                else:
                    callback(x.copy())
            except StopIteration:
                interrupted = True
        status, message = -1, ""
        if mma.kkt_residual <= tol:
            status, message = 0, f"Converged: the {residual} is at most tol = {tol:g}."
        elif interrupted:
            status, message = 3, f"Stopped by the callback with {residual}."
        elif mma.step_size <= 1e-4 * tol:
            message = (
                f"Stalled: the step fell to {mma.step_size:.2e} of the range, but the {residual} "
                f"is above tol = {tol:g}. Check the gradients, and that the constraints can be "
                f"met (greatest violation {result.maxcv:.2e})."
            )
            status = 2
        elif nit >= maxiter:
            status, message = 1, f"Stopped after maxiter = {maxiter} iterations with {residual}."
        if message:
            result.update(status=status, message=message, success=status == 0)
            return result
        x = x_next
        nit += 1
