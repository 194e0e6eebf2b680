"""Particles to grid and grid to particles."""

from mpmopt.kernels.arrays import (
    AFFINE,
    AFFINE_BAR,
    MASS_BAR,
    POSITION,
    SLOPE,
    VELOCITY,
    VELOCITY_BAR,
    at,
    in_tile,
)
from mpmopt.kernels.compiler import jit
from mpmopt.kernels.simd import (
    add,
    add_number,
    load,
    nothing,
    number,
    pack,
    pair_of,
    set_number,
    store,
    store_tensor,
    tensor,
    total,
)
from mpmopt.kernels.spline import deposit, moments, slopes


@jit
def momentum(state, data, tile, g, t, k):
    """What particle k of a group puts on nodes: (m v_x, m v_y, m, 0), columns of A dx likewise."""
    m, A, row = number(data.mass, g, k), tile.affine, 4 * t
    zero = 0.0 * m
    u, v = number(state, at(g, VELOCITY), k), number(state, at(g, VELOCITY + 1), k)
    q = pack(m * u, m * v, m, zero)
    a0 = pack(number(A, row, k), number(A, row + 2, k), zero, zero)
    a1 = pack(number(A, row + 1, k), number(A, row + 3, k), zero, zero)
    return q, a0, a1


@jit
def p2g(state, data, tile, cells, first, last):
    """Particle to grid: momentum and mass (q_x, q_y, m, 0), as moments of cells."""
    for g in range(first, last):
        t = g - first
        for k in range(4):
            q, a0, a1 = momentum(state, data, tile, g, t, k)
            deposit(cells, tile, t, k, q, a0, a1)


@jit
def p2g_adjoint(state, data, parameters, tile, cells, bar, data_bar, first, last):
    """From momentum_bar and mass_bar of cells to A_bar; adds to x_bar, v_bar and mass_bar."""
    dx, per_dx, gathered = parameters.dx, parameters.per_dx, tile.gathered
    for g in range(first, last):
        t = g - first
        for k in range(4):
            q, a0, a1 = momentum(state, data, tile, g, t, k)
            mean, along_x, along_y = moments(cells, tile, t, k)
            slope_x, slope_y = slopes(cells, tile, t, k, q, a0, a1)
            set_number(gathered, in_tile(t, AFFINE_BAR), k, along_x[0])
            set_number(gathered, in_tile(t, AFFINE_BAR + 1), k, along_y[0])
            set_number(gathered, in_tile(t, AFFINE_BAR + 2), k, along_x[1])
            set_number(gathered, in_tile(t, AFFINE_BAR + 3), k, along_y[1])
            set_number(gathered, in_tile(t, VELOCITY_BAR), k, mean[0])
            set_number(gathered, in_tile(t, VELOCITY_BAR + 1), k, mean[1])
            set_number(gathered, in_tile(t, MASS_BAR), k, mean[2])
            set_number(gathered, in_tile(t, SLOPE), k, total(slope_x))
            set_number(gathered, in_tile(t, SLOPE + 1), k, total(slope_y))
        a00, a01, a10, a11 = tensor(gathered, in_tile(t, AFFINE_BAR))
        store_tensor(gathered, in_tile(t, AFFINE_BAR), dx * a00, dx * a01, dx * a10, dx * a11)
        add(bar, at(g, POSITION), per_dx * load(gathered, in_tile(t, SLOPE)))
        add(bar, at(g, POSITION + 1), per_dx * load(gathered, in_tile(t, SLOPE + 1)))
        m, u, v = load(data.mass, g), load(state, at(g, VELOCITY)), load(state, at(g, VELOCITY + 1))
        u_bar = load(gathered, in_tile(t, VELOCITY_BAR))
        v_bar = load(gathered, in_tile(t, VELOCITY_BAR + 1))
        add(bar, at(g, VELOCITY), m * u_bar)
        add(bar, at(g, VELOCITY + 1), m * v_bar)
        add(data_bar.mass, g, load(gathered, in_tile(t, MASS_BAR)) + u * u_bar + v * v_bar)


@jit
def g2p(old, new, parameters, tile, cells, first, last):
    """Grid to particle: the new velocity, affine velocity and position."""
    dt, per_dx = parameters.dt, 4.0 / parameters.dx
    for g in range(first, last):
        t = g - first
        for k in range(4):
            mean, along_x, along_y = moments(cells, tile, t, k)
            set_number(new, at(g, VELOCITY), k, mean[0])
            set_number(new, at(g, VELOCITY + 1), k, mean[1])
            set_number(new, at(g, AFFINE), k, along_x[0])
            set_number(new, at(g, AFFINE + 1), k, along_y[0])
            set_number(new, at(g, AFFINE + 2), k, along_x[1])
            set_number(new, at(g, AFFINE + 3), k, along_y[1])
        for axis in range(2):
            x, v = load(old, at(g, POSITION + axis)), load(new, at(g, VELOCITY + axis))
            store(new, at(g, POSITION + axis), x + dt * v)
        c00, c01, c10, c11 = tensor(new, at(g, AFFINE))
        store_tensor(new, at(g, AFFINE), per_dx * c00, per_dx * c01, per_dx * c10, per_dx * c11)


@jit
def g2p_adjoint(parameters, tile, cells, cells_bar, bar, first, last):
    """From x_bar', v_bar', C_bar' to velocity_bar, as moments of cells, and to x_bar, v_bar, C_bar.

    v_bar and C_bar are zero here: what follows adds to them.
    """
    dt, per_dx = parameters.dt, parameters.per_dx
    c, h = 4.0 * per_dx, tile.gathered
    for g in range(first, last):
        t = g - first
        none = nothing(bar)
        for axis in range(2):
            x_bar, v_bar = load(bar, at(g, POSITION + axis)), load(bar, at(g, VELOCITY + axis))
            store(h, in_tile(t, VELOCITY_BAR + axis), v_bar + dt * x_bar)
            store(bar, at(g, VELOCITY + axis), none)
        c00, c01, c10, c11 = tensor(bar, at(g, AFFINE))
        store_tensor(h, in_tile(t, AFFINE_BAR), c * c00, c * c01, c * c10, c * c11)
        store_tensor(bar, at(g, AFFINE), none, none, none, none)
        for k in range(4):
            v_bar = pair_of(h, in_tile(t, VELOCITY_BAR), in_tile(t, VELOCITY_BAR + 1), k)
            c0 = pair_of(h, in_tile(t, AFFINE_BAR), in_tile(t, AFFINE_BAR + 2), k)
            c1 = pair_of(h, in_tile(t, AFFINE_BAR + 1), in_tile(t, AFFINE_BAR + 3), k)
            slope_x, slope_y = slopes(cells, tile, t, k, v_bar, c0, c1)
            deposit(cells_bar, tile, t, k, v_bar, c0, c1)
            add_number(bar, at(g, POSITION), k, per_dx * total(slope_x))
            add_number(bar, at(g, POSITION + 1), k, per_dx * total(slope_y))
