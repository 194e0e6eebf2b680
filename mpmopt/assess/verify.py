"""Is the gradient right? Dot-product, complex-step and Taylor tests, of kernels and of problems.

Three independent witnesses. The *dot-product* test compares each hand-written adjoint with the
derivative of its own kernel: for random directions, (D d).w must equal d.(D^T w). The derivative
D d comes from a complex step, f(x + i h d) = f(x) + i h D d + O(h^2), which has no cancellation, so
that both sides agree to rounding. The *complex-step* test does the same for the whole chain from
design to distance. The *Taylor* test needs nothing but values of the objective: what remains of
them beyond the gradient must fall with the square of the step.
"""

from __future__ import annotations

import copy
import dataclasses
import math
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from mpmopt import kernels
from mpmopt.design.actuation import labels, signal, signal_adjoint, sizes
from mpmopt.design.chain import DesignChain
from mpmopt.design.objective import Objective
from mpmopt.design.problem import Problem
from mpmopt.design.term import Outcome
from mpmopt.errors import DesignError
from mpmopt.kernels import Parts, parts
from mpmopt.scene import Scene
from mpmopt.scene.particles import discretise, of_solid
from mpmopt.simulation.simulation import Simulation
from mpmopt.simulation.surroundings import parameters_of
from mpmopt.validation import count

COMPLEX_STEP = 1e-30
DEFAULT_TAYLOR_STEPS = 0.5 ** np.arange(7.0, 12.0)
REPORT_TAYLOR_STEPS = 0.5 ** np.arange(7.0, 15.0)

DOT_TOLERANCE = 1e-13
COMPLEX_TOLERANCE = 1e-10
ORDER_TOLERANCE = 0.1
# A remainder over so many times the rounding of an objective has an order.
REMAINDER_ROUNDING = 20.0

Arrays = dict[str, NDArray]


def dot_product_mismatch(
    function: Callable[[Arrays], Arrays],
    adjoint: Callable[[Arrays, Arrays], Arrays],
    inputs: Arrays,
    rng: np.random.Generator,
) -> float:
    """Relative difference of (D d).w and d.(D^T w) for random d and w.

    Parameters
    ----------
    function : callable
        From named arrays to named arrays; must accept complex ones.
    adjoint : callable
        From the real inputs and the outputs' adjoints w to the adjoint of each input.
    inputs : dict of arrays
        Where the derivative is taken.
    rng : numpy Generator

    Returns
    -------
    float
        abs(difference) over the size of both sides' terms, the root of the sum of their squares;
        zero if all are zero.
    """
    # Each input, and each output, has its own unit; none shall drown another.
    d = {name: _size(value) * rng.standard_normal(value.shape) for name, value in inputs.items()}
    shifted = {name: value + 1j * COMPLEX_STEP * d[name] for name, value in inputs.items()}
    derivative = {name: out.imag / COMPLEX_STEP for name, out in function(shifted).items()}
    w = {name: rng.standard_normal(out.shape) / _size(out) for name, out in derivative.items()}
    left = [derivative[name] * w[name] for name in w]
    right = [bar * d[name] for name, bar in adjoint(inputs, w).items()]
    if len(right) != len(inputs):
        raise DesignError(f"the adjoint returned {len(right)} arrays for {len(inputs)} inputs")
    difference = abs(sum(map(np.sum, left)) - sum(map(np.sum, right)))
    # Not that of the sums: these may vanish by chance.
    size = sum(float(np.linalg.norm([np.linalg.norm(term) for term in s])) for s in (left, right))
    if not np.isfinite(difference):
        return float("inf")  # what is not a number fits nothing
    return float(difference / size) if size > 0.0 else 0.0


def _size(values: NDArray) -> float:
    """Greatest magnitude, or 1 if all are zero."""
    return float(np.abs(values).max(initial=0.0)) or 1.0


