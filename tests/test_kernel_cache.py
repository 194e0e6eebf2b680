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

from mpmopt.design.problem import Problem
from mpmopt.kernels import compiler
from mpmopt.simulation import buffers, lagrangian

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


@pytest.mark.cache
@pytest.mark.skipif(bool(getattr(config, "DISABLE_JIT", 0)), reason="nothing is compiled")
def test_an_edited_callee_in_another_file_is_never_stale(tmp_path):
    package = tmp_path / "kernels"
    package.mkdir()
    shutil.copy(compiler.__file__, package)
    (package / "loop.py").write_text(LOOP)

    def run(number: str) -> tuple[float, int]:
        """The loop's result, and how often it came from the disk."""
        callee: Path = package / "callee.py"
        text = CALLEE.format(number)
        if not callee.exists() or callee.read_text() != text:
            callee.write_text(text)
        done = subprocess.run(
            [sys.executable, "-c", PROGRAM],
            env={**os.environ, "PYTHONPATH": str(tmp_path), "NUMBA_CACHE_DIR": str(tmp_path)},
            cwd=tmp_path, capture_output=True, text=True, check=True,
        )  # fmt: skip
        value, hits = done.stdout.split()
        return float(value), int(hits)

    assert run("1.0") == (2.0, 0)
    assert run("1.0") == (2.0, 1)
    assert run("2.0") == (3.0, 0)
    assert run("2.0") == (3.0, 1)


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
