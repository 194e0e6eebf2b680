"""The contact layer of ground: what bears a particle, and what resists the nodes that it moves.

The laws are functions of numbers: `bearing` of a particle at a distance d from ground, `resistance`
of the velocity of a node to which the layer gives momentum. `press` applies the first; in the total
Lagrangian formulation `lagrangian.press` applies `mean_bearing`.
"""

import math

import numpy as np

from mpmopt.kernels.arrays import MASS_BAR, POSITION, VELOCITY_BAR, at, in_tile
from mpmopt.kernels.compiler import jit
from mpmopt.kernels.ground import (
    NODE_CREEPING,
    NODE_DAMPING,
    NODE_FRICTION,
    NODE_NORMAL,
    STIFFNESS,
    THICKNESS,
    distance,
    distance_adjoint,
    is_clear,
)
from mpmopt.kernels.simd import add_number, number, pack, set_number, total
from mpmopt.kernels.spline import deposit_value, value_and_slopes


@jit
def bearing(d, thickness, capacity):
    """Normal force b = capacity <1 - d/thickness>; capacity is gamma_k V kappa."""
    return capacity * (1.0 - d / thickness) if d.real < thickness else 0.0 * capacity * d


@jit
def bearing_adjoint(d, thickness, capacity, b_bar):
    """From b_bar to d_bar and capacity_bar."""
    if d.real < thickness:
        return -b_bar * capacity / thickness, b_bar * (1.0 - d / thickness)
    return 0.0 * d, 0.0 * d


@jit
def reach(d, thickness, width):
    """How deep the nearest point of a particle at d is in a layer, and how much of its width is."""
    deepest = thickness - d + 0.5 * width
    if deepest.real >= width:
        return deepest, width + 0.0 * d
    return (deepest, deepest) if deepest.real > 0.0 else (0.0 * d, 0.0 * d)


@jit
def mean_bearing(d, thickness, width, capacity):
    """Mean of `bearing` over places within width/2 of d: what narrower particles add up to.

    So a flat foot has the force that it has on the finest cells, wherever its rows lie.
    """
    deepest, inside = reach(d, thickness, width)
    return capacity * inside * (deepest - 0.5 * inside) / (width * thickness)


@jit
def mean_bearing_adjoint(d, thickness, width, capacity, b_bar):
    """From b_bar to d_bar and capacity_bar."""
    deepest, inside = reach(d, thickness, width)
    b_bar = b_bar * inside / (width * thickness)
    return -b_bar * capacity, b_bar * (deepest - 0.5 * inside)


@jit
def rise(x, y, margin, parameters):
    """How fast layers' forces on solid at a place rise with depth: the sum of kappa / thickness.

    Layers count that begin within a margin, which for `mean_bearing` is half a width: it rises no
    faster.
    """
    ground, found = parameters.ground, 0.0
    i, j = round(x * parameters.per_dx), round(y * parameters.per_dx)
    known = 0 <= i < parameters.nodes_x and 0 <= j < parameters.nodes_y
    if known and ground.clearance[i * parameters.nodes_y + j] > parameters.dx + margin:
        return found
    for n in range(len(ground.layers)):
        d, _, _, _ = distance(x, y, ground, n)
        if d < ground.layers[n, THICKNESS] + margin:
            found += ground.layers[n, STIFFNESS] / ground.layers[n, THICKNESS]
    return found


@jit
def stored(d, thickness, capacity):
    """Energy of which `bearing` is the force: capacity thickness/2 <1 - d/thickness>^2."""
    short = max(1.0 - d / thickness, 0.0)
    return 0.5 * capacity * thickness * short * short


@jit
def friction(v, c, creeping):
    """Tangential velocity v' after a step of Coulomb friction, of c at most: v' + c tau(v') = v.

    tau(v') = x (2 - |x|) with x = v' / creeping, and 1 beyond creeping: the step is implicit, and
    solved. (Law: the mollified one of Li et al. 2020.)
    """
    s = v if v.real > 0.0 else -v
    if s.real >= (creeping + c).real:
        return v - c if v.real > 0.0 else v + c
    root = np.sqrt(creeping * creeping + 4.0 * c * (creeping + c - s))
    return v * (2.0 * creeping) / (creeping + 2.0 * c + root)


@jit
def friction_adjoint(v, c, creeping, v_bar):
    """From v_bar' to v_bar and c_bar."""
    s = v if v > 0.0 else -v
    sign = 1.0 if v > 0.0 else -1.0
    if s >= creeping + c:
        return v_bar, -sign * v_bar
    root = np.sqrt(creeping * creeping + 4.0 * c * (creeping + c - s))
    x, v_bar = 2.0 * s / (creeping + 2.0 * c + root), creeping / root * v_bar
    return v_bar, -sign * x * (2.0 - x) * v_bar


@jit
def resistance(u, v, push, contact):
    """Velocity of a node after friction and damping; the layer changes its speed by `push`.

    v_n / (1 + alpha push), and v_t after `friction` of mu push, which is all of it where mu is
    infinite; contact holds n_x, n_y, mu, alpha and the creeping speed.
    """
    nx, ny, mu, alpha, creeping = contact
    normal, along = nx * u + ny * v, nx * v - ny * u
    normal = normal / (1.0 + alpha * push)
    along = 0.0 * along if mu == math.inf else friction(along, mu * push, creeping)
    return nx * normal - ny * along, ny * normal + nx * along


