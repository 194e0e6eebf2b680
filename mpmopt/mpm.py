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

Arrays hold records of four numbers, which a processor handles as one. Particles come in groups of
four: records 12 g to 12 g + 11 of a state are x, y, u, v, C00, C01, C10, C11, F00, F01, F10, F11 of
group g, and `grouped` makes them of an array (12, N). Grid arrays hold the window of nodes that
the particles touch and no others: node (i, j) is record ``(i - i0) nj + (j - j0)`` of window
``(i0, j0, ni, nj)``.

Several threads share a step. Each has its blocks of groups, which put their momentum on nodes of
their own, and its columns of the window, in which it adds the blocks up in their order. So results
do not depend on the number of threads. What is derived of particles lives in a `Tile`.

The kernels also compile for complex128, which makes the complex step an oracle for the adjoint:
cells, walls and comparisons look at real parts only. They know arrays and numbers, no user objects,
and they live in one file because Numba's disk cache does not see changes in another one. What
records can do (`load`, `store`, `spread`, `blend`, ...) stands at the end of the file.

Sources: Hu et al. 2018 (MLS-MPM), Jiang et al. 2015 (APIC), Sato et al. 2023 (actuation).
"""

import functools
import math
import operator
import sys
from typing import Any, NamedTuple

import numpy as np
from llvmlite import ir
from numba import njit, types
from numba.core import cgutils
from numba.extending import intrinsic, models, overload, register_model
from numpy.typing import DTypeLike, NDArray

STATE_SIZE = 12
NODE_SIZE = 4  # one record: momentum and mass (q_x, q_y, m, 0)

# Groups of four particles that are handled together, while what is derived of them is at hand.
TILE = 16

# How `advance` ended.
DONE, WINDOW_TOO_SMALL, PART_TOO_SMALL, ESCAPED, INVERTED, ABANDONED = range(6)

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
    """Constants of G groups of four particles and of K actuators; complex for the complex step."""

    volume: NDArray  # (G, 4) reference volume
    mass: NDArray  # (G, 4)
    lame_lambda: NDArray  # (G, 4)
    lame_mu: NDArray  # (G, 4)
    active: NDArray[np.bool_]  # (G,) whether a group has actuated particles
    actuated: NDArray[np.float64]  # (K, G, 4) 1 for the particles of actuator k, else 0
    actuation_stress: NDArray[np.float64]  # (K, 3) second Piola-Kirchhoff S: xx, xy, yy
    first: NDArray[np.int64]  # (B + 1,) first group of each of B blocks, and G


class BodyBar(NamedTuple):
    """Adjoints of `Body`, accumulated over the steps."""

    mass: NDArray  # (G, 4)
    lame_lambda: NDArray  # (G, 4)
    lame_mu: NDArray  # (G, 4)

    @classmethod
    def zeros(cls, groups: int) -> "BodyBar":
        """Nothing accumulated yet."""
        return cls(*(np.zeros((groups, 4)) for _ in cls._fields))


class Tile(NamedTuple):
    """What a step derives of some groups of particles at a time: small, to stay in fast memory.

    Arrays of records, so many for each of T groups.
    """

    base: NDArray[np.float64]  # (2 T, 4) first of the three nodes along x and y
    spline: NDArray  # (24 T, 4) by threes: w and w r along x and y; r and s of x, of y
    affine: NDArray  # (4 T, 4) A, the affine momentum
    gathered: NDArray  # (8 T, 4) by `p2g_adjoint`: A_bar, sum of w q_bar, sum over grad(w)
    mass_bar: NDArray  # (T, 4) sum over nodes of w m_bar


@jit
def make_tile(groups, like):
    """Room for so many groups, of the type of the array `like`."""
    zero = 0.0 * like.flat[0]
    return Tile(
        np.zeros((2 * groups, 4)),
        np.full((24 * groups, 4), zero),
        np.full((4 * groups, 4), zero),
        np.full((8 * groups, 4), zero),
        np.full((groups, 4), zero),
    )


class Scratch(NamedTuple):
    """What the threads share during a step, for B blocks and a window of M nodes."""

    velocity: NDArray  # (M, 4) u, of which two numbers are used
    velocity_bar: NDArray  # (M, 4)
    node_bar: NDArray  # (M, 4) adjoints of momentum and mass
    parts: NDArray  # (B, P, 4) what each block puts on the nodes of its own window
    ends: NDArray[np.int64]  # (B, 2) how the step ended for each block, and a particle

    @classmethod
    def make(cls, nodes: int, blocks: int, part: int, dtype: DTypeLike = float) -> "Scratch":
        """Room for so many nodes, blocks, and nodes of a block."""
        node, parts = (nodes, NODE_SIZE), (blocks, part, NODE_SIZE)
        velocity, velocity_bar, node_bar = (np.zeros(node, dtype) for _ in range(3))
        ends = np.zeros((blocks, 2), np.int64)
        return cls(velocity, velocity_bar, node_bar, np.zeros(parts, dtype), ends)


@jit
def weights(f):
    """Quadratic B-spline weights of three nodes; a particle is f cells from the first of them."""
    return 0.5 * (1.5 - f) * (1.5 - f), 0.75 - (f - 1.0) * (f - 1.0), 0.5 * (f - 0.5) * (f - 0.5)


@jit
def weight_slopes(f, dx):
    """Derivatives of the three weights with respect to the position."""
    return (f - 1.5) / dx, (2.0 - 2.0 * f) / dx, (f - 0.5) / dx


@jit
def distances(f, dx):
    """From the particle to the three nodes."""
    return (0.0 - f) * dx, (1.0 - f) * dx, (2.0 - f) * dx


@jit
def interpolation(position, dx, rows):
    """Nodes and weights (N, 9) of particles at (N, 2); node (i, j) has number i * rows + j."""
    nodes = np.empty((position.shape[0], 9), np.int64)
    values = np.empty((position.shape[0], 9))
    for p in range(position.shape[0]):
        i, j = int(position[p, 0] / dx - 0.5), int(position[p, 1] / dx - 0.5)
        wx, wy = weights(position[p, 0] / dx - i), weights(position[p, 1] / dx - j)
        for a in range(3):
            for b in range(3):
                nodes[p, 3 * a + b] = (i + a) * rows + j + b
                values[p, 3 * a + b] = wx[a] * wy[b]
    return nodes, values


@jit
def find_window(state, world, first, last):
    """Window (i0, j0, ni, nj) of the nodes that particles touch; whether all are on the grid."""
    dx = world.dx
    lo = spread(0.5 * dx)
    hi_x, hi_y = spread((world.nodes_x - 1.5) * dx), spread((world.nodes_y - 1.5) * dx)
    i_min, j_min = spread(float(world.nodes_x)), spread(float(world.nodes_y))
    i_max = j_max = spread(0.0)
    for g in range(first, last):
        x, y = real(load(state, 12 * g)), real(load(state, 12 * g + 1))
        if not (within(x, lo, hi_x) and within(y, lo, hi_y)):
            return 0, 0, 0, 0, False
        i, j = whole(x / dx - 0.5), whole(y / dx - 0.5)  # as in `locate`
        i_min, i_max = least(i_min, i), greatest(i_max, i)
        j_min, j_max = least(j_min, j), greatest(j_max, j)
    i0, i1, j0, j1 = i_min[0], i_max[0], j_min[0], j_max[0]
    for k in range(1, 4):
        i0, i1, j0, j1 = min(i0, i_min[k]), max(i1, i_max[k]), min(j0, j_min[k]), max(j1, j_max[k])
    return int(i0), int(j0), int(i1 - i0) + 3, int(j1 - j0) + 3, True


@jit
def margins(state, body, world, first, last):
    """How close groups of particles come to where a step is too long, as in `simulate.Margins`.

    The largest (dt / dx) sqrt(M / rho) and dt |C|, and the smallest J; M is the stiffness of a
    particle as stretched as it is, ``lambda + mu tr b + sqrt(mu^2 (tr^2 b - 4 det b) + lambda^2)``
    with b = F F^T. Extremes do not depend on the order in which they are taken.
    """
    stiffest = fastest = 0.0
    smallest = math.inf
    for g in range(first, last):
        for k in range(4):
            mass, volume = body.mass[g, k].real, body.volume[g, k].real
            if mass > 0.0:  # else it only fills its group
                mu, lam = body.lame_mu[g, k].real, body.lame_lambda[g, k].real
                c00, c01 = state[12 * g + 4, k].real, state[12 * g + 5, k].real
                c10, c11 = state[12 * g + 6, k].real, state[12 * g + 7, k].real
                f00, f01 = state[12 * g + 8, k].real, state[12 * g + 9, k].real
                f10, f11 = state[12 * g + 10, k].real, state[12 * g + 11, k].real
                J = f00 * f11 - f01 * f10
                trace = f00 * f00 + f01 * f01 + f10 * f10 + f11 * f11
                apart = mu * mu * max(trace * trace - 4.0 * J * J, 0.0)
                stiffness = lam + mu * trace + math.sqrt(apart + lam * lam)
                stiffest = max(stiffest, stiffness * volume / mass)
                fastest = max(fastest, c00 * c00 + c01 * c01 + c10 * c10 + c11 * c11)
                smallest = min(smallest, J)
    return world.dt / world.dx * math.sqrt(stiffest), world.dt * math.sqrt(fastest), smallest


@jit
def locate(state, world, tile, first, last):
    """Base nodes of the particles, and their weights w and w r along x and y, into the tile."""
    dx = world.dx
    for g in range(first, last):
        t = g - first
        x, y = load(state, 12 * g) / dx, load(state, 12 * g + 1) / dx
        i, j = whole(real(x) - 0.5), whole(real(y) - 0.5)
        store(tile.base, 2 * t, i)
        store(tile.base, 2 * t + 1, j)
        w_x, r_x = weights(x - i), distances(x - i, dx)
        w_y, r_y = weights(y - j), distances(y - j, dx)
        for a in range(3):
            store(tile.spline, 24 * t + a, w_x[a])
            store(tile.spline, 24 * t + 3 + a, w_x[a] * r_x[a])
            store(tile.spline, 24 * t + 6 + a, w_y[a])
            store(tile.spline, 24 * t + 9 + a, w_y[a] * r_y[a])


@jit
def locate_adjoint(state, world, tile, first, last):
    """After `locate`: distances r and the weights' slopes s along x and y, into the tile."""
    dx = world.dx
    for g in range(first, last):
        t = g - first
        fx = load(state, 12 * g) / dx - load(tile.base, 2 * t)
        fy = load(state, 12 * g + 1) / dx - load(tile.base, 2 * t + 1)
        s_x, r_x = weight_slopes(fx, dx), distances(fx, dx)
        s_y, r_y = weight_slopes(fy, dx), distances(fy, dx)
        for a in range(3):
            store(tile.spline, 24 * t + 12 + a, r_x[a])
            store(tile.spline, 24 * t + 15 + a, s_x[a])
            store(tile.spline, 24 * t + 18 + a, r_y[a])
            store(tile.spline, 24 * t + 21 + a, s_y[a])


