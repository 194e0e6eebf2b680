"""Does a finished robot go on: elsewhere, in other discretisations, when pushed, and for long?

A robot is what would be built: without grey and void, and without what hangs on nothing.
"""

from __future__ import annotations

import math
import threading
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from mpmopt.assess import threshold
from mpmopt.assess.refinement import (
    HALVINGS,
    other_formulation,
    with_twice_the_step,
)
from mpmopt.assess.threshold import SOLID_LIMITS, solid_body
from mpmopt.design.actuation import frequencies
from mpmopt.design.ensemble import side_by_side
from mpmopt.design.objective import Objective
from mpmopt.design.problem import Problem
from mpmopt.design.step_control import check_indicators, with_halvings
from mpmopt.design.variables import Variables
from mpmopt.design.variation import Variation
from mpmopt.errors import SceneError, SimulationError
from mpmopt.kernels import parts
from mpmopt.scene import Actuator, Grid, Scene
from mpmopt.scene.particles import Particles, discretise, mirror_images, nearest_designed
from mpmopt.scene.scene import LAGRANGIAN_LIMIT, Formulation
from mpmopt.simulation.simulation import Simulation

# In units of `unit`: when a robot stands, what comes before does not count, and when a speed has
# been seen.
STANDS, SETTLED, SEEN, FOLLOWED = 1.0, 2.0, 8.0, 20.0
FEW_FRICTIONS = (0.2, 0.35, 0.5, 0.8)
FRICTIONS = (0.2, 0.3, 0.35, 0.5, 0.65, 0.8, 1.5)
CHANGES = (0.8, 1.2)  # of the actuators' strength and frequency
# A push against the direction of travel, of this share of the solid's wave speed, and when the
# speed counts again.
PUSH, PUSHED, RECOVERED = 0.05, 3.0, 4.0
# Room for the way, in longer sides of the body.
ROOM = 12.0
# It has fallen when it leans by this angle, or is nearer to the ground than this share of the
# distance at which it stands; it has stopped when it goes less than this share of its speed for so
# long.
LEANS, LOW, SLOW, PAUSE = math.radians(45.0), 0.5, 0.1, 2.0
# Speeds of less than this share of the body's longer side per unit of time have no shares.
LEAST = 2e-3
# What `study` tells, of what there is.
NAMES = (
    "speed", "way", "speed_by_friction", "kept", "driven_share", "after_push", "speed_by_strength",
    "speed_by_frequency", "speed_by_step", "speed_by_cells", "followed", "components",
)  # fmt: skip
# The trials whose share of the speed `study` tells as ``kept``.
TRIALS = {
    "half_step": "step 0.5", "finer_cells": "cells 2", "finest_cells": "cells 4",
    "other_formulation": "other 2",
}  # fmt: skip
TOO_LONG = "particles times steps are more than"  # why a run was left out
# Particles times steps of one run, in the short study and in the full: longer ones are left out.
MOST_WORK, MOST_WORK_FULL = 1.5e8, 5e9


@dataclass(frozen=True)
class Robot:
    """A design as it would be built: every particle solid or absent, all in one piece.

    Attributes
    ----------
    problem : Problem
        In which it was designed.
    keep : (D,) array of bool
        Which of its design particles are there.
    variables : Variables
        Its actuation.
    """

    problem: Problem
    keep: NDArray[np.bool_]
    variables: Variables

    @classmethod
    def of(cls, problem: Problem, x: NDArray[np.float64]) -> Robot:
        """The robot of a design; what hangs on nothing is dropped."""
        keep = threshold.kept(problem, x)
        held = threshold.pieces(problem.scene, keep) == 0
        return cls(problem, keep & held, problem.split(x))

    def in_scene(self, scene: Scene) -> NDArray[np.bool_]:
        """Which design particles of another scene are there: those whose nearest one is.

        Where the body begins otherwise, all of it was moved.
        """
        there = discretise(scene)
        moved = _corner(scene) - _corner(self.problem.scene)
        there = replace(there, position=there.position - moved)
        return self.keep[nearest_designed(there, self.problem.particles)]

    def body(self, scene: Scene) -> Simulation:
        """The robot in a scene, which may have other cells."""
        return solid_body(scene, self.in_scene(scene), self.variables)

    def period(self, scene: Scene) -> float:
        """Of the slowest actuator in a scene."""
        return 2.0 * math.pi / float(np.min(frequencies(scene, self.variables.omega)))


