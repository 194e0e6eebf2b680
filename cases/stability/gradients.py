"""Gradients over the horizon: size, single precision, and how far a Taylor expansion holds."""

from dataclasses import replace
from typing import Any

import numpy as np
from walker import slanted_legs, walker

from mpmopt.assess.verify import contact_free
from mpmopt.design.problem import Problem
from mpmopt.scene import Ground, Scene
from mpmopt.simulation.simulation import Precision
from stability.common import Array, Found, Line, Measured, Points

HORIZONS = (25, 50, 100, 200, 400, 800, 1250, 2500, 5000)
STEPS = 10.0 ** -np.arange(1.0, 7.1, 0.5)  # of the design variables, in which radii are counted
ONE_PERCENT = 0.01
NAMES = {
    "wall": "with contact", "layer": "on a layer, viscous", "none": "without contact",
}  # fmt: skip


def scene_of(steps: int, contact: str) -> Scene:
    """The first steps of a walker with heavy void: on a wall, on a layer and viscous, or free."""
    scene = walker(64, 8e-4)
    scene = replace(scene, steps=steps, material=replace(scene.material, void_density=1e-2))
    if contact == "layer":
        ground = Ground.floor(4 / 64, friction=0.5, thickness=1 / 64)
        material = replace(scene.material, viscosity=0.02)
        return replace(scene, walls=(), ground=(ground,), material=material)
    return scene if contact == "wall" else contact_free(scene, steps)


def plain(scene: Scene, precision: Precision = "double") -> Problem:
    """A problem at beta = 4 that is evaluated in its own time step and in no other."""
    return Problem(scene, beta=4.0, precision=precision, halvings=0, limits=None)


def design(problem: Problem) -> Array:
    """Slanted legs with grey edges, which walk and stay on the grid for four seconds."""
    positions = problem.particles.position[problem.particles.designed]
    noise = np.random.default_rng(0).uniform(-0.1, 0.1, len(positions))
    return problem.join(np.where(slanted_legs(positions), 0.6, -0.4) + noise, 0.9, -0.3, -0.5)


def radius(problem: Problem, x: Array, value: float, gradient: Array) -> float:
    """Largest change of all design variables up to which the gradient predicts L within 1 %.

    Along a random direction whose entries are -1 or 1; 0 if it never does.
    """
    direction = np.random.default_rng(1).choice([-1.0, 1.0], x.size)
    slope = gradient @ direction
    good = 0.0
    for step in STEPS[::-1]:
        change = problem.value(x + step * direction) - value
        # Below that, the change itself drowns in rounding.
        if abs(change - step * slope) > ONE_PERCENT * abs(step * slope) + 1e-14:
            break
        good = float(step)
    return good


def at_horizon(steps: int, contact: str) -> dict[str, Any]:
    """One horizon: sizes, errors of single precision, and the radius."""
    scene = scene_of(steps, contact)
    problem = plain(scene)
    x = design(problem)
    value, gradient = problem.value_and_gradient(x)
    single_value, single_gradient = plain(scene, precision="single").value_and_gradient(x)
    size = float(np.linalg.norm(gradient))
    return {
        "contact": contact, "steps": steps, "value": value, "gradient": size,
        "single_value_error": abs(single_value - value) / abs(value),
        "single_gradient_error": float(np.linalg.norm(single_gradient - gradient)) / size,
        "radius": radius(problem, x, value, gradient),
    }  # fmt: skip


def points(quick: bool) -> Points:
    """All horizons, with both laws of contact and without."""
    horizons = [
        {"steps": steps, "contact": contact}
        for contact in NAMES
        for steps in (HORIZONS[:7:2] if quick else HORIZONS)
    ]
    return {at_horizon: horizons}


def measure(measured: Measured) -> Found:
    """What grows with the horizon."""
    rows = measured[at_horizon]
    lines = []
    for contact, name in NAMES.items():
        mine = [r for r in rows if r["contact"] == contact]
        first, last = mine[0], mine[-1]
        steps = f"{first['steps']} and {last['steps']} steps"
        lines.append(
            Line(
                f"Gradient over the horizon, {name}",
                "",
                f"norm {first['gradient']:.1e} and {last['gradient']:.1e} after {steps}",
                "Runs; exact to rounding for the branches taken.",
            )
        )
        lines.append(
            Line(
                f"Radius of the Taylor expansion, {name}",
                "smooth" if contact == "none" else "kinks where contact begins or ends",
                f"L is linear within 1 % up to changes of {first['radius']:.0e} and "
                f"{last['radius']:.0e} after {steps}",
                "Nothing is said: a longer move may go back; the optimiser then shortens moves.",
            )
        )
        lines.append(
            Line(
                f"Single precision, {name}",
                "rounding of 6e-8 a step",
                f"gradient off by {first['single_gradient_error']:.0e} and "
                f"{last['single_gradient_error']:.0e} after {steps}, the objective by "
                f"{last['single_value_error']:.0e}",
                "Runs, if asked for.",
            )
        )
    return Found({"gradients": rows}, lines)
