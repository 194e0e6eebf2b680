"""The time step over its limit: an isolated particle, bulk, free bodies, and fast spin."""

from dataclasses import replace
from typing import Any

import numpy as np
import scipy.linalg
from exact import at_rest

from mpmopt import kernels
from mpmopt.errors import SceneError, SimulationError
from mpmopt.scene import Grid, Scene, Solid
from mpmopt.scene.particles import Particles, discretise
from stability.common import (
    Array,
    Found,
    Line,
    Measured,
    Points,
    Rows,
    failure,
    largest,
    solid,
)

CELLS = 24
# What the documentation calls safe: Courant number, and dt |C|.
SAFE_COURANT, SAFE_TURN = 0.5, 0.35
KICK = 1e-6  # velocity of a perturbation, in wave speeds


def block_scene(cells: int = 6, steps: int = 2000) -> Scene:
    """A square solid of so many cells, free in space; cells are one wide, the step is legal."""
    low = (CELLS - cells) // 2
    scene = Scene(
        Grid((CELLS, CELLS), 1.0),
        time_step=0.01,
        steps=steps,
        body=(Solid((low, low), (low + cells, low + cells)),),
    )
    return scene


def linear_limit(
    position: Array, mass: Array, volume: Array, stiffness: Array, period: int = 0
) -> float:
    """Courant number of the solid from which the step, linearised at rest, is unstable.

    On the grid a step is u' = S u - dt M^-1 K q', q' = q + dt u: S is what the transfer to the
    particles and back makes of velocities, K the stiffness between nodes. Its first eigenvalue
    leaves the unit circle at -1, where dt^2 K u = 2 (M + M S) u.

    Parameters
    ----------
    position : (N, 2) array
        In cells.
    mass, volume, stiffness : (N,) arrays
        Mass and stiffness in those of the solid, with lambda = mu.
    period : int, optional
        Cells after which the body repeats itself along both axes; 0: it does not.
    """
    rows = period or int(position.max()) + 3
    long = 10**4
    nodes, weight = kernels.interpolation(position, 1.0, long)
    column, row = np.divmod(nodes, long)
    arm = np.stack([column - position[:, :1], row - position[:, 1:]], axis=-1)
    node = column % rows * rows + row % rows
    count = rows * rows
    lumped, shared = np.zeros(count), np.zeros((count, count))
    K, both = np.zeros((count, 2, count, 2)), np.arange(2)
    one = np.eye(2)
    for p, here in enumerate(node):
        pair, dot = np.outer(weight[p], weight[p]), arm[p] @ arm[p].T
        lumped[here] += mass[p] * weight[p]
        shared[np.ix_(here, here)] += mass[p] * pair * (1.0 + 4.0 * dot)
        tangent = (
            np.einsum("ij,ab->iajb", dot, one)
            + np.einsum("ib,ja->iajb", arm[p], arm[p])
            + np.einsum("ia,jb->iajb", arm[p], arm[p])
        )
        K[np.ix_(here, both, here, both)] += (
            16.0 * volume[p] * stiffness[p] * pair[:, None, :, None] * tangent
        )
    there = np.flatnonzero(lumped > 0.0)
    stiff = K[np.ix_(there, both, there, both)].reshape(2 * there.size, -1)
    inertia = np.diag(lumped[there]) + shared[np.ix_(there, there)]
    greatest = scipy.linalg.eigh(stiff, np.kron(inertia, one), eigvals_only=True)[-1]
    return float(np.sqrt(3.0) * np.sqrt(2.0 / greatest))  # c_p = sqrt(3) for lambda = mu = rho = 1


def stays_small(scene: Scene, particles: Particles, mass: Array, courant: float) -> bool:
    """Whether a small random motion does not grow."""
    rng = np.random.default_rng(1)
    state = at_rest(particles)
    speed = scene.material.wave_speed
    state[2:8] = KICK * speed * rng.uniform(-1.0, 1.0, state[2:8].shape)
    dt = courant * scene.grid.dx / speed
    simulation = solid(scene, particles, state, share={"mass": mass}, time_step=dt)
    try:
        return bool(np.abs(simulation.run()[2:8]).max() <= 3.0 * np.abs(state[2:8]).max())
    except SimulationError:
        return False


