"""Robots to make, and commands on the run file that one leaves: look at it, check it, take it away.

robots:
  walker, crawler, climber, silicone, terrain
  mpmopt ROBOT --help tells what each can be asked for

examples:
  mpmopt walker --preview --out out/walker             make a run
  mpmopt report out/walker/run.h5                      one page of all that it found
  mpmopt plot out/walker/run.h5                        pictures of it
  mpmopt film out/walker/run.h5                        and a film
  mpmopt verify out/walker/run.h5                      are its gradients right?
  mpmopt study out/walker/run.h5                       does it go elsewhere, and for long?

mpmopt COMMAND --help tells more. "python -m mpmopt" is the same as "mpmopt".

exit codes:
  0 all is well; 1 a check failed, or an error that standard error explains;
  2 the command line was not understood; 130 interrupted, 143 terminated
"""

from __future__ import annotations

import argparse
import logging
import sys
from collections.abc import Callable
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING, Any

from mpmopt import __version__
from mpmopt.errors import DesignError, MissingLibraryError
from mpmopt.io.console import how_to_go_on, reported

if TYPE_CHECKING:
    from mpmopt.results.runfile import RunFile

ROBOTS = ("walker", "crawler", "climber", "silicone", "terrain")


def robot(name: str, arguments: list[str]) -> None:
    """Run a robot's script, which ends the process, as ``python cases/NAME.py`` does from a clone.

    It is ``__main__`` then, too: what it defines travels to other processes.
    """
    package = Path(__file__).parent
    folder = package / "cases"  # of a wheel
    if not folder.is_dir():
        folder = package.parent / "cases"
    script = folder / f"{name}.py"
    sys.argv[:] = [f"mpmopt {name}", *arguments]
    sys.path.insert(0, str(folder))
    sys.modules["__main__"] = module = ModuleType("__main__")
    module.__file__ = str(script)
    exec(compile(script.read_bytes(), script, "exec"), vars(module))


def _read(path: Path) -> RunFile:
    from mpmopt.results import runfile

    return runfile.read_run(path)


def _target(out: Path | None, default: Path, force: bool) -> Path:
    """The file to write, in a folder that is there; what `out` names is replaced only by force."""
    from mpmopt.io.files import make_folder, refuse_existing

    refuse_existing([out] if out else (), force)
    target = out or default
    make_folder(target.parent)
    return target


def plot(path: Path, out: Path | None, force: bool) -> None:
    """Write pictures of a run: its scene, its bodies in motion, its history."""
    from mpmopt.io.files import make_folder, refuse_existing
    from mpmopt.io.progress import Progress
    from mpmopt.view.plot import picture_files, plot_run

    run = _read(path).run
    folder = out or path.parent
    files = picture_files(folder, run.scene).values()
    refuse_existing(files if out else (), force)
    make_folder(folder)
    with Progress("pictures", len(files)) as progress:

        def written(picture: Path) -> None:
            progress.step(picture.name)
            progress.print(str(picture))

        plot_run(folder, run, written)


def report(path: Path, out: Path | None, force: bool) -> None:
    """Write a run's report: one HTML file with film, gait, history, designs and numbers."""
    from mpmopt.view.report import report as reported_on

    found = _read(path)
    target = _target(out, path.parent / "report.html", force)
    reported_on(target, found.run, found.summary, found.versions, path)
    print(f"{target}: {target.stat().st_size / 1e6:.2g} MB")


def film(
    path: Path,
    out: Path | None,
    mp4: bool,
    seconds: float | None,
    forces: bool,
    finished: bool,
    force: bool,
) -> None:
    """Write a film of a run's design beside others, or of its finished robot."""
    from mpmopt.view.film import film as filmed

    if mp4 and out is not None and out.suffix.lower() != ".mp4":
        raise DesignError(f"--mp4 does not write {out}: leave --mp4 out, or let FILE end in .mp4")
    run = _read(path).run
    name = "finished" if finished else "film"
    target = _target(out, path.parent / f"{name}.{'mp4' if mp4 else 'gif'}", force)
    print(f"{target}: {filmed(target, run, seconds, forces, finished)}")


def verify(path: Path) -> int:
    """Print the checks of a run's gradients; 1 if any failed."""
    from mpmopt.assess.verify import Check, report
    from mpmopt.io.progress import Progress

    run = _read(path).run
    with Progress("checks") as progress:

        def show(check: Check) -> None:
            mark = "ok" if check.passed else "FAILED"
            progress.step(check.name)
            progress.print(f"{check.name:<34}  {check.value:12.3g}  {check.wanted:<10}  {mark}")

        checks = report(run.problem(), run.result.x, progress=show)
    failed = sum(not check.passed for check in checks)
    print(f"{len(checks) - failed} of {len(checks)} checks passed")
    return 1 if failed else 0


