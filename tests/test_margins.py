"""Step control: how close a run came to failure, and evaluations that are redone for it."""

import dataclasses

import numpy as np
import pytest
from conftest import small_scene, worst
from walker import walker

from mpmopt.checkpoints import Checkpointing
from mpmopt.errors import DesignError, SimulationError
from mpmopt.optimize import Settings, Stage, optimise
from mpmopt.problem import LIMITS, Problem
from mpmopt.scene import Design, Grid, Material, Solid, Wall
from mpmopt.simulate import WATCH, Margins
from mpmopt.verify import COMPLEX_STEP, COMPLEX_TOLERANCE, complex_step_test

CELL = 1 / 16


def stiffness(F, mu, lame_lambda):
    """Largest |d tau / d L| over symmetric strain rates L of unit norm: a dense 3 x 3 problem."""
    b = F @ F.T
    basis = [np.diag([1.0, 0.0]), np.diag([0.0, 1.0]), np.array([[0.0, 1.0], [1.0, 0.0]]) / 2**0.5]
    columns = [mu * (L @ b + b @ L.T) + lame_lambda * np.trace(L) * np.eye(2) for L in basis]
    return np.linalg.eigvalsh([[np.sum(E * A) for A in columns] for E in basis]).max()


def watched(scene, particles, states, mass, mu, lame_lambda):
    """Margins of some states, particle by particle."""
    dt, dx = scene.time_step, scene.grid.dx
    courant, spin, jacobian = [], [], []
    for state in states:
        for p in range(state.shape[1]):
            C, F = state[4:8, p].reshape(2, 2), state[8:12, p].reshape(2, 2)
            speed = stiffness(F, mu[p], lame_lambda[p]) * particles.volume[p] / mass[p]
            courant.append(dt / dx * np.sqrt(speed))
            spin.append(dt * np.linalg.norm(C))
            jacobian.append(np.linalg.det(F))
    return Margins(max(courant), max(spin), min(jacobian))


def lively(**changes):
    """A small walker that starts undeformed and moves fast; 46 particles, so one group is filled."""
    body = small_scene().body
    body = (*body[:2], Solid((4.5 * CELL, 6 * CELL), (6 * CELL, 7 * CELL)), body[3])
    return small_scene(body=body, **changes)


def design_of(problem, rng):
    designed = int(problem.particles.designed.sum())
    actuators = len(problem.scene.actuators)
    return problem.join(rng.uniform(-0.8, 0.8, designed), *(np.full(actuators, v) for v in (0.9, -0.3, -0.5)))  # fmt: skip


@pytest.mark.parametrize("steps", [5, 3 * WATCH, 3 * WATCH + 1])
def test_margins_are_those_of_every_sixteenth_state_and_the_last(rng, steps):
    problem = Problem(lively(steps=steps), 2.0, redo=0)
    x = design_of(problem, rng)
    simulation = problem.simulation(x)
    states = simulation.run(sorted({*range(0, steps, WATCH), steps}))
    density, lame_lambda, mu = problem.chain.material(problem.split(x).phi)
    mass = simulation.particles.volume * density
    expected = watched(problem.scene, simulation.particles, states, mass, mu, lame_lambda)
    assert len(density) % 4 == 2
    final, margins = simulation.watch()
    assert margins == pytest.approx(expected, rel=1e-12)
    assert np.array_equal(final, states[-1])
    assert min(margins.spin, 1.0 - margins.jacobian) > 1e-4  # something moved
    for every in (None, 7, "all"):
        with simulation.checkpoints(Checkpointing(every=every)) as checkpoints:
            assert simulation.forward(checkpoints).margins == margins


def test_an_undeformed_body_is_at_its_scenes_limit(scene):
    # Where void is as heavy as it is stiff, the stretched particle's limit is that of the scene.
    scene = scene.vary(mass_floor=1e-3)
    problem = Problem(scene, redo=0)
    simulation = problem.simulation(problem.join(1.0, 0.0, 0.0, 0.0))
    courant, spin, jacobian = simulation.margins(np.array(mpm_grouped(simulation)))
    assert courant == pytest.approx(scene.time_step / scene.largest_time_step, rel=1e-12)
    assert (spin, jacobian) == (0.0, 1.0)


def mpm_grouped(simulation):
    from mpmopt import mpm

    return mpm.grouped(simulation.initial)
