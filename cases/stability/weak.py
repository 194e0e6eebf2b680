"""Weak particles beside stressed solid: random designs over Courant number and floors."""

import math
from dataclasses import replace
from typing import Any

import numpy as np
from crawler import crawler, crawler_on_ground
from walker import walker, walker_on_ground

from mpmopt.assess.threshold import distance
from mpmopt.design.actuation import sizes
from mpmopt.design.chain import interpolate
from mpmopt.design.objective import Objective
from mpmopt.design.problem import Variables
from mpmopt.errors import SceneError, SimulationError
from mpmopt.scene import Grid, Material, Scene
from mpmopt.scene.particles import discretise
from mpmopt.scene.scene import Formulation
from mpmopt.simulation.formulations import simulation_of
from stability.common import Array, Found, Line, Measured, Points
from stability.time_step import block_scene, linear_limit

EPSILONS = tuple(10.0**-k for k in range(1, 7))
COURANTS = (0.14, 0.25, 0.35, 0.5, 0.6, 0.7, 0.8)
TOTAL_COURANTS = (0.14, 0.25, 0.35, 0.45)
VISCOSITY = 0.03  # of the cases in the total Lagrangian formulation
HEAVY = 1e-2  # the void density that is the cure
SAFE_STIFFNESS = 1e-3
# In the total Lagrangian formulation, with a void density of ten times the void stiffness.
SAFE_TOTAL_COURANT, SAFE_TOTAL_STIFFNESS = 0.25, (1e-4, 1e-3)
GAIN = 0.25  # of an optimised walker: deviations are judged by it


def roomy_walker(cells: int, time_step: float) -> Scene:
    """The walker on a floor twice as long, so that no loose piece finds its end."""
    scene, c = walker(cells, time_step), 16 / 64
    body = tuple(
        replace(
            part, lower=(part.lower[0] + c, part.lower[1]), upper=(part.upper[0] + c, part.upper[1])
        )
        for part in scene.body
    )
    return replace(scene, grid=Grid((2 * cells, cells), 1 / cells), body=body)


def free_walker(cells: int, time_step: float) -> Scene:
    """The walker in the total Lagrangian formulation, on ground with a layer."""
    scene = walker_on_ground(cells, time_step, 2.0)
    return replace(scene, steps=round(1.0 / time_step), transient=0.0, filter_length=0.0)


def free_crawler(cells: int, time_step: float) -> Scene:
    """The crawler in the total Lagrangian formulation, between layers."""
    scene = crawler_on_ground(cells, time_step, 2.0)
    return replace(scene, steps=round(1.0 / time_step), transient=0.0, filter_length=0.0)


CASES = {"walker": roomy_walker, "crawler": crawler}
TOTAL_CASES = {"walker": free_walker, "crawler": free_crawler}


def courant_scene(
    case: str,
    courant: float,
    cells: int = 64,
    material: Material | None = None,
    formulation: Formulation = "updated",
) -> Scene:
    """A case whose Courant number is at most so much."""
    material = material or Material()
    steps = math.ceil(material.wave_speed * cells / courant)
    make = (CASES if formulation == "updated" else TOTAL_CASES)[case]
    rest = make(cells, 1e-4)  # viscosity may not bear the step, and goes
    return replace(rest, material=material, time_step=1.0 / steps, steps=steps)


def patches(positions: Array, seed: int) -> np.ndarray:
    """A random drawing of void and solid: which of the particles at (D, 2) are there."""
    rng = np.random.default_rng(seed)
    waves = rng.normal(scale=60.0, size=(2, 30))
    return np.cos(positions @ waves + rng.uniform(0.0, 2.0 * np.pi, 30)).sum(axis=1) > -1.0


def actuation(scene: Scene, seed: int) -> Variables:
    """Full amplitude, random phase and bias, and the actuator's own frequency."""
    theta, b = np.random.default_rng(1000 + seed).uniform(-1.0, 1.0, (2, 1))
    return Variables(np.zeros(0), np.ones(1), theta, b, np.zeros(sizes(scene)[-1]))


def with_void(scene: Scene, there: np.ndarray, variables: Variables) -> float:
    """Objective of a drawn design whose void is simulated too.

    Raises
    ------
    SimulationError
        If the simulation fails.
    """
    particles = discretise(scene)
    material = interpolate(scene.material, particles.completed(there.astype(float)))
    simulation = simulation_of(scene, particles, *material, variables.signal(scene))
    return float(Objective.of(scene, particles).centroid(simulation.run()))


def floors(epsilon: float, heavy: bool) -> Material:
    """Both floors equal, or a heavy one for mass."""
    return Material(void_stiffness=epsilon, void_density=HEAVY if heavy else epsilon)


def free_floors(epsilon: float, heavy: bool) -> Material:
    """Both floors equal, or that of mass ten times as high, as in `presets.gait`; viscous."""
    density = min(1.0, 10.0 * epsilon) if heavy else epsilon
    return Material(void_stiffness=epsilon, void_density=density, viscosity=VISCOSITY)


def limit_at_rest(material: Material) -> float:
    """Courant number from which an undeformed block of solid within void is unstable.

    Void is a frame one cell wide. The worst of several places between the nodes.
    """
    position = discretise(block_scene(8)).position
    void = np.any(np.abs(position - 12.0) > 3.0, axis=1)
    mass = np.where(void, material.void_density, 1.0)
    stiffness = np.where(void, material.void_stiffness, 1.0)
    ones = np.ones(len(position))
    return min(linear_limit(position + shift, mass, ones, stiffness) for shift in (0.0, 0.25, 0.5))


