"""Nothing that is kept shares memory with the caller, and no result with what is kept."""

import dataclasses
from typing import Any

import numpy as np
import pytest
from conftest import SHORT, small_scene

from mpmopt.assess.discretisation import carried
from mpmopt.assess.trajectory import Body, Motion
from mpmopt.design.chain import DesignChain
from mpmopt.design.objective import Objective
from mpmopt.design.problem import Problem
from mpmopt.design.terms import Displacement
from mpmopt.errors import DesignError, SimulationError
from mpmopt.optimisation.loop import optimise
from mpmopt.scene.particles import Particles, discretise
from mpmopt.simulation.buffers import Memory
from mpmopt.simulation.checkpoints import Checkpointing
from mpmopt.simulation.simulation import Simulation

SCENE = small_scene(steps=12, transient=5 * 4e-3)


def arrays(thing):
    """The arrays of a dataclass, by name."""
    return {
        field.name: getattr(thing, field.name)
        for field in dataclasses.fields(thing)
        if isinstance(getattr(thing, field.name), np.ndarray)
    }


def spoil(*given):
    """Change every array that can be written to."""
    for array in given:
        if array.flags.writeable:
            array[...] = 0


def parts():
    """What a simulation is made of, in arrays that anybody can write to."""
    rng = np.random.default_rng(7)
    particles = discretise(SCENE)
    count = len(particles.position)
    state = np.zeros((12, count))
    state[0:2], state[8], state[11] = particles.position.T, 1.0, 1.1
    inputs = {name: array.copy() for name, array in arrays(particles).items()}
    material = {name: rng.uniform(0.5, 0.9, count) for name in ("density", "stiffness")}
    signal = rng.uniform(-1.0, 1.0, (12, 2))
    return inputs, {**material, "signal": signal, "state": state}


def results(simulation, every, change=lambda: None, memory=None):
    with simulation.checkpoints(Checkpointing(every=every)) as store:
        objective = Objective.of(SCENE, simulation.particles)
        forward = simulation.forward(store, memory, objective.instants)
        terminal_adjoints = objective.terminal_adjoints(forward.states)
        value = objective.value(forward.states)
        change()
        spoil(*forward.states.values())
        gradient = forward.reverse(terminal_adjoints)
    return [np.array(value), *arrays(gradient).values()]


@pytest.mark.parametrize("every", [None, 5, "all"])
def test_what_was_given_to_a_simulation_can_be_changed(every):
    inputs, given = parts()
    expected = results(Simulation(SCENE, Particles(*inputs.values()), **given), every)
    simulation = Simulation(SCENE, Particles(*inputs.values()), **given)
    spoil(*inputs.values(), *given.values())
    for found, wanted in zip(results(simulation, every), expected):
        assert np.array_equal(found, wanted)
    # And meanwhile, in one run's memory after the other.
    inputs, given = parts()
    simulation, memory = Simulation(SCENE, Particles(*inputs.values()), **given), Memory()
    for _ in range(2):
        change = lambda: spoil(*inputs.values(), *given.values())  # noqa: E731
        again = results(simulation, every, change, memory)
        assert all(np.array_equal(*pair) for pair in zip(again, expected))


def test_what_a_simulation_returned_can_be_changed():
    problem = Problem(SCENE, 2.0)
    x = problem.join(0.3, 0.9, -0.3, -0.5)
    simulation = problem.simulation(x)
    ask = [0, 5, 12]
    watched = simulation.watch([5]).states
    kept: list[Any] = [simulation.run(ask), simulation.run(), *watched.values()]
    evaluation = problem.evaluate(x)
    copies = [array.copy() for array in (*kept, evaluation.gradient)]
    spoil(*kept, evaluation.gradient)
    watched = simulation.watch([5]).states
    again: list[Any] = [simulation.run(ask), simulation.run(), *watched.values()]
    again.append(problem.evaluate(x).gradient)
    assert all(np.array_equal(*pair) for pair in zip(copies, again))
    variables, shifted = problem.split(x), x + 1e-30j
    spoil(*variables, *problem.split(shifted), problem.gamma(x), problem.present(variables.phi))
    assert np.array_equal(problem.evaluate(x).gradient, again[-1])
    assert np.array_equal(shifted, x + 1e-30j)


