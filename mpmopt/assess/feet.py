"""The feet of a body in motion: what of it touches ground and walls, and when."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import binary_dilation, label

from mpmopt.assess.trajectory import Motion
from mpmopt.scene.particles import own

FEET = 6  # that are told at most: those that bear for longest
# Of the one that bears most: what bears less than this share of that in all is no foot.
RARELY = 0.01
TOUCHES = 1e-3  # of what a layer bears at the ground: less is rounding
NEAR = 0.75  # cells from a wall within which a particle touches it
BEARS = 0.1  # of the largest load on any foot: one with more stands


@dataclass(frozen=True)
class Foot:
    """A patch of K particles that touches ground or a wall, at F instants.

    Attributes
    ----------
    name : str
    particles : (K,) array of int
    place, height : (F,) arrays
        Its mean coordinate along the direction, and its least distance from what it stands on: in
        the total Lagrangian formulation that of an edge of a particle.
    load : (F,) array
        Sum over its particles of how deep they are in the layer, over its thickness; in the total
        Lagrangian formulation of the mean over their width. The normal force is in proportion.
    stands : (F,) array of bool
        Whether that is more than `BEARS` of the largest on any foot.
    """

    name: str
    particles: NDArray[np.int64]
    place: NDArray[np.float64]
    height: NDArray[np.float64]
    load: NDArray[np.float64]
    stands: NDArray[np.bool_]

    def __post_init__(self) -> None:
        own(self, "particles", "place", "height", "load", "stands")


def feet(motion: Motion) -> list[Foot]:
    """The feet of a body, the hindmost first: what of it touches ground or walls at some time.

    A particle touches ground in its layer, and a wall within `NEAR` of a cell.

    Parameters
    ----------
    motion : Motion
        At F instants, the first of them the start. Particles that touch, and were within two
        spacings of each other there, are one foot; of a scene with a mirror those of one half.
    """
    scene = motion.scene
    half = len(motion.gamma) // (1 if scene.mirror is None else 2)
    position = motion.position[:, :, :half].astype(float)
    width = motion.spacing if scene.formulation == "total" else 0.0
    supports = {}
    for k, layer in enumerate(scene.layers):
        away, _ = layer.line.distance(np.moveaxis(position, 1, 0))
        supports[f"ground {k}"] = away - 0.5 * width, layer.bearing(away, width)
    for k, wall in enumerate(scene.walls):
        away = position[:, "xy".index(wall.axis)] - wall.position
        away = away if wall.solid_side == "below" else -away
        supports[f"wall {k}"] = away, np.maximum(1.0 - away / (NEAR * scene.grid.dx), 0.0)
    index = np.floor(position[0] / motion.spacing).astype(int)
    i, j = index - index.min(axis=1, keepdims=True)
    near, along = np.ones((3, 3)), np.einsum("k,fkp->fp", scene.direction, position)
    found = []
    for name, (distance, depth) in supports.items():
        depth = depth * (motion.gamma[:half] >= 0.5)
        often = (depth > TOUCHES).any(axis=0)
        lattice = np.zeros((i.max() + 1, j.max() + 1), dtype=bool)
        lattice[i[often], j[often]] = True
        names = np.where(often, label(binary_dilation(lattice, near), near)[0][i, j], 0)
        for number in range(1, names.max(initial=0) + 1):
            its = np.flatnonzero(names == number)
            found.append((name, its, distance[:, its].min(axis=1), depth[:, its].sum(axis=1)))
    most = max((load.sum() for *_, load in found), default=0.0)
    found = [each for each in found if each[3].sum() > RARELY * most]
    found = sorted(found, key=lambda each: -each[3].sum())[:FEET]
    found.sort(key=lambda each: (each[0], float(along[0, each[1]].mean())))
    several = len({each[0] for each in found}) > 1
    largest = max((load.max() for *_, load in found), default=0.0)
    return [
        Foot(
            f"foot {number}{f' on {name}' if several else ''}",
            its,
            along[:, its].mean(axis=1),
            height,
            load,
            load > BEARS * largest,
        )
        for number, (name, its, height, load) in enumerate(found, 1)
    ]
