"""The discrete model: one explicit MLS-MPM step and its exact adjoint, read from top to bottom.

A step advances the particle states from t_n to t_n + dt (primes mark the new state, c = 4/dx^2)::

    stress       F'  = (I + dt C) F,   J' = det F'
                 tau = mu (F'F'^T - I) + lambda ln J' I + s F' S F'^T
                 A   = m C - dt V c tau
    p2g          m_i = sum_p w_ip m,   q_i = sum_p w_ip (m v + A (x_i - x))
    grid_update  u_i = wall(q_i / m_i + dt g)
    g2p          v'  = sum_i w_ip u_i,  C' = c sum_i w_ip u_i (x_i - x)^T,  x' = x + dt v'

Every kernel is followed by its adjoint of the same name, which uses the same variable names;
``_bar`` marks the derivative of the objective with respect to a variable. Branches (contact, cells)
are those that the forward step took.

A state is an array (12, N): x, y, u, v, C00, C01, C10, C11, F00, F01, F10, F11 of N particles.
Grid arrays hold the window of nodes that the particles touch and no others: node (i, j) is record
``(i - i0) nj + (j - j0)`` of window ``(i0, j0, ni, nj)``.

The kernels also compile for complex128, which makes the complex step an oracle for the adjoint:
cells, walls and comparisons look at real parts only. They know arrays and numbers, no user objects,
and they live in one file because Numba's disk cache does not see changes in another one.

Sources: Hu et al. 2018 (MLS-MPM), Jiang et al. 2015 (APIC), Sato et al. 2023 (actuation).
"""

from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

STATE_SIZE = 12
NODE_SIZE = 4  # momentum x, momentum y, mass, padding to a full vector register

# How `advance` ended.
DONE, WINDOW_TOO_SMALL, ESCAPED, INVERTED = 0, 1, 2, 3

# No "nnan" or "ninf": comparisons must see what is not a number.
jit = njit(cache=True, nogil=True, error_model="numpy",
           fastmath={"contract", "reassoc", "nsz", "arcp"})  # fmt: skip


class World(NamedTuple):
    """What surrounds the body: time step, cell width, nodes per side, gravity and walls."""

    dt: float
    dx: float
    nodes_x: int
    nodes_y: int
    gravity_x: float
    gravity_y: float
    wall_axis: NDArray[np.int64]  # (W,) 0 or 1: the axis of the normal
    wall_side: NDArray[np.int64]  # (W,) +1: clamps nodes below `wall_node`, -1: above
    wall_node: NDArray[np.int64]  # (W,)
    wall_friction: NDArray[np.float64]  # (W,) Coulomb coefficient, infinite: sticks


class Body(NamedTuple):
    """Constants of N particles and of K actuators; arrays may be complex for the complex step."""

    volume: NDArray  # (N,) reference volume
    mass: NDArray  # (N,)
    lame_lambda: NDArray  # (N,)
    lame_mu: NDArray  # (N,)
    actuator: NDArray[np.int64]  # (N,) index of the actuator, -1: none
    actuation_stress: NDArray[np.float64]  # (K, 3) second Piola-Kirchhoff S: xx, xy, yy


class BodyBar(NamedTuple):
    """Adjoints of `Body`, accumulated over the steps."""

    mass: NDArray  # (N,)
    lame_lambda: NDArray  # (N,)
    lame_mu: NDArray  # (N,)


class Scratch(NamedTuple):
    """Arrays that live for one step. M is the number of node records of the window."""

    affine: NDArray  # (4, N) A, the affine momentum
    log_J: NDArray  # (N,)
    velocity: NDArray  # (M, 2) u
    affine_bar: NDArray  # (4, N)
    velocity_bar: NDArray  # (M, 2)
    node_bar: NDArray  # (M, 4) adjoints of momentum and mass


@jit
def weights(x, dx):
    """Base node, quadratic B-spline weights of it and the next two nodes, and their distances."""
    base = int(x.real / dx - 0.5)
    f = x / dx - base
    w = (0.5 * (1.5 - f) ** 2, 0.75 - (f - 1.0) ** 2, 0.5 * (f - 0.5) ** 2)
    d = (-f * dx, (1.0 - f) * dx, (2.0 - f) * dx)
    return base, w, d


