"""Pictures of a run from its file alone, whole or absent; what notebooks and terminals show."""

import dataclasses
import functools
import shutil
from io import BytesIO
from typing import Any

import matplotlib
import matplotlib.style
import numpy as np
import pytest
from conftest import SHORT, empty, small_scene
from PIL import Image
from scipy.ndimage import binary_erosion, label
from test_mirror import channel
from walker import walker, walker_on_ground

from mpmopt.__main__ import main
from mpmopt.app import multistart
from mpmopt.assess.trajectory import Motion, optimised
from mpmopt.design.problem import Problem
from mpmopt.errors import DesignError, SimulationError, StorageError
from mpmopt.io import files
from mpmopt.optimisation.history import Iteration
from mpmopt.optimisation.loop import optimise
from mpmopt.results import runfile
from mpmopt.scene import Design, Grid, Ground, Solid
from mpmopt.view import draw, plot
from mpmopt.view.film import Screen
from mpmopt.view.schematic import schematic

NAMES = {"schematic.png", "history.png", "design.png", "post_processed.png", "reference.png"}


def picture(content):
    """The pixels of a PNG, all of which are read."""
    with Image.open(BytesIO(content)) as image:
        assert image.format == "PNG"
        return np.array(image.convert("RGB"))


def test_plot_draws_a_run_from_its_file(short_path, tmp_path, capsys):
    folder = tmp_path / "new"
    assert main(["plot", str(short_path), "--out", str(folder)]) == 0
    assert {file.name for file in folder.iterdir()} == NAMES
    for file in folder.iterdir():
        pixels = picture(file.read_bytes())
        assert min(pixels.shape[:2]) >= 200
        assert (pixels < 128).all(axis=2).mean() >= 0.01  # not empty
    for name in ("design", "post_processed", "reference"):
        pixels = picture((folder / f"{name}.png").read_bytes()).astype(int)
        bodies = binary_erosion(pixels.min(axis=2) < 100, iterations=5)  # no lines, no letters
        assert label(bodies)[1] >= 8
    printed = capsys.readouterr()
    assert {line.split("/")[-1] for line in printed.out.splitlines()} == NAMES
    assert "5 of 5 pictures" in printed.err


HOSTILE: dict[Any, Any] = {
    "text.usetex": True,  # LaTeX need not be there
    "font.family": "no such font",
    "axes.unicode_minus": False,
    "axes.formatter.use_locale": True,
    "savefig.bbox": "tight",
    "savefig.dpi": 30,
    "figure.dpi": 50,
    "figure.autolayout": True,
    "figure.constrained_layout.use": True,
    "lines.linewidth": 9.0,
    "hatch.linewidth": 9.0,
    "patch.antialiased": False,
    "path.simplify_threshold": 1.0,
    "path.sketch": (5.0, 50.0, 5.0),
    "image.cmap": "gray",
}


def test_pictures_are_the_same_whatever_the_users_style_is(
    short_run, short_path, tmp_path, monkeypatch
):
    small = functools.partial(draw.png, dpi=20)
    for module in (draw, plot):
        monkeypatch.setattr(module, "png", lambda figure, dpi=None: small(figure))
    body = optimised(short_run.problem(), short_run.result.x)
    motion = Motion.of(body, [0, 20])
    shutil.copytree(short_path.parent, tmp_path / "start-0")
    row = {"start": 0, "gain": 0.1, "refined_gain": 0.05}

    def content():
        plot.plot_motion(tmp_path / "motion.png", body, 1)
        plot.plot_history(tmp_path / "history.png", short_run)
        multistart.draw(tmp_path / "starts.png", tmp_path, [row])
        for name in ("motion", "history", "starts"):
            yield (tmp_path / f"{name}.png").read_bytes()
        yield short_run.scene._repr_png_()
        yield short_run._repr_png_()
        yield Screen([motion], 1.0).frame(1).tobytes()

    wanted = list(content())
    with matplotlib.rc_context():
        matplotlib.style.use("dark_background")
        matplotlib.rcParams.update(HOSTILE)
        for number, (one, other) in enumerate(zip(content(), wanted, strict=True)):
            assert one == other, number
        assert matplotlib.rcParams["savefig.dpi"] == 30  # and it is theirs again


def test_instants_and_distances_of_a_small_and_fast_robot_can_be_read(monkeypatch, tmp_path):
    c = 1e-4  # a robot of half a millimetre in metres, in motion for 100 microseconds
    scene = small_scene(
        grid=Grid((16, 16), c), time_step=1e-6, steps=100, gravity=(1e2, 0.0), walls=(),
        body=(Solid((4 * c, 6 * c), (9 * c, 8 * c)),),
    )  # fmt: skip
    figures: list[Any] = []

    def png(figure):
        figures.append(figure)
        return b""

    monkeypatch.setattr(plot, "png", png)
    plot.plot_motion(tmp_path / "a.png", optimised(Problem(scene), np.empty(0)), 3)
    (figure,) = figures
    assert figure.get_suptitle() == "Optimised design, L = 0.000650505"  # it moved by 5e-7
    titles = [axes.get_title() for axes in figure.axes if axes.axison]
    assert titles == ["t = 0.000000", "t = 0.000050", "t = 0.000100"]


