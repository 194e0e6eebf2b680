"""The discrete model: one explicit MLS-MPM step and its exact adjoint, read from top to bottom.

A step advances the particle states from t_n to t_n + dt (primes mark the new state, c = 4/dx^2)::

    deform       F'  = (I + dt C) F,   J' = det F'
    stress       tau = mu (F'F'^T - I) + lambda ln J' I + s F' S F'^T
                 A   = m C - dt V c tau
    p2g          m_i = sum_p w_ip m,   q_i = sum_p w_ip (m v + A (x_i - x))
    mirror       adds the images across a plane of symmetry, if the scene has one
    grid_update  u_i = wall(q_i / m_i + dt g), where m_i > 0
    g2p          v'  = sum_i w_ip u_i,  C' = c sum_i w_ip u_i (x_i - x)^T,  x' = x + dt v'
    blend        v' += keep (v - sum_i w_ip u_i_old), if the scene asks for it

Every kernel is followed by its adjoint of the same name, which uses the same variable names;
``_bar`` marks the derivative of the objective with respect to a variable. Branches (contact, cells)
are those that the forward step took.

Sums over the nine nodes of a particle are not taken node by node. Where a particle is t cells from
the middle of its three nodes along an axis, |t| <= 1/2, the weights of all three are quadratic in
t: w = b_0 + t b_1 + (t^2/2) b_2 with constants b_k (`expand`). So a field on the nodes is a
polynomial in each cell, its Taylor expansion about the middle node, and what particles put on nodes
passes through moments of the cell, the transpose. A cell is expanded once for all particles in it.

Arrays (M, 4) hold records of four numbers and flat arrays (2 M,) pairs, which a processor handles
as one. Particles come in groups of four: records 12 g to 12 g + 11 of a state are x, y, u, v, C00,
C01, C10, C11, F00, F01, F10, F11 of group g, and `grouped` makes them of an array (12, N). Grid
arrays hold the window of nodes that the particles touch and no others: node (i, j) is record
``(i - i0) nj + (j - j0)`` of window ``(i0, j0, ni, nj)``. Records 9 c to 9 c + 8 of cell arrays are
the coefficients of cell c, number 3 k + l that of order k along x and l along y.

Several threads share a step. Each has its blocks of groups, which put their momentum on nodes of
their own, and its columns of the window, in which it adds the blocks up in their order. So results
do not depend on the number of threads. What is derived of particles lives in a `Tile`.

The kernels also compile for complex128, which makes the complex step an oracle for the adjoint:
cells, walls and comparisons look at real parts only. They know arrays and numbers, no user objects,
and they live in one file because Numba's disk cache does not see changes in another one. What
records can do (`load`, `store`, `pack`, ...) stands at the end of the file.

Sources: Hu et al. 2018 (MLS-MPM), Jiang et al. 2015 (APIC), Sato et al. 2023 (actuation).
"""

import functools
import logging
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


def _can_cache() -> bool:
    """Whether Numba finds a folder to keep compiled kernels in; without one it would raise."""
    try:
        njit(cache=True)(_can_cache)
    except RuntimeError:
        logging.getLogger(__name__).warning(
            "no folder to keep compiled kernels in, each start compiles them anew; let the "
            "environment variable NUMBA_CACHE_DIR name one"
        )
        return False
    return True


