"""Linter, formatter and type checker are clean, and the package is typed for who uses it."""

import subprocess
import sys
from pathlib import Path

import pytest

import mpmopt

ROOT = Path(__file__).parent.parent
pytestmark = pytest.mark.process


def run(*command: str, cwd: Path = ROOT) -> subprocess.CompletedProcess:
    return subprocess.run(
        [sys.executable, "-m", *command], capture_output=True, text=True, cwd=cwd
    )  # fmt: skip


@pytest.mark.parametrize("tool", ["ruff check .", "ruff format --check .", "mypy"])
def test_style(tool):
    done = run(*tool.split())
    assert done.returncode == 0, done.stdout


def test_a_wrong_name_of_the_package_is_an_error_and_no_right_one_is_of_any_type(tmp_path):
    names = list(mpmopt._HOMES)
    assert {"Scene", "optimise", "read_run"} <= set(names)
    lines = ["import mpmopt", "mpmopt.nonsense", *(f"reveal_type(mpmopt.{n})" for n in names)]
    (tmp_path / "user.py").write_text("\n".join(lines))
    done = run("mypy", "--config-file", str(ROOT / "setup.cfg"), str(tmp_path / "user.py"))
    errors = [line for line in done.stdout.splitlines() if "error:" in line]
    assert len(errors) == 1, done.stdout + done.stderr
    assert 'Module has no attribute "nonsense"' in errors[0]
    assert done.stdout.count("Revealed type is") == len(names)
    assert 'Revealed type is "Any"' not in done.stdout
