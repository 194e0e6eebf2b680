"""Does the grid matter? A robot on the layer of ground and on clamped nodes, on several cells.

    python cases/mesh_independence.py --out DIR [--quick]

The robot is the walker drawn by hand: the same lines, laid out in cells of a width of 1/64, 1/128
and 1/256. Measured are the displacement of its beam, which the objective is made of, after two
seconds, over the cells and over the step, for several layers; and up to which change of a design
its objective is linear. Writes
``mesh_independence.csv``, ``mesh_independence_validity.csv`` and ``mesh_independence.png``.
"""

import argparse
import sys
import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from stability import gradients
from walker import slanted_legs, walker

from mpmopt.assess.threshold import solid_body
from mpmopt.design.problem import Problem
from mpmopt.design.variables import START, Variables
from mpmopt.errors import SimulationError
from mpmopt.io.files import as_csv, replace_file
from mpmopt.scene import Ground, Scene, Wall
from mpmopt.scene.particles import discretise

Rows = list[dict[str, Any]]

C = 1 / 64
SECONDS = 2.0
LONGEST_STEP = 8e-4  # on 64 cells; it is halved with the cells
CELLS = (64, 128, 256)
SHARES = (0.01, 0.05)
# One for each choice, for the colour-blind too (P. Tol's muted and vibrant schemes).
COLOURS = (
    "#332288", "black", "#88CCEE", "#44AA99", "#117733", "#999933", "#DDCC77", "#CC6677", "#882255",
    "#AA4499", "#EE7733", "#0077BB", "#999999",
)  # fmt: skip
MARKERS = "osv^D<>pPXh*d"


@dataclass(frozen=True)
class Choice:
    """What bears the robot, and what damps it."""

    name: str
    layer: bool = True
    thickness: float = C
    fall: float = 0.0  # of the feet above the ground's line, in thicknesses
    damping: float | None = None
    friction: float = 0.5
    viscosity: float = 0.02
    per_cell: int = 2
    steps: int = 1  # as many as usual, times this
    actuated: bool = True
    stepped: bool = False  # on all cells the edges that the legs have on 64
    formulation: Literal["updated", "total"] = "updated"

    def scene(self, cells: int, halvings: int = 0, seconds: float = SECONDS) -> Scene:
        """The walker; its feet are on the ground's line, or fall onto it."""
        dt = LONGEST_STEP * 64 / cells / self.steps / 2**halvings
        scene = walker(cells, dt, self.per_cell)
        floor = Ground.floor(
            4 * C - self.fall * self.thickness,
            self.friction,
            thickness=self.thickness,
            damping=self.damping,
        )
        return replace(
            scene,
            steps=round(seconds / dt),
            material=replace(scene.material, viscosity=self.viscosity),
            walls=() if self.layer else (Wall("y", 4 * C, friction=0.5),),
            ground=(floor,) if self.layer else (),
            formulation=self.formulation,
        )


CHOICES = (
    Choice("layer"),
    Choice("clamped nodes", layer=False),
    Choice("layer, edges of 64 cells", stepped=True),
    Choice("layer, falls by a half of it", fall=0.5),
    Choice("layer, falls by all of it", fall=1.0),
    Choice("the same, edges of 64 cells", fall=1.0, stepped=True),
    Choice("layer, damping 2", damping=2.0),
    Choice("layer, twice as thick", thickness=2 * C),
    Choice("layer, friction 0.3", friction=0.3),
    Choice("layer, viscosity 0.05", viscosity=0.05, steps=2),
    Choice("layer, 3 x 3 a cell", per_cell=3),
    Choice("layer, total Lagrangian", formulation="total"),
    Choice("layer, no actuation", actuated=False),
)


def stepped_legs(position: NDArray[np.float64]) -> NDArray[np.bool_]:
    """The particles that are drawn on 64 cells, or on finer ones lie where those would."""
    h = C / 2
    return slanted_legs((np.floor(position / h) + 0.5) * h)


def displacement(
    choice: Choice, cells: int, halvings: int = 0, seconds: float = SECONDS
) -> dict[str, Any]:
    """How far the beam goes at four instants and the body at the end, and its greatest stretch."""
    scene = choice.scene(cells, halvings, seconds)
    particles = discretise(scene)
    strength = 1.0 if choice.actuated else 0.0
    a, theta, b = (
        np.array([value])
        for value in (strength * START["a"], START["theta"], strength * START["b"])
    )
    legs = stepped_legs if choice.stepped else slanted_legs
    keep = legs(particles.position[particles.designed])
    simulation = solid_body(scene, keep, Variables(np.zeros(0), a, theta, b))
    row: dict[str, Any] = {
        "choice": choice.name, "cells": cells, "step": scene.time_step,
        "displacement": np.nan, "way": np.full(4, np.nan), "body": np.nan, "stretch": np.nan,
        "failure": "",
    }  # fmt: skip
    instants = [round(k * scene.steps / 4) for k in range(5)]
    try:
        end = simulation.watch(instants)
    except SimulationError as error:
        return {**row, "failure": str(error).split(";")[0]}
    x = np.array([end.states[k][0] for k in instants])
    beam = x[:, ~simulation.particles.designed].mean(axis=1)
    return {
        **row, "displacement": float(beam[-1] - beam[0]), "way": beam[1:] - beam[0],
        "body": float(x[-1].mean() - x[0].mean()), "stretch": float(end.indicators.stretch),
    }  # fmt: skip


def spread(rows: Rows, what: str = "displacement") -> float:
    """Largest less smallest of some displacements over their mean, where that is the largest."""
    values = np.array([row[what] for row in rows])
    return float(np.max(np.ptp(values, axis=0) / abs(values.mean(axis=0))))


