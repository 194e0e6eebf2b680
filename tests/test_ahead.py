"""Two processes compile at the first start: the same bits, and none is left behind."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from numba import config

from mpmopt.simulation.threads import processors

pytestmark = [
    pytest.mark.cache,
    pytest.mark.skipif(bool(getattr(config, "DISABLE_JIT", 0)), reason="nothing is compiled"),
]
LOOPS = """
import os, sys, time
from mpmopt.kernels.compiler import loop_jit

if "help_out" in sys.orig_argv[-1]:
    {}

@loop_jit
def here(x):
    return x + 1.0

@loop_jit
def there(x):
    return x + 2.0
"""
PROGRAM = """
import os
from loops import here, there
from mpmopt.simulation.ahead import compile_in_two
{}
compile_in_two("loops", lambda: [([(here, (1.0,))], [(there, (1.0,))])])
print(here(1.0) + there(1.0), sum(there.stats.cache_hits.values()))
"""
GRADIENT = """
from dataclasses import replace
from walker import walker, walker_on_ground
from mpmopt import kernels
from mpmopt.design.problem import Problem
from mpmopt.kernels import lagrangian, lattice_indicators, pairs

scene = {scene}
problem = Problem(replace(scene, steps=20, transient=0.0))
value, gradient = problem.value_and_gradient(problem.join(0.0, 1.0, -0.3, -0.5))
print(value.hex(), hash(gradient.tobytes()))
here, there = {here}, {there}
print({{len(loop.signatures) for loop in here + there}})
for loops in here, there:
    print({{sum(loop.stats.cache_hits.values()) for loop in loops}})
"""
LATTICE = {
    "scene": "walker_on_ground(64, 4e-4, 4.0)",
    "here": "(lattice_indicators.look, lagrangian.particles, lagrangian.forces, lagrangian.press, "
    "lagrangian.forces_adjoint, lagrangian.press_adjoint, lagrangian.advance_lattice)",
    "there": "(pairs.renewed, lagrangian.move, lagrangian.advance_lattice_adjoint)",
}
PARTICLES = {
    "scene": "walker(64, 4e-4)",
    "here": "(kernels.advance,)",
    "there": "(kernels.closest, kernels.grips, kernels.energy, kernels.indicators, "
    "kernels.advance_adjoint)",
}


def started(
    tmp_path: Path, program: str, helper: str = "pass", **environment: str
) -> subprocess.Popen:
    """A program with a cache of its own, and the loops that it may import."""
    tmp_path.mkdir(exist_ok=True)
    (tmp_path / "loops.py").write_text(LOOPS.format(helper))
    path = os.pathsep.join([str(tmp_path), *sys.path])
    others = {name: value for name, value in os.environ.items() if name != "MPMOPT_THREADS"}
    return subprocess.Popen(
        [sys.executable, "-c", program],
        env={**others, "PYTHONPATH": path, "NUMBA_CACHE_DIR": str(tmp_path / "cache"),
             "PYTHONHASHSEED": "0", **environment},
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, start_new_session=True,
    )  # fmt: skip


def printed(*args, **kwargs) -> str:
    process = started(*args, **kwargs)
    output, errors = process.communicate()
    assert process.returncode == 0, errors
    assert not errors
    return output


@pytest.mark.skipif(processors() < 2, reason="one processor")
def test_the_helper_compiles_its_loops(tmp_path):
    assert printed(tmp_path, PROGRAM.format("")) == "5.0 1\n"
    assert printed(tmp_path, PROGRAM.format("")) == "5.0 1\n"  # from the disk


@pytest.mark.parametrize(
    ("helper", "before", "environment"),
    [
        ("pass", "", {"MPMOPT_THREADS": "1"}),
        pytest.param(
            "pass",
            "os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})",
            {},
            marks=pytest.mark.skipif(
                not hasattr(os, "sched_setaffinity"), reason="no process has processors of its own"
            ),
        ),
        ("pass", "import sys; sys.executable = '/nowhere'", {}),
        ("pass", "import sys; sys.executable = '/bin/true'", {}),  # ends before it hears anything
        ("raise OSError('broken')", "", {}),
    ],
)
def test_without_a_helper_all_is_compiled_here(tmp_path, helper, before, environment):
    assert printed(tmp_path, PROGRAM.format(before), helper, **environment) == "5.0 0\n"


def test_without_the_compiler_there_is_nothing_to_do(tmp_path):
    program = PROGRAM.format("").replace(", sum(there.stats.cache_hits.values())", "")
    assert printed(tmp_path, program, NUMBA_DISABLE_JIT="1") == "5.0\n"


def lives(number: int) -> bool:
    """Whether a process is there, and is not only listed because nobody asked how it ended."""
    stat = Path(f"/proc/{number}/stat")
    return stat.exists() and stat.read_text().rpartition(")")[2].split()[0] != "Z"


@pytest.mark.skipif(not Path("/proc").exists(), reason="Linux lists processes there")
def test_no_helper_outlives_a_program_that_is_killed(tmp_path):
    pid = tmp_path / "pid"
    helper = f"open({str(pid)!r}, 'w').write(str(os.getpid())); time.sleep(600)"
    # Where the tests run in the background, Python ignores what is sent to it otherwise.
    before = "import signal; signal.signal(signal.SIGINT, signal.default_int_handler)"
    for sent in (signal.SIGINT, signal.SIGKILL):
        process = started(tmp_path, PROGRAM.format(before), helper)
        while not (pid.exists() and pid.read_text()):
            assert process.poll() is None
            time.sleep(0.01)
        number = int(pid.read_text())
        pid.unlink()
        if sent == signal.SIGINT:  # which a terminal sends to both: this one leaves it to the other
            os.kill(number, sent)
            time.sleep(1.0)
            assert lives(number)
        process.send_signal(sent)
        process.communicate()  # until none has its output or errors
        assert process.returncode != 0
        until = time.monotonic() + 30.0
        while lives(number):
            assert time.monotonic() < until
            time.sleep(0.01)


@pytest.mark.slow
@pytest.mark.skipif(processors() < 2, reason="one processor")
@pytest.mark.parametrize("loops", [LATTICE, PARTICLES], ids=["lattice", "particles"])
def test_a_gradient_has_the_same_bits_and_no_loop_is_compiled_for_other_types(tmp_path, loops):
    alone, two = (
        printed(tmp_path / name, GRADIENT.format(**loops), **environment).splitlines()
        for name, environment in (("one", {"MPMOPT_THREADS": "1"}), ("two", {}))
    )
    assert alone == [two[0], "{1}", "{0}", "{0}"]
    assert two[1:] == ["{1}", "{0}", "{1}"]