def one_square(
    case: str,
    courant: float,
    epsilon: float,
    heavy: bool,
    designs: int,
    formulation: Formulation = "updated",
) -> dict[str, Any]:
    """Random designs with void, each against the same body without it."""
    material = floors(epsilon, heavy) if formulation == "updated" else free_floors(epsilon, heavy)
    row: dict[str, Any] = {
        "formulation": formulation, "case": case, "courant": courant,
        "void_stiffness": material.void_stiffness, "void_density": material.void_density,
        "refused": False, "designs": 0, "failed": 0,
        "median_deviation": np.nan, "largest_deviation": np.nan, "error": "",
    }  # fmt: skip
    try:
        scene = courant_scene(case, courant, material=material, formulation=formulation)
    except SceneError as error:
        return row | {"refused": True, "error": str(error)}
    particles = discretise(scene)
    away = []
    for seed in range(designs):
        there = patches(particles.position[particles.designed], seed)
        variables = actuation(scene, seed)
        row["designs"] += 1
        try:
            alone = distance(scene, there, variables)
            away.append(abs(with_void(scene, there, variables) - alone))
        except SimulationError as error:
            row["failed"] += 1
            row["error"] = str(error)
    if away:
        row["median_deviation"], row["largest_deviation"] = np.median(away), max(away)
    return row


def points(quick: bool) -> Points:
    """The map: case by case, floors and Courant numbers."""
    squares = [
        {"case": case, "courant": courant, "epsilon": epsilon, "heavy": heavy,
         "designs": 2 if quick else 8}
        for case in CASES
        for heavy in (False, True)
        for epsilon in (EPSILONS[::2] + EPSILONS[-1:] if quick else EPSILONS)
        for courant in (COURANTS[2::2] if quick else COURANTS)
        if not (heavy and epsilon == HEAVY)  # is among the equal ones
    ]  # fmt: skip
    squares += [
        {"case": case, "courant": courant, "epsilon": epsilon, "heavy": heavy,
         "designs": 2 if quick else 8, "formulation": "total"}
        for case in TOTAL_CASES
        for heavy in (False, True)
        for epsilon in (EPSILONS[2:3] if quick else EPSILONS[:5])
        for courant in (TOTAL_COURANTS[::2] if quick else TOTAL_COURANTS)
    ]  # fmt: skip
    return {one_square: squares}


def measure(measured: Measured) -> Found:
    """The map, and how it sums up for equal floors and for a heavy void density."""
    rows = [r for r in measured[one_square] if r["formulation"] == "updated"]
    lines = []
    for heavy in (False, True):
        mine = [r for r in rows if (r["void_density"] == HEAVY) is heavy or not heavy]
        mine = [r for r in mine if heavy or r["void_density"] == r["void_stiffness"]]
        ran = [r for r in mine if not r["refused"]]
        failed = [r for r in ran if r["failed"]]
        runs = sum(r["designs"] for r in ran)
        at_rest_limits = [
            limit_at_rest(floors(e, heavy)) for e in EPSILONS if not (heavy and e > HEAVY)
        ]
        theory = f"linearised step at rest: {min(at_rest_limits):.2f} to {max(at_rest_limits):.2f}"
        if failed:
            first = min(failed, key=lambda r: (r["courant"], -r["void_stiffness"]))
            said = (
                f"{sum(r['failed'] for r in failed)} of {runs} runs fail, the first at Courant "
                f"{first['courant']:g} with floors of {first['void_stiffness']:.0e}"
            )
        else:
            said = f"0 of {runs} runs fail, up to Courant {max(r['courant'] for r in ran):g}"
        weak = [r["largest_deviation"] for r in ran if r["void_stiffness"] <= SAFE_STIFFNESS]
        said += (
            f"; with floors of {SAFE_STIFFNESS:g} or less void moves the objective by at most "
            f"{np.nanmax(weak):.4f}"
        )
        name = f"void density {HEAVY:g}" if heavy else "floors of mass and stiffness equal"
        refused = sum(r["refused"] for r in mine)
        program = "SimulationError: inverted, or left the grid." if failed else ""
        if refused:
            program += f" {refused} of {len(mine)} squares are refused: SceneError."
        lines.append(
            Line(f"Weak particles beside stressed solid, {name}", theory, said, program.strip())
        )
    for heavy in (False, True):
        ran = [
            r
            for r in measured[one_square]
            if r["formulation"] == "total"
            and not r["refused"]
            and (r["void_density"] > r["void_stiffness"]) is heavy
        ]
        failed = [r for r in ran if r["failed"]]
        said = f"{sum(r['failed'] for r in ran)} of {sum(r['designs'] for r in ran)} runs fail"
        for courant in sorted({r["courant"] for r in ran}):
            some = [r for r in ran if r["courant"] == courant]
            said += f", {sum(r['failed'] for r in some)} at Courant {courant:g}"
        away = [r["largest_deviation"] for r in ran if r["void_stiffness"] <= SAFE_STIFFNESS]
        said += f"; with a stiffness of {SAFE_STIFFNESS:g} or less the others' void moves the "
        said += f"objective by at most {np.nanmax(away):.4f}"
        how = "10 times the void stiffness" if heavy else "equal to the void stiffness"
        name = f"Weak particles beside stressed solid, total Lagrangian, void density {how}"
        says = sorted({r["error"].split("; ")[0].split(": ")[-1] for r in failed})
        program = f"SimulationError: {', '.join(says)}." if failed else "Runs."
        lines.append(Line(name, "", said, program))
    return Found({"weak": measured[one_square]}, lines)
