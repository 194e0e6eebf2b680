"""Where the method fails: every failure mode, its limit in theory, as measured, and what happens.

    python cases/stability_map.py --out DIR [--quick] [--scheduler ADDRESS]

Writes ``stability_*.csv``, one table for each map, ``stability.rst``, which sums them up, and
``stability_map.png``. What ``stability.h5`` holds already is not measured again.
"""

import argparse
import csv
import datetime
import io
import logging
import os
import platform
import sys
from collections.abc import Sequence
from concurrent.futures import Executor
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

from mpmopt.errors import MpmoptError
from mpmopt.files import replace_file
from mpmopt.sweeps import connected, results, sweep

MODULES = {
    "time_step": time_step, "weak": weak, "adversary": adversary, "actuation": actuation,
    "inversion": inversion, "fracture": fracture, "contact": contact, "energy": energy,
    "safe": safe, "gradients": gradients, "optimiser": optimiser,
}  # fmt: skip


def as_csv(rows: Sequence[dict[str, Any]]) -> str:
    """Rows as comma-separated values, numbers with six digits."""
    text = io.StringIO()
    writer = csv.DictWriter(text, rows[0], lineterminator="\n")
    writer.writeheader()
    for row in rows:
        writer.writerow({k: f"{v:.6g}" if isinstance(v, float) else v for k, v in row.items()})
    return text.getvalue()


def one(module: str, function: str, arguments: dict[str, Any]) -> dict[str, Any]:
    """One row of one map."""
    logging.getLogger("mpmopt").setLevel(logging.ERROR)  # failed evaluations are the point
    return getattr(MODULES[module], function)(**arguments)


def measure(quick: bool, store: Path, executor: Executor | None = None) -> Found:
    """The points of all modules in one sweep, and what each module makes of its own."""
    points = [
        {"module": name, "function": function.__name__, "arguments": arguments}
        for name, module in MODULES.items()
        for function, rows in module.points(quick).items()
        for arguments in rows
    ]
    rows = iter(results(sweep(one, points, store, executor)))
    found = Found()
    for module in MODULES.values():
        part = module.measure(
            {
                function: [next(rows) for _ in arguments]
                for function, arguments in module.points(quick).items()
            }
        )
        found.tables |= part.tables
        found.lines += part.lines
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
    parser.add_argument("--scheduler", metavar="ADDRESS", help="measure on this Dask cluster")
    arguments = parser.parse_args(argv)
    arguments.out.mkdir(parents=True, exist_ok=True)
    try:
        with connected(arguments.scheduler) as executor:
            found = measure(arguments.quick, arguments.out / "stability.h5", executor)
    except MpmoptError as error:
        print(f"{type(error).__name__}: {error}", file=sys.stderr)
        return 1
    for name, rows in found.tables.items():
        replace_file(arguments.out / f"stability_{name}.csv", as_csv(rows).encode())
    text = summary(found, arguments.quick)
    replace_file(arguments.out / "stability.rst", text.encode())
    figure.plot(arguments.out / "stability_map.png", found.tables)
    print(text)
    return 0


if __name__ == "__main__":
    sys.exit(main())
