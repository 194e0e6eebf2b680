"""Inversion: the generalized vortex, a ring whose inside is turned by a body force."""

from typing import Any

import numpy as np

from mpmopt.errors import SimulationError
from mpmopt.scene import Grid, Material, Scene, Solid
from mpmopt.scene.particles import discretise
from stability.common import Array, Found, Line, Measured, Points, at_rest, solid

AMPLITUDES = (0.05, 0.1, 0.2, 0.3, 0.4, 0.5, 0.7, 1.0)
RING = Material(lame_lambda=1000 * 0.3 / (1.3 * 0.4), lame_mu=1000 / 2.6, density=1000.0)
CENTRE = 1.5


def vortex(amplitude: float, cells: int, duration: float = 1.0, courant: float = 0.4) -> float:
    """Root mean square error of the displacement at its worst, in amplitudes.

    The exact motion turns radius R by alpha = A sin(pi t) (1 - 32 (R - 1)^2 + 256 (R - 1)^4).
    The body force is applied to the particles between steps.

    Raises
    ------
    SimulationError
        If a particle inverts.
    """
    dx = 2.0 * CENTRE / cells
    dt = courant * dx / RING.wave_speed
    scene = Scene(
        Grid((cells, cells), dx),
        time_step=dt,
        steps=1,
        material=RING,
        body=(Solid((2 * dx, 2 * dx), (3.0 - 2 * dx, 3.0 - 2 * dx)),),
    )
    everything = discretise(scene)
    # The solution has no displacement at the edges: a rim of two cells holds them.
    off = np.abs(np.hypot(*(everything.position - CENTRE).T) - 1.0)
    ring = everything.subset(off < 0.25 + 2.0 * dx)
    X = ring.position.T - CENTRE
    R, angle = np.hypot(*X), np.arctan2(X[1], X[0])
    e = R - 1.0
    moved = np.abs(e) < 0.25
    g = np.where(moved, 1.0 - 32.0 * e**2 + 256.0 * e**4, 0.0)
    slope = np.where(moved, -64.0 * e + 1024.0 * e**3, 0.0)
    curvature = np.where(moved, -64.0 + 3072.0 * e**2, 0.0)
    shear = RING.lame_mu / RING.density

    def rotated(t: float) -> tuple[Array, Array, Array]:
        """Unit vectors along the radius and across it, and alpha / g."""
        time = amplitude * np.sin(np.pi * t)
        turned = angle + time * g
        return (
            np.array([np.cos(turned), np.sin(turned)]),
            np.array([-np.sin(turned), np.cos(turned)]),
            np.array(time),
        )

    def force(t: float) -> Array:
        outwards, across, time = rotated(t)
        rate = amplitude * np.pi * np.cos(np.pi * t) * g
        radial = -R * rate**2 + shear * R * (time * slope) ** 2
        tangential = -R * np.pi**2 * time * g - shear * time * (R * curvature + 3.0 * slope)
        return radial * outwards + tangential * across

    state = at_rest(ring)
    # Velocity v0 = A pi g R across; its gradient is C, and F is one step behind.
    rate = amplitude * np.pi
    state[2:4] = rate * g * R * np.array([-np.sin(angle), np.cos(angle)])
    along, cross = (
        np.array([np.cos(angle), np.sin(angle)]),
        np.array([-np.sin(angle), np.cos(angle)]),
    )
    gradient = rate * (
        np.einsum("in,jn->nij", cross, along) * (g + R * slope)[:, None, None]
        - np.einsum("in,jn->nij", along, cross) * g[:, None, None]
    )
    state[4:8] = gradient.reshape(-1, 4).T
    start = np.linalg.inv(np.eye(2) + dt * gradient)
    state[8:12] = start.reshape(-1, 4).T
    rim = np.flatnonzero(~moved)
    held = state[:, rim]
    worst = 0.0
    for step in range(round(duration / dt)):
        state[2:4] += dt * force(step * dt)
        try:
            state = solid(scene, ring, state).run()
        except SimulationError as error:
            raise SimulationError(
                error.what, step, error.particle, error.position, error.hint
            ) from error
        state[:, rim] = held
        outwards, _, _ = rotated((step + 1) * dt)
        miss = (state[0:2] - CENTRE - R * outwards)[:, moved]
        worst = max(worst, float(np.sqrt((miss**2).sum(axis=0).mean())))
    return worst / amplitude


def vortex_stretch(amplitude: float) -> float:
    """Greatest principal stretch of the exact vortex: that of its shear R alpha'."""
    e = np.linspace(-0.25, 0.25, 1001)
    shear = amplitude * np.abs((1.0 + e) * (-64.0 * e + 1024.0 * e**3)).max()
    return float(shear / 2.0 + np.sqrt(1.0 + (shear / 2.0) ** 2))


def one_vortex(amplitude: float, cells: int, courant: float) -> dict[str, Any]:
    """Its error, or why it failed."""
    row: dict[str, Any] = {
        "amplitude": amplitude, "stretch": vortex_stretch(amplitude), "cells": cells,
        "courant": courant, "error": np.nan, "failure": "",
    }  # fmt: skip
    try:
        return row | {"error": vortex(amplitude, cells, courant=courant)}
    except SimulationError as error:
        return row | {"failure": str(error)}


def points(quick: bool) -> Points:
    """Vortices over amplitudes, grids and Courant numbers."""
    vortices = [
        {"amplitude": amplitude, "cells": cells, "courant": courant}
        for courant in ((0.2,) if quick else (0.2, 0.4))
        for cells in ((24, 48) if quick else (24, 48, 96))
        for amplitude in (AMPLITUDES[1::2] if quick else AMPLITUDES)
    ]
    return {one_vortex: vortices}


def measure(measured: Measured) -> Found:
    """The vortex at a tenth, at one, and between."""
    found = Found()
    rows = found.tables["vortex"] = measured[one_vortex]
    fine = [r for r in rows if r["amplitude"] == 0.1 and r["courant"] == rows[-1]["courant"]]
    full = [r for r in rows if r["amplitude"] == 1.0]
    silent = [r for r in rows if not r["failure"] and r["error"] > 0.2 and r["stretch"] > 2.0]
    errors = ", ".join(f"{r['error']:.3f}" for r in fine)
    found.lines.append(
        Line(
            "Inversion: generalized vortex, A = 0.1",
            "exact solution, order 2",
            f"error {errors} A with {', '.join(str(r['cells']) for r in fine)} cells",
            "Runs.",
        )
    )
    said = {r["failure"].split(": ")[1].split(" (")[0].split(";")[0] for r in full}
    found.lines.append(
        Line(
            "Inversion: generalized vortex, A = 1",
            f"stretch {vortex_stretch(1.0):.1f}, far beyond one particle per cell",
            f"{sum(bool(r['failure']) for r in full)} of {len(full)} runs fail",
            f"SimulationError: {', '.join(sorted(said))}.",
        )
    )
    if silent:
        worst = max(silent, key=lambda r: r["error"])
        found.lines.append(
            Line(
                "Inversion: generalized vortex between them",
                f"stretch {vortex_stretch(0.3):.1f} at A = 0.3, {vortex_stretch(0.7):.1f} at 0.7",
                f"{len(silent)} runs end with an error above 0.2 A, up to {worst['error']:.1f} A",
                "**Runs, and is wrong**: stretch above one particle per cell.",
            )
        )
    return found
