"""What kernels pass to each other: surroundings, particles, nodes, scratch."""

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import DTypeLike, NDArray

from mpmopt.kernels.compiler import jit
from mpmopt.kernels.simd import nothing, store

# Rows of a state (12, N), or records of a group of particles in it, and the first of each quantity.
STATE_SIZE = 12
POSITION, VELOCITY, AFFINE, DEFORMATION = 0, 2, 4, 8
# Records of `Tile.place` and of `Tile.gathered` for each group, and the first of each quantity.
PLACE_SIZE, GATHERED_SIZE = 6, 9
AFFINE_BAR, VELOCITY_BAR, MASS_BAR, SLOPE = 0, 4, 6, 7
COEFFICIENTS = 9  # records of a cell: its polynomial, by order along x and y
NODE_SIZE = 4  # one record: momentum, mass and the layers' normal force (q_x, q_y, m, f_N)


class Parts(NamedTuple):
    """The quantities of a state (..., 12, N), as views of it."""

    position: NDArray  # (..., 2, N)
    velocity: NDArray  # (..., 2, N)
    affine_velocity: NDArray  # (..., 2, 2, N)
    deformation: NDArray  # (..., 2, 2, N)


def parts(state: NDArray) -> Parts:
    """Views of a state's position, velocity, affine velocity and deformation gradient."""
    ends = VELOCITY, AFFINE, DEFORMATION
    x, v, C, F = np.split(state, ends, axis=-2)
    tensors = (*state.shape[:-2], 2, 2, state.shape[-1])
    return Parts(x, v, C.reshape(tensors), F.reshape(tensors))


class Parameters(NamedTuple):
    """What surrounds the body: time step, cell width, nodes, gravity, walls and ground."""

    dt: float
    dx: float
    per_dx: float  # 1 / dx, of which cells are found
    nodes_x: int
    nodes_y: int
    gravity_x: float
    gravity_y: float
    walls: NDArray[np.float64]  # (W, columns) as `contact` names them
    ground: Any  # `ground.Ground`
    clamps: NDArray[np.float64]  # (steps, K, 6) lower and upper corner, and velocity of its nodes
    mirror_axis: int  # of the mirror plane's normal: 0 or 1; -1: no mirror
    mirror_node: int  # line of nodes that is the plane
    viscous: bool  # whether a material has a viscosity
    mass_tolerance: float  # mass of a node that is rounding of larger ones: the node is empty


class ParticleData(NamedTuple):
    """Constants of G groups of four particles and of K actuators; complex for the complex step."""

    volume: NDArray  # (G, 4) reference volume
    mass: NDArray  # (G, 4)
    stiffness: NDArray  # (G, 4) share of the solid's stiffness
    constants: NDArray  # (P, G, 4) of the solid, in the order of `material.PARAMETERS`
    active: NDArray[np.bool_]  # (G,) whether a group has actuated particles
    actuated: NDArray[np.float64]  # (K, G, 4) 1 for the particles of actuator k, else 0
    actuation_stress: NDArray[np.float64]  # (K, 3) second Piola-Kirchhoff S: xx, xy, yy
    first: NDArray[np.int64]  # (B + 1,) first group of each of B blocks, and G


class ParticleDataBar(NamedTuple):
    """Adjoints of `ParticleData`, accumulated over the steps."""

    mass: NDArray  # (G, 4)
    stiffness: NDArray  # (G, 4)

    @classmethod
    def zeros(cls, groups: int, dtype: DTypeLike = float) -> "ParticleDataBar":
        """Nothing accumulated yet."""
        return cls(*(np.zeros((groups, 4), dtype) for _ in cls._fields))


