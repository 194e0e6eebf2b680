"""Which ascent makes a robot that walks from every start? The walker's preview by several of them.

    python cases/optimisers.py --out DIR

Each goes through the same number of evaluations from the case's own start and from those of
``--starts``. Leaves a JSON file of each run, of them ``optimisers.csv``, and of the starts of each
ascent ``optimisers_summary.csv``. A run whose file is there is not made again.
"""

import argparse
import json
import math
import sys
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import walker
from numpy.typing import NDArray

from mpmopt.app.multistart import random_start
from mpmopt.app.sweeps import as_csv
from mpmopt.assess import threshold
from mpmopt.assess.robustness import Robot, Trial, speed
from mpmopt.design.evaluation import Evaluation
from mpmopt.design.objective import Objective
from mpmopt.design.problem import Problem
from mpmopt.design.task import Task
from mpmopt.design.variables import Freedom, completed
from mpmopt.design.variation import Variation
from mpmopt.errors import SceneError, SimulationError
from mpmopt.io.console import reported
from mpmopt.io.files import make_folder, replace_file
from mpmopt.optimisation.loop import LENGTHEN, SHORTEN
from mpmopt.optimisation.mma import Array, MovingAsymptotes
from mpmopt.optimisation.settings import Stage
from mpmopt.scene import Scene

PREVIEW = walker.CASES["preview"]
(STAGE,) = PREVIEW.settings.stages
EVALUATIONS = PREVIEW.settings.most_iterations
MOST_FAILURES = 8  # in a row
FRICTIONS = (0.3, 0.8)
STILL = 1e-3  # a turn of less than this, in squares of ranges, changes an asymptote less


class SmoothAsymptotes(MovingAsymptotes):
    """Moving asymptotes whose distances are continuous functions of the last two moves."""

    def _next_distance(self, x: Array) -> Array:
        if self.iteration < 2:
            return super()._next_distance(x)
        span = np.where(self.upper > self.lower, self.upper - self.lower, 1.0)
        last, before = (x - self.x_previous) / span, self.x_previous - self.x_before_previous
        turn = last * before / span
        share = turn / (np.abs(turn) + STILL)
        ends = np.where(share > 0.0, self.asymptote_increase, self.asymptote_decrease)
        distance = ends ** np.abs(share) * self.asymptote_distance
        return np.clip(distance, self.asymptote_min, self.asymptote_max)


@dataclass(frozen=True)
class Ascent:
    """How to climb; the defaults are what the walker's preview does.

    Attributes
    ----------
    betas : tuple of float
        Sharpness of the projection, each for an equal share of the evaluations.
    subpixel : bool
        `Stage.subpixel`.
    move_limit, raa0, asymptote_min, mma
        Of the moving asymptotes (`MovingAsymptotes`).
    adapt : bool
        `Settings.adapt_move_limit`.
    soft_minimum : float
        `Task.soft_minimum`.
    scenes : tuple of Variation
        `Task.scenes`.
    memory : float
        Share of the last gradient in the one that is followed.
    restart : float
        Below this share of the best displacement go back to its design, with half the move limit.
    """

    betas: tuple[float, ...] = (STAGE.beta,)
    subpixel: bool = STAGE.subpixel
    move_limit: float = STAGE.move_limit
    raa0: float = 1e-5
    asymptote_min: float = PREVIEW.settings.asymptote_min
    mma: type[MovingAsymptotes] = MovingAsymptotes
    adapt: bool = False
    soft_minimum: float = walker.TASK.soft_minimum
    scenes: tuple[Variation, ...] = walker.TASK.scenes
    memory: float = 0.0
    restart: float = 0.0

    @property
    def task(self) -> Task:
        return replace(walker.TASK, scenes=self.scenes, soft_minimum=self.soft_minimum)


def around(scenes: tuple[Variation, ...], by: float) -> tuple[Variation, ...]:
    """Each scene twice, with a little less and a little more strength: a gradient averaged."""
    return tuple(
        replace(each, strength=share * each.strength)
        for each in scenes
        for share in (1.0 - by, 1.0 + by)
    )


PRESENT = Ascent()
ASCENTS: Mapping[str, Ascent] = {
    "present": PRESENT,
    "plain projection": replace(PRESENT, betas=(8.0,), subpixel=False),
    "beta 4 to 32": replace(PRESENT, betas=(4.0, 8.0, 16.0, 32.0), subpixel=False),
    "mean": replace(PRESENT, soft_minimum=0.0),
    "gradient over strengths": replace(PRESENT, scenes=around(walker.TASK.scenes, 0.02)),
    "gradient with memory": replace(PRESENT, memory=0.7),
    "smooth asymptotes": replace(PRESENT, mma=SmoothAsymptotes),
    "convex": replace(PRESENT, raa0=0.1),
    "restart": replace(PRESENT, restart=0.7),
    "longer moves": replace(PRESENT, move_limit=0.05),
    "adapted moves": replace(PRESENT, adapt=True),
}


