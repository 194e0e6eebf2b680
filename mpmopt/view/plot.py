"""Pictures of a run: its scene, its bodies in motion, its history."""

from __future__ import annotations

import logging
import os
from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from mpmopt.assess.forces import Books
from mpmopt.assess.robustness import Robot, can_be_studied
from mpmopt.assess.trajectory import (
    Body,
    Make,
    Motion,
    equal_steps,
    moving,
    optimised,
    post_processed,
    reference,
)
from mpmopt.errors import SimulationError
from mpmopt.io.files import replace_file
from mpmopt.optimisation.history import Optimisation
from mpmopt.scene import Scene
from mpmopt.view.draw import (
    Arrows,
    Forces,
    Squares,
    draw_design,
    draw_history,
    draw_walls,
    format_of,
    new_figure,
    own_style,
    png,
    set_view,
    view,
)
from mpmopt.view.gait import plot_gait, plot_stride
from mpmopt.view.schematic import schematic

logger = logging.getLogger(__name__)


EIGHT = 8  # instants of a body that a run's pictures show


def plot_motion(
    path: str | os.PathLike[str], body: Body, pictures: int = EIGHT, books: Books | None = None
) -> None:
    """Write a PNG of a body at equal intervals from start to end.

    Parameters
    ----------
    path : Path
    body : Body
    pictures : int, optional
    books : Books, optional
        Of the body: arrows show what its supports push it with.

    Raises
    ------
    SimulationError
        If the body cannot be simulated.
    StorageError
        If the file cannot be written.
    """
    _plot_motion(path, Motion.of(body, equal_steps(body.simulation.scene, pictures)), books)


