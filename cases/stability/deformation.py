"""Inversion, numerical fracture under stretch, and particles leaving the grid."""

import numpy as np

from mpmopt.errors import SimulationError
from mpmopt.particles import lay_out
from mpmopt.scene import Grid, Material, Scene, Solid
from stability.common import Array, Found, Line, at_rest, solid, stretch

# Inversion: the generalized vortex, a ring whose inside is turned by a body force.

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
    everything = lay_out(scene)
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
        error = (state[0:2] - CENTRE - R * outwards)[:, moved]
        worst = max(worst, float(np.sqrt((error**2).sum(axis=0).mean())))
    return worst / amplitude


# Numerical fracture: a stretched body's particles lose sight of each other.


def transmitted_force(factor: float, offset: float, per_cell: int = 2) -> float:
    """Share of the traction that a cut through a uniformly stretched bar transmits.

    Within one step, the right half of a bar gains momentum P h dt to the left.

    Parameters
    ----------
    factor : float
        Stretch along the bar; nothing across it.
    offset : float
        Place of the cut between two nodes, in cells.
    per_cell : int
        Particles per cell and direction, undeformed.
    """
    half = 8.0
    cells = int(2 * half * factor) + 24
    scene = Scene(
        Grid((cells, 16), 1.0),
        time_step=1e-3,
        steps=1,
        body=(Solid((2.0, 4.0), (2.0 + 2 * half, 12.0)),),
        particles_per_cell=per_cell,
    )
    particles = lay_out(scene)
    state = at_rest(particles)
    middle = round(cells / 2) + offset
    state[0] = middle + factor * (state[0] - 2.0 - half)
    state[8] = factor
    end = solid(scene, particles, state).run()
    material = scene.material
    right = state[0] > middle
    gained = -material.density * (particles.volume * end[2])[right].sum()
    nominal = material.lame_mu * (factor - 1.0 / factor) + (
        material.lame_lambda * np.log(factor) / factor
    )
    return float(gained / (nominal * 8.0 * scene.time_step))


def weakest_cut(factor: float, per_cell: int = 2) -> float:
    """The least transmitted share over all places between two nodes."""
    offsets = np.linspace(0.0, 1.0, 8, endpoint=False)
    return min(transmitted_force(factor, float(offset), per_cell) for offset in offsets)


def pulled_bar(speed: float, per_cell: int, courant: float = 0.3) -> tuple[Array, float, str]:
    """Momentum of the right half of a bar whose ends fly apart, in initial ones, over time.

    A bar that holds together comes back: its momentum changes sign.

    Parameters
    ----------
    speed : float
        Of the ends, in wave speeds.
    per_cell : int

    Returns
    -------
    (31,) array
        Over 60 travel times of a wave through a cell.
    float
        Greatest stretch.
    str
        What the run says if it fails.
    """
    wave = Material().wave_speed
    scene = Scene(
        Grid((96, 12), 1.0),
        time_step=courant / wave,
        steps=round(60.0 / courant),
        body=(Solid((40.0, 4.0), (56.0, 8.0)),),
        particles_per_cell=per_cell,
    )
    particles = lay_out(scene)
    state = at_rest(particles)
    state[2] = speed * wave * (state[0] - 48.0) / 8.0
    state[4] = speed * wave / 8.0
    right = state[0] > 48.0
    frames = np.linspace(0, scene.steps, 31).astype(int)
    try:
        states = solid(scene, particles, state).run(list(frames))
    except SimulationError as error:
        return np.full(31, np.nan), np.nan, str(error)
    momentum = states[:, 2, right].sum(axis=1) / state[2, right].sum()
    return momentum, stretch(states), ""


# Leaving the grid.


def thrown(speed: float, courant: float = 0.3) -> tuple[int, int, str]:
    """A block that flies to the right, with so many wave speeds, until it leaves the grid.

    Returns
    -------
    int
        Step in which the program notices.
    int
        Step before which its foremost particles pass half a cell from the edge.
    str
        What it says.
    """
    scene = Scene(
        Grid((24, 16), 1.0),
        time_step=courant / Material().wave_speed,
        steps=10000,
        body=(Solid((4.0, 4.0), (8.0, 8.0)),),
    )
    particles = lay_out(scene)
    state = at_rest(particles)
    state[2] = speed * scene.material.wave_speed
    way = 23.5 - particles.position[:, 0].max()
    expected = int(np.floor(way / (speed * courant))) + 1
    try:
        solid(scene, particles, state).run()
    except SimulationError as error:
        return error.step, expected, str(error)
    return -1, expected, ""


AMPLITUDES = (0.05, 0.1, 0.2, 0.3, 0.4, 0.5, 0.7, 1.0)
STRETCHES = (1.0 + 1e-6, 1.25, 1.5, 1.75, 2.0, 2.25, 2.5, 3.0, 3.5, 4.0, 5.0, 6.0, 7.0, 8.0)
SPEEDS = (0.5, 0.75, 1.0, 1.25, 1.5, 2.0)


