"""Films: whole or absent, with the frames that were asked for, of bodies that move."""

import dataclasses
import os
import re
import resource
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from conftest import empty, small_scene
from PIL import Image
from test_mirror import channel

from mpmopt.__main__ import main
from mpmopt.assess.trajectory import (
    Motion,
    equal_steps,
    moving,
    optimised,
    post_processed,
    reference,
)
from mpmopt.design.problem import Problem
from mpmopt.errors import (
    DesignError,
    MissingLibraryError,
    SimulationError,
    StorageError,
)
from mpmopt.io.console import Interrupted
from mpmopt.optimisation.loop import optimise
from mpmopt.optimisation.settings import Settings, Stage
from mpmopt.results import runfile
from mpmopt.scene import Grid, Ground, Solid
from mpmopt.view import film as films
from mpmopt.view import plot
from mpmopt.view.film import LAST, RATE, Screen, _mp4, film, playing_time

ROOT = Path(__file__).parent.parent
C = 1 / 16
SHORT_ON_GROUND = Settings(
    (Stage(4.0, time_step=2e-3),), window=1, least_iterations=1, most_iterations=1
)


def motions(run, count):
    problem, x = run.problem(), run.result.x
    return [
        Motion.of(body(problem, x), equal_steps(problem.scene, count))
        for body in (optimised, post_processed, reference)
    ]


def gif(path):
    """All frames of a GIF, and their durations in seconds."""
    with Image.open(path) as image:
        frames, durations = [], []
        for number in range(image.n_frames):
            image.seek(number)
            frames.append(np.array(image.convert("RGB"), dtype=int))
            durations.append(image.info["duration"] / 1000.0)
    return np.array(frames), np.array(durations)


def test_a_gif_has_the_frames_that_were_asked_for_and_they_are_the_screens(short_run, tmp_path):
    told = film(tmp_path / "film.gif", short_run, seconds=1.0)
    frames, durations = gif(tmp_path / "film.gif")
    assert told.frames == len(frames) == RATE
    assert durations[:-1] == pytest.approx(1.0 / RATE)
    assert durations.sum() == pytest.approx(1.0 + LAST) == told.seconds
    assert told.bytes == (tmp_path / "film.gif").stat().st_size
    assert told.slow == pytest.approx(1.0 / short_run.scene.duration)
    screen = Screen(motions(short_run, RATE), told.slow)
    for number in (0, 7, RATE - 1):
        difference = np.abs(frames[number] - screen.frame(number).astype(int))
        assert difference.max() <= 64  # the palette, where red meets grey
        assert difference.mean() <= 2.0


def test_a_film_with_forces_has_arrows(short_run, tmp_path):
    for name, forces in (("plain.gif", False), ("forces.gif", True)):
        film(tmp_path / name, short_run, seconds=0.2, forces=forces)
    plain, pushed = (gif(tmp_path / name)[0] for name in ("plain.gif", "forces.gif"))
    assert len(plain) == len(pushed) == 5
    shown = Screen(motions(short_run, 5), 1.0).frame(0).shape
    assert plain[0].shape == shown
    assert pushed[0].shape != shown or np.abs(plain - pushed).max() > 100


def test_a_film_of_the_finished_robot_shows_the_seconds_that_its_speed_is_of(tmp_path, capsys):
    scene = small_scene(
        walls=(), ground=(Ground.floor(3 * C, thickness=C),), steps=20, time_step=2e-3,
        transient=0.01,
    )  # fmt: skip
    path = tmp_path / "run.h5"
    runfile.write(path, optimise(scene, SHORT_ON_GROUND, Problem(scene).join(1.0, 0.3, 0.0, 0.0)))
    assert main(["film", str(path), "--finished", "--seconds", "0.4"]) == 0
    assert capsys.readouterr().out.rstrip().endswith("; t = 0.02 to 0.08")
    frames, _ = gif(tmp_path / "finished.gif")
    assert len(frames) == 10
    assert np.abs(frames[0] - frames[-1]).max() > 100  # it moves
    assert main(["film", str(path), "--seconds", "0.2"]) == 0
    said = capsys.readouterr().out
    assert "t = 0 to 0.04; the speed is that of 0.02 to 0.08 (film --finished)" in said


def test_a_scene_without_ground_has_no_finished_robot_to_film(short_path, tmp_path, capsys):
    assert main(["film", str(short_path), "--finished", "--out", str(tmp_path / "a.gif")]) == 1
    said = " ".join(capsys.readouterr().err.split())
    assert "no actuator or no ground, so there is no speed to film; leave --finished" in said


