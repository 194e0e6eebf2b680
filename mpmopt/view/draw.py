"""What pictures and films are made of: figures without a screen, walls, bodies, histories."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from io import BytesIO
from typing import Any

import numpy as np
from matplotlib import rc_context, rcdefaults
from matplotlib.axes import Axes
from matplotlib.backend_bases import RendererBase
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import Collection, PolyCollection
from matplotlib.figure import Figure
from matplotlib.patches import FancyArrowPatch, Polygon, Rectangle
from matplotlib.path import Path as Outline
from matplotlib.transforms import Affine2D
from numpy.typing import ArrayLike, NDArray

from mpmopt.assess.forces import Books
from mpmopt.assess.trajectory import Motion, optimised
from mpmopt.design.problem import Problem
from mpmopt.optimisation.history import Optimisation
from mpmopt.scene import Ground, Scene

RED, BLUE = (0.85, 0.1, 0.1), (0.1, 0.25, 0.85)
# Particles are drawn so much wider than they are that no light shows between neighbours.
OVERLAP = 1.15
# Particles with less material than this are not drawn.
FAINTEST = 0.02
# The longest arrow, over the longer side of the picture.
LONGEST = 0.15
# What is rigid, and the ground's outline, of which small steps shall be seen.
SOLID: dict[str, Any] = {"facecolor": "0.88", "edgecolor": "0.6", "hatch": "//", "lw": 0.8}
OUTLINE: dict[str, Any] = {"fill": False, "edgecolor": "0.1", "lw": 1.3}
# Where the ground's layer bears: feet go in it, above the ground.
LAYER = "#f3e8c8"


@contextmanager
def own_style() -> Iterator[None]:
    """Draw with matplotlib's defaults, whatever the settings outside are.

    A figure is made and saved within this: some settings count when a part is made, others when it
    is drawn. Also a decorator: ``@own_style()``.
    """
    with rc_context():
        rcdefaults()
        yield


def new_figure(width: float, height: float) -> Figure:
    """An empty figure, in inches."""
    figure = Figure(figsize=(width, height), layout="tight")
    FigureCanvasAgg(figure)
    return figure


@own_style()
def png(figure: Figure, dpi: int = 120) -> bytes:
    """A figure as the content of a PNG file."""
    content = BytesIO()
    figure.savefig(content, format="png", dpi=dpi)
    return content.getvalue()


def format_of(values: ArrayLike) -> str:
    """A format for numbers of any unit that tells them apart: three digits of their range.

    Times from 0 to 0.16 have three digits after the point, lengths around 2e-6 an exponent. Numbers
    that hardly differ have six digits.
    """
    there = np.asarray(values, dtype=float)
    there = there[np.isfinite(there)]
    largest = np.abs(there).max(initial=0.0)
    if largest == 0.0:
        return ".3g"
    before = math.floor(math.log10(largest))
    after = 2 - math.floor(math.log10(max(np.ptp(there), 1e-3 * largest)))
    return f".{max(after, 0)}f" if after <= 6 and before <= 6 else f".{before + after + 1}g"


def draw_walls(axes: Axes, scene: Scene, moving: bool = False) -> None:
    """Draw walls, ground with its layer, and clamps with their ways, as far as the axes reach now.

    Parameters
    ----------
    axes : matplotlib Axes
    scene : Scene
    moving : bool, optional
        Draw walls where bodies rest on them in motion, not where they begin to act: the centres of
        the lowest particles come to rest there, and the squares reach half their width further.
    """
    deeper = 0.5 * scene.grid.dx / scene.particles_per_cell if moving else 0.0
    (left, right), (low, high) = axes.get_xlim(), axes.get_ylim()
    for wall in scene.walls:
        place = wall.position + (-deeper if wall.solid_side == "below" else deeper)
        first, last = (left, right) if wall.axis == "x" else (low, high)
        start, end = (first, place) if wall.solid_side == "below" else (place, last)
        if not start < end:
            continue
        corner, width, height = (
            ((start, low), end - start, high - low)
            if wall.axis == "x"
            else ((left, start), right - left, end - start)
        )
        axes.add_patch(Rectangle(corner, width, height, **SOLID))
    reach = 4.0 * (right - left + high - low)
    draw_layers(axes, scene, reach)
    for ground in scene.ground:
        for style in (SOLID, OUTLINE):
            axes.add_patch(Polygon(ground_outline(ground, reach), **style))
    for clamp in scene.clamps:
        width, height = np.subtract(clamp.upper, clamp.lower)
        axes.add_patch(Rectangle(clamp.lower, width, height, fill=False, edgecolor="C1", ls="--"))
        way = np.array([d for _, d in clamp.path]).reshape(-1, 2)
        axes.plot(*(way + np.add(clamp.lower, clamp.upper) / 2.0).T, color="C1", lw=0.8)


def draw_layers(axes: Axes, scene: Scene, reach: float) -> None:
    """Shade where the layers of ground bear, as thick as they are on both sides of its points."""
    angles = np.linspace(0.0, 2.0 * np.pi, 48)
    for ground, layer in zip(scene.ground, scene.layers, strict=True):
        disc = layer.thickness * np.array([np.cos(angles), np.sin(angles)]).T
        way = ground_outline(ground, reach)[: len(ground.points) + 2]
        along = np.diff(way, axis=0)
        across = layer.thickness * along[:, ::-1] / np.hypot(*along.T)[:, None] * (-1.0, 1.0)
        first, last = way[:-1], way[1:]
        bands = np.stack([first + across, last + across, last - across, first - across], axis=1)
        corners = [*bands, *(way[1:-1, None] + disc)]
        axes.add_collection(PolyCollection(corners, facecolor=LAYER, lw=0.0), autolim=False)


def ground_outline(ground: Ground, reach: float) -> NDArray[np.float64]:
    """Corners (n, 2) of the ground's solid, as far as it reaches around its points."""
    line, points = ground.line, np.array(ground.points)
    middle = points.mean(axis=0)
    reach += float(np.hypot(*(points - middle).T).max())
    ends = points[0] - reach * line.along[0], points[-1] + reach * line.along[-1]
    # Back from the last end to the first, clockwise: on the way's right-hand side.
    last, first = (float(np.arctan2(*(end - middle)[::-1])) for end in ends[::-1])
    turn = (last - first) % (2.0 * np.pi)
    angles = last - np.linspace(0.0, turn, 18)[1:-1]
    around = middle + 2.0 * reach * np.stack([np.cos(angles), np.sin(angles)], axis=1)
    return np.concatenate([ends[:1], points, ends[1:], around])


