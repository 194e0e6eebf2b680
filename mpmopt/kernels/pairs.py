"""Self-contact of a body on its lattice: particles that were far apart push each other when near.

A pair is pushed apart along its line with f = g_a g_b (d_c - r) at a distance r below d_c, where
g^2 = k <gamma - gamma_0>^2 / (1 - gamma_0)^2, k = 2 m_p (c_p / h)^2: void does not push. The force
is a function of the state alone. A list of near cells is a matter of speed: it holds the cells of
all pairs that touch in any state near the one it was made at, in the same order. So the bits do
not depend on when it is renewed. (Lists with a skin: Verlet 1967.)
"""

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from mpmopt.kernels.compiler import bare_jit, inner_jit, inner_loop_jit
from mpmopt.kernels.overlap import FAR

# Distance d_c below which two particles push each other, in cells.
REACH = 0.75
# By how much nearness of cells reaches beyond that, in cells.
SKIN = 1.5
# Part of it that a node may move before the list is renewed: half, less what is rounding.
HALF = 0.499
# Where nodes are that were nowhere yet.
NOWHERE = math.inf
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
    """A list that holds for all states whose nodes are near where they were.

    Cells with numbers from C on, and particles from C n n on, are images across the mirror plane.
    """

    at: NDArray[np.float64]  # (2, M) nodes when near cells were looked for
    cells: NDArray[np.int64]  # (., 2)
    members: NDArray[np.int64]  # cells that are in pairs


@bare_jit
def position(nodes, touch, cell, k):
    """Of particle k of a cell, from the first two rows of numbers of the nodes."""
    first = touch.first[cell]
    x = y = 0.0 * nodes[0, first]
    for m in range(9):
        w, i = touch.weights[k, m], first + touch.offset[m]
        x += w * nodes[0, i]
        y += w * nodes[1, i]
    return x, y


@bare_jit
def site(touch, cell, k):
    """Of a particle or an image on the lattice of particles in the reference configuration."""
    i, j, n = k // touch.per_cell, k % touch.per_cell, touch.per_cell
    if cell >= len(touch.grip):  # an image is seen from behind
        i, j = (n - 1 - i, j) if touch.axis == 0 else (i, n - 1 - j)
    return n * touch.corner[cell, 0] + i, n * touch.corner[cell, 1] + j


@bare_jit
def imaged(x, y, touch):
    """Position of an image."""
    return (2.0 * touch.plane - x, y) if touch.axis == 0 else (x, 2.0 * touch.plane - y)


@bare_jit
def flipped(x, y, touch):
    """Direction of an image."""
    return (-x, y) if touch.axis == 0 else (x, -y)


@bare_jit
def strayed(nodes, at, touch):
    """By how much at most two of what may touch came nearer than they were, halved.

    Which is half the diagonal of the box of their displacements: what all share brings none nearer.
    Along a mirror plane's normal an image goes the other way.
    """
    if at[0, 0] == NOWHERE:
        return math.inf
    low_x = low_y = math.inf
    high_x = high_y = -math.inf
    for i in range(at.shape[1]):
        if touch.nodes[i] > 0.0:
            dx, dy = nodes[0, i].real - at[0, i], nodes[1, i].real - at[1, i]
            low_x, high_x = min(low_x, dx), max(high_x, dx)
            low_y, high_y = min(low_y, dy), max(high_y, dy)
    if high_x < low_x:
        return 0.0  # nothing may touch anything
    if touch.axis == 0:
        low_x, high_x = min(low_x, -high_x), max(high_x, -low_x)
    elif touch.axis == 1:
        low_y, high_y = min(low_y, -high_y), max(high_y, -low_y)
    return 0.5 * math.hypot(high_x - low_x, high_y - low_y)


@inner_loop_jit
def nowhere(touch: Any) -> Near:
    """A list that holds for no state but where no cells were near before."""
    return Near(touch.alone, np.empty((0, 2), np.int64), np.empty(0, np.int64))


