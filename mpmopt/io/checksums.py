"""HDF5 files that end in their own digest: anybody's may be opened, and a damaged one is refused.

A digest (SHA-256) of all bytes stands behind the end of the HDF5 file, where HDF5 does not look.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from uuid import uuid4

import h5py
import numpy as np

from mpmopt.errors import MpmoptError

LARGEST = 10**9  # bytes of a file
SEAL = 80  # bytes of the digest at the end


def file_in_memory() -> h5py.File:
    """A new HDF5 file in memory: HDF5 does not survive a write to a disk that fails."""
    return h5py.File(str(uuid4()), "w", driver="core", backing_store=False)


def sealed(image: bytes) -> bytes:
    """The bytes of an HDF5 file and, where HDF5 does not look, their digest."""
    return image + b"\nmpmopt sha256 %s\n" % hashlib.sha256(image).hexdigest().encode()


def unsealed(path: Path, kind: str, writable: bool = False) -> h5py.File:
    """A sealed file, read once and then in memory: what is changed there stays there.

    No lock is taken, for such files are replaced as a whole.

    Raises
    ------
    ValueError
        If it was cut or changed since it was sealed, or holds what no file of this package does.
    OSError
        If it cannot be read.
    """
    size = path.stat().st_size
    if size > LARGEST:
        raise ValueError(f"it has {size} bytes, more than {LARGEST:.0e}: no {kind} is so large")
    content = path.read_bytes()
    image = content[:-SEAL]
    found, wanted = sealed(image)[-SEAL:], content[-SEAL:]
    # HDF5 may read a damaged file for ever, so it sees none.
    if not wanted.startswith(b"\nmpmopt sha256 "):
        if not content.startswith(b"\x89HDF"):
            raise ValueError(f"it is no HDF5 file: give the path of a {kind}")
        raise ValueError("it has no digest at its end: it is of an older mpmopt, or was cut")
    if found != wanted:
        raise ValueError(
            f"its content has the digest {found[15:27].decode()}..., its own is "
            f"{wanted[15:27].decode(errors='replace')}...; take a copy of it"
        )
    flags = h5py.h5f.FILE_IMAGE_OPEN_RW if writable else 0
    file = h5py.File(h5py.h5f.open_file_image(image, flags))
    _refuse_foreign(file, {h5py.h5o.get_info(file.id).addr}, size)
    return file


@contextmanager
def refusing(path: Path, kind: str, error: type[MpmoptError]) -> Iterator[None]:
    """Turn whatever a file makes go wrong while it is read into one error that names it."""
    try:
        yield
    except error:
        raise
    except (
        MpmoptError, OSError, LookupError, ValueError, TypeError, RuntimeError, AttributeError,
        ArithmeticError, MemoryError,
    ) as found:  # fmt: skip
        raise error(f"{path} is no {kind}, or damaged: {found}") from found


def _refuse_foreign(group: h5py.Group, seen: set[int], size: int) -> None:
    """Refuse what no file of this package holds, before any of it is read: it may be anybody's.

    All must be in the file itself, under one name, whole, as long as it says, and numbers or text.
    """
    _refuse_attributes(group)
    for name in group:
        where = f"{group.name.rstrip('/')}/{name}"
        link = group.get(name, getlink=True)
        if not isinstance(link, h5py.HardLink):
            raise ValueError(f"{where} leads elsewhere: {type(link).__name__}")
        item = group[name]
        address = h5py.h5o.get_info(item.id).addr
        if address in seen:
            raise ValueError(f"{where} has another name too")
        seen.add(address)
        if isinstance(item, h5py.Group):
            _refuse_foreign(item, seen, size)
            continue
        if not isinstance(item, h5py.Dataset) or not _is_plain(item.dtype):
            raise ValueError(f"{where} holds neither numbers nor text")
        _refuse_attributes(item)
        stored = item.id.get_create_plist()
        if stored.get_layout() not in (h5py.h5d.CONTIGUOUS, h5py.h5d.COMPACT):
            raise ValueError(f"{where} is not stored in one piece")
        if stored.get_external_count():
            raise ValueError(f"{where} is stored in another file")
        if item.nbytes > size:
            raise ValueError(f"{where} claims {item.nbytes} bytes of a file that has {size}")


def _refuse_attributes(item: h5py.Group | h5py.Dataset) -> None:
    for name in item.attrs:
        kind = item.attrs.get_id(name)
        if kind.shape != () or not _is_plain(kind.dtype):
            raise ValueError(f"attribute {name} of {item.name} is neither one number nor a text")


def _is_plain(dtype: np.dtype) -> bool:
    return h5py.check_string_dtype(dtype) is not None or dtype.kind in "biufc"
