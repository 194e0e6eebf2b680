"""How close a run comes to where its time step is too long, or its body tears or overlaps."""

from __future__ import annotations

import math
from collections.abc import Collection
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from mpmopt.errors import DesignError
from mpmopt.simulation.energy import LOOK, Balance
from mpmopt.validation import shown

if TYPE_CHECKING:
    from mpmopt.simulation.buffers import Segment
    from mpmopt.simulation.simulation import Simulation

# States are looked at for their indicators once in so many steps, and at the end.
WATCH = 16


class Indicators(NamedTuple):
    """How close a run came to where its step is too long: extremes over particles and steps.

    States 0, 16, 32, ... and the last one are looked at. Real parts count.

    Attributes
    ----------
    courant : float
        Largest (dt / dx) sqrt(M / rho) with the stiffness M of the stretched particle, more where
        it is viscous or in a layer of ground (docs: theory, "Step control"). An isolated particle
        is unstable above 1.
    velocity_increment : float
        Largest dt |C|, the Frobenius norm. Below 1 no particle can be inverted by a step.
    jacobian : float
        Smallest J = det F.
    stretch : float
        Largest singular value of F among particles with half the solid's stiffness or more. Solid
        is fractured where it exceeds the particles per cell and direction by far.
    energy : float
        Most that energy rose without work, as a share of what the run had to do with
        (`energy.Balance`). No law of motion allows any.
    gap : float
        Least distance, in current particle spacings, of particles with half the solid's stiffness
        or more that were over four cells apart in the reference configuration, at states 0, 64,
        ... and the last; infinite beyond a cell. Below 1/2 parts of the body lie in each other.
    gap_x, gap_y : float
        Where that was, infinite if nowhere.
    """

    courant: float = 0.0
    velocity_increment: float = 0.0
    jacobian: float = math.inf
    stretch: float = 0.0
    energy: float = 0.0
    gap: float = math.inf
    gap_x: float = math.inf
    gap_y: float = math.inf

    def join(self, other: Indicators) -> Indicators:
        """The indicators of two runs, or of two parts of a run, taken together."""
        return Indicators(
            max(self.courant, other.courant),
            max(self.velocity_increment, other.velocity_increment),
            min(self.jacobian, other.jacobian),
            max(self.stretch, other.stretch),
            max(self.energy, other.energy),
            *min(self[5:], other[5:]),
        )


class Watched(NamedTuple):
    """How a run ended.

    Attributes
    ----------
    states : dict of int to (12, N) array
        The states after so many steps: those that were asked for, and the last.
    indicators : Indicators
    """

    states: dict[int, NDArray]
    indicators: Indicators


def wanted_steps(instants: Collection[int], steps: int) -> set[int]:
    """Steps before the states that are asked for, and the last, or a DesignError."""
    for step in instants:
        if not isinstance(step, (int, np.integer)) or not 0 <= step <= steps:
            raise DesignError(
                f"instants must be whole numbers of steps from 0 to {steps}, got {shown(step)}"
            )
    return {int(step) for step in (*instants, steps)}


def looked_at(first: int, last: int, steps: int, every: int) -> list[int]:
    """Slots of the states that are looked at after steps `first`, in slot 0, to `last`."""
    slots = [*range(-first % every, last - first, every)]
    return [*slots, last - first] if last == steps else slots


class Watcher:
    """What is seen of a run: its indicators so far, and the states that were asked for."""

    def __init__(self, segment: Segment, instants: Collection[int]) -> None:
        simulation = segment.simulation
        self._segment, self._look = segment, simulation.looks()
        self._wanted = wanted_steps(instants, simulation.steps)
        self.states: dict[int, NDArray] = {}
        self.indicators = Indicators()

    def follow(self, first: int, last: int) -> None:
        """Look at steps `first` to `last`, whose states are in slots 0, 1, ..."""
        for step in sorted(self._wanted - set(self.states)):
            if first <= step <= last:
                self.states[step] = self._segment.state(step - first)
        self.indicators = self.indicators.join(self._look(self._segment.states, first, last))


class Looks:
    """Takes the indicators of a run's states, steps after steps."""

    def __init__(self, simulation: Simulation) -> None:
        self._simulation = simulation
        self._balance = Balance(simulation.data, simulation.parameters, simulation.signal)

    def __call__(self, states: NDArray, first: int, last: int) -> Indicators:
        """Those of steps `first` to `last`, whose states are in slots 0, 1, ..."""
        simulation, seen = self._simulation, Indicators()
        self._balance.follow(states, first, last)
        for slot in looked_at(first, last, simulation.steps, WATCH):
            seen = seen.join(simulation.indicators(states[slot]))
            if (first + slot) % LOOK == 0 or first + slot == simulation.steps:
                gap, x, y = simulation.gap(states[slot])
                seen = seen.join(Indicators(gap=gap, gap_x=x, gap_y=y))
        if last == simulation.steps:
            seen = seen._replace(energy=self._balance.appeared)
        return seen
