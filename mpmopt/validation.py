"""Checks of numbers that users give, with errors that name what was found and what was needed."""

from __future__ import annotations

import math
import os
from pathlib import Path
from typing import Any

import numpy as np

from mpmopt.errors import DesignError, MpmoptError, SceneError

MOST = 10**8  # of anything that is counted
# Sizes of numbers that a scene may hold, so that products of several are finite and not zero:
# limits of what floats represent, in whatever units, which decide nothing between them.
SMALLEST, GREATEST = 1e-30, 1e30


def shown(value: Any) -> str:
    """A value as it stands in a message: never long, whatever it is."""
    try:
        text = repr(value)
    except (ValueError, RecursionError):  # a number of thousands of digits, lists in lists in lists
        return f"a {type(value).__name__}"
    return text if len(text) <= 80 else f"{text[:77]}..."


def digits(value: float, count: int = 4) -> str:
    """A number with so many significant digits: of decimals, small units would leave none."""
    return f"{value:#.{count}g}".removesuffix(".")


def number(
    owner: str,
    name: str,
    value: Any,
    *,
    above: float = -math.inf,
    error: type[MpmoptError] = SceneError,
) -> float:
    """`value` as a float above a limit, from `SMALLEST` to `GREATEST` in size or 0; or an error."""
    kinds = (int, float, np.integer, np.floating)
    if isinstance(value, (bool, np.bool_)) or not isinstance(value, kinds):
        raise error(f"{owner}: {name} = {shown(value)} must be a number")
    try:
        result = float(value)
    except OverflowError:
        result = math.inf
    if not math.isfinite(result) or not result > above:
        limit = "finite" if above == -math.inf else f"finite and above {above:g}"
        raise error(f"{owner}: {name} = {shown(value)} must be {limit}")
    if result != 0.0 and not SMALLEST <= abs(result) <= GREATEST:
        raise error(
            f"{owner}: {name} = {result!r} must be 0 or from {SMALLEST:g} to {GREATEST:g} in size; "
            "take other units"
        )
    return result


def share(owner: str, name: str, value: Any, *, error: type[MpmoptError] = SceneError) -> float:
    """`value` as a float from 0 to below 1, or an error."""
    result = number(owner, name, value, error=error)
    if not 0.0 <= result < 1.0:
        raise error(f"{owner}: {name} = {result} must be at least 0 and below 1")
    return result


def count(
    owner: str,
    name: str,
    value: Any,
    least: int,
    most: int = MOST,
    *,
    error: type[MpmoptError] = SceneError,
) -> int:
    """`value` as a whole number from `least` to `most`, or an error."""
    if isinstance(value, bool) or not isinstance(value, (int, np.integer)):
        raise error(f"{owner}: {name} = {shown(value)} must be a whole number >= {least}")
    if not least <= value <= most:
        raise error(f"{owner}: {name} = {shown(value)} must be from {least} to {most:.3g}")
    return int(value)


def instance(owner: str, name: str, value: Any, kind: type, hint: str = "") -> None:
    """An error that says what to write where a value is of another kind."""
    if not isinstance(value, kind):
        raise DesignError(
            f"{owner}: {name} = {shown(value)} must be an object of class {kind.__name__}"
            f"{hint and f'; {hint}'}"
        )


def place(owner: str, name: str, value: Any) -> Path:
    """`value` as a path, or an error."""
    if not isinstance(value, (str, os.PathLike)):
        raise DesignError(f"{owner}: {name} = {shown(value)} must be a path")
    return Path(value)


def flag(owner: str, name: str, value: Any, *, error: type[MpmoptError] = SceneError) -> bool:
    """`value` as True or False, or an error."""
    if not isinstance(value, (bool, np.bool_)):
        raise error(f"{owner}: {name} = {shown(value)} must be True or False")
    return bool(value)
