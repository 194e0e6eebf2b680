"""Where the method fails: the case's limits against theory, and named errors beyond them."""

import csv
import logging
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import stability_map
from stability import (
    actuation,
    adversary,
    contact,
    energy,
    fracture,
    gradients,
    inversion,
    optimiser,
    safe,
    time_step,
    weak,
)
from stability.common import Found

from mpmopt.errors import SceneError, SimulationError
from mpmopt.io.files import as_csv
from mpmopt.scene import Material
from mpmopt.scene.particles import discretise

# Time step.


def limits(body, scene, mass=None, shift=0.0):
    """Linear theory and measurement of one body."""
    ones = np.ones(len(body.position))
    mass = ones if mass is None else mass
    body = time_step.shifted(body, shift)
    theory = time_step.linear_limit(body.position, mass, ones, ones)
    measured = time_step.largest(
        lambda courant: time_step.stays_small(scene, body, mass, courant), 0.5, 2.0, 0.005
    )
    return theory, measured


def test_an_isolated_particle_is_stable_up_to_0_866():
    scene = time_step.block_scene(steps=1000)
    theory, measured = limits(time_step.isolated(scene), scene)
    assert theory == pytest.approx(np.sqrt(0.75), rel=1e-12)
    assert 0.845 <= measured <= theory
    legal = scene.largest_time_step
    assert legal * scene.material.wave_speed == pytest.approx(theory, rel=1e-12)
    with pytest.raises(SceneError, match="over the stability limit"):
        replace(scene, time_step=1.001 * legal)


@pytest.mark.parametrize("shift", [0.0, 0.5])
def test_a_free_block_is_stable_as_long_as_the_linearised_step(shift):
    scene = time_step.block_scene(steps=1000)
    theory, measured = limits(discretise(scene), scene, shift=shift)
    assert 0.96 <= theory <= 1.2
    assert measured == pytest.approx(theory, rel=0.015)


def test_bulk_is_stable_longer_than_any_free_body():
    position = discretise(time_step.block_scene(6)).position
    ones = np.ones(len(position))
    theory = time_step.linear_limit(position, ones, ones, ones, period=6)
    assert theory == pytest.approx(1.306, abs=1e-3)


def test_void_does_not_lower_the_limit_at_rest_unless_its_mass_floor_is_the_lower():
    equal = [weak.limit_at_rest(weak.floors(epsilon, heavy=False)) for epsilon in (1e-1, 1e-6)]
    assert equal == pytest.approx([1.11, 1.11], abs=0.01)
    stiff = weak.limit_at_rest(Material(void_stiffness=1e-1, void_density=1e-2))
    assert stiff == pytest.approx(equal[0] / np.sqrt(10.0), rel=0.1)


@pytest.mark.parametrize(("rate", "least", "most"), [(0.1, 0.72, 0.76), (0.2, 0.59, 0.63)])
def test_a_squeezed_particle_fails_where_its_oscillation_resonates_with_the_step(rate, least, most):
    # Three steps an oscillation at Courant 0.750, four at 0.612.
    squeeze = np.array(time_step.MOTIONS["squeeze"])
    courants = np.arange(0.5, 0.8, 0.01)
    lives = [time_step.survives(squeeze, rate, courant) for courant in courants]
    assert least <= courants[lives.index(False)] <= most


def test_particles_in_fast_motion_live_in_the_safe_region(rng):
    for motion in (*time_step.MOTIONS.values(), *rng.standard_normal((10, 4))):
        for rate in (0.1, 0.5, 0.8, 0.9, 1.5, 3.0):
            courant = min(time_step.SAFE_COURANT, time_step.SAFE_TURN / rate)
            assert time_step.survives(np.array(motion), rate, courant, steps=1000)


# Weak particles.


def test_a_heavy_mass_floor_cures_void_that_is_flung():
    light = weak.one_square("walker", 0.8, 1e-6, heavy=False, designs=3)
    assert light["failed"] > 0
    assert "smaller time step" in light["error"]
    assert "higher void density" in light["error"]
    heavy = weak.one_square("walker", 0.8, 1e-6, heavy=True, designs=3)
    assert (heavy["designs"], heavy["failed"]) == (3, 0)
    assert heavy["largest_deviation"] <= 0.01 * weak.GAIN


