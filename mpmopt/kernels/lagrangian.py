"""Total Lagrangian steps: a body on the lattice of its own reference configuration.

Nodes are control points of quadratic B-splines, of which the cells are the spans; particles are
quadrature points at fixed places in their cells. Fields on nodes are polynomials of cells
(`kernels.spline`), so all that depends on a particle's place are the constants of a `pattern`.
"""

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import DTypeLike, NDArray

from mpmopt.kernels.actuation import second_piola
from mpmopt.kernels.arrays import COEFFICIENTS, clear
from mpmopt.kernels.compiler import jit, loop_jit
from mpmopt.kernels.ground import (
    CREEPING,
    DAMPING,
    FRICTION,
    STIFFNESS,
    THICKNESS,
    distance,
    distance_adjoint,
)
from mpmopt.kernels.layer import bearing, bearing_adjoint, resistance, resistance_adjoint
from mpmopt.kernels.material import solid_constants
from mpmopt.kernels.pairs import nowhere, push_apart, push_apart_adjoint, renewed
from mpmopt.kernels.simd import (
    above,
    add,
    chosen,
    load,
    logarithm,
    number,
    pack,
    reciprocal,
    total,
)
from mpmopt.kernels.spline import taylor, taylor_adjoint

# Below this J the logarithm goes on as its Taylor polynomial of order two, so that void may invert.
LEAST_J = 0.25
# Records of a pattern for a group: 6 of the derivative along x (orders (1, 0), (2, 0), (1, 1),
# (2, 1), (1, 2), (2, 2) of a cell's polynomial), 6 along y (x and y exchanged), 9 of the value.
PATTERN_SIZE, VALUE = 21, 12
# Cells whose middle is farther than this from the layers, in cells, have no particle in them.
CLEAR = 3.0


class Lattice(NamedTuple):
    """A body on its reference lattice of A by B cells, R groups of four particles in each."""

    dt: float
    dx: float
    gravity_x: float
    gravity_y: float
    columns: int  # A
    rows: int  # B
    volume: float  # of a particle
    viscous: bool  # whether any viscosity is above zero
    mirror_axis: int  # of the mirror plane's normal, 0 or 1: it bounds the cells; -1: no mirror
    pattern: NDArray[np.float64]  # (21 R, 4), as `pattern` makes it
    constants: NDArray[np.float64]  # (P, A B R, 4) of the solid, as `kernels.material` names them
    stiffness: NDArray  # (A B R, 4) share of the solid's, zero where no particle is
    filled: NDArray[np.bool_]  # (A B,) whether a cell has particles
    actuated: NDArray[np.float64]  # (K, A B R, 4) 1 for the particles of actuator k, else 0
    active: NDArray[np.bool_]  # (A B R,) whether a group has actuated particles
    actuation_stress: NDArray[np.float64]  # (K, 3) second Piola-Kirchhoff S: xx, xy, yy
    mass: NDArray  # (M,) of the nodes, lumped
    touch: Any  # `kernels.pairs.Touch`
    ground: Any  # `kernels.ground.Ground`
    nodes_y: int  # of the grid that the ground's table is for, and how many along x
    nodes_x: int


class LatticeBar(NamedTuple):
    """Adjoints of `Lattice`, accumulated over the steps, and of the signal."""

    stiffness: NDArray  # (A B R, 4)
    mass: NDArray  # (M,)
    grip: NDArray  # (A B, n n) of `Touch`

    @classmethod
    def zeros(cls, lattice: Lattice, dtype: DTypeLike = float) -> "LatticeBar":
        """Nothing accumulated yet."""
        shapes = lattice.stiffness.shape, lattice.mass.shape, lattice.touch.grip.shape
        return cls(*(np.zeros(shape, dtype) for shape in shapes))


