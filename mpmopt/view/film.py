"""Films of a run: its design, the design without grey and the reference design, side by side."""

from __future__ import annotations

import logging
import math
from collections.abc import Iterator, Sequence
from contextlib import closing
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import to_rgb
from numpy.typing import NDArray
from PIL import Image

from mpmopt.assess.forces import Books, books
from mpmopt.assess.robustness import SEEN, SETTLED, Robot, can_be_studied, lasting, unit
from mpmopt.assess.trajectory import (
    Body,
    Motion,
    equal_steps,
    moving,
    optimised,
    post_processed,
    reference,
)
from mpmopt.design.problem import Problem
from mpmopt.errors import DesignError, MissingLibraryError, StorageError
from mpmopt.io.files import replace_file
from mpmopt.io.progress import Progress
from mpmopt.optimisation.history import Optimisation
from mpmopt.scene import Scene
from mpmopt.view.draw import (
    BLUE,
    LAYER,
    RED,
    Arrows,
    Forces,
    Squares,
    draw_walls,
    format_of,
    new_figure,
    own_style,
    set_view,
    view,
)
from mpmopt.view.gait import body_of

logger = logging.getLogger(__name__)

RATE = 25  # frames per second: a whole number of GIF's hundredths of a second each
PERIOD = 1.25  # seconds that a film shows one period of the fastest actuator
SHORTEST, LONGEST = 4.0, 20.0  # seconds of a film, unless its length is asked for
LEAST = 8  # frames per period below which a gait is no longer seen
LAST = 1.0  # seconds for which the last frame stays
DPI = 100
BESIDE, ABOVE = 290, 560  # width in pixels of a panel beside others, and above others


def playing_time(scene: Scene, duration: float | None = None) -> float:
    """Seconds that a film of a scene takes, or of so much of it, so that its gait is seen."""
    return min(max(PERIOD * periods(scene, duration), SHORTEST), LONGEST)


def periods(scene: Scene, duration: float | None = None) -> float:
    """Periods of the fastest actuator within a scene's duration, or another."""
    fastest = max((actuator.angular_frequency for actuator in scene.actuators), default=0.0)
    return (scene.duration if duration is None else duration) * fastest / (2.0 * math.pi)


class Screen:
    """Bodies in motion, each in a panel of its own, drawn frame by frame.

    Parameters
    ----------
    motions : sequence of Motion
        At the same times.
    slow : float
        How many times slower they are shown, which the picture says.
    books : sequence of Books, optional
        Of the motions' bodies: arrows show what their supports push them with.

    Attributes
    ----------
    panels : list of matplotlib Axes
    """

    @own_style()
    def __init__(self, motions: Sequence[Motion], slow: float, books: Sequence[Books] = ()) -> None:
        self._motions, self._slow = motions, slow
        forces = Forces.of(motions, books) if books else None
        box = view(motions) if forces is None else forces.box
        self._longest = "" if forces is None else f"     longest arrow {forces.largest:.3g}"
        shape = float(np.divide(*(box[1] - box[0])[::-1]))
        columns, wide = (1, ABOVE) if shape < 0.75 else (len(motions), BESIDE)
        rows = len(motions) // columns
        label, head = 24, 30  # pixels above each panel and at the top
        tall = min(shape * (wide - 12), 1.5 * ABOVE) + label
        width = columns * wide
        height = round(rows * tall + head + 6)
        hair = 1e-6 / DPI  # so that no pixel is lost where matplotlib rounds down
        figure = new_figure(width / DPI + hair, height / DPI + hair)
        figure.set_layout_engine("none")
        figure.set_dpi(DPI)
        self.panels = []
        self._squares, self._labels = [], []
        self._arrows: list[Arrows] = []
        for number, motion in enumerate(motions):
            row, column = divmod(number, columns)
            left, top = column * wide + 6, head + row * tall + label
            axes = figure.add_axes((
                left / width, 1.0 - (top + tall - label) / height,
                (wide - 12) / width, (tall - label) / height,
            ))  # fmt: skip
            axes.set_xticks([])
            axes.set_yticks([])
            set_view(axes, box)
            draw_walls(axes, motion.scene, moving=True)
            squares = Squares(motion)
            squares.set_animated(True)
            axes.add_collection(squares, autolim=False)
            if forces is not None:
                arrows = Arrows(axes, *forces.values[number], forces.scale)
                for patch in arrows.patches:
                    patch.set_animated(True)
                self._arrows.append(arrows)
            self.panels.append(axes)
            self._squares.append(squares)
            self._labels.append(
                axes.annotate(
                    "", (0.0, 1.0), xytext=(0, 4), xycoords="axes fraction",
                    textcoords="offset points", animated=True, fontsize=8,
                )
            )  # fmt: skip
        self._clock = figure.text(
            6 / width, 1.0 - 8 / height, "", va="top", fontsize=10, animated=True, weight="bold"
        )
        self._figure = figure
        self._canvas = FigureCanvasAgg(figure)
        self._canvas.draw()
        self._empty = self._canvas.copy_from_bbox(figure.bbox)

    @property
    def frames(self) -> int:
        """Number of frames."""
        return len(self._motions[0].frames)

    @own_style()
    def frame(self, number: int) -> NDArray[np.uint8]:
        """One frame as colours (height, width, 3), from the top."""
        first = self._motions[0]
        times = first.frames * first.scene.time_step
        self._clock.set_text(
            f"t = {times[number]:{format_of(times)}}     {self._slow:.3g} times slower"
            f"{self._longest}"
        )
        form = format_of([motion.objective for motion in self._motions])
        self._canvas.restore_region(self._empty)
        self._figure.draw_artist(self._clock)
        for motion, axes, squares, label in zip(
            self._motions, self.panels, self._squares, self._labels
        ):
            squares.show(number)
            label.set_text(f"{motion.name}: L = {motion.objective[number]:{form}}")
            axes.draw_artist(squares)
            axes.draw_artist(label)
        for axes, arrows in zip(self.panels, self._arrows):
            arrows.show(number)
            for patch in arrows.patches:
                axes.draw_artist(patch)
        return np.array(self._canvas.buffer_rgba())[..., :3]