def test_void_as_fast_as_solid_fails_in_the_total_lagrangian_formulation_and_slower_does_not():
    equal, slow = (
        weak.one_square("walker", 0.25, 1e-4, heavy=heavy, designs=4, formulation="total")
        for heavy in (False, True)
    )
    assert equal["failed"] >= 1
    assert "not a number" in equal["error"]
    assert (slow["void_density"], slow["failed"]) == (1e-3, 0)


def test_stiff_light_void_is_refused():
    row = weak.one_square("crawler", 0.35, 1e-1, heavy=True, designs=1)
    assert row["refused"]
    assert "over the stability limit" in row["error"]


@pytest.mark.parametrize("case", ["walker", "crawler"])
@pytest.mark.parametrize("beta", [2.0, 32.0])
def test_nothing_fails_at_the_corner_of_the_safe_region(case, beta):
    row = safe.at_random(case, beta, seed=1)
    assert row["error"] == ""
    assert abs(row["half_step"] - row["distance"]) <= 0.02


@pytest.mark.slow
@pytest.mark.parametrize("case", ["walker", "crawler"])
def test_the_optimiser_finds_no_design_that_fails_in_the_safe_region(case):
    row = adversary.climb(case, *adversary.FLOORS[0], time_step.SAFE_COURANT, most=12)
    assert row["failed"] == 0
    assert row["gain"] > 0.05
    assert row["gain_half_step"] > 0.5 * row["gain"]
    assert adversary.climb("walker", *adversary.FLOORS[2], 0.8, most=12)["failed"] > 0


@pytest.mark.slow
@pytest.mark.parametrize("case", ["walker", "crawler"])
def test_no_random_design_fails_at_the_corner_of_the_safe_region(case):
    rows = [safe.at_random(case, beta, seed) for beta in safe.BETAS for seed in range(100, 125)]
    assert [row["error"] for row in rows] == [""] * len(rows)
    assert max(abs(row["half_step"] - row["distance"]) for row in rows) <= 0.03


# Actuation.


def test_a_kick_grows_where_ellipticity_is_lost_and_scenes_are_refused_there():
    # mu + s vanishes at strength 1.
    assert actuation.growth_of_a_kick(0.98) < 0.5
    assert actuation.growth_of_a_kick(1.02) > 1e3
    assert actuation.refused(0.999) == ""
    assert "ellipticity can be lost" in actuation.refused(1.0)


def test_distances_agree_between_steps_in_the_safe_region_only():
    weak_ones, strong = (
        [actuation.driven(strength, courant) for courant in (0.14, 0.5)]
        for strength in (safe.STRENGTH, 0.9)
    )
    assert max(row["stretch"] for row in weak_ones) < 2.0
    assert np.ptp([row["distance"] for row in weak_ones]) <= 0.03
    assert max(row["stretch"] for row in strong) > 2.0


# Large fracture.


def test_the_vortex_is_right_at_a_tenth_and_inverts_at_one():
    assert inversion.vortex(0.1, 24) <= 0.132
    assert inversion.vortex(0.1, 48) <= 0.05
    for cells in (24, 48):
        with pytest.raises(SimulationError, match="inverted"):
            inversion.vortex(1.0, cells)


def test_the_total_lagrangian_vortex_is_right_where_it_is_stretched_seven_times():
    assert inversion.vortex_stretch(1.0) > 7.0
    assert inversion.total_vortex(1.0, 48, 0.2) <= 0.03


@pytest.mark.slow
def test_the_total_lagrangian_vortex_converges():
    coarse, fine = inversion.total_vortex(1.0, 48, 0.2), inversion.total_vortex(1.0, 96, 0.2)
    assert fine <= 0.007
    assert np.log2(coarse / fine) >= 1.9
    with pytest.raises(SimulationError, match="not a number"):
        inversion.total_vortex(1.0, 96, 0.4)


@pytest.mark.slow
def test_the_vortex_converges_and_inverts_on_a_fine_grid():
    coarse, fine = inversion.vortex(0.1, 48), inversion.vortex(0.1, 96)
    assert np.log2(coarse / fine) >= 1.9
    with pytest.raises(SimulationError, match="inverted"):
        inversion.vortex(1.0, 96)


