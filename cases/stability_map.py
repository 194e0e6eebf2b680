"""Where the method fails: every failure mode, its limit in theory, as measured, and what happens.

    python cases/stability_map.py --out DIR [--quick] [--scheduler ADDRESS]

Writes ``stability_*.csv``, one table for each map, ``stability.rst``, which sums them up, and
``stability_map.png``. What ``stability.h5`` holds already is not measured again.
"""

import argparse
import datetime
import logging
import os
import platform
import sys
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

from mpmopt.app.sweeps import connected, results, sweep
from mpmopt.errors import MpmoptError
from mpmopt.io.files import as_csv, replace_file

MODULES = {
    "time_step": time_step, "weak": weak, "adversary": adversary, "actuation": actuation,
    "inversion": inversion, "fracture": fracture, "contact": contact, "energy": energy,
    "safe": safe, "gradients": gradients, "optimiser": optimiser,
}  # fmt: skip


def one(module: str, function: str, arguments: dict[str, Any]) -> dict[str, Any]:
    """One row of one map, and when and on what it was measured."""
    logging.getLogger("mpmopt").setLevel(logging.ERROR)  # failed evaluations are the point
    return {
        **getattr(MODULES[module], function)(**arguments),
        "measured_on": str(datetime.date.today()),
        "measured_with": f"{os.cpu_count()} cores of {processor()}, "
        f"Python {platform.python_version()}",
    }


def measure(quick: bool, store: Path, executor: Executor | None = None) -> tuple[Found, str]:
    """What each module makes of its points, all in one sweep, and when and on what they ran."""
    points = [
        {"module": name, "function": function.__name__, "arguments": arguments}
        for name, module in MODULES.items()
        for function, rows in module.points(quick).items()
        for arguments in rows
    ]
    measured = results(sweep(one, points, store, executor))
    days, machines = (
        sorted({row.pop(name) for row in measured}) for name in ("measured_on", "measured_with")
    )
    rows = iter(measured)
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
    return found, f"{' to '.join(dict.fromkeys((days[0], days[-1])))}, {'; '.join(machines)}"


def summary(found: Found, where: str, quick: bool) -> str:
    """The table of all modes, and when and on what it was measured."""
    header = ["what", "theory", "measured", "what the program does"]
    text = table("Ways to fail", header, [list(line) for line in found.lines])
    head, rest = text.split("\n", 1)
    widths = "   :widths: 20, 22, 33, 25"
    short = ", few points (``--quick``)" if quick else ""
    return (
        f"Measured on {where}, each row in one thread{short}. Courant numbers are c_p dt / dx of "
        "the solid.\n\n" + "\n".join([head, widths, rest])
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
            found, where = measure(arguments.quick, arguments.out / "stability.h5", executor)
    except MpmoptError as error:
        print(f"{type(error).__name__}: {error}", file=sys.stderr)
        return 1
    for name, rows in found.tables.items():
        replace_file(arguments.out / f"stability_{name}.csv", as_csv(rows).encode())
    text = summary(found, where, arguments.quick)
    replace_file(arguments.out / "stability.rst", text.encode())
    figure.plot(arguments.out / "stability_map.png", found.tables)
    print(text)
    return 0


if __name__ == "__main__":
    sys.exit(main())