def test_bodies_are_where_their_particles_are_and_move(short_run):
    shown = motions(short_run, 5)
    screen = Screen(shown, 1.0)
    pictures = [screen.frame(number) for number in range(5)]
    height = len(pictures[0])
    for panel, motion in zip(screen.panels, shown):
        problem, x = short_run.problem(), short_run.result.x
        body = {"o": optimised, "p": post_processed, "s": reference}[motion.name[0]](problem, x)
        solid = (body.gamma >= 0.9) & (body.simulation.particles.actuator < 0)
        assert solid.sum() >= 4
        for number, step in enumerate(motion.frames):
            state = body.simulation.run([int(step)])[0]  # told without the motion
            places = panel.transData.transform(state[0:2].T)
            x, y = np.floor(places[solid]).astype(int).T
            assert np.all(pictures[number][height - 1 - y, x] <= 60)
            right = places[:, 0].max()
            edge = panel.get_window_extent()
            middle = height - 1 - int(places[:, 1].mean())
            row = pictures[number][middle, int(right) + 14 : int(edge.x1) - 2]
            assert row.size and np.all(row == 255)  # nothing ahead of the body
        assert np.abs(np.diff([picture.astype(int) for picture in pictures], axis=0)).max() > 200


def test_both_halves_of_a_symmetric_scene_are_shown():
    scene = channel("y", steps=20)
    problem = Problem(scene, 4.0)
    x = problem.join(np.linspace(-1.0, 1.0, 24), 1.0, -0.3, -0.5)
    body = optimised(problem, x)
    motion = Motion.of(body, [0, 20])
    assert len(motion.gamma) == 2 * len(body.gamma)
    screen = Screen([motion], 1.0)
    (panel,) = screen.panels
    picture = screen.frame(1)[..., 0].astype(int)
    assert scene.mirror is not None
    axis = panel.transData.transform((0.0, scene.mirror.position))[1]
    box = panel.get_window_extent()
    above = [round(axis + 0.5 + k) for k in range(int(box.height / 2) - 3)]
    below = [round(axis - 0.5 - k) for k in range(int(box.height / 2) - 3)]
    columns = slice(int(box.x0) + 2, int(box.x1) - 2)
    upper, lower = (picture[len(picture) - 1 - np.array(rows), columns] for rows in (above, below))
    inside = slice(0, int(box.height / 2 * 0.5))  # hatches are not symmetric
    assert (upper[inside] < 128).mean() >= 0.1
    assert (abs(upper[inside] - lower[inside]) > 128).mean() <= 0.02


def test_a_film_is_long_enough_to_see_each_period():
    scene = small_scene(steps=400)  # 1.6, fastest actuator: 50
    periods = 1.6 * 50.0 / (2.0 * np.pi)
    assert playing_time(scene) == pytest.approx(1.25 * periods)
    assert playing_time(small_scene(steps=1)) == 4.0
    assert playing_time(small_scene(steps=4000)) == 20.0


def test_too_few_frames_for_the_gait_are_told(short_run, tmp_path, caplog):
    told = film(tmp_path / "film.gif", short_run, seconds=0.2)
    assert told.frames == 5
    assert told.per_period == pytest.approx(5 / (0.16 * 50.0 / (2.0 * np.pi)))
    assert "frames per period" in caplog.text


def mp4(path):
    """All frames of an MP4."""
    import imageio_ffmpeg

    decoded = subprocess.run(
        [imageio_ffmpeg.get_ffmpeg_exe(), "-i", path, "-f", "rawvideo", "-pix_fmt", "rgb24", "-"],
        capture_output=True, check=True,
    )  # fmt: skip
    facts = decoded.stderr.decode()
    assert "Video: h264" in facts and f"{RATE} fps" in facts
    width, height = map(int, re.findall(r", (\d+)x(\d+)[ ,]", facts)[0])
    return np.frombuffer(decoded.stdout, np.uint8).reshape(-1, height, width, 3).astype(int)


@pytest.mark.process
def test_mp4_has_the_frames_of_the_gif(short_run, tmp_path):
    told = film(tmp_path / "film.mp4", short_run, seconds=0.4)
    frames = mp4(tmp_path / "film.mp4")
    assert (told.frames, len(frames)) == (10, 10 + RATE)  # the last one stays for a second
    screen = Screen(motions(short_run, 10), 0.4 / 0.16)
    for number in (0, 5, 9):
        wanted = screen.frame(number)
        height, width, _ = wanted.shape
        assert np.abs(frames[number, :height, :width] - wanted).mean() <= 4.0


