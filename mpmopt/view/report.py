"""The report of a run: one HTML file with film, gait, history, designs and numbers.

All that it needs is in the file; it asks no network. ``report.html`` beside this file is the page,
and what follows makes the numbers that its script draws.
"""

from __future__ import annotations

import base64
import dataclasses
import html
import json
import os
import zlib
from collections.abc import Mapping
from contextlib import suppress
from functools import partial
from importlib import resources
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from mpmopt.assess.feet import feet
from mpmopt.assess.refinement import mapped
from mpmopt.assess.robustness import SEEN, SETTLED, can_be_studied, unit
from mpmopt.assess.trajectory import (
    Body,
    Make,
    Motion,
    equal_steps,
    moving,
    optimised,
    post_processed,
    reference,
    solid,
)
from mpmopt.design.problem import Problem
from mpmopt.design.task import FEASIBLE
from mpmopt.errors import SimulationError
from mpmopt.io.console import command
from mpmopt.io.files import replace_file
from mpmopt.optimisation.history import Optimisation
from mpmopt.scene import Scene
from mpmopt.scene.particles import discretise, mirror_images
from mpmopt.view.draw import FAINTEST, RED, ground_outline, view
from mpmopt.view.film import periods, playing_time

PER_PERIOD = 16  # instants of a film in one period of the fastest actuator; between, it is straight
FEWEST, MOST, MOST_IN_ALL = 80, 320, 960  # instants of a film, and of all together
PLACES = 65535  # steps of a place within a film's box
STRETCHES = 64  # steps of one in a deformation gradient, up to nearly 2
SOLID, ACTUATOR, EMPTY = (70, 70, 76, 255), (*(round(255 * c) for c in RED), 235), (0, 0, 0, 0)


