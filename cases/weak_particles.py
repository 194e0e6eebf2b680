"""Void beside stressed solid: which floors let a robot be designed with a long step.

    python cases/weak_particles.py --out DIR [--quick]

Optimises walker and crawler at Courant number 0.56 with several kinds of void, counts the
evaluations that fail, and measures by how much the void moves a binary design. Writes
``weak_particles.csv`` and ``weak_particles.rst``.
"""

import argparse
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import crawler
import numpy as np
import walker
from numpy.typing import NDArray

from mpmopt.assess.refinement import mapped
from mpmopt.assess.threshold import Baseline, distance, post_processed
from mpmopt.design.actuation import signal
from mpmopt.design.chain import interpolate
from mpmopt.design.objective import Objective
from mpmopt.design.problem import Problem
from mpmopt.design.variables import START, Variables
from mpmopt.design.variation import refined
from mpmopt.errors import MpmoptError, SimulationError
from mpmopt.io.files import as_csv, replace_file
from mpmopt.optimisation.loop import Optimisation, optimise
from mpmopt.optimisation.settings import Settings, Stage
from mpmopt.scene import Scene
from mpmopt.scene.particles import discretise
from mpmopt.simulation.simulation import Simulation

CASES = {
    "walker": (walker.walker, walker.slanted_legs),
    "crawler": (crawler.crawler, crawler.slanted_legs),
}
BETAS = (0.5, 1.0, 2.0, 4.0, 8.0, 16.0, 32.0)
LEAVE_OUT = 0.05  # gamma below which void is left out
STEP_IN_CELLS = 0.1024  # seconds per unit of dx: Courant number 0.56


class Void(NamedTuple):
    """How much of void is simulated, and from which beta on it is left out."""

    void_density: float
    left_out_from: float = np.inf
    void_stiffness: float = 1e-3

    def of(self, scene: Scene) -> Scene:
        """The scene with these floors."""
        return scene.vary(void_density=self.void_density, void_stiffness=self.void_stiffness)


VOIDS = {
    "mass 1e-3 (the paper's)": Void(1e-3),
    "mass 1e-2": Void(1e-2),
    "mass 3e-2": Void(3e-2),
    "mass 1e-2, left out": Void(1e-2, 0.0),
    "mass 1e-2, left out from beta 8": Void(1e-2, 8.0),
}


class Row(NamedTuple):
    """One line of the table; distances moved are in percent of the gain over the reference."""

    case: str
    void: str
    evaluations: int
    failed: int
    smallest_step: float
    optimised: str
    post_processed: str
    cpu_ms_per_evaluation: str
    moved_drawn: str
    moved_optimised: str
    moved_drawn_fine: str
    moved_optimised_fine: str


def short_optimisation(scene: Scene, void: Void, iterations: int) -> Optimisation:
    """Beta doubled from 0.5 to 32 at the scene's own step, so many evaluations each."""
    stages = tuple(
        Stage(
            beta,
            void.void_density,
            void.void_stiffness,
            scene.time_step,
            solid=beta >= 16.0,
            void_cutoff=LEAVE_OUT if beta >= void.left_out_from else 0.0,
            halvings=0,  # what fails shall count
            limited=False,
        )
        for beta in BETAS
    )
    settings = Settings(
        stages, least_iterations=iterations, most_iterations=iterations, tolerance=0.0
    )
    return optimise(scene, settings, Problem(stages[0].scene(scene)).join(**START))


def distance_with_void(
    scene: Scene, keep: NDArray[np.bool_], variables: Variables, void: Void
) -> float:
    """Objective L of a binary design (D,) whose void is there, unless late stages leave it out.

    Raises
    ------
    DesignError, SimulationError
        As the simulation does.
    """
    if np.isfinite(void.left_out_from):
        return distance(scene, keep, variables)
    scene = void.of(scene)
    particles = discretise(scene)
    material = interpolate(scene.material, particles.completed(keep.astype(float)))
    driven = signal(scene, variables.a, variables.theta, variables.b)
    simulation = Simulation(scene, particles, *material, driven)
    return float(Objective.of(scene, particles).centroid(simulation.run()))