@pytest.mark.process
@pytest.mark.parametrize(("height", "width"), [(33, 47), (33, 48), (34, 47), (34, 48)])
def test_mp4_can_have_any_size(tmp_path, height, width):
    """Matplotlib rounds sizes of figures in one way or another; H.264 needs even ones."""
    frame = np.full((height, width, 3), 100, np.uint8)
    (tmp_path / "film.mp4").write_bytes(_mp4(iter([frame, frame])))
    frames = mp4(tmp_path / "film.mp4")
    assert frames.shape == (2 + RATE, 34, 48, 3)
    assert frames[:, : height - 1, : width - 1] == pytest.approx(100, abs=4)
    assert np.all(frames[:, height:] >= 200) and np.all(frames[:, :, width:] >= 200)


def test_times_and_lengths_of_a_small_and_fast_robot_can_be_read():
    """A robot of 5 mm in metres, in motion for 10 ms."""
    c = 1 / 1024
    scene = small_scene(
        grid=Grid((16, 16), c), time_step=1e-4, steps=100, gravity=(0.0, -1.0), walls=(),
        body=(Solid((4 * c, 6 * c), (9 * c, 8 * c)),),
    )  # fmt: skip
    motion = Motion.of(optimised(Problem(scene), np.empty(0)), [0, 30, 100])
    motion = dataclasses.replace(motion, objective=np.array([0.0063476, 0.0064771, 0.0074123]))
    screen = Screen([motion], 1.0)
    (panel,) = screen.panels
    shown = []
    for number in range(3):
        screen.frame(number)
        (clock,), (label,) = panel.figure.texts, panel.texts
        shown.append((clock.get_text().split()[2], label.get_text().split()[-1]))
    assert shown == [("0.0000", "0.00635"), ("0.0030", "0.00648"), ("0.0100", "0.00741")]


def test_mp4_without_its_library_says_what_to_install(short_run, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "imageio_ffmpeg", None)
    with pytest.raises(MissingLibraryError, match=r"pip install 'mpmopt\[film\]'"):
        film(tmp_path / "film.mp4", short_run)
    assert not list(tmp_path.iterdir())


@pytest.mark.process
@pytest.mark.parametrize("name", ["false", "true", "no-such-program"])
@pytest.mark.filterwarnings("ignore::ResourceWarning")  # the library leaves its pipe open then
@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
def test_an_encoder_that_fails_leaves_nothing(short_run, tmp_path, monkeypatch, name):
    monkeypatch.setenv("IMAGEIO_FFMPEG_EXE", name)
    with pytest.raises(StorageError, match="ffmpeg"):
        film(tmp_path / "film.mp4", short_run, seconds=0.4)
    assert not list(tmp_path.iterdir())


def bursts(problem, x):
    raise SimulationError("it burst", 3, -1, (np.nan, np.nan), "take another")


def test_a_body_that_needs_a_shorter_step_moves_in_half_of_it(short_run):
    problem, x = short_run.problem(), short_run.result.x
    step = problem.scene.time_step

    def needs_half(there, x):
        return optimised(there, x) if there.scene.time_step < 0.6 * step else bursts(there, x)

    makes = optimised, bursts, needs_half
    (_, whole), (body, half) = moving(problem, x, makes, lambda scene: equal_steps(scene, 5))
    assert body.simulation.scene.time_step == half.scene.time_step == step / 2.0
    assert half.frames * half.scene.time_step == pytest.approx(whole.frames * step, abs=step)
    assert half.frames[-1] == half.scene.steps == 2 * problem.scene.steps
    assert half.objective[-1] == pytest.approx(whole.objective[-1], rel=1e-2)


def test_a_body_that_cannot_be_simulated_is_left_out(short_run, tmp_path, monkeypatch, caplog):
    film(tmp_path / "three.gif", short_run, seconds=0.4)
    monkeypatch.setattr(films, "post_processed", bursts)
    film(tmp_path / "two.gif", short_run, seconds=0.4)
    assert "it burst" in caplog.text
    three, two = (gif(tmp_path / f"{name}.gif")[0].shape for name in ("three", "two"))
    assert 3 * two[2] == 2 * three[2]  # beside each other
    monkeypatch.setattr(films, "optimised", bursts)  # as a design does whose void bursts
    film(tmp_path / "one.gif", short_run, seconds=0.4)
    monkeypatch.setattr(films, "reference", bursts)
    with pytest.raises(SimulationError, match="it burst"):
        film(tmp_path / "none.gif", short_run, seconds=0.4)
    assert {file.name for file in tmp_path.iterdir()} == {"three.gif", "two.gif", "one.gif"}


