"""Step control: how close a run came to failure, and evaluations that are halved for it."""

import dataclasses

import numpy as np
import pytest
from conftest import small_scene, worst
from walker import slanted_legs, walker

from mpmopt import kernels
from mpmopt.assess.threshold import SOLID_LIMITS, post_processed
from mpmopt.assess.verify import COMPLEX_STEP, COMPLEX_TOLERANCE, complex_step_test
from mpmopt.design.problem import Problem
from mpmopt.design.step_control import LIMITS, check_indicators
from mpmopt.errors import DesignError, FractureError, SimulationError
from mpmopt.optimisation.loop import optimise
from mpmopt.optimisation.settings import Settings, Stage
from mpmopt.scene import Actuator, Design, Ground, Material, Solid, Wall
from mpmopt.simulation.checkpoints import Checkpointing
from mpmopt.simulation.indicators import WATCH, Indicators

CELL = 1 / 16


def stiffness(F, mu, lame_lambda):
    """Largest |d tau / d L| over symmetric strain rates L of unit norm: a dense 3 x 3 problem."""
    b = F @ F.T
    basis = [np.diag([1.0, 0.0]), np.diag([0.0, 1.0]), np.array([[0.0, 1.0], [1.0, 0.0]]) / 2**0.5]
    columns = [mu * (L @ b + b @ L.T) + lame_lambda * np.trace(L) * np.eye(2) for L in basis]
    return np.linalg.eigvalsh([[np.sum(E * A) for A in columns] for E in basis]).max()


def watched(scene, particles, states, mass, share):
    """Indicators of some states, particle by particle."""
    dt, dx = scene.time_step, scene.grid.dx
    mu, lame_lambda = share * scene.material.lame_mu, share * scene.material.lame_lambda
    courant, velocity_increment, jacobian, stretch = [], [], [], [0.0]
    for state in states:
        for p in range(state.shape[1]):
            C, F = state[4:8, p].reshape(2, 2), state[8:12, p].reshape(2, 2)
            speed = stiffness(F, mu[p], lame_lambda[p]) * particles.volume[p] / mass[p]
            courant.append(dt / dx * np.sqrt(speed))
            velocity_increment.append(dt * np.linalg.norm(C))
            jacobian.append(np.linalg.det(F))
            if share[p] >= 0.5:
                stretch.append(float(np.linalg.norm(F, 2)))
    return Indicators(max(courant), max(velocity_increment), min(jacobian), max(stretch))


def test_a_layer_is_in_the_courant_number_of_what_is_in_it(scene):
    # Stiffer than its body, so that it counts; the lowest particles are in it, or they are not.
    layer = {"thickness": CELL, "stiffness": 1e5}
    for below, within in ((0.5, True), (0.7, True), (0.8, False), (3.0, False)):
        floor = Ground.floor((4 - below) * CELL, **layer)
        standing = dataclasses.replace(scene, walls=(), ground=(floor,)).vary(void_density=1e-3)
        problem = Problem(standing, halvings=0, limits=None)
        simulation = problem.simulation(problem.join(1.0, 0.0, 0.0, 0.0))
        courant = simulation.indicators(kernels.grouped(simulation.initial)).courant
        limit = standing.largest_time_step if within else standing.material.largest_time_step(CELL)
        assert courant == pytest.approx(standing.time_step / limit, rel=1e-12)
    assert standing.largest_time_step < 0.9 * standing.material.largest_time_step(CELL)


def lively(**changes):
    """A small walker of 46 particles, which do not fill their last group."""
    body = small_scene().body
    body = (*body[:2], Solid((4.5 * CELL, 6 * CELL), (6 * CELL, 7 * CELL)), body[3])
    return small_scene(body=body, **changes)


def design_of(problem, rng):
    designed = int(problem.particles.designed.sum())
    return problem.join(rng.uniform(-0.8, 0.8, designed), 0.9, -0.3, -0.5)


@pytest.mark.parametrize("steps", [5, 3 * WATCH, 3 * WATCH + 1])
def test_margins_are_those_of_every_sixteenth_state_and_the_last(rng, steps):
    problem = Problem(lively(steps=steps), 2.0, halvings=0, limits=None)
    x = design_of(problem, rng)
    simulation = problem.simulation(x)
    states = simulation.run(sorted({*range(0, steps, WATCH), steps}))
    field = problem.chain.field(problem.split(x).phi)
    mass = simulation.particles.volume * field.density
    expected = watched(problem.scene, simulation.particles, states, mass, field.stiffness)
    assert len(mass) % 4 == 2
    ends, indicators = simulation.watch()
    assert indicators == pytest.approx(expected, rel=1e-12)
    assert np.array_equal(ends[simulation.steps], states[-1])
    assert min(indicators.velocity_increment, 1.0 - indicators.jacobian) > 1e-4  # something moved
    for every in (None, 7, "all"):
        with simulation.checkpoints(Checkpointing(every=every)) as checkpoints:
            assert simulation.forward(checkpoints).indicators == indicators


