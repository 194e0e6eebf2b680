"""Forward and reverse loops over the steps of one body in one scene."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import DTypeLike, NDArray

from mpmopt import mpm
from mpmopt.checkpoints import Checkpointing, Checkpoints, Schedule
from mpmopt.checks import shown
from mpmopt.energy import Balance
from mpmopt.errors import DesignError, SimulationError, StorageError
from mpmopt.particles import Particles
from mpmopt.scene import MOST_NUMBERS, Scene
from mpmopt.threads import together

Precision = Literal["double", "single"]

# Kernels return to Python after so many steps times particles, so that signals are heard in time.
WORK_PER_CALL = 500_000
# Particles in a block, at least, and blocks, at most. They, and with them the order in which nodes
# are summed, do not depend on the number of threads.
BLOCK, BLOCKS = 400, 64
# States are looked at for their margins once in so many steps, and at the end.
WATCH = 16


def check_precision(precision: Precision) -> Precision:
    """`precision`, or a DesignError."""
    if precision not in ("double", "single"):
        raise DesignError(f'precision = {shown(precision)} must be "double" or "single"')
    return precision


def world_of(scene: Scene) -> mpm.World:
    """The scene's surroundings as the kernels see them."""
    dx = scene.grid.dx
    return mpm.World(
        dt=scene.time_step,
        dx=dx,
        per_dx=1.0 / dx,
        nodes_x=scene.grid.cells[0] + 1,
        nodes_y=scene.grid.cells[1] + 1,
        gravity_x=scene.gravity[0],
        gravity_y=scene.gravity[1],
        wall_axis=np.array(["xy".index(w.axis) for w in scene.walls], dtype=np.int64),
        wall_side=np.array(
            [1 if w.solid_side == "below" else -1 for w in scene.walls], dtype=np.int64
        ),
        wall_node=np.array([round(w.position / dx) for w in scene.walls], dtype=np.int64),
        wall_friction=np.array(
            [np.inf if w.friction == "stick" else w.friction for w in scene.walls], dtype=float
        ),
        mirror_axis=-1 if scene.mirror is None else scene.mirror.normal,
        mirror_node=0 if scene.mirror is None else round(scene.mirror.position / dx),
        keep=math.exp(-scene.time_step / scene.blend_time) if scene.blend_time else 0.0,
        dust=0.0,
    )


class Margins(NamedTuple):
    """How close a run came to where its step is too long: extremes over particles and steps.

    States 0, 16, 32, ... and the last one are looked at. Real parts count.

    Attributes
    ----------
    courant : float
        Largest (dt / dx) sqrt(M / rho) with the stiffness M of the stretched particle. An isolated
        particle is unstable above 1.
    spin : float
        Largest dt |C|, the Frobenius norm. Below 1 no particle can be inverted by a step.
    jacobian : float
        Smallest J = det F.
    stretch : float
        Largest singular value of F among particles with half the solid's stiffness or more. Solid
        is torn where it exceeds the particles per cell and direction by far.
    energy : float
        Most that energy rose without work, as a share of what the run had to do with
        (`energy.Balance`). No law of motion allows any.
    """

    courant: float = 0.0
    spin: float = 0.0
    jacobian: float = math.inf
    stretch: float = 0.0
    energy: float = 0.0

    def join(self, other: Margins) -> Margins:
        """The margins of two runs, or of two parts of a run, taken together."""
        return Margins(
            max(self.courant, other.courant),
            max(self.spin, other.spin),
            min(self.jacobian, other.jacobian),
            max(self.stretch, other.stretch),
            max(self.energy, other.energy),
        )


