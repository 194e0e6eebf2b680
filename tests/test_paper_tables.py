"""The table of both cases."""

import csv
import dataclasses

import crawler
import paper_tables
import pytest
import walker

from mpmopt.optimisation.settings import Settings


def test_a_line_counts_the_best_reference_and_the_share_of_the_retained_gain():
    line = paper_tables.row("walker", "paper", paper_tables.PRINTED["walker"])
    assert (line["reference"], line["gain"], line["share of gain retained"]) == (
        "0.208",
        "0.149",
        "97%",
    )
    ours = {
        "reference": 0.2, "baseline": 0.3, "optimised": 0.5, "post_processed": 0.4,
        "a": 1.0, "theta": -0.3, "b": -0.5,
    }  # fmt: skip
    line = paper_tables.row("walker", "ours", ours)
    assert (line["reference"], line["gain"], line["share of gain retained"]) == (
        "0.300",
        "0.100",
        "50%",
    )
    line = paper_tables.row("walker", "ours", {**ours, "post_processed": None})
    assert (line["post_processed"], line["gain"], line["share of gain retained"]) == ("-", "-", "-")
    line = paper_tables.row("walker", "ours", {**ours, "optimised": 0.29, "post_processed": 0.28})
    assert (line["gain"], line["share of gain retained"]) == ("-0.020", "-")


@pytest.fixture
def tiny(monkeypatch):
    """Both cases' previews cut to a few steps and evaluations."""
    for module in (walker, crawler):
        case = module.CASES["preview"]
        stages = case.settings.stages[:1]
        short = dataclasses.replace(
            case,
            scene=dataclasses.replace(case.scene, steps=50, transient=0.0),
            settings=Settings(stages, window=1, least_iterations=2, most_iterations=2),
        )
        monkeypatch.setitem(module.CASES, "preview", short)


@pytest.mark.case
def test_both_cases_are_run_once_and_then_read(tiny, tmp_path, capsys):
    arguments = ["--out", str(tmp_path), "--setting", "preview"]
    assert paper_tables.main(arguments) == 0
    first = capsys.readouterr().out
    assert "The geometry is ours" in first
    before = {path: path.stat().st_mtime_ns for path in tmp_path.glob("*/run.h5")}
    assert len(before) == 2
    assert paper_tables.main(arguments) == 0
    assert capsys.readouterr().out == first
    assert {path: path.stat().st_mtime_ns for path in before} == before

    with (tmp_path / "tables.csv").open() as file:
        lines = list(csv.DictReader(file))
    assert [line["case"] for line in lines] == ["walker", "walker", "crawler", "crawler"]
    assert [line["source"] for line in lines] == 2 * ["paper", "mpmopt, preview"]
    assert lines[2]["share of gain retained"] == "31%"
    table = (tmp_path / "tables.md").read_text().splitlines()
    assert len(table) == 6
    assert {line.count("|") for line in table} == {11}


@pytest.mark.case
def test_a_run_of_other_settings_is_not_taken_for_the_tables(tiny, tmp_path, capsys):
    assert paper_tables.main(["--out", str(tmp_path), "--setting", "preview"]) == 0
    capsys.readouterr()
    assert paper_tables.main(["--out", str(tmp_path), "--setting", "default"]) == 1
    assert "another scene or other settings" in capsys.readouterr().err
