"""Anything that may be given to the program: it runs, or is refused by name. The long version:

python cases/fuzz.py
"""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
from fuzz import fuzz


def test_scenes_designs_and_run_files_run_or_are_refused():
    rows = {row.what: row for row in fuzz(scenes=100, designs=50, files=50)}
    assert {what: row.tried for what, row in rows.items()} == {
        "scenes as objects": 50, "scenes as JSON text": 50, "designs": 50, "damaged run files": 50,
    }  # fmt: skip
    for row in rows.values():
        assert row.failures == []
        assert row.ran + row.refused == row.tried
        assert row.ran > 0 < row.refused


@pytest.mark.slow
@pytest.mark.parametrize("mode", [{}, {"NUMBA_BOUNDSCHECK": "1"}, {"NUMBA_DISABLE_JIT": "1"}])
def test_the_long_version_in_a_process_of_its_own(tmp_path, mode):
    # Indices are checked where kernels do not use pointers (bounds check), and where they do
    # (plain Python, of which less is done in the time).
    share = 4 if "NUMBA_DISABLE_JIT" in mode else 1
    counts = {"scenes": 2000 // share, "designs": 500 // share, "files": 500 // share}
    options = [f"--{name}={number}" for name, number in counts.items()]
    cases = Path(__file__).parent.parent / "cases"
    where = os.pathsep.join([str(cases.parent), str(cases)])
    environment = {**os.environ, **mode, "PYTHONPATH": where, "NUMBA_CACHE_DIR": str(tmp_path)}
    if not mode:
        del environment["NUMBA_CACHE_DIR"]
    done = subprocess.run(
        [sys.executable, str(cases / "fuzz.py"), *options, f"--json={tmp_path / 'rows.json'}"],
        env=environment, capture_output=True, text=True, timeout=3600,
    )  # fmt: skip
    assert done.returncode == 0, done.stdout + done.stderr
    rows = json.loads((tmp_path / "rows.json").read_text())
    assert sum(row["tried"] for row in rows) == sum(counts.values())
