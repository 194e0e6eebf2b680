"""Time against error: which discretisation a bar, a walker and a crawler need.

    python cases/speed_accuracy.py --out DIR [--quick] [--peers] [--scheduler ADDRESS]

Sweeps cells, Courant number, particles per cell, precision and formulation. The bar
has an exact answer; crawler and walker are designs given as functions of position, so that every
resolution sees the same robot. On walls they are compared with the finest that is affordable. On
ground with a layer there are two formulations: distances are compared with the mean of what both
tend to, extrapolated from their two finest, and gradients with the mean of the finest. Writes
``speed_accuracy.csv``, ``.h5`` and ``.png``, and the tables of the documentation, two of which have
the time at equal accuracy: there, and on fronts, a point counts with the largest error of all
shorter steps on its cells, as accuracy that is lost when the step is refined was luck (`sound`).
What ``speed_accuracy_points.h5`` holds already of the same sources is not measured again.
`--peers` adds Taichi in both precisions and Warp at the paper's setting, and what the fastest of
them would take at equal accuracy. The workers of a cluster must be alike, and each have a processor
of its own: what counts is their processor time.
"""

import argparse
import csv
import datetime
import hashlib
import importlib
import importlib.metadata
import itertools
import json
import math
import os
import subprocess
import sys
from collections.abc import Callable, Sequence
from concurrent.futures import Executor
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, Literal

import crawler
import h5py
import numpy as np
import peers
import walker
from benchmark import processor
from exact import Bar, manufactured_error
from matplotlib.artist import Artist
from matplotlib.patches import Rectangle

import mpmopt
from mpmopt.app.sweeps import connected, results, sweep
from mpmopt.assess.discretisation import Discretisation, Measured, density, measure, sums, timed
from mpmopt.design.actuation import signal_adjoint
from mpmopt.design.objective import Objective
from mpmopt.design.problem import Problem
from mpmopt.errors import MpmoptError, SceneError, SweepError
from mpmopt.scene import Design, Grid, Material, Scene
from mpmopt.scene.particles import discretise
from mpmopt.scene.scene import Formulation

BETA = 8.0
PATCH = 1 / 32  # gradients are compared as sums over squares of this width
# Heavier void than the cases have: where it is light, a few flung particles have a gradient that
# grows without limit as cells shrink, and that would be all that the chart shows.
FLOORS: dict[str, Any] = {"void_density": 1e-1, "void_stiffness": 1e-2}
C = 1 / 64  # the unit of length of both robots


def legs(distance: np.ndarray, width: float, height: float) -> np.ndarray:
    """phi from the distance to a leg's middle line: a smooth ridge of a width, +-height."""
    return height * (2.0 * np.exp(-math.log(2.0) * (2.0 * distance / width) ** 2) - 1.0)


def walker_phi(position: np.ndarray) -> np.ndarray:
    """Three legs that lean back, as in ``cases/walker.py``, with soft edges."""
    x, y = position.T
    foot = 2.5 * C * (11 * C - y) / (7 * C)
    return legs(np.min([abs(x + foot - top * C) for top in (7, 13, 19)], axis=0), 2.6 * C, 0.3)


def crawler_phi(position: np.ndarray) -> np.ndarray:
    """A spine with three pairs of legs, as in ``cases/crawler.py``, with soft edges."""
    x, y = position.T
    height = abs(y - 32 * C)
    foot = 4 * C * height / (6 * C)
    lines = [*(abs(x + foot - top * C) for top in (15, 23, 31)), height]
    return legs(np.min(lines, axis=0), 2 * C, 0.8)


# A stroke and a quarter between walls, two and a half on ground: as long as gradients have a limit.
WALLED, DURATION = 0.25, 0.5


def lasting(scene: Scene, duration: float) -> Scene:
    """The scene for another duration."""
    return replace(scene, steps=round(duration / scene.time_step))


def on_ground(scene: Scene) -> Scene:
    """A robot on ground, whose travel counts from the start."""
    material = Material(viscosity=0.02, **FLOORS)
    scene = replace(scene, transient=0.0, filter_length=0.0, material=material)
    return lasting(replace(scene, formulation="updated"), DURATION)


def walker_phi_on_ground(position: np.ndarray) -> np.ndarray:
    """The same legs; the body stands farther from the edge."""
    return walker_phi(position - np.array([walker.AHEAD, 0.0]))


# The paper's cells and step.
ROBOTS: dict[str, tuple[Scene, Callable[[np.ndarray], np.ndarray]]] = {
    "walker": (lasting(walker.walker(128, 2e-4).vary(**FLOORS), WALLED), walker_phi),
    "crawler": (lasting(crawler.crawler(128, 2e-4).vary(**FLOORS), WALLED), crawler_phi),
    "walker on ground": (
        on_ground(walker.walker_on_ground(128, 2e-4, 2.0)),
        walker_phi_on_ground,
    ),
    "crawler on ground": (on_ground(crawler.crawler_on_ground(128, 2e-4, 2.0)), crawler_phi),
}


# Standard deviation of a pass of the design filter on 64 cells. On finer ones phi is blurred by
# what a pass lacks there: from 64 cells on all have the same robot. On 32 it is another one.
BLUR = replace(ROBOTS["walker"][0], grid=Grid((64, 64), 1 / 64), time_step=4e-4).filter_spread


