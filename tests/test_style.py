"""Linter, formatter and type checker are clean."""

import subprocess
import sys
from pathlib import Path

import pytest


@pytest.mark.parametrize("tool", ["ruff check", "ruff format --check", "mypy"])
def test_style(tool):
    done = subprocess.run(
        [sys.executable, "-m", *tool.split(), *(["."] if "ruff" in tool else [])],
        capture_output=True,
        text=True,
        cwd=Path(__file__).parent.parent,
    )
    assert done.returncode == 0, done.stdout
