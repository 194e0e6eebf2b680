"""One case from start to end: optimise, judge, and leave a folder of results."""

from __future__ import annotations

import json
import logging
import os
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mpmopt.app.summary import summarise
from mpmopt.assess.threshold import Baseline
from mpmopt.design.problem import Problem
from mpmopt.design.task import DEFAULT_TASK, Task
from mpmopt.design.variables import completed
from mpmopt.errors import DesignError, RunFileError, StorageError
from mpmopt.io.console import say
from mpmopt.io.files import locked, make_folder, refuse_existing, replace_file
from mpmopt.io.pictures import read_picture
from mpmopt.optimisation.history import Optimisation
from mpmopt.optimisation.loop import HOW, begin, go_on
from mpmopt.optimisation.settings import FLOORS, Settings
from mpmopt.results import runfile
from mpmopt.scene import Scene
from mpmopt.scene.particles import discretise
from mpmopt.scene.parts import Checked
from mpmopt.scene.scene import Formulation
from mpmopt.simulation.checkpoints import Checkpointing
from mpmopt.validation import instance, place, shown
from mpmopt.view.live import ProgressBar

logger = logging.getLogger(__name__)

# Besides run.h5; the last three of robots on ground.
RESULTS = (
    "summary.json", "report.html", "design.png", "history.png",
    "stride.png", "gait.png", "robustness.png",
)  # fmt: skip


@dataclass(frozen=True)
class Case(Checked):
    """A scene, how to optimise it, and what an engineer would draw instead.

    Attributes
    ----------
    scene : Scene
    settings : Settings
    baseline : callable
        From positions (D, 2) of the design particles to which are there (D,): a second reference
        design besides the solid reference design.
    start : mapping, optional
        First phi, a, theta, b and omega, as `Problem.join` takes them; phi may also be the path of
        a PNG (`read_picture`). What is left out is that of `variables.START`.
    task : Task, optional
        Objective and constraints; default: the displacement.

    Raises
    ------
    DesignError
        If the start has another name in it, or anything is of another kind.
    """

    scene: Scene
    settings: Settings
    baseline: Baseline
    start: Mapping[str, Any] = field(default_factory=dict)
    task: Task = DEFAULT_TASK

    def __post_init__(self) -> None:
        instance("Case", "scene", self.scene, Scene)
        instance("Case", "settings", self.settings, Settings, HOW)
        instance("Case", "start", self.start, Mapping)
        instance("Case", "task", self.task, Task)
        if not callable(self.baseline):
            raise DesignError(
                f"Case: baseline = {shown(self.baseline)} must be a function of positions (D, 2), "
                "such as threshold.solid_reference"
            )
        start = completed("Case", self.start)
        if isinstance(start["phi"], (str, os.PathLike)):
            start["phi"] = read_picture(start["phi"])
        object.__setattr__(self, "start", start)

    def in_formulation(self, formulation: Formulation) -> Case:
        """The case in another formulation, with floors that MLS-MPM bears."""
        stages = self.settings.stages
        if formulation == "updated":
            stages = tuple(
                replace(
                    stage,
                    void_density=max(stage.void_density or 0.0, FLOORS[formulation][0]),
                    void_stiffness=max(stage.void_stiffness or 0.0, FLOORS[formulation][1]),
                    void_cutoff=0.05 if stage.solid else stage.void_cutoff,
                )
                for stage in stages
            )
        scene = replace(self.scene, formulation=formulation)
        return replace(self, scene=scene, settings=replace(self.settings, stages=stages))


