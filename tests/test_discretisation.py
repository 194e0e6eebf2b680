"""The cheapest discretisation: comparable gradients, symmetry found, and evidence that adds up."""

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from conftest import small_scene
from crawler import crawler, slanted_legs
from walker import walker

import mpmopt
from mpmopt.__main__ import main
from mpmopt.assess.discretisation import (
    Discretisation,
    Evidence,
    Measured,
    cheapest,
    density,
    measure,
    symmetry,
)
from mpmopt.design.problem import Problem
from mpmopt.errors import DesignError, SceneError
from mpmopt.optimisation.loop import optimise
from mpmopt.optimisation.settings import Settings, Stage
from mpmopt.results.runfile import write
from mpmopt.scene import Actuator, Ground, Mirror, Wall


def smooth(problem):
    """A design without symmetry as a function of position."""
    x, y = problem.particles.position[problem.particles.designed].T
    return problem.join(0.3 * np.sin(40 * x + 25 * y), 0.5, -0.3, -0.5)


def test_a_discretisation_keeps_duration_and_size_and_is_the_scenes_own_by_default():
    scene = walker(64, 8e-4)
    assert Discretisation.of(scene).scene(scene) == scene
    fine = Discretisation.of(scene, 1.5, 0.4).scene(scene)
    assert fine.grid.cells == (96, 96)
    assert fine.grid.size == pytest.approx(scene.grid.size)
    assert fine.duration == pytest.approx(scene.duration, rel=1e-12)
    assert 0.399 < fine.courant <= 0.4
    with pytest.raises(SceneError, match="no whole number"):
        Discretisation.of(small_scene(), 0.3)


def test_patches_hold_the_whole_gradient_and_compare_whole_bodies_with_half_ones():
    whole = replace(crawler(32, 2e-3, mirror=False), steps=20)
    problem = Problem(whole)
    gradient = np.arange(problem.size, dtype=float)
    sums = density(problem, gradient, 1 / 32)
    assert len(sums) == 32 * 32 + 3
    assert sums[:-3].sum() == pytest.approx(gradient[:-3].sum())
    assert list(sums[-3:]) == list(gradient[-3:])

    def design(problem):
        keep = slanted_legs(problem.particles.position[problem.particles.designed])
        return problem.join(np.where(keep, 0.5, -0.5), 1.0, -0.3, -0.5)

    plane = symmetry(whole, design, 2.0)
    assert plane == Mirror("y", 0.5)
    assert symmetry(whole, smooth, 2.0) is None
    half = measure(whole, Discretisation.of(whole, mirror=plane), design, 2.0, 1 / 32)
    # Measured with the plane in the scene, the whole body's gradient is folded about it.
    both = measure(replace(whole, mirror=plane), Discretisation.of(whole), design, 2.0, 1 / 32)
    distance, norm, angle = half.errors(both)
    assert distance <= 1e-10
    assert norm <= 1e-10
    assert angle <= 1e-5


def test_errors_are_those_of_vectors():
    scene = small_scene()
    here = Discretisation.of(scene)
    reference = Measured(here, 1.0, 1.0, 0.1, np.array([3.0, 4.0]))
    assert reference.errors(reference) == (0.0, 0.0, 0.0)
    twice = replace(reference, distance=0.12, gradient=np.array([6.0, 8.0]))
    assert twice.errors(reference) == pytest.approx((0.2, 1.0, 0.0), abs=1e-6)
    across = replace(reference, gradient=np.array([-4.0, 3.0]))
    assert across.errors(reference) == pytest.approx((0.0, math.sqrt(2.0), 90.0))
    assert np.isnan(Measured(here, failure="no").errors(reference)).all()


def test_a_failure_is_evidence_not_an_end():
    scene = small_scene()
    too_long = replace(Discretisation.of(scene), steps=2)
    measured = measure(scene, too_long, smooth, 1.0, 1 / 8)
    assert "time_step" in measured.failure
    assert np.isnan(measured.distance)


def test_single_precision_loses_digits_but_few():
    scene = small_scene()
    here = Discretisation.of(scene)
    double, single = (
        measure(scene, replace(here, precision=precision), smooth, 2.0, 1 / 16)
        for precision in ("double", "single")
    )
    distance, gradient, angle = single.errors(double)
    assert 0.0 < distance <= 1e-4
    assert 0.0 < gradient <= 1e-3
    assert angle <= 0.1
    assert single.megabytes == pytest.approx(double.megabytes / 2, rel=0.05)


