"""Loops over steps, forward and back."""

from mpmopt.kernels.arrays import clear, make_cells, make_tile
from mpmopt.kernels.barrier import meet
from mpmopt.kernels.compiler import loop_jit
from mpmopt.kernels.deformation import deform, deform_adjoint, first_inverted
from mpmopt.kernels.grid import add_blocks, grid_update, grid_update_adjoint, mirror
from mpmopt.kernels.layer import press, press_adjoint
from mpmopt.kernels.spline import (
    find_window,
    first_outside,
    locate,
    taylor,
    taylor_adjoint,
    whole_window,
)
from mpmopt.kernels.stress import stress, stress_adjoint
from mpmopt.kernels.transfer import g2p, g2p_adjoint, p2g, p2g_adjoint

# Groups of four particles that are handled together, while what is derived of them is at hand.
TILE = 16
# How `advance` ended.
DONE, WINDOW_TOO_SMALL, PART_TOO_SMALL, ESCAPED, INVERTED, ABANDONED = range(6)


@loop_jit
def advance(states, grids, windows, logs, first, last, data, parameters, signal, scratch,
            barrier_state, thread, threads):  # fmt: skip
    """Advance from the start of step `first` to the start of step `last`.

    Step n leads from slot n to slot n + 1 of `states` and leaves its nodes in slot n of `grids`,
    its windows (those of the blocks, then the whole one) in slot n of `windows` and its ln J' in
    slot n of `logs`; slots are counted round, so that two states and one of the others suffice
    where nothing is kept. Returns the step reached, how it ended, and the particle concerned (or
    -1); when a window, the whole one or a block's, does not fit into the records, more records and
    another call from the step reached go on.

    Called by `threads` threads at once, each with its number, which wait for each other at the
    `barrier_state` (`mpmopt.simulation.threads`) and return when one of them gives up there. Each
    takes its blocks of particles and its columns of nodes; what blocks put on nodes is added in
    their order, so that results do not depend on the number of threads.
    """
    blocks = data.first.size - 1
    own = range(thread * blocks // threads, (thread + 1) * blocks // threads)
    parts, ends = scratch.parts, scratch.ends
    tile = make_tile(TILE, states)
    node_cells, velocity_cells = make_cells(scratch)
    for n in range(first, last + 1):
        old = states[n % states.shape[0]]
        new = states[(n + 1) % states.shape[0]]
        slot = n % grids.shape[0]
        grid, log_J = grids[slot], logs[slot]
        for k in own:
            p0, p1 = data.first[k], data.first[k + 1]
            i0, j0, ni, nj, inside = find_window(old, parameters, p0, p1)
            ends[k, 0], ends[k, 1] = DONE, -1
            if not inside:
                ends[k, 0], ends[k, 1] = ESCAPED, first_outside(old, parameters, p0, p1)
            elif n < last:
                windows[slot, k, 0], windows[slot, k, 1] = i0, j0
                windows[slot, k, 2], windows[slot, k, 3] = ni, nj
                if ni * nj > parts.shape[1]:
                    ends[k, 0] = PART_TOO_SMALL
                else:
                    part = (i0, j0, ni, nj)
                    clear(node_cells, part)
                    for g0 in range(p0, p1, TILE):
                        g1 = min(g0 + TILE, p1)
                        if not deform(old, new, parameters, log_J, g0, g1):
                            ends[k, 0], ends[k, 1] = INVERTED, first_inverted(new, g0, g1)
                            break
                        locate(old, parameters, part, tile, g0, g1)
                        stress(old, new, log_J, data, parameters, signal[n], tile, g0, g1)
                        p2g(old, data, tile, node_cells, g0, g1)
                        if len(parameters.ground.layers) > 0:
                            press(old, data, parameters, tile, node_cells, g0, g1)
                    taylor_adjoint(node_cells, part, parts[k])
        if not meet(barrier_state, threads):
            return n, ABANDONED, -1
        for k in range(blocks):
            if ends[k, 0] != DONE:
                return n, ends[k, 0], ends[k, 1]
        if n == last:
            break
        i0, j0, ni, nj = whole_window(windows[slot, :blocks], parameters)
        window = (i0, j0, ni, nj)
        if thread == 0:
            for k in range(4):
                windows[slot, blocks, k] = window[k]
        if ni * nj > grid.shape[0]:
            return n, WINDOW_TOO_SMALL, -1
        columns = range(thread * ni // threads, (thread + 1) * ni // threads)
        for a in columns:
            add_blocks(parts, windows[slot], window, a, grid)
        if parameters.mirror_axis >= 0:
            if not meet(barrier_state, threads):
                return n, ABANDONED, -1
            if thread == 0:
                mirror(grid, window, parameters)
            if not meet(barrier_state, threads):
                return n, ABANDONED, -1
        for a in columns:
            grid_update(grid, window, parameters, parameters.clamps[n], scratch.velocity, a)
        if not meet(barrier_state, threads):
            return n, ABANDONED, -1
        for k in own:
            w = windows[slot, k]
            part = (w[0], w[1], w[2], w[3])
            taylor(scratch.velocity, window, part, velocity_cells)
            for g0 in range(data.first[k], data.first[k + 1], TILE):
                g1 = min(g0 + TILE, data.first[k + 1])
                locate(old, parameters, part, tile, g0, g1)
                g2p(old, new, parameters, tile, velocity_cells, g0, g1)
    return last, DONE, -1


@loop_jit
def advance_adjoint(states, grids, windows, logs, first, last, data, parameters, signal, scratch,
                    bar, data_bar, signal_bar, barrier_state, thread, threads):  # fmt: skip
    """Go back from the start of step `last` to the start of step `first`: the adjoint of `advance`.

    `bar` holds the adjoint of the state and is overwritten; `data_bar` and `signal_bar`
    (B, steps, K), by blocks, are added to. All that `advance` leaves of the steps must have been
    kept.
    """
    blocks = data.first.size - 1
    own = range(thread * blocks // threads, (thread + 1) * blocks // threads)
    parts_bar, velocity, velocity_bar = scratch.parts_bar, scratch.velocity, scratch.velocity_bar
    tile = make_tile(TILE, states)
    node_cells, velocity_cells = make_cells(scratch)
    _, velocity_cells_bar = make_cells(scratch)
    for n in range(last - 1, first - 1, -1):
        old, new, grid, log_J = states[n], states[n + 1], grids[n], logs[n]
        w = windows[n, blocks]
        ni, window = w[2], (w[0], w[1], w[2], w[3])
        columns = range(thread * ni // threads, (thread + 1) * ni // threads)
        for a in columns:
            grid_update(grid, window, parameters, parameters.clamps[n], velocity, a)
        if not meet(barrier_state, threads):
            return
        for k in own:
            p0, p1 = data.first[k], data.first[k + 1]
            w = windows[n, k]
            part = (w[0], w[1], w[2], w[3])
            taylor(velocity, window, part, velocity_cells)
            clear(velocity_cells_bar, part)
            for g0 in range(p0, p1, TILE):
                g1 = min(g0 + TILE, p1)
                locate(old, parameters, part, tile, g0, g1)
                g2p_adjoint(parameters, tile, velocity_cells, velocity_cells_bar, bar, g0, g1)
            taylor_adjoint(velocity_cells_bar, part, parts_bar[k])
        if not meet(barrier_state, threads):
            return
        for a in columns:
            add_blocks(parts_bar, windows[n], window, a, velocity_bar)
            grid_update_adjoint(
                grid, window, parameters, parameters.clamps[n], velocity_bar, scratch.node_bar, a
            )
        if not meet(barrier_state, threads):
            return
        if parameters.mirror_axis >= 0:
            if thread == 0:
                mirror(scratch.node_bar, window, parameters)
            if not meet(barrier_state, threads):
                return
        for k in own:
            p0, p1 = data.first[k], data.first[k + 1]
            w = windows[n, k]
            part = (w[0], w[1], w[2], w[3])
            taylor(scratch.node_bar, window, part, node_cells)
            for g0 in range(p0, p1, TILE):
                g1 = min(g0 + TILE, p1)
                locate(old, parameters, part, tile, g0, g1)
                stress(old, new, log_J, data, parameters, signal[n], tile, g0, g1)
                p2g_adjoint(old, data, parameters, tile, node_cells, bar, data_bar, g0, g1)
                stress_adjoint(
                    old, new, log_J, data, parameters, signal[n], tile, bar, data_bar,
                    signal_bar[k, n], g0, g1,
                )  # fmt: skip
                if len(parameters.ground.layers) > 0:
                    press_adjoint(old, data, parameters, tile, node_cells, bar, data_bar, g0, g1)
                deform_adjoint(old, parameters, bar, g0, g1)
