"""Momentum and mass of nodes to their velocity."""

from mpmopt.kernels.compiler import jit, loop_jit
from mpmopt.kernels.contact import clamp_of, wall, wall_adjoint
from mpmopt.kernels.layer import contact_at, resistance, resistance_adjoint
from mpmopt.kernels.simd import add, fused, load, nothing, store


@jit
def mirror(records, window, parameters):
    """Add to each node what the mirrored half puts there; this map is its own transpose.

    Records of nodes are (q_x, q_y, m, f_N). With R the reflection, a node and its image across the
    plane become r + R r_image and R r + r_image.
    """
    if parameters.mirror_axis < 0:
        return
    i0, j0, ni, nj = window
    normal = parameters.mirror_axis
    first, count, stride = (i0, ni, nj) if normal == 0 else (j0, nj, 1)
    across, step = (nj, 1) if normal == 0 else (ni, nj)
    plane = parameters.mirror_node - first
    for line in range(across):
        for k in range(count - plane):
            node = line * step + (plane + k) * stride
            image = line * step + (plane - k) * stride
            for lane in range(4):
                sign = -1.0 if lane == normal else 1.0
                folded = records[image, lane] + sign * records[node, lane]
                records[image, lane] = folded
                records[node, lane] = sign * folded


@jit
def add_blocks(parts, windows, window, a, nodes):
    """Column a of the window: the sum of what the blocks put there, in their order."""
    i0, j0, _, nj = window
    for k in range(a * nj, (a + 1) * nj):
        store(nodes, k, nothing(nodes))
    for b in range(parts.shape[0]):
        column = i0 + a - windows[b, 0]
        if 0 <= column < windows[b, 2]:
            source, target = column * windows[b, 3], a * nj + windows[b, 1] - j0
            for k in range(windows[b, 3]):
                add(nodes, target + k, load(parts[b], source + k))


@jit
def free_velocity(grid, node, per_m, parameters):
    """Velocity of a node from momentum, 1 / mass and gravity, before ground and walls."""
    return (
        fused(grid[node, 0], per_m, parameters.dt * parameters.gravity_x),
        fused(grid[node, 1], per_m, parameters.dt * parameters.gravity_y),
    )


@jit
def grid_update(grid, window, parameters, clamps, velocity, a):
    """Velocity of column a's nodes from momentum, gravity, ground, walls and a step's clamps.

    It is zero where no mass is.
    """
    i0, j0, _, nj = window
    for b in range(nj):
        node = a * nj + b
        m = grid[node, 2]
        u = v = 0.0 * m
        if m.real > parameters.mass_tolerance:
            u, v = free_velocity(grid, node, 1.0 / m, parameters)
            if grid[node, 3].real > 0.0:
                push = parameters.dt * grid[node, 3] / m
                u, v = resistance(u, v, push, contact_at(parameters, i0 + a, j0 + b))
            u, v = wall(i0 + a, j0 + b, u, v, parameters)
            clamp = clamp_of(i0 + a, j0 + b, clamps, parameters.dx)
            if clamp >= 0:
                u, v = clamps[clamp, 4] + 0.0 * m, clamps[clamp, 5] + 0.0 * m
        velocity[2 * node], velocity[2 * node + 1] = u, v


@loop_jit
def update_nodes(grid, window, parameters, clamps, velocity):
    """`grid_update` of all columns."""
    for a in range(window[2]):
        grid_update(grid, window, parameters, clamps, velocity, a)


@jit
def grid_update_adjoint(grid, window, parameters, clamps, velocity_bar, node_bar, a):
    """From velocity_bar of column a's nodes to their momentum_bar, mass_bar and f_N_bar."""
    i0, j0, _, nj = window
    for b in range(nj):
        node = a * nj + b
        m = grid[node, 2]
        if m > parameters.mass_tolerance:
            per_m = 1.0 / m
            u, v = grid[node, 0] * per_m, grid[node, 1] * per_m
            free_u, free_v = held_u, held_v = free_velocity(grid, node, per_m, parameters)
            push = parameters.dt * grid[node, 3] * per_m
            if push > 0.0 and len(parameters.walls) > 0:
                contact = contact_at(parameters, i0 + a, j0 + b)
                held_u, held_v = resistance(free_u, free_v, push, contact)
            u_bar, v_bar = wall_adjoint(
                i0 + a,
                j0 + b,
                held_u,
                held_v,
                parameters,
                velocity_bar[2 * node],
                velocity_bar[2 * node + 1],
            )
            push_bar = 0.0 * m
            if push > 0.0:
                contact = contact_at(parameters, i0 + a, j0 + b)
                u_bar, v_bar, push_bar = resistance_adjoint(
                    free_u, free_v, push, contact, u_bar, v_bar
                )
            node_bar[node, 0] = u_bar * per_m
            node_bar[node, 1] = v_bar * per_m
            node_bar[node, 2] = -fused(v_bar, v, u_bar * u) * per_m
            node_bar[node, 2] -= push_bar * push * per_m
            node_bar[node, 3] = push_bar * parameters.dt * per_m
            if clamp_of(i0 + a, j0 + b, clamps, parameters.dx) >= 0:
                node_bar[node] = 0.0
        else:
            node_bar[node] = 0.0
