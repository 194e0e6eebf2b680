"""Scenes, designs and run files of any kind: each runs to a finite answer or is refused by name.

    python cases/fuzz.py --scenes 2000 --designs 500 --files 500

Refused means: an error of the package's own. Anything else counts as a failure: another exception,
a warning, a result that is not finite, more than 4 GB of memory, more than a minute.

Compiled kernels reach records by pointers, which NUMBA_BOUNDSCHECK=1 does not see. With
NUMBA_DISABLE_JIT=1 they are plain Python, and every index into records is checked here.
"""

import argparse
import copy
import dataclasses
import faulthandler
import json
import math
import resource
import sys
import tempfile
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from hypothesis import HealthCheck, Phase, given, settings
from hypothesis import strategies as st
from numba import config

from mpmopt import kernels
from mpmopt.assess.threshold import post_processed
from mpmopt.design.problem import Problem
from mpmopt.errors import MpmoptError
from mpmopt.io.checksums import sealed
from mpmopt.kernels import simd
from mpmopt.optimisation.history import Optimisation
from mpmopt.optimisation.loop import go_on, optimise
from mpmopt.optimisation.settings import Settings, Stage
from mpmopt.results import runfile
from mpmopt.scene import (
    Actuator,
    Clamp,
    Design,
    Grid,
    Ground,
    Material,
    Mirror,
    Scene,
    Solid,
    Wall,
)

MEMORY = 4 * 10**9  # bytes of address space above what a process has when it starts
SECONDS = 60  # of one input


@dataclass
class Row:
    """What became of one kind of input.

    Attributes
    ----------
    what : str
    tried, ran, refused : int
    failures : list of str
        Inputs that did neither, and what happened.
    """

    what: str
    tried: int = 0
    ran: int = 0
    refused: int = 0
    failures: list[str] = field(default_factory=list)


# Scenes.

ODD_NUMBERS = [
    0, -1, 1, 2, 3.7, -0.0, 1e-300, 5e-324, 1e-30, 1e-12, 1e12, 1e30, 1e300, -1e300, 1e9, 10**9,
    10**12, 2**63, 2**64, 10**400, 10**5000, math.nan, math.inf, -math.inf, 0.1 + 0.2, 1 / 3,
]  # fmt: skip
ODD_VALUES: list[Any] = [
    *ODD_NUMBERS, None, True, False, "", "x", "stick", "below", "total", "\ud800", "1", "1e5",
    [], {}, [1], [1, 2, 3], [[1, 2], [3, 4]], [[]], {"a": 1}, [None, None], ["x", "y"],
    [math.nan, 0.0], [1e308, 1e308], [10**9, 10**9], 1000 * [0.0], "x" * 10000,
]  # fmt: skip
PARTS = {"grid": Grid, "material": Material, "mirror": Mirror}
TUPLES: dict[str, type] = {"walls": Wall, "ground": Ground, "clamps": Clamp}
KINDS = {part.kind: part for part in (Design, Solid, Actuator)}


