"""Motions with an exact answer: a vibrating bar, and a manufactured solution between mirrors."""

import math

import numpy as np
from numpy.typing import NDArray

from mpmopt import kernels
from mpmopt.design.objective import Objective
from mpmopt.scene import Grid, Material, Mirror, Scene, Solid
from mpmopt.scene.particles import Particles, discretise, of_solid
from mpmopt.simulation.checkpoints import Checkpointing
from mpmopt.simulation.lagrangian import LagrangianSimulation
from mpmopt.simulation.simulation import Simulation
from mpmopt.simulation.surroundings import parameters_of


def solid_simulation(scene, particles=None, state=None, precision="double"):
    particles = particles or discretise(scene)
    ones = np.ones(len(particles.position))
    signal = np.zeros((scene.steps, len(scene.actuators)))
    if scene.formulation == "total":  # begins at rest
        return LagrangianSimulation(
            scene, particles, of_solid(scene, particles, "density"), ones, signal
        )  # fmt: skip
    return Simulation(
        scene, particles, of_solid(scene, particles, "density"), ones, signal, state, precision
    )  # fmt: skip


def at_rest(particles: Particles) -> NDArray[np.float64]:
    """State (12, N) of particles that do not move and are not deformed."""
    state = np.zeros((12, len(particles.position)))
    state[0:2] = particles.position.T
    state[[8, 11]] = 1.0
    return state


class Bar:
    """A bar that is held at one end and vibrates along its axis in its lowest mode.

    Length l = 25, E = 100, nu = 0, rho = 1; v = v0 sin(beta s) at a distance s from the held end,
    with beta = pi / (2 l), and omega = beta sqrt(E / rho). Small strains follow
    u = v / omega sin(omega t), so the middle of the bar moves by v0 / (2 omega) sin(omega t).
    A plane of symmetry holds the end.

    Parameters
    ----------
    n : int
        Cells along the bar; it is two wide.
    courant : float
    per_cell : int
        Particles per cell and direction.
    checkpointing : Checkpointing, optional
    precision : {"double", "single"}, optional
    viscosity : float, optional
        eta, which makes the middle move by `damped` times as much.
    formulation : {"updated", "total"}, optional
        As in `Scene`.
    """

    length = 25.0
    speed = 10.0
    amplitude = 1e-2
    duration = 11.25  # periods: one and an eighth

    def __init__(
        self, n, courant, per_cell=2, checkpointing=None, precision="double",
        viscosity=0.0, formulation="updated",
    ):  # fmt: skip
        dx = self.length / n
        free, held = 4 * dx, 4 * dx + self.length
        steps = math.ceil(self.duration * self.speed / dx / courant - 1e-6)
        scene = Scene(
            Grid((2 * n + 8, 10), dx), time_step=self.duration / steps, steps=steps,
            material=Material(0.0, self.speed**2 / 2.0, viscosity=viscosity),
            body=(Solid((free, 4 * dx), (held + self.length, 6 * dx)),),
            particles_per_cell=per_cell, mirror=Mirror("x", held), direction=(0.0, 1.0),
            formulation=formulation,
        )  # fmt: skip
        particles = discretise(scene)
        beta = math.pi / (2.0 * self.length)
        self.omega = beta * self.speed
        self.decay = 0.5 * viscosity * beta**2  # of sigma = E strain + eta d(strain)/dt
        self.state = at_rest(particles)
        s = beta * (held - particles.position[:, 0])
        self.state[2] = -self.amplitude * np.sin(s)
        self.state[4] = self.amplitude * beta * np.cos(s)
        self.state[8] = 1.0 / (1.0 + scene.time_step * self.state[4])
        self.middle = -free - self.length / 2.0
        if formulation == "total":
            self.simulation = solid_simulation(scene, particles)
            start, there = self.simulation.start, self.simulation.lattice.mass > 0.0
            # A spline through sin(beta x) has control points on it that are this much larger.
            larger = 1.0 / (0.75 + 0.25 * math.cos(beta * dx))
            sine = np.sin(beta * (held - start[0]))
            start[2] = np.where(there, -larger * self.amplitude * sine, 0.0)
        else:
            self.simulation = solid_simulation(scene, particles, self.state, precision)
        self.objective = Objective.of(scene, particles, (-1.0, 0.0))
        self.checkpointing = checkpointing or Checkpointing()

    def exact(self):
        """Travel of the middle, and its derivatives by ln mu and ln v0."""
        phase = self.omega * self.duration
        reach = self.amplitude / (2.0 * self.omega)
        travel = reach * math.sin(phase)
        return travel, np.array([0.5 * (reach * phase * math.cos(phase) - travel), travel])

    def damped(self):
        """Travel of the middle over what it would be without viscosity."""
        omega = math.sqrt(self.omega**2 - self.decay**2)
        swing = math.sin(omega * self.duration) / omega * math.exp(-self.decay * self.duration)
        return swing / (math.sin(self.omega * self.duration) / self.omega)

    def value_and_gradient(self):
        """The same as simulated."""
        simulation, state = self.simulation, self.state
        with simulation.checkpoints(self.checkpointing) as store:
            forward = simulation.forward(store)
            value = float(self.objective.value(forward.states))
            bar = forward.reverse(self.objective.terminal_adjoints(forward.states))
        by_mu = bar.stiffness.sum()  # lambda is zero
        strain = simulation.scene.time_step * state[4]
        if simulation.scene.formulation == "total":
            by_v0 = bar.state[2:] * simulation.start[2:]
            return value - self.middle, np.array([by_mu, by_v0.sum()])
        by_v0 = bar.state[[2, 4, 8]] * [state[2], state[4], -strain / (1.0 + strain) ** 2]
        return value - self.middle, np.array([by_mu, by_v0.sum()])