def kernel_mismatches(scene: Scene, seed: int = 0) -> dict[str, float]:
    """Dot-product test of every kernel and link of the chain, on the body in rough motion.

    Parameters
    ----------
    scene : Scene
    seed : int, optional
        Of the random motion and directions.

    Returns
    -------
    dict of str to float
        Relative mismatch by name; rounding is about 1e-15.
    """
    rng = np.random.default_rng(seed)
    bench = _Bench(scene, rng)
    tests = {
        "deform": (bench.deform, bench.deform_adjoint, "affine_velocity deformation"),
        "stress": (
            bench.stress,
            bench.stress_adjoint,
            "affine_velocity deformation mass stiffness signal",
        ),
        "p2g": (bench.p2g, bench.p2g_adjoint, "position velocity affine mass"),
        "grid_update": (
            bench.grid_update,
            bench.grid_update_adjoint,
            "grid" + " normal_force" * bool(scene.ground),
        ),
        "g2p": (bench.g2p, bench.g2p_adjoint, "position velocity affine_velocity node_velocity"),
    }
    if scene.ground:
        tests["press"] = bench.press, bench.press_adjoint, "position stiffness"
    result = {
        name: dot_product_mismatch(
            function, adjoint, {key: bench.inputs[key] for key in keys.split()}, rng
        )
        for name, (function, adjoint, keys) in tests.items()
    }
    if scene.mirror is not None:
        grid = {"grid": rng.standard_normal((bench.nodes, kernels.NODE_SIZE))}
        result["mirror"] = dot_product_mismatch(
            bench.mirror, lambda v, w: {"grid": bench.mirror(w)["grid"]}, grid, rng
        )
    material = "density", "stiffness"
    chain, objective = DesignChain(scene, bench.particles, 2.0), bench.objective
    if bench.particles.designed.any():
        result["design"] = dot_product_mismatch(
            lambda v: {name: getattr(chain.field(v["phi"]), name) for name in material},
            lambda v, w: {"phi": chain.field(v["phi"]).pullback(*(w[name] for name in material))},
            {"phi": rng.uniform(-0.5, 0.5, int(bench.particles.designed.sum()))},
            rng,
        )
    if scene.actuators:
        result["signal"] = dot_product_mismatch(
            lambda v: {"s": signal(scene, **v)},
            lambda v, w: dict(
                zip(v, signal_adjoint(scene, v["a"], v["theta"], w["s"], v["omega"]))
            ),
            {
                name: rng.uniform(-1.0, 1.0, size)
                for name, size in zip(("a", "theta", "b", "omega"), sizes(scene))
            },
            rng,
        )

    def objective_adjoint(v: Arrays, w: Arrays) -> Arrays:
        bar = parts(w["L"][0] * objective.centroid_adjoint(bench.moved(v, float)))
        return {name: getattr(bar, name) for name in v}

    result["objective"] = dot_product_mismatch(
        lambda v: {"L": np.array([objective.centroid(bench.moved(v, complex))])},
        objective_adjoint,
        {name: bench.inputs[name] for name in ("position", "deformation")},
        rng,
    )
    return result


# Fields of `kernels.ParticleData` on which the stress depends and that a design changes.
DESIGNED = ("mass", "stiffness")