@pytest.mark.parametrize("name", ["film.avi", "film"])
def test_another_ending_is_refused(short_run, tmp_path, name):
    with pytest.raises(DesignError, match="ends in"):
        film(tmp_path / name, short_run)


def test_an_option_and_a_name_that_disagree_are_refused(short_path, tmp_path, capsys):
    target = tmp_path / "walker.gif"
    assert main(["film", str(short_path), "--mp4", "--out", str(target)]) == 1
    assert capsys.readouterr().err.startswith(f"DesignError: --mp4 does not write {target}")
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("seconds", [0.0, -1.0, 0.05, float("nan"), float("inf"), 1e9])
def test_a_length_that_makes_no_sense_is_refused(short_run, tmp_path, seconds):
    with pytest.raises(DesignError, match="seconds"):
        film(tmp_path / "film.gif", short_run, seconds)
    assert not list(tmp_path.iterdir())


@pytest.mark.skipif(not hasattr(resource, "RLIMIT_FSIZE"), reason="needs a file-size limit")
def test_a_full_disk_leaves_an_older_film_as_it_was(short_run, tmp_path):
    target = tmp_path / "film.gif"
    target.write_text("an older film")
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (20_000, before[1]))
    try:
        with pytest.raises(StorageError, match="make room"):
            film(target, short_run, seconds=1.0)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    assert [file.name for file in tmp_path.iterdir()] == [target.name]
    assert target.read_text() == "an older film"


@pytest.mark.process
@pytest.mark.parametrize("ending", ["gif", "mp4"])
def test_an_interrupt_leaves_an_older_film_as_it_was(short_path, tmp_path, monkeypatch, ending):
    target = tmp_path / f"film.{ending}"
    target.write_text("an older film")
    frame = Screen.frame

    def interrupted(self, number):
        if number == 3:
            raise Interrupted(signal.SIGINT)
        return frame(self, number)

    monkeypatch.setattr(Screen, "frame", interrupted)
    options = ["--seconds", "0.4", "--out", str(target), "--force"]
    assert main(["film", str(short_path), *options]) == 130
    assert [file.name for file in tmp_path.iterdir()] == [target.name]
    assert target.read_text() == "an older film"


def test_the_command_says_what_it_made(short_path, tmp_path, capsys):
    target = tmp_path / "new" / "walker.gif"
    assert main(["film", str(short_path), "--seconds", "0.4", "--out", str(target)]) == 0
    printed = capsys.readouterr()
    assert printed.out.startswith(f"{target}: 10 frames, 1.4 s, 2.5 times slower")
    assert "10 of 10 frames" in printed.err
    assert main(["film", str(short_path), "--out", str(tmp_path / "film.avi")]) == 1
    assert capsys.readouterr().err.startswith("DesignError: ")


def test_a_design_whose_void_bursts_has_its_picture_without_grey(
    short_run, tmp_path, caplog, monkeypatch
):
    """Measured: in the task's plain scene, which no scene of its ensemble was, a walker's did."""
    monkeypatch.setattr(plot, "optimised", bursts)
    plot.PICTURES["design"](tmp_path / "design.png", short_run)
    plot.PICTURES["post_processed"](tmp_path / "bare.png", short_run)
    assert (tmp_path / "design.png").read_bytes() == (tmp_path / "bare.png").read_bytes()
    assert "a body is left out: " in caplog.text


def test_a_run_without_a_design_has_no_film(tmp_path):
    scene = small_scene()
    runfile.write(tmp_path / "run.h5", empty(scene))
    with pytest.raises(DesignError, match="no evaluation succeeded yet"):
        film(tmp_path / "film.gif", runfile.read_run(tmp_path / "run.h5").run)
    assert main(["film", str(tmp_path / "run.h5")]) == 1
    assert [file.name for file in tmp_path.iterdir()] == ["run.h5"]


@pytest.mark.slow
def test_an_interrupt_ends_a_long_film_at_once(short_path, tmp_path):
    process = subprocess.Popen(
        [sys.executable, "-m", "mpmopt", "film", short_path, "--seconds", "60",
         "--out", tmp_path / "film.gif"],
        stderr=subprocess.PIPE, text=True, env={**os.environ, "PYTHONPATH": str(ROOT)},
    )  # fmt: skip
    assert process.stderr is not None
    assert "of 1500 frames" in process.stderr.readline()
    process.send_signal(signal.SIGINT)
    _, said = process.communicate(timeout=30)
    assert process.returncode == 130
    assert said.splitlines()[-1] == "stopped by SIGINT. Files are complete or absent."
    assert not list(tmp_path.iterdir())