def manufactured_error(n, amplitude, courant=0.2, per_cell=2):
    """Greatest rms error over half a period, in amplitudes, of the manufactured solution.

    u_i = A sin(pi X_i) sin(c pi t + phi_i) on the unit square between mirror walls, which fold what
    particles put on the ghost nodes back to the inside.
    """
    E, nu = 1e4, 0.3
    la, mu = E * nu / ((1 + nu) * (1 - 2 * nu)), E / (2 * (1 + nu))
    c = math.sqrt(E)
    phase = np.array([[0.0], [math.pi]])
    dx = 1.0 / n
    offset = 3 * dx  # room for the ghost nodes
    material = Material(lame_lambda=la, lame_mu=mu)
    steps = math.ceil(1.0 / c / (courant * dx / material.wave_speed))
    dt = 1.0 / c / steps
    scene = Scene(
        Grid((n + 6, n + 6), dx), time_step=dt, steps=steps, material=material,
        body=(Solid((offset, offset), (1 + offset, 1 + offset)),), particles_per_cell=per_cell,
    )  # fmt: skip
    particles = discretise(scene)
    simulation = solid_simulation(scene, particles)
    data, parameters = simulation.data, parameters_of(scene)
    X = particles.position.T - offset
    sine, cosine = np.sin(np.pi * X), np.cos(np.pi * X)

    def exact(t):
        u = amplitude * sine * np.sin(c * np.pi * t + phase)
        slope = amplitude * np.pi * cosine * np.sin(c * np.pi * t + phase)
        return u, 1.0 + slope

    def force(t):
        u, F = exact(t)
        J = F[0] * F[1]
        return np.pi**2 * u * (mu - c**2 - (la * (np.log(J) - 1.0) - mu) / F**2)

    old = at_rest(particles)
    rate = c * np.pi * np.cos(phase)
    old[2:4] = amplitude * sine * rate
    old[4], old[7] = amplitude * np.pi * cosine * rate
    old[8], old[11] = 1.0 / (1.0 + dt * old[4]), 1.0 / (1.0 + dt * old[7])
    shape, groups, side = old.shape, len(data.mass), n + 7
    every, window = (0, groups), (0, 0, side, side)
    old = kernels.grouped(old)
    new = old.copy()
    grid, velocity = np.zeros((side * side, kernels.NODE_SIZE)), np.zeros(2 * side * side)
    cells, velocity_cells = np.zeros((9 * side * side, 4)), np.zeros(18 * side * side)
    tile, log_J = kernels.make_tile(groups, old), np.zeros((groups, 4))
    worst = 0.0
    for step in range(steps):
        push = dt * force(step * dt)
        old[2::12] += kernels.grouped(push[:1])
        old[3::12] += kernels.grouped(push[1:])
        kernels.deform(old, new, parameters, log_J, *every)
        kernels.locate(old, parameters, window, tile, *every)
        kernels.stress(old, new, log_J, data, parameters, np.zeros(0), tile, *every)
        cells[:] = 0.0
        kernels.p2g(old, data, tile, cells, *every)
        kernels.taylor_adjoint(cells, window, grid)
        mirror(grid.reshape(side, side, 4), 0, n)
        mirror(grid.reshape(side, side, 4).transpose(1, 0, 2), 1, n)
        for column in range(side):
            kernels.grid_update(grid, window, parameters, parameters.clamps[0], velocity, column)
        kernels.taylor(velocity, window, window, velocity_cells)
        kernels.g2p(old, new, parameters, tile, velocity_cells, *every)
        old, new = new, old
        u, _ = exact((step + 1) * dt)
        error = kernels.ungrouped(old, *shape)[0:2] - offset - X - u
        worst = max(worst, math.sqrt((error**2).sum(axis=0).mean()) / amplitude)
    return worst


def mirror(nodes, normal, n):
    """Make momentum and mass symmetric about node rows 3 and 3 + n of the first axis."""
    for row, inward in ((3, 1), (3 + n, -1)):
        for k in (1, 2):
            inside, ghost = nodes[row + k * inward], nodes[row - k * inward]
            reflected = ghost.copy()
            reflected[:, normal] *= -1.0
            inside += reflected
            ghost[:] = inside
            ghost[:, normal] *= -1.0
        nodes[row, :, normal] = 0.0
        nodes[row, :, 1 - normal] *= 2.0
        nodes[row, :, 2] *= 2.0
