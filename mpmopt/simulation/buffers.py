"""Working memory of a run: the steps of a segment, and what one run leaves to the next."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import DTypeLike, NDArray

from mpmopt import kernels
from mpmopt.errors import SimulationError, StorageError
from mpmopt.scene.checks import MOST_NUMBERS
from mpmopt.simulation.ahead import Round, compile_in_two
from mpmopt.simulation.checkpoints import Checkpoints
from mpmopt.simulation.threads import MEETING, in_parallel

if TYPE_CHECKING:
    from mpmopt.simulation.simulation import Simulation


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


class Segment:
    """What `kernels.advance` leaves of the steps of a segment, and scratch arrays."""

    def __init__(self, simulation: Simulation, length: int, memory: Memory | None) -> None:
        self._goes_back = memory is not None  # what is only looked at leaves none to the next
        memory = memory or Memory()
        self.simulation, self.memory = simulation, memory
        memory.runs += 1
        self.run = memory.runs
        groups, dtype = simulation.data.mass.shape[0], simulation.initial.dtype
        states = (length + 1, kernels.STATE_SIZE * groups, 4)
        self.states = memory.take("states", states, dtype)
        self.blocks = len(simulation.data.first) - 1
        self.windows = np.zeros((length, self.blocks + 1, 4), np.int64)
        self.logs = memory.take("logs", (length, groups, 4), dtype)
        self.grids = np.empty((length, 0, kernels.NODE_SIZE), dtype)
        self.recomputed: set[int] = set()  # segments whose windows outgrew their room in the store
        kept = length * simulation.room[0] * kernels.NODE_SIZE
        self.most = max(MOST_NUMBERS, 4 * kept)
        self.reserve(*simulation.room, 0)
        self.states[0] = kernels.grouped(simulation.initial)

    def state(self, slot: int) -> NDArray:
        """The state (12, N) of the particles in a slot."""
        return kernels.ungrouped(self.states[slot], *self.simulation.initial.shape)

    def reserve(self, nodes: int, part: int, step: int) -> None:
        """`resize`, unless that would take far more memory than the run began with."""
        kept = len(self.grids) * nodes * kernels.NODE_SIZE
        shared = max(self.blocks, 2 * 9) * part * kernels.NODE_SIZE
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
        kept = self.grids
        shape = (len(kept), nodes, kernels.NODE_SIZE)
        if kept.size == 0:
            self.grids = self.memory.take("grids", shape, kept.dtype)
        else:
            self.grids = np.empty(shape, kept.dtype)
            self.grids[:, : kept.shape[1]] = kept
        self.scratch = kernels.Scratch.make(nodes, self.blocks, part, kept.dtype)

    def advance(self, first: int, last: int) -> None:
        """Advance from step `first`, whose state is in slot 0, to step `last`."""
        if first < last and self.states.dtype == float:
            name = "particles" if self._goes_back else "particles, only forward"
            compile_in_two(name, self._loops)
        simulation = self.simulation
        signal = simulation.signal[first:last]
        parameters = simulation.parameters_of_steps(first, last)
        reached, steps = 0, last - first
        while reached < steps:
            stop = min(steps, reached + simulation.steps_per_call)
            reached, end, particle = in_parallel(
                self.blocks,
                kernels.advance,
                self.states,
                self.grids,
                self.windows,
                self.logs,
                reached,
                stop,
                simulation.data,
                parameters,
                signal,
                self.scratch,
            )
            nodes, part = self.grids.shape[1], self.scratch.parts.shape[1]
            window = self.windows[reached % len(self.windows), :, 2:].prod(axis=1)
            if end == kernels.WINDOW_TOO_SMALL:
                self.reserve(int(1.25 * window[-1]), part, first + reached)
            elif end == kernels.PART_TOO_SMALL:
                self.reserve(nodes, int(1.25 * window[:-1].max()), first + reached)
            elif end != kernels.DONE:
                particle = min(particle, simulation.initial.shape[1] - 1)
                state = self.state(reached % len(self.states))
                raise _failure(simulation, end, first + reached, particle, state)

    def _loops(self) -> list[Round]:
        """The loops of a run, and of its way back if it goes back, in halves."""
        simulation, states = self.simulation, self.states
        data, parameters, signal = simulation.data, simulation.parameters, simulation.signal
        run = states, self.grids, self.windows, self.logs, 0, 0, data, parameters, signal
        meeting = np.empty(MEETING, np.int64), 0, 1
        bars = states[0], kernels.ParticleDataBar.zeros(len(data.mass), float), signal[None]
        seen = states[0], simulation._reference, simulation._solid, data, parameters
        places, held = np.empty(0, np.int64), np.empty((0, 0))
        looks = [
            (kernels.closest, seen),
            (kernels.grips, (states, places, data, parameters, held)),
            (kernels.energy, (states[0], data, parameters)),
            (kernels.indicators, (states[0], data, parameters, 0, 0)),
        ]
        back = [(kernels.advance_adjoint, (*run, self.scratch, *bars, *meeting))]
        mine = [(kernels.advance, (*run, self.scratch, *meeting))]
        return [(mine, looks + back if self._goes_back else looks)]

    def advance_adjoint(
        self,
        first: int,
        last: int,
        start: int,
        stop: int,
        state_bar: NDArray,
        bar: kernels.ParticleDataBar,
        signal_bar: NDArray,
    ) -> None:
        """The adjoint of steps `start` to `stop` of a segment, from the last to the first."""
        simulation = self.simulation
        part_bar = np.zeros((self.blocks, last - first, signal_bar.shape[1]), state_bar.dtype)
        in_parallel(
            self.blocks,
            kernels.advance_adjoint,
            self.states,
            self.grids,
            self.windows,
            self.logs,
            start - first,
            stop - first,
            simulation.data,
            simulation.parameters_of_steps(first, last),
            simulation.signal[first:last],
            self.scratch,
            state_bar,
            bar,
            part_bar,
        )
        signal_bar[start:stop] = part_bar[:, start - first : stop - first].sum(axis=0)

    def store(self, index: int, checkpoints: Checkpoints) -> None:
        """Store the state in slot 0, or the whole segment; without nodes if they outgrew it."""
        if not checkpoints.schedule.all_stored:
            checkpoints.write(index, state=self.state(0))
            return
        used = int(self.windows[:, -1, 2:].prod(axis=1).max())
        if used > self.simulation.room[0]:
            self.recomputed.add(index)
            checkpoints.write(index, states=self.states)
        else:
            grids = self.grids[:, :used]
            checkpoints.write(
                index, states=self.states, grids=grids, windows=self.windows, logs=self.logs
            )

    def recall(self, index: int, first: int, last: int, checkpoints: Checkpoints) -> None:
        """Bring the states and nodes of a segment back: read them, or recompute them."""
        if not checkpoints.schedule.all_stored:
            self.states[0] = kernels.grouped(checkpoints.read(index, "state"))
            self.advance(first, last)
            return
        self.states[:] = checkpoints.read(index, "states")
        if index in self.recomputed:
            self.advance(first, last)
        else:
            self.windows[:] = checkpoints.read(index, "windows")
            self.logs[:] = checkpoints.read(index, "logs")
            grids = checkpoints.read(index, "grids")
            self.grids[:, : grids.shape[1]] = grids


def _failure(
    simulation: Simulation, end: int, step: int, particle: int, state: NDArray
) -> SimulationError:
    x, y = (float(value) for value in np.real(kernels.parts(state).position[:, particle]))
    if end == kernels.INVERTED:
        what = "its deformation gradient is inverted"
    elif not (np.isfinite(x) and np.isfinite(y)):
        what = "its position is not a number"
    else:
        width, height = simulation.scene.grid.size
        margin = simulation.parameters.dx / 2
        what = (
            f"it left the grid ({margin:g} to {width - margin:g} by {margin:g} to "
            f"{height - margin:g})"
        )
    scene = simulation.scene
    floor = min(material.void_density for material in scene.materials)
    hint = (
        f"take a smaller time step (now {scene.time_step:g}, Courant {scene.courant:.2g}), a "
        f"higher void density (now {floor:g}), weaker actuation"
    )
    if end == kernels.ESCAPED:
        hint += ", or a larger grid"
    return SimulationError(what, step, particle, (x, y), hint)
