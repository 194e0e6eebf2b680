"""The total Lagrangian formulation: its step, its gradient, its laws."""

import dataclasses
import math
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from conftest import worst
from walker import slanted_legs, walker

from mpmopt import kernels
from mpmopt.assess.verify import complex_step_test
from mpmopt.design.problem import Problem
from mpmopt.errors import DesignError, SceneError
from mpmopt.kernels import lagrangian
from mpmopt.scene import Actuator, Design, Grid, Material, Mirror, Scene, Solid, Wall
from mpmopt.scene.ground import Ground
from mpmopt.scene.particles import discretise
from mpmopt.simulation.checkpoints import Checkpointing
from mpmopt.simulation.indicators import looked_at
from mpmopt.simulation.lagrangian import LagrangianSimulation
from mpmopt.simulation.simulation import Simulation

C = 1 / 16


def lattice_scene(**changes) -> Scene:
    """A small walker with two actuators in the total Lagrangian formulation."""
    scene = {
        "grid": Grid(cells=(16, 16), dx=C),
        "time_step": 4e-3,
        "steps": 60,
        "material": Material(void_density=1e-2, void_stiffness=1e-3, viscosity=0.05),
        "gravity": (0.5, -10.0),
        "ground": (
            Ground(((0.0, 4 * C), (5 * C, 4 * C), (1.0, 3.7 * C)), friction=0.4, thickness=C),
        ),
        "formulation": "total",
        "body": (
            Design((3 * C, 4 * C), (7 * C, 6 * C)),
            Actuator((3 * C, 6 * C), (4 * C, 7 * C), stress=((2.0, 0.5), (0.5, 1.0))),
            Solid((4 * C, 6 * C), (6 * C, 7 * C)),
            Actuator((6 * C, 6 * C), (7 * C, 7 * C), angular_frequency=50.0),
        ),
    }
    return Scene(**{**scene, **changes})


def material_of(simulation):
    """Density and stiffness of particles that are all solid."""
    return np.ones(len(simulation.position)), np.ones(len(simulation.position))


def reference_step(simulation, nodes, n):
    """One step as its equations say it, node by node; without ground."""
    scene, lattice = simulation.scene, simulation.lattice
    N, Gx, Gy = (each.toarray() for each in simulation._weights)
    count = len(N)
    x, v = nodes[:2].T, nodes[2:].T
    f = np.zeros_like(x)
    stiffness = kernels.ungrouped(simulation.data.stiffness, 1, count)[0]
    mass = N.T @ kernels.ungrouped(simulation.data.mass, 1, count)[0]
    la, mu, eta = (getattr(scene.material, name) for name in kernels.PARAMETERS)
    for p in range(count):
        F = np.stack([Gx[p] @ x, Gy[p] @ x], axis=1)
        rate = np.stack([Gx[p] @ v, Gy[p] @ v], axis=1)
        J = np.linalg.det(F)
        if J >= lagrangian.LEAST_J:
            log, slope = math.log(J), 1.0 / J
        else:
            off = J / lagrangian.LEAST_J - 1.0
            log = math.log(lagrangian.LEAST_J) + off - off**2 / 2
            slope = (1.0 - off) / lagrangian.LEAST_J
        cofactor = np.array([[F[1, 1], -F[1, 0]], [-F[0, 1], F[0, 0]]])
        S = eta * (F.T @ rate + rate.T @ F) / 2
        P = stiffness[p] * (mu * F + (la * log - mu) * slope * cofactor + F @ S)
        k = simulation.particles.actuator[p]
        if k >= 0:
            P = P + simulation.signal[n, k] * F @ np.array(scene.actuators[k].stress)
        f -= lattice.volume * (np.outer(Gx[p], P[:, 0]) + np.outer(Gy[p], P[:, 1]))
    new = nodes.copy()
    there = mass > 0.0
    dt = scene.time_step
    new[2:, there] += dt * (f[there] / mass[there, None] + np.array(scene.gravity)).T
    new[:2] += dt * new[2:]
    return new


