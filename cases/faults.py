"""Everything that can happen to a run, done to real processes and real files.

    python cases/faults.py --out out/faults [--quick]

Each run is a small walker, three stages, or a body in three scenes with two constraints. It counts
as survived if it ends, gone on with after the fault, in the same file as a run that nothing
happened to, number by number; only the seconds differ.
"""

from __future__ import annotations

import argparse
import contextlib
import dataclasses
import fcntl
import json
import os
import random
import resource
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import h5py
from walker import slanted_legs, walker

import mpmopt
from mpmopt.app import case
from mpmopt.app.summary import table
from mpmopt.assess.threshold import solid_reference
from mpmopt.design.one_piece import OnePiece
from mpmopt.design.task import AtMost, Task
from mpmopt.design.terms import Displacement, Effort, Volume
from mpmopt.design.variation import Variation
from mpmopt.io.console import how_to_go_on, reported
from mpmopt.io.files import as_csv, replace_file
from mpmopt.optimisation.settings import Settings, Stage
from mpmopt.results import runfile
from mpmopt.scene import Actuator, Design, Grid, Ground, Material, Scene, Solid
from mpmopt.simulation import buffers
from mpmopt.simulation.checkpoints import Checkpointing

SMALL = case.Case(
    dataclasses.replace(walker(64, 8e-4), steps=200),
    Settings(
        (
            Stage(0.5, 1e-2, 1e-3, 8e-4),
            Stage(2.0, 1e-2, 1e-3, 8e-4),
            Stage(8.0, 1e-2, 1e-3, 8e-4, solid=True, void_cutoff=0.05),
        ),
        window=2,
        least_iterations=6,
        most_iterations=6,
    ),
    slanted_legs,
)
C = 1 / 32
# In three scenes, one of them in the other formulation, and with two constraints.
ENSEMBLE = case.Case(
    Scene(
        Grid((32, 24), C),
        time_step=1e-3,
        steps=200,
        body=(
            Design((4 * C, 4 * C), (12 * C, 8 * C)),
            Actuator((4 * C, 8 * C), (10 * C, 10 * C)),
            Solid((10 * C, 8 * C), (12 * C, 10 * C)),
        ),
        gravity=(0.0, -10.0),
        ground=(Ground.floor(3.2 * C, thickness=C),),
        material=Material(viscosity=0.02),
    ),
    Settings((Stage(2.0, move_limit=0.1), Stage(8.0, solid=True)), most_iterations=6),
    solid_reference,
    task=Task(
        Displacement() - 0.01 * Effort(),
        (AtMost(OnePiece(), 0.0), AtMost(Volume(), 0.6)),
        (
            Variation(friction=0.3, threshold=0.4),
            Variation(thickness=1.25, formulation="total"),
            Variation(friction="stick", strength=1.1, threshold=0.6),
        ),
        soft_minimum=30.0,
    ),
)
CASES = {"walker": SMALL, "ensemble": ENSEMBLE}
PHASES = {"advance": b"forward", "advance_adjoint": b"reverse", "write": b"write"}


@dataclass(frozen=True)
class Row:
    """A kind of fault: how often it was done, and how often it was survived."""

    fault: str
    done: int
    survived: int
    remark: str = ""


def content(path: Path) -> dict[str, Any]:
    """All that a run file holds, by name, but for the seconds."""
    found: dict[str, Any] = {}

    def add(name: str, item: Any) -> None:
        for key, value in item.attrs.items():
            if key == "summary":
                value = {k: v for k, v in json.loads(value).items() if k != "seconds"}
            if key != "seconds":
                found[f"{name}@{key}"] = repr(value)
        if isinstance(item, h5py.Dataset) and name != "history/seconds":
            found[name] = item[()].tobytes() if item.dtype != object else item[()].tolist()

    with h5py.File(path, "r", locking=False) as file:
        add("", file)
        file.visititems(add)
    return found


def child(name: str, out: Path, phase: Path | None, on_disk: bool) -> int:
    """Run one of `CASES` as a case script does, telling in a file what it is at."""
    if phase is not None:
        handle = os.open(phase, os.O_WRONLY | os.O_CREAT)

        def telling(function: Callable, name: Callable[..., str]) -> Callable:
            def told(*arguments: Any) -> Any:
                os.pwrite(handle, PHASES[name(*arguments)].ljust(8), 0)
                try:
                    return function(*arguments)
                finally:
                    os.pwrite(handle, b"other".ljust(8), 0)

            return told

        buffers.in_parallel = telling(buffers.in_parallel, lambda *a: a[1].__name__)
        runfile.replace_file = telling(runfile.replace_file, lambda *a: "write")
    checkpointing = Checkpointing(every=7, store="disk") if on_disk else None
    return reported(
        lambda: print(table(case.run(CASES[name], out, checkpointing))),
        lambda: how_to_go_on(out / "run.h5"),
    )