@jit
def resistance_adjoint(u, v, push, contact, u_bar, v_bar):
    """From the new velocity's u_bar and v_bar to those of the old one, and push_bar."""
    nx, ny, mu, alpha, creeping = contact
    normal, along = nx * u + ny * v, nx * v - ny * u
    normal_bar, along_bar = nx * u_bar + ny * v_bar, nx * v_bar - ny * u_bar
    keep = 1.0 / (1.0 + alpha * push)
    normal_bar = keep * normal_bar
    push_bar = -alpha * keep * normal * normal_bar
    if mu == math.inf:
        along_bar = 0.0 * along_bar
    else:
        along_bar, c_bar = friction_adjoint(along, mu * push, creeping, along_bar)
        push_bar += mu * c_bar
    return nx * normal_bar - ny * along_bar, ny * normal_bar + nx * along_bar, push_bar


@jit
def contact_at(parameters, i, j):
    """Of node (i, j): n_x, n_y, mu, alpha and v_s of the ground there."""
    nodes, k = parameters.ground.nodes, i * parameters.nodes_y + j
    return (
        nodes[k, NODE_NORMAL],
        nodes[k, NODE_NORMAL + 1],
        nodes[k, NODE_FRICTION],
        nodes[k, NODE_DAMPING],
        nodes[k, NODE_CREEPING],
    )


@jit
def press(state, data, parameters, tile, cells, first, last):
    """Layers to grid: their momentum and normal force, (q_x, q_y, 0, f_N), as moments of cells."""
    ground, gathered = parameters.ground, tile.gathered
    for g in range(first, last):
        if not is_clear(state, parameters, g):
            t = g - first
            for k in range(4):
                x, y = number(state, at(g, POSITION), k), number(state, at(g, POSITION + 1), k)
                share = number(data.stiffness, g, k) * number(data.volume, g, k)
                for n in range(len(ground.layers)):
                    d, nx, ny, _ = distance(x, y, ground, n)
                    capacity = ground.layers[n, STIFFNESS] * share
                    b = bearing(d, ground.layers[n, THICKNESS], capacity)
                    if b.real > 0.0:
                        store_push(
                            gathered, t, k, parameters.dt * b * nx, parameters.dt * b * ny, b
                        )
                        deposit_value(cells, tile, t, k, load_push(gathered, t, k))


@jit
def press_adjoint(state, data, parameters, tile, cells, bar, data_bar, first, last):
    """From momentum_bar and f_N_bar of cells: adds to x_bar and stiffness_bar.

    It overwrites what `p2g_adjoint` gathered but for A_bar.
    """
    ground, gathered, dt, per_dx = (
        parameters.ground,
        tile.gathered,
        parameters.dt,
        parameters.per_dx,
    )
    for g in range(first, last):
        if not is_clear(state, parameters, g):
            t = g - first
            for k in range(4):
                x, y = number(state, at(g, POSITION), k), number(state, at(g, POSITION + 1), k)
                volume = number(data.volume, g, k)
                share = number(data.stiffness, g, k) * volume
                for n in range(len(ground.layers)):
                    thickness, stiffness = ground.layers[n, THICKNESS], ground.layers[n, STIFFNESS]
                    d, nx, ny, bend = distance(x, y, ground, n)
                    b = bearing(d, thickness, stiffness * share)
                    if b.real > 0.0:
                        store_push(gathered, t, k, dt * b * nx, dt * b * ny, b)
                        push = load_push(gathered, t, k)
                        mean, along_x, along_y = value_and_slopes(cells, tile, t, k)
                        qx, qy, b_bar = dt * mean[0], dt * mean[1], mean[3]
                        b_bar = b_bar + nx * qx + ny * qy
                        d_bar, capacity_bar = bearing_adjoint(
                            d, thickness, stiffness * share, b_bar
                        )
                        x_bar, y_bar = distance_adjoint(nx, ny, bend, d_bar, b * qx, b * qy)
                        x_bar = x_bar + per_dx * total(along_x * push)
                        y_bar = y_bar + per_dx * total(along_y * push)
                        add_number(bar, at(g, POSITION), k, x_bar)
                        add_number(bar, at(g, POSITION + 1), k, y_bar)
                        add_number(data_bar.stiffness, g, k, stiffness * volume * capacity_bar)


@jit
def store_push(gathered, t, k, px, py, force):
    """The impulse dt b n of a layer on particle k of a group, and b, as numbers of the arrays."""
    set_number(gathered, in_tile(t, VELOCITY_BAR), k, px)
    set_number(gathered, in_tile(t, VELOCITY_BAR + 1), k, py)
    set_number(gathered, in_tile(t, MASS_BAR), k, force)


@jit
def load_push(gathered, t, k):
    """What `store_push` wrote, as what it puts on nodes: (q_x, q_y, 0, f_N)."""
    px = number(gathered, in_tile(t, VELOCITY_BAR), k)
    py = number(gathered, in_tile(t, VELOCITY_BAR + 1), k)
    return pack(px, py, 0.0 * px, number(gathered, in_tile(t, MASS_BAR), k))