# No "nnan" or "ninf": comparisons must see what is not a number.
OPTIONS: dict[str, Any] = {
    "cache": _can_cache(),
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
    per_dx: float  # 1 / dx, of which cells are found
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
    keep: float  # share of what the grid smoothed away that particles keep; 0: no blend
    dust: float  # mass of a node that is rounding of larger ones: the node is empty


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
    def zeros(cls, groups: int, dtype: DTypeLike = float) -> "BodyBar":
        """Nothing accumulated yet."""
        return cls(*(np.zeros((groups, 4), dtype) for _ in cls._fields))


class Tile(NamedTuple):
    """What a step derives of some groups of particles at a time: small, to stay in fast memory.

    Arrays of records, so many for each of T groups.
    """

    cell: NDArray[np.float64]  # (T, 4) number of a particle's cell in the block's window
    place: NDArray  # (6 T, 4) by pairs along x and y: t, t^2/2, 3t/8 - t^3/2
    affine: NDArray  # (4 T, 4) A dx, the affine momentum of a cell's width
    gathered: NDArray  # (9 T, 4) by `p2g_adjoint`: A_bar, sums of w q_bar, w m_bar, slopes


@jit
def make_tile(groups, like):
    """Room for so many groups, of the type of the array `like`."""
    return Tile(
        np.zeros((groups, 4), like.real.dtype),
        np.zeros((6 * groups, 4), like.dtype),
        np.zeros((4 * groups, 4), like.dtype),
        np.zeros((9 * groups, 4), like.dtype),
    )


class Scratch(NamedTuple):
    """What the threads share during a step, for B blocks and a window of M nodes.

    There are S sheets of nodes: one, or two where a scene blends. Then the second has the momentum
    before force, gravity and walls, and its velocity.
    """

    velocity: NDArray  # (S, 2 M) u
    velocity_bar: NDArray  # (S, 2 M)
    node_bar: NDArray  # (S, M, 4) adjoints of momentum and mass
    parts: NDArray  # (B, S, P, 4) what each block puts on the nodes of its own window
    parts_bar: NDArray  # (B, S, 2 P) the same of `velocity_bar`
    ends: NDArray[np.int64]  # (B, 2) how the step ended for each block, and a particle

    @classmethod
    def make(
        cls, sheets: int, nodes: int, blocks: int, part: int, dtype: DTypeLike = float
    ) -> "Scratch":
        """Room for so many sheets, nodes, blocks, and nodes of a block."""
        return cls(
            np.zeros((sheets, 2 * nodes), dtype),
            np.zeros((sheets, 2 * nodes), dtype),
            np.zeros((sheets, nodes, NODE_SIZE), dtype),
            np.zeros((blocks, sheets, part, NODE_SIZE), dtype),
            np.zeros((blocks, sheets, 2 * part), dtype),
            np.zeros((blocks, 2), np.int64),
        )


@jit
def make_cells(scratch):
    """Coefficients of the cells of any block, of records (S, 9 P, 4) and of pairs (S, 18 P)."""
    _, sheets, part, _ = scratch.parts.shape
    dtype = scratch.parts.dtype
    return np.zeros((sheets, 9 * part, 4), dtype), np.zeros((sheets, 18 * part), dtype)


@jit
def clear(cells, part):
    """Zero the coefficients of a window's cells."""
    zero = nothing(cells)
    for k in range(9 * part[2] * (part[3] - 2)):
        store(cells, k, zero)


@jit
def weights(f):
    """Quadratic B-spline weights of three nodes; a particle is f cells from the first of them."""
    return 0.5 * (1.5 - f) * (1.5 - f), 0.75 - (f - 1.0) * (f - 1.0), 0.5 * (f - 0.5) * (f - 0.5)


@jit
def expand(f0, f1, f2):
    """Value, slope and curvature, per cell, of the spline of three nodes, at the middle."""
    outer = f0 + f2
    return 0.125 * outer + 0.75 * f1, 0.5 * (f2 - f0), outer - 2.0 * f1


@jit
def expand_adjoint(c0, c1, c2):
    """What three nodes get of the moments of order 0, 1 and 2: the transpose of `expand`."""
    even, odd = 0.125 * c0 + c2, 0.5 * c1
    return even - odd, 0.75 * c0 - 2.0 * c2, even + odd


@jit
def taylor(nodes, window, part, cells):
    """Taylor coefficients of a field on the nodes of a window, for all cells of a part of it."""
    i0, j0, _, nj = window
    i1, j1, columns, rows = part[0], part[1], part[2], part[3] - 2
    for i in range(columns):  # along y
        node = (i1 - i0 + i) * nj + j1 - j0
        for j in range(rows):
            c = 9 * (i * rows + j)
            v, s, k = expand(
                load(nodes, node + j), load(nodes, node + j + 1), load(nodes, node + j + 2)
            )
            store(cells, c, v)
            store(cells, c + 1, s)
            store(cells, c + 2, k)
    stride = 9 * rows
    for i in range(columns - 2):  # along x
        for c in range(i * stride, (i + 1) * stride, 9):
            for order in range(c, c + 3):
                v, s, k = expand(
                    load(cells, order), load(cells, order + stride), load(cells, order + 2 * stride)
                )
                store(cells, order, v)
                store(cells, order + 3, s)
                store(cells, order + 6, k)


@jit
def taylor_adjoint(cells, part, nodes):
    """From moments of all cells of a part to its nodes: the transpose of `taylor`."""
    columns, rows = part[2], part[3] - 2
    stride = 9 * rows
    for i in range(columns - 3, -1, -1):  # along x
        for c in range(i * stride, (i + 1) * stride, 9):
            for order in range(c, c + 3):
                f0, f1, f2 = expand_adjoint(
                    load(cells, order), load(cells, order + 3), load(cells, order + 6)
                )
                store(cells, order, f0)
                add(cells, order + stride, f1)
                add(cells, order + 2 * stride, f2)
    for i in range(columns):  # along y
        node = i * part[3]
        here = after = nothing(cells)
        for j in range(rows):
            c = 9 * (i * rows + j)
            f0, f1, f2 = expand_adjoint(load(cells, c), load(cells, c + 1), load(cells, c + 2))
            store(nodes, node + j, here + f0)
            here, after = after + f1, f2
        store(nodes, node + rows, here)
        store(nodes, node + rows + 1, after)


@jit
def deposit(cells, tile, g, k, f, a, b):
    """Add the moments of w f + w r_x a + w r_y b to the cell of particle k of a group."""
    c = 9 * int(number(tile.cell, g, k))
    tx, hx, rx = (
        number(tile.place, 6 * g, k),
        number(tile.place, 6 * g + 2, k),
        number(tile.place, 6 * g + 4, k),
    )
    deposit_row(cells, c, tile, g, k, f, b)
    deposit_row(cells, c + 3, tile, g, k, tx * f + 0.25 * a, tx * b)
    deposit_row(cells, c + 6, tile, g, k, hx * f + rx * a, hx * b)


@jit
def deposit_row(cells, c, tile, g, k, f, b):
    """The moments along y of w f + w r_y b."""
    ty, hy, ry = (
        number(tile.place, 6 * g + 1, k),
        number(tile.place, 6 * g + 3, k),
        number(tile.place, 6 * g + 5, k),
    )
    add(cells, c, f)
    add(cells, c + 1, ty * f + 0.25 * b)
    add(cells, c + 2, hy * f + ry * b)


@jit
def moments(cells, tile, g, k):
    """Sums over the nodes of particle k of a group of w f, w r_x f and w r_y f, for r in cells."""
    c = 9 * int(number(tile.cell, g, k))
    tx, hx, rx = (
        number(tile.place, 6 * g, k),
        number(tile.place, 6 * g + 2, k),
        number(tile.place, 6 * g + 4, k),
    )
    f0, b0 = moments_row(cells, c, tile, g, k)
    f1, b1 = moments_row(cells, c + 3, tile, g, k)
    f2, b2 = moments_row(cells, c + 6, tile, g, k)
    return f0 + tx * f1 + hx * f2, 0.25 * f1 + rx * f2, b0 + tx * b1 + hx * b2


@jit
def moments_row(cells, c, tile, g, k):
    """Along y only: w f and w r_y f."""
    ty, hy, ry = (
        number(tile.place, 6 * g + 1, k),
        number(tile.place, 6 * g + 3, k),
        number(tile.place, 6 * g + 5, k),
    )
    f0, f1, f2 = load(cells, c), load(cells, c + 1), load(cells, c + 2)
    return f0 + ty * f1 + hy * f2, 0.25 * f1 + ry * f2


@jit
def slopes(cells, tile, g, k, f, a, b):
    """Derivatives along x and y, per cell, of f.sum(w F) + a.sum(w r_x F) + b.sum(w r_y F).

    F is the cells' field. As records: the derivative is the sum of their numbers.
    """
    c = 9 * int(number(tile.cell, g, k))
    tx, hx, rx = (
        number(tile.place, 6 * g, k),
        number(tile.place, 6 * g + 2, k),
        number(tile.place, 6 * g + 4, k),
    )
    _, _, s0, _ = slopes_row(cells, c, tile, g, k)
    f1, b1, s1, k1 = slopes_row(cells, c + 3, tile, g, k)
    f2, b2, s2, k2 = slopes_row(cells, c + 6, tile, g, k)
    k0 = load(cells, c + 2)
    hy = number(tile.place, 6 * g + 3, k)
    along_x = (f1 + tx * f2) * f + ((0.375 - 3.0 * hx) * f2) * a + (b1 + tx * b2) * b
    bent = (0.375 - 3.0 * hy) * (k0 + tx * k1 + hx * k2)
    along_y = (s0 + tx * s1 + hx * s2) * f + (0.25 * s1 + rx * s2) * a + bent * b
    return along_x, along_y


@jit
def slopes_row(cells, c, tile, g, k):
    """Along y only: w f, w r_y f, and of the former slope and curvature."""
    ty = number(tile.place, 6 * g + 1, k)
    f, b = moments_row(cells, c, tile, g, k)
    curvature = load(cells, c + 2)
    return f, b, load(cells, c + 1) + ty * curvature, curvature


@jit
def interpolation(position, dx, rows):
    """Nodes and weights (N, 9) of particles at (N, 2); node (i, j) has number i * rows + j."""
    nodes = np.empty((position.shape[0], 9), np.int64)
    values = np.empty((position.shape[0], 9))
    per_dx = 1.0 / dx
    for p in range(position.shape[0]):
        x, y = position[p, 0], position[p, 1]
        i, j = int(cell_coordinate(x, per_dx)), int(cell_coordinate(y, per_dx))
        wx, wy = weights(per_dx * x - i), weights(per_dx * y - j)
        for a in range(3):
            for b in range(3):
                nodes[p, 3 * a + b] = (i + a) * rows + j + b
                values[p, 3 * a + b] = wx[a] * wy[b]
    return nodes, values


@jit
def find_window(state, world, first, last):
    """Window (i0, j0, ni, nj) of the nodes that particles touch; whether all are on the grid."""
    per_dx, end_x, end_y = world.per_dx, world.nodes_x - 2.0, world.nodes_y - 2.0
    i_max = j_max = real(nothing(state))
    i_min, j_min = i_max + world.nodes_x, j_max + world.nodes_y
    for g in range(first, last):
        x = cell_coordinate(real(load(state, 12 * g)), per_dx)
        y = cell_coordinate(real(load(state, 12 * g + 1)), per_dx)
        if not (within(x, 0.0, end_x) and within(y, 0.0, end_y)):
            return 0, 0, 0, 0, False
        i, j = whole(x), whole(y)
        i_min, i_max = least(i_min, i), greatest(i_max, i)
        j_min, j_max = least(j_min, j), greatest(j_max, j)
    i0, i1, j0, j1 = i_min[0], i_max[0], j_min[0], j_max[0]
    for k in range(1, 4):
        i0, i1, j0, j1 = min(i0, i_min[k]), max(i1, i_max[k]), min(j0, j_min[k]), max(j1, j_max[k])
    return int(i0), int(j0), int(i1 - i0) + 3, int(j1 - j0) + 3, True


@jit
def margins(state, body, world, solid, first, last):
    """How close groups of particles come to where a step is too long, as in `simulate.Margins`.

    The largest (dt / dx) sqrt(M / rho) and dt |C|, the smallest J, and the largest stretch of
    particles whose mu is at least `solid`; M is the stiffness of a particle as stretched as it is,
    ``lambda + mu tr b + sqrt(mu^2 (tr^2 b - 4 det b) + lambda^2)`` with b = F F^T. Extremes do not
    depend on the order in which they are taken.
    """
    stiffest = fastest = longest = 0.0
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
                apart = max(trace * trace - 4.0 * J * J, 0.0)
                stiffness = lam + mu * trace + math.sqrt(mu * mu * apart + lam * lam)
                if mu >= solid:
                    longest = max(longest, 0.5 * (trace + math.sqrt(apart)))
                stiffest = max(stiffest, stiffness * volume / mass)
                fastest = max(fastest, c00 * c00 + c01 * c01 + c10 * c10 + c11 * c11)
                smallest = min(smallest, J)
    courant, spin = world.dt / world.dx * math.sqrt(stiffest), world.dt * math.sqrt(fastest)
    return courant, spin, smallest, math.sqrt(longest)


@jit
def locate(state, world, part, tile, first, last):
    """The cells of the particles in the window `part` and their places in them, into the tile."""
    i0, j0, _, nj = part
    per_dx = world.per_dx
    for g in range(first, last):
        k = g - first
        x, y = load(state, 12 * g), load(state, 12 * g + 1)
        i = whole(cell_coordinate(real(x), per_dx))
        j = whole(cell_coordinate(real(y), per_dx))
        store(tile.cell, k, (nj - 2) * (i - i0) + (j - j0))
        tx, ty = per_dx * x - (i + 1.0), per_dx * y - (j + 1.0)
        hx, hy = 0.5 * tx * tx, 0.5 * ty * ty
        store(tile.place, 6 * k, tx)
        store(tile.place, 6 * k + 1, ty)
        store(tile.place, 6 * k + 2, hx)
        store(tile.place, 6 * k + 3, hy)
        store(tile.place, 6 * k + 4, tx * (0.375 - hx))
        store(tile.place, 6 * k + 5, ty * (0.375 - hy))


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
    """Affine momentum A dx from C, F' and ln J'."""
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
        impulse = (4.0 * world.dt / world.dx) * load(body.volume, g)
        m = world.dx * m
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
    s00 = s01 = s11 = 0.0 * load(body.mass, g)
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
    """From A_bar: adds to C_bar, F_bar' and to the adjoints of the material and the signal."""
    for g in range(first, last):
        c00, c01, c10, c11 = tensor(old, 12 * g + 4)
        f00, f01, f10, f11 = tensor(new, 12 * g + 8)
        a00, a01, a10, a11 = tensor(tile.gathered, 9 * (g - first))
        m, mu = load(body.mass, g), load(body.lame_mu, g)
        add(bar, 12 * g + 4, m * a00)
        add(bar, 12 * g + 5, m * a01)
        add(bar, 12 * g + 6, m * a10)
        add(bar, 12 * g + 7, m * a11)
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
def inertia(old, body, world, tile, first, last):
    """Affine momentum A dx of the velocity alone, m C dx, in the place of `stress`."""
    for g in range(first, last):
        m = world.dx * load(body.mass, g)
        c00, c01, c10, c11 = tensor(old, 12 * g + 4)
        store_tensor(tile.affine, 4 * (g - first), m * c00, m * c01, m * c10, m * c11)


@jit
def inertia_adjoint(old, body, tile, bar, body_bar, first, last):
    """Adds to C_bar and to the adjoint of the mass."""
    for g in range(first, last):
        c00, c01, c10, c11 = tensor(old, 12 * g + 4)
        a00, a01, a10, a11 = tensor(tile.gathered, 9 * (g - first))
        m = load(body.mass, g)
        add(body_bar.mass, g, a00 * c00 + a01 * c01 + a10 * c10 + a11 * c11)
        add(bar, 12 * g + 4, m * a00)
        add(bar, 12 * g + 5, m * a01)
        add(bar, 12 * g + 6, m * a10)
        add(bar, 12 * g + 7, m * a11)


@jit
def momentum(state, body, tile, g, t, k):
    """What particle k of a group puts on nodes: (m v_x, m v_y, m, 0), columns of A dx likewise."""
    m, A, row = number(body.mass, g, k), tile.affine, 4 * t
    zero = 0.0 * m
    q = pack(m * number(state, 12 * g + 2, k), m * number(state, 12 * g + 3, k), m, zero)
    a0 = pack(number(A, row, k), number(A, row + 2, k), zero, zero)
    a1 = pack(number(A, row + 1, k), number(A, row + 3, k), zero, zero)
    return q, a0, a1


@jit
def p2g(state, body, tile, cells, first, last):
    """Particle to grid: momentum and mass (q_x, q_y, m, 0), as moments of cells."""
    for g in range(first, last):
        t = g - first
        for k in range(4):
            q, a0, a1 = momentum(state, body, tile, g, t, k)
            deposit(cells, tile, t, k, q, a0, a1)


@jit
def p2g_adjoint(state, body, world, tile, cells, bar, body_bar, first, last):
    """From momentum_bar and mass_bar of cells to A_bar; adds to x_bar, v_bar and mass_bar."""
    dx, per_dx, gathered = world.dx, world.per_dx, tile.gathered
    for g in range(first, last):
        t = g - first
        for k in range(4):
            q, a0, a1 = momentum(state, body, tile, g, t, k)
            mean, along_x, along_y = moments(cells, tile, t, k)
            slope_x, slope_y = slopes(cells, tile, t, k, q, a0, a1)
            set_number(gathered, 9 * t, k, along_x[0])
            set_number(gathered, 9 * t + 1, k, along_y[0])
            set_number(gathered, 9 * t + 2, k, along_x[1])
            set_number(gathered, 9 * t + 3, k, along_y[1])
            set_number(gathered, 9 * t + 4, k, mean[0])
            set_number(gathered, 9 * t + 5, k, mean[1])
            set_number(gathered, 9 * t + 6, k, mean[2])
            set_number(gathered, 9 * t + 7, k, total(slope_x))
            set_number(gathered, 9 * t + 8, k, total(slope_y))
        a00, a01, a10, a11 = tensor(gathered, 9 * t)
        store_tensor(gathered, 9 * t, dx * a00, dx * a01, dx * a10, dx * a11)
        add(bar, 12 * g, per_dx * load(gathered, 9 * t + 7))
        add(bar, 12 * g + 1, per_dx * load(gathered, 9 * t + 8))
        m, u, v = load(body.mass, g), load(state, 12 * g + 2), load(state, 12 * g + 3)
        u_bar, v_bar = load(gathered, 9 * t + 4), load(gathered, 9 * t + 5)
        add(bar, 12 * g + 2, m * u_bar)
        add(bar, 12 * g + 3, m * v_bar)
        add(body_bar.mass, g, load(gathered, 9 * t + 6) + u * u_bar + v * v_bar)


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
        normal_is_x = world.wall_axis[k] == 0
        if is_behind(i, j, k, world):
            un, ut = (u, v) if normal_is_x else (v, u)
            if world.wall_side[k] * un.real < 0.0:
                keep, slope = friction(un.real, ut.real, k, world)
                un, ut = 0.0 * un, fused(slope, un, keep * ut)
            u, v = (un, ut) if normal_is_x else (ut, un)
    return u, v


@jit
def wall_adjoint(i, j, u, v, world, u_bar, v_bar):
    """Transpose of `wall`: through the derivative D of its branches, of (u, v) by (u, v)."""
    d00, d01, d10, d11 = 1.0, 0.0, 0.0, 1.0
    for k in range(world.wall_axis.size):
        normal_is_x = world.wall_axis[k] == 0
        if is_behind(i, j, k, world):
            un, ut = (u, v) if normal_is_x else (v, u)
            if world.wall_side[k] * un < 0.0:
                keep, slope = friction(un, ut, k, world)
                un, ut = 0.0, fused(slope, un, keep * ut)
                if normal_is_x:
                    d10, d11 = keep * d10 + slope * d00, keep * d11 + slope * d01
                    d00 = d01 = 0.0
                else:
                    d00, d01 = keep * d00 + slope * d10, keep * d01 + slope * d11
                    d10 = d11 = 0.0
            u, v = (un, ut) if normal_is_x else (ut, un)
    return d00 * u_bar + d10 * v_bar, d01 * u_bar + d11 * v_bar


@jit
def is_behind(i, j, k, world):
    """Whether node (i, j) is strictly behind wall k."""
    node = i if world.wall_axis[k] == 0 else j
    return world.wall_side[k] * (world.wall_node[k] - node) > 0


@jit
def friction(un, ut, k, world):
    """What an approaching node's tangential velocity becomes at wall k: keep ut + slope un."""
    coefficient = world.wall_friction[k]
    if abs(ut) < coefficient * abs(un):  # without friction nothing sticks, at rest either
        return 0.0, 0.0
    return 1.0, np.sign(ut) * coefficient * world.wall_side[k]


@jit
def add_blocks(parts, sheet, windows, window, a, nodes):
    """Column a of the window: the sum of what the blocks put there, in their order."""
    i0, j0, _, nj = window
    for k in range(a * nj, (a + 1) * nj):
        store(nodes, k, nothing(nodes))
    for b in range(parts.shape[0]):
        column = i0 + a - windows[b, 0]
        if 0 <= column < windows[b, 2]:
            source, target = column * windows[b, 3], a * nj + windows[b, 1] - j0
            for k in range(windows[b, 3]):
                add(nodes, target + k, load(parts[b, sheet], source + k))


@jit
def free_velocity(grid, node, per_m, world):
    """Velocity of a node from momentum, 1 / mass and gravity, before the walls."""
    return (
        fused(grid[0, node, 0], per_m, world.dt * world.gravity_x),
        fused(grid[0, node, 1], per_m, world.dt * world.gravity_y),
    )


@jit
def grid_update(grid, window, world, velocity, a):
    """Velocity of column a's nodes from momentum, gravity and walls; zero where no mass is."""
    i0, j0, _, nj = window
    for b in range(nj):
        node = a * nj + b
        m = grid[0, node, 2]
        u = v = 0.0 * m
        if m.real > world.dust:
            u, v = free_velocity(grid, node, 1.0 / m, world)
            u, v = wall(i0 + a, j0 + b, u, v, world)
        velocity[0, 2 * node], velocity[0, 2 * node + 1] = u, v
        if world.keep > 0.0:
            u = v = 0.0 * m
            if m.real > world.dust:
                per_m = 1.0 / grid[1, node, 2]
                u, v = grid[1, node, 0] * per_m, grid[1, node, 1] * per_m
            velocity[1, 2 * node], velocity[1, 2 * node + 1] = u, v


@jit
def grid_update_adjoint(grid, window, world, velocity_bar, node_bar, a):
    """From velocity_bar of column a's nodes to their momentum_bar and mass_bar."""
    i0, j0, _, nj = window
    for b in range(nj):
        node = a * nj + b
        m = grid[0, node, 2]
        if m > world.dust:
            per_m = 1.0 / m
            u, v = grid[0, node, 0] * per_m, grid[0, node, 1] * per_m
            u_bar, v_bar = wall_adjoint(
                i0 + a,
                j0 + b,
                *free_velocity(grid, node, per_m, world),
                world,
                velocity_bar[0, 2 * node],
                velocity_bar[0, 2 * node + 1],
            )
            momentum_bar(node_bar[0], node, u, v, per_m, u_bar, v_bar)
            if world.keep > 0.0:
                per_m = 1.0 / grid[1, node, 2]
                u, v = grid[1, node, 0] * per_m, grid[1, node, 1] * per_m
                u_bar, v_bar = velocity_bar[1, 2 * node], velocity_bar[1, 2 * node + 1]
                momentum_bar(node_bar[1], node, u, v, per_m, u_bar, v_bar)
        else:
            node_bar[:, node] = 0.0


@jit
def momentum_bar(node_bar, node, u, v, per_m, u_bar, v_bar):
    """Adjoint of a velocity (u, v) = q / m, into a node's record."""
    node_bar[node, 0] = u_bar * per_m
    node_bar[node, 1] = v_bar * per_m
    node_bar[node, 2] = -fused(v_bar, v, u_bar * u) * per_m


@jit
def g2p(old, new, world, tile, cells, first, last):
    """Grid to particle: the new velocity, affine velocity and position."""
    dt, per_dx = world.dt, 4.0 / world.dx
    for g in range(first, last):
        t = g - first
        for k in range(4):
            mean, along_x, along_y = moments(cells, tile, t, k)
            set_number(new, 12 * g + 2, k, mean[0])
            set_number(new, 12 * g + 3, k, mean[1])
            set_number(new, 12 * g + 4, k, along_x[0])
            set_number(new, 12 * g + 5, k, along_y[0])
            set_number(new, 12 * g + 6, k, along_x[1])
            set_number(new, 12 * g + 7, k, along_y[1])
        store(new, 12 * g, load(old, 12 * g) + dt * load(new, 12 * g + 2))
        store(new, 12 * g + 1, load(old, 12 * g + 1) + dt * load(new, 12 * g + 3))
        c00, c01, c10, c11 = tensor(new, 12 * g + 4)
        store_tensor(new, 12 * g + 4, per_dx * c00, per_dx * c01, per_dx * c10, per_dx * c11)


@jit
def g2p_adjoint(world, tile, cells, cells_bar, bar, first, last):
    """From x_bar', v_bar', C_bar' to velocity_bar, as moments of cells, and to x_bar, v_bar, C_bar.

    Without a blend v_bar and C_bar are zero here: what follows adds to them.
    """
    dt, per_dx = world.dt, world.per_dx
    c, h = 4.0 * per_dx, tile.gathered
    for g in range(first, last):
        t = g - first
        none = nothing(bar)
        for axis in range(2):
            v_bar = load(bar, 12 * g + 2 + axis)
            store(h, 9 * t + axis, v_bar + dt * load(bar, 12 * g + axis))
            store(bar, 12 * g + 2 + axis, world.keep * v_bar)
        c00, c01, c10, c11 = tensor(bar, 12 * g + 4)
        store_tensor(h, 9 * t + 2, c * c00, c * c01, c * c10, c * c11)
        store_tensor(bar, 12 * g + 4, none, none, none, none)
        for k in range(4):
            v_bar = pair(number(h, 9 * t, k), number(h, 9 * t + 1, k))
            c0 = pair(number(h, 9 * t + 2, k), number(h, 9 * t + 4, k))
            c1 = pair(number(h, 9 * t + 3, k), number(h, 9 * t + 5, k))
            slope_x, slope_y = slopes(cells, tile, t, k, v_bar, c0, c1)
            deposit(cells_bar, tile, t, k, v_bar, c0, c1)
            set_number(bar, 12 * g, k, number(bar, 12 * g, k) + per_dx * total(slope_x))
            set_number(bar, 12 * g + 1, k, number(bar, 12 * g + 1, k) + per_dx * total(slope_y))


@jit
def blend(old, new, world, tile, cells, first, last):
    """Particles keep a share of what the transfer of their own velocity smoothed away."""
    for g in range(first, last):
        t = g - first
        for k in range(4):
            mean, _, _ = moments(cells, tile, t, k)
            set_number(tile.gathered, 9 * t, k, mean[0])
            set_number(tile.gathered, 9 * t + 1, k, mean[1])
        for axis in range(2):
            lost = load(old, 12 * g + 2 + axis) - load(tile.gathered, 9 * t + axis)
            add(new, 12 * g + 2 + axis, world.keep * lost)


@jit
def blend_adjoint(world, tile, cells, cells_bar, bar, first, last):
    """To velocity_bar of the second sheet, as moments of cells; adds to x_bar.

    After `g2p_adjoint`, which leaves keep v_bar' as v_bar.
    """
    per_dx = world.per_dx
    for g in range(first, last):
        t = g - first
        for k in range(4):
            v_bar = pair(-number(bar, 12 * g + 2, k), -number(bar, 12 * g + 3, k))
            none = nothing(cells)
            slope_x, slope_y = slopes(cells, tile, t, k, v_bar, none, none)
            deposit(cells_bar, tile, t, k, v_bar, none, none)
            set_number(bar, 12 * g, k, number(bar, 12 * g, k) + per_dx * total(slope_x))
            set_number(bar, 12 * g + 1, k, number(bar, 12 * g + 1, k) + per_dx * total(slope_y))


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
    node_cells, velocity_cells = make_cells(scratch)
    sheets = len(scratch.velocity)
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
                if ni * nj > parts.shape[2]:
                    ends[k, 0] = PART_TOO_SMALL
                else:
                    part = (i0, j0, ni, nj)
                    for sheet in range(sheets):
                        clear(node_cells[sheet], part)
                    for g0 in range(p0, p1, TILE):
                        g1 = min(g0 + TILE, p1)
                        if not deform(old, new, world, log_J, g0, g1):
                            ends[k, 0], ends[k, 1] = INVERTED, first_inverted(new, g0, g1)
                            break
                        locate(old, world, part, tile, g0, g1)
                        for sheet in range(sheets):
                            if sheet == 0:
                                stress(old, new, log_J, body, world, signal[n], tile, g0, g1)
                            else:
                                inertia(old, body, world, tile, g0, g1)
                            p2g(old, body, tile, node_cells[sheet], g0, g1)
                    for sheet in range(sheets):
                        taylor_adjoint(node_cells[sheet], part, parts[k, sheet])
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
        if ni * nj > grid.shape[1]:
            return n, WINDOW_TOO_SMALL, -1
        columns = range(thread * ni // threads, (thread + 1) * ni // threads)
        for sheet in range(sheets):
            for a in columns:
                add_blocks(parts, sheet, windows[slot], window, a, grid[sheet])
        if world.mirror_axis >= 0:
            if not meet(meeting, threads):
                return n, ABANDONED, -1
            if thread == 0:
                for sheet in range(sheets):
                    mirror(grid[sheet], window, world)
            if not meet(meeting, threads):
                return n, ABANDONED, -1
        for a in columns:
            grid_update(grid, window, world, scratch.velocity, a)
        if not meet(meeting, threads):
            return n, ABANDONED, -1
        for k in own:
            w = windows[slot, k]
            part = (w[0], w[1], w[2], w[3])
            for sheet in range(sheets):
                taylor(scratch.velocity[sheet], window, part, velocity_cells[sheet])
            for g0 in range(body.first[k], body.first[k + 1], TILE):
                g1 = min(g0 + TILE, body.first[k + 1])
                locate(old, world, part, tile, g0, g1)
                g2p(old, new, world, tile, velocity_cells[0], g0, g1)
                if sheets == 2:
                    blend(old, new, world, tile, velocity_cells[1], g0, g1)
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
    parts_bar, velocity, velocity_bar = scratch.parts_bar, scratch.velocity, scratch.velocity_bar
    tile = make_tile(TILE, states)
    node_cells, velocity_cells = make_cells(scratch)
    _, velocity_cells_bar = make_cells(scratch)
    sheets = len(velocity)
    for n in range(last - 1, first - 1, -1):
        old, new, grid, log_J = states[n], states[n + 1], grids[n], logs[n]
        w = windows[n, blocks]
        ni, window = w[2], (w[0], w[1], w[2], w[3])
        columns = range(thread * ni // threads, (thread + 1) * ni // threads)
        for a in columns:
            grid_update(grid, window, world, velocity, a)
        if not meet(meeting, threads):
            return
        for k in own:
            p0, p1 = body.first[k], body.first[k + 1]
            w = windows[n, k]
            part = (w[0], w[1], w[2], w[3])
            for sheet in range(sheets):
                taylor(velocity[sheet], window, part, velocity_cells[sheet])
                clear(velocity_cells_bar[sheet], part)
            for g0 in range(p0, p1, TILE):
                g1 = min(g0 + TILE, p1)
                locate(old, world, part, tile, g0, g1)
                g2p_adjoint(
                    world, tile, velocity_cells[0], velocity_cells_bar[0], bar, g0, g1
                )  # fmt: skip
                if sheets == 2:
                    blend_adjoint(
                        world, tile, velocity_cells[1], velocity_cells_bar[1], bar, g0, g1
                    )  # fmt: skip
            for sheet in range(sheets):
                taylor_adjoint(velocity_cells_bar[sheet], part, parts_bar[k, sheet])
        if not meet(meeting, threads):
            return
        for a in columns:
            for sheet in range(sheets):
                add_blocks(parts_bar, sheet, windows[n], window, a, velocity_bar[sheet])
            grid_update_adjoint(grid, window, world, velocity_bar, scratch.node_bar, a)
        if not meet(meeting, threads):
            return
        if world.mirror_axis >= 0:
            if thread == 0:
                for sheet in range(sheets):
                    mirror(scratch.node_bar[sheet], window, world)
            if not meet(meeting, threads):
                return
        for k in own:
            p0, p1 = body.first[k], body.first[k + 1]
            w = windows[n, k]
            part = (w[0], w[1], w[2], w[3])
            for sheet in range(sheets):
                taylor(scratch.node_bar[sheet], window, part, node_cells[sheet])
            for g0 in range(p0, p1, TILE):
                g1 = min(g0 + TILE, p1)
                locate(old, world, part, tile, g0, g1)
                for sheet in range(sheets):
                    if sheet == 0:
                        stress(old, new, log_J, body, world, signal[n], tile, g0, g1)
                    else:
                        inertia(old, body, world, tile, g0, g1)
                    p2g_adjoint(old, body, world, tile, node_cells[sheet], bar, body_bar, g0, g1)
                    if sheet == 0:
                        stress_adjoint(
                            old, new, log_J, body, world, signal[n], tile, bar, body_bar,
                            signal_bar[k, n], g0, g1,
                        )  # fmt: skip
                    else:
                        inertia_adjoint(old, body, tile, bar, body_bar, g0, g1)
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
    per_dx, end_x, end_y = world.per_dx, world.nodes_x - 2.0, world.nodes_y - 2.0
    for p in range(4 * first, 4 * last):
        x = cell_coordinate(state[12 * (p // 4), p % 4].real, per_dx)
        y = cell_coordinate(state[12 * (p // 4) + 1, p % 4].real, per_dx)
        if not (0.0 <= x < end_x and 0.0 <= y < end_y):
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
    return filled[:, :particles].copy()


# Records of four numbers, of a node or one number of four particles in a row, and pairs. These
# functions on numpy arrays are their definition; compiled, they are vector registers.


def load(array, k):
    """Record k of an array (M, 4), or pair k of a flat array."""
    return array[k].copy() if array.ndim == 2 else array[2 * k : 2 * k + 2].copy()


def nothing(array):
    """The zeros of what `load` reads from such an array."""
    return np.zeros(4 if array.ndim == 2 else 2, array.dtype)


def store(array, k, record):
    """Write what `load` reads."""
    if array.ndim == 2:
        array[k] = record
    else:
        array[2 * k : 2 * k + 2] = record


def number(array, k, lane):
    """One number of record k of an array (M, 4)."""
    return array[k, lane]


def set_number(array, k, lane, value):
    """Write what `number` reads."""
    array[k, lane] = value


def pack(a, b, c, d):
    """The record of four numbers."""
    return np.array([a, b, c, d])


def pair(a, b):
    """The pair of two numbers."""
    return np.array([a, b])


def total(x):
    """The sum of the numbers of a record or pair."""
    return x.sum()


def positive(x):
    """Whether the real parts of a record are all above zero; what is not a number is not."""
    return bool(np.all(np.real(x) > 0.0))


def logarithm(x):
    """The natural logarithms of a record of positive numbers."""
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.log(x)


def cell_coordinate(x, per_dx):
    """A coordinate in cells from the middle of the first one; its whole part is the first node.

    What decides, here and in `fused`, is rounded alike wherever it stands, forward and adjoint: no
    compiler may contract it into what is around it.
    """
    return per_dx * x - 0.5


def fused(a, b, c):
    """Number a b + c, whose real part is rounded once."""
    return a * b + c


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
    """Add to what `load` reads."""
    store(array, k, load(array, k) + record)


class Register(types.Type):
    """A record or a pair in a vector register; a complex number takes two of its places."""

    def __init__(self, dtype, lanes):
        self.dtype, self.lanes = dtype, lanes
        super().__init__(f"Register({dtype}, {lanes})")


@register_model(Register)
class RegisterModel(models.PrimitiveModel):
    """As a vector of LLVM."""

    def __init__(self, manager, kind):
        super().__init__(manager, kind, _vector(kind))


FLAGS = ("contract", "reassoc", "nsz", "arcp")
INT32 = ir.IntType(32)


def _vector(kind):
    """LLVM's type of a register."""
    number = ir.FloatType() if kind.dtype == types.float32 else ir.DoubleType()
    return ir.VectorType(number, kind.lanes * (2 if kind.dtype == types.complex128 else 1))


def _register(array):
    """What `load` reads from an array."""
    return Register(array.dtype, 4 if array.ndim == 2 else 2)


def _shuffle(builder, x, y, lanes):
    mask = ir.Constant(ir.VectorType(INT32, len(lanes)), lanes)
    return builder.shuffle_vector(x, y, mask)


def _parts(context, builder, dtype, value):
    """A number, or the parts of a complex one."""
    if dtype != types.complex128:
        return [value]
    value = context.make_complex(builder, dtype, value)
    return [value.real, value.imag]


def _filled(context, builder, kind, values):
    """The register of some numbers of its type."""
    vector = ir.Constant(_vector(kind), ir.Undefined)
    parts = [part for value in values for part in _parts(context, builder, kind.dtype, value)]
    for lane, value in enumerate(parts):
        vector = builder.insert_element(vector, value, INT32(lane))
    return vector


def _spread_out(context, builder, kind, value):
    """The register of so many times the same number."""
    parts = _parts(context, builder, kind.dtype, value)
    vector = ir.Constant(_vector(kind), ir.Undefined)
    for lane, part in enumerate(parts):
        vector = builder.insert_element(vector, part, INT32(lane))
    return _shuffle(builder, vector, vector, list(range(len(parts))) * kind.lanes)


def _pointer(context, builder, array_type, array, k, vector, lane=None):
    """To what `load` reads, or to one of its numbers; the compiler need not look up strides."""
    array = context.make_array(array_type)(context, builder, array)
    place = builder.mul(k, k.type(_register(array_type).lanes))
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
    kind = _register(array)

    def generate(context, builder, signature, arguments):
        pointer = _pointer(context, builder, array, *arguments, _vector(kind))
        return builder.load(pointer, align=4)

    return kind(array, types.intp), generate


@intrinsic
def _nothing(typingctx, array):
    kind = _register(array)

    def generate(context, builder, signature, arguments):
        return ir.Constant(_vector(kind), None)

    return kind(array), generate


@intrinsic
def _store(typingctx, array, k, record):
    kind = _register(array)

    def generate(context, builder, signature, arguments):
        pointer = _pointer(context, builder, array, *arguments[:2], _vector(kind))
        builder.store(arguments[2], pointer, align=4)
        return context.get_dummy_value()

    return types.none(array, types.intp, kind), generate


@intrinsic
def _pack(typingctx, numbers):
    dtype = types.complex128 if types.complex128 in numbers.types else numbers.types[0]
    kind = Register(dtype, len(numbers))

    def generate(context, builder, signature, arguments):
        values = cgutils.unpack_tuple(builder, arguments[0])
        values = [
            context.cast(builder, v, of, dtype) for v, of in zip(values, numbers.types, strict=True)
        ]
        return _filled(context, builder, kind, values)

    return kind(numbers), generate


@intrinsic
def _as(typingctx, x, like):
    """A number or register as a register that can be combined with another one, or a number."""
    kind = x if isinstance(x, Register) else like
    if types.complex128 in (getattr(x, "dtype", x), getattr(like, "dtype", like)):
        kind = Register(types.complex128, kind.lanes)

    def generate(context, builder, signature, arguments):
        value = arguments[0]
        if not isinstance(x, Register):
            value = context.cast(builder, value, x, kind.dtype)
            return _spread_out(context, builder, kind, value)
        if x == kind:
            return value
        zeros = ir.Constant(_vector(x), None)
        lanes = [lane for k in range(x.lanes) for lane in (k, x.lanes + k)]
        return _shuffle(builder, value, zeros, lanes)

    return kind(x, like), generate


def _real_parts(builder, record, vector):
    if record.dtype != types.complex128:
        return vector
    return _shuffle(builder, vector, vector, list(range(0, 2 * record.lanes, 2)))


def _all(builder, lanes):
    return functools.reduce(
        builder.and_, [builder.extract_element(lanes, INT32(k)) for k in range(4)]
    )


@intrinsic
def _real(typingctx, x):
    dtype = types.float64 if x.dtype == types.complex128 else x.dtype

    def generate(context, builder, signature, arguments):
        return _real_parts(builder, x, arguments[0])

    return Register(dtype, x.lanes)(x), generate


@intrinsic
def _whole(typingctx, x):
    def generate(context, builder, signature, arguments):
        vector = _vector(x)
        name = f"llvm.trunc.v4f{32 if x.dtype == types.float32 else 64}"
        kind = ir.FunctionType(vector, [vector])
        function = cgutils.get_or_insert_function(builder.module, kind, name)
        return builder.call(function, arguments)

    return x(x), generate


@intrinsic
def _cell_coordinate(typingctx, x, per_dx):
    def generate(context, builder, signature, arguments):
        kind = arguments[0].type
        half = ir.Constant(kind, x.lanes * [0.5] if isinstance(x, Register) else 0.5)
        per_dx_ = arguments[1] if per_dx == x else context.cast(builder, arguments[1], per_dx, x)
        # Having a flag, these get none of the options', which would let them be contracted.
        cells = builder.fmul(arguments[0], per_dx_, flags=("nsz",))
        return builder.fsub(cells, half, flags=("nsz",))

    return x(x, per_dx), generate


@intrinsic
def _fused(typingctx, a, b, c):
    kind = types.float64 if types.float64 in (a, b, c) else a

    def generate(context, builder, signature, arguments):
        numbers = zip(arguments, signature.args, strict=True)
        return builder.fma(*(context.cast(builder, value, of, kind) for value, of in numbers))

    return kind(a, b, c), generate


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


def _arithmetic(name):
    @intrinsic
    def operate(typingctx, x, y):
        def generate(context, builder, signature, arguments):
            a, b = arguments
            if x.dtype != types.complex128 or name in ("fadd", "fsub"):
                return getattr(builder, name)(a, b, flags=FLAGS)
            # (a.re + i a.im) b = a.re b + a.im (i b)
            re, im, turn = ([2 * k + place for k in range(x.lanes) for place in pair] for pair in (
                (0, 0), (1, 1), (1, 0)
            ))  # fmt: skip
            turned = _shuffle(builder, b, b, turn)
            signs = ir.Constant(_vector(x), x.lanes * [-1.0, 1.0])
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
        if isinstance(x, Register) or isinstance(y, Register):
            return lambda x, y: operate(_as(x, y), _as(y, x))


for _symbol, _name in (
    (operator.add, "fadd"),
    (operator.sub, "fsub"),
    (operator.mul, "fmul"),
):
    _overload_arithmetic(_symbol, _name)


@intrinsic
def _divide(typingctx, x, y):
    def generate(context, builder, signature, arguments):
        return builder.fdiv(*arguments, flags=FLAGS)

    return x(x, x), generate


@overload(operator.truediv)
def _overload_divide(x, y):
    if isinstance(x, Register) and types.complex128 not in (x.dtype, getattr(y, "dtype", y)):
        return lambda x, y: _divide(x, _as(y, x))


@intrinsic
def _lane(typingctx, record, k):
    def generate(context, builder, signature, arguments):
        lane = builder.trunc(arguments[1], INT32)
        if record.dtype != types.complex128:
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
        zeros = ir.Constant(value.type, None)
        return _all(builder, builder.fcmp_ordered(">", value, zeros))

    return types.boolean(record), generate


@intrinsic
def _exponent_and_fraction(typingctx, record):
    """x = 2^k m with m from sqrt(1/2) to sqrt(2): the records of k and m."""
    result = types.UniTuple(record, 2)
    single = record.dtype == types.float32
    width, fraction, bias = (32, 23, 127) if single else (64, 52, 1023)
    numbers = np.float32 if single else np.float64

    def generate(context, builder, signature, arguments):
        integers = ir.VectorType(ir.IntType(width), 4)

        def constant(value):
            return ir.Constant(integers, 4 * [value])

        def bits_of(number):
            return int(numbers(number).view(np.int32 if single else np.int64))

        bits = builder.bitcast(arguments[0], integers)
        shifted = builder.add(bits, constant(bits_of(1.0) - bits_of(0.5**0.5)))
        exponent = builder.lshr(shifted, constant(fraction))
        power = builder.shl(exponent, constant(fraction))
        m = builder.sub(builder.add(bits, constant(bits_of(1.0))), power)
        short = ir.VectorType(INT32, 4)  # processors convert no longer integers in a register
        k = exponent if single else builder.trunc(exponent, short)
        k = builder.sitofp(builder.sub(k, ir.Constant(short, 4 * [bias])), _vector(record))
        return context.make_tuple(builder, result, [k, builder.bitcast(m, _vector(record))])

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


@overload(nothing)
def _overload_nothing(array):
    return lambda array: _nothing(array)


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
    return lambda a, b: _pack((a, b))


@overload(pack)
def _overload_pack(a, b, c, d):
    return lambda a, b, c, d: _pack((a, b, c, d))


@overload(total)
def _overload_total(x):
    if x.lanes == 2:
        return lambda x: x[0] + x[1]
    return lambda x: (x[0] + x[1]) + (x[2] + x[3])


@overload(real)
def _overload_real(x):
    return lambda x: _real(x)


@overload(whole)
def _overload_whole(x):
    return lambda x: _whole(x)


@overload(cell_coordinate)
def _overload_cell_coordinate(x, per_dx):
    if isinstance(x, Register):
        return lambda x, per_dx: _cell_coordinate(x, _as(per_dx, x))
    return lambda x, per_dx: _cell_coordinate(x, per_dx)


@overload(fused)
def _overload_fused(a, b, c):
    if types.complex128 in (a, b, c):
        return lambda a, b, c: complex(_fused(a.real, b.real, c.real), (a * b + c).imag)
    return lambda a, b, c: _fused(a, b, c)


@overload(within)
def _overload_within(x, low, high):
    return lambda x, low, high: _within(x, _as(low, x), _as(high, x))


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
    if x.dtype != types.complex128:
        return lambda x: _log(x)
    return lambda x: _pack((np.log(x[0]), np.log(x[1]), np.log(x[2]), np.log(x[3])))


def _place(context, builder, array_type, array, k):
    """To number k of a flat array."""
    return builder.gep(context.make_array(array_type)(context, builder, array).data, [k])


@intrinsic
def _atomic_add(typingctx, array, k, amount):
    def generate(context, builder, signature, arguments):
        pointer = _place(context, builder, array, *arguments[:2])
        return builder.atomic_rmw("add", pointer, arguments[2], "seq_cst")

    return types.int64(array, types.intp, types.int64), generate


@intrinsic
def _atomic_load(typingctx, array, k):
    def generate(context, builder, signature, arguments):
        pointer = _place(context, builder, array, *arguments)
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
