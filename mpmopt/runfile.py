"""The one file that a run leaves: scene, settings, versions, history and designs, in HDF5.

Layout (version 2)::

    attributes       format, version, stop_reason; as JSON: scene, settings, versions, summary
    history/NAME     one entry per evaluation: objective, beta, greyness, step, ...
    stages/K/        best design of stage K: x, gamma; attributes of its evaluation
    best/            the best of all, with phi, a, theta, b spelled out; attribute stage
"""

from __future__ import annotations

import dataclasses
import json
import os
import platform
import tempfile
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from uuid import uuid4

import h5py
import numpy as np
from numpy.typing import NDArray

import mpmopt
from mpmopt.errors import MpmoptError, RunFileError, StorageError
from mpmopt.optimize import Iteration, Optimisation, Settings, Stage
from mpmopt.problem import Problem, Variables
from mpmopt.scene import Scene

FORMAT, VERSION = "mpmopt run", 2
COLUMNS = tuple(f.name for f in dataclasses.fields(Iteration) if f.type in ("int", "float"))


@dataclass(frozen=True)
class RunFile:
    """What a run file holds.

    Attributes
    ----------
    scene : Scene
    settings : Settings
    versions : dict of str to str
        Of this package and of those it computes with.
    history : dict of str to (n,) array
        Columns named as the fields of `Iteration`.
    designs : dict of int to (n,) array
        The best design of each stage that had one.
    time_steps : dict of int to float
        In which these were evaluated.
    best_stage : int or None
        Stage of the best design of all; None if no evaluation succeeded.
    stop_reason : str
        Empty if the run was not finished.
    summary : dict
        That of `case.summarise`; empty if there is none yet.
    """

    scene: Scene
    settings: Settings
    versions: dict[str, str]
    history: dict[str, NDArray]
    designs: dict[int, NDArray[np.float64]]
    time_steps: dict[int, float]
    best_stage: int | None
    stop_reason: str
    summary: dict[str, Any]

    @property
    def best(self) -> NDArray[np.float64]:
        """The best design of all.

        Raises
        ------
        RunFileError
            If there is none: the run failed or was stopped before its first evaluation.
        """
        return self.designs[self._stage(None)]

    def problem(self, stage: int | None = None) -> Problem:
        """The problem that a stage solved, by default that of the best design."""
        index = self._stage(stage)
        return self.settings.stages[index].problem(self.scene, self.time_steps[index])

    def _stage(self, stage: int | None) -> int:
        index = self.best_stage if stage is None else stage
        if index not in self.designs:
            raise RunFileError(f"the run file holds no design of stage {index}")
        return index


def write(path: Path, run: Optimisation, summary: Mapping[str, Any] | None = None) -> None:
    """Write a run as it stands; an older file of that name is replaced only by a complete one.

    Parameters
    ----------
    path : Path
    run : Optimisation
    summary : mapping, optional
        Of a finished run.

    Raises
    ------
    StorageError
        If the file cannot be written; an older one is still whole.
    """
    # HDF5 does not survive a write that fails, so it writes to memory only.
    with h5py.File(f"run-{uuid4()}", "w", driver="core", backing_store=False) as file:
        _fill(file, run)
        file.attrs["summary"] = json.dumps(dict(summary or {}))
        file.flush()
        image = file.id.get_file_image()
    replace_file(Path(path), image)


def replace_file(path: Path, content: bytes) -> None:
    """Write a file that is complete or absent; an older one stays until the new one is complete.

    Raises
    ------
    StorageError
        If it cannot be written.
    """
    new = None
    try:
        handle, name = tempfile.mkstemp(prefix=f".{path.name}-", dir=path.parent)
        new = Path(name)
        with os.fdopen(handle, "wb") as file:
            file.write(content)
            file.flush()
            os.fsync(file.fileno())
        new.chmod(0o644)
        os.replace(new, path)
    except OSError as error:
        raise StorageError(
            f"cannot write {len(content)} bytes to {path}: {error}; make room or choose another "
            "folder"
        ) from error
    finally:
        if new is not None:
            new.unlink(missing_ok=True)


