"""The discrete model: one explicit MLS-MPM step and its exact adjoint, read from top to bottom.

A step advances the particle states from t_n to t_n + dt (primes mark the new state, c = 4/dx^2)::

    deform       F'  = (I + dt C) F,   J' = det F'
    stress       tau = mu (F'F'^T - I) + lambda ln J' I + s F' S F'^T
                 A   = m C - dt V c tau
    p2g          m_i = sum_p w_ip m,   q_i = sum_p w_ip (m v + A (x_i - x))
    press        q_i += dt sum_p w_ip b n,  f_i = sum_p w_ip b,  b = gamma_k V kappa <1 - d/delta>
    mirror       adds the images across a plane of symmetry, if the scene has one
    grid_update  u_i = wall(resistance(q_i / m_i + dt g, dt f_i / m_i)), where m_i > 0
    g2p          v'  = sum_i w_ip u_i,  C' = c sum_i w_ip u_i (x_i - x)^T,  x' = x + dt v'

Every kernel is followed by its adjoint of the same name, which uses the same variable names;
``_bar`` marks the derivative of the objective with respect to a variable. Branches (contact, cells)
are those that the forward step took.

Sums over the nine nodes of a particle are not taken node by node. Where a particle is t cells from
the middle of its three nodes along an axis, |t| <= 1/2, the weights of all three are quadratic in
t: w = b_0 + t b_1 + (t^2/2) b_2 with constants b_k (`expand`). So a field on the nodes is a
polynomial in each cell, its Taylor expansion about the middle node, and what particles put on nodes
passes through moments of the cell, the transpose. A cell is expanded once for all particles in it.

Arrays (M, 4) hold records of four numbers and flat arrays (2 M,) pairs, which a processor handles
as one. Particles come in groups of four: records 12 g to 12 g + 11 of a state are x, y, u, v, C00,
C01, C10, C11, F00, F01, F10, F11 of group g, and `grouped` makes them of an array (12, N). Grid
arrays hold the window of nodes that the particles touch and no others: node (i, j) is record
``(i - i0) nj + (j - j0)`` of window ``(i0, j0, ni, nj)``. Records 9 c to 9 c + 8 of cell arrays are
the coefficients of cell c, number 3 k + l that of order k along x and l along y.

Several threads share a step. Each has its blocks of groups, which put their momentum on nodes of
their own, and its columns of the window, in which it adds the blocks up in their order. So results
do not depend on the number of threads. What is derived of particles lives in a `Tile`.

The kernels also compile for complex128, which makes the complex step an oracle for the adjoint:
cells, walls and comparisons look at real parts only. They know arrays and numbers, no user objects.
What records can do (`load`, `store`, `pack`, ...) stands in `simd`.

Sources: Hu et al. 2018 (MLS-MPM), Jiang et al. 2015 (APIC), Sato et al. 2023 (actuation).
"""

from mpmopt.kernels.arrays import (
    NODE_SIZE,
    STATE_SIZE,
    Parameters,
    ParticleData,
    ParticleDataBar,
    Parts,
    Scratch,
    Tile,
    grouped,
    make_tile,
    parts,
    ungrouped,
)
from mpmopt.kernels.barrier import meet
from mpmopt.kernels.compiler import plain
from mpmopt.kernels.contact import wall, wall_adjoint
from mpmopt.kernels.deformation import deform, deform_adjoint
from mpmopt.kernels.energy import energy, grips
from mpmopt.kernels.grid import (
    free_velocity,
    grid_update,
    grid_update_adjoint,
    mirror,
    update_nodes,
)
from mpmopt.kernels.indicators import SOLID, indicators
from mpmopt.kernels.layer import press, press_adjoint
from mpmopt.kernels.material import PARAMETERS, energy_density, kirchhoff, wave_modulus
from mpmopt.kernels.overlap import closest
from mpmopt.kernels.spline import (
    expand,
    expand_adjoint,
    find_window,
    first_outside,
    interpolation,
    locate,
    taylor,
    taylor_adjoint,
    weights,
    whole_window,
)
from mpmopt.kernels.step import (
    ABANDONED,
    DONE,
    ESCAPED,
    INVERTED,
    PART_TOO_SMALL,
    WINDOW_TOO_SMALL,
    advance,
    advance_adjoint,
)
from mpmopt.kernels.stress import stress, stress_adjoint
from mpmopt.kernels.transfer import g2p, g2p_adjoint, p2g, p2g_adjoint

__all__ = [
    "ABANDONED",
    "DONE",
    "ESCAPED",
    "INVERTED",
    "NODE_SIZE",
    "PARAMETERS",
    "PART_TOO_SMALL",
    "SOLID",
    "STATE_SIZE",
    "WINDOW_TOO_SMALL",
    "Parameters",
    "ParticleData",
    "ParticleDataBar",
    "Parts",
    "Scratch",
    "Tile",
    "advance",
    "advance_adjoint",
    "closest",
    "deform",
    "deform_adjoint",
    "energy",
    "energy_density",
    "expand",
    "expand_adjoint",
    "find_window",
    "first_outside",
    "free_velocity",
    "g2p",
    "g2p_adjoint",
    "grid_update",
    "grid_update_adjoint",
    "grips",
    "grouped",
    "indicators",
    "interpolation",
    "kirchhoff",
    "locate",
    "make_tile",
    "meet",
    "mirror",
    "p2g",
    "p2g_adjoint",
    "parts",
    "plain",
    "press",
    "press_adjoint",
    "stress",
    "stress_adjoint",
    "taylor",
    "taylor_adjoint",
    "ungrouped",
    "update_nodes",
    "wall",
    "wall_adjoint",
    "wave_modulus",
    "weights",
    "whole_window",
]
