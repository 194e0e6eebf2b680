"""Inversion: the generalized vortex, a ring whose inside is turned by a body force."""

from typing import Any

import numpy as np
from exact import at_rest

from mpmopt.errors import SimulationError
from mpmopt.scene import Grid, Material, Scene, Solid
from mpmopt.scene.particles import discretise
from mpmopt.scene.scene import Formulation
from mpmopt.simulation.lagrangian import LagrangianSimulation
from stability.common import Array, Found, Line, Measured, Points, solid

AMPLITUDES = (0.05, 0.1, 0.2, 0.3, 0.4, 0.5, 0.7, 1.0)
RING = Material(lame_lambda=1000 * 0.3 / (1.3 * 0.4), lame_mu=1000 / 2.6, density=1000.0)
CENTRE = 1.5


class Vortex:
    """The exact motion of material points, and the body force that makes it.

    It turns radius R by alpha = A sin(pi t) (1 - 32 (R - 1)^2 + 256 (R - 1)^4).
    """

    def __init__(self, position: Array, amplitude: float) -> None:
        X = position.T - CENTRE
        self.amplitude = amplitude
        self.R, self.angle = np.hypot(*X), np.arctan2(X[1], X[0])
        e = self.R - 1.0
        self.moved = np.abs(e) < 0.25
        self.g = np.where(self.moved, 1.0 - 32.0 * e**2 + 256.0 * e**4, 0.0)
        self.slope = np.where(self.moved, -64.0 * e + 1024.0 * e**3, 0.0)
        self.curvature = np.where(self.moved, -64.0 + 3072.0 * e**2, 0.0)

    def rotated(self, t: float) -> tuple[Array, Array, Array]:
        """Unit vectors along the radius and across it, and alpha / g."""
        time = self.amplitude * np.sin(np.pi * t)
        turned = self.angle + time * self.g
        return (
            np.array([np.cos(turned), np.sin(turned)]),
            np.array([-np.sin(turned), np.cos(turned)]),
            np.array(time),
        )

    def position(self, t: float) -> Array:
        """Where the points (2, N) are."""
        return CENTRE + self.R * self.rotated(t)[0]

    def force(self, t: float) -> Array:
        """The body force (2, N), per mass."""
        shear = RING.lame_mu / RING.density
        outwards, across, time = self.rotated(t)
        rate = self.amplitude * np.pi * np.cos(np.pi * t) * self.g
        radial = -self.R * rate**2 + shear * self.R * (time * self.slope) ** 2
        bent = self.R * self.curvature + 3.0 * self.slope
        tangential = -self.R * np.pi**2 * time * self.g - shear * time * bent
        return radial * outwards + tangential * across

    def error(self, position: Array, t: float) -> float:
        """Root mean square of what is missed by points (2, N) that move, in amplitudes."""
        miss = (position - self.position(t))[:, self.moved]
        return float(np.sqrt((miss**2).sum(axis=0).mean())) / self.amplitude


def square(cells: int, courant: float, formulation: Formulation = "updated") -> Scene:
    """The solution has no displacement outside the ring: any body that holds it will do."""
    dx = 2.0 * CENTRE / cells
    return Scene(
        Grid((cells, cells), dx),
        time_step=courant * dx / RING.wave_speed,
        steps=1,
        material=RING,
        body=(Solid((2 * dx, 2 * dx), (3.0 - 2 * dx, 3.0 - 2 * dx)),),
        formulation=formulation,
    )


def vortex(amplitude: float, cells: int, duration: float = 1.0, courant: float = 0.4) -> float:
    """Root mean square error of the displacement at its worst, in amplitudes.

    The body force is applied to the particles between steps.

    Raises
    ------
    SimulationError
        If a particle inverts.
    """
    scene = square(cells, courant)
    dx, dt = scene.grid.dx, scene.time_step
    everything = discretise(scene)
    # A rim of two cells holds the edges.
    off = np.abs(np.hypot(*(everything.position - CENTRE).T) - 1.0)
    ring = everything.subset(off < 0.25 + 2.0 * dx)
    exact = Vortex(ring.position, amplitude)
    R, angle, g, slope = exact.R, exact.angle, exact.g, exact.slope
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
    rim = np.flatnonzero(~exact.moved)
    held = state[:, rim]
    worst = 0.0
    for step in range(round(duration / dt)):
        state[2:4] += dt * exact.force(step * dt)
        try:
            state = solid(scene, ring, state).run()
        except SimulationError as error:
            raise SimulationError(
                error.what, step, error.particle, error.position, error.hint
            ) from error
        state[:, rim] = held
        worst = max(worst, exact.error(state[0:2], (step + 1) * dt))
    return worst


