"""What cases use: settings for a gait, for one second, and the paper's; robots in one piece."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from mpmopt.design.one_piece import OnePiece
from mpmopt.design.task import AtMost
from mpmopt.optimisation.settings import Settings, Stage

# Robots end at 0.3 to 0.6 of the solid reference design's; a loose piece takes a thousandfold, but
# small corners only little.
IN_ONE_PIECE = AtMost(OnePiece(), -0.4)
SEED = 1000  # of the starts of a gait, which are others than those of `--starts`


def black_and_white(drawing: Callable[[NDArray], NDArray]) -> Callable[[NDArray], NDArray]:
    """A start's phi: 1 where a drawing has material, and -1 where it has none."""
    return lambda positions: np.where(drawing(positions), 1.0, -1.0)


def continuation(time_step: float | None = None, most_iterations: int = 25) -> Settings:
    """Beta from 0.5 to 32; void weighs 1e-2 of a solid, until what is clear void is left out.

    From 8 on, that is, when designs are judged solid too, with the least of their refinement study.
    """
    return Settings(
        tuple(
            Stage(
                beta=0.5 * 2**k,
                void_density=1e-2,
                void_stiffness=1e-3,
                time_step=time_step,
                solid=k >= 4,
                refined=k >= 4,
                void_cutoff=0.05 if k >= 4 else 0.0,
            )
            for k in range(7)
        ),
        most_iterations=most_iterations,
    )


def gait(most_iterations: int, move_limit: float = 0.02, starts: int = 1) -> Settings:
    """Plain moving asymptotes with short moves, black and white from the first design.

    Its edges are as wide as a particle, so that no grey is there whose gain could be lost. A
    design counts without its void, by the lesser objective with half the step and with cells half
    as wide, so the best is at least as good as the start, which is a drawing that strides. It needs
    contact layers, finite friction and viscosity, with which distance is smooth. It also needs the
    total Lagrangian formulation, whose void may be light. Several actuators need shorter moves.

    Where an ascent ends is a matter of luck, or of rounding. The best of several, each from the
    start with another random field added, is less so: one stage each, the first from the start.
    """
    stage = Stage(100.0, solid=True, refined=True, move_limit=move_limit, subpixel=True)
    return Settings(
        (stage, *(replace(stage, disturbed=SEED + k) for k in range(1, starts))),
        adapt_move_limit=False,
        sharpen_asymptotes=False,
        tolerance=0.0,
        most_iterations=most_iterations,
    )


def paper_preset(time_step: float) -> Settings:
    """The paper's: beta doubled from 0.5 to 16, both floors 1e-3, moving asymptotes as published.

    Each stage goes on from the last design of the one before; no step is halved, no limit counts.
    """
    return Settings(
        tuple(
            Stage(0.5 * 2**k, 1e-3, 1e-3, time_step, move_limit=0.5, halvings=0, limited=False)
            for k in range(6)
        ),
        adapt_move_limit=False,
        sharpen_asymptotes=False,
        best_first=False,
    )
