"""Damping by the transfer to the grid and back: with the step, and with the blend of a scene.

    python cases/dissipation.py --out DIR [--quick] [--runs RUN.h5 ...]

The affine transfer damps once in every step, so that a smaller step damps more; with a `blend_time`
damping becomes a rate. Measured on four motions, each with steps that differ by a factor of eight:
the travel of the two robots drawn by hand, a spinning disc, a bar that vibrates freely, two discs
that collide; and the best designs of runs, without their void.
"""

import argparse
import csv
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import crawler
import numpy as np
import walker

from mpmopt.app.case import START
from mpmopt.assess.threshold import distance, kept
from mpmopt.design.problem import Variables
from mpmopt.results import runfile
from mpmopt.scene import Grid, Material, Scene, Solid
from mpmopt.scene.particles import Particles, discretise
from mpmopt.simulation.simulation import Simulation


def cell_time(scene: Scene) -> float:
    """How long a pressure wave takes through a cell."""
    return scene.grid.dx / scene.material.wave_speed


CELL_TIME = cell_time(walker.CASES["preview"].scene)  # blend times are scaled to other scenes'
BLEND_TIMES = (0.0, 5e-4, 1e-3, 2e-3, 4e-3, 8e-3)
HALVINGS = range(4)


def travel(case, blend_time: float, halvings: int) -> float:
    """How far a drawn robot goes in one second on the paper's walls, on 64 x 64 cells."""
    scene = replace(getattr(case, case.__name__)(64, 8e-4), blend_time=blend_time)
    scene = scene.vary(time_step=scene.time_step / 2**halvings)
    particles = discretise(scene)
    keep = case.slanted_legs(particles.position[particles.designed])
    signal = Variables(np.zeros(0), *(np.array([START[name]]) for name in ("a", "theta", "b")))
    start = distance(replace(scene, steps=1), keep, signal)
    return distance(scene, keep, signal) - start


def designed(path: Path, blend_time: float, halvings: int) -> float:
    """How far the best design of a run goes without its void."""
    run = runfile.read_run(path).run
    problem, x = run.problem(), run.result.x
    scene = replace(problem.scene.vary(time_step=8e-4 / 2**halvings), blend_time=blend_time)
    keep, signal = kept(problem, x), problem.split(x)
    first = replace(scene, steps=1, transient=0.0)
    return distance(scene, keep, signal) - distance(first, keep, signal)


def moving(scene: Scene, particles: Particles, velocity: np.ndarray, slope: np.ndarray):
    """A simulation of solid particles with velocities (2, N) and gradients of them (4, N)."""
    count, material = len(particles.position), scene.material
    state = np.zeros((12, count))
    state[0:2], state[2:4], state[4:8] = particles.position.T, velocity, slope
    state[[8, 11]] = 1.0
    ones = np.ones(count)
    return Simulation(
        scene, particles, material.density * ones, ones, np.zeros((scene.steps, 0)), state
    )  # fmt: skip


def spinning_disc(blend_time: float, halvings: int) -> float:
    """Share of the kinetic energy that a disc (R = 0.15, 10 rad/s, n = 64) has after one second."""
    dt = 8e-4 / 2**halvings
    scene = Scene(
        Grid((64, 64), 1 / 64), dt, round(1 / dt), (Solid((0.25, 0.25), (0.75, 0.75)),),
        blend_time=blend_time,
    )  # fmt: skip
    everything = discretise(scene)
    disc = everything.subset(np.hypot(*(everything.position.T - 0.5)) < 0.15)
    x, y = disc.position.T - 0.5
    velocity_increment = np.array([[0.0], [-10.0], [10.0], [0.0]])
    simulation = moving(scene, disc, 10.0 * np.array([-y, x]), velocity_increment)
    return kinetic(scene, simulation.run()) / kinetic(scene, simulation.initial)


def kinetic(scene: Scene, state: np.ndarray) -> float:
    """Energy of motion, the affine part included, over mass / 2 of a particle."""
    return float((state[2:4] ** 2).sum() + scene.grid.dx**2 / 4 * (state[4:8] ** 2).sum())