@dataclass(frozen=True)
class Filmed:
    """What a film shows.

    Attributes
    ----------
    frames : int
    seconds : float
        That it plays.
    slow : float
        How many times slower than the simulated time.
    per_period : float
        Frames in one period of the fastest actuator; 0 if there is none.
    bytes : int
    time : str
        Which simulated times those are.
    """

    frames: int
    seconds: float
    slow: float
    per_period: float
    bytes: int
    time: str = ""

    def __str__(self) -> str:
        gait = f", {self.per_period:.0f} frames per period of the actuation"
        return (
            f"{self.frames} frames, {self.seconds:.1f} s, {self.slow:.3g} times slower"
            f"{gait if self.per_period else ''}, {self.bytes / 1e6:.3g} MB"
            f"{self.time and f'; t = {self.time}'}"
        )


def film(
    path: Path,
    run: Optimisation,
    seconds: float | None = None,
    forces: bool = False,
    finished: bool = False,
) -> Filmed:
    """Write a film of a run's best design, the same without grey, and the solid reference design.

    All have the best design's actuation. A body that cannot be simulated is left out.

    Or of the finished robot alone, in the time that its speed is of (`robustness.speed`).

    Parameters
    ----------
    path : Path
        Ending in ``.gif``, or in ``.mp4``, which needs imageio-ffmpeg (``mpmopt[film]``).
    run : Optimisation
    seconds : float, optional
        That the film plays; default: as long as it takes to see each period of the actuation.
    forces : bool, optional
        Draw what ground and walls push the bodies with, which takes a few seconds more.
    finished : bool, optional
        Film the finished robot.

    Raises
    ------
    DesignError
        If the run has no design, `path` has another ending, `seconds` makes no sense, or there is
        no speed to film: no actuator or no ground.
    MissingLibraryError
        If a library for the format is not installed.
    SimulationError
        If the best design cannot be simulated.
    StorageError
        If the file cannot be written.
    """
    problem, x = run.problem(), run.result.x
    scene, begin = problem.scene, 0.0
    if finished:
        if not can_be_studied(scene):
            raise DesignError(
                "film: the scene has no actuator or no ground, so there is no speed to film; leave "
                "--finished (finished=True) out"
            )
        begin, end = (time * unit(scene) for time in (SETTLED, SEEN))
        scene = lasting(scene, end)
    duration = scene.duration - begin
    if seconds is None:
        seconds = playing_time(scene, duration)
    path = Path(path)
    count = count_frames(path, seconds)

    def frames_of(scene: Scene) -> NDArray[np.int64]:
        return equal_steps(scene, count, round(begin / scene.time_step))

    def robot(problem: Problem, x: NDArray[np.float64]) -> Body:
        return body_of(Robot.of(problem, x), lasting(problem.scene, begin + duration))

    makes = (robot,) if finished else (optimised, post_processed, reference)
    bodies, motions = map(list, zip(*moving(problem, x, makes, frames_of)))
    slow = seconds / duration
    screen = Screen(motions, slow, [books(body.simulation) for body in bodies] if forces else ())
    size = write(path, screen)
    shown = periods(scene, duration)
    per_period = count / shown if shown else 0.0
    if 0.0 < per_period < LEAST:
        logger.warning(
            "the film has %.1f frames per period of the actuation; with %.2g seconds it has %d",
            per_period, LEAST * shown / RATE, LEAST,
        )  # fmt: skip
    spans = f"{begin:g} to {begin + duration:g}"
    if can_be_studied(scene) and not finished:
        one = unit(problem.scene)
        spans += f"; the speed is that of {SETTLED * one:g} to {SEEN * one:g} (film --finished)"
    return Filmed(count, seconds + LAST, slow, per_period, size, spans)


