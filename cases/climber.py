"""A climbing robot in a vertical shaft: three squeezed cores, each with a phase of its own.

    python cases/climber.py --preview --out DIR

It is not in the paper. It shows a scene of one's own: gravity along the shaft, nothing to stand
on but a bottom far below, several actuators.
"""

import sys

import numpy as np

from mpmopt.app.case import Case
from mpmopt.app.script import main
from mpmopt.design.task import Task
from mpmopt.design.variables import Bounded, Tied
from mpmopt.design.variation import Variation
from mpmopt.optimisation.presets import IN_ONE_PIECE, black_and_white, gait
from mpmopt.scene import Actuator, Design, Grid, Ground, Material, Mirror, Scene


def climber(cells: int, time_step: float, seconds: float) -> Scene:
    """The climber on `cells` cells across; what comes in the first second does not count.

    Cores half as wide as the body are strong enough to drag its feet where friction is high, though
    the shaft presses enough to hold it where friction is low.
    """
    c = 1 / 64
    left, right, low, high = 24 * c, 40 * c, 18 * c, 42 * c  # of the body
    # The shaft's layers, a cell thick, squeeze the body, so that it holds on smooth walls too.
    walls, bottom = (23.6 * c, 40.4 * c), 4 * c
    shaft = ((walls[0], 1.0), (walls[0], bottom), (walls[1], bottom), (walls[1], 1.0))
    actuators = tuple(
        Actuator((28 * c, y * c), (36 * c, (y + 6) * c), detuning=0.9) for y in (21, 27, 33)
    )
    return Scene(
        grid=Grid(cells=(cells, 5 * cells // 2), dx=1 / cells),
        time_step=time_step,
        steps=round(seconds / time_step),
        transient=1.0,
        gravity=(0.0, -1.0),
        direction=(0.0, 1.0),
        ground=(Ground(shaft, friction=0.5, thickness=c),),
        material=Material(viscosity=0.03),
        formulation="total",
        body=(
            Design((left, low), (right, 21 * c)),
            Design((left, 21 * c), (28 * c, 39 * c)),
            *actuators,
            Design((36 * c, 21 * c), (right, 39 * c)),
            Design((left, 39 * c), (right, high)),
        ),
        filter_length=2 * c,
        mirror=Mirror("x", 32 * c),
    )


def three_pairs(positions: np.ndarray) -> np.ndarray:
    """A spine, two pairs of legs that lean down, and one further down that leans up.

    The best of 4786 drawings in a body with narrower cores, widened with it. It merely creeps; what
    the robot climbs is the optimisation's.
    """
    c = 1 / 64
    x, y = positions.T
    away = abs(x - 32 * c) / (8 * c)
    legs = [
        abs(y + slant * c * away - top * c) <= 0.5 * c * (root + (foot - root) * away)
        for top, slant, root, foot in (
            (35.4, 3.1, 4.2, 3.6),
            (31.8, 2.7, 3.8, 3.2),
            (21.8, -1.8, 4.3, 1.8),
        )
    ]
    return np.any([*legs, away <= 4 / 8], axis=0)


START = {
    "phi": black_and_white(three_pairs),
    "a": 1.0,
    "theta": (-0.8, -0.5, -0.7),
    "b": -0.3,
    "omega": 0.9,
}

# Cores of one frequency: others would drift out of step.
TASK = Task(
    subject_to=(IN_ONE_PIECE,),
    scenes=(
        Variation(friction=0.28, strength=0.9),
        Variation(friction=0.45),
        Variation(friction=0.72, strength=1.1),
    ),
    variables=(Bounded("b", lower=-0.3, upper=0.3), Tied("omega", to=0)),
    soft_minimum=8.0,
)

CASES = {
    "default": Case(climber(64, 1e-3, 4.0), gait(100, 0.005), three_pairs, START, TASK),
    "preview": Case(climber(64, 1e-3, 3.0), gait(40, 0.005), three_pairs, START, TASK),
}

if __name__ == "__main__":
    sys.exit(main(__doc__.splitlines()[0], CASES))
