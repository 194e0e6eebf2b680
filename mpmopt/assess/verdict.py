"""A finished run in one word, and why."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from mpmopt.assess.robustness import TOO_LONG, TRIALS
from mpmopt.validation import digits

# A robot that loses more than a fifth with half the step, on finer cells or in the other
# formulation lives by its simulation: do not build it.
KEPT = 0.8
# One of which less of the speed is driven slides, or falls along.
DRIVEN = 0.5
# What the summary's names of other discretisations say.
SAID = {
    "half_step": "half the step", "finer_cells": "cells half as wide",
    "finest_cells": "cells a quarter as wide",
    "other_formulation": "cells half as wide in the other formulation",
    "other formulation": "the other formulation",
}  # fmt: skip


def verdict(summary: Mapping[str, Any], missed: Sequence[str] = (), travels: bool = True) -> str:
    """A word, a colon, and why: the first of these that is true.

    ``fails``: it cannot be simulated as it would be built. ``breaks a constraint``. Of robots on
    ground that are to travel, as `robustness.study` found: ``stands``, too slow for shares;
    ``goes back``, against its direction; ``falls`` and ``stops``, where it was followed for long;
    ``slides``, less than `DRIVEN` of the speed is driven. Of others: ``no gain`` over the solid
    reference design. ``loose pieces``: some particles hang on nothing. ``doubtful``: it keeps less
    than `KEPT` in another discretisation, where the step is not longer, or fails there. ``goes`` or
    ``gains``: none of these; it says so where nothing was compared.

    Parameters
    ----------
    summary : mapping
        As in a run file.
    missed : sequence of str, optional
        Constraints that the design breaks.
    travels : bool, optional
        Whether it was designed for travel (`Task.travels`); others count by their gain alone.
    """
    studied = travels and "speed" in summary
    value = summary["speed"] if studied else summary.get("post_processed")
    failures, loose = summary.get("failures", {}), summary.get("disconnected_particles", 0)
    followed = summary.get("followed") if studied else None
    driven = summary.get("driven_share") if studied else None
    gain = summary.get("gain", {}).get("as designed")
    if value is None:
        return f"fails: {failures.get('nominal', 'it cannot be simulated without its void')}"
    if missed:
        return f"breaks a constraint: {'; '.join(missed)}"
    way = summary.get("way", "goes")
    if studied and way != "goes":
        return f"{way}: its speed along the way is {digits(value, 3)}"
    if followed and followed["end"] in ("falls", "stops"):
        return f"{followed['end']}: at t = {digits(followed['seconds'], 3)}"
    if followed and followed["end"] != "goes on":
        return f"fails: at t = {digits(followed['seconds'], 3)}, {followed['end']}"
    if driven is not None and driven < DRIVEN:
        return f"slides: only {driven:.0%} of its speed is driven"
    if not studied and not (gain or 0.0) > 0.0:
        return "no gain: the solid block does as well"
    if loose:
        return f"loose pieces: {loose} particles hang on nothing"
    what, good = ("speed", "goes") if studied else ("gain", "gains")
    least, where, compared = 1.0, "", False
    for name, share in summary.get("kept" if studied else "retained_gain", {}).items():
        said = SAID.get(name, name)
        if name == "twice the step" or TOO_LONG in failures.get(TRIALS.get(name, ""), ""):
            continue
        if share is None:
            return f"doubtful: no {what} with {said}"
        compared = True
        if share < least:
            least, where = share, f" with {said}"
    if least < KEPT:
        return f"doubtful: only {least:.0%} of its {what}{where}"
    if not compared:
        study = "; mpmopt study compares other discretisations" if studied and not followed else ""
        return f"{good}: not compared{study}"
    later = "; mpmopt study tells whether it falls later" if studied and not followed else ""
    return f"{good}: {least:.0%} or more of its {what} in other discretisations{later}"
