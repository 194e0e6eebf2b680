"""When an evaluation is rejected and its time step halved, and when solid tears or overlaps."""

from __future__ import annotations

import logging
import math
from collections.abc import Callable
from typing import TypeVar

from mpmopt.errors import FractureError, OverlapError, SceneError, SimulationError
from mpmopt.scene import Scene
from mpmopt.simulation.indicators import Indicators
from mpmopt.simulation.simulation import Simulation

logger = logging.getLogger(__name__)

Result = TypeVar("Result")

# An evaluation that goes beyond these is not trusted (docs: theory, "Step control"); the stretch is
# over the particles per cell and direction.
LIMITS = Indicators(
    courant=1.0, velocity_increment=0.5, jacobian=0.01, stretch=1.5, energy=0.05, gap=0.0
)


def with_halvings(
    scene: Scene, simulated: Callable[[Scene], Result], halvings: int
) -> tuple[Result, int]:
    """What is simulated in a scene, or in it in a step that is short enough, and how often halved.

    Raises
    ------
    SceneError
        If the scene is none.
    SimulationError
        If the last attempt fails; a `FractureError` or `OverlapError` at once, as no step mends it.
    """
    failure: SimulationError | None = None
    halved = 0
    while True:
        try:
            there = scene.vary(time_step=scene.time_step / 2**halved) if halved else scene
            return simulated(there), halved
        except SceneError:
            if failure is None:
                raise
            raise failure from None  # not that its scene allows no shorter step
        except SimulationError as error:
            if halved == halvings or isinstance(error, (FractureError, OverlapError)):
                raise
            logger.info("time step %g is halved: %s", there.time_step, error)
            halved, failure = halved + 1, error


def check_indicators(indicators: Indicators, simulation: Simulation, limits: Indicators) -> None:
    """A run that went beyond a limit is an error.

    Parameters
    ----------
    indicators : Indicators
    simulation : Simulation
    limits : Indicators
        As `LIMITS`.

    Raises
    ------
    SimulationError
        If the step is too long; a `FractureError` if solid is fractured and an `OverlapError` if
        parts of it lie in each other, which no step mends.
    """
    for what, value, limit in (
        ("the Courant number of a stretched particle", indicators.courant, limits.courant),
        ("dt |C| of a particle", indicators.velocity_increment, limits.velocity_increment),
        ("energy that appears from nowhere", indicators.energy, limits.energy),
    ):
        if not value <= limit:
            raise too_long(simulation, f"{what} reached {value:.3g}, the limit is {limit:.3g}")
    if not indicators.jacobian >= limits.jacobian or indicators.jacobian <= 0.0:
        fell = f"J of a particle fell to {indicators.jacobian:.3g}"
        raise too_long(simulation, f"{fell}, it must stay above {limits.jacobian:.3g}")
    per_cell = simulation.scene.particles_per_cell
    limit = limits.stretch * per_cell
    if not indicators.stretch <= limit:
        raise FractureError(
            f"solid is stretched {indicators.stretch:.3g} times, beyond {limit:.3g} it tears",
            simulation.steps,
            -1,
            (math.nan, math.nan),
            f"take more particles per cell (now {per_cell}), a stiffer body or weaker actuation",
        )
    if not indicators.gap >= limits.gap:
        raise OverlapError(
            "parts of the body that were over 4 cells apart lie in each other: solid particles "
            f"came within {indicators.gap:.3g} of their spacing, the limit is {limits.gap:.3g}",
            simulation.steps,
            -1,
            (indicators.gap_x, indicators.gap_y),
            f"near ({indicators.gap_x:.4g}, {indicators.gap_y:.4g}) keep parts apart: weaker "
            "actuation, a stiffer body, or material between them",
        )


def too_long(simulation: Simulation, what: str) -> SimulationError:
    """What the step is too long for, as an error about the whole body."""
    hint = f"take a smaller time step (now {simulation.scene.time_step:g})"
    return SimulationError(what, simulation.steps, -1, (math.nan, math.nan), hint)
