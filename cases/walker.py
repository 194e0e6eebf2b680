"""A walking robot: a squeezed beam on a block that is to become legs (Sato et al., section 3.1).

    python cases/walker.py --preview --out DIR

The paper's figures do not tell its dimensions; these are ours, so that gains over the reference
design can be compared, but not distances.
"""

import sys

from mpmopt.case import Case, main
from mpmopt.optimize import Settings, Stage
from mpmopt.scene import Actuator, Design, Grid, Scene, Solid, Wall


def walker(cells: int, time_step: float) -> Scene:
    """The walker on `cells` x `cells` cells of the unit square, for one second."""
    c = 1 / 64
    return Scene(
        grid=Grid(cells=(cells, cells), dx=1 / cells),
        time_step=time_step,
        steps=round(1.0 / time_step),
        gravity=(0.0, -10.0),
        walls=(Wall("y", 4 * c),),
        body=(
            Design((3 * c, 4 * c), (23 * c, 11 * c)),
            Solid((3 * c, 11 * c), (8 * c, 14 * c)),
            Actuator((8 * c, 11 * c), (18 * c, 14 * c)),
            Solid((18 * c, 11 * c), (23 * c, 14 * c)),
        ),
    )


def stages(time_step: float, betas: int = 7, late: int = 3) -> tuple[Stage, ...]:
    """Beta doubled from 0.5, the mass floor halved with it; half the step from stage `late` on."""
    return tuple(
        Stage(
            beta=0.5 * 2**k,
            mass_floor=1e-2 * 0.5**k,
            stiffness_floor=1e-3,
            time_step=time_step if k < late else time_step / 2,
            solid=k >= betas - 2,
        )
        for k in range(betas)
    )


CASES = {
    "default": Case(
        walker(128, 5e-4),
        Settings(
            tuple(Stage(0.5 * 2**k, 1e-2, 1e-3, 5e-4, solid=k > 3) for k in range(6)),
            most_iterations=25,
        ),
    ),
    "preview": Case(walker(64, 8e-4), Settings(stages(8e-4), most_iterations=25)),
    # MMA with its usual constants, going on from the last design as beta doubles.
    "paper": Case(
        walker(128, 2e-4),
        Settings(
            tuple(Stage(0.5 * 2**k, 1e-3, 1e-3, 2e-4) for k in range(6)),
            move_limit=0.5,
            adapt_move_limit=False,
            sharpen_asymptotes=False,
            best_first=False,
        ),
    ),
}

if __name__ == "__main__":
    sys.exit(main(__doc__.splitlines()[0], CASES))