@jit
def weight_slopes(x, dx):
    """Derivatives of the three weights with respect to x."""
    f = x / dx - int(x.real / dx - 0.5)
    return ((f - 1.5) / dx, -2.0 * (f - 1.0) / dx, (f - 0.5) / dx)


@jit
def interpolation(position, dx, rows):
    """Nodes and weights (N, 9) of particles at (N, 2); node (i, j) has number i * rows + j."""
    nodes = np.empty((position.shape[0], 9), np.int64)
    values = np.empty((position.shape[0], 9))
    for p in range(position.shape[0]):
        i, wx, _ = weights(position[p, 0], dx)
        j, wy, _ = weights(position[p, 1], dx)
        for a in range(3):
            for b in range(3):
                nodes[p, 3 * a + b] = (i + a) * rows + j + b
                values[p, 3 * a + b] = wx[a] * wy[b]
    return nodes, values


@jit
def find_window(state, world):
    """Window (i0, j0, ni, nj) of all touched nodes, and the first particle off the grid or -1."""
    lo = 0.5 * world.dx
    hi_x = (world.nodes_x - 1.5) * world.dx
    hi_y = (world.nodes_y - 1.5) * world.dx
    x_min, x_max, y_min, y_max = hi_x, lo, hi_y, lo
    for p in range(state.shape[1]):
        x = state[0, p].real
        y = state[1, p].real
        if not (lo <= x < hi_x and lo <= y < hi_y):
            return 0, 0, 0, 0, p
        x_min = min(x_min, x)
        x_max = max(x_max, x)
        y_min = min(y_min, y)
        y_max = max(y_max, y)
    i0 = int(x_min / world.dx - 0.5)
    j0 = int(y_min / world.dx - 0.5)
    ni = int(x_max / world.dx - 0.5) + 3 - i0
    nj = int(y_max / world.dx - 0.5) + 3 - j0
    return i0, j0, ni, nj, -1


@jit
def stress(old, new, body, world, signal, scratch):
    """F' into the new state, A and ln J' into the scratch; the first inverted particle or -1."""
    dt = world.dt
    C, F, G = old[4:8], old[8:12], new[8:12]
    inverted = -1
    for p in range(old.shape[1]):
        c00, c01, c10, c11 = C[0, p], C[1, p], C[2, p], C[3, p]
        f00 = F[0, p] + dt * (c00 * F[0, p] + c01 * F[2, p])
        f01 = F[1, p] + dt * (c00 * F[1, p] + c01 * F[3, p])
        f10 = F[2, p] + dt * (c10 * F[0, p] + c11 * F[2, p])
        f11 = F[3, p] + dt * (c10 * F[1, p] + c11 * F[3, p])
        J = f00 * f11 - f01 * f10
        if not J.real > 0.0 and inverted < 0:
            inverted = p
        log_J = np.log(J)
        mu = body.lame_mu[p]
        spherical = body.lame_lambda[p] * log_J - mu
        t00 = mu * (f00 * f00 + f01 * f01) + spherical
        t01 = mu * (f00 * f10 + f01 * f11)
        t11 = mu * (f10 * f10 + f11 * f11) + spherical
        k = body.actuator[p]
        if k >= 0:
            s = signal[k]
            s00 = s * body.actuation_stress[k, 0]
            s01 = s * body.actuation_stress[k, 1]
            s11 = s * body.actuation_stress[k, 2]
            t00 += f00 * (s00 * f00 + s01 * f01) + f01 * (s01 * f00 + s11 * f01)
            t01 += f00 * (s00 * f10 + s01 * f11) + f01 * (s01 * f10 + s11 * f11)
            t11 += f10 * (s00 * f10 + s01 * f11) + f11 * (s01 * f10 + s11 * f11)
        m = body.mass[p]
        impulse = dt * body.volume[p] * 4.0 / world.dx**2
        G[0, p], G[1, p], G[2, p], G[3, p] = f00, f01, f10, f11
        scratch.affine[0, p] = m * c00 - impulse * t00
        scratch.affine[1, p] = m * c01 - impulse * t01
        scratch.affine[2, p] = m * c10 - impulse * t01
        scratch.affine[3, p] = m * c11 - impulse * t11
        scratch.log_J[p] = log_J
    return inverted


