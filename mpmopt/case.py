"""One case from start to end: optimise, judge, and leave a folder of results."""

from __future__ import annotations

import argparse
import json
import logging
import os
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mpmopt import binary, runfile
from mpmopt.audit import audit
from mpmopt.binary import Drawing, farthest, full_block, pieces, post_processed, unactuated
from mpmopt.checkpoints import Checkpointing
from mpmopt.checks import digits, instance, place, shown
from mpmopt.errors import DesignError, RunFileError, SimulationError, StorageError
from mpmopt.files import locked, make_folder, refuse_foreign, replace_file
from mpmopt.history import Optimisation
from mpmopt.interrupt import how_to_go_on, reported, say
from mpmopt.optimize import HOW, Settings, Stage, begin, go_on, refuse_unfit
from mpmopt.particles import lay_out
from mpmopt.problem import Problem, Variables
from mpmopt.progress import Progress
from mpmopt.scene import Scene

logger = logging.getLogger(__name__)

RESULTS = ("summary.json", "design.png", "history.png")  # besides run.h5
START = {"phi": 0.0, "a": 1.0, "theta": -0.3, "b": -0.5}
QUARTER_TURNS = (0.0, 0.5, 1.0, -0.5)  # of theta, for the starts that scout


@dataclass(frozen=True)
class Case:
    """A scene, how to optimise it, and what an engineer would draw instead.

    Attributes
    ----------
    scene : Scene
    settings : Settings
    drawing : callable
        From positions (D, 2) of the design particles to which are there (D,): a second reference
        design besides the full block.
    start : mapping, optional
        First phi, a, theta and b, as `Problem.join` takes them: one number for all actuators, or
        one for each. What is left out is that of `START`.

    Raises
    ------
    DesignError
        If the start has another name in it, or anything is of another kind.
    """

    scene: Scene
    settings: Settings
    drawing: Drawing
    start: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        instance("Case", "scene", self.scene, Scene)
        instance("Case", "settings", self.settings, Settings, HOW)
        instance("Case", "start", self.start, Mapping)
        if not callable(self.drawing):
            raise DesignError(
                f"Case: drawing = {shown(self.drawing)} must be a function of positions (D, 2), "
                "such as binary.full_block"
            )
        if unknown := set(self.start) - set(START):
            raise DesignError(
                f"Case: start has {', '.join(unknown)}; its names are {', '.join(START)}"
            )
        object.__setattr__(self, "start", {**START, **self.start})


def _sharpening(time_step: float, stages: int, coarsening: int = 1) -> tuple[Stage, ...]:
    """Beta doubled from 0.5; from 8 on, clear void is left out and designs are judged solid.

    On the scene's own cells they count with the least of their audit.
    """
    return tuple(
        Stage(
            beta=0.5 * 2**k,
            mass_floor=1e-2,
            stiffness_floor=1e-3,
            time_step=time_step,
            solid=k >= 4,
            audited=k >= 4 and coarsening == 1,
            coarsening=coarsening,
            leave_out=0.05 if k >= 4 else 0.0,
        )
        for k in range(stages)
    )


def sharpened(time_step: float) -> Settings:
    """Beta from 0.5 to 32; void weighs 1e-2 of a solid, until what is clear void is left out."""
    return Settings(_sharpening(time_step, stages=7), most_iterations=25)


def refined(coarse_time_step: float, time_step: float) -> Settings:
    """Cells twice as wide find the gait, then the scene's own find the shape.

    The coarse stages are the first five of `sharpened`; four starts, whose signals are a quarter
    turn apart, scout three of them. The fine ones begin at beta = 8 and stay at 16 and 32 for
    several stages: each begins with long moves again, which shake the design out of what it got
    stuck in. Their void has a mass floor of 1e-2, and what is clear void is left out.
    """
    coarse = _sharpening(coarse_time_step, stages=5, coarsening=2)
    fine = tuple(
        Stage(
            beta,
            mass_floor=1e-2,
            stiffness_floor=1e-3,
            time_step=time_step,
            solid=True,
            audited=True,
            move_limit=move_limit,
            leave_out=0.05,
        )
        for beta, move_limit, repeats in ((8.0, 0.05, 1), (16.0, 0.05, 4), (32.0, 0.025, 3))
        for _ in range(repeats)
    )
    return Settings((*coarse, *fine), most_iterations=25, tolerance=0.0, scouting=3)


