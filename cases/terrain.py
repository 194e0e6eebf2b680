"""The walker on other ground than a level floor: a slope, a step, rough ground.

    python cases/terrain.py --slope --out DIR
"""

import sys
from dataclasses import replace

import numpy as np
import walker

from mpmopt.app.case import Case
from mpmopt.app.script import main
from mpmopt.scene import Ground, Scene

C = 1 / 64


def on(ground: Ground) -> Scene:
    """The walker's preview on another ground, level with its floor where the body starts."""
    return replace(walker.PREVIEW, ground=(ground,))


def slope(degrees: float = 5.0) -> Scene:
    """Ground that rises in front of the body, or falls where the angle is negative."""
    rise = float(np.tan(np.radians(degrees)))
    return on(Ground(((0.0, 3 * C), (24 * C, 3 * C), (25 * C, (3 + rise) * C))))


def step(height: float = C) -> Scene:
    """A step up in front of the body, or down where the height is negative."""
    up = 3 * C + height
    return on(Ground(((0.0, 3 * C), (26 * C, 3 * C), (26 * C, up), (1.0, up))))


def rough(depth: float = C / 2) -> Scene:
    """Hills and hollows, every two cells, of which no hill is above the walker's floor."""
    heights = 3 * C - depth * np.random.default_rng(0).uniform(0.0, 1.0, 33)
    return on(Ground.heights(np.linspace(0.0, 1.0, 33).tolist(), heights.tolist()))


CASES = {
    "default": replace(walker.CASES["preview"], scene=rough()),
    "slope": replace(walker.CASES["preview"], scene=slope()),
    "step": replace(walker.CASES["preview"], scene=step()),
}

if __name__ == "__main__":
    sys.exit(main(__doc__.splitlines()[0], CASES))
