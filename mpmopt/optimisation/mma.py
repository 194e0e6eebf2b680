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

import reprlib
from collections.abc import Callable, Mapping
from numbers import Real
from typing import Any

import numpy as np
import numpy.typing as npt

from mpmopt.errors import MpmoptError

Array = npt.NDArray[np.float64]
Evaluate = Callable[[Array], tuple[float, npt.ArrayLike]]

ASYMPTOTE_MARGIN = 0.9  # how far towards an asymptote a step may go: alpha, beta of [3]
GRADIENT_SHARE = 1e-3  # of |df/dx| that both P and Q receive, so that none is zero [3]
ELASTIC_COST = 1e3  # c_i of [3], for functions scaled to gradients of size one
INNER_ITERATIONS = 30  # of the globally convergent variant; convexity grows up to 10 times in each
PRECISION = 1e-12  # of the subproblem's solution, relative to the change over one step
HOPELESS = 1e-8  # a constraint whose gradient is so much smaller than its value loses weight
LEAST_GRADIENT = 1e-150  # gradients below would overflow in quotients
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
        since the last reset or `forget_gradients`, and to that of g_i at x, so that the iterates
        do not depend on the scale of f or g.

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
        self.lower = checked("lower bound", lower, (n,), "give every variable finite bounds")
        self.upper = checked("upper bound", upper, (n,), "give every variable finite bounds")
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

    def forget_gradients(self) -> None:
        """Measure the least convexity by the gradients of the next step alone.

        For a motion that may be chaotic: a gradient that it blew up would hold back all steps that
        follow.
        """
        self.gradient_scale = np.zeros_like(self.gradient_scale)

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
        x = checked("x", x, (n,), "start from a finite x")
        self.check_within("x", x)
        if (g is None) != (dgdx is None):
            raise MMAError("g and dgdx belong together: pass both or none")
        if g is None or dgdx is None:
            g, dgdx = np.zeros(0), np.zeros((0, n))
        m = np.size(g)
        values = checked_values(f, g, m)
        gradients = np.vstack(
            [checked("dfdx", dfdx, (n,), REJECT), checked("dgdx", dgdx, (m, n), REJECT)]
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
        scale[1:] = np.maximum(size, np.maximum(HOPELESS * np.abs(values), LEAST_GRADIENT))[1:]

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
            actual = checked_values(*pair("evaluate", evaluate(x_next.copy())), m)
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

    def check_within(self, name: str, x: Array) -> None:
        """Refuse an x (n,) that is not within the bounds."""
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


def checked(name: str, value: npt.ArrayLike, shape: tuple[int, ...], cure: str) -> Array:
    """A new float array of that shape, or an `MMAError` with that name and cure."""
    array = real(name, value)
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


def real(name: str, value: Any) -> Array:
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


def pair(name: str, value: Any) -> tuple[Any, Any]:
    """The first two, as scipy.optimize takes them."""
    try:
        return value[0], value[1]
    except (TypeError, IndexError, KeyError):
        raise MMAError(f"{name} gave {reprlib.repr(value)}: it must return a pair") from None


def checked_values(f: float, g: npt.ArrayLike, m: int) -> Array:
    """(f, g_1, ..., g_m)."""
    return np.append(checked("f", f, (), REJECT), checked("g", np.ravel(g), (m,), REJECT))


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
