"""The one file that a run leaves: scene, settings, versions, history and designs, in HDF5.

Layout (version 6)::

    attributes       format, version, stage, reason, gave_up, stop_reason, full_study; as JSON:
                     scene, settings, task, versions, summary
    x                the design that the stage began with
    history/NAME     one entry per evaluation: objective, beta, non_discreteness, step, ...
    designs          one row per evaluation: 255 gamma, rounded, for pictures; may be missing
    best/            the best of all, with gamma, phi, a, theta, b, omega; attribute stage
    stages/K/        the best design of stage K: x, gamma; attributes of its evaluation
    first/, last/    the first and the last evaluation, in the same way
    stage/           a stage that is under way: what its next step depends on
    baseline         which design particles the baseline design has; not there without one

The file is sealed with a digest of all its bytes (`checksums`).
"""

from __future__ import annotations

import dataclasses
import json
import os
import platform
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

import mpmopt
from mpmopt.design.task import Task
from mpmopt.design.variables import Variables
from mpmopt.errors import RunFileError, StorageError
from mpmopt.io.checksums import LARGEST, SEAL, file_in_memory, refusing, sealed, unsealed
from mpmopt.io.files import replace_file
from mpmopt.optimisation.history import Candidate, Iteration, Optimisation, StageState
from mpmopt.optimisation.settings import Settings
from mpmopt.scene import Scene
from mpmopt.validation import instance, place

FORMAT, VERSION = "mpmopt run", 6
WHOLE = tuple(f.name for f in dataclasses.fields(Iteration) if f.type == "int")
# For each constraint or scene one.
TUPLES = tuple(f.name for f in dataclasses.fields(Iteration) if f.type == "tuple[float, ...]")
COLUMNS = tuple(f.name for f in dataclasses.fields(Iteration) if f.type in ("int", "float"))

PLACE = ("stage", "reason", "gave_up", "stop_reason")  # where a run stands


@dataclass(frozen=True)
class RunFile:
    """What a run file holds.

    Attributes
    ----------
    run : Optimisation
        As it stood: `loop.go_on` goes on with it.
    versions : dict of str to str
        Of this package and of those it computes with.
    summary : dict
        That of `summary.summarise`; empty if there is none yet.
    baseline : (D,) array of bool, optional
        Which design particles the baseline design has, if there is one.
    full_study : bool, optional
        Whether the finished robot is to be tried in all ways of `robustness.study`.
    """

    run: Optimisation
    versions: dict[str, str]
    summary: dict[str, Any] = field(default_factory=dict)
    baseline: NDArray[np.bool_] | None = field(default=None, repr=False)
    full_study: bool = False


def write(
    path: str | os.PathLike[str],
    run: Optimisation,
    summary: Mapping[str, Any] | None = None,
    baseline: NDArray[np.bool_] | None = None,
    full_study: bool = False,
) -> None:
    """Write a run as it stands; an older file of that name is replaced only by a complete one.

    Parameters
    ----------
    path : str or path
    run : Optimisation
    summary : mapping, optional
        Of a finished run.
    baseline : (D,) array of bool, optional
    full_study : bool, optional
        As in `RunFile`.

    Raises
    ------
    StorageError
        If the file cannot be written, or nothing would read it back; an older one is still whole.
    """
    path = place("runfile.write", "path", path)
    instance("runfile.write", "run", run, Optimisation)
    with file_in_memory() as file:
        _fill(file, run)
        file.attrs["summary"] = json.dumps(dict(summary or {}))
        file.attrs["full_study"] = bool(full_study)
        if baseline is not None:
            file.create_dataset("baseline", data=baseline, dtype="?")
        file.flush()
        image = file.id.get_file_image()
    if len(image) + SEAL > LARGEST:
        raise StorageError(
            f"{path} would have {len(image):.3g} bytes, more than {LARGEST:.0e}, which nothing "
            "reads back; take fewer stages or fewer particles"
        )
    replace_file(path, sealed(image))


