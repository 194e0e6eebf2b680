"""Settings that cases use: continuation, coarse to fine, and the paper's."""

from __future__ import annotations

from mpmopt.optimisation.settings import Settings, Stage


def _sharpening(time_step: float, stages: int, coarsening: int = 1) -> tuple[Stage, ...]:
    """Beta doubled from 0.5; from 8 on, clear void is left out and designs are judged solid.

    On the scene's own cells they count with the least of their refinement study.
    """
    return tuple(
        Stage(
            beta=0.5 * 2**k,
            void_density=1e-2,
            void_stiffness=1e-3,
            time_step=time_step,
            solid=k >= 4,
            refined=k >= 4 and coarsening == 1,
            coarsening=coarsening,
            void_cutoff=0.05 if k >= 4 else 0.0,
        )
        for k in range(stages)
    )


def continuation(time_step: float) -> Settings:
    """Beta from 0.5 to 32; void weighs 1e-2 of a solid, until what is clear void is left out."""
    return Settings(_sharpening(time_step, stages=7), most_iterations=25)


def coarse_to_fine(coarse_time_step: float, time_step: float) -> Settings:
    """Cells twice as wide find the gait, then the scene's own find the shape.

    The coarse stages are the first five of `continuation`. The fine ones begin at beta = 8 and stay
    at 16 and 32 for several stages: each begins with long moves again, which shake the design out
    of what it got stuck in. Their void has a void density of 1e-2, and what is clear void is left
    out.
    """
    coarse = _sharpening(coarse_time_step, stages=5, coarsening=2)
    fine = tuple(
        Stage(
            beta,
            void_density=1e-2,
            void_stiffness=1e-3,
            time_step=time_step,
            solid=True,
            refined=True,
            move_limit=move_limit,
            void_cutoff=0.05,
        )
        for beta, move_limit, repeats in ((8.0, 0.05, 1), (16.0, 0.05, 4), (32.0, 0.025, 3))
        for _ in range(repeats)
    )
    return Settings((*coarse, *fine), most_iterations=25, tolerance=0.0)


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
