"""Total Lagrangian steps: a body on the lattice of its own reference configuration.

Nodes are control points of quadratic B-splines, of which the cells are the spans; particles are
quadrature points at fixed places in their cells, n x n in each. A step goes along the rows of
cells, four neighbours at a time: of each cell the same particle. Sums over the nine nodes of a cell
are taken across the row first, then along it.

A row of nodes has `width` numbers, one for each node and some that stand for none. Node i of row j
has number j width + i; the nodes of cell (i, j) are (i, j) to (i + 2, j + 2). The state (4, M) of
the nodes are their x_x, x_y, v_x, v_y.
"""

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import DTypeLike, NDArray

from mpmopt.kernels.actuation import second_piola
from mpmopt.kernels.arrays import DEFORMATION, POSITION, STATE_SIZE, VELOCITY
from mpmopt.kernels.compiler import bare_jit, bare_loop_jit, inner_jit, loop_jit
from mpmopt.kernels.ground import (
    CREEPING,
    DAMPING,
    FRICTION,
    STIFFNESS,
    THICKNESS,
    distance,
    distance_adjoint,
)
from mpmopt.kernels.layer import mean_bearing, mean_bearing_adjoint, resistance, resistance_adjoint
from mpmopt.kernels.material import solid_constants
from mpmopt.kernels.pairs import nowhere, push_apart, push_apart_adjoint, renewed
from mpmopt.kernels.simd import (
    above,
    add,
    add_four,
    chosen,
    four,
    greatest,
    load,
    logarithm,
    nothing,
    put_four,
    real,
    reciprocal,
    total,
    within,
)

# Below this J the logarithm goes on as its Taylor polynomial of order two, so that void may invert.
LEAST_J = 0.25
# Zeros before and after a row of stresses, which nodes beside its cells take their share of.
MARGIN = 4
# Cells are asked anew whether they are near a layer when a node may have moved so many cells.
SKIN = 1.0


class Lattice(NamedTuple):
    """A body on its reference lattice: B rows of cells, A groups of four in each.

    A group has n x n records of particles, one of each of its cells: V in all, of which
    ((j n + b) n + a) A + g is that of group g of row j, a-th along x and b-th along y.
    """

    dt: float
    dx: float
    gravity_x: float
    gravity_y: float
    columns: int  # of cells, of which the last group may have less than four
    groups: int  # A
    rows: int  # B
    volume: float  # of a particle
    viscous: bool  # whether any viscosity is above zero
    mirror_axis: int  # of the mirror plane's normal, 0 or 1: it bounds the cells; -1: no mirror
    weights: NDArray[np.float64]  # (n, 6), as `weights` makes it
    constants: NDArray[np.float64]  # (P, V, 4) of the solid; or (P, 1, 4), where all are alike
    varied: int  # 1; or 0, where all are alike
    stiffness: NDArray  # (V, 4) share of the solid's, zero where no particle is
    filled: NDArray[np.bool_]  # (A B,) whether a group of cells has particles
    actuated: NDArray[np.float64]  # (K, V, 4) 1 for the particles of actuator k, else 0
    active: NDArray[np.bool_]  # (V,) whether a record has actuated particles
    actuation_stress: NDArray[np.float64]  # (K, 3) second Piola-Kirchhoff S: xx, xy, yy
    mass: NDArray  # (M,) of the nodes, lumped
    squared_influence: NDArray[np.float64]  # (M,) v_p^2 <= max_i of it times v_i^2
    held: NDArray[np.int64]  # (H,) nodes that clamps hold
    holder: NDArray[np.int64]  # (H,) which clamp each of them is in
    clamps: NDArray[np.float64]  # (steps, K, 6) as those of `kernels.arrays.Parameters`
    ground: Any  # `kernels.ground.Ground`
    nodes_y: int  # of the grid that the ground's table is for, and how many along x
    nodes_x: int
    touch: Any  # `kernels.pairs.Touch`; the last one: see `but_touch`


class LatticeBar(NamedTuple):
    """Adjoints of `Lattice`, accumulated over the steps."""

    stiffness: NDArray  # (V, 4)
    mass: NDArray  # (M,)
    grip: NDArray  # (C, n n) of `Touch`

    @classmethod
    def zeros(cls, lattice: Lattice, dtype: DTypeLike = float) -> "LatticeBar":
        """Nothing accumulated yet."""
        shapes = lattice.stiffness.shape, lattice.mass.shape, lattice.touch.grip.shape
        return cls(*(np.zeros(shape, dtype) for shape in shapes))


class Rows(NamedTuple):
    """What a step derives of one row of cells at a time: small, to stay in fast memory."""

    values: NDArray  # (fields, width) sums across the row, by the splines' values
    slopes: NDArray  # (fields, width) and by their slopes
    stress: NDArray  # (fields, 2, n, MARGIN + width) by x and y, of particles by place along x


@inner_jit
def but_touch(lattice):
    """A lattice without its last field: most kernels do not ask for it, and compile faster."""
    return Lattice(*lattice[:-1], 0)


