"""The source distribution holds its own tests, cases and pages."""

import shutil
import subprocess
import sys
import tarfile
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
FOLDERS = ("mpmopt", "tests", "cases", "docs")
NOT_OURS = shutil.ignore_patterns(
    ".*", "__pycache__", "_build", "_gallery", "out", "build", "*.egg-info"
)
BUILD = "import sys; from setuptools import build_meta; print(build_meta.build_sdist(sys.argv[1]))"


@pytest.mark.process
def test_the_source_distribution_holds_all_that_a_clone_holds(tmp_path):
    pytest.importorskip("setuptools", "77")
    clone = shutil.copytree(ROOT, tmp_path / "clone", ignore=NOT_OURS)
    wanted = {path.relative_to(clone) for name in FOLDERS for path in (clone / name).rglob("*.*")}
    wanted |= {Path("CONTRIBUTING.md"), Path("CHANGELOG.md"), Path("setup.cfg"), Path("ruff.toml")}
    done = subprocess.run(
        [sys.executable, "-c", BUILD, tmp_path], cwd=clone, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr
    with tarfile.open(tmp_path / done.stdout.split()[-1]) as archive:
        held = {Path(*Path(name).parts[1:]) for name in archive.getnames()}
    assert len(wanted) > 150
    assert wanted <= held
