"""The optimiser as an adversary: it finds designs in which weak particles fail, or propel."""

from contextlib import suppress
from typing import Any

import numpy as np

from mpmopt.assess.threshold import THRESHOLD, distance, solid_body
from mpmopt.design.objective import Objective
from mpmopt.design.problem import Problem
from mpmopt.design.step_control import LIMITS
from mpmopt.errors import SimulationError
from mpmopt.optimisation.loop import optimise
from mpmopt.optimisation.settings import Settings, Stage
from mpmopt.scene import Material
from stability.common import Found, Line, Measured, Points, stretch
from stability.weak import CASES, HEAVY, SAFE_STIFFNESS, courant_scene

FLOORS = ((HEAVY, SAFE_STIFFNESS), (1e-3, 1e-3), (1e-5, 1e-5))  # of mass and stiffness
COURANTS = (0.25, 0.5, 0.8)
BETAS = (1, 4, 16)


def climb(
    case: str, mass: float, stiffness: float, courant: float, most: int, halvings: int = 0
) -> dict[str, Any]:
    """A short optimisation with long moves: what fails, and what is left at half the step.

    Parameters
    ----------
    case : str
    mass, stiffness : float
        Floors.
    courant : float
    most : int
        Successful evaluations at each of three sharpnesses.
    halvings : int
        How often the program may halve the step of an evaluation; 0 shows how many would fail,
        and no limit counts.
    """
    scene = courant_scene(case, courant, 64, Material(void_density=mass, void_stiffness=stiffness))
    stages = tuple(
        Stage(
            beta,
            mass,
            stiffness,
            scene.time_step,
            move_limit=0.1,
            halvings=halvings,
            limited=halvings > 0,
        )
        for beta in BETAS
    )
    settings = Settings(stages, least_iterations=most, most_iterations=most)
    run = optimise(scene, settings, Problem(scene).join(0.0, 1.0, -0.3, -0.5))
    best, problem = run.result, run.problem()
    x, variables = best.x, problem.split(best.x)
    block = np.ones(variables.phi.size, dtype=bool)
    reference = distance(problem.scene, block, variables)
    row: dict[str, Any] = {
        "case": case, "void_density": mass, "void_stiffness": stiffness, "courant": courant,
        "halvings": halvings, "evaluations": len(run.history), "failed": run.failed_evaluations,
        "halved": run.halved_evaluations, "gain": best.objective - reference,
        "gain_half_step": np.nan, "gain_without_void": np.nan, "stretch_without_void": np.nan,
    }  # fmt: skip
    half = Problem(
        problem.scene.vary(time_step=best.time_step / 2.0),
        BETAS[best.stage],
        halvings=halvings,
        limits=LIMITS if halvings else None,
    )
    with suppress(SimulationError):
        row["gain_half_step"] = float(half.value(x)) - reference
    simulation = solid_body(problem.scene, best.gamma >= THRESHOLD, variables)
    objective = Objective.of(problem.scene, simulation.particles)
    with suppress(SimulationError):
        states = simulation.run([*range(0, simulation.steps, 10), simulation.steps])
        row["gain_without_void"] = float(objective.centroid(states[-1])) - reference
        row["stretch_without_void"] = stretch(states)
    return row


def points(quick: bool) -> Points:
    """Both cases by floors and Courant numbers; in short, only the safe corner and a bad one."""
    choices = [(FLOORS[0], 0.5), (FLOORS[2], 0.8)]
    if not quick:
        choices = [(floors, courant) for floors in FLOORS for courant in COURANTS]
    climbs = [
        {"case": case, "mass": mass, "stiffness": stiffness, "courant": courant,
         "most": 6 if quick else 12, "halvings": halvings}
        for halvings in (0, 2)
        for case in CASES
        for (mass, stiffness), courant in choices
        if halvings == 0 or courant == COURANTS[-1]
    ]  # fmt: skip
    return {climb: climbs}


def measure(measured: Measured) -> Found:
    """What fails by floors and Courant numbers, and what is left at half the step."""
    rows = measured[climb]
    lines = []
    for floors in FLOORS:
        both = [row for row in rows if (row["void_density"], row["void_stiffness"]) == floors]
        mine = [row for row in both if row["halvings"] == 0]
        if not mine:
            continue
        failed, halved, of = (
            sum(row[key] for row in both if row["halvings"])
            for key in ("failed", "halved", "evaluations")
        )
        program = "SimulationError; the optimiser goes back with half the move limit."
        if of:
            program = (
                f"Repeated with half the step: at Courant {COURANTS[-1]:g} {halved} of {of} are "
                f"halved and {failed} fail (SimulationError)."
            )
        share = ", ".join(
            f"{sum(r['failed'] for r in mine if r['courant'] == c)} of "
            f"{sum(r['evaluations'] for r in mine if r['courant'] == c)} at {c:g}"
            for c in dict.fromkeys(row["courant"] for row in mine)
        )
        kept = [row["gain_half_step"] / row["gain"] for row in mine if row["gain"] > 0.02]
        lines.append(
            Line(
                f"The optimiser as adversary, floors of mass and stiffness {floors[0]:g}, "
                f"{floors[1]:g}",
                "",
                f"without step control fail, by Courant number: {share}; half the step keeps "
                f"{np.nanmin(kept):.0%} to {np.nanmax(kept):.0%} of the gain; without void solid "
                f"is stretched up to {np.nanmax([r['stretch_without_void'] for r in mine]):.1f}",
                program,
            )
        )
    return Found({"adversary": rows}, lines)