def total_vortex(amplitude: float, cells: int, courant: float = 0.4) -> float:
    """The same error in the total Lagrangian formulation, of a whole square.

    Raises
    ------
    SimulationError
        If the step is too long for how far the body is stretched.
    """
    scene = square(cells, courant, "total")
    dt, particles = scene.time_step, discretise(scene)
    simulation = LagrangianSimulation(
        scene, particles, RING.density * np.ones(len(particles.position)),
        np.ones(len(particles.position)), np.zeros((1, 0)),
    )  # fmt: skip
    lattice, at = simulation.lattice, simulation.start[:2]
    exact, of_nodes = Vortex(particles.position, amplitude), Vortex(at.T, amplitude)
    # Velocities are half a step behind. A spline is an eighth of the curvature off its nodes.
    v = (at - of_nodes.position(-dt)) / dt
    v = v.reshape(2, lattice.rows + 2, -1)
    bent = 4.0 * v - sum(np.roll(v, k, axis) for k in (1, -1) for axis in (1, 2))
    segment = simulation.segment(1)
    states = segment.states
    there = lattice.mass > 0.0
    states[0, 2:] = np.where(there, (v + bent / 8.0).reshape(2, -1), 0.0)
    # What is two cells off the ring is held, so that no error turns the square.
    rim = np.flatnonzero(abs(of_nodes.R - 1.0) > 0.25 + 2.0 * scene.grid.dx)
    rest = states[0][:, rim]
    to_nodes = simulation._weights[0].T * (RING.density * lattice.volume)
    worst = 0.0
    for step in range(round(1.0 / dt)):
        push = (to_nodes @ exact.force(step * dt).T).T[:, there]
        states[0, 2:, there] += dt * (push / lattice.mass[there]).T
        try:
            segment.advance(0, 1)
        except SimulationError as error:
            raise SimulationError(
                error.what, step, error.particle, error.position, error.hint
            ) from error
        states[0] = states[1]
        states[0][:, rim] = rest
        worst = max(worst, exact.error(simulation.particle_state(states[0])[:2], (step + 1) * dt))
    return worst


def lumped(cells: int) -> float:
    """About how much too far the vortex swings with lumped mass, in amplitudes.

    A wave number k then has (k h)^2 / 4 more inertia, which its stiffness k^2 mu bears: of a swing
    that is slow beside that, pi^2 rho h^2 / (4 mu), whatever k is.
    """
    return float(np.pi**2 * RING.density * (2.0 * CENTRE / cells) ** 2 / (4.0 * RING.lame_mu))


def vortex_stretch(amplitude: float) -> float:
    """Greatest principal stretch of the exact vortex: that of its shear R alpha'."""
    e = np.linspace(-0.25, 0.25, 1001)
    shear = amplitude * np.abs((1.0 + e) * (-64.0 * e + 1024.0 * e**3)).max()
    return float(shear / 2.0 + np.sqrt(1.0 + (shear / 2.0) ** 2))


def one_vortex(
    amplitude: float, cells: int, courant: float, formulation: Formulation
) -> dict[str, Any]:
    """Its error, or why it failed."""
    row: dict[str, Any] = {
        "formulation": formulation, "amplitude": amplitude, "stretch": vortex_stretch(amplitude),
        "cells": cells, "courant": courant, "error": np.nan, "failure": "",
    }  # fmt: skip
    of = vortex if formulation == "updated" else total_vortex
    try:
        return row | {"error": of(amplitude, cells, courant=courant)}
    except SimulationError as error:
        return row | {"failure": str(error)}


def points(quick: bool) -> Points:
    """Vortices over formulations, amplitudes, grids and Courant numbers."""
    vortices = [
        {"amplitude": amplitude, "cells": cells, "courant": courant, "formulation": formulation}
        for formulation in ("updated", "total")
        for courant in ((0.2,) if quick else (0.2, 0.4))
        for cells in ((24, 48) if quick else (24, 48, 96))
        for amplitude in (AMPLITUDES[1::2] if quick else AMPLITUDES)
    ]
    return {one_vortex: vortices}


def measure(measured: Measured) -> Found:
    """The vortex at a tenth, at one, and between."""
    found = Found()
    both = found.tables["vortex"] = measured[one_vortex]
    rows = [r for r in both if r["formulation"] == "updated"]
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
    total = [r for r in both if r["formulation"] == "total"]
    courants = sorted({r["courant"] for r in total})
    most = {
        courant: max(
            (r["stretch"] for r in total if r["courant"] == courant and not r["failure"]),
            default=np.nan,
        )
        for courant in courants
    }
    failed = [r for r in total if r["failure"]]
    first = min((r["stretch"] for r in failed), default=np.nan)
    full = [r for r in total if r["amplitude"] == 1.0]
    ran = ", ".join(
        f"{r['error']:.3f} A with {r['cells']} cells at Courant {r['courant']:g}"
        for r in full
        if not r["failure"]
    )
    slow = [r for r in total if (r["amplitude"], r["courant"]) == (0.1, courants[0])]
    found.lines.append(
        Line(
            "Inversion: generalized vortex, total Lagrangian",
            "order 2: lumped mass makes "
            + ", ".join(f"{lumped(r['cells']):.3f}" for r in slow)
            + f" A; stretch {vortex_stretch(1.0):.1f} at A = 1, stiffness grows with its square",
            "at A = 0.1 error "
            + ", ".join(f"{r['error']:.3f}" for r in slow)
            + f" A with {', '.join(str(r['cells']) for r in slow)} cells; at A = 1 "
            f"{ran or 'none'}; {len(failed)} of {len(total)} runs fail, from "
            f"stretch {first:.1f} on; "
            + ", ".join(
                f"up to {stretch:.1f} at Courant {courant:g}" for courant, stretch in most.items()
            ),
            "SimulationError: a node is not a number; `Problem` redoes it with half the step.",
        )
    )
    return found