@bare_jit
def width_of(lattice):
    """Numbers in a row of nodes: the last group's cells touch two nodes beyond it."""
    return 4 * lattice.groups + 4


@inner_jit
def make_rows(fields, stressed, lattice):
    """Room for a row of so many fields, and so many components that have stresses."""
    n, width, dtype = len(lattice.weights), width_of(lattice), lattice.stiffness.dtype
    return Rows(
        np.zeros((fields, width), dtype),
        np.zeros((fields, width), dtype),
        np.zeros((stressed, 2, n, MARGIN + width), dtype),
    )


@bare_jit
def across(nodes, first, b, scale, lattice, rows, field):
    """Sums of a field over the three rows of nodes of a row of cells, at b-th particles along y.

    `first` is the place of its first node in `nodes`; the sums are times a scale.
    """
    width, w = width_of(lattice), lattice.weights
    n0, n1, n2 = scale * w[b, 0], scale * w[b, 1], scale * w[b, 2]
    g0, g1, g2 = scale * w[b, 3], scale * w[b, 4], scale * w[b, 5]
    for i in range(0, width, 4):
        u0 = four(nodes, first + i)
        u1 = four(nodes, first + width + i)
        u2 = four(nodes, first + 2 * width + i)
        put_four(rows.values, field * width + i, n0 * u0 + n1 * u1 + n2 * u2)
        put_four(rows.slopes, field * width + i, g0 * u0 + g1 * u1 + g2 * u2)


@bare_jit
def along(sums, place, w0, w1, w2):
    """Sum over the three nodes along x of the cells of a group."""
    return w0 * four(sums, place) + w1 * four(sums, place + 1) + w2 * four(sums, place + 2)


@bare_jit
def gradient(rows, field, i, a, lattice):
    """Gradient (00, 01, 10, 11) of a vector field at a-th particles along x of cells from i on."""
    w, width = lattice.weights, width_of(lattice)
    n0, n1, n2, g0, g1, g2 = w[a, 0], w[a, 1], w[a, 2], w[a, 3], w[a, 4], w[a, 5]
    x, y = field * width + i, (field + 1) * width + i
    return (
        along(rows.values, x, g0, g1, g2),
        along(rows.slopes, x, n0, n1, n2),
        along(rows.values, y, g0, g1, g2),
        along(rows.slopes, y, n0, n1, n2),
    )


@bare_jit
def put_stress(rows, field, i, a, lattice, P):
    """Write what `gradient_adjoint` takes, of a-th particles along x of cells from i on."""
    n = len(lattice.weights)
    length = MARGIN + width_of(lattice)
    place = (2 * field * n + a) * length + MARGIN + i
    p00, p01, p10, p11 = P
    put_four(rows.stress, place, p00)
    put_four(rows.stress, place + n * length, p01)
    put_four(rows.stress, place + 2 * n * length, p10)
    put_four(rows.stress, place + 3 * n * length, p11)


@bare_jit
def put_load(rows, field, i, a, lattice, load):
    """Write what `value_adjoint` takes, of a-th particles along x of cells from i on."""
    n, length = len(lattice.weights), MARGIN + width_of(lattice)
    put_four(rows.stress, (2 * field * n + a) * length + MARGIN + i, load)


@bare_jit
def gradient_adjoint(rows, fields, b, scale, lattice, nodes, first):
    """Adds to the fields of nodes what `gradient` and `across` transposed give of the stresses.

    `first` is the place of the row's first node in `nodes`, of which each field has M.
    """
    width, w, n, M = width_of(lattice), lattice.weights, len(lattice.weights), len(lattice.mass)
    length = MARGIN + width
    n0, n1, n2 = scale * w[b, 0], scale * w[b, 1], scale * w[b, 2]
    g0, g1, g2 = scale * w[b, 3], scale * w[b, 4], scale * w[b, 5]
    for field in range(fields):
        for i in range(0, width, 4):
            x = 2 * field * n * length + MARGIN + i
            by_value = by_slope = nothing(rows.values)
            for a in range(n):
                y = x + n * length
                by_value = by_value + along(rows.stress, x - 2, w[a, 5], w[a, 4], w[a, 3])
                by_slope = by_slope + along(rows.stress, y - 2, w[a, 2], w[a, 1], w[a, 0])
                x += length
            node = field * M + first + i
            add_four(nodes, node, n0 * by_value + g0 * by_slope)
            add_four(nodes, node + width, n1 * by_value + g1 * by_slope)
            add_four(nodes, node + 2 * width, n2 * by_value + g2 * by_slope)


@bare_jit
def continued(J):
    """ln J and its first and second derivative, continued below `LEAST_J`."""
    inside = above(J, LEAST_J)
    safe = chosen(inside, J, 0.0 * J + LEAST_J)
    slope = reciprocal(safe)
    off = J - safe  # zero inside
    log = logarithm(safe)
    bend = slope * slope
    return log + off * slope - 0.5 * off * off * bend, slope - off * bend, 0.0 * J - bend


