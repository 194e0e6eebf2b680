"""What the disk keeps of kernels is never stale, and found again."""

import os
import shutil
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest
from conftest import small_scene
from numba import config

from mpmopt import kernels
from mpmopt.design.problem import Problem
from mpmopt.kernels import compiler
from mpmopt.simulation import buffers, lagrangian

compiled = pytest.mark.skipif(bool(getattr(config, "DISABLE_JIT", 0)), reason="nothing is compiled")
LOOP = """
from kernels.callee import callee
from kernels.compiler import loop_jit

@loop_jit
def loop(x):
    return callee(x)
"""
CALLEE = """
from kernels.compiler import jit

@jit
def callee(x):
    return x + {}
"""
PROGRAM = """
from kernels.loop import loop
print(loop(1.0), sum(loop.stats.cache_hits.values()))
"""
ENDED = (
    """
import os
replace, replaced = os.replace, []

def ended_between(*names):
    if replaced:
        os._exit(3)
    replaced.append(replace(*names))

os.replace = ended_between
"""
    + PROGRAM
)


class Package:
    """A loop that calls a function of another file, in a folder of its own."""

    def __init__(self, folder: Path):
        self.folder = folder
        self.kernels = folder / "kernels"
        self.kernels.mkdir()
        shutil.copy(compiler.__file__, self.kernels)
        (self.kernels / "loop.py").write_text(LOOP)

    def write(self, number: str) -> None:
        """The number that the callee adds."""
        (self.kernels / "callee.py").write_text(CALLEE.format(number))

    def start(self, program: str = PROGRAM) -> subprocess.CompletedProcess[str]:
        path = str(self.folder)
        return subprocess.run(
            [sys.executable, "-c", program],
            env={**os.environ, "PYTHONPATH": path, "NUMBA_CACHE_DIR": path},
            cwd=path, capture_output=True, text=True,
        )  # fmt: skip

    def run(self) -> tuple[float, int]:
        """The loop's result, and how often it came from the disk."""
        done = self.start()
        assert not done.returncode, done.stderr
        value, hits = done.stdout.split()
        return float(value), int(hits)


@pytest.mark.cache
@compiled
def test_an_edited_callee_in_another_file_is_never_stale(tmp_path):
    package = Package(tmp_path)
    package.write("1.0")
    assert package.run() == (2.0, 0)
    assert package.run() == (2.0, 1)
    package.write("2.0")
    assert package.run() == (3.0, 0)
    assert package.run() == (3.0, 1)
    assert len(list(tmp_path.rglob("loop.loop*.nbc"))) == 1


@pytest.mark.cache
@compiled
def test_a_process_that_is_ended_while_it_writes_leaves_nothing_stale(tmp_path):
    package = Package(tmp_path)
    package.write("1.0")
    assert package.run() == (2.0, 0)
    package.write("2.0")
    assert package.start(ENDED).returncode == 3
    assert package.run()[0] == 3.0


def test_a_loop_is_to_compile_where_the_disk_has_none_and_numba_tells():
    """Its private parts may go one day: no first start dies of that."""
    index: dict[str, str] = {}
    file = SimpleNamespace(_load_index=lambda: index)
    cache = SimpleNamespace(_cache_file=file, _index_key=lambda types, codegen: "key")
    loop = SimpleNamespace(
        _cache=cache, typeof_pyval=type, overloads={}, targetctx=SimpleNamespace(codegen=str)
    )
    assert compiler.is_to_compile(loop, (1.0,))
    index["key"] = "compiled"
    assert not compiler.is_to_compile(loop, (1.0,))

    def unreadable():
        raise OSError

    file._load_index = unreadable
    assert not compiler.is_to_compile(loop, (1.0,))
    cache._index_key = lambda types: "key"
    assert not compiler.is_to_compile(loop, (1.0,))
    del cache._index_key
    assert not compiler.is_to_compile(loop, (1.0,))
    assert not compiler.is_to_compile(unreadable, ())


@pytest.mark.parametrize("formulation", ["updated", "total"])
def test_a_run_of_no_steps_compiles_nothing(formulation, monkeypatch):
    asked: list[str] = []
    for module in (buffers, lagrangian):
        monkeypatch.setattr(module, "compile_in_two", lambda what, loops: asked.append(what))
    problem = Problem(small_scene(walls=(), formulation=formulation))
    segment = problem.simulation(problem.join(0.0, 0.5, 0.0, 0.0)).segment(1)
    segment.advance(0, 0)
    assert not asked
    segment.advance(0, 1)
    assert len(asked) == 1


def test_the_way_back_is_compiled_only_where_it_is_gone():
    problem = Problem(small_scene(walls=()))
    simulation = problem.simulation(problem.join(0.0, 0.5, 0.0, 0.0))
    adjoint = kernels.advance_adjoint
    for memory in (None, buffers.Memory()):
        ((_, theirs),) = simulation.segment(1, memory)._loops()
        assert any(loop is adjoint for loop, _ in theirs) == (memory is not None)
