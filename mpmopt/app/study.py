"""The full study of a finished robot, kept with its run."""

from __future__ import annotations

import json
import math
import os
from pathlib import Path

from mpmopt.app.case import draw_or_warn
from mpmopt.app.summary import table, verdict_of
from mpmopt.assess import robustness
from mpmopt.errors import DesignError
from mpmopt.io.files import locked, replace_file
from mpmopt.io.notebook import Place, in_notebook
from mpmopt.io.progress import Progress
from mpmopt.results import runfile
from mpmopt.validation import digits, place


def full_study(path: str | os.PathLike[str]) -> str:
    """Make all runs of `robustness.study` of a finished run; keep and draw what they give.

    Its run file and ``summary.json`` have the numbers afterwards, ``robustness.png`` shows them. A
    study that is there is not made again.

    Parameters
    ----------
    path : str or path
        Run file.

    Returns
    -------
    str
        The study as aligned text.

    Raises
    ------
    DesignError
        If the run is not finished.
    RunFileError, StorageError
        As reading and writing do.
    """
    path = Path(os.path.realpath(place("study", "path", path)))
    with locked(path):
        kept = runfile.read_run(path)
        if not kept.summary:
            raise DesignError(f"{path} holds an unfinished run: go on with it before it is studied")
        summary = dict(kept.summary)
        if "followed" not in summary:
            problem, x = kept.run.problem(), kept.run.result.x
            with Progress("simulations") as progress:
                if in_notebook():
                    Place().show(kept.run)

                def show(name: str, speed: float) -> None:
                    progress.step(f"{name}: {'failed' if math.isnan(speed) else digits(speed, 3)}")

                summary |= robustness.study(problem, x, full=True, progress=show)
            summary |= {"verdict": verdict_of(summary, kept.run)}
            text = json.dumps(summary, indent=1) + "\n"
            replace_file(path.parent / "summary.json", text.encode())
            runfile.write(path, kept.run, summary, kept.baseline, kept.full_study)
            page = path.parent / "report.html"
            if page.exists():
                from mpmopt.view.report import report

                draw_or_warn(page, lambda at: report(at, kept.run, summary, kept.versions, path))
        if "speed" in summary:
            from mpmopt.view.gait import plot_robustness

            draw_or_warn(path.parent / "robustness.png", lambda at: plot_robustness(at, summary))
    names = ("verdict", *robustness.NAMES, "failures")
    return table({name: summary[name] for name in names if name in summary})