class Process:
    """One of `CASES`, by default the small walker, in a process of its own."""

    def __init__(self, out: Path, *options: str, **settings: Any) -> None:
        self.out, self.phase = out, out.with_suffix(".phase")
        self.phase.write_bytes(b"start".ljust(8))
        command = [*settings.pop("prefix", ())]
        command += [sys.executable, __file__, "--child", "--out", str(out), "--phase"]
        environment = {**os.environ, **settings.pop("environment", {})}
        self.process = subprocess.Popen(
            [*command, str(self.phase), *options],
            stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=environment, **settings,
        )  # fmt: skip

    def at(self) -> str:
        """What it is at."""
        return self.phase.read_bytes().decode().strip()

    def wait_for(self, *phases: str, seconds: float = 300.0) -> bool:
        """Whether it comes to one of these phases before it ends."""
        until = time.monotonic() + seconds
        while self.process.poll() is None and time.monotonic() < until:
            if self.at() in phases:
                return True
            time.sleep(1e-4)
        return False

    def end(self, number: int | None = None) -> tuple[int, str]:
        """Its exit code and what it wrote to standard error, after a signal if there is one."""
        if number is not None:
            self.process.send_signal(number)
        _, text = self.process.communicate(timeout=600.0)
        return self.process.returncode, text


def resumed(out: Path) -> dict[str, Any]:
    """What ``python -m mpmopt resume`` makes of what is left in a folder."""
    command = [sys.executable, "-m", "mpmopt", "resume", str(out / "run.h5")]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return content(out / "run.h5")


def finished(out: Path, *options: str, **settings: Any) -> dict[str, Any]:
    """The content of a run that nothing happens to, or nothing more."""
    code, text = Process(out, *options, **settings).end()
    assert code == 0, text
    return content(out / "run.h5")


def on_one_processor() -> None:
    """Let this process have one only, where the system can do that."""
    if hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})


def kills(
    folder: Path, whole: dict[str, Any], count: int, dice: random.Random, name: str = "walker"
) -> list[Row]:
    """SIGKILL at random moments: in the forward run, on the way back, in a write, wherever."""
    where: dict[str, list[int]] = {}
    run = 0
    while count > 0:
        out = folder / f"killed-{name}-{run}"
        run += 1
        at: list[str] = []
        alive = True
        while alive and len(at) < 4 and count > 0:
            process = Process(out, f"--case={name}")
            begun = process.wait_for("forward")
            wanted = dice.choice(("forward", "reverse", "write", "anything"))
            time.sleep(dice.uniform(0.0, 1.0))
            if wanted != "anything":
                process.wait_for(wanted, seconds=5.0)
            phase = process.at()
            alive = process.end(signal.SIGKILL)[0] == -signal.SIGKILL and begun
            if alive:
                at.append(phase)
                count -= 1
        same = resumed(out) == whole and not list(out.glob(".run.h5-*"))
        for phase in at:
            done = where.setdefault(phase, [0, 0])
            done[0] += 1
            done[1] += same
        show(f"{run} runs, {count} kills left")
    of = "" if name == "walker" else f", {name}"
    return [
        Row(f"SIGKILL in {phase}{of}", done[0], done[1]) for phase, done in sorted(where.items())
    ]


def ensembles(folder: Path, count: int, dice: random.Random) -> list[Row]:
    """The run in three scenes with two constraints: other threads and processors, and SIGKILL."""
    whole = finished(folder / "ensemble", "--case=ensemble", environment={"MPMOPT_THREADS": "1"})
    two = {"MPMOPT_THREADS": "2"}
    others = [
        finished(folder / "ensemble-2", "--case=ensemble", environment=two),
        finished(folder / "ensemble-alone", "--case=ensemble", environment=two,
                 preexec_fn=on_one_processor),
    ]  # fmt: skip
    same = sum(other == whole for other in others)
    rows = [Row("nothing, two threads or one processor, ensemble", len(others), same)]
    return rows + kills(folder, whole, count, dice, "ensemble")


