"""Does a design hang together? Heat that its material produces must flow out through material."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
import scipy.sparse
from numpy.typing import NDArray
from scipy.sparse.linalg import splu

from mpmopt.design.term import Adjoints, Outcome, Term
from mpmopt.errors import DesignError
from mpmopt.scene import Scene
from mpmopt.scene.particles import discretise
from mpmopt.scene.parts import Checked

LEAST_CONDUCTIVITY = 1e-3  # of an edge, over that between solid particles
NOTHING = 1e-12  # f of a design without material, so that it has a logarithm


class _Lattice(NamedTuple):
    """Edges between neighbours on the particles' lattice.

    Design particles count from 0 to D - 1; all others are number D, which is kept at zero.
    """

    first: NDArray[np.intp]
    second: NDArray[np.intp]
    designed: int
    full: float  # the compliance of a design that is solid everywhere


@dataclass(frozen=True)
class OnePiece(Term, Checked):
    """Logarithm of f, the thermal compliance of a design over that of the solid reference design.

    Each design particle produces heat gamma; an edge of the lattice conducts k + (1 - k) gamma_a
    gamma_b, with k = 1e-3; what is not designed is kept at zero. So K T = q and f ~ q.T: about 0.3
    to 0.6 for a robot, and a thousandfold if a piece is loose: ``AtMost(OnePiece(), log(4))``.
    Poulsen's and Li et al.'s virtual temperature, on particles.
    """

    def value(self, outcome: Outcome) -> Any:
        lattice = _lattice(outcome.simulation.scene)
        f = outcome.gamma @ _temperature(lattice, outcome.gamma) / lattice.full
        return np.log(f + NOTHING)

    def adjoints(self, outcome: Outcome) -> Adjoints:
        gamma, lattice = outcome.gamma, _lattice(outcome.simulation.scene)
        T = _temperature(lattice, gamma)
        a, b, designed = lattice.first, lattice.second, lattice.designed
        g, t = np.append(gamma, 1.0), np.append(T, 0.0)
        drop = (1.0 - LEAST_CONDUCTIVITY) * (t[a] - t[b]) ** 2
        # d(q.T) = 2 T.dq - T.dK T: the problem is its own adjoint.
        lost = np.bincount(a, drop * g[b], designed + 1) + np.bincount(b, drop * g[a], designed + 1)
        return Adjoints(gamma=(2.0 * T - lost[:designed]) / (gamma @ T + NOTHING * lattice.full))


@lru_cache(maxsize=4)
def _lattice(scene: Scene) -> _Lattice:
    particles = discretise(scene)
    sites = np.floor(particles.position * scene.particles_per_cell / scene.grid.dx).astype(np.intp)
    sites -= sites.min(axis=0)
    designed = int(particles.designed.sum())
    index = np.full(sites.max(axis=0) + 1, -1)
    names = np.full(len(sites), designed)
    names[particles.designed] = np.arange(designed)
    index[tuple(sites.T)] = names
    pairs = [(index[:-1], index[1:]), (index[:, :-1], index[:, 1:])]
    first, second = (np.concatenate([pair[k].ravel() for pair in pairs]) for k in (0, 1))
    there = (first >= 0) & (second >= 0) & (first != second)  # both may be kept at zero
    lattice = _Lattice(first[there], second[there], designed, 1.0)
    if not designed or not np.any(np.maximum(lattice.first, lattice.second) == designed):
        raise DesignError(
            "OnePiece: no Design touches a Solid or an Actuator, which it could hang on; put one "
            "beside it"
        )
    ones = np.ones(designed)
    return lattice._replace(full=float(ones @ _temperature(lattice, ones)))


def _temperature(lattice: _Lattice, gamma: NDArray) -> NDArray:
    """T (D,) of K(gamma) T = gamma."""
    a, b, designed = lattice.first, lattice.second, lattice.designed
    g = np.append(gamma, 1.0)
    k = LEAST_CONDUCTIVITY + (1.0 - LEAST_CONDUCTIVITY) * g[a] * g[b]
    rows, columns = np.concatenate([a, b, a, b]), np.concatenate([a, b, b, a])
    K = scipy.sparse.csc_array((np.concatenate([k, k, -k, -k]), (rows, columns)))
    try:
        T: NDArray = splu(K[:designed, :designed].tocsc(), permc_spec="MMD_AT_PLUS_A").solve(gamma)
    except RuntimeError as error:  # a singular matrix
        raise DesignError(
            "OnePiece: a Design is apart from all Solids and Actuators; let regions share an edge"
        ) from error
    return T
