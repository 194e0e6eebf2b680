"""The same bits whatever surrounds a run: threads, the kernels' cache, other processes.

That no schedule of checkpoints and no number of threads changes a gradient is in
`test_checkpoints` and `test_threads`.
"""

import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from walker import walker

from mpmopt.design.problem import Problem
from mpmopt.optimisation.loop import optimise
from mpmopt.optimisation.settings import Settings, Stage
from mpmopt.simulation.checkpoints import Checkpointing


def short_run(checkpointing=None):
    """Everything that a short optimisation computes, but for the clock."""
    scene = replace(walker(64, 8e-4), steps=48)
    stages = tuple(Stage(beta, 1e-2, 1e-3, 8e-4, solid=beta > 1.0) for beta in (1.0, 4.0))
    settings = Settings(stages, window=1, least_iterations=3, most_iterations=3)
    problem = Problem(stages[0].scene(scene))
    assert len(problem.simulation(np.zeros(problem.size)).data.first) - 1 >= 2  # blocks
    start = problem.join(0.0, 1.0, -0.3, -0.5)
    run = optimise(scene, settings, start, checkpointing=checkpointing)
    return [
        [np.asarray(value).tobytes() for name, value in vars(item).items() if name != "seconds"]
        for item in run.history
    ]


def test_an_optimisation_has_the_same_history_for_any_threads_and_checkpoints(monkeypatch):
    monkeypatch.setenv("MPMOPT_THREADS", "1")
    alone = short_run()
    assert len(alone) == 6
    assert len({item[6] for item in alone}) > 3  # designs differ
    monkeypatch.setenv("MPMOPT_THREADS", "2")
    assert short_run() == alone
    assert short_run(Checkpointing(every=7, store="disk")) == alone


SCRIPT = """
import hashlib, sys
sys.path[:0] = sys.argv[1:]
from test_determinism import short_run
print(hashlib.sha256(repr(short_run()).encode()).hexdigest())
"""


@pytest.mark.slow
def test_two_processes_with_one_cold_cache_agree_with_a_warm_one(tmp_path):
    here = Path(__file__).parent
    places = [str(here), str(here.parent), str(here.parent / "cases")]

    def begin():
        return subprocess.Popen(
            [sys.executable, "-c", SCRIPT, *places],
            env={**os.environ, "NUMBA_CACHE_DIR": str(tmp_path), "MPMOPT_THREADS": "1"},
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )

    def end(process):
        out, err = process.communicate(timeout=1800)
        assert process.returncode == 0, err
        return out

    cold = [end(process) for process in [begin(), begin()]]
    assert any(tmp_path.rglob("*.nbc"))
    warm = [end(process) for process in [begin(), begin()]]
    assert len({*cold, *warm}) == 1
