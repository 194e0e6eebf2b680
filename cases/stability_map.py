"""Where the method fails: every failure mode, its limit in theory, as measured, and what happens.

    python cases/stability_map.py --out DIR [--quick]

Writes ``stability_*.csv``, one table for each map, ``stability.rst``, which sums them up, and
``stability_map.png``.
"""

import argparse
import csv
import datetime
import io
import logging
import os
import platform
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from benchmark import processor, table
from stability import (
    actuation,
    adversary,
    contact,
    energy,
    figure,
    fracture,
    gradients,
    inversion,
    optimiser,
    safe,
    time_step,
    weak,
)
from stability.common import Found

from mpmopt.runfile import replace_file

MODULES = (
    time_step, weak, adversary, actuation, inversion, fracture, contact, energy, safe, gradients,
    optimiser,
)  # fmt: skip


def as_csv(rows: Sequence[dict[str, Any]]) -> str:
    """Rows as comma-separated values, numbers with six digits."""
    text = io.StringIO()
    writer = csv.DictWriter(text, rows[0], lineterminator="\n")
    writer.writeheader()
    for row in rows:
        writer.writerow({k: f"{v:.6g}" if isinstance(v, float) else v for k, v in row.items()})
    return text.getvalue()


def measure(quick: bool) -> Found:
    """All modules, with a line of progress for each."""
    found = Found()
    for number, module in enumerate(MODULES, 1):
        name = module.__name__.split(".")[-1]
        print(f"{number} of {len(MODULES)}, {name} ...", end=" ", flush=True)
        began, worked = time.perf_counter(), time.process_time()
        part = module.measure(quick)
        found.tables |= part.tables
        found.lines += part.lines
        took, worked = time.perf_counter() - began, time.process_time() - worked
        print(f"{took:.0f} s, {worked:.0f} s of them at work", flush=True)
    return found


def summary(found: Found, quick: bool) -> str:
    """The table of all modes, and where it was measured."""
    header = ["what", "theory", "measured", "what the program does"]
    text = table("Ways to fail", header, [list(line) for line in found.lines])
    head, rest = text.split("\n", 1)
    widths = "   :widths: 20, 22, 33, 25"
    short = ", few points (``--quick``)" if quick else ""
    return (
        f"Measured on {datetime.date.today()}, one thread of {os.cpu_count()} cores of "
        f"{processor()}, Python {platform.python_version()}{short}. Courant numbers are "
        "c_p dt / dx of the solid.\n\n" + "\n".join([head, widths, rest])
    )


def main(argv: list[str] | None = None) -> int:
    """Measure all modes, write tables, summary and figure."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, required=True, metavar="DIR", help="folder of results")
    parser.add_argument("--quick", action="store_true", help="fewer points, within three minutes")
    arguments = parser.parse_args(argv)
    logging.getLogger("mpmopt").setLevel(logging.ERROR)  # failed evaluations are the point
    arguments.out.mkdir(parents=True, exist_ok=True)
    found = measure(arguments.quick)
    for name, rows in found.tables.items():
        replace_file(arguments.out / f"stability_{name}.csv", as_csv(rows).encode())
    text = summary(found, arguments.quick)
    replace_file(arguments.out / "stability.rst", text.encode())
    figure.plot(arguments.out / "stability_map.png", found.tables)
    print(text)
    return 0


if __name__ == "__main__":
    sys.exit(main())
