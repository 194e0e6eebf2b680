"""All tables and figures of the page of results, by one command: hours, on two cores.

    python cases/results.py --out DIR [--docs]

It runs the robots, their spread by starts and rounding, the paper's tables and the comparison of
optimisers, which each go on where they were stopped and leave alone what DIR holds already.
"""

import argparse
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

from mpmopt.__main__ import ROBOTS
from mpmopt.io.console import reported
from mpmopt.io.files import replace_file

ROOT = Path(__file__).parent.parent
# Where the docs read what is left in DIR.
PAGES = {
    "robots.csv": "docs/results/robots.csv",
    "walker/stride.png": "docs/images/walker.png",
    "walker.gif": "docs/images/walker.gif",
    "spread-default/spread.csv": "docs/results/spread_default.csv",
    "spread-default/spread.png": "docs/images/spread.png",
    "spread-preview/spread.csv": "docs/results/spread_preview.csv",
    "paper/tables.csv": "docs/results/tables_paper.csv",
    "optimisers/optimisers.csv": "docs/results/optimisers.csv",
}


def commands(out: Path) -> Iterator[list[str]]:
    """Arguments of the interpreter, one command after the other."""

    def case(name: str, *arguments: str) -> list[str]:
        return [str(ROOT / "cases" / f"{name}.py"), *arguments]

    for robot in ROBOTS:
        yield case(robot, "--out", str(out / robot))
    yield case("robots", *(str(out / robot) for robot in ROBOTS), "--out", str(out / "robots.csv"))
    yield [
        "-m", "mpmopt", "film", str(out / "walker" / "run.h5"), "--seconds", "8",
        "--out", str(out / "walker.gif"), "--force",
    ]  # fmt: skip
    for setting in ("default", "preview"):
        folder = str(out / f"spread-{setting}")
        yield case("spread", "walker", "--setting", setting, "--out", folder)
    yield case("paper_tables", "--out", str(out / "paper"))
    yield case("optimisers", "--starts", "2", "--out", str(out / "optimisers"))


def work(out: Path, docs: bool) -> int:
    """Run all commands, up to one that fails; its exit code."""
    for command in commands(out):
        print("+ python", *command, flush=True)
        code = subprocess.run([sys.executable, *command]).returncode
        if code:
            return code
    if docs:
        for name, page in PAGES.items():
            replace_file(ROOT / page, (out / name).read_bytes())
    return 0


def main(argv: list[str] | None = None) -> int:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, required=True, metavar="DIR", help="folder of results")
    parser.add_argument("--docs", action="store_true", help="copy them to where the docs read them")
    options = parser.parse_args(argv)
    return reported(lambda: work(options.out, options.docs), lambda: "The same command goes on.")


if __name__ == "__main__":
    sys.exit(main())