@dataclass(frozen=True)
class Gradient:
    """Derivatives of the objective with respect to a simulation's inputs.

    Attributes
    ----------
    density, lame_lambda, lame_mu : (N,) arrays
    signal : (steps, K) array
    state : (12, N) array
        With respect to the initial state.
    """

    density: NDArray[np.float64]
    lame_lambda: NDArray[np.float64]
    lame_mu: NDArray[np.float64]
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
    density, lame_lambda, lame_mu : (N,) arrays
        Real, or complex for the complex step.
    signal : (steps, K) array
        Of the scene's K actuators; real or complex.
    state : (12, N) array, optional
        Initial state (layout: `mpmopt.mpm`); default: at rest and undeformed.
    precision : {"double", "single"}, optional
        Of all numbers. Single is for looks ahead: its gradients lose digits with every step.

    Raises
    ------
    DesignError
        If shapes do not fit, or a value is not finite or not positive where it must be.
    """

    def __init__(
        self,
        scene: Scene,
        particles: Particles,
        density: NDArray,
        lame_lambda: NDArray,
        lame_mu: NDArray,
        signal: NDArray,
        state: NDArray | None = None,
        precision: Precision = "double",
    ) -> None:
        check_precision(precision)
        count = len(particles.position)
        if state is None:
            state = np.zeros((mpm.STATE_SIZE, count))
            state[0:2] = particles.position.T
            state[8] = state[11] = 1.0
        shapes = {
            "density": (density, (count,)),
            "lame_lambda": (lame_lambda, (count,)),
            "lame_mu": (lame_mu, (count,)),
            "signal": (signal, (scene.steps, len(scene.actuators))),
            "state": (state, (mpm.STATE_SIZE, count)),
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
        dtype = np.result_type(density, lame_lambda, lame_mu, signal, state, float)
        if precision == "single" and dtype.kind == "f":
            dtype = np.dtype(np.float32)
        if not np.real(density).min() > 0.0:
            raise DesignError(f"density {np.real(density).min():g} must be above 0")
        real = np.empty(0, dtype).real.dtype
        self.scene = scene
        self.particles = particles
        # A node's mass is a sum that cancels, so the least of it is rounding of a particle's.
        dust = 8.0 * np.finfo(real).eps * float((particles.volume * np.real(density)).max())
        self.world = world_of(scene)._replace(dust=dust)
        actuator = mpm.grouped(particles.actuator)
        stress = [(S[0][0], S[0][1], S[1][1]) for S in (a.stress for a in scene.actuators)]
        self.body = mpm.Body(
            volume=mpm.grouped(particles.volume.astype(dtype), repeat=False),
            mass=mpm.grouped((particles.volume * density).astype(dtype), repeat=False),
            lame_lambda=mpm.grouped(np.asarray(lame_lambda, dtype=dtype)),
            lame_mu=mpm.grouped(np.asarray(lame_mu, dtype=dtype)),
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
        wanted = [self.scene.steps] if frames is None else list(frames)
        whole = all(isinstance(frame, (int, np.integer)) for frame in wanted)
        ends = [0, *wanted, self.steps]
        if not whole or ends != sorted(ends):
            raise DesignError(
                f"frames must be whole numbers that increase from 0 to {self.steps}, got "
                f"{shown(wanted)}"
            )
        memory = _Segment(self, 1, Memory())
        states = memory.states
        states[0] = mpm.grouped(self.initial)
        kept = []
        step = 0
        for frame in wanted:
            while step < frame:
                last = min(frame, step + self.steps_per_call)
                memory.advance(step, last)
                states[0] = states[(last - step) % 2]
                step = last
            kept.append(mpm.ungrouped(states[0], *self.initial.shape))
        return kept[-1] if frames is None else np.array(kept)

    def watch(self) -> Watched:
        """Run forward and keep nothing: how the run ends, and how close it came to failure.

        Raises
        ------
        SimulationError
            As `run`.
        """
        memory = _Segment(self, min(WATCH, self.steps), Memory())
        memory.states[0] = mpm.grouped(self.initial)
        watcher = _Watcher(self)
        for first in range(0, self.steps, WATCH):
            last = min(first + WATCH, self.steps)
            memory.advance(first, last)
            watcher.follow(memory.states, first, last)
            memory.states[0] = memory.states[last - first]
        state = mpm.ungrouped(memory.states[0], *self.initial.shape)
        return Watched(state, watcher.settled, watcher.margins)

    def margins(self, records: NDArray) -> Margins:
        """Those of a state, as records of groups of particles (`mpm.grouped`), but for energy."""
        solid = 0.5 * self.scene.material.lame_mu
        found = mpm.margins(records, self.body, self.world, solid, 0, len(self.body.mass))
        return Margins(*(float(value) for value in found))

    @property
    def sheets(self) -> int:
        """Sheets of nodes: two where particles keep a share of their own velocity, else one."""
        return 2 if self.world.keep > 0.0 else 1

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
        position = np.real(self.initial[0:2])
        most = (self.world.nodes_x, self.world.nodes_y)

        def nodes(first: int, last: int) -> int:
            cells = np.fmin(np.ptp(position[:, first:last], axis=1) / self.world.dx, most)
            return int(np.prod(np.ceil(1.25 * cells) + 4))

        first = 4 * self.body.first
        blocks = max(nodes(a, b) for a, b in pairwise(first))
        return nodes(0, position.shape[1]), blocks

    def checkpoints(self, wish: Checkpointing) -> Checkpoints:
        """A store for `forward`, with the schedule that the wish and the body's size ask for.

        It holds of each segment the state (12, N) at its start; or, where all are kept, what
        `mpm.advance` leaves of its steps.

        Raises
        ------
        StorageError
            If the disk has too little room.
        """
        groups, dtype = self.body.mass.shape[0], self.initial.dtype
        states, log = (mpm.STATE_SIZE * groups, 4), (groups, 4)
        nodes, _ = self.room
        grid = (self.sheets, nodes, mpm.NODE_SIZE)
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
                "windows": ((length, len(self.body.first), 4), np.int64),
                "logs": ((length, *log), dtype),
            }
        return Checkpoints(schedule, arrays, wish.store)

    def forward(self, checkpoints: Checkpoints, memory: Memory | None = None) -> Forward:
        """Run forward, storing what the checkpoints' schedule asks for.

        Parameters
        ----------
        checkpoints : Checkpoints
        memory : Memory, optional
            Of an earlier run whose gradient was taken.

        Raises
        ------
        SimulationError
            As `run`.
        """
        schedule = checkpoints.schedule
        segment = _Segment(self, schedule.segment, memory or Memory())
        segment.states[0] = mpm.grouped(self.initial)
        watcher = _Watcher(self)
        for index, (first, last) in enumerate(schedule.segments):
            if not schedule.all_stored:
                state = mpm.ungrouped(segment.states[0], *self.initial.shape)
                checkpoints.write(index, state=state)
            segment.advance(first, last)
            watcher.follow(segment.states, first, last)
            if last < schedule.steps:
                if schedule.all_stored:
                    segment.store(index, checkpoints)
                segment.states[0] = segment.states[last - first]
        return Forward(self, checkpoints, segment, watcher)


class Watched(NamedTuple):
    """How a run ended.

    Attributes
    ----------
    state : (12, N) array
        The final state.
    settled : (12, N) array or None
        The state after the scene's transient, if it has one.
    margins : Margins
    """

    state: NDArray
    settled: NDArray | None
    margins: Margins


class _Watcher:
    """What is seen of a run: its margins so far, and the state after the transient."""

    def __init__(self, simulation: Simulation) -> None:
        self.simulation, self._seen = simulation, Margins()
        self.settled: NDArray | None = None
        self._balance = Balance(simulation.body, simulation.world, simulation.signal)

    def follow(self, states: NDArray, first: int, last: int) -> None:
        """Look at steps `first` to `last`, whose states are in slots 0, 1, ..."""
        self._balance.follow(states, first, last)
        transient = self.simulation.scene.transient_steps
        if first < transient <= last:
            shape = self.simulation.initial.shape
            self.settled = mpm.ungrouped(states[transient - first], *shape)
        slots = [*range(-first % WATCH, last - first, WATCH)]
        if last == self.simulation.steps:
            slots.append(last - first)
        for slot in slots:
            self._seen = self._seen.join(self.simulation.margins(states[slot]))

    @property
    def margins(self) -> Margins:
        return self._seen._replace(energy=self._balance.appeared)


class Memory:
    """Working memory that one run leaves to the next.

    Memory that is new to a process costs more time than what a run writes into it.
    """

    def __init__(self) -> None:
        self._buffers: dict[str, NDArray[np.uint8]] = {}
        self.runs = 0  # that it was given to

    def take(self, name: str, shape: tuple[int, ...], dtype: DTypeLike) -> NDArray:
        """An array with any content, in the place of the last one of that name."""
        size = math.prod(shape) * np.dtype(dtype).itemsize
        if name not in self._buffers or self._buffers[name].size < size:
            self._buffers.pop(name, None)
            try:
                self._buffers[name] = np.empty(size, np.uint8)
            except MemoryError as error:
                raise StorageError(
                    f"no memory for {size} bytes of {name}: {error}; store fewer states "
                    "(Checkpointing.memory, .every), or simulate fewer particles"
                ) from error
        return self._buffers[name][:size].view(dtype).reshape(shape)


class _Segment:
    """What `mpm.advance` leaves of the steps of a segment, and scratch arrays."""

    def __init__(self, simulation: Simulation, length: int, memory: Memory) -> None:
        self.simulation, self.memory = simulation, memory
        memory.runs += 1
        self.run = memory.runs
        groups, dtype = simulation.body.mass.shape[0], simulation.initial.dtype
        states = (length + 1, mpm.STATE_SIZE * groups, 4)
        self.states = memory.take("states", states, dtype)
        self.blocks = len(simulation.body.first) - 1
        self.windows = np.zeros((length, self.blocks + 1, 4), np.int64)
        self.logs = memory.take("logs", (length, groups, 4), dtype)
        self.grids = np.empty((length, simulation.sheets, 0, mpm.NODE_SIZE), dtype)
        self.recomputed: set[int] = set()  # segments whose windows outgrew their room in the store
        kept = length * simulation.sheets * simulation.room[0] * mpm.NODE_SIZE
        self.most = max(MOST_NUMBERS, 4 * kept)
        self.make_room(*simulation.room, 0)

    def make_room(self, nodes: int, part: int, step: int) -> None:
        """`resize`, unless that would take far more memory than the run began with."""
        length, sheets, _, _ = self.grids.shape
        kept = length * sheets * nodes * mpm.NODE_SIZE
        shared = max(self.blocks, 2 * 9) * sheets * part * mpm.NODE_SIZE
        for numbers, most in ((kept, self.most), (shared, MOST_NUMBERS)):
            if numbers > most:
                raise SimulationError(
                    f"particles are spread over {nodes} nodes, those of a block over {part}, which "
                    f"takes {numbers:.3g} numbers, more than {most:.3g}",
                    step,
                    -1,
                    (math.nan, math.nan),
                    "let no part of the body fly away: take a smaller time step (now "
                    f"{self.simulation.scene.time_step:g}), weaker actuation, or a smaller grid",
                )
        self.resize(nodes, part)

    def resize(self, nodes: int, part: int) -> None:
        """Make room for windows of so many nodes, and so many in a block's, keeping the grids."""
        kept, sheets = self.grids, self.simulation.sheets
        shape = (len(kept), sheets, nodes, mpm.NODE_SIZE)
        if kept.size == 0:
            self.grids = self.memory.take("grids", shape, kept.dtype)
        else:
            self.grids = np.empty(shape, kept.dtype)
            self.grids[:, :, : kept.shape[2]] = kept
        self.scratch = mpm.Scratch.make(sheets, nodes, self.blocks, part, kept.dtype)

    def advance(self, first: int, last: int) -> None:
        """Advance from step `first`, whose state is in slot 0, to step `last`."""
        simulation = self.simulation
        signal = simulation.signal[first:last]
        reached, steps = 0, last - first
        while reached < steps:
            stop = min(steps, reached + simulation.steps_per_call)
            reached, end, particle = together(
                self.blocks,
                (stop - reached) * len(self.states[0]),
                mpm.advance,
                self.states,
                self.grids,
                self.windows,
                self.logs,
                reached,
                stop,
                simulation.body,
                simulation.world,
                signal,
                self.scratch,
            )
            nodes, part = self.grids.shape[2], self.scratch.parts.shape[2]
            window = self.windows[reached % len(self.windows), :, 2:].prod(axis=1)
            if end == mpm.WINDOW_TOO_SMALL:
                self.make_room(int(1.25 * window[-1]), part, first + reached)
            elif end == mpm.PART_TOO_SMALL:
                self.make_room(nodes, int(1.25 * window[:-1].max()), first + reached)
            elif end != mpm.DONE:
                shape = simulation.initial.shape
                particle = min(particle, shape[1] - 1)
                state = mpm.ungrouped(self.states[reached % len(self.states)], *shape)
                raise _failure(simulation, end, first + reached, particle, state)

    def store(self, index: int, checkpoints: Checkpoints) -> None:
        """Store the whole segment, or only its states if its windows outgrew their room."""
        used = int(self.windows[:, -1, 2:].prod(axis=1).max())
        if used > self.simulation.room[0]:
            self.recomputed.add(index)
            checkpoints.write(index, states=self.states)
        else:
            grids = self.grids[:, :, :used]
            checkpoints.write(
                index, states=self.states, grids=grids, windows=self.windows, logs=self.logs
            )

    def recall(self, index: int, first: int, last: int, checkpoints: Checkpoints) -> None:
        """Bring the states and nodes of a segment back: read them, or recompute them."""
        if not checkpoints.schedule.all_stored:
            self.states[0] = mpm.grouped(checkpoints.read(index, "state"))
            self.advance(first, last)
            return
        self.states[:] = checkpoints.read(index, "states")
        if index in self.recomputed:
            self.advance(first, last)
        else:
            self.windows[:] = checkpoints.read(index, "windows")
            self.logs[:] = checkpoints.read(index, "logs")
            grids = checkpoints.read(index, "grids")
            self.grids[:, :, : grids.shape[2]] = grids


