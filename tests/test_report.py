"""The report of a run: its numbers, and its page in a real browser."""

import base64
import dataclasses
import json
import os
import subprocess
import zlib
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from browser import Browser
from conftest import empty, small_scene
from PIL import Image

from mpmopt.__main__ import main
from mpmopt.assess.trajectory import Motion, optimised, post_processed
from mpmopt.design.problem import Problem
from mpmopt.design.task import AtMost, Task
from mpmopt.design.terms import Displacement, Effort, Volume
from mpmopt.design.variation import Variation
from mpmopt.errors import DesignError, SimulationError
from mpmopt.results import runfile
from mpmopt.scene.particles import discretise
from mpmopt.view import report as reporting
from mpmopt.view.draw import view
from mpmopt.view.report import design_picture, packed, report

ROOT = Path(__file__).parent.parent
SUMMARY = {
    "start": 0.32, "reference": 0.31, "optimised": 0.5, "post_processed": 0.4,
    "gain": {"as designed": 0.09, "half the step": None},
    "retained_gain": {"half the step": None},
    "speed_by_friction": {"0.3": 0.125, "0.5": 0.25}, "components": 1, "thinnest_member": 0.0625,
    "odd": "</script><!-- & <b>", "disconnected_particles": 3, "a": [1.0, 0.5],
}  # fmt: skip


@pytest.fixture(scope="module")
def page(short_path, tmp_path_factory):
    """The report of the short run, with a summary that others wrote, and a constraint missed."""
    found = runfile.read_run(short_path)
    found.run.history[0] = dataclasses.replace(found.run.history[0], violation=0.1)
    path = tmp_path_factory.mktemp("report") / "a page.html"
    with np.errstate(all="raise", under="ignore"):
        report(path, found.run, SUMMARY, found.versions, short_path)
    return path


def data_of(page) -> dict[str, Any]:
    """What the page's script reads; what is no JSON, such as NaN, is an error."""
    text = page.read_text().split('type="application/json">')[1].split("</script>")[0]

    def refused(name):
        raise ValueError(name)

    data: dict[str, Any] = json.loads(text, parse_constant=refused)
    return data


def test_the_page_holds_everything_itself_and_nothing_of_the_data_ends_its_script(page):
    data, text = data_of(page), page.read_text()
    assert data["tables"]["more"]["odd"] == SUMMARY["odd"]
    assert text.count("</script>") == 2
    assert "http" not in text.replace("http-equiv", "").replace("http://www.w3.org/2000/svg", "")
    assert "default-src 'none'" in text
    assert page.stat().st_size < 1e6


def test_displacements_count_from_where_the_body_was(page, short_run):
    data = data_of(page)
    start = 5 / 16  # the middle of solid and actuators
    assert short_run.origin == pytest.approx(start)
    assert data["tables"]["placed"]["without grey"] == pytest.approx(0.4 - start)
    wanted = [item.objective - start for item in short_run.history]
    assert data["history"]["objective"] == pytest.approx(wanted, rel=1e-4)
    assert data["tables"]["retained"]["half the step"] == {"gain": None, "retained": None}


def test_a_body_that_stays_has_gone_nowhere_whatever_counts(short_run):
    still = dataclasses.replace(short_run.scene, gravity=(0.0, 0.0), walls=())
    problem = Problem(still)
    x = problem.join(1.0, 0.0, 0.0, 0.0)
    for term in (Displacement(), Displacement((0.0, 1.0)), Displacement(region=1), Effort()):
        run = dataclasses.replace(short_run, scene=still, task=Task(term))
        assert run.origin == pytest.approx(Problem(still, task=run.task).value(x), abs=1e-12)
        assert run.measure == ("objective" if term == Effort() else "displacement")


def test_the_chosen_evaluation_is_the_results(page, short_run):
    number = short_run.chosen
    assert data_of(page)["history"]["chosen"] == number
    assert short_run.history[number - 1].objective == short_run.result.objective
    assert number == 2 and short_run.number_of(short_run.first) == 1


def unpacked(text, frames, particles):
    """Places (F, 2, M) and deformations (F, 4, M) as the page's script reads them."""
    content = np.frombuffer(zlib.decompress(base64.b64decode(text)), np.uint8)
    low, high, F = np.split(content, [2 * frames * particles, 4 * frames * particles])
    place = np.add.accumulate((low + 256 * high.astype(np.uint16)).reshape(frames, 2, particles))
    F = np.add.accumulate(F.view(np.int8).reshape(frames, 4, particles), dtype=np.int8)
    return place.astype(np.uint16), F


