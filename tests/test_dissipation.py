"""The transfer damps once in every step, so that smaller steps damp more."""

import numpy as np
import pytest
from exact import at_rest, solid_simulation

from mpmopt.scene import Grid, Material, Scene, Solid
from mpmopt.scene.particles import discretise


def two_discs(dt):
    """Kinetic energy after the collision of two discs over that before, on cells of 1/20."""
    E, nu = 1000.0, 0.3
    scene = Scene(
        Grid((24, 24), 0.05), dt, round(3.5 / dt), (Solid((0.1, 0.1), (1.1, 1.1)),),
        material=Material(E * nu / ((1 + nu) * (1 - 2 * nu)), E / (2 * (1 + nu)), density=1000.0),
    )  # fmt: skip
    everything = discretise(scene)
    low, high = (np.hypot(*(everything.position.T - 0.1 - c)) < 0.2 for c in (0.2, 0.8))
    discs = everything.subset(low | high)
    state = at_rest(discs)
    state[2:4] = np.where(low[low | high], 0.1, -0.1)
    end = solid_simulation(scene, discs, state).run()

    def kinetic(state):
        return (state[2:4] ** 2).sum() + scene.grid.dx**2 / 4 * (state[4:8] ** 2).sum()

    return kinetic(end) / kinetic(state)


def test_two_discs_that_collide_lose_more_with_a_smaller_step():
    coarse, fine = two_discs(4e-3), two_discs(1e-3)
    # Public measurements of this collision, with a step of 1e-3: 0.287.
    assert fine == pytest.approx(0.287, abs=0.005)
    assert coarse > 1.5 * fine