def _corner(scene: Scene) -> NDArray[np.float64]:
    return np.min([region.lower for region in scene.body], axis=0)


def can_be_studied(scene: Scene) -> bool:
    """Whether a scene's robot is driven, on ground whose friction is a number."""
    return bool(scene.actuators and scene.ground)


def unit(scene: Scene) -> float:
    """The unit of this file's times: the scene's transient, or its unit of time if it has none."""
    return scene.transient or 1.0


def whole_periods(period: float, begin: float, end: float) -> float:
    """The time until which as many whole periods have passed since `begin` as there is room for."""
    return begin + max(1, math.floor((end - begin) / period + 1e-9)) * period


def lasting(scene: Scene, seconds: float) -> Scene:
    """The scene for another time, all of which counts, and with room for the way."""
    room = math.ceil(ROOM * max(scene.extent) / scene.grid.dx)
    more = [room if component else 0 for component in scene.direction]
    behind = [room if component < 0.0 else 0 for component in scene.direction]
    nx, ny = (n + cells for n, cells in zip(scene.grid.cells, more))
    steps = max(1, math.ceil(seconds / scene.time_step - 1e-6))
    moved = _moved(scene, behind[0] * scene.grid.dx, behind[1] * scene.grid.dx)
    grid = Grid((nx, ny), scene.grid.dx)
    return replace(scene, **moved, grid=grid, steps=steps, transient=0.0)


def _moved(scene: Scene, dx: float, dy: float) -> dict[str, Any]:
    """What of a scene has a place, all of it moved; along a plane of symmetry, which stays."""

    def at(point: tuple[float, float]) -> tuple[float, float]:
        return point[0] + dx, point[1] + dy

    def boxes(items: tuple[Any, ...]) -> tuple[Any, ...]:
        return tuple(replace(each, lower=at(each.lower), upper=at(each.upper)) for each in items)

    along = {"x": dx, "y": dy}
    return {
        "body": boxes(scene.body),
        "clamps": boxes(scene.clamps),
        "walls": tuple(
            replace(wall, position=wall.position + along[wall.axis]) for wall in scene.walls
        ),
        "ground": tuple(replace(each, points=tuple(map(at, each.points))) for each in scene.ground),
    }


def with_cells(
    scene: Scene, multiple: float = 1.0, formulation: Formulation | None = None
) -> Scene:
    """The scene with so many times its cells along each axis, and in another formulation.

    The step is as much shorter as cells are narrower, and shorter still where viscosity or a layer
    need that. It has no design filter, which no solid body needs.

    Raises
    ------
    SceneError
        If that is no whole number of cells, or cannot be simulated.
    """
    nx, ny = (multiple * n for n in scene.grid.cells)
    if nx != round(nx) or ny != round(ny):
        raise SceneError(f"{multiple:g} times {scene.grid.cells} cells is no whole number")
    dx, step = scene.grid.dx / multiple, scene.time_step / multiple
    layer = max((each.stiffness / each.thickness for each in scene.layers), default=0.0)
    limit = LAGRANGIAN_LIMIT * min(m.largest_time_step(dx, layer) for m in scene.materials)
    step /= max(1, math.ceil(step / limit - 1e-9)) if multiple > 1.0 or formulation else 1
    return replace(
        scene,
        filter_length=0.0,
        grid=Grid((round(nx), round(ny)), dx),
        time_step=step,
        steps=max(1, round(scene.duration / step)),
        formulation=formulation or scene.formulation,
    )


def with_frequency(scene: Scene, share: float) -> Scene:
    """The scene with actuators so many times as fast."""
    body = tuple(
        replace(region, angular_frequency=share * region.angular_frequency)
        if isinstance(region, Actuator)
        else region
        for region in scene.body
    )
    return replace(scene, body=body)


class Trial(NamedTuple):
    """One run of a robot: the scene that it is in, and what happens to it."""

    scene: Callable[[], Scene]
    frozen: bool = False  # the actuation is held from `SETTLED` on
    pushed: bool = False
    halvings: int = 0  # of its step, at most, where it fails


