"""The discrete model: one explicit MLS-MPM step and its exact adjoint, read from top to bottom.

A step advances the particle states from t_n to t_n + dt (primes mark the new state, c = 4/dx^2)::

    deform       F'  = (I + dt C) F,   J' = det F'
    stress       tau = mu (F'F'^T - I) + lambda ln J' I + s F' S F'^T
                 A   = m C - dt V c tau
    p2g          m_i = sum_p w_ip m,   q_i = sum_p w_ip (m v + A (x_i - x))
    mirror       adds the images across a plane of symmetry, if the scene has one
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
and they live in one file because Numba's disk cache does not see changes in another one. `load`,
`store`, `pack` and `add_scaled` handle a node's record as one; they stand at the end of the file.

Sources: Hu et al. 2018 (MLS-MPM), Jiang et al. 2015 (APIC), Sato et al. 2023 (actuation).
"""

import operator
from typing import Any, NamedTuple

import numpy as np
from llvmlite import ir
from numba import njit, types
from numba.core import cgutils
from numba.extending import intrinsic, models, overload, register_model
from numpy.typing import DTypeLike, NDArray

STATE_SIZE = 12
NODE_SIZE = 4  # one vector register: momentum and mass (q_x, q_y, m, 0), velocity (u, v, u, v)

# How `advance` ended.
DONE, WINDOW_TOO_SMALL, ESCAPED, INVERTED = 0, 1, 2, 3

# No "nnan" or "ninf": comparisons must see what is not a number.
OPTIONS: dict[str, Any] = {
    "cache": True,
    "nogil": True,
    "error_model": "numpy",
    "fastmath": {"contract", "reassoc", "nsz", "arcp"},
}
loop_jit = njit(**OPTIONS)
# Kernels become part of the loops that call them: which of several compiled copies a loop calls
# would otherwise depend on whether it came from the disk cache, and with it the last bits.
jit = njit(**OPTIONS, forceinline=True)


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
    mirror_axis: int  # of the mirror plane's normal: 0 or 1; -1: no mirror
    mirror_node: int  # line of nodes that is the plane


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

    @classmethod
    def zeros(cls, particles: int) -> "BodyBar":
        """Nothing accumulated yet, for so many particles."""
        return cls(*(np.zeros(particles) for _ in cls._fields))


class Scratch(NamedTuple):
    """Arrays that live for one step, for N particles and a window of M nodes."""

    affine: NDArray  # (4, N) A, the affine momentum
    velocity: NDArray  # (M, 4) u
    affine_bar: NDArray  # (4, N)
    velocity_bar: NDArray  # (M, 4)
    node_bar: NDArray  # (M, 4) adjoints of momentum and mass

    @classmethod
    def make(cls, particles: int, nodes: int, dtype: DTypeLike = float) -> "Scratch":
        """Room for so many particles and nodes."""
        affine, node = (4, particles), (nodes, NODE_SIZE)
        return cls(*(np.zeros(shape, dtype) for shape in (affine, node, affine, node, node)))


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
    # Nodes across a mirror need their images.
    if world.mirror_axis == 0:
        extra = max(0, i0 + (i0 + ni - 1) - 2 * world.mirror_node)
        i0, ni = i0 - extra, ni + extra
    elif world.mirror_axis == 1:
        extra = max(0, j0 + (j0 + nj - 1) - 2 * world.mirror_node)
        j0, nj = j0 - extra, nj + extra
    return i0, j0, ni, nj, -1


@jit
def deform(old, new, world, log_J):
    """F' into the new state and ln J'; returns the first inverted particle or -1."""
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
        G[0, p], G[1, p], G[2, p], G[3, p] = f00, f01, f10, f11
        log_J[p] = np.log(J)
    return inverted


@jit
def deform_adjoint(old, world, bar):
    """From F_bar' to F_bar, in place; adds to C_bar."""
    dt = world.dt
    C, F, C_bar, F_bar = old[4:8], old[8:12], bar[4:8], bar[8:12]
    for p in range(old.shape[1]):
        c00, c01, c10, c11 = C[0, p], C[1, p], C[2, p], C[3, p]
        f00, f01, f10, f11 = F[0, p], F[1, p], F[2, p], F[3, p]
        b00, b01, b10, b11 = F_bar[0, p], F_bar[1, p], F_bar[2, p], F_bar[3, p]
        C_bar[0, p] += dt * (b00 * f00 + b01 * f01)
        C_bar[1, p] += dt * (b00 * f10 + b01 * f11)
        C_bar[2, p] += dt * (b10 * f00 + b11 * f01)
        C_bar[3, p] += dt * (b10 * f10 + b11 * f11)
        F_bar[0, p] = b00 + dt * (c00 * b00 + c10 * b10)
        F_bar[1, p] = b01 + dt * (c00 * b01 + c10 * b11)
        F_bar[2, p] = b10 + dt * (c01 * b00 + c11 * b10)
        F_bar[3, p] = b11 + dt * (c01 * b01 + c11 * b11)


