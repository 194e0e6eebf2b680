"""One figure of all maps, with the theoretical limits drawn."""

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle

from mpmopt.scene.scene import Formulation
from stability.inversion import lumped
from stability.safe import STRENGTH
from stability.time_step import RESONANCES, SAFE_COURANT, SAFE_TURN
from stability.weak import HEAVY, SAFE_STIFFNESS, SAFE_TOTAL_COURANT, SAFE_TOTAL_STIFFNESS

Rows = list[dict[str, Any]]
Tables = Mapping[str, Rows]
LIMIT: dict[str, Any] = {"color": "0.35", "ls": "--", "lw": 1.0}  # how theory is drawn
SAFE: dict[str, Any] = {"color": "tab:green", "alpha": 0.12, "lw": 0.0}
FAILED = "#b2182b"
CONTACTS = {"wall": ("contact", "C3"), "layer": ("layer", "C2"), "none": ("no contact", "C0")}


def column(rows: Rows, key: str) -> np.ndarray:
    """One column as numbers."""
    return np.array([row[key] for row in rows], dtype=float)


def groups(rows: Rows, *keys: str) -> dict[tuple, Rows]:
    """Rows with the same keys, in order."""
    found: dict[tuple, Rows] = {}
    for row in rows:
        found.setdefault(tuple(row[key] for key in keys), []).append(row)
    return found


def note(axes: Axes, x: float, y: float, text: str, **more: Any) -> None:
    """A small remark."""
    style: dict[str, Any] = {"fontsize": 7, "color": "0.25"}
    axes.annotate(text, (x, y), **(style | more))


def rest(axes: Axes, tables: Tables) -> None:
    """Limits of bodies at rest."""
    rows = tables["time_step_rest"]
    names = [
        row["body"].replace(", ", ",\n").replace(" cells from the grid", " cells") for row in rows
    ]
    y = np.arange(len(rows))[::-1]
    axes.plot(column(rows, "theory"), y, "|", ms=16, mew=1.5, color="0.35", label="linear theory")
    axes.plot(column(rows, "measured"), y, "o", ms=5, color="tab:blue", label="measured")
    axes.axvspan(0.866, 1.45, color=FAILED, alpha=0.08, lw=0)
    note(axes, 0.875, -0.65, "refused")
    axes.set_yticks(y, names, fontsize=7)
    axes.set_xlim(0.75, 1.45)
    axes.set_ylim(-0.8, len(rows) - 0.3)
    axes.set_xlabel("Courant number")
    axes.set_title("Time step: bodies at rest")
    axes.legend(fontsize=7, loc="upper right")


def motion(axes: Axes, tables: Tables) -> None:
    """Limits of an isolated particle in motion."""
    for (name,), rows in groups(tables["time_step_motion"], "motion").items():
        axes.semilogx(column(rows, "rate"), column(rows, "measured"), ".-", lw=1, label=name)
    for height, name in zip((np.sqrt(0.75), *RESONANCES), ("linear", "order 3", "order 4")):
        axes.axhline(height, **LIMIT)
        note(axes, 3.1, height + 0.01, name, ha="right")
    axes.set_ylim(0.0, 1.0)
    rate = np.geomspace(0.03, 3.0, 50)
    axes.fill_between(rate, np.minimum(SAFE_COURANT, SAFE_TURN / rate), **SAFE)
    note(axes, 0.035, 0.05, f"safe: Courant <= {SAFE_COURANT:g}, dt |C| <= {SAFE_TURN:g}")
    axes.set_xlabel("|C| in $c_p$ / dx")
    axes.set_ylabel("Courant number")
    axes.set_title("Time step: one particle in motion")
    axes.legend(fontsize=7, loc="lower left", bbox_to_anchor=(0.0, 0.1))