class _Bench:
    """Kernels and their adjoints as functions of named arrays, on a roughly moving body."""

    def __init__(self, scene: Scene, rng: np.random.Generator) -> None:
        self.particles = discretise(scene)
        self.objective = Objective.of(scene, self.particles)
        count = len(self.particles.position)
        dx = scene.grid.dx
        # Scattered, hitting walls and sliding on them, well deformed but not inverted.
        speed = dx / scene.time_step
        self.state: NDArray = np.zeros((kernels.STATE_SIZE, count))
        x, v, C, F = own = parts(self.state)
        x[:] = self.particles.position.T + 0.5 * dx * rng.uniform(-1.0, 1.0, x.shape)
        v[:] = 0.1 * speed * rng.standard_normal(v.shape)
        C[:] = 0.1 / scene.time_step * rng.uniform(-1.0, 1.0, C.shape)
        F[:] = 0.2 * rng.uniform(-1.0, 1.0, F.shape) + np.eye(2)[:, :, None]
        self.parameters = parameters_of(scene)
        vary = rng.uniform(0.1, 1.0, count)
        sample = Simulation(
            scene,
            self.particles,
            of_solid(scene, self.particles, "density") * vary,
            vary[::-1],
            np.full((scene.steps, len(scene.actuators)), 0.7),
            self.state,
        )
        self.data = sample.data
        groups = len(self.data.mass)
        self.all = (0, groups)
        *window, inside = kernels.find_window(
            kernels.grouped(self.state), self.parameters, *self.all
        )
        if not inside:
            raise DesignError("a particle is outside the grid")
        self.window = tuple(window)
        self.nodes = window[2] * window[3]
        affine = rng.standard_normal((4, count)) * np.mean(sample.data.mass) * speed
        self.inputs: Arrays = {
            **own._asdict(),
            **{name: kernels.ungrouped(getattr(self.data, name), 1, count) for name in DESIGNED},
            "signal": np.full(len(scene.actuators), 0.7),
            "affine": affine,
            "node_velocity": speed * rng.standard_normal((self.nodes, 2)),
        }
        grid = self.p2g(self.inputs)["grid"]
        self.mass_grid = grid[:, 2]
        self.inputs["grid"] = grid[grid[:, 2] > 0.0]
        self.inputs["normal_force"] = np.zeros(len(self.inputs["grid"]))
        if scene.ground:
            self.inputs["normal_force"] = self.press(self.inputs)["force"][self.mass_grid > 0.0]

    def _tile(self, records: NDArray) -> kernels.Tile:
        """Of all groups, located."""
        tile = kernels.make_tile(self.all[1], records)
        kernels.locate(records, self.parameters, self.window, tile, *self.all)
        return tile

    def _scratch(self, dtype: type) -> kernels.Scratch:
        return kernels.Scratch.make(self.nodes, 1, self.nodes, dtype)

    def _cells(self, nodes: NDArray) -> NDArray:
        """Taylor coefficients of a field on the nodes."""
        cells = np.zeros((9 * self.nodes, 4) if nodes.ndim == 2 else 18 * self.nodes, nodes.dtype)
        kernels.taylor(nodes, self.window, self.window, cells)
        return cells

    def _nodes(self, cells: NDArray) -> NDArray:
        """What cells' moments put on the nodes."""
        nodes = np.zeros((self.nodes, 4) if cells.ndim == 2 else 2 * self.nodes, cells.dtype)
        kernels.taylor_adjoint(cells, self.window, nodes)
        return nodes

    def _parts(self, records: NDArray) -> Parts:
        return parts(self._particles(records, kernels.STATE_SIZE))

    def _particles(self, records: NDArray, rows: int) -> NDArray:
        return kernels.ungrouped(records, rows, self.state.shape[1])

    def moved(self, v: Arrays, dtype: type) -> NDArray:
        """The state (12, N), of which the named arrays replace some parts."""
        state: NDArray = self.state.astype(dtype)
        own = parts(state)
        for name in own._fields:
            if name in v:
                getattr(own, name)[:] = v[name]
        return state

    def _state(self, v: Arrays, dtype: type) -> NDArray:
        return kernels.grouped(self.moved(v, dtype))

    def _data(self, v: Arrays, dtype: type) -> kernels.ParticleData:
        data = self.data._replace(
            **{name: kernels.grouped(v[name], repeat=False) for name in DESIGNED if name in v}
        )
        floats = ("volume", *DESIGNED)
        return data._replace(**{name: getattr(data, name).astype(dtype) for name in floats})

    def deform(self, v: Arrays) -> Arrays:
        old = self._state(v, np.result_type(*v.values()).type)
        new, log_J = old.copy(), np.zeros((self.all[1], 4), old.dtype)
        kernels.deform(old, new, self.parameters, log_J, *self.all)
        return {"new": self._parts(new).deformation}

    def deform_adjoint(self, v: Arrays, w: Arrays) -> Arrays:
        old = self._state(v, float)
        bar = self._bar(deformation=w["new"])
        kernels.deform_adjoint(old, self.parameters, bar, *self.all)
        found = self._parts(bar)
        return {"affine_velocity": found.affine_velocity, "deformation": found.deformation}

    def _bar(self, **values: NDArray) -> NDArray:
        """Adjoint of a state of which only the named parts are not zero."""
        bar = np.zeros_like(self.state)
        for name, value in values.items():
            getattr(parts(bar), name)[:] = value
        return kernels.grouped(bar, repeat=False)

    def _data_bar(self) -> kernels.ParticleDataBar:
        return kernels.ParticleDataBar.zeros(self.all[1])

    def stress(self, v: Arrays) -> Arrays:
        # Here the deformation gradient is the new one, on which the stress depends.
        dtype = np.result_type(*v.values()).type
        state, data = self._state(v, dtype), self._data(v, dtype)
        tile, log_J = self._tile(state), _log_jacobian(state)
        kernels.stress(state, state, log_J, data, self.parameters, v["signal"], tile, *self.all)
        return {"affine": self._particles(tile.affine, 4) / self.parameters.dx}

    def stress_adjoint(self, v: Arrays, w: Arrays) -> Arrays:
        state, data = self._state(v, float), self._data(v, float)
        tile, log_J = self._tile(state), _log_jacobian(state)
        bar, data_bar = np.zeros_like(state), self._data_bar()
        signal_bar = 0.0 * v["signal"]
        self._gather(tile, w["affine"])
        given = (state, state, log_J, data, self.parameters, v["signal"], tile)
        kernels.stress_adjoint(*given, bar, data_bar, signal_bar, *self.all)
        found = self._parts(bar)
        return {
            "affine_velocity": found.affine_velocity,
            "deformation": found.deformation,
            **{name: self._particles(getattr(data_bar, name), 1) for name in DESIGNED},
            "signal": signal_bar,
        }

    def _gather(self, tile: kernels.Tile, affine_bar: NDArray) -> None:
        gathered = np.zeros((9, self.state.shape[1]))
        gathered[:4] = affine_bar
        tile.gathered[:] = kernels.grouped(gathered, repeat=False)

    def p2g(self, v: Arrays) -> Arrays:
        dtype = np.result_type(*v.values()).type
        state, data = self._state(v, dtype), self._data(v, dtype)
        tile, cells = self._tile(state), np.zeros((9 * self.nodes, 4), dtype)
        tile.affine[:] = kernels.grouped(v["affine"] * self.parameters.dx, repeat=False)
        kernels.p2g(state, data, tile, cells, *self.all)
        return {"grid": self._nodes(cells)[:, :3]}

    def p2g_adjoint(self, v: Arrays, w: Arrays) -> Arrays:
        state, data = self._state(v, float), self._data(v, float)
        tile, bar, data_bar = self._tile(state), np.zeros_like(state), self._data_bar()
        tile.affine[:] = kernels.grouped(v["affine"] * self.parameters.dx, repeat=False)
        nodes = np.zeros((self.nodes, kernels.NODE_SIZE))
        nodes[:, :3] = w["grid"]
        cells = self._cells(nodes)
        kernels.p2g_adjoint(state, data, self.parameters, tile, cells, bar, data_bar, *self.all)
        found = self._parts(bar)
        return {
            "position": found.position,
            "velocity": found.velocity,
            "affine": self._particles(tile.gathered, 9)[:4],
            "mass": self._particles(data_bar.mass, 1),
        }

    def mirror(self, v: Arrays) -> Arrays:
        records = np.zeros((self.nodes, kernels.NODE_SIZE), v["grid"].dtype)
        records[:] = v["grid"]
        kernels.mirror(records, self.window, self.parameters)
        return {"grid": records}

    def press(self, v: Arrays) -> Arrays:
        """What the ground's layers give the nodes."""
        dtype = np.result_type(*v.values()).type
        state, data = self._state(v, dtype), self._data(v, dtype)
        tile, cells = self._tile(state), np.zeros((9 * self.nodes, 4), dtype)
        kernels.press(state, data, self.parameters, tile, cells, *self.all)
        nodes = self._nodes(cells)
        return {"momentum": nodes[:, :2], "force": nodes[:, 3]}

    def press_adjoint(self, v: Arrays, w: Arrays) -> Arrays:
        state, data = self._state(v, float), self._data(v, float)
        tile, bar, data_bar = self._tile(state), np.zeros_like(state), self._data_bar()
        nodes = np.zeros((self.nodes, kernels.NODE_SIZE))
        nodes[:, :2], nodes[:, 3] = w["momentum"], w["force"]
        cells = self._cells(nodes)
        kernels.press_adjoint(state, data, self.parameters, tile, cells, bar, data_bar, *self.all)
        stiffness = self._particles(data_bar.stiffness, 1)
        return {"position": self._parts(bar).position, "stiffness": stiffness}

    def _before_update(self, v: Arrays, dtype: type) -> tuple[Any, ...]:
        grid = np.zeros((self.nodes, kernels.NODE_SIZE), dtype)
        grid[self.mass_grid > 0.0, :3] = v["grid"]
        if "normal_force" in v:
            grid[self.mass_grid > 0.0, 3] = v["normal_force"]
        return grid, self.window, self.parameters, self.parameters.clamps[0]

    def grid_update(self, v: Arrays) -> Arrays:
        dtype = np.result_type(*v.values()).type
        scratch, given = self._scratch(dtype), self._before_update(v, dtype)
        for column in range(self.window[2]):
            kernels.grid_update(*given, scratch.velocity, column)
        return {"velocity": scratch.velocity}

    def grid_update_adjoint(self, v: Arrays, w: Arrays) -> Arrays:
        scratch, given = self._scratch(float), self._before_update(v, float)
        for column in range(self.window[2]):
            kernels.grid_update_adjoint(*given, w["velocity"], scratch.node_bar, column)
        node_bar = scratch.node_bar[self.mass_grid > 0.0]
        result = {"grid": node_bar[:, :3], "normal_force": node_bar[:, 3]}
        return {name: result[name] for name in v}

    def _before_g2p(self, v: Arrays) -> tuple[NDArray, NDArray]:
        dtype = np.result_type(*v.values()).type
        return self._state(v, dtype), self._cells(v["node_velocity"].astype(dtype).ravel())

    def g2p(self, v: Arrays) -> Arrays:
        old, cells = self._before_g2p(v)
        new, tile = np.zeros_like(old), self._tile(old)
        kernels.g2p(old, new, self.parameters, tile, cells, *self.all)
        x, v_new, C, _ = self._parts(new)
        return {"position": x, "velocity": v_new, "affine_velocity": C}

    def g2p_adjoint(self, v: Arrays, w: Arrays) -> Arrays:
        old, cells = self._before_g2p(v)
        bar, tile, cells_bar = self._bar(**w), self._tile(old), np.zeros_like(cells)
        kernels.g2p_adjoint(self.parameters, tile, cells, cells_bar, bar, *self.all)
        found = {name: getattr(self._parts(bar), name) for name in v if name != "node_velocity"}
        return {**found, "node_velocity": self._nodes(cells_bar).reshape(-1, 2)}


