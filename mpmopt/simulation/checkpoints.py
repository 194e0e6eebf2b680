"""Which particle states are kept for the reverse loop, and the store, in memory or HDF5."""

from __future__ import annotations

import math
import os
import shutil
import tempfile
import zlib
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import h5py
import numpy as np
from numpy.typing import DTypeLike, NDArray

from mpmopt.errors import DesignError, StorageError
from mpmopt.scene.parts import Checked
from mpmopt.validation import count, number

MEGABYTE = 1_000_000


@dataclass(frozen=True)
class Checkpointing(Checked):
    """What the user says about checkpoints; what is left open is chosen from the memory budget.

    Parameters
    ----------
    every : int or "all", optional
        Store the state of every k-th step and recompute the others, or store all and recompute
        none.
    memory : int, optional
        Budget in bytes for states, store included unless it is on disk.
    store : "memory" or "disk", optional
        Where checkpoints go: plain arrays, or a scratch file (HDF5) in the system's temporary
        folder.

    Raises
    ------
    DesignError
        If a value makes no sense.
    """

    every: int | Literal["all"] | None = None
    memory: int = 256 * MEGABYTE
    store: Literal["memory", "disk"] | None = None

    def __post_init__(self) -> None:
        name = "Checkpointing"
        if self.every not in (None, "all"):
            every = count(name, 'every (or "all")', self.every, 1, error=DesignError)
            self._set(every=every)
        memory = number(name, "memory", self.memory, above=0.0, error=DesignError)
        self._set(memory=int(memory))
        if self.store not in (None, "memory", "disk"):
            raise DesignError(f'{name}: store = {self.store!r} must be "memory" or "disk"')


