"""Random starts: what field they add, and that it is the same on every grid."""

import math
from itertools import pairwise

import numpy as np
from walker import walker

from mpmopt.design.problem import Problem
from mpmopt.optimisation.starts import AMPLITUDE, LENGTH, random_start

SCENE = walker(64, 8e-4)
SIDE = 20 / 64  # the longest of the walker's design domain


def test_random_starts_differ_and_can_be_had_again(rng):
    position = rng.uniform(0.0, SIDE, (50, 2))
    fields = [random_start(SCENE, seed)(position) for seed in (1, 2, 3)]
    again = random_start(SCENE, 3)(position)
    assert np.array_equal(fields[2], again)
    assert all(np.abs(one - other).max() > 0.1 for one, other in pairwise(fields))
    assert max(np.abs(field).max() for field in fields) <= 1.0


def test_a_start_is_a_gaussian_field_of_the_stated_amplitude_and_length():
    distance = np.array([0.0, 0.5, 1.0, 2.0]) * LENGTH * SIDE
    for direction in np.eye(2):
        line = 0.1 + distance[:, None] * direction
        values = np.array([random_start(SCENE, seed)(line) for seed in range(1, 2001)])
        covariance = values[:, :1].T @ values / len(values) / AMPLITUDE**2
        wanted = np.exp(-((distance / (LENGTH * SIDE)) ** 2) / 2.0)
        assert np.abs(values.mean(axis=0)).max() <= 4.0 * AMPLITUDE / math.sqrt(len(values))
        assert np.abs(covariance - wanted).max() <= 0.1


def test_every_grid_begins_with_the_same_field():
    field = random_start(SCENE, 5)
    fine = random_start(walker(128, 5e-4), 5)
    coarse, there = Problem(SCENE), Problem(walker(128, 5e-4))
    start = coarse.join(field(coarse.particles.position[coarse.particles.designed]), 1, 0, 0)
    other = there.join(fine(there.particles.position[there.particles.designed]), 1, 0, 0)
    # Nearest particles lie a quarter of a fine cell apart along each axis.
    moved = np.abs(there.transfer(coarse, start) - other).max()
    assert moved <= 0.1
    assert np.ptp(start[: coarse.particles.designed.sum()]) > 0.5