@bare_jit
def solid_stress(F, rate, constants, viscous):
    """First Piola-Kirchhoff stress P of the solid at F and its rate of change (00, 01, 10, 11).

    P = mu F + (lambda ln J - mu) (ln J)' cof F + eta F sym(F^T dF/dt).
    """
    f00, f01, f10, f11 = F
    d00, d01, d10, d11 = rate
    lam, mu, eta = constants
    log_J, slope, _ = continued(f00 * f11 - f01 * f10)
    h = (lam * log_J - mu) * slope
    p00, p01 = mu * f00 + h * f11, mu * f01 - h * f10
    p10, p11 = mu * f10 - h * f01, mu * f11 + h * f00
    if viscous:
        e00, e11 = eta * (f00 * d00 + f10 * d10), eta * (f01 * d01 + f11 * d11)
        e01 = 0.5 * eta * (f00 * d01 + f10 * d11 + f01 * d00 + f11 * d10)
        p00, p01 = p00 + f00 * e00 + f01 * e01, p01 + f00 * e01 + f01 * e11
        p10, p11 = p10 + f10 * e00 + f11 * e01, p11 + f10 * e01 + f11 * e11
    return p00, p01, p10, p11


@bare_jit
def solid_stress_adjoint(F, rate, constants, viscous, P_bar):
    """F_bar and the adjoint of the rate from P_bar: the transpose of `solid_stress`."""
    f00, f01, f10, f11 = F
    d00, d01, d10, d11 = rate
    q00, q01, q10, q11 = P_bar
    lam, mu, eta = constants
    log_J, slope, bend = continued(f00 * f11 - f01 * f10)
    free = lam * log_J - mu
    h = free * slope
    h_bar = q00 * f11 - q01 * f10 - q10 * f01 + q11 * f00
    J_bar = h_bar * (lam * slope * slope + free * bend)
    b00, b01 = mu * q00 + h * q11 + J_bar * f11, mu * q01 - h * q10 - J_bar * f10
    b10, b11 = mu * q10 - h * q01 - J_bar * f01, mu * q11 + h * q00 + J_bar * f00
    r00 = r01 = r10 = r11 = 0.0 * q00
    if viscous:
        e00, e11 = eta * (f00 * d00 + f10 * d10), eta * (f01 * d01 + f11 * d11)
        e01 = 0.5 * eta * (f00 * d01 + f10 * d11 + f01 * d00 + f11 * d10)
        b00, b01 = b00 + q00 * e00 + q01 * e01, b01 + q00 * e01 + q01 * e11
        b10, b11 = b10 + q10 * e00 + q11 * e01, b11 + q10 * e01 + q11 * e11
        # M = eta sym(F^T P_bar)
        m00, m11 = eta * (f00 * q00 + f10 * q10), eta * (f01 * q01 + f11 * q11)
        m01 = 0.5 * eta * (f00 * q01 + f10 * q11 + f01 * q00 + f11 * q10)
        b00, b01 = b00 + d00 * m00 + d01 * m01, b01 + d00 * m01 + d01 * m11
        b10, b11 = b10 + d10 * m00 + d11 * m01, b11 + d10 * m01 + d11 * m11
        r00, r01 = f00 * m00 + f01 * m01, f00 * m01 + f01 * m11
        r10, r11 = f10 * m00 + f11 * m01, f10 * m01 + f11 * m11
    return (b00, b01, b10, b11), (r00, r01, r10, r11)


@bare_jit
def stress(rows, r, i, a, lattice, signal):
    """First Piola-Kirchhoff stress P of record r: a-th particles along x of cells from i on."""
    F = gradient(rows, 0, i, a, lattice)
    rate = F  # which nothing asks for
    if lattice.viscous:
        rate = gradient(rows, 2, i, a, lattice)
    constants = solid_constants(lattice, lattice.varied * r)
    p00, p01, p10, p11 = solid_stress(F, rate, constants, lattice.viscous)
    k = load(lattice.stiffness, r)
    p00, p01, p10, p11 = k * p00, k * p01, k * p10, k * p11
    if lattice.active[r]:
        f00, f01, f10, f11 = F
        s00, s01, s11 = second_piola(lattice, r, signal)
        p00, p01 = p00 + f00 * s00 + f01 * s01, p01 + f00 * s01 + f01 * s11
        p10, p11 = p10 + f10 * s00 + f11 * s01, p11 + f10 * s01 + f11 * s11
    return p00, p01, p10, p11


