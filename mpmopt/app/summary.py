"""What a finished run reached, in numbers."""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mpmopt.assess import robustness, threshold
from mpmopt.assess.forces import cost_of_transport
from mpmopt.assess.refinement import study
from mpmopt.assess.threshold import (
    best_actuated,
    pieces,
    post_processed,
    solid_reference,
    unactuated,
)
from mpmopt.assess.trajectory import post_processed as without_grey
from mpmopt.assess.verdict import verdict
from mpmopt.assess.width import thinnest_member
from mpmopt.design.actuation import frequencies
from mpmopt.design.ensemble import side_by_side
from mpmopt.design.problem import Problem
from mpmopt.design.variables import Variables
from mpmopt.errors import MissingLibraryError, SimulationError
from mpmopt.optimisation.history import Optimisation
from mpmopt.results.outline import outline
from mpmopt.validation import digits, instance

logger = logging.getLogger(__name__)


def summarise(
    result: Optimisation, baseline: NDArray[np.bool_] | None = None, full: bool = False
) -> dict[str, Any]:
    """Objective values (L, larger is farther), actuation and counts of a finished optimisation.

    And the finished robot's `robustness.study`, in full or in short, and its `verdict`.

    The baseline (D,) is that of `baseline_particles`, or none.

    Reference designs count with the better of the first and the best design's actuation. The cost
    of transport is that of the post-processed design, over all of its travel.
    """
    instance("summarise", "result", result, Optimisation)
    best, problem = result.result, result.problem()
    first = result.first
    assert first is not None
    actuations = [Variables.of(item.x, problem.scene) for item in (first, best)]
    actuation = actuations[1]

    def best_of(design: threshold.Baseline) -> float:
        return best_actuated(problem.scene, design, *actuations, task=result.task)

    # What takes the interpreter for itself runs while others are in compiled loops.
    asked: tuple[Callable[[], Any], ...] = (
        lambda: study(problem, best.x),
        lambda: _value_or_none(lambda: best_of(solid_reference)),
        lambda: None if baseline is None else _value_or_none(lambda: best_of(lambda _: baseline)),
        lambda: _value_or_none(lambda: unactuated(problem, best.x)),
        lambda: _cost(problem, best.x),
        lambda: _thinnest_member(problem, best.x),
    )
    rows, reference, drawn, off, cost, width = side_by_side(lambda ask: ask(), asked)
    designed, *others = rows
    block = np.nan if reference is None else reference

    def numbers(values: np.ndarray) -> float | list[float]:
        return float(values[0]) if values.size == 1 else values.tolist()

    found = {
        "start": _value_or_none(lambda: first.objective),
        "reference": reference,
        "baseline": drawn,
        "optimised": best.objective,
        # The row has none where the reference failed.
        "post_processed": _value_or_none(lambda: post_processed(problem, best.x))
        if designed.failure
        else _number_or_none(designed.distance),
        "actuation_off": off,
        "cost_of_transport": cost,
        "disconnected_particles": int(
            (pieces(problem.scene, threshold.kept(problem, best.x)) > 0).sum()
        ),
        "post_processed_half_step": _number_or_none(rows[1].distance),
        # Over the solid reference design where it goes farther: as designed, or as in the row.
        "gain": {
            row.name: _number_or_none(
                threshold.beyond_rounding(
                    problem.scene, row.distance - np.fmax(row.reference, block)
                )
            )
            for row in rows
        },
        "retained_gain": {row.name: _number_or_none(row.retained) for row in others},
        "shorter_steps": {row.name: row.time_step for row in others if row.halved},
        **robustness.study(problem, best.x, full),
        "thinnest_member": width,
        **_constraints(result),
        "non_discreteness": best.non_discreteness,
        "a": numbers(actuation.a),
        "theta": numbers(actuation.theta),
        "b": numbers(actuation.b),
        **_chosen(result, actuation),
        "evaluations": len(result.history),
        "failed_evaluations": result.failed_evaluations,
        "halved_evaluations": result.halved_evaluations,
        "seconds": result.history[-1].seconds,
        "stop_reason": result.stop_reason,
    }
    return {"verdict": verdict_of(found, result), **found}


def verdict_of(summary: Mapping[str, Any], result: Optimisation) -> str:
    """The `verdict` on an optimisation, of which there is a summary."""
    return verdict(summary, result.missed, result.task.travels(result.scene))


def _cost(problem: Problem, x: NDArray[np.float64]) -> float | None:
    """The cost of transport without grey; None where nothing has a weight."""
    if not any(problem.scene.gravity):
        return None
    return _value_or_none(lambda: cost_of_transport(without_grey(problem, x).simulation))


def _thinnest_member(problem: Problem, x: NDArray[np.float64]) -> float | None:
    """Width of the finished robot's thinnest member; None without manifold3d."""
    keep = robustness.Robot.of(problem, x).keep
    detail = problem.scene.grid.dx / problem.scene.particles_per_cell
    rings = [ring for piece in outline(problem, x, keep=keep) for ring in piece.rings]
    try:
        return _number_or_none(thinnest_member(rings, detail))
    except MissingLibraryError:
        return None


def _chosen(result: Optimisation, actuation: Variables) -> dict[str, Any]:
    """Frequencies, if they are designed, and what was not free, if anything."""
    found: dict[str, Any] = {}
    if actuation.omega.size:
        found["angular_frequency"] = frequencies(result.scene, actuation.omega).tolist()
    if result.task.variables:
        found["variables"] = [str(restriction) for restriction in result.task.variables]
    return found


def _constraints(result: Optimisation) -> dict[str, Any]:
    """Value and multiplier of each constraint at the best design, if there are any."""
    best, constraints = result.result, result.task.subject_to
    rows = zip(map(str, constraints), zip(best.constraints, best.multipliers))
    found = {f"{name}: value, multiplier": list(pair) for name, pair in rows}
    return {"constraints": found} if found else {}


def _value_or_none(function: Callable[[], float]) -> float | None:
    """A value for the summary, null in JSON if there is none."""
    try:
        return _number_or_none(function())
    except SimulationError as error:
        logger.info("no value: %s", error)
        return None


def _number_or_none(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None


def _shown(value: Any) -> str:
    if value is None:
        return "-"
    return digits(value) if isinstance(value, float) else str(value)


def table(summary: Mapping[str, Any]) -> str:
    """The summary as aligned text."""
    flat = _flat(summary)
    width = max(len(name) for name in flat)
    lines = []
    for name, value in flat.items():
        values = value if isinstance(value, list) else [value]
        shown = ", ".join(_shown(v) for v in values)
        lines.append(f"{name.replace('_', ' '):<{width}}  {shown}")
    return "\n".join(lines)


def _flat(values: Mapping[str, Any]) -> dict[str, Any]:
    """The same without mappings in it: the names of what is in one have its name before them."""
    flat: dict[str, Any] = {}
    for name, value in values.items():
        if isinstance(value, Mapping):
            flat.update({f"{name}, {key}": item for key, item in _flat(value).items()})
        else:
            flat[name] = value
    return flat
