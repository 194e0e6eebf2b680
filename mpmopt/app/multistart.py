"""One case from several starts: how far luck carries, and which run is the best."""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import logging
import math
import os
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from mpmopt.app.case import RESULTS, Case, baseline_particles, draw_or_warn, run
from mpmopt.app.sweeps import connected, sweep
from mpmopt.assess.threshold import Baseline
from mpmopt.design.task import Task
from mpmopt.errors import RunFileError, SweepError
from mpmopt.io.files import as_csv, locked, make_folder, refuse_existing, replace_file
from mpmopt.optimisation.loop import check_body_fits
from mpmopt.optimisation.settings import Settings
from mpmopt.optimisation.starts import disturbed
from mpmopt.results import runfile
from mpmopt.scene import Scene
from mpmopt.validation import count, digits, instance, place

logger = logging.getLogger(__name__)


def one_start(
    scene: str,
    settings: dict[str, Any],
    start: dict[str, Any],
    task: str,
    seed: int,
    *,
    baseline: Baseline,
    out: Path,
) -> dict[str, float]:
    """Optimise from one start, in a folder of its own, or go on with what was begun there.

    What `case.run` leaves is in ``out/start-SEED``, and ``log.txt`` with what it said.

    Returns
    -------
    dict
        Numbers of the summary; `gain` is the post-processed design's over the solid reference
        design, and `refined_gain` the least of it as designed, with half the step, and with cells
        half as wide.
    """
    case = Case(
        Scene.from_json(scene), Settings.from_dict(settings), baseline, start, Task.from_json(task)
    )
    folder = out / f"start-{seed}"
    folder.mkdir(parents=True, exist_ok=True)
    # Paths may hold what is no text.
    log = (folder / "log.txt").open("a", buffering=1, encoding="utf-8", errors="backslashreplace")
    phi = disturbed(np.asarray(start["phi"], dtype=float), case.scene, seed) if seed else None
    with log, contextlib.redirect_stderr(log):
        summary = run(case, folder, phi=phi)

    def number(value: float | None) -> float:
        return math.nan if value is None else float(value)

    gains = {name: number(value) for name, value in summary["gain"].items()}
    retained = summary["retained_gain"]
    honest = ("as designed", "half the step", "cells half as wide")
    return {
        "reference": number(summary["reference"]),
        "optimised": summary["optimised"],
        "post_processed": number(summary["post_processed"]),
        "gain": gains["as designed"],
        "retained_half_step": number(retained["half the step"]),
        "retained_half_cells": number(retained["cells half as wide"]),
        "refined_gain": float(np.min([gains[name] for name in honest])),
        "disconnected_particles": summary["disconnected_particles"],
        "evaluations": summary["evaluations"],
        "failed_evaluations": summary["failed_evaluations"],
        "seconds": summary["seconds"],
    }


def multistart(
    case: Case,
    out: str | os.PathLike[str],
    starts: int,
    scheduler: str | None = None,
    force: bool = False,
) -> str:
    """Optimise a case from several starts: its own, and random ones with seeds 1, 2, ...

    The random ones add a smooth random field to the case's phi (`random_start`). Starts run side by
    side. Leaves ``start-0``, ``start-1``, ..., one folder for each; the numbers in ``starts.h5``
    (`sweeps`) and ``starts.csv``; and ``starts.png``. A start whose numbers are there is not run
    again; one that was stopped is gone on with.

    Parameters
    ----------
    case : Case
    out : str or path
        Folder; on a cluster one that all workers see under this name.
    starts : int
    scheduler : str, optional
        Address of a Dask cluster (`sweeps.connected`).
    force : bool, optional
        Remove what these starts left before, and run them anew.

    Returns
    -------
    str
        The table, what spread there is, and the best after its refinement study.

    Raises
    ------
    SweepError
        If no start is asked for or came to an end, or those who compute gave up (`sweeps.sweep`).
    StorageError
        If the folder cannot be written to or holds files of those names without their
        ``starts.h5``, or another process is at work in it.
    """
    instance("multistart", "case", case, Case)
    starts = count("multistart", "starts", starts, 1, error=SweepError)
    out = place("multistart", "out", out).absolute()
    check_body_fits(case.scene)
    baseline_particles(case)  # what is wrong with it is told now, not by every start
    make_folder(out)
    table, picture = out / "starts.csv", out / "starts.png"
    if not (out / "starts.h5").exists():
        refuse_existing((table, picture), force)
    start = dict(case.start)
    problem = case.settings.stages[0].problem(case.scene)
    start["phi"] = problem.split(problem.join(**start)).phi
    plan = {
        "scene": case.scene.to_json(),
        "settings": dataclasses.asdict(case.settings),
        "start": {name: np.asarray(value).tolist() for name, value in start.items()},
        "task": case.task.to_json(),
    }
    function = functools.partial(one_start, baseline=case.baseline, out=out)
    with connected(scheduler) as executor:
        if force:
            _clear(out, [out / f"start-{seed}" for seed in range(starts)])
        outcomes = sweep(
            function,
            [{**plan, "seed": seed} for seed in range(starts)],
            out / "starts.h5",
            executor,
        )
    rows = [
        {"start": outcome.point["seed"], **outcome.result}
        for outcome in outcomes
        if not outcome.error
    ]
    failed = "".join(
        f"start {outcome.point['seed']} failed: {outcome.error.splitlines()[0]}\n"
        for outcome in outcomes
        if outcome.error
    )
    if not rows:
        raise SweepError(f"no start came to an end\n{failed}")
    plain = [{name.replace("_", " "): value for name, value in row.items()} for row in rows]
    replace_file(table, as_csv(plain, digits=4).encode())
    draw_or_warn(picture, lambda path: draw(path, out, rows))
    return failed + report(rows)


