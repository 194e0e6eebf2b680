"""Kinetic and potential energy of a state, and what actuators squeeze."""

import math
from typing import Any

from numpy.typing import NDArray

from mpmopt.kernels.actuation import squeezed
from mpmopt.kernels.arrays import AFFINE, POSITION, VELOCITY, at, components
from mpmopt.kernels.compiler import loop_jit
from mpmopt.kernels.deformation import midway
from mpmopt.kernels.ground import STIFFNESS, THICKNESS, distance
from mpmopt.kernels.layer import stored
from mpmopt.kernels.material import constants_of_one, energy_density


@loop_jit
def energy(state: NDArray, data: Any, parameters: Any) -> tuple[float, float]:
    """Kinetic and potential energy of a state, of records of groups of four particles.

    F is half a step behind the velocities, as `deform` uses the old ones, and x half a step ahead
    of them; both are taken where the velocities are. Infinite if a particle is inverted. What the
    ground's layers store is potential energy.
    """
    kinetic = potential = 0.0
    half, inertia = 0.5 * parameters.dt, 0.25 * parameters.dx * parameters.dx
    for g in range(data.mass.shape[0]):
        for k in range(4):
            mass, volume = float(data.mass[g, k].real), float(data.volume[g, k].real)
            if mass == 0.0:  # only fills its group
                continue
            x, y = float(state[at(g, POSITION), k].real), float(state[at(g, POSITION + 1), k].real)
            u, v = float(state[at(g, VELOCITY), k].real), float(state[at(g, VELOCITY + 1), k].real)
            c00, c01, c10, c11 = components(state, g, AFFINE, k)
            F = midway(state, g, k, half)
            J = F[0] * F[3] - F[1] * F[2]
            if not J > 0.0:
                return math.inf, math.inf
            turning = c00 * c00 + c01 * c01 + c10 * c10 + c11 * c11
            kinetic += 0.5 * mass * (u * u + v * v + inertia * turning)
            potential += volume * energy_density(F, math.log(J), constants_of_one(data, g, k))
            potential -= mass * parameters.gravity_x * (x - half * u)
            potential -= mass * parameters.gravity_y * (y - half * v)
            ground, share = parameters.ground, volume * float(data.stiffness[g, k].real)
            for n in range(len(ground.layers)):
                d, _, _, _ = distance(x - half * u, y - half * v, ground, n)
                capacity = ground.layers[n, STIFFNESS] * share
                potential += stored(d, ground.layers[n, THICKNESS], capacity)
    return kinetic, potential


@loop_jit
def grips(states: NDArray, slots: NDArray, data: Any, parameters: Any, out: NDArray) -> None:
    """What each actuator squeezes: sum V/2 S : F^T F, of some slots' states into `out` (n, K).

    Its rate times the signal s is the power that the stress s F S F^T takes from the body.
    """
    half = 0.5 * parameters.dt
    for n in range(slots.size):
        state = states[slots[n]]
        for a in range(out.shape[1]):
            s00, s01 = data.actuation_stress[a, 0], data.actuation_stress[a, 1]
            s11, held = data.actuation_stress[a, 2], 0.0
            for g in range(data.mass.shape[0]):
                if data.active[g]:
                    for k in range(4):
                        stretch = squeezed(midway(state, g, k, half), s00, s01, s11)
                        volume = float(data.volume[g, k].real)
                        held += 0.5 * volume * data.actuated[a, g, k] * stretch
            out[n, a] = held