@bare_jit
def stress_adjoint(rows, r, i, a, lattice, signal, bar, signal_bar):
    """F_bar and the adjoint of its rate from P_bar, the gradient of the rows' fields 4 and 5.

    Adds to the adjoints of stiffness and signal.
    """
    F = gradient(rows, 0, i, a, lattice)
    rate = F
    if lattice.viscous:
        rate = gradient(rows, 2, i, a, lattice)
    q00, q01, q10, q11 = gradient(rows, 4, i, a, lattice)
    constants = solid_constants(lattice, lattice.varied * r)
    p00, p01, p10, p11 = solid_stress(F, rate, constants, lattice.viscous)
    add(bar.stiffness, r, q00 * p00 + q01 * p01 + q10 * p10 + q11 * p11)
    k = load(lattice.stiffness, r)
    P_bar = k * q00, k * q01, k * q10, k * q11
    F_bar, rate_bar = solid_stress_adjoint(F, rate, constants, lattice.viscous, P_bar)
    if lattice.active[r]:
        f00, f01, f10, f11 = F
        b00, b01, b10, b11 = F_bar
        s00, s01, s11 = second_piola(lattice, r, signal)
        b00, b01 = b00 + q00 * s00 + q01 * s01, b01 + q00 * s01 + q01 * s11
        b10, b11 = b10 + q10 * s00 + q11 * s01, b11 + q10 * s01 + q11 * s11
        F_bar = b00, b01, b10, b11
        m00, m11 = f00 * q00 + f10 * q10, f01 * q01 + f11 * q11
        m01 = f00 * q01 + f10 * q11 + f01 * q00 + f11 * q10
        for each in range(signal.size):
            S = lattice.actuation_stress[each]
            power = S[0] * m00 + S[1] * m01 + S[2] * m11
            signal_bar[each] += total(load(lattice.actuated[each], r) * power)
    return F_bar, rate_bar


@loop_jit
def particles(nodes: NDArray, lattice: Any, number: NDArray[np.int64], state: NDArray) -> None:
    """Fill in x, v and F of the particles, from the state (4, M) of the nodes.

    `number` (V, 4) tells which particle of `state`, records (12 G, 4) of groups of four, each of
    the lattice's is; -1: none.
    """
    lattice = but_touch(lattice)
    to_particles(nodes, lattice, number, make_rows(4, 3, lattice), state)


