"""The command line: what it says of itself is true."""

import argparse
import configparser
import importlib.util
import os
import re
import shlex
import shutil
import signal
import subprocess
import sys
from pathlib import Path

import pytest
from conftest import empty

import mpmopt
from mpmopt import __main__ as commands
from mpmopt.io.console import Interrupted
from mpmopt.results import runfile

ROOT = Path(__file__).parent.parent
PARSER = commands._parser()
SUBPARSERS = next(
    action.choices for action in PARSER._actions if isinstance(action, argparse._SubParsersAction)
)


def command(*arguments):
    """``python -m mpmopt`` as a process of its own."""
    return subprocess.run(
        [sys.executable, "-m", "mpmopt", *map(str, arguments)],
        capture_output=True, text=True, timeout=120, cwd=ROOT,
    )  # fmt: skip


def examples(name):
    """Arguments of the examples in a command's help."""
    lines = re.findall(
        r"^  mpmopt (.*)$", SUBPARSERS[name].format_help().split("examples:")[1], re.MULTILINE
    )
    return [shlex.split(line) for line in lines]


def first_example(name, path):
    """Its first example, on another run file."""
    return [str(path) if part == "out/walker/run.h5" else part for part in examples(name)[0]]


@pytest.mark.parametrize("name", SUBPARSERS)
def test_the_examples_of_each_command_are_understood(name):
    assert examples(name)
    for example in examples(name):
        assert example[0] == name
        assert "out/walker/run.h5" in example
        assert callable(PARSER.parse_args(example).do)


def test_the_help_lists_every_command_and_its_examples_are_understood():
    help_text = PARSER.format_help()
    for name in SUBPARSERS:
        assert re.search(rf"^    {name}\b", help_text, re.MULTILINE)
    shown = re.findall(r"^  mpmopt ([a-z]+ \S+)", help_text, re.MULTILINE)
    assert len(shown) >= 3
    for example in shown:
        name, option = example.split()
        if name not in commands.ROBOTS:
            PARSER.parse_args([name, option])
    assert f"  {', '.join(commands.ROBOTS)}\n" in help_text


@pytest.mark.process
@pytest.mark.parametrize("name", commands.ROBOTS)
def test_a_robot_is_asked_for_in_a_clone_as_its_script_is(name, monkeypatch):
    monkeypatch.setenv("COLUMNS", "200")
    done = command(name, "--help")
    script = subprocess.run(
        [sys.executable, f"cases/{name}.py", "--help"], capture_output=True, text=True, cwd=ROOT,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
    )  # fmt: skip
    assert (done.returncode, script.returncode) == (0, 0), done.stderr + script.stderr
    assert done.stdout.split()[3:] == script.stdout.split()[2:]


def test_the_installed_command_is_this_one():
    settings = configparser.ConfigParser()
    settings.read(ROOT / "setup.cfg")
    name, target = settings["options.entry_points"]["console_scripts"].strip().split(" = ")
    module, function = target.split(":")
    assert name == PARSER.prog
    assert getattr(importlib.import_module(module), function) is commands.main


HOW = """
from setuptools import Distribution
package = Distribution()
package.parse_config_files(["setup.cfg"])
install = package.get_command_obj("editable_wheel")
install.ensure_finalized()
print(type(install._select_strategy("mpmopt", "", "")).__name__)
"""


@pytest.mark.process
def test_an_editable_install_is_an_entry_of_the_path():
    """A finder would come too late in the folder above a clone: to Python that is a package."""
    if importlib.util.find_spec("setuptools") is None:
        pytest.skip("needs setuptools")
    done = subprocess.run(
        [sys.executable, "-c", HOW], capture_output=True, text=True, timeout=120, cwd=ROOT
    )
    assert done.stdout == "_StaticPth\n", done.stderr


@pytest.mark.process
def test_a_folder_of_the_packages_name_does_not_hide_it(tmp_path):
    (tmp_path / "mpmopt" / "docs").mkdir(parents=True)
    done = subprocess.run(
        [sys.executable, "-m", "mpmopt", "--version"], capture_output=True, text=True, timeout=120,
        cwd=tmp_path, env={**os.environ, "PYTHONPATH": str(ROOT)},
    )  # fmt: skip
    assert (done.returncode, done.stdout) == (0, f"mpmopt {mpmopt.__version__}\n")


@pytest.mark.process
def test_exit_codes_are_those_of_the_help(tmp_path, monkeypatch, capsys):
    said = command("--version")
    assert (said.returncode, said.stdout) == (0, f"mpmopt {mpmopt.__version__}\n")
    for wrong in ([], ["fly"], ["plot"], ["film", "run.h5", "--seconds", "long"]):
        with pytest.raises(SystemExit) as end:
            commands.main(wrong)
        assert end.value.code == 2
    capsys.readouterr()
    for name in SUBPARSERS:
        assert commands.main(first_example(name, tmp_path / "run.h5")) == 1
        assert capsys.readouterr().err.startswith("RunFileError: ")

    def interrupted(path):
        raise Interrupted(signal.SIGTERM)

    monkeypatch.setattr(runfile, "read_run", interrupted)
    assert commands.main(["verify", "run.h5"]) == 143
    assert capsys.readouterr().err == "\nstopped by SIGTERM. Files are complete or absent.\n"


