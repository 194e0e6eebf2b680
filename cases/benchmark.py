"""How fast, how much memory: one gradient of the paper's walker, by threads, sizes and schedules.

    python cases/benchmark.py --out DIR [--peers] [--quick]

Contestants take turns within each round, so that the ratios between them hold on a noisy machine;
the figures are medians over the rounds. `--peers` adds the same scene in Warp, Taichi and JAX with
their own automatic differentiation (``pip install mpmopt[peers]``); objectives and gradients must
agree with ours before any time is printed.
"""

import argparse
import datetime
import importlib
import importlib.metadata
import os
import platform
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
from walker import walker, walker_on_ground

from mpmopt.design.ensemble import side_by_side
from mpmopt.design.objective import Objective
from mpmopt.design.problem import Problem
from mpmopt.scene import Grid
from mpmopt.scene.scene import Formulation
from mpmopt.simulation.checkpoints import Checkpointing
from mpmopt.simulation.simulation import Simulation

PEERS = {"warp_mpm": "warp-lang", "taichi_mpm": "taichi", "jax_mpm": "jax"}
VALUE_TOLERANCE, GRADIENT_TOLERANCE = 1e-10, 1e-9  # relative
KEEP_ALL = Checkpointing(memory=2**34)

Run = Callable[[], object]


def problem_of(cells: int, steps: int) -> tuple[Problem, np.ndarray]:
    """The walker at the paper's Courant number, and a design without symmetry."""
    problem = Problem(replace(walker(cells, 2e-4 * 128 / cells), steps=steps))
    phi = np.random.default_rng(0).uniform(-0.5, 0.5, int(problem.particles.designed.sum()))
    return problem, problem.join(phi, 1.0, -0.3, -0.5)


def gradient_of(simulation: Simulation, objective: Objective, keep: Checkpointing) -> tuple:
    """Ours: value and the derivatives that peers give."""
    with simulation.checkpoints(keep) as checkpoints:
        forward = simulation.forward(checkpoints)
        bars = objective.terminal_adjoints(forward.states)
        return objective.value(forward.states), forward.reverse(bars)


def with_threads(number: int, run: Run) -> Run:
    """The same with so many threads."""

    def call() -> object:
        os.environ["MPMOPT_THREADS"] = str(number)
        return run()

    return call


def in_turns(runs: Mapping[str, Run], rounds: int) -> dict[str, np.ndarray]:
    """Seconds (rounds,) of each, after one round that does not count."""
    seconds: dict[str, list[float]] = {name: [] for name in runs}
    for number in range(rounds + 1):
        for name, run in runs.items():
            began = time.perf_counter()
            run()
            if number:
                seconds[name].append(time.perf_counter() - began)
    os.environ.pop("MPMOPT_THREADS", None)
    return {name: np.array(values) for name, values in seconds.items()}


def ratio(one: np.ndarray, other: np.ndarray) -> float:
    """Median over the rounds of one's seconds over the other's."""
    return float(np.median(one / other))


def table(title: str, header: list[str], rows: list[list[str]]) -> str:
    """A csv-table in reStructuredText."""
    lines = [f".. csv-table:: {title}", "   :header: " + ", ".join(f'"{h}"' for h in header), ""]
    return (
        "\n".join(lines + ["   " + ", ".join(f'"{cell}"' for cell in row) for row in rows]) + "\n"
    )


def threads_and_schedules(steps: int, rounds: int) -> str:
    """One and two threads; states recomputed or kept."""
    problem, x = problem_of(128, steps)
    simulation = problem.simulation(x)
    objective = Objective.of(problem.scene, simulation.particles)
    runs: dict[str, Run] = {}
    for number in (1, 2):
        runs[f"forward {number}"] = with_threads(number, simulation.run)
        for name, keep in (("recomputed", Checkpointing()), ("kept", KEEP_ALL)):
            runs[f"{name} {number}"] = with_threads(
                number, partial(gradient_of, simulation, objective, keep)
            )
    seconds = in_turns(runs, rounds)
    per = 1e9 / (steps * simulation.initial.shape[1])
    rows = []
    for kind in ("forward", "recomputed", "kept"):
        for number in (1, 2):
            mine = seconds[f"{kind} {number}"]
            name = kind if kind == "forward" else f"value + gradient, states {kind}"
            rows.append(
                [
                    name,
                    str(number),
                    f"{np.median(mine) * per:.1f}",
                    f"{ratio(mine, seconds[f'forward {number}']):.2f}",
                    f"{ratio(seconds[f'{kind} 1'], mine):.2f}",
                ]
            )
    header = ["what", "threads", "ns per particle and step", "forward runs", "times one thread"]
    return table(f"The paper's walker, {steps} steps, by threads and schedule", header, rows)


