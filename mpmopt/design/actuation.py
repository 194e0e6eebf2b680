"""The actuators' signals s_k(t) = a_k sin(omega_k t + pi theta_k) + b_k, and their pullback."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from mpmopt.scene import Scene


def _phase(scene: Scene, theta: NDArray) -> NDArray:
    time = np.arange(scene.steps) * scene.time_step
    omega = np.array([actuator.angular_frequency for actuator in scene.actuators])
    return omega * time[:, None] + np.pi * theta


def signal(scene: Scene, a: NDArray, theta: NDArray, b: NDArray) -> NDArray:
    """Signals at the start of every step, from amplitude, phase and bias.

    Parameters
    ----------
    scene : Scene
        With K actuators.
    a, theta, b : (K,) arrays
        Real or complex.

    Returns
    -------
    (steps, K) array
    """
    return a * np.sin(_phase(scene, theta)) + b


def signal_adjoint(
    scene: Scene, a: NDArray, theta: NDArray, signal_bar: NDArray
) -> tuple[NDArray, NDArray, NDArray]:
    """Adjoints of a, theta and b (K,) from those of the signals (steps, K)."""
    phase = _phase(scene, theta)
    a_bar = (signal_bar * np.sin(phase)).sum(axis=0)
    theta_bar = np.pi * a * (signal_bar * np.cos(phase)).sum(axis=0)
    return a_bar, theta_bar, signal_bar.sum(axis=0)
