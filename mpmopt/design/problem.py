"""Scene and design to objective and gradient: all that an optimiser sees."""

from __future__ import annotations

import copy
import dataclasses
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mpmopt.design.actuation import signal_adjoint, sizes
from mpmopt.design.chain import DesignChain
from mpmopt.design.ensemble import side_by_side, together
from mpmopt.design.evaluation import Evaluation
from mpmopt.design.picture import looked_up
from mpmopt.design.step_control import LIMITS, check_indicators, too_long, with_halvings
from mpmopt.design.task import DEFAULT_TASK, Task
from mpmopt.design.term import Adjoints, Outcome
from mpmopt.design.variables import Variables
from mpmopt.design.variation import Variation
from mpmopt.errors import DesignError
from mpmopt.scene import Scene
from mpmopt.scene.particles import discretise, nearest_designed
from mpmopt.simulation.buffers import Memory
from mpmopt.simulation.checkpoints import Checkpointing
from mpmopt.simulation.formulations import simulation_of
from mpmopt.simulation.indicators import Indicators
from mpmopt.simulation.simulation import Gradient, Precision, Simulation, check_precision
from mpmopt.validation import count, instance, share


class Problem:
    """What a design achieves of a task in a scene, and which way to change it.

    The vector x of an optimiser is phi, a, theta, b, omega in this order (`Variables`), all within
    [-1, 1].

    Parameters
    ----------
    scene : Scene
    beta : float, optional
        Sharpness of the projection.
    checkpointing : Checkpointing, optional
    void_cutoff : float, optional
        Design particles whose gamma is below this are not simulated. Their void weighs nothing
        then, cannot be flung about, and costs no time; they return when the filter brings them
        back. The objective jumps where gamma crosses this; its gradient is that between jumps.
    halvings : int, optional
        How often an evaluation that fails or goes beyond a limit is made again with half the time
        step; then it is a SimulationError.
    limits : Indicators, optional
        Beyond which an evaluation is not trusted; None: only what fails is rejected.
    precision : {"double", "single"}, optional
        Of the simulation (`Simulation`).
    task : Task, optional
        Objective, constraints and scenes; default: the displacement in this one.
    subpixel : bool, optional
        Whether edges of the design are at least as wide as a particle, however large beta is
        (`projection.project_subpixel`).

    Attributes
    ----------
    members : tuple of Problem
        The same design in each scene of the task; empty if it has one.
    particles : Particles
    chain : DesignChain
    size : int
        Number n of design variables; D + 3 K of K actuators with one harmonic and no detuning.

    Raises
    ------
    DesignError
        If the scene is none, or beta, `void_cutoff`, `halvings`, `limits`, `precision` or the task
        makes no sense.
    """

    def __init__(
        self,
        scene: Scene,
        beta: float = 1.0,
        checkpointing: Checkpointing | None = None,
        void_cutoff: float = 0.0,
        halvings: int = 2,
        limits: Indicators | None = LIMITS,
        precision: Precision = "double",
        task: Task = DEFAULT_TASK,
        subpixel: bool = False,
    ) -> None:
        instance("Problem", "scene", scene, Scene)
        instance("Problem", "task", task, Task)
        for variation in task.scenes or (Variation(),):
            task.instants(variation.scene(scene))  # what makes no sense is told now
        self.task = task
        self.checkpointing = Checkpointing() if checkpointing is None else checkpointing
        instance("Problem", "checkpointing", self.checkpointing, Checkpointing)
        self.scene = scene
        self.precision: Precision = check_precision(precision)
        self._memories: list[Memory] = []
        self.void_cutoff = share("Problem", "void_cutoff", void_cutoff, error=DesignError)
        self.halvings = count("Problem", "halvings", halvings, 0, error=DesignError)
        if limits is not None:
            instance("Problem", "limits", limits, Indicators)
        self.limits = limits
        self.particles = discretise(scene)
        self.chain = DesignChain(scene, self.particles, beta, subpixel)
        self.size = int(self.particles.designed.sum()) + sum(sizes(scene))
        self.members = tuple(self._member(variation) for variation in task.scenes)

    def _member(self, variation: Variation) -> Problem:
        """This problem in one scene of its task."""
        member = copy.copy(self)
        member.scene, member.task, member.members = variation.scene(self.scene), self.task.alone, ()
        member._memories = []
        if variation.refinement > 1:
            member.particles = discretise(member.scene)
        member.chain = self.chain.varied(
            variation.threshold, member.scene, member.particles, self.particles
        )
        return member

    def join(self, phi: Any, a: Any, theta: Any, b: Any, omega: Any = 0.0) -> NDArray[np.float64]:
        """The vector x of named variables; single numbers stand for all entries.

        Parameters
        ----------
        phi : (rows, columns) array, callable, (D,) array or float
            A picture (`looked_up`); a function of the design particles' positions (D, 2), which
            gives phi (D,); or phi itself, column by column of particles from below.
        a, theta, b, omega : arrays or float
            As in `Variables`.

        Raises
        ------
        DesignError
            If a shape does not fit or an entry is no real number.

        Examples
        --------
        >>> import numpy as np
        >>> from mpmopt.design.problem import Problem
        >>> from mpmopt.scene import Actuator, Design, Grid, Scene
        >>> c = 1 / 16
        >>> body = Design((4 * c, 4 * c), (8 * c, 6 * c)), Actuator((4 * c, 6 * c), (8 * c, 7 * c))
        >>> problem = Problem(Scene(Grid((16, 16), c), 4e-3, 10, body))
        >>> picture = np.array([[1.0, 1.0, 1.0, 1.0], [1.0, -1.0, -1.0, 1.0]])  # two legs
        >>> x = problem.join(picture, a=1.0, theta=-0.3, b=-0.5)
        >>> print(x[:8])  # the first two columns of particles: the left leg
        [1. 1. 1. 1. 1. 1. 1. 1.]
        >>> print(x[8:12])  # the next one: the gap, and the row above it
        [-1. -1.  1.  1.]
        >>> legs = problem.join(lambda position: 1.0 - 2.0 * (position[:, 0] < 6 * c), 1, 0, 0)
        """
        position = self.particles.position[self.particles.designed]
        phi = _real("phi", phi(position.copy()) if callable(phi) else phi)
        vector = phi.size == len(position) and 1 in phi.shape
        if phi.ndim == 2 and not vector:
            phi = looked_up(phi, self.scene, position)
        parts = []
        for name, value, size in zip(
            Variables._fields, (phi, a, theta, b, omega), (len(position), *sizes(self.scene))
        ):
            array = _real(name, value)
            if array.size not in (1, size) or array.ndim > 1:
                hint = ", or be a picture or a function of positions" if name == "phi" else ""
                raise DesignError(
                    f"{name} has shape {array.shape}, must have {(size,)} or (){hint}"
                )
            parts.append(np.broadcast_to(array, size))
        return np.concatenate(parts)

    def split(self, x: NDArray) -> Variables:
        """The named variables of a vector x.

        Raises
        ------
        DesignError
            If x has another size, or an entry is not finite or outside [-1, 1].
        """
        x = _array("x", x)
        x = x.copy() if x.dtype == complex else _real("x", x)
        if x.shape != (self.size,):
            raise DesignError(
                f"x has shape {x.shape}, this problem's variables {(self.size,)}; Problem.join "
                "makes x of its parts"
            )
        outside = ~(np.abs(x.real) <= 1.0)
        if outside.any():
            raise DesignError(
                f"{outside.sum()} of {x.size} design variables are not within [-1, 1], the first "
                f"is x[{outside.argmax()}] = {x[outside.argmax()]}"
            )
        return Variables.of(x, self.scene)

    def transfer(self, other: Problem, x: NDArray[np.float64]) -> NDArray[np.float64]:
        """The design x of another problem as one of this problem, whose grid is another.

        Each design particle takes phi from the nearest one of the other problem's.
        """
        instance("Problem.transfer", "other", other, Problem)
        parts = other.split(x)
        phi = parts.phi[nearest_designed(self.particles, other.particles)]
        return self.join(phi, *parts[1:])

    def gamma(self, x: NDArray) -> NDArray:
        """Material density (D,) of the design particles."""
        return self.chain.field(self.split(x).phi).gamma

    def present(self, phi: NDArray) -> NDArray[np.bool_]:
        """Which of all particles are simulated (N,)."""
        if self.void_cutoff == 0.0:  # gamma may be below zero by rounding
            return np.ones(len(self.particles.position), dtype=bool)
        return self.particles.completed(self.chain.field(phi).gamma.real >= self.void_cutoff)

    def simulation(self, x: NDArray) -> Simulation:
        """The simulation of a design."""
        variables = self.split(x)
        present, field = self.present(variables.phi), self.chain.field(variables.phi)
        return simulation_of(
            self.scene,
            self.particles.subset(present),
            field.density[present],
            field.stiffness[present],
            variables.signal(self.scene),
            precision=self.precision,
        )

    def at(self, time_step: float) -> Problem:
        """The same problem in another time step.

        Raises
        ------
        SceneError
            If the scene cannot be simulated with it.
        """
        other = copy.copy(self)
        other.scene = self.scene.vary(time_step=time_step)
        share = time_step / self.scene.time_step
        other.members = tuple(each.at(share * each.scene.time_step) for each in self.members)
        return other

    def value(self, x: NDArray) -> Any:
        """Objective L of a design, larger is farther; complex if x is complex.

        Raises
        ------
        DesignError
            If x does not fit.
        SimulationError
            If the simulation fails, or comes too close to it, in all time steps that are tried.
        """
        return self._evaluation(x, Problem._value).value

    def constraints(self, x: NDArray) -> NDArray:
        """Values (m,) of the constraints' terms, as `value`."""
        return self._evaluation(x, Problem._value).constraints

    def value_and_gradient(self, x: NDArray) -> tuple[float, NDArray[np.float64]]:
        """Objective L and its gradient (n,), by the reverse loop.

        Raises
        ------
        DesignError, SimulationError, StorageError
            As `evaluate`.
        """
        evaluation = self.evaluate(x)
        return evaluation.value, evaluation.gradient

    def evaluate(self, x: NDArray) -> Evaluation:
        """Objective and gradient, and the time step that they are of.

        Raises
        ------
        DesignError, SimulationError
            As `value`; a gradient that is not finite is a SimulationError too.
        StorageError
            If checkpoints cannot be stored or read back.
        """
        x = _real("x", x)
        return self._evaluation(x, Problem._value_and_gradient)

    def _evaluation(
        self, x: NDArray, evaluate: Callable[[Problem, NDArray], Evaluation]
    ) -> Evaluation:
        """In all scenes of the task, each in a time step that is short enough."""

        def accepted(problem: Problem) -> Evaluation:
            def in_scene(scene: Scene) -> Evaluation:
                same = scene is problem.scene
                return evaluate(problem if same else problem.at(scene.time_step), x)

            evaluation, halved = with_halvings(problem.scene, in_scene, self.halvings)
            return dataclasses.replace(evaluation, halved=halved)

        if not self.members:
            return accepted(self)
        evaluation = together(self.task, side_by_side(accepted, self.members))
        time_step = self.scene.time_step / 2.0**evaluation.halved
        return dataclasses.replace(evaluation, time_step=time_step)

    def _value(self, x: NDArray) -> Evaluation:
        simulation = self.simulation(x)
        end = simulation.watch(self.task.instants(self.scene))
        self._check(end.indicators, simulation)
        outcome = Outcome(simulation, self.gamma(x), end.states)
        value, *others = (_finite(term.value(outcome), simulation) for term in self.task.terms)
        return Evaluation(
            value,
            np.empty(0),
            end.indicators,
            self.scene.time_step,
            constraints=np.array(others),
        )

    def _value_and_gradient(self, x: NDArray[np.float64]) -> Evaluation:
        variables, simulation = self.split(x), self.simulation(x)
        try:
            memory = self._memories.pop()
        except IndexError:  # the first evaluation, or others are under way
            memory = Memory()
        try:
            return self._differentiate(variables, simulation, memory)
        finally:
            self._memories.append(memory)

    def _differentiate(
        self, variables: Variables, simulation: Simulation, memory: Memory
    ) -> Evaluation:
        gamma = self.chain.field(variables.phi).gamma
        values, gradients = [], []
        with simulation.checkpoints(self.checkpointing) as checkpoints:
            instants = self.task.instants(self.scene)
            forward = simulation.forward(checkpoints, memory, instants)
            self._check(forward.indicators, simulation)
            outcome, swept = Outcome(simulation, gamma, forward.states), False
            for term in self.task.terms:
                values.append(float(_finite(term.value(outcome), simulation)))
                bars, sweep = term.adjoints(outcome), None
                if bars.states:
                    if swept:  # which overwrote what another needs
                        forward = simulation.forward(checkpoints, memory, instants)
                    sweep, swept = forward.reverse(bars.states), True
                gradients.append(_finite(self._pullback(variables, bars, sweep), simulation))
        return Evaluation(
            values[0],
            gradients[0],
            forward.indicators,
            self.scene.time_step,
            constraints=np.array(values[1:]),
            jacobian=np.array(gradients)[1:],
        )

    def _pullback(
        self, variables: Variables, bars: Adjoints, sweep: Gradient | None
    ) -> NDArray[np.float64]:
        """The gradient (n,) of a term, from its adjoints and the sweep that they began."""
        phi, a, theta, b, omega = variables
        density_bar, stiffness_bar = np.zeros((2, len(self.particles.position)))
        signal_bar = np.zeros((self.scene.steps, b.size)) + bars.signal
        if sweep is not None:
            present = self.present(phi)
            density_bar[present], stiffness_bar[present] = sweep.density, sweep.stiffness
            signal_bar = sweep.signal + bars.signal
        if np.ndim(bars.density):  # of a term that simulates by itself
            density_bar[self.present(phi)] += bars.density
            stiffness_bar[self.present(phi)] += bars.stiffness
        phi_bar = self.chain.field(phi).pullback(density_bar, stiffness_bar, bars.gamma)
        actuation_bar = signal_adjoint(self.scene, a, theta, signal_bar, omega)
        return np.concatenate([phi_bar, *actuation_bar])

    def _check(self, indicators: Indicators, simulation: Simulation) -> None:
        if self.limits is not None:
            check_indicators(indicators, simulation, self.limits)


def _array(name: str, value: Any) -> NDArray:
    if np.ma.is_masked(value):
        raise DesignError(f"{name} has masked entries, which have no value; fill them")
    try:
        return np.asarray(value)
    except (ValueError, OverflowError) as error:
        raise DesignError(f"{name} is no array of numbers: {error}") from error


def _real(name: str, value: Any) -> NDArray[np.float64]:
    array = _array(name, value)
    if not (np.issubdtype(array.dtype, np.floating) or np.issubdtype(array.dtype, np.integer)):
        raise DesignError(f"{name} holds {array.dtype}, must hold real numbers")
    with np.errstate(over="ignore"):  # wider numbers: infinite ones are refused
        return array.astype(float)


def _finite(values: Any, simulation: Simulation) -> Any:
    if not np.all(np.isfinite(values)):
        raise too_long(
            simulation,
            f"{np.sum(~np.isfinite(values))} of {np.size(values)} results are not finite",
        )
    return values