def postprocess(path: Path, threshold: float) -> None:
    """Print what a run's best design does once it is solid or absent everywhere."""
    import numpy as np

    from mpmopt.assess.threshold import (
        best_actuated,
        kept,
        pieces,
        post_processed,
        retained_share,
        solid_reference,
    )
    from mpmopt.validation import digits

    found = _read(path)
    problem, x = found.run.problem(), found.run.result.x
    keep = kept(problem, x, threshold)
    optimised = problem.value(x)
    value = post_processed(problem, x, threshold)
    reference = found.summary.get("reference")
    if reference is None:
        reference = best_actuated(
            problem.scene, solid_reference, problem.split(x), task=problem.task
        )
    share = retained_share(problem.scene, value - reference, optimised - reference)
    shown = "no gain to keep" if np.isnan(share) else f"{share:.1%}"
    sizes = np.bincount(pieces(problem.scene, keep)[keep])
    solid = f"(gamma >= {threshold:g} solid, the rest removed)"
    print(f"solid reference design   {digits(reference)}")
    print(f"optimised                {digits(optimised)}")
    print(f"post-processed           {digits(value)}  {solid}")
    print(f"retained gain            {shown}")
    print(f"design particles kept    {keep.sum()} of {keep.size}")
    loose = ", ".join(str(size) for size in sorted(sizes[1:], reverse=True)) or "none"
    print(f"pieces hanging on nothing, particles of each: {loose}")


def scenes(path: Path, out: Path | None, seconds: float, force: bool) -> None:
    """Write a film of a run's finished robot in all scenes of its task, side by side."""
    from mpmopt.view.ensemble import film_scenes

    run = _read(path).run
    target = _target(out, path.parent / "scenes.gif", force)
    print(f"{target}: {film_scenes(target, run, seconds)}")


def study(path: Path) -> None:
    """Print whether a run's best design keeps its gain and goes elsewhere; keep it in the run."""
    import numpy as np

    from mpmopt.app.study import full_study
    from mpmopt.assess.refinement import Variant, variants
    from mpmopt.assess.refinement import study as refined
    from mpmopt.assess.robustness import can_be_studied
    from mpmopt.io.progress import Progress
    from mpmopt.validation import digits

    run = _read(path).run
    with Progress("simulations", len(variants(run.scene))) as progress:

        def show(row: Variant) -> None:
            progress.step(row.name)
            if row.failure:
                progress.print(f"{row.name:<21}  no value: {row.failure}")
                return
            cells = f"{row.cells[0]} x {row.cells[1]}"
            retained = "" if np.isnan(row.retained) else f"{row.retained:9.0%}"
            if row.halved:
                retained += f"  (fails with a step of {row.time_step * 2**row.halved:.2g})"
            progress.print(
                f"{row.name:<21}  {cells:>9}  {row.time_step:8.2g}  {digits(row.reference):>10}  "
                f"{digits(row.distance):>9}  {retained}"
            )

        progress.print(
            f"{'post-processed design':<21}  {'cells':>9}  {'step':>8}   reference     design  "
            "gain retained"
        )
        refined(run.problem(), run.result.x, progress=show)
    if can_be_studied(run.scene):
        print(full_study(path))


def forces(path: Path, out: Path | None, force: bool) -> None:
    """Print, write and draw what drives and bears a run's best design, without grey."""
    import numpy as np

    from mpmopt.assess.forces import books
    from mpmopt.assess.trajectory import post_processed
    from mpmopt.io.files import as_csv, make_folder, refuse_existing, replace_file
    from mpmopt.io.progress import Progress
    from mpmopt.validation import digits
    from mpmopt.view.plot import plot_forces, plot_motion

    run = _read(path).run
    folder = out or path.parent
    names = ("forces.csv", "forces.png", "forces_motion.png")
    table, picture, pictures = files = [folder / name for name in names]
    refuse_existing(files if out else (), force)
    body = post_processed(run.problem(), run.result.x)
    with Progress("steps", body.simulation.steps) as progress:
        found = books(body.simulation, progress.step)
    make_folder(folder)
    replace_file(table, as_csv(found.rows()).encode())
    plot_forces(picture, body.name, found)
    plot_motion(pictures, body, books=found)
    _, borne, _ = found.means(100)
    sizes = np.hypot(*np.moveaxis(borne, -1, 0))
    print(f"{'travel':<24} {digits(found.travel)}, of the centre of mass")
    print(f"{'weight':<24} {digits(found.weight)}")
    print(f"{'cost of transport':<24} {digits(found.cost_of_transport)}")
    for name, values in found.work.items():
        print(f"{'work of ' + name:<24} {digits(float(values[-1]))}")
    share = float(np.abs(found.residual).max()) / (found.turnover or 1.0)
    print(f"{'unexplained':<24} {share:.1g} of the energy that is turned over")
    for k, name in enumerate(found.supports):
        mean = ", ".join(digits(value) for value in borne[:, k].mean(axis=0))
        peak = digits(float(sizes[:, k].max()))
        print(f"{'force of ' + name:<24} mean ({mean}), at most {peak} over 1 % of the time")
    print(*files, sep="\n")


