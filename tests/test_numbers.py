"""Signals, objectives, walls and schedules against numbers worked out by hand."""

import contextlib
import math

import numpy as np
import pytest
from conftest import small_scene

from mpmopt import kernels
from mpmopt.design.actuation import signal
from mpmopt.design.objective import Objective
from mpmopt.design.problem import Problem
from mpmopt.design.step_control import with_halvings
from mpmopt.errors import SceneError, SimulationError
from mpmopt.kernels import contact
from mpmopt.scene import Wall
from mpmopt.scene.particles import Particles, discretise
from mpmopt.simulation.checkpoints import Checkpointing, Schedule
from mpmopt.simulation.indicators import Indicators, Watched
from mpmopt.simulation.simulation import Simulation
from mpmopt.simulation.surroundings import parameters_of


def test_a_signal_is_that_of_the_start_of_each_step():
    scene = small_scene(steps=3)
    omega = [actuator.angular_frequency for actuator in scene.actuators]
    a, theta, b = np.array([0.9, 0.5]), np.array([0.25, -0.5]), np.array([0.1, -0.2])
    found = signal(scene, a, theta, b)
    assert found[0] == pytest.approx([0.9 * math.sqrt(0.5) + 0.1, -0.5 - 0.2])
    for n in range(3):
        for k in range(2):
            phase = omega[k] * n * scene.time_step + math.pi * theta[k]
            assert found[n, k] == pytest.approx(a[k] * math.sin(phase) + b[k], rel=1e-14)


def three():
    """Three particles in a row, the last of which is designed, and a state of theirs."""
    particles = Particles(
        position=np.array([[1.0, 0.0], [2.0, 0.0], [9.0, 0.0]]),
        volume=np.array([1.0, 3.0, 5.0]),
        designed=np.array([False, False, True]),
        actuator=np.array([0, -1, -1]),
        region=np.array([0, 1, 2]),
    )
    state = np.zeros((12, 3))
    state[0], state[1] = (2.0, 4.0, 50.0), (1.0, 3.0, 70.0)
    state[8], state[11] = (1.0, 2.0, 1.0), (2.0, 1.0, 1.0)
    state[9, 0], state[10, 0] = 0.5, 2.0  # J = 1, 2, 1
    return particles, state


def test_the_objective_is_the_centroid_of_what_is_not_designed_by_its_present_volume():
    particles, state = three()
    objective = Objective.of(small_scene(), particles, (1.0, 0.0))
    assert objective.start == (1.0 * 1.0 + 3.0 * 2.0) / 4.0
    assert objective.centroid(state) == pytest.approx((1.0 * 2.0 + 6.0 * 4.0) / 7.0)
    slanted = Objective.of(small_scene(), particles, (0.6, 0.8))
    along = (0.6 * 2.0 + 0.8 * 1.0, 0.6 * 4.0 + 0.8 * 3.0)
    assert slanted.centroid(state) == pytest.approx((along[0] + 6.0 * along[1]) / 7.0)


def test_after_a_transient_the_objective_is_where_it_would_be_had_it_begun_at_the_start():
    particles, state = three()
    scene = small_scene(transient=3 * 4e-3)
    objective = Objective.of(scene, particles, (1.0, 0.0))
    assert objective.instants == (3,)
    assert Objective.of(small_scene(), particles).instants == ()
    later = state.copy()
    later[0] += 0.5
    assert objective.value({3: state, 9: later}) == pytest.approx(objective.start + 0.5)
    assert objective.value({3: state, 9: state}) == pytest.approx(objective.start)


def test_the_kernels_know_the_walls_of_the_scene():
    c = 1 / 16
    scene = small_scene(
        walls=(
            Wall("y", 4 * c, friction=0.25),
            Wall("x", 3 * c),
            Wall("x", 12 * c, "above", friction=0.0),
        ),
    )
    parameters = parameters_of(scene)
    assert parameters.walls[:, contact.AXIS].tolist() == [1, 0, 0]
    assert parameters.walls[:, contact.SIDE].tolist() == [1, 1, -1]
    assert parameters.walls[:, contact.NODE].tolist() == [4, 3, 12]
    assert parameters.walls[:, contact.FRICTION].tolist() == [0.25, math.inf, 0.0]


