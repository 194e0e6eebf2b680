"""A robot that crosses rough ground: the walker's body, designed on three grounds at once.

    python cases/terrain.py --preview --out DIR

Hollows are up to a cell deep, that is a seventh of a leg's height. What it is judged
on is a fourth ground, which no scene of the optimisation has. `slope` and `step` are other shapes.
"""

import sys
from dataclasses import replace

import numpy as np
import walker

from mpmopt.app.case import Case
from mpmopt.app.script import main
from mpmopt.optimisation.presets import gait
from mpmopt.scene import Ground, Scene

C = 1 / 64
FLAT = walker.CASES["preview"].scene
NEAR, FAR = 1.5, 5.0  # how far rough ground goes, for designs and for robots that are followed


def on(ground: Ground, scene: Scene = FLAT) -> Scene:
    """The walker on ground of another shape, with its friction and its layer."""
    return replace(scene, ground=(like_flat(ground),))


def like_flat(ground: Ground) -> Ground:
    """Ground of another shape with the walker's friction and layer."""
    return replace(FLAT.ground[0], points=ground.points)


def slope(degrees: float = 5.0) -> Scene:
    """Ground that rises in front of the body, or falls where the angle is negative."""
    rise = float(np.tan(np.radians(degrees)))
    return on(Ground(((0.0, 3 * C), (32 * C, 3 * C), (33 * C, (3 + rise) * C))))


def step(height: float = C) -> Scene:
    """A step up in front of the body, or down where the height is negative."""
    up = 3 * C + height
    return on(Ground(((0.0, 3 * C), (34 * C, 3 * C), (34 * C, up), (35 * C, up))))


def hills(seed: int, depth: float = C, far: float = NEAR) -> Ground:
    """Hills and hollows, every five cells, of which no hill is above the walker's floor."""
    places = np.arange(0.0, far, 5 * C)
    heights = 3 * C - depth * np.random.default_rng(seed).uniform(0.0, 1.0, len(places))
    return like_flat(Ground.heights(places.tolist(), heights.tolist()))


def rough(seed: int = 0, depth: float = C, scene: Scene = FLAT) -> Scene:
    """The walker on hills and hollows."""
    return replace(scene, ground=(hills(seed, depth, FAR),))


# As the walker's, but each on other hills.
TASK = replace(
    walker.TASK,
    scenes=tuple(
        replace(variation, ground=(hills(seed),))
        for seed, variation in enumerate(walker.TASK.scenes, 4)
    ),
)

CASES = {
    "default": Case(
        rough(scene=walker.CASES["default"].scene),
        gait(120),
        walker.two_legs,
        walker.START,
        TASK,
    ),
    "preview": Case(rough(), gait(40), walker.two_legs, walker.START, TASK),
}

if __name__ == "__main__":
    sys.exit(main(__doc__.splitlines()[0], CASES))
