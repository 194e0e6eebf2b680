"""Forward and reverse loops over the steps of one body in one scene."""

from __future__ import annotations

import copy
import math
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise
from typing import Any, Literal

import numpy as np
from numpy.typing import DTypeLike, NDArray

from mpmopt import kernels
from mpmopt.errors import DesignError
from mpmopt.scene import Scene
from mpmopt.scene.particles import Particles, of_solid
from mpmopt.scene.parts import Vector
from mpmopt.simulation.buffers import Memory, Segment
from mpmopt.simulation.checkpoints import Checkpointing, Checkpoints, Schedule
from mpmopt.simulation.indicators import WATCH, Indicators, Looks, Watched, Watcher
from mpmopt.simulation.surroundings import parameters_of
from mpmopt.validation import shown

Precision = Literal["double", "single"]

# Kernels return to Python after so many steps times particles, so that signals are heard in time.
WORK_PER_CALL = 500_000
# Particles in a block, at least, and blocks, at most. They, and with them the order in which nodes
# are summed, do not depend on the number of threads.
BLOCK, BLOCKS = 400, 64


def check_precision(precision: Precision) -> Precision:
    """`precision`, or a DesignError."""
    if precision not in ("double", "single"):
        raise DesignError(f'precision = {shown(precision)} must be "double" or "single"')
    return precision


@dataclass(frozen=True)
class Gradient:
    """Derivatives of the objective with respect to a simulation's inputs.

    Attributes
    ----------
    density, stiffness : (N,) arrays
    signal : (steps, K) array
    state : (12, N) array
        With respect to the initial state.
    """

    density: NDArray[np.float64]
    stiffness: NDArray[np.float64]
    signal: NDArray[np.float64]
    state: NDArray[np.float64]


