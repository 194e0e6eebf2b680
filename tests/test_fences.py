"""Rooms and their fences, as `setup.cfg` has them, and the page that tells of them."""

import ast
import configparser
import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
PACKAGE = ROOT / "mpmopt"
PAGE = (ROOT / "docs" / "architecture.rst").read_text()


@pytest.mark.process
def test_no_room_imports_what_it_must_not():
    command = "from importlinter.cli import lint_imports_command as lint; lint([])"
    done = subprocess.run([sys.executable, "-c", command], cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr
    assert "0 broken" in done.stdout


def test_the_page_shows_the_rooms_as_they_are_fenced():
    config = configparser.ConfigParser()
    config.read(ROOT / "setup.cfg")
    floors = config["importlinter:contract:floors"]["layers"].split()
    fenced = [name.removeprefix("mpmopt.") for name in floors if name != "|"]
    drawn = re.findall(
        r"^   (\w+)  ", PAGE.split(".. code-block:: text")[1].split("Scene,")[0], re.M
    )
    assert drawn == fenced[1:]  # the commands are below the drawing
    folders = {path.parent.name for path in PACKAGE.glob("*/__init__.py")}
    files = {path.stem for path in PACKAGE.glob("*.py")} - {"__init__", "__main__"}
    assert set(drawn) == folders | files


def names_in(path: Path) -> set[str]:
    """All functions, classes and constants that a file defines."""
    nodes = list(ast.walk(ast.parse(path.read_text())))
    kinds = (ast.FunctionDef, ast.ClassDef)
    return {node.name for node in nodes if isinstance(node, kinds)} | {
        target.id
        for node in nodes
        if isinstance(node, ast.Assign)
        for target in node.targets
        if isinstance(target, ast.Name)
    }


def test_what_the_page_says_is_where_it_says():
    said = re.findall(r"``([\w/]+\.py)``((?:: ``\w+``(?:, ``\w+``)*)?)", PAGE)
    assert len(said) > 25
    for file, names in said:
        path = ROOT / file if file.startswith(("tests/", "cases/")) else PACKAGE / file
        assert path.is_file(), file
        assert set(re.findall(r"``(\w+)``", names)) <= names_in(path), file


def test_all_that_makes_a_gradient_is_there():
    drawing = PAGE.split("How a value and a gradient are made")[1]
    known = set().union(*(names_in(path) for path in PACKAGE.rglob("*.py")))
    names = re.findall(r"^ +([\w.]+)(?:\([\w, ]*\))?  ", drawing, re.MULTILINE)
    assert len(names) == 11
    assert {part for name in names for part in name.split(".")} <= known