def test_a_film_keeps_places_to_a_hundred_thousandth_and_deformations_to_a_hundredth(short_run):
    motion = Motion.of(optimised(short_run.problem(), short_run.result.x), [0, 7, 20, 40])
    box, order = view([motion]), np.arange(len(motion.gamma))[::-1]
    place, F = unpacked(packed(motion, box, order), 4, order.size)
    found = box[0][:, None] + place / 65535 * np.ptp(box, axis=0)[:, None]
    assert np.abs(found - motion.position[:, :, order]).max() <= 1e-5 * np.ptp(box)
    assert np.abs(F / 64 - motion.deformation[:, :, order]).max() <= 1 / 128 + 1e-6
    assert np.ptp(motion.position, axis=0).max() > 0.01  # it moves


def test_films_show_what_moves_and_end_where_it_ends(page, short_run):
    films = {film["name"]: film for film in data_of(page)["films"]}
    assert list(films)[:2] == ["post-processed design", "optimised design"]
    scene = short_run.scene
    for film in films.values():
        assert film["time"][0] == 0.0
        assert film["time"][-1] == pytest.approx(scene.duration)
        assert len(film["signal"]) == film["particles"]
        assert len(film["signals"][0]) == 3  # of two actuators, and none
        assert len(film["solids"]) == 2
    body = post_processed(short_run.problem(), short_run.result.x)
    motion = Motion.of(body, [0, scene.steps])
    moved = np.diff(motion.position.mean(axis=2), axis=0)[0] @ scene.direction
    assert films["post-processed design"]["travel"][-1] == pytest.approx(moved, rel=1e-4)


def test_a_designs_picture_has_a_pixel_for_each_particle():
    scene = small_scene()
    problem = Problem(scene)
    half = discretise(scene)
    gamma = np.where(half.position[half.designed, 0] < 5 / 16, 1.0, 0.0)
    uri = design_picture(scene, gamma)
    head, content = uri.split(",")
    assert head == "data:image/png;base64"
    with Image.open(BytesIO(base64.b64decode(content))) as image:
        pixels = np.array(image)
    assert pixels.shape == (6, 8, 4)  # the body is 4 x 3 cells of 2 x 2 particles
    assert (pixels[2:, :4, 3] == 255).all() and (pixels[2:, 4:, 3] == 0).all()
    assert (pixels[:2, :2, 0] > 200).all() and (pixels[:2, 2:6, 0] < 100).all()
    assert problem.gamma(problem.join(0.0, 0.0, 0.0, 0.0)).size == gamma.size


def test_each_evaluation_is_shown_with_its_design(page, short_run):
    pictures = data_of(page)["history"]["pictures"]
    assert len(set(pictures)) == len(pictures) == 2
    last = short_run.designs[1]
    assert last == pytest.approx(255.0 * short_run.last.gamma, abs=0.5)
    assert pictures[1] == design_picture(short_run.scene, last / 255.0)


def test_a_body_that_cannot_be_simulated_is_left_out(
    short_run, short_path, tmp_path, caplog, monkeypatch
):
    def fails(problem, x):
        raise SimulationError("it burst", 3, -1, (np.nan, np.nan), "take another")

    for body in ("optimised", "reference"):
        monkeypatch.setattr(reporting, body, fails)
    report(tmp_path / "a.html", short_run, {}, {}, short_path)
    assert [film["name"] for film in data_of(tmp_path / "a.html")["films"]] == [
        "post-processed design"
    ]
    assert "a body is left out: step 3, body: it burst" in caplog.text


def test_each_constraint_is_told_with_value_bound_and_multiplier(short_run, short_path, tmp_path):
    task = Task(subject_to=(AtMost(Volume(), 0.4), AtMost(Effort(), 0.5)))
    best = dataclasses.replace(
        short_run.result, constraints=(0.3, 0.7), multipliers=(0.0, 0.125), violation=0.4
    )
    run = dataclasses.replace(short_run, task=task, best={0: best})
    report(tmp_path / "a.html", run, {}, {}, short_path)
    assert data_of(tmp_path / "a.html")["tables"]["constraints"] == [
        {"name": "Volume()", "value": 0.3, "bound": 0.4, "multiplier": 0.0, "met": True},
        {"name": "Effort()", "value": 0.7, "bound": 0.5, "multiplier": 0.125, "met": False},
    ]


