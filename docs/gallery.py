"""Runs the cases at a small size and leaves pictures, films and numbers for the gallery.

    python docs/gallery.py

Sphinx calls this before it reads the pages. What is newer than its sources is left as it is.
"""

import csv
import io
import sys
from pathlib import Path

sys.path.append(str(Path(__file__).parent / "tutorial"))
sys.path.append(str(Path(__file__).parent.parent / "cases"))
# An installed package comes first; the working copy serves where there is none.
sys.path.append(str(Path(__file__).parent.parent))

import climber
import crawler
import robot
import walker

import mpmopt
from mpmopt.app.case import Case, baseline_particles
from mpmopt.app.summary import summarise
from mpmopt.assess.trajectory import post_processed
from mpmopt.design.problem import Problem
from mpmopt.io.files import make_folder, replace_file
from mpmopt.io.progress import Progress
from mpmopt.optimisation.loop import optimise
from mpmopt.results import runfile
from mpmopt.view.film import film
from mpmopt.view.plot import plot_motion

OUT = Path(__file__).parent / "_gallery"
CASES = {
    "walker": (walker, walker.CASES["preview"]),
    "crawler": (crawler, crawler.CASES["preview"]),
    "climber": (climber, climber.CASES["preview"]),
    "worm": (robot, robot.CASE),
}
SECONDS = 5.0  # of a film
ROWS = {
    "start": "Start",
    "reference": "Solid reference design",
    "baseline": "Baseline design",
    "optimised": "Optimised",
    "post_processed": "Post-processed",
    "actuation_off": "The same with its actuation off",
    "retained_gain": "Gain retained",
    "disconnected_particles": "Disconnected particles",
    "evaluations": "Evaluations",
    "failed_evaluations": "Failed evaluations",
}


def make(name: str, case: Case) -> None:
    """Optimise a case and write its picture, film and numbers."""
    first = case.settings.stages[0]
    start = Problem(first.scene(case.scene), first.beta).join(**case.start)
    result = optimise(case.scene, case.settings, start, task=case.task)
    summary = summarise(result, baseline_particles(case))
    path = OUT / f"{name}.h5"
    runfile.write(path, result, summary)
    film(OUT / f"{name}.gif", result, SECONDS)
    plot_motion(OUT / f"{name}.png", post_processed(result.problem(), result.result.x), 4)
    table = io.StringIO()
    csv.writer(table).writerows((label, text(summary[key])) for key, label in ROWS.items())
    replace_file(OUT / f"{name}.csv", table.getvalue().encode())  # last: says that all is there


def text(value: object) -> str:
    """A value of a summary as the table shows it."""
    if isinstance(value, dict):
        shares = {name: "none" if v is None else f"{v:.0%}" for name, v in value.items()}
        return "; ".join(f"{share} with {name}" for name, share in shares.items())
    return f"{value:.3f}" if isinstance(value, float) else str(value)


def main() -> None:
    """Make what is missing or older than the package or its own case."""
    package = list(Path(mpmopt.__file__).parent.glob("*.py"))
    make_folder(OUT)
    with Progress("cases of the gallery", len(CASES)) as progress:
        for name, (module, case) in CASES.items():
            sources = [Path(__file__), Path(module.__file__), *package]
            newest = max(source.stat().st_mtime for source in sources)
            done = OUT / f"{name}.csv"
            if not done.exists() or done.stat().st_mtime < newest:
                make(name, case)
            progress.step(name)


if __name__ == "__main__":
    main()
