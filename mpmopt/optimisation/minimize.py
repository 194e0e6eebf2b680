"""Moving asymptotes with the face of `scipy.optimize`: `minimize`, its constraints and results."""

import copy
import inspect
import reprlib
from collections.abc import Callable, Iterable
from numbers import Real
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.optimize import Bounds, LinearConstraint, NonlinearConstraint, OptimizeResult

from mpmopt.optimisation.mma import (
    EPSILON,
    PARAMETERS,
    REJECT,
    Array,
    MMAError,
    MovingAsymptotes,
    checked,
    pair,
    real,
)

FADED = 1e-6  # a gradient so much smaller than the largest seen moves x little: raa0


class _Rows:
    """A constraint of scipy.optimize as rows g(x) <= 0: lower limits first, then upper."""

    def __init__(self, name: str, constraint: Any, x0: Array) -> None:
        self.name = name
        if isinstance(constraint, LinearConstraint):
            matrix = np.atleast_2d(_dense(f"the matrix of {name}", constraint.A))
            if matrix.shape[1] != x0.size:
                raise MMAError(
                    f"the matrix of {name} has shape {matrix.shape}, but there are {x0.size} "
                    "variables: give it one column for each"
                )
            self.fun: Any = lambda x: matrix @ x
            self.jac: Any = lambda x: matrix
        elif isinstance(constraint, NonlinearConstraint):
            self.fun, self.jac = constraint.fun, constraint.jac
        else:
            raise MMAError(
                f"{name} is {reprlib.repr(constraint)}: pass a LinearConstraint or a "
                "NonlinearConstraint"
            )
        if np.any(constraint.keep_feasible):
            raise MMAError(
                f"{name} has keep_feasible=True, but moving asymptotes may violate a constraint "
                "on their way: leave it out, and let the functions stand such points"
            )
        for what, function in (("fun", self.fun), ("jac", self.jac)):
            if not callable(function):
                raise MMAError(
                    f"the {what} of {name} is {reprlib.repr(function)}: pass a callable; there are "
                    "no finite differences"
                )
        self.size = np.size(self.fun(x0.copy()))
        self.components(x0)  # refuses what is no vector
        self.low, self.high = (
            _spread(f"the {side} limit of {name}", value, self.size, "components")
            for side, value in (("lower", constraint.lb), ("upper", constraint.ub))
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

    def components(self, x: Array) -> Array:
        """The values of its function, one for each component."""
        values = np.atleast_1d(real(f"the value of {self.name}", self.fun(x.copy())))
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
        matrix = _dense(name, self.jac(x.copy()))
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

    def violated(self, row: int, amount: float) -> str:
        """Which limit the row is, and that it is violated by that amount."""
        lower = np.flatnonzero(self.has_low)
        if row < lower.size:
            i, side, limit = lower[row], "lower", self.low
        else:
            i, side, limit = np.flatnonzero(self.has_high)[row - lower.size], "upper", self.high
        return f"{self.name}[{i}] violates its {side} limit {limit[i]:g} by {amount:.6g}"


def _dense(name: str, matrix: Any) -> Array:
    return real(name, matrix.toarray() if hasattr(matrix, "toarray") else matrix)


def _spread(name: str, value: Any, n: int, what: str) -> Array:
    """A number, or one for each of the n."""
    array = real(name, value)
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
    return real("the lower bound", lower), real("the upper bound", upper)


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
                f, gradient = pair("fun", f)
                self.gradient = self._gradient(gradient, x.size)
            value = real("the value of fun", f)
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
        gradient = np.atleast_1d(real("the gradient", value))
        return checked("the gradient", gradient, (n,), REJECT)


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
    method=mpmopt.minimize, options={...})`` and a direct call do the same.

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
    constraints : LinearConstraint, NonlinearConstraint, or a list of these
        In the conventions of scipy.optimize; inequalities only, with their Jacobian matrices.
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
        if not (isinstance(value, Real) and value >= 0):
            raise MMAError(f"{name} is {value!r}: it must be a number, at least 0")
    x = np.atleast_1d(real("x0", x0))
    if x.ndim > 1:
        raise MMAError(f"x0 has shape {x.shape}: it must have one dimension")
    x = checked("x0", x, x.shape, "start from finite values")
    mma = MovingAsymptotes(*_bounds(bounds, x.size), **parameters)
    # Rounding may put a start on a bound just outside it; further out is a mistake.
    rounding = 4 * EPSILON * np.maximum(np.abs(mma.lower), np.abs(mma.upper))
    inside = np.clip(x, mma.lower, mma.upper)
    x = np.where(np.abs(x - inside) <= rounding, inside, x)
    mma.check_within("x0", x)
    if isinstance(constraints, LinearConstraint | NonlinearConstraint):
        constraints = [constraints]
    try:
        constraints = [] if constraints is None else list(constraints)
    except TypeError:
        constraints = [constraints]  # refused by the next line
    rows = [_Rows(f"constraints[{k}]", c, x) for k, c in enumerate(constraints)]
    problem = _Problem(fun, jac, args if isinstance(args, tuple) else (args,), rows)
    by_name = callback is not None and _takes_result(callback)

    nit = 0
    while True:
        f, g = problem.values(x)
        dfdx, dgdx = problem.gradients(x)
        evaluate = problem.values if globally_convergent else None
        x_next = mma.step(x, f, dfdx, g, dgdx, evaluate)
        result: Any = OptimizeResult(
            x=x, fun=f, jac=dfdx, maxcv=float(g.max(initial=0.0)), nit=nit, nfev=problem.nfev,
            njev=problem.njev, multipliers=mma.multipliers, kkt_residual=mma.kkt_residual,
            step_size=mma.step_size,
        )  # fmt: skip
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
