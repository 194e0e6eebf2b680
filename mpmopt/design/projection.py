"""From a filtered design to material density: smoothed Heaviside functions, and the way back.

The plain one is as wide as beta says, on the scale of the design. The subpixel one is at least as
wide as a particle, in space: with a large beta it is black and white everywhere else, and still has
a gradient all along the edges of a design (SSP2: Romano, Arrieta and Johnson, arXiv:2601.10737;
after Hammond et al., arXiv:2503.20189).
"""

from __future__ import annotations

import numpy as np
import scipy.sparse
from numpy.typing import NDArray

from mpmopt.scene import Scene
from mpmopt.scene.particles import Particles, discretise, mirror_images

# R: half the width of an edge, in particle spacings.
REACH = 0.55
LEAST_SLOPE = 1e-6  # where a design does not vary, gamma is the plain one


def project(phi: NDArray, beta: float, threshold: float = 0.5) -> NDArray:
    """Smoothed Heaviside gamma, 0 at phi = -1 and 1 at phi = 1, steepest where (phi + 1) / 2 = eta.

    The paper's gamma = (tanh(beta phi) / tanh(beta) + 1) / 2 at a threshold eta of 1/2; others
    erode or dilate the design (Wang, Lazarov and Sigmund, 2011).
    """
    if threshold == 0.5:
        return 0.5 * (np.tanh(beta * phi) / np.tanh(beta) + 1.0)
    at, low, high = _edges(beta, threshold)
    return (np.tanh(beta * (phi - at)) + low) / (low + high)


def project_adjoint(
    phi: NDArray, beta: float, gamma_bar: NDArray, threshold: float = 0.5
) -> NDArray:
    """phi_bar from gamma_bar."""
    at, low, high = _edges(beta, threshold)
    decay = np.exp(-np.abs(beta * (phi - at)))
    sech = 2.0 * decay / (1.0 + decay**2)  # 1 - tanh^2 = sech^2, which does not cancel
    return gamma_bar * beta / (low + high) * sech**2


def _edges(beta: float, threshold: float) -> tuple[float, float, float]:
    """The threshold on the scale of phi, and tanh(beta x) for the ways x from the ends to it."""
    at = 2.0 * threshold - 1.0
    return at, float(np.tanh(beta * (1.0 + at))), float(np.tanh(beta * (1.0 - at)))


def lattice_differences(scene: Scene, particles: Particles) -> list[scipy.sparse.csr_array]:
    """Matrices (D, D) of d/dx, d/dy, and R d2/dx2, R d2/dy2, sqrt(2) R d2/dxdy, in spacings.

    They are between the D design particles of a scene and their neighbours, across a mirror too.
    Where one neighbour along an axis is missing, the first difference is one-sided and the second
    along that axis zero.
    """
    body = discretise(scene, whole=True)
    half, whole = particles.subset(particles.designed), body.subset(body.designed)
    image = mirror_images(scene, half, whole)
    site = np.floor(whole.position * (scene.particles_per_cell / scene.grid.dx)).astype(np.int64)
    site += 1  # with a margin of empty sites
    number = np.full(site.max(axis=0, initial=0) + 2, -1)
    here = np.arange(len(site))
    number[tuple(site.T)] = here

    def matrix(column: NDArray, values: NDArray) -> scipy.sparse.csr_array:
        return scipy.sparse.csr_array((values, (here, column)), shape=(here.size, here.size))

    first, second = [], []
    for step in np.eye(2, dtype=np.int64):
        sides = [number[tuple((site + sign * step).T)] for sign in (1, -1)]
        there = [side >= 0 for side in sides]
        share = 1.0 / np.maximum(there[0].astype(float) + there[1], 1.0)
        after, before = (np.where(side >= 0, side, here) for side in sides)
        both = (there[0] & there[1]).astype(float)
        first.append(matrix(after, share) - matrix(before, share))
        second.append(matrix(after, both) - matrix(here, 2.0 * both) + matrix(before, both))
    differences = [
        *first, REACH * second[0], REACH * second[1], np.sqrt(2.0) * REACH * (first[0] @ first[1])
    ]  # fmt: skip
    if scene.mirror is not None:  # columns are summed over a particle and its image
        kept = np.unique(image, return_index=True)[1]
        ones = np.ones(image.size)
        fold = scipy.sparse.csr_array((ones, (here, image)), shape=(here.size, kept.size))
        differences = [(each @ fold).tocsr()[kept] for each in differences]
    return [each.tocsr() for each in differences]


def project_subpixel(
    phi: NDArray, beta: float, threshold: float, differences: list[scipy.sparse.csr_array]
) -> NDArray:
    """gamma = (1 - F) P(phi - R n F) + F P(phi + R n (1 - F)) with `project` as P.

    F(s) rises from 0 to 1 between the distances s = -1 and 1 from the edge, in half widths;
    s = (phi - phi_0) / (R n), n^2 = |grad phi|^2 + R^2 |grad grad phi|^2, phi_0 the threshold.
    """
    reach, _, F = edge(phi, threshold, differences)
    low, high = (
        project(each, beta, threshold) for each in (phi - reach * F, phi + reach * (1 - F))
    )
    return (1.0 - F) * low + F * high


def project_subpixel_adjoint(
    phi: NDArray,
    beta: float,
    gamma_bar: NDArray,
    threshold: float,
    differences: list[scipy.sparse.csr_array],
) -> NDArray:
    """phi_bar from gamma_bar."""
    reach, s, F = edge(phi, threshold, differences)
    low, high = phi - reach * F, phi + reach * (1.0 - F)
    low_bar = project_adjoint(low, beta, (1.0 - F) * gamma_bar, threshold)
    high_bar = project_adjoint(high, beta, F * gamma_bar, threshold)
    jump = project(high, beta, threshold) - project(low, beta, threshold)
    F_bar = gamma_bar * jump - reach * (low_bar + high_bar)
    s_bar = 0.9375 * (1.0 - s**2) ** 2 * F_bar
    reach_bar = (1.0 - F) * high_bar - F * low_bar - s_bar * s / reach
    phi_bar = low_bar + high_bar + s_bar / reach
    for difference in differences:
        phi_bar += difference.T @ (reach_bar * REACH**2 / reach * (difference @ phi))
    return phi_bar


def edge(
    phi: NDArray, threshold: float, differences: list[scipy.sparse.csr_array]
) -> tuple[NDArray, NDArray, NDArray]:
    """R n, half the width of an edge on the scale of phi, s within [-1, 1], and F."""
    squares = sum((difference @ phi) ** 2 for difference in differences)
    reach = REACH * np.sqrt(squares + LEAST_SLOPE**2)
    s = (phi - (2.0 * threshold - 1.0)) / reach
    s = np.where(np.abs(s.real) < 1.0, s, np.sign(s.real))
    return reach, s, _rise(s)


def _rise(s: NDArray) -> NDArray:
    """F."""
    return 0.5 + 0.0625 * s * (15.0 - 10.0 * s**2 + 3.0 * s**4)


def edge_at(gamma: float) -> float:
    """The s at which F is gamma."""
    s = np.linspace(-1.0, 1.0, 20001)
    return float(np.interp(gamma, _rise(s), s))