@pytest.mark.parametrize("per_cell", [2, 3])
def test_a_cut_carries_all_up_to_one_particle_per_cell_and_nothing_at_half_of_one(per_cell):
    assert fracture.weakest_cut(1.0 + 1e-6, per_cell) == pytest.approx(1.0, abs=1e-3)
    assert fracture.weakest_cut(float(per_cell), per_cell) == pytest.approx(1.0, abs=1e-9)
    assert fracture.weakest_cut(1.5 * per_cell, per_cell) == pytest.approx(0.54, abs=0.01)
    assert fracture.weakest_cut(2.0 * per_cell, per_cell) == pytest.approx(0.0, abs=1e-9)


def test_a_pulled_bar_tears_with_two_particles_per_cell_and_comes_back_with_three():
    torn, torn_stretch, _ = fracture.pulled_bar(1.5, 2)
    whole, _, _ = fracture.pulled_bar(1.5, 3)
    assert torn.min() > 0.0
    assert whole.min() < -0.9
    assert torn_stretch > 2.0


def test_a_pulled_bar_comes_back_in_the_total_lagrangian_formulation_until_its_step_is_too_long():
    back, stretch, said = fracture.pulled_bar(1.5, 2, 0.2, "total")
    assert said == ""
    assert back.min() < -0.9
    assert stretch > 2.5  # where MLS-MPM is torn
    _, _, said = fracture.pulled_bar(2.0, 2, 0.3, "total")
    assert "smaller time step" in said


@pytest.mark.parametrize("speed", [0.37, 1.01])
def test_leaving_the_grid_is_noticed_in_the_step_in_which_it_happens(speed):
    noticed, expected, text = fracture.thrown(speed)
    assert noticed == expected
    assert "left the grid" in text
    assert "larger grid" in text


# Contact.


def test_contact_is_felt_from_one_and_a_half_cells_on():
    height, free = contact.dropped_block(150)
    untouched = np.abs(height - free) < 1e-9
    last = int(np.flatnonzero(untouched).max())
    assert height[last] >= 1.48
    assert free[last + 1] <= 1.5


def test_a_block_sticks_and_slides_on_an_incline_as_coulomb_says():
    for ratio in (0.0, 0.2, 0.5, 0.8):
        assert contact.travelled("block", ratio * contact.STEEP) == pytest.approx(
            1.0 - ratio, abs=1e-3
        )
    assert contact.travelled("block", 2.0 * contact.STEEP) == pytest.approx(0.0, abs=0.02)


def test_a_block_slides_on_a_layer_as_coulomb_says_and_creeps_where_it_sticks():
    for ratio in (0.2, 0.8):
        found = contact.travelled("block", ratio * contact.STEEP, law="layer")
        assert found == pytest.approx(1.0 - ratio, abs=0.01)
    found = contact.travelled("block", 2.0 * contact.STEEP, law="layer")
    assert found == pytest.approx(0.0, abs=0.01)


@pytest.mark.parametrize(("share", "digits"), [(0.3, 0.01), (3.0, 0.01)])
def test_a_viscous_particle_has_the_limit_of_its_scene(share, digits):
    row = time_step.viscous_limit("isolated particle", share, 1000)
    assert row["measured"] == pytest.approx(row["theory"], rel=digits)


def test_a_disc_slides_below_a_third_of_the_slope_and_rolls_above():
    for ratio in (0.0, 0.2):
        assert contact.travelled("disc", ratio * contact.STEEP) == pytest.approx(
            1.0 - ratio, abs=0.01
        )
    coarse = contact.travelled("disc", contact.STEEP)
    fine = contact.travelled("disc", contact.STEEP, cells=64)
    assert 2.0 / 3.0 < fine < coarse < 0.8  # too fast, less so on finer cells


def test_an_impact_that_is_too_fast_has_a_name():
    assert contact.impact(1.0, 0.35)["failure"] == ""
    assert "inverted" in contact.impact(5.0, 0.35)["failure"]


# Gradients.


def test_contact_shortens_the_radius_in_which_the_gradient_predicts():
    free = gradients.at_horizon(400, contact="none")
    touching = gradients.at_horizon(400, contact="wall")
    assert free["radius"] >= 1e-3
    assert touching["radius"] < free["radius"]


