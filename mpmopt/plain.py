"""One step as its equations say it, node by node: the slow definition of what `mpmopt.mpm` does.

The kernels sum over nodes by polynomials of cells, in groups of four particles and blocks of them.
Tests hold them against this.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from mpmopt import mpm
from mpmopt.simulate import Simulation


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
    world, body, count = simulation.world, simulation.body, state.shape[1]
    dt, dx = world.dt, world.dx
    constants = (body.volume, body.mass, body.lame_lambda, body.lame_mu)
    V, m, la, mu = (mpm.ungrouped(values, 1, count)[0] for values in constants)
    x, v = state[0:2], state[2:4]
    C, F = state[4:8].reshape(2, 2, count), state[8:12].reshape(2, 2, count)
    I = np.eye(2)[:, :, None]  # noqa: E741

    # deform
    F = product(I + dt * C, F)
    J = F[0, 0] * F[1, 1] - F[0, 1] * F[1, 0]

    # stress
    sS = np.zeros_like(F)
    for k, (xx, xy, yy) in enumerate(body.actuation_stress):
        there = mpm.ungrouped(body.actuated[k], 1, count)[0]
        sS = sS + simulation.signal[n, k] * there * np.array([[[xx], [xy]], [[xy], [yy]]])
    FT = F.transpose(1, 0, 2)
    tau = mu * (product(F, FT) - I) + la * np.log(J) * I + product(product(F, sS), FT)
    A = m * C - dt * V * (4.0 / dx**2) * tau

    # particle to grid
    base = np.floor(x.real / dx - 0.5).astype(int)
    w = [mpm.weights(x[k] / dx - base[k]) for k in (0, 1)]
    stencil = []
    for a in range(3):
        for b in range(3):
            i, j = base[0] + a, base[1] + b
            stencil.append((i, j, w[0][a] * w[1][b], np.stack([i, j]) * dx - x))
    nodes = (world.nodes_x, world.nodes_y)
    mass = np.zeros(nodes, state.dtype)
    q, q_old = np.zeros((2, *nodes), state.dtype), np.zeros((2, *nodes), state.dtype)
    for i, j, w_i, d in stencil:
        np.add.at(mass, (i, j), w_i * m)
        for k in (0, 1):
            np.add.at(q[k], (i, j), w_i * (m * v[k] + A[k, 0] * d[0] + A[k, 1] * d[1]))
            np.add.at(q_old[k], (i, j), w_i * m * (v[k] + C[k, 0] * d[0] + C[k, 1] * d[1]))

    # grid update
    u, u_old = np.zeros_like(q), np.zeros_like(q)
    for i, j in zip(*np.nonzero(mass.real > 0.0)):
        ux = q[0, i, j] / mass[i, j] + dt * world.gravity_x
        uy = q[1, i, j] / mass[i, j] + dt * world.gravity_y
        u[:, i, j] = mpm.wall(i, j, ux, uy, world)
        u_old[:, i, j] = q_old[:, i, j] / mass[i, j]

    # grid to particle, and blend
    new = np.zeros_like(state)
    lost = v.copy()
    for i, j, w_i, d in stencil:
        new[2:4] += w_i * u[:, i, j]
        new[4:8] += (4.0 / dx**2) * np.concatenate([w_i * u[k, i, j] * d for k in (0, 1)])
        lost = lost - w_i * u_old[:, i, j]
    new[0:2] = x + dt * new[2:4]
    new[2:4] += world.keep * lost
    new[8:12] = F.reshape(4, count)
    return new


def product(a: NDArray, b: NDArray) -> NDArray:
    """Products of tensors (2, 2, N)."""
    return np.einsum("ijp,jkp->ikp", a, b)
