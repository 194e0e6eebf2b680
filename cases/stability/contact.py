"""Contact: onset and rest of a dropped block; sticking, sliding and rolling on an incline."""

import math
from typing import Any, Literal

import numpy as np
from exact import at_rest

from mpmopt.errors import SimulationError
from mpmopt.scene import Grid, Ground, Material, Scene, Solid, Wall
from mpmopt.scene.particles import discretise
from stability.common import Array, Found, Line, Measured, Points, Rows, solid

DX = 1.0 / 32.0
STEEP = 0.3  # tan(alpha) of the incline
LAWS = "wall", "layer"  # clamped nodes, and ground with a contact layer


def dropped_block(steps: int, drop: float = 1.0) -> tuple[Array, Array]:
    """Height of the lowest particles above the last clamped row, and of a free fall, in cells."""
    scene = Scene(
        Grid((32, 32), DX),
        time_step=2e-3,
        steps=steps,
        gravity=(0.0, -1.0),
        body=(Solid((8 * DX, (3 + drop) * DX), (16 * DX, (9 + drop) * DX)),),
        walls=(Wall("y", 3 * DX),),
    )
    particles = discretise(scene)
    states = solid(scene, particles).run(range(steps + 1))
    number = np.arange(steps + 1)
    free = particles.position[:, 1].min() - scene.time_step**2 * number * (number + 1) / 2
    return states[:, 1].min(axis=1) / DX - 2.0, free / DX - 2.0


def floor_at(
    law: str, y: float, friction: float | Literal["stick"], thickness: float
) -> dict[str, Any]:
    """What a scene stands on at a height y."""
    if law == "wall":
        return {"walls": (Wall("y", y, friction=friction),)}
    return {"ground": (Ground.floor(y - thickness, friction, thickness=thickness),)}


def travelled(
    shape: str, friction: float, slope: float = STEEP, cells: int = 32, law: str = "wall"
) -> float:
    """Acceleration of a body along an incline, in those of a frictionless slide.

    Gravity is tilted, the floor is level. The body first settles under the normal part of gravity.

    Parameters
    ----------
    shape : {"block", "disc"}
    friction : float
    slope : float
        tan(alpha).
    cells : int
        In a unit of length; the block is 1/4 by 1/8, the disc has radius 0.15.
    law : {"wall", "layer"}
        The layer has a thickness of 1/64.
    """
    dx = 1.0 / cells
    alpha = math.atan(slope)
    g = 1.0
    material = Material(lame_lambda=50.0, lame_mu=50.0)
    dt = 0.4 * dx / material.wave_speed
    normal = -g * math.cos(alpha)
    floor = 4 * dx
    box = (
        ((0.25, floor), (0.5, floor + 0.125))
        if shape == "block"
        else ((0.25, floor), (0.5625, floor + 0.3125))
    )
    run, settle = 1.2, 1.0

    def scene(gravity: tuple[float, float], seconds: float) -> Scene:
        return Scene(
            Grid((2 * cells, cells), dx),
            time_step=dt,
            steps=round(seconds / dt),
            gravity=gravity,
            material=material,
            body=(Solid(*box),),
            **floor_at(law, floor, friction, 1 / 64),
        )

    first = scene((0.0, normal), settle)
    particles = discretise(first)
    if shape == "disc":
        arm = particles.position - np.array([0.40625, floor + 0.15])
        particles = particles.subset(np.hypot(*arm.T) < 0.15)
    state = solid(first, particles).run()
    state[2:8] = 0.0
    second = scene((g * math.sin(alpha), normal), run)
    frames = np.linspace(0, second.steps, 13).astype(int)
    x = solid(second, particles, state).run(list(frames))[:, 0].mean(axis=1)
    t = frames * dt
    # From the second third on: x = x0 + v0 t + a t^2 / 2
    late = t >= run / 3.0
    return float(2.0 * np.polyfit(t[late], x[late], 2)[0] / (g * math.sin(alpha)))


def theory(shape: str, ratio: float) -> float:
    """The same, of a rigid body, where `ratio` is friction / tan(alpha)."""
    if shape == "block":
        return max(0.0, 1.0 - ratio)
    return 2.0 / 3.0 if ratio >= 1.0 / 3.0 else 1.0 - ratio


def impact(speed: float, courant: float, law: str = "wall") -> dict[str, Any]:
    """A square block thrown at a floor: how fast it comes back, in impact speeds."""
    wave = Material().wave_speed
    seconds = 20.0 / wave * (1.0 + 0.4 / speed)
    scene = Scene(
        Grid((32, 64), 1.0),
        time_step=courant / wave,
        steps=round(seconds * wave / courant),
        body=(Solid((12.0, 12.0), (20.0, 20.0)),),
        **floor_at(law, 8.0, "stick", 1.0),
    )
    particles = discretise(scene)
    state = at_rest(particles)
    state[3] = -speed * wave
    row: dict[str, Any] = {
        "law": law, "speed": speed, "courant": courant, "rebound": np.nan, "failure": "",
    }  # fmt: skip
    try:
        end = solid(scene, particles, state).run()
        row["rebound"] = float(end[3].mean() / (speed * wave))
    except SimulationError as error:
        row["failure"] = str(error)
    return row