@jit
def whole_window(windows, world):
    """Window (i0, j0, ni, nj) that holds those of all blocks (B, 4), and their mirror images."""
    i0, j0, i1, j1 = world.nodes_x, world.nodes_y, 0, 0
    for b in range(windows.shape[0]):
        i0 = min(i0, windows[b, 0])
        j0 = min(j0, windows[b, 1])
        i1 = max(i1, windows[b, 0] + windows[b, 2])
        j1 = max(j1, windows[b, 1] + windows[b, 3])
    if world.mirror_axis == 0:
        i0 = min(i0, 2 * world.mirror_node - (i1 - 1))
    elif world.mirror_axis == 1:
        j0 = min(j0, 2 * world.mirror_node - (j1 - 1))
    return i0, j0, i1 - i0, j1 - j0


@jit
def deform(old, new, world, log_J, first, last):
    """F' into the new state and ln J'; returns whether no particle is inverted."""
    dt = world.dt
    upright = True
    for g in range(first, last):
        c00, c01, c10, c11 = tensor(old, 12 * g + 4)
        f00, f01, f10, f11 = tensor(old, 12 * g + 8)
        g00 = f00 + dt * (c00 * f00 + c01 * f10)
        g01 = f01 + dt * (c00 * f01 + c01 * f11)
        g10 = f10 + dt * (c10 * f00 + c11 * f10)
        g11 = f11 + dt * (c10 * f01 + c11 * f11)
        J = g00 * g11 - g01 * g10
        upright &= positive(J)
        store_tensor(new, 12 * g + 8, g00, g01, g10, g11)
        store(log_J, g, logarithm(J))
    return upright


@jit
def deform_adjoint(old, world, bar, first, last):
    """From F_bar' to F_bar, in place; adds to C_bar."""
    dt = world.dt
    for g in range(first, last):
        c00, c01, c10, c11 = tensor(old, 12 * g + 4)
        f00, f01, f10, f11 = tensor(old, 12 * g + 8)
        d00, d01, d10, d11 = tensor(bar, 12 * g + 4)
        b00, b01, b10, b11 = tensor(bar, 12 * g + 8)
        store_tensor(
            bar,
            12 * g + 4,
            d00 + dt * (b00 * f00 + b01 * f01),
            d01 + dt * (b00 * f10 + b01 * f11),
            d10 + dt * (b10 * f00 + b11 * f01),
            d11 + dt * (b10 * f10 + b11 * f11),
        )
        store_tensor(
            bar,
            12 * g + 8,
            b00 + dt * (c00 * b00 + c10 * b10),
            b01 + dt * (c00 * b01 + c10 * b11),
            b10 + dt * (c01 * b00 + c11 * b10),
            b11 + dt * (c01 * b01 + c11 * b11),
        )


@jit
def stress(old, new, log_J, body, world, signal, tile, first, last):
    """Affine momentum A from C, F' and ln J'."""
    for g in range(first, last):
        c00, c01, c10, c11 = tensor(old, 12 * g + 4)
        f00, f01, f10, f11 = tensor(new, 12 * g + 8)
        m, mu = load(body.mass, g), load(body.lame_mu, g)
        spherical = load(body.lame_lambda, g) * load(log_J, g) - mu
        t00 = mu * (f00 * f00 + f01 * f01) + spherical
        t01 = mu * (f00 * f10 + f01 * f11)
        t11 = mu * (f10 * f10 + f11 * f11) + spherical
        if body.active[g]:
            s00, s01, s11 = actuation(body, g, signal)
            t00 = t00 + f00 * (s00 * f00 + s01 * f01) + f01 * (s01 * f00 + s11 * f01)
            t01 = t01 + f00 * (s00 * f10 + s01 * f11) + f01 * (s01 * f10 + s11 * f11)
            t11 = t11 + f10 * (s00 * f10 + s01 * f11) + f11 * (s01 * f10 + s11 * f11)
        impulse = world.dt * (4.0 / world.dx**2) * load(body.volume, g)
        store_tensor(
            tile.affine,
            4 * (g - first),
            m * c00 - impulse * t00,
            m * c01 - impulse * t01,
            m * c10 - impulse * t01,
            m * c11 - impulse * t11,
        )