def trajectory(path: Path, out: Path | None, force: bool) -> None:
    """Write how a run's best design moves, without grey, as comma-separated values."""
    from mpmopt.assess.trajectory import post_processed
    from mpmopt.io.files import replace_file
    from mpmopt.results.trajectory import table

    run = _read(path).run
    target = _target(out, path.parent / "trajectory.csv", force)
    text = table(post_processed(run.problem(), run.result.x))
    replace_file(target, text.encode())
    print(f"{target}: {len(text.splitlines()) - 1} instants")


def cheapest(path: Path, tol: float, gradient_tol: float | None, seconds: float) -> None:
    """Print the cheapest discretisation that tells a run's best design as well as the finest."""
    from mpmopt.assess import discretisation
    from mpmopt.io.progress import Progress

    run = _read(path).run
    problem = run.problem()
    with Progress("discretisations") as progress:

        def show(line: discretisation.Evidence) -> None:
            progress.step(str(line.measured.discretisation))
            progress.print(str(line))

        found = discretisation.cheapest(
            problem.scene,
            run.result.x,
            tol,
            beta=problem.chain.beta,
            subpixel=problem.chain.subpixel,
            void_cutoff=problem.void_cutoff,
            task=problem.task,
            gradient_tolerance=gradient_tol,
            seconds=seconds,
            progress=show,
        )
    print(f"reference                {found.reference.discretisation}")
    own = (found.objective_uncertainty, found.gradient_uncertainty)
    distance, gradient = ("unknown" if value != value else f"{value:.1%}" for value in own)
    print(f"its own uncertainty      distance {distance}, gradient {gradient}")
    if found.other_reference is not None:
        print(f"other formulation        {found.other_reference.discretisation}")
        apart = f"distance {found.objective_apart:.1%}, gradient {found.gradient_apart:.1%}"
        print(f"apart from it            {apart}")
    label = "cheapest near it" if found.doubt else f"cheapest within {tol:.3g}"
    print(f"{label:<24} {found.best}")
    if found.doubt:
        print(found.doubt)


def resume(path: Path) -> None:
    """Go on with a run that was stopped, and print what it found."""
    from mpmopt.app.case import resume as resumed
    from mpmopt.app.ending import ending

    resumed(path)
    print(ending(path))


def export(path: Path, out: Path | None, force: bool, **options: Any) -> int:
    """Write a run's best design as files that other programs read; 1 if one cannot be written."""
    from mpmopt.io.files import refuse_existing
    from mpmopt.results.export import export as exported
    from mpmopt.results.export import files, ours, size, widths

    run = _read(path).run
    folder = out or path.parent
    there = [folder / name for name in files(options["formats"], options["parts"])]
    refuse_existing((file for file in there if out and not ours(file)), force)
    done = exported(run.problem(), run.result.x, folder, **options)
    for file in done.paths:
        print(f"{file}  {file.stat().st_size} bytes")
    if done.polygons:
        width, height = size(done.polygons)
        area = sum(polygon.area for polygon in done.polygons)
        holes = sum(len(polygon.rings) - 1 for polygon in done.polygons)
        print(f"size    {width:.6g} x {height:.6g} mm, area {area:.6g} mm2")
        print(f"pieces  {len(done.polygons)}, with {holes} holes")
        try:
            member, gap = widths(done.polygons, done.detail)
            print(f"widths  thinnest member {member:.3g} mm, narrowest gap {gap:.3g} mm")
        except MissingLibraryError as error:
            print(error)
    if done.loose:
        left = (
            "left out"
            if options["drop_components"]
            else "still there: --drop-components leaves them out"
        )
        print(f"{done.loose} particles hang on nothing, {left}")
    return 1 if done.failed else 0