@st.composite
def plausible(draw: Any) -> dict[str, Any]:
    """A scene as JSON would hold it, small and nearly always valid."""
    per_cell = draw(st.sampled_from([1, 2, 2, 2, 3]))
    dx = draw(st.sampled_from([1 / 16, 1.0, 0.1, 1e-3, 1e-6, 1e4, math.pi]))
    cells = draw(st.integers(12, 24)), draw(st.integers(8, 20))
    mirrored = draw(st.integers(0, 4)) == 0  # about y = 3 dx
    columns = draw(st.integers(1, 3))
    body, x = [], draw(st.integers(1, 2)) * per_cell
    bottom = draw(st.integers(1, 2)) * per_cell
    for k in range(columns):
        kind = "solid" if k == 0 else draw(st.sampled_from(["solid", "design", "actuator"]))
        width, height = (draw(st.integers(1, 4)) for _ in range(2))
        if mirrored:
            height = 2 * (3 * per_cell - bottom)
        region = {
            "kind": kind,
            "lower": [x * dx / per_cell, bottom * dx / per_cell],
            "upper": [(x + width) * dx / per_cell, (bottom + height) * dx / per_cell],
        }
        if kind == "actuator":
            xx, xy, yy = (draw(st.integers(-35, 35)) / 100 for _ in range(3))
            xy = 0.0 if mirrored else xy / 4
            region["stress"] = [[xx, xy], [xy, yy]]
            region["angular_frequency"] = draw(st.floats(1e-3, 1e3))
        body.append(region)
        x += width + draw(st.integers(0, 2))
    mu = draw(st.sampled_from([1.0, 1.0, 1e-6, 1e6]))
    for region in body:
        if "stress" in region:
            region["stress"] = [[mu * value for value in row] for row in region["stress"]]
    material = {
        "lame_lambda": mu * draw(st.sampled_from([0.0, 1.0, 10.0])),
        "lame_mu": mu,
        "density": draw(st.sampled_from([1.0, 1.0, 1e-6, 1e6])),
        "void_stiffness": draw(st.sampled_from([1e-3, 1e-2, 1e-6, 1.0])),
        "void_density": draw(st.sampled_from([1e-2, 1e-2, 1e-3, 1.0])),
    }
    walls = []
    standing = draw(st.sampled_from(["wall", "ground", "nothing"]))
    if standing == "wall" and not mirrored:
        friction = draw(st.sampled_from(["stick", 0.0, 0.3, 1e6]))
        walls.append({"axis": "y", "position": dx, "solid_side": "below", "friction": friction})
    light = max(1.0, material["void_stiffness"] / material["void_density"])
    stiffness = 2.0 * light * (mu + material["lame_lambda"]) / material["density"]
    courant = draw(st.sampled_from([0.1, 0.5, 0.9, 1.0 - 1e-9]))
    time_step = courant * dx / math.sqrt(stiffness)
    viscous = draw(st.sampled_from([0.0, 0.0, 1e-3, 0.1, 3.0]))  # a of `largest_time_step`
    time_step /= viscous + math.sqrt(viscous**2 + 1.0)
    material["viscosity"] = viscous * material["density"] * dx * math.sqrt(stiffness) / light
    for region in body:
        if draw(st.integers(0, 3)) == 0:
            heavier = draw(st.sampled_from([1.0, 2.0, 10.0]))
            region["material"] = {**material, "density": heavier * material["density"]}
    strength = draw(st.sampled_from([0.0, 1e-5, 1e-3, 1e-2, 10.0]))  # dx per step and step
    gravity = 0.0 if mirrored else -strength * dx / time_step**2
    steps = draw(st.integers(1, 20))
    ground = []
    if standing == "ground":
        ground = draw(grounds(dx, bottom * dx / per_cell, mirrored))
    total = not walls and draw(st.booleans())
    held = draw(st.sampled_from([0, 0, 0, 1, 1, 2]))
    clamps = [draw(clamp(dx, time_step, mirrored, body)) for _ in range(held)]
    time_step *= 0.7 if total else 1.0
    return {
        "grid": {"cells": list(cells), "dx": dx},
        "time_step": time_step,
        "steps": steps,
        "transient": draw(st.integers(0, steps - 1)) * time_step,
        "body": body,
        "walls": walls,
        "ground": ground,
        "clamps": clamps,
        "formulation": "total" if total else "updated",
        "material": material,
        "gravity": [draw(st.sampled_from([0.0, 0.1])) * gravity, gravity],
        "direction": [1.0, 0.0] if mirrored or draw(st.booleans()) else [0.6, -0.8],
        "particles_per_cell": per_cell,
        "filter_length": draw(st.sampled_from([0.0, dx])),
        "mirror": {"axis": "y", "position": 3 * dx} if mirrored else None,
    }


@st.composite
def grounds(draw: Any, dx: float, bottom: float, mirrored: bool) -> list[dict[str, Any]]:
    """Ground below a height, level or rough; before a mirror at 3 dx the same above."""
    thickness = draw(st.sampled_from([0.5, 1.0, 2.0])) * dx
    y = bottom - draw(st.sampled_from([0.0, 0.3, 1.0])) * thickness
    count = draw(st.integers(2, 5))
    points = [[4.0 * k * dx, y - draw(st.integers(0, 2)) * dx / 3] for k in range(count)]
    below = {
        "points": points,
        "friction": draw(st.sampled_from(["stick", 0.0, 0.5, 1e6])),
        "thickness": draw(st.sampled_from([thickness, thickness, None])),
        "stiffness": None,
        "damping": draw(st.sampled_from([None, 0.0, 1.0])),
        "creeping_speed": None,
    }
    if not mirrored:
        return [below]
    above = {**below, "points": [[x, 6 * dx - height] for x, height in points[::-1]]}
    return [below, above]