@pytest.mark.parametrize(("tolerance", "gradient_tolerance"), [(0.1, math.inf), (0.2, 0.5)])
def test_evidence_adds_up(tolerance, gradient_tolerance):
    scene = small_scene()
    shown: list[Any] = []
    found = cheapest(
        scene, smooth, tolerance, beta=2.0, gradient_tolerance=gradient_tolerance,
        progress=shown.append,
    )  # fmt: skip
    assert list(found.rows) == shown
    reference = found.reference
    assert reference.discretisation.cells == (32, 32)
    rows = {row.measured.discretisation: row for row in found.rows}
    assert len(rows) == len(found.rows)
    for row in found.rows:
        errors = row.measured.errors(reference)
        if not row.measured.failure:
            assert errors == (row.objective_error, row.gradient_error, row.angle)
        assert row.within == (
            row.objective_error <= tolerance and row.gradient_error <= gradient_tolerance
        )
    assert rows[found.best].within

    def work(item):
        return math.prod(item.cells) * item.particles_per_cell**2 * item.steps

    # What is cheaper was measured and is not within, or was so by chance: its finer one is not.
    assert work(found.best) <= work(reference.discretisation)
    lucky = [
        item
        for item, row in rows.items()
        if work(item) < work(found.best) and row.within and item.precision == "double"
    ]
    for item in lucky:
        assert any(
            not row.within and other.cells > item.cells
            and other.particles_per_cell == item.particles_per_cell
            for other, row in rows.items()
        )  # fmt: skip


def test_the_loosest_tolerance_takes_the_cheapest_and_the_tightest_the_reference():
    scene = small_scene(walls=(Wall("y", 4 / 16, friction=0.3),))  # on a line of coarser grids too
    problem = Problem(scene, 2.0)
    x = smooth(problem)
    loose = mpmopt.cheapest(scene, x, 1e9, beta=2.0)
    assert loose.best.cells[0] < 16
    tight = mpmopt.cheapest(scene, x, 1e-12, beta=2.0)
    assert replace(tight.best, precision="double") == tight.reference.discretisation
    assert tight.gradient_uncertainty > 1e-12


def on_ground(**changes):
    """The small walker on a layer, which both formulations know."""
    ground = (Ground.floor(3 / 16, friction=0.3, thickness=1 / 16),)
    return small_scene(walls=(), ground=ground, steps=8, time_step=2e-3, **changes)


def test_both_formulations_are_measured_each_against_its_own_finest():
    found = cheapest(on_ground(), smooth, 1e-9, gradient_tolerance=math.inf)
    assert found.reference.discretisation.formulation == "updated"  # the scene's own
    assert found.other_reference is not None
    assert found.other_reference.discretisation.formulation == "total"
    finest = {"updated": found.reference, "total": found.other_reference}
    for row in found.rows:
        errors = row.measured.errors(finest[row.measured.discretisation.formulation])
        assert row.objective_error == errors[0]
    apart = found.other_reference.errors(found.reference)
    assert (found.objective_apart, found.gradient_apart) == apart[:2]
    assert 1e-9 < found.objective_apart < 0.5
    assert f"differ in distance by {found.objective_apart:.3g}" in found.doubt
    loose = replace(found, tolerance=0.5, objective_uncertainty=0.1)
    assert loose.doubt == ""
    walled = cheapest(small_scene(steps=8), smooth, 1e9)
    assert walled.other_reference is None
    assert math.isnan(walled.objective_apart)
    assert {row.measured.discretisation.formulation for row in walled.rows} == {"updated"}


@pytest.mark.parametrize("faster", ["updated", "total"])
def test_the_formulation_that_takes_less_time_is_the_cheapest(monkeypatch, faster):
    def clocked(scene, discretisation, *arguments, real=measure, **options):
        measured = real(scene, discretisation, *arguments, **options)
        work = math.prod(discretisation.cells) * discretisation.steps
        share = 1.0 if discretisation.formulation == faster else 100.0
        return replace(measured, seconds=share * work / 1e4)

    monkeypatch.setattr("mpmopt.assess.discretisation.measure", clocked)
    found = cheapest(on_ground(), smooth, 1e9)
    assert found.best.formulation == faster
    assert found.reference.discretisation.formulation == faster
    # The total Lagrangian formulation has no single precision: none is tried.
    assert not any("precision" in row.measured.failure for row in found.rows)


def test_what_makes_no_sense_is_refused():
    scene = small_scene()
    with pytest.raises(DesignError, match="tolerance"):
        cheapest(scene, smooth, 0.0)
    with pytest.raises(DesignError, match="gradient_tolerance"):
        cheapest(scene, smooth, 0.1, gradient_tolerance=-1.0)
    with pytest.raises(DesignError, match="seconds"):
        cheapest(scene, smooth, 0.1, seconds=1e-12)


def test_the_filter_keeps_its_length_on_other_grids():
    scene = walker(64, 8e-4)
    reach = scene.filter_spread
    kept = replace(scene, filter_length=reach)
    assert kept.filter_passes == 1
    fine = Discretisation.of(kept, 2.0).scene(kept)
    assert fine.filter_spread == pytest.approx(reach, rel=0.02)


