"""A crawling robot in a channel (Sato et al., section 3.2): a squeezed core in a block of design.

    python cases/crawler.py --preview --out DIR

The paper's figures do not tell its dimensions; these are ours, so that gains over the reference
design can be compared, but not distances.
"""

import sys

from mpmopt.case import Case, main, published, refined, sharpened
from mpmopt.scene import Actuator, Design, Grid, Mirror, Scene, Wall


def crawler(cells: int, time_step: float, mirror: bool = True) -> Scene:
    """The crawler on `cells` x `cells` cells of the unit square, for one second.

    Of the symmetric body only the lower half is simulated, unless `mirror` is False.
    """
    c = 1 / 64
    return Scene(
        grid=Grid(cells=(cells, cells), dx=1 / cells),
        time_step=time_step,
        steps=round(1.0 / time_step),
        walls=(Wall("y", 26 * c), Wall("y", 38 * c, "above")),
        body=(
            Design((13 * c, 26 * c), (20 * c, 38 * c)),
            Design((20 * c, 26 * c), (26 * c, 29 * c)),
            Actuator((20 * c, 29 * c), (26 * c, 35 * c)),
            Design((20 * c, 35 * c), (26 * c, 38 * c)),
            Design((26 * c, 26 * c), (33 * c, 38 * c)),
        ),
        mirror=Mirror("y", 32 * c) if mirror else None,
    )


CASES = {
    "default": Case(crawler(128, 5e-4), refined(8e-4, 5e-4)),
    "preview": Case(crawler(64, 8e-4), sharpened(8e-4)),
    "paper": Case(crawler(128, 2e-4), published(2e-4)),
}

if __name__ == "__main__":
    sys.exit(main(__doc__.splitlines()[0], CASES))