@inner_loop_jit
def look(at, touch):
    """Near pairs of cells, own ones and own ones with images, for nodes (2, M).

    Cells are sorted into bins by the middles of the boxes about their particles. Bins are as wide
    as what is near may be apart. Pairs are in ascending order.
    """
    count, own = len(touch.grip), len(touch.cells)
    units, reach = own if touch.axis < 0 else 2 * own, (REACH + SKIN) * touch.dx
    boxes = np.empty((2 * own, 4))  # x0, y0, x1, y1
    put_boxes(at, touch, boxes)
    low, per, bins, width = np.empty(2), np.empty(2), np.empty(2, np.int64), 0.0
    for n in range(units):
        for axis in range(2):
            width = max(width, boxes[n, 2 + axis] - boxes[n, axis])
    for axis in range(2):
        low[axis], high = math.inf, -math.inf
        for n in range(units):
            low[axis] = min(low[axis], boxes[n, axis])
            high = max(high, boxes[n, 2 + axis])
        span = max(high - low[axis], 0.0)
        bins[axis] = int(min(span / (width + reach), 2.0 * math.sqrt(units))) + 1
        per[axis] = 1.0 / max(width + reach, span / bins[axis])
    newest, older = np.empty(bins[0] * bins[1], np.int64), np.empty(units, np.int64)
    newest[:] = -1
    keys, total = np.empty(64, np.int64), 0
    for n in range(units - 1, -1, -1):  # images first, so that own cells meet all of them
        i = min(int((0.5 * (boxes[n, 0] + boxes[n, 2]) - low[0]) * per[0]), bins[0] - 1)
        j = min(int((0.5 * (boxes[n, 1] + boxes[n, 3]) - low[1]) * per[1]), bins[1] - 1)
        place = i * bins[1] + j
        if n < own:
            first = total
            for a in range(max(i - 1, 0), min(i + 2, bins[0])):
                for b in range(max(j - 1, 0), min(j + 2, bins[1])):
                    m = newest[a * bins[1] + b]
                    while m >= 0:
                        # A cell and another's image are the other and this one's: one counts.
                        if (m < own or m - own >= n) and are_near(boxes, n, m, reach, touch):
                            if total == len(keys):
                                keys = grown(keys)
                            key, k = cell_of(touch, m), total
                            while k > first and keys[k - 1] < key:
                                keys[k] = keys[k - 1]
                                k -= 1
                            keys[k] = key
                            total += 1
                        m = older[m]
            for k in range(first, total):
                keys[k] += 2 * count * touch.cells[n]
        older[n], newest[place] = newest[place], n
    pairs = unpacked(keys, total, 2 * count)
    return pairs[::-1].copy()


@bare_jit
def put_boxes(at, touch, boxes):
    """Boxes about the particles of the cells that may touch, and about those of their images."""
    own = len(touch.cells)
    for n in range(own):
        for axis in range(2):
            low, high = math.inf, -math.inf
            for k in range(len(touch.weights)):
                x, first = 0.0, touch.first[touch.cells[n]]
                for m in range(9):
                    x += touch.weights[k, m] * at[axis, first + touch.offset[m]]
                low, high = min(low, x), max(high, x)
            boxes[n, axis], boxes[n, 2 + axis] = low, high
            if axis == touch.axis:
                low, high = 2.0 * touch.plane - high, 2.0 * touch.plane - low
            boxes[own + n, axis], boxes[own + n, 2 + axis] = low, high


@bare_jit
def cell_of(touch, n):
    """The number of the n-th cell that may touch, or image of one."""
    own = len(touch.cells)
    return touch.cells[n] if n < own else len(touch.grip) + touch.cells[n - own]


@bare_jit
def are_near(boxes, n, m, reach, touch):
    """Whether two cells are nearer than `reach`, and hold particles that were far apart."""
    c, d, rim = cell_of(touch, n), cell_of(touch, m), 1.0 - 1.0 / touch.per_cell
    i = abs(touch.corner[d, 0] - touch.corner[c, 0]) + rim
    j = abs(touch.corner[d, 1] - touch.corner[c, 1]) + rim
    if i * i + j * j <= FAR * FAR:
        return False  # as most are that lie in the same bins
    x = max(boxes[m, 0] - boxes[n, 2], boxes[n, 0] - boxes[m, 2], 0.0)
    y = max(boxes[m, 1] - boxes[n, 3], boxes[n, 1] - boxes[m, 3], 0.0)
    return x * x + y * y < reach * reach


@inner_jit
def grown(keys):
    """The same with room for twice as many."""
    more = np.empty(2 * len(keys), np.int64)
    for n in range(len(keys)):
        more[n] = keys[n]
    return more


@inner_jit
def unpacked(keys, total, base):
    """The pairs (total, 2) a, b of keys a base + b."""
    pairs = np.empty((total, 2), np.int64)
    for n in range(total):
        pairs[n, 0], pairs[n, 1] = keys[n] // base, keys[n] % base
    return pairs


@inner_jit
def members_of(cells, count):
    """Those of so many own cells that are in pairs, themselves or as images."""
    there, members, total = np.zeros(count, np.bool_), np.empty(count, np.int64), 0
    for n in range(len(cells)):
        there[cells[n, 0]] = there[cells[n, 1] % count] = True
    for c in range(count):
        if there[c]:
            members[total] = c
            total += 1
    return members[:total]


