"""The actuators' signals, sums of sines whose frequency may be designed, and their pullback.

Of actuator k with harmonics h = 1 .. H:

    s(t) = b + sum_h a_h sin(h omega t + pi theta_h),  omega = angular_frequency (1 + detuning w)

With one harmonic and no detuning that is the paper's. The variables a, theta, b and w (which is
called omega) are within [-1, 1], so a signal is within 1 + H of zero (`Actuator.largest_signal`).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from mpmopt.scene import Scene

NONE: NDArray[np.float64] = np.empty(0)


def sizes(scene: Scene) -> tuple[int, int, int, int]:
    """Numbers of entries of a, theta, b and omega.

    a and theta have one for each harmonic of each actuator, actuator by actuator; b one for each
    actuator; omega one for each actuator with a detuning.
    """
    actuators = scene.actuators
    waves = sum(actuator.harmonics for actuator in actuators)
    return waves, waves, len(actuators), sum(actuator.detuning > 0.0 for actuator in actuators)


def labels(scene: Scene) -> list[str]:
    """What each entry of a, theta, b and omega is of, in this order."""
    numbered = list(enumerate(scene.actuators))
    waves = [
        f"of actuator {k}" + (f", harmonic {h + 1}" if actuator.harmonics > 1 else "")
        for k, actuator in numbered
        for h in range(actuator.harmonics)
    ]
    biases = [f"of actuator {k}" for k, _ in numbered]
    tuned = [f"of actuator {k}" for k, actuator in numbered if actuator.detuning > 0.0]
    entries = {"a": waves, "theta": waves, "b": biases, "omega": tuned}
    return [f"{name} {each}" for name, several in entries.items() for each in several]


def frequencies(scene: Scene, omega: NDArray) -> NDArray:
    """Angular frequency (K,) of each actuator."""
    detuning = np.array([actuator.detuning for actuator in scene.actuators])
    change = np.zeros(detuning.size, dtype=np.result_type(omega, float))
    change[detuning > 0.0] = omega
    nominal = np.array([actuator.angular_frequency for actuator in scene.actuators])
    return nominal * (1.0 + detuning * change)


class _Waves:
    """The M sines of all actuators; those of actuator k are the ones from ``first[k]`` on."""

    def __init__(self, scene: Scene, theta: NDArray, omega: NDArray) -> None:
        harmonics = np.array([actuator.harmonics for actuator in scene.actuators], dtype=int)
        self.first = np.cumsum(harmonics) - harmonics
        self.actuator = np.repeat(np.arange(harmonics.size), harmonics)
        self.order = np.arange(self.actuator.size) - self.first[self.actuator] + 1  # h
        self.time = np.arange(scene.steps) * scene.time_step
        frequency = self.order * frequencies(scene, omega)[self.actuator]
        self.phase = frequency * self.time[:, None] + np.pi * theta  # (steps, M)

    def summed(self, waves: NDArray) -> NDArray:
        """Sums (..., K) over the harmonics of each actuator."""
        return np.add.reduceat(waves, self.first, axis=-1)

    def spread(self, signals: NDArray) -> NDArray:
        """The same for all harmonics of an actuator (..., M), the transpose of `summed`."""
        return np.take(signals, self.actuator, axis=-1)


def signal(scene: Scene, a: NDArray, theta: NDArray, b: NDArray, omega: NDArray = NONE) -> NDArray:
    """Signals at the start of every step.

    Parameters
    ----------
    scene : Scene
        With K actuators.
    a, theta, b, omega : arrays
        Real or complex, as many as `sizes` says.

    Returns
    -------
    (steps, K) array
    """
    waves = _Waves(scene, theta, omega)
    return waves.summed(a * np.sin(waves.phase)) + b


def signal_adjoint(
    scene: Scene, a: NDArray, theta: NDArray, signal_bar: NDArray, omega: NDArray = NONE
) -> tuple[NDArray, NDArray, NDArray, NDArray]:
    """Adjoints of a, theta, b and omega from those of the signals (steps, K)."""
    waves = _Waves(scene, theta, omega)
    waves_bar = waves.spread(signal_bar)
    phase_bar = waves_bar * np.cos(waves.phase)  # but for a
    a_bar = (waves_bar * np.sin(waves.phase)).sum(axis=0)
    theta_bar = np.pi * a * phase_bar.sum(axis=0)
    frequency_bar = waves.summed(waves.order * a * (waves.time @ phase_bar))
    omega_bar = [
        bar * actuator.angular_frequency * actuator.detuning
        for bar, actuator in zip(frequency_bar, scene.actuators)
        if actuator.detuning > 0.0
    ]
    return a_bar, theta_bar, signal_bar.sum(axis=0), np.array(omega_bar, dtype=float)
