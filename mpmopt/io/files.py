"""Files that are complete or absent, in folders that one process at a time works in; tables."""

from __future__ import annotations

import csv
import fcntl
import io
import logging
import os
import re
import tempfile
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any
from uuid import uuid4

from mpmopt.errors import StorageError

logger = logging.getLogger(__name__)


def replace_file(path: str | os.PathLike[str], content: bytes) -> None:
    """Write a file that is complete or absent; an older one stays until the new one is complete.

    Raises
    ------
    StorageError
        If it cannot be written.
    """
    path = Path(path)
    new = path.with_name(f"{_unfinished(path)}{uuid4().hex}")
    try:
        with new.open("xb") as file:
            file.write(content)
            file.flush()
            os.fsync(file.fileno())
        os.replace(new, path)
    except OSError as error:
        raise StorageError(
            f"cannot write {len(content)} bytes to {path}: {error}; make room or choose another "
            "folder"
        ) from error
    finally:
        with suppress(OSError):
            new.unlink(missing_ok=True)


def as_csv(rows: Sequence[Mapping[str, Any]], digits: int = 6) -> str:
    """Rows of the same names as comma-separated values, numbers with so many digits."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(rows[0])
    for row in rows:
        cells = (row[name] for name in rows[0])
        writer.writerow(f"{v:.{digits}g}" if isinstance(v, float) else v for v in cells)
    return text.getvalue()


def refuse_existing(paths: Iterable[Path], force: bool = False) -> None:
    """Refuse to replace what is there already.

    Raises
    ------
    StorageError
        If some are there, and it is not forced.
    """
    there = [str(path) for path in paths if os.path.lexists(path)]
    if there and not force:
        raise StorageError(
            f"{', '.join(there)} {'are' if there[1:] else 'is'} there already; choose another "
            "place with --out, or --force to replace what is there"
        )


def make_folder(folder: Path) -> None:
    """Make a folder, if it is not there, and see that files can be written to it.

    Raises
    ------
    StorageError
        If not.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            pass
    except OSError as error:
        raise StorageError(f"cannot write to {folder}: {error}; choose another folder") from error


def _unfinished(path: Path) -> str:
    return f".{path.name}-"


@contextmanager
def locked(path: Path) -> Iterator[None]:
    """Let no other process of this kind work on a file, and remove what killed ones left of it.

    The lock is one on the file's folder: it leaves nothing behind and ends with the process. File
    systems without locks only warn.

    Raises
    ------
    StorageError
        If another process has the lock, or there is no such folder.
    """
    try:
        folder = os.open(path.parent, os.O_RDONLY)
    except OSError as error:
        raise StorageError(f"cannot open the folder of {path}: {error}") from error
    try:
        try:
            fcntl.flock(folder, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            raise StorageError(
                f"another process is at work in {path.parent}; wait for it, or choose another "
                "folder"
            ) from error
        except OSError as error:
            logger.warning("no lock on %s: %s; start no second process there", path, error)
        unfinished = re.compile(re.escape(_unfinished(path)) + "[0-9a-f]{32}")
        for left in path.parent.iterdir():
            if unfinished.fullmatch(left.name):
                with suppress(OSError):
                    left.unlink()
        yield
    finally:
        os.close(folder)
