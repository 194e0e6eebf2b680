"""Random designs inside the region that the documentation calls safe: nothing may fail."""

from dataclasses import replace
from typing import Any

import numpy as np

from mpmopt.design.objective import Objective
from mpmopt.design.problem import Problem
from mpmopt.errors import SimulationError
from mpmopt.scene import Actuator, Material, Scene
from stability.common import Found, Line, Measured, Points, stretch
from stability.time_step import SAFE_COURANT
from stability.weak import CASES, actuation, courant_scene

# The corner of the region where it is most likely to fail.
STRENGTH = 0.6
MATERIAL = Material(void_density=1e-2, void_stiffness=1e-3)
BETAS = (2.0, 32.0)


def corner(case: str, cells: int = 64, courant: float = SAFE_COURANT) -> Scene:
    """A case at the corner of the safe region."""
    scene = courant_scene(case, courant, cells, MATERIAL)
    stress = STRENGTH * MATERIAL.lame_mu / 2.0
    body = tuple(
        replace(part, stress=((stress, 0.0), (0.0, stress))) if isinstance(part, Actuator) else part
        for part in scene.body
    )
    return replace(scene, body=body)


def at_random(case: str, beta: float, seed: int, cells: int = 64) -> dict[str, Any]:
    """One random grey design with random actuation of full amplitude, and with half the step."""
    row: dict[str, Any] = {
        "case": case, "beta": beta, "seed": seed, "cells": cells, "distance": np.nan,
        "half_step": np.nan, "solid_stretch": np.nan, "error": "",
    }  # fmt: skip
    scene = corner(case, cells)
    for key in ("distance", "half_step"):
        problem = Problem(scene, beta=beta)
        positions = problem.particles.position[problem.particles.designed]
        rng = np.random.default_rng(seed)
        waves = rng.normal(scale=60.0, size=(2, 30))
        field = np.cos(positions @ waves + rng.uniform(0.0, 2.0 * np.pi, 30)).sum(axis=1)
        phi = np.clip(0.3 + field / 4.0, -1.0, 1.0)
        x = problem.join(phi, *actuation(scene, seed)[1:])
        simulation = problem.simulation(x)
        try:
            states = simulation.run([*range(0, scene.steps, 20), scene.steps])
        except SimulationError as error:
            return row | {"error": str(error)}
        row[key] = float(Objective.of(problem.scene, simulation.particles).centroid(states[-1]))
        if key == "distance":
            solid = problem.particles.completed(problem.gamma(x) >= 0.5)
            row["solid_stretch"] = stretch(states[:, :, solid])
        scene = scene.vary(time_step=scene.time_step / 2.0)
    return row


def points(quick: bool) -> Points:
    """Many random designs of both cases, grey and nearly black and white."""
    designs = [
        {"case": case, "beta": beta, "seed": seed, "cells": cells}
        for cells in ((64,) if quick else (64, 128))
        for case in CASES
        for beta in BETAS
        for seed in range(3 if quick else 25 if cells == 64 else 5)
    ]
    return {at_random: designs}


def measure(measured: Measured) -> Found:
    """How many fail, and how far half the step moves the others."""
    rows = measured[at_random]
    failed = sum(bool(row["error"]) for row in rows)
    change = np.array([abs(row["half_step"] - row["distance"]) for row in rows])
    longest = np.nanmax([row["solid_stretch"] for row in rows])
    line = Line(
        "At the corner of the safe region: random designs",
        "nothing fails",
        f"{failed} of {len(rows)} designs fail; half the step moves the objective by "
        f"{np.nanmedian(change):.4f} in the median and at most {np.nanmax(change):.3f}; solid is "
        f"stretched up to {longest:.1f}",
        "Runs.",
    )
    return Found({"safe": rows}, [line])
