"""What is packed: the source distribution holds all of a clone, and a wheel of it makes robots."""

import shlex
import shutil
import signal
import subprocess
import sys
import tarfile
import time
from pathlib import Path

import pytest

from mpmopt.__main__ import ROBOTS

ROOT = Path(__file__).parent.parent
FOLDERS = ("mpmopt", "tests", "cases", "docs")
NOT_OURS = shutil.ignore_patterns(
    ".*", "__pycache__", "_build", "_gallery", "out", "build", "*.egg-info"
)
BUILD = "import sys; from setuptools import build_meta; print(build_meta.{}(sys.argv[1]))"
pytestmark = pytest.mark.process


def build(kind, source, out):
    """Pack a folder; the archive."""
    command = [sys.executable, "-c", BUILD.format(kind), out]
    done = subprocess.run(command, cwd=source, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return out / done.stdout.split()[-1]


@pytest.fixture(scope="module")
def clone(tmp_path_factory):
    pytest.importorskip("setuptools", "77")
    return shutil.copytree(ROOT, tmp_path_factory.mktemp("clone") / "clone", ignore=NOT_OURS)


@pytest.fixture(scope="module")
def sdist(clone, tmp_path_factory):
    """The unpacked source distribution."""
    folder = tmp_path_factory.mktemp("sdist")
    with tarfile.open(build("build_sdist", clone, folder)) as archive:
        archive.extractall(folder)
    return next(path for path in folder.iterdir() if path.is_dir())


@pytest.fixture(scope="module")
def installed(sdist, tmp_path_factory):
    """A folder with what pip installs of the wheel of the source distribution."""
    pytest.importorskip("pip")
    folder = tmp_path_factory.mktemp("wheel")
    wheel = build("build_wheel", sdist, folder)
    options = ["--no-deps", "--no-index", "--no-compile", "--target", folder / "site"]
    command = [sys.executable, "-m", "pip", "install", "-q", *options, wheel]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return folder / "site"


@pytest.fixture
def surroundings(installed, tmp_path, monkeypatch):
    """An empty folder to be in, from which only the wheel's package is found."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("PYTHONPATH", str(installed))
    monkeypatch.setenv("NUMBA_DISABLE_JIT", "1")
    return tmp_path


def test_the_source_distribution_holds_all_that_a_clone_holds(clone, sdist):
    wanted = {path.relative_to(clone) for name in FOLDERS for path in (clone / name).rglob("*.*")}
    wanted |= {Path("CONTRIBUTING.md"), Path("CHANGELOG.md"), Path("setup.cfg"), Path("ruff.toml")}
    assert len(wanted) > 150
    assert wanted <= {path.relative_to(sdist) for path in sdist.rglob("*.*")}


def test_the_wheel_has_the_robots_the_page_of_the_report_and_types(installed):
    package = installed / "mpmopt"
    assert {path.stem for path in (package / "cases").iterdir()} == set(ROBOTS)
    assert (package / "py.typed").is_file()
    assert (package / "view" / "report.html").is_file()
    assert {path.name.split("-")[0] for path in installed.iterdir()} == {"mpmopt", "bin"}


@pytest.mark.parametrize("name", ROBOTS)
def test_an_installed_command_knows_every_robot(installed, surroundings, name):
    command = [installed / "bin" / "mpmopt", name, "--help"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr
    assert done.stdout.startswith(f"usage: mpmopt {name} ")


def test_an_installed_robot_that_is_stopped_says_how_to_go_on(installed, surroundings, short_path):
    run = Path("out/robot/run.h5")
    command = [installed / "bin" / "mpmopt", "silicone", "--out", run.parent]
    process = subprocess.Popen(command, stderr=subprocess.PIPE, text=True)
    try:
        while process.poll() is None and not run.exists():
            time.sleep(0.001)  # an evaluation that has begun ends first: minutes without the JIT
        process.send_signal(signal.SIGINT)
        said = process.communicate(timeout=600)[1]
    finally:
        process.kill()
    assert process.returncode == 130, said
    pasted = shlex.split(said.strip().split("go on with: ")[1])
    assert pasted[-2:] == ["resume", str(run)]
    shutil.copy(short_path, run)  # one that is soon at its end
    done = subprocess.run(pasted, capture_output=True, text=True, timeout=600)
    assert done.returncode == 0, done.stderr
    assert (run.parent / "report.html").exists()
    following = shlex.split(done.stdout.splitlines()[-1].removeprefix("next"))
    assert following[1:4] == ["-m", "mpmopt", "film"]
    assert Path(following[4]).samefile(run)