@st.composite
def clamp(
    draw: Any, dx: float, time_step: float, mirrored: bool, body: list[dict[str, Any]]
) -> dict[str, Any]:
    """A rectangle over a corner of the body or all of a region, or anywhere.

    It is held, or moves by a tenth of a cell a step at most.
    """
    half = draw(st.sampled_from([0.5, 1.0, 2.5]))
    middle = [draw(st.integers(1, 3)), 3.0 if mirrored else draw(st.integers(2, 5))]
    lower, upper = ([(m + s * half) * dx for m in middle] for s in (-1, 1))
    if draw(st.integers(0, 3)):
        region = draw(st.sampled_from(body))
        more = draw(st.sampled_from([0.0, 0.3, 1.0])) * dx
        lower, upper = ([x + s * more for x in region[e]] for s, e in ((-1, "lower"), (1, "upper")))
        if draw(st.booleans()):  # a part of it
            upper[0] = lower[0] + draw(st.sampled_from([0.5, 1.0, 2.0])) * dx
    path, x, y = [], 0.0, 0.0
    for k in range(draw(st.sampled_from([0, 0, 1, 3]))):
        x += draw(st.sampled_from([0.0, 0.2])) * dx
        y += 0.0 if mirrored else draw(st.sampled_from([-0.1, 0.1])) * dx
        path.append([4.0 * k * time_step, [x, y]])
    return {"lower": lower, "upper": upper, "path": path}


def places(data: Any, path: tuple = ()) -> list[tuple]:
    """Where values stand in nested lists and objects."""
    found = [path] if path else []
    items = data.items() if isinstance(data, dict) else enumerate(data)
    for key, value in items:
        found += places(value, (*path, key)) if isinstance(value, (dict, list)) else [(*path, key)]
    return found


def at(data: Any, path: tuple) -> Any:
    """What stands there."""
    for key in path:
        data = data[key]
    return data


@st.composite
def odd(draw: Any) -> dict[str, Any]:
    """A scene of which some values are replaced."""
    data = copy.deepcopy(draw(plausible()))
    for _ in range(draw(st.integers(1, 3))):
        *path, key = draw(st.sampled_from(places(data)))
        there = at(data, tuple(path))
        if (key not in there) if isinstance(there, dict) else key >= len(there):
            continue
        value = there[key]
        if isinstance(value, float) and draw(st.booleans()):  # another one that may do
            factor = draw(st.sampled_from([1e-9, 0.5, 1.0 + 1e-9, 1.0 + 1e-5, 2.0, -1.0, 1e3]))
            there[key] = factor * value
        else:
            there[key] = copy.deepcopy(draw(st.sampled_from(ODD_VALUES)))
    # A run that is valid must be short.
    steps = data.get("steps")
    if type(steps) is int and 20 < steps <= 10**8:
        data["steps"] = 20
    return data


@st.composite
def text(draw: Any) -> str:
    """The JSON of a scene, perhaps with keys more or less, or damaged."""
    data = draw(st.one_of(plausible(), odd()))
    if draw(st.booleans()):
        objects = [(), *(p for p in places(data) if isinstance(at(data, p), dict))]
        there = at(data, draw(st.sampled_from(objects)))
        if there:
            key = draw(st.sampled_from(sorted(there)))
            if draw(st.booleans()):
                del there[key]
            else:
                there[draw(st.sampled_from(["colour", key.upper(), "\ud800", ""]))] = there[key]
    with_whole = json.dumps(data, default=str) if not _has_giant(data) else "1" + 5000 * "0"
    kind = draw(
        st.sampled_from(["whole"] * 4 + ["cut", "flipped", "twice", "deep", "long", "other"])
    )
    k = draw(st.integers(0, max(len(with_whole) - 1, 0)))
    if kind == "cut":
        return with_whole[:k]
    if kind == "flipped":
        return with_whole[:k] + draw(st.characters()) + with_whole[k + 1 :]
    if kind == "twice":
        return with_whole.replace('"dx"', '"dx": 1, "dx"')
    if kind == "deep":
        n = draw(st.sampled_from([10, 10**5, 10**6]))
        return with_whole.replace("[", "[" * n, 1) if draw(st.booleans()) else '{"a":' * n
    if kind == "long":
        return with_whole + " " * 10**6 if draw(st.booleans()) else f'{{"steps": {"9" * 10**5}}}'
    return draw(st.text(max_size=20)) if kind == "other" else with_whole