def test_single_precision_loses_little_within_a_few_hundred_steps():
    row = gradients.at_horizon(400, contact="none")
    assert 0.0 < row["single_value_error"] <= 1e-5
    assert 0.0 < row["single_gradient_error"] <= 1e-3


# Optimiser.


def test_asymptotes_at_a_hundredth_cycle_and_the_default_does_not():
    assert optimiser.cycle(1e-2) == pytest.approx(9e-3, rel=1e-6)
    assert optimiser.cycle(1e-1) == pytest.approx(9e-2, rel=1e-6)
    assert optimiser.cycle(1e-6) <= 1e-8


@pytest.mark.parametrize("scale", [1e-12, 1e12])
def test_scale_changes_no_iterate(scale):
    assert optimiser.change_by_scale(scale) <= 1e-12


def test_a_nan_in_the_gradient_is_refused():
    assert "dfdx[1] is nan" in optimiser.refusal_of_nan()


def test_saturated_variables_have_no_slope_left():
    row = optimiser.saturation(16.0)
    assert row["formula"] == pytest.approx(4.05e-13, rel=1e-2)
    assert row["complex_step"] == pytest.approx(row["formula"], rel=1e-12)
    assert row["adjoint"] == pytest.approx(row["formula"], rel=1e-2)  # 1 - tanh^2 cancels


# The case.


def test_a_module_becomes_tables_and_a_summary():
    found = optimiser.measure({})
    text = as_csv(found.tables["saturation"])
    rows = list(csv.DictReader(text.splitlines()))
    assert [float(row["beta"]) for row in rows] == list(optimiser.BETAS)
    summary = stability_map.summary(found, "a day", quick=True)
    assert "Measured on a day, " in summary
    assert "few points" in summary
    assert summary.count("Moving asymptotes") == 3


def test_energy_rows_are_known_by_what_they_are_not_by_their_place(monkeypatch):
    points = energy.points(quick=True)[energy.balance]
    assert all(point in energy.points(quick=False)[energy.balance] for point in points)
    point = {"kind": "unstable", "case": "free block at Courant 1.3"}
    assert points.count(point) == 1
    row = energy.balance(**point)
    cases = energy.cases
    monkeypatch.setattr(energy, "cases", lambda quick: [("new", "first", None), *cases(quick)])
    assert energy.points(quick=True)[energy.balance] == [{"kind": "new", "case": "first"}, *points]
    assert energy.balance(**point) == row
    assert row["energy"] > 1.0


def test_a_summary_tells_when_and_on_what_its_rows_were_measured(tmp_path, monkeypatch, caplog):
    caplog.set_level(logging.ERROR, "mpmopt")  # as rows do, and undone after this test

    def row(x):
        return {"x": x}

    module = SimpleNamespace(
        row=row,
        points=lambda quick: {row: [{"x": x} for x in range(2 if quick else 3)]},
        measure=lambda measured: Found({"rows": measured[row]}, []),
    )
    monkeypatch.setattr(stability_map, "MODULES", {"module": module})
    with ThreadPoolExecutor(1) as executor:

        def where(name, quick):
            monkeypatch.setattr(stability_map, "processor", lambda: name)
            found, text = stability_map.measure(quick, tmp_path / "stability.h5", executor)
            assert found.tables["rows"] == [{"x": x} for x in range(len(found.tables["rows"]))]
            return text

        first = where("the first machine", quick=True)
        assert "the first machine" in first
        assert where("another machine", quick=True) == first
        both = where("another machine", quick=False)
    assert "the first machine" in both
    assert "another machine" in both


@pytest.mark.slow
def test_the_case_writes_a_table_for_each_map_a_summary_and_a_figure(tmp_path):
    assert stability_map.main(["--out", str(tmp_path), "--quick"]) == 0
    names = {path.name for path in tmp_path.iterdir()}
    assert {"stability.rst", "stability_map.png", "stability_weak.csv"} <= names
    assert (tmp_path / "stability_map.png").stat().st_size > 50_000
    for path in tmp_path.glob("*.csv"):
        assert len(path.read_text().splitlines()) >= 3, path.name
