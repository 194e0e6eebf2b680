"""The paper's two tables beside ours: objective values and actuation of walker and crawler.

    python cases/paper_tables.py --out DIR [--setting preview]

Runs both cases in one setting, or reads what DIR already holds of them, and writes ``tables.md``
and ``tables.csv``. The paper's figures, which show its geometry, are lost: the geometry is ours, so
gains over the reference compare, distances do not.
"""

import argparse
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import crawler
import walker

from mpmopt.app import case
from mpmopt.errors import MpmoptError
from mpmopt.io.files import as_csv, replace_file
from mpmopt.results import runfile

CASES = {"walker": walker.CASES, "crawler": crawler.CASES}
SETTINGS = ("default", "preview", "paper")

# Tables 1 and 2 of Sato et al. and the text of sections 3.1 and 3.2, as distances (larger is
# farther).
PRINTED = {
    "walker": {"reference": 0.208, "optimised": 0.362, "post_processed": 0.357,
               "a": 1.00, "theta": -0.330, "b": -0.982},
    "crawler": {"reference": 0.379, "optimised": 0.451, "post_processed": 0.401,
                "a": 0.964, "theta": -0.174, "b": -0.447},
}  # fmt: skip


def row(name: str, source: str, summary: Mapping[str, Any]) -> dict[str, str]:
    """One line of the table, from a summary or from what the paper printed."""
    values = dict(summary)
    references = [summary["reference"], summary.get("baseline")]
    values["reference"] = max(value for value in references if value is not None)
    optimised, solid, share = values["optimised"], values["post_processed"], "-"
    if solid is not None:
        values["gain"] = solid - values["reference"]
        if optimised > values["reference"]:  # else there is no gain to retain
            share = f"{values['gain'] / (optimised - values['reference']):.0%}"
    line = {"case": name, "source": source}
    for column in ("reference", "optimised", "post_processed", "gain", "a", "theta", "b"):
        line[column] = "-" if values.get(column) is None else f"{values[column]:.3f}"
    line["share of gain retained"] = share
    return line


def rows(summaries: Mapping[str, Mapping[str, Any]], setting: str) -> list[dict[str, str]]:
    """The paper's line and ours for each case."""
    return [
        line
        for name, summary in summaries.items()
        for line in (
            row(name, "paper", PRINTED[name]),
            row(name, f"mpmopt, {setting}", summary),
        )
    ]


def markdown(lines: list[dict[str, str]]) -> str:
    """The lines as a Markdown table."""
    table = [list(lines[0]), ["---"] * len(lines[0]), *(list(line.values()) for line in lines)]
    return "".join(f"| {' | '.join(cells).replace('_', '-')} |\n" for cells in table)


def summary_of(name: str, setting: str, folder: Path) -> dict[str, Any]:
    """The summary of a case, from the folder if it holds a finished run, else from a new run."""
    path = folder / "run.h5"
    if not path.exists():
        return case.run(CASES[name][setting], folder)
    found = runfile.read_run(path)
    if not found.summary:
        raise MpmoptError(f"{path} holds a run that was not finished; move it away")
    wanted = CASES[name][setting]
    if (found.run.scene, found.run.settings) != (wanted.scene, wanted.settings):
        raise MpmoptError(f"{path} holds another scene or other settings; choose another folder")
    return found.summary


def main(argv: list[str] | None = None) -> int:
    """Run or read both cases, print and write the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument(
        "--out", type=Path, required=True, metavar="DIR", help="folder of both runs"
    )
    parser.add_argument("--setting", choices=SETTINGS, default="paper", help="of both cases")
    arguments = parser.parse_args(argv)
    try:
        summaries = {
            name: summary_of(name, arguments.setting, arguments.out / name) for name in CASES
        }
        lines = rows(summaries, arguments.setting)
        replace_file(arguments.out / "tables.csv", as_csv(lines).encode())
        replace_file(arguments.out / "tables.md", markdown(lines).encode())
    except MpmoptError as error:
        print(f"{type(error).__name__}: {error}", file=sys.stderr)
        return 1
    print(markdown(lines), end="")
    print("The geometry is ours (the paper's figures are lost): compare gains, not distances.")
    return 0


if __name__ == "__main__":
    sys.exit(main())