def _has_giant(data: Any) -> bool:
    return any(type(at(data, p)) is int and at(data, p) >= 10**4000 for p in places(data))


def _made(part: Any, data: Any) -> Any:
    """The part of these values, if they are what its constructor asks for; else they themselves."""
    if not isinstance(data, dict):
        return data
    needed = {f.name for f in dataclasses.fields(part) if f.default is dataclasses.MISSING}
    known = {f.name for f in dataclasses.fields(part)}
    return part(**data) if needed <= set(data) <= known else data


def _region(data: Any) -> Any:
    if not isinstance(data, dict) or data.get("kind") not in list(KINDS):
        return data
    values = {k: v for k, v in data.items() if k != "kind"}
    if "material" in values:
        values["material"] = _made(Material, values["material"])
    return _made(KINDS[data["kind"]], values)


def from_objects(data: dict[str, Any]) -> Scene:
    """The scene of these values, without JSON."""
    data = dict(data)
    for name, part in PARTS.items():
        data[name] = _made(part, data[name])
    if isinstance(data["body"], list):
        data["body"] = tuple(_region(item) for item in data["body"])
    for name, part in TUPLES.items():
        if isinstance(data[name], list):
            data[name] = tuple(_made(part, item) for item in data[name])
    return Scene(**data)


def run_scene(scene: Scene, kind: int) -> None:
    """Value and gradient of a scene, in one of several ways; the result must be finite."""
    if scene.steps > 20:
        return  # a valid one that takes long
    choices: tuple[dict[str, Any], ...] = (
        {}, {"halvings": 0, "limits": None}, {"precision": "single"},
        {"void_cutoff": 0.5, "beta": 8.0},
    )  # fmt: skip
    problem = Problem(scene, **choices[kind])
    x = problem.join(
        np.linspace(-1.0, 1.0, problem.size - 3 * len(scene.actuators)), 1.0, -0.3, -0.5
    )
    value, gradient = problem.value_and_gradient(x)
    _finite(value, gradient)
    if kind == 1:
        _finite(problem.value(x), post_processed(problem, x))


def _finite(*values: Any) -> None:
    for value in values:
        if not np.all(np.isfinite(value)):
            raise AssertionError(f"result {value!r} is not finite")


# Designs.

SMALL = Scene(
    grid=Grid((16, 16), 1 / 16),
    time_step=4e-3,
    steps=5,
    gravity=(0.0, -10.0),
    walls=(Wall("y", 4 / 16),),
    body=(
        Design((3 / 16, 4 / 16), (7 / 16, 6 / 16)),
        Actuator((3 / 16, 6 / 16), (5 / 16, 7 / 16)),
        Solid((5 / 16, 6 / 16), (7 / 16, 7 / 16)),
    ),
    material=Material(void_density=1e-2),
)
SIZE = 32 + 3
ODD_DESIGNS = [
    None, 3.0, "x", [], {}, [[1.0], [1.0, 2.0]], SIZE * ["0"], SIZE * [None], SIZE * [10**400],
    SIZE * [True], np.zeros((SIZE, 1)), np.zeros((1, SIZE)), np.zeros(0), np.zeros(SIZE + 1),
    np.zeros(SIZE, complex), np.full(SIZE, 1j * np.nan), np.zeros(SIZE, np.complex64),
    np.zeros(SIZE, object), np.zeros(SIZE, "S3"), np.zeros(SIZE, "M8[s]"), np.zeros(SIZE, bool),
    np.zeros(SIZE, np.float16), np.ones(SIZE, np.uint8), np.full(SIZE, 2**64 - 1, np.uint64),
    np.ma.masked_less(np.zeros(SIZE), 1.0), np.full(SIZE, np.longdouble("1e4000")), range(SIZE),
    object(),
]  # fmt: skip
ENTRIES = [0.0, 1.0, -1.0, 1.0 + 1e-16, 1.0 + 1e-15, -1.5, 1e300, 5e-324, np.nan, np.inf, -np.inf]