def test_a_run_whose_memory_was_taken_is_not_gone_back_through():
    inputs, given = parts()
    simulation, memory = Simulation(SCENE, Particles(*inputs.values()), **given), Memory()
    with simulation.checkpoints(Checkpointing()) as store:
        first = simulation.forward(store, memory)
        second = simulation.forward(store, memory)
        with pytest.raises(DesignError, match="memory"):
            first.reverse({})
        second.reverse({})


@pytest.mark.parametrize("row", [0, 2])
def test_a_state_that_is_no_number_is_a_failure_by_name(row):
    inputs, given = parts()
    simulation = Simulation(SCENE, Particles(*inputs.values()), **given)
    simulation.initial[row, 3] = np.nan
    with pytest.raises(SimulationError, match="not a number"):
        simulation.run()
    given["state"][row, 3] = np.nan
    with pytest.raises(DesignError, match="state holds 1 values not finite"):
        Simulation(SCENE, Particles(*inputs.values()), **given)


def test_parts_of_a_problem_keep_their_own():
    inputs, _ = parts()
    particles = Particles(*inputs.values())
    objective, chain = Objective.of(SCENE, particles), DesignChain(SCENE, particles, 2.0)
    state = parts()[1]["state"]
    designed = int(particles.designed.sum())
    expected = objective.centroid(state), chain.field(np.full(designed, 0.3)).density
    weight = objective.weight.copy()
    same = Objective(objective.direction, weight, objective.start)
    spoil(*inputs.values(), weight)
    chain.field(np.zeros(designed))  # forgets the one before
    for found in (objective, same):
        again = found.centroid(state), chain.field(np.full(designed, 0.3)).density
        assert all(np.array_equal(*pair) for pair in zip(again, expected))
    with pytest.raises(ValueError, match="read-only"):
        particles.position[0] = 0.0


def test_a_motion_and_a_design_that_is_carried_keep_their_own():
    problem = Problem(SCENE, 2.0)
    x = problem.join(0.3, 0.9, -0.3, -0.5)
    simulation, frames = problem.simulation(x), np.array([0, 6, 12])
    objective, grey = Displacement(), np.full(32, 0.5)
    gamma = np.full(len(simulation.particles.position), 0.5)
    motion = Motion.of(Body("a", simulation, gamma, objective, grey), frames)
    design, wanted = carried(problem, x), x.copy()
    spoil(gamma, frames, x, grey)
    assert motion.frames.tolist() == [0, 6, 12]
    assert set(motion.gamma) == {0.5}
    assert np.array_equal(design(problem), wanted)
    before = motion.objective.copy()
    spoil(*arrays(motion).values())
    again = Motion.of(Body("a", simulation, np.ones(48), objective, np.full(32, 0.5)), [0, 6, 12])
    assert np.array_equal(again.objective, before)


def test_an_optimisation_keeps_its_own():
    x = Problem(SCENE).join(0.3, 1.0, -0.3, -0.5)

    def spoilt(run):
        spoil(x)
        for item in (run.first, run.last, run.stage_state, *run.best.values()):
            if item is not None:
                spoil(*arrays(item).values())

    expected = optimise(SCENE, SHORT, x.copy())
    found = optimise(SCENE, SHORT, x, [spoilt])
    assert found.last is not None and expected.last is not None
    assert np.array_equal(found.last.x, expected.last.x)
    assert [i.objective for i in found.history] == [i.objective for i in expected.history]


@pytest.mark.parametrize(
    ("name", "wrong"),
    [
        ("density", lambda a: a.astype(str)),
        ("signal", lambda a: np.ma.masked_greater(a, 0.5)),
        ("stiffness", lambda a: a > 0.0),
        ("state", lambda a: a.astype(object)),
    ],
)
def test_a_simulation_of_what_are_no_numbers_is_refused(name, wrong):
    inputs, given = parts()
    with pytest.raises(DesignError, match=name):
        Simulation(SCENE, Particles(*inputs.values()), **{**given, name: wrong(given[name])})
