"""Progress: a bar on a terminal, lines elsewhere, results never mixed with either."""

import gc
import os
import struct
import subprocess
import sys
from pathlib import Path

import pytest

from mpmopt.io.progress import Progress

ROOT = Path(__file__).parent.parent
WORK = """
from mpmopt.io.progress import Progress
with Progress("steps", 20) as progress:
    for k in range(20):
        progress.step(f"number {k}")
        progress.print(f"result {k}")
"""


def test_off_a_terminal_there_are_ten_lines(capsys):
    with Progress("frames", 35) as progress:
        for _ in range(35):
            progress.step("all is well")
    lines = capsys.readouterr().err.splitlines()
    assert [line.split(",")[0] for line in lines] == [f"{k} of 35 frames" for k in range(3, 36, 3)]
    assert all(line.endswith(" s: all is well") for line in lines)


def test_where_the_end_is_not_known_there_is_a_line_every_ten(capsys):
    with Progress("gradients") as progress:
        for _ in range(25):
            progress.step()
    lines = capsys.readouterr().err.splitlines()
    assert [line.split(",")[0] for line in lines] == ["10 gradients", "20 gradients"]


def test_a_bar_that_is_interrupted_while_it_is_made_adds_nothing_to_the_advice(monkeypatch):
    def interrupted(*_, **__):
        raise KeyboardInterrupt

    monkeypatch.setattr("tqdm.tqdm.__init__", interrupted)
    with pytest.raises(KeyboardInterrupt):
        Progress("steps")
    gc.collect()  # an error while the bar is removed would be a warning here


def on_a_terminal(work, columns=80):
    """What a process writes to standard output, a pipe, and to standard error, a terminal."""
    import fcntl
    import pty
    import termios

    master, slave = pty.openpty()
    fcntl.ioctl(slave, termios.TIOCSWINSZ, struct.pack("HHHH", 24, columns, 0, 0))
    process = subprocess.Popen(
        [sys.executable, "-c", work], stdout=subprocess.PIPE, stderr=slave,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
    )  # fmt: skip
    os.close(slave)
    said = b""
    try:
        while part := os.read(master, 4096):
            said += part
    except OSError:  # the other end is closed
        pass
    results, _ = process.communicate(timeout=30)
    os.close(master)
    return process.returncode, results.decode(), said.decode()


def seen(said):
    """The lines of a terminal once all of this is written; no bar is so high that it scrolls."""
    lines, row, column = [""], 0, 0
    for character in said.replace("\x1b[A", "\v"):
        if character == "\r":
            column = 0
        elif character == "\n":
            row += 1
            lines += [""] * (row + 1 - len(lines))
        elif character == "\v":
            row -= 1
        else:
            line = lines[row].ljust(column)
            lines[row] = line[:column] + character + line[column + 1 :]
            column += 1
    return [line.rstrip() for line in lines]


needs_terminal = pytest.mark.skipif(not hasattr(os, "openpty"), reason="no pseudo-terminals")


@pytest.mark.process
@needs_terminal
def test_on_a_terminal_there_is_a_bar_and_results_stay_whole():
    code, results, said = on_a_terminal(WORK)
    assert code == 0
    assert results.splitlines() == [f"result {k}" for k in range(20)]
    assert "steps" in said and "20" in said
    assert "number" in said
    assert "result" not in said
    assert "of 20 steps" not in said


GOING_ON = """
import time
from mpmopt.io.progress import Progress
with Progress("steps", 1000) as progress:
    progress.count = 900
    for k in range(20):
        progress.step()
        time.sleep(0.05)
"""


@pytest.mark.process
@needs_terminal
def test_the_time_that_is_left_is_that_of_what_is_done_now():
    _, _, said = on_a_terminal(GOING_ON)
    last = said.split("\r")[-3]
    assert "/1000 " in last
    minutes, seconds = last.split("<")[1].split(",")[0].split(":")
    assert 2 <= 60 * int(minutes) + int(seconds) <= 20  # 80 steps of 0.05 s


LOGS = """
import logging, sys, time, warnings
from mpmopt.errors import StorageError
from mpmopt.io.console import reported
from mpmopt.io.progress import Progress
{setup}
def work():
    progress = Progress("steps", 3)
    for k in range(3):
        progress.step("all is well")
        time.sleep(0.15)  # the bar is drawn
        logging.getLogger("mpmopt.some").warning("logged %d", k)
        warnings.warn(f"warned {{k}}")
        print("printed", k, file=sys.stderr)
    print("in ", end="", file=sys.stderr)
    print("parts", file=sys.stderr)
    {end}
code = reported(work, lambda: "Advice.")
logging.getLogger("mpmopt.some").warning("the end")
sys.exit(code)
"""


@pytest.mark.process
@needs_terminal
@pytest.mark.parametrize(("setup", "end"), [
    ("", "raise StorageError('no room')"),
    ("logging.basicConfig(format='%(message)s')", "progress.close()"),
    ("logging.getLogger('mpmopt').addHandler(logging.StreamHandler())",
     "raise StorageError('no room')"),
])  # fmt: skip
def test_no_line_of_a_terminal_holds_a_bar_and_something_else(setup, end):
    code, _, said = on_a_terminal(LOGS.format(setup=setup, end=end))
    assert said.count("all is well") >= 3  # the bar was there
    lines = [line for line in seen(said) if line and not line.startswith("  warnings.warn(")]
    wanted = [
        line
        for k in range(3)
        for line in (f"logged {k}", f"<string>:13: UserWarning: warned {k}", f"printed {k}")
    ]
    wanted.append("in parts")
    if code:
        wanted.append("StorageError: no room")
    assert lines == [*wanted, "the end"]