@st.composite
def variables(draw: Any) -> Any:
    """Design variables: in bounds, at bounds, beyond; with odd entries; of any shape and kind."""
    if draw(st.integers(0, 3)) == 0:
        return draw(st.sampled_from(ODD_DESIGNS))
    size = draw(st.sampled_from([SIZE, SIZE, SIZE, SIZE - 1, 0, 2 * SIZE]))
    seed = draw(st.integers(0, 2**16))
    x = np.random.default_rng(seed).uniform(-1.0, 1.0, size)
    x *= draw(st.sampled_from([0.0, 1e-300, 0.5, 1.0, 1.0, 1.01]))
    for _ in range(draw(st.integers(0, 3)) if size else 0):
        x[draw(st.integers(0, size - 1))] = draw(st.sampled_from(ENTRIES))
    kind = draw(st.sampled_from([np.float64, np.float64, np.float32, np.float16, np.longdouble]))
    with np.errstate(all="ignore"):
        x = x.astype(kind)
    return x[::-1] if draw(st.booleans()) else x


def run_design(problem: Problem, x: Any, kind: int) -> None:
    """All that takes a design must refuse it or give what is finite."""
    if kind == 0:
        _finite(*problem.value_and_gradient(x))
    elif kind == 1:
        _finite(problem.value(x), problem.gamma(x))
    elif kind == 2:
        _finite(post_processed(problem, x))
    else:
        _finite(problem.join(x, 0.5, 0.5, 0.5), problem.join(0.0, x, 0.0, 0.0))


# Run files.

BIG = 10**12  # entries that a dataset claims


def _link(name: str, link: Any) -> Callable[[h5py.File], None]:
    def change(file: h5py.File) -> None:
        file.pop(name)
        file[name] = link

    return change


def _dataset(name: str, **options: Any) -> Callable[[h5py.File], None]:
    def change(file: h5py.File) -> None:
        file.pop(name)
        file.create_dataset(name, **options)

    return change


def _virtual(file: h5py.File) -> None:
    layout = h5py.VirtualLayout(shape=(35,), dtype="f8")
    layout[:] = h5py.VirtualSource("elsewhere.h5", "x", shape=(35,))
    file.pop("stages/0/x")
    file.create_virtual_dataset("stages/0/x", layout)


def _cycle(file: h5py.File) -> None:
    for k in range(50):
        file[f"stages/0/back{k}"] = file["stages"]


def _deep(file: h5py.File) -> None:
    group = file
    for _ in range(2000):
        group = group.create_group("g")


OBJECTS = np.array(["a"], dtype=h5py.string_dtype())
CHANGES: list[Callable[[h5py.File], Any]] = [
    lambda f: f.attrs.update(version=1),
    lambda f: f.attrs.update(version="two"),
    lambda f: f.attrs.update(version=np.nan),
    lambda f: f.attrs.update(version=np.arange(10)),
    lambda f: f.attrs.update(format=3),
    lambda f: f.attrs.update(format=b"mpmopt run"),
    lambda f: f.attrs.create("scene", data=f["history"].ref, dtype=h5py.ref_dtype),
    lambda f: f.attrs.create("scene", data=h5py.Empty("f8")),
    lambda f: f.attrs.update(scene=np.arange(5.0)),
    lambda f: f.attrs.update(scene='{"grid":' * 5000),
    lambda f: f.attrs.update(settings="[" * 50000),
    lambda f: f.attrs.update(settings='{"stages": 3}'),
    lambda f: f.attrs.update(settings='{"stages": [3]}'),
    lambda f: f.attrs.update(settings=f.attrs["settings"].replace("0.5", "NaN")),
    lambda f: f.attrs.update(settings=f.attrs["settings"].replace("0.5", "1e400")),
    lambda f: f.attrs.update(summary="[1, 2]"),
    lambda f: f.attrs.update(versions="3"),
    lambda f: f.attrs.update(stop_reason=3),
    lambda f: f["best"].attrs.update(stage=99),
    lambda f: f["best"].attrs.update(stage=np.inf),
    lambda f: f["best"].attrs.update(stage="x"),
    lambda f: f["stages/0"].attrs.update(time_step=np.nan),
    lambda f: f["stages/0"].attrs.update(time_step=1e-300),
    lambda f: f["stages/0"].attrs.update(time_step=1e3),
    _link("stages/0/x", h5py.ExternalLink("other.h5", "/x")),
    _link("stages/0", h5py.ExternalLink("/etc/passwd", "/")),
    _link("history", h5py.SoftLink("/history")),
    _link("history/beta", h5py.SoftLink("/stages/0/x")),
    _dataset("stages/0/x", data=OBJECTS),
    _dataset("stages/0/x", shape=(BIG,), dtype="f8", chunks=(1024,)),
    _dataset("stages/0/x", shape=(BIG,), dtype="f8"),
    _dataset("history/beta", shape=(BIG,), dtype="f8", chunks=(1024,), compression="gzip"),
    _dataset("history/failure", shape=(BIG,), dtype=h5py.string_dtype(), chunks=(1024,)),
    _dataset("history/failure", data=np.arange(3.0)),
    _dataset("history/failure", shape=(3,), dtype=h5py.ref_dtype),
    _dataset("history/failure", shape=(3,), dtype=h5py.vlen_dtype(np.float64)),
    _dataset("stages/0/x", shape=(35,), dtype="f8", external=[("/etc/passwd", 0, 280)]),
    _dataset("stages/0/x", data=np.full(35, np.nan)),
    _dataset("stages/0/x", data=np.zeros(34)),
    _dataset("stages/0/x", data=np.zeros(35, np.complex128)),
    _dataset("stages/0/x", data=np.zeros(35, [("a", "f8")])),
    _dataset("stages/0/x", data=np.zeros((35, 1))),
    _dataset("stages/0/x", data=3.0),
    _dataset("stages/0/x", dtype=np.float64),
    _virtual,
    _cycle,
    _deep,
    lambda f: f.create_group("stages/9"),
    lambda f: f.create_group("stages/-1"),
    lambda f: f.create_group("stages/" + "9" * 5000),
    lambda f: f.pop("best"),
    lambda f: f.pop("x"),
    lambda f: f.attrs.update(stage=7),
    lambda f: f.attrs.update(stage=-1),
    lambda f: f.attrs.update(stage=np.nan),
    lambda f: f["last"].attrs.update(stage=2**62),
    lambda f: f["last"].attrs.update(objective="far"),
    lambda f: f["first"].attrs.pop("beta"),
    lambda f: f["stage/mma"].pop("lower"),
    _dataset("stage/mma/x_previous", data=np.full(3, np.nan)),
    _dataset("stage/values", data=np.zeros(0)),
    lambda f: f.create_dataset("baseline", data=np.zeros(3)),
    lambda f: f.create_group("baseline"),
]


