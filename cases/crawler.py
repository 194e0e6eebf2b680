"""A crawling robot in a channel (Sato et al., section 3.2): a squeezed core in a block of design.

    python cases/crawler.py --preview --out DIR

The paper's channel has walls that stick, for one second. With ``--paper`` it is that. Without, its
walls have contact layers and a finite friction, the channel is twice as long, and what counts is
how far the crawler goes after its first second. The paper's figures do not tell its dimensions;
these are ours, so that gains over the reference design can be compared, but not distances.
"""

import sys
from dataclasses import replace

import numpy as np

from mpmopt.app.case import Case
from mpmopt.app.script import main
from mpmopt.design.task import Task
from mpmopt.design.variables import Bounded
from mpmopt.design.variation import Variation
from mpmopt.optimisation.presets import IN_ONE_PIECE, black_and_white, gait, paper_preset
from mpmopt.scene import Actuator, Design, Grid, Ground, Material, Mirror, Scene, Wall


def crawler(cells: int, time_step: float, mirror: bool = True) -> Scene:
    """The paper's crawler on `cells` x `cells` cells of the unit square, for one second.

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


def crawler_on_ground(cells: int, time_step: float, seconds: float) -> Scene:
    """The same body in a longer channel with layers, and with a frequency that is designed too.

    Its layers squeeze the body a little, so that it does not coast; MLS-MPM's particles, which feel
    them at their middles, from 128 cells on. What comes in the first second does not count.
    """
    c = 1 / 64
    scene = crawler(cells, time_step)
    layer = {"friction": 0.5, "thickness": c}
    return replace(
        scene,
        grid=Grid(cells=(2 * cells, cells), dx=1 / cells),
        walls=(),
        ground=(
            Ground.floor(25.15 * c, **layer),
            Ground(((1.0, 38.85 * c), (0.0, 38.85 * c)), **layer),
        ),
        body=tuple(
            replace(part, detuning=0.9) if isinstance(part, Actuator) else part
            for part in scene.body
        ),
        material=Material(viscosity=0.03),
        steps=round(seconds / time_step),
        transient=1.0,
        filter_length=2 * c,
        formulation="total",
    )


def slanted_legs(positions: np.ndarray) -> np.ndarray:
    """What one would draw by hand: a spine with three pairs of legs that lean back."""
    c = 1 / 64
    x, y = positions.T
    height = abs(y - 32 * c)
    foot = 4 * c * height / (6 * c)  # how far back a leg has leant at this height
    legs = [abs(x + foot - top * c) <= 1.25 * c for top in (15, 23, 31)]
    return np.any([*legs, height <= 1.5 * c], axis=0)


def two_pairs(positions: np.ndarray) -> np.ndarray:
    """A spine, a skin around the core, and two pairs of legs, of which those in front lean back.

    One of the best of 1273 drawings; one in six goes 0.02 a second or more in all scenes.
    """
    c = 1 / 64
    x, y = positions.T
    height = abs(y - 32 * c) / (6 * c)
    legs = [
        abs(x + slant * c * height - top * c) <= 0.5 * c * (4 + (foot - 4) * height)
        for top, slant, foot in ((34.5, 4.0, 2.0), (19.0, -1.0, 3.5))
    ]
    skin = (height <= 4 / 6) & (x >= 19 * c) & (x <= 27 * c)
    return np.any([*legs, height <= 2 / 6, skin], axis=0)


START = {"phi": black_and_white(two_pairs), "a": 0.8, "theta": 0.6, "b": -0.3, "omega": 0.7}

# A stronger core goes faster, but stretches until MLS-MPM tears it.
TASK = Task(
    subject_to=(IN_ONE_PIECE,),
    scenes=(
        Variation(friction=0.28, strength=0.9),
        Variation(friction=0.45),
        Variation(friction=0.72, strength=1.1),
    ),
    variables=(Bounded("a", lower=-0.8, upper=0.8), Bounded("b", lower=-0.3, upper=0.3)),
    soft_minimum=8.0,
)

CASES = {
    "default": Case(crawler_on_ground(64, 1e-3, 3.0), gait(80), two_pairs, START, TASK),
    "preview": Case(crawler_on_ground(64, 1e-3, 3.0), gait(40), two_pairs, START, TASK),
    "paper": Case(crawler(128, 2e-4), paper_preset(2e-4), slanted_legs),
}

if __name__ == "__main__":
    sys.exit(main(__doc__.splitlines()[0], CASES))
