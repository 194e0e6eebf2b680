"""The feet of a body in motion: what of it touches ground and walls, and when."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import label

from mpmopt.assess.trajectory import Motion
from mpmopt.scene.particles import own

FEET = 6  # that are told at most
# Of the one that touches longest: what touches for less than this share of that is no foot.
RARELY = 0.05
NEAR = 0.75  # cells from a wall within which a particle touches it


@dataclass(frozen=True)
class Foot:
    """Neighbouring particles that touch a support at some time.

    Attributes
    ----------
    name : str
    particles : (K,) array of int
    height : (F,) array
        Of the lowest of them above the support.
    touches : (F,) array of bool
    """

    name: str
    particles: NDArray[np.int64]
    height: NDArray[np.float64]
    touches: NDArray[np.bool_]

    def __post_init__(self) -> None:
        own(self, "particles", "height", "touches")


def feet(motion: Motion) -> list[Foot]:
    """The feet of a body: what of it touches ground or walls at some time, from back to front.

    A particle touches ground in its layer, and a wall within `NEAR` of a cell. Particles that do
    are one foot if they are neighbours before they move. Of a scene with a mirror, feet are those
    of the simulated half.
    """
    scene, half = motion.scene, len(motion.gamma) // (1 if motion.scene.mirror is None else 2)
    position = motion.position[:, :, :half].astype(float)
    supports = [
        (layer.line.distance(np.moveaxis(position, 1, 0))[0], layer.thickness)
        for layer in scene.layers
    ]
    for wall in scene.walls:
        away = position[:, "xy".index(wall.axis)] - wall.position
        near = NEAR * scene.grid.dx
        supports.append((away if wall.solid_side == "below" else -away, near))
    index = np.floor(position[0] / motion.spacing).astype(int)
    i, j = index - index.min(axis=1, keepdims=True)
    found: list[tuple[int, NDArray[np.int64], NDArray[np.float64], NDArray[np.bool_]]] = []
    for number, (height, near) in enumerate(supports):
        close = (height < near) & (motion.gamma[:half] >= 0.5)
        lattice = np.zeros((i.max() + 1, j.max() + 1), dtype=bool)
        touching = close.any(axis=0)
        lattice[i[touching], j[touching]] = True
        labels = np.where(touching, label(lattice, np.ones((3, 3)))[0][i, j], 0)
        for foot in range(1, labels.max(initial=0) + 1):
            particles = np.flatnonzero(labels == foot)
            lowest = height[:, particles].min(axis=1)
            touches = np.array(close[:, particles].any(axis=1))
            found.append((number, particles, lowest, touches))
    most = max((touches.sum() for *_, touches in found), default=0)
    found = [each for each in found if each[-1].sum() > RARELY * most]
    found = sorted(found, key=lambda each: -each[-1].sum())[:FEET]
    ahead = np.array(scene.direction) @ position[0]
    found.sort(key=lambda each: (each[0], float(ahead[each[1]].mean())))
    several = len({number for number, *_ in found}) > 1
    names = [f"ground {k}" for k in range(len(scene.layers))]
    names += [f"wall {k}" for k in range(len(scene.walls))]
    return [
        Foot(f"foot {k}{f' on {names[number]}' if several else ''}", particles, height, touches)
        for k, (number, particles, height, touches) in enumerate(found, 1)
    ]