@jit
def actuation(body, g, signal):
    """s S of the actuators of four particles: xx, xy, yy."""
    s00 = s01 = s11 = spread(0.0 * body.mass[g, 0])
    for k in range(signal.size):
        there = load(body.actuated[k], g)
        s00 = s00 + signal[k] * body.actuation_stress[k, 0] * there
        s01 = s01 + signal[k] * body.actuation_stress[k, 1] * there
        s11 = s11 + signal[k] * body.actuation_stress[k, 2] * there
    return s00, s01, s11


@jit
def stress_adjoint(
    old, new, log_J, body, world, signal, tile, bar, body_bar, signal_bar, first, last
):
    """From A_bar to C_bar; adds to F_bar' and to the adjoints of the material and the signal."""
    for g in range(first, last):
        c00, c01, c10, c11 = tensor(old, 12 * g + 4)
        f00, f01, f10, f11 = tensor(new, 12 * g + 8)
        a00, a01, a10, a11 = tensor(tile.gathered, 8 * (g - first))
        m, mu = load(body.mass, g), load(body.lame_mu, g)
        store_tensor(bar, 12 * g + 4, m * a00, m * a01, m * a10, m * a11)
        add(body_bar.mass, g, a00 * c00 + a01 * c01 + a10 * c10 + a11 * c11)

        # T = tau_bar; tau is symmetric, and t01 gathers both of its places in A.
        impulse = -world.dt * (4.0 / world.dx**2) * load(body.volume, g)
        t00, t01, t11 = impulse * a00, impulse * (a01 + a10), impulse * a11
        trace = t00 + t11
        stretch = t00 * (f00 * f00 + f01 * f01)
        stretch = stretch + t01 * (f00 * f10 + f01 * f11)
        stretch = stretch + t11 * (f10 * f10 + f11 * f11)
        add(body_bar.lame_mu, g, stretch - trace)
        add(body_bar.lame_lambda, g, trace * load(log_J, g))

        # F_bar' += (T + T^T) F' (mu I + s S) + lambda tr T F'^-T
        pressure = load(body.lame_lambda, g) * trace / (f00 * f11 - f01 * f10)
        h00, h01, h10, h11 = mu * f00, mu * f01, mu * f10, mu * f11
        if body.active[g]:
            s00, s01, s11 = actuation(body, g, signal)
            h00, h01 = h00 + f00 * s00 + f01 * s01, h01 + f00 * s01 + f01 * s11
            h10, h11 = h10 + f10 * s00 + f11 * s01, h11 + f10 * s01 + f11 * s11
            for k in range(signal.size):
                there = load(body.actuated[k], g)
                s00 = body.actuation_stress[k, 0]
                s01 = body.actuation_stress[k, 1]
                s11 = body.actuation_stress[k, 2]
                g00, g01 = s00 * f00 + s01 * f01, s01 * f00 + s11 * f01  # F' S
                g10, g11 = s00 * f10 + s01 * f11, s01 * f10 + s11 * f11
                power = t00 * (g00 * f00 + g01 * f01)
                power = power + t01 * (g00 * f10 + g01 * f11)
                power = power + t11 * (g10 * f10 + g11 * f11)
                signal_bar[k] += total(there * power)
        b00, b01, b10, b11 = tensor(bar, 12 * g + 8)
        store_tensor(
            bar,
            12 * g + 8,
            b00 + 2.0 * t00 * h00 + t01 * h10 + pressure * f11,
            b01 + 2.0 * t00 * h01 + t01 * h11 - pressure * f10,
            b10 + t01 * h00 + 2.0 * t11 * h10 - pressure * f01,
            b11 + t01 * h01 + 2.0 * t11 * h11 + pressure * f00,
        )


@jit
def spreads(tile, row, k):
    """Three numbers of particle k of four as records: from a record of the tile's splines on."""
    w0, w1 = number(tile.spline, row, k), number(tile.spline, row + 1, k)
    return spread(w0), spread(w1), spread(number(tile.spline, row + 2, k))


@jit
def blends(x, y):
    """First halves of three records and second halves of three others."""
    return blend(x[0], y[0]), blend(x[1], y[1]), blend(x[2], y[2])


@jit
def p2g(state, body, world, tile, window, grid, first, last):
    """Particle to grid: momentum and mass (q_x, q_y, m, 0) of the window's nodes."""
    i0, j0, _, nj = window
    for g in range(first, last):
        t = g - first
        for k in range(4):
            i, j = number(tile.base, 2 * t, k), number(tile.base, 2 * t + 1, k)
            node = (int(i) - i0) * nj + int(j) - j0
            w_x, wr_x = spreads(tile, 24 * t, k), spreads(tile, 24 * t + 3, k)
            w_y, wr_y = spreads(tile, 24 * t + 6, k), spreads(tile, 24 * t + 9, k)
            m = number(body.mass, g, k)
            zero = 0.0 * m
            A, row = tile.affine, 4 * t
            q = pack(m * number(state, 12 * g + 2, k), m * number(state, 12 * g + 3, k), m, zero)
            a0 = pack(number(A, row, k), number(A, row + 2, k), zero, zero)
            a1 = pack(number(A, row + 1, k), number(A, row + 3, k), zero, zero)
            p2g_row(grid, node, w_x[0] * q + wr_x[0] * a0, w_x[0] * a1, w_y, wr_y)
            p2g_row(grid, node + nj, w_x[1] * q + wr_x[1] * a0, w_x[1] * a1, w_y, wr_y)
            p2g_row(grid, node + 2 * nj, w_x[2] * q + wr_x[2] * a0, w_x[2] * a1, w_y, wr_y)


@jit
def p2g_row(grid, n, q, a1, w, wr):
    """Add w q + w r a1 to three nodes in a row."""
    add(grid, n, w[0] * q + wr[0] * a1)
    add(grid, n + 1, w[1] * q + wr[1] * a1)
    add(grid, n + 2, w[2] * q + wr[2] * a1)


