"""The walker on other ground than a level floor: a slope, a step, rough ground.

python cases/terrain.py --slope --out DIR
"""

import sys
from dataclasses import replace

import numpy as np
import walker

from mpmopt.app.script import main
from mpmopt.scene import Ground, Scene

C = 1 / 64
FLAT = walker.CASES["preview"].scene


def on(ground: Ground) -> Scene:
    """The walker of the preview on ground of another shape, with its friction and its layer."""
    return replace(FLAT, ground=(replace(FLAT.ground[0], points=ground.points),))


def slope(degrees: float = 5.0) -> Scene:
    """Ground that rises in front of the body, or falls where the angle is negative."""
    rise = float(np.tan(np.radians(degrees)))
    return on(Ground(((0.0, 3 * C), (32 * C, 3 * C), (33 * C, (3 + rise) * C))))


def step(height: float = C) -> Scene:
    """A step up in front of the body, or down where the height is negative."""
    up = 3 * C + height
    return on(Ground(((0.0, 3 * C), (34 * C, 3 * C), (34 * C, up), (35 * C, up))))


def rough(depth: float = C / 2) -> Scene:
    """Hills and hollows, every two cells, of which no hill is above the walker's floor."""
    heights = 3 * C - depth * np.random.default_rng(0).uniform(0.0, 1.0, 49)
    return on(Ground.heights(np.linspace(0.0, 1.5, 49).tolist(), heights.tolist()))


CASES = {
    "default": replace(walker.CASES["preview"], scene=rough()),
    "slope": replace(walker.CASES["preview"], scene=slope()),
    "step": replace(walker.CASES["preview"], scene=step()),
}

if __name__ == "__main__":
    sys.exit(main(__doc__.splitlines()[0], CASES))