def _log_jacobian(records: NDArray) -> NDArray:
    F = parts(records.reshape(-1, kernels.STATE_SIZE, 4)).deformation
    return np.log(F[:, 0, 0] * F[:, 1, 1] - F[:, 0, 1] * F[:, 1, 0])


class ComplexStep(NamedTuple):
    """The gradient along a direction d, against the complex step.

    Both numbers are over the size of the derivative, or of its terms where these cancel by
    symmetry: what every particle's end contributes, as the root of the sum of squares.

    Attributes
    ----------
    error : float
        abs(complex step - gradient.d), on that scale.
    noise : float
        What rounding alone can do: the changes of the gradient when x moves by a few units in the
        last place to either side, and rounding of the positions, times abs(d). A stiff, sharp or
        long simulation amplifies rounding; no gradient of it can be more exact than this.
    """

    error: float
    noise: float


def complex_step_test(
    problem: Problem, x: NDArray[np.float64], directions: int = 2, seed: int = 0
) -> dict[str, ComplexStep]:
    """Compare the gradient with the complex step along several directions.

    Parameters
    ----------
    problem : Problem
        In double precision.
    x : (n,) array
        Design variables.
    directions : int, optional
        Random directions of phi; each of a, theta, b of every actuator is checked besides.
    seed : int, optional
        Of the random directions.

    Returns
    -------
    dict of str to ComplexStep
        By the name of the direction.

    Raises
    ------
    DesignError
        If x does not fit, or the problem is in single precision.
    """
    return dict(_complex_steps(*_settled(problem, x), x, directions, seed))