@jit
def stress_adjoint(old, new, body, world, signal, scratch, bar, body_bar, signal_bar):
    """From A_bar and F_bar' to C_bar and F_bar; adds to the adjoints of the material and signal."""
    dt = world.dt
    C, F, G = old[4:8], old[8:12], new[8:12]
    C_bar, F_bar = bar[4:8], bar[8:12]
    for p in range(old.shape[1]):
        c00, c01, c10, c11 = C[0, p], C[1, p], C[2, p], C[3, p]
        f00, f01, f10, f11 = G[0, p], G[1, p], G[2, p], G[3, p]
        a00, a01 = scratch.affine_bar[0, p], scratch.affine_bar[1, p]
        a10, a11 = scratch.affine_bar[2, p], scratch.affine_bar[3, p]
        m = body.mass[p]
        body_bar.mass[p] += a00 * c00 + a01 * c01 + a10 * c10 + a11 * c11

        # tau is symmetric: t01 gathers both of its places in A.
        impulse = -dt * body.volume[p] * 4.0 / world.dx**2
        t00 = impulse * a00
        t01 = impulse * (a01 + a10)
        t11 = impulse * a11
        mu = body.lame_mu[p]
        trace = t00 + t11
        body_bar.lame_mu[p] += (
            t00 * (f00 * f00 + f01 * f01)
            + t01 * (f00 * f10 + f01 * f11)
            + t11 * (f10 * f10 + f11 * f11)
            - trace
        )
        body_bar.lame_lambda[p] += trace * scratch.log_J[p]

        # F_bar' += mu (T + T^T) F' + lambda tr T F'^-T, with T = tau_bar
        p00, p01, p11 = 2.0 * mu * t00, mu * t01, 2.0 * mu * t11
        pressure = body.lame_lambda[p] * trace / (f00 * f11 - f01 * f10)
        b00 = F_bar[0, p] + p00 * f00 + p01 * f10 + pressure * f11
        b01 = F_bar[1, p] + p00 * f01 + p01 * f11 - pressure * f10
        b10 = F_bar[2, p] + p01 * f00 + p11 * f10 - pressure * f01
        b11 = F_bar[3, p] + p01 * f01 + p11 * f11 + pressure * f00
        k = body.actuator[p]
        if k >= 0:
            s00 = body.actuation_stress[k, 0]
            s01 = body.actuation_stress[k, 1]
            s11 = body.actuation_stress[k, 2]
            g00, g01 = f00 * s00 + f01 * s01, f00 * s01 + f01 * s11  # F' S
            g10, g11 = f10 * s00 + f11 * s01, f10 * s01 + f11 * s11
            signal_bar[k] += (
                t00 * (g00 * f00 + g01 * f01)
                + t01 * (g00 * f10 + g01 * f11)
                + t11 * (g10 * f10 + g11 * f11)
            )
            s = signal[k]
            b00 += s * (2.0 * t00 * g00 + t01 * g10)
            b01 += s * (2.0 * t00 * g01 + t01 * g11)
            b10 += s * (t01 * g00 + 2.0 * t11 * g10)
            b11 += s * (t01 * g01 + 2.0 * t11 * g11)

        # A = m C - ..., F' = (I + dt C) F
        h00, h01, h10, h11 = F[0, p], F[1, p], F[2, p], F[3, p]
        C_bar[0, p] = m * a00 + dt * (b00 * h00 + b01 * h01)
        C_bar[1, p] = m * a01 + dt * (b00 * h10 + b01 * h11)
        C_bar[2, p] = m * a10 + dt * (b10 * h00 + b11 * h01)
        C_bar[3, p] = m * a11 + dt * (b10 * h10 + b11 * h11)
        F_bar[0, p] = b00 + dt * (c00 * b00 + c10 * b10)
        F_bar[1, p] = b01 + dt * (c00 * b01 + c10 * b11)
        F_bar[2, p] = b10 + dt * (c01 * b00 + c11 * b10)
        F_bar[3, p] = b11 + dt * (c01 * b01 + c11 * b11)


