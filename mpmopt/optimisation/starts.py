"""Random starts: smooth fields that are added to the phi of a start."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from mpmopt.scene import Design, Scene

AMPLITUDE = 0.3  # standard deviation of a start's phi
LENGTH = 0.15  # its correlation length, in longest sides of the design domain
WAVES = 64


def random_start(scene: Scene, seed: int) -> Callable[[NDArray], NDArray[np.float64]]:
    """A smooth random field phi, the same on every grid.

    A sum of plane waves, phi = A sqrt(2 / W) sum_w cos(k_w . x + p_w), with Gaussian k_w and
    uniform p_w: nearly a Gaussian field with covariance A^2 exp(-r^2 / (2 l^2)) (Shinozuka and
    Deodatis, Applied Mechanics Reviews 44, 1991, 191), where l is `LENGTH` times the longest side
    of the design domain and A is `AMPLITUDE`. What is beyond [-1, 1] is cut off.

    Parameters
    ----------
    scene : Scene
    seed : int

    Returns
    -------
    callable
        From positions (D, 2) to phi (D,).
    """
    corners = np.array([(r.lower, r.upper) for r in scene.body if isinstance(r, Design)])
    sides = np.ptp(corners, axis=(0, 1)) if len(corners) else np.ones(2)
    rng = np.random.default_rng(seed)
    waves = rng.standard_normal((2, WAVES)) / (LENGTH * sides.max())
    phase = rng.uniform(0.0, 2.0 * np.pi, WAVES)

    def field(position: NDArray) -> NDArray[np.float64]:
        total = np.cos(position @ waves + phase).sum(axis=1)
        return np.clip(AMPLITUDE * math.sqrt(2.0 / WAVES) * total, -1.0, 1.0)

    return field


def disturbed(
    phi: NDArray | Callable[[NDArray], NDArray], scene: Scene, seed: int
) -> Callable[[NDArray], NDArray[np.float64]]:
    """A start's phi, (D,) or a function of positions, with a `random_start` added, in [-1, 1]."""
    noise = random_start(scene, seed)

    def field(position: NDArray) -> NDArray[np.float64]:
        own = phi(position) if callable(phi) else phi
        return np.clip(own + noise(position), -1.0, 1.0)

    return field
