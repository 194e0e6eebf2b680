"""The energy balance: it is that of the motion, and it notices energy from nowhere."""

from dataclasses import replace

import numpy as np
import pytest
from conftest import small_scene
from exact import Bar, at_rest
from stability.common import solid
from stability.time_step import block_scene
from walker import slanted_legs, walker

from mpmopt import kernels
from mpmopt.assess.threshold import distance, post_processed
from mpmopt.assess.verify import COMPLEX_STEP
from mpmopt.design.problem import Problem, Variables
from mpmopt.design.step_control import LIMITS
from mpmopt.errors import DesignError, FractureError, SimulationError
from mpmopt.scene import Actuator, Clamp, Grid, Scene, Solid, Wall
from mpmopt.scene.particles import discretise
from mpmopt.simulation import energy
from mpmopt.simulation.checkpoints import Checkpointing
from mpmopt.simulation.simulation import Simulation
from mpmopt.simulation.surroundings import parameters_of


def totals(simulation, state):
    """Energy of a state, and what each actuator squeezes."""
    records = kernels.grouped(state)
    held = np.zeros((1, simulation.signal.shape[1]))
    data, parameters = simulation.data, simulation.parameters
    energy.grips(records[None], np.zeros(1, np.int64), data, parameters, held)
    return sum(energy.energy(records, data, parameters)), held[0]


def one_step(dt, rng):
    """A strained body of two actuators in affine motion, which transfers keep, for a step."""
    c = 1 / 16
    body = (
        Actuator((3 * c, 4 * c), (6 * c, 7 * c), stress=((2.0, 0.7), (0.7, -1.0))),
        Actuator((6 * c, 4 * c), (8 * c, 7 * c), stress=((-1.0, 0.2), (0.2, 2.0))),
        Solid((8 * c, 4 * c), (9 * c, 7 * c)),
    )
    scene = small_scene(body=body, steps=1, time_step=dt, gravity=(2.0, -5.0), walls=())
    particles = discretise(scene)
    state = at_rest(particles)
    rate = rng.uniform(-1.0, 1.0, (2, 2))
    state[2:4] = rate @ (state[0:2] - 0.4)
    state[4:8] = rate.reshape(4, 1)
    state[8:12] += rng.uniform(-0.2, 0.2, (4, len(particles.position)))
    ones = rng.uniform(0.5, 1.0, len(particles.position))
    signal = np.array([[1.3, -0.8]])
    return Simulation(scene, particles, ones, ones, signal, state)


def test_what_a_step_gains_is_what_the_actuators_give():
    # Nothing is lost in this motion, so the balance closes with the square of the step.
    left, given = [], []
    for dt in (1e-4, 1e-5):
        simulation = one_step(dt, np.random.default_rng(4))
        before, held = totals(simulation, simulation.initial)
        after, squeezed = totals(simulation, simulation.run())
        work = -simulation.signal[0] @ (squeezed - held)
        left.append(abs(after - before - work))
        given.append(abs(work))
    assert left[0] <= 0.02 * given[0]
    assert left[1] <= 0.011 * left[0]
    assert given[1] == pytest.approx(0.1 * given[0], rel=0.05)


def margin(simulation):
    return simulation.watch().indicators.energy


@pytest.mark.parametrize("precision", ["double", "single"])
def test_no_energy_appears_in_a_motion_that_is_resolved(precision):
    # A bar that vibrates without loss, for eleven periods: what is seen is the step's own error.
    assert margin(Bar(50, 0.5, precision=precision).simulation) <= 2e-4
    scene = Scene(
        Grid((32, 32), 1 / 32), time_step=2e-3, steps=100, gravity=(1.0, -10.0),
        body=(Solid((0.25, 0.625), (0.5, 0.75)),),
    )  # fmt: skip
    rounding = 1e-12 if precision == "double" else 1e-5
    fall = Problem(scene, precision=precision).simulation(np.zeros(0))
    assert margin(fall) <= rounding
    bounce = replace(scene, steps=1500, walls=(Wall("y", 3 / 32),))
    assert margin(Problem(bounce, precision=precision).simulation(np.zeros(0))) <= rounding


def lively(**changes):
    problem = Problem(small_scene(steps=150, **changes), 2.0)
    return problem, problem.join(np.linspace(-0.8, 0.8, 32), [0.9, 0.5], [-0.3, 0.2], [-0.5, 0.1])


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_the_work_of_an_actuator_counts(monkeypatch, sign):
    # With it nothing appears; taken as its opposite, all of it does.
    problem, x = lively(gravity=(0.0, 0.0), walls=())
    real = energy.grips

    def signed(*arguments):
        real(*arguments)
        arguments[-1][:] *= sign

    monkeypatch.setattr(energy, "grips", signed)
    found = margin(problem.simulation(x))
    assert found == 0.0 if sign > 0.0 else found > 5.0 * LIMITS.energy


def test_the_balance_is_the_same_for_every_schedule_and_for_complex_numbers():
    problem, x = lively()
    simulation = problem.simulation(x)
    simulation.initial[2] += 3.0 * simulation.initial[1]  # it shears: not zero to begin with
    expected = simulation.watch().indicators
    for every in (1, 7, 100, "all"):
        with simulation.checkpoints(Checkpointing(every=every)) as checkpoints:
            assert simulation.forward(checkpoints).indicators == expected
    complex_one = problem.simulation(x + 1j * COMPLEX_STEP)
    assert margin(complex_one) == pytest.approx(margin(problem.simulation(x)), abs=1e-12)


