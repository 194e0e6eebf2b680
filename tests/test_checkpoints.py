"""Which states are kept, what that costs, and that it changes no bit of the gradient."""

import math
import resource
import shutil
from typing import Any

import numpy as np
import pytest
from conftest import small_scene
from exact import at_rest
from walker import walker

from mpmopt.design.objective import Objective
from mpmopt.design.problem import Problem
from mpmopt.errors import DesignError, StorageError
from mpmopt.scene.particles import discretise
from mpmopt.simulation.checkpoints import MEGABYTE, Checkpointing, Checkpoints, Schedule
from mpmopt.simulation.simulation import Simulation

SIZE = 1000  # bytes of a step


@pytest.mark.parametrize("steps", [1, 2, 7, 100, 1250, 5000])
@pytest.mark.parametrize("every", [1, 3, 71, 10**6, "all", None])
@pytest.mark.parametrize("memory", [1, 200 * SIZE, 10**9])
def test_segments_cover_every_step_once(steps, every, memory):
    schedule = Schedule.choose(steps, SIZE, Checkpointing(every, memory))
    covered = [n for first, last in schedule.segments for n in range(first, last)]
    assert covered == list(range(steps))
    assert all(last - first <= schedule.segment for first, last in schedule.segments)
    assert 0 <= schedule.steps_recomputed < steps


def test_all_states_stay_in_memory_if_they_fit():
    schedule = Schedule.choose(1000, SIZE, Checkpointing(memory=1000 * SIZE))
    assert schedule.segments == [(0, 1000)]
    assert schedule.steps_recomputed == 0


def test_else_memory_grows_as_the_root_of_the_steps_for_one_more_forward_run():
    for steps in (1000, 5000, 20000):
        schedule = Schedule.choose(steps, SIZE, Checkpointing(memory=700 * SIZE))
        root = math.ceil(math.sqrt(steps))
        assert schedule.segment == root
        assert schedule.in_memory
        assert schedule.stored_bytes + (root + 1) * SIZE <= (2 * root + 1) * SIZE
        assert steps - root <= schedule.steps_recomputed < steps


def test_a_store_over_the_budget_goes_to_disk():
    schedule = Schedule.choose(5000, SIZE, Checkpointing(memory=100 * SIZE))
    assert not schedule.in_memory
    assert (schedule.segment + 1) * SIZE <= 100 * SIZE
    assert not Schedule.choose(5000, SIZE, Checkpointing("all", 100 * SIZE)).in_memory
    assert Schedule.choose(5000, SIZE, Checkpointing("all", 100 * SIZE)).steps_recomputed == 0
    assert Schedule.choose(5000, SIZE, Checkpointing(3, 10 * SIZE, "memory")).in_memory


def test_every_kth_state_recomputes_all_but_the_last_segment():
    schedule = Schedule.choose(100, SIZE, Checkpointing(every=30))
    assert schedule.segments == [(0, 30), (30, 60), (60, 90), (90, 100)]
    assert schedule.steps_recomputed == 90


@pytest.mark.parametrize(
    "wrong",
    [
        {"every": 0},
        {"every": "some"},
        {"every": True},
        {"every": 2.5},
        {"memory": 0},
        {"memory": "256MB"},
        {"memory": None},
        {"store": 3},
    ],
)
def test_senseless_wishes_are_refused(wrong):
    with pytest.raises(DesignError, match=next(iter(wrong))):
        Checkpointing(**wrong)


@pytest.fixture(scope="module")
def rough_walker():
    """The preview's walker with a random design, 250 steps of it, and its gradient."""
    scene = walker(64, 8e-4).vary(void_density=1e-2, void_stiffness=1e-3)
    scene = type(scene)(**{**vars(scene), "steps": 250})
    problem = Problem(scene, beta=2.0)
    design = np.random.default_rng(3).uniform(-1.0, 1.0, problem.size - 3)
    x = problem.join(design, 0.9, -0.3, -0.5)
    return scene, x, problem.value_and_gradient(x)