def signals(folder: Path, whole: dict[str, Any], dice: random.Random, count: int) -> list[Row]:
    """SIGINT and SIGTERM: exit within a second, with their code and the way to go on."""
    rows = []
    for number, wanted in ((signal.SIGINT, 130), (signal.SIGTERM, 143)):
        for where in ("forward", "reverse", "write", "compilation"):
            survived, longest = 0, 0.0
            times = 1 if where == "compilation" else count
            for k in range(times):
                cold = tempfile.TemporaryDirectory()
                environment = {"NUMBA_CACHE_DIR": cold.name} if where == "compilation" else {}
                for attempt in range(5):
                    out = folder / f"{number.name}-{where}-{k}-{attempt}"
                    process = Process(out, environment=environment)
                    process.wait_for("forward")
                    time.sleep(dice.uniform(0.0, 1.0))
                    if where == "compilation" or process.wait_for(where):
                        break
                    code, text = process.end()  # a fast machine was through by then
                    assert code == 0, text
                began = time.monotonic()
                found, text = process.end(number)
                longest = max(longest, time.monotonic() - began)
                told = f"{number.name}. Every evaluation is saved; go on with: python" in text
                same = resumed(out) == whole
                survived += found == wanted and told and same
                if not (found == wanted and told and same):
                    show(f"not survived: exit code {found}, same: {same}, it said: {text}")
                cold.cleanup()
            rows.append(
                Row(f"{number.name} in {where}", times, survived, f"{longest:.2f} s to exit")
            )
            show(rows[-1].fault)
    return rows


