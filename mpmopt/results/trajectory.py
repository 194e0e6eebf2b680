"""How a body moves, as a table of comma-separated values for other programs."""

from __future__ import annotations

import numpy as np

from mpmopt.assess.feet import feet
from mpmopt.assess.trajectory import Body, Motion, equal_steps
from mpmopt.io.files import as_csv

INSTANTS = 401  # unless there are fewer steps


def table(body: Body) -> str:
    """A body in motion as comma-separated values, a line for each instant, in the scene's units.

    The columns are time; place and velocity of the centroid of all material, x, y, vx, vy; its
    travel along the scene's direction; signal 0, 1, ... of the actuators; and of each foot
    (`feet`) its height, and 1 where it stands.

    Parameters
    ----------
    body : Body

    Raises
    ------
    SimulationError
        If the body cannot be simulated.
    """
    scene = body.simulation.scene
    motion = Motion.of(body, np.unique(equal_steps(scene, INSTANTS)))
    place = motion.centroid
    signals = np.real(body.simulation.signal)[np.minimum(motion.frames, scene.steps - 1)]
    columns = {
        "time": motion.frames * scene.time_step,
        **dict(zip(("x", "y"), place.T)),
        **dict(zip(("vx", "vy"), motion.mean_velocity.T)),
        "travel": (place - place[0]) @ np.array(scene.direction),
    }
    for number, signal in enumerate(signals.T):
        columns[f"signal {number}"] = signal
    for foot in feet(motion):
        columns[f"{foot.name}, height"] = foot.height
        columns[f"{foot.name}, stands"] = foot.stands.astype(int)
    return as_csv([dict(zip(columns, row)) for row in zip(*columns.values())], digits=9)
