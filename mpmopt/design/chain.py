"""From design variables to material: filter, projection, interpolation, and the way back."""

from __future__ import annotations

import copy
from dataclasses import dataclass

import numpy as np
import scipy.sparse
from numpy.typing import NDArray

from mpmopt.design.projection import (
    lattice_differences,
    project,
    project_adjoint,
    project_subpixel,
    project_subpixel_adjoint,
)
from mpmopt.errors import DesignError
from mpmopt.kernels import interpolation
from mpmopt.scene import Material, Scene
from mpmopt.scene.particles import (
    Particles,
    Solids,
    discretise,
    mirror_images,
    nearest_designed,
    own,
    solids,
)
from mpmopt.validation import number

# Nodes with less than this of a particle's weight do not carry it. Lattice sites have none or far
# more, but for rounding of their position.
LEAST_WEIGHT = 1e-12


def filter_matrix(
    scene: Scene, particles: Particles, points: NDArray[np.float64] | None = None
) -> scipy.sparse.csr_array[np.float64]:
    """The paper's filter (sec. 2.3, steps 1 to 3) as one matrix (D, D) over the D design particles.

    Particle to grid, 3 x 3 convolution (`Scene.filter_passes` times), grid to particle. Only design
    particles take part; nodes that carry none are left out and the weights that remain are scaled
    to sum to one, so that a constant field stays constant. A mirror shows the filter the other
    half's particles: by itself it does what the paper's mapping of one half to the other does.

    Parameters
    ----------
    scene : Scene
    particles : Particles
    points : (M, 2) array, optional
        Where else the filtered field is wanted, in design regions or on their edges: the matrix is
        (M, D) then.
    """
    rows = scene.grid.cells[1] + 1
    body = discretise(scene, whole=True)
    position = body.position[body.designed]
    nodes, values = interpolation(position, scene.grid.dx, rows)
    carries = values > LEAST_WEIGHT
    used, column = np.unique(nodes[carries], return_inverse=True)
    to_particles = scipy.sparse.csr_array(
        (values[carries], (np.nonzero(carries)[0], column)), shape=(len(position), used.size)
    )

    w0, w1, w2 = scene.filter_weights
    node = np.stack(np.divmod(used, rows), axis=1)
    i, j = (index - min(index, default=0) for index in node.T)
    number = np.full(
        (max(i, default=0) + 3, max(j, default=0) + 3), -1
    )  # with a margin of empty nodes
    number[i + 1, j + 1] = np.arange(used.size)
    pairs, shares = [], []
    for di in (-1, 0, 1):
        for dj in (-1, 0, 1):
            neighbour = number[i + 1 + di, j + 1 + dj]
            exists = neighbour >= 0
            pairs.append(np.stack([np.flatnonzero(exists), neighbour[exists]]))
            shares.append(np.full(exists.sum(), (w0, w1, w2)[abs(di) + abs(dj)]))
    row, column = np.concatenate(pairs, axis=1)
    shape = (used.size, used.size)
    convolution = scipy.sparse.csr_array((np.concatenate(shares), (row, column)), shape=shape)

    def normalised(matrix: scipy.sparse.csr_array) -> scipy.sparse.csr_array:
        return scipy.sparse.diags_array(1.0 / matrix.sum(axis=1)) @ matrix

    matrix, convolution = normalised(to_particles.T.tocsr()), normalised(convolution)
    # Distances on the lattice, in half spacings, are whole numbers, which no rounding changes.
    halves = 2 * scene.particles_per_cell
    site = np.rint(position * (halves / scene.grid.dx)).astype(np.int64)
    for _ in range(scene.filter_passes):
        matrix = (convolution @ matrix).tocsr()
        row = np.repeat(np.arange(used.size), np.diff(matrix.indptr))
        apart = halves * node[row] - site[matrix.indices]
        matrix.data[(apart**2).sum(axis=1) > (halves * scene.filter_radius) ** 2] = 0.0
        matrix.eliminate_zeros()
    half, whole = particles.subset(particles.designed), body.subset(body.designed)
    points = half.position if points is None else points
    nodes, values = interpolation(points, scene.grid.dx, rows)
    row, k = np.nonzero((values > LEAST_WEIGHT) & np.isin(nodes, used))
    to_points = scipy.sparse.csr_array(
        (values[row, k], (row, np.searchsorted(used, nodes[row, k]))), (len(points), used.size)
    )
    matrix = normalised((to_points @ matrix).tocsr()).tocsr()
    if scene.mirror is None:
        return matrix
    # Columns are summed over a particle and its image.
    image = mirror_images(scene, half, whole)
    shape = (image.size, len(half.position))
    ones = np.ones(image.size)
    return (matrix @ scipy.sparse.csr_array((ones, (np.arange(image.size), image)), shape)).tocsr()


def non_discreteness(gamma: NDArray) -> float:
    """Mean of 4 gamma (1 - gamma): 0 for a black and white design, 1 for a uniformly grey one."""
    return float(np.mean(4.0 * gamma * (1.0 - gamma))) if gamma.size else 0.0