@jit
def slopes_x(cells, c, lane, pattern, r):
    """Derivative along x of a field, one lane of the cell's records, at four particles."""
    return (
        load(pattern, PATTERN_SIZE * r) * number(cells, c + 3, lane)
        + load(pattern, PATTERN_SIZE * r + 1) * number(cells, c + 6, lane)
        + load(pattern, PATTERN_SIZE * r + 2) * number(cells, c + 4, lane)
        + load(pattern, PATTERN_SIZE * r + 3) * number(cells, c + 7, lane)
        + load(pattern, PATTERN_SIZE * r + 4) * number(cells, c + 5, lane)
        + load(pattern, PATTERN_SIZE * r + 5) * number(cells, c + 8, lane)
    )


@jit
def slopes_y(cells, c, lane, pattern, r):
    """Derivative along y of a field, one lane of the cell's records, at four particles."""
    return (
        load(pattern, PATTERN_SIZE * r + 6) * number(cells, c + 1, lane)
        + load(pattern, PATTERN_SIZE * r + 7) * number(cells, c + 2, lane)
        + load(pattern, PATTERN_SIZE * r + 8) * number(cells, c + 4, lane)
        + load(pattern, PATTERN_SIZE * r + 9) * number(cells, c + 5, lane)
        + load(pattern, PATTERN_SIZE * r + 10) * number(cells, c + 7, lane)
        + load(pattern, PATTERN_SIZE * r + 11) * number(cells, c + 8, lane)
    )


@jit
def gradients(cells, c, first, pattern, r):
    """Gradient (00, 01, 10, 11) of the vector field in lanes `first` and `first` + 1."""
    return (
        slopes_x(cells, c, first, pattern, r),
        slopes_y(cells, c, first, pattern, r),
        slopes_x(cells, c, first + 1, pattern, r),
        slopes_y(cells, c, first + 1, pattern, r),
    )