def main(argv: list[str] | None = None) -> int:
    """Run a command; the exit code is one of those in the module's text."""
    argv = sys.argv[1:] if argv is None else argv
    if argv and argv[0] in ROBOTS:
        robot(argv[0], argv[1:])
    options = vars(_parser().parse_args(argv))
    do, advice = options.pop("do"), options.pop("advice")
    logging.basicConfig(format="%(message)s")
    return reported(lambda: do(**options), lambda: advice(options["path"]))


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="mpmopt", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.set_defaults(advice=lambda path: "Files are complete or absent.")
    parser.add_argument("--version", action="version", version=f"mpmopt {__version__}")
    commands = parser.add_subparsers(required=True, metavar="COMMAND", title="commands")

    def add(
        do: Callable[..., int | None], text: str, description: str, *examples: str
    ) -> argparse.ArgumentParser:
        name = do.__name__
        command = commands.add_parser(
            name,
            help=text,
            description=description,
            epilog="\n  ".join(["examples:", *(f"mpmopt {name} {line}" for line in examples)]),
            formatter_class=argparse.RawDescriptionHelpFormatter,
        )
        command.set_defaults(do=do)
        command.add_argument("path", type=Path, metavar="RUN.h5", help="run file of a case")
        return command

    def add_place(command: argparse.ArgumentParser, metavar: str, text: str) -> None:
        command.add_argument("--out", type=Path, metavar=metavar, help=text)
        command.add_argument(
            "--force", action="store_true", help="replace files that are at --out already"
        )

    command = add(
        resume,
        "go on with it after a stop",
        "Go on with an unfinished run to the end that it would have had without a stop.",
        "out/walker/run.h5",
    )
    command.set_defaults(advice=how_to_go_on)

    command = add(
        report,
        "write a page of its film, gait, history, designs and numbers",
        "Write report.html, a single file that any browser opens without a network: the best\n"
        "design in motion, its gait, the history, the designs, its robustness, the constraints,\n"
        "all settings, and how to reproduce it.",
        "out/walker/run.h5",
        "out/walker/run.h5 --out walker.html",
    )
    add_place(command, "FILE", "HTML file (default: report.html there)")

    command = add(
        plot,
        "draw its scene, its designs in motion and its history",
        "Write schematic.png, history.png and, in motion, design.png (as it was optimised),\n"
        "post_processed.png (without grey) and reference.png (the solid reference design); of a\n"
        "robot on ground stride.png (a period of its gait) and gait.png (its feet over time).",
        "out/walker/run.h5",
        "out/walker/run.h5 --out pictures",
    )
    add_place(command, "DIR", "folder (default: the run's)")

    command = add(
        film,
        "film its design beside the reference",
        "Write a film of the best design, the same without grey, and the solid reference\n"
        "design with the same actuation, in slow motion, for as long as the scene lasts; or of\n"
        "the finished robot in the time that its speed is of. GIF needs nothing more; MP4 needs\n"
        "pip install 'mpmopt[film]'.",
        "out/walker/run.h5",
        "out/walker/run.h5 --mp4",
        "out/walker/run.h5 --seconds 12 --out walker.gif",
        "out/walker/run.h5 --forces",
        "out/walker/run.h5 --finished",
    )
    command.add_argument(
        "--finished", action="store_true", help="finished.gif: the robot at its speed, t = 2 to 8"
    )
    command.add_argument(
        "--forces", action="store_true", help="arrows: what ground and walls push bodies with"
    )
    command.add_argument("--mp4", action="store_true", help="film.mp4 instead of film.gif")
    add_place(command, "FILE", "ends in .gif or .mp4 (default: film.gif, or finished.gif, there)")
    command.add_argument(
        "--seconds", type=float, help="that it plays (default: so that each period is seen)"
    )

    command = add(
        verify,
        "check the gradients of its best design",
        "Put the gradient before three independent witnesses: dot products, the complex step, and\n"
        "the order of Taylor's remainder. Exits with 1 if any check fails.",
        "out/walker/run.h5",
    )

    command = add(
        postprocess,
        "remove the void of its best design",
        "Say how far the best design goes once its particles are solid or absent.",
        "out/walker/run.h5",
        "out/walker/run.h5 --threshold 0.5",
    )
    command.add_argument(
        "--threshold", type=float, default=0.3, help="gamma from which a particle stays (0.3)"
    )

    command = add(
        scenes,
        "film its finished robot in all scenes of its task",
        "Write a film of the best design, without void and what hangs on nothing, in all scenes\n"
        "of the run's task at once, from rest; on ground of several frictions if it has only one.",
        "out/walker/run.h5",
        "out/walker/run.h5 --out walker.mp4",
    )
    add_place(command, "FILE", "ends in .gif or .mp4 (default: scenes.gif there)")
    command.add_argument("--seconds", type=float, default=10.0, help="that it plays (10)")

    command = add(
        study,
        "try its best design elsewhere",
        "Say how much of its gain the best design, without void, keeps with half the step, twice\n"
        "the step where that is stable, cells half as wide, and in the other formulation:\n"
        "numerical propulsion keeps little. Then, of a robot on ground, how fast it goes on\n"
        "ground of other frictions, in both formulations on other cells, with stronger and\n"
        "faster actuators, without actuation and after a push, and for how long it goes on. The\n"
        "numbers go to the run file and summary.json, and robustness.png shows them.",
        "out/walker/run.h5",
    )

    command = add(
        forces,
        "say what drives and bears its best design",
        "Keep the books of the best design, without void: the work of actuators, viscosity,\n"
        "ground, walls and numerics, the cost of transport (actuators' work over weight and\n"
        "travel), and the forces of ground and walls. forces.csv and forces.png have them over\n"
        "time, forces_motion.png as arrows.",
        "out/walker/run.h5",
        "out/walker/run.h5 --out pictures",
    )
    add_place(command, "DIR", "folder (default: the run's)")

    command = add(
        trajectory,
        "write how its best design moves as a table",
        "Write trajectory.csv, of the best design without void, in the scene's units: time, place\n"
        "and velocity of the centroid, travel, the actuators' signals, and for each foot its\n"
        "height and whether it stands.",
        "out/walker/run.h5",
        "out/walker/run.h5 --out walker.csv",
    )
    add_place(command, "FILE", "CSV file (default: trajectory.csv there)")

    command = add(
        cheapest,
        "find the cheapest discretisation that is accurate enough",
        "Measure the best design in one discretisation after the other, from the cheapest on,\n"
        "until distance and gradient agree with the finest affordable one; in both formulations\n"
        "where the scene has no walls.",
        "out/walker/run.h5 --tol 0.1",
        "out/walker/run.h5 --tol 0.05 --gradient-tol inf --seconds 300",
    )
    command.add_argument(
        "--tol", type=float, default=0.05, help="relative tolerance of distance and gradient (0.05)"
    )
    command.add_argument("--gradient-tol", type=float, help="another one of the gradient; inf: any")
    command.add_argument(
        "--seconds", type=float, default=60.0, help="what the finest reference may take (60)"
    )

    command = add(
        export,
        "write its design as drawing, solid and motion",
        "Write the best design without grey: design.svg, design.dxf, design.stl and design.3mf at\n"
        "a size in millimetres, motion.vtkhdf in the scene's units. All but SVG and the motion,\n"
        "and the widths of the thinnest member and gap, need pip install 'mpmopt[export]'.",
        "out/walker/run.h5 --svg --dxf --stl --vtk --width 60",
        "out/walker/run.h5 --stl --scale 200 --thickness 8 --drop-components --out parts",
        "out/walker/run.h5 --stl --svg --parts --width 60 --out molds",
    )
    for name, text in (
        ("svg", "write a drawing"),
        ("dxf", "write a drawing for CAD"),
        ("stl", "write a watertight solid"),
        ("3mf", "write the same for printers that know several materials"),
        ("vtk", "write the motion, for ParaView"),
    ):
        command.add_argument(
            f"--{name}", dest="formats", action="append_const", const=name, default=[], help=text
        )
    command.add_argument(
        "--parts",
        action="store_true",
        help="actuators and passive body apart: layers, objects, a file of each as STL",
    )
    command.add_argument("--width", type=float, metavar="MM", help="width of the drawing or solid")
    command.add_argument(
        "--scale", type=float, metavar="MM", help="instead: length of the scene's unit"
    )
    command.add_argument(
        "--thickness", type=float, metavar="MM", help="of the solid (default: a tenth of the width)"
    )
    command.add_argument(
        "--threshold", type=float, default=0.3, help="gamma from which a particle stays (0.3)"
    )
    command.add_argument(
        "--drop-components", action="store_true", help="leave out pieces that hang on nothing"
    )
    command.add_argument(
        "--kerf", type=float, metavar="MM", help="warn of members and gaps thinner than a cut"
    )
    add_place(command, "DIR", "folder (default: the run's)")
    return parser


if __name__ == "__main__":
    sys.exit(main())