def vortex_stretch(amplitude: float) -> float:
    """Greatest principal stretch of the exact vortex: that of its shear R alpha'."""
    e = np.linspace(-0.25, 0.25, 1001)
    shear = amplitude * np.abs((1.0 + e) * (-64.0 * e + 1024.0 * e**3)).max()
    return float(shear / 2.0 + np.sqrt(1.0 + (shear / 2.0) ** 2))


def vortices(quick: bool) -> list[dict[str, object]]:
    """Errors of the vortex over amplitudes, grids and Courant numbers."""
    rows: list[dict[str, object]] = []
    for courant in (0.4,) if quick else (0.2, 0.4):
        for cells in (24, 48) if quick else (24, 48, 96):
            for amplitude in AMPLITUDES[1::2] + AMPLITUDES[-1:] if quick else AMPLITUDES:
                row: dict[str, object] = {
                    "amplitude": amplitude, "stretch": vortex_stretch(amplitude), "cells": cells,
                    "courant": courant, "error": np.nan, "failure": "",
                }  # fmt: skip
                try:
                    row["error"] = vortex(amplitude, cells, courant=courant)
                except SimulationError as error:
                    row["failure"] = str(error)
                rows.append(row)
    return rows


def measure(quick: bool) -> Found:
    """Vortex, stretched bars, and blocks that leave the grid."""
    found = Found()
    rows = found.tables["vortex"] = vortices(quick)
    fine = [r for r in rows if r["amplitude"] == 0.1 and r["courant"] == 0.4]
    full = [r for r in rows if r["amplitude"] == 1.0]
    silent = [r for r in rows if not r["failure"] and float(str(r["error"])) > 0.2 and
              float(str(r["stretch"])) > 2.0]  # fmt: skip
    errors = ", ".join(f"{r['error']:.3f}" for r in fine)
    found.lines.append(
        Line(
            "Inversion: generalized vortex, A = 0.1",
            "exact solution, order 2",
            f"error {errors} A with {', '.join(str(r['cells']) for r in fine)} cells",
            "Runs.",
        )
    )
    said = {str(r["failure"]).split(": ")[1].split(" (")[0].split(";")[0] for r in full}
    found.lines.append(
        Line(
            "Inversion: generalized vortex, A = 1",
            f"stretch {vortex_stretch(1.0):.1f}, far beyond one particle per cell",
            f"{sum(bool(r['failure']) for r in full)} of {len(full)} runs fail",
            f"SimulationError: {', '.join(sorted(said))}.",
        )
    )
    if silent:
        worst = max(silent, key=lambda r: float(str(r["error"])))
        found.lines.append(
            Line(
                "Inversion: generalized vortex between them",
                f"stretch {vortex_stretch(0.3):.1f} at A = 0.3, {vortex_stretch(0.7):.1f} at 0.7",
                f"{len(silent)} runs end with an error above 0.2 A, up to {worst['error']:.1f} A",
                "**Runs, and is wrong**: stretch above one particle per cell.",
            )
        )
    found.tables["fracture_force"] = [
        {"per_cell": n, "stretch": s, "weakest_cut": weakest_cut(s, n)}
        for n in (2, 3)
        for s in STRETCHES
    ]
    bars = found.tables["fracture_bar"] = []
    for n in (2, 3):
        for speed in SPEEDS:
            momentum, longest, said_bar = pulled_bar(speed, n)
            back = bool(np.nanmin(momentum) < -0.5) if not said_bar else False
            bars.append(
                {"per_cell": n, "speed": speed, "stretch": longest, "comes_back": back,
                 "failure": said_bar, "least_momentum": float(np.min(momentum))}
            )  # fmt: skip
    torn = {
        n: min(
            (b["speed"] for b in bars if b["per_cell"] == n and not b["comes_back"]), default=np.inf
        )
        for n in (2, 3)
    }
    cuts = {(r["per_cell"], r["stretch"]): r["weakest_cut"] for r in found.tables["fracture_force"]}
    found.lines.append(
        Line(
            "Numerical fracture, 2 (3) particles per cell and direction",
            "stretch 2 (3): one particle a cell; stretch 4 (6): neighbours share no node",
            f"weakest cut carries {cuts[2, 2.0]:.0%}, {cuts[2, 3.0]:.0%}, {abs(cuts[2, 4.0]):.0%} "
            f"at stretch 2, 3, 4 ({cuts[3, 3.0]:.0%} and {abs(cuts[3, 6.0]):.0%} at 3 and 6); a "
            f"pulled bar tears from {torn[2]:g} ({torn[3]:g}) c_p on",
            "**Runs, and is wrong**: nothing is said.",
        )
    )
    flights = found.tables["leaving"] = []
    for speed in (0.11, 0.37, 1.01):
        noticed, expected, text = thrown(speed)
        flights.append({"speed": speed, "step": noticed, "expected": expected, "failure": text})
    found.lines.append(
        Line(
            "Particles that leave the grid",
            "noticed in step " + ", ".join(str(f["expected"]) for f in flights),
            "noticed in step " + ", ".join(str(f["step"]) for f in flights),
            "SimulationError with step, particle and place.",
        )
    )
    return found
