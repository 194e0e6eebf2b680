"""The body laid out as particles."""

import numpy as np
import pytest
from conftest import small_scene
from walker import walker

from mpmopt.scene.particles import discretise


def test_volume_and_centroid_are_those_of_the_rectangles(scene):
    particles = discretise(scene)
    assert particles.volume.sum() == pytest.approx(12 * scene.grid.dx**2, rel=1e-14)
    assert particles.volume[particles.designed].sum() == pytest.approx(8 * scene.grid.dx**2)
    for k, actuator in enumerate(scene.actuators):
        mine = particles.actuator == k
        centre = (np.array(actuator.lower) + actuator.upper) / 2
        assert particles.position[mine].mean(axis=0) == pytest.approx(centre, abs=1e-14)
        assert not particles.designed[mine].any()


def test_every_resolution_sees_the_same_walker():
    coarse, fine = discretise(walker(64, 8e-4)), discretise(walker(128, 4e-4))
    assert (len(coarse.position), len(fine.position)) == (800, 3200)
    assert coarse.volume.sum() == pytest.approx(fine.volume.sum(), rel=1e-13)
    mean = [p.position[~p.designed].mean(axis=0) for p in (coarse, fine)]
    assert mean[0] == pytest.approx(mean[1], abs=1e-14)


@pytest.mark.parametrize("per_cell", [1, 2, 3])
def test_particles_form_a_lattice_ordered_as_the_nodes_are(per_cell):
    particles = discretise(small_scene(particles_per_cell=per_cell))
    assert len(particles.position) == 12 * per_cell**2
    x, y = particles.position.T
    assert np.all((np.diff(x) > 1e-9) | ((np.abs(np.diff(x)) < 1e-9) & (np.diff(y) > 0)))


def test_a_subset_keeps_what_belongs_together(scene):
    particles = discretise(scene)
    keep = particles.position[:, 0] > 0.3
    subset = particles.subset(keep)
    assert np.all(subset.position[:, 0] > 0.3)
    assert len(subset.volume) == len(subset.designed) == len(subset.actuator) == keep.sum()
    assert np.array_equal(subset.region, particles.region[keep])