def weak(formulation: Formulation, heavy: bool) -> Callable[[Axes, Tables], None]:
    """Heat map of what void does, for equal floors or for a heavy void density."""
    total = formulation == "total"

    def draw(axes: Axes, tables: Tables) -> None:
        rows = [
            row
            for row in tables["weak"]
            if row["formulation"] == formulation
            and (
                row["void_density"] == HEAVY
                if heavy and not total
                else (row["void_density"] != row["void_stiffness"]) is heavy
            )
        ]
        epsilons = sorted({row["void_stiffness"] for row in rows}, reverse=True)
        courants = sorted({row["courant"] for row in rows})
        colour = np.full((len(epsilons), len(courants)), np.nan)
        for (epsilon, courant), both in groups(rows, "void_stiffness", "courant").items():
            i, j = epsilons.index(epsilon), courants.index(courant)
            if any(row["refused"] for row in both):
                axes.add_patch(Rectangle((j - 0.5, i - 0.5), 1, 1, fc="0.9", ec="0.6", hatch="///"))
                continue
            failed, runs = (sum(row[key] for row in both) for key in ("failed", "designs"))
            if failed:
                axes.add_patch(Rectangle((j - 0.5, i - 0.5), 1, 1, color=FAILED, zorder=2))
                axes.text(j, i, f"{failed}/{runs}", color="w", ha="center", va="center", fontsize=7)
            colour[i, j] = max(np.nanmax([row["largest_deviation"] for row in both] + [1e-6]), 1e-6)
        image = axes.imshow(colour, cmap="YlOrBr", norm=LogNorm(1e-5, 1e-1), aspect="auto")
        if heavy:
            most = SAFE_TOTAL_COURANT if total else SAFE_COURANT
            least, stiffest = SAFE_TOTAL_STIFFNESS if total else (0.0, SAFE_STIFFNESS)
            wide = sum(courant <= most for courant in courants)
            top = sum(epsilon > 1.01 * stiffest for epsilon in epsilons)
            high = sum(epsilon > 0.99 * least for epsilon in epsilons) - top
            corner, size = (-0.5, top - 0.5), (wide, high)
            axes.add_patch(Rectangle(corner, *size, fill=False, ec="tab:green", lw=3, zorder=3))
        axes.set_xticks(range(len(courants)), [f"{c:g}" for c in courants], fontsize=7)
        axes.set_yticks(range(len(epsilons)), [f"{e:.0e}" for e in epsilons], fontsize=7)
        axes.set_xlabel("Courant number")
        axes.set_ylabel("void stiffness")
        much = "ten times that void density" if total else f"void density {HEAVY:g}"
        what = ", total" * total + f", {much if heavy else 'same void density'}"
        axes.set_title(f"Void{what} (n/m failed)")
        bar = axes.figure.colorbar(image, ax=axes, pad=0.02)
        bar.set_label("void moves L by", fontsize=7)
        bar.ax.tick_params(labelsize=7)

    return draw


def ellipticity(axes: Axes, tables: Tables) -> None:
    """Walkers up to the loss of ellipticity."""
    rows = [row for row in tables["actuation_walker"] if row["bias"] < 0.0]
    colours = iter(np.linspace(0.0, 0.9, len({row["courant"] for row in rows})))
    for (courant,), some in groups(rows, "courant").items():
        axes.plot(
            column(some, "strength"), column(some, "distance"), ".-", lw=1,
            color=colormaps["viridis"](next(colours)), label=f"Courant {courant:g}",
        )  # fmt: skip
        lost = [row["strength"] for row in some if row["error"]]
        axes.plot(lost, np.full(len(lost), 0.27), "x", color=FAILED)
    axes.axvline(1.0, **LIMIT)
    axes.axvspan(0.0, STRENGTH, **SAFE)
    axes.axvspan(1.0, 1.1, color=FAILED, alpha=0.08, lw=0)
    note(axes, 1.01, 0.31, "refused:\nellipticity\nlost", va="top")
    axes.set_xlim(0.0, 1.12)
    axes.set_xlabel("largest signal x actuation stress / $\\mu$")
    axes.set_ylabel("distance of a walker")
    axes.set_title("Strong actuation (x: failed)")
    axes.legend(fontsize=6, loc="upper left")


def fracture(axes: Axes, tables: Tables) -> None:
    """Force over a cut of a stretched bar."""
    for (n,), rows in groups(tables["fracture_force"], "per_cell").items():
        axes.plot(
            column(rows, "stretch"),
            column(rows, "weakest_cut"),
            ".-",
            label=f"{n} a cell",
            color=f"C{n}",
        )
        axes.axvline(2 * n, color=f"C{n}", ls="--", lw=1)
        axes.axvline(n, color=f"C{n}", ls=":", lw=1)
    note(axes, 4.1, 0.92, "dotted: 1 particle a cell\ndashed: no node shared", va="top")
    axes.axvspan(1.0, 2.0, **SAFE)
    axes.set_xlabel("stretch")
    axes.set_ylabel("force across the weakest cut")
    axes.set_title("Numerical fracture")
    axes.legend(fontsize=7, loc="center right")