def _fill(file: h5py.File, run: Optimisation) -> None:
    file.attrs["format"], file.attrs["version"] = FORMAT, VERSION
    file.attrs["scene"] = run.scene.to_json()
    file.attrs["task"] = run.task.to_json()
    file.attrs["settings"] = json.dumps(dataclasses.asdict(run.settings))
    file.attrs["versions"] = json.dumps(versions())
    for name in PLACE:
        file.attrs[name] = getattr(run, name)
    file.create_dataset("x", data=run.x, dtype="f8")
    for stage, item in run.best.items():
        _write_candidate(file, f"stages/{stage}", item)
    for name in COLUMNS:
        column = np.array([getattr(item, name) for item in run.history], dtype=float)
        file.create_dataset(f"history/{name}", data=column, dtype="f8")
    for name in TUPLES:
        rows = np.array([getattr(item, name) for item in run.history], dtype=float)
        shape = (len(run.history), _width(name, run.task))
        file.create_dataset(f"history/{name}", data=rows.reshape(shape), dtype="f8")
    file.create_dataset(
        "history/failure", data=[i.failure for i in run.history], dtype=h5py.string_dtype()
    )
    if run.designs and len(run.designs) == len(run.history):  # a run that was begun before has none
        file.create_dataset("designs", data=np.array(run.designs), dtype="u1")
    for name in ("first", "last"):
        _write_candidate(file, name, getattr(run, name))
    if run.stage_state is not None:
        _write_stage(file.create_group("stage"), run.stage_state)
    if run.best:
        x, gamma = run.result.x, run.result.gamma
        group = file.create_group("best")
        group.attrs["stage"] = run.result.stage
        for name, value in {"gamma": gamma, **Variables.of(x, run.scene)._asdict()}.items():
            group.create_dataset(name, data=value, dtype="f8")


def _write_candidate(parent: h5py.Group, name: str, item: Candidate | None) -> None:
    if item is None:
        return
    group = parent.create_group(name)
    group.create_dataset("x", data=item.x, dtype="f8")
    group.create_dataset("gamma", data=item.gamma, dtype="f8")
    for key, value in item.numbers().items():
        if key in TUPLES:
            group.create_dataset(key, data=value, dtype="f8")
        else:
            group.attrs[key] = value


def _write_stage(group: h5py.Group, state: StageState) -> None:
    group.attrs["time_step"], group.attrs["failures"] = state.time_step, state.failures
    for name in ("values", "gradients", "incumbent_gradients"):
        group.create_dataset(name, data=getattr(state, name), dtype="f8")
    _write_candidate(group, "incumbent", state.incumbent)
    for name, value in state.mma.items():
        group.create_dataset(f"mma/{name}", data=value, dtype="f8")


def versions() -> dict[str, str]:
    """Of this package and of those it computes with."""
    import numba
    import scipy

    return {
        "mpmopt": mpmopt.__version__,
        "python": platform.python_version(),
        "numba": numba.__version__,
        "numpy": np.__version__,
        "scipy": scipy.__version__,
        "h5py": h5py.__version__,
    }


def read_run(path: str | os.PathLike[str]) -> RunFile:
    """Read a run file.

    Raises
    ------
    RunFileError
        If it does not exist, is no run file, is damaged or of another version.
    """
    path = place("runfile.read", "path", path)
    with refusing(path, "run file", RunFileError):
        if not path.is_file():
            what = "is no file" if path.exists() else "is not there"
            raise RunFileError(f"{path} {what}; give the path of a run.h5")
        with unsealed(path, "run file") as file:
            return _read(file, path)


def _read(file: h5py.File, path: Path) -> RunFile:
    if file.attrs.get("format") != FORMAT:
        raise RunFileError(f"{path} is HDF5 but no run file of mpmopt")
    if file.attrs["version"] != VERSION:
        raise RunFileError(
            f"{path} is a run file of version {file.attrs['version']}, this mpmopt reads version "
            f"{VERSION}; its versions: {file.attrs.get('versions')}"
        )
    settings = Settings.from_dict(json.loads(file.attrs["settings"]))
    task = Task.from_json(file.attrs["task"])
    run = Optimisation(
        scene=Scene.from_json(file.attrs["scene"]),
        settings=settings,
        task=task,
        x=_numbers(file, "x"),
        stage=int(file.attrs["stage"]),
        reason=str(file.attrs["reason"]),
        gave_up=bool(file.attrs["gave_up"]),
        best=_read_best(file.get("stages", {}), len(settings.stages)),
        history=_read_history(file["history"], task),
        designs=_read_designs(file["designs"]) if "designs" in file else [],
        first=_read_candidate(file, "first"),
        last=_read_candidate(file, "last"),
        stage_state=_read_stage(file["stage"]) if "stage" in file else None,
        stop_reason=str(file.attrs["stop_reason"]),
    )
    if not 0 <= run.stage <= len(settings.stages):
        raise ValueError(f"stage {run.stage} of {len(settings.stages)}")
    return RunFile(
        run,
        versions=json.loads(file.attrs["versions"]),
        summary=dict(json.loads(file.attrs["summary"])),
        baseline=_read_baseline(file["baseline"]) if "baseline" in file else None,
        full_study=bool(file.attrs.get("full_study", False)),  # a later addition
    )


