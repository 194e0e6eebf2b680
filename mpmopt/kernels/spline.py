"""Quadratic B-splines: fields on nodes as polynomials of cells, and which cell a particle is in."""

import numpy as np

from mpmopt.kernels.arrays import COEFFICIENTS, PLACE_SIZE, POSITION, at
from mpmopt.kernels.compiler import jit
from mpmopt.kernels.simd import (
    add,
    cell_coordinate,
    greatest,
    least,
    load,
    nothing,
    number,
    real,
    store,
    whole,
    within,
)


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
            c = COEFFICIENTS * (i * rows + j)
            v, s, k = expand(
                load(nodes, node + j), load(nodes, node + j + 1), load(nodes, node + j + 2)
            )
            store(cells, c, v)
            store(cells, c + 1, s)
            store(cells, c + 2, k)
    stride = COEFFICIENTS * rows
    for i in range(columns - 2):  # along x
        for c in range(i * stride, (i + 1) * stride, COEFFICIENTS):
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
    stride = COEFFICIENTS * rows
    for i in range(columns - 3, -1, -1):  # along x
        for c in range(i * stride, (i + 1) * stride, COEFFICIENTS):
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
            c = COEFFICIENTS * (i * rows + j)
            f0, f1, f2 = expand_adjoint(load(cells, c), load(cells, c + 1), load(cells, c + 2))
            store(nodes, node + j, here + f0)
            here, after = after + f1, f2
        store(nodes, node + rows, here)
        store(nodes, node + rows + 1, after)


@jit
def store_place(tile, g, t, h, r, axis):
    """Where particles of group g are in their cells along an axis: t, t^2/2 and 3t/8 - t^3/2."""
    store(tile.place, PLACE_SIZE * g + axis, t)
    store(tile.place, PLACE_SIZE * g + 2 + axis, h)
    store(tile.place, PLACE_SIZE * g + 4 + axis, r)


@jit
def place_along_x(tile, g, k):
    """What `store_place` wrote along x, of particle k of a group."""
    return (
        number(tile.place, PLACE_SIZE * g, k),
        number(tile.place, PLACE_SIZE * g + 2, k),
        number(tile.place, PLACE_SIZE * g + 4, k),
    )


@jit
def place_along_y(tile, g, k):
    """What `store_place` wrote along y, of particle k of a group."""
    return (
        number(tile.place, PLACE_SIZE * g + 1, k),
        number(tile.place, PLACE_SIZE * g + 3, k),
        number(tile.place, PLACE_SIZE * g + 5, k),
    )


@jit
def deposit(cells, tile, g, k, f, a, b):
    """Add the moments of w f + w r_x a + w r_y b to the cell of particle k of a group."""
    c = COEFFICIENTS * int(number(tile.cell, g, k))
    tx, hx, rx = place_along_x(tile, g, k)
    deposit_row(cells, c, tile, g, k, f, b)
    deposit_row(cells, c + 3, tile, g, k, tx * f + 0.25 * a, tx * b)
    deposit_row(cells, c + 6, tile, g, k, hx * f + rx * a, hx * b)


@jit
def deposit_row(cells, c, tile, g, k, f, b):
    """The moments along y of w f + w r_y b."""
    ty, hy, ry = place_along_y(tile, g, k)
    add(cells, c, f)
    add(cells, c + 1, ty * f + 0.25 * b)
    add(cells, c + 2, hy * f + ry * b)


@jit
def moments(cells, tile, g, k):
    """Sums over the nodes of particle k of a group of w f, w r_x f and w r_y f, for r in cells."""
    c = COEFFICIENTS * int(number(tile.cell, g, k))
    tx, hx, rx = place_along_x(tile, g, k)
    f0, b0 = moments_row(cells, c, tile, g, k)
    f1, b1 = moments_row(cells, c + 3, tile, g, k)
    f2, b2 = moments_row(cells, c + 6, tile, g, k)
    return f0 + tx * f1 + hx * f2, 0.25 * f1 + rx * f2, b0 + tx * b1 + hx * b2


@jit
def moments_row(cells, c, tile, g, k):
    """Along y only: w f and w r_y f."""
    ty, hy, ry = place_along_y(tile, g, k)
    f0, f1, f2 = load(cells, c), load(cells, c + 1), load(cells, c + 2)
    return f0 + ty * f1 + hy * f2, 0.25 * f1 + ry * f2


@jit
def slopes(cells, tile, g, k, f, a, b):
    """Derivatives along x and y, per cell, of f.sum(w F) + a.sum(w r_x F) + b.sum(w r_y F).

    F is the cells' field. As records: the derivative is the sum of their numbers.
    """
    c = COEFFICIENTS * int(number(tile.cell, g, k))
    tx, hx, rx = place_along_x(tile, g, k)
    _, _, s0, _ = slopes_row(cells, c, tile, g, k)
    f1, b1, s1, k1 = slopes_row(cells, c + 3, tile, g, k)
    f2, b2, s2, k2 = slopes_row(cells, c + 6, tile, g, k)
    k0 = load(cells, c + 2)
    _, hy, _ = place_along_y(tile, g, k)
    along_x = (f1 + tx * f2) * f + ((0.375 - 3.0 * hx) * f2) * a + (b1 + tx * b2) * b
    bent = (0.375 - 3.0 * hy) * (k0 + tx * k1 + hx * k2)
    along_y = (s0 + tx * s1 + hx * s2) * f + (0.25 * s1 + rx * s2) * a + bent * b
    return along_x, along_y