def palette() -> Image.Image:
    """Those of films: greys, red and blue from black over themselves to white, and the layer's."""
    colours = [np.repeat(np.linspace(0.0, 1.0, 32)[:, None], 3, axis=1), np.array([to_rgb(LAYER)])]
    for tint in (np.array(RED), np.array(BLUE)):
        share = np.linspace(0.0, 1.0, 17)[1:, None]
        colours += [share * tint, share[:-1] + (1.0 - share[:-1]) * tint]
    image = Image.new("P", (1, 1))
    image.putpalette(np.rint(255.0 * np.concatenate(colours)).astype(np.uint8).tobytes())
    return image


def _gif(frames: Iterator[NDArray[np.uint8]]) -> bytes:
    colours = palette()
    images = [
        Image.fromarray(frame).quantize(palette=colours, dither=Image.Dither.NONE)
        for frame in frames
    ]
    durations = [1000 // RATE] * (len(images) - 1) + [1000 // RATE + round(1000 * LAST)]
    content = BytesIO()
    images[0].save(
        content, format="GIF", save_all=True, append_images=images[1:], duration=durations, loop=0,
        optimize=True,
    )  # fmt: skip
    return content.getvalue()


def _ffmpeg() -> Any:
    """The package that brings ffmpeg."""
    try:
        import imageio_ffmpeg

        imageio_ffmpeg.get_ffmpeg_exe()
    except (ImportError, RuntimeError) as error:
        raise MissingLibraryError(
            f"MP4 needs imageio-ffmpeg and its ffmpeg ({error}): pip install 'mpmopt[film]', or "
            "write a GIF"
        ) from error
    return imageio_ffmpeg


def _mp4(frames: Iterator[NDArray[np.uint8]]) -> bytes:
    """H.264, by way of a file of ffmpeg's own, because it must go back in it."""
    frame = next(frames)
    height, width, _ = frame.shape
    with TemporaryDirectory() as folder:
        path = Path(folder) / "film.mp4"
        writer = _ffmpeg().write_frames(
            str(path),
            (width, height),
            fps=RATE,
            codec="libx264",
            quality=None,
            macro_block_size=1,
            ffmpeg_log_level="error",
            # Sizes that yuv420p can have.
            output_params=[
                "-crf", "20", "-vf", "pad=ceil(iw/2)*2:ceil(ih/2)*2:color=white",
                "-movflags", "+faststart",
            ],
        )  # fmt: skip
        try:
            with closing(writer):
                writer.send(None)
                writer.send(frame.tobytes())
                for frame in frames:
                    writer.send(frame.tobytes())
                for _ in range(round(LAST * RATE)):
                    writer.send(frame.tobytes())
            content = path.read_bytes()
        except OSError as error:
            raise StorageError(f"ffmpeg failed: {str(error).splitlines()[0]}") from error
    if b"moov" not in content:  # its tables, which come last
        raise StorageError("ffmpeg wrote no whole film; make room for temporary files")
    return content


WRITERS = {".gif": _gif, ".mp4": _mp4}


def count_frames(path: Path, seconds: float) -> int:
    """Number of frames of a film that plays for so long.

    Raises
    ------
    DesignError, MissingLibraryError
        As `film`.
    """
    if path.suffix.lower() not in WRITERS:
        raise DesignError(f"{path} ends in {path.suffix!r}, a film in one of {sorted(WRITERS)}")
    if path.suffix.lower() == ".mp4":
        _ffmpeg()
    count = round(seconds * RATE) if 0.0 < seconds <= 600.0 else 0
    if count < 2:
        raise DesignError(f"film: seconds = {seconds!r} must be from {2 / RATE:g} to 600")
    return count


def write(path: Path, screen: Screen) -> int:
    """Write a screen's frames as a film of the kind that the path's ending names; its bytes.

    Raises
    ------
    StorageError
        As `film`.
    """
    with Progress("frames", screen.frames) as progress:

        def frames() -> Iterator[NDArray[np.uint8]]:
            for number in range(screen.frames):
                yield screen.frame(number)
                progress.step()

        content = WRITERS[path.suffix.lower()](frames())
    replace_file(path, content)
    return len(content)