@pytest.mark.parametrize("per_cell", [2, 3])
def test_a_step_is_what_its_equations_say(rng, per_cell):
    scene = lattice_scene(ground=(), particles_per_cell=per_cell)
    particles = discretise(scene)
    count = len(particles.position)
    simulation = LagrangianSimulation(
        scene, particles, *rng.uniform(0.2, 1.0, (2, count)), rng.uniform(-1.0, 1.0, (60, 2))
    )
    nodes = simulation.start.copy()
    nodes[:2] += 1.5 * C * rng.uniform(-1.0, 1.0, (2, simulation.nodes))
    nodes[2:] = rng.standard_normal((2, simulation.nodes))
    nodes[2:, simulation.lattice.mass == 0.0] = 0.0
    states = np.zeros((2, *nodes.shape))
    states[0] = nodes  # solid and void alike
    lagrangian.advance_lattice(states, 0, 1, simulation.lattice, simulation.signal)
    expected = reference_step(simulation, nodes, 0)
    assert np.abs(states[1] - expected).max() <= 1e-13 * np.abs(expected).max()
    F = kernels.parts(simulation.particle_state(nodes)).deformation
    J = F[0, 0] * F[1, 1] - F[0, 1] * F[1, 0]
    assert J.min() < lagrangian.LEAST_J < 1.0 < J.max()  # on both sides of the continuation


@pytest.mark.parametrize(
    "changes",
    [
        {},
        {"ground": (Ground(((0.0, 4 * C), (1.0, 4 * C)), friction="stick", thickness=C),)},
        {"ground": (Ground(((0, 0), (4.6 * C, 4 * C), (1, 0)), friction=0.4, thickness=C),)},
        {"particles_per_cell": 3, "time_step": 2e-3},
        {"transient": 0.1},
        {"material": Material(void_density=1e-2)},
    ],
)
def test_the_gradient_is_exact_in_contact(rng, changes):
    problem = Problem(lattice_scene(**changes), 2.0, halvings=0, limits=None)
    designed = int(problem.particles.designed.sum())
    x = problem.join(rng.uniform(-0.8, 0.8, designed), 0.9, -0.3, -0.5)
    assert worst(complex_step_test(problem, x)) <= 1e-12


def test_the_gradient_is_the_same_for_all_checkpoints(rng):
    scene = lattice_scene()
    x = rng.uniform(-0.8, 0.8, Problem(scene).size)
    whole = Problem(scene).value_and_gradient(x)
    for every in (7, "all", 60):
        for store in ("memory", "disk"):
            value, gradient = Problem(
                scene, checkpointing=Checkpointing(every=every, store=store)
            ).value_and_gradient(x)
            assert value == whole[0]
            assert np.array_equal(gradient, whole[1])


@pytest.mark.slow
def test_single_precision_loses_digits_but_few(rng):
    double, single = (
        Problem(lattice_scene(), precision=precision) for precision in ("double", "single")
    )
    x = rng.uniform(-0.8, 0.8, double.size)
    value, gradient = double.value_and_gradient(x)
    coarse, also = single.value_and_gradient(x)
    assert 0.0 < abs(coarse - value) <= 1e-5
    assert np.linalg.norm(also - gradient) <= 1e-3 * np.linalg.norm(gradient)


def channel(mirror, axis):
    """A block between two grounds with this normal, whole or half of it."""

    def turned(x, y):
        return (x, y) if axis == "y" else (y, x)

    def wall(*points):
        return Ground(points if axis == "y" else points[::-1], friction=0.4, thickness=C)

    body = (
        Design(turned(3 * C, 4 * C), turned(5 * C, 8 * C)),
        Actuator(turned(5 * C, 4 * C), turned(7 * C, 8 * C)),
    )
    walls = (
        wall(turned(0.0, 4 * C), turned(1.0, 4 * C)),
        wall(turned(1.0, 8 * C), turned(0.0, 8 * C)),
    )
    return lattice_scene(
        body=body, ground=walls, gravity=(0.0, 0.0), direction=turned(1.0, 0.0),
        mirror=Mirror(axis, 6 * C) if mirror else None,
    )  # fmt: skip