def over_cells_and_steps(quick: bool = False) -> Rows:
    """One row for each choice: displacements over cells and over steps, and their spreads."""
    rows, seconds = [], 0.2 if quick else SECONDS
    for choice in CHOICES[:2] if quick else CHOICES:
        began = time.process_time()
        cells = [displacement(choice, n, 0, seconds) for n in (CELLS[:1] if quick else CELLS)]
        steps = [
            [first, *(displacement(choice, first["cells"], k, seconds) for k in (1, 2))]
            for first in cells[:2]
        ]
        row: dict[str, Any] = {"choice": choice.name}
        row |= {f"{r['cells']} cells": r["displacement"] for r in cells}
        row["spread over cells"] = spread(cells)
        row["of the body"] = spread(cells, "body")
        row["at the worst of four instants"] = spread(cells, "way")
        for found in steps:
            row[f"spread over steps, {found[0]['cells']} cells"] = spread(found)
        row["greatest stretch"] = max(r["stretch"] for r in cells)
        row["failure"] = "; ".join(r["failure"] for r in cells if r["failure"])
        rows.append(row)
        print(*row.values(), f"({time.process_time() - began:.0f} s)", sep="  ", flush=True)
    return rows


def problems(design: str, layer: bool, seconds: float) -> tuple[Problem, NDArray[np.float64]]:
    """A problem on 64 cells and a design of it: the grey start, or drawn legs at beta = 8."""
    scene = Choice("", layer, fall=1.0, viscosity=0.02 if layer else 0.0).scene(64, 0, seconds)
    if not layer:
        scene = replace(scene, walls=(Wall("y", 4 * C),))  # the paper's, which stick
    scene = replace(scene, material=replace(scene.material, void_density=1e-2))
    problem = Problem(scene, beta=1.0 if design == "grey" else 8.0, halvings=0, limits=None)
    if design == "drawn":
        return problem, gradients.design(problem)
    noise = np.random.default_rng(0).uniform(-0.1, 0.1, problem.particles.designed.sum())
    return problem, problem.join(noise, 0.9, -0.3, -0.5)


def radii(
    problem: Problem, x: NDArray, value: float, slope: float, direction: NDArray
) -> dict[float, float]:
    """Largest changes along a direction up to which the slope predicts L within these shares."""
    found = dict.fromkeys(SHARES, 0.0)
    open_: tuple[float, ...] = SHARES
    for step in gradients.STEPS[::-1]:
        off = abs(problem.value(x + step * direction) - value - step * slope)
        # Below 1e-14 a change drowns in rounding.
        open_ = tuple(share for share in open_ if off <= share * abs(step * slope) + 1e-14)
        if not open_:
            break
        found |= dict.fromkeys(open_, float(step))
    return found


def validity(design: str, layer: bool, seconds: float) -> dict[str, Any]:
    """Largest changes up to which the gradient predicts the objective, along two directions."""
    problem, x = problems(design, layer, seconds)
    row: dict[str, Any] = {
        "design": design, "contact": "layer, viscosity 0.02" if layer else "clamped nodes, stick",
        "seconds": seconds,
    }  # fmt: skip
    value, gradient = problem.value_and_gradient(x)
    row["gradient"] = float(np.linalg.norm(gradient))
    for name, direction in (
        ("random signs", np.random.default_rng(1).choice([-1.0, 1.0], x.size)),
        ("the gradient's signs", np.sign(gradient)),
    ):
        found = radii(problem, x, value, gradient @ direction, direction)
        row |= {f"{share:.0%}, {name}": radius for share, radius in found.items()}
    print(*row.values(), sep="  ", flush=True)
    return row


def over_changes(quick: bool = False) -> Rows:
    """One row for each design, contact and duration."""
    return [
        validity(design, layer, seconds)
        for design in ("grey", "drawn")
        for seconds in ((0.2,) if quick else (1.0, 3.0))
        for layer in (True, False)
    ]


def plot(path: Path, rows: Rows) -> None:
    """Displacement over the cells, one line a choice."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(9.0, 4.6), layout="constrained")
    axes = figure.add_subplot()
    for row, colour, marker in zip(rows, COLOURS, MARKERS):
        cells = [n for n in CELLS if f"{n} cells" in row]
        style = {"color": colour, "marker": marker, "label": row["choice"]}
        style["ls"] = "--" if row["choice"] == "clamped nodes" else "-"
        axes.plot(cells, [row[f"{n} cells"] for n in cells], **style)
    axes.set_xscale("log", base=2)
    axes.set_xticks(CELLS, [str(n) for n in CELLS])
    axes.set_xlabel("cells in a unit of length")
    axes.set_ylabel("displacement of the beam after two seconds")
    figure.legend(loc="outside right upper", fontsize="small")
    figure.savefig(path, dpi=110)


def main(argv: list[str] | None = None) -> int:
    """Measure, and write both tables and the figure."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, required=True, metavar="DIR", help="folder of results")
    parser.add_argument("--quick", action="store_true", help="only 64 cells, for 0.2 seconds")
    arguments = parser.parse_args(argv)
    arguments.out.mkdir(parents=True, exist_ok=True)
    rows = over_cells_and_steps(arguments.quick)
    replace_file(arguments.out / "mesh_independence.csv", as_csv(rows, 3).encode())
    plot(arguments.out / "mesh_independence.png", rows)
    found = over_changes(arguments.quick)
    replace_file(arguments.out / "mesh_independence_validity.csv", as_csv(found, 3).encode())
    return 0


if __name__ == "__main__":
    sys.exit(main())
