"""How close particles come to where a step is too long, or where solid tears."""

import math

from mpmopt.kernels.arrays import AFFINE, DEFORMATION, POSITION, at, components
from mpmopt.kernels.compiler import jit
from mpmopt.kernels.deformation import stretches
from mpmopt.kernels.layer import rise
from mpmopt.kernels.material import constants_of_one, wave_modulus
from mpmopt.kernels.viscosity import viscous_modulus

SOLID = 0.5


@jit
def indicators(state, data, parameters, first, last):
    """How close groups of particles come to where a step is too long, as in `Indicators`.

    The largest Courant number and dt |C|, the smallest J, and the largest stretch of
    particles with `SOLID` of the solid's stiffness or more; with its
    `wave_modulus` M and `viscous_modulus` N, an isolated particle is unstable where the Courant
    number k_v + sqrt(k_v^2 + k_e^2) is above 1, k_e^2 = (dt/dx)^2 M/rho and k_v = dt/dx^2 N/rho;
    within layers of ground whose forces rise with r, k_e^2 has dt^2 r / (4 rho) more.
    Extremes do not depend on the order in which they are taken.
    """
    courant = fastest = longest = 0.0
    per_cell = parameters.dt / parameters.dx
    smallest = math.inf
    for g in range(first, last):
        for k in range(4):
            mass, volume = data.mass[g, k].real, data.volume[g, k].real
            if mass > 0.0:  # else it only fills its group
                c00, c01, c10, c11 = components(state, g, AFFINE, k)
                F = components(state, g, DEFORMATION, k)
                trace, apart = stretches(F)
                constants, specific = constants_of_one(data, g, k), volume / mass
                elastic = per_cell * per_cell * wave_modulus(trace, apart, constants) * specific
                if len(parameters.ground.layers):
                    x, y = state[at(g, POSITION), k].real, state[at(g, POSITION + 1), k].real
                    share = data.stiffness[g, k].real * specific
                    elastic += (
                        0.25 * parameters.dt * parameters.dt * share * rise(x, y, 0.0, parameters)
                    )
                viscous = viscous_modulus(trace, apart, constants) * specific
                viscous *= per_cell / parameters.dx
                if data.stiffness[g, k].real >= SOLID:
                    longest = max(longest, 0.5 * (trace + math.sqrt(apart)))
                courant = max(courant, viscous + math.sqrt(viscous * viscous + elastic))
                fastest = max(fastest, c00 * c00 + c01 * c01 + c10 * c10 + c11 * c11)
                smallest = min(smallest, F[0] * F[3] - F[1] * F[2])
    velocity_increment = parameters.dt * math.sqrt(fastest)
    return courant, velocity_increment, smallest, math.sqrt(longest)
