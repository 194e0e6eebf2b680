"""Progress: a bar on a terminal, lines elsewhere, results never mixed with either."""

import os
import struct
import subprocess
import sys
from pathlib import Path

import pytest

from mpmopt.progress import Progress

ROOT = Path(__file__).parent.parent
WORK = """
from mpmopt.progress import Progress
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


@pytest.mark.skipif(not hasattr(os, "openpty"), reason="no pseudo-terminals")
def test_on_a_terminal_there_is_a_bar_and_results_stay_whole():
    import fcntl
    import pty
    import termios

    master, slave = pty.openpty()
    fcntl.ioctl(slave, termios.TIOCSWINSZ, struct.pack("HHHH", 24, 80, 0, 0))
    process = subprocess.Popen(
        [sys.executable, "-c", WORK], stdout=subprocess.PIPE, stderr=slave,
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
    assert process.returncode == 0
    assert results.decode().splitlines() == [f"result {k}" for k in range(20)]
    assert b"steps" in said and b"20" in said
    assert b"number" in said
    assert b"result" not in said
    assert b"of 20 steps" not in said