@pytest.mark.parametrize("store", ["memory", "disk", None])
@pytest.mark.parametrize("every", [1, 7, 16, 250, "all"])
def test_no_schedule_changes_a_bit_of_the_gradient(rough_walker, every, store):
    scene, x, (value, gradient) = rough_walker
    problem = Problem(scene, 2.0, Checkpointing(every=every, store=store))
    other_value, other_gradient = problem.value_and_gradient(x)
    assert other_value == value
    assert np.array_equal(other_gradient, gradient)


def test_a_tiny_budget_changes_no_bit_either(rough_walker):
    scene, x, (value, gradient) = rough_walker
    problem = Problem(scene, 2.0, Checkpointing(memory=MEGABYTE // 2))
    with problem.simulation(x).checkpoints(problem.checkpointing) as checkpoints:
        schedule = checkpoints.schedule
    assert not schedule.in_memory
    assert (schedule.segment + 1) * schedule.step_bytes <= MEGABYTE // 2
    other_value, other_gradient = problem.value_and_gradient(x)
    assert other_value == value
    assert np.array_equal(other_gradient, gradient)


@pytest.fixture
def scratch(tmp_path, monkeypatch):
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    return tmp_path


def test_the_scratch_file_is_removed(rough_walker, scratch):
    scene, x, _ = rough_walker
    Problem(scene, 2.0, Checkpointing(every=50, store="disk")).value_and_gradient(x)
    assert list(scratch.iterdir()) == []


def test_the_scratch_file_is_removed_when_the_simulation_fails(rough_walker, scratch, monkeypatch):
    scene, x, _ = rough_walker

    def fail(*_):
        raise RuntimeError("stop")

    monkeypatch.setattr("mpmopt.simulation.simulation.Forward.reverse", fail)
    with pytest.raises(RuntimeError, match="stop"):
        Problem(scene, 2.0, Checkpointing(every=50, store="disk")).value_and_gradient(x)
    assert list(scratch.iterdir()) == []


ONE_NUMBER = {"state": ((1,), float)}


def test_too_little_room_on_the_disk_is_said_before_any_step(scratch):
    free = shutil.disk_usage(scratch).free
    schedule = Schedule(10, 1, False, False, 1)
    with pytest.raises(StorageError, match=r"MB needed, \S+ MB free; store fewer states"):
        Checkpoints(schedule, {"state": ((free // 8,), float)})
    assert list(scratch.iterdir()) == []


def test_too_little_memory_is_a_storage_error():
    schedule = Schedule(steps=10, segment=1, all_stored=False, in_memory=True, step_bytes=2**50)
    with pytest.raises(StorageError, match="no memory for checkpoints"):
        Checkpoints(schedule, {"state": ((2**47,), float)})


def test_a_folder_that_is_not_there_is_a_storage_error(tmp_path, monkeypatch):
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path / "nowhere"))
    schedule = Schedule(10, 1, False, False, 100)
    with pytest.raises(StorageError, match="no room for checkpoints"):
        Checkpoints(schedule, ONE_NUMBER)


@pytest.mark.skipif(not hasattr(resource, "RLIMIT_FSIZE"), reason="needs a file-size limit")
def test_a_file_that_can_grow_no_more_is_a_storage_error(scratch):
    limit = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (100_000, limit[1]))
    try:
        with pytest.raises(StorageError, match="no room for checkpoints of"):
            Checkpoints(Schedule(10, 1, False, False, 30_000), {"state": ((3_750,), float)})
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limit)
    assert list(scratch.iterdir()) == []


def test_stores_do_not_know_each_other(rough_walker):
    scene, x, _ = rough_walker
    simulation = Problem(scene, 2.0).simulation(x)
    wish = Checkpointing(every=100, store="memory")
    with simulation.checkpoints(wish) as one, simulation.checkpoints(wish) as other:
        one.write(0, state=simulation.initial)
        other.write(0, state=2.0 * simulation.initial)
        assert np.array_equal(one.read(0, "state"), simulation.initial)


@pytest.mark.parametrize("every", [50, "all", 250])
def test_going_back_twice_is_refused(rough_walker, every):
    scene, x, _ = rough_walker
    problem = Problem(scene, 2.0)
    simulation = problem.simulation(x)
    with simulation.checkpoints(Checkpointing(every)) as checkpoints:
        forward = simulation.forward(checkpoints)
        terminal_adjoints = Objective.of(problem.scene, simulation.particles).terminal_adjoints(
            forward.states
        )
        forward.reverse(terminal_adjoints)
        with pytest.raises(DesignError, match="run forward again"):
            forward.reverse(terminal_adjoints)


def test_a_store_that_lost_its_data_says_so():
    schedule = Schedule(10, 1, False, False, 100)
    with (
        Checkpoints(schedule, ONE_NUMBER) as checkpoints,
        pytest.raises(StorageError, match="cannot read grids of segment 3 back"),
    ):
        checkpoints.read(3, "grids")


def test_windows_that_outgrow_the_store_are_recomputed():
    # A body that flies apart: no segment's nodes fit where its first ones did.
    scene = small_scene(walls=(), gravity=(0.0, 0.0), steps=40)
    gradients = []
    for every in ("all", 40):
        particles = discretise(scene)
        ones = np.ones(48)
        state = at_rest(particles)
        state[2:4] = [[9.0], [14.0]] * (state[0:2] - state[0:2].mean(axis=1, keepdims=True))
        simulation = Simulation(scene, particles, ones, 1e-10 * ones, np.zeros((40, 2)), state)
        with simulation.checkpoints(Checkpointing(every, store="memory")) as checkpoints:
            forward = simulation.forward(checkpoints)
            objective = Objective.of(scene, particles, (0.6, 0.8))
            gradients.append(forward.reverse(objective.terminal_adjoints(forward.states)))
        if every == "all":
            assert forward.recomputed_segments >= 1
    assert np.array_equal(gradients[0].state, gradients[1].state)
    assert np.array_equal(gradients[0].density, gradients[1].density)


@pytest.mark.parametrize("every", [1, 5, 8, "all", None])
def test_any_states_can_be_asked_for_and_have_their_adjoints_added_on_the_way_back(rng, every):
    # Of a sum over some states, at the ends of segments and within: the complex step.
    scene, instants = small_scene(steps=16), (0, 3, 5, 8, 15)
    problem = Problem(scene)
    x = problem.join(0.2, 0.9, -0.3, -0.5)
    simulation = problem.simulation(x)
    weight = {step: rng.standard_normal(simulation.initial.shape) for step in (*instants, 16)}
    with simulation.checkpoints(Checkpointing(every, store="memory")) as store:
        forward = simulation.forward(store, instants=instants)
        assert sorted(forward.states) == sorted(weight)
        kept = {step: state.copy() for step, state in forward.states.items()}
        gradient = forward.reverse(weight)
    states = simulation.run(sorted(weight))
    watched = simulation.watch(instants).states
    for step, state in zip(sorted(weight), states):
        assert np.array_equal(kept[step], state)
        assert np.array_equal(watched[step], state)
    direction = rng.standard_normal(simulation.initial.shape)
    simulation = problem.simulation(x + 0j)
    simulation.initial += 1e-30j * direction
    moved = simulation.run(sorted(weight)).imag / 1e-30
    terms = [weight[step] * state for step, state in zip(sorted(weight), moved)]
    difference = np.sum(terms) - np.sum(gradient.state * direction)
    assert abs(difference) <= 1e-12 * np.linalg.norm(terms)


def test_instants_and_seeds_that_are_none_are_refused():
    problem = Problem(small_scene(steps=4))
    simulation = problem.simulation(problem.join(0.2, 0.9, -0.3, -0.5))
    wrong: Any
    for wrong in ([5], [-1], [1.5]):
        with pytest.raises(DesignError, match="instants must be whole numbers of steps from 0 to"):
            simulation.watch(wrong)
    for terminal_adjoints in ({5: simulation.initial}, {-1: simulation.initial}, {4: np.zeros(3)}):
        with (
            simulation.checkpoints(Checkpointing(store="memory")) as store,
            pytest.raises(
                DesignError, match=r"terminal_adjoints has shape .* must have \(12, 48\) at steps"
            ),
        ):
            simulation.forward(store).reverse(terminal_adjoints)
