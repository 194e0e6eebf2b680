"""The one file that a sweep leaves: its points and what came of them, in HDF5.

Layout (version 2)::

    attributes          format, version, function; versions of packages as JSON
    points/K/           point as JSON with sorted keys; error, empty if there is none
    points/K/result/    one number, text or array for each entry

A point is known by its content: K is the SHA-256 of that JSON, shortened. The file is sealed with
a digest of all its bytes (`checksums`), and replaced by a complete one whenever it is saved.
"""

from __future__ import annotations

import hashlib
import json
import logging
from collections.abc import Mapping
from contextlib import closing
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import h5py

from mpmopt.errors import SweepError
from mpmopt.io.checksums import file_in_memory, refusing, sealed, unsealed
from mpmopt.io.files import replace_file

logger = logging.getLogger(__name__)

FORMAT, VERSION, KIND = "mpmopt sweep", 2, "sweep's file"


@dataclass(frozen=True)
class Outcome:
    """What came of a point.

    Attributes
    ----------
    point : dict
    result : dict
        Of numbers, texts and arrays; empty if the point failed.
    error : str
        Why it failed, first the exception, then where; or empty.
    """

    point: dict[str, Any]
    result: dict[str, Any] = field(default_factory=dict)
    error: str = ""


class SweepFile:
    """A sweep's file in memory; what is put into it is on disk once it is saved.

    Parameters
    ----------
    path : Path
        If there is no such file, the sweep begins.
    function : str or None
        Name of the function of which it holds results; None for any.

    Raises
    ------
    SweepError
        If the file is of another kind or function, or damaged.
    """

    def __init__(self, path: Path, function: str | None) -> None:
        from mpmopt.results.runfile import versions  # slow, and those who compute need it not

        self._path = path
        if not path.exists():
            file = file_in_memory()
            file.attrs["format"], file.attrs["version"] = FORMAT, VERSION
            file.attrs["function"], file.attrs["versions"] = function, json.dumps(versions())
            self._file, self._points = file, file.create_group("points", track_order=True)
            return
        with refusing(path, KIND, SweepError):
            self._file = file = unsealed(path, KIND, writable=True)
            found = tuple(file.attrs.get(name) for name in ("format", "version", "function"))
            if found != (FORMAT, VERSION, function or found[2]):
                raise SweepError(
                    f"{path} holds {found[0]!r}, version {found[1]}, of function {found[2]!r}, not "
                    f"{FORMAT!r}, version {VERSION}, of {function!r}; choose another file"
                )
            self._points = file["points"]
            self.outcomes()  # what cannot be read is found now
            before = json.loads(file.attrs["versions"])
            changed = {name: now for name, now in versions().items() if before.get(name) != now}
        if function and changed:
            logger.warning("%s was begun with %s; now it is %s", path, before, changed)

    def __getitem__(self, key: str) -> Outcome:
        """What came of a point, by its JSON."""
        return _outcome(self._points[_digest(key)])

    def outcomes(self) -> list[Outcome]:
        """All that the file holds, in order of arrival."""
        return [_outcome(group) for group in self._points.values()]

    def has(self, key: str) -> bool:
        """Whether there is a result of a point."""
        name = _digest(key)
        return name in self._points and not self._points[name]["error"].asstr()[()]

    def put(self, key: str, result: Mapping[str, Any], error: str) -> None:
        """Keep what came of a point; it replaces a failure."""
        name = _digest(key)
        if name in self._points:
            del self._points[name]
        group = self._points.create_group(name)
        group["point"], group["error"] = key, error
        inside = group.create_group("result", track_order=True)
        for entry, value in result.items():
            inside[entry] = value

    def save(self) -> None:
        """Replace the file on disk; a `StorageError` if that cannot be."""
        self._file.flush()
        replace_file(self._path, sealed(self._file.id.get_file_image()))

    def close(self) -> None:
        """Give the memory back."""
        self._file.close()


def read(path: Path) -> list[Outcome]:
    """All that a sweep's file holds, in order of arrival.

    Raises
    ------
    SweepError
        If it is not there, is of another kind or damaged.
    """
    path = Path(path)
    if not path.is_file():
        raise SweepError(f"{path} is not there; give the path of a sweep's file")
    with closing(SweepFile(path, None)) as file:
        return file.outcomes()


def _digest(key: str) -> str:
    return hashlib.sha256(key.encode()).hexdigest()[:20]


def _outcome(group: h5py.Group) -> Outcome:
    result = {}
    for name, dataset in group["result"].items():
        if h5py.check_string_dtype(dataset.dtype):
            result[name] = dataset.asstr()[()]
        else:
            result[name] = dataset[()] if dataset.ndim else dataset[()].item()
    point = json.loads(group["point"].asstr()[()])
    return Outcome(dict(point), result, group["error"].asstr()[()])