def vibrating_bar(blend_time: float, halvings: int) -> float:
    """Share of its amplitude that a free bar has after five periods.

    E = 100, rho = 1, nu = 0, half its length L = 25 with its middle at rest: v = 0.1 sin(beta x),
    beta = pi / (2 L). Exact for small amplitudes: the mean of one half goes as cos(omega t).
    """
    half, speed, E = 25.0, 0.1, 100.0
    beta = np.pi / (2 * half)
    period = 2 * np.pi / (beta * np.sqrt(E))
    dt = period / 200 / 2**halvings
    scene = Scene(
        Grid((60, 8), 1.0), dt, round(5 * period / dt), (Solid((5.0, 3.0), (55.0, 5.0)),),
        material=Material(lame_lambda=0.0, lame_mu=E / 2, density=1.0),
    )  # fmt: skip
    scene = replace(scene, blend_time=blend_time * cell_time(scene) / CELL_TIME)
    bar = discretise(scene)
    x = bar.position[:, 0] - 30.0
    velocity, slope = np.zeros((2, len(x))), np.zeros((4, len(x)))
    velocity[0], slope[0] = speed * np.sin(beta * x), speed * beta * np.cos(beta * x)
    simulation = moving(scene, bar, velocity, slope)
    last = round(period / dt)
    frames = simulation.run(range(simulation.steps - last, simulation.steps + 1, 5))
    mean = frames[:, 2, x > 0.0].mean(axis=1)
    return float(np.abs(mean).max() / velocity[0, x > 0.0].mean())


def two_discs(blend_time: float, halvings: int) -> float:
    """Kinetic energy after the collision of two discs over that before (cells of 1/20)."""
    dt = 4e-3 / 2**halvings
    E, nu = 1000.0, 0.3
    material = Material(
        E * nu / ((1 + nu) * (1 - 2 * nu)), E / (2 * (1 + nu)), density=1000.0,
    )  # fmt: skip
    scene = Scene(
        Grid((24, 24), 0.05), dt, round(3.5 / dt), (Solid((0.1, 0.1), (1.1, 1.1)),),
        material=material,
    )  # fmt: skip
    scene = replace(scene, blend_time=blend_time * cell_time(scene) / CELL_TIME)
    everything = discretise(scene)
    low, high = (np.hypot(*(everything.position.T - 0.1 - c)) < 0.2 for c in (0.2, 0.8))
    discs = everything.subset(low | high)
    side = np.where(low[low | high], 0.1, -0.1)
    simulation = moving(scene, discs, np.array([side, side]), np.zeros((4, 1)))
    return kinetic(scene, simulation.run()) / kinetic(scene, simulation.initial)


MOTIONS: dict[str, Callable[[float, int], float]] = {
    "travel of the walker": lambda tau, k: travel(walker, tau, k),
    "travel of the crawler": lambda tau, k: travel(crawler, tau, k),
    "spinning disc, energy kept": spinning_disc,
    "vibrating bar, amplitude kept": vibrating_bar,
    "two discs, energy kept": two_discs,
}


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, required=True, metavar="DIR", help="folder of results")
    parser.add_argument("--quick", action="store_true", help="three blend times, two steps")
    parser.add_argument("--runs", nargs="*", type=Path, default=[], metavar="RUN.h5")
    arguments = parser.parse_args()
    blend_times = BLEND_TIMES[::2] if arguments.quick else BLEND_TIMES
    halvings = HALVINGS[:2] if arguments.quick else HALVINGS
    motions = {
        f"travel of {path}": lambda tau, k, path=path: designed(path, tau, k)
        for path in arguments.runs
    }
    rows = []
    for name, motion in {**MOTIONS, **motions}.items():
        for blend_time in blend_times:
            began = time.process_time()
            values = np.array([motion(blend_time, k) for k in halvings])
            spread = np.ptp(values) / abs(values.mean())
            cells = [name, f"{blend_time:g}", *(f"{v:.4f}" for v in values), f"{spread:.0%}"]
            rows.append(cells)
            print(*cells, f"({time.process_time() - began:.0f} s)", sep="  ", flush=True)
    arguments.out.mkdir(parents=True, exist_ok=True)
    with (arguments.out / "dissipation.csv").open("w", newline="") as file:
        writer = csv.writer(file)
        steps = ["largest step", "half", "a quarter", "an eighth"][: len(halvings)]
        writer.writerow(["motion", "blend time (s)", *steps, "spread"])
        writer.writerows(rows)
    return 0


if __name__ == "__main__":
    sys.exit(main())