def run(
    case: Case,
    out: str | os.PathLike[str],
    checkpointing: Checkpointing | None = None,
    force: bool = False,
    phi: Callable[[NDArray[np.float64]], NDArray[np.float64]] | None = None,
    full_study: bool = False,
) -> dict[str, Any]:
    """Optimise a case and leave its results in a folder.

    Writes ``run.h5`` (before the first and after every evaluation), ``summary.json``,
    ``report.html``, ``design.png`` and ``history.png``; of a robot on ground also ``stride.png``,
    ``gait.png`` and ``robustness.png``. A folder that holds an unfinished run of this case is gone
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
    full_study : bool, optional
        Try the finished robot in all ways of `robustness.study`, not only in some. The run file
        remembers it, for `resume`.

    Returns
    -------
    dict
        The summary.

    Raises
    ------
    DesignError
        If the baseline is none (`baseline_particles`); it is looked at before anything is written.
    StorageError
        If the folder cannot be made, holds another case's run or files of those names without a
        run, or another process is at work in it.
    MpmoptError
        As `optimise` does.
    """
    instance("run", "case", case, Case)
    path = Path(os.path.realpath(place("run", "out", out) / "run.h5"))
    folder = path.parent
    first = case.settings.stages[0]
    problem = Problem(first.scene(case.scene), first.beta, checkpointing)
    if phi is not None and not callable(phi):
        raise DesignError(f"run: phi = {shown(phi)} must be a function of positions (D, 2)")
    start = problem.join(**(case.start if phi is None else {**case.start, "phi": phi}))
    new, baseline = begin(case.scene, case.settings, start, case.task), baseline_particles(case)
    make_folder(folder)
    with locked(path):
        if path.exists() and not force:
            try:
                kept = runfile.read_run(path)
            except RunFileError as error:
                raise RunFileError(
                    f"{error}; choose another folder, or --force to replace it"
                ) from error
            begun = kept.run.first.x if kept.run.first else kept.run.x
            its = kept.run.scene, kept.run.settings, kept.run.task
            same = its == (case.scene, case.settings, case.task)
            if not same or not np.array_equal(begun, new.x):
                raise StorageError(
                    f"{path} holds an earlier run of another case; choose another folder, or "
                    "--force to replace it"
                )
            kept = replace(kept, full_study=full_study or kept.full_study)
            return _go_on(path, kept, checkpointing)
        refuse_existing((folder / name for name in RESULTS), force)
        runfile.write(path, new, baseline=baseline, full_study=full_study)
        return _go_on(path, runfile.read_run(path), checkpointing)


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
    # A link would be replaced, not what it leads to.
    path = Path(os.path.realpath(place("resume", "path", path)))
    if not path.exists():
        raise RunFileError(f"{path} is not there; give the path of a run.h5")
    with locked(path):
        return _go_on(path, runfile.read_run(path), checkpointing)


def baseline_particles(case: Case) -> NDArray[np.bool_]:
    """Which design particles (D,) the case's baseline has.

    Raises
    ------
    DesignError
        If it does not give (D,) of True and False.
    """
    particles = discretise(case.scene)
    position = particles.position[particles.designed]
    array, shape = np.asarray(case.baseline(position), dtype=object), (len(position),)
    kinds = {type(value).__name__ for value in array.ravel().tolist()}
    if array.shape != shape or not kinds <= {"bool", "bool_"}:
        raise DesignError(
            f"Case: baseline gave {', '.join(sorted(kinds))} of shape {array.shape} for "
            f"positions of shape {position.shape}, must give bool of shape {shape}: whether "
            "each particle is there"
        )
    return array.astype(bool)


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

    def save(current: Optimisation, summary: Mapping[str, Any] | None = None) -> None:
        runfile.write(path, current, summary, kept.baseline, kept.full_study)

    result = go_on(kept.run, [save, ProgressBar()], checkpointing)
    summary = summarise(result, kept.baseline, kept.full_study)
    text = json.dumps(summary, indent=1) + "\n"
    replace_file(path.parent / "summary.json", text.encode())
    save(result, summary)
    drawn = RESULTS[1:] if "speed" in summary else RESULTS[1:4]
    for name in drawn:
        draw_or_warn(path.parent / name, lambda target: _draw(target, result, summary, path))
    return summary


def _draw(target: Path, result: Optimisation, summary: Mapping[str, Any], source: Path) -> None:
    from mpmopt.view.gait import plot_robustness
    from mpmopt.view.plot import PICTURES
    from mpmopt.view.report import report

    if target.suffix == ".html":
        report(target, result, summary, runfile.versions(), source)
    elif target.name == "robustness.png":
        plot_robustness(target, summary)
    else:
        PICTURES[target.stem](target, result)


def draw_or_warn(path: Path, draw: Callable[[Path], None]) -> None:
    """Draw a picture of what is saved; one that fails is a warning of one line."""
    try:
        draw(path)
    except Exception as error:
        reason = (str(error).splitlines() or [""])[0]
        logger.warning("no %s: %s: %s", path.name, type(error).__name__, reason)
