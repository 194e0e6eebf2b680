"""The total Lagrangian formulation: a body on its reference lattice, forward and back."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import Any

import numpy as np
import scipy.sparse
from numpy.typing import DTypeLike, NDArray

from mpmopt import kernels
from mpmopt.errors import DesignError, SimulationError
from mpmopt.kernels import lagrangian, lattice_indicators, pairs
from mpmopt.scene.parts import Vector
from mpmopt.simulation.ahead import Round, compile_in_two
from mpmopt.simulation.buffers import Memory
from mpmopt.simulation.checkpoints import Checkpointing, Checkpoints, Schedule
from mpmopt.simulation.energy import LOOK
from mpmopt.simulation.indicators import Indicators, looked_at
from mpmopt.simulation.simulation import Gradient, Simulation
from mpmopt.simulation.surroundings import holders

# A node of which no particle takes more than one over this is light.
LIGHT = 16.0


class LagrangianSimulation(Simulation):
    """One body on its own lattice: for bodies that do not tear, at a fraction of the cost.

    It takes what `Simulation` takes, begins at rest and undeformed, and gives particle states of
    the same layout, whose affine velocity is zero. Its own state are nodes (4, M): position and
    velocity.
    """

    at_once = LOOK

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        if len(args) > 5 or kwargs.get("state") is not None:
            raise DesignError("the total Lagrangian formulation begins at rest; give no state")
        if self.initial.real.dtype == np.float32:
            raise DesignError(
                'the total Lagrangian formulation has no precision "single"; take "double"'
            )
        scene, particles = self.scene, self.particles
        per_cell, dx = scene.particles_per_cell, scene.grid.dx
        count, dtype = len(particles.position), self.initial.dtype
        low, high = self._cells()
        columns, rows = (int(cells) for cells in high - low)
        groups = -(-columns // 4)
        width = 4 * (groups + 1)
        site = np.floor(particles.position * (per_cell / dx)).astype(np.int64) - low * per_cell
        cell, place = site // per_cell, site % per_cell
        line = (cell[:, 1] * per_cell + place[:, 1]) * per_cell + place[:, 0]
        self._slot = 4 * groups * line + cell[:, 0]
        records = rows * per_cell**2 * groups
        self._number = np.full((records, 4), -1)
        self._number.ravel()[self._slot] = np.arange(count)

        def laid_out(values: NDArray) -> NDArray:
            """Numbers (N,) of particles as records (V, 4) of the lattice, zero where none is."""
            numbers = np.zeros(4 * records, values.dtype)
            numbers[self._slot] = values
            return numbers.reshape(records, 4)

        def of_particles(records: NDArray) -> NDArray:
            return kernels.ungrouped(records, 1, count)[0]

        self.nodes = (rows + 2) * width
        self._weights = self._interpolation(cell, place, width)
        there = laid_out(np.ones(count))
        actuated = np.array([laid_out(of_particles(each)) for each in self.data.actuated])
        actuated = actuated.reshape(-1, records, 4)
        constants = np.array([of_particles(each) for each in self.data.constants])
        alike = bool(np.all(constants == constants[:, :1]))
        mass = (self._weights[0].T @ of_particles(self.data.mass)).astype(dtype)
        influence = self._influence()
        axis = self._mirror_axis(high)
        grip, self._grip_slope = pairs.grips(
            of_particles(self.data.stiffness), constants[0] + 2.0 * constants[1], dx / per_cell, dx
        )
        at = np.stack(np.meshgrid(np.arange(width), np.arange(rows + 2), indexing="xy"))
        self.start = np.zeros((4, self.nodes), dtype)
        self.start[:2] = (at.reshape(2, -1) - 0.5 + low[:, None]) * dx
        # Nodes are in the middle of cells: so all nodes of a cell are held that is in a clamp.
        holder = holders(self.start[:2].real, self.parameters.clamps[0], 0.5 * dx)
        held = np.nonzero(holder >= 0)[0]
        self.lattice = lagrangian.Lattice(
            dt=scene.time_step,
            dx=dx,
            gravity_x=scene.gravity[0],
            gravity_y=scene.gravity[1],
            columns=columns,
            groups=groups,
            rows=rows,
            volume=(dx / per_cell) ** 2,
            viscous=bool(np.any(constants[2] > 0.0)),
            mirror_axis=axis,
            weights=lagrangian.weights(per_cell, dx),
            constants=np.repeat(constants[:, :1], 4, axis=1)[:, None]
            if alike
            else np.array([laid_out(each) for each in constants]),
            varied=int(not alike),
            stiffness=laid_out(of_particles(self.data.stiffness)),
            filled=np.any(there.reshape(rows, -1, groups, 4), axis=(1, 3)).ravel(),
            actuated=actuated,
            active=np.any(actuated, axis=(0, 2)),
            actuation_stress=self.data.actuation_stress,
            mass=self._folded(mass, axis, columns, width),
            squared_influence=influence**2,
            touch=self._touch(cell, place, low, high, grip, influence),
            held=held,
            holder=holder[held],
            clamps=self.parameters.clamps,
            ground=self.parameters.ground,
            nodes_y=self.parameters.nodes_y,
            nodes_x=self.parameters.nodes_x,
        )

    def _cells(self) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """First cell of the body along both axes, and the one after its last."""
        dx, scene = self.scene.grid.dx, self.scene
        corners = np.array([(region.lower, region.upper) for region in scene.body]) / dx
        low = np.floor(corners[:, 0].min(axis=0) + 1e-6).astype(np.int64)
        high = np.ceil(corners[:, 1].max(axis=0) - 1e-6).astype(np.int64)
        if scene.mirror is not None:
            k = scene.mirror.normal
            high[k] = min(high[k], round(scene.mirror.position / dx))
        return low, high

    def _touch(
        self,
        cell: NDArray[np.int64],
        place: NDArray[np.int64],
        low: NDArray[np.int64],
        high: NDArray[np.int64],
        grip: NDArray,
        influence: NDArray[np.float64],
    ) -> pairs.Touch:
        """What of the body may touch the rest of it, from the particles' places and grips (N,)."""
        mirror, dx, per_cell = self.scene.mirror, self.scene.grid.dx, self.scene.particles_per_cell
        columns, rows = (int(cells) for cells in high - low)
        width = self.nodes // (rows + 2)
        self._seat = cell[:, 0] * rows + cell[:, 1], place[:, 0] * per_cell + place[:, 1]
        grips = np.zeros((columns * rows, per_cell**2), grip.dtype)
        grips[self._seat] = grip
        cells = np.nonzero(np.any(grips.real > 0.0, axis=1))[0]
        corner = np.stack(np.divmod(np.arange(columns * rows), rows), axis=1)
        first = corner @ [1, width]
        offset = np.add.outer(np.arange(3), width * np.arange(3)).ravel()
        nodes = np.zeros(self.nodes)
        nodes[np.add.outer(first[cells], offset)] = 1.0
        image, axis = corner.copy(), -1
        if mirror is not None:
            axis = mirror.normal
            line = round(mirror.position / dx) - int(low[axis])
            image[:, axis] = 2 * line - 1 - image[:, axis]
        values = lagrangian.weights(per_cell, dx)[:, :3].copy()
        side = pairs.SIDE
        block_corner, block = np.unique(corner[cells] // side * side, axis=0, return_inverse=True)
        blocks = np.full((len(block_corner), side * side), -1)
        blocks[block, (corner[cells] % side) @ [side, 1]] = cells
        block_image = block_corner.copy()
        if mirror is not None:
            block_image[:, axis] = 2 * line - side - block_image[:, axis]
        return pairs.Touch(
            dx=dx,
            per_cell=per_cell,
            axis=axis,
            plane=0.0 if mirror is None else mirror.position,
            corner=np.concatenate([corner, image]),
            first=first,
            offset=offset,
            values=values,
            weights=np.einsum("am,bn->abmn", values, values).reshape(per_cell**2, 9),
            grip=grips,
            cells=cells,
            blocks=blocks,
            block_corner=np.concatenate([block_corner, block_image]),
            influence=influence * nodes,
            alone=np.full((2, self.nodes), pairs.NOWHERE),
        )

    def _influence(self) -> NDArray[np.float64]:
        """What of a node's speed counts (M,): no particle is faster than the most of all nodes has.

        A node at a corner, of which particles take next to nothing, has next to no mass either, and
        trembles far faster than any of them. For any c_i > 0, v_p = sum_i w_pi v_i is at most
        max_i(c_i v_i) times the largest sum_i w_pi / c_i of a particle.
        """
        weights = self._weights[0]
        counts = np.minimum(LIGHT * weights.max(axis=0).toarray().ravel(), 1.0)
        inverse = np.divide(1.0, counts, out=np.zeros_like(counts), where=counts > 0.0)
        return counts * max(float((weights @ inverse).max()), 1.0)

    def _mirror_axis(self, high: NDArray[np.int64]) -> int:
        """Of the plane that bounds the lattice, or -1."""
        mirror = self.scene.mirror
        if mirror is None or high[mirror.normal] != round(mirror.position / self.scene.grid.dx):
            return -1
        return mirror.normal

    def _folded(self, mass: NDArray, axis: int, columns: int, width: int) -> NDArray:
        """Masses of nodes, of which those beside a mirror plane also have their image's."""
        if axis < 0:
            return mass
        lines = mass.reshape(-1, width).copy()
        beside = lines[:, columns : columns + 2].T if axis == 0 else lines[-2:]
        beside[:] = beside.sum(axis=0)
        return lines.ravel()

    def _interpolation(
        self, cell: NDArray[np.int64], place: NDArray[np.int64], width: int
    ) -> tuple[scipy.sparse.csr_array, ...]:
        """Value and derivatives along x and y at the particles, (N, M) each."""
        dx, per_cell = self.scene.grid.dx, self.scene.particles_per_cell
        t = (place + 0.5) / per_cell
        value = np.stack([0.5 * (1.0 - t) ** 2, 0.75 - (t - 0.5) ** 2, 0.5 * t**2])  # (3, N, 2)
        slope = np.stack([t - 1.0, 1.0 - 2.0 * t, t]) / dx
        count = len(cell)
        node = [(cell[:, 1] + b) * width + cell[:, 0] + a for a in range(3) for b in range(3)]
        where = (np.tile(np.arange(count), 9), np.concatenate(node))

        def matrix(along_x: NDArray, along_y: NDArray) -> scipy.sparse.csr_array:
            entries = [along_x[a, :, 0] * along_y[b, :, 1] for a in range(3) for b in range(3)]
            return scipy.sparse.csr_array((np.concatenate(entries), where), (count, self.nodes))

        return matrix(value, value), matrix(slope, value), matrix(value, slope)

    def particle_state(self, nodes: NDArray) -> NDArray:
        """The state (12, N) of the particles from that (4, M) of the nodes."""
        return kernels.ungrouped(self._records(nodes), *self.initial.shape)

    def _records(self, nodes: NDArray) -> NDArray:
        """The same as records of groups of particles, as `kernels.grouped` makes them."""
        count = len(self._slot)
        records = np.zeros((kernels.STATE_SIZE * -(-count // 4), 4), nodes.dtype)
        lagrangian.particles(nodes, self.lattice, self._number, records)
        return records

    def particle_state_adjoint(self, bar: NDArray) -> NDArray:
        """Adjoint (4, M) of the nodes' state from that of the particles' (12, N)."""
        N, Gx, Gy = self._weights
        x_bar, v_bar, C_bar, F_bar = kernels.parts(bar)
        if np.any(C_bar):
            raise DesignError("the total Lagrangian formulation has no affine velocity to ask for")
        position = N.T @ x_bar.T + Gx.T @ F_bar[:, 0].T + Gy.T @ F_bar[:, 1].T
        return np.concatenate([position, N.T @ v_bar.T], axis=1).T.copy()

    def pushed(self, step: int, velocity: Vector) -> LagrangianSimulation:
        """As `Simulation.pushed`."""
        other, segment = self._from(step), self.segment(1)
        segment.advance(0, step)
        other.start = segment.states[step % 2].copy()
        other.start[2:] += np.reshape(velocity, (2, 1))
        return other

    def node_states(self) -> Iterator[NDArray]:
        """The states (4, M) of the nodes after 0, 1, ... steps, one after the other."""
        segment = self.segment(min(self.at_once, self.steps))
        yield self.start
        for first, last in self._parts(segment):
            yield from segment.states[1 : last - first + 1].copy()

    def looks(self) -> Callable[[NDArray, int, int], Indicators]:
        """As `Simulation.looks`."""
        return lambda states, first, last: self.look(
            states, looked_at(first, last, self.steps, LOOK)
        )

    def look(self, states: NDArray, slots: Sequence[int]) -> Indicators:
        """Indicators of states of the nodes, slots of `states` (., 4, M).

        Courant number, smallest J of solid, and gap. Of the Courant number a particle alone in its
        cell bears 0.9; blocks bear more. Solid cannot tear here, and no energy is counted.
        """
        found = np.empty((len(slots), 5))
        lattice_indicators.look(
            states, np.array(slots, np.int64), self.lattice, self._number, self._reference,
            self._solid, self.data, self.parameters, found,
        )  # fmt: skip
        seen = Indicators()
        for courant, jacobian, *gap in found.tolist():
            seen = seen.join(Indicators(courant, 0.0, jacobian, 0.0, 0.0, *gap))
        return seen

    def checkpoints(self, wish: Checkpointing) -> Checkpoints:
        """As `Simulation.checkpoints`; what is stored are states of nodes."""
        dtype = self.start.dtype
        schedule = Schedule.choose(self.steps, 4 * self.nodes * dtype.itemsize, wish)
        arrays: dict[str, tuple[tuple[int, ...], DTypeLike]] = {"state": (self.start.shape, dtype)}
        if schedule.all_stored:
            arrays = {"states": ((schedule.segment + 1, *self.start.shape), dtype)}
        return Checkpoints(schedule, arrays)

    def segment(self, length: int, memory: Memory | None = None) -> Any:
        """As `Simulation.segment`."""
        return NodeSegment(self, length, memory or Memory())

    def state_bar(self, terminal: NDArray) -> NDArray:
        """As `Simulation.state_bar`: that of the nodes (4, M)."""
        return self.particle_state_adjoint(terminal).astype(self.start.dtype)

    def zero_bar(self) -> lagrangian.LatticeBar:
        """As `Simulation.zero_bar`."""
        return lagrangian.LatticeBar.zeros(self.lattice, self.start.dtype)

    def gradient(self, state_bar: NDArray, bar: Any, signal_bar: NDArray) -> Gradient:
        """As `Simulation.gradient`; its state is that of the nodes (4, M)."""
        lattice = self.lattice
        width = 4 * (lattice.groups + 1)
        mass_bar = self._folded(bar.mass, lattice.mirror_axis, lattice.columns, width)
        return Gradient(
            density=self.particles.volume * (self._weights[0] @ mass_bar),
            stiffness=bar.stiffness.ravel()[self._slot] + self._grip_slope * bar.grip[self._seat],
            signal=signal_bar,
            state=state_bar,
        )

    @property
    def steps_per_call(self) -> int:
        """Steps that the kernels make before they return to Python."""
        return 1 + 1_000_000 // self.nodes


class NodeSegment:
    """The states of nodes of a segment, as `Segment`."""

    def __init__(self, simulation: LagrangianSimulation, length: int, memory: Memory) -> None:
        self.simulation, self.memory = simulation, memory
        memory.runs += 1
        self.run = memory.runs
        start = simulation.start
        self.states = memory.take("nodes", (length + 1, *start.shape), start.dtype)
        self.states[0] = start
        self.recomputed: set[int] = set()

    def state(self, slot: int) -> NDArray:
        """As `Segment.state`."""
        return self.simulation.particle_state(self.states[slot])

    def advance(self, first: int, last: int) -> None:
        """As `Segment.advance`."""
        if first < last and self.states.dtype == float:
            compile_in_two("lattice", self._loops)
        simulation = self.simulation
        clamps = simulation.parameters.clamps[first:]
        lattice = simulation.lattice._replace(clamps=clamps)
        step = first
        while step < last:
            stop = min(last, step + simulation.steps_per_call)
            reached, node = lagrangian.advance_lattice(
                self.states, step - first, stop - first, lattice, simulation.signal[first:]
            )
            if node >= 0:
                x, y = self.states[reached % len(self.states), :2, node].real.tolist()
                raise SimulationError(
                    "a node is not a number", first + reached, -1, (x, y),
                    f"take a smaller time step (now {simulation.scene.time_step:g}), a higher void "
                    "density or weaker actuation",
                )  # fmt: skip
            step = stop

    def _loops(self) -> list[Round]:
        """The loops of a run and of its way back, in halves that take as long to compile."""
        simulation, states, x = self.simulation, self.states, self.states[0]
        lattice, signal, number = simulation.lattice, simulation.signal, simulation._number
        inner, bar = lattice._replace(touch=0), lagrangian.LatticeBar.zeros(lattice)
        rows = lagrangian.Rows(*(np.empty((0,) * axes) for axes in (2, 2, 4)))
        near, groups = kernels.plain(pairs.nowhere)(lattice.touch), lattice.filled
        body = simulation._reference, simulation._solid, simulation.data, simulation.parameters
        look = states, np.empty(0, np.int64), lattice, number, *body, np.empty((0, 5))
        run = states, 0, 0, lattice, signal
        return [
            (
                [
                    (lattice_indicators.look, look),
                    (lagrangian.particles, (x, lattice, number, x)),
                    (lagrangian.forces, (x, inner, signal[0], rows, x)),
                    (lagrangian.press, (x, inner, groups, rows, x)),
                ],
                [(pairs.renewed, (near, x, lattice.touch))],
            ),
            (
                [
                    (lagrangian.forces_adjoint, (x, x, inner, signal[0], rows, x, bar, signal[0])),
                    (lagrangian.press_adjoint, (x, x, inner, groups, rows, x, bar)),
                ],
                [
                    (lagrangian.move, (x, x, x, inner.mass, inner)),
                    (lagrangian.move_adjoint, (x, x, x, inner.mass, inner, x, x, bar)),
                    (pairs.push_apart_adjoint, (near, x, lattice.touch, x, x, bar.grip)),
                ],
            ),
            (
                [(lagrangian.advance_lattice, run)],
                [(lagrangian.advance_lattice_adjoint, (*run, x, bar, signal))],
            ),
        ]

    def advance_adjoint(
        self,
        first: int,
        last: int,
        start: int,
        stop: int,
        state_bar: NDArray,
        bar: lagrangian.LatticeBar,
        signal_bar: NDArray,
    ) -> None:
        """As `Segment.advance_adjoint`."""
        simulation = self.simulation
        lagrangian.advance_lattice_adjoint(
            self.states, start - first, stop - first, simulation.lattice,
            simulation.signal[first:last], state_bar, bar, signal_bar[first:last],
        )  # fmt: skip

    def store(self, index: int, checkpoints: Checkpoints) -> None:
        """As `Segment.store`."""
        if checkpoints.schedule.all_stored:
            checkpoints.write(index, states=self.states)
        else:
            checkpoints.write(index, state=self.states[0])

    def recall(self, index: int, first: int, last: int, checkpoints: Checkpoints) -> None:
        """As `Segment.recall`."""
        if checkpoints.schedule.all_stored:
            self.states[:] = checkpoints.read(index, "states")
        else:
            self.states[0] = checkpoints.read(index, "state")
            self.advance(first, last)
