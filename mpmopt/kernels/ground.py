"""Signed distance and normal of ground: polylines whose first and last segment have no end.

The distance is positive on the free side and its gradient is the normal n, whose own derivative is
(I - n n^T) / d at a corner and zero elsewhere. Which part of a polyline is the nearest is decided
by real parts.
"""

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from mpmopt.kernels.arrays import POSITION, at
from mpmopt.kernels.compiler import jit, loop_jit
from mpmopt.kernels.simd import cell_coordinate, load, real, within

# Columns of a segment: first point, unit vector along it, where it begins and ends as distances
# from the first point, and at both ends the direction that parts the free side from the solid one.
START, ALONG, LOW, HIGH, LEFT, RIGHT = 0, 2, 4, 5, 6, 8
SEGMENT_SIZE = 10
# Columns of a layer: what `layer` needs of one ground. The last three are copied to nodes.
LAYER = THICKNESS, STIFFNESS, FRICTION, DAMPING, CREEPING = range(5)
# Columns of a node: the nearest ground's normal, friction (infinite: sticks), damping and creeping.
NODE_NORMAL, NODE_FRICTION, NODE_DAMPING, NODE_CREEPING = 0, 2, 3, 4
NODE_COLUMNS = 5


class Ground(NamedTuple):
    """K polylines of S segments in all, and what they are at the M nodes of the grid."""

    segments: NDArray[np.float64]  # (S, 10)
    first: NDArray[np.int64]  # (K + 1,) first segment of each polyline, and S
    layers: NDArray[np.float64]  # (K, 5)
    nodes: NDArray[np.float64]  # (M, 5); node (i, j) has number i * nodes_y + j
    clearance: NDArray[np.float64]  # (M,) how far a node is from the nearest layer


@jit
def distance(x, y, ground, k):
    """Signed distance of a place from polyline k, its unit normal, and 1/d at a corner or 0."""
    segments = ground.segments
    best, nearest, place, beyond = math.inf, ground.first[k], 0.0, 0.0
    for s in range(ground.first[k], ground.first[k + 1]):
        rx, ry = float(x.real) - segments[s, START], float(y.real) - segments[s, START + 1]
        tx, ty = segments[s, ALONG], segments[s, ALONG + 1]
        along = rx * tx + ry * ty
        here = min(max(along, segments[s, LOW]), segments[s, HIGH])
        gx, gy = rx - here * tx, ry - here * ty
        gap = gx * gx + gy * gy
        if gap < best:
            best, nearest, place, beyond = gap, s, here, along - here
    tx, ty = segments[nearest, ALONG], segments[nearest, ALONG + 1]
    rx, ry = x - segments[nearest, START], y - segments[nearest, START + 1]
    if beyond == 0.0 or best == 0.0:
        d = tx * ry - ty * rx
        return d, -ty + 0.0 * d, tx + 0.0 * d, 0.0 * d
    rx, ry = rx - place * tx, ry - place * ty
    end = RIGHT if beyond > 0.0 else LEFT
    side = segments[nearest, end] * rx.real + segments[nearest, end + 1] * ry.real
    d = np.sqrt(rx * rx + ry * ry)
    if side < 0.0:
        d = -d
    bend = 1.0 / d
    return d, rx * bend, ry * bend, bend


@jit
def distance_adjoint(nx, ny, bend, d_bar, nx_bar, ny_bar):
    """From d_bar and n_bar to x_bar: d_bar n + bend (I - n n^T) n_bar."""
    across = nx * nx_bar + ny * ny_bar
    return (
        d_bar * nx + bend * (nx_bar - across * nx),
        d_bar * ny + bend * (ny_bar - across * ny),
    )


@jit
def is_clear(state, parameters, g):
    """Whether a group of particles is farther from ground than its layers are thick.

    A distance changes by no more than one goes: all of the group are nearer to the first one's
    middle node than that is to a layer.
    """
    x, y = real(load(state, at(g, POSITION))), real(load(state, at(g, POSITION + 1)))
    i = int(cell_coordinate(x[0], parameters.per_dx)) + 1
    j = int(cell_coordinate(y[0], parameters.per_dx)) + 1
    clearance = parameters.ground.clearance[i * parameters.nodes_y + j]
    rx, ry = x - i * parameters.dx, y - j * parameters.dx
    return clearance > 0.0 and within(rx * rx + ry * ry, -1.0, clearance * clearance)


@jit
def deepest(x, y, ground):
    """The polyline that a place is the deepest in, the normal of that, and how far layers are."""
    k, nx, ny, least, clearance = 0, 0.0, 0.0, math.inf, math.inf
    for n in range(len(ground.layers)):
        d, x_n, y_n, _ = distance(x, y, ground, n)
        clearance = min(clearance, d - ground.layers[n, THICKNESS])
        if d < least:
            k, nx, ny, least = n, x_n, y_n, d
    return k, nx, ny, clearance


@loop_jit
def tabulate(ground: Any, nodes_y: int, dx: float) -> None:
    """Fill in the nodes' columns, of the ground that each is the deepest in, and clearances.

    Halfway between two sides a node takes the mean of their normals, as symmetry wants it.
    """
    step = 1e-8 * dx
    for node in range(len(ground.nodes)):
        x, y = (node // nodes_y) * dx, (node % nodes_y) * dx
        k, nx, ny, ground.clearance[node] = deepest(x, y, ground)
        mean_x = mean_y = 0.0
        for sx, sy in ((-step, -step), (-step, step), (step, -step), (step, step)):
            _, x_n, y_n, _ = deepest(x + sx, y + sy, ground)
            mean_x, mean_y = mean_x + 0.25 * x_n, mean_y + 0.25 * y_n
        length = math.sqrt(mean_x * mean_x + mean_y * mean_y)
        if 0.1 < length < 1.0 - 1e-6:
            nx, ny = mean_x / length, mean_y / length
        ground.nodes[node, NODE_NORMAL], ground.nodes[node, NODE_NORMAL + 1] = nx, ny
        for column in range(3):
            ground.nodes[node, NODE_FRICTION + column] = ground.layers[k, FRICTION + column]