@st.composite
def damages(draw: Any) -> tuple[str, Any]:
    """How a run file is damaged: bytes, or something that HDF5 allows."""
    kinds = ["flip", "flip", "flip", "cut", "blank", "insert", "change", "nothing"]
    kind = draw(st.sampled_from(kinds))
    if kind == "nothing":  # a whole file must run
        return kind, []
    if kind == "change":
        return kind, draw(st.integers(0, len(CHANGES) - 1))
    places = st.lists(
        st.tuples(st.floats(0.0, 1.0), st.integers(1, 255)),
        min_size=1,
        max_size=8 if kind == "flip" else 1,
    )
    return kind, draw(places)


def damage(content: bytes, kind: str, how: Any, path: Path) -> None:
    """Leave a damaged copy of a run file."""
    if kind == "change":
        path.write_bytes(content)
        with h5py.File(path, "r+") as file:
            CHANGES[how](file)
        path.write_bytes(sealed(path.read_bytes()))
        return
    changed = bytearray(content)
    for share, by in how:
        place = min(int(share * len(changed)), len(changed) - 1)
        if kind == "flip":
            changed[place] ^= by
        elif kind == "cut":
            del changed[place:]
        elif kind == "blank":
            changed[place : place + 16 * by] = bytes(len(changed[place : place + 16 * by]))
        else:
            changed[place:place] = bytes([by])
    path.write_bytes(changed)


def run_file(path: Path) -> None:
    """Read a run file, use what is in it, and go on with it."""
    run = runfile.read_run(path).run
    _finite(run.problem().gamma(run.result.x), [item.objective for item in run.history])
    go_on(run)


def small_run(path: Path) -> bytes:
    """The content of a run file, written by a short optimisation that was then stopped."""
    stages = (Stage(0.5, 1e-2, 1e-3, 4e-3), Stage(2.0, 1e-2, 1e-3, 4e-3, solid=True))
    how = Settings(stages, window=2, least_iterations=2, most_iterations=3)

    def write(run: Optimisation) -> None:
        if len(run.history) == 5:
            runfile.write(path, run)

    optimise(SMALL, how, Problem(SMALL).join(0.0, 1.0, -0.3, -0.5), [write])
    return path.read_bytes()