def test_the_command_prints_evidence_and_what_it_found(tmp_path, capsys):
    scene = small_scene()
    stage = Stage(1.0, void_density=1e-2, void_stiffness=1e-3, time_step=4e-3)
    settings = Settings((stage,), window=1, least_iterations=1, most_iterations=1)
    run = optimise(scene, settings, Problem(scene).join(0.1, 0.5, 0.2, 0.1))
    path = tmp_path / "run.h5"
    write(path, run)
    assert main(["cheapest", str(path), "--tol", "1e9"]) == 0
    printed = capsys.readouterr().out.splitlines()
    assert printed[-1].startswith("cheapest within 1e+09")
    assert sum("within" in line for line in printed[:-1]) >= 2
    assert main(["cheapest", str(path), "--tol", "1e-9"]) == 0
    *_, own, best, doubt = capsys.readouterr().out.splitlines()
    assert own.startswith("its own uncertainty      distance ")
    assert best.startswith("cheapest near it")
    assert "asked for is 1e-09" in doubt


@pytest.mark.parametrize("seconds", [0.5, 1.1])
def test_single_precision_is_taken_only_where_it_took_less_time(monkeypatch, seconds):
    def clocked(*arguments, real=measure, **options):
        measured = real(*arguments, **options)
        single = measured.discretisation.precision == "single"
        return replace(measured, seconds=seconds if single else 1.0)

    monkeypatch.setattr("mpmopt.assess.discretisation.measure", clocked)
    found = cheapest(small_scene(steps=8), smooth, 1e9)
    single = {row.measured.discretisation.precision: row for row in found.rows}["single"]
    assert single.within
    assert (found.best.precision == "single") == (seconds < 1.0)


def test_a_tolerance_below_what_the_reference_knows_is_named():
    scene = small_scene(steps=8)
    found = cheapest(scene, smooth, 1e-6)
    assert found.objective_uncertainty > 1e-6
    assert f"distance to {found.objective_uncertainty:.3g}, asked for is 1e-06" in found.doubt
    assert "seconds" in found.doubt
    assert cheapest(scene, smooth, 1e9).doubt == ""
    loose = replace(found, tolerance=1e9, gradient_tolerance=math.inf)
    assert loose.doubt == ""
    assert "not known at all" in replace(loose, objective_uncertainty=math.nan).doubt
    only = replace(loose, gradient_uncertainty=math.nan)
    assert only.doubt == ""  # the gradient may be any


def test_evidence_of_a_small_robot_has_its_digits():
    measured = Measured(Discretisation.of(small_scene()), 1.0, 1.0, 1.2345e-5, np.ones(2))
    assert "1.234e-05" in str(Evidence(measured, 0.1, 0.1, 1.0, True))
    assert "nan" not in str(Evidence(measured, 0.1, 0.0, math.nan, True))


def test_a_body_that_does_not_travel_is_compared_with_what_rounding_does():
    here = Discretisation.of(small_scene())
    still = Measured(here, 1.0, 1.0, 0.0, np.zeros(2), size=1.0)
    assert still.errors(still)[:2] == (0.0, 0.0)
    hardly = replace(still, distance=3e-17, gradient=np.array([0.0, 2e-17]))
    assert max(hardly.errors(still)[:2]) <= 1e-4
    assert max(still.errors(hardly)[:2]) <= 1e-4
    goes = replace(still, distance=0.1, gradient=np.array([0.1, 0.0]))
    assert min(goes.errors(still)[:2]) > 1e9
    assert replace(goes, size=0.0).errors(replace(still, size=0.0))[:2] == (math.inf, math.inf)
    body = (Actuator((0.25, 0.25), (0.5, 0.5)),)
    scene = small_scene(steps=8, body=body, walls=(), gravity=(0.0, 0.0))
    found = cheapest(scene, lambda problem: problem.join(np.empty(0), 0.0, 0.0, 0.0), 0.1)
    assert found.best.cells[0] < 16
    assert found.doubt == ""


@pytest.mark.parametrize("value", [math.nan, 0.0, -1.0, "1", None])
def test_options_that_are_no_limits_are_refused(value):
    scene = small_scene(steps=2)
    options = [{"seconds": value}, {"gradient_tolerance": value if value is not None else "x"}]
    for option in options:
        with pytest.raises(DesignError, match=next(iter(option))):
            cheapest(scene, smooth, 0.1, **option)
    here = Discretisation.of(scene)
    with pytest.raises(DesignError, match="patch"):
        measure(scene, here, smooth, 1.0, value)
    with pytest.raises(DesignError, match="repeats"):
        measure(scene, here, smooth, 1.0, 1 / 16, repeats=0)
