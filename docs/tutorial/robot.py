"""A worm on a floor: two actuators in a row, each free to find its phase."""

import sys

from mpmopt.app.case import Case
from mpmopt.app.script import main
from mpmopt.optimisation.presets import continuation
from mpmopt.scene import Actuator, Design, Grid, Scene, Wall

c = 1 / 64  # width of a cell
worm = Scene(
    grid=Grid(cells=(128, 32), dx=c),
    time_step=8e-4,
    steps=1250,  # one second
    gravity=(0.0, -10.0),
    walls=(Wall("y", 4 * c, friction=0.5),),
    body=(
        Design((16 * c, 4 * c), (40 * c, 9 * c)),
        Actuator((16 * c, 9 * c), (28 * c, 12 * c)),
        Actuator((28 * c, 9 * c), (40 * c, 12 * c)),
    ),
)


def all_there(positions):
    """What a drawn design would be, to compare with: here simply the solid reference design."""
    return positions[:, 0] > 0.0


CASE = Case(worm, continuation(8e-4), all_there)

if __name__ == "__main__":
    sys.exit(main("A worm.", {"default": CASE}))
