"""Is it the same everywhere? One robot's preview from eight starts, and with other rounding.

    python cases/spread.py walker --out DIR

Leaves what `--starts` leaves, ``rounding`` with the plain start on a processor that is told to have
no fused multiply-add (the first time its kernels are compiled for that), and of all of them
``spread.csv`` and ``spread.png``: the finished robots side by side. What was stopped goes on.
"""

import argparse
import json
import os
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import climber
import crawler
import numpy as np
import walker
from robots import worst

from mpmopt.app.case import Case
from mpmopt.app.multistart import multistart
from mpmopt.assess.robustness import Robot, can_be_studied
from mpmopt.assess.trajectory import Motion
from mpmopt.io.console import reported
from mpmopt.io.files import as_csv, replace_file
from mpmopt.results import runfile
from mpmopt.validation import digits
from mpmopt.view.draw import Squares, draw_walls, new_figure, own_style, png, set_view, view
from mpmopt.view.gait import body_of

CASES = {"walker": walker.CASES, "crawler": crawler.CASES, "climber": climber.CASES}
PLAIN = {"NUMBA_CPU_NAME": "generic", "NUMBA_CPU_FEATURES": ""}
ROUNDING = "rounding"


def other_rounding(name: str, setting: str, out: Path) -> None:
    """Run a case in a process whose compiled arithmetic rounds otherwise."""
    script = Path(__file__).with_name(f"{name}.py")
    option = [] if setting == "default" else [f"--{setting}"]
    command = [sys.executable, str(script), *option, "--out", str(out / ROUNDING)]
    subprocess.run(command, env={**os.environ, **PLAIN}, check=True, stdout=subprocess.DEVNULL)


def row(folder: Path) -> dict[str, Any]:
    """What the summary of a run says of its robot."""
    summary: dict[str, Any] = json.loads((folder / "summary.json").read_text())

    def number(value: float | None) -> float:
        return float("nan") if value is None else float(value)

    return {
        "run": folder.name,
        "speed": number(summary["speed"]),
        "worst at friction 0.3 to 0.8": worst(summary),
        "kept at half the step": number(summary["kept"]["half_step"]),
        "on finer cells": number(summary["kept"]["finer_cells"]),
        "driven share": number(summary["driven_share"]),
        "components": summary["components"],
        "evaluations": summary["evaluations"],
    }


def spread(rows: Sequence[dict[str, Any]]) -> str:
    """Median and worst speed of the starts, and by how much other rounding changes the plain one.

    A robot that cannot be simulated has none, and counts as one that stands still.
    """
    speeds = {row["run"]: float(np.nan_to_num(row["speed"])) for row in rows}
    starts = [speed for run, speed in speeds.items() if run != ROUNDING]
    lines = [
        f"speed of {len(starts)} starts: median {digits(float(np.median(starts)), 3)}, worst "
        f"{digits(min(starts), 3)}, best {digits(max(starts), 3)}"
    ]
    if ROUNDING in speeds and speeds["start-0"]:
        change = speeds[ROUNDING] / speeds["start-0"] - 1.0
        lines.append(f"with other rounding: {digits(speeds[ROUNDING], 3)}, {change:+.0%}")
    return "\n".join(lines)


@own_style()
def draw(path: Path, folders: Sequence[Path], rows: Sequence[dict[str, Any]]) -> None:
    """Write a PNG of the finished robots before they move, side by side."""
    motions = []
    for folder in folders:
        run = runfile.read_run(folder / "run.h5").run
        robot = Robot.of(run.problem(), run.result.x)
        motions.append(Motion.of(body_of(robot, robot.problem.scene), [0]))
    box = view(motions)
    width, height = box[1] - box[0]
    columns = min(len(motions), 3 if width > height else 5)
    lines = -(-len(motions) // columns)
    wide = 10.0 / columns
    figure = new_figure(10.0, lines * (wide * height / width + 0.3))
    panels = figure.subplots(lines, columns, squeeze=False).ravel()
    for axes in panels:
        axes.set_axis_off()
    for axes, motion, one in zip(panels, motions, rows):
        set_view(axes, box)
        draw_walls(axes, motion.scene)
        axes.add_collection(Squares(motion), autolim=False)
        axes.set_title(f"{one['run']}: speed {digits(one['speed'], 3)}", fontsize=9)
    replace_file(path, png(figure))


def compare(name: str, setting: str, starts: int, out: Path, force: bool = False) -> str:
    """Run what is not there yet, and leave table and picture; the spread as text."""
    case: Case = CASES[name][setting]
    print(multistart(case, out, starts, force=force))
    other_rounding(name, setting, out)
    folders = [*(out / f"start-{seed}" for seed in range(starts)), out / ROUNDING]
    folders = [folder for folder in folders if (folder / "summary.json").exists()]
    rows = [row(folder) for folder in folders]
    replace_file(out / "spread.csv", as_csv(rows, digits=4).encode())
    draw(out / "spread.png", folders, rows)
    return spread(rows)


def main(argv: list[str] | None = None) -> int:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("robot", choices=CASES)
    parser.add_argument("--setting", default="preview", help="of the case (preview)")
    parser.add_argument("--starts", type=int, default=8, help="all but one random (8)")
    parser.add_argument("--out", type=Path, required=True, metavar="DIR", help="folder of results")
    options = parser.parse_args(argv)
    if options.setting not in CASES[options.robot]:
        parser.error(f"--setting {options.setting}: one of {', '.join(CASES[options.robot])}")
    if not can_be_studied(CASES[options.robot][options.setting].scene):
        parser.error(f"--setting {options.setting}: its robot has no speed, for it is on walls")
    return reported(
        lambda: print(compare(options.robot, options.setting, options.starts, options.out)),
        lambda: "The same command goes on.",
    )


if __name__ == "__main__":
    sys.exit(main())