@jit
def stress(old, new, log_J, body, world, signal, scratch):
    """Affine momentum A from C, F' and ln J'."""
    C, F = old[4:8], new[8:12]
    for p in range(old.shape[1]):
        f00, f01, f10, f11 = F[0, p], F[1, p], F[2, p], F[3, p]
        mu = body.lame_mu[p]
        spherical = body.lame_lambda[p] * log_J[p] - mu
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
        impulse = world.dt * body.volume[p] * 4.0 / world.dx**2
        scratch.affine[0, p] = m * C[0, p] - impulse * t00
        scratch.affine[1, p] = m * C[1, p] - impulse * t01
        scratch.affine[2, p] = m * C[2, p] - impulse * t01
        scratch.affine[3, p] = m * C[3, p] - impulse * t11


@jit
def stress_adjoint(old, new, log_J, body, world, signal, scratch, bar, body_bar, signal_bar):
    """From A_bar to C_bar; adds to F_bar' and to the adjoints of the material and the signal."""
    C, F, A_bar = old[4:8], new[8:12], scratch.affine_bar
    C_bar, F_bar = bar[4:8], bar[8:12]
    for p in range(old.shape[1]):
        f00, f01, f10, f11 = F[0, p], F[1, p], F[2, p], F[3, p]
        a00, a01, a10, a11 = A_bar[0, p], A_bar[1, p], A_bar[2, p], A_bar[3, p]
        m = body.mass[p]
        C_bar[0, p], C_bar[1, p], C_bar[2, p], C_bar[3, p] = m * a00, m * a01, m * a10, m * a11
        body_bar.mass[p] += a00 * C[0, p] + a01 * C[1, p] + a10 * C[2, p] + a11 * C[3, p]

        # T = tau_bar; tau is symmetric, and t01 gathers both of its places in A.
        impulse = -world.dt * body.volume[p] * 4.0 / world.dx**2
        t00, t01, t11 = impulse * a00, impulse * (a01 + a10), impulse * a11
        mu = body.lame_mu[p]
        trace = t00 + t11
        body_bar.lame_mu[p] += (
            t00 * (f00 * f00 + f01 * f01)
            + t01 * (f00 * f10 + f01 * f11)
            + t11 * (f10 * f10 + f11 * f11)
            - trace
        )
        body_bar.lame_lambda[p] += trace * log_J[p]

        # F_bar' += mu (T + T^T) F' + lambda tr T F'^-T
        p00, p01, p11 = 2.0 * mu * t00, mu * t01, 2.0 * mu * t11
        pressure = body.lame_lambda[p] * trace / (f00 * f11 - f01 * f10)
        b00 = p00 * f00 + p01 * f10 + pressure * f11
        b01 = p00 * f01 + p01 * f11 - pressure * f10
        b10 = p01 * f00 + p11 * f10 - pressure * f01
        b11 = p01 * f01 + p11 * f11 + pressure * f00
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
        F_bar[0, p] += b00
        F_bar[1, p] += b01
        F_bar[2, p] += b10
        F_bar[3, p] += b11


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
        down = pack(grid, a01, a11, 0.0, 0.0)
        for a in range(3):
            node = (i - i0 + a) * nj + j - j0
            row = pack(grid, qx + a00 * rx[a], qy + a10 * rx[a], m, 0.0)
            for b in range(3):
                w = wx[a] * wy[b]
                momentum = add_scaled(ry[b], down, row)
                store(grid, node + b, add_scaled(w, momentum, load(grid, node + b)))


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
        # Sums over the nodes, named by their weights along x and y: the weight w, its slope s, each
        # perhaps times the distance r. Lanes: adjoints of q_x, q_y and m.
        ww = wr_w = w_wr = s_w = sr_w = s_wr = w_s = wr_s = w_sr = zero(grid_bar)
        for a in range(3):
            node = (i - i0 + a) * nj + j - j0
            row_w = row_wr = row_s = row_sr = zero(grid_bar)
            for b in range(3):
                record = load(grid_bar, node + b)
                row_w = add_scaled(wy[b], record, row_w)
                row_wr = add_scaled(wy[b] * ry[b], record, row_wr)
                row_s = add_scaled(slope_y[b], record, row_s)
                row_sr = add_scaled(slope_y[b] * ry[b], record, row_sr)
            w, r, s = wx[a], rx[a], slope_x[a]
            ww = add_scaled(w, row_w, ww)
            wr_w = add_scaled(w * r, row_w, wr_w)
            w_wr = add_scaled(w, row_wr, w_wr)
            s_w = add_scaled(s, row_w, s_w)
            sr_w = add_scaled(s * r, row_w, sr_w)
            s_wr = add_scaled(s, row_wr, s_wr)
            w_s = add_scaled(w, row_s, w_s)
            wr_s = add_scaled(w * r, row_s, wr_s)
            w_sr = add_scaled(w, row_sr, w_sr)
        x_bar[0, p] += (
            (qx * s_w[0] + a00 * sr_w[0] + a01 * s_wr[0])
            + (qy * s_w[1] + a10 * sr_w[1] + a11 * s_wr[1])
            + m * s_w[2]
            - (a00 * ww[0] + a10 * ww[1])
        )
        x_bar[1, p] += (
            (qx * w_s[0] + a00 * wr_s[0] + a01 * w_sr[0])
            + (qy * w_s[1] + a10 * wr_s[1] + a11 * w_sr[1])
            + m * w_s[2]
            - (a01 * ww[0] + a11 * ww[1])
        )
        v_bar[0, p] = m * ww[0]
        v_bar[1, p] = m * ww[1]
        A_bar[0, p], A_bar[1, p], A_bar[2, p], A_bar[3, p] = wr_w[0], w_wr[0], wr_w[1], w_wr[1]
        body_bar.mass[p] += ww[2] + v[0, p] * ww[0] + v[1, p] * ww[1]


