"""Command line of case scripts."""

from __future__ import annotations

import argparse
import logging
from collections.abc import Mapping
from pathlib import Path

from mpmopt.app.case import Case, run
from mpmopt.app.ending import ending
from mpmopt.errors import SceneError
from mpmopt.io.console import how_to_go_on, reported


def main(description: str, cases: Mapping[str, Case], argv: list[str] | None = None) -> int:
    """Command line of a case script.

    Parameters
    ----------
    description : str
    cases : mapping of str to Case
        By setting: "default", and others that become options such as ``--preview``.
    argv : list of str, optional
        Default: the command line's.

    Returns
    -------
    int
        Exit code: 0, 1 with a message on standard error, or 128 and the number of a signal.
    """
    parser = argparse.ArgumentParser(description=description)
    parser.add_argument(
        "--out",
        type=Path,
        required=True,
        metavar="DIR",
        help="folder of results; an unfinished run in it is gone on with",
    )
    parser.add_argument("--force", action="store_true", help="begin anew, replace earlier results")
    # An empty group breaks the help of argparse.
    choice = parser.add_mutually_exclusive_group() if len(cases) > 1 else parser
    for name, case in cases.items():
        if name != "default":
            scene = case.scene
            text = f"n = {scene.grid.cells[0]}, dt = {scene.time_step:g}"
            if scene.transient:
                text += f", travel counts from t = {scene.transient:g} to {scene.duration:g}"
            choice.add_argument(
                f"--{name}", dest="setting", action="store_const", const=name, help=text
            )
    parser.add_argument(
        "--formulation",
        choices=("updated", "total"),
        help="simulate it so: updated is MLS-MPM, total is total Lagrangian",
    )
    parser.add_argument(
        "--starts",
        type=int,
        metavar="N",
        help="optimise from N starts, all but one with a random field added",
    )
    parser.add_argument(
        "--scheduler", metavar="ADDRESS", help="run the starts on this Dask cluster"
    )
    arguments = parser.parse_args(argv)
    logging.basicConfig(format="%(message)s")
    setting = getattr(arguments, "setting", None) or "default"
    case = cases[setting]
    if arguments.formulation:
        try:
            case = case.in_formulation(arguments.formulation)
        except SceneError as error:
            parser.error(f"--formulation {arguments.formulation}: {error}")
    out, force = arguments.out, arguments.force
    if arguments.starts is None:
        if arguments.scheduler:
            parser.error("--scheduler is for --starts: one run is one process")

        def whole() -> None:
            run(case, out, force=force, full_study=setting == "default")
            print(ending(out / "run.h5"))

        return reported(whole, lambda: how_to_go_on(out / "run.h5"))
    if arguments.starts < 1:
        parser.error(f"--starts {arguments.starts}: at least 1")
    from mpmopt.app.multistart import multistart

    return reported(
        lambda: print(multistart(case, out, arguments.starts, arguments.scheduler, force)),
        lambda: "Every evaluation is saved; the same command without --force goes on.",
    )
