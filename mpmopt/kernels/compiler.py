"""How kernels are compiled, and when what the disk keeps of them is stale.

Numba's disk cache does not see that a callee in another file changed. So the cache of every kernel
is stamped with a digest of all kernels' sources: after any change all of them are compiled anew.
"""

import hashlib
import logging
from collections.abc import Callable
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Any
from uuid import uuid4

from numba import njit
from numba.core.registry import cpu_target


def _can_cache() -> bool:
    """Whether Numba finds a folder to keep compiled kernels in; without one it would raise."""
    try:
        njit(cache=True)(_can_cache)
    except RuntimeError:
        logging.getLogger(__name__).warning(
            "no folder to keep compiled kernels in, each start compiles them anew; let the "
            "environment variable NUMBA_CACHE_DIR name one"
        )
        return False
    return True


def _digest() -> str:
    """Of all kernels' sources."""
    digest = hashlib.sha256()
    for path in sorted(Path(__file__).parent.glob("*.py")):
        digest.update(path.name.encode() + b"\0" + path.read_bytes() + b"\0")
    return digest.hexdigest()


STAMP = _digest()

# Numba tries overloads of an operator in the order of their registration. Reading the disk cache
# would register those of strings, lists and dictionaries first, and make compiling slower. Numba
# itself calls this before it compiles.
cpu_target.typing_context.refresh()

# No "nnan" or "ninf": comparisons must see what is not a number.
OPTIONS: dict[str, Any] = {
    "cache": _can_cache(),
    "no_cfunc_wrapper": True,
    "nogil": True,
    "error_model": "numpy",
    "fastmath": {"contract", "reassoc", "nsz", "arcp"},
}

# For compiled callers alone: no function that unpacks Python's objects is compiled beside it.
INNER: dict[str, Any] = {**OPTIONS, "no_cpython_wrapper": True}

# And without the counting of references to arrays.
BARE: dict[str, Any] = {**INNER, "_nrt": False}


def loop_jit(function: Callable[..., Any]) -> Any:
    """Compile a loop that Python calls."""
    return _stamped(njit(**OPTIONS)(function))


def jit(function: Callable[..., Any]) -> Any:
    """Compile a kernel that becomes part of the loops that call it.

    Which of several compiled copies a loop calls would otherwise depend on whether it came from the
    disk cache, and with it the last bits.
    """
    return _stamped(njit(**OPTIONS, forceinline=True)(function))


def inner_jit(function: Callable[..., Any]) -> Any:
    """As `jit`, for kernels that only compiled code calls: tuples of arrays are long to unpack."""
    return _stamped(njit(**INNER, forceinline=True)(function))


def inner_loop_jit(function: Callable[..., Any]) -> Any:
    """As `inner_jit`, of a loop that stands by itself."""
    return _stamped(njit(**INNER)(function))


def bare_jit(function: Callable[..., Any]) -> Any:
    """As `jit`, for kernels that make no arrays: they count no references to those they take.

    Counting costs more than a short kernel does whose tuples hold many arrays. Only compiled code
    calls them. They return no arrays: the caller would free what was never counted.
    """
    return _stamped(njit(**BARE, forceinline=True)(function))


def bare_loop_jit(function: Callable[..., Any]) -> Any:
    """As `bare_jit`, of a loop that stands by itself."""
    return _stamped(njit(**BARE)(function))


def plain(kernel: Any) -> Any:
    """A kernel as it is written, for numbers and arrays in Python."""
    return getattr(kernel, "py_func", kernel)


def types_of(kernel: Any, arguments: tuple[Any, ...]) -> tuple[Any, ...]:
    """Numba's types of a loop's arguments."""
    return tuple(map(kernel.typeof_pyval, arguments))


def is_to_compile(kernel: Any, arguments: tuple[Any, ...]) -> bool:
    """Whether a call would compile a loop, and keep it on disk; no where Numba does not tell."""
    try:
        file, types = kernel._cache._cache_file, types_of(kernel, arguments)
        key = kernel._cache._index_key(types, kernel.targetctx.codegen())
        return types not in kernel.overloads and key not in file._load_index()
    except (AttributeError, TypeError, OSError):  # not compiled, not cached, or another Numba's
        return False


def _stamped(kernel: Any) -> Any:
    file: Any = getattr(getattr(kernel, "_cache", None), "_cache_file", None)
    if hasattr(file, "_save_data"):  # the compiler and its cache are on, and Numba's own is this
        file._source_stamp, file.save = STAMP, partial(_save, file)
    return kernel


def _save(file: Any, key: Any, data: Any) -> None:
    """Keep a compiled kernel: data under a new name, then the index; remove what that leaves out.

    Numba itself writes the index first, and the data under a name that others had before them. A
    process that reads in between, or after one that was ended there, would run what was compiled of
    older sources, by another version, or for other types.
    """
    name = file._data_name(uuid4().int >> 80)
    file._save_data(name, data)
    overloads = {**file._load_index(), key: name}
    file._save_index(overloads)
    for path in Path(file._cache_path).glob(file._index_name.replace(".nbi", ".*.nbc")):
        if path.name not in overloads.values():
            with suppress(OSError):  # another process was faster, or reads it
                path.unlink()