def published(time_step: float) -> Settings:
    """The paper's: beta doubled from 0.5 to 16, both floors 1e-3, moving asymptotes as published.

    Each stage goes on from the last design of the one before, and nothing is redone.
    """
    return Settings(
        tuple(Stage(0.5 * 2**k, 1e-3, 1e-3, time_step, move_limit=0.5, redo=0) for k in range(6)),
        adapt_move_limit=False,
        sharpen_asymptotes=False,
        best_first=False,
    )


class ProgressBar:
    """Callback of `optimise` that shows objective, beta and greyness; log lines off a terminal."""

    def __init__(self) -> None:
        self._progress = Progress("gradients")

    def __call__(self, run: Optimisation) -> None:
        self._progress.count = len(run.history) - 1
        if run.stop_reason:
            self._progress.close()
            return
        last = run.history[-1]
        self._progress.step(
            f"L {digits(last.objective)}, beta {last.beta:g}, greyness {last.greyness:.3f}"
        )


def run(
    case: Case,
    out: str | os.PathLike[str],
    checkpointing: Checkpointing | None = None,
    force: bool = False,
    phi: Callable[[NDArray[np.float64]], NDArray[np.float64]] | None = None,
) -> dict[str, Any]:
    """Optimise a case and leave its results in a folder.

    Writes ``run.h5`` (before the first and after every evaluation), ``summary.json``,
    ``design.png`` and ``history.png``. A folder that holds an unfinished run of this case is gone
    on with; one that holds a finished one is left as it is.

    Parameters
    ----------
    case : Case
    out : str or path
        Folder, made if it is not there.
    checkpointing : Checkpointing, optional
    force : bool, optional
        Begin anew and replace whatever the folder holds under those names.
    phi : callable, optional
        Of positions (D, 2): phi (D,) that a run begins with, instead of the case's.

    Returns
    -------
    dict
        The summary.

    Raises
    ------
    DesignError
        If the drawing is none (`drawn`); it is looked at before anything is written.
    StorageError
        If the folder cannot be made, holds another case's run or foreign files of those names, or
        another process is at work in it.
    MpmoptError
        As `optimise` does.
    """
    instance("run", "case", case, Case)
    path = Path(os.path.realpath(place("run", "out", out) / "run.h5"))
    folder = path.parent
    first = case.settings.stages[0]
    problem = Problem(first.scene(case.scene), first.beta, checkpointing)
    turns = QUARTER_TURNS if case.settings.scouting else (0.0,)
    position = problem.particles.position[problem.particles.designed]
    if phi is not None and not callable(phi):
        raise DesignError(f"run: phi = {shown(phi)} must be a function of positions (D, 2)")
    plain = case.start if phi is None else {**case.start, "phi": phi(position)}
    parts = Variables.of(problem.join(**plain), len(position))
    starts = [problem.join(*parts._replace(theta=_turned(parts.theta, turn))) for turn in turns]
    refuse_unfit(case.scene)
    new, drawing = begin(case.scene, case.settings, starts), drawn(case)
    make_folder(folder)
    with locked(path):
        if path.exists() and not force:
            try:
                kept = runfile.read(path)
            except RunFileError as error:
                raise RunFileError(
                    f"{error}; choose another folder, or --force to replace it"
                ) from error
            begun = kept.run.first.x if kept.run.first else kept.run.legs[0].x
            same = (kept.scene, kept.settings) == (case.scene, case.settings)
            if not same or not np.array_equal(begun, starts[0]):
                raise StorageError(
                    f"{path} holds an earlier run of another case; choose another folder, or "
                    "--force to replace it"
                )
            return _go_on(path, kept, checkpointing)
        refuse_foreign((folder / name for name in RESULTS), force)
        runfile.write(path, new, drawing=drawing)
        return _go_on(path, runfile.read(path), checkpointing)


def resume(
    path: str | os.PathLike[str], checkpointing: Checkpointing | None = None
) -> dict[str, Any]:
    """Go on with the run of a run file to the end that it would have had without a stop.

    Returns
    -------
    dict
        The summary, also of a run that was finished already.

    Raises
    ------
    RunFileError
        If there is no run file, or it is damaged.
    StorageError
        If another process is at work on it.
    MpmoptError
        As `optimise` does.
    """
    path = Path(
        os.path.realpath(place("resume", "path", path))
    )  # a link would be replaced, not what it leads to
    with locked(path):
        return _go_on(path, runfile.read(path), checkpointing)