class Squares(Collection):
    """Particles as the deformed squares that they stand for.

    Grey is gamma, red a positive and blue a negative signal. Those with more material are drawn
    above those with less.

    Parameters
    ----------
    motion : Motion
    frame : int, optional
        Index of the instant that is shown at first.
    """

    def __init__(self, motion: Motion, frame: int = 0) -> None:
        super().__init__(linewidths=0.0)
        half = 0.5 * OVERLAP * motion.spacing
        corners = [(-half, -half), (half, -half), (half, half), (-half, half)]
        self.set_paths([Outline([*corners, corners[0]], closed=True)])
        self._motion = motion
        drawn = np.flatnonzero(motion.gamma >= FAINTEST)
        self._order = drawn[np.argsort(motion.gamma[drawn], kind="stable")]
        self._gamma = np.clip(motion.gamma[self._order], 0.0, 1.0)[:, None]
        self._linear = np.zeros((len(self._order), 3, 3))
        self._linear[:, 2, 2] = 1.0
        self.show(frame)

    def show(self, frame: int) -> None:
        """Show another instant, given by its index."""
        motion, order = self._motion, self._order
        self._linear[:, :2, :2] = motion.deformation[frame][:, order].T.reshape(-1, 2, 2)
        self.set_offsets(motion.position[frame][:, order].T)
        actuation = motion.actuation[frame][order, None]
        strength = np.clip(np.abs(actuation), 0.0, 1.0)
        tint = np.where(actuation > 0.0, RED, BLUE)
        self.set_facecolor(1.0 - self._gamma * (1.0 - strength * tint))
        self.stale = True

    def get_transforms(self) -> Any:
        """One for each particle: its deformation gradient."""
        return self._linear

    def draw(self, renderer: RendererBase) -> None:
        """Draw with the axes' scale; `offsets` place the particles."""
        assert self.axes is not None
        scale = self.axes.transData.get_affine().get_matrix().copy()
        scale[:2, 2] = 0.0
        self.set_transform(Affine2D(scale))
        self.set_offset_transform(self.axes.transData)
        super().draw(renderer)


class Arrows:
    """Forces of supports on a body, as arrows that end where each acts.

    Parameters
    ----------
    axes : matplotlib Axes
    force, place : (F, P, 2) arrays
        Of P supports at F instants; a place that is not a number has no arrow.
    scale : float
        Length of an arrow over its force.
    frame : int, optional
        Index of the instant that is shown at first.
    """

    def __init__(
        self,
        axes: Axes,
        force: NDArray[np.float64],
        place: NDArray[np.float64],
        scale: float,
        frame: int = 0,
    ) -> None:
        self._tip, self._tail = place, place - scale * force
        style: dict[str, Any] = {"arrowstyle": "-|>", "mutation_scale": 9, "lw": 1.4}
        style |= {"shrinkA": 0.0, "shrinkB": 0.0, "zorder": 5, "color": "black"}
        self.patches = [FancyArrowPatch((0.0, 0.0), (1.0, 1.0), **style) for _ in force[0]]
        for patch in self.patches:
            axes.add_patch(patch)
        self.show(frame)

    def show(self, frame: int) -> None:
        """Show another instant, given by its index."""
        for patch, tail, tip in zip(self.patches, self._tail[frame], self._tip[frame]):
            there = bool(np.isfinite(tip).all() and (tail != tip).any())
            patch.set_visible(there)
            if there:
                patch.set_positions(tuple(tail), tuple(tip))


