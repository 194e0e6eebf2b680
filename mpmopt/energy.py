"""Energy that a run has, is given, and cannot explain (docs: theory, "Energy").

The kernels are not in `mpmopt.mpm`, because that file is compiled anew whenever it changes.
"""

import math
from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

from mpmopt.mpm import OPTIONS

# The balance is struck once in so many steps, and at the end.
LOOK = 64
# Between two looks at an actuator, its signal changes by so much of its greatest size at most; with
# the mean signal, its work is known to the square of that over twelve.
SIGNAL_CHANGE = 0.2
# Units in the last place that energies of few particles are off by, several times.
ROUNDING = 64.0


@njit(**OPTIONS)
def energy(state: NDArray, body: Any, world: Any) -> tuple[float, float]:
    """Kinetic and potential energy of a state, of records of groups of four particles.

    F is half a step behind the velocities, as `deform` uses the old ones, and x half a step ahead
    of them; both are taken where the velocities are. Infinite if a particle is inverted.
    """
    kinetic = potential = 0.0
    half, inertia = 0.5 * world.dt, 0.25 * world.dx * world.dx
    for g in range(body.mass.shape[0]):
        for k in range(4):
            mass, volume = float(body.mass[g, k].real), float(body.volume[g, k].real)
            if mass == 0.0:  # only fills its group
                continue
            mu, lam = float(body.lame_mu[g, k].real), float(body.lame_lambda[g, k].real)
            x, y = float(state[12 * g, k].real), float(state[12 * g + 1, k].real)
            u, v = float(state[12 * g + 2, k].real), float(state[12 * g + 3, k].real)
            c00, c01 = float(state[12 * g + 4, k].real), float(state[12 * g + 5, k].real)
            c10, c11 = float(state[12 * g + 6, k].real), float(state[12 * g + 7, k].real)
            f00, f01, f10, f11 = midway(state, g, k, half)
            J = f00 * f11 - f01 * f10
            if not J > 0.0:
                return math.inf, math.inf
            log_J = math.log(J)
            trace = f00 * f00 + f01 * f01 + f10 * f10 + f11 * f11
            turning = c00 * c00 + c01 * c01 + c10 * c10 + c11 * c11
            kinetic += 0.5 * mass * (u * u + v * v + inertia * turning)
            potential += volume * (0.5 * mu * (trace - 2.0) - mu * log_J + 0.5 * lam * log_J**2)
            potential -= mass * world.gravity_x * (x - half * u)
            potential -= mass * world.gravity_y * (y - half * v)
    return kinetic, potential


@njit(**OPTIONS)
def grips(states: NDArray, slots: NDArray, body: Any, world: Any, out: NDArray) -> None:
    """What each actuator squeezes: sum V/2 S : F^T F, of some slots' states into `out` (n, K).

    Its rate times the signal s is the power that the stress s F S F^T takes from the body.
    """
    half = 0.5 * world.dt
    for n in range(slots.size):
        state = states[slots[n]]
        for a in range(out.shape[1]):
            s00, s01 = body.actuation_stress[a, 0], body.actuation_stress[a, 1]
            s11, held = body.actuation_stress[a, 2], 0.0
            for g in range(body.mass.shape[0]):
                if body.active[g]:
                    for k in range(4):
                        f00, f01, f10, f11 = midway(state, g, k, half)
                        stretch = s00 * (f00 * f00 + f10 * f10) + s11 * (f01 * f01 + f11 * f11)
                        stretch += 2.0 * s01 * (f00 * f01 + f10 * f11)
                        volume = float(body.volume[g, k].real)
                        held += 0.5 * volume * body.actuated[a, g, k] * stretch
            out[n, a] = held