@bare_loop_jit
def to_particles(nodes, lattice, number, rows, state):
    """What `particles` does, in the room that it makes."""
    n, M, width = len(lattice.weights), len(lattice.mass), width_of(lattice)
    for j in range(lattice.rows):
        for b in range(n):
            for field in range(4):
                across(nodes, field * M + j * width, b, 1.0, lattice, rows, field)
            for a in range(n):
                for g in range(lattice.groups):
                    r = ((j * n + b) * n + a) * lattice.groups + g
                    f00, f01, f10, f11 = gradient(rows, 0, 4 * g, a, lattice)
                    x, y = value(rows, 0, 4 * g, a, lattice), value(rows, 1, 4 * g, a, lattice)
                    u, v = value(rows, 2, 4 * g, a, lattice), value(rows, 3, 4 * g, a, lattice)
                    for k in range(4):
                        p = number[r, k]
                        if p >= 0:
                            record, lane = STATE_SIZE * (p // 4), p % 4
                            state[record + POSITION, lane] = x[k]
                            state[record + POSITION + 1, lane] = y[k]
                            state[record + VELOCITY, lane] = u[k]
                            state[record + VELOCITY + 1, lane] = v[k]
                            state[record + DEFORMATION, lane] = f00[k]
                            state[record + DEFORMATION + 1, lane] = f01[k]
                            state[record + DEFORMATION + 2, lane] = f10[k]
                            state[record + DEFORMATION + 3, lane] = f11[k]


@bare_loop_jit
def forces(state, lattice, signal, rows, force):
    """Adds the internal force - sum V P G to the nodes' f_x and f_y."""
    n, M, width = len(lattice.weights), len(lattice.mass), width_of(lattice)
    none = nothing(rows.values)
    for j in range(lattice.rows):
        for b in range(n):
            for field in range(4 if lattice.viscous else 2):
                across(state, field * M + j * width, b, 1.0, lattice, rows, field)
            for a in range(n):
                for g in range(lattice.groups):
                    P = none, none, none, none
                    if lattice.filled[j * lattice.groups + g]:
                        r = ((j * n + b) * n + a) * lattice.groups + g
                        P = stress(rows, r, 4 * g, a, lattice, signal)
                    put_stress(rows, 0, 4 * g, a, lattice, P)
            gradient_adjoint(rows, 2, b, -lattice.volume, lattice, force, j * width)


@bare_loop_jit
def forces_adjoint(state, force_bar, lattice, signal, rows, state_bar, bar, signal_bar):
    """From f_bar: adds to x_bar and v_bar of the nodes, to adjoints of stiffness and signal."""
    n, M, width = len(lattice.weights), len(lattice.mass), width_of(lattice)
    none = nothing(rows.values)
    fields = 4 if lattice.viscous else 2
    for j in range(lattice.rows):
        for b in range(n):
            for field in range(fields):
                across(state, field * M + j * width, b, 1.0, lattice, rows, field)
            for field in range(2):
                first = field * M + j * width
                across(force_bar, first, b, -lattice.volume, lattice, rows, 4 + field)
            for a in range(n):
                for g in range(lattice.groups):
                    F_bar = rate_bar = none, none, none, none
                    if lattice.filled[j * lattice.groups + g]:
                        r = ((j * n + b) * n + a) * lattice.groups + g
                        F_bar, rate_bar = stress_adjoint(
                            rows, r, 4 * g, a, lattice, signal, bar, signal_bar
                        )
                    put_stress(rows, 0, 4 * g, a, lattice, F_bar)
                    put_stress(rows, 2, 4 * g, a, lattice, rate_bar)
            gradient_adjoint(rows, fields, b, 1.0, lattice, state_bar, j * width)


@bare_jit
def value(rows, field, i, a, lattice):
    """A field at a-th particles along x of cells from i on."""
    w = lattice.weights
    return along(rows.values, field * width_of(lattice) + i, w[a, 0], w[a, 1], w[a, 2])


@bare_jit
def value_adjoint(rows, fields, b, lattice, nodes, first):
    """Adds to the fields of nodes what `value` and `across` transposed give of the loads.

    `first` is the place of the row's first node in `nodes`, of which each field has M.
    """
    width, w, n, M = width_of(lattice), lattice.weights, len(lattice.weights), len(lattice.mass)
    length = MARGIN + width
    for field in range(fields):
        for i in range(0, width, 4):
            by_value = nothing(rows.values)
            for a in range(n):
                x = (2 * field * n + a) * length + MARGIN + i
                by_value = by_value + along(rows.stress, x - 2, w[a, 2], w[a, 1], w[a, 0])
            node = field * M + first + i
            add_four(nodes, node, w[b, 0] * by_value)
            add_four(nodes, node + width, w[b, 1] * by_value)
            add_four(nodes, node + 2 * width, w[b, 2] * by_value)


@bare_jit
def is_clear(x, y, lattice):
    """Whether a particle at (x, y) stays off the layers until it has moved by `SKIN` cells."""
    ground, reach = lattice.ground, SKIN * lattice.dx + 0.5 * math.sqrt(lattice.volume)
    i, j = math.floor(x / lattice.dx + 0.5), math.floor(y / lattice.dx + 0.5)
    known = 0 <= i < lattice.nodes_x and 0 <= j < lattice.nodes_y
    # No place is more than 0.71 cells from its node.
    if known and ground.clearance[i * lattice.nodes_y + j] > reach + 0.75 * lattice.dx:
        return True
    for m in range(len(ground.layers)):
        d, _, _, _ = distance(x, y, ground, m)
        if d <= ground.layers[m, THICKNESS] + reach:
            return False
    return True


@bare_loop_jit
def find_near(state, lattice, rows, near):
    """Which groups of cells (A B,) have a particle that the layers are near to."""
    n, M, width = len(lattice.weights), len(lattice.mass), width_of(lattice)
    near[:] = False
    for j in range(lattice.rows):
        for b in range(n):
            for field in range(2):
                across(state, field * M + j * width, b, 1.0, lattice, rows, field)
            for a in range(n):
                for g in range(lattice.groups):
                    group = j * lattice.groups + g
                    if lattice.filled[group] and not near[group]:
                        x = real(value(rows, 0, 4 * g, a, lattice))
                        y = real(value(rows, 1, 4 * g, a, lattice))
                        for k in range(4):
                            near[group] = near[group] or not is_clear(x[k], y[k], lattice)


@bare_jit
def is_near(near, j, lattice):
    """Whether a layer is near to a row of cells."""
    found = False
    for g in range(j * lattice.groups, (j + 1) * lattice.groups):
        found = found or near[g]
    return found


@bare_loop_jit
def press(state, lattice, near, rows, force):
    """Adds the layers' force b n and its size b to the nodes' f_x, f_y and f_N."""
    n, M, width = len(lattice.weights), len(lattice.mass), width_of(lattice)
    for j in range(lattice.rows):
        if is_near(near, j, lattice):
            for b in range(n):
                for field in range(2):
                    across(state, field * M + j * width, b, 1.0, lattice, rows, field)
                for a in range(n):
                    for g in range(lattice.groups):
                        for field in range(3):
                            put_load(rows, field, 4 * g, a, lattice, nothing(rows.values))
                        if near[j * lattice.groups + g]:
                            r = ((j * n + b) * n + a) * lattice.groups + g
                            bear(rows, r, 4 * g, a, lattice)
                value_adjoint(rows, 3, b, lattice, force, j * width)


@bare_jit
def bear(rows, r, i, a, lattice):
    """The loads b n_x, b n_y, b of record r: a-th particles along x of cells from i on."""
    layers, width = lattice.ground.layers, math.sqrt(lattice.volume)
    x, y = value(rows, 0, i, a, lattice), value(rows, 1, i, a, lattice)
    for k in range(4):
        capacity = lattice.volume * lattice.stiffness[r, k]
        if capacity.real > 0.0:
            for m in range(len(layers)):
                d, nx, ny, _ = distance(x[k], y[k], lattice.ground, m)
                thickness = layers[m, THICKNESS]
                if d.real < thickness + 0.5 * width:
                    size = mean_bearing(d, thickness, width, layers[m, STIFFNESS] * capacity)
                    at = MARGIN + i + k
                    rows.stress[0, 0, a, at] += size * nx
                    rows.stress[1, 0, a, at] += size * ny
                    rows.stress[2, 0, a, at] += size


@bare_loop_jit
def press_adjoint(state, force_bar, lattice, near, rows, state_bar, bar):
    """From the nodes' f_bar and f_N_bar: adds to x_bar and to stiffness_bar."""
    n, M, width = len(lattice.weights), len(lattice.mass), width_of(lattice)
    for j in range(lattice.rows):
        if is_near(near, j, lattice):
            for b in range(n):
                for field in range(2):
                    across(state, field * M + j * width, b, 1.0, lattice, rows, field)
                for field in range(3):
                    first = field * M + j * width
                    across(force_bar, first, b, 1.0, lattice, rows, 2 + field)
                for a in range(n):
                    for g in range(lattice.groups):
                        for field in range(2):
                            put_load(rows, field, 4 * g, a, lattice, nothing(rows.values))
                        if near[j * lattice.groups + g]:
                            r = ((j * n + b) * n + a) * lattice.groups + g
                            bear_adjoint(rows, r, 4 * g, a, lattice, bar)
                value_adjoint(rows, 2, b, lattice, state_bar, j * width)


@bare_jit
def bear_adjoint(rows, r, i, a, lattice, bar):
    """The loads x_bar, y_bar of record r from f_bar and f_N_bar there; adds to stiffness_bar."""
    layers, width = lattice.ground.layers, math.sqrt(lattice.volume)
    x, y = value(rows, 0, i, a, lattice), value(rows, 1, i, a, lattice)
    qx, qy = value(rows, 2, i, a, lattice), value(rows, 3, i, a, lattice)
    size_bar = value(rows, 4, i, a, lattice)
    for k in range(4):
        capacity = lattice.volume * lattice.stiffness[r, k]
        if capacity > 0.0:
            for m in range(len(layers)):
                d, nx, ny, bend = distance(x[k], y[k], lattice.ground, m)
                thickness = layers[m, THICKNESS]
                if d < thickness + 0.5 * width:
                    full = layers[m, STIFFNESS] * capacity
                    size = mean_bearing(d, thickness, width, full)
                    b_bar = size_bar[k] + nx * qx[k] + ny * qy[k]
                    d_bar, full_bar = mean_bearing_adjoint(d, thickness, width, full, b_bar)
                    x_bar, y_bar = distance_adjoint(nx, ny, bend, d_bar, size * qx[k], size * qy[k])
                    bar.stiffness[r, k] += layers[m, STIFFNESS] * lattice.volume * full_bar
                    at = MARGIN + i + k
                    rows.stress[0, 0, a, at] += x_bar
                    rows.stress[1, 0, a, at] += y_bar


@bare_jit
def contact_of(x, y, ground):
    """What `resistance` takes, of the ground that a node is the deepest in, and 1/d at a corner."""
    nearest = 0
    d, nx, ny, bend = distance(x, y, ground, 0)
    for n in range(1, len(ground.layers)):
        closer, n_x, n_y, b = distance(x, y, ground, n)
        if closer.real < d.real:
            nearest, d, nx, ny, bend = n, closer, n_x, n_y, b
    layer = ground.layers[nearest]
    return (nx, ny, layer[FRICTION], layer[DAMPING], layer[CREEPING]), bend


@bare_loop_jit
def fold(fields, lattice):
    """Add to nodes beside the mirror plane what the mirrored half puts there; its own transpose.

    The plane is halfway between the last two lines of nodes. Fields are (f_x, f_y, f_N), (3, M).
    """
    width, axis = width_of(lattice), lattice.mirror_axis
    for line in range(lattice.rows + 2 if axis == 0 else width):
        inner = line * width + lattice.columns if axis == 0 else lattice.rows * width + line
        outer = inner + 1 if axis == 0 else inner + width
        for field in range(3):
            sign = -1.0 if field == axis else 1.0
            folded = fields[field, inner] + sign * fields[field, outer]
            fields[field, inner], fields[field, outer] = folded, sign * folded


@inner_jit
def steps_per_mass(lattice):
    """dt / m of the nodes (M,), and zero where they have no mass, or forces cannot move them."""
    per_mass = np.zeros_like(lattice.mass)
    for i in range(len(per_mass)):
        if lattice.mass[i].real > 0.0:
            per_mass[i] = lattice.dt / lattice.mass[i]
    for k in lattice.held:
        per_mass[k] = 0.0
    return per_mass


@bare_loop_jit
def hold(old, new, n, lattice):
    """Give held nodes the velocity of their clamps in step n; the most of influence^2 v^2."""
    fastest = 0.0
    for k, clamp in zip(lattice.held, lattice.holder):
        u, v = lattice.clamps[n, clamp, 4], lattice.clamps[n, clamp, 5]
        new[0, k], new[1, k] = old[0, k] + lattice.dt * u, old[1, k] + lattice.dt * v
        new[2, k], new[3, k] = u, v
        fastest = max(fastest, lattice.squared_influence[k] * (u * u + v * v))
    return fastest


@bare_loop_jit
def hold_adjoint(state_bar, lattice):
    """The transpose of `hold` after that of `move`: velocities of clamps depend on no state."""
    for k in lattice.held:
        state_bar[2, k] = state_bar[3, k] = 0.0


@bare_loop_jit
def move(old, new, force, per_mass, lattice):
    """From a state and the forces on its nodes to the next; the most of influence^2 v^2 then.

    It is infinite, or not a number, if one's velocity is.
    """
    M, dt = len(lattice.mass), lattice.dt
    fastest = real(0.0 * four(old, 0))
    sound = True
    for i in range(0, M, 4):
        per_m, m = four(per_mass, i), four(lattice.mass, i)
        u = four(old, 2 * M + i) + per_m * (four(force, i) + lattice.gravity_x * m)
        v = four(old, 3 * M + i) + per_m * (four(force, M + i) + lattice.gravity_y * m)
        put_four(new, 2 * M + i, u)
        put_four(new, 3 * M + i, v)
        if total(real(four(force, 2 * M + i))) > 0.0:
            for k in range(i, i + 4):
                if force[2, k].real > 0.0:
                    contact, _ = contact_of(old[0, k], old[1, k], lattice.ground)
                    push = per_mass[k] * force[2, k]
                    new[2, k], new[3, k] = resistance(new[2, k], new[3, k], push, contact)
            u, v = four(new, 2 * M + i), four(new, 3 * M + i)
        put_four(new, i, four(old, i) + dt * u)
        put_four(new, M + i, four(old, M + i) + dt * v)
        speed = real(u) * real(u) + real(v) * real(v)
        sound = sound and within(speed, 0.0, math.inf)
        fastest = greatest(four(lattice.squared_influence, i) * speed, fastest)
    if not sound:
        return math.inf
    return max(max(fastest[0], fastest[1]), max(fastest[2], fastest[3]))


@bare_jit
def before_resistance(u, v, push, contact):
    """The velocity that `resistance` made (u, v) of; along ground that sticks, none."""
    nx, ny, mu, alpha, creeping = contact
    normal, along = nx * u + ny * v, nx * v - ny * u
    normal = normal * (1.0 + alpha * push)
    if mu != math.inf:
        x = abs(along) / creeping
        slip = 1.0 if x >= 1.0 else x * (2.0 - x)
        along = along + np.sign(along) * mu * push * slip
    return nx * normal - ny * along, ny * normal + nx * along


@bare_loop_jit
def move_adjoint(old, new, force, per_mass, lattice, state_bar, force_bar, bar):
    """From the next state's adjoint to that of the state, but for what forces give, and to f_bar.

    Of the forces only f_N is read; f_x and f_y get velocities before the resistance.
    """
    M, dt = len(lattice.mass), lattice.dt
    for i in range(0, M, 4):
        per_m = four(per_mass, i)
        u_bar = four(state_bar, 2 * M + i) + dt * four(state_bar, i)
        v_bar = four(state_bar, 3 * M + i) + dt * four(state_bar, M + i)
        u, v = four(new, 2 * M + i), four(new, 3 * M + i)
        if total(four(force, 2 * M + i)) > 0.0:
            put_four(state_bar, 2 * M + i, u_bar)
            put_four(state_bar, 3 * M + i, v_bar)
            put_four(force, i, u)
            put_four(force, M + i, v)
            for k in range(i, i + 4):
                if force[2, k] * per_mass[k] > 0.0:  # but for what is held
                    resist_adjoint(k, old, force, per_mass, lattice, state_bar, force_bar, bar)
            u, v = four(force, i), four(force, M + i)
            u_bar, v_bar = four(state_bar, 2 * M + i), four(state_bar, 3 * M + i)
        put_four(state_bar, 2 * M + i, u_bar)
        put_four(state_bar, 3 * M + i, v_bar)
        put_four(force_bar, i, per_m * u_bar)
        put_four(force_bar, M + i, per_m * v_bar)
        # dt f / m, of what is not lost by friction that sticks: u_bar is zero there.
        u = u - four(old, 2 * M + i) - dt * lattice.gravity_x
        v = v - four(old, 3 * M + i) - dt * lattice.gravity_y
        add_four(bar.mass, i, (-1.0 / dt) * per_m * (u * u_bar + v * v_bar))


@bare_jit
def resist_adjoint(k, old, force, per_mass, lattice, state_bar, force_bar, bar):
    """The transpose of the resistance to node k, in place: velocity in `force`, its adjoint."""
    contact, bend = contact_of(old[0, k], old[1, k], lattice.ground)
    nx, ny = contact[0], contact[1]
    push = per_mass[k] * force[2, k]
    u, v, u_bar, v_bar = force[0, k], force[1, k], state_bar[2, k], state_bar[3, k]
    free_u, free_v = before_resistance(u, v, push, contact)
    normal, along = nx * u + ny * v, nx * v - ny * u
    nx_bar, ny_bar = u_bar * normal + v_bar * along, v_bar * normal - u_bar * along
    u_bar, v_bar, push_bar = resistance_adjoint(free_u, free_v, push, contact, u_bar, v_bar)
    normal_bar, along_bar = nx * u_bar + ny * v_bar, nx * v_bar - ny * u_bar
    nx_bar += normal_bar * free_u + along_bar * free_v
    ny_bar += normal_bar * free_v - along_bar * free_u
    x_bar, y_bar = distance_adjoint(nx, ny, bend, 0.0, nx_bar, ny_bar)
    state_bar[0, k] += x_bar
    state_bar[1, k] += y_bar
    state_bar[2, k], state_bar[3, k] = u_bar, v_bar
    force[0, k], force[1, k] = free_u, free_v
    force_bar[2, k] = push_bar * per_mass[k]
    bar.mass[k] -= push_bar * push * per_mass[k] / lattice.dt


@loop_jit
def advance_lattice(
    states: NDArray, first: int, last: int, lattice: Any, signal: NDArray
) -> tuple[int, int]:
    """Steps `first` to `last` of a lattice: slot n of `states` (., 4, M) to slot n + 1, round.

    Returns the step reached, and a node whose velocity is not a number then, or -1.
    """
    touch, lattice = lattice.touch, but_touch(lattice)
    rows, force = make_rows(4, 3, lattice), np.zeros((3, len(lattice.mass)), states.dtype)
    near, per_mass = np.zeros(len(lattice.filled), np.bool_), steps_per_mass(lattice)
    moved, touching, room = math.inf, nowhere(touch), -1.0
    for n in range(first, last):
        old, new = states[n % len(states)], states[(n + 1) % len(states)]
        force[:] = 0.0
        forces(old, lattice, signal[n], rows, force)
        if len(lattice.ground.layers):
            if moved > SKIN * lattice.dx:
                find_near(old, lattice, rows, near)
                moved = 0.0
            press(old, lattice, near, rows, force)
        if room < 0.0:
            touching, room = renewed(touching, old, touch)
        if len(touching.pairs):
            push_apart(touching, old, touch, force)
        if lattice.mirror_axis >= 0:
            fold(force, lattice)
        speed = move(old, new, force, per_mass, lattice)
        speed = max(speed, hold(old, new, n, lattice))
        if not speed < math.inf:
            return n, first_unsound(new)
        moved += lattice.dt * math.sqrt(speed)
        room -= lattice.dt * math.sqrt(speed)
    return last, -1


@bare_loop_jit
def first_unsound(state):
    """The first node whose speed is infinite or not a number."""
    for i in range(state.shape[1]):
        if not abs(state[2, i]) + abs(state[3, i]) < math.inf:
            return i
    return 0


@loop_jit
def advance_lattice_adjoint(
    states: NDArray,
    first: int,
    last: int,
    lattice: Any,
    signal: NDArray,
    state_bar: NDArray,
    bar: Any,
    signal_bar: NDArray,
) -> None:
    """The adjoint of `advance_lattice`, from step `last` back to `first`.

    `state_bar` (4, M) is overwritten; `bar` and `signal_bar` (steps, K) are added to.
    """
    touch, lattice = lattice.touch, but_touch(lattice)
    rows, force = make_rows(6, 4, lattice), np.zeros((3, len(lattice.mass)), states.dtype)
    force_bar = np.zeros_like(force)
    near, per_mass = np.zeros(len(lattice.filled), np.bool_), steps_per_mass(lattice)
    moved, touching, room = math.inf, nowhere(touch), -1.0
    for n in range(last - 1, first - 1, -1):
        old, new = states[n], states[n + 1]
        if len(lattice.ground.layers):
            if moved > SKIN * lattice.dx:
                find_near(old, lattice, rows, near)
                moved = 0.0
            force[:] = 0.0
            force_bar[2] = 0.0
            press(old, lattice, near, rows, force)
            if lattice.mirror_axis >= 0:
                fold(force, lattice)
        move_adjoint(old, new, force, per_mass, lattice, state_bar, force_bar, bar)
        hold_adjoint(state_bar, lattice)
        if lattice.mirror_axis >= 0:
            fold(force_bar, lattice)
        if room < 0.0:
            touching, room = renewed(touching, old, touch)
        if len(touching.pairs):
            push_apart_adjoint(touching, old, touch, force_bar, state_bar, bar.grip)
        step = lattice.dt * fastest_of(old, lattice)
        moved += step
        room -= step
        forces_adjoint(old, force_bar, lattice, signal[n], rows, state_bar, bar, signal_bar[n])
        if len(lattice.ground.layers):
            press_adjoint(old, force_bar, lattice, near, rows, state_bar, bar)


@bare_loop_jit
def fastest_of(state, lattice):
    """A speed that no particle exceeds."""
    M = state.shape[1]
    fastest = 0.0 * four(state, 0)
    for i in range(0, M, 4):
        u, v = four(state, 2 * M + i), four(state, 3 * M + i)
        fastest = greatest(four(lattice.squared_influence, i) * (u * u + v * v), fastest)
    return math.sqrt(max(max(fastest[0], fastest[1]), max(fastest[2], fastest[3])))


def weights(per_cell: int, dx: float) -> NDArray[np.float64]:
    """Weights (n, 6) of a cell's three nodes along an axis for n particles: values, then slopes."""
    t = (np.arange(per_cell) + 0.5) / per_cell
    values = 0.5 * (1.0 - t) ** 2, 0.75 - (t - 0.5) ** 2, 0.5 * t**2
    slopes = (t - 1.0) / dx, (1.0 - 2.0 * t) / dx, t / dx
    return np.stack([*values, *slopes], axis=1)
