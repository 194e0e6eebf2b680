"""The books of a motion: its energy and who gives and takes it, and the forces that bear it.

A second look at every step, in NumPy, beside the kernels that made it (docs: theory, "Forces").
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.spatial import KDTree

from mpmopt import kernels
from mpmopt.assess.trajectory import with_image
from mpmopt.kernels.lagrangian import LEAST_J
from mpmopt.kernels.overlap import FAR
from mpmopt.kernels.pairs import REACH
from mpmopt.scene import Scene
from mpmopt.simulation.lagrangian import LagrangianSimulation
from mpmopt.simulation.simulation import Simulation
from mpmopt.simulation.surroundings import holders

# What a state has, and what it is given (less than zero: what is taken from it).
ENERGIES = ("kinetic", "elastic", "gravity", "layer", "self-contact")
WORKS = ("actuation", "viscosity", "friction", "damping", "walls", "clamps", "transfer")
Array = NDArray[np.float64]


@dataclass(frozen=True)
class Books:
    """Energy and forces of a body in S steps; of a scene with a mirror both halves count.

    Attributes
    ----------
    scene : Scene
    time : (S + 1,) array
    energy : dict of str to (S + 1,) array
        By kind: kinetic, with what the affine velocity has; elastic; gravity; what the grounds'
        layers store; and what pairs of the formulation "total" do that push each other.
    work : dict of str to (S + 1,) array
        What was done so far, by whom: actuation, viscosity, friction and damping of grounds, walls
        in all, clamps in all, and transfer between particles and nodes, of which no body knows; the
        formulation "total" has no walls and no transfer.
    supports : tuple of str
        The scene's grounds in their order, its walls as one, and its clamps in their order.
    force : (S, P, 2) array
        Of each of P supports on the body, mean of a step.
    place : (S, P, 2) array
        Where it acts: the mean place of a ground's normal force, and of what walls and clamps do;
        not a number where there is none.
    weight : float
    travel : float
        Of the centre of mass, along the scene's direction.
    actuation : float
        Work of actuators that do work; those that get work back do not give it to others.
    """

    scene: Scene
    time: Array
    energy: dict[str, Array]
    work: dict[str, Array]
    supports: tuple[str, ...]
    force: Array
    place: Array
    weight: float
    travel: float
    actuation: float

    @property
    def residual(self) -> Array:
        """Energy (S + 1,) that no work explains: the error of the steps."""
        total = np.sum([*self.energy.values()], axis=0)
        return total - total[0] - np.sum([*self.work.values()], axis=0)

    @property
    def turnover(self) -> float:
        """Kinetic energy at first, and all changes of potential energy and of works."""
        changes = [self.energy[kind] for kind in ENERGIES[1:]] + list(self.work.values())
        moved = sum(float(np.abs(np.diff(each)).sum()) for each in changes)
        return float(self.energy["kinetic"][0]) + moved

    @property
    def cost_of_transport(self) -> float:
        """Actuators' work over weight and travel's size; infinite if there is no such product."""
        return _cost(self.actuation, self.weight, self.travel)

    def means(self, count: int = 200) -> tuple[Array, Array, Array]:
        """Forces and places over so many equal parts of the time, as steps alone are rough.

        Returns
        -------
        (T,) array of the parts' middles, (T, P, 2) forces, (T, P, 2) places; T is `count`, or the
        number of steps if that is less
        """
        steps = len(self.force)
        starts = np.arange(min(count, steps)) * steps // min(count, steps)
        middle = self.time[starts] + 0.5 * self.scene.time_step * np.diff(starts, append=steps)
        return middle, *self._over(starts)

    def around(self, frames: NDArray[np.integer]) -> tuple[Array, Array]:
        """Forces and places (F, P, 2) at F instants, means from halfway to the ones beside them.

        Parameters
        ----------
        frames : (F,) array of int
            Increasing numbers of steps.
        """
        starts = np.concatenate([[0], (frames[:-1] + frames[1:] + 1) // 2])
        # Instants that are the same step, as there are where steps are few, have its force.
        return self._over(np.minimum(starts, len(self.force) - 1))

    def rows(self, count: int = 200) -> list[dict[str, float]]:
        """A table of as many parts of the time as `means` has.

        Each has its middle; the energies, and the works done so far, at its end; and every
        support's mean force on the body and its place.
        """
        time, force, place = self.means(count)
        steps = len(self.force)
        ends = (np.arange(len(time)) + 1) * steps // len(time)
        rows = []
        for n, end in enumerate(ends):
            row = {"time": float(time[n])}
            row |= {f"energy, {name}": float(each[end]) for name, each in self.energy.items()}
            row |= {f"work of {name}": float(each[end]) for name, each in self.work.items()}
            for k, support in enumerate(self.supports):
                for what, values in (("force", force), ("place", place)):
                    for axis, value in zip("xy", values[n, k]):
                        row[f"{what} of {support}, {axis}"] = float(value)
            rows.append(row)
        return rows

    def _over(self, starts: NDArray[np.integer]) -> tuple[Array, Array]:
        """Mean forces and places of the steps from each start to the next, one at least."""

        def summed(values: Array) -> Array:
            return np.add.reduceat(values, starts)

        lengths = np.maximum(np.diff(starts, append=len(self.force)), 1)
        there = np.isfinite(self.place)
        often = summed(there.astype(float))
        place = np.divide(
            summed(np.where(there, self.place, 0.0)),
            often,
            out=np.full(often.shape, np.nan),
            where=often > 0.0,
        )
        return summed(self.force) / lengths[:, None, None], place


def books(simulation: Simulation, progress: Callable[[], None] | None = None) -> Books:
    """Run a body and keep its books.

    Parameters
    ----------
    simulation : Simulation
    progress : callable, optional
        Called after every step.

    Raises
    ------
    SimulationError
        As `Simulation.run` does.
    """
    account = _account(simulation)
    steps, scene = simulation.steps, simulation.scene
    supports = tuple(f"ground {k}" for k in range(len(scene.layers)))
    supports += ("walls",) * bool(scene.walls)
    supports += tuple(f"clamp {k}" for k in range(len(scene.clamps)))
    energies, works = np.empty((steps + 1, len(ENERGIES))), np.zeros((steps + 1, len(WORKS)))
    force, place = np.empty((2, steps, len(supports), 2))
    states = account.states()
    first = old = next(states)
    held, given = account.held(old), 0.0
    energies[0] = account.energies(old)
    for n, new in enumerate(states):
        signal, before, held = simulation.signal[n].real, held, account.held(new)
        work = -signal * (held - before)
        given += float(np.maximum(work, 0.0).sum())
        energies[n + 1] = account.energies(new)
        others, force[n], place[n] = account.step(old, new, signal, n)
        works[n + 1] = work.sum(), *others
        old = new
        if progress is not None:
            progress()
    moved = account.centre(old) - account.centre(first)
    return Books(
        scene=scene,
        time=scene.time_step * np.arange(steps + 1.0),
        energy=dict(zip(ENERGIES, energies.T)),
        work=dict(zip(WORKS, np.add.accumulate(works).T)),
        supports=supports,
        force=force,
        place=place,
        weight=account.weight,
        travel=float(moved @ scene.direction),
        actuation=given,
    )


def cost_of_transport(simulation: Simulation) -> float:
    """That of a body's `books`, in less time: of the steps only actuators are looked at.

    Raises
    ------
    SimulationError
        As `Simulation.run` does.
    """
    account = _account(simulation)
    states = account.states()
    first = last = next(states)
    held, given = account.held(first), 0.0
    for signal, last in zip(simulation.signal.real, states):
        before, held = held, account.held(last)
        given += float(np.maximum(-signal * (held - before), 0.0).sum())
    moved = account.centre(last) - account.centre(first)
    return _cost(given, account.weight, float(moved @ simulation.scene.direction))


def _cost(actuation: float, weight: float, travel: float) -> float:
    carried = weight * abs(travel)
    return actuation / carried if carried > 0.0 else math.inf


def _account(simulation: Simulation) -> _Account:
    lattice = isinstance(simulation, LagrangianSimulation)
    return _LatticeAccount(simulation) if lattice else _Account(simulation)


class _Account:
    """What a step does with energy, of N particles and M nodes; of a mirror both halves count."""

    def __init__(self, simulation: Simulation) -> None:
        self.simulation, self.scene = simulation, simulation.scene
        scene = simulation.scene
        self.layers = scene.layers
        self.width = 0.0  # of particles, over which a layer's pressure is a mean
        data, count = simulation.data, simulation.initial.shape[1]
        halves = 1 if scene.mirror is None else 2

        def of_particles(values: NDArray) -> Array:
            return np.tile(kernels.ungrouped(values.real, 1, count)[0].astype(float), halves)

        self.volume, self.mass = of_particles(data.volume), of_particles(data.mass)
        self.stiffness = of_particles(data.stiffness)
        self.constants = [self.stiffness * of_particles(values) for values in data.constants]
        actuated = [of_particles(there) for there in data.actuated]
        self.actuated = np.reshape(actuated, (len(actuated), len(self.mass)))
        self.stress = np.array([actuator.stress for actuator in scene.actuators]).reshape(-1, 2, 2)
        self._prepare()

    def _prepare(self) -> None:
        """What nodes have, for which steps are to be looked at."""
        scene = self.scene
        whole = self.simulation.parameters._replace(mirror_axis=-1)
        self.parameters = whole._replace(walls=whole.walls[:0]), whole
        self.cells = scene.grid.cells[0] + 1, scene.grid.cells[1] + 1
        i, j = np.divmod(np.arange(self.cells[0] * self.cells[1]), self.cells[1])
        self.nodes = np.stack([i, j]) * scene.grid.dx  # their places (2, M)
        lines = [layer.line.distance(self.nodes) for layer in self.layers]
        self.ground = np.argmin([d for d, _ in lines], axis=0) if lines else np.zeros(i.size, int)
        self.normal = np.array([n for _, n in lines] or np.zeros((1, *self.nodes.shape)))
        self.normal = self.normal[self.ground, :, np.arange(i.size)].T

    def _both(self, state: NDArray) -> Array:
        """A state (12, N) of particles, and of a scene with a mirror its image (12, 2 N)."""
        mirror = self.scene.mirror
        return state.real if mirror is None else with_image(state.real, mirror)

    def states(self) -> Iterator[Array]:
        """States (12, N) after 0, 1, ... steps."""
        yield from map(self._both, self.simulation.states())

    @property
    def weight(self) -> float:
        """Of all particles."""
        return float(self.mass.sum()) * math.hypot(*self.scene.gravity)

    def centre(self, state: Array) -> Array:
        """Of mass (2,)."""
        return state[:2] @ self.mass / self.mass.sum()

    def _midway(self, state: Array) -> tuple[Array, Array]:
        """Where particles are and how deformed, (2, N) and (2, 2, N), when they have v and C."""
        dt = self.scene.time_step
        x, v, C, F = kernels.parts(state)
        return x - 0.5 * dt * v, F + 0.5 * dt * _product(C, F)

    def _motion(self, v: Array, C: Array) -> float:
        """Kinetic energy."""
        inertia = 0.25 * self.scene.grid.dx**2
        return 0.5 * float((self.mass * v**2).sum() + inertia * (self.mass * C**2).sum())

    def _bearing(self, x: Array) -> tuple[Array, Array]:
        """Normal forces (K, N) of layers on particles, and the unit normals (K, 2, N)."""
        forces, normals = np.empty((len(self.layers), x.shape[1])), []
        for force, layer in zip(forces, self.layers):
            d, normal = layer.line.distance(x)
            force[:] = self.stiffness * self.volume * layer.stiffness
            force *= layer.bearing(d, self.width)
            normals.append(normal)
        return forces, np.array(normals).reshape(-1, *x.shape)

    def kinetic(self, state: Array) -> float:
        """Energy."""
        _, v, C, _ = kernels.parts(state)
        return self._motion(v, C)

    def _logarithm(self, F: Array) -> Array:
        """ln J of deformation gradients (2, 2, N)."""
        return np.log(_determinant(F))

    def energies(self, state: Array) -> tuple[float, ...]:
        """`ENERGIES` of a state."""
        x, F = self._midway(state)
        log_J = self._logarithm(F)
        density = kernels.plain(kernels.energy_density)(F.reshape(4, -1), log_J, self.constants)
        share = self.stiffness * self.volume
        layer = sum(
            float(share @ each.stored(each.line.distance(x)[0], self.width)) * each.stiffness
            for each in self.layers
        )
        fallen = -float((self.mass * x).sum(axis=1) @ self.scene.gravity)
        elastic = float((self.volume * density).sum())
        return self.kinetic(state), elastic, fallen, layer, self.pressed(x)

    def pressed(self, x: Array) -> float:
        """Energy of parts at (2, N) that press each other, of which a grid has none."""
        return 0.0

    def held(self, state: Array) -> Array:
        """What each actuator squeezes (K,): V/2 S : F^T F."""
        _, F = self._midway(state)
        stretch = np.einsum("kab,cap,cbp->kp", self.stress, F, F)
        return 0.5 * (self.actuated * stretch * self.volume).sum(axis=1)

    def step(
        self, old: Array, new: Array, signal: Array, n: int
    ) -> tuple[tuple[float, ...], Array, Array]:
        """`WORKS` of a step but for the first, and every support's force and place (P, 2)."""
        dt, dx = self.scene.time_step, self.scene.grid.dx
        x, v, C, _ = kernels.parts(old)
        _, v_new, C_new, F = kernels.parts(new)

        # Stress: elastic, of actuators, viscous.
        log_J = self._logarithm(F)
        xx, xy, yy = kernels.plain(kernels.kirchhoff)(F.reshape(4, -1), log_J, self.constants)
        sS = np.einsum("k,kp,kab->abp", signal, self.actuated, self.stress)
        FT = F.transpose(1, 0, 2)
        B, D = _product(F, FT), 0.5 * (C + C.transpose(1, 0, 2))
        viscous = self.constants[kernels.PARAMETERS.index("viscosity")]
        viscous = viscous * _product(_product(B, D), B)
        tau = np.array([[xx, xy], [xy, yy]]) + _product(_product(F, sS), FT) + viscous

        # Particles to grid: momentum as it was, and what forces add.
        N, Nx, Ny = self._interpolation(x)
        borne, normal = self._bearing(x)
        push = (borne[:, None] * normal).sum(axis=0)
        A = -dt * self.volume * (4.0 / dx**2) * tau
        affine = self.mass * C
        m = N.T @ self.mass
        there = m > self.parameters[1].mass_tolerance
        per_m = np.divide(1.0, m, out=np.zeros_like(m), where=there)
        q = N.T @ (self.mass * v).T + Nx.T @ affine[:, 0].T + Ny.T @ affine[:, 1].T
        added = N.T @ (dt * push).T + Nx.T @ A[:, 0].T + Ny.T @ A[:, 1].T

        # Velocities of nodes: as they were, after forces, after grounds, after walls and clamps.
        u_old = q * per_m[:, None]
        grid = np.column_stack([q + added, m, N.T @ borne.sum(axis=0)])
        u_free = (q + added) * per_m[:, None] + dt * there[:, None] * self.scene.gravity
        window, after = (0, 0, *self.cells), np.zeros((2, 2 * len(m)))
        clamps = self.parameters[1].clamps[n]
        for parameters, held_too, velocity in zip(self.parameters, (clamps[:0], clamps), after):
            kernels.update_nodes(grid, window, parameters, held_too, velocity)
        u_ground, u = after.reshape(2, -1, 2)
        u_mean = 0.5 * (u_old + u)

        # Impulses of grounds, walls and clamps, whose work is that on the mean velocity.
        holder = holders(self.nodes, clamps)
        slowed = (grid[:, 3] > 0.0) & (holder < 0)
        impulse = (slowed * m)[:, None] * (u_ground - u_free)
        resisting = (impulse * self.normal.T).sum(axis=1)[:, None] * self.normal.T
        stopping = m[:, None] * (u - u_free) - impulse
        stopping[np.abs(stopping) <= 1e-13 * m[:, None] * np.abs(u_free).max()] = 0.0  # rounding
        damping = float((resisting * u_mean).sum())
        friction = float(((impulse - resisting) * u_mean).sum())
        given = (stopping * u_mean).sum(axis=1)
        walls, clamped = float(given[holder < 0].sum()), float(given[holder >= 0].sum())

        # Grid to particles, which take up less than nodes give, in motion, F and x.
        v_mean = (N @ u_mean).T
        C_mean = (4.0 / dx**2) * np.stack([(Nx @ u_mean).T, (Ny @ u_mean).T], axis=1)
        (x_old, F_old), (x_new, F_new) = self._midway(old), self._midway(new)
        strain, moved = _product(F_new - F_old, _inverse(F)), x_new - x_old
        dissipated = float((self.volume * viscous * strain).sum())
        kept = 0.5 * float((m[:, None] * (u_old**2 - u**2)).sum())
        transfer = kept - self._motion(v, C) + self._motion(v_new, C_new)
        transfer += float((self.volume * tau * (strain - dt * C_mean)).sum())
        transfer += float((push * (dt * v_mean - moved)).sum())
        works = (-dissipated, friction, damping, walls, clamped, transfer)
        return works, *self._supports(x, borne, normal, impulse, stopping, holder)

    def _interpolation(self, x: Array) -> tuple[sparse.csr_array, ...]:
        """Weights (N, M) of nodes at particles, and times how far nodes are along x and y."""
        dx, count = self.scene.grid.dx, x.shape[1]
        base = np.floor(x / dx - 0.5).astype(int)
        t = x / dx - base - 1.0  # from the middle one of three nodes, in cells
        w = np.array([0.5 * (0.5 - t) ** 2, 0.75 - t**2, 0.5 * (0.5 + t) ** 2])
        away = dx * (np.array([-1.0, 0.0, 1.0])[:, None, None] - t)
        product = w[:, None, 0] * w[None, :, 1]
        near = np.arange(3)
        node = (base[0] + near[:, None, None]) * self.cells[1] + base[1] + near[:, None]
        found = []
        for weight in (product, product * away[:, None, 0], product * away[None, :, 1]):
            data, indices = (each.reshape(9, count).T.ravel() for each in (weight, node))
            places = data, indices, np.arange(0, 9 * count + 1, 9)
            found.append(sparse.csr_array(places, shape=(count, self.nodes.shape[1])))
        return tuple(found)

    def _supports(
        self,
        x: Array,
        borne: Array,
        normal: Array,
        impulse: Array,
        stopping: Array,
        holder: NDArray[np.int64],
    ) -> tuple[Array, Array]:
        """Force and place (P, 2) of every support; what stops nodes is its holder, -1 the walls."""
        dt, forces, places = self.scene.time_step, [], []
        for k, b in enumerate(borne):
            own = impulse[self.ground == k].sum(axis=0)
            forces.append(normal[k] @ b + own / dt)
            places.append(_mean(x, b))
        for k in range(-1 if self.scene.walls else 0, len(self.scene.clamps)):
            own = stopping * (holder == k)[:, None]
            forces.append(own.sum(axis=0) / dt)
            places.append(_mean(self.nodes, np.hypot(*own.T)))
        return np.reshape(forces, (-1, 2)), np.reshape(places, (-1, 2))


