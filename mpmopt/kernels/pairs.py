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

from mpmopt.kernels.compiler import bare_jit, inner_jit, inner_loop_jit, loop_jit
from mpmopt.kernels.overlap import FAR

# Distance d_c below which two particles push each other, in cells.
REACH = 0.75
# By how much nearness reaches beyond that, in cells: of particles, and of cells.
SKIN, WIDE_SKIN = 0.3 * REACH, 1.5
# Part of a skin that a node may move before a list is renewed: half, less what is rounding.
HALF = 0.499
# Cells of a block along each axis. Neighbours by an edge hold nothing that was far apart.
SIDE = 2
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
    values: NDArray[np.float64]  # (n, 3) weights of a cell's nodes along an axis
    weights: NDArray[np.float64]  # (n n, 9) N_ip of the nodes of a particle's cell
    grip: NDArray  # (C, n n) g of the particles
    cells: NDArray[np.int64]  # those with a grip above zero
    blocks: NDArray[np.int64]  # (B, 4) these cells, `SIDE` by `SIDE`, or -1
    block_corner: NDArray[np.int64]  # (2 B, 2) place of the first cell of a block, and of its image
    influence: NDArray[np.float64]  # (M,) root of the lattice's at nodes of these cells, else 0
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
    room: float  # by how much others of these cells' pairs must come nearer to touch


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

    No particle is displaced from a place by more than the most of influence times a node's
    displacement from there. The place is the middle of the box of displacements of nodes that count
    in full: what all share brings none nearer. Along a mirror plane's normal an image goes the
    other way.
    """
    if at[0, 0] == NOWHERE:
        return math.inf
    low_x = low_y = math.inf
    high_x = high_y = -math.inf
    for i in range(at.shape[1]):
        if touch.influence[i] >= 1.0:
            dx, dy = nodes[0, i].real - at[0, i], nodes[1, i].real - at[1, i]
            low_x, high_x = min(low_x, dx), max(high_x, dx)
            low_y, high_y = min(low_y, dy), max(high_y, dy)
    if high_x < low_x:
        return 0.0  # nothing may touch anything
    middle_x = 0.0 if touch.axis == 0 else 0.5 * (low_x + high_x)
    middle_y = 0.0 if touch.axis == 1 else 0.5 * (low_y + high_y)
    most_x = most_y = 0.0
    for i in range(at.shape[1]):
        dx, dy = nodes[0, i].real - at[0, i] - middle_x, nodes[1, i].real - at[1, i] - middle_y
        most_x = max(most_x, touch.influence[i] * abs(dx))
        most_y = max(most_y, touch.influence[i] * abs(dy))
    return math.hypot(most_x, most_y)


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
        0.0,
    )


@inner_loop_jit
def look_for_cells(nodes, touch):
    """Pairs of cells whose particles may come to touch: own cells, and own ones with images.

    Blocks of cells are sorted into bins by the middles of their boxes. Bins are as wide as what is
    near may be apart. Pairs are in ascending order.
    """
    count, reach, own = len(touch.grip), (REACH + WIDE_SKIN) * touch.dx, len(touch.blocks)
    cells = boxes_of_cells(nodes, touch)
    blocks, which, units = boxes_of_blocks(cells, touch, reach)
    low_x = low_y = math.inf
    high_x = high_y = -math.inf
    width = 0.0
    for n in range(units):
        x0, y0, x1, y1 = blocks[n, 0], blocks[n, 1], blocks[n, 2], blocks[n, 3]
        low_x, high_x = min(low_x, x0), max(high_x, x1)
        low_y, high_y = min(low_y, y0), max(high_y, y1)
        width = max(width, x1 - x0, y1 - y0)
    most = 2 * int(math.sqrt(units)) + 1
    width += reach
    columns = int(min((high_x - low_x) / width, most)) + 1
    rows = int(min((high_y - low_y) / width, most)) + 1
    per_x = 1.0 / max(width, (high_x - low_x) / columns)
    per_y = 1.0 / max(width, (high_y - low_y) / rows)
    newest, older = np.full(columns * rows, -1), np.empty(units, np.int64)
    found, total = np.empty(64, np.int64), 0
    rim = 1.0 - 1.0 / touch.per_cell
    for n in range(units - 1, -1, -1):  # images first, so that own blocks meet all of them
        i = int((0.5 * (blocks[n, 0] + blocks[n, 2]) - low_x) * per_x)
        j = int((0.5 * (blocks[n, 1] + blocks[n, 3]) - low_y) * per_y)
        i, j = min(i, columns - 1), min(j, rows - 1)
        for a in range(max(i - 1, 0), min(i + 2, columns)):
            for b in range(max(j - 1, 0), min(j + 2, rows)):
                m = newest[a * rows + b]
                while m >= 0 and n < own:
                    if are_far_and_near(blocks, n, m, rim + SIDE - 1, reach):
                        if total + SIDE**4 > len(found):
                            found = grown(found)
                        total = add_cells(found, total, which[n], which[m], cells, touch, reach)
                    m = older[m]
        older[n] = newest[i * rows + j]
        newest[i * rows + j] = n
    sort(found, total)
    return unpacked(found, total, 2 * count)


@inner_jit
def grown(keys):
    """The same with room for twice as many."""
    more = np.empty(2 * len(keys), np.int64)
    for n in range(len(keys)):
        more[n] = keys[n]
    return more


@bare_jit
def sort(keys, total):
    """Put so many keys in ascending order (Shell 1959)."""
    gap = total // 2
    while gap > 0:
        for n in range(gap, total):
            key, m = keys[n], n
            while m >= gap and keys[m - gap] > key:
                keys[m] = keys[m - gap]
                m -= gap
            keys[m] = key
        gap //= 2


@inner_jit
def unpacked(keys, total, base):
    """The pairs (total, 2) a, b of keys a base + b."""
    pairs = np.empty((total, 2), np.int64)
    for n in range(total):
        pairs[n, 0], pairs[n, 1] = keys[n] // base, keys[n] % base
    return pairs


@inner_loop_jit
def boxes_of_cells(nodes, touch):
    """Boxes (2 C, 6) about the particles of cells and images, and their places on the lattice.

    Numbers are x0, y0, x1, y1 in the state, and i, j in the reference configuration.
    """
    count, M, step = len(touch.grip), nodes.shape[1], touch.offset[1]
    last = M - touch.offset[8]
    sums, ends = np.empty(M), np.empty((4, M))
    ends[:2], ends[2:] = math.inf, -math.inf
    for axis in range(2):
        along, low, high = nodes[axis], ends[axis], ends[2 + axis]
        for b in range(touch.per_cell):
            v0, v1, v2 = touch.values[b, 0], touch.values[b, 1], touch.values[b, 2]
            for i in range(M - 2 * step):
                sums[i] = v0 * along[i] + v1 * along[i + step] + v2 * along[i + 2 * step]
            for a in range(touch.per_cell):
                w0, w1, w2 = touch.values[a, 0], touch.values[a, 1], touch.values[a, 2]
                for i in range(last):
                    x = w0 * sums[i] + w1 * sums[i + 1] + w2 * sums[i + 2]
                    low[i] = x if x < low[i] else low[i]
                    high[i] = x if x > high[i] else high[i]
    boxes = np.empty((2 * count, 6))
    for n in range(len(touch.cells)):
        c = touch.cells[n]
        for k in range(4):
            boxes[c, k] = ends[k, touch.first[c]]
        boxes[c, 4], boxes[c, 5] = touch.corner[c, 0], touch.corner[c, 1]
        if touch.axis >= 0:
            add_image(boxes, c, count + c, touch)
            boxes[count + c, 4] = touch.corner[count + c, 0]
            boxes[count + c, 5] = touch.corner[count + c, 1]
    return boxes


@bare_jit
def add_image(boxes, n, m, touch):
    """Makes box m that of the image of box n."""
    x0, y0 = imaged(boxes[n, 0], boxes[n, 1], touch)
    x1, y1 = imaged(boxes[n, 2], boxes[n, 3], touch)
    boxes[m, 0], boxes[m, 2] = min(x0, x1), max(x0, x1)
    boxes[m, 1], boxes[m, 3] = min(y0, y1), max(y0, y1)


@inner_loop_jit
def boxes_of_blocks(cells, touch, reach):
    """The same of blocks, and of those images that may be near to any; which, and their number."""
    own = len(touch.blocks)
    boxes, which, units = np.empty((2 * own, 6)), np.empty(2 * own, np.int64), own
    high = -math.inf
    for n in range(own):
        x0 = y0 = math.inf
        x1 = y1 = -math.inf
        for k in range(SIDE * SIDE):
            c = touch.blocks[n, k]
            if c >= 0:
                x0, y0 = min(x0, cells[c, 0]), min(y0, cells[c, 1])
                x1, y1 = max(x1, cells[c, 2]), max(y1, cells[c, 3])
        boxes[n, 0], boxes[n, 1], boxes[n, 2], boxes[n, 3] = x0, y0, x1, y1
        high = max(high, x1 if touch.axis == 0 else y1)
        which[n] = n
    if touch.axis >= 0:
        for n in range(own):
            if boxes[n, 2 + touch.axis] + high + reach > 2.0 * touch.plane:
                add_image(boxes, n, units, touch)
                which[units] = own + n
                units += 1
    for n in range(units):
        boxes[n, 4] = touch.block_corner[which[n], 0]
        boxes[n, 5] = touch.block_corner[which[n], 1]
    return boxes, which, units


@bare_jit
def are_far_and_near(boxes, n, m, rim, reach):
    """Whether two boxes are nearer than `reach`, and were farther apart than what is one part.

    `rim` is the width of a box in the reference configuration, in cells.
    """
    i, j = abs(boxes[m, 4] - boxes[n, 4]) + rim, abs(boxes[m, 5] - boxes[n, 5]) + rim
    x = max(boxes[m, 0] - boxes[n, 2], boxes[n, 0] - boxes[m, 2], 0.0)
    y = max(boxes[m, 1] - boxes[n, 3], boxes[n, 1] - boxes[m, 3], 0.0)
    return i * i + j * j > FAR * FAR and x * x + y * y < reach * reach


@bare_jit
def add_cells(found, total, n, m, boxes, touch, reach):
    """Adds keys of near cells of block n and of block or image m; returns how many there are."""
    count, own = len(touch.grip), len(touch.blocks)
    other, shift = (m - own, count) if m >= own else (m, 0)
    rim = 1.0 - 1.0 / touch.per_cell
    for i in range(SIDE * SIDE):
        c = touch.blocks[n, i]
        for j in range(SIDE * SIDE):
            d = touch.blocks[other, j]
            # A cell and another's image are the other and this one's image: one of them counts.
            counts = c >= 0 and d >= 0 and (d >= c or shift == 0)
            if counts and are_far_and_near(boxes, c, d + shift, rim, reach):
                found[total] = min(c, d) * 2 * count + max(c, d) + shift
                total += 1
    return total


@inner_loop_jit
def look_for_particles(nodes, touch, cells):
    """Pairs of particles of near cells that may come to touch, and the cells that they are of.

    And by how much the nearest of the other pairs must come nearer to touch.
    """
    count, size = touch.grip.shape
    reach, far = (REACH + SKIN) * touch.dx, (FAR * touch.per_cell) ** 2
    found, total, others = np.empty(64, np.int64), 0, math.inf
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
                square = dx * dx + dy * dy
                if square < max(reach * reach, others):
                    i, j = site(touch, a, k)
                    p, q = site(touch, b, m)
                    apart = (i - p) ** 2 + (j - q) ** 2 > far
                    if apart and touch.grip[a, k].real > 0.0 and touch.grip[own, m].real > 0.0:
                        if square >= reach * reach:
                            others = square
                            continue
                        if total == len(found):
                            found = grown(found)
                        found[total] = (a * size + k) * 2 * count * size + b * size + m
                        total += 1
                        there[a] = there[own] = True
    room = math.sqrt(others) - REACH * touch.dx
    members, own = np.empty(count, np.int64), 0
    for c in range(count):
        if there[c]:
            members[own] = c
            own += 1
    members = members[:own]
    return unpacked(found, total, 2 * count * size), members, room


@inner_jit
def places(nodes):
    """Real parts (2, M) of the nodes' positions."""
    at = np.empty((2, nodes.shape[1]))
    for i in range(nodes.shape[1]):
        at[0, i], at[1, i] = nodes[0, i].real, nodes[1, i].real
    return at


