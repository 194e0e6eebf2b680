"""Energy that a run has, is given, and cannot explain (docs: theory, "Energy")."""

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mpmopt.kernels import energy, grips, plain, wave_modulus

# The balance is struck once in so many steps, and at the end.
LOOK = 64
# Between two looks at an actuator, its signal changes by so much of its greatest size at most; with
# the mean signal, its work is known to the square of that over twelve.
SIGNAL_CHANGE = 0.2
# Units in the last place that energies of few particles are off by, several times.
ENERGY_ULPS = 64.0


class Balance:
    """Kinetic and potential energy of a run against the work of its actuators.

    Their difference may fall, by what transfers and walls take, but no law of motion lets it rise.

    Parameters
    ----------
    data, parameters
        As the kernels see them.
    signal : (steps, K) array
    """

    def __init__(self, data: Any, parameters: Any, signal: NDArray) -> None:
        self._data, self._parameters = data, parameters
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
        # Steps so far in which a clamp moved: it does work, which nobody counts.
        moving = parameters.clamps[..., 4:].any(axis=(1, 2))
        self._moved, self._looked = np.concatenate([[0], np.add.accumulate(moving)]), 0
        # What is rounding only: of strains, and of positions in gravity.
        constants = data.stiffness.real * data.constants
        modulus = float((data.volume.real * plain(wave_modulus)(2.0, 0.0, constants)).sum())
        weight = float(data.mass.real.sum()) * math.hypot(
            parameters.gravity_x, parameters.gravity_y
        )
        height = parameters.dx * max(parameters.nodes_x, parameters.nodes_y)
        self._rounding = (
            ENERGY_ULPS * float(np.finfo(signal.dtype).eps) * (modulus + weight * height)
        )

    def follow(self, states: NDArray, first: int, last: int) -> None:
        """Take in steps `first` to `last`, whose states are in slots 0, 1, ..."""
        begin = max(-(-first // self._every), self._seen + 1)
        end = len(self._mean) if last == self._steps else last // self._every
        if begin <= end:
            places = np.minimum(self._every * np.arange(begin, end + 1), self._steps) - first
            held = np.zeros((len(places), len(self._held)))
            grips(states, places, self._data, self._parameters, held)
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
        kinetic, potential = energy(state, self._data, self._parameters)
        work = float(self._work[-(-step // self._every)])
        balance = kinetic + potential - work
        if self._last is None:
            self._turnover = kinetic
        else:
            self._turnover += abs(potential - self._last[0]) + abs(work - self._last[1])
        self._last = potential, work
        if math.isinf(kinetic) or self._moved[step] == self._moved[self._looked]:
            self._lowest = min(self._lowest, balance)
            self._rise = max(self._rise, balance - self._lowest)
        else:
            self._lowest = balance
        self._looked = step

    @property
    def appeared(self) -> float:
        """Greatest rise, as a share of what kinetic and potential energy and work turned over.

        From one look to the next in which a clamp moves, a rise does not count.
        """
        if math.isinf(self._rise):
            return math.inf
        return self._rise / max(self._turnover, self._rounding)