def other_start(seed: int) -> Callable[[NDArray[np.float64]], NDArray[np.float64]]:
    """The walker's phi and, but for seed 0, a random field, as `--starts` does."""
    noise = random_start(PREVIEW.scene, seed)

    def phi(positions: NDArray[np.float64]) -> NDArray[np.float64]:
        own = walker.start(positions)
        return np.clip(own + noise(positions), -1.0, 1.0) if seed else own

    return phi


@dataclass
class Climb:
    """One run: its best design without grey, and how it went.

    Attributes
    ----------
    history : list of (float, float)
        Of each evaluation the objective with grey and without; not a number where it failed.
    best : (float, (n,) array, float, float), optional
        Objective without grey of the best design, the design, its beta and objective with grey.
    violation : float
        Its `Task.violation`.
    """

    history: list[tuple[float, float]] = field(default_factory=list)
    best: tuple[float, NDArray[np.float64], float, float] | None = None
    violation: float = math.inf

    def without_grey(self, problem: Problem, x: NDArray[np.float64], e: Evaluation) -> None:
        """Judge a design as `Stage.solid` does."""
        try:
            solid = threshold.post_processed(problem.at(e.time_step), x)
        except (SceneError, SimulationError):
            solid = math.nan
        self.history.append((e.value, solid))
        violation = problem.task.violation(e.constraints)
        if math.isnan(solid):
            return
        if self.best is None or (-violation, solid) > (-self.violation, self.best[0]):
            self.best, self.violation = (solid, x, problem.chain.beta, e.value), violation


def stage(ascent: Ascent, beta: float) -> Stage:
    """The preview's, as an ascent has it."""
    return replace(STAGE, beta=beta, subpixel=ascent.subpixel, move_limit=ascent.move_limit)


def climb(scene: Scene, ascent: Ascent, start: Mapping[str, Any], evaluations: int) -> Climb:
    """Climb from a start; the design is judged by the task of the present ascent."""
    run, x = Climb(), None
    origin = Objective.of(scene, Problem(scene).particles).start
    for beta in ascent.betas:
        at = stage(ascent, beta)
        problem, judge = (at.problem(scene, task=task) for task in (ascent.task, PRESENT.task))
        freedom = Freedom(scene, problem.size, ascent.task.variables)
        x = freedom.started(problem.join(**completed("climb", start)) if x is None else x)
        x = _one_beta(run, problem, judge, freedom, ascent, x, evaluations, origin)
    return run


