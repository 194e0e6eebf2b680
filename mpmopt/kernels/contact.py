"""The law of contact: what becomes of the velocity of a node behind a wall, or in a clamp.

A wall is a row of numbers, whose columns are named here; `scene.Wall.row` makes them. A law is
`response` and `response_derivative`; `wall` and `wall_adjoint` apply it at all walls of a node.
"""

import numpy as np

from mpmopt.kernels.compiler import jit
from mpmopt.kernels.simd import fused

# Axis of the normal, 0 or 1; side: +1 clamps the nodes below `NODE`, -1 those above; Coulomb's
# coefficient, infinite: sticks.
COLUMNS = AXIS, SIDE, NODE, FRICTION = range(4)


@jit
def response(un, ut, walls, k):
    """Normal and tangential velocity of a node after wall k, which it is behind.

    Only an approaching node is touched: its normal velocity becomes zero and friction takes at most
    the coefficient times as much of its tangential velocity.
    """
    if walls[k, SIDE] * un.real < 0.0:
        keep, slope = friction(un.real, ut.real, walls, k)
        return 0.0 * un, fused(slope, un, keep * ut)
    return un, ut


@jit
def response_derivative(un, ut, walls, k):
    """Derivatives of `response`: of the normal velocity by both, and of the tangential by both."""
    if walls[k, SIDE] * un < 0.0:
        keep, slope = friction(un, ut, walls, k)
        return 0.0, 0.0, slope, keep
    return 1.0, 0.0, 0.0, 1.0


@jit
def friction(un, ut, walls, k):
    """What an approaching node's tangential velocity becomes: keep ut + slope un."""
    if abs(ut) < walls[k, FRICTION] * abs(un):  # without friction nothing sticks, at rest either
        return 0.0, 0.0
    return 1.0, np.sign(ut) * walls[k, FRICTION] * walls[k, SIDE]


@jit
def wall(i, j, u, v, parameters):
    """Velocity of node (i, j) after the walls, one after the other."""
    walls = parameters.walls
    for k in range(len(walls)):
        if is_behind(i, j, walls, k):
            if walls[k, AXIS] == 0:
                u, v = response(u, v, walls, k)
            else:
                v, u = response(v, u, walls, k)
    return u, v


@jit
def wall_adjoint(i, j, u, v, parameters, u_bar, v_bar):
    """Transpose of `wall`: through the derivative D of its responses, of (u, v) by (u, v)."""
    d00, d01, d10, d11 = 1.0, 0.0, 0.0, 1.0
    walls = parameters.walls
    for k in range(len(walls)):
        if is_behind(i, j, walls, k):
            if walls[k, AXIS] == 0:
                uu, uv, vu, vv = response_derivative(u, v, walls, k)
                u, v = response(u, v, walls, k)
            else:
                vv, vu, uv, uu = response_derivative(v, u, walls, k)
                v, u = response(v, u, walls, k)
            d00, d10 = uu * d00 + uv * d10, vu * d00 + vv * d10
            d01, d11 = uu * d01 + uv * d11, vu * d01 + vv * d11
    return d00 * u_bar + d10 * v_bar, d01 * u_bar + d11 * v_bar


@jit
def clamp_of(i, j, clamps, dx):
    """The first of the clamps (K, 6) of a step that holds node (i, j), or -1."""
    for k in range(len(clamps)):
        if clamps[k, 0] <= i * dx <= clamps[k, 2] and clamps[k, 1] <= j * dx <= clamps[k, 3]:
            return k
    return -1


@jit
def is_behind(i, j, walls, k):
    """Whether node (i, j) is strictly behind wall k."""
    node = i if walls[k, AXIS] == 0 else j
    return walls[k, SIDE] * (walls[k, NODE] - node) > 0