@jit
def p2g_adjoint(state, body, world, tile, scratch, window, bar, body_bar, first, last):
    """From momentum_bar and mass_bar of nodes to v_bar, A_bar, x_bar and mass_bar of particles."""
    i0, j0, _, nj = window
    nodes, A, gathered = scratch.node_bar, tile.affine, tile.gathered
    for g in range(first, last):
        t = g - first
        for k in range(4):
            i, j = number(tile.base, 2 * t, k), number(tile.base, 2 * t + 1, k)
            node = (int(i) - i0) * nj + int(j) - j0
            w_x, wr_x = spreads(tile, 24 * t, k), spreads(tile, 24 * t + 3, k)
            w_y, wr_y = spreads(tile, 24 * t + 6, k), spreads(tile, 24 * t + 9, k)
            r_x, s_x = spreads(tile, 24 * t + 12, k), spreads(tile, 24 * t + 15, k)
            r_y, s_y = spreads(tile, 24 * t + 18, k), spreads(tile, 24 * t + 21, k)
            w_wr, w_s, s_w = blends(w_y, wr_y), blends(w_y, s_y), blends(s_x, w_x)
            m = number(body.mass, g, k)
            q = pair(m * number(state, 12 * g + 2, k), m * number(state, 12 * g + 3, k))
            a0 = pair(number(A, 4 * t, k), number(A, 4 * t + 2, k))
            a1 = pair(number(A, 4 * t + 1, k), number(A, 4 * t + 3, k))
            mean_0, slope_0, mass_0 = p2g_adjoint_row(
                nodes, node, q + r_x[0] * a0, a1, r_y, w_wr, w_s
            )
            mean_1, slope_1, mass_1 = p2g_adjoint_row(
                nodes, node + nj, q + r_x[1] * a0, a1, r_y, w_wr, w_s
            )
            mean_2, slope_2, mass_2 = p2g_adjoint_row(
                nodes, node + 2 * nj, q + r_x[2] * a0, a1, r_y, w_wr, w_s
            )
            mean = w_x[0] * mean_0 + w_x[1] * mean_1 + w_x[2] * mean_2
            along = wr_x[0] * mean_0 + wr_x[1] * mean_1 + wr_x[2] * mean_2
            slope = s_w[0] * slope_0 + s_w[1] * slope_1 + s_w[2] * slope_2
            # Lanes of w_s m_bar: (w, w, s, s), and along x: (s, w, w, w).
            mass = blend(alternate(s_x[0], w_x[0]), w_x[0]) * mass_0
            mass = mass + blend(alternate(s_x[1], w_x[1]), w_x[1]) * mass_1
            mass = mass + blend(alternate(s_x[2], w_x[2]), w_x[2]) * mass_2
            set_number(gathered, 8 * t, k, along[0])
            set_number(gathered, 8 * t + 1, k, mean[2])
            set_number(gathered, 8 * t + 2, k, along[1])
            set_number(gathered, 8 * t + 3, k, mean[3])
            set_number(gathered, 8 * t + 4, k, mean[0])
            set_number(gathered, 8 * t + 5, k, mean[1])
            set_number(gathered, 8 * t + 6, k, slope[0] + slope[1] + m * mass[0])
            set_number(gathered, 8 * t + 7, k, slope[2] + slope[3] + m * mass[2])
            set_number(tile.mass_bar, t, k, mass[1])
        a00, a01, a10, a11 = tensor(A, 4 * t)
        qx_bar, qy_bar = load(gathered, 8 * t + 4), load(gathered, 8 * t + 5)
        add(bar, 12 * g, load(gathered, 8 * t + 6) - a00 * qx_bar - a10 * qy_bar)
        add(bar, 12 * g + 1, load(gathered, 8 * t + 7) - a01 * qx_bar - a11 * qy_bar)
        m, u, v = load(body.mass, g), load(state, 12 * g + 2), load(state, 12 * g + 3)
        store(bar, 12 * g + 2, m * qx_bar)
        store(bar, 12 * g + 3, m * qy_bar)
        add(body_bar.mass, g, load(tile.mass_bar, t) + u * qx_bar + v * qy_bar)


@jit
def p2g_adjoint_row(nodes, n, q, a1, r, w_wr, w_s):
    """Sums over three nodes in a row: w q_bar and w r q_bar; w, s times q_bar.(q + a1 r); m_bar."""
    q_bar, m_bar = load_pair(nodes, n), spread(number(nodes, n, 2))
    mean, slope, mass = w_wr[0] * q_bar, w_s[0] * ((q + r[0] * a1) * q_bar), w_s[0] * m_bar
    q_bar, m_bar = load_pair(nodes, n + 1), spread(number(nodes, n + 1, 2))
    mean = mean + w_wr[1] * q_bar
    slope = slope + w_s[1] * ((q + r[1] * a1) * q_bar)
    mass = mass + w_s[1] * m_bar
    q_bar, m_bar = load_pair(nodes, n + 2), spread(number(nodes, n + 2, 2))
    mean = mean + w_wr[2] * q_bar
    slope = slope + w_s[2] * ((q + r[2] * a1) * q_bar)
    mass = mass + w_s[2] * m_bar
    return mean, slope, mass


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
                folded = records[image, lane] + sign * records[node, lane]
                records[image, lane] = folded
                records[node, lane] = sign * folded


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
def add_blocks(parts, windows, window, a, nodes):
    """Column a of the window: the sum of what the blocks put there, in their order."""
    i0, j0, _, nj = window
    nodes[a * nj : (a + 1) * nj] = 0.0
    for b in range(parts.shape[0]):
        column = i0 + a - windows[b, 0]
        if 0 <= column < windows[b, 2]:
            source, target = column * windows[b, 3], a * nj + windows[b, 1] - j0
            for k in range(windows[b, 3]):
                store(nodes, target + k, load(nodes, target + k) + load(parts[b], source + k))


@jit
def grid_update(grid, window, world, scratch, a):
    """Velocity of column a's nodes from momentum, gravity and walls; zero where no mass is."""
    i0, j0, _, nj = window
    for b in range(nj):
        node = a * nj + b
        m = grid[node, 2]
        u = v = 0.0 * m
        if m.real > 0.0:
            u = grid[node, 0] / m + world.dt * world.gravity_x
            v = grid[node, 1] / m + world.dt * world.gravity_y
            u, v = wall(i0 + a, j0 + b, u, v, world)
        scratch.velocity[node, 0], scratch.velocity[node, 1] = u, v


@jit
def grid_update_adjoint(grid, window, world, scratch, a):
    """From velocity_bar of column a's nodes to their momentum_bar and mass_bar."""
    i0, j0, _, nj = window
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
def g2p(old, new, world, tile, scratch, window, first, last):
    """Grid to particle: the new velocity, affine velocity and position."""
    i0, j0, _, nj = window
    c, dt = 4.0 / world.dx**2, world.dt
    for g in range(first, last):
        t = g - first
        for k in range(4):
            i, j = number(tile.base, 2 * t, k), number(tile.base, 2 * t + 1, k)
            node = (int(i) - i0) * nj + int(j) - j0
            w_x, wr_x = spreads(tile, 24 * t, k), spreads(tile, 24 * t + 3, k)
            w_wr = blends(spreads(tile, 24 * t + 6, k), spreads(tile, 24 * t + 9, k))
            row_0 = g2p_row(scratch.velocity, node, w_wr)
            row_1 = g2p_row(scratch.velocity, node + nj, w_wr)
            row_2 = g2p_row(scratch.velocity, node + 2 * nj, w_wr)
            mean = w_x[0] * row_0 + w_x[1] * row_1 + w_x[2] * row_2  # w u, w r_y u
            along = wr_x[0] * row_0 + wr_x[1] * row_1 + wr_x[2] * row_2  # w r_x u
            set_number(new, 12 * g + 2, k, mean[0])
            set_number(new, 12 * g + 3, k, mean[1])
            set_number(new, 12 * g + 4, k, along[0])
            set_number(new, 12 * g + 5, k, mean[2])
            set_number(new, 12 * g + 6, k, along[1])
            set_number(new, 12 * g + 7, k, mean[3])
        store(new, 12 * g, load(old, 12 * g) + dt * load(new, 12 * g + 2))
        store(new, 12 * g + 1, load(old, 12 * g + 1) + dt * load(new, 12 * g + 3))
        c00, c01, c10, c11 = tensor(new, 12 * g + 4)
        store_tensor(new, 12 * g + 4, c * c00, c * c01, c * c10, c * c11)


@jit
def g2p_row(velocity, n, w_wr):
    """Sums over three nodes in a row: w u and w r u."""
    row = w_wr[0] * load_pair(velocity, n) + w_wr[1] * load_pair(velocity, n + 1)
    return row + w_wr[2] * load_pair(velocity, n + 2)


