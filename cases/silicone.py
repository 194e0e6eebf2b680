"""A walking robot of silicone, 60 mm long, in kilograms, metres, seconds and pascals.

    python cases/silicone.py --preview --out DIR

All of it is Ecoflex 00-30, so one mould and one pour make it. The middle of its beam is squeezed
along the beam, by up to 8.4 kPa, 30 to 50 times a second: that is too quick for air, not for
dielectric elastomers or magnets. The plane is a section, so masses and forces are those of a
metre of depth: densities in kg/m^3 and stresses in Pa are those of the solid. The viscosity is an
assumption: 30 Pa s is a loss factor of 0.096 in shear at 40 Hz. The ground yields by up to 1.5 mm.
"""

import sys
from dataclasses import replace

import numpy as np
import walker

from mpmopt.app.case import Case
from mpmopt.app.script import main
from mpmopt.design.variables import Bounded
from mpmopt.optimisation.presets import black_and_white, gait
from mpmopt.scene import SILICONES, Actuator, Design, Grid, Ground, Scene, Solid

MM = 1e-3
CELL = 3 * MM
LEFT, FOOT = 8 * CELL, 2 * CELL  # where the body begins
VISCOSITY = 30.0  # Pa s
PRESSURE = 6e3  # Pa along the beam, at a signal of one
FREQUENCY = 40.0  # Hz, and by how much of itself it may change
DETUNING = 0.25
TIME_STEP = 5e-5  # s


def silicone_walker(seconds: float = 0.4) -> Scene:
    """The walker's body on cells of 3 mm; what comes in the first 0.1 s does not count."""

    def at(x: int, y: int) -> tuple[float, float]:
        return LEFT + x * CELL, FOOT + y * CELL

    layer = 1.5 * MM
    return Scene(
        grid=Grid(cells=(96, 40), dx=CELL),
        time_step=TIME_STEP,
        steps=round(seconds / TIME_STEP),
        transient=0.1,
        gravity=(0.0, -9.81),
        ground=(Ground.floor(FOOT - layer, friction=0.5, thickness=layer, damping=4.0),),
        material=replace(SILICONES["Ecoflex 00-30"], viscosity=VISCOSITY),
        body=(
            Design(at(0, 0), at(20, 7)),
            Solid(at(0, 7), at(5, 10)),
            Actuator(
                at(5, 7),
                at(15, 10),
                stress=((PRESSURE, 0.0), (0.0, 0.0)),
                angular_frequency=2.0 * np.pi * FREQUENCY,
                detuning=DETUNING,
            ),
            Solid(at(15, 7), at(20, 10)),
        ),
        filter_length=2 * CELL,
        formulation="total",
    )


def two_legs(positions: np.ndarray) -> np.ndarray:
    """The walker's drawing, on these cells."""
    return walker.two_legs(((positions - (LEFT, FOOT)) / CELL + (11, 4)) / 64)


START = {"phi": black_and_white(two_legs), "a": 1.0, "theta": 0.7, "b": -0.2, "omega": 0.3}

# The walker's in metres, without thinner and thicker designs, which do not stride at one frequency.
# Its actuator may be held squeezed more, which its skin bears: so it strides better.
TASK = replace(
    walker.TASK,
    scenes=tuple(replace(each, threshold=0.5) for each in walker.TASK.scenes),
    variables=(Bounded("b", lower=-0.4, upper=0.4),),
    soft_minimum=walker.TASK.soft_minimum / (64 * CELL),
)

CASES = {
    "default": Case(silicone_walker(0.5), gait(80, 0.01), two_legs, START, TASK),
    "preview": Case(silicone_walker(), gait(40, 0.01), two_legs, START, TASK),
}

if __name__ == "__main__":
    sys.exit(main(__doc__.splitlines()[0], CASES))
