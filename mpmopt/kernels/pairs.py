"""Self-contact of a body on its lattice: particles that were far apart push each other when near.

A pair is pushed apart along its line with f = g_a g_b (d_c - r) at a distance r below d_c, where
g^2 = k <gamma - gamma_0>^2 / (1 - gamma_0)^2, k = 2 m_p (c_p / h)^2: void does not push. The force
is a function of the state alone. Lists of near cells, and of near particles in them, are a matter
of speed: they hold all pairs that touch in any state near the one they were made at, in the same
order, and what does not touch adds nothing. So the bits do not depend on when a list is renewed.
(Lists with a skin: Verlet 1967.)
"""

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from mpmopt.kernels.compiler import jit, loop_jit
from mpmopt.kernels.overlap import FAR

# Distance d_c below which two particles push each other, in cells.
REACH = 0.75
# By how much nearness reaches beyond that, in cells: of particles, and of cells.
SKIN, WIDE_SKIN = 0.3 * REACH, 1.0
# Part of a skin that a node may move before a list is renewed: half, less what is rounding.
HALF = 0.499
# Where nodes are that were nowhere yet.
NOWHERE = 1e150
# gamma_0, the share of the solid's stiffness below which a particle pushes nothing.
LEAST_STIFFNESS = 0.05


class Touch(NamedTuple):
    """What of a body may touch the rest of it: C cells with n x n particles in each, M nodes."""

    dx: float
    per_cell: int  # n
    axis: int  # of a mirror plane's normal, 0 or 1; -1: no mirror
    plane: float  # its position
    corner: NDArray[np.int64]  # (2 C, 2) place of a cell, and of its image, on the lattice
    first: NDArray[np.int64]  # (C,) first node of a cell
    offset: NDArray[np.int64]  # (9,) of the cell's nodes from the first
    weights: NDArray[np.float64]  # (n n, 9) N_ip of the nodes of a particle's cell
    grip: NDArray  # (C, n n) g of the particles
    cells: NDArray[np.int64]  # those with a grip above zero
    nodes: NDArray[np.float64]  # (M,) 1 for the nodes of these cells, else 0
    alone: NDArray[np.float64]  # (2, M) where the nodes were when no cells were near; a cache


class Near(NamedTuple):
    """Lists that hold for all states whose nodes are near where they were.

    Cells with numbers from C on, and particles from C n n on, are images across the mirror plane.
    """

    cells_at: NDArray[np.float64]  # (2, M) nodes when near cells were looked for
    cells: NDArray[np.int64]  # (., 2)
    at: NDArray[np.float64]  # (2, M) nodes when near particles were looked for
    pairs: NDArray[np.int64]  # (., 2) of particles
    members: NDArray[np.int64]  # cells that have particles in pairs


@jit
def position(nodes, touch, cell, k):
    """Of particle k of a cell, from the first two rows of numbers of the nodes."""
    first = touch.first[cell]
    x = y = 0.0 * nodes[0, first]
    for m in range(9):
        w, i = touch.weights[k, m], first + touch.offset[m]
        x += w * nodes[0, i]
        y += w * nodes[1, i]
    return x, y


@jit
def site(touch, cell, k):
    """Of a particle or an image on the lattice of particles in the reference configuration."""
    i, j, n = k // touch.per_cell, k % touch.per_cell, touch.per_cell
    if cell >= len(touch.grip):  # an image is seen from behind
        i, j = (n - 1 - i, j) if touch.axis == 0 else (i, n - 1 - j)
    return n * touch.corner[cell, 0] + i, n * touch.corner[cell, 1] + j


@jit
def imaged(x, y, touch):
    """Position of an image."""
    return (2.0 * touch.plane - x, y) if touch.axis == 0 else (x, 2.0 * touch.plane - y)


@jit
def flipped(x, y, touch):
    """Direction of an image."""
    return (-x, y) if touch.axis == 0 else (x, -y)


@jit
def moved(nodes, at, touch, limit):
    """Whether a node of what may touch is farther than `limit` from where it was."""
    far = 0
    for i in range(at.shape[1]):
        dx, dy = nodes[0, i].real - at[0, i], nodes[1, i].real - at[1, i]
        far += touch.nodes[i] * (dx * dx + dy * dy) > limit * limit
    return far > 0