class Forward:
    """A forward run that is ready to be gone back through.

    Attributes
    ----------
    state : (12, N) array
        The final state.
    settled : (12, N) array or None
        The state after the scene's transient, if it has one.
    margins : Margins
    """

    def __init__(
        self,
        simulation: Simulation,
        checkpoints: Checkpoints,
        memory: _Segment,
        watcher: _Watcher,
    ) -> None:
        self.settled, self.margins = watcher.settled, watcher.margins
        self._simulation, self._checkpoints, self._memory = simulation, checkpoints, memory
        self._reversed = False
        first, last = checkpoints.schedule.segments[-1]
        self.state = mpm.ungrouped(memory.states[last - first], *simulation.initial.shape)

    @property
    def recomputed_segments(self) -> int:
        """Segments that `reverse` recomputes."""
        schedule = self._checkpoints.schedule
        if schedule.all_stored:
            return len(self._memory.recomputed)
        return len(schedule.segments) - 1

    def reverse(
        self, seed: NDArray[np.float64], transient_seed: NDArray[np.float64] | None = None
    ) -> Gradient:
        """Go back through all steps from the objective's derivatives by states.

        Parameters
        ----------
        seed : (12, N) array
            By the final state.
        transient_seed : (12, N) array, optional
            By the state after the scene's transient.

        Raises
        ------
        DesignError
            If called a second time, as going back overwrites what it needs; or if another run was
            given the same memory meanwhile.
        StorageError
            If a checkpoint cannot be read back.
        """
        if self._reversed:
            raise DesignError("this run was gone back through already; run forward again")
        if self._memory.memory.runs != self._memory.run:
            raise DesignError("another run took this one's memory; give each run its own")
        self._reversed = True
        simulation, memory = self._simulation, self._memory
        schedule = self._checkpoints.schedule
        dtype, count = simulation.initial.dtype, seed.shape[1]
        bar = mpm.grouped(seed.astype(dtype), repeat=False)
        body_bar = mpm.BodyBar.zeros(len(simulation.body.mass), dtype)
        signal_bar = np.zeros_like(simulation.signal)
        segments, transient = schedule.segments, simulation.scene.transient_steps
        for index in range(len(segments) - 1, -1, -1):
            first, last = segments[index]
            if last < schedule.steps:
                memory.recall(index, first, last, self._checkpoints)
            part_bar = np.zeros((memory.blocks, *signal_bar[first:last].shape), dtype)
            stop = last - first
            while stop > 0:
                start = max(0, stop - simulation.steps_per_call)
                if start < transient - first < stop:
                    start = transient - first
                together(
                    memory.blocks,
                    (stop - start) * len(bar),
                    mpm.advance_adjoint,
                    memory.states,
                    memory.grids,
                    memory.windows,
                    memory.logs,
                    start,
                    stop,
                    simulation.body,
                    simulation.world,
                    simulation.signal[first:last],
                    memory.scratch,
                    bar,
                    body_bar,
                    part_bar,
                )
                stop = start
                if transient_seed is not None and first + start == transient:
                    bar += mpm.grouped(transient_seed.astype(dtype), repeat=False)
            signal_bar[first:last] = part_bar.sum(axis=0)
        return Gradient(
            density=simulation.particles.volume * mpm.ungrouped(body_bar.mass, 1, count)[0],
            lame_lambda=mpm.ungrouped(body_bar.lame_lambda, 1, count)[0],
            lame_mu=mpm.ungrouped(body_bar.lame_mu, 1, count)[0],
            signal=signal_bar,
            state=mpm.ungrouped(bar, mpm.STATE_SIZE, count),
        )


def _failure(
    simulation: Simulation, end: int, step: int, particle: int, state: NDArray
) -> SimulationError:
    x, y = (float(value) for value in np.real(state[0:2, particle]))
    if end == mpm.INVERTED:
        what = "its deformation gradient is inverted"
    elif not (np.isfinite(x) and np.isfinite(y)):
        what = "its position is not a number"
    else:
        width, height = simulation.scene.grid.size
        margin = simulation.world.dx / 2
        what = (
            f"it left the grid ({margin:g} to {width - margin:g} by {margin:g} to "
            f"{height - margin:g})"
        )
    scene = simulation.scene
    hint = (
        f"take a smaller time step (now {scene.time_step:g}, Courant {scene.courant:.2g}), a "
        f"higher mass floor (now {scene.material.mass_floor:g}), weaker actuation"
    )
    if end == mpm.ESCAPED:
        hint += ", or a larger grid"
    return SimulationError(what, step, particle, (x, y), hint)
