"""The scene's body laid out as particles."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from mpmopt.scene import Actuator, Design, Scene


def own(owner: Any, *names: str) -> None:
    """Replace arrays of a frozen dataclass by copies that nobody can write to."""
    for name in names:
        array = np.array(getattr(owner, name))
        array.setflags(write=False)
        object.__setattr__(owner, name, array)


@dataclass(frozen=True)
class Particles:
    """N particles in their reference position.

    Attributes
    ----------
    position : (N, 2) array
    volume : (N,) array
        Reference volume (an area).
    designed : (N,) array of bool
        Whether a particle's material is designed; the others are solid.
    actuator : (N,) array of int
        Index of the particle's actuator, -1 if it has none.
    region : (N,) array of int
        Index of the particle's region of the scene's body.
    """

    position: NDArray[np.float64]
    volume: NDArray[np.float64]
    designed: NDArray[np.bool_]
    actuator: NDArray[np.int64]
    region: NDArray[np.int64]

    def __post_init__(self) -> None:
        own(self, "position", "volume", "designed", "actuator", "region")

    def subset(self, keep: NDArray[np.bool_]) -> Particles:
        """The particles that `keep` (N,) marks, in the same order."""
        return Particles(
            self.position[keep], self.volume[keep], self.designed[keep], self.actuator[keep],
            self.region[keep],
        )  # fmt: skip

    def completed(self, values: NDArray) -> NDArray:
        """Values (N,) of all particles: those of the design particles (D,), and 1 elsewhere."""
        found = np.ones(len(self.position), values.dtype)
        found[self.designed] = values
        return found


class Solids(NamedTuple):
    """What `Material` has of the same name, of the solid that each of N particles is made of."""

    density: NDArray[np.float64]  # (N,)
    void_density: NDArray[np.float64]  # (N,)
    void_stiffness: NDArray[np.float64]  # (N,)


def of_solid(scene: Scene, particles: Particles, name: str) -> NDArray[np.float64]:
    """An attribute of the scene's materials, by its name, of each particle's solid (N,)."""
    values = [getattr(scene.material_of(region), name) for region in scene.body]
    return np.array(values, dtype=float)[particles.region]


def solids(scene: Scene, particles: Particles) -> Solids:
    """Density and floors of the solid that each particle is made of."""
    return Solids(*(of_solid(scene, particles, name) for name in Solids._fields))


def discretise(scene: Scene, whole: bool = False) -> Particles:
    """Fill the body with a regular lattice of particles, column by column as nodes are stored.

    Parameters
    ----------
    scene : Scene
    whole : bool, optional
        Lay out both halves of a scene with a mirror, not only the simulated one.
    """
    spacing = scene.grid.dx / scene.particles_per_cell
    columns, rows, designed, actuator, regions = [], [], [], [], []
    actuators = 0
    for number, region in enumerate(scene.body):
        (i0, j0), (i1, j1) = scene.lattice(region)
        i, j = (index.ravel() for index in np.meshgrid(range(i0, i1), range(j0, j1)))
        columns.append(i)
        rows.append(j)
        designed.append(np.full(i.size, isinstance(region, Design)))
        actuator.append(np.full(i.size, actuators if isinstance(region, Actuator) else -1))
        regions.append(np.full(i.size, number))
        actuators += isinstance(region, Actuator)
    i, j = np.concatenate(columns), np.concatenate(rows)
    order = np.lexsort((j, i))
    position = (np.stack([i, j], axis=1)[order] + 0.5) * spacing
    particles = Particles(
        position=position,
        volume=np.full(len(position), spacing**2),
        designed=np.concatenate(designed)[order],
        actuator=np.concatenate(actuator)[order].astype(np.int64),
        region=np.concatenate(regions)[order].astype(np.int64),
    )
    if scene.mirror is None or whole:
        return particles
    return particles.subset(position[:, scene.mirror.normal] < scene.mirror.position)


def mirror_images(scene: Scene, half: Particles, whole: Particles) -> NDArray[np.int64]:
    """Index into the half's particles of each particle of the whole body, or of its image."""
    mirror = scene.mirror
    if mirror is None:
        return np.arange(len(half.position))
    spacing = scene.grid.dx / scene.particles_per_cell
    folded = whole.position.copy()
    across = folded[:, mirror.normal]
    np.minimum(across, 2.0 * mirror.position - across, out=across)
    row = round(scene.grid.size[1] / spacing)

    def cell(position: NDArray[np.float64]) -> NDArray[np.int64]:
        index = (position / spacing).astype(np.int64)
        return index[:, 0] * row + index[:, 1]

    return np.searchsorted(cell(half.position), cell(folded))


def nearest_designed(particles: Particles, others: Particles) -> NDArray[np.int64]:
    """Index of the design particle of `others` that is nearest to each of `particles`' own."""
    here, there = (each.position[each.designed] for each in (particles, others))
    return KDTree(there).query(here)[1] if len(here) else np.empty(0, np.int64)