class _LatticeAccount(_Account):
    """The same of a total Lagrangian body, whose states are those of its nodes (4, M).

    A state's velocity is what led to its place: in the middle of the way both belong together, and
    from there to the next middle a node goes dt times the mean of its old and new velocity. So the
    work of all that changes a node's momentum is exact, and of it only strains have an error.
    """

    simulation: LagrangianSimulation

    def _prepare(self) -> None:
        lattice = self.simulation.lattice
        self.width = float(np.sqrt(lattice.volume))
        # Nodes beside the mirror plane have their image's mass too, and stand for half a node each.
        shares = np.ones(self._lines)
        if lattice.mirror_axis >= 0:
            self._beside(shares)[:] = 0.5
        m = lattice.mass.real.astype(float)
        self._per_m = np.divide(1.0, m, out=np.zeros_like(m), where=m > 0.0)
        self._m = m * shares.ravel()
        if self.scene.mirror is not None:
            self._m = np.tile(self._m, 2)
        self._holder = np.full(len(m), -1)
        self._holder[lattice.held] = lattice.holder
        grip = lattice.touch.grip[self.simulation._seat].real.astype(float)
        self._grip = np.resize(grip, len(self.mass))  # images have that of their originals
        rest = np.zeros((kernels.STATE_SIZE, len(grip)))
        rest[:2] = self.simulation.particles.position.T
        self._rest = self._both(rest)[:2]

    @property
    def _lines(self) -> tuple[int, int]:
        """Nodes along y and x, which are stored so."""
        return self.simulation.lattice.rows + 2, 4 * self.simulation.lattice.groups + 4

    def _beside(self, lines: Array) -> Array:
        """The two lines of nodes beside the mirror plane."""
        lattice = self.simulation.lattice
        columns = slice(lattice.columns, lattice.columns + 2)
        return (
            lines[..., columns].swapaxes(-1, -2) if lattice.mirror_axis == 0 else lines[..., -2:, :]
        )

    def states(self) -> Iterator[Array]:
        for nodes in self.simulation.node_states():
            yield nodes.real

    def _nodes(self, nodes: Array) -> Array:
        """State (4, M) of nodes and their images."""
        mirror, both = self.scene.mirror, nodes
        if mirror is not None:
            image = nodes.copy()
            image[mirror.normal] = 2.0 * mirror.position - image[mirror.normal]
            image[2 + mirror.normal] *= -1.0
            both = np.concatenate([both, image], axis=1)
        return both

    def centre(self, state: Array) -> Array:
        return self._nodes(state)[:2] @ self._m / self._m.sum()

    def _midway(self, state: Array) -> tuple[Array, Array]:
        middle = state.copy()
        middle[:2] -= 0.5 * self.scene.time_step * middle[2:]
        x, _, _, F = kernels.parts(self._both(self.simulation.particle_state(middle)))
        return x, F

    def kinetic(self, state: Array) -> float:
        return 0.5 * float((self._m * self._nodes(state)[2:] ** 2).sum())

    def _pairs(self, x: Array) -> tuple[NDArray[np.int64], NDArray[np.int64], Array, Array]:
        """Pairs (P,) and (P,) of particles at (2, N) that push each other, d (2, P) and |d|."""
        dx = self.scene.grid.dx
        solid = np.flatnonzero(self._grip > 0.0)
        a, b = solid[KDTree(x[:, solid].T).query_pairs(REACH * dx, output_type="ndarray")].T
        # The distance of particles at rest, whose sites are integers, is not left to rounding.
        far = np.hypot(*(self._rest[:, a] - self._rest[:, b])) > FAR * dx * (1.0 + 1e-9)
        a, b = a[far], b[far]
        d = x[:, a] - x[:, b]
        return a, b, d, np.hypot(*d)

    def pressed(self, x: Array) -> float:
        a, b, _, r = self._pairs(x)
        deep = REACH * self.scene.grid.dx - r
        return 0.5 * float((self._grip[a] * self._grip[b] * deep**2).sum())

    def _pushed_apart(self, x: Array) -> Array:
        """Forces (2, N) of particles at (2, N) on each other."""
        a, b, d, r = self._pairs(x)
        f = self._grip[a] * self._grip[b] * (REACH * self.scene.grid.dx / r - 1.0) * d
        count = x.shape[1]
        return np.array([np.bincount(a, k, count) - np.bincount(b, k, count) for k in f])

    def _logarithm(self, F: Array) -> Array:
        J = _determinant(F)
        safe = np.maximum(J, LEAST_J)
        off = (J - safe) / safe
        return np.log(safe) + off - 0.5 * off**2

    def step(
        self, old: Array, new: Array, signal: Array, n: int
    ) -> tuple[tuple[float, ...], Array, Array]:
        simulation, dt = self.simulation, self.scene.time_step
        half = self.simulation.particle_state(old)
        x, _, _, F = kernels.parts(self._both(half))
        velocity = np.tile(old[2:], (2, 1))
        rate = kernels.parts(self._both(simulation.particle_state(velocity)))[3]

        # Viscous stress, on the strain from the middle of one step to that of the next.
        F_old, F_new = self._midway(old)[1], self._midway(new)[1]
        eta = self.constants[kernels.PARAMETERS.index("viscosity")]
        E = np.einsum("kip,kjp->ijp", F, rate)
        viscous = eta * 0.5 * _product(F, E + E.transpose(1, 0, 2))
        dissipated = float((self.volume * viscous * (F_new - F_old)).sum())

        # Velocities of nodes without friction, damping and clamps.
        borne, normal = self._bearing(x)
        push = (borne[:, None] * normal).sum(axis=0) + self._pushed_apart(x)
        count = half.shape[1]
        stress = self._first_piola(F, viscous, signal)[:, :, :count]
        N, Gx, Gy = simulation._weights
        force = np.concatenate([
            N.T @ push[:, :count].T - Gx.T @ stress[:, 0].T - Gy.T @ stress[:, 1].T,
            (N.T @ borne[:, :count].sum(axis=0))[:, None],
        ], axis=1)  # fmt: skip
        force = self._folded(force.T)
        free = old[2:] + dt * (force[:2] * self._per_m + np.reshape(self.scene.gravity, (2, 1)))
        taken = old.copy()
        touched = (force[2] > 0.0) | (self._holder >= 0)
        taken[2:] = np.where(touched & (self._per_m > 0.0), new[2:] - free, 0.0)

        places, lost, before, after = (self._nodes(each) for each in (old, taken, old, new))
        holder = np.resize(self._holder, len(self._m))  # images are in the same clamp
        lines = [layer.line.distance(places[:2]) for layer in self.layers]
        self.ground = np.argmin([d for d, _ in lines], axis=0) if lines else places[0] * 0
        along = np.zeros_like(places[:2])
        for k, (_, each) in enumerate(lines):
            along[:, self.ground == k] = each[:, self.ground == k]
        given, midst = self._m * lost[2:], 0.5 * (before[2:] + after[2:])
        impulse, stopping = given * (holder < 0), given * (holder >= 0)
        resisting = (impulse * along).sum(axis=0) * along
        damping = float((resisting * midst).sum())
        friction = float((impulse * midst).sum()) - damping
        clamped = float((stopping * midst).sum())
        self.nodes = places[:2]
        forces = self._supports(x, borne, normal, impulse.T, stopping.T, holder)
        return (-dissipated, friction, damping, 0.0, clamped, 0.0), *forces

    def _first_piola(self, F: Array, viscous: Array, signal: Array) -> Array:
        """V P (2, 2, N): elastic, viscous, and of actuators."""
        lam, mu = (self.constants[kernels.PARAMETERS.index(n)] for n in ("lame_lambda", "lame_mu"))
        J = _determinant(F)
        safe = np.maximum(J, LEAST_J)
        slope = (1.0 - (J - safe) / safe) / safe
        cofactor = np.array([[F[1, 1], -F[1, 0]], [-F[0, 1], F[0, 0]]])
        elastic = mu * F + (lam * self._logarithm(F) - mu) * slope * cofactor
        sS = np.einsum("k,kp,kab->abp", signal, self.actuated, self.stress)
        return self.volume * (elastic + viscous + _product(F, sS))

    def _folded(self, forces: Array) -> Array:
        """Forces (3, M) with what the mirrored half puts on nodes beside the mirror plane."""
        axis = self.simulation.lattice.mirror_axis
        if axis < 0:
            return forces
        lines = forces.reshape(3, *self._lines).copy()
        signs = np.ones((3, 1, 1))
        signs[axis] = -1.0
        beside = self._beside(lines)
        beside[:] = beside + signs * beside[:, ::-1]
        return lines.reshape(3, -1)


def _mean(places: Array, weights: Array) -> Array:
    """Mean of places (2, N), not a number if weights (N,) are zero."""
    total = weights.sum()
    return (places * weights).sum(axis=1) / total if total > 0.0 else np.full(2, np.nan)


def _product(a: Array, b: Array) -> Array:
    """Products of tensors (2, 2, N)."""
    return np.einsum("ijp,jkp->ikp", a, b)


def _inverse(F: Array) -> Array:
    """Inverses of tensors (2, 2, N)."""
    adjugate = np.array([[F[1, 1], -F[0, 1]], [-F[1, 0], F[0, 0]]])
    return adjugate / _determinant(F)


def _determinant(F: Array) -> Array:
    """Of tensors (2, 2, N)."""
    return F[0, 0] * F[1, 1] - F[0, 1] * F[1, 0]