@loop_jit
def nowhere(touch: Any) -> Near:
    """Lists that hold for no state."""
    none = np.full(touch.alone.shape, NOWHERE)
    return Near(
        touch.alone,
        np.empty((0, 2), np.int64),
        none,
        np.empty((0, 2), np.int64),
        np.empty(0, np.int64),
    )


@loop_jit
def look_for_cells(nodes, touch):
    """Pairs of cells whose particles may come to touch: own cells, and own ones with images.

    Boxes of their particles are sorted into bins by their middles; bins are as wide as what is near
    may be apart. Pairs are in ascending order.
    """
    count, reach = len(touch.grip), (REACH + WIDE_SKIN) * touch.dx
    own = len(touch.cells)
    boxes = np.empty((2 * own, 4))
    cells = np.empty(2 * own, np.int64)
    low_x = low_y = math.inf
    high_x = high_y = -math.inf
    width = 0.0
    for n in range(own):
        c = touch.cells[n]
        x0 = y0 = math.inf
        x1 = y1 = -math.inf
        for k in range(touch.grip.shape[1]):
            if touch.grip[c, k].real > 0.0:
                x, y = position(nodes, touch, c, k)
                x0, x1, y0, y1 = min(x0, x), max(x1, x), min(y0, y), max(y1, y)
        cells[n] = c
        boxes[n, 0], boxes[n, 1], boxes[n, 2], boxes[n, 3] = x0, y0, x1, y1
        width = max(width, x1 - x0, y1 - y0)
        low_x, high_x = min(low_x, x0), max(high_x, x1)
        low_y, high_y = min(low_y, y0), max(high_y, y1)
    units = own
    if touch.axis >= 0:
        high = high_x if touch.axis == 0 else high_y
        for n in range(own):
            if boxes[n, 2 + touch.axis] + high + reach > 2.0 * touch.plane:
                cells[units] = count + cells[n]
                x0, y0 = imaged(boxes[n, 0], boxes[n, 1], touch)
                x1, y1 = imaged(boxes[n, 2], boxes[n, 3], touch)
                boxes[units, 0], boxes[units, 2] = min(x0, x1), max(x0, x1)
                boxes[units, 1], boxes[units, 3] = min(y0, y1), max(y0, y1)
                low_x, high_x = min(low_x, boxes[units, 0]), max(high_x, boxes[units, 2])
                low_y, high_y = min(low_y, boxes[units, 1]), max(high_y, boxes[units, 3])
                units += 1
    most = 2 * int(math.sqrt(units)) + 1
    width += reach
    columns = int(min((high_x - low_x) / width, most)) + 1
    rows = int(min((high_y - low_y) / width, most)) + 1
    width_x = max(width, (high_x - low_x) / columns)
    width_y = max(width, (high_y - low_y) / rows)
    newest, older = np.full(columns * rows, -1), np.empty(units, np.int64)
    found, partners = np.empty((64, 2), np.int64), np.empty(units, np.int64)
    total = 0
    # From the last to the first, so that those met before have larger numbers; images come first.
    for n in range(units - 1, -1, -1):
        x, y = 0.5 * (boxes[n, 0] + boxes[n, 2]), 0.5 * (boxes[n, 1] + boxes[n, 3])
        i, j = (
            min(int((x - low_x) / width_x), columns - 1),
            min(int((y - low_y) / width_y), rows - 1),
        )
        if cells[n] < count:
            size = 0
            for a in range(max(i - 1, 0), min(i + 2, columns)):
                for b in range(max(j - 1, 0), min(j + 2, rows)):
                    m = newest[a * rows + b]
                    while m >= 0:
                        # Most are near in the reference configuration.
                        if are_far(touch, cells[n], cells[m]):
                            gap_x = max(boxes[m, 0] - boxes[n, 2], boxes[n, 0] - boxes[m, 2], 0.0)
                            gap_y = max(boxes[m, 1] - boxes[n, 3], boxes[n, 1] - boxes[m, 3], 0.0)
                            near = gap_x * gap_x + gap_y * gap_y < reach * reach
                            # A cell and another's image are the other and this one's image.
                            if near and cells[m] % count >= cells[n]:
                                partners[size] = cells[m]
                                size += 1
                        m = older[m]
            partners[:size].sort()
            while total + size > len(found):
                found = np.concatenate((found, found))
            for m in range(size):
                # In descending order, which is turned round at the end.
                found[total, 0], found[total, 1] = cells[n], partners[size - 1 - m]
                total += 1
        older[n] = newest[i * rows + j]
        newest[i * rows + j] = n
    return found[:total][::-1].copy()


