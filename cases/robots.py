"""A table of robots: what the runs in some folders reached.

python cases/robots.py out/walker out/crawler out/climber --out docs/results/robots.csv
"""

import argparse
import csv
import io
import json
import sys
from pathlib import Path
from typing import Any

from mpmopt.io.files import replace_file
from mpmopt.validation import digits

HEADER = (
    "robot", "start", "optimised", "without grey", "gain over the solid block",
    "of it with the actuation off", "gain left at half the step", "on cells half as wide",
    "disconnected particles", "gradients", "of them failed", "seconds",
)  # fmt: skip


def row(folder: Path) -> list[str]:
    """What the summary of a run says."""
    summary: dict[str, Any] = json.loads((folder / "summary.json").read_text())
    reference, retained = summary["reference"], summary["retained_gain"]

    def over(value: float | None) -> str:
        return "-" if value is None or reference is None else f"{value - reference:.3f}"

    def share(value: float | None) -> str:
        return "-" if value is None else f"{value:.0%}"

    def number(value: float | None) -> str:
        return "-" if value is None else digits(value)

    return [
        folder.name,
        *(number(summary[name]) for name in ("start", "optimised", "post_processed")),
        over(summary["post_processed"]),
        over(summary["actuation_off"]),
        share(retained["half the step"]),
        share(retained["cells half as wide"]),
        str(summary["disconnected_particles"]),
        str(summary["evaluations"]),
        str(summary["failed_evaluations"]),
        f"{summary['seconds']:.0f}",
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
