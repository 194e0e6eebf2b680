"""What the disk keeps of kernels is never stale, and found again."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from numba import config

from mpmopt.kernels import compiler

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
