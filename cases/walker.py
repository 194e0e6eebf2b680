"""A walking robot: a squeezed beam on a block that is to become legs (Sato et al., section 3.1).

    python cases/walker.py --preview --out DIR

The paper's walker stands on a floor that sticks, for one second, and lunges once. With ``--paper``
it is that. Without, its floor has a contact layer and a finite friction, its material is viscous,
and what counts is how far it goes after its first second. The paper's figures do not tell its
dimensions; these are ours, so that gains over the reference design can be compared, but not
distances.
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
from mpmopt.scene import Actuator, Design, Grid, Ground, Material, Scene, Solid, Wall

AHEAD = 8 / 64  # of the paper's body is the one on ground


def walker(cells: int, time_step: float, particles_per_cell: int = 2) -> Scene:
    """The paper's walker on `cells` x `cells` cells of the unit square, for one second."""
    c = 1 / 64
    return Scene(
        grid=Grid(cells=(cells, cells), dx=1 / cells),
        time_step=time_step,
        steps=round(1.0 / time_step),
        particles_per_cell=particles_per_cell,
        gravity=(0.0, -10.0),
        walls=(Wall("y", 4 * c),),
        body=(
            Design((3 * c, 4 * c), (23 * c, 11 * c)),
            Solid((3 * c, 11 * c), (8 * c, 14 * c)),
            Actuator((8 * c, 11 * c), (18 * c, 14 * c)),
            Solid((18 * c, 11 * c), (23 * c, 14 * c)),
        ),
    )


def walker_on_ground(cells: int, time_step: float, seconds: float) -> Scene:
    """The same body on ground with a layer, and with a frequency that is designed too.

    What comes in the first second does not count. It has more room, behind it too.
    """
    scene = walker(cells, time_step)
    body = []
    for part in scene.body:
        part = replace(part, lower=_ahead(part.lower), upper=_ahead(part.upper))
        body.append(replace(part, detuning=0.9) if isinstance(part, Actuator) else part)
    return replace(
        scene,
        grid=Grid(cells=(3 * cells // 2, cells), dx=1 / cells),
        body=tuple(body),
        walls=(),
        ground=(Ground.floor(3 / 64, friction=0.5, thickness=1 / 64, damping=2.0),),
        material=Material(viscosity=0.03),
        steps=round(seconds / time_step),
        transient=1.0,
        filter_length=2 / 64,
        formulation="total",
    )


def _ahead(point: tuple[float, float]) -> tuple[float, float]:
    return point[0] + AHEAD, point[1]


def slanted_legs(positions: np.ndarray) -> np.ndarray:
    """What one would draw by hand: three legs that lean back, as a bristle robot's."""
    c = 1 / 64
    x, y = positions.T
    foot = 2.5 * c * (11 * c - y) / (7 * c)  # how far back a leg has leant at this height
    return np.any([abs(x + foot - top * c) <= 1.25 * c for top in (7, 13, 19)], axis=0)


def two_legs(positions: np.ndarray) -> np.ndarray:
    """A thin hind leg and a wide front leg that lean back, on a skin under the beam.

    One in four of 673 such drawings, with legs of other places, slants and widths and other
    signals, goes 0.02 a second or more in all scenes of the task, at frequencies from 45 to 55.
    """
    c = 1 / 64
    x, y = positions.T
    x, depth = x - AHEAD, 11 * c - y
    legs = [
        abs(x + slant * depth / 7 - top * c) <= 0.5 * width * c
        for top, slant, width in ((8.0, 1.5, 2.5), (19.5, 5.0, 3.5))
    ]
    return np.any([*legs, depth <= c], axis=0)


START = {"phi": black_and_white(two_legs), "a": 1.0, "theta": 0.7, "b": -0.3, "omega": 0.8}

# What nobody knows of the world: friction, softness of the ground, strength, and how exactly it was
# made. The actuator is held squeezed only a little: more stretches the skin until MLS-MPM tears it.
TASK = Task(
    scenes=(
        Variation(friction=0.28, strength=0.9, threshold=0.4),
        Variation(friction=0.45, thickness=2.0),
        Variation(friction=0.72, strength=1.1, threshold=0.6),
    ),
    subject_to=(IN_ONE_PIECE,),
    variables=(Bounded("b", lower=-0.3, upper=0.3),),
    soft_minimum=8.0,
)

CASES = {
    "default": Case(walker_on_ground(64, 1e-3, 4.0), gait(60, starts=3), two_legs, START, TASK),
    "preview": Case(walker_on_ground(64, 1e-3, 3.0), gait(40), two_legs, START, TASK),
    "paper": Case(walker(128, 2e-4), paper_preset(2e-4), slanted_legs),
}

if __name__ == "__main__":
    sys.exit(main(__doc__.splitlines()[0], CASES))