@jit
def mirror(records, window, world):
    """Add to each node what the mirrored half puts there; this map is its own transpose.

    Records of nodes are (q_x, q_y, m, 0). With R the reflection, a node and its image across the
    plane become r + R r_image and R r + r_image.
    """
    if world.mirror_axis < 0:
        return
    i0, j0, ni, nj = window
    normal = world.mirror_axis
    first, count, stride = (i0, ni, nj) if normal == 0 else (j0, nj, 1)
    across, step = (nj, 1) if normal == 0 else (ni, nj)
    plane = world.mirror_node - first
    for line in range(across):
        for k in range(count - plane):
            node = line * step + (plane + k) * stride
            image = line * step + (plane - k) * stride
            for lane in range(3):
                sign = -1.0 if lane == normal else 1.0
                total = records[image, lane] + sign * records[node, lane]
                records[image, lane] = total
                records[node, lane] = sign * total


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
                store(scratch.velocity, node, pack(scratch.velocity, u, v, u, v))
            else:
                store(scratch.velocity, node, zero(scratch.velocity))


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
        # Lanes: sums over u and v, then over u r_y and v r_y.
        across_0 = pack(velocity, wy[0], wy[0], wy[0] * ry[0], wy[0] * ry[0])
        across_1 = pack(velocity, wy[1], wy[1], wy[1] * ry[1], wy[1] * ry[1])
        across_2 = pack(velocity, wy[2], wy[2], wy[2] * ry[2], wy[2] * ry[2])
        mean = along = zero(velocity)
        for a in range(3):
            node = (i - i0 + a) * nj + j - j0
            row = add_scaled(across_0, load(velocity, node), zero(velocity))
            row = add_scaled(across_1, load(velocity, node + 1), row)
            row = add_scaled(across_2, load(velocity, node + 2), row)
            mean = add_scaled(wx[a], row, mean)
            along = add_scaled(wx[a] * rx[a], row, along)
        u, v = mean[0], mean[1]
        c00, c01, c10, c11 = along[0], mean[2], along[1], mean[3]
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
        # Sums over the nodes, named as in `p2g_adjoint`. Lanes: over u and v, then u r_y and v r_y.
        s_w = sr_w = w_s = wr_s = zero(velocity)
        down = pack(velocity, c01, c11, 0.0, 0.0)
        for a in range(3):
            node = (i - i0 + a) * nj + j - j0
            row = pack(velocity, u_bar + c00 * rx[a], v_bar + c10 * rx[a], 0.0, 0.0)
            row_w = row_s = zero(velocity)
            for b in range(3):
                w, wr, s, sr = wy[b], wy[b] * ry[b], slope_y[b], slope_y[b] * ry[b]
                record = load(velocity, node + b)
                row_w = add_scaled(pack(velocity, w, w, wr, wr), record, row_w)
                row_s = add_scaled(pack(velocity, s, s, sr, sr), record, row_s)
                h = add_scaled(ry[b], down, row)
                h = add_scaled(wx[a] * w, h, load(velocity_bar, node + b))
                store(velocity_bar, node + b, h)
            s_w = add_scaled(slope_x[a], row_w, s_w)
            sr_w = add_scaled(slope_x[a] * rx[a], row_w, sr_w)
            w_s = add_scaled(wx[a], row_s, w_s)
            wr_s = add_scaled(wx[a] * rx[a], row_s, wr_s)
        bar[0, p] += (
            (u_bar * s_w[0] + c00 * sr_w[0] + c01 * s_w[2])
            + (v_bar * s_w[1] + c10 * sr_w[1] + c11 * s_w[3])
            - (c00 * u + c10 * v)
        )
        bar[1, p] += (
            (u_bar * w_s[0] + c00 * wr_s[0] + c01 * w_s[2])
            + (v_bar * w_s[1] + c10 * wr_s[1] + c11 * w_s[3])
            - (c01 * u + c11 * v)
        )


