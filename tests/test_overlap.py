"""Parts of a body that were far apart and come to lie in each other."""

import dataclasses
import math

import numpy as np
import pytest
from conftest import small_scene
from scipy.spatial.distance import cdist

from mpmopt import kernels
from mpmopt.assess.threshold import SOLID_LIMITS
from mpmopt.design.problem import Problem
from mpmopt.design.step_control import LIMITS, check_indicators
from mpmopt.errors import OverlapError
from mpmopt.kernels import plain
from mpmopt.scene import Grid, Scene, Solid
from mpmopt.simulation.indicators import Indicators

C = 1 / 32


def two_blocks(**changes):
    """Two blocks eight cells apart, as one body without what would join them."""
    body = Solid((4 * C, 4 * C), (8 * C, 8 * C)), Solid((16 * C, 4 * C), (20 * C, 8 * C))
    return Scene(Grid((32, 32), C), 1e-3, 64, body, **changes)


def moved(simulation, right, by):
    """Its initial state, with the right one of two blocks elsewhere."""
    state = simulation.initial.copy()
    kernels.parts(state).position[:, right] += np.array(by)[:, None]
    return state


def by_hand(simulation, state):
    """The least distance of far particles in current spacings, pair by pair, and where."""
    x, _, _, F = kernels.parts(state.real)
    area = simulation.particles.volume * (F[0, 0] * F[1, 1] - F[0, 1] * F[1, 0])
    reference = simulation.particles.position
    ratio = cdist(x.T, x.T) / np.sqrt(np.minimum(area[:, None], area[None]))
    ratio[cdist(reference, reference) <= 4.0 * simulation.scene.grid.dx] = math.inf
    p, q = np.unravel_index(ratio.argmin(), ratio.shape)
    return ratio.min(), {tuple(x[:, p]), tuple(x[:, q])}


@pytest.mark.parametrize("by", [(-9.3 * C, 0.4 * C), (-8.2 * C, 3.9 * C), (-11.9 * C, -0.1 * C)])
def test_the_gap_is_that_of_all_pairs(by):
    problem = Problem(two_blocks())
    simulation = problem.simulation(np.empty(0))
    right = simulation.particles.position[:, 0] > 12 * C
    state = moved(simulation, right, by)
    kernels.parts(state).deformation[0, 0] = np.where(right, 1.3, 0.8)
    gap, *place = simulation.gap(kernels.grouped(state))
    expected, places = by_hand(simulation, state)
    assert gap == pytest.approx(expected, rel=1e-12)
    assert tuple(place) in places


@pytest.mark.parametrize("out", [(0.9, 0.0), (-0.9, 0.0), (0.1, 2.0), (0.0, -1e300)])
def test_a_gap_beyond_the_grid_is_found_in_bounds(out):
    # Bodies of the formulation "total" may leave it; as plain Python, indices are checked.
    simulation = Problem(two_blocks(formulation="total")).simulation(np.empty(0))
    right = simulation.particles.position[:, 0] > 12 * C
    state = moved(simulation, right, (-11.9 * C, -0.1 * C))
    kernels.parts(state).position[:] += np.array(out)[:, None]
    solid, reference = simulation.data.mass > 0.0, simulation.particles.position.T
    gap, *_ = plain(kernels.closest)(
        kernels.grouped(state), kernels.grouped(reference), solid, simulation.data,
        simulation.parameters,
    )  # fmt: skip
    if abs(out[1]) < 1e9:
        assert gap == pytest.approx(by_hand(simulation, state)[0], rel=1e-9)


def test_near_parts_of_a_body_and_far_ones_apart_have_no_gap():
    simulation = Problem(two_blocks()).simulation(np.empty(0))
    assert simulation.gap(kernels.grouped(simulation.initial)) == (math.inf, math.inf, math.inf)
    assert simulation.watch().indicators.gap == math.inf


def test_void_may_lie_in_solid():
    problem = Problem(small_scene())
    x = problem.join(-1.0, 0.0, 0.0, 0.0)
    simulation = problem.simulation(x)
    state = simulation.initial.copy()
    kernels.parts(state).position[:, simulation.particles.designed] = 0.5
    assert simulation.gap(kernels.grouped(state))[0] == math.inf


def test_a_body_whose_parts_lie_in_each_other_does_not_count_and_says_where():
    problem = Problem(two_blocks())
    simulation = problem.simulation(np.empty(0))
    right = simulation.particles.position[:, 0] > 12 * C
    simulation.initial = moved(simulation, right, (-10 * C, 0.05 * C))
    indicators = simulation.watch().indicators
    assert indicators.gap < 0.5
    check_indicators(indicators._replace(courant=0.0, energy=0.0), simulation, LIMITS)
    with pytest.raises(
        OverlapError, match=r"over 4 cells apart lie in each other.* near \(0\.1953, 0\.1"
    ) as e:
        check_indicators(indicators, simulation, SOLID_LIMITS)
    assert 6 * C < e.value.position[0] < 8 * C


def test_the_grid_keeps_parts_apart_that_run_into_each_other():
    scene = dataclasses.replace(two_blocks(), steps=256)
    simulation = Problem(scene).simulation(np.empty(0))
    velocity = kernels.parts(simulation.initial).velocity
    velocity[0] = np.where(simulation.particles.position[:, 0] > 12 * C, -1.0, 1.0)
    indicators = simulation.watch().indicators
    assert 2.0 < indicators.gap < 4.0  # the kernels meet, a cell and a half apart


def test_the_nearest_of_two_runs_is_kept_with_its_place():
    near, far = Indicators(gap=0.4, gap_x=1.0, gap_y=2.0), Indicators(gap=0.6, gap_x=3.0, gap_y=4.0)
    assert near.join(far)[5:] == far.join(near)[5:] == near[5:]