def test_a_clamp_that_moves_may_raise_energy_but_one_at_rest_may_not(monkeypatch):
    # Shaken for 128 steps and then held. What appears is told after every look.
    c = 1 / 16
    path = tuple((k * 8e-3, (0.5 * c * (k % 2), 0.0)) for k in range(33))
    scene = Scene(
        Grid((24, 16), c), time_step=2e-3, steps=512,
        body=(Solid((4 * c, 6 * c), (12 * c, 8 * c)),),
        clamps=(Clamp((3 * c, 5 * c), (7 * c, 9 * c), path),),
    )  # fmt: skip
    assert not parameters_of(scene).clamps[128:, :, 4:].any()
    simulation = Problem(scene).simulation(np.zeros(0))
    found: list[float] = []
    assert margin(simulation) <= 1e-3
    real = energy.energy

    def false(first):
        """Energy that appears once, from a look on."""
        found.clear()

        def told(*arguments):
            kinetic, potential = real(*arguments)
            found.append(kinetic)
            return kinetic + 10.0 * max(found) * (len(found) > first), potential

        monkeypatch.setattr(energy, "energy", told)
        return margin(simulation)

    assert false(1) <= 1e-3
    assert false(4) >= 1.0


@pytest.mark.parametrize(("courant", "least", "most"), [(0.8, 0.0, 1e-6), (1.2, 0.5, np.inf)])
def test_a_step_that_is_unstable_makes_energy(courant, least, most):
    # Free blocks are stable up to 1.10; 50 steps later a particle is inverted.
    scene = block_scene(steps=50)
    particles = discretise(scene)
    state, speed = at_rest(particles), scene.material.wave_speed
    state[2:8] = 1e-6 * speed * np.random.default_rng(1).uniform(-1.0, 1.0, state[2:8].shape)
    assert least <= margin(solid(scene, particles, state, time_step=courant / speed)) <= most


def test_an_evaluation_in_which_energy_appears_fails_and_says_so(monkeypatch):
    problem, x = lively()
    problem.value_and_gradient(x)
    monkeypatch.setattr("mpmopt.simulation.energy.Balance.appeared", 1.01 * LIMITS.energy)
    for function in (problem.value, problem.value_and_gradient):
        with pytest.raises(
            SimulationError, match=r"energy that appears from nowhere reached 0\.05"
        ):
            function(x)
    with pytest.raises(SimulationError, match="energy that appears"):
        post_processed(problem, x)
    Problem(problem.scene, 2.0, halvings=0, limits=None).value_and_gradient(x)


def test_a_body_without_void_that_is_torn_has_no_distance():
    # As in `test_margins`: just below where ellipticity is lost.
    scene = walker(64, 8e-4)
    stress = 0.99 * scene.material.lame_mu / 2.0
    body = tuple(
        replace(part, stress=((stress, 0.0), (0.0, stress))) if isinstance(part, Actuator) else part
        for part in scene.body
    )
    particles = discretise(scene)
    keep = slanted_legs(particles.position[particles.designed])
    push = Variables(np.zeros(0), np.ones(1), np.array([-0.3]), -np.ones(1))
    with pytest.raises(FractureError, match="solid is stretched"):
        distance(replace(scene, body=body), keep, push)
    assert np.isfinite(distance(scene, keep, push))


@pytest.mark.parametrize(
    "wrong",
    [{"a": np.array([1.0, 1.5])}, {"b": np.array([np.nan, 0.0])}, {"theta": np.array([0j, 0.0])}],
)
def test_actuation_beyond_its_bounds_is_refused(wrong):
    push = Variables(np.zeros(0), np.ones(2), np.zeros(2), np.zeros(2))._replace(**wrong)
    with pytest.raises(DesignError, match=next(iter(wrong))):
        distance(small_scene(), np.ones(32, dtype=bool), push)


def test_ellipticity_in_shear_is_lost_where_scenes_say_whatever_the_deformation(rng):
    # docs/failure.rst: m.Q(n)m = n.F (mu I + s S) F^T n for m across n, by finite differences.
    mu, lam, step = 10.0, 7.0, 1e-6

    def first_piola(F, sS):
        J = np.linalg.det(F)
        tau = mu * (F @ F.T - np.eye(2)) + lam * np.log(J) * np.eye(2) + F @ sS @ F.T
        return tau @ np.linalg.inv(F).T

    for _ in range(20):
        F = np.eye(2) + rng.uniform(-0.5, 0.5, (2, 2))
        if np.linalg.det(F) < 0.1:
            continue
        sS = rng.uniform(-12.0, 12.0, (2, 2))
        sS = sS + sS.T
        angle = rng.uniform(0.0, np.pi)
        n, m = np.array([np.cos(angle), np.sin(angle)]), np.array([-np.sin(angle), np.cos(angle)])
        wave = step * np.outer(m, F.T @ n)
        change = (first_piola(F + wave, sS) - first_piola(F - wave, sS)) / (2.0 * step)
        shear = m @ change @ (F.T @ n)
        assert shear == pytest.approx(n @ F @ (mu * np.eye(2) + sS) @ F.T @ n, abs=1e-6)


def test_no_energy_appears_in_a_body_that_hardly_moves():
    # A few particles at rest, but for rounding: alone, or on a floor under a weight of nothing.
    c = 1 / 16
    for width, amplitude, gravity, walls in (
        (2, 1e-12, 0.0, ()),
        (3, 0.0, -1e-12, (Wall("y", 4 * c),)),
        (6, 4e-15, 0.0, ()),
    ):
        body = (Actuator((4 * c, 4 * c), ((4 + width / 2) * c, 4.5 * c)),)
        scene = Scene(Grid((16, 16), c), 1e-3, 200, body, walls, gravity=(0.0, gravity))
        problem = Problem(scene)
        for theta in (-0.7, 0.1, 0.4):
            x = problem.join(np.zeros(0), amplitude, theta, -amplitude)
            assert margin(problem.simulation(x)) <= 0.2 * LIMITS.energy
