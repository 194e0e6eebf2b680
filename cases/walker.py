"""A walking robot: a squeezed beam on a block that is to become legs (Sato et al., section 3.1).

    python cases/walker.py --preview --out DIR

The paper's figures do not tell its dimensions; these are ours, so that gains over the reference
design can be compared, but not distances.
"""

import sys

from mpmopt.case import Case, main, published, refined, sharpened
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


CASES = {
    "default": Case(walker(128, 5e-4), refined(8e-4, 5e-4)),
    "preview": Case(walker(64, 8e-4), sharpened(8e-4)),
    "paper": Case(walker(128, 2e-4), published(2e-4)),
}

if __name__ == "__main__":
    sys.exit(main(__doc__.splitlines()[0], CASES))