@jit
def p2g(state, body, world, scratch, window, grid):
    """Particle to grid: momentum and mass of the window's nodes."""
    i0, j0, ni, nj = window
    x, v, A = state[0:2], state[2:4], scratch.affine
    grid[: ni * nj] = 0.0
    for p in range(state.shape[1]):
        i, wx, rx = weights(x[0, p], world.dx)
        j, wy, ry = weights(x[1, p], world.dx)
        m = body.mass[p]
        qx, qy = m * v[0, p], m * v[1, p]
        a00, a01, a10, a11 = A[0, p], A[1, p], A[2, p], A[3, p]
        for a in range(3):
            node = (i - i0 + a) * nj + j - j0
            row_x = qx + a00 * rx[a]
            row_y = qy + a10 * rx[a]
            for b in range(3):
                w = wx[a] * wy[b]
                grid[node + b, 0] += w * (row_x + a01 * ry[b])
                grid[node + b, 1] += w * (row_y + a11 * ry[b])
                grid[node + b, 2] += w * m


@jit
def p2g_adjoint(state, body, world, scratch, window, bar, body_bar):
    """From momentum_bar and mass_bar of nodes to v_bar, A_bar, x_bar and mass_bar of particles."""
    i0, j0, _, nj = window
    x, v, A = state[0:2], state[2:4], scratch.affine
    x_bar, v_bar, A_bar = bar[0:2], bar[2:4], scratch.affine_bar
    grid_bar = scratch.node_bar
    for p in range(state.shape[1]):
        i, wx, rx = weights(x[0, p], world.dx)
        j, wy, ry = weights(x[1, p], world.dx)
        slope_x = weight_slopes(x[0, p], world.dx)
        slope_y = weight_slopes(x[1, p], world.dx)
        m = body.mass[p]
        qx, qy = m * v[0, p], m * v[1, p]
        a00, a01, a10, a11 = A[0, p], A[1, p], A[2, p], A[3, p]
        gx = gy = sum_x = sum_y = sum_m = 0.0
        b00 = b01 = b10 = b11 = 0.0
        for a in range(3):
            node = (i - i0 + a) * nj + j - j0
            row_x = qx + a00 * rx[a]
            row_y = qy + a10 * rx[a]
            across = along = row_qx = row_qy = 0.0
            for b in range(3):
                qx_bar, qy_bar = grid_bar[node + b, 0], grid_bar[node + b, 1]
                m_bar = grid_bar[node + b, 2]
                w_bar = qx_bar * (row_x + a01 * ry[b]) + qy_bar * (row_y + a11 * ry[b]) + m_bar * m
                across += wy[b] * w_bar
                along += slope_y[b] * w_bar
                row_qx += wy[b] * qx_bar
                row_qy += wy[b] * qy_bar
                w = wx[a] * wy[b]
                b01 += w * ry[b] * qx_bar
                b11 += w * ry[b] * qy_bar
                sum_m += w * m_bar
            gx += slope_x[a] * across
            gy += wx[a] * along
            sum_x += wx[a] * row_qx
            sum_y += wx[a] * row_qy
            b00 += wx[a] * rx[a] * row_qx
            b10 += wx[a] * rx[a] * row_qy
        x_bar[0, p] += gx - (a00 * sum_x + a10 * sum_y)
        x_bar[1, p] += gy - (a01 * sum_x + a11 * sum_y)
        v_bar[0, p] = m * sum_x
        v_bar[1, p] = m * sum_y
        A_bar[0, p], A_bar[1, p], A_bar[2, p], A_bar[3, p] = b00, b01, b10, b11
        body_bar.mass[p] += sum_m + v[0, p] * sum_x + v[1, p] * sum_y


@jit
def wall(i, j, u, v, world):
    """Velocity of node (i, j) after the walls.

    Only an approaching node is touched: its normal velocity becomes zero and friction takes at most
    `friction` times as much of its tangential velocity.
    """
    for k in range(world.wall_axis.size):
        side = world.wall_side[k]
        normal_is_x = world.wall_axis[k] == 0
        if side * (world.wall_node[k] - (i if normal_is_x else j)) > 0:
            un, ut = (u, v) if normal_is_x else (v, u)
            if side * un.real < 0.0:
                friction = world.wall_friction[k]
                if abs(ut.real) <= friction * abs(un.real):
                    ut = 0.0 * ut
                else:
                    ut = ut + np.sign(ut.real) * friction * side * un
                un = 0.0 * un
            u, v = (un, ut) if normal_is_x else (ut, un)
    return u, v