def drawn(case: Case) -> dict[int, NDArray[np.bool_]]:
    """Which design particles the case's drawing has, for each coarsening of its stages.

    Raises
    ------
    DesignError
        If it does not give (D,) of True and False.
    """
    there = {}
    for coarsening, stage in {stage.coarsening: stage for stage in case.settings.stages}.items():
        particles = lay_out(stage.scene(case.scene))
        position = particles.position[particles.designed]
        array, shape = np.asarray(case.drawing(position), dtype=object), (len(position),)
        kinds = {type(value).__name__ for value in array.ravel().tolist()}
        if array.shape != shape or not kinds <= {"bool", "bool_"}:
            raise DesignError(
                f"Case: drawing gave {', '.join(sorted(kinds))} of shape {array.shape} for "
                f"positions of shape {position.shape}, must give bool of shape {shape}: whether "
                "each particle is there"
            )
        there[coarsening] = array.astype(bool)
    return there


def _go_on(
    path: Path, kept: runfile.RunFile, checkpointing: Checkpointing | None
) -> dict[str, Any]:
    if kept.summary:
        say(f"{path} holds a finished run.")
        return kept.summary
    if kept.versions != runfile.versions():
        logger.warning("%s was begun with %s: digits may differ", path, kept.versions)
    if kept.run.history:
        say(f"Going on after {len(kept.run.history)} evaluations.")

    def save(current: Optimisation) -> None:
        runfile.write(path, current, drawing=kept.drawing)

    result = go_on(kept.run, [save, ProgressBar()], checkpointing)
    summary = summarise(result, kept.drawing)
    text = json.dumps(summary, indent=1) + "\n"
    replace_file(path.parent / "summary.json", text.encode())
    runfile.write(path, result, summary, kept.drawing)
    _draw(path.parent, result)
    return summary


def _turned(theta: NDArray[np.float64], turn: float) -> NDArray[np.float64]:
    """Theta and a turn, within [-1, 1]."""
    theta = theta + turn
    return np.where(np.abs(theta) > 1.0, theta - 2.0 * np.sign(theta), theta)


def summarise(result: Optimisation, drawing: Mapping[int, NDArray[np.bool_]]) -> dict[str, Any]:
    """Objective values (L, larger is farther), actuation and counts of a finished optimisation.

    The drawing is that of `drawn`, or empty.

    Reference designs count with the better of the first and the best design's actuation.
    """
    instance("summarise", "result", result, Optimisation)
    best, problem = result.result, result.problem()
    _, *others = audits = audit(problem, best.x)
    first = result.first
    assert first is not None
    there = drawing.get(result.settings.stages[best.stage].coarsening)
    actuations = [Variables.of(item.x, item.gamma.size) for item in (first, best)]
    actuation = actuations[1]
    reference = _value_or_none(lambda: farthest(problem.scene, full_block, *actuations))
    block = np.nan if reference is None else reference

    def numbers(values: np.ndarray) -> float | list[float]:
        return float(values[0]) if values.size == 1 else values.tolist()

    return {
        "start": _value_or_none(lambda: first.objective),
        "reference": reference,
        "reference_drawn": None
        if there is None
        else _value_or_none(lambda: farthest(problem.scene, lambda _: there, *actuations)),
        "optimised": best.objective,
        "post_processed": _value_or_none(lambda: post_processed(problem, best.x)),
        "actuation_off": _value_or_none(lambda: unactuated(problem, best.x)),
        "loose_particles": int((pieces(problem.scene, binary.kept(problem, best.x)) > 0).sum()),
        "post_processed_half_step": _number_or_none(audits[1].distance),
        # Over the full block where it goes farther: as designed, or as in the row.
        "gain": {
            row.name: _number_or_none(
                binary.beyond_rounding(problem.scene, row.distance - np.fmax(row.reference, block))
            )
            for row in audits
        },
        "gain_kept": {row.name: _number_or_none(row.kept) for row in others},
        "greyness": best.greyness,
        "a": numbers(actuation.a),
        "theta": numbers(actuation.theta),
        "b": numbers(actuation.b),
        "evaluations": len(result.history),
        "failed_evaluations": result.failed_evaluations,
        "redone_evaluations": result.redone_evaluations,
        "seconds": result.history[-1].seconds,
        "stop_reason": result.stop_reason,
    }