class DesignChain:
    """Design variables phi (D,) in [-1, 1] to mass density and stiffness of all N particles.

    Parameters
    ----------
    scene : Scene
        Its materials and filter weights.
    particles : Particles
    beta : float
        Sharpness of the projection, > 0.
    subpixel : bool, optional
        Whether edges are at least as wide as a particle, however large beta is
        (`projection.project_subpixel`).

    Attributes
    ----------
    threshold : float
        Of the projection.

    Raises
    ------
    DesignError
        If beta is not positive and finite.
    """

    def __init__(
        self, scene: Scene, particles: Particles, beta: float, subpixel: bool = False
    ) -> None:
        self.beta = number("DesignChain", "beta", beta, above=0.0, error=DesignError)
        self.threshold = 0.5
        self.filter = filter_matrix(scene, particles)
        self.subpixel = subpixel
        self.differences = lattice_differences(scene, particles) if subpixel else []
        self.from_own: NDArray[np.int64] | None = None
        self.designed = particles.designed
        self.solids = solids(scene, particles)
        self._last: Field | None = None

    def varied(
        self, threshold: float, scene: Scene, particles: Particles, own: Particles
    ) -> DesignChain:
        """This chain with another threshold, to the particles of another scene.

        Those take the design from the nearest of this chain's `own`.
        """
        other = copy.copy(self)
        other.threshold, other._last = threshold, None
        if particles is not own:
            other.from_own = nearest_designed(particles, own)
            other.designed = particles.designed
        other.solids = solids(scene, particles)
        return other

    def field(self, phi: NDArray) -> Field:
        """The material of a design phi (D,), real or complex.

        The last one is kept, so that all who ask for one design share one field.
        """
        last = self._last
        if last is not None and last.phi.dtype == phi.dtype and np.array_equal(last.phi, phi):
            return last
        filtered = self.filter @ phi
        filtered = filtered - (filtered.real - np.clip(filtered.real, -1.0, 1.0))  # rounding
        gamma = np.ones(self.designed.size, dtype=np.result_type(phi, float))
        gamma[self.designed] = self._projected(filtered)
        material = interpolate(self.solids, gamma)
        last = self._last = Field(self, phi, filtered, gamma[self.designed], *material)
        return last  # which another thread may have replaced

    def _projected(self, filtered: NDArray) -> NDArray:
        """gamma of the design particles."""
        if self.subpixel:
            gamma = project_subpixel(filtered, self.beta, self.threshold, self.differences)
        else:
            gamma = project(filtered, self.beta, self.threshold)
        return gamma if self.from_own is None else gamma[self.from_own]

    def _projected_adjoint(self, filtered: NDArray, gamma_bar: NDArray) -> NDArray:
        """Adjoint of the filtered design."""
        if self.from_own is not None:
            own_bar = np.zeros(filtered.shape, gamma_bar.dtype)
            np.add.at(own_bar, self.from_own, gamma_bar)
            gamma_bar = own_bar
        if self.subpixel:
            return project_subpixel_adjoint(
                filtered, self.beta, gamma_bar, self.threshold, self.differences
            )
        return project_adjoint(filtered, self.beta, gamma_bar, self.threshold)


@dataclass(frozen=True)
class Field:
    """A design's material, by `DesignChain.field`: all that a simulation and its pullback need.

    Attributes
    ----------
    chain : DesignChain
    phi : (D,) array
        Design variables.
    filtered : (D,) array
        Filtered phi; of the chain's own design particles where it goes to another scene's.
    gamma : (D,) array
        Material density of the design particles, within [0, 1].
    density, stiffness : (N,) arrays
        Of all particles; stiffness as a share of the solid's.
    """

    chain: DesignChain
    phi: NDArray
    filtered: NDArray
    gamma: NDArray
    density: NDArray
    stiffness: NDArray

    def __post_init__(self) -> None:
        own(self, "phi", "filtered", "gamma", "density", "stiffness")

    def pullback(
        self, density_bar: NDArray, stiffness_bar: NDArray, gamma_bar: NDArray | float = 0.0
    ) -> NDArray:
        """phi_bar (D,) from the adjoints of density and stiffness (N,), and of gamma (D,)."""
        chain = self.chain
        through = interpolate_adjoint(chain.solids, density_bar, stiffness_bar)
        gamma_bar = through[chain.designed] + gamma_bar
        return chain.filter.T @ chain._projected_adjoint(self.filtered, gamma_bar)


def interpolate(material: Material | Solids, gamma: NDArray) -> tuple[NDArray, NDArray]:
    """Density and stiffness, linear in gamma between floors and solid (paper, sec. 2.2)."""
    mass = (1.0 - material.void_density) * gamma + material.void_density
    stiffness = (1.0 - material.void_stiffness) * gamma + material.void_stiffness
    return material.density * mass, stiffness


def interpolate_adjoint(
    material: Material | Solids, density_bar: NDArray, stiffness_bar: NDArray
) -> NDArray:
    """gamma_bar from the adjoints of density and stiffness."""
    return (1.0 - material.void_density) * material.density * density_bar + (
        1.0 - material.void_stiffness
    ) * stiffness_bar