@dataclass(frozen=True)
class Schedule:
    """Steps cut into segments of equal length; the last may be shorter and is never stored whole.

    Read aloud: advance segment by segment, storing the first state of each (or all of it); then,
    from the last segment to the first, recompute (or read back) its states and go back through it.
    The last segment is still in memory when the forward run ends.

    Attributes
    ----------
    steps : int
    segment : int
        Steps of a segment.
    all_stored : bool
        Whether whole segments are stored, so that nothing is recomputed.
    in_memory : bool
        Whether the store is held in memory.
    step_bytes : int
        Bytes that one step needs: particle states and nodes.
    """

    steps: int
    segment: int
    all_stored: bool
    in_memory: bool
    step_bytes: int

    @classmethod
    def choose(cls, steps: int, step_bytes: int, wish: Checkpointing) -> Schedule:
        """The schedule for a wish.

        All states stay in memory if they fit. Else segments of about sqrt(steps) steps need the
        least memory, for one more forward run; the store moves to disk if it does not fit either.
        """
        root = math.isqrt(steps - 1) + 1
        if wish.every == "all":
            segment, stored = root, steps
        elif wish.every is not None:
            segment = min(wish.every, steps)
            stored = math.ceil(steps / segment)
        elif steps * step_bytes <= wish.memory:
            segment, stored = steps, 1
        else:
            segment, stored = root, root
            if (segment + 1) * step_bytes > wish.memory:
                segment = max(1, wish.memory // step_bytes - 1)
                stored = math.ceil(steps / segment)
        fits = stored == 1 or (segment + 1 + stored) * step_bytes <= wish.memory
        in_memory = wish.store == "memory" or (wish.store is None and fits)
        return cls(steps, segment, wish.every == "all", in_memory, step_bytes)

    @property
    def segments(self) -> list[tuple[int, int]]:
        """First step of each segment and the step after its last."""
        return [
            (first, min(first + self.segment, self.steps))
            for first in range(0, self.steps, self.segment)
        ]

    @property
    def steps_recomputed(self) -> int:
        """Steps that are computed a second time."""
        return 0 if self.all_stored else self.segments[-1][0]

    @property
    def stored_bytes(self) -> int:
        """Bytes that the store takes."""
        before_last = self.segments[-1][0] + len(self.segments) - 1
        return (before_last if self.all_stored else len(self.segments)) * self.step_bytes


class Checkpoints:
    """Room for arrays of every segment: in memory, or in an HDF5 file that goes at the end.

    All room of the file is taken before the first step: a disk that is full, or that fills up
    meanwhile, costs no computed step, and HDF5, which does not survive it, never meets a write that
    fails.

    Parameters
    ----------
    schedule : Schedule
    arrays : mapping of str to (shape, dtype)
        What is stored of each segment. Each dataset begins with an axis of the segments.

    Raises
    ------
    StorageError
        If the file cannot be made, or memory or disk have too little room.
    """

    def __init__(
        self, schedule: Schedule, arrays: Mapping[str, tuple[tuple[int, ...], DTypeLike]]
    ) -> None:
        self.schedule = schedule
        self._path: Path | None = None
        self._file: h5py.File | None = None
        self._store: dict[str, Any]  # arrays or datasets
        self._sums: dict[tuple[int, str], tuple[tuple[slice, ...], int]] = {}  # of a file's parts
        if schedule.in_memory:
            try:
                self._store = {
                    name: np.empty((len(schedule.segments), *shape), dtype)
                    for name, (shape, dtype) in arrays.items()
                }
            except MemoryError as error:
                raise StorageError(
                    f"no memory for checkpoints of {schedule.stored_bytes / MEGABYTE:.3g} MB: "
                    f"{error}; store fewer states (Checkpointing.every), or put them on disk"
                ) from error
            return
        try:
            handle, name = tempfile.mkstemp(prefix="mpmopt-", suffix=".h5")
            os.close(handle)
            self._path = Path(name)
            sizes = (
                np.dtype(dtype).itemsize * math.prod(shape) for shape, dtype in arrays.values()
            )
            size = len(schedule.segments) * sum(sizes) + MEGABYTE
            _take_room(self._path, size)  # twice, because HDF5 begins with an empty file
            with h5py.File(self._path, "w") as file:
                _lay_out(file, len(schedule.segments), arrays)
            _take_room(self._path, self._path.stat().st_size)
            self._file = h5py.File(self._path, "r+")
            self._store = dict(self._file)
            with suppress(OSError):  # some systems remove no open file
                self._path.unlink()  # nobody can touch it, and nothing is left if we are killed
        except OSError as error:
            self.close()
            raise StorageError(
                f"no room for checkpoints of {schedule.stored_bytes / MEGABYTE:.3g} MB in "
                f"{tempfile.gettempdir()}: {error}; store fewer states (Checkpointing.every), or "
                "put them elsewhere (the environment variable TMPDIR)"
            ) from error

    def write(self, segment: int, **arrays: NDArray) -> None:
        """Store named arrays of a segment; they may be shorter than the room for them."""
        for name, array in arrays.items():
            where = tuple(map(slice, array.shape))
            place = (segment, *where)
            self._store[name][place] = array
            if not self.schedule.in_memory:
                self._sums[segment, name] = where, _checksum(array)

    def read(self, segment: int, name: str) -> NDArray:
        """An array of a segment, with all the room that it has.

        Raises
        ------
        StorageError
            If the file lost it.
        """
        try:
            array = np.asarray(self._store[name][segment])
            array.setflags(write=False)  # it may be a view of the store
            if (segment, name) in self._sums:
                where, checksum = self._sums[segment, name]
                if _checksum(array[where]) != checksum:
                    raise OSError("it is not what was written")
            return array
        except (OSError, KeyError, RuntimeError) as error:
            raise StorageError(
                f"cannot read {name} of segment {segment} back from the store: "
                f"{error}; run again, with the file out of other programs' reach"
            ) from error

    def close(self) -> None:
        """Close the store and remove its file."""
        if self._file is not None:
            self._file.close()
        if self._path is not None:
            self._path.unlink(missing_ok=True)

    def __enter__(self) -> Checkpoints:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def _lay_out(
    file: h5py.File, segments: int, arrays: Mapping[str, tuple[tuple[int, ...], DTypeLike]]
) -> None:
    settings = h5py.h5p.create(h5py.h5p.DATASET_CREATE)
    settings.set_alloc_time(h5py.h5d.ALLOC_TIME_EARLY)
    settings.set_fill_time(h5py.h5d.FILL_TIME_NEVER)
    for name, (shape, dtype) in arrays.items():
        space = h5py.h5s.create_simple((segments, *shape))
        kind = h5py.h5t.py_create(np.dtype(dtype))
        h5py.h5d.create(file.id, name.encode(), kind, space, dcpl=settings)


def _take_room(path: Path, size: int) -> None:
    with path.open("ab") as file:
        free = shutil.disk_usage(path.parent).free
        if free < size:
            raise OSError(f"{size / MEGABYTE:.3g} MB needed, {free / MEGABYTE:.3g} MB free")
        if hasattr(os, "posix_fallocate"):
            os.posix_fallocate(file.fileno(), 0, size)


def _checksum(array: NDArray) -> int:
    return zlib.crc32(np.ascontiguousarray(array).data)
