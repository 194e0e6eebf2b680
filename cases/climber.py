"""A climbing robot in a vertical shaft: three squeezed cores, each with a phase of its own.

    python cases/climber.py --preview --out DIR

It is not in the paper. It shows a scene of one's own: gravity along the shaft, nothing to stand
on but a bottom far below, several actuators.
"""

import sys
from dataclasses import replace

import numpy as np

from mpmopt.app.case import Case
from mpmopt.app.script import main
from mpmopt.design.variation import Variation
from mpmopt.optimisation.presets import IN_ONE_PIECE, creep
from mpmopt.scene import Actuator, Design, Grid, Ground, Material, Mirror, Scene


def climber(cells: int, time_step: float, seconds: float) -> Scene:
    """The climber on `cells` x `cells` cells; what comes in the first second does not count."""
    c = 1 / 64
    left, right, low, high = 26 * c, 38 * c, 18 * c, 42 * c  # of the body
    # The shaft's layers are a cell thick and squeeze the body a little, so that it holds at first.
    walls, bottom = (25.3 * c, 38.7 * c), 4 * c
    shaft = ((walls[0], 1.0), (walls[0], bottom), (walls[1], bottom), (walls[1], 1.0))
    actuators = tuple(Actuator((30 * c, y * c), (34 * c, (y + 6) * c)) for y in (21, 27, 33))
    return Scene(
        grid=Grid(cells=(cells, cells), dx=1 / cells),
        time_step=time_step,
        steps=round(seconds / time_step),
        transient=1.0,
        gravity=(0.0, -1.0),
        direction=(0.0, 1.0),
        ground=(Ground(shaft, friction=1.0, thickness=c),),
        material=Material(viscosity=0.03),
        formulation="total",
        body=(
            Design((left, low), (right, 21 * c)),
            Design((left, 21 * c), (30 * c, 39 * c)),
            *actuators,
            Design((34 * c, 21 * c), (right, 39 * c)),
            Design((left, 39 * c), (right, high)),
        ),
        filter_length=1.5 * c,  # thin legs slip on finer cells
        mirror=Mirror("x", 32 * c),
    )


def slanted_legs(positions: np.ndarray) -> np.ndarray:
    """What one would draw by hand: four pairs of legs that lean down."""
    c = 1 / 64
    x, y = positions.T
    foot = 4 * c * abs(x - 32 * c) / (6 * c)  # how far down a leg has leant at this distance
    return np.any([abs(y + foot - top * c) <= 1.25 * c for top in (24, 30, 36, 41)], axis=0)


# Three cores a quarter of a turn apart, the lowest first; squeezed outwards on the average.
START = {"phi": 0.0, "a": 1.0, "theta": (0.7, 0.2, -0.3), "b": -0.5}

TASK = replace(
    IN_ONE_PIECE,
    scenes=(
        Variation(friction=0.7, strength=0.9, threshold=0.4),
        Variation(friction=0.9),
        Variation(friction=1.2, strength=1.1, threshold=0.6),
    ),
    soft_minimum=8.0,
)

CASES = {
    "default": Case(climber(64, 1e-3, 4.0), creep(25), slanted_legs, START, TASK),
    "preview": Case(climber(64, 1e-3, 3.0), creep(15), slanted_legs, START, TASK),
}

if __name__ == "__main__":
    sys.exit(main(__doc__.splitlines()[0], CASES))
