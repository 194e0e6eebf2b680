"""Every change on the list is noticed by the tests named with it."""

import os
import subprocess
import sys

import pytest
from changes import CHANGES, ROOT


def test_every_change_has_one_place_and_tests_that_exist():
    assert len({(change.module, change.name) for change in CHANGES}) == len(CHANGES)
    for change in CHANGES:
        assert change.text
        assert change.old != change.new
        for test in change.tests.split():
            file, _, name = test.partition("::")
            assert f"def {name}" in (ROOT / "tests" / file).read_text()


@pytest.mark.slow
def test_every_change_is_noticed():
    done = subprocess.run(
        [sys.executable, ROOT / "tests" / "changes.py"],
        capture_output=True, text=True, env={**os.environ, "MPMOPT_THREADS": "1"},
    )  # fmt: skip
    assert done.returncode == 0, done.stdout + done.stderr