@jit
def g2p_adjoint(old, new, world, tile, scratch, window, bar, part_window, part, first, last):
    """From x_bar', v_bar', C_bar' to velocity_bar of the nodes; turns x_bar' into x_bar.

    Velocities come from the whole window, their adjoints go to a block's part of it.
    """
    i0, j0, _, nj = window
    i1, j1, _, nl = part_window
    c, dt, velocity = 4.0 / world.dx**2, world.dt, scratch.velocity
    for g in range(first, last):
        t = g - first
        x_bar, y_bar = load(bar, 12 * g), load(bar, 12 * g + 1)
        c00, c01, c10, c11 = tensor(bar, 12 * g + 4)
        c00, c01, c10, c11 = c * c00, c * c01, c * c10, c * c11
        store_tensor(bar, 12 * g + 4, c00, c01, c10, c11)
        add(bar, 12 * g + 2, dt * x_bar)
        add(bar, 12 * g + 3, dt * y_bar)
        u, v = load(new, 12 * g + 2), load(new, 12 * g + 3)
        store(bar, 12 * g, x_bar - c00 * u - c10 * v)
        store(bar, 12 * g + 1, y_bar - c01 * u - c11 * v)
        for k in range(4):
            i, j = int(number(tile.base, 2 * t, k)), int(number(tile.base, 2 * t + 1, k))
            node, part_node = (i - i0) * nj + j - j0, (i - i1) * nl + j - j1
            w_x, w_y = spreads(tile, 24 * t, k), spreads(tile, 24 * t + 6, k)
            r_x, s_x = spreads(tile, 24 * t + 12, k), spreads(tile, 24 * t + 15, k)
            r_y, s_y = spreads(tile, 24 * t + 18, k), spreads(tile, 24 * t + 21, k)
            w_s, s_w = blends(w_y, s_y), blends(s_x, w_x)
            v_bar = pair(number(bar, 12 * g + 2, k), number(bar, 12 * g + 3, k))
            c0 = pair(number(bar, 12 * g + 4, k), number(bar, 12 * g + 6, k))
            c1 = pair(number(bar, 12 * g + 5, k), number(bar, 12 * g + 7, k))
            slope_0 = g2p_adjoint_row(
                part, part_node, velocity, node, v_bar + r_x[0] * c0, c1, w_x[0], w_y, r_y, w_s
            )
            slope_1 = g2p_adjoint_row(
                part, part_node + nl, velocity, node + nj, v_bar + r_x[1] * c0, c1, w_x[1], w_y,
                r_y, w_s,
            )  # fmt: skip
            slope_2 = g2p_adjoint_row(
                part, part_node + 2 * nl, velocity, node + 2 * nj, v_bar + r_x[2] * c0, c1, w_x[2],
                w_y, r_y, w_s,
            )  # fmt: skip
            slope = s_w[0] * slope_0 + s_w[1] * slope_1 + s_w[2] * slope_2
            set_number(bar, 12 * g, k, number(bar, 12 * g, k) + (slope[0] + slope[1]))
            set_number(bar, 12 * g + 1, k, number(bar, 12 * g + 1, k) + (slope[2] + slope[3]))


@jit
def g2p_adjoint_row(part, k, velocity, n, v_bar, c1, w_x, w, r, w_s):
    """Add w_x w (v_bar + c1 r) to three nodes in a row; the sum of w, s times it, times u."""
    u_bar = v_bar + r[0] * c1
    add(part, k, (w_x * w[0]) * u_bar)
    slope = w_s[0] * (u_bar * load_pair(velocity, n))
    u_bar = v_bar + r[1] * c1
    add(part, k + 1, (w_x * w[1]) * u_bar)
    slope = slope + w_s[1] * (u_bar * load_pair(velocity, n + 1))
    u_bar = v_bar + r[2] * c1
    add(part, k + 2, (w_x * w[2]) * u_bar)
    return slope + w_s[2] * (u_bar * load_pair(velocity, n + 2))