@loop_jit
def advance(states, grids, windows, logs, first, last, body, world, signal, scratch):
    """Advance from the start of step `first` to the start of step `last`.

    Step n leads from slot n to slot n + 1 of `states` and leaves its nodes in slot n of `grids` and
    `windows` and its ln J' in slot n of `logs`; slots are counted round, so that two states and one
    of the others suffice where nothing is kept. Returns the step reached, how it ended, and the
    particle concerned (or -1); when the window does not fit into the records, more records and
    another call from the step reached go on.
    """
    for n in range(first, last):
        old = states[n % states.shape[0]]
        new = states[(n + 1) % states.shape[0]]
        slot = n % grids.shape[0]
        grid, log_J = grids[slot], logs[slot]
        i0, j0, ni, nj, particle = find_window(old, world)
        if particle >= 0:
            return n, ESCAPED, particle
        if ni * nj > grid.shape[0]:
            return n, WINDOW_TOO_SMALL, -1
        window = (i0, j0, ni, nj)
        for k in range(4):
            windows[slot, k] = window[k]
        particle = deform(old, new, world, log_J)
        if particle >= 0:
            return n, INVERTED, particle
        stress(old, new, log_J, body, world, signal[n], scratch)
        p2g(old, body, world, scratch, window, grid)
        mirror(grid, window, world)
        grid_update(grid, window, world, scratch)
        g2p(old, new, world, scratch, window)
    particle = find_window(states[last % states.shape[0]], world)[4]
    return last, DONE if particle < 0 else ESCAPED, particle


@loop_jit
def advance_adjoint(states, grids, windows, logs, first, last, body, world, signal, scratch, bar,
                    body_bar, signal_bar):  # fmt: skip
    """Go back from the start of step `last` to the start of step `first`: the adjoint of `advance`.

    `bar` (12, N) holds the adjoint of the state and is overwritten; `body_bar` and `signal_bar`
    (steps, K) are added to. All that `advance` leaves of the steps must have been kept.
    """
    for n in range(last - 1, first - 1, -1):
        old, new, grid, log_J = states[n], states[n + 1], grids[n], logs[n]
        window = (windows[n, 0], windows[n, 1], windows[n, 2], windows[n, 3])
        stress(old, new, log_J, body, world, signal[n], scratch)
        grid_update(grid, window, world, scratch)
        g2p_adjoint(old, new, world, scratch, window, bar)
        grid_update_adjoint(grid, window, world, scratch)
        mirror(scratch.node_bar, window, world)
        p2g_adjoint(old, body, world, scratch, window, bar, body_bar)
        stress_adjoint(
            old, new, log_J, body, world, signal[n], scratch, bar, body_bar, signal_bar[n]
        )
        deform_adjoint(old, world, bar)


# Records of four numbers. These functions on tuples are their definition; in double precision the
# compiler is given vector registers instead, which it does not find by itself.


def load(array, k):
    """Record k of an array (M, 4)."""
    return array[k, 0], array[k, 1], array[k, 2], array[k, 3]


def store(array, k, record):
    """Write record k of an array (M, 4)."""
    array[k, 0], array[k, 1], array[k, 2], array[k, 3] = record