def test_the_design_is_filmed_in_each_scene_of_an_ensemble(short_run, short_path, tmp_path):
    task = Task(scenes=(Variation(strength=0.5), Variation(refinement=2)))
    history = [dataclasses.replace(item, scenes=(0.4, 0.5)) for item in short_run.history]
    run = dataclasses.replace(short_run, task=task, history=history)
    report(tmp_path / "a.html", run, {}, {}, short_path)
    data = data_of(tmp_path / "a.html")
    plain, _, _, weak, fine = data["films"]
    assert weak["name"] == "post-processed design in scene 1: strength 0.5"
    assert fine["name"] == "post-processed design in scene 2: refinement 2"
    assert fine["particles"] == 4 * plain["particles"]
    assert weak["motion"] != plain["motion"]
    assert data["history"]["scenes"][0] == pytest.approx([0.4 - 5 / 16, 0.5 - 5 / 16])


def test_a_run_without_a_design_has_no_report(short_path, tmp_path):
    with pytest.raises(DesignError, match="no evaluation succeeded yet"):
        report(tmp_path / "a.html", empty(small_scene()), {}, {}, short_path)
    assert not list(tmp_path.iterdir())


def test_the_command_writes_the_page(short_path, tmp_path, capsys):
    target = tmp_path / "new" / "walker.html"
    assert main(["report", str(short_path), "--out", str(target)]) == 0
    assert capsys.readouterr().out.startswith(f"{target}: 0.")
    data = data_of(target)
    assert data["tables"]["more"] == {}  # a run file without a summary
    assert all(str(short_path) in line for line in data["commands"].values())


@pytest.mark.process
def test_the_line_that_reproduces_a_run_gives_its_digits(page):
    line = next(iter(data_of(page)["commands"].values()))
    done = subprocess.run(
        line, shell=True, capture_output=True, text=True, timeout=120,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    again, objective = done.stdout.split()
    assert again == objective


SLIDER = "Number(document.querySelector('#slider').value)"
CANVAS = "canvas.toDataURL()"  # what it shows


@pytest.mark.process
def test_the_page_works_in_a_real_browser(page, tmp_path):
    browser = Browser(tmp_path / "profile")
    try:
        browser.open(page)
        browser.wait("canvas.dataset.ready === '0'")
        first = browser.js(CANVAS)

        browser.click("#slider", 0.5)
        assert browser.js(SLIDER) == pytest.approx(500, abs=30)
        assert "0.080 of 0.16" in browser.js("document.querySelector('#clock').textContent")
        middle = browser.js(CANVAS)
        assert middle != first

        browser.click("#play")
        assert browser.js("document.querySelector('#play').textContent") == "Pause"
        browser.wait(f"{SLIDER} > 560")
        browser.click("#play")
        assert browser.js("document.querySelector('#play').textContent") == "Play"
        stopped = browser.js(SLIDER)
        assert browser.js(CANVAS) != middle
        browser.js("new Promise((done) => setTimeout(done, 150))")
        assert browser.js(SLIDER) == stopped
        browser.click("#travel svg", 0.99)  # a click in a chart goes there
        assert browser.js(SLIDER) == 1000
        browser.click("#play")  # from the end it begins anew
        assert browser.js(SLIDER) < 900
        browser.click("#play")

        for number in range(browser.js("data.films.length")):
            browser.js(
                f"(() => {{ const c = document.querySelector('#choice'); c.value = '{number}';"
                "c.dispatchEvent(new Event('change')); })()"
            )
            browser.wait(f"canvas.dataset.ready === '{number}'")
        browser.move("#history svg", 0.2)
        assert browser.js("document.querySelector('#look').textContent").startswith(
            "Evaluation 1 of 2"
        )
        browser.move("#history svg", 0.85)
        look = browser.js("document.querySelector('#look').textContent")
        assert look.startswith("Evaluation 2 of 2, the chosen one")
        assert browser.js("document.querySelector('#look img').naturalWidth") == 8
        assert browser.js("past.pictures.length") == 2
        assert browser.js("document.querySelectorAll('#history circle.open').length") == 2
        assert "open mark" in browser.js("document.querySelector('#history').textContent")
        text = browser.js("document.body.innerText")
        for name in ("speed by friction", "thinnest member", "pieces", SUMMARY["odd"]):
            assert name in text

        shots = []
        for width in (1200, 380):
            for dark in (False, True):
                browser.open(page, width, 800, dark)
                browser.wait("canvas.dataset.ready === '0'")
                assert browser.js("document.documentElement.scrollWidth") == width
                shots.append(browser.whole())
                with Image.open(BytesIO(shots[-1])) as image:
                    pixels = np.array(image.convert("L"))
                assert pixels.shape[1] == width
                assert (pixels[-1, 0] < 128) == dark
                assert 0.005 < (np.abs(pixels - float(pixels[-1, 0])) > 80).mean() < 0.3
        assert len(set(shots)) == 4
        assert browser.said == []
    finally:
        browser.close()