@dataclass(frozen=True)
class Forces:
    """Forces and places (F, P, 2) of each of several motions, drawn to one scale.

    Attributes
    ----------
    values : list of ((F, P, 2) array, (F, P, 2) array)
    largest : float
    scale : float
        Length of an arrow over its force.
    box : (2, 2) array
        Lower and upper corner of a picture that holds all arrows and the motions.
    """

    values: list[tuple[NDArray[np.float64], NDArray[np.float64]]]
    largest: float
    scale: float
    box: NDArray[np.float64]

    @classmethod
    def of(cls, motions: Sequence[Motion], books: Sequence[Books]) -> Forces:
        """The means around the motions' instants."""
        values = [each.around(motion.frames) for motion, each in zip(motions, books, strict=True)]
        sizes = [np.hypot(*np.moveaxis(force, -1, 0)).max(initial=0.0) for force, _ in values]
        largest, box = float(max(sizes)), view(motions)
        scale = LONGEST * float(np.ptp(box, axis=0).max()) / largest if largest else 0.0
        tails = [(place - scale * force).reshape(-1, 2) for force, place in values]
        corners = np.concatenate([box, *tails])  # some of which are not a number
        return cls(values, largest, scale, np.array([np.nanmin(corners, 0), np.nanmax(corners, 0)]))


def view(motions: Sequence[Motion]) -> NDArray[np.float64]:
    """Lower and upper corner (2, 2) of a picture that holds all that moves, and some margin."""
    boxes = np.array([motion.box for motion in motions])
    box = np.array([boxes[:, 0].min(axis=0), boxes[:, 1].max(axis=0)])
    margin = 6.0 * motions[0].spacing
    return np.array([box[0] - margin, box[1] + margin])


def set_view(axes: Axes, box: NDArray[np.float64]) -> None:
    """Show a box (2, 2) with equal scales."""
    axes.set_aspect("equal")
    axes.set_xlim(box[0, 0], box[1, 0])
    axes.set_ylim(box[0, 1], box[1, 1])


def draw_design(axes: Axes, problem: Problem, x: NDArray[np.float64]) -> None:
    """Draw a design before it moves; nothing is simulated."""
    motion = Motion.of(optimised(problem, x), [0])
    set_view(axes, view([motion]))
    draw_walls(axes, problem.scene)
    axes.add_collection(Squares(motion), autolim=False)
    axes.tick_params(labelsize=7)


def draw_history(axes: Axes, run: Optimisation) -> None:
    """Draw objective, beta and non-discreteness over a run's evaluations, stages marked.

    Evaluations that break a constraint are open circles.
    """

    def column(name: str) -> NDArray[np.float64]:
        return np.array([getattr(item, name) for item in run.history], dtype=float)

    number = np.arange(1, len(run.history) + 1)
    objective, solid = column("objective"), column("post_processed")
    lines: list[Any] = axes.plot(number, objective, "k.-", ms=4, lw=1, label="objective L")
    missed = column("violation") > 0.0
    if missed.any():
        style: dict[str, Any] = {"ms": 4, "mfc": "white", "label": "breaks a constraint"}
        lines += axes.plot(number[missed], objective[missed], "ko", **style)
    if not np.isnan(solid).all():
        lines += axes.plot(number, solid, "C1-", lw=1, label="post-processed L")
    failed = np.isnan(objective)
    if failed.any():
        floor = 0.0 if failed.all() else np.nanmin(objective)
        at_floor = np.full(failed.sum(), floor)
        lines += axes.plot(number[failed], at_floor, "rx", label="failed evaluation")
    axes.set_xlabel("evaluation")
    axes.set_ylabel("objective L (distance)")
    other = axes.twinx()
    lines += other.plot(number, column("non_discreteness"), "C0-", lw=1, label="non-discreteness")
    other.set_ylim(0.0, 1.05)
    other.set_ylabel("non-discreteness")
    stage, beta = column("stage"), column("beta")
    changed = np.diff(stage) != 0
    for first in [0, *(np.flatnonzero(changed) + 1)]:
        axes.axvline(first + 0.5, color="0.7", lw=0.8)
        axes.annotate(
            f"$\\beta$ = {beta[first]:g}", (first + 0.5, 1.01), rotation=90,
            xycoords=("data", "axes fraction"), ha="center", va="bottom", fontsize=7,
        )  # fmt: skip
    axes.set_xlim(0.5, len(number) + 0.5)
    labels = [str(line.get_label()) for line in lines]
    axes.legend(lines, labels, loc="upper center", ncols=3, fontsize=8, frameon=False,
                bbox_to_anchor=(0.5, -0.12))  # fmt: skip
