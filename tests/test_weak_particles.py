"""The study of void beside stressed solid."""

import csv
import dataclasses

import numpy as np
import pytest
import walker
import weak_particles
from weak_particles import VOIDS, Void

from mpmopt.assess.threshold import distance
from mpmopt.scene.particles import discretise

ACTUATION = weak_particles.start_actuation()
STEP = weak_particles.STEP_IN_CELLS / 64


@pytest.fixture
def baseline():
    """The walker's scene on 64 x 64 cells, a tenth of it in time, and slanted legs."""
    scene = dataclasses.replace(walker.walker(64, STEP), steps=60)
    particles = discretise(scene)
    return scene, walker.slanted_legs(particles.position[particles.designed])


def test_the_long_step_is_at_courant_one_half_or_more():
    for make, _ in weak_particles.CASES.values():
        assert 0.5 <= make(128, weak_particles.STEP_IN_CELLS / 128).courant <= 0.6


def test_void_that_is_left_out_moves_nothing_and_void_that_is_there_does(baseline):
    scene, keep = baseline
    removed = distance(scene, keep, ACTUATION)
    assert weak_particles.distance_with_void(scene, keep, ACTUATION, Void(1e-2, 0.0)) == removed
    there = weak_particles.distance_with_void(scene, keep, ACTUATION, Void(1e-2))
    assert there != removed
    assert abs(there - removed) < 0.1 * scene.grid.dx  # weak: it moves little in so few steps
    # Where all is solid there is no void.
    full = np.ones_like(keep)
    with_void = weak_particles.distance_with_void(scene, full, ACTUATION, Void(1e-2))
    assert with_void == distance(scene, full, ACTUATION)


def test_moved_is_in_percent_of_the_gain_over_the_solid_reference_design(baseline, monkeypatch):
    scene, keep = baseline
    monkeypatch.setattr(
        weak_particles, "distance", lambda _, kept, *rest: 3.0 if kept is keep else 1.0
    )
    monkeypatch.setattr(weak_particles, "distance_with_void", lambda *args: 3.5)
    assert weak_particles.moved(scene, keep, ACTUATION) == ["25.0"] * len(VOIDS)
    monkeypatch.setattr(weak_particles, "distance", lambda *args: 1.0)
    assert set(weak_particles.moved(scene, keep, ACTUATION)) == {"no gain"}


def test_a_failure_is_named_not_numbered(baseline, monkeypatch):
    scene, keep = baseline
    short = dataclasses.replace(scene, gravity=(0.0, -3000.0))
    assert set(weak_particles.moved(short, keep, ACTUATION)) == {"fails without void"}
    # The solid reference design lives, the legs' void does not.
    monkeypatch.setattr(weak_particles, "distance", lambda _, kept, *rest: float(kept is keep))
    found = weak_particles.moved(short, keep, ACTUATION)
    assert found[0].startswith("failed at step ")


def test_main_writes_a_line_for_each_case_and_void(monkeypatch, tmp_path, capsys):
    def short(make):
        return lambda cells, step: dataclasses.replace(make(cells, step), steps=20)

    cases = {name: (short(make), legs) for name, (make, legs) in weak_particles.CASES.items()}
    monkeypatch.setattr(weak_particles, "CASES", cases)
    monkeypatch.setattr(weak_particles, "BETAS", (8.0, 16.0))
    arguments = ["--out", str(tmp_path), "--quick", "--iterations", "1"]
    assert weak_particles.main(arguments) == 0
    with (tmp_path / "weak_particles.csv").open() as file:
        lines = list(csv.DictReader(file))
    assert [(line["case"], line["void"]) for line in lines] == [
        (case, void) for case in cases for void in VOIDS
    ]
    assert {line["evaluations"] for line in lines} == {"2"}
    left_out = [line for line in lines if "left out" in line["void"]]
    assert len(left_out) == 4
    for line in left_out:
        values = {line[key] for key in line if key.startswith("moved")}
        assert values <= {"0.0", "no gain"}
    assert (tmp_path / "weak_particles.rst").read_text().rstrip() in capsys.readouterr().out


@pytest.mark.slow
@pytest.mark.parametrize("case", weak_particles.CASES)
def test_the_cure_lets_both_cases_be_optimised_with_a_long_step(case):
    make, _ = weak_particles.CASES[case]
    void = VOIDS["mass 1e-2, left out from beta 8"]
    run = weak_particles.short_optimisation(make(64, STEP), void, 10)
    assert len(run.history) == 10 * len(weak_particles.BETAS)
    assert run.failed_evaluations == 0
    assert run.result.objective > run.history[0].objective + 0.05