RATIOS = (0.0, 0.1, 0.2, 0.3, 0.4, 0.6, 0.8, 1.2, 2.0, 3.0)
SPEEDS = (0.1, 0.2, 0.5, 1.0, 1.5, 2.0, 3.0, 5.0)


def on_incline(shape: str, cells: int, ratio: float, law: str = "wall") -> dict[str, Any]:
    """A body on the incline, in theory and as measured."""
    return {
        "law": law, "shape": shape, "cells": cells, "ratio": ratio,
        "theory": theory(shape, ratio),
        "measured": travelled(shape, ratio * STEEP, cells=cells, law=law),
    }  # fmt: skip


def points(quick: bool) -> Points:
    """Inclines and impacts."""
    inclines = [
        {"shape": shape, "cells": cells, "ratio": ratio, "law": law}
        for law in LAWS
        for shape in ("block", "disc")
        for cells in ((32,) if quick else (32, 64, 128))
        for ratio in (RATIOS[::3] if quick else RATIOS)
    ]
    impacts = [
        {"speed": s, "courant": courant, "law": law}
        for law in LAWS
        for s in SPEEDS
        for courant in (0.14, 0.35)
    ]
    return {on_incline: inclines, impact: impacts}


def measure(measured: Measured) -> Found:
    """Onset and rest, inclines, impacts."""
    found = Found()
    height, free = dropped_block(300)
    last_free = int(np.flatnonzero(np.abs(height - free) < 1e-9).max())
    found.tables["contact_onset"] = [
        {"step": k, "height": float(height[k]), "free_fall": float(free[k])} for k in range(301)
    ]
    rest = float(dropped_block(15000)[0][-1])
    found.lines.append(
        Line(
            "Contact: onset and rest of a dropped block",
            "felt 1.5 cells above the last clamped row",
            f"felt between {height[last_free]:.3f} and {free[last_free + 1]:.3f} cells; rests at "
            f"{rest:.2f}",
            "Runs: the wall is half a cell soft.",
        )
    )
    found.tables["incline"], found.tables["impact"] = measured[on_incline], measured[impact]
    for law in LAWS:
        inclines, impacts = (
            [row for row in measured[function] if row["law"] == law]
            for function in (on_incline, impact)
        )
        found.lines += lines(law, inclines, impacts)
    return found


def lines(law: str, rows: Rows, hits: Rows) -> list[Line]:
    """What inclines and impacts of one law amount to."""
    found, on = [], "" if law == "wall" else ", on a layer"

    def worst(shape: str, low: float, high: float) -> str:
        return ", ".join(
            "{:.2g}".format(
                max(
                    abs(r["measured"] - r["theory"])
                    for r in rows
                    if r["shape"] == shape and r["cells"] == cells and low <= r["ratio"] <= high
                )
            )
            for cells in dict.fromkeys(r["cells"] for r in rows)
        )

    cells = ", ".join(str(n) for n in dict.fromkeys(r["cells"] for r in rows))
    unit = "of g sin(alpha)"
    for name, rigid, shape, low, high, loss in (
        ("sticking block", "a = 0 for mu_f >= tan(alpha)", "block", 1.0, 9.0, "Runs."),
        ("sliding block", "a = g (sin - mu_f cos)", "block", 0.0, 0.99, "Runs."),
        ("sliding disc", "a = g (sin - mu_f cos)", "disc", 0.0, 0.32, "Runs."),
        ("rolling disc", "a = 2/3 g sin for tan(alpha) <= 3 mu_f", "disc", 0.34, 9.0,
         f"Runs: rolls too {'fast' if law == 'wall' else 'slowly'} by a share that falls with the "
         "cells."),
    ):  # fmt: skip
        off = f"off by at most {worst(shape, low, high)} {unit} with {cells} cells"
        found.append(Line(f"Contact: {name} on an incline{on}", rigid, off, loss))
    apart = [
        abs(a["rebound"] - b["rebound"])
        for a, b in zip(hits[::2], hits[1::2], strict=True)
        if not (a["failure"] or b["failure"])
    ]
    fails = [r for r in hits if r["failure"]]
    slowest = min(fails, key=lambda r: r["speed"], default=None)
    failing = (
        "none fails"
        if slowest is None
        else f"fails from {slowest['speed']:g} c_p on at Courant {slowest['courant']:g}"
    )
    found.append(
        Line(
            f"Contact: impact{on}",
            "",
            f"rebounds at Courant 0.14 and 0.35 differ by at most {max(apart):.2f}; {failing}",
            "Runs." if slowest is None else "SimulationError: inverted, or left the grid.",
        )
    )
    return found