@pytest.mark.parametrize("unit", [2.0**-40, 2.0**40])
def test_a_schematic_says_the_same_in_any_unit_of_length(unit):
    c = unit / 16
    scene = small_scene(
        grid=Grid((16, 16), c), time_step=unit * 4e-3, walls=(), gravity=(0.0, 0.0),
        body=(Solid((3 * c, 4 * c), (7 * c, 6 * c)), Solid((3 * c, 6 * c), (6 * c, 7 * c))),
    )  # fmt: skip
    lengths = [word for word in words(schematic(scene)) if word[:1].isdigit()]
    assert sorted(lengths) == sorted(f"{k * c:.6g}" for k in (4, 3, 1, 3, 2, 1))


def test_a_history_is_the_same_from_a_run_and_from_its_file(tmp_path):
    scene = small_scene(steps=10)
    run = optimise(scene, SHORT, Problem(scene).join(0.0, 1.0, -0.3, -0.5))
    runfile.write(tmp_path / "run.h5", run)
    plot.plot_history(tmp_path / "a.png", run)
    plot.plot_history(tmp_path / "b.png", runfile.read_run(tmp_path / "run.h5").run)
    assert (tmp_path / "a.png").read_bytes() == (tmp_path / "b.png").read_bytes()


def run_of(**columns):
    """A run with this history and no design."""
    names = [field.name for field in dataclasses.fields(Iteration)]
    count = len(columns["objective"])
    default = {name: count * [0] for name in names} | {"post_processed": count * [np.nan]}
    rows = zip(*({**default, **columns}[name] for name in names))
    run = empty(small_scene())
    run.history = [Iteration(**dict(zip(names, row))) for row in rows]
    return run


def test_a_history_marks_each_stage_and_failure_where_it_is():
    axes = draw.new_figure(7, 4).add_subplot()
    draw.draw_history(
        axes,
        run_of(
            objective=[0.2, 0.3, np.nan, 0.4, 0.5, 0.6],
            beta=[0.5, 0.5, 0.5, 1.0, 0.5, 0.5],
            stage=[0, 0, 0, 1, 0, 0],
        ),
    )
    lines = {line.get_label(): line for line in axes.lines}
    assert np.array_equal(lines["failed evaluation"].get_xdata(), [3])
    assert np.array_equal(np.asarray(lines["objective L"].get_ydata())[:2], [0.2, 0.3])
    texts: list[Any] = list(axes.texts)
    marks = {text.xy[0]: text.get_text() for text in texts}
    assert marks == {0.5: r"$\beta$ = 0.5", 3.5: r"$\beta$ = 1", 4.5: r"$\beta$ = 0.5"}


def test_a_history_marks_what_breaks_a_constraint():
    for violation, marked in (([0.2, 0.0, np.nan], [1.0]), ([0.0, 0.0, np.nan], [])):
        axes = draw.new_figure(7, 4).add_subplot()
        draw.draw_history(axes, run_of(objective=[0.3, 0.2, np.nan], violation=violation))
        lines = [line for line in axes.lines if line.get_label() == "breaks a constraint"]
        assert [x for line in lines for x in np.asarray(line.get_xdata())] == marked
        assert all(line.get_markerfacecolor() == "white" for line in lines)
        legend = axes.get_legend()
        assert legend is not None
        names = [text.get_text() for text in legend.get_texts()]
        assert ("breaks a constraint" in names) == bool(marked)


def test_a_history_of_failures_alone_can_be_drawn():
    axes = draw.new_figure(7, 4).add_subplot()
    draw.draw_history(axes, run_of(objective=[np.nan, np.nan]))
    assert "failed evaluation" in {line.get_label() for line in axes.lines}


def test_a_run_without_a_design_is_an_error_and_leaves_nothing(tmp_path, capsys):
    runfile.write(tmp_path / "run.h5", empty(small_scene()))
    assert main(["plot", str(tmp_path / "run.h5")]) == 1
    assert capsys.readouterr().err.startswith("DesignError: there is no design")
    assert [file.name for file in tmp_path.iterdir()] == ["run.h5"]


