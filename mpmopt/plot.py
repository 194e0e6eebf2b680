"""Pictures of designs and of the history of an optimisation, drawn without a screen."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import PolyCollection
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle
from numpy.typing import NDArray

from mpmopt.history import Optimisation
from mpmopt.problem import Problem
from mpmopt.scene import Mirror, Scene
from mpmopt.simulate import Simulation


def draw_walls(axes: Axes, scene: Scene) -> None:
    """Draw the walls where bodies come to rest, which is at their position."""
    width, height = scene.grid.size
    for wall in scene.walls:
        start, end = (
            (0.0, wall.position)
            if wall.solid_side == "below"
            else (wall.position, width if wall.axis == "x" else height)
        )
        corner, size = (
            ((start, 0.0), (end - start, height))
            if wall.axis == "x"
            else ((0.0, start), (width, end - start))
        )
        axes.add_patch(Rectangle(corner, *size, facecolor="0.85", edgecolor="0.4", hatch="//"))


def draw_body(
    axes: Axes,
    state: NDArray[np.float64],
    spacing: float,
    gamma: NDArray[np.float64],
    actuation: NDArray[np.float64],
) -> None:
    """Draw particles as the deformed squares that they stand for.

    Parameters
    ----------
    axes : matplotlib Axes
    state : (12, N) array
    spacing : float
        Width of a particle's undeformed square.
    gamma : (N,) array
        0: invisible, 1: black.
    actuation : (N,) array
        Signal divided by its largest: red where positive, blue where negative.
    """
    corners = 0.5 * spacing * np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]])
    F = state[8:12].T.reshape(-1, 2, 2)
    polygons = state[0:2].T[:, None] + np.einsum("pij,kj->pki", F, corners)
    gamma = np.clip(gamma, 0.0, 1.0)
    colour = np.repeat(0.85 * (1.0 - gamma)[:, None], 3, axis=1)
    strength = np.clip(np.abs(actuation), 0.0, 1.0)[:, None]
    tint = np.where(actuation[:, None] > 0.0, [0.85, 0.1, 0.1], [0.1, 0.25, 0.85])
    colour = (1.0 - strength) * colour + strength * tint
    rgba = np.concatenate([colour, gamma[:, None]], axis=1)
    axes.add_collection(PolyCollection(list(polygons), facecolors=rgba, edgecolors="none"))


def with_image(state: NDArray[np.float64], mirror: Mirror) -> NDArray[np.float64]:
    """A state (12, N) and its mirror image (12, 2 N)."""
    image = state.copy()
    k, other = mirror.normal, 1 - mirror.normal
    image[k] = 2.0 * mirror.position - state[k]
    image[2 + k] *= -1.0
    for block in (4, 8):  # C and F: one reflection from each side
        image[block + 2 * k + other] *= -1.0
        image[block + 2 * other + k] *= -1.0
    return np.concatenate([state, image], axis=1)


def plot_motion(
    path: Path, simulation: Simulation, gamma: NDArray[np.float64], title: str, pictures: int = 8
) -> None:
    """Write a PNG of a body at equal intervals from start to end.

    Parameters
    ----------
    path : Path
    simulation : Simulation
        Of N particles.
    gamma : (N,) array
        What to draw of each particle; a scene's mirror image is drawn with it.
    title : str
    pictures : int, optional
    """
    scene = simulation.scene
    frames = np.rint(np.linspace(0, scene.steps, pictures)).astype(int)
    states = simulation.run(list(frames))
    signal = np.abs(simulation.signal).max(initial=0.0)
    actuator = simulation.particles.actuator
    if scene.mirror is not None:
        states = np.array([with_image(state, scene.mirror) for state in states])
        gamma, actuator = np.tile(gamma, 2), np.tile(actuator, 2)
    spacing = scene.grid.dx / scene.particles_per_cell
    low = states[:, 0:2].min(axis=(0, 2)) - 6 * spacing
    high = states[:, 0:2].max(axis=(0, 2)) + 6 * spacing
    columns = 2 if pictures > 1 else 1
    rows = -(-pictures // columns)
    shape = (high[1] - low[1]) / (high[0] - low[0])
    figure = Figure(figsize=(5.0 * columns, (5.0 * shape + 0.35) * rows + 0.4), layout="tight")
    FigureCanvasAgg(figure)
    figure.suptitle(title)
    for number, (frame, state) in enumerate(zip(frames, states, strict=True)):
        axes = figure.add_subplot(rows, columns, number + 1)
        draw_walls(axes, scene)
        now = np.zeros(len(actuator))
        if signal > 0.0:
            values = simulation.signal[min(frame, scene.steps - 1)].real / signal
            now[actuator >= 0] = values[actuator[actuator >= 0]]
        draw_body(axes, state, spacing, gamma, now)
        axes.set_xlim(low[0], high[0])
        axes.set_ylim(low[1], high[1])
        axes.set_aspect("equal")
        axes.set_title(f"t = {frame * scene.time_step:.2f}", fontsize=9)
        axes.tick_params(labelsize=7)
    figure.savefig(path, dpi=120)


def plot_design(path: Path, problem: Problem, x: NDArray[np.float64], title: str) -> None:
    """Write a PNG of a design in motion: grey is gamma, red and blue the actuation's sign."""
    gamma = np.ones(len(problem.particles.position))
    gamma[problem.particles.designed] = problem.gamma(x)
    present = problem.present(problem.split(x).phi)
    plot_motion(path, problem.simulation(x), gamma[present], title)


def plot_history(path: Path, run: Optimisation) -> None:
    """Write a PNG of objective, beta and greyness over the evaluations, stages marked."""
    history = run.history
    number = np.arange(1, len(history) + 1)

    def column(name: str) -> NDArray[np.float64]:
        return np.array([getattr(item, name) for item in history], dtype=float)

    figure = Figure(figsize=(7.0, 4.5), layout="tight")
    FigureCanvasAgg(figure)
    axes = figure.add_subplot()
    lines: list[Any] = axes.plot(number, column("objective"), "k.-", label="objective L")
    failed = np.isnan(column("objective"))
    if failed.any():
        at_floor = np.full(failed.sum(), np.nanmin(column("objective")))
        lines += axes.plot(number[failed], at_floor, "rx", label="failed evaluation")
    axes.set_xlabel("evaluation")
    axes.set_ylabel("objective L (distance)")
    other = axes.twinx()
    lines += other.plot(number, column("greyness"), "C0-", label="greyness")
    other.set_ylim(0.0, 1.05)
    other.set_ylabel("greyness")
    stages = column("stage")
    for start in _starts(stages):
        axes.axvline(start + 0.5, color="0.7", lw=0.8)
        axes.annotate(
            f"$\\beta$ = {history[start].beta:g}", (start + 0.5, 1.01), rotation=90,
            xycoords=("data", "axes fraction"), ha="center", va="bottom", fontsize=7,
        )  # fmt: skip
    axes.legend(lines, [line.get_label() for line in lines], loc="center right")
    axes.set_title("History of the optimisation", pad=32.0)
    figure.savefig(path, dpi=120)


def _starts(stages: NDArray[np.float64]) -> Sequence[int]:
    return [0, *(np.flatnonzero(np.diff(stages)) + 1).tolist()]