def _settled(problem: Problem, x: NDArray[np.float64]) -> tuple[Problem, NDArray[np.float64]]:
    """The problem in the time step that x is evaluated with, which stays, and the gradients."""
    if problem.precision != "double":
        raise DesignError(
            f'precision = "{problem.precision}" has no gradient that agrees to rounding; verify '
            'the problem with precision = "double"'
        )
    evaluation = problem.evaluate(x)
    problem = problem.at(evaluation.time_step)
    problem.halvings = 0
    for each in (problem, *problem.members):
        each.limits = None
    return problem, evaluation.gradients


def _complex_steps(
    problem: Problem,
    gradients: NDArray[np.float64],
    x: NDArray[np.float64],
    directions: int,
    seed: int,
) -> Iterator[tuple[str, ComplexStep]]:
    directions = count("complex_step_test", "directions", directions, 0, error=DesignError)
    rng, ulp = np.random.default_rng(seed), np.finfo(float).eps
    move = 2.0 * ulp * rng.choice([-1.0, 1.0], x.size)
    # To both sides, for a body at rest on a wall is where the objective has a kink.
    sides = (problem.evaluate(np.clip(x + s * move, -1.0, 1.0)) for s in (-1.0, 1.0))
    change = sum(np.linalg.norm(other.gradients - gradients, axis=1) for other in sides)
    rounding = ulp * np.array([max(problem.scene.grid.size), *len(problem.task.subject_to) * [1.0]])
    names = labels(problem.scene)
    designed = x.size - len(names)
    vectors = {}
    for number in range(directions if designed else 0):
        d = np.zeros(x.size)
        d[:designed] = rng.standard_normal(designed)
        vectors[f"phi along direction {number}"] = d
    for k, name in enumerate(names):
        d = np.zeros(x.size)
        d[designed + k] = 1.0
        vectors[name] = d
    for name, d in vectors.items():
        exact, terms = _derivatives(problem, x + 1j * COMPLEX_STEP * d)
        length = np.linalg.norm(d)
        scale = np.maximum(np.maximum(abs(exact), terms), rounding * length)
        error, noise = abs(exact - gradients @ d) / scale, (change + rounding) * length / scale
        for k in range(len(gradients)):
            of = f"{name}, {problem.task.subject_to[k - 1].term}" if k else name
            yield of, ComplexStep(float(error[k]), float(noise[k]))