@pytest.mark.parametrize("axis", ["x", "y"])
def test_half_a_symmetric_body_is_the_same_solution_and_has_the_same_gradient(rng, axis):
    half, whole = Problem(channel(True, axis), 2.0), Problem(channel(False, axis), 2.0)
    x = half.join(rng.uniform(-0.5, 0.5, int(half.particles.designed.sum())), 0.9, -0.3, -0.5)
    value, gradient = half.value_and_gradient(x)
    y = whole.transfer(half, x)
    position, own = (p.particles.position[p.particles.designed] for p in (whole, half))
    k = "xy".index(axis)
    folded = position.copy()
    folded[:, k] = np.minimum(position[:, k], 12 * C - position[:, k])
    image = np.array([np.abs(own - each).sum(axis=1).argmin() for each in folded])
    y[: len(image)] = x[image]
    expected, by_y = whole.value_and_gradient(y)
    assert value == pytest.approx(expected, rel=1e-12)
    summed = np.zeros(len(own))
    np.add.at(summed, image, by_y[: len(image)])
    assert gradient[: len(own)] == pytest.approx(summed, rel=1e-9, abs=1e-13)
    assert worst(complex_step_test(half, x)) <= 1e-12


def free_block(**changes):
    scene = lattice_scene(
        ground=(), gravity=(0.0, 0.0),
        body=(Solid((4 * C, 4 * C), (9 * C, 7 * C)), Actuator((9 * C, 4 * C), (12 * C, 7 * C))),
        **changes,
    )  # fmt: skip
    particles = discretise(scene)
    t = scene.time_step * np.arange(scene.steps)
    return LagrangianSimulation(scene, particles, *material_of(particles), np.sin(20 * t)[:, None])


def test_a_free_body_keeps_its_momenta():
    simulation = free_block()
    states = np.zeros((61, *simulation.start.shape))
    states[0] = simulation.start
    states[0, 2] = 0.3 + 2.0 * (states[0, 1] - 0.3)
    lattice = simulation.lattice
    lagrangian.advance_lattice(states, 0, 60, lattice, simulation.signal)
    x, v, m = states[:, :2], states[:, 2:], lattice.mass
    linear = np.einsum("m,skm->sk", m, v)
    before = x - simulation.scene.time_step * v  # positions that the velocities were found at
    angular = np.einsum("m,sm->s", m, before[:, 0] * v[:, 1] - before[:, 1] * v[:, 0])
    assert np.abs(linear - linear[0]).max() <= 1e-13 * np.abs(linear[0]).max()
    assert np.abs(angular - angular[0]).max() <= 1e-12 * np.abs(angular[0])
    assert np.abs(v - v[0]).max() > 0.1


def test_cells_are_asked_anew_when_nodes_may_have_come_near(rng):
    # What all steps in one call give is what single steps do, each of which asks all cells.
    scene = lattice_scene(ground=(Ground(((0.0, C), (1.0, C)), friction=0.4, thickness=C),))
    particles = discretise(scene)
    simulation = LagrangianSimulation(scene, particles, *material_of(particles), np.zeros((60, 2)))
    lattice, signal = simulation.lattice, simulation.signal
    states = np.zeros((61, *simulation.start.shape))
    states[0] = simulation.start
    states[0, 3] = np.where(lattice.mass > 0.0, -3.0, 0.0)
    by_one = states.copy()
    lagrangian.advance_lattice(states, 0, 60, lattice, signal)
    for n in range(60):
        lagrangian.advance_lattice(by_one, n, n + 1, lattice, signal)
    assert states[..., 3, :].min() < -2.9
    assert states[..., 3, :].max() > 0.5  # it bounces
    assert np.array_equal(states, by_one)
    found = []
    terminal = rng.standard_normal(simulation.start.shape)
    for cuts in ([0, 60], range(61)):
        bar, signal_bar = lagrangian.LatticeBar.zeros(lattice), np.zeros_like(signal)
        state_bar = np.where(lattice.mass > 0.0, terminal, 0.0)
        for first, last in reversed([*pairwise(cuts)]):
            lagrangian.advance_lattice_adjoint(
                states, first, last, lattice, signal, state_bar, bar, signal_bar
            )
        found.append(np.concatenate([state_bar.ravel(), bar.mass, bar.stiffness.ravel()]))
    at_once, stepwise = found
    assert np.array_equal(at_once, stepwise)


