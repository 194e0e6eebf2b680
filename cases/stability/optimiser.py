"""The optimiser: cycles of close asymptotes, scaling, values that are no numbers, saturation."""

from typing import Any

import numpy as np

from mpmopt.design.projection import project, project_adjoint
from mpmopt.optimisation.mma import MMAError, MovingAsymptotes
from stability.common import Found, Line, Measured, Points

LEAST_DISTANCES = (1e-6, 1e-5, 1e-4, 1e-3, 1e-2, 1e-1)
SCALES = tuple(10.0**k for k in (-12, -9, -6, -3, 3, 6, 9, 12))
BETAS = (1, 2, 4, 8, 16, 32)


def cycle(least_distance: float) -> float:
    """Width of the cycle that minimising (x - 50)^2 + 25 on [1, 100] ends in, in ranges."""
    optimiser = MovingAsymptotes([1.0], [100.0], asymptote_min=least_distance)
    x, path = np.array([2.0]), []
    for _ in range(200):
        x = optimiser.step(x, (x[0] - 50.0) ** 2 + 25.0, 2.0 * (x - 50.0))
        path.append(x[0])
    return float(np.ptp(path[-20:]) / 99.0)


def change_by_scale(scale: float) -> float:
    """Greatest change of an iterate when the objective is multiplied by a number."""

    def path(by: float) -> np.ndarray:
        target, weight = np.linspace(-0.9, 0.9, 7), 10.0 ** np.arange(-3.0, 4.0)
        optimiser = MovingAsymptotes(-np.ones(7), np.ones(7), move_limit=0.2)
        x, points = np.zeros(7), []
        for _ in range(30):
            f, slope = float(weight @ (x - target) ** 4), 4.0 * weight * (x - target) ** 3
            x = optimiser.step(x, by * f, by * slope)
            points.append(x)
        return np.array(points)

    return float(np.abs(path(scale) - path(1.0)).max())


def refusal_of_nan() -> str:
    """What a gradient with one NaN among its entries comes to."""
    try:
        MovingAsymptotes(np.zeros(3), np.ones(3)).step(0.5 * np.ones(3), 1.0, [1.0, np.nan, 1.0])
    except MMAError as error:
        return str(error)
    return ""


def saturation(beta: float) -> dict[str, Any]:
    """Slope of the projection at phi = 1: by formula, by the adjoint, by the complex step."""
    one = np.ones(1)
    return {
        "beta": beta,
        "formula": float(beta / (2.0 * np.tanh(beta) * np.cosh(beta) ** 2)),
        "adjoint": float(project_adjoint(one, beta, one)[0]),
        "complex_step": float(project(one + 1e-30j, beta).imag[0] / 1e-30),
    }


def points(quick: bool) -> Points:
    """None: nothing here takes long."""
    return {}


def measure(measured: Measured) -> Found:
    """Cycles, scales, NaN and saturation."""
    found = Found()
    found.tables["optimiser_cycle"] = [
        {"least_distance": d, "width": cycle(d)} for d in LEAST_DISTANCES
    ]
    found.tables["optimiser_scale"] = [{"scale": s, "change": change_by_scale(s)} for s in SCALES]
    found.tables["saturation"] = [saturation(beta) for beta in BETAS]
    width = {row["least_distance"]: row["width"] for row in found.tables["optimiser_cycle"]}
    change = max(row["change"] for row in found.tables["optimiser_scale"])
    slope = next(row for row in found.tables["saturation"] if row["beta"] == 16)
    found.lines = [
        Line(
            "Moving asymptotes: 2-cycle",
            "asymptotes at 0.01 of the range: a cycle of 0.9 % of it",
            f"{width[1e-2]:.2%}; with the default of 1e-6 {width[1e-6]:.0e}",
            "Converges; a run that stops while it cycles reports the projected gradient.",
        ),
        Line(
            "Moving asymptotes: bad scaling",
            "iterates do not depend on the scale",
            f"change by {change:.0e} for scales of 1e-12 to 1e12",
            "Converges.",
        ),
        Line(
            "Moving asymptotes: a NaN in the gradient", "one NaN spoils its variable, silently", "",
            f"MMAError: {refusal_of_nan().split(':')[0]}.",
        ),
        Line(
            "Saturation at beta = 16",
            f"slope {slope['formula']:.1e} at phi = 1",
            f"{slope['adjoint']:.1e}",
            "Runs: what is saturated stays.",
        ),
    ]  # fmt: skip
    return found