def _derivatives(problem: Problem, x: NDArray[np.complex128]) -> tuple[NDArray, NDArray]:
    """Those of all terms (1 + m,) by the complex step, and the size of what each is a sum of."""
    pairs = [_terms(member, x) for member in problem.members or (problem,)]
    values, size = (np.array(part) for part in zip(*pairs))  # (S, 1 + m) each
    value, weights = problem.task.soft(values[:, 0])
    worst = values[:, 1:].real.argmax(axis=0), np.arange(1, values.shape[1])
    exact = np.array([value, *values[worst]]).imag / COMPLEX_STEP
    return exact, np.array([weights.real @ size[:, 0], *size[worst]])


def _terms(problem: Problem, x: NDArray[np.complex128]) -> tuple[list[complex], list[float]]:
    """Values of all terms in one scene, and the size of what the derivative of each is a sum of."""
    simulation = problem.simulation(x)
    states = simulation.watch(problem.task.instants(problem.scene)).states
    outcome = Outcome(simulation, problem.gamma(x), states)
    real_states = {step: state.real for step, state in states.items()}
    real = Outcome(problem.simulation(x.real), outcome.gamma.real, real_states)
    values, size = [], []
    for term in problem.task.terms:
        bars = term.adjoints(real)
        parts = [bar * states[step].imag for step, bar in bars.states.items()]
        parts += [bars.gamma * outcome.gamma.imag, bars.signal * simulation.signal.imag]
        values.append(term.value(outcome))
        size.append(math.hypot(*(float(np.linalg.norm(part)) for part in parts)) / COMPLEX_STEP)
    return values, size


class Taylor(NamedTuple):
    """Taylor test: remainders of a first-order expansion.

    Attributes
    ----------
    step : (k,) array
        Steps along the direction, each half of the one before.
    remainder : (k,) array
        abs(L(x + step d) - L(x) - step gradient.d).
    order : (k - 1,) array
        log2 of the ratio of successive remainders; 2 if the gradient is right.
    """

    step: NDArray[np.float64]
    remainder: NDArray[np.float64]
    order: NDArray[np.float64]