class Simulation:
    """One body, its material and its actuators' signals, ready to run.

    Parameters
    ----------
    scene : Scene
        Grid, time, walls, gravity, and the actuators' stresses.
    particles : Particles
        N of them.
    density, stiffness : (N,) arrays
        Mass density, and share of the solid's stiffness. Real, or complex for the complex step.
    signal : (steps, K) array
        Of the scene's K actuators; real or complex.
    state : (12, N) array, optional
        Initial state (layout: `mpmopt.kernels`); default: at rest and undeformed.
    precision : {"double", "single"}, optional
        Of all numbers. Single is for looks ahead: its gradients lose digits with every step.

    Raises
    ------
    DesignError
        If shapes do not fit, or a value is not finite or not positive where it must be.
    """

    at_once = WATCH  # steps that are kept while a run is only looked at

    def __init__(
        self,
        scene: Scene,
        particles: Particles,
        density: NDArray,
        stiffness: NDArray,
        signal: NDArray,
        state: NDArray | None = None,
        precision: Precision = "double",
    ) -> None:
        check_precision(precision)
        count = len(particles.position)
        if state is None:
            state = np.zeros((kernels.STATE_SIZE, count))
            x, _, _, F = kernels.parts(state)
            x[:], F[0, 0], F[1, 1] = particles.position.T, 1.0, 1.0
        shapes = {
            "density": (density, (count,)),
            "stiffness": (stiffness, (count,)),
            "signal": (signal, (scene.steps, len(scene.actuators))),
            "state": (state, (kernels.STATE_SIZE, count)),
        }
        for name, (array, shape) in shapes.items():
            if np.shape(array) != shape:
                raise DesignError(f"{name} has shape {np.shape(array)}, must have {shape}")
            kind = np.asarray(array).dtype
            if kind.kind not in "fciu":
                raise DesignError(f"{name} holds {kind}, must hold numbers")
            if np.ma.is_masked(array):
                raise DesignError(f"{name} has masked entries, which have no value; fill them")
            if not np.all(np.isfinite(array)):
                raise DesignError(f"{name} holds {np.sum(~np.isfinite(array))} values not finite")
        if count == 0:
            raise DesignError("the body has no particles")
        dtype = np.result_type(density, stiffness, signal, state, float)
        if precision == "single" and dtype.kind == "f":
            dtype = np.dtype(np.float32)
        if not np.real(density).min() > 0.0:
            raise DesignError(f"density {np.real(density).min():g} must be above 0")
        real = np.empty(0, dtype).real.dtype
        self.scene = scene
        self.particles = particles
        # A node's mass is a sum that cancels, so the least of it is rounding of a particle's.
        heaviest = float((particles.volume * np.real(density)).max())
        mass_tolerance = 8.0 * np.finfo(real).eps * heaviest
        self.parameters = parameters_of(scene)._replace(mass_tolerance=mass_tolerance)
        actuator = kernels.grouped(particles.actuator)
        stress = [(S[0][0], S[0][1], S[1][1]) for S in (a.stress for a in scene.actuators)]
        constants = np.array([
            kernels.grouped(of_solid(scene, particles, name)) for name in kernels.PARAMETERS
        ], dtype=real)  # fmt: skip
        self.data = kernels.ParticleData(
            volume=kernels.grouped(particles.volume.astype(dtype), repeat=False),
            mass=kernels.grouped((particles.volume * density).astype(dtype), repeat=False),
            stiffness=kernels.grouped(np.asarray(stiffness, dtype=dtype)),
            constants=constants,
            active=np.any(actuator >= 0, axis=1),
            actuated=(actuator == np.arange(len(stress))[:, None, None]).astype(real),
            actuation_stress=np.array(stress, dtype=float).reshape(-1, 3),
            first=np.linspace(
                0, -(-count // 4), min(max(count // BLOCK, 1), BLOCKS) + 1, dtype=np.int64
            ),
        )
        self.signal = np.array(signal, dtype=dtype, order="C")
        self.initial = np.array(state, dtype=dtype, order="C")

    def run(self, frames: Sequence[int] | None = None) -> NDArray:
        """Run forward and keep nothing.

        Parameters
        ----------
        frames : sequence of int, optional
            Increasing numbers of steps after which the state is wanted, 0 for the initial one.

        Returns
        -------
        (12, N) array, the final state; or (len(frames), 12, N) array

        Raises
        ------
        SimulationError
            If a particle leaves the grid, inverts, or is not a number.
        """
        wanted = self._wanted(frames)
        segment = self.segment(1)
        kept, step = [], 0
        for frame in wanted:
            segment.advance(step, frame)
            segment.states[0] = segment.states[(frame - step) % 2]
            kept.append(segment.state(0))
            step = frame
        return kept[-1] if frames is None else np.array(kept)

    def _wanted(self, frames: Sequence[int] | None) -> list[int]:
        """Steps before the states that `run` gives, or a DesignError."""
        wanted = [self.scene.steps] if frames is None else list(frames)
        whole = all(isinstance(frame, (int, np.integer)) for frame in wanted)
        ends = [0, *wanted, self.steps]
        if not whole or ends != sorted(ends):
            raise DesignError(
                f"frames must be whole numbers that increase from 0 to {self.steps}, got "
                f"{shown(wanted)}"
            )
        return wanted

    def pushed(self, step: int, velocity: Vector) -> Simulation:
        """The same body from a step on, with all that it has by then and a velocity more.

        Raises
        ------
        DesignError
            If the step is none before the last.
        SimulationError
            As `run`.
        """
        (state,) = self.run([step])
        other = self._from(step)
        other.initial = state
        kernels.parts(state).velocity[:] += np.reshape(velocity, (2, 1))
        return other

    def _from(self, step: int) -> Any:
        """The same without its first steps, at the old start."""
        if not 0 <= step < self.steps:
            raise DesignError(f"step = {step} must be from 0 to {self.steps - 1}")
        other = copy.copy(self)
        other.scene = replace(self.scene, steps=self.steps - step, transient=0.0)
        other.signal = self.signal[step:]
        other.parameters = self.parameters_of_steps(step, self.steps)
        return other

    def states(self) -> Iterator[NDArray]:
        """The states (12, N) after 0, 1, ... steps, one after the other.

        Raises
        ------
        SimulationError
            As `run`.
        """
        segment = self.segment(min(self.at_once, self.steps))
        yield segment.state(0)
        for first, last in self._parts(segment):
            for slot in range(1, last - first + 1):
                yield segment.state(slot)

    def _parts(self, segment: Segment) -> Iterator[tuple[int, int]]:
        """First step and the step after the last of what is in the segment, one after another."""
        length = len(segment.states) - 1
        for first in range(0, self.steps, length):
            last = min(first + length, self.steps)
            segment.advance(first, last)
            yield first, last
            if last < self.steps:  # the last steps stay for the way back
                segment.states[0] = segment.states[last - first]

    def watch(self, instants: Collection[int] = ()) -> Watched:
        """Run forward: how the run ends, and how close it came to failure.

        Parameters
        ----------
        instants : collection of int, optional
            Numbers of steps after which the state is wanted besides the last, 0 for the initial.

        Raises
        ------
        DesignError
            If an instant is none.
        SimulationError
            As `run`.
        """
        segment = self.segment(min(self.at_once, self.steps))
        watcher = Watcher(segment, instants)
        for first, last in self._parts(segment):
            watcher.follow(first, last)
        return Watched(watcher.states, watcher.indicators)

    def looks(self) -> Callable[[NDArray, int, int], Indicators]:
        """What takes the indicators of steps of a run, in their order (`Looks`)."""
        return Looks(self)

    def indicators(self, records: NDArray) -> Indicators:
        """Those of a state, as records of groups (`grouped`), but for energy and gap."""
        found = kernels.indicators(records, self.data, self.parameters, 0, len(self.data.mass))
        return Indicators(*(float(value) for value in found))

    def gap(self, records: NDArray) -> tuple[float, float, float]:
        """How near solid that was far apart comes in a state, and where (`kernels.closest`)."""
        found = kernels.closest(records, self._reference, self._solid, self.data, self.parameters)
        return tuple(float(value) for value in found)  # type: ignore[return-value]

    @cached_property
    def _solid(self) -> NDArray[np.bool_]:
        """Which particles (G, 4) have half the solid's stiffness or more."""
        solid = self.data.stiffness.real >= kernels.SOLID
        return solid & (self.data.mass.real > 0.0)  # others only fill their group

    @cached_property
    def _reference(self) -> NDArray[np.float64]:
        """Records (2 G, 4) of the particles' places in the reference configuration."""
        return kernels.grouped(self.particles.position.T)

    def parameters_of_steps(self, first: int, last: int) -> kernels.Parameters:
        """The surroundings, in which step `first` is number 0."""
        return self.parameters._replace(clamps=self.parameters.clamps[first:last])

    def segment(self, length: int, memory: Memory | None = None) -> Segment:
        """Room for so many steps, with the initial state in slot 0."""
        return Segment(self, length, memory)

    @property
    def steps(self) -> int:
        """Number of steps."""
        return self.scene.steps

    @property
    def steps_per_call(self) -> int:
        """Steps that the kernels make before they return to Python."""
        return 1 + WORK_PER_CALL // self.initial.shape[1]

    @cached_property
    def room(self) -> tuple[int, int]:
        """Records to start with, of the body's nodes and of a block's.

        The initial windows with a quarter to spare on each axis.
        """
        position = np.real(kernels.parts(self.initial).position)
        most = (self.parameters.nodes_x, self.parameters.nodes_y)

        def nodes(first: int, last: int) -> int:
            cells = np.fmin(np.ptp(position[:, first:last], axis=1) / self.parameters.dx, most)
            return int(np.prod(np.ceil(1.25 * cells) + 4))

        first = 4 * self.data.first
        blocks = max(nodes(a, b) for a, b in pairwise(first))
        return nodes(0, position.shape[1]), blocks

    def checkpoints(self, wish: Checkpointing) -> Checkpoints:
        """A store for `forward`, with the schedule that the wish and the body's size ask for.

        It holds of each segment the state (12, N) at its start; or, where all are kept, what
        `kernels.advance` leaves of its steps.

        Raises
        ------
        StorageError
            If the disk has too little room.
        """
        groups, dtype = self.data.mass.shape[0], self.initial.dtype
        states, log = (kernels.STATE_SIZE * groups, 4), (groups, 4)
        nodes, _ = self.room
        grid = (nodes, kernels.NODE_SIZE)
        numbers = math.prod(states) + math.prod(log) + math.prod(grid)
        step_bytes = numbers * dtype.itemsize
        schedule = Schedule.choose(self.steps, step_bytes, wish)
        length = schedule.segment
        arrays: dict[str, tuple[tuple[int, ...], DTypeLike]] = {
            "state": (self.initial.shape, dtype)
        }
        if schedule.all_stored:
            arrays = {
                "states": ((length + 1, *states), dtype),
                "grids": ((length, *grid), dtype),
                "windows": ((length, len(self.data.first), 4), np.int64),
                "logs": ((length, *log), dtype),
            }
        return Checkpoints(schedule, arrays)

    def forward(
        self,
        checkpoints: Checkpoints,
        memory: Memory | None = None,
        instants: Collection[int] = (),
    ) -> Forward:
        """Run forward, storing what the checkpoints' schedule asks for.

        Parameters
        ----------
        checkpoints : Checkpoints
        memory : Memory, optional
            Of an earlier run whose gradient was taken.
        instants : collection of int, optional
            As in `watch`.

        Raises
        ------
        DesignError
            If an instant is none.
        SimulationError
            As `run`.
        """
        segment = self.segment(checkpoints.schedule.segment, memory)
        watcher = Watcher(segment, instants)
        for index, (first, last) in enumerate(self._parts(segment)):
            watcher.follow(first, last)
            if last < self.steps:
                segment.store(index, checkpoints)
        return Forward(self, checkpoints, segment, watcher)

    def state_bar(self, terminal: NDArray) -> NDArray:
        """An adjoint (12, N) of the particles' state, as that of what is stepped."""
        return kernels.grouped(terminal.astype(self.initial.dtype), repeat=False)

    def zero_bar(self) -> Any:
        """Adjoints of what stays the same in all steps, nothing accumulated yet."""
        return kernels.ParticleDataBar.zeros(len(self.data.mass), self.initial.dtype)

    def gradient(self, state_bar: NDArray, bar: Any, signal_bar: NDArray) -> Gradient:
        """The gradient from the adjoints of all steps."""
        shape = self.initial.shape
        return Gradient(
            density=self.particles.volume * kernels.ungrouped(bar.mass, 1, shape[1])[0],
            stiffness=kernels.ungrouped(bar.stiffness, 1, shape[1])[0],
            signal=signal_bar,
            state=kernels.ungrouped(state_bar, *shape),
        )


def _check_terminal_adjoints(
    terminal_adjoints: Mapping[int, NDArray[np.float64]], shape: tuple[int, ...], steps: int
) -> None:
    """Adjoints of states of a shape after so many steps, or a DesignError."""
    for step, terminal in terminal_adjoints.items():
        if not 0 <= step <= steps or np.shape(terminal) != shape:
            raise DesignError(
                f"terminal_adjoints has shape {np.shape(terminal)} at step {step}, must have "
                f"{shape} at steps from 0 to {steps}"
            )


class Forward:
    """A forward run that is ready to be gone back through.

    Attributes
    ----------
    states : dict of int to (12, N) array
        The states after so many steps: those that were asked for, and the last.
    indicators : Indicators
    """

    def __init__(
        self,
        simulation: Simulation,
        checkpoints: Checkpoints,
        segment: Segment,
        watcher: Watcher,
    ) -> None:
        self.states, self.indicators = watcher.states, watcher.indicators
        self._simulation, self._checkpoints, self._segment = simulation, checkpoints, segment
        self._reversed = False

    @property
    def recomputed_segments(self) -> int:
        """Segments that `reverse` recomputes."""
        schedule = self._checkpoints.schedule
        if schedule.all_stored:
            return len(self._segment.recomputed)
        return len(schedule.segments) - 1

    def reverse(self, terminal_adjoints: Mapping[int, NDArray[np.float64]]) -> Gradient:
        """Go back through all steps from a function's derivatives by states.

        Parameters
        ----------
        terminal_adjoints : mapping of int to (12, N) array
            Derivatives by the states after so many steps, any of them from 0 to the last.

        Raises
        ------
        DesignError
            If there is no such step or a shape is wrong; if called a second time, as going back
            overwrites what it needs; or if another run was given the same memory meanwhile.
        StorageError
            If a checkpoint cannot be read back.
        """
        if self._reversed:
            raise DesignError("this run was gone back through already; run forward again")
        simulation, segment = self._simulation, self._segment
        if segment.memory.runs != segment.run:
            raise DesignError("another run took this one's memory; give each run its own")
        shape, steps = simulation.initial.shape, simulation.steps
        _check_terminal_adjoints(terminal_adjoints, shape, steps)
        self._reversed = True
        state_bar = simulation.state_bar(terminal_adjoints.get(steps, np.zeros(shape)))
        bar = simulation.zero_bar()
        signal_bar = np.zeros_like(simulation.signal)
        for index, (first, last) in reversed([*enumerate(self._checkpoints.schedule.segments)]):
            if last < steps:
                segment.recall(index, first, last, self._checkpoints)
            stop = last
            while stop > first:
                earlier = (step for step in terminal_adjoints if step < stop)
                start = max(first, stop - simulation.steps_per_call, *earlier)
                segment.advance_adjoint(first, last, start, stop, state_bar, bar, signal_bar)
                stop = start
                if start in terminal_adjoints:
                    state_bar += simulation.state_bar(terminal_adjoints[start])
        return simulation.gradient(state_bar, bar, signal_bar)
