"""Does a design keep its gain in other discretisations? Numerical propulsion does not."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from mpmopt.assess import threshold
from mpmopt.assess.threshold import distance
from mpmopt.design.ensemble import side_by_side
from mpmopt.design.problem import Problem
from mpmopt.design.step_control import with_halvings
from mpmopt.design.variation import refined
from mpmopt.errors import SceneError, SimulationError
from mpmopt.scene import Scene
from mpmopt.scene.particles import discretise, nearest_designed
from mpmopt.scene.scene import Formulation
from mpmopt.validation import instance

# How often the step is halved where a simulation with other cells, or in the other formulation,
# fails: what was designed in one need not be stable in the other.
HALVINGS = 2
FINER = "cells half as wide"
OTHER = "other formulation"
OTHERWISE = FINER, OTHER


@dataclass(frozen=True)
class Variant:
    """One simulation of a post-processed design.

    Attributes
    ----------
    name : str
        What differs from the discretisation that it was designed in.
    cells : tuple of int
    time_step : float
    reference : float
        Objective L of the solid reference design with the same actuation, or not a number.
    distance : float
        Objective L of the design, or not a number.
    retained : float
        Share of the gain over the reference that the design has where it was designed.
    failure : str
        Why there is no number, or empty.
    halved : int
        How often its step was halved because the simulation failed with a longer one.
    """

    name: str
    cells: tuple[int, int]
    time_step: float
    reference: float = np.nan
    distance: float = np.nan
    retained: float = np.nan
    failure: str = ""
    halved: int = 0


def least(problem: Problem, x: NDArray[np.float64]) -> float:
    """The lesser objective L of a design without its void with half the step or cells half as wide.

    Raises
    ------
    DesignError, SceneError, SimulationError
        As the simulations do.
    """
    scene, variables = problem.scene, problem.split(x)

    def simulated(there: Scene) -> float:
        return distance(there, mapped(there, problem, x), variables, problem.task)

    finer = scene.vary(time_step=scene.time_step / 2.0), refined(scene, 2)
    return min(side_by_side(simulated, finer))


def mapped(scene: Scene, problem: Problem, x: NDArray[np.float64]) -> NDArray[np.bool_]:
    """A post-processed design on another scene's lattice: particles whose nearest one is solid.

    Returns
    -------
    (D,) array of bool
        Which design particles of the scene are there.
    """
    return threshold.kept(problem, x)[nearest_designed(discretise(scene), problem.particles)]


def variants(scene: Scene) -> dict[str, Callable[[], Scene]]:
    """What makes the discretisations that `study` tries, by name."""
    others: dict[str, Callable[[], Scene]] = {
        "as designed": lambda: scene,
        "half the step": lambda: scene.vary(time_step=scene.time_step / 2.0),
    }
    longer = with_twice_the_step(scene)
    if longer is not None:
        others["twice the step"] = lambda: longer
    others[FINER] = lambda: refined(scene, 2)
    if not scene.walls:  # which one of the formulations does not know
        others[OTHER] = lambda: replace(scene, formulation=other_formulation(scene))
    return others


def with_twice_the_step(scene: Scene) -> Scene | None:
    """The scene with a step twice as long, or None where that is over the stability limit.

    Most robots are designed with more than half of the longest stable step.
    """
    if 2.0 * scene.time_step > scene.largest_time_step:
        return None
    return replace(scene, time_step=2.0 * scene.time_step, steps=math.ceil(scene.steps / 2))


def other_formulation(scene: Scene) -> Formulation:
    """The one that the scene is not in."""
    return "updated" if scene.formulation == "total" else "total"


def study(
    problem: Problem,
    x: NDArray[np.float64],
    progress: Callable[[Variant], None] | None = None,
) -> list[Variant]:
    """Simulate a design without its void again with other steps and cells.

    A robot is the same at every discretisation: particles that gamma >= 0.3 makes solid stay, those
    of another lattice take this from the nearest one.

    Parameters
    ----------
    problem : Problem
        In the discretisation that the design is from.
    x : (n,) array
        Its variables.
    progress : callable, optional
        Called with each line of the result.

    Returns
    -------
    list of Variant
        First as it was designed, then with half the step, twice the step where that is stable,
        cells half as wide, and in the other formulation where the scene has no walls; these two
        with a step halved up to `HALVINGS` times where they fail. What cannot be simulated says
        why.

    Raises
    ------
    DesignError
        If x does not fit, or the problem is none.
    """
    instance("study", "problem", problem, Problem)
    variables = problem.split(x)
    scene = problem.scene
    rows: list[Variant] = []

    def simulated(there: Scene) -> tuple[float, float]:
        keep = mapped(there, problem, x)
        reference, design = side_by_side(
            lambda body: distance(there, body, variables, problem.task),
            (np.ones_like(keep), keep),
        )
        return reference, design

    for name, make in variants(scene).items():
        there = scene
        try:
            there = make()
            # What is as designed, or has another step, has that one.
            most = HALVINGS if name in OTHERWISE else 0
            (reference, design), halved = with_halvings(there, simulated, most)
            gain = rows[0].distance - rows[0].reference if rows else design - reference
            retained = threshold.retained_share(scene, design - reference, gain)
            step = there.time_step / 2**halved
            rows.append(
                Variant(name, there.grid.cells, step, reference, design, retained, halved=halved)
            )
        except (SceneError, SimulationError) as error:
            rows.append(Variant(name, there.grid.cells, there.time_step, failure=str(error)))
        if progress is not None:
            progress(rows[-1])
    return rows