def blur(scene: Scene, position: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The places (25, N, 2) and weights (25, N) of phi that blur it at (N, 2), as the filter does.

    What is not designed has no weight, and what is beyond a plane of symmetry is its image.
    """
    spread = math.sqrt(max(BLUR**2 - scene.filter_spread**2, 0.0))
    steps, shares = np.polynomial.hermite_e.hermegauss(5)
    away = np.stack(np.meshgrid(steps, steps), axis=-1).reshape(-1, 1, 2)
    places = position + spread * away
    if scene.mirror is not None:
        plane, across = scene.mirror, places[..., scene.mirror.normal]
        side = np.sign(position[0, plane.normal] - plane.position)
        places[..., plane.normal] = plane.position + side * abs(across - plane.position)
    weights = np.outer(shares, shares).reshape(-1, 1) * np.any(
        [
            np.all((part.lower <= places) & (places <= part.upper), axis=-1)
            for part in scene.body
            if isinstance(part, Design)
        ],
        axis=0,
    )
    return places, weights / weights.sum(axis=0)


def design(phi: Callable[[np.ndarray], np.ndarray]) -> Callable[[Problem], np.ndarray]:
    """A robot's variables in any problem, driven as at the start of an optimisation."""

    def variables(problem: Problem) -> np.ndarray:
        position = problem.particles.position[problem.particles.designed]
        places, weights = blur(problem.scene, position)
        values = phi(places.reshape(-1, 2)).reshape(weights.shape)
        return problem.join((weights * values).sum(axis=0), a=1.0, theta=-0.3, b=-0.5)

    return variables


def in_patches(scene: Scene, gradient: np.ndarray) -> np.ndarray:
    """A `density` in cells as one in squares of `PATCH`, of phi before it was blurred."""
    nx, ny = scene.grid.cells
    used = np.flatnonzero(gradient[: nx * ny])
    centres = scene.grid.dx * (np.stack(np.divmod(used, ny), axis=1) + 0.5)
    places, weights = blur(scene, centres)
    before = sums(scene, places, weights * gradient[used], PATCH)
    return np.concatenate([before, gradient[nx * ny :]])


@dataclass(frozen=True)
class Choice:
    """What is chosen besides cells and step: one marker of the figure."""

    name: str
    marker: str
    per_cell: int = 2
    precision: Literal["double", "single"] = "double"
    formulation: Formulation = "updated"


PLAIN = Choice("2 x 2 a cell, double", "o")
MORE_PARTICLES = Choice("3 x 3 a cell", "s", per_cell=3)
SINGLE = Choice("single precision", "^", precision="single")
TOTAL = Choice("total Lagrangian", "D", formulation="total")
SWEPT = (PLAIN.name, TOTAL.name)  # over cells and Courant numbers
FORMULATIONS: tuple[Formulation, ...] = ("updated", "total")
PEERS = {
    "Taichi, double": ("taichi_mpm", "taichi", "*"),
    "Taichi, single": ("taichi_mpm", "taichi", "h"),
    "Warp, double": ("warp_mpm", "warp-lang", "p"),
}


@dataclass(frozen=True)
class Point:
    """One marker: a scene in one discretisation, and its errors.

    Attributes
    ----------
    scene : str
    n : int
        Cells along the unit square, or along the bar.
    steps : int
    courant : float
    choice : str
    measured : Measured
    distance_ratio : float
        Distance over the reference's.
    distance_error, gradient_error : float
        Relative to the reference.
    angle : float
        Between the gradients, in degrees.
    """

    scene: str
    n: int
    steps: int
    courant: float
    choice: str
    measured: Measured
    distance_ratio: float = math.nan
    distance_error: float = math.nan
    gradient_error: float = math.nan
    angle: float = math.nan

    @property
    def formulation(self) -> Formulation:
        return self.measured.discretisation.formulation

    def against(self, reference: Measured) -> "Point":
        """The same with its errors."""
        distance, gradient, angle = self.measured.errors(reference)
        return replace(
            self,
            distance_ratio=self.measured.distance / reference.distance,
            distance_error=distance,
            gradient_error=gradient,
            angle=angle,
        )

    def row(self) -> dict[str, str]:
        """One line of the CSV file."""
        measured = self.measured
        return {
            "scene": self.scene, "choice": self.choice, "n": str(self.n),
            "steps": str(self.steps), "Courant": f"{self.courant:.3g}",
            "seconds": f"{measured.seconds:.3g}", "MB": f"{measured.megabytes:.3g}",
            "distance": f"{measured.distance:.6g}", "distance error": f"{self.distance_error:.2e}",
            "gradient norm": f"{np.linalg.norm(measured.gradient):.4g}",
            "gradient error": f"{self.gradient_error:.2e}", "angle": f"{self.angle:.1f}",
            "failure": measured.failure,
        }  # fmt: skip


def settings(quick: bool) -> list[tuple[int, float, Choice]]:
    """Cells, Courant number and choice of all points."""
    smallest = {32: 0.1, 64: 0.1} if quick else {32: 0.05, 64: 0.05, 128: 0.1, 256: 0.2}
    points = [
        (n, courant, PLAIN)
        for n, least in smallest.items()
        for courant in COURANTS
        if courant >= least
    ]
    others = (MORE_PARTICLES, SINGLE)
    points += [(n, 0.4, choice) for n in smallest if 32 < n < 256 for choice in others]
    points += [(n, LEAST, MORE_PARTICLES) for n in smallest if 32 < n < 256]
    if not quick:
        points.append(PAPER)
        points += [(n, 0.8, SINGLE) for n in (64, 128, 256)]
    points += [(n, courant, TOTAL) for n, courant, choice in points if choice is PLAIN]
    return points


COURANTS = (0.05, 0.1, 0.2, 0.3, 0.4, 0.6, 0.8)
LEAST = 0.2  # that all cells are measured with: down to it a step is refined (`sound`)
PAPER = (128, ROBOTS["walker"][0].courant, PLAIN)
RECOMMENDED = (128, 0.6, PLAIN)
# On walls the reference is at the Courant number of the recommended setting.
REFERENCE, QUICK_REFERENCE = (384, 0.6, PLAIN), (128, 0.6, PLAIN)
# On ground it is extrapolated from two, at a Courant number that viscosity bears on the finest in
# both formulations.
LIMITS, QUICK_LIMITS, LIMIT_COURANT = (128, 256, 384), (32, 64, 128), 0.2
ORDER = 2  # of both formulations on ground, in cells and step together


def is_possible(name: str, n: int, courant: float, choice: Choice) -> bool:
    """Whether a scene can be laid out so: on fine cells viscosity shortens the step.

    In the total Lagrangian formulation steps are shorter still, and there are no walls.
    """
    try:
        if name == "bar":
            Bar(n, courant, formulation=choice.formulation)
        else:
            laid_out(ROBOTS[name][0], n, courant, choice).scene(ROBOTS[name][0])
    except SceneError:
        return False
    return True


def laid_out(scene: Scene, n: int, courant: float, choice: Choice) -> Discretisation:
    """A robot's scene with n cells along a unit of length."""
    return Discretisation.of(
        scene, n / scene.grid.cells[1], courant, particles_per_cell=choice.per_cell,
        precision=choice.precision, formulation=choice.formulation,
    )  # fmt: skip


def nearest_possible(name: str, point: tuple[int, float, Choice]) -> tuple[int, float, Choice]:
    """The same with the next Courant number below that a scene allows."""
    n, courant, choice = point
    allowed = (c for c in COURANTS[::-1] if c <= courant and is_possible(name, n, c, choice))
    return n, next(allowed), choice


def measure_bar(n: int, courant: float, choice: Choice) -> Measured:
    """The bar in one discretisation."""
    bar = Bar(
        n, courant, choice.per_cell, precision=choice.precision, formulation=choice.formulation
    )  # fmt: skip
    scene = bar.simulation.scene
    here = replace(Discretisation.of(scene), precision=choice.precision)
    try:
        bar.value_and_gradient()  # kernels are compiled then
        (distance, gradient), seconds = timed(bar.value_and_gradient)
    except MpmoptError as error:
        return Measured(here, failure=str(error))
    return Measured(here, seconds, math.nan, distance, gradient)


def measure_robot(name: str, scene: Scene, n: int, courant: float, choice: Choice) -> Measured:
    """A robot in one discretisation."""
    _, phi = ROBOTS[name]
    laid = laid_out(scene, n, courant, choice)
    measured = measure(scene, laid, design(phi), BETA, 1 / n, repeats=2 if n < 256 else 1)
    if measured.failure:
        return measured
    return replace(measured, gradient=in_patches(laid.scene(scene), measured.gradient))


def sources() -> str:
    """A digest of what numbers depend on: the package's files and those of the cases."""
    digest = hashlib.sha256()
    for folder in (Path(mpmopt.__file__).parent, Path(__file__).parent):
        for path in sorted(folder.rglob("*.py")):
            name = path.relative_to(folder).as_posix().encode()
            digest.update(name + b"\0" + path.read_bytes() + b"\0")
    return digest.hexdigest()[:20]


def measure_point(
    name: str, scene: str, n: int, courant: float, choice: dict[str, Any], program: str
) -> dict[str, Any]:
    """The bar, or a robot of a scene, in one discretisation; the fewer seconds of two count.

    The first evaluation takes its memory from the system, which can cost as much again; an
    optimiser pays that once. A worker whose `sources` are not those of the program refuses.
    """
    if sources() != program:
        raise SweepError("this worker has other sources than the program that asks it")
    measured = (
        measure_bar(n, courant, Choice(**choice))
        if name == "bar"
        else measure_robot(name, Scene.from_json(scene), n, courant, Choice(**choice))
    )
    return {
        "steps": measured.discretisation.steps, "seconds": measured.seconds,
        "megabytes": measured.megabytes, "distance": measured.distance,
        "gradient": measured.gradient, "failure": measured.failure,
    }  # fmt: skip


@dataclass(frozen=True)
class Bench:
    """Where points are measured and kept.

    Attributes
    ----------
    store : Path
    executor : Executor or None
        None: one process of this machine, as two at a time would slow each other down.
    """

    store: Path
    executor: Executor | None = None

    def measure(
        self,
        points: Sequence[tuple[str, int, float, Choice]],
        scenes: Sequence[Scene] | None = None,
    ) -> list[Measured]:
        """All points, once, in the robots' own scenes or in others."""
        if scenes is None:
            bar = Bar(32, 0.4).simulation.scene
            scenes = [bar if name == "bar" else ROBOTS[name][0] for name, *_ in points]
        program = sources()
        wanted = [
            {"name": name, "scene": scene.to_json(), "n": n, "courant": courant,
             "choice": asdict(choice), "program": program}
            for (name, n, courant, choice), scene in zip(points, scenes, strict=True)
        ]  # fmt: skip
        outcomes = sweep(measure_point, wanted, self.store, self.executor, workers=1)
        return [
            Measured(
                Discretisation((n, n), row.pop("steps"), formulation=choice.formulation), **row
            )
            for (_, n, _, choice), row in zip(points, results(outcomes), strict=True)
        ]

    def run(self, points: Sequence[tuple[str, int, float, Choice]]) -> list[Point]:
        """Measure all points."""
        best = self.measure(points)
        return [
            Point(name, n, measured.discretisation.steps, courant, choice.name, measured)
            for (name, n, courant, choice), measured in zip(points, best, strict=True)
        ]


def sound(points: Sequence[Point]) -> list[Point]:
    """The points as they count: each error the largest of all shorter steps on the same cells.

    Of the same scene, formulation, particles a cell and precision; for single precision double
    speaks too. Accuracy that is lost when the step is refined was luck: errors of cells and step
    cancel, and nobody knows beforehand at which step. The step is refined to `LEAST`, so that all
    cells are judged alike; points with shorter ones, which none speaks for, are left out.
    """
    shared = [p for p in points if p.courant >= LEAST]

    def worst(point: Point, error: str) -> float:
        like = {point.choice, PLAIN.name if point.choice == SINGLE.name else point.choice}
        errors = [
            getattr(p, error)
            for p in shared
            if (p.scene, p.n) == (point.scene, point.n)
            and p.choice in like
            and p.steps > point.steps
        ]
        own: float = getattr(point, error)
        # A shorter step that fails has lost all.
        return own if math.isnan(own) else max([own, *(math.inf if e != e else e for e in errors)])

    return [
        replace(
            point,
            distance_error=worst(point, "distance_error"),
            gradient_error=worst(point, "gradient_error"),
            angle=worst(point, "angle"),
        )
        for point in shared
    ]


def front(points: Sequence[Point], error: str) -> list[Point]:
    """The points that nothing is both faster and more accurate than, by seconds, as they count."""
    best: list[Point] = []
    usable = [
        p for p in sound(points) if math.isfinite(getattr(p, error)) and p.measured.seconds > 0.0
    ]
    for point in sorted(usable, key=lambda p: (p.measured.seconds, getattr(p, error))):
        # Peers agree to rounding, which is no gain.
        if not best or getattr(point, error) < (1.0 - 1e-6) * getattr(best[-1], error):
            best.append(point)
    return best


def peer_point(name: str, robot: str) -> Point:
    """A peer at the paper's setting, in a process of its own."""
    done = subprocess.run(
        [sys.executable, __file__, "--out", ".", "--peer", name, "--robot", robot],
        capture_output=True, text=True, check=False,
    )  # fmt: skip
    if done.returncode:
        raise SystemExit(f"{name} failed:\n{done.stderr[-2000:]}")
    result = json.loads(done.stdout.splitlines()[-1])
    scene = ROBOTS[robot][0]
    gradient = np.array(result["gradient"])
    measured = Measured(
        Discretisation.of(scene), result["seconds"], result["megabytes"], result["distance"],
        gradient, "" if np.all(np.isfinite(gradient)) else "its gradient is not a number",
    )  # fmt: skip
    print(f"{robot}, {name}: {measured.seconds:.2f} s", file=sys.stderr, flush=True)
    return Point(robot, PAPER[0], scene.steps, scene.courant, name, measured)


def print_peer(name: str, robot: str) -> None:
    """In the process that `peer_point` starts; peers know no plane of symmetry."""
    module, _, _ = PEERS[name]
    peer = importlib.import_module(f"peers.{module}")
    if "single" in name:
        vars(peer)["real"] = vars(peer)["ti"].f32
    scene, phi = ROBOTS[robot]
    plane, scene = scene.mirror, replace(scene, mirror=None)
    problem = Problem(scene, BETA)
    x = design(phi)(problem)
    simulation = problem.simulation(x)
    objective = Objective.of(problem.scene, simulation.particles)
    program = peer.prepare(simulation, objective)
    program.value_and_gradient()
    (value, bars), seconds = timed(program.value_and_gradient, 3)
    variables = problem.split(x)
    density_bar, lambda_bar, mu_bar = (
        np.asarray(bars[key], float) for key in ("density", "lame_lambda", "lame_mu")
    )
    stiffness_bar = peers.stiffness_bar(simulation, lambda_bar, mu_bar)
    phi_bar = problem.chain.field(variables.phi).pullback(density_bar, stiffness_bar)
    signal = signal_adjoint(scene, variables.a, variables.theta, np.asarray(bars["signal"], float))
    gradient = np.concatenate([phi_bar, *signal])
    status = Path("/proc/self/status").read_text().splitlines()
    print(
        json.dumps(
            {
                "seconds": seconds,
                "megabytes": next(int(s.split()[1]) for s in status if s.startswith("VmHWM"))
                / 1024,
                "distance": value - objective.start,
                "gradient": in_patches(
                    ROBOTS[robot][0], density(problem, gradient, scene.grid.dx, plane)
                ).tolist(),
            }
        )
    )


def horizons(bench: Bench) -> list[dict[str, str]]:
    """How the gradient's error grows with the simulated time: n = 64 and 128 against 256."""
    finest = {
        (name, formulation): nearest_possible(
            name,
            (
                256,
                LIMIT_COURANT if ROBOTS[name][0].ground else REFERENCE[1],
                PLAIN if formulation == "updated" else TOTAL,
            ),
        )
        for name, formulation in robots()
    }
    where = [(robot, duration) for robot in finest for duration in (0.25, 0.5, 1.0)]
    cells = (64, 128, 256)
    measured = iter(
        bench.measure(
            [(robot[0], n, *finest[robot][1:]) for robot, _ in where for n in cells],
            [lasting(ROBOTS[robot[0]][0], duration) for robot, duration in where for _ in cells],
        )
    )
    rows = []
    for (name, formulation), duration in where:
        coarse, middle, fine = (next(measured) for _ in cells)
        row = {
            "robot": name, "formulation": formulation, "seconds simulated": f"{duration:g}",
        }  # fmt: skip
        for n, one in ((64, coarse), (128, middle)):
            distance, gradient, angle = one.errors(fine)
            row[f"distance, n = {n}"] = f"{distance:.0%}"
            row[f"gradient, n = {n}"] = f"{gradient:.0%}, {angle:.0f} deg"
        rows.append(row)
    return rows


def manufactured() -> list[dict[str, str]]:
    """The manufactured solution's error and its order."""
    rows: list[dict[str, str]] = []
    last = math.nan
    for n in (8, 16, 32, 64):
        error = manufactured_error(n, 1e-3)
        order = "" if math.isnan(last) else f"{math.log2(last / error):.2f}"
        rows.append({"n": str(n), "rms error / amplitude": f"{error:.2e}", "order": order})
        last = error
    return rows


def distances(points: Sequence[Point]) -> list[dict[str, str]]:
    """Distance by step, over the reference's: one line for each robot, formulation and n."""
    rows = []
    for name, formulation in robots():
        for n in sorted({p.n for p in points}):
            line = {
                p.courant: p.distance_ratio
                for p in points
                if (p.scene, p.formulation, p.n) == (name, formulation, n)
                and p.choice in SWEPT
                and not p.measured.failure
            }
            if not line:
                continue
            row = {"robot": name, "formulation": formulation, "n": str(n)}
            for courant in COURANTS:
                row[f"{courant:g}"] = f"{line[courant]:.3f}" if courant in line else ""
            rows.append(row)
    return rows


def robots() -> list[tuple[str, Formulation]]:
    """Robots, in all formulations that their scenes allow."""
    return [
        (name, formulation)
        for name, (scene, _) in ROBOTS.items()
        for formulation in FORMULATIONS
        if formulation == "updated" or not scene.walls
    ]


ERRORS = {"distance": "distance_error", "gradient": "gradient_error"}
LEVELS = (0.2, 0.15, 0.1, 0.05, 0.02, 0.01, 0.005, 0.001)


@dataclass(frozen=True)
class Cost:
    """What an error costs, on a line of points that differ in cells alone.

    Attributes
    ----------
    coarse : Point or None
        The finest that is off by more; None if there is none.
    fine : Point
        The next finer one.
    share : float
        Of the way between them, in logarithms, at which the error is as wanted.
    """

    coarse: Point | None
    fine: Point
    share: float = 1.0

    def __str__(self) -> str:
        cells = f"{self.coarse.n} to {self.fine.n}" if self.coarse else f"{self.fine.n}"
        return f"n = {cells}, Courant {self.fine.courant:g}, {self.fine.choice}"

    def between(self, number: Callable[[Point], float]) -> float:
        """A number of points there: a power of the error, as of both ends."""
        if self.coarse is None:
            return number(self.fine)
        return float(number(self.coarse) ** (1.0 - self.share) * number(self.fine) ** self.share)

    @property
    def seconds(self) -> float:
        return self.between(lambda point: point.measured.seconds)


def cost(points: Sequence[Point], level: float, error: str = "distance_error") -> Cost | None:
    """The least that some points take to be off by at most so much, and not by chance.

    With all shorter steps (`sound`), and with all finer cells, as in `discretisation.cheapest`, up
    to the finest of all: a step that these do not bear shows by nothing that it is right. Between
    two numbers of cells errors and costs are taken as powers of the cells, so that none is favoured
    by the cells that were chosen.
    """
    lines: dict[tuple[float, str], list[Point]] = {}
    for point in sorted(sound(points), key=lambda p: p.n):
        if point.choice not in PEERS and point.measured.seconds > 0.0:
            lines.setdefault((point.courant, point.choice), []).append(point)
    found = []
    finest = max((line[-1].n for line in lines.values()), default=0)
    for line in (each for each in lines.values() if each[-1].n == finest):
        errors = [getattr(point, error) for point in line]
        first = len(line)
        while first > 0 and errors[first - 1] <= level:
            first -= 1
        if first == len(line):
            continue
        if first == 0 or math.isinf(errors[first - 1]):
            found.append(Cost(None, line[first]))
        else:
            above, below = errors[first - 1], max(errors[first], 1e-12)
            share = math.log(above / level) / math.log(above / below)
            found.append(Cost(line[first - 1], line[first], share))
    return min(found, key=lambda each: each.seconds, default=None)


def of(points: Sequence[Point], scene: str, formulation: Formulation) -> list[Point]:
    """Those of a scene in a formulation."""
    return [p for p in points if (p.scene, p.formulation) == (scene, formulation)]


def at_equal_accuracy(
    points: Sequence[Point], apart: dict[str, tuple[float, float]]
) -> list[dict[str, str]]:
    """What a distance and a gradient cost in both formulations, to accuracies that are known."""
    rows = []
    for name, known in apart.items():
        for (what, error), least in zip(ERRORS.items(), known):
            for level in LEVELS:
                if level < least:
                    break
                row = {"scene": name, "of the": what, "off by at most": f"{100.0 * level:g} %"}
                found = {}
                for formulation in FORMULATIONS:
                    best = cost(of(points, name, formulation), level, error)
                    found[formulation] = best.seconds if best else math.nan
                    row[formulation] = f"{best}" if best else "none"
                    row[f"{formulation}, s"] = f"{found[formulation]:.3g}" if best else ""
                times = found["updated"] / found["total"]
                row["times"] = f"{times:.1f}" if math.isfinite(times) else ""
                row["known to"] = f"{least:.2%}"
                if any(map(math.isfinite, found.values())):
                    rows.append(row)
    return without_repeats(rows, ("scene", "of the", "updated, s", "total, s"))


def without_repeats(rows: list[dict[str, str]], names: Sequence[str]) -> list[dict[str, str]]:
    """Those whose next one differs: of several errors that cost the same only the least is told."""
    last = [[row[name] for name in names] for row in rows[1:]]
    return [
        row
        for row, after in itertools.zip_longest(rows, last)
        if after != [row[name] for name in names]
    ]


def particles(point: Point) -> int:
    """Of the whole body: peers know no plane of symmetry."""
    if point.scene == "bar":
        return Bar(point.n, point.courant).simulation.initial.shape[1]
    scene = laid_out(ROBOTS[point.scene][0], point.n, point.courant, PLAIN)
    return len(discretise(replace(scene.scene(ROBOTS[point.scene][0]), mirror=None)).position)


def against_peers(
    points: Sequence[Point], apart: dict[str, tuple[float, float]]
) -> list[dict[str, str]]:
    """How many times as long as ours in total Lagrangian the fastest peer takes at equal accuracy.

    Peers do MLS-MPM and compute our numbers to 1e-13, so they need the cells and steps that ours
    needs in double precision. What they take for a particle and step is that of the walker on
    walls, as they know no ground with a layer. All is processor time: what counts where every
    processor has a scene of its own.
    """
    pace = {
        p.choice: p.measured.seconds / (particles(p) * p.steps)
        for p in points
        if p.scene == "walker" and p.choice in PEERS and "double" in p.choice
    }
    fastest = min(pace, key=lambda choice: pace[choice])
    rows = []
    for name, (least, _) in apart.items():
        mine = [p for p in points if p.scene == name and p.choice in SWEPT]
        for level in (level for level in LEVELS if level >= least):
            updated, total = (cost(of(mine, name, which), level) for which in FORMULATIONS)
            if not (updated and total):
                continue
            count = updated.between(lambda point: particles(point) * point.steps)
            times = count * pace[fastest] / total.seconds
            rows.append(
                {
                    "scene": name, "off by at most": f"{100.0 * level:g} %",
                    "total": f"{total}", "s": f"{total.seconds:.3g}", "MLS-MPM": f"{updated}",
                    "particles x steps": f"{count:.3g}", "fastest peer": fastest,
                    "its s": f"{count * pace[fastest]:.3g}", "times": f"{times:.1f}",
                }
            )  # fmt: skip
    return without_repeats(rows, ("scene", "s", "particles x steps"))


def write_csv(path: Path, rows: Sequence[dict[str, str]]) -> None:
    """A table with a header."""
    with path.open("w", newline="") as file:
        writer = csv.DictWriter(file, list(rows[0]) if rows else [], lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)


def machine() -> str:
    """Where and when."""
    versions = ", ".join(
        f"{name} {importlib.metadata.version(name)}" for name in ("numba", "numpy")
    )
    return f"{datetime.date.today()}, one thread of {processor()}, {versions}"


def write_h5(
    path: Path, points: Sequence[Point], references: dict[tuple[str, Formulation], Measured]
) -> None:
    """All numbers, and the gradients as densities: a group for each scene and formulation."""
    with h5py.File(path, "w") as file:
        file.attrs["machine"] = machine()
        for (name, formulation), reference in references.items():
            mine = [p for p in points if (p.scene, p.formulation) == (name, formulation)]
            group = file.create_group(f"{name}, {formulation}")
            group.attrs["reference distance"] = reference.distance
            group.create_dataset("reference gradient", data=reference.gradient)
            columns = {
                "n": [p.n for p in mine], "steps": [p.steps for p in mine],
                "courant": [p.courant for p in mine],
                "seconds": [p.measured.seconds for p in mine],
                "megabytes": [p.measured.megabytes for p in mine],
                "distance": [p.measured.distance for p in mine],
                "distance_error": [p.distance_error for p in mine],
                "gradient_error": [p.gradient_error for p in mine],
                "angle": [p.angle for p in mine],
            }  # fmt: skip
            for key, values in columns.items():
                group.create_dataset(key, data=np.array(values))
            group.create_dataset("choice", data=[p.choice for p in mine], dtype=h5py.string_dtype())
            empty = np.full_like(reference.gradient, np.nan)
            gradients = [p.measured.gradient if p.measured.gradient.size else empty for p in mine]
            group.create_dataset("gradient", data=np.array(gradients))


STYLES = {PLAIN.name: "-", TOTAL.name: ":"}
COLOURS = {32: "#9e9e9e", 64: "#1f77b4", 128: "#e07b00", 256: "#2a9d3a"}
TITLES = {
    "bar": "(a) vibrating bar, against the exact answer",
    "walker": "(b) walker on walls",
    "crawler": "(c) crawler on walls",
    "walker on ground": "(d) walker on ground, viscous",
    "crawler on ground": "(e) crawler on ground, viscous",
}


def draw(path: Path, points: Sequence[Point], known: dict[str, tuple[float, float]]) -> None:
    """The chart.

    Parameters
    ----------
    path : Path
    points : sequence of Point
    known : mapping of str to (float, float)
        By scene, how well its reference is known: distance and gradient.
    """
    import matplotlib

    matplotlib.use("agg")
    from matplotlib import pyplot as plt
    from matplotlib.lines import Line2D

    markers = {c.name: c.marker for c in (PLAIN, TOTAL, MORE_PARTICLES, SINGLE)}
    markers.update({name: marker for name, (_, _, marker) in PEERS.items()})
    figure, axes = plt.subplots(3, len(TITLES), figsize=(4.9 * len(TITLES), 14.5))
    for column, (name, title) in enumerate(TITLES.items()):
        mine = [p for p in points if p.scene == name]
        for row, (error, what) in enumerate(
            (
                ("distance_error", "error of the distance"),
                ("gradient_error", "error of the gradient"),
            )
        ):
            ax = axes[row, column]
            _scatter(ax, mine, error, markers, known[name][row])
            ax.set_title(title if row == 0 else "")
            ax.set_xlabel("processor time of a value and gradient")
            ax.set_ylabel(what)
        _steps(axes[2, column], mine)
    choices = [name for name in markers if any(p.choice == name for p in points)]
    handles: list[Artist] = [
        Line2D([], [], marker="o", ls="", color=COLOURS[n], label=f"n = {n}")
        for n in sorted({p.n for p in points})
    ]
    handles += [
        Line2D([], [], marker=markers[name], ls="", mfc="none", mec="#333333", label=name)
        for name in choices
    ]
    handles += [
        Line2D([], [], color="black", lw=1.2, drawstyle="steps-post", label="Pareto front"),
        Rectangle((0, 0), 1, 1, color="#e8e8e8", label="less than the reference knows"),
    ]
    figure.legend(handles=handles, loc="lower center", ncols=6, frameon=False)
    figure.subplots_adjust(0.05, 0.1, 0.985, 0.97, wspace=0.24, hspace=0.22)
    figure.savefig(path, dpi=110)
    plt.close(figure)


def _scatter(
    ax, points: Sequence[Point], error: str, markers: dict[str, str], known: float
) -> None:
    """Time against one error, with the Pareto front and the named settings."""
    from matplotlib.ticker import LogLocator, NullFormatter

    ax.loglog()
    for n, colour in COLOURS.items():
        for name, style in STYLES.items():
            line = sorted(
                (p for p in points if p.n == n and p.choice == name), key=lambda p: p.courant
            )
            where = [(p.measured.seconds, getattr(p, error)) for p in line]
            line_of = zip(*where) if where else ([], [])
            ax.plot(*line_of, style, color=colour, lw=0.8, alpha=0.6, zorder=1)
    for p in points:
        big = p.choice in PEERS
        ax.plot(
            p.measured.seconds, getattr(p, error), markers[p.choice], ms=11 if big else 7,
            mfc=COLOURS[p.n] if p.choice in SWEPT or big else "white", mec=COLOURS[p.n],
            mew=1.3, zorder=4 if big else 3,
        )  # fmt: skip
    best = front(points, error)
    ax.plot(
        [p.measured.seconds for p in best], [getattr(p, error) for p in best],
        color="black", lw=1.2, drawstyle="steps-post", zorder=2,
    )  # fmt: skip
    low, high = ax.get_ylim()
    if known > low:
        ax.axhspan(low, known, color="#e8e8e8", zorder=0)
        ax.set_ylim(low, high)
    for label, (n, courant, choice), place in (
        ("paper's setting", PAPER, (0.62, 0.95)),
        ("recommended", RECOMMENDED, (0.05, 0.06)),
    ):
        for p in points:
            if (p.n, p.courant, p.choice) == (n, courant, choice.name):
                at = p.measured.seconds, getattr(p, error)
                ax.plot(*at, "o", ms=15, mfc="none", mec="crimson", mew=1.6, zorder=5)
                ax.annotate(
                    f"{label}:\nn = {n}, Courant {courant:.2g}", at, xycoords="data",
                    xytext=place, textcoords="axes fraction", color="crimson", fontsize=9,
                    va="top" if place[1] > 0.5 else "bottom",
                    arrowprops={"arrowstyle": "-", "color": "crimson", "lw": 0.8, "shrinkB": 7},
                    bbox={"fc": "white", "ec": "none", "alpha": 0.8, "pad": 1}, zorder=6,
                )  # fmt: skip
    low, high = ax.get_ylim()
    subs = (1.0, 2.0, 5.0) if high > 10.0 * low else (1.0, 1.5, 2.0, 3.0, 4.0, 5.0, 6.0, 8.0)
    ax.xaxis.set_major_locator(LogLocator(subs=(1.0, 3.0), numticks=20))
    ax.yaxis.set_major_locator(LogLocator(subs=subs, numticks=20))
    ax.xaxis.set_major_formatter(lambda seconds, _: f"{seconds:g} s")
    ax.yaxis.set_major_formatter(lambda share, _: f"{100.0 * share:.3g} %")
    for axis in (ax.xaxis, ax.yaxis):
        axis.set_minor_formatter(NullFormatter())
    ax.grid(True, which="major", alpha=0.3)


def _steps(ax, points: Sequence[Point]) -> None:
    """Distance by Courant number, the reference's being one."""
    for n, colour in COLOURS.items():
        for choice, style in STYLES.items():
            line = sorted(
                (p.courant, p.distance_ratio) for p in points if (p.n, p.choice) == (n, choice)
            )
            mark = "o" if choice == PLAIN.name else "D"
            ax.plot(*zip(*line) if line else ([], []), style + mark, color=colour, ms=5, lw=1.2)
    ax.axhline(1.0, color="black", lw=0.8)
    ax.set_xscale("log")
    ax.set_xticks(COURANTS, [f"{c:g}" for c in COURANTS])
    ax.minorticks_off()
    ax.set_xlabel("Courant number")
    ax.set_ylabel("distance, relative to the reference")
    ax.grid(True, alpha=0.3)


def main(argv: Sequence[str] | None = None) -> int:
    """Measure, and write tables and figure."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, required=True, metavar="DIR", help="folder of results")
    parser.add_argument("--quick", action="store_true", help="fewer cells and steps")
    parser.add_argument("--peers", action="store_true", help="Taichi and Warp too")
    parser.add_argument("--scheduler", metavar="ADDRESS", help="measure on this Dask cluster")
    parser.add_argument("--peer", choices=list(PEERS), help=argparse.SUPPRESS)
    parser.add_argument("--robot", choices=list(ROBOTS), help=argparse.SUPPRESS)
    arguments = parser.parse_args(argv)
    if arguments.peer:
        print_peer(arguments.peer, arguments.robot)
        return 0
    arguments.out.mkdir(parents=True, exist_ok=True)
    os.environ.setdefault("MPMOPT_THREADS", "1")
    try:
        with connected(arguments.scheduler) as executor:
            bench = Bench(arguments.out / "speed_accuracy_points.h5", executor)
            chart(arguments.out / "speed_accuracy", bench, arguments.quick, arguments.peers)
    except MpmoptError as error:
        print(f"{type(error).__name__}: {error}", file=sys.stderr)
        return 1
    return 0


def chart(path: Path, bench: Bench, quick: bool, peers: bool) -> None:
    """Measure all points, and write tables and figure to names that begin with a path."""
    wanted = settings(quick)
    finest = QUICK_REFERENCE if quick else REFERENCE
    points = bench.run(
        [(name, *point) for name in TITLES for point in wanted if is_possible(name, *point)]
    )
    references: dict[tuple[str, Formulation], Measured] = {
        ("bar", "updated"): exact_bar(), ("bar", "total"): exact_bar(),
    }  # fmt: skip
    known = {"bar": (0.0, 0.0)}  # how far a reference may be off: distance and gradient
    walled = [name for name, (scene, _) in ROBOTS.items() if not scene.ground]
    for name in walled:
        at = nearest_possible(name, finest)
        (references[name, "updated"],) = bench.measure([(name, *at)])
        same = [p for p in points if (p.scene, p.choice) == (name, PLAIN.name)]
        next_best = min(same, key=lambda p: (-p.n, abs(p.courant - at[1])))
        known[name] = next_best.measured.errors(references[name, "updated"])[:2]
    tends = limits(bench, quick)
    for name in dict.fromkeys(name for name, _ in tends):
        both = [tends[name, which].extrapolated for which in FORMULATIONS]
        references[name, "updated"] = references[name, "total"] = mean(*both)
        apart, *_ = both[0].errors(mean(*both))
        known[name] = (
            max(apart, *(tends[name, which].distance_left for which in FORMULATIONS)),
            max(tends[name, which].gradient_left for which in FORMULATIONS),
        )
    if peers:  # they know walls
        points += [peer_point(name, robot) for robot in walled for name in PEERS]
    points = [p.against(references[p.scene, p.formulation]) for p in points]
    write_csv(Path(f"{path}.csv"), [p.row() for p in points])
    write_csv(Path(f"{path}_distance.csv"), distances(points))
    fronts = [
        p
        for name in TITLES
        for p in front([q for q in points if q.scene == name], "distance_error")
    ]
    write_csv(Path(f"{path}_front.csv"), [p.row() for p in fronts])
    on_both = {name: known[name] for name in known if name not in walled}
    write_csv(Path(f"{path}_equal.csv"), at_equal_accuracy(points, on_both))
    write_csv(Path(f"{path}_limits.csv"), [tends[each].row(references[each]) for each in tends])
    if peers:
        write_csv(Path(f"{path}_peers.csv"), against_peers(points, on_both))
    if not quick:
        write_csv(Path(f"{path}_horizon.csv"), horizons(bench))
        write_csv(Path(f"{path}_manufactured.csv"), manufactured())
    write_h5(Path(f"{path}.h5"), points, references)
    draw(Path(f"{path}.png"), points, known)
    print(machine())
    for scene, (distance, gradient) in known.items():
        print(f"{scene}: distance known to {distance:.2%}, gradient to {gradient:.1%}")


@dataclass(frozen=True)
class Limit:
    """What a robot on ground tends to in one formulation.

    Attributes
    ----------
    scene : str
    formulation : "updated" or "total"
    courant : float
    cells : tuple of int
        Three, the finest last.
    measured : tuple of Measured
        With these cells.
    """

    scene: str
    formulation: Formulation
    courant: float
    cells: tuple[int, ...]
    measured: tuple[Measured, ...]

    @property
    def extrapolated(self) -> Measured:
        """The finest, with the distance that it and the next tend to (Richardson 1911)."""
        _, middle, fine = self.measured
        return replace(
            fine, distance=fine.distance + self._left * (fine.distance - middle.distance)
        )

    @property
    def distance_left(self) -> float:
        """How far the finest distance is from where it tends to, as a share.

        No limit is known better than that: the order may not be reached yet.
        """
        return abs(self.measured[-1].distance / self.extrapolated.distance - 1.0)

    @property
    def gradient_left(self) -> float:
        """About how far the finest gradient is from where it tends to, as a share."""
        _, middle, fine = self.measured
        return self._left * middle.errors(fine)[1]

    @property
    def _left(self) -> float:
        """What the next step of an error that falls with `ORDER` is of the last one."""
        return 1.0 / ((self.cells[-1] / self.cells[-2]) ** ORDER - 1.0)

    def row(self, reference: Measured) -> dict[str, str]:
        """One line of the table of limits, against the mean of both formulations'."""
        row = {"scene": self.scene, "formulation": self.formulation}
        row["Courant"] = f"{self.courant:g}"
        for n, one in zip(self.cells, self.measured):
            row[f"distance, n = {n}"] = f"{one.distance:.5f}"
        row["limit"] = f"{self.extrapolated.distance:.5f}"
        for n, one in zip(self.cells, self.measured):
            _, gradient, angle = one.errors(reference)
            row[f"gradient off by, n = {n}"] = f"{gradient:.1%}, {angle:.1f} deg"
        return row


def limits(bench: Bench, quick: bool) -> dict[tuple[str, Formulation], Limit]:
    """Those of all robots on ground."""
    cells, found = QUICK_LIMITS if quick else LIMITS, {}
    for name, formulation in robots():
        if not ROBOTS[name][0].ground:
            continue
        choice = PLAIN if formulation == "updated" else TOTAL
        _, courant, _ = nearest_possible(name, (cells[-1], LIMIT_COURANT, choice))
        measured = bench.measure([(name, n, courant, choice) for n in cells])
        found[name, formulation] = Limit(name, formulation, courant, cells, tuple(measured))
    return found


def mean(one: Measured, other: Measured) -> Measured:
    """Halfway between two."""
    return replace(
        one,
        distance=0.5 * (one.distance + other.distance),
        gradient=0.5 * (one.gradient + other.gradient),
    )


def exact_bar() -> Measured:
    """The bar's exact answer."""
    bar = Bar(32, 0.4)
    return Measured(Discretisation.of(bar.simulation.scene), 0.0, 0.0, *bar.exact())


if __name__ == "__main__":
    sys.exit(main())