def _fill(file: h5py.File, run: Optimisation) -> None:
    file.attrs["format"], file.attrs["version"] = FORMAT, VERSION
    file.attrs["scene"] = run.scene.to_json()
    file.attrs["settings"] = json.dumps(dataclasses.asdict(run.settings))
    file.attrs["versions"] = json.dumps(_versions())
    file.attrs["stop_reason"] = run.stop_reason
    for name in COLUMNS:
        column = np.array([getattr(item, name) for item in run.history], dtype=float)
        file.create_dataset(f"history/{name}", data=column, dtype="f8")
    file.create_dataset(
        "history/failure", data=[i.failure for i in run.history], dtype=h5py.string_dtype()
    )
    for stage, item in run.best.items():
        group = file.create_group(f"stages/{stage}")
        group.create_dataset("x", data=item.x, dtype="f8")
        group.create_dataset("gamma", data=item.gamma, dtype="f8")
        for name in COLUMNS:
            group.attrs[name] = getattr(item, name)
    if run.best:
        x, gamma = run.result.x, run.result.gamma
        group = file.create_group("best")
        group.attrs["stage"] = run.result.stage
        for name, value in {"gamma": gamma, **Variables.of(x, gamma.size)._asdict()}.items():
            group.create_dataset(name, data=value, dtype="f8")


def _versions() -> dict[str, str]:
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


def read(path: Path) -> RunFile:
    """Read a run file.

    Raises
    ------
    RunFileError
        If it does not exist, is no run file, is damaged or of another version.
    """
    path = Path(path)
    if not path.is_file():
        raise RunFileError(f"{path} is not there; give the path of a run.h5")
    try:
        with h5py.File(path, "r") as file:
            if file.attrs.get("format") != FORMAT:
                raise RunFileError(f"{path} is HDF5 but no run file of mpmopt")
            if file.attrs["version"] != VERSION:
                raise RunFileError(
                    f"{path} is a run file of version {file.attrs['version']}, this mpmopt reads "
                    f"version {VERSION}; its versions: {file.attrs.get('versions')}"
                )
            settings = json.loads(file.attrs["settings"])
            settings["stages"] = tuple(Stage(**stage) for stage in settings["stages"])
            history: dict[str, Any] = {name: _numbers(file, f"history/{name}") for name in COLUMNS}
            history["failure"] = file["history/failure"].asstr()[:]
            stages = sorted(int(name) for name in file["stages"]) if "stages" in file else []
            if any(not 0 <= stage < len(settings["stages"]) for stage in stages):
                raise ValueError(f"designs of stages {stages} of {len(settings['stages'])}")
            if len({len(column) for column in history.values()}) != 1:
                raise ValueError("the history's columns have different lengths")
            return RunFile(
                scene=Scene.from_json(file.attrs["scene"]),
                settings=Settings(**settings),
                versions=json.loads(file.attrs["versions"]),
                history=history,
                designs={stage: _numbers(file, f"stages/{stage}/x") for stage in stages},
                best_stage=int(file["best"].attrs["stage"]) if "best" in file else None,
                time_steps={k: float(file[f"stages/{k}"].attrs["time_step"]) for k in stages},
                stop_reason=str(file.attrs["stop_reason"]),
                summary=dict(json.loads(file.attrs["summary"])),
            )
    except MpmoptError as error:
        if isinstance(error, RunFileError):
            raise
        raise RunFileError(f"{path} is damaged: {error}") from error
    except (OSError, KeyError, ValueError, TypeError, RuntimeError, AttributeError) as error:
        raise RunFileError(f"{path} is no run file, or damaged: {error}") from error


def _numbers(file: h5py.File, name: str) -> NDArray[np.float64]:
    dataset = file[name]
    if not isinstance(dataset, h5py.Dataset) or dataset.dtype != np.float64 or dataset.ndim != 1:
        raise ValueError(f"{name} is no column of 64-bit numbers")
    return np.asarray(dataset[:], dtype=float)