@jit
def gradient_adjoint(moments, c, pattern, r, P):
    """Adds to lanes 0 and 1 of a cell's moments what `gradients` transposed gives of P."""
    p00, p01, p10, p11 = P
    for k in range(6):
        w = load(pattern, PATTERN_SIZE * r + k)
        order = c + (k % 2 + 1) * 3 + k // 2
        moments[order, 0] += total(w * p00)
        moments[order, 1] += total(w * p10)
    for k in range(6):
        w = load(pattern, PATTERN_SIZE * r + 6 + k)
        order = c + (k // 2) * 3 + k % 2 + 1
        moments[order, 0] += total(w * p01)
        moments[order, 1] += total(w * p11)


@jit
def gradients_adjoint(moments, c, pattern, r, P, Q):
    """Adds to a cell's moments what `gradients` transposed gives of P in lanes 0, 1, Q in 2, 3."""
    p00, p01, p10, p11 = P
    q00, q01, q10, q11 = Q
    for k in range(6):
        w = load(pattern, PATTERN_SIZE * r + k)
        order = (k % 2 + 1) * 3 + k // 2
        add(
            moments, c + order, pack(total(w * p00), total(w * p10), total(w * q00), total(w * q10))
        )
    for k in range(6):
        w = load(pattern, PATTERN_SIZE * r + 6 + k)
        order = (k // 2) * 3 + k % 2 + 1
        add(
            moments, c + order, pack(total(w * p01), total(w * p11), total(w * q01), total(w * q11))
        )


@jit
def continued(J):
    """ln J and its first and second derivative, continued below `LEAST_J`."""
    inside = above(J, LEAST_J)
    safe = chosen(inside, J, 0.0 * J + LEAST_J)
    slope = reciprocal(safe)
    off = J - safe  # zero inside
    log = logarithm(safe)
    bend = slope * slope
    return log + off * slope - 0.5 * off * off * bend, slope - off * bend, 0.0 * J - bend


@jit
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


@jit
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


@jit
def forces(cells, moments, lattice, signal):
    """Moments of the internal force - sum V P G of all cells, from the polynomials of (x, v)."""
    groups, pattern = lattice.pattern.shape[0] // PATTERN_SIZE, lattice.pattern
    for cell in range(lattice.columns * lattice.rows):
        if lattice.filled[cell]:
            c = COEFFICIENTS * cell
            for r in range(groups):
                g = cell * groups + r
                F = gradients(cells, c, 0, pattern, r)
                rate = F  # which nothing asks for
                if lattice.viscous:
                    rate = gradients(cells, c, 2, pattern, r)
                p00, p01, p10, p11 = solid_stress(
                    F, rate, solid_constants(lattice, g), lattice.viscous
                )
                share = -lattice.volume * load(lattice.stiffness, g)
                p00, p01, p10, p11 = share * p00, share * p01, share * p10, share * p11
                if lattice.active[g]:
                    f00, f01, f10, f11 = F
                    s00, s01, s11 = second_piola(lattice, g, signal)
                    V = lattice.volume
                    p00, p01 = p00 - V * (f00 * s00 + f01 * s01), p01 - V * (f00 * s01 + f01 * s11)
                    p10, p11 = p10 - V * (f10 * s00 + f11 * s01), p11 - V * (f10 * s01 + f11 * s11)
                gradient_adjoint(moments, c, pattern, r, (p00, p01, p10, p11))


@jit
def forces_adjoint(cells, cells_bar, moments, lattice, signal, bar, signal_bar):
    """From f_bar, of which `cells_bar` are the polynomials, to moments of x_bar and v_bar.

    Adds to the adjoints of stiffness and signal.
    """
    groups, pattern = lattice.pattern.shape[0] // PATTERN_SIZE, lattice.pattern
    V = lattice.volume
    for cell in range(lattice.columns * lattice.rows):
        if lattice.filled[cell]:
            c = COEFFICIENTS * cell
            for r in range(groups):
                g = cell * groups + r
                F = gradients(cells, c, 0, pattern, r)
                rate = gradients(cells, c, 2, pattern, r)
                q00, q01, q10, q11 = gradients(cells_bar, c, 0, pattern, r)
                q00, q01, q10, q11 = -V * q00, -V * q01, -V * q10, -V * q11
                p00, p01, p10, p11 = solid_stress(
                    F, rate, solid_constants(lattice, g), lattice.viscous
                )
                add(bar.stiffness, g, q00 * p00 + q01 * p01 + q10 * p10 + q11 * p11)
                k = load(lattice.stiffness, g)
                P_bar = k * q00, k * q01, k * q10, k * q11
                F_bar, rate_bar = solid_stress_adjoint(
                    F, rate, solid_constants(lattice, g), lattice.viscous, P_bar
                )
                if lattice.active[g]:
                    f00, f01, f10, f11 = F
                    b00, b01, b10, b11 = F_bar
                    s00, s01, s11 = second_piola(lattice, g, signal)
                    b00, b01 = b00 + q00 * s00 + q01 * s01, b01 + q00 * s01 + q01 * s11
                    b10, b11 = b10 + q10 * s00 + q11 * s01, b11 + q10 * s01 + q11 * s11
                    F_bar = b00, b01, b10, b11
                    m00, m11 = f00 * q00 + f10 * q10, f01 * q01 + f11 * q11
                    m01 = f00 * q01 + f10 * q11 + f01 * q00 + f11 * q10
                    for a in range(signal.size):
                        power = (
                            lattice.actuation_stress[a, 0] * m00
                            + lattice.actuation_stress[a, 1] * m01
                            + lattice.actuation_stress[a, 2] * m11
                        )
                        signal_bar[a] += total(load(lattice.actuated[a], g) * power)
                gradients_adjoint(moments, c, pattern, r, F_bar, rate_bar)


@jit
def value(cells, c, lane, pattern, r, k):
    """A field, one lane of the cell's records, at particle k of a group."""
    result = 0.0 * cells[c, lane]
    for order in range(COEFFICIENTS):
        result += pattern[PATTERN_SIZE * r + VALUE + order, k] * cells[c + order, lane]
    return result


@jit
def is_clear(cells, c, lattice):
    """Whether the cell is too far from ground to touch it."""
    i = round(float(cells[c, 0].real) / lattice.dx)
    j = round(float(cells[c, 1].real) / lattice.dx)
    if not (0 <= i < lattice.nodes_x and 0 <= j < lattice.nodes_y):
        return False
    return lattice.ground.clearance[i * lattice.nodes_y + j] > CLEAR * lattice.dx


@jit
def press(cells, moments, lattice):
    """Adds the layers' force b n and its size b, in lanes 0 to 2, to the moments of all cells."""
    groups, pattern = lattice.pattern.shape[0] // PATTERN_SIZE, lattice.pattern
    layers = lattice.ground.layers
    for cell in range(lattice.columns * lattice.rows):
        c = COEFFICIENTS * cell
        if lattice.filled[cell] and not is_clear(cells, c, lattice):
            for r in range(groups):
                g = cell * groups + r
                for k in range(4):
                    capacity = lattice.volume * lattice.stiffness[g, k]
                    if capacity.real > 0.0:
                        x = value(cells, c, 0, pattern, r, k)
                        y = value(cells, c, 1, pattern, r, k)
                        for n in range(len(layers)):
                            d, nx, ny, _ = distance(x, y, lattice.ground, n)
                            if d.real < layers[n, THICKNESS]:
                                b = bearing(
                                    d, layers[n, THICKNESS], layers[n, STIFFNESS] * capacity
                                )
                                for order in range(COEFFICIENTS):
                                    w = pattern[PATTERN_SIZE * r + VALUE + order, k]
                                    moments[c + order, 0] += w * b * nx
                                    moments[c + order, 1] += w * b * ny
                                    moments[c + order, 2] += w * b


@jit
def press_adjoint(cells, cells_bar, moments, lattice, bar):
    """From polynomials of the adjoint of `press`: adds to moments of x_bar and stiffness_bar."""
    groups, pattern = lattice.pattern.shape[0] // PATTERN_SIZE, lattice.pattern
    layers = lattice.ground.layers
    for cell in range(lattice.columns * lattice.rows):
        c = COEFFICIENTS * cell
        if lattice.filled[cell] and not is_clear(cells, c, lattice):
            for r in range(groups):
                g = cell * groups + r
                for k in range(4):
                    capacity = lattice.volume * lattice.stiffness[g, k]
                    if capacity.real > 0.0:
                        x = value(cells, c, 0, pattern, r, k)
                        y = value(cells, c, 1, pattern, r, k)
                        qx = value(cells_bar, c, 0, pattern, r, k)
                        qy = value(cells_bar, c, 1, pattern, r, k)
                        force_bar = value(cells_bar, c, 2, pattern, r, k)
                        for n in range(len(layers)):
                            d, nx, ny, bend = distance(x, y, lattice.ground, n)
                            thickness = layers[n, THICKNESS]
                            if d.real < thickness:
                                full = layers[n, STIFFNESS] * capacity
                                b = bearing(d, thickness, full)
                                b_bar = force_bar + nx * qx + ny * qy
                                d_bar, full_bar = bearing_adjoint(d, thickness, full, b_bar)
                                x_bar, y_bar = distance_adjoint(nx, ny, bend, d_bar, b * qx, b * qy)
                                bar.stiffness[g, k] += (
                                    layers[n, STIFFNESS] * lattice.volume * full_bar
                                )
                                for order in range(COEFFICIENTS):
                                    w = pattern[PATTERN_SIZE * r + VALUE + order, k]
                                    moments[c + order, 0] += w * x_bar
                                    moments[c + order, 1] += w * y_bar


@jit
def contact_of(x, y, ground):
    """What `resistance` takes, of the ground that a node is the deepest in, and 1/d at a corner."""
    nearest, least = 0, math.inf
    for n in range(len(ground.layers)):
        d, _, _, _ = distance(x, y, ground, n)
        if d.real < least:
            nearest, least = n, d.real
    _, nx, ny, bend = distance(x, y, ground, nearest)
    layer = ground.layers[nearest]
    return (nx, ny, layer[FRICTION], layer[DAMPING], layer[CREEPING]), bend


@jit
def fold(records, lattice):
    """Add to nodes beside the mirror plane what the mirrored half puts there; its own transpose.

    The plane is halfway between the last two lines of nodes. Lanes are (x, y, f_N, 0).
    """
    lines, rows, axis = lattice.columns + 2, lattice.rows + 2, lattice.mirror_axis
    for line in range(rows if axis == 0 else lines):
        inner = (lines - 2) * rows + line if axis == 0 else line * rows + rows - 2
        outer = inner + rows if axis == 0 else inner + 1
        for lane in range(3):
            sign = -1.0 if lane == axis else 1.0
            folded = records[inner, lane] + sign * records[outer, lane]
            records[inner, lane], records[outer, lane] = folded, sign * folded


@loop_jit
def advance_lattice(
    states: NDArray, pushes: NDArray, first: int, last: int, lattice: Any, signal: NDArray
) -> tuple[int, int]:
    """Steps `first` to `last` of a lattice: slot n of `states` (., M, 4) to slot n + 1, round.

    A node's record is (x_x, x_y, v_x, v_y). Slots of `pushes` (., M) get by how much the layers
    change nodes' speeds. Returns the step reached and the node that is not a number, or -1.
    """
    nodes = len(lattice.mass)
    window = (0, 0, lattice.columns + 2, lattice.rows + 2)
    records = COEFFICIENTS * window[2] * window[3]
    cells, moments = np.zeros((records, 4), states.dtype), np.zeros((records, 4), states.dtype)
    force = np.zeros((nodes, 4), states.dtype)
    dt, near = lattice.dt, nowhere(lattice.touch)
    for n in range(first, last):
        old, new = states[n % len(states)], states[(n + 1) % len(states)]
        taylor(old, window, window, cells)
        clear(moments, window)
        forces(cells, moments, lattice, signal[n])
        if len(lattice.ground.layers):
            press(cells, moments, lattice)
        taylor_adjoint(moments, window, force)
        near = renewed(near, old.T, lattice.touch)
        if len(near.pairs):
            push_apart(near, old.T, lattice.touch, force.T)
        if lattice.mirror_axis >= 0:
            fold(force, lattice)
        push = pushes[n % len(pushes)]
        for i in range(nodes):
            u = v = 0.0 * old[i, 2]
            push[i] = 0.0
            if lattice.mass[i].real > 0.0:
                per_m = dt / lattice.mass[i]
                u = old[i, 2] + per_m * force[i, 0] + dt * lattice.gravity_x
                v = old[i, 3] + per_m * force[i, 1] + dt * lattice.gravity_y
                if force[i, 2].real > 0.0:
                    push[i] = per_m * force[i, 2]
                    contact, _ = contact_of(old[i, 0], old[i, 1], lattice.ground)
                    u, v = resistance(u, v, push[i], contact)
            new[i, 2], new[i, 3] = u, v
            new[i, 0], new[i, 1] = old[i, 0] + dt * u, old[i, 1] + dt * v
            if not (math.isfinite(u.real) and math.isfinite(v.real)):
                return n, i
    return last, -1


@jit
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


@loop_jit
def advance_lattice_adjoint(
    states: NDArray,
    pushes: NDArray,
    first: int,
    last: int,
    lattice: Any,
    signal: NDArray,
    state_bar: NDArray,
    bar: Any,
    signal_bar: NDArray,
) -> None:
    """The adjoint of `advance_lattice`, from step `last` back to `first`.

    `state_bar` (M, 4) is overwritten; `bar` and `signal_bar` (steps, K) are added to.
    """
    nodes = len(lattice.mass)
    window = (0, 0, lattice.columns + 2, lattice.rows + 2)
    records = COEFFICIENTS * window[2] * window[3]
    cells, cells_bar = np.zeros((records, 4), states.dtype), np.zeros((records, 4), states.dtype)
    moments = np.zeros((records, 4), states.dtype)
    force_bar, back = np.zeros((nodes, 4), states.dtype), np.zeros((nodes, 4), states.dtype)
    dt, near = lattice.dt, nowhere(lattice.touch)
    for n in range(last - 1, first - 1, -1):
        old, new = states[n], states[n + 1]
        for i in range(nodes):
            for lane in range(3):
                force_bar[i, lane] = 0.0
            m = lattice.mass[i]
            if m > 0.0:
                u_bar = state_bar[i, 2] + dt * state_bar[i, 0]
                v_bar = state_bar[i, 3] + dt * state_bar[i, 1]
                u, v, push = new[i, 2], new[i, 3], pushes[n, i]
                if push > 0.0:
                    contact, bend = contact_of(old[i, 0], old[i, 1], lattice.ground)
                    nx, ny = contact[0], contact[1]
                    free_u, free_v = before_resistance(u, v, push, contact)
                    normal, along = nx * u + ny * v, nx * v - ny * u
                    nx_bar, ny_bar = u_bar * normal + v_bar * along, v_bar * normal - u_bar * along
                    u_bar, v_bar, push_bar = resistance_adjoint(
                        free_u, free_v, push, contact, u_bar, v_bar
                    )
                    u, v = free_u, free_v
                    normal_bar, along_bar = nx * u_bar + ny * v_bar, nx * v_bar - ny * u_bar
                    nx_bar += normal_bar * u + along_bar * v
                    ny_bar += normal_bar * v - along_bar * u
                    x_bar, y_bar = distance_adjoint(nx, ny, bend, 0.0, nx_bar, ny_bar)
                    state_bar[i, 0] += x_bar
                    state_bar[i, 1] += y_bar
                    force_bar[i, 2] = push_bar * dt / m
                    bar.mass[i] -= push_bar * push / m
                force_bar[i, 0], force_bar[i, 1] = dt / m * u_bar, dt / m * v_bar
                # dt f / m, of what is not lost by friction that sticks: u_bar is zero there.
                pushed_x = u - old[i, 2] - dt * lattice.gravity_x
                pushed_y = v - old[i, 3] - dt * lattice.gravity_y
                bar.mass[i] -= (pushed_x * u_bar + pushed_y * v_bar) / m
                state_bar[i, 2], state_bar[i, 3] = u_bar, v_bar
            else:
                state_bar[i, 2] = state_bar[i, 3] = 0.0
        if lattice.mirror_axis >= 0:
            fold(force_bar, lattice)
        near = renewed(near, old.T, lattice.touch)
        if len(near.pairs):
            push_apart_adjoint(near, old.T, lattice.touch, force_bar.T, state_bar.T, bar.grip)
        taylor(old, window, window, cells)
        taylor(force_bar, window, window, cells_bar)
        clear(moments, window)
        forces_adjoint(cells, cells_bar, moments, lattice, signal[n], bar, signal_bar[n])
        if len(lattice.ground.layers):
            press_adjoint(cells, cells_bar, moments, lattice, bar)
        taylor_adjoint(moments, window, back)
        for i in range(nodes):
            add(state_bar, i, load(back, i))


def pattern(per_cell: int, dx: float) -> NDArray[np.float64]:
    """Constants (21 R, 4) of the n x n particles of a cell, by which its polynomial is weighed.

    Particle a n + b is a-th along x and b-th along y; what fills the last group is at the middle.
    """
    t = (np.arange(per_cell) + 0.5) / per_cell - 0.5
    x, y = (each.ravel() for each in np.meshgrid(t, t, indexing="ij"))
    groups = -(-x.size // 4)
    x, y = (np.concatenate([each, np.zeros(4 * groups - each.size)]) for each in (x, y))
    one = np.ones_like(x)
    along_x = one, x, y, x * y, y * y / 2, x * y * y / 2
    along_y = one, y, x, x * y, x * x / 2, x * x * y / 2
    powers = [(one, x, x * x / 2)[i] * (one, y, y * y / 2)[j] for i in range(3) for j in range(3)]
    constants = np.concatenate([np.stack([*along_x, *along_y]) / dx, powers])
    return constants.reshape(PATTERN_SIZE, groups, 4).swapaxes(0, 1).reshape(-1, 4).copy()