@loop_jit
def renewed(near: Any, nodes: NDArray, touch: Any) -> tuple[Near, float]:
    """The lists for nodes (., M), of which the first two rows are x and y: anew if they moved.

    And by how much all nodes may move before they have to be asked for again.
    """
    moved, may = strayed(nodes, near.cells_at, touch), HALF * WIDE_SKIN * touch.dx
    if moved > may:
        at, old, moved = places(nodes), nowhere(touch), 0.0
        cells = look_for_cells(at, touch)
        if len(cells) == 0:
            for i in range(at.shape[1]):
                touch.alone[0, i], touch.alone[1, i] = at[0, i], at[1, i]
        near = Near(at, cells, old.at, old.pairs, old.members, old.room)
    room = may - moved
    if len(near.cells) > 0:
        moved = strayed(nodes, near.at, touch)
        if moved > HALF * near.room:
            at, moved = places(nodes), 0.0
            pairs, members, free = look_for_particles(at, touch, near.cells)
            near = Near(near.cells_at, near.cells, at, pairs, members, free)
        room = min(room, HALF * near.room - moved)
    return near, room


@bare_jit
def way_between(pairs, n, place, touch):
    """The particles of a pair, whether the second is there as its image, and the way from there."""
    a, b = pairs[n, 0], pairs[n, 1] % touch.grip.size
    image = pairs[n, 1] != b
    x, y = place[b, 0], place[b, 1]
    if image:
        x, y = imaged(x, y, touch)
    return a, b, image, place[a, 0] - x, place[a, 1] - y


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
        a, b, image, dx, dy = way_between(near.pairs, n, place, touch)
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
        a, b, image, dx, dy = way_between(near.pairs, n, place, touch)
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