def test_an_undeformed_body_is_at_its_scenes_limit(scene):
    # Where void is as heavy as it is stiff, the stretched particle's limit is that of the scene.
    scene = scene.vary(void_density=1e-3)
    problem = Problem(scene, halvings=0, limits=None)
    simulation = problem.simulation(problem.join(1.0, 0.0, 0.0, 0.0))
    indicators = simulation.indicators(kernels.grouped(simulation.initial))
    courant = scene.time_step / scene.largest_time_step
    assert indicators == pytest.approx(Indicators(courant, 0.0, 1.0, 1.0), rel=1e-12)


def driven_walker(share):
    """A walker with slanted legs whose actuation is a share of that which loses ellipticity."""
    scene = walker(64, 8e-4)
    stress = share * scene.material.lame_mu / 2.0 * np.eye(2)
    body = tuple(
        dataclasses.replace(part, stress=stress) if isinstance(part, Actuator) else part
        for part in scene.body
    )
    problem = Problem(dataclasses.replace(scene, body=body), 8.0, void_cutoff=0.05, halvings=1)
    positions = problem.particles.position[problem.particles.designed]
    return problem, problem.join(np.where(slanted_legs(positions), 1.0, -1.0), 1.0, -0.3, -1.0)


def test_a_body_that_may_be_cracked_is_climbed_through_but_does_not_count():
    problem, x = driven_walker(0.8)
    stretch = problem.evaluate(x).indicators.stretch
    assert 1.0 < stretch / problem.scene.particles_per_cell <= LIMITS.stretch
    with pytest.raises(FractureError, match=r"solid is stretched 2\.\d+ times, beyond 2 it tears"):
        post_processed(problem, x)
    problem, x = driven_walker(0.6)
    assert np.isfinite(post_processed(problem, x))


def test_solid_that_is_torn_is_an_error_and_no_distance():
    # Just below where ellipticity is lost; at 0.95 of that distances are 0.42 or 0.57 by the step.
    problem, x = driven_walker(0.99)
    scene = walker(64, 8e-4)
    with pytest.raises(FractureError, match=r"solid is stretched .* more particles per cell"):
        problem.value(x)
    with pytest.raises(FractureError, match=r"solid is stretched .* more particles per cell"):
        problem.value_and_gradient(x)
    gentle = Problem(scene, 8.0, void_cutoff=0.05, halvings=1).evaluate(x)
    assert 1.0 < gentle.indicators.stretch <= LIMITS.stretch * scene.particles_per_cell


# Scenes that provoke each of the three, and what they reach in their own step.
def stretched() -> Problem:
    """Void as light as it is weak, close to the scene's limit: stretched, it is over its own."""
    material = Material(void_density=1e-3, void_stiffness=1e-3)
    return Problem(
        small_scene(time_step=9.5e-3, steps=32, material=material, gravity=(0.5, -20.0)), 2.0
    )


def dropped() -> Problem:
    """Soft and fast: it meets the floor with almost a cell in each step."""
    body = (
        Design((3 * CELL, 8 * CELL), (7 * CELL, 10 * CELL)),
        Solid((3 * CELL, 10 * CELL), (7 * CELL, 11 * CELL)),
    )
    material = Material(1.0, 1.0, void_density=0.1, void_stiffness=0.1)
    scene = small_scene(
        time_step=9e-3, steps=18, material=material, body=body,
        gravity=(0.0, -30.0), walls=(Wall("y", 4 * CELL),),
    )  # fmt: skip
    return Problem(scene, 2.0)


def crushed() -> Problem:
    """Far too soft for its weight: what is below is crushed in every step that is tried."""
    body = (
        Design((3 * CELL, 4 * CELL), (7 * CELL, 9 * CELL)),
        Solid((3 * CELL, 9 * CELL), (7 * CELL, 10 * CELL)),
    )
    material = Material(0.2, 0.2, void_density=0.1, void_stiffness=1e-2)
    scene = small_scene(
        time_step=4e-3, steps=100, material=material, body=body,
        gravity=(0.0, -10.0), walls=(Wall("y", 4 * CELL),),
    )  # fmt: skip
    return Problem(scene, 2.0)


def design(problem):
    designed = int(problem.particles.designed.sum())
    return problem.join(np.linspace(-0.8, 0.8, designed), 0.9, -0.3, -0.5)


def plain(problem, time_step):
    """The same in another step, and nothing halved."""
    return Problem(
        problem.scene.vary(time_step=time_step), problem.chain.beta, halvings=0, limits=None
    )


@pytest.mark.parametrize(
    ("make", "over"), [(stretched, "courant"), (dropped, "velocity_increment")]
)
def test_what_comes_too_close_is_the_same_scene_with_half_the_step(make, over):
    problem = make()
    x, dt = design(problem), problem.scene.time_step
    first = plain(problem, dt).evaluate(x)
    assert [
        n
        for n in ("courant", "velocity_increment")
        if getattr(first.indicators, n) > getattr(LIMITS, n)
    ] == [over]
    assert first.indicators.jacobian > LIMITS.jacobian
    assert (first.halved, first.time_step) == (0, dt)
    evaluation, half = problem.evaluate(x), plain(problem, dt / 2).evaluate(x)
    assert (evaluation.halved, evaluation.time_step) == (1, dt / 2)
    assert evaluation.value == half.value != first.value
    assert np.array_equal(evaluation.gradient, half.gradient)
    assert evaluation.indicators == half.indicators
    assert problem.scene.time_step == dt
    # Value alone, and its complex step, take the same decision.
    assert problem.value(x) == half.value
    assert problem.value(x + 1j * COMPLEX_STEP).real == pytest.approx(half.value, rel=1e-13)
    assert worst(complex_step_test(problem, x)) <= COMPLEX_TOLERANCE