def pulled(axes: Axes, tables: Tables) -> None:
    """Which pulled bars come back, and how far they were stretched."""
    names = []
    for y, ((formulation, per_cell, courant), rows) in enumerate(
        groups(tables["fracture_bar"], "formulation", "per_cell", "courant").items()
    ):
        kind = "total" if formulation == "total" else "MLS-MPM"
        names.append(f"{kind}, {per_cell} a cell,\nCourant {courant:g}")
        whole = [row for row in rows if row["comes_back"]]
        torn = [row["speed"] for row in rows if not row["comes_back"]]
        axes.plot(column(whole, "speed"), [y] * len(whole), "o", ms=5, color="tab:green")
        axes.plot(torn, [y] * len(torn), "x", ms=6, color=FAILED)
        for row in whole:
            note(axes, row["speed"], y + 0.15, f"{row['stretch']:.1f}", ha="center", fontsize=6)
    axes.set_xscale("log")
    ticks = sorted({row["speed"] for row in tables["fracture_bar"]})
    axes.set_xticks(ticks, [f"{t:g}" for t in ticks])
    axes.set_xticks([], minor=True)
    axes.set_yticks(range(len(names)), names, fontsize=6)
    axes.set_ylim(-0.5, len(names) - 0.3)
    axes.set_xlabel("speed of the ends / $c_p$")
    axes.set_title("Pulled bar: comes back, stretched so far (x: torn, failed)")


def vortex(axes: Axes, tables: Tables) -> None:
    """Errors of the vortex over its greatest stretch."""
    for (formulation, cells, courant), rows in groups(
        tables["vortex"], "formulation", "cells", "courant"
    ).items():
        total = formulation == "total"
        style: dict[str, Any] = {
            "ls": "-" if courant == 0.4 else ":",
            "color": f"C{(24, 48, 96).index(cells) + 3 * total}",
        }
        axes.loglog(
            column(rows, "stretch"), column(rows, "error"), marker="D" if total else ".", lw=1,
            ms=3 if total else 6, label=f"{cells} cells, {courant:g}{', total' * total}", **style,
        )  # fmt: skip
        lost = [row["stretch"] for row in rows if row["failure"]]
        axes.plot(
            lost,
            np.full(len(lost), 2.0 * (1.25 if courant == 0.4 else 1.0) * (1.5 if total else 1.0)),
            "x",
            **style | {"ls": ""},
        )
    axes.axvline(2.0, **LIMIT)
    axes.axvspan(1.0, 2.0, **SAFE)
    for cells in sorted({row["cells"] for row in tables["vortex"]}):
        axes.axhline(lumped(cells), **LIMIT | {"lw": 0.6})
        note(axes, 7.9, lumped(cells), f"lumped mass, {cells}", ha="right", va="bottom", fontsize=5)
    ticks = (1.2, 1.5, 2.0, 3.0, 5.0, 7.0)
    axes.set_xticks(ticks, [f"{t:g}" for t in ticks])
    axes.set_xticks([], minor=True)
    axes.set_xlim(1.15, 8.0)
    axes.set_ylim(bottom=5e-4)  # room for the legend
    axes.set_xlabel("greatest stretch (A = 0.05 ... 1)")
    axes.set_ylabel("error / A")
    axes.set_title("Vortex, by Courant number (x: failed)")
    axes.legend(fontsize=5, ncols=2, loc="lower right")


def incline(axes: Axes, tables: Tables) -> None:
    """Accelerations on an incline."""
    ratio = np.linspace(0.0, 3.0, 300)
    axes.plot(ratio, np.maximum(0.0, 1.0 - ratio), **LIMIT)
    axes.plot(ratio, np.where(ratio < 1 / 3, 1.0 - ratio, 2 / 3), **LIMIT)
    marks = {32: "o", 64: "s", 128: "^"}
    for (law, shape, cells), rows in groups(tables["incline"], "law", "shape", "cells").items():
        colours = ("C0", "C1") if law == "wall" else ("C2", "C3")
        axes.plot(
            column(rows, "ratio"), column(rows, "measured"), marks[cells], ms=4, mfc="none",
            color=colours[shape != "block"], label=f"{shape}, {cells} cells, {law}",
        )  # fmt: skip
    note(axes, 2.2, 0.56, "disc, rigid", color="0.35")
    note(axes, 2.2, 0.06, "block, rigid", color="0.35")
    axes.set_xlabel("friction / tan(slope)")
    axes.set_ylabel("acceleration / (g sin)")
    axes.set_title("Incline: stick, slide, roll")
    axes.legend(fontsize=5, ncols=2, loc="center right", bbox_to_anchor=(1.0, 0.36))