@jit
def wall_adjoint(i, j, u, v, world, u_bar, v_bar):
    """Transpose of `wall`: through the derivative D of its branches, of (u, v) by (u, v)."""
    d00, d01, d10, d11 = 1.0, 0.0, 0.0, 1.0
    for k in range(world.wall_axis.size):
        side = world.wall_side[k]
        normal_is_x = world.wall_axis[k] == 0
        if side * (world.wall_node[k] - (i if normal_is_x else j)) > 0:
            un, ut = (u, v) if normal_is_x else (v, u)
            if side * un < 0.0:
                friction = world.wall_friction[k]
                keep, slope = 1.0, 0.0
                if abs(ut) <= friction * abs(un):
                    keep = 0.0
                else:
                    slope = np.sign(ut) * friction * side
                ut = keep * ut + slope * un
                un = 0.0
                if normal_is_x:
                    d10, d11 = keep * d10 + slope * d00, keep * d11 + slope * d01
                    d00 = d01 = 0.0
                else:
                    d00, d01 = keep * d00 + slope * d10, keep * d01 + slope * d11
                    d10 = d11 = 0.0
            u, v = (un, ut) if normal_is_x else (ut, un)
    return d00 * u_bar + d10 * v_bar, d01 * u_bar + d11 * v_bar


@jit
def grid_update(grid, window, world, scratch):
    """Velocity of the nodes from momentum, gravity and walls; zero where there is no mass."""
    i0, j0, ni, nj = window
    for a in range(ni):
        for b in range(nj):
            node = a * nj + b
            m = grid[node, 2]
            if m.real > 0.0:
                u = grid[node, 0] / m + world.dt * world.gravity_x
                v = grid[node, 1] / m + world.dt * world.gravity_y
                u, v = wall(i0 + a, j0 + b, u, v, world)
                scratch.velocity[node, 0] = u
                scratch.velocity[node, 1] = v
            else:
                scratch.velocity[node, 0] = 0.0
                scratch.velocity[node, 1] = 0.0


@jit
def grid_update_adjoint(grid, window, world, scratch):
    """From velocity_bar of the nodes to their momentum_bar and mass_bar."""
    i0, j0, ni, nj = window
    for a in range(ni):
        for b in range(nj):
            node = a * nj + b
            m = grid[node, 2]
            if m > 0.0:
                qx, qy = grid[node, 0], grid[node, 1]
                u_bar, v_bar = wall_adjoint(
                    i0 + a,
                    j0 + b,
                    qx / m + world.dt * world.gravity_x,
                    qy / m + world.dt * world.gravity_y,
                    world,
                    scratch.velocity_bar[node, 0],
                    scratch.velocity_bar[node, 1],
                )
                scratch.node_bar[node, 0] = u_bar / m
                scratch.node_bar[node, 1] = v_bar / m
                scratch.node_bar[node, 2] = -(u_bar * qx + v_bar * qy) / (m * m)
            else:
                scratch.node_bar[node] = 0.0


@jit
def g2p(old, new, world, scratch, window):
    """Grid to particle: the new velocity, affine velocity and position."""
    i0, j0, _, nj = window
    c = 4.0 / world.dx**2
    velocity = scratch.velocity
    for p in range(old.shape[1]):
        i, wx, rx = weights(old[0, p], world.dx)
        j, wy, ry = weights(old[1, p], world.dx)
        u = v = c00 = c01 = c10 = c11 = 0.0
        for a in range(3):
            node = (i - i0 + a) * nj + j - j0
            row_u = row_v = row_uy = row_vy = 0.0
            for b in range(3):
                wu = wy[b] * velocity[node + b, 0]
                wv = wy[b] * velocity[node + b, 1]
                row_u += wu
                row_v += wv
                row_uy += wu * ry[b]
                row_vy += wv * ry[b]
            u += wx[a] * row_u
            v += wx[a] * row_v
            c00 += wx[a] * rx[a] * row_u
            c10 += wx[a] * rx[a] * row_v
            c01 += wx[a] * row_uy
            c11 += wx[a] * row_vy
        new[0, p] = old[0, p] + world.dt * u
        new[1, p] = old[1, p] + world.dt * v
        new[2, p], new[3, p] = u, v
        new[4, p], new[5, p], new[6, p], new[7, p] = c * c00, c * c01, c * c10, c * c11


