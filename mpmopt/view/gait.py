"""Pictures of how a finished robot goes: a stride, its feet over time, and what it bears."""

from __future__ import annotations

import os
from collections.abc import Mapping
from typing import Any

import numpy as np
from matplotlib.axes import Axes

from mpmopt.assess.feet import BEARS, FEET, feet
from mpmopt.assess.robustness import SEEN, SETTLED, Robot, lasting, unit
from mpmopt.assess.trajectory import Body, Motion
from mpmopt.design.terms import Displacement
from mpmopt.io.files import replace_file
from mpmopt.scene import Scene
from mpmopt.view.draw import (
    LAYER,
    Squares,
    draw_walls,
    new_figure,
    own_style,
    png,
    set_view,
    view,
)

INSTANTS = 8  # of a stride
PERIODS, PER_PERIOD = 6, 32  # of a gait diagram: periods whose feet are seen, and frames in each
KEPT = {
    "half_step": "half the step",
    "finer_cells": "cells 1/2",
    "finest_cells": "cells 1/4",
    "other_formulation": "other formulation,\ncells 1/2",
}


def body_of(robot: Robot, scene: Scene, name: str = "finished robot") -> Body:
    """The robot in a scene, as pictures and films take it."""
    simulation = robot.body(scene)
    gamma = np.ones(len(simulation.particles.position))
    return Body(name, simulation, gamma, Displacement(), robot.in_scene(scene).astype(float))


@own_style()
def plot_stride(path: str | os.PathLike[str], robot: Robot) -> None:
    """Write a PNG of one period of a finished robot's gait, in eight instants.

    Parameters
    ----------
    path : Path
    robot : Robot
        Of a scene with actuators.

    Raises
    ------
    SimulationError
        If the robot cannot be simulated until then.
    StorageError
        If the file cannot be written.
    """
    one = robot.period(robot.problem.scene)
    settled = SETTLED * unit(robot.problem.scene)
    scene = lasting(robot.problem.scene, settled + one)
    times = settled + one * np.arange(INSTANTS) / INSTANTS
    frames = np.rint(times / scene.time_step).astype(int)
    motion = Motion.of(body_of(robot, scene), [*frames, scene.steps])
    box = view([motion])
    width, height = box[1] - box[0]
    columns = 4 if height < 2.0 * width else INSTANTS
    rows = INSTANTS // columns
    wide = 10.0 / columns
    figure = new_figure(10.0, (wide * height / width + 0.25) * rows + 0.35)
    way = motion.objective[-1] - motion.objective[0]
    figure.suptitle(
        f"One period of {one:.3g} from t = {settled:g}, in which the robot goes {way:.3g}",
        fontsize=10,
    )
    # Dotted: where its front was at first.
    ahead = np.array(scene.direction)
    front = float((ahead @ motion.position[0]).max())
    panels = figure.subplots(rows, columns, squeeze=False).ravel()
    for number, axes in enumerate(panels):
        set_view(axes, box)
        draw_walls(axes, scene, moving=True)
        axes.add_collection(Squares(motion, number), autolim=False)
        line = axes.axvline if abs(ahead[0]) > abs(ahead[1]) else axes.axhline
        line(front, color="C2", ls=":", lw=1.0)
        axes.set_title(f"{number}/{INSTANTS} of the period", fontsize=8)
        axes.set_xticks([])
        axes.set_yticks([])
    replace_file(path, png(figure))


@own_style()
def plot_gait(path: str | os.PathLike[str], robot: Robot) -> None:
    """Write a PNG of a finished robot's way, and of its feet over some periods.

    Raises
    ------
    SimulationError
        If the robot cannot be simulated for so long.
    StorageError
        If the file cannot be written.
    """
    one = robot.period(robot.problem.scene)
    settled, end = (time * unit(robot.problem.scene) for time in (SETTLED, SEEN))
    scene = lasting(robot.problem.scene, end)
    far = np.arange(0.0, end, one / 8.0)
    near = settled + one * np.arange(PERIODS * PER_PERIOD + 1) / PER_PERIOD
    frames = np.unique(np.rint(np.concatenate([far, near]) / scene.time_step).astype(int))
    frames = frames[frames <= scene.steps]
    motion = Motion.of(body_of(robot, scene), frames)
    time = motion.frames * scene.time_step
    figure = new_figure(9.0, 7.5)
    whole, place, height, ground = figure.subplots(4, 1, height_ratios=(1.2, 1.6, 1.0, 1.2))
    whole.plot(time, motion.objective, "k-", lw=1.2)
    whole.axvspan(near[0], near[-1], color="0.9")
    whole.set_ylabel("way of\nthe centroid")
    whole.set_xlim(0.0, end)
    seen = (time >= near[0] - 1e-9) & (time <= near[-1] + 1e-9)
    found = feet(motion)
    most = max((float(foot.load[seen].max()) for foot in found), default=0.0) or 1.0
    t = time[seen]
    place.plot(t, motion.objective[seen], "k-", lw=1.2, label="centroid")
    for number, foot in enumerate(found):
        colour, load = f"C{number}", foot.load[seen] / most
        for axes, values in ((place, foot.place[seen]), (height, foot.height[seen])):
            axes.plot(t, values, color=colour, lw=0.7)
            axes.plot(t, np.where(load > BEARS, values, np.nan), color=colour, lw=2.5)
        place.plot([], [], color=colour, lw=2.5, label=f"foot {number + 1}")
        line = len(found) - 1.0 - number
        ground.fill_between(t, line, line + 0.9 * load, color=colour, lw=0.0)
    place.set_ylabel("along the way")
    place.legend(fontsize=7, ncols=FEET + 1, frameon=False, loc="lower center",
                 bbox_to_anchor=(0.5, 1.0))  # fmt: skip
    for layer in scene.layers:
        height.axhspan(0.0, layer.thickness, color=LAYER)
    height.set_ylabel("above the\nground")
    ground.set_ylabel("load on\neach foot")
    ground.set_yticks(np.arange(len(found)) + 0.1,
                      [str(len(found) - k) for k in range(len(found))])  # fmt: skip
    for axes in (place, height, ground):
        axes.set_xlim(near[0], near[-1])
        for k in range(PERIODS + 1):
            axes.axvline(settled + k * one, color="0.8", lw=0.6, zorder=0)
    half = "" if scene.mirror is None else "; one half"
    ground.set_xlabel(f"time t (lines: periods of the actuation; thick: bears{half})")
    replace_file(path, png(figure))