def energy(simulation, nodes):
    """Kinetic and stored energy of a state of the nodes, whose velocities are half a step old."""
    scene, lattice = simulation.scene, simulation.lattice
    x, v = nodes[:2], nodes[2:]
    middle = np.concatenate([x - 0.5 * lattice.dt * v, v])
    F = kernels.parts(simulation.particle_state(middle)).deformation
    log = np.log(F[0, 0] * F[1, 1] - F[0, 1] * F[1, 0])
    material = scene.material
    stored = material.lame_mu / 2.0 * ((F**2).sum(axis=(0, 1)) - 2.0 - 2.0 * log)
    stored += material.lame_lambda / 2.0 * log**2
    return (lattice.mass * (v**2).sum(axis=0)).sum() / 2.0, lattice.volume * stored.sum()


@pytest.mark.parametrize("steps", [3000, pytest.param(100_000, marks=pytest.mark.slow)])
def test_the_energy_of_a_vibrating_bar_does_not_drift(steps):
    scene = lattice_scene(
        ground=(), gravity=(0.0, 0.0), material=Material(), steps=steps, time_step=2e-3,
        body=(Solid((3 * C, 5 * C), (13 * C, 7 * C)),),
    )  # fmt: skip
    particles = discretise(scene)
    simulation = LagrangianSimulation(
        scene, particles, *material_of(particles), np.zeros((steps, 0))
    )
    segment = simulation.segment(1)
    state = segment.states
    there = simulation.lattice.mass > 0.0
    x = simulation.start[0] - 0.5
    state[0, 3] = np.where(there, 0.3 * (12.0 * x**2 - 0.33), 0.0)  # it bends
    found = []
    for _ in range(steps // 50):
        found.append(energy(simulation, state[0]))
        segment.advance(0, 50)
    kinetic, stored = np.array(found).T
    total = kinetic + stored
    share = len(total) // 5
    assert stored.max() > 0.8 * total[0]
    assert np.ptp(total) <= 2e-3 * total[0]
    assert total[-share:].mean() == pytest.approx(total[:share].mean(), rel=1e-4)


def test_void_may_invert_and_the_gradient_stays_exact(rng):
    # The end of a block of void is thrown through the rest.
    c = C
    scene = lattice_scene(
        ground=(), gravity=(0.0, 0.0), material=Material(void_density=1e-2, void_stiffness=1e-4),
        time_step=2e-3, steps=60,
        body=(
            Design((3 * c, 4 * c), (5 * c, 7 * c)),
            Actuator((5 * c, 4 * c), (7 * c, 7 * c), stress=((4.9, 0.0), (0.0, 0.0))),
        ),
    )  # fmt: skip
    problem = Problem(scene, 8.0, halvings=0, limits=None)
    x = problem.join(rng.uniform(-1.0, -0.8, int(problem.particles.designed.sum())), 1.0, 0.9, 0.0)
    simulation: Any = problem.simulation(x)
    simulation.start[2] = 3.0 * (simulation.start[0] < 3.6 * c)
    F = kernels.parts(simulation.run(range(0, 61, 5))).deformation
    J = F[:, 0, 0] * F[:, 1, 1] - F[:, 0, 1] * F[:, 1, 0]
    assert J.min() < lagrangian.LEAST_J
    terminal = rng.standard_normal(simulation.initial.shape)
    terminal[4:8] = 0.0
    with simulation.checkpoints(Checkpointing()) as checkpoints:
        gradient = simulation.forward(checkpoints).reverse({60: terminal})
    direction = rng.standard_normal(simulation.start.shape)
    moved: Any = problem.simulation(x + 0j)
    moved.start[:] = simulation.start + 1e-30j * direction
    found = (terminal * moved.run()).sum().imag / 1e-30
    assert found == pytest.approx((gradient.state * direction).sum(), rel=1e-10)


def test_an_isolated_cell_is_stable_up_to_the_limit_and_not_far_beyond():
    scene = lattice_scene(
        body=(Solid((4 * C, 4 * C), (5 * C, 5 * C)), Actuator((5 * C, 4 * C), (6 * C, 5 * C))),
        ground=(), gravity=(0.0, 0.0), material=Material(), time_step=1e-3, steps=400,
    )  # fmt: skip
    particles = discretise(scene)
    particles = particles.subset(particles.position[:, 0] < 5 * C)

    def grows(share):
        simulation = LagrangianSimulation(
            scene, particles, *material_of(particles), np.zeros((400, 1))
        )
        simulation.lattice = simulation.lattice._replace(dt=share * scene.largest_time_step)
        rough = np.random.default_rng(1).standard_normal((2, simulation.nodes))
        simulation.start[:2] += 1e-6 * C * rough
        states = np.zeros((401, *simulation.start.shape))
        states[0] = simulation.start
        with np.errstate(all="ignore"):
            _, failed = lagrangian.advance_lattice(
                states, 0, 400, simulation.lattice, simulation.signal
            )
        return failed >= 0 or not np.abs(states[-1] - simulation.start).max() < 1e-2 * C

    assert not grows(0.99)
    assert grows(1.5)


def walked(kind: Any, cells: int) -> float:
    """How far a walker drawn by hand goes in a second."""
    scene = dataclasses.replace(
        walker(cells, 0.0512 / cells), walls=(), material=Material(viscosity=0.02),
        gravity=(0.0, -1.0),  # under more its legs fold, and touch
        ground=(Ground(((0.0, 4 / 64), (1.0, 4 / 64)), friction=0.5),),
    )  # fmt: skip
    scene = dataclasses.replace(scene, steps=round(1.0 / scene.time_step))
    particles = discretise(scene)
    there = slanted_legs(particles.position[particles.designed])
    particles = particles.subset(particles.completed(there))
    t = scene.time_step * np.arange(scene.steps)
    signal = (np.sin(30.0 * t - 0.3 * np.pi) - 0.5)[:, None]
    simulation = kind(scene, particles, *material_of(particles), signal)
    ends = simulation.run([0, scene.steps])[:, 0, ~particles.designed].mean(axis=1)
    return float(ends[1] - ends[0])


def test_both_formulations_tend_to_the_same_walk():
    coarse, fine = ([walked(kind, n) for kind in (Simulation, LagrangianSimulation)]
                    for n in (64, 96))  # fmt: skip
    limits = [b + (b - a) / (1.5**2 - 1.0) for a, b in zip(coarse, fine)]
    assert limits[0] > 0.1
    assert limits[1] == pytest.approx(limits[0], rel=0.05)
    assert abs(limits[1] - coarse[1]) < 0.6 * abs(limits[0] - coarse[0])


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({"walls": (Wall("y", 4 * C),), "ground": ()}, "no grid for 1 walls; stand the body"),
        ({"formulation": "eulerian"}, 'must be "updated" or "total"'),
    ],
)
def test_what_the_formulation_cannot_do_is_said_with_the_cure(changes, says):
    with pytest.raises(SceneError, match=says):
        lattice_scene(**changes)


