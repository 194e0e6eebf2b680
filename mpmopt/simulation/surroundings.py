"""A scene's surroundings as the kernels see them."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from mpmopt import kernels
from mpmopt.kernels import contact, ground
from mpmopt.scene import Scene


def parameters_of(scene: Scene) -> kernels.Parameters:
    """The scene's surroundings as the kernels see them."""
    dx = scene.grid.dx
    return kernels.Parameters(
        dt=scene.time_step,
        dx=dx,
        per_dx=1.0 / dx,
        nodes_x=scene.grid.cells[0] + 1,
        nodes_y=scene.grid.cells[1] + 1,
        gravity_x=scene.gravity[0],
        gravity_y=scene.gravity[1],
        walls=np.array([wall.row(dx) for wall in scene.walls], dtype=float).reshape(
            -1, len(contact.COLUMNS)
        ),
        ground=_ground_of(scene),
        clamps=np.array([clamp.rows(scene) for clamp in scene.clamps])
        .reshape(-1, scene.steps, 6)
        .swapaxes(0, 1)
        .copy(),
        mirror_axis=-1 if scene.mirror is None else scene.mirror.normal,
        mirror_node=0 if scene.mirror is None else round(scene.mirror.position / dx),
        viscous=any(material.viscosity > 0.0 for material in scene.materials),
        mass_tolerance=0.0,
    )


def holders(
    places: NDArray[np.float64], clamps: NDArray[np.float64], reach: float = 0.0
) -> NDArray[np.int64]:
    """The first of the clamps (K, 6) of a step that holds what is at places (2, M), or -1: (M,).

    They hold as far out as `reach`; without it, as `kernels.contact.clamp_of` says.
    """
    found = np.full(places.shape[1], -1)
    for k in reversed(range(len(clamps))):
        low, high = clamps[k, 0:2, None] - reach, clamps[k, 2:4, None] + reach
        found[((low <= places) & (places <= high)).all(axis=0)] = k
    return found


def _ground_of(scene: Scene) -> ground.Ground:
    """The scene's ground as the kernels see it."""
    lines = [layer.line for layer in scene.layers]
    rows = [
        np.column_stack(
            [line.start, line.along, line.low, line.high, line.corner[:-1], line.corner[1:]]
        )
        for line in lines
    ]
    layers = [layer[1:] for layer in scene.layers]
    nodes_y = scene.grid.cells[1] + 1
    nodes = (scene.grid.cells[0] + 1) * nodes_y if layers else 0
    result = ground.Ground(
        segments=np.concatenate([np.empty((0, ground.SEGMENT_SIZE)), *rows]),
        first=np.cumsum([0, *map(len, rows)]),
        layers=np.array(layers, dtype=float).reshape(-1, len(ground.LAYER)),
        nodes=np.empty((nodes, ground.NODE_COLUMNS)),
        clearance=np.empty(nodes),
    )
    if layers:
        ground.tabulate(result, nodes_y, scene.grid.dx)
    return result
