"""Whether parts of a body that were far apart come to lie in each other."""

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mpmopt.kernels.arrays import DEFORMATION, POSITION, at, components
from mpmopt.kernels.compiler import loop_jit

# Parts nearer than so many cells in the reference configuration are one part.
FAR = 4.0


@loop_jit
def closest(
    state: NDArray, reference: NDArray, solid: NDArray, data: Any, parameters: Any
) -> tuple[float, float, float]:
    """How near solid particles come that were more than `FAR` cells apart, and where.

    Parameters
    ----------
    state : (12 G, 4) array
        Records of groups of four particles.
    reference : (2 G, 4) array
        Records of the particles' reference position.
    solid : (G, 4) array of bool
        Which particles count.
    data, parameters
        As all kernels see them.

    Returns
    -------
    float, float, float
        The least distance in current particle spacings, infinite beyond a cell, and x, y of one of
        the two particles, infinite too then.
    """
    columns, rows = parameters.nodes_x, parameters.nodes_y
    newest = np.full(columns * rows, -1)
    older = np.full(4 * len(solid), -1)
    far = (FAR * parameters.dx) ** 2
    least, x_least, y_least = math.inf, math.inf, math.inf
    for p in range(4 * len(solid)):
        g, k = p // 4, p % 4
        if not solid[g, k]:
            continue
        x, y = float(state[at(g, POSITION), k].real), float(state[at(g, POSITION + 1), k].real)
        # What has left the grid, as a total Lagrangian body may, is in the cells along its edge.
        i = int(min(max(x * parameters.per_dx, 0.0), columns - 1.0))
        j = int(min(max(y * parameters.per_dx, 0.0), rows - 1.0))
        # Those that are met later look back at this one, so that each pair is looked at once.
        for a in range(max(i - 1, 0), min(i + 2, columns)):
            for b in range(max(j - 1, 0), min(j + 2, rows)):
                q = newest[a * rows + b]
                while q >= 0:
                    h, m = q // 4, q % 4
                    apart_x = reference[2 * g, k] - reference[2 * h, m]
                    apart_y = reference[2 * g + 1, k] - reference[2 * h + 1, m]
                    if apart_x * apart_x + apart_y * apart_y > far:
                        dx = x - float(state[at(h, POSITION), m].real)
                        dy = y - float(state[at(h, POSITION + 1), m].real)
                        area = min(_area(state, data, g, k), _area(state, data, h, m))
                        ratio = (dx * dx + dy * dy) / area
                        if ratio < least:
                            least, x_least, y_least = ratio, x, y
                    q = older[q]
        older[p] = newest[i * rows + j]
        newest[i * rows + j] = p
    return math.sqrt(least), x_least, y_least


@loop_jit
def _area(state, data, g, k):
    """The current area of a particle."""
    f00, f01, f10, f11 = components(state, g, DEFORMATION, k)
    return float(data.volume[g, k].real) * max(f00 * f11 - f01 * f10, 0.0)