def test_single_precision_is_refused():
    problem = Problem(lattice_scene(), precision="single")
    with pytest.raises(DesignError, match='no precision "single"; take "double"'):
        problem.value(problem.join(0.0, 1.0, -0.3, -0.5))


def test_the_formulation_travels_as_json():
    scene = lattice_scene()
    assert Scene.from_json(scene.to_json()) == scene


def test_states_one_after_the_other_are_those_of_a_run():
    simulation = free_block(steps=3)
    one_by_one = np.array(list(simulation.states()))
    assert np.array_equal(one_by_one, simulation.run(range(4)))


def test_a_look_sees_what_the_definitions_say(rng):
    material = Material(viscosity=0.1, void_density=1e-2, void_stiffness=1e-3)
    scene = lattice_scene(material=material)
    particles = discretise(scene)
    count = len(particles.position)
    stiffness = rng.uniform(0.3, 1.0, count)
    solid = stiffness >= 0.5
    density = np.where(solid, rng.uniform(0.7, 1.0, count), 0.1)  # waves are fastest in void
    simulation = LagrangianSimulation(scene, particles, density, stiffness, np.zeros((60, 2)))
    sizes = (1.0, 0.3), (1.0, 2.0), (1.0, 0.0), (0.3, 0.1), (12.0, 0.0)  # the last one softens
    states = np.zeros((len(sizes), *simulation.start.shape))
    for n, (shrunk, rough) in enumerate(sizes):
        states[n] = simulation.start
        states[n, :2] += (shrunk - 1.0) * (states[n, :2] - 5 * C)
        states[n, :2] += shrunk * rough * C * rng.standard_normal((2, simulation.nodes))
    per_dx = scene.time_step / scene.grid.dx
    expected = []
    for nodes in states:
        state = simulation.particle_state(nodes)
        F = kernels.parts(state).deformation[..., solid]
        J = F[0, 0] * F[1, 1] - F[0, 1] * F[1, 0]
        s2 = np.linalg.svd(F.T)[1][:, 0] ** 2
        log, slope, bend = kernels.plain(lagrangian.continued)(J)
        hardening = material.lame_lambda * slope**2
        hardening += (material.lame_lambda * log - material.lame_mu) * bend
        share = (stiffness / density)[solid]
        elastic = per_dx**2 * share * (material.lame_mu + np.maximum(hardening, 0.0) * s2)
        reach = scene.layers[0].thickness + 0.25 * scene.grid.dx  # half a particle's width more
        within = scene.layers[0].line.distance(state[:2, solid])[0] < reach
        rising = scene.layers[0].stiffness / scene.layers[0].thickness
        elastic += within * share * rising * (scene.time_step / 2.0) ** 2
        viscous = per_dx / scene.grid.dx * share * material.viscosity * s2
        courant = (viscous + np.sqrt(viscous**2 + elastic)).max()
        expected.append((courant, J.min(), *simulation.gap(kernels.grouped(state))))
        found = simulation.look(nodes[None], [0])
        assert (found.courant, found.jacobian) == pytest.approx((courant, J.min()), rel=1e-13)
        assert found[5:] == pytest.approx(expected[-1][2:], rel=1e-13)
    seen = simulation.look(states, [3, 1])
    assert seen.courant == pytest.approx(max(expected[3][0], expected[1][0]), rel=1e-13)
    assert seen.jacobian == pytest.approx(min(expected[3][1], expected[1][1]), rel=1e-13)
    assert seen[5:] == pytest.approx(min(expected[3][2:], expected[1][2:]), rel=1e-13)
    assert min(each[1] for each in expected) < lagrangian.LEAST_J
    assert seen.gap < math.inf