def taylor_test(
    problem: Problem,
    x: NDArray[np.float64],
    direction: NDArray[np.float64],
    steps: NDArray[np.float64] = DEFAULT_TAYLOR_STEPS,
) -> Taylor:
    """Remainders of the objective's first-order expansion at x.

    Where contact branches switch within a step the objective is not smooth and the order is lost;
    `contact_free` makes a window in which it holds.

    Parameters
    ----------
    problem : Problem
    x, direction : (n,) arrays
        x + step direction must stay within [-1, 1].
    steps : (k,) array, optional
        Default: 1/128 to 1/2048, for a direction whose entries are about one.
    """
    value, gradient = problem.value_and_gradient(x)
    slope = gradient @ direction
    remainder = np.array([
        abs(problem.value(x + step * direction) - value - step * slope) for step in steps
    ])  # fmt: skip
    with np.errstate(divide="ignore", invalid="ignore"):  # remainders may be zero
        order = np.log2(remainder[:-1] / remainder[1:]) / np.log2(steps[:-1] / steps[1:])
    return Taylor(np.asarray(steps), remainder, order)


def contact_free(scene: Scene, steps: int = 200) -> Scene:
    """The first steps of a scene without walls, ground and gravity: nothing is ever touched."""
    steps = min(steps, scene.steps)
    return dataclasses.replace(
        scene,
        steps=steps,
        walls=(),
        ground=(),
        gravity=(0.0, 0.0),
        transient=min(scene.transient, 0.5 * steps * scene.time_step),
    )


class Check(NamedTuple):
    """One line of `report`."""

    name: str
    value: float
    wanted: str
    passed: bool


def report(
    problem: Problem,
    x: NDArray[np.float64],
    seed: int = 0,
    progress: Callable[[Check], None] | None = None,
) -> list[Check]:
    """All three tests on a design: each kernel, the whole gradient, and the Taylor order.

    Parameters
    ----------
    problem : Problem
    x : (n,) array
        Design variables. The Taylor test, which needs room on both sides, starts from x / 2 with
        the projection at beta = 1.
    seed : int, optional
    progress : callable, optional
        Called with each check once it is made.
    """
    checks = []
    for check in _checks(problem, x, seed):
        checks.append(check)
        if progress is not None:
            progress(check)
    return checks


def _checks(problem: Problem, x: NDArray[np.float64], seed: int) -> Iterator[Check]:
    for name, error in kernel_mismatches(problem.scene, seed).items():
        wanted = f"<= {DOT_TOLERANCE:g}"
        yield Check(f"dot product: {name}", error, wanted, error <= DOT_TOLERANCE)
    problem, gradient = _settled(problem, x)
    for name, (error, noise) in _complex_steps(problem, gradient, x, 2, seed):
        tolerance = max(COMPLEX_TOLERANCE, noise)
        wanted = f"<= {tolerance:.2g}" + (" (rounding)" if noise > COMPLEX_TOLERANCE else "")
        yield Check(f"complex step: {name}", error, wanted, error <= tolerance)
    free = copy.copy(problem)
    free.scene, free.void_cutoff = contact_free(problem.scene), 0.0
    free.chain = DesignChain(free.scene, free.particles, 1.0)
    rng = np.random.default_rng(seed)
    # The second and third terms of the expansion may cancel along a direction, not along three.
    tries = (_taylor_check(free, x / 2.0, rng.uniform(-1.0, 1.0, x.size)) for _ in range(3))
    for check in tries:
        if check.passed:
            break
    yield check


def _taylor_check(problem: Problem, x: NDArray[np.float64], direction: NDArray) -> Check:
    """The order of the smallest remainder that is above rounding, if there is one."""
    taylor = taylor_test(problem, x, direction, REPORT_TAYLOR_STEPS)
    ulp = np.finfo(float).eps
    least = taylor_test(problem, x, direction, np.array([-2.0 * ulp, 2.0 * ulp])).remainder
    rounding = REMAINDER_ROUNDING * max(ulp * max(problem.scene.grid.size), *least)
    clear = np.flatnonzero(taylor.remainder[1:] > rounding)
    if not clear.size:
        largest = float(taylor.remainder[1:].max())
        passed = largest <= rounding  # what is not a number is not
        return Check("Taylor remainder, contact-free", largest, f"<= {rounding:.2g}", passed)
    order = float(taylor.order[clear[-1]])
    passed = abs(order - 2.0) <= ORDER_TOLERANCE
    return Check("Taylor order, contact-free", order, f"2 +- {ORDER_TOLERANCE:g}", passed)
