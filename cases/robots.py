"""A table of robots: what the runs in some folders reached.

python cases/robots.py out/walker out/crawler out/climber --out docs/results/robots.csv
"""

import argparse
import csv
import io
import json
import math
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from mpmopt.io.files import replace_file
from mpmopt.validation import digits

HEADER = (
    "robot", "mean speed", "worst at friction 0.3 to 0.8", "kept at half the step",
    "on cells half as wide", "a quarter as wide", "in the other formulation", "driven share",
    "pieces", "thinnest member", "goes on for", "without grey, over the solid block",
    "gradients", "of them failed",
)  # fmt: skip


def worst(summary: Mapping[str, Any], low: float = 0.3, high: float = 0.8) -> float:
    """The least speed over frictions of a summary; not a number if one of them has none."""
    frictions = summary.get("speed_by_friction", {}).items()
    values = [value for name, value in frictions if low <= float(name) <= high]
    return min(values) if values and None not in values else math.nan


def row(folder: Path) -> list[str]:
    """What the summary of a run says; a dash where it says nothing."""
    summary: dict[str, Any] = json.loads((folder / "summary.json").read_text())
    kept, followed = summary.get("kept", {}), summary.get("followed", {})
    solid, block = summary["post_processed"], summary["reference"]

    def number(value: float | None) -> str:
        return "-" if value is None or math.isnan(value) else digits(value, 3)

    def share(value: float | None) -> str:
        return "-" if value is None else f"{value:.0%}"

    end = followed.get("end", "goes on")
    return [
        folder.name,
        number(summary.get("speed")),
        number(worst(summary)),
        *(
            share(kept.get(name))
            for name in ("half_step", "finer_cells", "finest_cells", "other_formulation")
        ),
        share(summary.get("driven_share")),
        str(summary.get("components", "-")),
        number(summary.get("thinnest_member")),
        number(followed.get("seconds")) + ("" if end == "goes on" else f", {end}"),
        number(None if solid is None or block is None else solid - block),
        str(summary["evaluations"]),
        str(summary["failed_evaluations"]),
    ]


def main(arguments: list[str] | None = None) -> int:
    """Write the table, a line for each folder."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folders", nargs="+", type=Path, help="folders of finished runs")
    parser.add_argument("--out", required=True, type=Path, help="the table, a CSV file")
    options = parser.parse_args(arguments)
    lines = [HEADER, *(row(folder) for folder in options.folders)]
    table = io.StringIO()
    csv.writer(table, lineterminator="\n").writerows(lines)
    replace_file(options.out, table.getvalue().encode())
    print(table.getvalue(), end="")
    return 0


if __name__ == "__main__":
    sys.exit(main())
