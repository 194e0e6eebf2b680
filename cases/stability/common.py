"""What all failure modes share: solid bodies, steps that a scene would refuse, and a bisection."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from mpmopt.errors import SimulationError
from mpmopt.scene import Scene
from mpmopt.scene.particles import Particles, discretise
from mpmopt.simulation.simulation import Simulation

Array = NDArray[np.float64]
Rows = list[dict[str, Any]]
# Functions whose calls are a module's rows, with the arguments of each.
Points = Mapping[Callable[..., dict[str, Any]], Rows]
Measured = Mapping[Callable[..., dict[str, Any]], Rows]  # what these calls returned


class Line(NamedTuple):
    """One failure mode in the summary table."""

    mode: str
    theory: str
    measured: str
    program: str


@dataclass
class Found:
    """What one module measured: tables by name, and what they amount to."""

    tables: dict[str, list[dict[str, Any]]] = field(default_factory=dict)
    lines: list[Line] = field(default_factory=list)


def solid(
    scene: Scene,
    particles: Particles | None = None,
    state: Array | None = None,
    *,
    share: Mapping[str, Array] | None = None,
    signal: Array | None = None,
    time_step: float | None = None,
) -> Simulation:
    """A body of the scene's solid.

    Parameters
    ----------
    scene : Scene
    particles : Particles, optional
        Default: all of the scene's.
    state : (12, N) array, optional
    share : dict, optional
        Factors (N,) on the solid's "mass" and "stiffness".
    signal : (steps, K) array, optional
        Default: zero.
    time_step : float, optional
        Step that is taken instead of the scene's: one that a scene would refuse.
    """
    particles = particles or discretise(scene)
    ones, material, share = np.ones(len(particles.position)), scene.material, share or {}
    stiffness = share.get("stiffness", ones)
    simulation = Simulation(
        scene,
        particles,
        material.density * share.get("mass", ones),
        stiffness,
        np.zeros((scene.steps, len(scene.actuators))) if signal is None else signal,
        state,
    )
    if time_step is not None:
        simulation.parameters = simulation.parameters._replace(dt=time_step)
    return simulation


def stretch(states: Array) -> float:
    """Greatest principal stretch of any particle in states (..., 12, N)."""
    F = np.moveaxis(states[..., 8:12, :], -2, -1)
    F = F.reshape(*F.shape[:-1], 2, 2)
    return float(np.linalg.norm(F, ord=2, axis=(-2, -1)).max())


def failure(run: Callable[[], Any]) -> str:
    """What a simulation that failed says, or nothing if it did not fail."""
    try:
        run()
    except SimulationError as error:
        return str(error)
    return ""


def largest(holds: Callable[[float], bool], low: float, high: float, digits: float = 0.01) -> float:
    """Largest number between `low`, for which something holds, and `high`, to relative digits.

    It is not a number if `low` does not do, and infinite if `high` does.
    """
    if not holds(low):
        return np.nan
    if holds(high):
        return np.inf
    while high / low > 1.0 + digits:
        middle = np.sqrt(low * high)
        low, high = (middle, high) if holds(middle) else (low, middle)
    return float(low)