def zero(array):
    """The record of zeros of an array's type."""
    z = array.dtype.type(0.0)
    return z, z, z, z


def pack(array, a, b, c, d):
    """The record of four numbers, of an array's type."""
    return a, b, c, d


def add_scaled(s, x, y):
    """The record s x + y; s is a number or a record."""
    if not isinstance(s, tuple):
        s = (s, s, s, s)
    return s[0] * x[0] + y[0], s[1] * x[1] + y[1], s[2] * x[2] + y[2], s[3] * x[3] + y[3]


class Register(types.Type):
    """A record in a vector register."""

    def __init__(self):
        super().__init__("Register")


register = Register()
VECTOR = ir.VectorType(ir.DoubleType(), NODE_SIZE)
FLAGS = ("contract", "reassoc", "nsz", "arcp")


@register_model(Register)
class RegisterModel(models.PrimitiveModel):
    """As a vector of LLVM."""

    def __init__(self, manager, kind):
        super().__init__(manager, kind, VECTOR)


def _record_pointer(context, builder, signature, arguments):
    array_type = signature.args[0]
    array = context.make_array(array_type)(context, builder, arguments[0])
    first = context.get_constant(types.intp, 0)
    pointer = cgutils.get_item_pointer(
        context, builder, array_type, array, [arguments[1], first], wraparound=False
    )
    return builder.bitcast(pointer, VECTOR.as_pointer())


def _broadcast(builder, values):
    vector = ir.Constant(VECTOR, ir.Undefined)
    for lane, value in enumerate(values):
        vector = builder.insert_element(vector, value, ir.Constant(ir.IntType(32), lane))
    return vector


@intrinsic
def _load(typingctx, array, k):
    def generate(context, builder, signature, arguments):
        return builder.load(_record_pointer(context, builder, signature, arguments), align=8)

    return register(array, types.intp), generate


@intrinsic
def _store(typingctx, array, k, record):
    def generate(context, builder, signature, arguments):
        pointer = _record_pointer(context, builder, signature, arguments)
        builder.store(arguments[2], pointer, align=8)
        return context.get_dummy_value()

    return types.none(array, types.intp, record), generate


@intrinsic
def _pack(typingctx, a, b, c, d):
    def generate(context, builder, signature, arguments):
        return _broadcast(builder, arguments)

    return register(*4 * (types.float64,)), generate


@intrinsic
def _add_scaled(typingctx, s, x, y):
    def generate(context, builder, signature, arguments):
        factor, x, y = arguments
        if signature.args[0] == types.float64:
            factor = _broadcast(builder, NODE_SIZE * [factor])
        return builder.fadd(builder.fmul(factor, x, flags=FLAGS), y, flags=FLAGS)

    return register(s, x, y), generate


@intrinsic
def _lane(typingctx, record, k):
    def generate(context, builder, signature, arguments):
        lane = builder.trunc(arguments[1], ir.IntType(32))
        return builder.extract_element(arguments[0], lane)

    return types.float64(record, types.intp), generate


@overload(operator.getitem)
def _getitem(record, k):
    if isinstance(record, Register):
        return lambda record, k: _lane(record, k)


@overload(load)
def _overload_load(array, k):
    if array.dtype == types.float64:
        return lambda array, k: _load(array, k)
    return load


@overload(store)
def _overload_store(array, k, record):
    if array.dtype == types.float64:
        return lambda array, k, record: _store(array, k, record)
    return store


@overload(zero)
def _overload_zero(array):
    if array.dtype == types.float64:
        return lambda array: _pack(0.0, 0.0, 0.0, 0.0)
    return lambda array: (0j, 0j, 0j, 0j)


@overload(pack)
def _overload_pack(array, a, b, c, d):
    if array.dtype == types.float64:
        return lambda array, a, b, c, d: _pack(a, b, c, d)
    return lambda array, a, b, c, d: (a + 0j, b + 0j, c + 0j, d + 0j)


@overload(add_scaled)
def _overload_add_scaled(s, x, y):
    if isinstance(x, Register):
        return lambda s, x, y: _add_scaled(s, x, y)
    if isinstance(s, types.BaseTuple):
        return lambda s, x, y: (
            s[0] * x[0] + y[0],
            s[1] * x[1] + y[1],
            s[2] * x[2] + y[2],
            s[3] * x[3] + y[3],
        )
    return lambda s, x, y: (s * x[0] + y[0], s * x[1] + y[1], s * x[2] + y[2], s * x[3] + y[3])