def _value_or_none(function: Callable[[], float]) -> float | None:
    """A value for the summary, null in JSON if there is none."""
    try:
        return _number_or_none(function())
    except SimulationError as error:
        logger.warning("no value: %s", error)
        return None


def _number_or_none(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None


def _draw(out: Path, result: Optimisation) -> None:
    def design(path: Path) -> None:
        from mpmopt.motion import optimised
        from mpmopt.plot import plot_motion

        plot_motion(path, optimised(result.problem(), result.result.x))

    def history(path: Path) -> None:
        from mpmopt.plot import plot_history

        plot_history(path, result)

    draw_or_warn(out / "design.png", design)
    draw_or_warn(out / "history.png", history)


def draw_or_warn(path: Path, draw: Callable[[Path], None]) -> None:
    """Draw a picture of what is saved; one that fails is a warning of one line."""
    try:
        draw(path)
    except Exception as error:
        reason = (str(error).splitlines() or [""])[0]
        logger.warning("no %s: %s: %s", path.name, type(error).__name__, reason)


def _shown(value: Any) -> str:
    if value is None:
        return "-"
    return digits(value) if isinstance(value, float) else str(value)


def table(summary: Mapping[str, Any]) -> str:
    """The summary as aligned text."""
    flat: dict[str, Any] = {}
    for name, value in summary.items():
        if isinstance(value, Mapping):
            flat.update({f"{name}, {key}": item for key, item in value.items()})
        else:
            flat[name] = value
    width = max(len(name) for name in flat)
    lines = []
    for name, value in flat.items():
        values = value if isinstance(value, list) else [value]
        shown = ", ".join(_shown(v) for v in values)
        lines.append(f"{name.replace('_', ' '):<{width}}  {shown}")
    return "\n".join(lines)


def main(description: str, cases: Mapping[str, Case], argv: list[str] | None = None) -> int:
    """Command line of a case script.

    Parameters
    ----------
    description : str
    cases : mapping of str to Case
        By setting: "default", and others that become options such as ``--preview``.
    argv : list of str, optional
        Default: the command line's.

    Returns
    -------
    int
        Exit code: 0, 1 with a message on standard error, or 128 and the number of a signal.
    """
    parser = argparse.ArgumentParser(description=description)
    parser.add_argument(
        "--out",
        type=Path,
        required=True,
        metavar="DIR",
        help="folder of results; an unfinished run in it is gone on with",
    )
    parser.add_argument("--force", action="store_true", help="begin anew, replace earlier results")
    # An empty group breaks the help of argparse.
    choice = parser.add_mutually_exclusive_group() if len(cases) > 1 else parser
    for name, case in cases.items():
        if name != "default":
            scene = case.scene
            text = f"n = {scene.grid.cells[0]}, dt = {scene.time_step:g}"
            if scene.transient:
                text += f", travel counts from t = {scene.transient:g} to {scene.duration:g}"
            choice.add_argument(
                f"--{name}", dest="setting", action="store_const", const=name, help=text
            )
    parser.add_argument(
        "--starts", type=int, metavar="N", help="optimise from N starts, all but one random"
    )
    parser.add_argument(
        "--scheduler", metavar="ADDRESS", help="run the starts on this Dask cluster"
    )
    arguments = parser.parse_args(argv)
    logging.basicConfig(format="%(message)s")
    case = cases[getattr(arguments, "setting", None) or "default"]
    out, force = arguments.out, arguments.force
    if arguments.starts is None:
        if arguments.scheduler:
            parser.error("--scheduler is for --starts: one run is one process")
        return reported(
            lambda: print(table(run(case, out, force=force))), lambda: how_to_go_on(out / "run.h5")
        )
    if arguments.starts < 1:
        parser.error(f"--starts {arguments.starts}: at least 1")
    from mpmopt.multistart import multistart

    return reported(
        lambda: print(multistart(case, out, arguments.starts, arguments.scheduler, force)),
        lambda: "Every evaluation is saved; the same command without --force goes on.",
    )