@jit
def are_far(touch, a, b):
    """Whether any particles of two cells were farther apart than what is one part."""
    rim = 1.0 - 1.0 / touch.per_cell
    i = abs(touch.corner[a, 0] - touch.corner[b, 0]) + rim
    j = abs(touch.corner[a, 1] - touch.corner[b, 1]) + rim
    return i * i + j * j > FAR * FAR


@loop_jit
def look_for_particles(nodes, touch, cells):
    """Pairs of particles of near cells that may come to touch, and the cells that they are of."""
    count, size = touch.grip.shape
    reach, far = (REACH + SKIN) * touch.dx, (FAR * touch.per_cell) ** 2
    found, total = np.empty((64, 2), np.int64), 0
    there = np.zeros(count, np.bool_)
    place, last = np.empty((2, size, 2)), -1
    for n in range(len(cells)):
        a, b = cells[n, 0], cells[n, 1]
        own = b % count
        for k in range(size):
            if a != last:
                place[0, k, 0], place[0, k, 1] = position(nodes, touch, a, k)
            x, y = position(nodes, touch, own, k)
            if own != b:
                x, y = imaged(x, y, touch)
            place[1, k, 0], place[1, k, 1] = x, y
        last = a
        for k in range(size):
            for m in range(k if a == own else 0, size):
                dx, dy = place[0, k, 0] - place[1, m, 0], place[0, k, 1] - place[1, m, 1]
                if dx * dx + dy * dy < reach * reach:
                    i, j = site(touch, a, k)
                    p, q = site(touch, b, m)
                    apart = (i - p) ** 2 + (j - q) ** 2 > far
                    if apart and touch.grip[a, k].real > 0.0 and touch.grip[own, m].real > 0.0:
                        if total == len(found):
                            found = np.concatenate((found, found))
                        found[total, 0], found[total, 1] = a * size + k, b * size + m
                        total += 1
                        there[a] = there[own] = True
    return found[:total].copy(), np.nonzero(there)[0]


@jit
def places(nodes):
    """Real parts (2, M) of the nodes' positions."""
    at = np.empty((2, nodes.shape[1]))
    for i in range(nodes.shape[1]):
        at[0, i], at[1, i] = nodes[0, i].real, nodes[1, i].real
    return at


@loop_jit
def renewed(near: Any, nodes: NDArray, touch: Any) -> Near:
    """The lists for nodes (., M), of which the first two rows are x and y: anew if they moved."""
    if moved(nodes, near.cells_at, touch, HALF * WIDE_SKIN * touch.dx):
        at, old = places(nodes), nowhere(touch)
        cells = look_for_cells(at, touch)
        if len(cells) == 0:
            touch.alone[:] = at
        near = Near(at, cells, old.at, old.pairs, old.members)
    if len(near.cells) > 0 and moved(nodes, near.at, touch, HALF * SKIN * touch.dx):
        at = places(nodes)
        pairs, members = look_for_particles(at, touch, near.cells)
        near = Near(near.cells_at, near.cells, at, pairs, members)
    return near


@loop_jit
def push_apart(near: Any, nodes: NDArray, touch: Any, force: NDArray) -> None:
    """Adds the pairs' forces to the first two rows of the nodes' `force` (., M)."""
    size, reach = touch.grip.shape[1], REACH * touch.dx
    count = touch.grip.size
    grip = touch.grip.ravel()
    place, pushes = np.empty((count, 2), nodes.dtype), np.zeros((count, 2), nodes.dtype)
    for c in near.members:
        for k in range(size):
            place[c * size + k, 0], place[c * size + k, 1] = position(nodes, touch, c, k)
    for n in range(len(near.pairs)):
        a, b = near.pairs[n, 0], near.pairs[n, 1] % count
        image = near.pairs[n, 1] != b
        x, y = place[b, 0], place[b, 1]
        if image:
            x, y = imaged(x, y, touch)
        dx, dy = place[a, 0] - x, place[a, 1] - y
        square = dx * dx + dy * dy
        if 0.0 < square.real < reach * reach:
            f = grip[a] * grip[b] * (reach / np.sqrt(square) - 1.0)
            dx, dy = f * dx, f * dy
            pushes[a, 0] += dx
            pushes[a, 1] += dy
            if image:
                dx, dy = flipped(dx, dy, touch)
            if a != b:  # the image of a particle pushes it as it is pushed, which is one force
                pushes[b, 0] -= dx
                pushes[b, 1] -= dy
    spread(near, touch, pushes, force)