def report(
    path: str | os.PathLike[str],
    run: Optimisation,
    summary: Mapping[str, Any],
    versions: Mapping[str, str],
    source: Path,
) -> None:
    """Write the report of a run.

    Parameters
    ----------
    path : Path
        Of the HTML file.
    run : Optimisation
    summary, versions : mapping
        As in `RunFile`; an empty summary is that of a run that is not finished.
    source : Path
        The run file, for the commands that are told.

    Raises
    ------
    DesignError
        If the run has no design.
    StorageError
        If the file cannot be written.
    """
    problem, x = run.problem(), run.result.x
    films: list[dict[str, Any]] = []
    makes = _makes(problem)
    frames = partial(_frames, most=min(MOST, MOST_IN_ALL // len(makes)))
    with suppress(SimulationError):  # which `moving` has told
        films.extend(_film(motion) for _, motion in moving(problem, x, makes, frames))
    name = source.absolute().parent.name or str(source)
    content = {
        "name": name,
        "scene": str(run.scene),
        "state": run.stop_reason or "Not finished.",
        "films": films,
        "film_note": _film_note(run.scene),
        "history": _history(run),
        "designs": _designs(run),
        "tables": _tables(run, summary, versions),
        "settings": {
            "scene": json.loads(run.scene.to_json()),
            "objective and constraints": json.loads(run.task.to_json()),
            "optimisation": dataclasses.asdict(run.settings),
        },
        "commands": _commands(source, can_be_studied(run.scene)),
    }
    page = resources.files("mpmopt.view").joinpath("report.html").read_text(encoding="utf-8")
    # What ends a script or begins a comment there must not stand in it.
    data = json.dumps(_finite(content), separators=(",", ":")).replace("<", "\\u003c")
    page = page.replace("$NAME", html.escape(name)).replace("$DATA", data)
    replace_file(path, page.encode("utf-8", errors="backslashreplace"))


def _film_note(scene: Scene) -> str:
    """Which seconds the films show, and where those are that the speed is of."""
    if not can_be_studied(scene):
        return ""
    one = unit(scene)
    return (
        f"The films end with the scene, at t = {scene.duration:.4g}. The speed in the tables is "
        f"that of the finished robot from t = {SETTLED * one:.4g} to {SEEN * one:.4g}: mpmopt film "
        "--finished films it (below, How to reproduce)."
    )


def _finite(value: Any) -> Any:
    """What JSON can say: numbers that are none become null, six digits of others are enough."""
    if isinstance(value, Mapping):
        return {str(key): _finite(item) for key, item in value.items()}
    if isinstance(value, (list, tuple, np.ndarray)):
        return [_finite(item) for item in value]
    if isinstance(value, (float, np.floating)):
        return float(f"{value:.6g}") if np.isfinite(value) else None
    return value.item() if isinstance(value, np.generic) else value


def _base64(values: NDArray[np.uint8]) -> str:
    return base64.b64encode(values.tobytes()).decode()


def _makes(problem: Problem) -> list[Make]:
    """What makes each body that is filmed: the design without grey also in each of its scenes."""
    in_scenes = [partial(_in_scene, number) for number in range(len(problem.members))]
    return [post_processed, optimised, reference, *in_scenes]


def _in_scene(number: int, problem: Problem, x: NDArray[np.float64]) -> Body:
    member = problem.members[number]
    name = f"post-processed design in scene {number + 1}: {problem.task.scenes[number]}"
    return solid(name[:100], member, x, mapped(member.scene, problem, x))


def _frames(scene: Scene, most: int) -> NDArray[np.int64]:
    """Instants of a film, no more than so many."""
    count = int(np.clip(round(PER_PERIOD * periods(scene)), FEWEST, most)) + 1
    return np.unique(equal_steps(scene, count))


def _film(motion: Motion) -> dict[str, Any]:
    """A body in motion, as the page's script reads it."""
    scene = motion.scene
    box = view([motion])
    drawn = np.flatnonzero(motion.gamma >= FAINTEST)
    order = drawn[np.argsort(motion.gamma[drawn], kind="stable")]
    e = np.array(scene.direction)
    moved = motion.centroid - motion.centroid[0]
    travel, rise = (moved @ axis for axis in (e, np.array([-e[1], e[0]])))
    place = np.empty(len(motion.gamma), np.int64)
    place[order] = np.arange(len(order))
    actuation = motion.actuation[:, order]
    signals, signal_of = np.unique(actuation, axis=1, return_inverse=True)
    return {
        "name": motion.name,
        "time": motion.frames * scene.time_step,
        "settled": scene.transient,
        "seconds": playing_time(scene),
        "box": box,
        "spacing": motion.spacing,
        "particles": len(order),
        "gamma": _base64(np.rint(255.0 * np.clip(motion.gamma[order], 0.0, 1.0)).astype(np.uint8)),
        "signals": np.round(signals, 3),
        "signal": signal_of.ravel(),
        "motion": packed(motion, box, order),
        "solids": _solids(scene, box, motion.spacing),
        "layers": [layer.thickness for layer in scene.layers],
        "travel": travel,
        "rise": rise,
        "feet": [
            {
                "name": foot.name,
                "particles": place[foot.particles],
                "height": foot.height,
                "stands": foot.stands.astype(int),
            }
            for foot in feet(motion)
        ],
    }


def packed(motion: Motion, box: NDArray[np.float64], order: NDArray[np.int64]) -> str:
    """Places and deformations of particles at all instants, as base64 of a zlib stream.

    Places are whole numbers of two bytes within the box, deformation gradients of one byte
    (`STRETCHES`). Of each there is the change since the instant before: first the low bytes of all
    places, then the high ones, then the deformation gradients.
    """
    places = (motion.position[:, :, order] - box[0][:, None]) / np.ptp(box, axis=0)[:, None]
    whole = np.rint(PLACES * np.clip(places, 0.0, 1.0)).astype(np.uint16)
    F = np.rint(np.clip(STRETCHES * motion.deformation[:, :, order], -127.0, 127.0)).astype(np.int8)

    def changes(values: NDArray) -> NDArray:
        change = values.copy()
        change[1:] -= values[:-1]  # modulo 2^8 or 2^16, which adding undoes
        return change

    moved = changes(whole)
    low, high = (moved & 255).astype(np.uint8), (moved >> 8).astype(np.uint8)
    content = low.tobytes() + high.tobytes() + changes(F).tobytes()
    return base64.b64encode(zlib.compress(content, 9)).decode()


def _solids(scene: Scene, box: NDArray[np.float64], spacing: float) -> list[NDArray[np.float64]]:
    """Corners of all that is rigid, the ground first, as far as it is within a box."""
    (left, low), (right, high) = box
    reach = 4.0 * float(np.ptp(box, axis=0).sum())
    solids = [ground_outline(ground, reach) for ground in scene.ground]
    for wall in scene.walls:
        k, below = "xy".index(wall.axis), wall.solid_side == "below"
        corners = box.copy()
        # Where bodies rest on it, as in `draw_walls`.
        corners[int(below), k] = wall.position + (-0.5 if below else 0.5) * spacing
        (left, low), (right, high) = corners
        if left < right and low < high:
            solids.append(np.array([(left, low), (right, low), (right, high), (left, high)]))
    return solids


def _history(run: Optimisation) -> dict[str, Any]:
    names = (
        "stage", "beta", "objective", "post_processed", "refined", "non_discreteness", "violation",
        "halved", "seconds", "failure", "scenes",
    )  # fmt: skip
    zero = run.origin
    columns: dict[str, Any] = {name: [getattr(i, name) for i in run.history] for name in names}
    for name in ("objective", "post_processed", "refined"):
        columns[name] = [value - zero for value in columns[name]]
    columns["scenes"] = [[value - zero for value in values] for values in columns["scenes"]]
    columns["pictures"] = [design_picture(run.scene, design / 255.0) for design in run.designs]
    columns["unit"], columns["chosen"] = run.measure, run.chosen
    return columns


def _designs(run: Optimisation) -> list[dict[str, Any]]:
    """The designs that the run keeps, in the order of their evaluations, with pictures."""
    kept = {f"best of stage {stage + 1}": item for stage, item in sorted(run.best.items())}
    named = [*kept.items(), ("last", run.last), ("first", run.first)]
    numbered: dict[int, dict[str, Any]] = {}
    for name, item in named:
        if item is None:
            continue
        number = run.number_of(item)
        if number in numbered:
            numbered[number]["names"].append(name)
            continue
        scene = run.settings.stages[item.stage].scene(run.scene)
        numbered[number] = {
            "evaluation": number,
            "stage": item.stage,
            "names": [name],
            "picture": design_picture(scene, item.gamma),
        }
    return [numbered[number] for number in sorted(numbered)]


def design_picture(scene: Scene, gamma: NDArray[np.float64]) -> str:
    """A PNG as a data URI: a pixel for each particle, opaque where there is material."""
    half, whole = discretise(scene), discretise(scene, whole=True)
    colour = np.tile(np.array(SOLID, float), (len(half.position), 1))
    colour[half.designed, 3] *= np.clip(gamma, 0.0, 1.0)
    colour[half.actuator >= 0] = ACTUATOR
    i, j = np.floor(whole.position * scene.particles_per_cell / scene.grid.dx).astype(int).T
    pixels = np.tile(np.array(EMPTY, np.uint8), (np.ptp(j) + 1, np.ptp(i) + 1, 1))
    pixels[j.max() - j, i - i.min()] = np.rint(colour[mirror_images(scene, half, whole)])
    content = BytesIO()
    Image.fromarray(pixels, "RGBA").save(content, format="PNG", optimize=True)
    return f"data:image/png;base64,{base64.b64encode(content.getvalue()).decode()}"


# Of a summary, what is a place: displacements count from the origin.
PLACED = {
    "start": "first design",
    "reference": "solid block, same actuation",
    "baseline": "design drawn by hand",
    "optimised": "optimised, with its void",
    "post_processed": "without grey",
    "post_processed_half_step": "without grey, half the time step",
    "actuation_off": "without grey, actuators off",
}


ACTUATION = "a", "theta", "b", "angular_frequency"


def _tables(
    run: Optimisation, summary: Mapping[str, Any], versions: Mapping[str, str]
) -> dict[str, Any]:
    zero, rest = run.origin, dict(summary)
    result = run.result
    placed = {
        text: None if rest[name] is None else rest[name] - zero
        for name, text in PLACED.items()
        if name in rest
    }
    for name in (*PLACED, "constraints", "stop_reason"):
        rest.pop(name, None)
    retained = {
        name: {"gain": value, "retained": rest.get("retained_gain", {}).get(name)}
        for name, value in rest.pop("gain", {}).items()
    }
    rest.pop("retained_gain", None)
    others = {name: rest.pop(name) for name in ACTUATION if name in rest}
    rows = zip(run.task.subject_to, result.constraints, result.multipliers)
    return {
        "placed": placed,
        "retained": retained,
        "more": rest,
        "actuation": others,
        "constraints": [
            {
                "name": str(constraint.term),
                "value": value,
                "bound": constraint.bound,
                "multiplier": multiplier,
                "met": bool(constraint.g(value) <= FEASIBLE),
            }
            for constraint, value, multiplier in rows
        ],
        "versions": dict(versions),
    }


AGAIN = (
    "from mpmopt.results.runfile import read_run; from mpmopt.optimisation.loop import optimise; "
    "run = read_run({path}).run; "
    "print(optimise(run.scene, run.settings, run.first.x, task=run.task).result.objective, "
    "run.result.objective)"
)


def _commands(source: Path, studied: bool) -> dict[str, str]:
    path = str(source.absolute())
    film = command("-m", "mpmopt", "film", path)
    at_speed = {"film the finished robot in the time that its speed is of": f"{film} --finished"}
    return {
        "optimise again from its first design, to the same digits": command(
            "-c", AGAIN.format(path=json.dumps(path))
        ),
        "check its gradients": command("-m", "mpmopt", "verify", path),
        "try it elsewhere, and in other discretisations": command("-m", "mpmopt", "study", path),
        "film it": film,
        **(at_speed if studied else {}),
        "take it out, 60 mm wide": command(
            "-m", "mpmopt", "export", path, "--svg", "--width", "60"
        ),
    }