@jit
def g2p_adjoint(old, new, world, scratch, window, bar):
    """From x_bar', v_bar', C_bar' to velocity_bar of the nodes; turns x_bar' into x_bar."""
    i0, j0, ni, nj = window
    c = 4.0 / world.dx**2
    velocity, velocity_bar = scratch.velocity, scratch.velocity_bar
    velocity_bar[: ni * nj] = 0.0
    for p in range(old.shape[1]):
        i, wx, rx = weights(old[0, p], world.dx)
        j, wy, ry = weights(old[1, p], world.dx)
        slope_x = weight_slopes(old[0, p], world.dx)
        slope_y = weight_slopes(old[1, p], world.dx)
        u, v = new[2, p], new[3, p]
        u_bar = bar[2, p] + world.dt * bar[0, p]
        v_bar = bar[3, p] + world.dt * bar[1, p]
        c00, c01, c10, c11 = c * bar[4, p], c * bar[5, p], c * bar[6, p], c * bar[7, p]
        gx = gy = 0.0
        for a in range(3):
            node = (i - i0 + a) * nj + j - j0
            row_x = u_bar + c00 * rx[a]
            row_y = v_bar + c10 * rx[a]
            across = along = 0.0
            for b in range(3):
                hx = row_x + c01 * ry[b]
                hy = row_y + c11 * ry[b]
                w = wx[a] * wy[b]
                w_bar = velocity[node + b, 0] * hx + velocity[node + b, 1] * hy
                across += wy[b] * w_bar
                along += slope_y[b] * w_bar
                velocity_bar[node + b, 0] += w * hx
                velocity_bar[node + b, 1] += w * hy
            gx += slope_x[a] * across
            gy += wx[a] * along
        bar[0, p] += gx - (c00 * u + c10 * v)
        bar[1, p] += gy - (c01 * u + c11 * v)


@jit
def advance(states, grids, windows, first, last, body, world, signal, scratch):
    """Advance from the start of step `first` to the start of step `last`.

    Step n leads from slot n to slot n + 1 of `states` and leaves its nodes in slot n of `grids` and
    `windows`; slots are counted round, so that two states and one grid suffice where nothing is
    kept. Returns the step reached, how it ended, and the particle concerned (or -1); when the
    window does not fit into the records, more records and another call from the step reached go on.
    """
    for n in range(first, last):
        old = states[n % states.shape[0]]
        new = states[(n + 1) % states.shape[0]]
        grid = grids[n % grids.shape[0]]
        i0, j0, ni, nj, particle = find_window(old, world)
        if particle >= 0:
            return n, ESCAPED, particle
        if ni * nj > grid.shape[0]:
            return n, WINDOW_TOO_SMALL, -1
        window = (i0, j0, ni, nj)
        for k in range(4):
            windows[n % grids.shape[0], k] = window[k]
        particle = stress(old, new, body, world, signal[n], scratch)
        if particle >= 0:
            return n, INVERTED, particle
        p2g(old, body, world, scratch, window, grid)
        grid_update(grid, window, world, scratch)
        g2p(old, new, world, scratch, window)
    return last, DONE, -1


@jit
def advance_adjoint(states, grids, windows, first, last, body, world, signal, scratch, bar,
                    body_bar, signal_bar):  # fmt: skip
    """Go back from the start of step `last` to the start of step `first`: the adjoint of `advance`.

    `bar` (12, N) holds the adjoint of the state and is overwritten; `body_bar` and `signal_bar`
    (steps, K) are added to. All states and grids of the steps must have been kept.
    """
    for n in range(last - 1, first - 1, -1):
        old, new, grid = states[n], states[n + 1], grids[n]
        window = (windows[n, 0], windows[n, 1], windows[n, 2], windows[n, 3])
        stress(old, new, body, world, signal[n], scratch)
        grid_update(grid, window, world, scratch)
        g2p_adjoint(old, new, world, scratch, window, bar)
        grid_update_adjoint(grid, window, world, scratch)
        p2g_adjoint(old, body, world, scratch, window, bar, body_bar)
        stress_adjoint(old, new, body, world, signal[n], scratch, bar, body_bar, signal_bar[n])