def test_margins_of_two_runs_are_the_worse_of_each():
    one = Indicators(0.1, 0.9, 0.5, 1.5, 0.0)
    other = Indicators(0.2, 0.8, 0.6, 1.25, 0.01)
    assert one.join(other) == other.join(one) == Indicators(0.2, 0.9, 0.5, 1.5, 0.01)


def test_only_stretched_solid_can_be_torn():
    scene = small_scene()
    particles = discretise(scene)
    count = len(particles.position)
    state = np.zeros((12, count))
    state[0:2] = particles.position.T
    state[8], state[11] = 1.0, 1.0
    state[8, :3] = 5.0, 3.0, 2.0
    stiffness = np.ones(count)
    stiffness[:2] = 0.1, 0.49  # void and what is nearly void
    signal = np.zeros((scene.steps, 2))
    simulation = Simulation(scene, particles, np.ones(count), stiffness, signal, state)
    assert simulation.indicators(kernels.grouped(state)).stretch == pytest.approx(2.0)


GOOD = Indicators(
    courant=1.0, velocity_increment=0.5, jacobian=0.01, stretch=3.0, energy=0.05
)  # at the limits


@pytest.mark.parametrize(
    ("over", "tries"),
    [
        ({}, 1),
        ({"courant": 1.01}, 3),
        ({"velocity_increment": 0.51}, 3),
        ({"jacobian": 0.0099}, 3),
        ({"energy": 0.051}, 3),
        ({"stretch": 3.01}, 1),  # no step mends what is torn
    ],
)
def test_what_is_over_a_limit_is_tried_again_unless_it_is_torn_or_left_alone(
    monkeypatch, over, tries
):
    steps = []

    def watch(simulation, instants):
        steps.append(simulation.scene.time_step)
        return Watched({simulation.steps: simulation.initial}, GOOD._replace(**over))

    monkeypatch.setattr(Simulation, "watch", watch)
    scene = small_scene()
    x = Problem(scene).join(0.0, 0.5, 0.0, 0.0)
    with pytest.raises(SimulationError) if over else contextlib.nullcontext():
        Problem(scene).value(x)
    assert steps == [4e-3, 2e-3, 1e-3][:tries]
    assert np.isfinite(Problem(scene, halvings=0, limits=None).value(x))
    # Whether limits count and whether a step is halved are two questions.
    steps.clear()
    with pytest.raises(SimulationError) if over else contextlib.nullcontext():
        Problem(scene, halvings=0).value(x)
    assert np.isfinite(Problem(scene, limits=None).value(x))
    assert steps == [4e-3, 4e-3]
    looser = Problem(scene, limits=Indicators(2.0, 1.0, 1e-3, 2.0, 0.1))
    assert np.isfinite(looser.value(x))


def test_a_step_that_the_scene_does_not_allow_hides_no_failure():
    def simulated(there):
        if there is scene:
            raise SimulationError("it burst", 3, -1, (0.0, 0.0), "none")
        raise SceneError("no such step")

    scene = small_scene()
    with pytest.raises(SimulationError, match="it burst"):
        with_halvings(scene, simulated, 2)
    with pytest.raises(SceneError, match="no such step"):
        with_halvings(small_scene(), simulated, 2)


def test_a_window_holds_the_mirror_images_of_its_nodes():
    # Nodes 8 to 12 along x and 3 to 5 along y.
    windows = np.array([[8, 3, 3, 2], [10, 4, 3, 2]])
    parameters = parameters_of(small_scene())

    def window(axis, node):
        return kernels.whole_window(
            windows, parameters._replace(mirror_axis=axis, mirror_node=node)
        )

    assert window(-1, 0) == (8, 3, 5, 3)
    assert window(0, 9) == (6, 3, 7, 3)
    assert window(1, 3) == (8, 1, 5, 5)
    assert window(0, 11) == window(1, 5) == (8, 3, 5, 3)


def test_a_schedule_recomputes_nothing_that_it_has():
    schedule = Schedule.choose(10, 100, Checkpointing(every=4))
    assert schedule.segments == [(0, 4), (4, 8), (8, 10)]
    assert (schedule.steps_recomputed, schedule.stored_bytes) == (8, 300)
    everything = Schedule.choose(10, 100, Checkpointing("all"))
    assert everything.segments == [(0, 4), (4, 8), (8, 10)]
    assert (everything.steps_recomputed, everything.stored_bytes) == (0, 1000)
