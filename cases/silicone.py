"""A walking robot of silicone, 60 mm long, in kilograms, metres, seconds and pascals.

    python cases/silicone.py --out DIR

A beam of Dragon Skin 30, whose middle is a soft core of Ecoflex 00-30 that is squeezed along it, on
a block of Ecoflex 00-30 that is to become legs, on ground with a layer of 2 mm. The plane is a
section, so masses and forces are those of a metre of depth: densities in kg/m^3 and stresses in Pa
are those of the solid. The viscosity is a choice, and less than silicones have: more would need a
shorter step.
"""

import sys
from dataclasses import replace

import numpy as np

from mpmopt.app.case import Case
from mpmopt.app.script import main
from mpmopt.optimisation.presets import continuation
from mpmopt.scene import SILICONES, Actuator, Design, Grid, Ground, Scene, Solid

MM = 1e-3
VISCOSITY = 5.0  # Pa s
PRESSURE = 15e3  # Pa along the beam, at a signal of one
FREQUENCY = 5.0  # Hz


def silicone_walker(time_step: float = 2e-5) -> Scene:
    """The robot on cells of 2 mm, for half a second."""
    soft = replace(SILICONES["Ecoflex 00-30"], viscosity=VISCOSITY)
    stiff = replace(SILICONES["Dragon Skin 30"], viscosity=VISCOSITY)
    foot, left, knee, top = 8 * MM, 20 * MM, 22 * MM, 28 * MM
    return Scene(
        grid=Grid(cells=(60, 30), dx=2 * MM),
        time_step=time_step,
        steps=round(0.5 / time_step),
        gravity=(0.0, -9.81),
        ground=(Ground.floor(foot - 2 * MM, friction=0.6, thickness=2 * MM),),
        material=soft,
        body=(
            Design((left, foot), (left + 60 * MM, knee)),
            Solid((left, knee), (left + 14 * MM, top), material=stiff),
            Actuator(
                (left + 14 * MM, knee),
                (left + 46 * MM, top),
                stress=((PRESSURE, 0.0), (0.0, 0.0)),
                angular_frequency=2.0 * np.pi * FREQUENCY,
            ),
            Solid((left + 46 * MM, knee), (left + 60 * MM, top), material=stiff),
        ),
    )


def slanted_legs(positions: np.ndarray) -> np.ndarray:
    """What one would draw by hand: three legs that lean back."""
    x, y = positions.T
    lean = 5 * MM * (22 * MM - y) / (14 * MM)  # how far back a leg has leant at this height
    return np.any([abs(x + lean - top * MM) <= 4 * MM for top in (32, 50, 68)], axis=0)


CASES = {"default": Case(silicone_walker(), continuation(2e-5), slanted_legs)}

if __name__ == "__main__":
    sys.exit(main(__doc__.splitlines()[0], CASES))