class Tile(NamedTuple):
    """What a step derives of some groups of particles at a time: small, to stay in fast memory.

    Arrays of records, so many for each of T groups.
    """

    cell: NDArray[np.float64]  # (T, 4) number of a particle's cell in the block's window
    place: NDArray  # (6 T, 4) by pairs along x and y: t, t^2/2, 3t/8 - t^3/2
    affine: NDArray  # (4 T, 4) A dx, the affine momentum of a cell's width
    gathered: NDArray  # (9 T, 4) by `p2g_adjoint`: A_bar, sums of w q_bar, w m_bar, slopes


@jit
def at(g, row):
    """Record of a state that holds a row of group g."""
    return STATE_SIZE * g + row


@jit
def components(state, g, row, k):
    """Real parts of the four components of a tensor of particle k of group g."""
    r = at(g, row)
    c00, c01, c10, c11 = state[r, k], state[r + 1, k], state[r + 2, k], state[r + 3, k]
    return float(c00.real), float(c01.real), float(c10.real), float(c11.real)


@jit
def in_tile(t, row):
    """Record of `Tile.gathered` that holds a row of group t of the tile."""
    return GATHERED_SIZE * t + row


@jit
def make_tile(groups, like):
    """Room for so many groups, of the type of the array `like`."""
    return Tile(
        np.zeros((groups, 4), like.real.dtype),
        np.zeros((PLACE_SIZE * groups, 4), like.dtype),
        np.zeros((4 * groups, 4), like.dtype),
        np.zeros((GATHERED_SIZE * groups, 4), like.dtype),
    )


class Scratch(NamedTuple):
    """What the threads share during a step, for B blocks and a window of M nodes."""

    velocity: NDArray  # (2 M,) u
    velocity_bar: NDArray  # (2 M,)
    node_bar: NDArray  # (M, 4) adjoints of momentum and mass
    parts: NDArray  # (B, P, 4) what each block puts on the nodes of its own window
    parts_bar: NDArray  # (B, 2 P) the same of `velocity_bar`
    ends: NDArray[np.int64]  # (B, 2) how the step ended for each block, and a particle

    @classmethod
    def make(cls, nodes: int, blocks: int, part: int, dtype: DTypeLike = float) -> "Scratch":
        """Room for so many nodes, blocks, and nodes of a block."""
        return cls(
            np.zeros(2 * nodes, dtype),
            np.zeros(2 * nodes, dtype),
            np.zeros((nodes, NODE_SIZE), dtype),
            np.zeros((blocks, part, NODE_SIZE), dtype),
            np.zeros((blocks, 2 * part), dtype),
            np.zeros((blocks, 2), np.int64),
        )


@jit
def make_cells(scratch):
    """Coefficients of the cells of any block, of records (9 P, 4) and of pairs (18 P,)."""
    records, dtype = COEFFICIENTS * scratch.parts.shape[1], scratch.parts.dtype
    return np.zeros((records, 4), dtype), np.zeros(2 * records, dtype)


@jit
def clear(cells, part):
    """Zero the coefficients of a window's cells."""
    zero = nothing(cells)
    for k in range(COEFFICIENTS * part[2] * (part[3] - 2)):
        store(cells, k, zero)


def grouped(array: NDArray, repeat: bool = True) -> NDArray:
    """R numbers (R, N) of N particles as records (R G, 4) of groups of four; (N,) as (G, 4).

    The last group is filled with repeats of the last particle, or with zeros.
    """
    rows = np.atleast_2d(array)
    count, groups = rows.shape[1], -(-rows.shape[1] // 4)
    filled = np.empty((len(rows), 4 * groups), rows.dtype)
    filled[:, :count] = rows
    filled[:, count:] = rows[:, -1:] if repeat else 0.0
    return filled.reshape(-1, groups, 4).swapaxes(0, 1).reshape(-1, 4)


def ungrouped(records: NDArray, rows: int, particles: int) -> NDArray:
    """The inverse of `grouped`: (rows, particles)."""
    filled = records.reshape(-1, rows, 4).swapaxes(0, 1).reshape(rows, -1)
    return filled[:, :particles].copy()
