"""Strong actuation, up to the loss of ellipticity and beyond.

An actuator that pushes with s S = -strength mu I lowers the shear stiffness to (1 - strength) mu.
At strength 1 shear waves stand still, beyond it they grow.
"""

from dataclasses import replace
from typing import Any

import numpy as np
from exact import at_rest
from scipy.optimize import brentq
from walker import slanted_legs

from mpmopt.assess.threshold import solid_body
from mpmopt.design.objective import Objective
from mpmopt.design.problem import Variables
from mpmopt.errors import SceneError, SimulationError
from mpmopt.scene import Actuator, Grid, Material, Scene
from mpmopt.scene.particles import discretise
from stability.common import Found, Line, Measured, Points, largest, solid, stretch
from stability.safe import STRENGTH
from stability.weak import courant_scene

KICK = 1e-6  # velocity of a perturbation, in wave speeds
STRENGTHS = (0.1, 0.2, 0.4, 0.6, 0.8, 0.9, 0.95, 0.99)
COURANTS = (0.14, 0.25, 0.35, 0.5, 0.6, 0.7, 0.8)


def equilibrium_stretch(strength: float) -> float:
    """Stretch at which an actuator that pushes with s S = -strength mu I is free of stress.

    mu (f^2 - 1) + 2 lambda ln f - strength mu f^2 = 0, with lambda = mu.
    """
    return float(brentq(lambda f: (1.0 - strength) * f**2 - 1.0 + 2.0 * np.log(f), 0.5, 2.0))


def growth_of_a_kick(strength: float, courant: float = 0.3, steps: int = 2000) -> float:
    """How many times the fastest particle of an actuator in equilibrium becomes faster.

    Infinite where the run fails.
    """
    scene = Scene(
        Grid((32, 32), 1.0),
        time_step=courant / Material().wave_speed,
        steps=steps,
        body=(Actuator((12.0, 12.0), (20.0, 20.0), stress=((1.0, 0.0), (0.0, 1.0))),),
    )
    particles = discretise(scene)
    f = equilibrium_stretch(strength)
    state = at_rest(particles)
    state[0:2] = 16.0 + f * (state[0:2] - 16.0)
    state[[8, 11]] = f
    kick = np.random.default_rng(2).uniform(-1.0, 1.0, (2, state.shape[1]))
    state[2:4] = KICK * scene.material.wave_speed * kick
    signal = np.full((steps, 1), -strength * scene.material.lame_mu)
    try:
        end = solid(scene, particles, state, signal=signal).run()
    except SimulationError:
        return np.inf
    return float(np.abs(end[2:4]).max() / np.abs(state[2:4]).max())


def kicked(strength: float) -> dict[str, Any]:
    """The same as a row."""
    return {"strength": strength, "growth": growth_of_a_kick(strength)}


def refused(strength: float) -> str:
    """What a scene says whose signal of 2 makes s S = -strength mu I."""
    stress = strength * Material().lame_mu / 2.0
    try:
        Scene(
            Grid((32, 32), 1.0),
            time_step=0.05,
            steps=1,
            body=(Actuator((12.0, 12.0), (20.0, 20.0), stress=((stress, 0.0), (0.0, stress))),),
        )
    except SceneError as error:
        return str(error)
    return ""


def driven(strength: float, courant: float, bias: float = -1.0) -> dict[str, Any]:
    """A walker on slanted legs, without void, whose actuator reaches a strength with its signal.

    Parameters
    ----------
    strength : float
        Largest |s S| / mu.
    courant : float
    bias : float
        -1: it pushes at most; 1: it pulls at most.
    """
    scene = courant_scene("walker", courant)
    stress = strength * scene.material.lame_mu / 2.0
    body = tuple(
        replace(part, stress=((stress, 0.0), (0.0, stress))) if isinstance(part, Actuator) else part
        for part in scene.body
    )
    scene = replace(scene, body=body)
    particles = discretise(scene)
    positions = particles.position[particles.designed] - np.array([16 / 64, 0.0])
    row: dict[str, Any] = {
        "strength": strength, "courant": courant, "bias": bias, "distance": np.nan,
        "stretch": np.nan, "error": "",
    }  # fmt: skip
    variables = Variables(np.zeros(0), np.ones(1), np.array([-0.3]), np.array([bias]))
    simulation = solid_body(scene, slanted_legs(positions), variables)
    objective = Objective.of(scene, simulation.particles)
    try:
        states = simulation.run([*range(0, scene.steps, 10), scene.steps])
        row["distance"] = objective.centroid(states[-1]) - 16 / 64
        row["stretch"] = stretch(states)
    except SimulationError as error:
        row["error"] = str(error)
    return row


def points(quick: bool) -> Points:
    """Kicks around the loss of ellipticity, and walkers up to it."""
    walkers = [
        {"strength": strength, "courant": courant, "bias": bias}
        for bias in (-1.0, 1.0)
        for strength in (STRENGTHS[1::2] if quick else STRENGTHS)
        for courant in (COURANTS[::3] if quick else COURANTS)
    ]
    kicks = [{"strength": s} for s in (0.5, 0.9, 0.98, 0.99, 1.0, 1.01, 1.02, 1.05)]
    return {kicked: kicks, driven: walkers}


def measure(measured: Measured) -> Found:
    """Ellipticity, measured by the growth of a kick; and walkers up to that limit."""
    walkers = measured[driven]
    limit = largest(lambda s: growth_of_a_kick(s) < 1.0, 0.5, 1.05, 0.002)
    first = next(s for s in np.linspace(0.9, 1.1, 201) if refused(s))
    ellipticity = Line(
        "Strong actuation: loss of ellipticity",
        "largest signal times actuation stress = mu",
        f"a kick grows from {limit:.3f} mu on",
        f"Refused from {first:.3f} mu on: SceneError.",
    )

    def spread(rows: list[dict[str, Any]]) -> float:
        return max(
            np.ptp([r["distance"] for r in rows if r["strength"] == s and not r["error"]])
            for s in {r["strength"] for r in rows}
        )

    pushing = [r for r in walkers if r["bias"] < 0.0]
    safe = [r for r in pushing if r["strength"] <= STRENGTH]
    rest = [r for r in pushing if r["strength"] > STRENGTH]
    failed = sum(bool(r["error"]) for r in rest)
    walking = Line(
        "Strong actuation: a walker below that limit",
        f"stretch at rest {equilibrium_stretch(0.5):.2f} at mu / 2, "
        f"{equilibrium_stretch(1.0):.2f} at mu",
        f"up to {STRENGTH} mu distances at Courant {COURANTS[0]:g} to {COURANTS[-1]:g} lie "
        f"within {spread(safe):.3f} (stretch up to {max(r['stretch'] for r in safe):.1f}), above "
        f"within {spread(rest):.3f} (stretch up to {np.nanmax([r['stretch'] for r in rest]):.1f})",
        f"{failed} of {len(rest)} strong runs end in a SimulationError; **the others run, and "
        "their distance means nothing**.",
    )
    return Found(
        {"actuation_kick": measured[kicked], "actuation_walker": walkers}, [ellipticity, walking]
    )
