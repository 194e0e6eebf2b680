"""Running bodies: what is returned, and what happens where the method fails."""

import dataclasses

import numpy as np
import pytest
from walker import walker

from mpmopt.design.problem import Problem
from mpmopt.errors import DesignError, SimulationError
from mpmopt.scene import Grid, Scene, Solid
from mpmopt.scene.particles import discretise
from mpmopt.simulation.simulation import Simulation


def simulation(scene, state=None, **material):
    particles = discretise(scene)
    ones = np.ones(len(particles.position))
    material = {"density": ones, "stiffness": ones, **material}
    signal = np.zeros((scene.steps, len(scene.actuators)))
    return Simulation(scene, particles, **{"signal": signal, **material}, state=state)


def test_frames_are_the_states_on_the_way(scene):
    run = simulation(scene)
    frames = run.run([0, 3, 3, 40])
    assert np.array_equal(frames[0], run.initial)
    assert np.array_equal(frames[1], frames[2])
    assert np.array_equal(frames[3], run.run())
    shorter = simulation(dataclasses.replace(scene, steps=3))
    assert np.array_equal(shorter.run(), frames[1])


def test_frames_of_one_group_of_particles_are_their_own():
    # Four particles fill their group, so that no copy is made on the way by chance.
    c = 1 / 16
    body = (Solid((4 * c, 4 * c), (5 * c, 5 * c)),)
    falling = simulation(Scene(Grid((16, 16), c), 4e-3, 20, body, gravity=(1.0, 0.0)))
    assert falling.initial.shape[1] == 4
    frames = falling.run([0, 10, 20])
    assert np.array_equal(frames[0], falling.initial)
    assert np.all(np.diff(frames[:, 0], axis=0) > 0.0)


@pytest.mark.parametrize("frames", [[-1], [41], [3, 2], [1.5], [np.nan], ["1"]])
def test_frames_outside_the_run_are_refused(scene, frames):
    with pytest.raises(DesignError, match="from 0 to 40"):
        simulation(scene).run(frames)


def test_a_run_leaves_its_simulation_as_it_was(scene):
    run = simulation(scene)
    assert np.array_equal(run.run(), run.run())


def test_a_body_that_spreads_finds_room(scene):
    # The window outgrows its first size while the body flies apart.
    free = dataclasses.replace(scene, walls=(), gravity=(0.0, 0.0))
    run = simulation(free)
    state = run.initial.copy()
    centre = state[0:2].mean(axis=1, keepdims=True)
    state[2:4] = 8.0 * (state[0:2] - centre)
    weak = np.full(state.shape[1], 1e-10)
    frames = simulation(free, state, stiffness=weak).run([0, 40])
    spread = [np.ptp(frame[0]) for frame in frames]
    assert spread[1] >= 2.0 * spread[0]


def test_a_particle_that_leaves_the_grid_ends_the_run_by_name(scene):
    state = simulation(scene).initial.copy()
    state[2] = 5.0
    with pytest.raises(SimulationError, match="left the grid") as error:
        simulation(dataclasses.replace(scene, walls=()), state).run()
    assert 0 < error.value.step < 40
    assert error.value.particle >= 0
    assert error.value.position[0] >= 1.0 - scene.grid.dx
    assert f"step {error.value.step}, particle {error.value.particle} at" in str(error.value)
    assert "larger grid" in str(error.value)


@pytest.mark.parametrize("gravity", [1e6, 1e18, 1e30])
def test_a_particle_that_leaves_in_the_last_step_is_found_too(scene, gravity):
    last = dataclasses.replace(scene, steps=1, gravity=(gravity, 0.0), walls=())
    with pytest.raises(SimulationError, match=r"left the grid|not a number") as error:
        simulation(last).run()
    assert error.value.step == 1


def test_an_inverted_particle_ends_the_run_by_name(scene):
    state = simulation(scene).initial.copy()
    state[8, 7] = -0.5
    with pytest.raises(SimulationError, match="inverted") as error:
        simulation(scene, state).run()
    assert (error.value.step, error.value.particle) == (0, 7)


def test_what_becomes_infinite_ends_the_run_by_name(scene):
    state = simulation(scene).initial.copy()
    state[2, 3] = 1e308
    state[3, 3] = -1e308
    with pytest.raises(SimulationError, match=r"left the grid|not a number"):
        simulation(scene, state).run()


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"density": np.ones(3)}, r"\(3,\), must have \(48,\)"),
        ({"density": np.zeros(48)}, "must be above 0"),
        ({"stiffness": np.full(48, np.nan)}, "stiffness holds 48 values not finite"),
        ({"signal": np.zeros((40, 1))}, r"\(40, 1\), must have \(40, 2\)"),
        ({"state": np.zeros((12, 47))}, r"\(12, 47\), must have \(12, 48\)"),
    ],
)
def test_arrays_that_do_not_fit_are_refused(scene, change, says):
    with pytest.raises(DesignError, match=says):
        simulation(scene, **change)


def test_a_body_without_particles_is_refused(scene):
    nothing = discretise(scene).subset(np.zeros(48, dtype=bool))
    with pytest.raises(DesignError, match="no particles"):
        Simulation(scene, nothing, np.zeros(0), np.zeros(0), np.zeros((scene.steps, 2)))


def test_blocks_visit_hardly_more_nodes_than_the_whole_body():
    scene = walker(128, 2e-4)
    problem = Problem(scene)
    simulation = problem.simulation(problem.join(0.0, 1.0, -0.3, -0.5))
    nodes, part = simulation.room
    blocks = len(simulation.data.first) - 1
    assert blocks == 8
    # The body covers 40 x 20 cells; a quarter more on each axis is kept free.
    assert nodes == (50 + 4) * (25 + 4)
    assert blocks * part <= 2.1 * nodes
    # Groups of four particles: no more than three are repeated to fill the last one.
    assert 0 <= 4 * len(simulation.data.mass) - simulation.initial.shape[1] <= 3


def test_a_body_that_flies_apart_takes_no_more_memory_than_there_is(scene):
    parts = (Solid((10.0, 10.0), (12.0, 12.0)), Solid((18.0, 10.0), (20.0, 12.0)))
    wide = dataclasses.replace(
        scene, grid=Grid((10**6, 10**6), 1.0), body=parts, walls=(), gravity=(0.0, 0.0),
        time_step=0.05, steps=300,
    )  # fmt: skip
    problem = Problem(wide, halvings=0, limits=None)
    flying = problem.simulation(problem.join(0.0, 0.0, 0.0, 0.0))
    flying.initial[2:4, flying.initial[0] > 14.0] = 1e6
    with pytest.raises(SimulationError, match=r"spread over \d+ nodes.*let no part .* fly away"):
        flying.watch()
