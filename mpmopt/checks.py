"""Checks of numbers that users give, with errors that name what was found and what was needed."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from mpmopt.errors import MpmoptError, SceneError

MOST = 10**8  # of anything that is counted


def number(
    owner: str,
    name: str,
    value: Any,
    *,
    above: float = -math.inf,
    error: type[MpmoptError] = SceneError,
) -> float:
    """`value` as a finite float above a limit, or an error."""
    kinds = (int, float, np.integer, np.floating)
    if isinstance(value, (bool, np.bool_)) or not isinstance(value, kinds):
        raise error(f"{owner}: {name} = {value!r} must be a number")
    try:
        result = float(value)
    except OverflowError:
        result = math.inf
    if not math.isfinite(result) or not result > above:
        limit = "finite" if above == -math.inf else f"finite and above {above:g}"
        raise error(f"{owner}: {name} = {value!r:.40} must be {limit}")
    return result


def share(owner: str, name: str, value: Any, *, error: type[MpmoptError] = SceneError) -> float:
    """`value` as a float from 0 to below 1, or an error."""
    result = number(owner, name, value, error=error)
    if not 0.0 <= result < 1.0:
        raise error(f"{owner}: {name} = {result} must be at least 0 and below 1")
    return result


def count(
    owner: str, name: str, value: Any, least: int, *, error: type[MpmoptError] = SceneError
) -> int:
    """`value` as a whole number from `least` to `MOST`, or an error."""
    if isinstance(value, bool) or not isinstance(value, (int, np.integer)):
        raise error(f"{owner}: {name} = {value!r} must be a whole number >= {least}")
    if not least <= value <= MOST:
        raise error(f"{owner}: {name} = {value!r:.40} must be from {least} to {MOST:.0e}")
    return int(value)
