"""What of a term the actuators earn: its value less that of the same body without signals."""

from __future__ import annotations

import copy
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np

from mpmopt.design.term import Adjoints, Outcome, Term
from mpmopt.scene import Scene
from mpmopt.scene.parts import Checked
from mpmopt.simulation.buffers import Memory
from mpmopt.simulation.checkpoints import Checkpointing
from mpmopt.simulation.simulation import Simulation
from mpmopt.validation import instance


@dataclass(frozen=True)
class Driven(Term, Checked):
    """A term less its value for the same body whose actuators do nothing.

    A body that merely tips over gains nothing by it. The second body is simulated for each value,
    and forward and back for each gradient: it doubles the cost.

    Parameters
    ----------
    term : Term
        Of the motion, such as ``Displacement()``.
    """

    term: Term

    def __post_init__(self) -> None:
        instance("Driven", "term", self.term, Term, "such as Displacement()")

    def instants(self, scene: Scene) -> tuple[int, ...]:
        return self.term.instants(scene)

    def value(self, outcome: Outcome) -> Any:
        return self.term.value(outcome) - self.term.value(self._still(outcome))

    def adjoints(self, outcome: Outcome) -> Adjoints:
        bars, still = self.term.adjoints(outcome), self._still(outcome)
        still_bars = self.term.adjoints(still)
        density = bars.density - still_bars.density
        stiffness = bars.stiffness - still_bars.stiffness
        if still_bars.states:
            simulation = still.simulation
            with simulation.checkpoints(Checkpointing()) as checkpoints:
                sweep = simulation.forward(checkpoints, Memory()).reverse(still_bars.states)
            density, stiffness = density - sweep.density, stiffness - sweep.stiffness
        return Adjoints(bars.states, bars.signal, bars.gamma - still_bars.gamma, density, stiffness)

    def _still(self, outcome: Outcome) -> Outcome:
        simulation, states = _still(outcome.simulation, self.instants(outcome.simulation.scene))
        return Outcome(simulation, outcome.gamma, states)


@lru_cache(maxsize=4)
def _still(simulation: Simulation, instants: tuple[int, ...]) -> tuple[Simulation, dict[int, Any]]:
    """The body without signals, and its states; of one body they are asked for again and again."""
    still = copy.copy(simulation)
    still.signal = np.zeros_like(simulation.signal)
    return still, still.watch(instants).states
