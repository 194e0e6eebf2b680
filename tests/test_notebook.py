"""In a notebook an optimisation shows a bar and its best design, and both change in place."""

import base64
import sys
from types import ModuleType, SimpleNamespace
from typing import Any

import numpy as np
import pytest
from conftest import SHORT, small_scene

from mpmopt.app.study import full_study
from mpmopt.design.problem import Problem
from mpmopt.io.notebook import in_notebook
from mpmopt.io.progress import Progress
from mpmopt.optimisation.history import Optimisation
from mpmopt.optimisation.loop import optimise
from mpmopt.optimisation.settings import Settings
from mpmopt.results import runfile
from mpmopt.view import live

PNG = b"\x89PNG"


@pytest.fixture
def places(monkeypatch):
    """What a kernel was asked to show: a list for each place below the cell."""
    shown: list[list[Any]] = []

    def display(thing, display_id):
        assert display_id is True
        place = [thing]
        shown.append(place)
        return SimpleNamespace(update=place.append)

    ipython: Any = ModuleType("IPython")
    ipython.version_info = (9, 0)  # which Matplotlib asks for
    ipython.get_ipython = lambda: SimpleNamespace(kernel=object())
    ipython.display = SimpleNamespace(display=display)
    monkeypatch.setitem(sys.modules, "IPython", ipython)
    monkeypatch.setitem(sys.modules, "ipykernel", ModuleType("ipykernel"))
    return shown


def test_a_shell_without_a_kernel_is_no_notebook(places, monkeypatch):
    assert in_notebook()
    shell: Any = sys.modules["IPython"]
    for found in (SimpleNamespace(), None):  # IPython in a terminal, and imported by a script
        monkeypatch.setattr(shell, "get_ipython", lambda found=found: found)
        assert not in_notebook()
    monkeypatch.delitem(sys.modules, "IPython")
    assert not in_notebook()


def test_a_bar_changes_in_place_and_stays(places, capfd):
    with Progress("frames", 3) as progress:
        for k in range(3):
            progress.step(f"number {k}")
        progress.print("a result")
    (bar,) = places
    assert all(isinstance(each, str) and "\r" not in each and each.strip() for each in bar)
    assert "0/3" in repr(bar[0]) and "'" not in repr(bar[0])
    assert "3/3" in bar[-1] and "number 2" in bar[-1]
    assert capfd.readouterr() == ("a result\n", "")


def test_a_bar_that_was_left_disturbs_no_other(places):
    left = Progress("frames", 3)  # as an interrupted cell leaves it
    with Progress("frames", 2) as progress:
        progress.step()
        progress.step()
    assert "2/2" in places[1][-1]
    assert all("\x1b" not in each for place in places for each in place)
    left.close()


def test_an_optimisation_shows_a_bar_and_below_it_its_best_design(places, monkeypatch, capfd):
    monkeypatch.setattr(live, "PAUSE", 0.0)
    monkeypatch.setattr(live, "SHARE", 1e9)
    scene = small_scene(steps=4)
    seen = []
    run = optimise(scene, SHORT, {}, lambda run: seen.append(len(run.history)))
    bar, picture = places
    assert "2/2" in bar[-1] and "displacement" in bar[-1]
    assert picture == 3 * [run]  # after both evaluations and at the end
    assert picture[-1]._repr_png_().startswith(PNG)
    assert seen == [1, 2, 2]
    assert capfd.readouterr() == ("", "")


@pytest.mark.parametrize(
    ("picture", "evaluation", "times"),
    [
        (0.5, 1.0, [1.0, 6.5, 12.0, 14.5]),  # five seconds after the last, and at the end
        (0.01, 0.4, [0.4, 1.61, 2.82, 4.03, 5.24]),  # not before a second is over
    ],
)
def test_pictures_take_a_tenth_of_the_time(places, monkeypatch, picture, evaluation, times):
    clock = [0.0]
    shown = []

    class Slow:
        def show(self, thing):
            shown.append(clock[0])
            clock[0] += picture

    monkeypatch.setattr(live, "Place", Slow)
    monkeypatch.setattr(live.time, "monotonic", lambda: clock[0])

    def later(run):
        clock[0] += evaluation

    settings = Settings(SHORT.stages, window=1, least_iterations=12, most_iterations=12)
    optimise(small_scene(steps=4), settings, {}, [later, live.ProgressBar()])
    assert shown == pytest.approx(times)


def test_a_bar_of_ones_own_is_the_only_one(places):
    optimise(small_scene(steps=4), SHORT, {}, live.ProgressBar())
    assert len(places) == 2


def test_watching_changes_no_bit(places, monkeypatch):
    scene = small_scene(steps=4)
    start = Problem(scene).join(0.3, 1.0, -0.3, -0.5)
    watched = optimise(scene, SHORT, start)
    monkeypatch.delitem(sys.modules, "IPython")
    assert np.array_equal(watched.result.x, optimise(scene, SHORT, start).result.x)
    assert len(places) == 2


def test_a_study_shows_its_robot_below_its_bar(places, short_path, tmp_path, monkeypatch):
    kept = runfile.read_run(short_path)
    path = tmp_path / "run.h5"
    runfile.write(path, kept.run, {"post_processed": 0.5})

    def study(problem, x, full, progress):
        progress("friction 0.5", 0.1)
        return {"speed": None, "followed": 1.0}

    monkeypatch.setattr("mpmopt.app.study.robustness.study", study)
    monkeypatch.setattr("mpmopt.view.gait.plot_robustness", lambda path, summary: None)
    full_study(path)
    bar, (robot,) = places
    assert "friction 0.5: 0.100" in bar[-1]
    assert isinstance(robot, Optimisation)


CELL = """
from conftest import SHORT, small_scene
from mpmopt import optimise
run = optimise(small_scene(steps=4), SHORT, {})
"""


@pytest.mark.process
@pytest.mark.filterwarnings("default")
def test_a_real_kernel_shows_both(monkeypatch):
    pytest.importorskip("ipykernel", reason="needs ipykernel: pip install 'mpmopt[test]'")
    nbclient = pytest.importorskip("nbclient", reason="needs nbclient: pip install 'mpmopt[test]'")
    import nbformat

    monkeypatch.setenv("PYTHONPATH", ":".join(path for path in sys.path if path))
    notebook = nbformat.v4.new_notebook(cells=[nbformat.v4.new_code_cell(CELL)])
    nbclient.NotebookClient(notebook, timeout=200).execute()
    outputs = notebook.cells[0].outputs
    assert [output.output_type for output in outputs] == 2 * ["display_data"]
    bar, picture = (output.data for output in outputs)
    assert "2/2" in bar["text/plain"] and "displacement" in bar["text/plain"]
    assert base64.b64decode(picture["image/png"]).startswith(PNG)
    assert "Run of 2 evaluations" in picture["text/plain"]
