"""Threads: the same bits for any number of them, and none that waits for another for ever."""

import threading
from dataclasses import replace

import numpy as np
import pytest
from conftest import small_scene
from crawler import crawler

from mpmopt import threads
from mpmopt.checkpoints import Checkpointing
from mpmopt.errors import MpmoptError, SimulationError
from mpmopt.problem import Problem
from mpmopt.scene import Solid, Wall


def evaluated(scene, every=20):
    problem = Problem(scene, 2.0, Checkpointing(every=every))
    x = np.random.default_rng(3).uniform(-0.8, 0.8, problem.size)
    blocks = len(problem.simulation(x).body.first) - 1
    return blocks, problem.value_and_gradient(x)


@pytest.mark.parametrize("every", [20, "all"])
def test_the_number_of_threads_changes_no_bit(monkeypatch, every):
    scene = replace(crawler(128, 4e-4), steps=60)
    results = []
    for number in ("1", "2", "3", "7"):
        monkeypatch.setenv("MPMOPT_THREADS", number)
        blocks, (value, gradient) = evaluated(scene, every)
        results.append((value, gradient.tobytes()))
    assert blocks >= 4
    assert len(set(results)) == 1


def test_threads_that_do_not_start_are_done_without(monkeypatch, caplog):
    scene = replace(crawler(128, 4e-4), steps=20)
    monkeypatch.setenv("MPMOPT_THREADS", "1")
    _, alone = evaluated(scene)
    monkeypatch.setenv("MPMOPT_THREADS", "3")

    def refuse(self):
        raise RuntimeError("can't start new thread")

    threads._say_once.cache_clear()
    monkeypatch.setattr(threading.Thread, "start", refuse)
    _, refused = evaluated(scene)
    assert refused[0] == alone[0]
    assert np.array_equal(refused[1], alone[1])
    assert len([r for r in caplog.records if "1 of 3 threads run" in r.message]) == 1


def test_a_failure_in_one_block_ends_all_threads(monkeypatch):
    monkeypatch.setenv("MPMOPT_THREADS", "2")
    c = 1 / 64
    # Heavy fall: the lowest particles, in several blocks, leave a grid without walls.
    scene = small_scene(
        grid=replace(small_scene().grid, cells=(64, 64), dx=c), walls=(Wall("x", 2 * c),),
        gravity=(0.0, -10.0), steps=500, time_step=1e-3,
        body=(Solid((3 * c, 4 * c), (23 * c, 14 * c)),),
    )  # fmt: skip
    with pytest.raises(SimulationError, match="left the grid") as caught:
        problem = Problem(scene)
        problem.value(np.empty(0))
    assert 0 <= caught.value.particle < len(problem.particles.position)


@pytest.mark.parametrize("wish", ["0", "-1", "two", "1.5"])
def test_a_wrong_number_of_threads_is_refused(monkeypatch, wish):
    monkeypatch.setenv("MPMOPT_THREADS", wish)
    with pytest.raises(MpmoptError, match="MPMOPT_THREADS"):
        threads.threads()