def test_an_unfinished_run_is_drawn_without_what_fails(short_run, tmp_path, caplog, monkeypatch):
    def fails(problem, x):
        raise SimulationError("it burst", 3, -1, (np.nan, np.nan), "take another")

    for body in ("optimised", "post_processed", "reference"):
        monkeypatch.setattr(plot, body, fails)
    unfinished = dataclasses.replace(short_run, stop_reason="")
    plot.plot_run(tmp_path, unfinished)
    assert {file.name for file in tmp_path.iterdir()} == {"schematic.png", "history.png"}
    assert "no reference.png: step 3, body: it burst" in caplog.text


def test_a_folder_that_cannot_be_written_is_a_storage_error(short_run, tmp_path):
    with pytest.raises(StorageError):
        plot.plot_run(tmp_path / "nowhere", short_run)
    (tmp_path / "file").write_text("")
    with pytest.raises(StorageError, match="choose another folder"):
        files.make_folder(tmp_path / "file" / "folder")


def words(figure):
    (axes,) = figure.axes
    return [text.get_text() for text in axes.texts]


def test_a_schematic_tells_all_that_is_there():
    shown = words(schematic(walker(64, 8e-4)))
    assert sorted(word for word in shown if word.isalpha()) == [
        "actuator", "design", "solid", "solid", "stick", "travel",
    ]  # fmt: skip
    assert "g = 10" in shown
    # 20c x 10c: along x 5c, 10c, 5c; along y 7c, 3c; with c = 1/64
    lengths = sorted(float(word) for word in shown if word.startswith("0."))
    assert np.allclose(lengths, sorted(k / 64 for k in (20, 10, 5, 10, 5, 7, 3)), rtol=1e-5)


@pytest.mark.parametrize(("friction", "said"), [(0.35, "friction 0.35"), ("stick", "stick")])
def test_a_schematic_tells_the_friction_of_ground_inside_it(friction, said):
    scene = walker_on_ground(64, 8e-4, 4.0)
    points = ((0.0, 3 / 64), (0.3, 3 / 64), (0.6, 1 / 64))
    for ground in (Ground.floor(3 / 64, friction), Ground(points, friction)):
        (axes,) = schematic(dataclasses.replace(scene, ground=(ground,))).axes
        (label,) = [text for text in axes.texts if text.get_text() == said]
        d, _ = ground.distance(np.array(label.get_position()))
        assert d < 0.0
        (left, right), (low, high) = axes.get_xlim(), axes.get_ylim()
        x, y = label.get_position()
        assert left < x < right and low < y < high
    below = dataclasses.replace(scene, ground=(Ground.floor(-1.0, friction),))
    assert said not in words(schematic(below))  # out of sight


def test_a_schematic_of_a_channel_shows_its_mirror_and_friction():
    figure = schematic(channel("x"))
    assert words(figure).count("friction 0.4") == 2
    assert not any(word.startswith("g =") for word in words(figure))
    (line,) = figure.axes[0].lines
    assert np.array_equal(line.get_xdata(), [0.5, 0.5])


def test_a_schematic_numbers_actuators_as_the_variables_are():
    shown = words(schematic(small_scene()))
    assert {"actuator 0", "actuator 1", "friction 0.3", "stick"} <= set(shown)


def test_notebooks_show_pictures_and_terminals_a_sentence(short_run):
    scene = small_scene()
    assert picture(scene._repr_png_()).std() > 10
    assert "16 x 16 cells 0.0625 wide, 40 steps of 0.004" in str(scene)
    assert "1 design, 2 actuator, 1 solid" in str(scene)
    assert "y > 0.25 (friction 0.3), x > 0.1875 (stick)" in str(scene)
    assert picture(short_run._repr_png_()).std() > 10
    assert repr(short_run) == str(short_run)
    assert str(short_run).startswith("Run of 2 evaluations, 0 failed: best L = ")
    assert "at stage 1 of 1, beta 4. Stage 1 of 1 was the last:" in str(short_run)


def test_an_optimisation_without_a_design_shows_no_picture():
    none = empty(small_scene(steps=10))
    assert repr(none) == "Run of 0 evaluations, 0 failed: no design yet. Not finished."
    assert none._repr_png_() is None


def test_a_run_that_failed_says_how():
    run = run_of(objective=[0.2, np.nan], failure=["", "step 3: it burst"])
    with pytest.raises(DesignError, match=r"no design: .* the last: step 3: it burst"):
        _ = run.result


def test_instants_of_a_tall_body_stand_in_one_row(tmp_path):
    c = 1 / 16
    body = (Design((6 * c, 2 * c), (9 * c, 12 * c)), Solid((6 * c, 12 * c), (9 * c, 14 * c)))
    tall = small_scene(body=body, walls=(), steps=3)
    problem = Problem(tall)
    plot.plot_motion(tmp_path / "a.png", optimised(problem, problem.join(1.0, [], [], [])), 4)
    height, width, _ = picture((tmp_path / "a.png").read_bytes()).shape
    assert height < width  # two rows would be three times as high as wide