def full_disk(folder: Path, whole: dict[str, Any], count: int, dice: random.Random) -> list[Row]:
    """Writes that fail at a random size, and a file system without room."""
    process = Process(folder / "begun")
    process.wait_for("forward")
    process.end(signal.SIGKILL)
    file = folder / "begun" / "run.h5"
    first = file.stat().st_size
    assert resumed(file.parent) == whole
    last = file.stat().st_size
    survived = 0
    for k in range(count):
        out, limit = folder / f"limited-{k}", dice.randint(first, last - 1)

        def lower(limit: int = limit) -> None:
            resource.setrlimit(resource.RLIMIT_FSIZE, (limit, limit))

        code, text = Process(out, preexec_fn=lower).end()
        survived += code == 1 and "StorageError: cannot write" in text and resumed(out) == whole
        show(f"disk full, {k + 1} of {count}")
    rows = [Row("a write fails at a random size", count, survived)]
    with small_disk(folder / "disk", last + last // 2) as disk:
        if disk is None:
            return [*rows, Row("small disk", 0, 0, "needs leave to mount one")]
        code, text = Process(disk / "out").end()
        told = code == 1 and "make room" in text
        shutil.copytree(disk / "out", folder / "from-disk")
    same = resumed(folder / "from-disk") == whole
    return [*rows, Row("the disk is full", 1, int(told and same))]


@contextlib.contextmanager
def small_disk(path: Path, size: int) -> Iterator[Path | None]:
    """A file system of so many bytes, if the system lets us have one."""
    path.mkdir()
    mount = ["mount", "-t", "tmpfs", "-o", f"size={size}", "tmpfs", str(path)]
    if shutil.which("mount") is None or subprocess.run(mount, capture_output=True).returncode:
        yield None
        return
    try:
        yield path
    finally:
        subprocess.run(["umount", str(path)], check=True)


def scratch(folder: Path, whole: dict[str, Any]) -> list[Row]:
    """The scratch file of states on disk is truncated, or looked for to be deleted."""
    rows = []
    out, place = folder / "scratch", folder / "tmp"
    place.mkdir()
    process = Process(out, "--on-disk", environment={"TMPDIR": str(place)})
    process.wait_for("reverse")
    names = [name for name in place.iterdir() if name.suffix == ".h5"]
    same = process.end()[0] == 0 and content(out / "run.h5") == whole
    rows.append(Row("a scratch file to delete", 1, int(same and not names), "has no name"))
    out = folder / "truncated"
    process = Process(out, "--on-disk", environment={"TMPDIR": str(place)})
    process.wait_for("reverse")
    process.wait_for("forward")
    handles = Path(f"/proc/{process.process.pid}/fd")
    for handle in handles.iterdir() if handles.exists() else ():
        if "mpmopt-" in str(handle.readlink()) and "deleted" in str(handle.readlink()):
            os.truncate(handle, 4096)
    code, text = process.end()
    told = code == 1 and "StorageError" in text
    rows.append(Row("the scratch file is truncated", 1, int(told and resumed(out) == whole)))
    return rows


def company(folder: Path, whole: dict[str, Any]) -> list[Row]:
    """Two processes on one run file, and a reader that has locked it."""
    out = folder / "two"
    first = Process(out)
    first.wait_for("forward")
    code, text = Process(out).end()
    told = code == 1 and "another process is at work" in text
    same = first.end()[0] == 0 and content(out / "run.h5") == whole
    rows = [Row("a second process on a run", 1, int(told and same))]
    out = folder / "read"
    process = Process(out)
    process.wait_for("reverse")
    process.end(signal.SIGKILL)
    with (out / "run.h5").open("rb") as reader, h5py.File(out / "run.h5", "r"):
        fcntl.flock(reader, fcntl.LOCK_SH)
        same = finished(out, environment={"HDF5_USE_FILE_LOCKING": "TRUE"}) == whole
    rows.append(Row("another program reads and locks it", 1, int(same)))
    out = folder / "lockless"
    same = finished(out, environment={"HDF5_USE_FILE_LOCKING": "FALSE"}) == whole
    rows.append(Row("no HDF5 locking", 1, int(same)))
    return rows


def read_only(folder: Path, whole: dict[str, Any]) -> list[Row]:
    """Nothing but the folder of results can be written: neither the package nor any cache."""
    place = folder / "installed"
    package = Path(mpmopt.__file__).parent
    shutil.copytree(package, place / "mpmopt", ignore=shutil.ignore_patterns("__pycache__"))
    for path in (*place.rglob("*"), place):
        path.chmod(0o555 if path.is_dir() else 0o444)
    nowhere = {"NUMBA_CACHE_DIR": str(place), "HOME": str(place), "XDG_CACHE_HOME": str(place)}
    environment = {**nowhere, "PYTHONPATH": str(place), "PYTHONDONTWRITEBYTECODE": "1"}
    # Permissions count for root only without this capability.
    powers = "-dac_override,-dac_read_search"
    prefix = ["setpriv", f"--bounding-set={powers}", f"--inh-caps={powers}"]
    process = Process(
        folder / "read-only", environment=environment, prefix=prefix if os.geteuid() == 0 else []
    )
    code, _ = process.end()
    same = code == 0 and content(folder / "read-only" / "run.h5") == whole
    for path in (place, *place.rglob("*")):
        path.chmod(0o755)
    return [Row("read-only package and caches", 1, int(same))]


def fuzzed(folder: Path, quick: bool) -> list[Row]:
    """Any scenes, designs and run files run or are refused by name, with bounds checking too."""
    rows = []
    modes = {"": 1, "NUMBA_BOUNDSCHECK": 1, "NUMBA_DISABLE_JIT": 4}  # where less is done
    for mode, share in modes.items():
        share *= 20 if quick else 1
        counts = {"scenes": 2000, "designs": 500, "files": 500}
        options = [f"--{name}={number // share}" for name, number in counts.items()]
        cache = {"NUMBA_CACHE_DIR": str(folder / mode)} if mode else {}
        found = folder / f"fuzz{mode}.json"
        subprocess.run(
            [sys.executable, str(Path(__file__).with_name("fuzz.py")), *options, f"--json={found}"],
            env={**os.environ, **cache, **({mode: "1"} if mode else {})}, check=False,
            stdout=sys.stderr,
        )  # fmt: skip
        named = f", {mode}" if mode else ""
        for row in json.loads(found.read_text()):
            remark = f"{row['ran']} ran; {row['refused']} refused"
            good = row["tried"] - len(row["failures"])
            rows.append(Row(f"any {row['what']}{named}", row["tried"], good, remark))
        show(f"fuzzing{named}")
    return rows


def show(text: str) -> None:
    """A line of progress."""
    print(f"  {text}", file=sys.stderr, flush=True)


def campaign(folder: Path, quick: bool) -> list[Row]:
    """All faults, in a folder of runs."""
    dice = random.Random(20261126)
    whole = finished(folder / "whole")
    again = finished(folder / "again", environment={"MPMOPT_THREADS": "2"})
    rows = [Row("nothing, with two threads", 1, int(again == whole))]
    rows += kills(folder, whole, 8 if quick else 100, dice)
    rows += ensembles(folder, 2 if quick else 30, dice)
    rows += signals(folder, whole, dice, 1 if quick else 5)
    rows += full_disk(folder, whole, 2 if quick else 10, dice)
    rows += scratch(folder, whole)
    rows += company(folder, whole)
    rows += read_only(folder, whole)
    rows += fuzzed(folder, quick)
    return rows


def main(argv: list[str] | None = None) -> int:
    """Run the campaign and print its table; 1 if anything was not survived."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, required=True, metavar="DIR", help="folder of results")
    parser.add_argument("--quick", action="store_true", help="a few of each kind")
    parser.add_argument("--child", action="store_true", help=argparse.SUPPRESS)
    parser.add_argument("--case", choices=CASES, default="walker", help=argparse.SUPPRESS)
    parser.add_argument("--phase", type=Path, help=argparse.SUPPRESS)
    parser.add_argument("--on-disk", action="store_true", help=argparse.SUPPRESS)
    arguments = parser.parse_args(argv)
    if arguments.child:
        return child(arguments.case, arguments.out, arguments.phase, arguments.on_disk)
    arguments.out.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=arguments.out, ignore_cleanup_errors=True) as folder:
        rows = campaign(Path(folder), arguments.quick)
    table = as_csv([dataclasses.asdict(row) for row in rows])
    replace_file(arguments.out / "faults.csv", table.encode())
    print(table, end="")
    lost = sum(row.done - row.survived for row in rows)
    print(f"{sum(row.done for row in rows)} faults, {lost} not survived")
    return 1 if lost else 0


if __name__ == "__main__":
    sys.exit(main())