def adversary(axes: Axes, tables: Tables) -> None:
    """Share of evaluations that fail while a walker or crawler is optimised."""
    rows = [row for row in tables["adversary"] if row["halvings"] == 0]
    by_floors = groups(rows, "void_density", "void_stiffness")
    courants = sorted({row["courant"] for row in rows})
    width = 0.8 / len(by_floors)
    for number, ((mass, stiffness), some) in enumerate(by_floors.items()):
        for (courant,), both in groups(some, "courant").items():
            failed, all_of_them = (sum(r[key] for r in both) for key in ("failed", "evaluations"))
            x = courants.index(courant) + (number - (len(by_floors) - 1) / 2) * width
            label = f"mass {mass:g}, stiffness {stiffness:g}" if both[0] is some[0] else None
            axes.bar(x, failed / all_of_them, 0.9 * width, color=f"C{number}", label=label)
            note(axes, x, failed / all_of_them, f"{failed}/{all_of_them}", ha="center", va="bottom")
    axes.set_xticks(range(len(courants)), [f"{courant:g}" for courant in courants])
    axes.margins(y=0.2)
    axes.set_xlabel("Courant number")
    axes.set_ylabel("share of evaluations that fail")
    axes.set_title("The optimiser as adversary, by floors")
    axes.legend(fontsize=7, loc="upper left")


def sizes(axes: Axes, tables: Tables) -> None:
    """Norm of the gradient, and the error of single precision, over the horizon."""
    for (contact,), rows in groups(tables["gradients"], "contact").items():
        name, colour = CONTACTS[contact]
        steps = column(rows, "steps")
        axes.loglog(
            steps, column(rows, "gradient"), ".-", color=colour, label=f"|gradient|, {name}"
        )
        error = column(rows, "single_gradient_error")
        if np.isfinite(error).any():
            axes.loglog(steps, error, "x:", color=colour, label=f"single, relative, {name}")
    axes.set_xlabel("steps")
    axes.set_ylim(1e-6, 1.0)
    axes.set_title("Gradient over the horizon")
    axes.legend(fontsize=6, loc="upper left")


def radii(axes: Axes, tables: Tables) -> None:
    """How far L is linear."""
    for (contact,), rows in groups(tables["gradients"], "contact").items():
        name, colour = CONTACTS[contact]
        axes.loglog(column(rows, "steps"), column(rows, "radius"), ".-", color=colour, label=name)
    axes.axhline(0.1, **LIMIT)
    note(axes, 25, 0.105, "move limit of the optimiser")
    axes.set_xlabel("steps")
    axes.set_ylabel("change of the design")
    axes.set_title("L is linear within 1 % up to")
    axes.legend(fontsize=7, loc="lower left")


def optimiser(axes: Axes, tables: Tables) -> None:
    """Cycles of the moving asymptotes, and saturation."""
    rows = tables["optimiser_cycle"]
    distance = column(rows, "least_distance")
    axes.loglog(distance, 0.9 * distance, **LIMIT, label="0.9 x least distance")
    axes.loglog(
        distance, np.maximum(column(rows, "width"), 1e-8), "o-", ms=4, label="cycle (0 at 1e-8)"
    )
    axes.set_xlabel("least distance of asymptotes, in ranges")
    axes.set_ylabel("width of the cycle, in ranges")
    axes.set_title("Moving asymptotes: 2-cycle")
    axes.legend(fontsize=7)


PANELS = (
    rest, motion, weak("updated", False), weak("updated", True), weak("total", False),
    weak("total", True), fracture, pulled, vortex, ellipticity, adversary, incline, sizes, radii,
    optimiser,
)  # fmt: skip


def plot(path: Path, tables: Tables) -> None:
    """Write the figure."""
    figure = Figure(figsize=(19.0, 11.5), layout="constrained")
    FigureCanvasAgg(figure)
    for axes, panel in zip(figure.subplots(3, 5).flat, PANELS, strict=True):
        panel(axes, tables)
        axes.title.set_fontsize(10)
        axes.xaxis.label.set_fontsize(8)
        axes.yaxis.label.set_fontsize(8)
        axes.tick_params(labelsize=7)
    figure.suptitle(
        "Where the method fails. Dashed: theory. Green: what docs/failure.rst calls safe.",
        fontsize=12,
    )
    figure.savefig(path, dpi=110)