def speed(robot: Robot, trial: Trial, most_work: float = math.inf) -> float:
    """Mean speed of a robot along the direction of travel, over whole periods.

    From `SETTLED` to `SEEN`, or from `RECOVERED` where it is pushed, in units of `unit`: its solid
    and actuators' centroid at the end, less that at the beginning, over the time between.

    Raises
    ------
    SceneError, SimulationError
        If that cannot be simulated, or goes beyond `threshold.SOLID_LIMITS`, or takes too long.
    """
    scene = trial.scene()
    one = unit(scene)
    begin = one * (RECOVERED if trial.pushed else SETTLED)
    end = whole_periods(robot.period(scene), begin, one * SEEN)
    scene = lasting(scene, end)
    simulation = robot.body(scene)
    work = float(simulation.initial.shape[1]) * scene.steps
    if work > most_work:
        raise SceneError(f"{work:.1g} {TOO_LONG} {most_work:.1g}")
    first, past = round(begin / scene.time_step), 0
    if trial.frozen:
        simulation.signal[first:] = simulation.signal[first]
    if trial.pushed:
        past = round(one * PUSHED / scene.time_step)
        back = -PUSH * scene.wave_speed
        velocity = back * scene.direction[0], back * scene.direction[1]
        simulation = simulation.pushed(past, velocity)
    seen = simulation.watch([first - past])
    check_indicators(seen.indicators, simulation, SOLID_LIMITS)
    centroid = Objective.of(scene, simulation.particles).centroid
    last = simulation.steps
    way = centroid(seen.states[last]) - centroid(seen.states[first - past])
    return float(way) / ((last + past - first) * scene.time_step)


@dataclass(frozen=True)
class Followed:
    """How long a robot goes on.

    Attributes
    ----------
    seconds : float
        Until it falls, stops or cannot be simulated, or `FOLLOWED` times `unit`.
    end : str
        "goes on", "falls", "stops", or why it cannot be simulated.
    """

    seconds: float
    end: str


def follow(robot: Robot, scene: Scene) -> Followed:
    """Follow a robot for long, and say when it falls or stops.

    It falls where its solid and actuators, on the average, lean by 45 degrees, or their centroid is
    half as far from the ground as on the average between `STANDS` and `SETTLED`: it may be drawn
    above the ground. It stops where it goes less than a tenth of its speed for `PAUSE`. All times
    are in units of `unit`.
    """
    one = unit(scene)
    scene = lasting(scene, one * FOLLOWED)
    simulation = robot.body(scene)
    every = max(1, round(0.25 * robot.period(scene) / scene.time_step))
    frames = np.arange(0, scene.steps + 1, every)
    time = scene.time_step * frames
    try:
        states, failure = simulation.run(frames.tolist()), None
    except SimulationError as error:
        failure = error
        frames = frames[frames < error.step]
        states = simulation.run(frames.tolist())
    way, height, angle = track(scene, simulation.particles, states)
    time = time[: len(way)]
    stands = (time >= one * STANDS) & (time <= one * SETTLED)
    fallen = np.zeros(len(time), dtype=bool)
    if stands.any():
        fallen = (height < LOW * height[stands].mean()) & (time >= one * STANDS)
    if scene.mirror is None:  # of half a body both sides may lean
        fallen |= np.abs(angle) > LEANS
    seen = np.flatnonzero((time >= one * SETTLED) & (time <= one * SEEN))
    first, last = (seen[0], seen[-1]) if seen.size > 1 else (0, -1)
    mean = max(float(way[last] - way[first]) / float(np.ptp(time[[first, last]]) or 1.0), 0.0)
    pause = max(1, round(one * PAUSE / (every * scene.time_step)))
    slow = way[pause:] - way[: len(way) - pause] <= SLOW * mean * one * PAUSE
    events = [(float(time[fallen.argmax()]), "falls")] if fallen.any() else []
    late = np.flatnonzero(slow & (time[: len(slow)] >= one * SETTLED))
    if late.size:
        events.append((float(time[late[0]]), "stops"))
    if failure is not None:
        events.append((failure.step * scene.time_step, failure.what))
    return Followed(*min(events, default=(one * FOLLOWED, "goes on")))


