"""A scene before anything moves: domains, walls, dimensions, gravity, direction of travel."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Patch, Rectangle
from numpy.typing import NDArray

from mpmopt.scene import Actuator, Design, Region, Scene, Solid
from mpmopt.view.draw import LAYER, draw_walls, new_figure, own_style, set_view

FACES: dict[type[Region], str] = {Design: "0.93", Actuator: "#f2b8ad", Solid: "0.55"}
HATCHES: dict[type[Region], str] = {Design: "..", Actuator: "xx", Solid: ""}
# More intervals than these would not be readable along one side of a body.
MOST_INTERVALS = 8


@own_style()
def schematic(scene: Scene) -> Figure:
    """A figure of a scene: what is designed, what squeezes, where it stands and shall go.

    Lengths are in the scene's unit. Walls are where they begin to act, ground where it is.
    """
    corners = np.array([(region.lower, region.upper) for region in scene.body])
    box = np.array([corners[:, 0].min(axis=0), corners[:, 1].max(axis=0)])
    gap = 0.1 * float((box[1] - box[0]).max())  # between a body and what is drawn around it
    ahead = np.where(np.array(scene.direction) < 0.0, -1.0, 1.0)
    # Lengths stand opposite to the direction of travel, those along x above if it is horizontal.
    sides = np.array([-ahead[0], -ahead[1] if scene.direction[1] else 1.0])
    seen = box + np.outer([-1.0, 1.0], [4.0 * gap, 3.0 * gap])
    width, height = seen[1] - seen[0]
    scale = min(7.0 / width, 7.0 / height)
    figure = new_figure(scale * width + 0.9, scale * height + 1.3)
    axes = figure.add_subplot()
    set_view(axes, seen)
    draw_walls(axes, scene)
    for number, region in enumerate(scene.body):
        _draw_region(axes, scene, region, number)
    for k in (0, 1):
        # But for rounding: edges that meet are one.
        edges = np.unique(np.round(corners[:, :, k] / scene.grid.dx, 6)) * scene.grid.dx
        _draw_lengths(axes, edges, box, k, sides[1 - k], gap)
    _draw_arrows(axes, scene, box, ahead, gap)
    _label_walls(axes, scene, seen)
    if scene.mirror is not None:
        line = axes.axhline if scene.mirror.axis == "y" else axes.axvline
        line(scene.mirror.position, color="C0", ls="-.", lw=1.2, label="plane of symmetry")
    kinds = [kind for kind in FACES if any(isinstance(region, kind) for region in scene.body)]
    handles = [
        Patch(facecolor=FACES[kind], hatch=HATCHES[kind], edgecolor="0.3", label=kind.kind)
        for kind in kinds
    ]
    if scene.ground:
        handles.append(Patch(facecolor=LAYER, edgecolor="0.3", label="layer of the ground"))
    axes.legend(
        handles=[*handles, *axes.lines], ncols=4, loc="upper center", frameon=False,
        bbox_to_anchor=(0.5, -0.08),
    )  # fmt: skip
    nx, ny = scene.grid.cells
    axes.set_title(
        f"{nx} x {ny} cells of width {scene.grid.dx:.6g}, {scene.steps} steps of "
        f"{scene.time_step:.4g}",
        fontsize=9,
    )
    axes.tick_params(labelsize=7)
    return figure


def _draw_region(axes: Axes, scene: Scene, region: Region, number: int) -> None:
    width, height = region.upper[0] - region.lower[0], region.upper[1] - region.lower[1]
    kind = type(region)
    patch = Rectangle(region.lower, width, height, facecolor=FACES[kind], edgecolor="0.3", lw=0.8)
    patch.set_hatch(HATCHES[kind])
    axes.add_patch(patch)
    name = region.kind
    if isinstance(region, Actuator) and len(scene.actuators) > 1:
        name += f" {sum(isinstance(other, Actuator) for other in scene.body[:number])}"
    wide, tall = np.diff(axes.transData.transform([region.lower, region.upper]), axis=0)[0]
    if max(wide, tall) >= 60.0 and min(wide, tall) >= 16.0:
        middle = np.add(region.lower, region.upper) / 2.0
        _label(axes, middle, name, size=9, upright=wide < 60.0)


def _draw_lengths(
    axes: Axes,
    edges: NDArray[np.float64],
    box: NDArray[np.float64],
    k: int,
    side: float,
    gap: float,
) -> None:
    """Arrows with lengths along axis k: one between neighbouring edges each, and the whole."""
    start = box[1, 1 - k] if side > 0.0 else box[0, 1 - k]

    def at(along: float, gaps: float) -> tuple[float, float]:
        across = start + gaps * side * gap
        return (across, along) if k else (along, across)

    chains = [[edges[0], edges[-1]]]
    if 2 < len(edges) <= MOST_INTERVALS + 1:
        chains.insert(0, list(edges))
    for row, chain in enumerate(chains, 1):
        for edge in chain:
            _arrow(axes, at(edge, 0.15), at(edge, row + 0.2), style="-", width=0.5)
        for low, high in pairwise(chain):
            _arrow(axes, at(low, row), at(high, row), style="<->", width=0.8)
            ends = axes.transData.transform([at(low, row), at(high, row)])
            room = float(np.hypot(*(ends[1] - ends[0])))
            _label(axes, at((low + high) / 2, row), f"{high - low:.6g}",
                   upright=(room < 70.0) != bool(k))  # fmt: skip


def _draw_arrows(
    axes: Axes, scene: Scene, box: NDArray[np.float64], ahead: NDArray[np.float64], gap: float
) -> None:
    """The direction of travel in front of the body, and gravity above that."""
    direction, gravity = np.array(scene.direction), np.array(scene.gravity)
    half = (box[1] - box[0]) / 2.0
    start = box.mean(axis=0) + direction * (half @ abs(direction) + 0.5 * gap)
    _arrow(axes, start, start + 2.2 * gap * direction)
    above = np.array([0.8 * direction[0], 0.35 + 0.8 * direction[1]])
    _label(axes, start + gap * above, "travel", size=9)
    strength = float(np.hypot(*gravity))
    if strength > 0.0:
        side = box[1, 0] if ahead[0] > 0.0 else box[0, 0]
        centre = np.array([side + 1.4 * ahead[0] * gap, box[1, 1] + 1.2 * gap])
        reach = 0.9 * gap * gravity / strength
        _arrow(axes, centre - reach, centre + reach)
        _label(axes, (centre[0] + 1.2 * gap * ahead[0], centre[1]), f"g = {strength:.3g}", size=9)


def _label_walls(axes: Axes, scene: Scene, seen: NDArray[np.float64]) -> None:
    """Say what each wall and ground that is in view does to what slides on it."""
    for wall in scene.walls:
        k = "xy".index(wall.axis)
        low, high = seen[:, k]
        inside = (low, wall.position) if wall.solid_side == "below" else (wall.position, high)
        if inside[1] - inside[0] >= 0.03 * (high - low):
            at = np.full(2, sum(inside) / 2.0)
            at[1 - k] = seen[:, 1 - k] @ [0.12, 0.88]
            text = "stick" if wall.friction == "stick" else f"friction {wall.friction:.4g}"
            _label(axes, at, text, upright=k == 0)
    places = np.meshgrid(*(np.linspace(low, high, 21)[1:-1] for low, high in seen.T))
    for ground in scene.ground:
        d, _ = ground.distance(np.array(places))
        if d.min() < -0.03 * float(np.ptp(seen[:, 1])):
            deepest = np.unravel_index(d.argmin(), d.shape)
            text = "stick" if ground.friction == "stick" else f"friction {ground.friction:.4g}"
            _label(axes, [float(axis[deepest]) for axis in places], text)


def _arrow(
    axes: Axes,
    start: Sequence[float] | NDArray[np.float64],
    end: Sequence[float] | NDArray[np.float64],
    style: str = "-|>",
    width: float = 1.6,
) -> None:
    arrow = {"arrowstyle": style, "lw": width, "color": "black", "shrinkA": 0, "shrinkB": 0}
    axes.annotate("", (end[0], end[1]), (start[0], start[1]), arrowprops=arrow)


def _label(
    axes: Axes,
    at: Sequence[float] | NDArray[np.float64],
    text: str,
    size: float = 8,
    upright: bool = False,
) -> None:
    axes.text(
        float(at[0]), float(at[1]), text, fontsize=size, rotation=90 if upright else 0,
        ha="center", va="center", bbox={"facecolor": "white", "edgecolor": "none", "pad": 1.0},
    )  # fmt: skip