# All of them.


def _note(row: Row, what: Any, action: Callable[[], None]) -> None:
    """Do it and count what became of it."""
    row.tried += 1
    faulthandler.dump_traceback_later(SECONDS, exit=True)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            action()
        row.ran += 1
    except MpmoptError as error:
        str(error).encode()  # can be printed
        row.refused += 1
    except Exception as error:
        row.failures.append(f"{type(error).__name__}: {error}; input: {what!r}"[:3000])
    finally:
        faulthandler.cancel_dump_traceback_later()


def _each(strategy: Any, number: int, action: Callable[[Any], None]) -> None:
    """Do it with so many inputs, the same ones in every run."""
    if number == 0:
        return

    @settings(
        max_examples=number,
        derandomize=True,
        database=None,
        deadline=None,
        phases=(Phase.generate,),
        suppress_health_check=list(HealthCheck),
    )
    @given(strategy)
    def run(value: Any) -> None:
        action(value)

    run()


def fuzz(scenes: int, designs: int, files: int) -> list[Row]:
    """Try so many of each.

    Parameters
    ----------
    scenes : int
        Half of them as objects, half as JSON text.
    designs : int
    files : int
        Damaged run files.
    """
    for kind in range(4):  # compile all kernels that are not cached
        run_scene(SMALL, kind)
    Problem(SMALL).value(np.zeros(SIZE, complex))
    objects, texts = Row("scenes as objects"), Row("scenes as JSON text")
    design_row, file_row = Row("designs"), Row("damaged run files")
    kinds = st.integers(0, 3)

    def scene_from(row: Row, make: Callable[[Any], Scene]) -> Callable[[Any], None]:
        return lambda pair: _note(row, pair, lambda: run_scene(make(pair[0]), pair[1]))

    both = st.tuples(st.one_of(plausible(), odd()), kinds)
    _each(both, scenes - scenes // 2, scene_from(objects, from_objects))
    _each(st.tuples(text(), kinds), scenes // 2, scene_from(texts, Scene.from_json))
    problem = Problem(SMALL)
    _each(
        st.tuples(variables(), kinds),
        designs,
        lambda pair: _note(design_row, pair, lambda: run_design(problem, *pair)),
    )
    if files:
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "run.h5"
            content = small_run(path)

            def one(how: tuple[str, Any]) -> None:
                damage(content, *how, path)
                _note(file_row, how, lambda: run_file(path))

            _each(damages(), files, one)
    return [row for row in (objects, texts, design_row, file_row) if row.tried]


def check_indices() -> None:
    """Let the kernels' accesses to records, as plain Python functions, check their indices."""

    def checked(access: Callable[..., Any]) -> Callable[..., Any]:
        def within(array: np.ndarray, k: int, *rest: Any) -> Any:
            records = len(array) if array.ndim == 2 else len(array) // 2
            if not 0 <= k < records:
                raise IndexError(f"{access.__name__}: record {k} of {records}")
            return access(array, k, *rest)

        return within

    for name in ("load", "store", "number", "set_number"):
        right: Callable[..., Any] = getattr(simd, name)
        for module in [m for m in sys.modules.values() if m.__name__.startswith(kernels.__name__)]:
            if getattr(module, name, None) is right:
                setattr(module, name, checked(right))


def main(argv: Sequence[str] | None = None) -> int:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    for name, number in (("scenes", 2000), ("designs", 500), ("files", 500)):
        parser.add_argument(f"--{name}", type=int, default=number)
    parser.add_argument("--json", type=Path, help="leave the rows here too")
    arguments = parser.parse_args(argv)
    used = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    if getattr(config, "DISABLE_JIT", 0):
        check_indices()
    hard = resource.getrlimit(resource.RLIMIT_AS)[1]
    resource.setrlimit(resource.RLIMIT_AS, (used + MEMORY, hard))
    rows = fuzz(arguments.scenes, arguments.designs, arguments.files)
    for row in rows:
        print(f"{row.what}: {row.tried} tried, {row.ran} ran, {row.refused} refused, "
              f"{len(row.failures)} failed")  # fmt: skip
        for failure in row.failures:
            print("  ", failure)
    if arguments.json:
        arguments.json.write_text(json.dumps([vars(row) for row in rows], indent=1))
    return 1 if any(row.failures for row in rows) else 0


if __name__ == "__main__":
    sys.exit(main())
