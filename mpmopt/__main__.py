"""Commands on run files: ``python -m mpmopt verify DIR/run.h5`` and so on."""

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


def postprocess(path: Path, threshold: float) -> int:
    """Print what a run's best design does once it is solid or absent everywhere."""
    import numpy as np

    from mpmopt import runfile
    from mpmopt.binary import farthest, full_block, pieces, post_processed

    run = runfile.read(path)
    problem, x = run.problem(), run.best
    optimised = problem.value(x)
    value = post_processed(problem, x, threshold)
    reference = run.summary.get("reference") or farthest(
        problem.scene, full_block, problem.split(x)
    )
    keep = problem.gamma(x) >= threshold
    sizes = np.bincount(pieces(problem.scene, keep)[keep])
    print(f"reference (full block)   {reference:.4f}")
    print(f"optimised                {optimised:.4f}")
    print(f"post-processed           {value:.4f}  (gamma >= {threshold:g} solid, the rest removed)")
    print(f"share of the gain kept   {(value - reference) / (optimised - reference):.1%}")
    print(f"design particles kept    {keep.sum()} of {keep.size}")
    loose = ", ".join(str(size) for size in sorted(sizes[1:], reverse=True)) or "none"
    print(f"pieces hanging on nothing, particles of each: {loose}")
    return 0


def audit(path: Path) -> int:
    """Print whether a run's best design, without void, keeps its gain in other discretisations."""
    import numpy as np

    from mpmopt import runfile
    from mpmopt.audit import audit as audited

    run = runfile.read(path)
    print(
        f"{'post-processed design':<21}  {'cells':>9}  {'step':>8}  full block  design  gain kept"
    )
    for row in audited(run.problem(), run.best):
        cells = f"{row.cells[0]} x {row.cells[1]}"
        if row.failure:
            print(f"{row.name:<21}  no value: {row.failure}")
            continue
        kept = "" if np.isnan(row.kept) else f"{row.kept:9.0%}"
        print(
            f"{row.name:<21}  {cells:>9}  {row.time_step:8.2g}  {row.reference:10.4f}  "
            f"{row.distance:6.4f}  {kept}"
        )
    return 0


def cheapest(path: Path, tolerance: float, gradient_tolerance: float | None, seconds: float) -> int:
    """Print the cheapest discretisation that tells a run's best design as well as the finest."""
    from mpmopt import discretisation, runfile

    run = runfile.read(path)
    problem = run.problem()
    found = discretisation.cheapest(
        problem.scene,
        run.best,
        tolerance,
        beta=problem.chain.beta,
        leave_out=problem.leave_out,
        gradient_tolerance=gradient_tolerance,
        seconds=seconds,
        progress=lambda line: print(line, flush=True),
    )
    print(f"reference                {found.reference.discretisation}")
    print(
        f"its own uncertainty      travel {found.objective_uncertainty:.1%}, "
        f"gradient {found.gradient_uncertainty:.1%}"
    )
    print(f"cheapest within {tolerance:<8.3g} {found.best}")
    return 0


def resume(path: Path) -> int:
    """Go on with a run that was stopped; the exit code says how that ended."""
    from mpmopt import case

    return case.reported(lambda: case.resume(path), path)


def main(argv: list[str] | None = None) -> int:
    """Run a command; 0 if all is well, 1 if not, 2 if it was not understood."""
    parser = argparse.ArgumentParser(prog="python -m mpmopt", description=__doc__)
    commands = parser.add_subparsers(required=True)
    command = commands.add_parser("resume", help="go on with a run that was stopped")
    command.add_argument("path", type=Path, metavar="RUN.h5")
    command.set_defaults(do=lambda arguments: resume(arguments.path))
    command = commands.add_parser("verify", help="check the gradients of a run's best design")
    command.add_argument("path", type=Path, metavar="RUN.h5")
    command.set_defaults(do=lambda arguments: verify(arguments.path))
    command = commands.add_parser("postprocess", help="remove the void of a run's best design")
    command.add_argument("path", type=Path, metavar="RUN.h5")
    command.add_argument(
        "--threshold", type=float, default=0.3, help="gamma from which a particle stays (0.3)"
    )
    command.set_defaults(do=lambda arguments: postprocess(arguments.path, arguments.threshold))
    command = commands.add_parser("audit", help="simulate a run's best design more finely")
    command.add_argument("path", type=Path, metavar="RUN.h5")
    command.set_defaults(do=lambda arguments: audit(arguments.path))
    command = commands.add_parser(
        "cheapest", help="find the cheapest discretisation that is accurate enough"
    )
    command.add_argument("path", type=Path, metavar="RUN.h5")
    command.add_argument(
        "--tol", type=float, default=0.05, help="relative tolerance of travel and gradient (0.05)"
    )
    command.add_argument(
        "--gradient-tol", type=float, default=None, help="another one of the gradient; inf: any"
    )
    command.add_argument(
        "--seconds", type=float, default=60.0, help="what the finest reference may take (60)"
    )
    command.set_defaults(
        do=lambda arguments: cheapest(
            arguments.path, arguments.tol, arguments.gradient_tol, arguments.seconds
        )
    )
    arguments = parser.parse_args(argv)
    try:
        return int(arguments.do(arguments))
    except MpmoptError as error:
        print(f"{type(error).__name__}: {error}", file=sys.stderr)
        return 1


if __name__ == "__main__":
    sys.exit(main())