def test_each_command_refuses_a_run_without_a_design(short_run, tmp_path, capsys):
    path = tmp_path / "run.h5"
    runfile.write(path, empty(short_run.scene))
    for name in SUBPARSERS.keys() - {"resume"}:
        assert commands.main(first_example(name, path)) == 1
        assert "no design: no evaluation succeeded yet" in capsys.readouterr().err
    assert [file.name for file in tmp_path.iterdir()] == ["run.h5"]


WRITES = {
    "plot": (["--out"], "reference.png"),
    "film": (["--seconds", "0.4", "--out"], "film.gif"),
    "film --mp4": (["--seconds", "0.4", "--mp4", "--out"], "film.mp4"),
    "export": (["--svg", "--width", "60", "--out"], "design.svg"),
}


@pytest.mark.parametrize("name", WRITES)
def test_files_at_another_place_are_replaced_only_by_force(short_path, tmp_path, capsys, name):
    options, written = WRITES[name]
    file = tmp_path / written
    out = file if name.startswith("film") else tmp_path
    words = [name.split()[0], str(short_path), *options, str(out)]
    file.write_text("somebody's")
    assert commands.main(words) == 1
    assert capsys.readouterr().err.startswith(f"StorageError: {file} is there already; choose")
    assert [(path.name, path.read_text()) for path in tmp_path.iterdir()] == [
        (written, "somebody's")
    ]
    assert commands.main([*words, "--force"]) == 0
    assert len(file.read_bytes()) > 100
    # Without --out, what the command made in the run's folder is made anew.
    run = shutil.copy(short_path, tmp_path / "run.h5")
    file.write_text("made before")
    assert commands.main([name.split()[0], str(run), *options[:-1]]) == 0
    assert len(file.read_bytes()) > 100


@pytest.mark.parametrize("kind", ["folder", "pipe", "link to nothing", "link to a device"])
def test_what_is_no_file_is_there_already_and_not_even_read(short_path, tmp_path, capsys, kind):
    film = tmp_path / "film.gif"
    if kind == "folder":
        film.mkdir()
    elif kind == "pipe":
        os.mkfifo(film)
    else:
        film.symlink_to("/dev/zero" if kind == "link to a device" else tmp_path / "nothing")
    assert commands.main(["film", str(short_path), "--out", str(film)]) == 1
    assert capsys.readouterr().err.startswith(f"StorageError: {film} is there already")


def test_a_place_that_cannot_be_is_an_error_in_a_line(short_path, tmp_path, capsys):
    for command in ("plot", "film", "export --svg --width 60"):
        name, *options = command.split()
        out = tmp_path / (300 * "x") / "film.gif"
        assert commands.main([name, str(short_path), *options, "--out", str(out)]) == 1
        assert capsys.readouterr().err.startswith("StorageError: cannot write to")
        assert commands.main([name, str(out), *options]) == 1
        assert capsys.readouterr().err.startswith("RunFileError: ")


@pytest.mark.process
def test_a_reader_that_goes_away_is_an_error_in_a_line(short_path):
    reader, writer = os.pipe()
    os.close(reader)
    done = subprocess.run(
        [sys.executable, "-m", "mpmopt", "postprocess", str(short_path)],
        stdout=writer, stderr=subprocess.PIPE, text=True, timeout=120, cwd=ROOT,
    )  # fmt: skip
    os.close(writer)
    assert (done.returncode, done.stderr) == (1, "BrokenPipeError: [Errno 32] Broken pipe\n")


@pytest.mark.process
def test_a_path_that_standard_output_cannot_say_is_escaped(short_path, tmp_path):
    folder = tmp_path / os.fsdecode(b"gr\xc3\xbcn\xff")
    folder.mkdir()
    shutil.copy(short_path, folder / "run.h5")
    done = subprocess.run(
        [sys.executable, "-m", "mpmopt", "export", folder / "run.h5", "--svg", "--width", "60"],
        capture_output=True, text=True, timeout=120, cwd=ROOT,
        env={**os.environ, "PYTHONIOENCODING": "ascii:strict", "PYTHONUTF8": "1"},
    )  # fmt: skip
    assert (done.returncode, done.stderr) == (0, "")
    assert f"{tmp_path}/gr\\xfcn\\udcff/design.svg  " in done.stdout


STOPPED = """
import os, signal, sys
from mpmopt.io.console import reported
def work():
    print("half a line", end="")
    os.kill(os.getpid(), signal.SIGINT)
sys.exit(reported(work, lambda: "Advice."))
"""


@pytest.mark.process
def test_a_signal_counts_even_if_nobody_reads(tmp_path):
    with Path("/dev/full").open("w") as full:
        done = subprocess.run(
            [sys.executable, "-c", STOPPED],
            stdout=full, stderr=subprocess.PIPE, text=True, timeout=120, cwd=ROOT,
            env={name: value for name, value in os.environ.items() if name != "PYTHONUNBUFFERED"},
        )  # fmt: skip
    assert (done.returncode, done.stderr) == (130, "\nstopped by SIGINT. Advice.\n")


@pytest.mark.process
def test_nobody_needs_to_listen_to_progress(short_path, tmp_path):
    film = tmp_path / "film.gif"
    command = f"{sys.executable} -m mpmopt film {short_path} --seconds 0.4 --out {film}"
    for stream in ("2>&-", ">&- 2>&-", "2>/dev/full"):
        done = subprocess.run(f"{command} {stream}", shell=True, timeout=120, cwd=ROOT)
        assert done.returncode == 0
        film.unlink()