def moved(scene: Scene, keep: NDArray[np.bool_], variables: Variables) -> list[str]:
    """By how much of its gain each void moves a binary design, or why not."""
    try:
        removed = distance(scene, keep, variables)
        gain = removed - distance(scene, np.ones_like(keep), variables)
    except SimulationError:
        return ["fails without void"] * len(VOIDS)
    if gain <= 0.0:
        return ["no gain"] * len(VOIDS)
    changes = []
    for void in VOIDS.values():
        try:
            change = distance_with_void(scene, keep, variables, void) - removed
            changes.append(f"{100.0 * change / gain:.1f}")
        except SimulationError as error:
            changes.append(f"failed at step {error.step}")
    return changes


def start_actuation() -> Variables:
    """The signal that optimisations start from."""
    a, theta, b = (np.array([START[name]]) for name in ("a", "theta", "b"))
    return Variables(np.empty(0), a, theta, b)


def rows_of(name: str, cells: int, iterations: int) -> Iterator[Row]:
    """The lines of one case, on so many cells and on twice as many."""
    make, baseline = CASES[name]
    scene = make(cells, STEP_IN_CELLS / cells)
    runs, seconds = {}, {}
    for label, void in VOIDS.items():
        began = time.process_time()
        runs[label] = short_optimisation(scene, void, iterations)
        seconds[label] = time.process_time() - began
        print(f"{name}, {label}: {runs[label].failed_evaluations} failed", file=sys.stderr)
    changes = [
        moved(there, keep, variables)
        for there in (scene, refined(scene, 2))
        # The last one's void is left out: it is as binary as they come.
        for keep, variables in designs(there, baseline, runs[label])
    ]
    for index, (label, run) in enumerate(runs.items()):
        yield Row(
            name,
            label,
            len(run.history),
            run.failed_evaluations,
            min(item.time_step for item in run.history),
            f"{run.result.objective:.3f}",
            solid_distance(run),
            f"{1e3 * seconds[label] / len(run.history):.0f}",
            *(change[index] for change in changes),
        )


def solid_distance(run: Optimisation) -> str:
    """Distance of the result without its void, or that it fails."""
    try:
        return f"{post_processed(run.problem(), run.result.x):.3f}"
    except SimulationError:
        return "failed"


def designs(
    scene: Scene, baseline: Baseline, run: Optimisation
) -> list[tuple[NDArray[np.bool_], Variables]]:
    """The baseline design and the optimised one, with their actuation, on a scene's grid."""
    particles = discretise(scene)
    there = baseline(particles.position[particles.designed])
    problem, x = run.problem(), run.result.x
    return [(there, start_actuation()), (mapped(scene, problem, x), problem.split(x))]


def main(argv: list[str] | None = None) -> int:
    """Measure, print and write the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, required=True, metavar="DIR", help="folder of results")
    parser.add_argument("--quick", action="store_true", help="half as many cells along each side")
    parser.add_argument("--iterations", type=int, default=10, help="evaluations per beta (10)")
    arguments = parser.parse_args(argv)
    cells = 64 if arguments.quick else 128
    try:
        arguments.out.mkdir(parents=True, exist_ok=True)
        rows = [row for name in CASES for row in rows_of(name, cells, arguments.iterations)]
        text = as_csv([row._asdict() for row in rows])
        replace_file(arguments.out / "weak_particles.csv", text.encode())
    except MpmoptError as error:
        print(f"{type(error).__name__}: {error}", file=sys.stderr)
        return 1
    lines = text.replace("_", " ").splitlines()
    table = [f".. csv-table:: Void at Courant number 0.56, {cells} x {cells} cells",
             "   :header-rows: 1", "", *(f"   {line}" for line in lines)]  # fmt: skip
    (arguments.out / "weak_particles.rst").write_text("\n".join(table) + "\n")
    print("\n".join(table))
    return 0


if __name__ == "__main__":
    sys.exit(main())
