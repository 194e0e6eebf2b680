"""The smallest version of the command that asks whether the grid matters."""

import csv

import mesh_independence
import numpy as np
import pytest
from mesh_independence import CHOICES, Choice, displacement, stepped_legs
from walker import slanted_legs

from mpmopt.scene.particles import discretise

LAYER = CHOICES[0]


def test_edges_of_64_cells_are_the_same_body_on_all():
    positions = [discretise(LAYER.scene(n)) for n in (64, 128)]
    coarse, fine = (p.position[p.designed][stepped_legs(p.position[p.designed])] for p in positions)
    drawn = positions[0].position[positions[0].designed]
    assert np.array_equal(stepped_legs(drawn), slanted_legs(drawn))
    assert len(fine) == 4 * len(coarse)
    quarters = {tuple(q) for q in np.floor(fine * 128).astype(int)}
    assert quarters == {tuple(q) for q in np.floor(coarse * 128).astype(int)}


def test_the_choices_are_scenes_that_differ_in_what_they_say():
    for choice in CHOICES:
        for cells in mesh_independence.CELLS:
            scene = choice.scene(cells)
            assert scene.steps * scene.time_step == pytest.approx(mesh_independence.SECONDS)
            assert bool(scene.ground) is choice.layer is not bool(scene.walls)


def test_the_walker_moves_as_far_as_measured():
    assert displacement(LAYER, 64)["displacement"] == pytest.approx(0.0929, abs=0.002)


def test_from_64_to_128_cells_the_walker_goes_as_far_and_does_not_where_it_falls():
    found = {
        name: [displacement(choice, cells)["displacement"] for cells in (64, 128)]
        for name, choice in (("stands", LAYER), ("falls", Choice("falls", fall=1.0)))
    }
    apart = {name: abs(b - a) / a for name, (a, b) in found.items()}
    assert apart["stands"] <= 0.01
    assert apart["falls"] >= 0.05


def test_the_command_writes_its_tables_and_its_figure(tmp_path):
    assert mesh_independence.main(["--quick", "--out", str(tmp_path)]) == 0
    with (tmp_path / "mesh_independence.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [row["choice"] for row in rows] == ["layer", "clamped nodes"]
    assert all(0.0 <= float(row["spread over steps, 64 cells"]) < 0.5 for row in rows)
    with (tmp_path / "mesh_independence_validity.csv").open() as file:
        rows = list(csv.DictReader(file))
    for row in rows:
        for direction in ("random signs", "the gradient's signs"):
            assert 0.0 < float(row[f"1%, {direction}"]) <= float(row[f"5%, {direction}"])
    assert (tmp_path / "mesh_independence.png").stat().st_size > 0


def test_each_choice_has_a_colour_and_a_mark_of_its_own():
    for looks in (mesh_independence.COLOURS, mesh_independence.MARKERS):
        assert len(set(looks)) == len(looks) == len(CHOICES)
