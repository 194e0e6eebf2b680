"""Commands on run files: ``python -m mpmopt verify DIR/run.h5``."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from mpmopt.errors import MpmoptError


def verify(path: Path) -> int:
    """Print the checks of a run's gradients; 1 if any failed."""
    from mpmopt import runfile
    from mpmopt.verify import report

    run = runfile.read(path)
    checks = report(run.problem(), run.best)
    width = max(len(check.name) for check in checks)
    for check in checks:
        mark = "ok" if check.passed else "FAILED"
        print(f"{check.name:<{width}}  {check.value:12.3g}  {check.wanted:<10}  {mark}")
    failed = sum(not check.passed for check in checks)
    print(f"{len(checks) - failed} of {len(checks)} checks passed")
    return 1 if failed else 0


def main(argv: list[str] | None = None) -> int:
    """Run a command; 0 if all is well, 1 if not, 2 if it was not understood."""
    parser = argparse.ArgumentParser(prog="python -m mpmopt", description=__doc__)
    commands = parser.add_subparsers(required=True)
    command = commands.add_parser("verify", help="check the gradients of a run's best design")
    command.add_argument("path", type=Path, metavar="RUN.h5")
    command.set_defaults(do=lambda arguments: verify(arguments.path))
    arguments = parser.parse_args(argv)
    try:
        return int(arguments.do(arguments))
    except MpmoptError as error:
        print(f"{type(error).__name__}: {error}", file=sys.stderr)
        return 1


if __name__ == "__main__":
    sys.exit(main())