def on_ground(
    cells: int, steps: int, formulation: Formulation = "total"
) -> tuple[Simulation, Objective]:
    """The walker on ground, with its layer and viscosity."""
    scene = replace(
        walker_on_ground(64, 4e-4, 4.0),
        grid=Grid((3 * cells // 2, cells), 1 / cells),
        time_step=min(1.6e-4 * 128 / cells, 13.0 / cells**2),  # as viscosity bears
        steps=steps,
        transient=0.0,
        filter_length=0.0,  # a physical length would take too many passes on the finest cells
        formulation=formulation,
    )
    problem = Problem(scene)
    phi = np.random.default_rng(0).uniform(-0.5, 0.5, int(problem.particles.designed.sum()))
    simulation = problem.simulation(problem.join(phi, 1.0, -0.3, -0.5))
    return simulation, Objective.of(problem.scene, simulation.particles)


def several(*runs: Run) -> Run:
    """Runs side by side, each by one thread; each needs a simulation of its own."""
    return with_threads(1, lambda: side_by_side(lambda run: run(), runs))


def formulations(steps: int, rounds: int) -> str:
    """The walker on ground, viscous, in both formulations, by one thread."""
    runs: dict[str, Run] = {}
    kinds: tuple[Formulation, ...] = ("updated", "total")
    for kind in kinds:
        simulation, objective = on_ground(128, steps, kind)
        count = simulation.initial.shape[1]
        runs[f"forward {kind}"] = with_threads(1, simulation.run)
        gradients = [
            partial(gradient_of, *pair, KEEP_ALL)
            for pair in ((simulation, objective), on_ground(128, steps, kind))
        ]
        runs[f"both {kind}"] = several(gradients[0])
        runs[f"two {kind}"] = several(*gradients)
    seconds = in_turns(runs, rounds)
    rows = []
    for what, number, name in (
        ("forward", 1, "forward"),
        ("both", 1, "value + gradient"),
        ("two", 2, "value + gradient, two scenes side by side, each of both"),
    ):
        updated, total = seconds[f"{what} updated"], seconds[f"{what} total"]
        per = [np.median(each) / (number * steps * count) * 1e9 for each in (updated, total)]
        rows.append([name, *(f"{each:.1f}" for each in per), f"{ratio(total, updated):.2f}"])
    rows.append(
        [
            "two scenes take as long as one, times",
            *(
                f"{ratio(seconds[f'two {kind}'], seconds[f'both {kind}']):.2f}"
                for kind in ("updated", "total")
            ),
            "",
        ]
    )
    header = ["ns per particle and step", "MLS-MPM", "total Lagrangian", "ratio"]
    title = f"The walker on ground, {count} particles, {steps} steps, one thread a scene"
    return table(title, header, rows)


def sizes_on_ground(quick: bool, rounds: int) -> str:
    """Total Lagrangian: cost per particle from hundreds to a quarter of a million."""
    rows: list[list[str]] = []
    costs = []
    grids = (64, 2000), (128, 1000), (256, 400), (512, 100), (1024, 30)
    for cells, steps in grids[: 2 if quick else 5]:
        simulation, objective = on_ground(cells, steps)
        count = simulation.initial.shape[1]
        seconds = in_turns(
            {
                "forward": with_threads(1, simulation.run),
                "both": several(partial(gradient_of, simulation, objective, KEEP_ALL)),
            },
            rounds,
        )
        per = 1e9 / (count * steps)
        cost = [float(np.median(seconds[name])) * per for name in ("forward", "both")]
        costs.append(cost)
        times = [f"{mine / first:.2f}" for mine, first in zip(cost, costs[0])]
        rows.append([f"{count}", f"{cost[0]:.1f}", times[0], f"{cost[1]:.1f}", times[1]])
    header = [
        "particles", "forward ns", "times the first", "value + gradient ns", "times the first"
    ]  # fmt: skip
    return table("Total Lagrangian, the walker on ground, by size, one thread", header, rows)


def sizes(quick: bool, rounds: int) -> str:
    """Cost per particle and speed-up of two threads from thousands to a quarter of a million."""
    rows = []
    first = None
    for cells, steps in ((128, 1000), (256, 400), (512, 200), (1024, 60))[: 2 if quick else 4]:
        problem, x = problem_of(cells, steps)
        simulation = problem.simulation(x)
        objective = Objective.of(problem.scene, simulation.particles)
        seconds = in_turns(
            {
                str(number): with_threads(
                    number, partial(gradient_of, simulation, objective, Checkpointing())
                )
                for number in (1, 2)
            },
            rounds,
        )
        count = simulation.initial.shape[1]
        cost = np.median(seconds["1"]) / (count * steps) * 1e9
        first = first or cost
        rows.append(
            [
                f"{cells} x {cells}",
                f"{count}",
                f"{cost:.1f}",
                f"{cost / first:.2f}",
                f"{ratio(seconds['1'], seconds['2']):.2f}",
            ]
        )
    header = [
        "cells",
        "particles",
        "ns, one thread",
        "times the first",
        "two threads are faster by",
    ]
    return table("Value + gradient by size", header, rows)


def first_steps(formulation: Formulation, began: float) -> None:
    """In the processes of `start_up`: print when the first step and the first gradient are done."""
    problem, x = problem_of(64, 1)
    if formulation == "total":
        problem = Problem(replace(walker_on_ground(64, 4e-4, 4.0), steps=1, transient=0.0))
        x = problem.join(0.0, 1.0, -0.3, -0.5)
    problem.value(x)
    first = time.perf_counter() - began
    problem.value_and_gradient(x)
    print(first, time.perf_counter() - began)


def start_up() -> str:
    """Seconds to the first time step and to the first gradient, with an empty and a full cache."""
    program = (
        "import sys, time; began = time.perf_counter(); sys.path.insert(0, sys.argv[1])\n"
        "from benchmark import first_steps\n"
        "first_steps(sys.argv[2], began)\n"
    )
    rows = []
    with tempfile.TemporaryDirectory() as cache:
        for name in ("first start: compiling", "later start"):
            for formulation in ("updated", "total"):
                done = subprocess.run(
                    [sys.executable, "-c", program, str(Path(__file__).parent), formulation],
                    env={**os.environ, "NUMBA_CACHE_DIR": f"{cache}/{formulation}"},
                    capture_output=True, text=True, check=True,
                )  # fmt: skip
                step, gradient = map(float, done.stdout.split())
                rows.append([name, formulation, f"{step:.1f}", f"{gradient:.1f}"])
    header = ["", "formulation", "s to the first time step", "s to the first gradient"]
    return table("From the interpreter's start", header, rows)


def peak_memory(contestant: str, steps: int) -> float:
    """Peak memory in MB of a process that does one gradient; not a number off Linux."""
    if not Path("/proc/self/status").exists():
        return float("nan")
    done = subprocess.run(
        [sys.executable, __file__, "--memory", contestant, "--steps", str(steps), "--out", "."],
        capture_output=True, text=True, check=True,
    )  # fmt: skip
    return float(done.stdout.split()[-1])


def print_peak_memory(contestant: str, steps: int) -> None:
    """In the process that `peak_memory` starts."""
    if contestant == "total":
        simulation, objective = on_ground(128, steps)
    else:
        problem, x = problem_of(128, steps)
        simulation = problem.simulation(x)
        objective = Objective.of(problem.scene, simulation.particles)
    if contestant in ("mpmopt", "total"):
        gradient_of(simulation, objective, Checkpointing())
    else:
        peer = importlib.import_module(f"peers.{contestant}").prepare(simulation, objective)
        peer.value_and_gradient()
    # Not ru_maxrss, which a process inherits from the one that started it.
    status = Path("/proc/self/status").read_text().splitlines()
    print(next(int(line.split()[1]) for line in status if line.startswith("VmHWM")) / 1024)


def peers(steps: int, rounds: int) -> str:
    """The same scene in libraries for automatic differentiation, in double precision."""
    problem, x = problem_of(128, steps)
    simulation = problem.simulation(x)
    objective = Objective.of(problem.scene, simulation.particles)
    value, ours = gradient_of(simulation, objective, Checkpointing())
    runs: dict[str, Run] = {
        "mpmopt forward": with_threads(2, simulation.run),
        "mpmopt": with_threads(2, lambda: gradient_of(simulation, objective, Checkpointing())),
    }
    pairs = [on_ground(128, steps) for _ in range(2)]
    lattice = pairs[0][0]
    runs |= {
        "ensemble forward": several(*(each.run for each, _ in pairs)),
        "ensemble": several(*(partial(gradient_of, *pair, KEEP_ALL) for pair in pairs)),
    }
    found = {}
    for module, package in PEERS.items():
        peer = importlib.import_module(f"peers.{module}")
        program = peer.prepare(simulation, objective)
        theirs, gradient = program.value_and_gradient()
        apart = {"objective": abs(theirs / value - 1.0)}
        for name, mine in vars(ours).items():
            if name in gradient:
                apart[name] = float(np.linalg.norm(gradient[name] - mine) / np.linalg.norm(mine))
        if apart["objective"] > VALUE_TOLERANCE or max(apart.values()) > GRADIENT_TOLERANCE:
            raise SystemExit(f"{peer.NAME} does not agree with mpmopt, so no time counts: {apart}")
        found[module] = (f"{peer.NAME} ({importlib.metadata.version(package)})", apart)
        runs[f"{module} forward"], runs[module] = program.value, program.value_and_gradient
    seconds = in_turns(runs, rounds)
    per = 1e9 / (steps * simulation.initial.shape[1])
    rows = []
    for module, (name, apart) in {"mpmopt": ("mpmopt, two threads", {}), **found}.items():
        forward, both = seconds[f"{module} forward"], seconds[module]
        rows.append(
            [
                name,
                f"{np.median(forward) * per:.0f}",
                f"{ratio(forward, seconds['mpmopt forward']):.1f}",
                f"{np.median(both) * per:.0f}",
                f"{ratio(both, seconds['mpmopt']):.1f}",
                f"{peak_memory(module, steps):.0f}",
                f"{max(apart.values()):.0e}" if apart else "",
            ]
        )
    two = 2.0 * lattice.initial.shape[1] / simulation.initial.shape[1]  # as many particles
    times = [seconds[name] / two for name in ("ensemble forward", "ensemble")]
    rows.insert(
        1,
        [
            "mpmopt, total Lagrangian on ground, two scenes side by side",
            f"{np.median(times[0]) * per:.0f}",
            f"{ratio(times[0], seconds['mpmopt forward']):.1f}",
            f"{np.median(times[1]) * per:.0f}",
            f"{ratio(times[1], seconds['mpmopt']):.1f}",
            "",
            "",
        ],
    )
    header = [
        "program", "forward ns", "times ours", "value + gradient ns", "times ours", "peak MB",
        "differs by",
    ]  # fmt: skip
    return table(f"The paper's walker, {steps} steps, double precision", header, rows)


def processor() -> str:
    """The processor's name, as far as the system tells."""
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
        return next(line.split(":")[1].strip() for line in lines if line.startswith("model name"))
    except (OSError, StopIteration):
        return platform.processor()


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, required=True, metavar="DIR", help="folder of results")
    parser.add_argument("--peers", action="store_true", help="measure Warp, Taichi and JAX too")
    parser.add_argument("--quick", action="store_true", help="fewer rounds and sizes")
    parser.add_argument("--steps", type=int, default=1000, help="time steps of the walker (1000)")
    parser.add_argument("--memory", metavar="NAME", help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.memory:
        print_peak_memory(arguments.memory, arguments.steps)
        return 0
    rounds = 3 if arguments.quick else 7
    versions = " ".join(
        f"{name} {importlib.metadata.version(name)}," for name in ("numba", "numpy", "llvmlite")
    )
    parts = [
        f"Measured on {datetime.date.today()}, {os.cpu_count()} cores of {processor()}, Python "
        f"{platform.python_version()}, {versions} medians of {rounds} rounds.\n",
        threads_and_schedules(arguments.steps, rounds),
        formulations(arguments.steps, rounds),
        sizes(arguments.quick, 3),
        sizes_on_ground(arguments.quick, 3),
        start_up(),
        f"Peak memory of one gradient at 5000 steps: {peak_memory('mpmopt', 5000):.0f} MB; in the "
        f"total Lagrangian formulation, all states kept, {peak_memory('total', 5000):.0f} MB.\n",
    ]
    if arguments.peers:
        parts.insert(1, peers(arguments.steps, rounds))
    text = "\n".join(parts)
    arguments.out.mkdir(parents=True, exist_ok=True)
    (arguments.out / "benchmark.rst").write_text(text)
    print(text)
    return 0


if __name__ == "__main__":
    sys.exit(main())