@jit
def spread(near, touch, numbers, nodes):
    """Adds numbers (., 2) of particles to those of the nodes: the transpose of `position`."""
    size = touch.grip.shape[1]
    for c in near.members:
        first = touch.first[c]
        for k in range(size):
            x, y = numbers[c * size + k, 0], numbers[c * size + k, 1]
            if x != 0.0 or y != 0.0:
                for m in range(9):
                    w, i = touch.weights[k, m], first + touch.offset[m]
                    nodes[0, i] += w * x
                    nodes[1, i] += w * y


@loop_jit
def push_apart_adjoint(
    near: Any,
    nodes: NDArray,
    touch: Any,
    force_bar: NDArray,
    state_bar: NDArray,
    grip_bar: NDArray,
) -> None:
    """Adds to x_bar, the first two rows of the nodes' `state_bar`, and to `grip_bar` (C, n n)."""
    size, reach = touch.grip.shape[1], REACH * touch.dx
    count = touch.grip.size
    grip, grip_bar = touch.grip.ravel(), grip_bar.ravel()
    place, pushes_bar = np.empty((count, 2), nodes.dtype), np.empty((count, 2), nodes.dtype)
    place_bar = np.zeros((count, 2), nodes.dtype)
    for c in near.members:
        for k in range(size):
            p = c * size + k
            place[p, 0], place[p, 1] = position(nodes, touch, c, k)
            pushes_bar[p, 0], pushes_bar[p, 1] = position(force_bar, touch, c, k)
    for n in range(len(near.pairs)):
        a, b = near.pairs[n, 0], near.pairs[n, 1] % count
        image = near.pairs[n, 1] != b
        x, y = place[b, 0], place[b, 1]
        if image:
            x, y = imaged(x, y, touch)
        dx, dy = place[a, 0] - x, place[a, 1] - y
        square = dx * dx + dy * dy
        if 0.0 < square.real < reach * reach:
            r = np.sqrt(square)
            shape, full = reach / r - 1.0, grip[a] * grip[b]
            qx, qy = pushes_bar[a, 0], pushes_bar[a, 1]
            if a != b:
                bx, by = pushes_bar[b, 0], pushes_bar[b, 1]
                if image:
                    bx, by = flipped(bx, by, touch)
                qx, qy = qx - bx, qy - by
            along = dx * qx + dy * qy
            full_bar = shape * along
            turn = full * reach / (square * r) * along
            dx_bar, dy_bar = full * shape * qx - turn * dx, full * shape * qy - turn * dy
            grip_bar[a] += full_bar * grip[b]
            grip_bar[b] += full_bar * grip[a]
            place_bar[a, 0] += dx_bar
            place_bar[a, 1] += dy_bar
            if image:
                dx_bar, dy_bar = flipped(dx_bar, dy_bar, touch)
            place_bar[b, 0] -= dx_bar
            place_bar[b, 1] -= dy_bar
    spread(near, touch, place_bar, state_bar)


def grips(
    stiffness: NDArray, modulus: NDArray[np.float64], spacing: float, dx: float
) -> tuple[NDArray, NDArray]:
    """g of particles and its derivative by gamma, from gamma and the modulus of their solid.

    g^2 = 2 m_p (c_p / h)^2 of solid, where m_p c_p^2 is its area times lambda + 2 mu.
    """
    above = stiffness.real > LEAST_STIFFNESS
    scale = spacing / (dx * (1.0 - LEAST_STIFFNESS))
    slope: NDArray[np.float64] = np.where(above, scale * np.sqrt(2.0 * modulus), 0.0)
    return slope * (stiffness - LEAST_STIFFNESS), slope