@njit(**OPTIONS, forceinline=True)
def midway(state: NDArray, g: int, k: int, half: float) -> tuple[float, float, float, float]:
    """F of a particle after half a step: (I + dt/2 C) F."""
    c00, c01 = float(state[12 * g + 4, k].real), float(state[12 * g + 5, k].real)
    c10, c11 = float(state[12 * g + 6, k].real), float(state[12 * g + 7, k].real)
    f00, f01 = float(state[12 * g + 8, k].real), float(state[12 * g + 9, k].real)
    f10, f11 = float(state[12 * g + 10, k].real), float(state[12 * g + 11, k].real)
    return (
        f00 + half * (c00 * f00 + c01 * f10),
        f01 + half * (c00 * f01 + c01 * f11),
        f10 + half * (c10 * f00 + c11 * f10),
        f11 + half * (c10 * f01 + c11 * f11),
    )


class Balance:
    """Kinetic and potential energy of a run against the work of its actuators.

    Their difference may fall, by what transfers and walls take, but no law of motion lets it rise.

    Parameters
    ----------
    body, world
        As the kernels see them.
    signal : (steps, K) array
    """

    def __init__(self, body: Any, world: Any, signal: NDArray) -> None:
        self._body, self._world = body, world
        self._steps = len(signal)
        size, change = (np.abs(x).max(initial=0.0) for x in (signal, np.diff(signal, axis=0)))
        between = SIGNAL_CHANGE * size / change if change > 0.0 else math.inf
        self._every = 2 ** int(math.log2(min(max(between, 1.0), LOOK)))
        starts = np.arange(0, self._steps, self._every)
        lengths = np.diff(starts, append=self._steps)[:, None]
        self._mean = np.add.reduceat(signal.real.astype(float), starts, axis=0) / lengths
        self._work = np.zeros(len(starts) + 1)
        self._seen, self._held = -1, np.zeros(signal.shape[1])
        self._last: tuple[float, float] | None = None
        self._lowest, self._rise, self._turnover = math.inf, 0.0, 0.0
        # What is rounding only: of strains, and of positions in gravity.
        modulus = float((body.volume.real * (body.lame_lambda.real + 2 * body.lame_mu.real)).sum())
        weight = float(body.mass.real.sum()) * math.hypot(world.gravity_x, world.gravity_y)
        height = world.dx * max(world.nodes_x, world.nodes_y)
        self._rounding = ROUNDING * float(np.finfo(signal.dtype).eps) * (modulus + weight * height)

    def follow(self, states: NDArray, first: int, last: int) -> None:
        """Take in steps `first` to `last`, whose states are in slots 0, 1, ..."""
        begin = max(-(-first // self._every), self._seen + 1)
        end = len(self._mean) if last == self._steps else last // self._every
        if begin <= end:
            places = np.minimum(self._every * np.arange(begin, end + 1), self._steps) - first
            held = np.zeros((len(places), len(self._held)))
            grips(states, places, self._body, self._world, held)
            if begin > 0:
                held = np.concatenate([[self._held], held])
            work = -(self._mean[end - len(held) + 1 : end] * np.diff(held, axis=0)).sum(axis=1)
            known = end - len(work)
            work = np.concatenate([self._work[known : known + 1], work])
            self._work[known : end + 1] = np.add.accumulate(work)
            self._seen, self._held = end, held[-1]
        for step in range(-(-first // LOOK) * LOOK, last + (last == self._steps), LOOK):
            self._look(states[step - first], step)
        if last == self._steps and last % LOOK:
            self._look(states[last - first], last)

    def _look(self, state: NDArray, step: int) -> None:
        kinetic, potential = energy(state, self._body, self._world)
        work = float(self._work[-(-step // self._every)])
        balance = kinetic + potential - work
        if self._last is None:
            self._turnover = kinetic
        else:
            self._turnover += abs(potential - self._last[0]) + abs(work - self._last[1])
        self._last = potential, work
        self._lowest = min(self._lowest, balance)
        self._rise = max(self._rise, balance - self._lowest)

    @property
    def appeared(self) -> float:
        """Greatest rise, as a share of what kinetic and potential energy and work turned over."""
        if math.isinf(self._rise):
            return math.inf
        return self._rise / max(self._turnover, self._rounding)