def test_what_no_step_cures_is_an_error():
    problem = crushed()
    x, dt = design(problem), problem.scene.time_step
    reached = [plain(problem, dt / k).evaluate(x).indicators for k in (1, 2, 4)]
    assert all(m.jacobian < LIMITS.jacobian for m in reached)
    assert all(
        m.courant < LIMITS.courant and m.velocity_increment < LIMITS.velocity_increment
        for m in reached
    )
    with pytest.raises(SimulationError, match=rf"J of a .* stay above 0.01; .* \(now {dt / 4:g}\)"):
        problem.value(x)
    with pytest.raises(SimulationError, match="J of a particle"):
        problem.evaluate(x)


def test_a_simulation_that_fails_is_repeated_too():
    # With a longer step the dropped body is inverted when it meets the floor.
    scene = dataclasses.replace(dropped().scene, time_step=1.2e-2, steps=16)
    problem = Problem(scene, 2.0)
    x = design(problem)
    with pytest.raises(SimulationError, match="inverted"):
        plain(problem, scene.time_step).evaluate(x)
    evaluation = problem.evaluate(x)
    assert evaluation.halved == 1
    assert evaluation.value == plain(problem, 6e-3).value(x)
    with pytest.raises(SimulationError, match="inverted"):
        Problem(scene, 2.0, halvings=0, limits=None).value(x)


def test_no_limit_is_met_by_an_evaluation_that_is_left_alone(rng):
    problem = Problem(small_scene(), 2.0)
    x = design_of(problem, rng)
    evaluation = problem.evaluate(x)
    assert (evaluation.halved, evaluation.time_step) == (0, problem.scene.time_step)
    value, gradient = Problem(problem.scene, 2.0, halvings=0, limits=None).value_and_gradient(x)
    assert evaluation.value == value
    assert np.array_equal(evaluation.gradient, gradient)


def test_the_number_of_threads_changes_no_margin(monkeypatch):
    problem = Problem(walker(64, 8e-4).vary(void_density=1e-2), 2.0)
    problem.scene = dataclasses.replace(problem.scene, steps=40)
    simulation = problem.simulation(problem.join(0.0, 1.0, -0.3, -0.5))
    assert len(simulation.data.first) - 1 >= 2  # blocks
    found = []
    for threads in ("1", "2"):
        monkeypatch.setenv("MPMOPT_THREADS", threads)
        found.append(simulation.watch().indicators)
    assert found[0] == found[1]


def test_an_optimisation_records_steps_and_margins():
    problem = stretched()
    scene, x = problem.scene, design(problem)
    material = scene.material
    stage = Stage(2.0, material.void_density, material.void_stiffness, scene.time_step)
    settings = Settings((stage,), least_iterations=1, most_iterations=2)
    designs = []
    run = optimise(scene, settings, x, [lambda run: designs.append(run.last)])
    assert run.halved_evaluations == len(run.history) == 2
    for item in designs:
        assert item is not None
        assert (item.halved, item.time_step) == (1, scene.time_step / 2)
        again = plain(problem, item.time_step).evaluate(item.x)
        assert again.value == item.objective
        names = [name for name in Indicators._fields if hasattr(item, name)]  # but for the place
        assert [getattr(again.indicators, name) for name in names] == [
            getattr(item, name) for name in names
        ]
        assert len(names) == 6
    assert run.problem().scene.time_step == scene.time_step / 2
    assert run.problem().value(run.result.x) == run.result.objective
    left_alone = dataclasses.replace(stage, halvings=0, limited=False)
    off = dataclasses.replace(settings, stages=(left_alone,))
    run = optimise(scene, off, x)
    assert run.halved_evaluations == 0
    assert run.history[0].courant > LIMITS.courant
    assert run.history[0].time_step == scene.time_step


@pytest.mark.parametrize("wrong", [-1, 0.5, "a"])
def test_a_senseless_number_of_attempts_is_refused(wrong):
    with pytest.raises(DesignError, match="halvings"):
        Problem(small_scene(), halvings=wrong)
    with pytest.raises(DesignError, match="halvings"):
        Stage(1.0, 1e-2, 1e-3, 1e-3, halvings=wrong)


@pytest.mark.parametrize("J", [0.0, -0.5])
def test_solid_that_is_turned_inside_out_never_counts(J):
    simulation = Problem(small_scene(steps=2)).simulation(np.zeros(Problem(small_scene()).size))
    for limits in (LIMITS, SOLID_LIMITS):
        with pytest.raises(SimulationError, match="J of a particle fell to"):
            check_indicators(Indicators(jacobian=J), simulation, limits)