def isolated(scene: Scene) -> Particles:
    """One particle of the scene's body."""
    return discretise(scene).subset(np.arange(len(discretise(scene).position)) == 0)


def shifted(particles: Particles, by: float) -> Particles:
    """The same particles elsewhere between the nodes."""
    return replace(particles, position=particles.position + by)


def resting_limit(body: str, steps: int, shift: float = 0.0) -> dict[str, Any]:
    """Limit of a body at rest: linear theory beside what a small kick shows.

    Parameters
    ----------
    body : {"isolated particle", "free block", "bulk"}
    steps : int
        After which a kick must not have grown.
    shift : float
        Of a free block against the grid, in cells.
    """
    if body == "bulk":
        # A rim four times as heavy moves slowly and leaves what lies inside to itself.
        scene = block_scene(14, steps)
        particles = discretise(scene)
        rim = np.any(np.abs(particles.position - CELLS / 2) > 4.0, axis=1)
        mass = np.where(rim, 4.0, 1.0)
        patch = discretise(block_scene(6)).position
        ones = np.ones(len(patch))
        theory = linear_limit(patch, ones, ones, ones, period=6)
    else:
        scene = block_scene(steps=steps)
        block = shifted(discretise(scene), shift)
        particles = isolated(scene) if body == "isolated particle" else block
        mass = ones = np.ones(len(particles.position))
        theory = linear_limit(particles.position, ones, ones, ones)
    measured = largest(lambda c: stays_small(scene, particles, mass, c), 0.3, 3.0, 0.005)
    name = f"{body}, {shift:g} cells from the grid" if body == "free block" else body
    return {"body": name, "theory": theory, "measured": measured}


def viscous_limit(body: str, share: float, steps: int) -> dict[str, Any]:
    """Limit of a viscous body at rest, as the scene's check has it, beside what a kick shows.

    Parameters
    ----------
    body : {"isolated particle", "free block"}
    share : float
        k eta / (rho dx^2), with the limit k without viscosity: `Material.largest_time_step`.
    steps : int
    """
    scene = block_scene(steps=steps)
    material, elastic = scene.material, scene.largest_time_step
    eta = share * material.density * scene.grid.dx**2 / elastic
    scene = replace(scene, material=replace(material, viscosity=eta))
    particles = isolated(scene) if body == "isolated particle" else discretise(scene)
    mass = np.ones(len(particles.position))
    theory = scene.largest_time_step * material.wave_speed / scene.grid.dx
    measured = largest(
        lambda c: stays_small(scene, particles, mass, c), 0.8 * theory, 3.0 * theory, 0.005
    )
    return {"body": body, "share": share, "theory": theory, "measured": measured}


MOTIONS = {
    "spin": (0.0, -1.0, 1.0, 0.0),
    "squeeze": (-1.0, 0.0, 0.0, -1.0),
    "dilate": (1.0, 0.0, 0.0, 1.0),
    "shear": (0.0, 1.0, 0.0, 0.0),
    "stretch": (1.0, 0.0, 0.0, -1.0),
}
# |C| in units of c_p / dx
RATES = (0.03, 0.1, 0.2, 0.3, 0.5, 0.7, 1.0, 1.5, 2.0, 3.0)
# Courant numbers at which an oscillation of the isolated particle takes 3 and 4 steps.
RESONANCES = tuple(np.sqrt(0.75) * np.sin(np.pi / n) for n in (3, 4))