@own_style()
def plot_robustness(path: str | os.PathLike[str], summary: Mapping[str, Any]) -> None:
    """Write a PNG of the speeds that a summary has of a robot elsewhere.

    Parameters
    ----------
    path : Path
    summary : mapping
        With what `robustness.study` gives.

    Raises
    ------
    StorageError
        If the file cannot be written.
    """
    full = "speed_by_cells" in summary
    figure = new_figure(10.0, 6.4 if full else 3.2)
    panels = figure.subplots(2 if full else 1, 2, squeeze=False).ravel()
    nominal = summary["speed"]
    for axes in panels:
        axes.axhline(0.0, color="0.5", lw=0.8)
        if nominal is not None and axes is not panels[1]:
            axes.axhline(nominal, color="0.5", ls=":", lw=1.0, label="as designed")
    _curve(panels[0], summary["speed_by_friction"], "C0", "")
    panels[0].set_xlabel("friction of the ground")
    panels[0].set_ylabel("mean speed")
    shares = {KEPT.get(name, name): value for name, value in summary["kept"].items()}
    shares["driven share"] = summary["driven_share"]
    if full:
        shares["after a push"] = summary["after_push"]
    _bars(panels[1], shares)
    panels[1].set_ylabel("share of the speed")
    if full:
        for k, (formulation, values) in enumerate(summary["speed_by_cells"].items()):
            _curve(panels[2], values, f"C{k}", formulation)
        panels[2].set_xscale("log", base=2)
        ticks = [float(name) for name in next(iter(summary["speed_by_cells"].values()))]
        panels[2].set_xticks(ticks, [f"{tick:g}" for tick in ticks])
        panels[2].set_xlabel("cells along the grid's shorter side, with steps to match")
        panels[2].set_ylabel("mean speed")
        for k, (name, text) in enumerate(
            (("step", "time step"), ("strength", "actuators' strength"), ("frequency", "frequency"))
        ):
            _curve(panels[3], summary[f"speed_by_{name}"], f"C{k}", text)
        panels[3].set_xlabel("times that of the run")
        for axes in panels[2:]:
            axes.legend(fontsize=8, frameon=False)
    replace_file(path, png(figure))


def _curve(axes: Axes, values: Mapping[str, float | None], colour: str, name: str) -> None:
    """Speeds by numbers as text; what has none is a cross on the line of zero."""
    points = sorted((float(text), value) for text, value in values.items())
    there = [(number, value) for number, value in points if value is not None]
    if there:
        axes.plot(*zip(*there), "o-", color=colour, ms=4, lw=1.2, label=name or None)
    gone = [number for number, value in points if value is None]
    axes.plot(gone, np.zeros(len(gone)), "x", color=colour, ms=7)


def _bars(axes: Axes, shares: Mapping[str, float | None]) -> None:
    """Shares as bars with their numbers; what has none says so."""
    for number, value in enumerate(shares.values()):
        text = "none" if value is None else f"{value:.0%}"
        axes.bar(number, value or 0.0, color="C0", width=0.6)
        axes.annotate(
            text, (number, max(value or 0.0, 0.0)), xytext=(0, 2), textcoords="offset points",
            ha="center", fontsize=8,
        )  # fmt: skip
    axes.axhline(1.0, color="0.5", ls=":", lw=1.0)
    axes.set_xticks(range(len(shares)), list(shares), fontsize=7, rotation=20)
    axes.margins(y=0.15)