@own_style()
def _plot_motion(path: str | os.PathLike[str], motion: Motion, books: Books | None = None) -> None:
    pictures = len(motion.frames)
    forces = None if books is None else Forces.of([motion], [books])
    box = view([motion]) if forces is None else forces.box
    width, height = box[1] - box[0]
    columns, wide = (2, 5.0) if height < 1.25 * width else (4, 2.5)  # inches of a panel
    columns = min(columns, pictures)
    rows = -(-pictures // columns)
    figure = new_figure(wide * columns, (wide * height / width + 0.35) * rows + 0.4)
    name = motion.name[0].upper() + motion.name[1:]
    longest = "" if forces is None else f", longest arrow {forces.largest:.3g}"
    figure.suptitle(f"{name}, L = {motion.objective[-1]:{format_of(motion.objective)}}{longest}")
    panels = figure.subplots(rows, columns, sharex=True, sharey=True, squeeze=False).ravel()
    for axes in panels[pictures:]:
        axes.set_axis_off()
    times = motion.frames * motion.scene.time_step
    for number, (time, axes) in enumerate(zip(times, panels)):
        set_view(axes, box)
        draw_walls(axes, motion.scene, moving=True)
        axes.add_collection(Squares(motion, number), autolim=False)
        if forces is not None:
            Arrows(axes, *forces.values[0], forces.scale, number)
        axes.set_title(f"t = {time:{format_of(times)}}", fontsize=9)
        axes.tick_params(labelsize=7)
    replace_file(path, png(figure))


@own_style()
def plot_history(path: str | os.PathLike[str], run: Optimisation) -> None:
    """Write a PNG of objective, beta and non-discreteness over a run's evaluations, stages marked.

    Raises
    ------
    StorageError
        If the file cannot be written.
    """
    figure = new_figure(7.0, 4.5)
    axes = figure.add_subplot()
    draw_history(axes, run)
    axes.set_title("History of the optimisation", pad=32.0)
    replace_file(path, png(figure))


@own_style()
def plot_forces(path: str | os.PathLike[str], name: str, books: Books) -> None:
    """Write a PNG of a motion's energy, the work done on it, and its supports' forces over time.

    Parameters
    ----------
    path : Path
    name : str
        Of the body.
    books : Books

    Raises
    ------
    StorageError
        If the file cannot be written.
    """
    figure = new_figure(7.0, 10.0)
    figure.suptitle(f"{name[0].upper()}{name[1:]}, who bears it and who drives it")
    energy, work, force, place = figure.subplots(4, 1, sharex=True)
    for kind, values in books.energy.items():
        if np.ptp(values) > 1e-9 * books.turnover:
            energy.plot(books.time, values - values[0], lw=1, label=kind)
    for kind, values in books.work.items():
        if np.ptp(values) > 1e-9 * books.turnover:
            work.plot(books.time, values, lw=1, label=kind)
    work.plot(books.time, books.residual, "k:", lw=1, label="unexplained")
    time, forces, places = books.means()
    for k, support in enumerate(books.supports):
        for axis, style in ((1, "-"), (0, "--")):
            label = f"{support}, {'xy'[axis]}"
            force.plot(time, forces[:, k, axis], f"C{k}{style}", lw=1, label=label)
            place.plot(time, places[:, k, axis], f"C{k}{style}", lw=1, label=label)
    texts = "change of energy", "work done so far", "force on the body", "place of the force"
    for axes, text in zip((energy, work, force, place), texts):
        axes.set_ylabel(text)
        if axes.lines:
            axes.legend(fontsize=7, frameon=False, ncols=2)
    place.set_xlabel("time t")
    replace_file(path, png(figure))


@own_style()
def overview(run: Optimisation) -> Figure:
    """A figure of a run's best design before it moves, beside the history that led to it."""
    figure = new_figure(12.0, 4.0)
    left, right = figure.subplots(1, 2)
    draw_design(left, run.problem(), run.result.x)
    draw_history(right, run)
    return figure


def _plot_first(path: Path, run: Optimisation, *makes: Make) -> None:
    """The first of these bodies of the best design that can be simulated."""
    instants = partial(equal_steps, count=EIGHT)
    _, motion = next(moving(run.problem(), run.result.x, makes, instants))
    _plot_motion(path, motion)


def _robot(run: Optimisation) -> Robot:
    return Robot.of(run.problem(), run.result.x)


PICTURES: dict[str, Callable[[Path, Optimisation], None]] = {
    "schematic": lambda path, run: replace_file(path, png(schematic(run.scene))),
    "history": lambda path, run: plot_history(path, run),
    "design": lambda path, run: _plot_first(path, run, optimised, post_processed),
    "post_processed": lambda path, run: _plot_first(path, run, post_processed),
    "reference": lambda path, run: _plot_first(path, run, reference),
    "stride": lambda path, run: plot_stride(path, _robot(run)),
    "gait": lambda path, run: plot_gait(path, _robot(run)),
}
GAITS = ("stride", "gait")  # of robots on ground only


def picture_files(folder: Path, scene: Scene) -> dict[str, Path]:
    """The files that `plot_run` writes to a folder, by name."""
    studied = can_be_studied(scene)
    return {name: folder / f"{name}.png" for name in PICTURES if studied or name not in GAITS}


def plot_run(
    folder: Path, run: Optimisation, progress: Callable[[Path], None] | None = None
) -> None:
    """Write all pictures of a run to a folder.

    ``schematic.png`` shows the scene, ``design.png``, ``post_processed.png`` and ``reference.png``
    bodies in motion, and ``history.png`` the optimisation; of a robot on ground, ``stride.png`` and
    ``gait.png`` show the finished one. A body that cannot be simulated has no picture.

    Parameters
    ----------
    folder : Path
    run : Optimisation
    progress : callable, optional
        Called with the path of each picture that was written.

    Raises
    ------
    DesignError
        If the run has no design.
    StorageError
        If a file cannot be written.
    """
    run.problem()  # an error before anything is written
    for name, path in picture_files(folder, run.scene).items():
        try:
            PICTURES[name](path, run)
        except SimulationError as error:
            logger.warning("no %s: %s", path.name, error)
            continue
        if progress is not None:
            progress(path)