@jit
def slopes_row(cells, c, tile, g, k):
    """Along y only: w f, w r_y f, and of the former slope and curvature."""
    ty, _, _ = place_along_y(tile, g, k)
    f, b = moments_row(cells, c, tile, g, k)
    curvature = load(cells, c + 2)
    return f, b, load(cells, c + 1) + ty * curvature, curvature


@jit
def deposit_value(cells, tile, g, k, f):
    """Add the moments of w f alone, as `deposit` does with a = b = 0."""
    c = COEFFICIENTS * int(number(tile.cell, g, k))
    tx, hx, _ = place_along_x(tile, g, k)
    ty, hy, _ = place_along_y(tile, g, k)
    tf, hf = tx * f, hx * f
    add(cells, c, f)
    add(cells, c + 1, ty * f)
    add(cells, c + 2, hy * f)
    add(cells, c + 3, tf)
    add(cells, c + 4, ty * tf)
    add(cells, c + 5, hy * tf)
    add(cells, c + 6, hf)
    add(cells, c + 7, ty * hf)
    add(cells, c + 8, hy * hf)


@jit
def value_and_slopes(cells, tile, g, k):
    """The cells' field at particle k of a group, and its derivatives along x and y, per cell."""
    c = COEFFICIENTS * int(number(tile.cell, g, k))
    tx, hx, _ = place_along_x(tile, g, k)
    f0, _, s0, _ = slopes_row(cells, c, tile, g, k)
    f1, _, s1, _ = slopes_row(cells, c + 3, tile, g, k)
    f2, _, s2, _ = slopes_row(cells, c + 6, tile, g, k)
    return f0 + tx * f1 + hx * f2, f1 + tx * f2, s0 + tx * s1 + hx * s2


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
def find_window(state, parameters, first, last):
    """Window (i0, j0, ni, nj) of the nodes that particles touch; whether all are on the grid."""
    per_dx, end_x, end_y = parameters.per_dx, parameters.nodes_x - 2.0, parameters.nodes_y - 2.0
    i_max = j_max = real(nothing(state))
    i_min, j_min = i_max + parameters.nodes_x, j_max + parameters.nodes_y
    for g in range(first, last):
        x = cell_coordinate(real(load(state, at(g, POSITION))), per_dx)
        y = cell_coordinate(real(load(state, at(g, POSITION + 1))), per_dx)
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
def locate(state, parameters, part, tile, first, last):
    """The cells of the particles in the window `part` and their places in them, into the tile."""
    i0, j0, _, nj = part
    per_dx = parameters.per_dx
    for g in range(first, last):
        k = g - first
        x, y = load(state, at(g, POSITION)), load(state, at(g, POSITION + 1))
        i = whole(cell_coordinate(real(x), per_dx))
        j = whole(cell_coordinate(real(y), per_dx))
        store(tile.cell, k, (nj - 2) * (i - i0) + (j - j0))
        tx, ty = per_dx * x - (i + 1.0), per_dx * y - (j + 1.0)
        hx, hy = 0.5 * tx * tx, 0.5 * ty * ty
        store_place(tile, k, tx, hx, tx * (0.375 - hx), 0)
        store_place(tile, k, ty, hy, ty * (0.375 - hy), 1)


@jit
def whole_window(windows, parameters):
    """Window (i0, j0, ni, nj) that holds those of all blocks (B, 4), and their mirror images."""
    i0, j0, i1, j1 = parameters.nodes_x, parameters.nodes_y, 0, 0
    for b in range(windows.shape[0]):
        i0 = min(i0, windows[b, 0])
        j0 = min(j0, windows[b, 1])
        i1 = max(i1, windows[b, 0] + windows[b, 2])
        j1 = max(j1, windows[b, 1] + windows[b, 3])
    if parameters.mirror_axis == 0:
        i0 = min(i0, 2 * parameters.mirror_node - (i1 - 1))
    elif parameters.mirror_axis == 1:
        j0 = min(j0, 2 * parameters.mirror_node - (j1 - 1))
    return i0, j0, i1 - i0, j1 - j0


@jit
def first_outside(state, parameters, first, last):
    """The first particle of groups of four that is off the grid, or is not a number."""
    per_dx, end_x, end_y = parameters.per_dx, parameters.nodes_x - 2.0, parameters.nodes_y - 2.0
    for p in range(4 * first, 4 * last):
        x = cell_coordinate(state[at(p // 4, POSITION), p % 4].real, per_dx)
        y = cell_coordinate(state[at(p // 4, POSITION + 1), p % 4].real, per_dx)
        if not (0.0 <= x < end_x and 0.0 <= y < end_y):
            return p
    return -1
