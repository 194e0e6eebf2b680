"""The walker's scene in libraries that differentiate by themselves, for the benchmark."""

import numpy as np
from numpy.typing import NDArray

from mpmopt.kernels import Parameters, contact, ungrouped
from mpmopt.simulation.simulation import Simulation


def window(simulation: Simulation) -> tuple[NDArray, NDArray]:
    """First node and size of a window of nodes that the body never leaves."""
    steps = simulation.steps
    run = (
        simulation.run(frames=range(0, steps + 1, 5))[:, 0:2].real / simulation.parameters.dx - 0.5
    )
    low = run.min(axis=(0, 2)).astype(int) - 2
    high = run.max(axis=(0, 2)).astype(int) + 5
    return low, high - low


def clamped(parameters: Parameters) -> tuple[list[int], list[int]]:
    """First and last node along x and y that no wall clamps; only sticking walls are known."""
    if parameters.mirror_axis >= 0 or not np.all(np.isinf(parameters.walls[:, contact.FRICTION])):
        raise NotImplementedError("only sticking walls and no mirror planes")
    low, high = [0, 0], [parameters.nodes_x, parameters.nodes_y]
    for row in parameters.walls:
        axis, node = int(row[contact.AXIS]), int(row[contact.NODE])
        if row[contact.SIDE] > 0:
            low[axis] = max(low[axis], node)
        else:
            high[axis] = min(high[axis], node)
    return low, high


def constants(simulation: Simulation) -> tuple[NDArray, NDArray, NDArray, NDArray]:
    """Volume, mass, lambda and mu (N,) of the particles."""
    data, count = simulation.data, simulation.initial.shape[1]
    arrays = (data.volume, data.mass, data.stiffness, *data.constants[:2])
    volume, mass, stiffness, lam, mu = (ungrouped(array, 1, count)[0] for array in arrays)
    return volume, mass, stiffness * lam, stiffness * mu


def stiffness_bar(simulation: Simulation, lambda_bar: NDArray, mu_bar: NDArray) -> NDArray:
    """The adjoint (N,) of the particles' stiffness, from those of lambda and mu."""
    count = simulation.initial.shape[1]
    lam, mu = (ungrouped(array, 1, count)[0] for array in simulation.data.constants[:2])
    return lam * lambda_bar + mu * mu_bar