def _clear(out: Path, folders: Sequence[Path]) -> None:
    """Remove what starts left, once nobody is at work on any of it."""
    with contextlib.ExitStack() as locks:
        locks.enter_context(locked(out / "starts.h5"))
        found = [folder for folder in folders if folder.is_dir()]
        for folder in found:
            locks.enter_context(locked(folder / "run.h5"))
        (out / "starts.h5").unlink(missing_ok=True)
        for folder in found:
            for name in ("log.txt", *RESULTS, "run.h5"):  # that which says whose it is at last
                (folder / name).unlink(missing_ok=True)


def best_of(rows: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """The row with the greatest refined gain; one that has none comes last."""
    return max(rows, key=_rank)


def _rank(row: dict[str, Any]) -> tuple[float, float]:
    refined, gain = (np.nan_to_num(row[name], nan=-np.inf) for name in ("refined_gain", "gain"))
    return refined, gain


def report(rows: Sequence[dict[str, Any]]) -> str:
    """The rows as aligned text, their spread, and the best."""
    columns: dict[str, tuple[str, Callable[[Any], str]]] = {
        "start": ("start", str),
        "post_processed": ("post-processed", _length),
        "gain": ("     gain", _length),
        "retained_half_step": ("retained at half step", "{:.0%}".format),
        "retained_half_cells": ("at half cells", "{:.0%}".format),
        "refined_gain": ("refined gain", _length),
        "disconnected_particles": ("loose", str),
        "failed_evaluations": ("failed", str),
        "seconds": ("seconds", "{:.0f}".format),
    }
    lines = ["  ".join(heading for heading, _ in columns.values())]
    for row in rows:
        cells = (
            ("-" if row[name] != row[name] else form(row[name])).rjust(len(head))
            for name, (head, form) in columns.items()
        )
        lines.append("  ".join(cells))
    for name in ("gain", "refined_gain"):
        values = [row[name] for row in rows if math.isfinite(row[name])]
        if values:
            low, middle, high = np.percentile(values, (0, 50, 100))
            lines.append(
                f"{name.replace('_', ' ')}: {_length(low)} to {_length(high)}, median "
                f"{_length(middle)}, standard deviation {_length(float(np.std(values)))}"
            )
    best = best_of(rows)
    gain = best["refined_gain"]
    found = f"gain {_length(gain)}" if math.isfinite(gain) else "which has no refined gain"
    lines.append(f"best after its refinement study: start-{best['start']}, {found}")
    return "\n".join(lines)


def _length(value: float) -> str:
    return digits(value, 3)


def draw(path: Path, out: Path, rows: Sequence[dict[str, Any]]) -> None:
    """Write a PNG: gains by start, and the designs, the best first, as far as there is room."""
    from mpmopt.view.draw import own_style

    with own_style():
        _draw(path, out, rows)


def _draw(path: Path, out: Path, rows: Sequence[dict[str, Any]]) -> None:
    from mpmopt.view.draw import draw_design, format_of, new_figure, png

    ranked = sorted(rows, key=_rank, reverse=True)
    shown = ranked[:8]
    lines = -(-len(shown) // 4)
    figure = new_figure(10.0, 3.2 + 1.5 * lines)
    figure.set_layout_engine("constrained")
    parts: Any = figure.subfigures(2, 1, height_ratios=(3.0, 1.5 * lines))
    upper, lower = parts
    axes = upper.subplots()
    start = [row["start"] for row in rows]
    gain, refined = ([row[name] for row in rows] for name in ("gain", "refined_gain"))
    axes.vlines(start, refined, gain, color="0.7", lw=2, zorder=1)
    axes.plot(start, gain, "o", color="C0", label="post-processed")
    axes.plot(start, refined, "s", color="C1", label="after the refinement study")
    axes.axhline(np.nanmedian(gain), color="C0", ls=":", lw=1, label="median")
    if np.isfinite(refined).any():
        axes.axhline(np.nanmedian(refined), color="C1", ls=":", lw=1)
    best = ranked[0]
    axes.plot(
        best["start"], best["refined_gain"], "s", ms=13, mfc="none", mec="crimson", mew=1.5,
        label="best",
    )  # fmt: skip
    axes.axhline(0.0, color="black", lw=0.8)
    axes.set_xticks(start)
    axes.set_xlabel("start (0: plain)")
    axes.set_ylabel("gain over the solid reference design")
    axes.legend(fontsize=8, ncols=4, loc="lower center", bbox_to_anchor=(0.5, 1.0), frameon=False)
    axes.grid(True, axis="y", alpha=0.3)
    form = format_of([row["refined_gain"] for row in shown])
    for axis, row in zip(lower.subplots(lines, 4, squeeze=False).flat, shown):
        try:
            kept = runfile.read_run(out / f"start-{row['start']}" / "run.h5").run
            draw_design(axis, kept.problem(), kept.result.x)
        except RunFileError as error:
            logger.warning("no picture of start %d's design: %s", row["start"], error)
        axis.set_title(f"start {row['start']}: {row['refined_gain']:{form}}", fontsize=9)
    for axis in lower.axes:
        axis.set_axis_off()
    replace_file(path, png(figure))