def _one_beta(
    run: Climb,
    problem: Problem,
    judge: Problem,
    freedom: Freedom,
    ascent: Ascent,
    x: NDArray[np.float64],
    evaluations: int,
    origin: float,
) -> NDArray[np.float64]:
    """The evaluations at one beta; returns the best design as it is, for the next."""
    mma = ascent.mma(
        freedom.lower,
        freedom.upper,
        move_limit=ascent.move_limit,
        asymptote_min=ascent.asymptote_min,
        raa0=ascent.raa0,
    )
    width, (constraint,) = max(problem.scene.grid.size), problem.task.subject_to
    top: tuple[NDArray[np.float64], Evaluation] | None = None
    slope: NDArray[np.float64] | None = None
    last, failures = math.nan, 0

    def rank(e: Evaluation) -> tuple[float, float]:
        return -problem.task.violation(e.constraints), e.value

    for _ in range(evaluations // len(ascent.betas)):
        back = False
        try:
            e = problem.evaluate(x)
        except SimulationError:
            run.history.append((math.nan, math.nan))
            failures += 1
            if top is None or failures == MOST_FAILURES:
                break
            back = True
        else:
            failures = 0
            run.without_grey(judge, x, e)
            if top is None or rank(e) > rank(top[1]):
                top = x, e
            best = top[1].value - origin
            back = ascent.restart > 0.0 and e.value - origin < ascent.restart * best
        if back:
            (x, e), slope = top, None
            mma.reset()
            mma.move_limit /= 2.0
        else:
            factor = SHORTEN if ascent.adapt and e.value < last else LENGTHEN
            mma.move_limit = min(ascent.move_limit, factor * mma.move_limit)
            last = e.value
        gradients = freedom.pullback(e.gradients)
        slope = (
            gradients[0]
            if slope is None
            else (ascent.memory * slope + (1.0 - ascent.memory) * gradients[0])
        )
        free = mma.step(
            freedom.reduced(x),
            -e.value / width,
            -slope / width,
            [constraint.g(e.constraints[0])],
            gradients[1:] / constraint.scale,
        )
        x = freedom.whole(x, free)
    return top[0] if top else x


def speeds(scene: Scene, ascent: Ascent, run: Climb) -> dict[str, float]:
    """Speed of the finished robot, and the least over frictions; not a number if it fails."""
    if run.best is None:
        return {"speed": math.nan, "worst": math.nan}
    _, x, beta, _ = run.best
    problem = stage(ascent, beta).problem(scene, task=PRESENT.task)
    robot, found = Robot.of(problem, x), []
    for variation in (Variation(), *(Variation(friction=each) for each in FRICTIONS)):
        there = variation.scene(problem.scene)
        try:
            found.append(speed(robot, Trial(partial(replace, there))))
        except (SceneError, SimulationError):
            found.append(math.nan)
    return {"speed": found[0], "worst": float(np.min(found))}


def one(name: str, seed: int, path: Path, evaluations: int) -> dict[str, Any]:
    """The row of one run, from its file if that is there."""
    if path.exists():
        kept: dict[str, Any] = json.loads(path.read_text())
        return kept
    ascent, began = ASCENTS[name], time.process_time()
    start = {**PREVIEW.start, "phi": other_start(seed)}
    run = climb(PREVIEW.scene, ascent, start, evaluations)
    used = time.process_time() - began
    origin = Objective.of(PREVIEW.scene, Problem(PREVIEW.scene).particles).start
    grey = run.best[3] - origin if run.best else math.nan
    solid = run.best[0] - origin if run.best else math.nan
    row = {
        "ascent": name,
        "start": seed,
        **speeds(PREVIEW.scene, ascent, run),
        "with grey": grey,
        "without": solid,
        "loss": 1.0 - solid / grey,
        "evaluations": len(run.history),
        "of them failed": sum(math.isnan(value) for value, _ in run.history),
        "processor seconds": used,
        "history": [(value - origin, solid - origin) for value, solid in run.history],
    }
    replace_file(path, json.dumps(row).encode())
    return row


def summary(rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Of each ascent median and worst over its starts; a robot that fails stands still."""
    found = []
    for name in dict.fromkeys(row["ascent"] for row in rows):
        its = [row for row in rows if row["ascent"] == name]

        def of(key: str, its: list[dict[str, Any]] = its) -> NDArray[np.float64]:
            return np.nan_to_num([row[key] for row in its])

        found.append(
            {
                "ascent": name,
                "starts": len(its),
                "median speed": float(np.median(of("speed"))),
                "least speed": float(of("speed").min()),
                "greatest speed": float(of("speed").max()),
                "median of worst over friction": float(np.median(of("worst"))),
                "least of worst over friction": float(of("worst").min()),
                "median loss without grey": float(np.median(of("loss"))),
                "evaluations": int(np.median(of("evaluations"))),
                "processor seconds": float(np.median(of("processor seconds"))),
            }
        )
    return found


def compare(names: list[str], starts: int, out: Path, evaluations: int = EVALUATIONS) -> str:
    """Make the runs that are not there yet, and both tables of all that are; returns the second."""
    make_folder(out)
    table = ""
    for seed in range(starts):
        for name in names:
            found = one(name, seed, _path(out, name, seed), evaluations)
            print(f"{name}, start {seed}: speed {found['speed']:.3g}", flush=True)
            paths = [_path(out, each, k) for each in ASCENTS for k in range(starts)]
            rows = [json.loads(path.read_text()) for path in paths if path.exists()]
            plain = [{k: v for k, v in row.items() if k != "history"} for row in rows]
            replace_file(out / "optimisers.csv", as_csv(plain, digits=4).encode())
            table = as_csv(summary(rows), digits=3)
            replace_file(out / "optimisers_summary.csv", table.encode())
    return table


def _path(out: Path, name: str, seed: int) -> Path:
    return out / f"{name.replace(' ', '_')}-{seed}.json"


def main(argv: list[str] | None = None) -> int:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, required=True, metavar="DIR", help="folder of results")
    parser.add_argument("--starts", type=int, default=3, help="of each ascent (3)")
    parser.add_argument(
        "--ascents", nargs="+", choices=ASCENTS, default=list(ASCENTS), metavar="NAME",
        help=f"of {', '.join(ASCENTS)} (all)",
    )  # fmt: skip
    options = parser.parse_args(argv)
    return reported(
        lambda: print(compare(options.ascents, options.starts, options.out), end=""),
        lambda: "The same command goes on.",
    )


if __name__ == "__main__":
    sys.exit(main())