@pytest.mark.parametrize("segment", [1, 7, 64, 100, 1000])
def test_states_are_looked_at_once_whatever_the_segments(segment):
    steps, seen = 200, []
    for first in range(0, steps, segment):
        last = min(first + segment, steps)
        seen += [first + slot for slot in looked_at(first, last, steps, 64)]
    assert seen == [0, 64, 128, 192, 200]


@pytest.mark.parametrize("per_cell", [1, 2])
@pytest.mark.parametrize(
    "points",
    [
        ((0.0, 4 * C), (1.0, 4 * C)),
        ((0.0, 0.5 * C), (1.0, 3.6 * C)),
        ((0.0, 0.0), (6.2 * C, 3.4 * C), (1.0, 0.0)),
    ],
)
def test_what_a_layer_reaches_within_a_skin_is_never_clear(rng, points, per_cell):
    ground = Ground(points, thickness=C)
    scene = lattice_scene(ground=(ground,), particles_per_cell=per_cell)
    particles = discretise(scene)
    lattice = LagrangianSimulation(
        scene, particles, *material_of(particles), np.zeros((60, 2))
    ).lattice
    places = C * rng.uniform(1.0, 14.0, (2, 4000))
    away = scene.layers[0].line.distance(places)[0] - C - 0.5 * C / per_cell
    clear = [kernels.plain(lagrangian.is_clear)(x, y, lattice) for x, y in places.T]
    assert not np.any(clear & (away < lagrangian.SKIN * C))
    assert np.all(np.array(clear)[away > (lagrangian.SKIN + 1.5) * C])