@inner_loop_jit
def renewed(near: Any, nodes: NDArray, touch: Any) -> tuple[Near, float]:
    """The list for nodes (., M), of which the first two rows are x and y: anew if they moved.

    And by how much all nodes may move before it has to be asked for again.
    """
    moved, may = strayed(nodes, near.at, touch), HALF * SKIN * touch.dx
    if moved > may:
        at, moved = np.empty((2, nodes.shape[1])), 0.0
        for axis in range(2):
            for i in range(nodes.shape[1]):
                at[axis, i] = nodes[axis, i].real
        cells = look(at, touch)
        if len(cells) == 0:
            for axis in range(2):
                for i in range(at.shape[1]):
                    touch.alone[axis, i] = at[axis, i]
        near = Near(at, cells, members_of(cells, len(touch.grip)))
    return near, may - moved


@inner_loop_jit
def touching(near, place, touch):
    """Pairs (., 2) of particles at places (., 2) that push each other."""
    count, size = touch.grip.shape
    reach, far = REACH * touch.dx, (FAR * touch.per_cell) ** 2
    keys, total = np.empty(64, np.int64), 0
    for n in range(len(near.cells)):
        a, b = near.cells[n, 0], near.cells[n, 1]
        own = b % count
        for k in range(size):
            for m in range(k if a == own else 0, size):
                x, y = place[own * size + m, 0].real, place[own * size + m, 1].real
                if own != b:
                    x, y = imaged(x, y, touch)
                dx, dy = place[a * size + k, 0].real - x, place[a * size + k, 1].real - y
                if 0.0 < dx * dx + dy * dy < reach * reach:
                    i, j = site(touch, a, k)
                    p, q = site(touch, b, m)
                    if (i - p) ** 2 + (j - q) ** 2 > far:
                        if total == len(keys):
                            keys = grown(keys)
                        keys[total] = (a * size + k) * 2 * count * size + b * size + m
                        total += 1
    return unpacked(keys, total, 2 * count * size)


@inner_jit
def placed(near, nodes, touch):
    """Places (C n n, 2) of the particles in near cells; the others' are not filled in."""
    size = touch.grip.shape[1]
    place = np.empty((touch.grip.size, 2), nodes.dtype)
    for c in near.members:
        for k in range(size):
            place[c * size + k, 0], place[c * size + k, 1] = position(nodes, touch, c, k)
    return place


@bare_jit
def way_between(pairs, n, place, touch):
    """The particles of a pair, whether the second is there as its image, and the way from there."""
    a, b = pairs[n, 0], pairs[n, 1] % touch.grip.size
    image = pairs[n, 1] != b
    x, y = place[b, 0], place[b, 1]
    if image:
        x, y = imaged(x, y, touch)
    return a, b, image, place[a, 0] - x, place[a, 1] - y


@inner_loop_jit
def push_apart(near: Any, nodes: NDArray, touch: Any, force: NDArray) -> None:
    """Adds the pairs' forces to the first two rows of the nodes' `force` (., M)."""
    reach, grip = REACH * touch.dx, touch.grip.ravel()
    place = placed(near, nodes, touch)
    pairs, pushes = touching(near, place, touch), np.zeros_like(place)
    for n in range(len(pairs)):
        a, b, image, dx, dy = way_between(pairs, n, place, touch)
        f = grip[a] * grip[b] * (reach / np.sqrt(dx * dx + dy * dy) - 1.0)
        dx, dy = f * dx, f * dy
        pushes[a, 0] += dx
        pushes[a, 1] += dy
        if image:
            dx, dy = flipped(dx, dy, touch)
        if a != b:  # the image of a particle pushes it as it is pushed, which is one force
            pushes[b, 0] -= dx
            pushes[b, 1] -= dy
    spread(near, touch, pushes, force)


@bare_jit
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


@inner_loop_jit
def push_apart_adjoint(
    near: Any,
    nodes: NDArray,
    touch: Any,
    force_bar: NDArray,
    state_bar: NDArray,
    grip_bar: NDArray,
) -> None:
    """Adds to x_bar, the first two rows of the nodes' `state_bar`, and to `grip_bar` (C, n n)."""
    reach, grip, grip_bar = REACH * touch.dx, touch.grip.ravel(), grip_bar.ravel()
    place, pushes_bar = placed(near, nodes, touch), placed(near, force_bar, touch)
    pairs, place_bar = touching(near, place, touch), np.zeros_like(place)
    for n in range(len(pairs)):
        a, b, image, dx, dy = way_between(pairs, n, place, touch)
        square = dx * dx + dy * dy
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
