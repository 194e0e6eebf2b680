"""Particles that lose each other, in a stretched body, or the grid."""

from typing import Any

import numpy as np
from exact import at_rest

from mpmopt.errors import SimulationError
from mpmopt.scene import Grid, Material, Scene, Solid
from mpmopt.scene.particles import discretise
from mpmopt.scene.scene import Formulation
from mpmopt.simulation.lagrangian import LagrangianSimulation
from stability.common import Array, Found, Line, Measured, Points, solid, stretch

STRETCHES = (1.0 + 1e-6, 1.25, 1.5, 1.75, 2.0, 2.25, 2.5, 3.0, 3.5, 4.0, 5.0, 6.0, 7.0, 8.0)
SPEEDS = (0.5, 0.75, 1.0, 1.25, 1.5, 2.0)
FASTER = (3.0, 4.0)  # what a body that does not tear bears


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
    particles = discretise(scene)
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


def pulled_bar(
    speed: float, per_cell: int, courant: float = 0.3, formulation: Formulation = "updated"
) -> tuple[Array, float, str]:
    """Momentum of the right half of a bar whose ends fly apart, in initial ones, over time.

    A bar that holds together comes back: its momentum changes sign.

    Parameters
    ----------
    speed : float
        Of the ends, in wave speeds.
    per_cell : int
    courant : float, optional
    formulation : {"updated", "total"}, optional

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
        formulation=formulation,
    )
    particles = discretise(scene)
    state = at_rest(particles)
    state[2] = speed * wave * (state[0] - 48.0) / 8.0
    state[4] = speed * wave / 8.0
    right = state[0] > 48.0
    frames = np.linspace(0, scene.steps, 31).astype(int)
    if formulation == "updated":
        simulation = solid(scene, particles, state)
    else:  # a linear velocity is the same at nodes
        ones = np.ones(len(right))
        simulation = LagrangianSimulation(scene, particles, ones, ones, np.zeros((scene.steps, 0)))
        start = simulation.start
        start[2] = speed * wave * (start[0] - 48.0) / 8.0 * (simulation.lattice.mass > 0.0)
    try:
        states = simulation.run(list(frames))
    except SimulationError as error:
        return np.full(31, np.nan), np.nan, str(error)
    momentum = states[:, 2, right].sum(axis=1) / state[2, right].sum()
    return momentum, stretch(states), ""


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
    particles = discretise(scene)
    state = at_rest(particles)
    state[2] = speed * scene.material.wave_speed
    way = 23.5 - particles.position[:, 0].max()
    expected = int(np.floor(way / (speed * courant))) + 1
    try:
        solid(scene, particles, state).run()
    except SimulationError as error:
        return error.step, expected, str(error)
    return -1, expected, ""


def cut(per_cell: int, stretch: float) -> dict[str, Any]:
    """The weakest cut as a row."""
    return {"per_cell": per_cell, "stretch": stretch, "weakest_cut": weakest_cut(stretch, per_cell)}


def bar(per_cell: int, speed: float, courant: float, formulation: Formulation) -> dict[str, Any]:
    """Whether a pulled bar comes back."""
    momentum, longest, said = pulled_bar(speed, per_cell, courant, formulation)
    back = bool(np.nanmin(momentum) < -0.5) if not said else False
    return {
        "formulation": formulation, "courant": courant, "per_cell": per_cell, "speed": speed,
        "stretch": longest, "comes_back": back, "failure": said,
        "least_momentum": float(np.min(momentum)),
    }  # fmt: skip


def flight(speed: float) -> dict[str, Any]:
    """When a block that leaves the grid is noticed, and when it should be."""
    noticed, expected, text = thrown(speed)
    return {"speed": speed, "step": noticed, "expected": expected, "failure": text}


def points(quick: bool) -> Points:
    """Cuts through stretched bars, pulled bars, and blocks that leave the grid: none takes long."""
    return {
        cut: [{"per_cell": n, "stretch": s} for n in (2, 3) for s in STRETCHES],
        bar: [
            {"per_cell": n, "speed": speed, "courant": 0.3, "formulation": "updated"}
            for n in (2, 3)
            for speed in SPEEDS
        ]
        + [
            {"per_cell": 2, "speed": speed, "courant": courant, "formulation": "total"}
            for courant in (0.05, 0.1, 0.2, 0.3)
            for speed in (*SPEEDS, *FASTER)
        ],
        flight: [{"speed": speed} for speed in (0.11, 0.37, 1.01)],
    }


def measure(measured: Measured) -> Found:
    """Cuts, bars and flights."""
    bars, flights = measured[bar], measured[flight]
    found = Found({"fracture_force": measured[cut], "fracture_bar": bars, "leaving": flights})
    torn = {
        n: min(
            (
                b["speed"]
                for b in bars
                if (b["formulation"], b["per_cell"]) == ("updated", n) and not b["comes_back"]
            ),
            default=np.inf,
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
            "A simulation runs on, **and is wrong**; `Problem` ends in a FractureError beyond 1.5 "
            "times one particle a cell, and bodies without void beyond one.",
        )
    )
    whole = [b for b in bars if b["formulation"] == "total"]
    borne = ", ".join(
        f"{max(b['speed'] for b in some):g} c_p (stretch {max(b['stretch'] for b in some):.1f}) at "
        f"Courant {courant:g}"
        for courant in sorted({b["courant"] for b in whole})
        if (some := [b for b in whole if b["courant"] == courant and b["comes_back"]])
    )
    lost = [b for b in whole if not b["comes_back"]]
    why = sorted({b["failure"].split("; ")[0].split(": ")[-1] for b in lost if b["failure"]})
    found.lines.append(
        Line(
            "A bar that is pulled, total Lagrangian",
            "no fracture; stiffness grows with the stretch squared",
            f"comes back up to {borne}; {len(lost)} of {len(whole)} do not",
            f"SimulationError: {', '.join(why)}; `Problem` redoes it with half the step.",
        )
    )
    found.lines.append(
        Line(
            "Particles that leave the grid",
            "noticed in step " + ", ".join(str(f["expected"]) for f in flights),
            "noticed in step " + ", ".join(str(f["step"]) for f in flights),
            "SimulationError with step, particle and place.",
        )
    )
    return found
