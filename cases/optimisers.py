"""Which way to climb makes a robot that walks from every start? The walker's preview by several.

    python cases/optimisers.py --out DIR

Each takes as many evaluations, from the case's own start and from random ones
(`starts.disturbed`). Leaves the run file of each run, and ``optimisers.csv``: speeds of the
finished robots without grey. What was stopped goes on.
"""

import argparse
import sys
from collections.abc import Iterable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import walker

from mpmopt.assess.robustness import Robot, Trial, speed
from mpmopt.design.task import Task
from mpmopt.design.variation import Variation
from mpmopt.errors import SceneError, SimulationError, StorageError
from mpmopt.io.console import reported
from mpmopt.io.files import as_csv, make_folder, replace_file
from mpmopt.io.progress import Progress
from mpmopt.optimisation.history import Optimisation
from mpmopt.optimisation.loop import begin, go_on
from mpmopt.optimisation.settings import Settings, Stage
from mpmopt.optimisation.starts import disturbed
from mpmopt.results import runfile

CASE = walker.CASES["preview"]
FRICTIONS = (0.3, 0.8)
SETTINGS, TASK = CASE.settings, CASE.task


def with_stages(*stages: Stage) -> Settings:
    """The case's settings with other stages, which share its evaluations."""
    return replace(SETTINGS, stages=stages, most_iterations=SETTINGS.most_iterations // len(stages))


(STAGE,) = SETTINGS.stages
WAYS: Mapping[str, tuple[Settings, Task]] = {
    "as the case": (SETTINGS, TASK),
    "plain projection, beta 8": (
        with_stages(replace(STAGE, beta=8.0, subpixel=False)), TASK
    ),
    "plain projection, beta 4 to 32": (
        with_stages(*(replace(STAGE, beta=2.0**k, subpixel=False) for k in range(2, 6))), TASK
    ),
    "mean over the scenes": (SETTINGS, replace(TASK, soft_minimum=0.0)),
    "gradient over six scenes": (
        SETTINGS,
        replace(
            TASK,
            scenes=tuple(
                replace(each, strength=share * each.strength)
                for each in TASK.scenes
                for share in (0.98, 1.02)
            ),
        ),
    ),
    "moves of 0.05": (with_stages(replace(STAGE, move_limit=0.05)), TASK),
    "moves that adapt": (replace(SETTINGS, adapt_move_limit=True), TASK),
}  # fmt: skip


def start_of(seed: int) -> dict[str, Any]:
    """The case's start; with a seed, one with a smooth random field added, as `--starts` has."""
    if not seed:
        return dict(CASE.start)
    return {**CASE.start, "phi": disturbed(CASE.start["phi"], CASE.scene, seed)}


def finished(path: Path, settings: Settings, task: Task, seed: int) -> Optimisation:
    """The run, once it has ended; it is in a file all the time."""
    if path.exists():
        run = runfile.read_run(path).run
        if (run.scene, run.settings, run.task) != (CASE.scene, settings, task):
            raise StorageError(f"{path} holds another scene, settings or task; take another --out")
    else:
        run = begin(CASE.scene, settings, start_of(seed), task)
    if not run.stop_reason:
        run = go_on(run, lambda each: runfile.write(path, each))
    return run


def row(way: str, seed: int, run: Optimisation) -> dict[str, Any]:
    """What the run's robot is worth; a speed that cannot be simulated is zero."""
    problem, x = run.problem(), run.result.x
    robot, speeds = Robot.of(problem, x), []
    for friction in (None, *FRICTIONS):
        scene = Variation(friction=friction).scene(CASE.scene)
        try:
            speeds.append(speed(robot, Trial(lambda scene=scene: scene)))  # type: ignore[misc]
        except (SceneError, SimulationError):
            speeds.append(0.0)
    grey, bare = (value - run.origin for value in (run.result.objective, run.result.post_processed))
    return {
        "way": way,
        "start": seed,
        "speed": speeds[0],
        "worst at friction 0.3 to 0.8": min(speeds),
        "lost without grey": 1.0 - bare / grey,
        "chosen evaluation": run.chosen,
        "evaluations": len(run.history),
    }


def compare(ways: Iterable[str], starts: int, out: Path) -> str:
    """Run what is not there yet, and leave the table; its text."""
    make_folder(out)
    plan = [(way, seed) for way in ways for seed in range(starts)]
    rows = []
    with Progress("runs", len(plan)) as progress:
        for way, seed in plan:
            path = out / f"{way.replace(' ', '_').replace(',', '')}-{seed}.h5"
            rows.append(row(way, seed, finished(path, *WAYS[way], seed)))
            progress.step(f"{way}, start {seed}: speed {rows[-1]['speed']:.3f}")
            table = as_csv(rows, digits=3)
            replace_file(out / "optimisers.csv", table.encode())
    return table


def main(argv: list[str] | None = None) -> int:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--ways", nargs="+", choices=WAYS, default=list(WAYS), metavar="WAY")
    parser.add_argument("--starts", type=int, default=3, help="all but one random (3)")
    parser.add_argument("--out", type=Path, required=True, metavar="DIR", help="folder of results")
    options = parser.parse_args(argv)
    return reported(
        lambda: print(compare(options.ways, options.starts, options.out)),
        lambda: "The same command goes on.",
    )


if __name__ == "__main__":
    sys.exit(main())