def _read_baseline(dataset: h5py.Dataset) -> NDArray[np.bool_]:
    if not isinstance(dataset, h5py.Dataset) or dataset.dtype != bool or dataset.ndim != 1:
        raise ValueError("baseline has not one axis of True and False")
    return np.asarray(dataset[:])


def _width(name: str, task: Task) -> int:
    """How many numbers an evaluation has of those in `TUPLES`."""
    return len(task.scenes if name == "scenes" else task.subject_to)


def _read_history(group: h5py.Group, task: Task) -> list[Iteration]:
    columns: dict[str, Any] = {name: _numbers(group, name).tolist() for name in COLUMNS}
    columns["failure"] = group["failure"].asstr()[:].tolist()
    for name in TUPLES:
        rows = _numbers(group, name, 2)
        if rows.shape[1] != _width(name, task):
            raise ValueError(f"{name}: {rows.shape[1]} columns, its task has {_width(name, task)}")
        columns[name] = list(map(tuple, rows.tolist()))
    for name in WHOLE:
        columns[name] = [int(value) for value in columns[name]]
    if len({len(column) for column in columns.values()}) != 1:
        raise ValueError("the history's columns have different lengths")
    return [Iteration(**dict(zip(columns, row))) for row in zip(*columns.values())]


def _read_designs(dataset: h5py.Dataset) -> list[NDArray[np.uint8]]:
    if not isinstance(dataset, h5py.Dataset) or dataset.dtype != np.uint8 or dataset.ndim != 2:
        raise ValueError("designs has not two axes of bytes")
    return list(dataset[:])


def _read_best(group: h5py.Group, stages: int) -> dict[int, Candidate]:
    best = {}
    for name in sorted(group, key=int):
        item = _read_candidate(group, name)
        if item is None or item.stage != int(name) or not 0 <= item.stage < stages:
            raise ValueError(f"a design of stage {name} of {stages}")
        best[item.stage] = item
    return best


def _read_candidate(parent: h5py.Group, name: str) -> Candidate | None:
    if name not in parent:
        return None
    group = parent[name]
    numbers: dict[str, Any] = {key: float(group.attrs[key]) for key in COLUMNS}
    numbers.update({key: int(group.attrs[key]) for key in WHOLE})
    numbers.update({key: tuple(_numbers(group, key).tolist()) for key in TUPLES})
    failure = str(group.attrs["failure"])
    return Candidate(
        **numbers, failure=failure, x=_numbers(group, "x"), gamma=_numbers(group, "gamma")
    )


def _read_stage(group: h5py.Group) -> StageState:
    state = StageState(
        time_step=float(group.attrs["time_step"]),
        failures=int(group.attrs["failures"]),
        values=_numbers(group, "values"),
        gradients=_numbers(group, "gradients", 2),
        incumbent=_read_candidate(group, "incumbent"),
        incumbent_gradients=_numbers(group, "incumbent_gradients", 2),
        mma={name: item[()] for name, item in group["mma"].items()},
    )
    incumbent = 0 if state.incumbent is None else state.incumbent.x.size
    wrong = state.incumbent_gradients.shape[1] != incumbent
    if wrong or (state.gradients.size and not state.values.size):
        raise ValueError("a stage whose values, gradients and designs do not fit together")
    return state


def _numbers(group: h5py.Group, name: str, axes: int = 1) -> NDArray[np.float64]:
    dataset = group[name]
    if not isinstance(dataset, h5py.Dataset) or dataset.dtype != np.float64 or dataset.ndim != axes:
        raise ValueError(f"{group.name}/{name} has not {axes} axes of 64-bit numbers")
    return np.asarray(dataset[:], dtype=float)