@loop_jit
def advance(states, grids, windows, logs, first, last, body, world, signal, scratch, meeting,
            thread, threads):  # fmt: skip
    """Advance from the start of step `first` to the start of step `last`.

    Step n leads from slot n to slot n + 1 of `states` and leaves its nodes in slot n of `grids`,
    its windows (those of the blocks, then the whole one) in slot n of `windows` and its ln J' in
    slot n of `logs`; slots are counted round, so that two states and one of the others suffice
    where nothing is kept. Returns the step reached, how it ended, and the particle concerned (or
    -1); when a window, the whole one or a block's, does not fit into the records, more records and
    another call from the step reached go on.

    Called by `threads` threads at once, each with its number, which wait for each other at the
    `meeting` (`mpmopt.threads`) and return when one of them gives up there. Each takes its blocks
    of particles and its columns of nodes; what blocks put on nodes is added in their order, so that
    results do not depend on the number of threads.
    """
    blocks = body.first.size - 1
    own = range(thread * blocks // threads, (thread + 1) * blocks // threads)
    parts, ends = scratch.parts, scratch.ends
    tile = make_tile(TILE, states)
    for n in range(first, last + 1):
        old = states[n % states.shape[0]]
        new = states[(n + 1) % states.shape[0]]
        slot = n % grids.shape[0]
        grid, log_J = grids[slot], logs[slot]
        for k in own:
            p0, p1 = body.first[k], body.first[k + 1]
            i0, j0, ni, nj, inside = find_window(old, world, p0, p1)
            ends[k, 0], ends[k, 1] = DONE, -1
            if not inside:
                ends[k, 0], ends[k, 1] = ESCAPED, first_outside(old, world, p0, p1)
            elif n < last:
                windows[slot, k, 0], windows[slot, k, 1] = i0, j0
                windows[slot, k, 2], windows[slot, k, 3] = ni, nj
                if ni * nj > parts.shape[1]:
                    ends[k, 0] = PART_TOO_SMALL
                else:
                    parts[k, : ni * nj] = 0.0
                    for g0 in range(p0, p1, TILE):
                        g1 = min(g0 + TILE, p1)
                        if not deform(old, new, world, log_J, g0, g1):
                            ends[k, 0], ends[k, 1] = INVERTED, first_inverted(new, g0, g1)
                            break
                        locate(old, world, tile, g0, g1)
                        stress(old, new, log_J, body, world, signal[n], tile, g0, g1)
                        p2g(old, body, world, tile, (i0, j0, ni, nj), parts[k], g0, g1)
        if not meet(meeting, threads):
            return n, ABANDONED, -1
        for k in range(blocks):
            if ends[k, 0] != DONE:
                return n, ends[k, 0], ends[k, 1]
        if n == last:
            break
        i0, j0, ni, nj = whole_window(windows[slot, :blocks], world)
        window = (i0, j0, ni, nj)
        if thread == 0:
            for k in range(4):
                windows[slot, blocks, k] = window[k]
        if ni * nj > grid.shape[0]:
            return n, WINDOW_TOO_SMALL, -1
        columns = range(thread * ni // threads, (thread + 1) * ni // threads)
        for a in columns:
            add_blocks(parts, windows[slot], window, a, grid)
        if world.mirror_axis >= 0:
            if not meet(meeting, threads):
                return n, ABANDONED, -1
            if thread == 0:
                mirror(grid, window, world)
            if not meet(meeting, threads):
                return n, ABANDONED, -1
        for a in columns:
            grid_update(grid, window, world, scratch, a)
        if not meet(meeting, threads):
            return n, ABANDONED, -1
        for k in own:
            for g0 in range(body.first[k], body.first[k + 1], TILE):
                g1 = min(g0 + TILE, body.first[k + 1])
                locate(old, world, tile, g0, g1)
                g2p(old, new, world, tile, scratch, window, g0, g1)
    return last, DONE, -1


@loop_jit
def advance_adjoint(states, grids, windows, logs, first, last, body, world, signal, scratch, bar,
                    body_bar, signal_bar, meeting, thread, threads):  # fmt: skip
    """Go back from the start of step `last` to the start of step `first`: the adjoint of `advance`.

    `bar` holds the adjoint of the state and is overwritten; `body_bar` and `signal_bar`
    (B, steps, K), by blocks, are added to. All that `advance` leaves of the steps must have been
    kept.
    """
    blocks = body.first.size - 1
    own = range(thread * blocks // threads, (thread + 1) * blocks // threads)
    parts = scratch.parts
    tile = make_tile(TILE, states)
    for n in range(last - 1, first - 1, -1):
        old, new, grid, log_J = states[n], states[n + 1], grids[n], logs[n]
        w = windows[n, blocks]
        ni, window = w[2], (w[0], w[1], w[2], w[3])
        columns = range(thread * ni // threads, (thread + 1) * ni // threads)
        for a in columns:
            grid_update(grid, window, world, scratch, a)
        if not meet(meeting, threads):
            return
        for k in own:
            p0, p1 = body.first[k], body.first[k + 1]
            w = windows[n, k]
            part = (w[0], w[1], w[2], w[3])
            parts[k, : w[2] * w[3]] = 0.0
            for g0 in range(p0, p1, TILE):
                g1 = min(g0 + TILE, p1)
                locate(old, world, tile, g0, g1)
                locate_adjoint(old, world, tile, g0, g1)
                g2p_adjoint(old, new, world, tile, scratch, window, bar, part, parts[k], g0, g1)
        if not meet(meeting, threads):
            return
        for a in columns:
            add_blocks(parts, windows[n], window, a, scratch.velocity_bar)
            grid_update_adjoint(grid, window, world, scratch, a)
        if not meet(meeting, threads):
            return
        if world.mirror_axis >= 0:
            if thread == 0:
                mirror(scratch.node_bar, window, world)
            if not meet(meeting, threads):
                return
        for k in own:
            p0, p1 = body.first[k], body.first[k + 1]
            for g0 in range(p0, p1, TILE):
                g1 = min(g0 + TILE, p1)
                locate(old, world, tile, g0, g1)
                locate_adjoint(old, world, tile, g0, g1)
                stress(old, new, log_J, body, world, signal[n], tile, g0, g1)
                p2g_adjoint(old, body, world, tile, scratch, window, bar, body_bar, g0, g1)
                stress_adjoint(
                    old, new, log_J, body, world, signal[n], tile, bar, body_bar, signal_bar[k, n],
                    g0, g1,
                )  # fmt: skip
                deform_adjoint(old, world, bar, g0, g1)


@jit
def first_inverted(state, first, last):
    """The first particle of groups of four whose deformation gradient is inverted."""
    for p in range(4 * first, 4 * last):
        f, k = 12 * (p // 4) + 8, p % 4
        if not (state[f, k] * state[f + 3, k] - state[f + 1, k] * state[f + 2, k]).real > 0.0:
            return p
    return -1


@jit
def first_outside(state, world, first, last):
    """The first particle of groups of four that is off the grid, or is not a number."""
    lo = 0.5 * world.dx
    hi_x, hi_y = (world.nodes_x - 1.5) * world.dx, (world.nodes_y - 1.5) * world.dx
    for p in range(4 * first, 4 * last):
        x, y = state[12 * (p // 4), p % 4].real, state[12 * (p // 4) + 1, p % 4].real
        if not (lo <= x < hi_x and lo <= y < hi_y):
            return p
    return -1


def grouped(array: NDArray, repeat: bool = True) -> NDArray:
    """R numbers (R, N) of N particles as records (R G, 4) of groups of four; (N,) as (G, 4).

    The last group is filled with repeats of the last particle, or with zeros.
    """
    rows = np.atleast_2d(array)
    count, groups = rows.shape[1], -(-rows.shape[1] // 4)
    filled = np.empty((len(rows), 4 * groups), rows.dtype)
    filled[:, :count] = rows
    filled[:, count:] = rows[:, -1:] if repeat else 0.0
    return filled.reshape(-1, groups, 4).swapaxes(0, 1).reshape(-1, 4)


def ungrouped(records: NDArray, rows: int, particles: int) -> NDArray:
    """The inverse of `grouped`: (rows, particles)."""
    filled = records.reshape(-1, rows, 4).swapaxes(0, 1).reshape(rows, -1)
    return np.ascontiguousarray(filled[:, :particles])


# Records of four numbers: of a node, or one number of four particles in a row. These functions on
# numpy arrays are their definition; compiled, a record is a vector register of the processor.


def load(array, k):
    """Record k of an array (M, 4)."""
    return array[k].copy()


def load_pair(array, k):
    """The first two numbers of record k of an array (M, ...), twice."""
    return np.tile(array[k, :2], 2)


def store(array, k, record):
    """Write record k of an array (M, 4)."""
    array[k] = record


def number(array, k, lane):
    """One number of record k of an array (M, 4)."""
    return array[k, lane]


def set_number(array, k, lane, value):
    """Write what `number` reads."""
    array[k, lane] = value


def spread(number):
    """The record of four times the same number."""
    return np.full(4, number)


def pack(a, b, c, d):
    """The record of four numbers."""
    return np.array([a, b, c, d])


def pair(a, b):
    """The record of two numbers, twice."""
    return np.array([a, b, a, b])


def blend(x, y):
    """The first half of record x and the second half of y."""
    return np.concatenate([x[:2], y[2:]])


def alternate(x, y):
    """The even numbers of record x and the odd ones of y."""
    return np.array([x[0], y[1], x[2], y[3]])


def total(x):
    """The sum of a record's numbers."""
    return x.sum()


def positive(x):
    """Whether the real parts of a record are all above zero; what is not a number is not."""
    return bool(np.all(np.real(x) > 0.0))


def logarithm(x):
    """The natural logarithms of a record of positive numbers."""
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.log(x)


def meet(meeting, threads):
    """Wait until all threads are here; whether they came, and none gave up."""
    return True


def real(x):
    """The real parts of a record."""
    return np.real(x)


def whole(x):
    """The numbers of a real record without their fractions."""
    return np.trunc(x)


def within(x, low, high):
    """Whether low <= x < high for all of a real record; not if one is not a number."""
    return bool(np.all((low <= x) & (x < high)))


def least(x, y):
    """The smaller numbers of two real records."""
    return np.minimum(x, y)


def greatest(x, y):
    """The larger numbers of two real records."""
    return np.maximum(x, y)


@jit
def tensor(array, k):
    """Records k to k + 3: the components of a tensor."""
    return load(array, k), load(array, k + 1), load(array, k + 2), load(array, k + 3)


@jit
def store_tensor(array, k, x00, x01, x10, x11):
    """Write what `tensor` reads."""
    store(array, k, x00)
    store(array, k + 1, x01)
    store(array, k + 2, x10)
    store(array, k + 3, x11)


@jit
def add(array, k, record):
    """Add to record k of an array (M, 4)."""
    store(array, k, load(array, k) + record)


class Register(types.Type):
    """A record in a vector register: four doubles, or four complex numbers as eight."""

    def __init__(self, dtype):
        self.dtype = dtype
        super().__init__(f"Register({dtype})")


@register_model(Register)
class RegisterModel(models.PrimitiveModel):
    """As a vector of LLVM."""

    def __init__(self, manager, kind):
        super().__init__(manager, kind, _vector(kind.dtype))


FLAGS = ("contract", "reassoc", "nsz", "arcp")
INT32 = ir.IntType(32)


def _vector(dtype):
    return ir.VectorType(ir.DoubleType(), 4 if dtype == types.float64 else 8)


def _shuffle(builder, x, y, lanes):
    mask = ir.Constant(ir.VectorType(INT32, len(lanes)), lanes)
    return builder.shuffle_vector(x, y, mask)


def _doubles(context, builder, dtype, value):
    """The doubles of a number: one, or the parts of a complex one."""
    if dtype == types.float64:
        return [value]
    value = context.make_complex(builder, dtype, value)
    return [value.real, value.imag]


def _vector_of(context, builder, dtype, values):
    """The vector of four numbers."""
    vector = ir.Constant(_vector(dtype), ir.Undefined)
    doubles = [d for value in values for d in _doubles(context, builder, dtype, value)]
    for lane, value in enumerate(doubles):
        vector = builder.insert_element(vector, value, INT32(lane))
    return vector


def _pointer(context, builder, array_type, array, k, vector, lane=None):
    """To record k of an array (M, 4), whose strides the compiler need not look up, or to a lane."""
    array = context.make_array(array_type)(context, builder, array)
    width = NODE_SIZE if array_type.ndim == 2 else 1
    place = builder.mul(k, k.type(width))
    if lane is not None:
        place = builder.add(place, lane)
    return builder.bitcast(builder.gep(array.data, [place]), vector.as_pointer())


@intrinsic
def _number(typingctx, array, k, lane):
    def generate(context, builder, signature, arguments):
        kind = context.get_data_type(array.dtype)
        return builder.load(_pointer(context, builder, array, *arguments[:2], kind, arguments[2]))

    return array.dtype(array, types.intp, types.intp), generate


@intrinsic
def _set_number(typingctx, array, k, lane, value):
    def generate(context, builder, signature, arguments):
        kind = context.get_data_type(array.dtype)
        pointer = _pointer(context, builder, array, *arguments[:2], kind, arguments[2])
        builder.store(arguments[3], pointer)
        return context.get_dummy_value()

    return types.none(array, types.intp, types.intp, array.dtype), generate


@intrinsic
def _load(typingctx, array, k):
    def generate(context, builder, signature, arguments):
        vector = _vector(array.dtype)
        pointer = _pointer(context, builder, array, arguments[0], arguments[1], vector)
        return builder.load(pointer, align=8)

    return Register(array.dtype)(array, types.intp), generate


@intrinsic
def _load_pair(typingctx, array, k):
    def generate(context, builder, signature, arguments):
        half = ir.VectorType(ir.DoubleType(), _vector(array.dtype).count // 2)
        pointer = _pointer(context, builder, array, arguments[0], arguments[1], half)
        pair = builder.load(pointer, align=8)
        return _shuffle(builder, pair, pair, 2 * list(range(half.count)))

    return Register(array.dtype)(array, types.intp), generate


@intrinsic
def _store(typingctx, array, k, record):
    def generate(context, builder, signature, arguments):
        vector = _vector(array.dtype)
        pointer = _pointer(context, builder, array, arguments[0], arguments[1], vector)
        builder.store(arguments[2], pointer, align=8)
        return context.get_dummy_value()

    return types.none(array, types.intp, Register(array.dtype)), generate


@intrinsic
def _pack(typingctx, a, b, c, d):
    def generate(context, builder, signature, arguments):
        return _vector_of(context, builder, a, arguments)

    return Register(a)(a, a, a, a), generate


@intrinsic
def _spread(typingctx, a):
    def generate(context, builder, signature, arguments):
        vector = _vector_of(context, builder, a, arguments)
        lanes = [0] * 4 if a == types.float64 else [0, 1] * 4
        return _shuffle(builder, vector, vector, lanes)

    return Register(a)(a), generate


def _choice(second):
    """Of two records: the numbers marked in `second` from the second one."""

    @intrinsic
    def choose(typingctx, x, y):
        def generate(context, builder, signature, arguments):
            width = _vector(x.dtype).count
            of = width // 4
            lanes = [k + width * second[k // of] for k in range(width)]
            return _shuffle(builder, *arguments, lanes)

        return x(x, x), generate

    return choose


def _real_parts(builder, record, vector):
    return (
        vector if record.dtype == types.float64 else _shuffle(builder, vector, vector, [0, 2, 4, 6])
    )


def _all(builder, lanes):
    return functools.reduce(
        builder.and_, [builder.extract_element(lanes, INT32(k)) for k in range(4)]
    )


@intrinsic
def _real(typingctx, x):
    def generate(context, builder, signature, arguments):
        return _real_parts(builder, x, arguments[0])

    return Register(types.float64)(x), generate


@intrinsic
def _whole(typingctx, x):
    def generate(context, builder, signature, arguments):
        value = builder.fptosi(arguments[0], ir.VectorType(ir.IntType(64), 4))
        return builder.sitofp(value, _vector(types.float64))

    return x(x), generate


@intrinsic
def _within(typingctx, x, low, high):
    def generate(context, builder, signature, arguments):
        above = builder.fcmp_ordered("<=", arguments[1], arguments[0])
        below = builder.fcmp_ordered("<", arguments[0], arguments[2])
        return _all(builder, builder.and_(above, below))

    return types.boolean(x, low, high), generate


def _extreme(symbol):
    @intrinsic
    def extreme(typingctx, x, y):
        def generate(context, builder, signature, arguments):
            return builder.select(builder.fcmp_ordered(symbol, *arguments), *arguments)

        return x(x, y), generate

    return extreme


_least, _greatest = _extreme("<"), _extreme(">")
_blend = _choice((0, 0, 1, 1))
_alternate = _choice((0, 1, 0, 1))


def _arithmetic(name):
    @intrinsic
    def operate(typingctx, x, y):
        def generate(context, builder, signature, arguments):
            a, b = arguments
            if x.dtype == types.float64 or name in ("fadd", "fsub"):
                return getattr(builder, name)(a, b, flags=FLAGS)
            # (a.re + i a.im) b = a.re b + a.im (i b)
            re, im = [0, 0, 2, 2, 4, 4, 6, 6], [1, 1, 3, 3, 5, 5, 7, 7]
            turned = _shuffle(builder, b, b, [1, 0, 3, 2, 5, 4, 7, 6])
            signs = ir.Constant(_vector(x.dtype), 4 * [-1.0, 1.0])
            turned = builder.fmul(turned, signs, flags=FLAGS)
            real = builder.fmul(_shuffle(builder, a, a, re), b, flags=FLAGS)
            imaginary = builder.fmul(_shuffle(builder, a, a, im), turned, flags=FLAGS)
            return builder.fadd(real, imaginary, flags=FLAGS)

        return x(x, x), generate

    return operate


def _overload_arithmetic(symbol, name):
    operate = _arithmetic(name)

    @overload(symbol)
    def arithmetic(x, y):
        if not (isinstance(x, Register) or isinstance(y, Register)):
            return None
        if types.complex128 in (getattr(x, "dtype", x), getattr(y, "dtype", y)):
            return lambda x, y: operate(_as_complex(x), _as_complex(y))
        return lambda x, y: operate(_as_real(x), _as_real(y))


def _as_real(x):
    """A record of real numbers."""


def _as_complex(x):
    """A record of complex numbers."""


@overload(_as_real)
def _overload_as_real(x):
    if isinstance(x, Register):
        return lambda x: x
    return lambda x: _spread(float(x))


@overload(_as_complex)
def _overload_as_complex(x):
    if not isinstance(x, Register):
        return lambda x: _spread(complex(x))
    if x.dtype == types.complex128:
        return lambda x: x
    return lambda x: _pack(complex(x[0]), complex(x[1]), complex(x[2]), complex(x[3]))


for _symbol, _name in (
    (operator.add, "fadd"),
    (operator.sub, "fsub"),
    (operator.mul, "fmul"),
):
    _overload_arithmetic(_symbol, _name)


@intrinsic
def _divide(typingctx, x, y):
    def generate(context, builder, signature, arguments):
        x_lanes, y_lanes = arguments
        if x.dtype == types.complex128:
            y_lanes = _shuffle(builder, y_lanes, y_lanes, [0, 0, 1, 1, 2, 2, 3, 3])
        return builder.fdiv(x_lanes, y_lanes, flags=FLAGS)

    return x(x, y), generate


@overload(operator.truediv)
def _overload_divide(x, y):
    if isinstance(x, Register) and types.complex128 not in (y, getattr(y, "dtype", y)):
        return lambda x, y: _divide(x, _as_real(y))


@intrinsic
def _lane(typingctx, record, k):
    def generate(context, builder, signature, arguments):
        lane = builder.trunc(arguments[1], INT32)
        if record.dtype == types.float64:
            return builder.extract_element(arguments[0], lane)
        value = context.make_complex(builder, record.dtype)
        lane = builder.shl(lane, INT32(1))
        value.real = builder.extract_element(arguments[0], lane)
        value.imag = builder.extract_element(arguments[0], builder.add(lane, INT32(1)))
        return value._getvalue()

    return record.dtype(record, types.intp), generate


@overload(operator.getitem)
def _getitem(record, k):
    if isinstance(record, Register):
        return lambda record, k: _lane(record, k)


@intrinsic
def _positive(typingctx, record):
    def generate(context, builder, signature, arguments):
        value = _real_parts(builder, record, arguments[0])
        zeros = ir.Constant(_vector(types.float64), None)
        return _all(builder, builder.fcmp_ordered(">", value, zeros))

    return types.boolean(record), generate


@intrinsic
def _exponent_and_fraction(typingctx, record):
    """x = 2^k m with m from sqrt(1/2) to sqrt(2): the records of k and m."""
    result = types.UniTuple(record, 2)

    def generate(context, builder, signature, arguments):
        integers = ir.VectorType(ir.IntType(64), 4)

        def constant(value):
            return ir.Constant(integers, 4 * [value])

        bits = builder.bitcast(arguments[0], integers)
        half = constant(int(np.float64(0.5**0.5).view(np.int64)))
        k = builder.ashr(builder.sub(bits, half), constant(52))
        m = builder.bitcast(builder.sub(bits, builder.shl(k, constant(52))), _vector(record.dtype))
        k = builder.sitofp(k, _vector(record.dtype))
        return context.make_tuple(builder, result, [k, m])

    return result(record), generate


@jit
def _log(x):
    """ln x = k ln 2 + 2 artanh(s), s = (m - 1) / (m + 1), where x = 2^k m; |s| < 0.1716."""
    k, m = _exponent_and_fraction(x)
    s = (m - 1.0) / (m + 1.0)
    z = s * s
    z2 = z * z
    odd = 1.0 / 25.0 + z2 * 0.0
    even = 1.0 / 23.0 + z2 * 0.0
    for power in (21.0, 17.0, 13.0, 9.0, 5.0):
        odd = 1.0 / power + z2 * odd
    for power in (19.0, 15.0, 11.0, 7.0, 3.0):
        even = 1.0 / power + z2 * even
    series = even + z * odd  # 1/3 + z/5 + z^2/7 + ...
    return k * LN2 + (2.0 * s + 2.0 * s * z * series)


LN2 = math.log(2.0)


@overload(load)
def _overload_load(array, k):
    return lambda array, k: _load(array, k)


@overload(load_pair)
def _overload_load_pair(array, k):
    return lambda array, k: _load_pair(array, k)


@overload(store)
def _overload_store(array, k, record):
    return lambda array, k, record: _store(array, k, record)


@overload(number)
def _overload_number(array, k, lane):
    return lambda array, k, lane: _number(array, k, lane)


@overload(set_number)
def _overload_set_number(array, k, lane, value):
    return lambda array, k, lane, value: _set_number(array, k, lane, value)


@overload(pair)
def _overload_pair(a, b):
    return lambda a, b: _pack(a, b, a, b)


@overload(spread)
def _overload_spread(number):
    return lambda number: _spread(number)


@overload(pack)
def _overload_pack(a, b, c, d):
    return lambda a, b, c, d: _pack(a, b, c, d)


@overload(blend)
def _overload_blend(x, y):
    return lambda x, y: _blend(x, y)


@overload(alternate)
def _overload_alternate(x, y):
    return lambda x, y: _alternate(x, y)


@overload(total)
def _overload_total(x):
    return lambda x: (x[0] + x[1]) + (x[2] + x[3])


@overload(real)
def _overload_real(x):
    return lambda x: _real(x)


@overload(whole)
def _overload_whole(x):
    return lambda x: _whole(x)


@overload(within)
def _overload_within(x, low, high):
    return lambda x, low, high: _within(x, low, high)


@overload(least)
def _overload_least(x, y):
    return lambda x, y: _least(x, y)


@overload(greatest)
def _overload_greatest(x, y):
    return lambda x, y: _greatest(x, y)


@overload(positive)
def _overload_positive(x):
    return lambda x: _positive(x)


@overload(logarithm)
def _overload_logarithm(x):
    if x.dtype == types.float64:
        return lambda x: _log(x)
    return lambda x: _pack(np.log(x[0]), np.log(x[1]), np.log(x[2]), np.log(x[3]))


@intrinsic
def _atomic_add(typingctx, array, k, amount):
    def generate(context, builder, signature, arguments):
        pointer = _pointer(context, builder, array, arguments[0], arguments[1], ir.IntType(64))
        return builder.atomic_rmw("add", pointer, arguments[2], "seq_cst")

    return types.int64(array, types.intp, types.int64), generate


@intrinsic
def _atomic_load(typingctx, array, k):
    def generate(context, builder, signature, arguments):
        pointer = _pointer(context, builder, array, arguments[0], arguments[1], ir.IntType(64))
        return builder.load_atomic(pointer, "seq_cst", align=8)

    return types.int64(array, types.intp), generate


# Turns of waiting before the processor is left to others, should they be more than processors.
TURNS = 500


@intrinsic
def _give_way(typingctx):
    name = "SwitchToThread" if sys.platform == "win32" else "sched_yield"

    def generate(context, builder, signature, arguments):
        kind = ir.FunctionType(INT32, [])
        builder.call(cgutils.get_or_insert_function(builder.module, kind, name), [])
        return context.get_dummy_value()

    return types.none(), generate


@overload(meet)
def _overload_meet(meeting, threads):
    # Threads at this meeting in meeting[0], meetings so far in [8], whether one gave up in [16].
    def implementation(meeting, threads):
        if threads == 1:
            return True
        before = _atomic_load(meeting, 8)
        if _atomic_add(meeting, 0, 1) == threads - 1:
            _atomic_add(meeting, 0, -threads)
            _atomic_add(meeting, 8, 1)
            return True
        turns = 0
        while _atomic_load(meeting, 8) == before:
            turns += 1
            if turns > TURNS:
                if _atomic_load(meeting, 16) != 0:
                    return False
                _give_way()
        return True

    return implementation