def track(
    scene: Scene, particles: Particles, states: Iterable[NDArray[np.float64]]
) -> tuple[NDArray[np.float64], ...]:
    """How far the solid and the actuators are, how high, and by how much they lean.

    Parameters
    ----------
    scene : Scene
    particles : Particles
        N of them.
    states : (F,) states (12, N)

    Returns
    -------
    (F,) arrays: the centroid along the direction, its distance from the ground (infinite without),
    and the angle of their mean deformation gradient's rotation
    """
    axes = [Objective.of(scene, particles, e) for e in ((1.0, 0.0), (0.0, 1.0))]
    weight, rows = axes[0].weight, []
    for state in states:
        place = np.array([axis.centroid(state) for axis in axes])
        above = [float(layer.line.distance(place[:, None])[0][0]) for layer in scene.layers]
        F = parts(state).deformation @ weight
        angle = math.atan2(F[1, 0] - F[0, 1], F[0, 0] + F[1, 1])
        rows.append((place @ scene.direction, min(above, default=math.inf), angle))
    return tuple(np.array(rows).reshape(-1, 3).T)


def components(scene: Scene, keep: NDArray[np.bool_]) -> int:
    """Pieces of the whole body, which hold together over edges and not over corners.

    Parameters
    ----------
    scene : Scene
    keep : (D,) array of bool
        Design particles that are there.
    """
    half, whole = discretise(scene), discretise(scene, whole=True)
    there = half.completed(keep)[mirror_images(scene, half, whole)]
    return int(threshold.connected(scene, whole, there).max())


def study(
    problem: Problem,
    x: NDArray[np.float64],
    full: bool = False,
    progress: Callable[[str, float], None] | None = None,
) -> dict[str, Any]:
    """What a finished robot is worth, as the summary has it.

    Independent runs share the processor's cores.

    Parameters
    ----------
    problem : Problem
        In the discretisation that the design is from.
    x : (n,) array
        Its variables.
    full : bool, optional
        Make all runs, which takes minutes, not only those that take seconds.
    progress : callable, optional
        Called with the name of each run that has ended, and its speed or not a number.

    Returns
    -------
    dict
        ``speed``; ``way``: "goes", "goes back" or "stands", which have no shares, or None where
        there is no speed; ``speed_by_friction``, and where it is full ``speed_by_strength``,
        ``speed_by_frequency``, ``speed_by_step`` (times the run's, as far as it is stable) and, of
        both formulations, ``speed_by_cells`` (along the grid's shorter side), by numbers as text;
        ``kept``, shares of the speed with half the step, with cells half as wide, and where it is
        full a quarter as wide, and half as wide in the other formulation; ``driven_share``, what is
        missing when the actuation is held; ``after_push``, the share of the speed that it has after
        a push; ``followed``, how long it goes on and what ends it; ``components``, before loose
        pieces are dropped; ``failures``, why a number is None; and ``shorter_steps_of_speed``,
        the steps of runs with other cells or in the other formulation that fail with the step that
        they should have. Only the components where there is no ground or no actuator.

    Raises
    ------
    DesignError
        If x does not fit.
    """
    scene, robot = problem.scene, Robot.of(problem, x)
    found: dict[str, Any] = {"components": components(scene, threshold.kept(problem, x))}
    if not can_be_studied(scene):
        return found
    most_work = MOST_WORK_FULL if full else MOST_WORK
    speeds, failures, shorter = _speeds(robot, _trials(scene, full), most_work, progress)
    nominal = speeds["nominal"]
    for kind in ("cells", "step", "strength", "frequency"):
        speeds[f"{kind} 1"] = nominal

    least = LEAST * max(scene.extent)
    way = None
    if nominal is not None:
        way = "goes" if nominal > least else "goes back" if nominal < -least else "stands"
    if way == "stands":
        failures["shares"] = f"the robot stands: no speed within {least:.2g} of zero has shares"
    elif way == "goes back":
        failures["shares"] = "the robot goes back: a speed against its direction has no shares"

    def share(name: str) -> float | None:
        value = speeds[name]
        if value is None or nominal is None or way != "goes":
            return None
        return value / nominal

    def table(kind: str) -> dict[str, float | None]:
        names = (name.split() for name in speeds)
        numbers = sorted((words[1] for words in names if words[0] == kind), key=float)
        return {number: speeds[f"{kind} {number}"] for number in numbers}

    kept = {name: share(trial) for name, trial in TRIALS.items() if trial in speeds}
    still = share("frozen")
    found |= {
        "speed": nominal,
        "way": way,
        "speed_by_friction": table("friction"),
        "kept": kept,
        "driven_share": None if still is None else 1.0 - still,
    }
    if full:
        count = min(scene.grid.cells)
        found |= {
            "after_push": share("pushed"),
            "speed_by_strength": table("strength"),
            "speed_by_frequency": table("frequency"),
            "speed_by_step": table("step"),
            "speed_by_cells": {
                formulation: {
                    f"{float(multiple) * count:g}": value for multiple, value in of_cells.items()
                }
                for formulation, of_cells in (
                    (scene.formulation, table("cells")),
                    (other_formulation(scene), table("other")),
                )
            },
            "followed": vars(follow(robot, scene)),
        }
    return found | {"failures": failures, "shorter_steps_of_speed": shorter}


