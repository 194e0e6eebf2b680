"""Changes that make the program wrong, and the tests that notice: are they noticed?

Run as a program it makes each change in turn and runs the tests named with it, all of them or those
whose module or name begins with what is given::

    python tests/changes.py [NAME...]

They are in ``changes.txt``. The source is changed while it is imported, so no file is touched.
Kernels that are changed run without the JIT: nothing is compiled for a change, and nothing compiled
hides it. Wrong adjoints are in ``wrong_adjoints.py``, which asks more: that each check of a
gradient finds them.
"""

import importlib.abc
import importlib.machinery
import importlib.util
import os
import signal
import sys
import tempfile
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).parent.parent
KERNELS = "kernels."  # modules that are compiled
SECONDS = 300  # for the tests of a change


class Change(NamedTuple):
    """What is replaced in a module, and which tests shall fail."""

    name: str
    module: str
    old: str
    new: str
    tests: str  # as pytest takes them, below tests/

    @property
    def path(self) -> Path:
        """The module's file."""
        return ROOT / "mpmopt" / f"{self.module.replace('.', '/')}.py"

    @property
    def text(self) -> str:
        """The module's source with the change."""
        text = (self.path).read_text()
        if text.count(self.old) != 1:
            raise ValueError(f"{self.name}: {text.count(self.old)} places for {self.old!r}")
        return text.replace(self.old, self.new)


class Importer(importlib.machinery.SourceFileLoader, importlib.abc.MetaPathFinder):  # type: ignore[misc]
    """Imports the changed module in the place of the real one."""

    def __init__(self, change: Change) -> None:
        name = f"mpmopt.{change.module}"
        super().__init__(name, str(change.path))
        self.code = compile(change.text, self.path, "exec", dont_inherit=True)

    def find_spec(self, name, path, target=None):
        if name == self.name:
            return importlib.util.spec_from_file_location(name, self.path, loader=self)
        return None

    def get_code(self, fullname):
        return self.code


def run_tests(tests: Sequence[str], jit: bool, change: Change | None) -> int:
    """Exit code of pytest on a changed program, in a process that has not imported it yet."""
    import numba
    import pytest

    os.environ["NUMBA_DISABLE_JIT"] = str(int(not jit))
    numba.config.reload_config()
    if change is not None:
        sys.meta_path.insert(0, Importer(change))
    sys.path[:0] = [str(ROOT), str(ROOT / "cases"), str(ROOT / "tests")]
    os.chdir(ROOT)
    signal.alarm(SECONDS)
    return pytest.main(["-x", "-q", "-p", "no:cacheprovider", *(f"tests/{test}" for test in tests)])


Job = tuple[Sequence[str], bool, Change | None]


def outcomes(jobs: Sequence[Job]) -> Iterator[tuple[int, int, str]]:
    """Of `run_tests` in a process for each job, as they end: its index, exit code and output.

    What takes long to import they have from this one.
    """
    import h5py  # noqa: F401
    import matplotlib.figure  # noqa: F401
    import numba  # noqa: F401
    import pytest  # noqa: F401
    import scipy.optimize  # noqa: F401

    sys.stdout.flush()
    waiting = list(range(len(jobs)))[::-1]
    running: dict[int, int] = {}
    with tempfile.TemporaryDirectory() as folder:
        while waiting or running:
            if waiting and len(running) < (os.cpu_count() or 1):
                index = waiting.pop()
                pid = os.fork()
                if pid == 0:
                    _child(jobs[index], f"{folder}/{index}")
                running[pid] = index
            else:
                pid, status = os.wait()
                index = running.pop(pid)
                output = Path(folder, str(index)).read_text()
                yield index, os.waitstatus_to_exitcode(status), output


def _child(job: Job, output: str) -> None:
    code = 3  # as pytest's for an error of its own
    try:
        file = os.open(output, os.O_CREAT | os.O_WRONLY)
        os.dup2(file, 1)
        os.dup2(file, 2)
        code = int(run_tests(*job))
        sys.stdout.flush()
    finally:
        os._exit(code)


def verdict(code: int, output: str, tests: str) -> str:
    """Empty if the tests noticed a change, else what happened instead."""
    if code == 1:
        return ""
    if code == 0:
        return f"not noticed by {tests}"
    if code == -signal.SIGALRM:
        return f"{tests} did not end within {SECONDS} s"
    return f"{tests} ended with {code}: {output[-500:]}"


def main(names: Sequence[str]) -> int:
    """Exit code: 0 if each change was noticed, and nothing fails without one."""
    changes = [c for c in CHANGES if not names or f"{c.module} {c.name}".startswith(tuple(names))]
    by_jit = {
        jit: [c.tests for c in changes if (not c.module.startswith(KERNELS)) == jit]
        for jit in (True, False)
    }
    plain = [
        (sorted({test for text in texts for test in text.split()}), jit, None)
        for jit, texts in by_jit.items()
        if texts
    ]
    for _, code, output in outcomes(plain):
        if code:
            print(f"tests fail without any change:\n{output}")
            return 1
    noticed = 0
    jobs = [
        (change.tests.split(), not change.module.startswith(KERNELS), change) for change in changes
    ]
    for index, code, output in outcomes(jobs):
        what = verdict(code, output, changes[index].tests)
        noticed += not what
        print(
            f"{changes[index].module:<22}{changes[index].name:<56}{what or 'noticed'}", flush=True
        )
    print(f"{noticed} of {len(changes)} changes noticed")
    return int(noticed < len(changes))


def _changes() -> Iterator[Change]:
    """Those of ``changes.txt``, which says how it is to be read."""
    module = common = ""
    text = (ROOT / "tests" / "changes.txt").read_text()
    for section in text.split("\n== ")[2:]:
        head, *entries = section.split("\n* ")
        module, _, common = head.partition(": ")
        for entry in entries:
            name, *lines = entry.rstrip("\n").split("\n")
            own, old, new = (
                [line[2:] for line in lines if line.startswith(sign)] for sign in "@-+"
            )
            if not new:
                old.append("")
            tests = own[0] if own else common.strip()
            yield Change(name, module, "\n".join(old), "\n".join(new), tests)


CHANGES = tuple(_changes())

if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
