"""Threads: the same bits for any number of them, and none that waits for another for ever."""

import threading
from dataclasses import replace

import numpy as np
import pytest
from crawler import crawler
from numba import njit

from mpmopt import kernels
from mpmopt.design.problem import Problem
from mpmopt.errors import MpmoptError, SimulationError
from mpmopt.scene import Grid, Scene, Solid
from mpmopt.scene.particles import discretise
from mpmopt.simulation import threads
from mpmopt.simulation.buffers import Memory, Segment
from mpmopt.simulation.checkpoints import Checkpointing
from mpmopt.simulation.simulation import Simulation

jit_loop = njit(nogil=True)


def evaluated(scene, every=20):
    problem = Problem(scene, 2.0, Checkpointing(every=every))
    x = np.random.default_rng(3).uniform(-0.8, 0.8, problem.size)
    blocks = len(problem.simulation(x).data.first) - 1
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


@jit_loop
def wait_for_each_other(barrier_state, thread, threads):
    return kernels.meet(barrier_state, threads)


@pytest.mark.parametrize("failing", [0, 1, 2])
@pytest.mark.parametrize("error", [KeyboardInterrupt, MemoryError])
def test_no_thread_waits_for_one_that_failed(monkeypatch, failing, error):
    monkeypatch.setenv("MPMOPT_THREADS", "3")
    came = []

    def loop(barrier_state, thread, number):
        if thread == failing:
            raise error("in one thread")
        came.append(wait_for_each_other(barrier_state, thread, number))

    before = threading.active_count()
    with pytest.raises(error, match="in one thread"):
        threads.in_parallel(3, loop)
    assert threading.active_count() == before
    assert came == [False, False]
    came.clear()
    assert threads.in_parallel(3, wait_for_each_other) is True


def body_of(steps=40):
    """Gravity-free, of several blocks, as a simulation with a state to spoil."""
    c = 1 / 64
    scene = Scene(Grid((64, 64), c), 1e-3, steps, body=(Solid((10 * c, 10 * c), (40 * c, 30 * c)),))
    particles = discretise(scene)
    ones = np.ones(len(particles.position))
    state = np.zeros((12, len(ones)))
    state[0:2], state[8], state[11] = particles.position.T, 1.0, 1.0

    def simulation(state):
        signal = np.zeros((steps, 0))
        return Simulation(scene, particles, ones, ones, signal, state)

    return simulation, state


@pytest.mark.parametrize("particle", [3, 2397])
def test_a_failure_in_one_block_ends_all_threads(monkeypatch, particle):
    monkeypatch.setenv("MPMOPT_THREADS", "2")
    simulation, state = body_of()
    spoilt = simulation(state)
    assert len(spoilt.data.first) - 1 == 6
    spoilt.initial[8, particle] = -1.0  # inverted, in the first or the last block
    with pytest.raises(SimulationError, match="inverted") as caught:
        spoilt.run()
    assert caught.value.particle == particle


@pytest.mark.parametrize("number", ["1", "2"])
def test_windows_that_outgrow_their_room_get_what_they_need_and_change_no_bit(monkeypatch, number):
    monkeypatch.setenv("MPMOPT_THREADS", number)
    simulation, state = body_of()
    state[2] = 3.0
    falling = simulation(state)
    room = falling.room
    ends = set()
    for nodes, part in (room, (10, room[1]), (room[0], 10), (10, 10)):
        memory = Segment(falling, 20, Memory())
        memory.grids = memory.grids[:, :0]
        memory.resize(nodes, part)
        memory.states[0] = kernels.grouped(falling.initial)
        memory.advance(0, 20)
        ends.add(memory.states[20].tobytes())
        assert memory.grids.shape[1] <= room[0]
        assert memory.scratch.parts.shape[2] <= room[1]
    assert len(ends) == 1


def test_a_wish_for_a_number_of_threads_is_kept(monkeypatch):
    monkeypatch.setenv("MPMOPT_THREADS", "2")
    seen = []
    for _ in range(3):
        threads.in_parallel(2, lambda barrier_state, thread, number: seen.append(number))
    assert seen == [2] * 6


def test_without_the_compiler_there_is_one_thread(monkeypatch):
    monkeypatch.setattr("numba.config.DISABLE_JIT", 1)
    monkeypatch.setenv("MPMOPT_THREADS", "2")
    assert threads.threads() == 1


@pytest.mark.parametrize("wish", ["0", "-1", "two", "1.5"])
def test_a_wrong_number_of_threads_is_refused(monkeypatch, wish):
    monkeypatch.setenv("MPMOPT_THREADS", wish)
    with pytest.raises(MpmoptError, match="MPMOPT_THREADS"):
        threads.threads()