def _trials(scene: Scene, full: bool) -> dict[str, Trial]:
    """The runs of a study, the longest first; names are a kind and a number."""
    other = other_formulation(scene)

    def cells(multiple: float, formulation: Formulation | None = None) -> Trial:
        return Trial(lambda: with_cells(scene, multiple, formulation), halvings=HALVINGS)

    def steps(multiple: float) -> Trial:
        return Trial(lambda: replace(scene, time_step=multiple * scene.time_step))

    def friction(value: float) -> Trial:
        return Trial(lambda: Variation(friction=value).scene(scene))

    def strength(value: float) -> Trial:
        return Trial(lambda: Variation(strength=value).scene(scene))

    def frequency(value: float) -> Trial:
        return Trial(lambda: with_frequency(scene, value))

    trials: dict[str, Trial] = {}
    if full:
        trials |= {"cells 4": cells(4.0), "other 2": cells(2.0, other)}
    trials |= {"cells 2": cells(2.0), "step 0.5": steps(0.5)}
    if full:
        trials["other 1"] = cells(1.0, other)
        if with_twice_the_step(scene) is not None:
            trials["step 2"] = steps(2.0)
        trials |= {"cells 0.5": cells(0.5), "other 0.5": cells(0.5, other)}
        trials |= {f"strength {value:g}": strength(value) for value in CHANGES}
        trials |= {f"frequency {value:g}": frequency(value) for value in CHANGES}
        trials["pushed"] = Trial(lambda: scene, pushed=True)
    frictions = FRICTIONS if full else FEW_FRICTIONS
    trials |= {f"friction {value:g}": friction(value) for value in frictions}
    return trials | {"nominal": Trial(lambda: scene), "frozen": Trial(lambda: scene, frozen=True)}


def _speeds(
    robot: Robot,
    trials: dict[str, Trial],
    most_work: float,
    progress: Callable[[str, float], None] | None,
) -> tuple[dict[str, float | None], dict[str, str], dict[str, float]]:
    """The speed of each trial, None where there is none, and why; and steps that were shortened."""
    shorter: dict[str, float] = {}
    speeds: dict[str, float | None] = dict.fromkeys(trials)
    failures: dict[str, str] = {}
    one_at_a_time = threading.Lock()

    def run(name: str) -> None:
        value = math.nan
        trial = trials[name]

        def simulated(there: Scene) -> float:
            return speed(robot, trial._replace(scene=lambda: there), most_work)

        try:
            scene = trial.scene()
            value, halved = with_halvings(scene, simulated, trial.halvings)
            speeds[name] = value
            if halved:
                shorter[name] = scene.time_step / 2**halved
        except SimulationError as error:
            failures[name] = error.what
        except SceneError as error:
            failures[name] = str(error)
        if progress is not None:
            with one_at_a_time:
                progress(name, value)

    side_by_side(run, list(trials))
    told = {name: failures[name] for name in trials if name in failures}
    return speeds, told, {name: shorter[name] for name in trials if name in shorter}
