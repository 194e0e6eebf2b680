"""Which particle states are kept for the reverse loop, and the HDF5 store that keeps them."""

from __future__ import annotations

import math
import os
import shutil
import tempfile
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Literal

import h5py
import numpy as np
from numpy.typing import NDArray

from mpmopt.errors import DesignError, StorageError

MEGABYTE = 1_000_000


@dataclass(frozen=True)
class Checkpointing:
    """What the user says about checkpoints; what is left open is chosen from the memory budget.

    Parameters
    ----------
    every : int or "all", optional
        Store the state of every k-th step and recompute the others, or store all and recompute
        none.
    memory : int, optional
        Budget in bytes for states, store included unless it is on disk.
    store : "memory", "disk" or Path, optional
        Where checkpoints go: HDF5's core driver, a scratch file in the system's temporary folder
        that is removed at the end, or a file that is kept.

    Raises
    ------
    DesignError
        If a value makes no sense.
    """

    every: int | Literal["all"] | None = None
    memory: int = 256 * MEGABYTE
    store: Path | Literal["memory", "disk"] | None = None

    def __post_init__(self) -> None:
        if self.every not in (None, "all") and not (
            isinstance(self.every, int) and self.every >= 1
        ):
            raise DesignError(f'every = {self.every!r} must be a whole number >= 1 or "all"')
        if not self.memory > 0:
            raise DesignError(f"memory = {self.memory!r} bytes must be above 0")
        if self.store not in (None, "memory", "disk") and not isinstance(self.store, Path):
            raise DesignError(f'store = {self.store!r} must be "memory", "disk" or a Path')


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
        """The schedule that recomputes least within the budget.

        All states stay in memory if they fit. Else segments of about sqrt(steps) steps need the
        least memory; the store moves to disk if it does not fit either.
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
        fits = (segment + 1 + stored) * step_bytes <= wish.memory
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
    """HDF5 file of arrays by segment, made at once and removed at the end unless it was asked for.

    Parameters
    ----------
    schedule : Schedule
    store : "memory", "disk", Path or None
        As in `Checkpointing`; a Path is kept.

    Raises
    ------
    StorageError
        If the file cannot be made or the disk has too little room for what will come.
    """

    def __init__(
        self, schedule: Schedule, store: Path | Literal["memory", "disk"] | None = None
    ) -> None:
        self.schedule = schedule
        self.path: Path | None = store if isinstance(store, Path) else None
        self._keep = self.path is not None
        try:
            if schedule.in_memory:
                self._file = h5py.File(
                    "checkpoints", "w", driver="core", backing_store=False, block_size=MEGABYTE
                )
                return
            if self.path is None:
                handle, name = tempfile.mkstemp(prefix="mpmopt-", suffix=".h5")
                os.close(handle)
                self.path = Path(name)
            free = shutil.disk_usage(self.path.parent).free
            if free < schedule.stored_bytes:
                self._remove()
                raise StorageError(
                    f"checkpoints need {schedule.stored_bytes / MEGABYTE:.0f} MB but "
                    f"{self.path.parent} has {free / MEGABYTE:.0f} MB free; store fewer states "
                    "(Checkpointing.every), or put them elsewhere (Checkpointing.store, or the "
                    "environment variable TMPDIR)"
                )
            self._file = h5py.File(self.path, "w")
        except OSError as error:
            if isinstance(error, StorageError):
                raise
            self._remove()
            raise StorageError(f"cannot make the checkpoint file {self.path}: {error}") from error

    def write(self, segment: int, **arrays: NDArray) -> None:
        """Store named arrays of a segment."""
        try:
            for name, array in arrays.items():
                self._file.create_dataset(f"{segment}/{name}", data=array, dtype=array.dtype)
            self._file.flush()  # an error in writing what HDF5 holds back would pass unseen
        except (OSError, RuntimeError) as error:
            size = sum(array.nbytes for array in arrays.values())
            raise StorageError(
                f"cannot store {size} bytes of segment {segment} in "
                f"{self.path or 'memory'}: {error}; make room, or store fewer states "
                "(Checkpointing.every)"
            ) from error

    def read(self, segment: int, name: str) -> NDArray:
        """An array of a segment, as it was written."""
        try:
            return np.asarray(self._file[f"{segment}/{name}"][()])
        except (OSError, KeyError, RuntimeError) as error:
            raise StorageError(
                f"cannot read {name} of segment {segment} back from {self.path or 'memory'}: "
                f"{error}; run again, with the file out of other programs' reach"
            ) from error

    def close(self) -> None:
        """Close the store, and remove it unless it is to be kept.

        Raises
        ------
        StorageError
            If a file that is to be kept could not be completed.
        """
        try:
            self._file.close()
        except (OSError, RuntimeError) as error:
            if self._keep:
                raise StorageError(f"cannot complete {self.path}: {error}; make room") from error
        finally:
            if not self._keep:
                self._remove()

    def _remove(self) -> None:
        if self.path is not None:
            self.path.unlink(missing_ok=True)

    def __enter__(self) -> Checkpoints:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        try:
            self.close()
        except StorageError:
            if error is None:
                raise