def survives(motion: Array, rate: float, courant: float, steps: int = 3000) -> bool:
    """Whether an isolated particle lives on that starts with |C| = rate c_p / dx."""
    scene = block_scene(steps=steps)
    one = isolated(scene)
    state, speed = at_rest(one), scene.material.wave_speed
    state[4:8, 0] = rate * speed / scene.grid.dx * np.asarray(motion) / np.linalg.norm(motion)
    run = solid(scene, one, state, time_step=courant * scene.grid.dx / speed).run
    return not failure(run)


def moving_limit(motion: str, rate: float, spacing: float) -> dict[str, Any]:
    """Lowest Courant number, of so many, at which an isolated particle in fast motion inverts."""
    courants = np.arange(0.1, 0.9, spacing)
    fails = (c for c in courants if not survives(np.array(MOTIONS[motion]), rate, c))
    first = float(next(fails, np.nan))
    return {"motion": motion, "rate": rate, "measured": first, "dt_C": first * rate}


def points(quick: bool) -> Points:
    """Bodies at rest, elastic and viscous, and motions by their rate."""
    steps = 1000 if quick else 4000
    shifts = (0.0, 0.25, 0.5) if quick else (0.0, 0.125, 0.25, 0.375, 0.5)
    rest: Rows = [
        {"body": "isolated particle", "steps": steps},
        *({"body": "free block", "steps": steps, "shift": shift} for shift in shifts),
        {"body": "bulk", "steps": steps},
    ]
    viscous = [
        {"body": body, "share": share, "steps": steps}
        for body in ("isolated particle", "free block")
        for share in ((1.0,) if quick else (0.1, 0.3, 1.0, 3.0))
    ]
    motion = [
        {"motion": name, "rate": rate, "spacing": 0.02 if quick else 0.01}
        for name in MOTIONS
        for rate in (RATES[::3] if quick else RATES)
    ]
    return {resting_limit: rest, viscous_limit: viscous, moving_limit: motion}


def measure(measured: Measured) -> Found:
    """Limits at rest and in motion, and what a scene says to a step that is too long."""
    rest, viscous, motion = (measured[f] for f in (resting_limit, viscous_limit, moving_limit))
    scene = block_scene()
    legal, said = scene.largest_time_step, ""
    try:
        replace(scene, time_step=1.001 * legal)
    except SceneError as error:
        said = type(error).__name__
    by_body: dict[str, list[dict[str, Any]]] = {}
    for row in rest:
        by_body.setdefault(row["body"].split(",")[0], []).append(row)
    refused = f"Refused from Courant {legal * scene.material.wave_speed:.3f} on: {said}."
    lines = []
    for body, rows in by_body.items():
        theory, found = (min(row[key] for row in rows) for key in ("theory", "measured"))
        lines.append(Line(f"Time step too long: {body}", f"{theory:.3f}", f"{found:.3f}", refused))
    for body in dict.fromkeys(row["body"] for row in viscous):
        rows = [row for row in viscous if row["body"] == body]
        said_of, found_of = (
            ", ".join(f"{row[key]:.3f} at {row['share']:g}" for row in rows)
            for key in ("theory", "measured")
        )
        lines.append(
            Line(
                f"Time step too long: {body} with viscosity",
                f"{said_of} (k eta / (rho dx^2))" if body == "isolated particle" else "",
                found_of,
                "Refused from the isolated particle's on: SceneError.",
            )
        )
    worst = {
        rate: min(r["measured"] for r in motion if r["rate"] == rate)
        for rate in dict.fromkeys(r["rate"] for r in motion)
    }
    lines.append(
        Line(
            "Time step too long: isolated particle that spins or is strained fast",
            f"resonances of order 3 and 4: {RESONANCES[0]:.3f}, {RESONANCES[1]:.3f}",
            ", ".join(f"{first:.2f} at {rate:g}" for rate, first in worst.items())
            + " (rate in c_p / dx)",
            "The particle inverts: SimulationError.",
        )
    )
    tables = {
        "time_step_rest": rest, "time_step_viscous": viscous, "time_step_motion": motion,
    }  # fmt: skip
    return Found(tables, lines)
