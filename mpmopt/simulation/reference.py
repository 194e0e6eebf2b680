"""One step as its equations say it, node by node: what `mpmopt.kernels` do, slowly.

The kernels sum over nodes by polynomials of cells, in groups of four particles and blocks of them.
Tests hold them against this, which shares no arithmetic with them.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from mpmopt.kernels import PARAMETERS, kirchhoff, parts, plain, ungrouped
from mpmopt.scene import Scene
from mpmopt.simulation.simulation import Simulation


def step(simulation: Simulation, state: NDArray, n: int) -> NDArray:
    """The state after step n, of a scene without a mirror.

    Parameters
    ----------
    simulation : Simulation
    state : (12, N) array
        At the start of the step; real or complex.
    n : int
        Number of the step, for the signal.

    Returns
    -------
    (12, N) array
    """
    scene, data, count = simulation.scene, simulation.data, state.shape[1]
    dt, dx = scene.time_step, scene.grid.dx
    V, m, stiffness = (
        ungrouped(values, 1, count)[0] for values in (data.volume, data.mass, data.stiffness)
    )
    constants = [stiffness * ungrouped(values, 1, count)[0] for values in data.constants]
    x, v, C, F = parts(state)
    I = np.eye(2)[:, :, None]  # noqa: E741
    law, viscosity = plain(kirchhoff), constants[PARAMETERS.index("viscosity")]

    # deform
    F = product(I + dt * C, F)
    J = F[0, 0] * F[1, 1] - F[0, 1] * F[1, 0]

    # stress
    sS = np.zeros_like(F)
    for k, actuator in enumerate(scene.actuators):
        there = simulation.particles.actuator == k
        sS = sS + simulation.signal[n, k] * there * np.array(actuator.stress)[:, :, None]
    FT = F.transpose(1, 0, 2)
    xx, xy, yy = law(F.reshape(4, -1), np.log(J), constants)
    B, D = product(F, FT), 0.5 * (C + C.transpose(1, 0, 2))
    tau = np.array([[xx, xy], [xy, yy]]) + product(product(F, sS), FT)
    tau = tau + viscosity * product(product(B, D), B)
    A = m * C - dt * V * (4.0 / dx**2) * tau

    # particle to grid
    base = np.floor(x.real / dx - 0.5).astype(int)
    stencil = []
    for a in range(3):
        for b in range(3):
            i, j = base[0] + a, base[1] + b
            d = np.stack([i, j]) * dx - x
            stencil.append((i, j, spline(d[0] / dx) * spline(d[1] / dx), d))
    nodes = tuple(cells + 1 for cells in scene.grid.cells)
    mass = np.zeros(nodes, state.dtype)
    q = np.zeros((2, *nodes), state.dtype)
    for i, j, w_i, d in stencil:
        np.add.at(mass, (i, j), w_i * m)
        for k in (0, 1):
            np.add.at(q[k], (i, j), w_i * (m * v[k] + A[k, 0] * d[0] + A[k, 1] * d[1]))

    # the ground's layers to grid
    force = np.zeros(nodes, state.dtype)
    for layer in scene.layers:
        depth, normal = layer.line.distance(x)
        pushed = stiffness * V * layer.stiffness * (1.0 - depth / layer.thickness)
        pushed = np.where(pushed.real > 0.0, pushed, 0.0)
        for i, j, w_i, _d in stencil:
            np.add.at(force, (i, j), w_i * pushed)
            for k in (0, 1):
                np.add.at(q[k], (i, j), w_i * dt * pushed * normal[k])

    # grid update
    u = np.zeros_like(q)
    for i, j in zip(*np.nonzero(mass.real > 0.0)):
        u[:, i, j] = q[:, i, j] / mass[i, j] + dt * np.array(scene.gravity)
        if force[i, j].real > 0.0:
            u[:, i, j] = resist(
                scene, np.array([i, j]) * dx, u[:, i, j], dt * force[i, j] / mass[i, j]
            )
        meet_walls(scene, np.array([i, j]) * dx, u[:, i, j])
        for clamp in scene.clamps:
            t, place = dt * np.array([n, n + 1]), np.array([i, j]) * dx
            before, after = clamp.displacement(t)
            low, high = before + clamp.lower - place, before + clamp.upper - place
            if (low <= 1e-6 * dx).all() and (high >= -1e-6 * dx).all():
                u[:, i, j] = (after - before) / dt
                break

    # grid to particle
    new = np.zeros_like(state)
    x_new, v_new, C_new, F_new = parts(new)
    for i, j, w_i, d in stencil:
        v_new += w_i * u[:, i, j]
        C_new += (4.0 / dx**2) * w_i * u[:, None, i, j] * d
    x_new[:] = x + dt * v_new
    F_new[:] = F
    return new


def spline(r: NDArray) -> NDArray:
    """Quadratic B-spline at distances r, in cells, from its middle."""
    r = np.where(r.real < 0.0, -r, r)
    return np.where(r.real < 0.5, 0.75 - r**2, np.where(r.real < 1.5, 0.5 * (1.5 - r) ** 2, 0.0))


def resist(scene: Scene, place: NDArray[np.float64], u: NDArray, push: complex | float) -> NDArray:
    """Velocity (2,) of a node at a place (2,) after friction and damping of the nearest ground.

    The layer changes the node's speed by `push` along the normal.
    """
    ground = min(scene.layers, key=lambda layer: float(layer.line.distance(place)[0]))
    _, n = ground.line.distance(place)
    u_n = (u @ n) * n
    u_t = u - u_n
    kept = 0.0 * push
    if ground.friction < np.inf:
        # Coulomb, implicit: u' + c tau(u') = u, tau = x (2 - x) with x = u' / creeping, at most 1.
        speed, c, creeping = np.sqrt(u_t @ u_t), ground.friction * push, ground.creeping_speed
        if speed.real >= (c + creeping).real:
            kept = 1.0 - c / speed
        else:
            b = creeping + 2.0 * c
            kept = 2.0 * creeping / (b + np.sqrt(b**2 - 4.0 * c * speed))
    return u_n / (1.0 + ground.damping * push) + u_t * kept


def meet_walls(scene: Scene, place: NDArray[np.float64], u: NDArray) -> None:
    """Change the velocity u (2,) of a node at a place (2,) where it approaches a wall before it.

    Coulomb: the wall takes the normal velocity, and of the tangential one no more than the friction
    coefficient times as much.
    """
    for wall in scene.walls:
        normal = "xy".index(wall.axis)
        outward = 1.0 if wall.solid_side == "below" else -1.0
        depth = outward * (wall.position - place[normal])
        approach = -outward * u[normal]
        if depth > 1e-3 * scene.grid.dx and approach.real > 0.0:
            sliding = u[1 - normal]
            speed = sliding if sliding.real > 0.0 else -sliding
            left = 0.0 * speed
            if wall.friction != "stick" and speed.real >= wall.friction * approach.real:
                left = speed - wall.friction * approach
            u[1 - normal] = left if sliding.real > 0.0 else -left
            u[normal] = 0.0


def product(a: NDArray, b: NDArray) -> NDArray:
    """Products of tensors (2, 2, N)."""
    return np.einsum("ijp,jkp->ikp", a, b)
