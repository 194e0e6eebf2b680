"""How close states of a total Lagrangian body come to where a step is too long, or parts overlap.

One call looks at many states, so that threads seldom meet at the interpreter.
"""

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mpmopt.kernels.arrays import DEFORMATION, POSITION, STATE_SIZE, at
from mpmopt.kernels.compiler import bare_jit, loop_jit
from mpmopt.kernels.lagrangian import but_touch, continued, make_rows, to_particles
from mpmopt.kernels.layer import rise
from mpmopt.kernels.material import solid_constants
from mpmopt.kernels.overlap import closest
from mpmopt.kernels.simd import load, real


@loop_jit
def look(
    states: NDArray,
    slots: NDArray[np.int64],
    lattice: Any,
    number: NDArray[np.int64],
    reference: NDArray[np.float64],
    solid: NDArray[np.bool_],
    data: Any,
    parameters: Any,
    found: NDArray[np.float64],
) -> None:
    """Fill in a row of `found` (L, 5) for each of L slots of the nodes' `states` (., 4, M).

    It has the largest Courant number and the smallest J of `margins`, and what `closest` finds.
    `number` is as in `particles`; `reference`, `solid`, `data` and `parameters` as in `closest`.
    """
    lattice = but_touch(lattice)
    rows = make_rows(4, 3, lattice)
    state = np.zeros((STATE_SIZE * len(solid), 4), states.dtype)
    for n in range(len(slots)):
        to_particles(states[slots[n]], lattice, number, rows, state)
        found[n, 0], found[n, 1] = margins(state, solid, data, parameters)
        found[n, 2], found[n, 3], found[n, 4] = closest(state, reference, solid, data, parameters)


@bare_jit
def margins(state, solid, data, parameters):
    """Largest Courant number k_v + sqrt(k_v^2 + k_e^2) and smallest J of solid.

    Void, which is crushed and turned inside out, moves with the solid around it.

    Against dF = a N, a wave along N, the tangent of `lagrangian.solid_stress` has the stiffness
    M = mu + h' s^2 with h = (lambda ln J - mu) (ln J)' and the larger stretch s; its viscosity is
    eta s^2. k_e^2 = (dt / dx)^2 M / rho, k_v = dt / dx^2 eta s^2 / rho. Within layers of ground
    k_e^2 has more, as in `indicators`.
    """
    dt, dx = parameters.dt, parameters.dx
    courant, smallest = 0.0, math.inf
    step = dt / dx
    for g in range(len(solid)):
        f00, f01 = real(load(state, at(g, DEFORMATION))), real(load(state, at(g, DEFORMATION + 1)))
        f10 = real(load(state, at(g, DEFORMATION + 2)))
        f11 = real(load(state, at(g, DEFORMATION + 3)))
        J, trace = f00 * f11 - f01 * f10, f00 * f00 + f01 * f01 + f10 * f10 + f11 * f11
        log, slope, bend = continued(J)
        lam, mu, eta = solid_constants(data, g)
        hardening = lam * slope * slope + (lam * log - mu) * bend
        for k in range(4):
            if solid[g, k]:
                apart = math.sqrt(max(trace[k] * trace[k] - 4.0 * J[k] * J[k], 0.0))
                s2 = 0.5 * (trace[k] + apart)
                specific = data.stiffness[g, k].real * data.volume[g, k].real / data.mass[g, k].real
                elastic = step * step * (mu[k] + max(hardening[k], 0.0) * s2) * specific
                if len(parameters.ground.layers):
                    x = state[at(g, POSITION), k].real
                    y = state[at(g, POSITION + 1), k].real
                    half_width = 0.5 * math.sqrt(data.volume[g, k].real)
                    elastic += 0.25 * dt * dt * specific * rise(x, y, half_width, parameters)
                viscous = step / dx * eta[k] * s2 * specific
                courant = max(courant, viscous + math.sqrt(viscous * viscous + elastic))
                smallest = min(smallest, J[k])
    return courant, smallest
