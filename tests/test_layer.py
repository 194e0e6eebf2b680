"""The contact layer: its laws, their adjoints, and what bodies do on it."""

import dataclasses
import math

import numpy as np
import pytest
from conftest import small_scene, worst
from exact import at_rest, solid_simulation

from mpmopt import kernels
from mpmopt.assess.verify import COMPLEX_STEP, DOT_TOLERANCE, complex_step_test, kernel_mismatches
from mpmopt.design.problem import Problem
from mpmopt.kernels import layer
from mpmopt.scene import Design, Grid, Ground, Material, Mirror, Scene, Solid
from mpmopt.scene.particles import discretise
from mpmopt.simulation.reference import step
from mpmopt.simulation.simulation import Simulation

C = 1 / 16
GROUNDS = {
    "floor": (Ground.floor(3.9 * C, friction=0.3, thickness=C),),
    "slope": (Ground.slope((5 * C, 3.7 * C), 3.0, friction=0.6, thickness=C),),
    "sticks": (Ground.floor(3.9 * C, friction="stick", thickness=C),),
    "slippery": (Ground.floor(3.9 * C, friction=0.0, damping=0.0, thickness=C),),
    "convex": (Ground(((2 * C, 2 * C), (5.05 * C, 3.9 * C), (8 * C, 2.5 * C)), thickness=C),),
    "concave": (
        Ground(((2.4 * C, 8 * C), (2.9 * C, 3.6 * C), (8 * C, 3.8 * C)), thickness=C, damping=9.0),
    ),
    "two": (
        Ground.floor(3.9 * C, friction=0.3, thickness=C),
        Ground(((2.85 * C, 8 * C), (2.85 * C, 0.0)), thickness=C, friction=2.0),
    ),
}


def standing(name, **changes):
    """The small scene without walls on a ground of that name."""
    material = Material(void_density=1e-2, void_stiffness=1e-3, viscosity=0.02)
    ground = GROUNDS[name]
    return small_scene(**{
        "walls": (), "ground": ground, "time_step": 2e-3, "material": material, **changes,
    })  # fmt: skip


def law(name):
    return kernels.plain(getattr(layer, name))


CONTACTS = [
    (0.6, 0.8, 0.5, 1.0, 0.02), (0.0, 1.0, 0.0, 0.0, 0.1), (-1.0, 0.0, math.inf, 2.0, 0.1),
    (0.8, -0.6, 30.0, 0.5, 1e-3),
]  # fmt: skip


@pytest.mark.parametrize("contact", CONTACTS)
def test_friction_and_damping_take_what_they_say(contact):
    n, (mu, alpha, creeping) = np.array(contact[:2]), contact[2:]
    t = np.array([-n[1], n[0]])
    for speed, push in ((3.0, 0.4), (-0.01, 0.02), (0.0, 1.0)):
        u = np.array(law("resistance")(*(0.7 * n + speed * t), push, contact))
        assert u @ n == pytest.approx(0.7 / (1.0 + alpha * push))
        if mu == math.inf:
            assert u @ t == pytest.approx(0.0, abs=1e-15)
        else:  # the friction of a step is that of the velocity at its end
            x = u @ t / creeping
            tau = math.copysign(1.0, x) if abs(x) > 1.0 else x * (2.0 - abs(x))
            assert u @ t + mu * push * tau == pytest.approx(speed, rel=1e-10, abs=1e-12)


def test_friction_is_continuous_where_creeping_ends():
    for c in (0.0, 0.3):
        low, high = (law("friction")(0.1 + c + change, c, 0.1) for change in (-1e-12, 1e-12))
        assert low == pytest.approx(high, abs=1e-11)
        low, high = (
            law("friction_adjoint")(0.1 + c + change, c, 0.1, 1.0) for change in (-1e-12, 1e-12)
        )
        assert low == pytest.approx(high, abs=1e-5)


@pytest.mark.parametrize("contact", CONTACTS)
def test_the_adjoint_of_resistance_is_transposed(rng, contact):
    for _ in range(20):
        x, w = np.append(rng.standard_normal(2), rng.uniform(0.0, 2.0)), rng.standard_normal(2)
        found = law("resistance_adjoint")(*x, contact, *w)
        for k in range(3):
            moved = x + 1j * COMPLEX_STEP * (np.arange(3) == k)
            varied = np.imag(law("resistance")(*moved, contact)) / COMPLEX_STEP
            assert abs(varied @ w - found[k]) <= 1e-14 * (1.0 + np.abs(varied * w).sum())


def test_what_bears_is_the_slope_of_what_is_stored():
    for d in (-0.3, 0.1, 0.7, 1.4):
        moved, share = complex(d, COMPLEX_STEP), complex(5.0, COMPLEX_STEP)
        force = law("bearing")(d, 0.9, 5.0)
        energy = [law("stored")(d + change, 0.9, 5.0) for change in (-1e-6, 1e-6)]
        assert force == pytest.approx((energy[0] - energy[1]) / 2e-6, abs=1e-8)
        assert force == pytest.approx(max(5.0 * (1.0 - d / 0.9), 0.0))
        d_bar, share_bar = law("bearing_adjoint")(d, 0.9, 5.0, 1.0)
        assert d_bar == pytest.approx(law("bearing")(moved, 0.9, 5.0).imag / COMPLEX_STEP)
        assert share_bar == pytest.approx(law("bearing")(d, 0.9, share).imag / COMPLEX_STEP)


@pytest.mark.parametrize("width", [0.3, 2.5])  # the other one is wider than the layer
def test_a_mean_is_what_narrower_particles_bear(width):
    for d in (-0.3, 0.7, 0.9, 1.2, 3.0):
        parts = d + width * ((np.arange(4000) + 0.5) / 4000 - 0.5)
        expected = np.mean([law("bearing")(part, 0.9, 5.0) for part in parts])
        assert law("mean_bearing")(d, 0.9, width, 5.0) == pytest.approx(expected, abs=1e-6)
        moved, share = complex(d, COMPLEX_STEP), complex(5.0, COMPLEX_STEP)
        d_bar, share_bar = law("mean_bearing_adjoint")(d, 0.9, width, 5.0, 2.0)
        varied = law("mean_bearing")(moved, 0.9, width, 5.0).imag / COMPLEX_STEP
        assert d_bar == pytest.approx(2.0 * varied)
        varied = law("mean_bearing")(d, 0.9, width, share).imag / COMPLEX_STEP
        assert share_bar == pytest.approx(2.0 * varied)


@pytest.mark.parametrize("width", [0.0, 0.3 * C, 2.5 * C])
def test_layers_know_what_their_kernels_do(width):
    (floor,) = standing("floor").layers
    for d in (-0.3 * C, 0.7 * C, 0.99 * C, 3.0 * C):
        expected = (
            law("mean_bearing")(d, floor.thickness, width, 1.0)
            if width
            else law("bearing")(d, floor.thickness, 1.0)
        )
        assert floor.bearing(np.array(d), width) == pytest.approx(expected)
        step = 1e-6 * C
        energy = floor.stored(np.array([d - step, d + step]), width)
        slope = (energy[0] - energy[1]) / (2.0 * step)
        assert slope == pytest.approx(float(floor.bearing(np.array(d), width)), abs=1e-5)


@pytest.mark.parametrize("width", [0.01, 0.3, 0.7, 2.0])
def test_rows_add_up_to_the_same_wherever_they_lie(width):
    for surface in np.linspace(-0.5, 0.8, 7):
        rows = surface + width * (np.arange(200) + 0.5)
        borne = width * sum(law("mean_bearing")(row, 0.9, width, 5.0) for row in rows)
        # The integral of 5 <1 - s/0.9> from the surface on.
        assert borne == pytest.approx(5.0 * (0.9 - surface) ** 2 / 1.8, rel=1e-12)


@pytest.mark.parametrize("cells", [16, 24, 32])
def test_a_lattice_sinks_as_deep_as_the_layer_says_on_any_cells(cells):
    c, height, thickness, stiffness = 1 / cells, 0.25, 1 / 16, 3e3
    depth = math.sqrt(2.0 * thickness * 10.0 * height / stiffness)
    scene = Scene(
        Grid((cells, cells), c), 2e-3 * c, 250 * cells, gravity=(0.0, -10.0), direction=(0.0, 1.0),
        material=Material(3e3, 3e3, viscosity=0.3), formulation="total",
        body=(Solid((0.25, 0.5), (0.75, 0.5 + height)),),
        ground=(Ground.floor(0.5 + depth - thickness, thickness=thickness, damping=20.0,
                             stiffness=stiffness),),
    )  # fmt: skip
    simulation = Problem(scene, halvings=0, limits=None).simulation(np.zeros(0))
    end = simulation.run()
    assert np.abs(end[2:4]).max() < 1e-3
    assert abs((end - simulation.initial)[1].mean()) <= 5e-3 * depth


def moving(scene, rng, dtype=float):
    """A body of any material in rough motion."""
    particles = discretise(scene)
    count = len(particles.position)
    state = at_rest(particles).astype(dtype)
    state[2:4] = rng.uniform(-0.5, 0.5, (2, count))
    state[4:8] = rng.uniform(-20.0, 20.0, (4, count))
    state[8:12] += rng.uniform(-0.2, 0.2, (4, count))
    density, stiffness = rng.uniform(0.1, 1.0, (2, count))
    signal = np.full((scene.steps, len(scene.actuators)), 0.5)
    return Simulation(scene, particles, density, stiffness, signal, state)


@pytest.mark.parametrize("name", GROUNDS)
def test_kernels_do_what_the_equations_say(rng, name):
    for dtype in (float, complex):
        simulation = moving(standing(name, steps=1), rng, dtype)
        expected = step(simulation, simulation.initial, 0)
        free = step(moving(standing(name, steps=1, ground=()), rng), simulation.initial, 0)
        assert np.abs(expected - free)[2:4].max() > 1e-4
        assert np.abs(simulation.run() - expected).max() <= 1e-12 * np.abs(expected).max()


@pytest.mark.parametrize("name", GROUNDS)
def test_every_kernel_is_transposed(name):
    for seed in range(3):
        found = kernel_mismatches(standing(name), seed)
        assert max(found.values()) <= DOT_TOLERANCE
        assert "press" in found


@pytest.mark.parametrize("name", GROUNDS)
def test_the_whole_gradient_is_exact(rng, name):
    problem = Problem(standing(name), 2.0, halvings=0, limits=None)
    x = problem.join(rng.uniform(-1.0, 1.0, 32), [0.9, 0.5], [-0.3, 0.2], [-0.5, 0.1])
    assert worst(complex_step_test(problem, x)) <= 1e-12


def block(ground, **changes):
    """A solid block of 4 x 4 cells that may rest on ground."""
    scene = {
        "grid": Grid((24, 16), C), "time_step": 2e-3, "steps": 200,
        "body": (Solid((4 * C, 5 * C), (8 * C, 9 * C)),), "ground": (ground,),
        "gravity": (0.0, -10.0), "material": Material(100.0, 100.0),
    }  # fmt: skip
    return Scene(**{**scene, **changes})


def pressed(scene, state):
    """Normal force of every particle."""
    total = 0.0
    for each in scene.layers:
        d, _ = each.line.distance(state[:2])
        total = total + (C / 2) ** 2 * each.stiffness * np.maximum(1.0 - d / each.thickness, 0.0)
    return total


@pytest.mark.parametrize("what", ["rests", "slides", "lifts"])
def test_gradients_of_a_block_that_rests_slides_or_lifts_are_exact(what):
    angle, velocity = {"rests": (0.0, 0.0), "slides": (-40.0, 0.0), "lifts": (0.0, 2.0)}[what]
    place = 4.4 * C if what != "slides" else 3.0 * C
    ground = Ground.slope((6 * C, place), angle, thickness=C, stiffness=2e3, friction=0.3)
    scene = block(
        ground, steps=30,
        body=(Solid((4 * C, 7 * C), (8 * C, 9 * C)), Design((4 * C, 5 * C), (8 * C, 7 * C))),
    )  # fmt: skip
    problem = Problem(scene, 2.0, halvings=0, limits=None)
    x = problem.join(np.linspace(-1.0, 1.0, problem.particles.designed.sum()), [], [], [])
    assert worst(complex_step_test(problem, x)) <= 1e-12
    particles = discretise(scene)
    state = at_rest(particles)
    state[3] = velocity
    rng = np.random.default_rng(0)
    ones, bar = np.ones(len(particles.position)), rng.standard_normal(state.shape)
    direction = rng.standard_normal(state.shape)

    def run(change):
        return Simulation(scene, particles, ones, ones, np.zeros((30, 0)), state + change)

    simulation = run(0.0)
    with simulation.checkpoints(problem.checkpointing) as checkpoints:
        gradient = simulation.forward(checkpoints).reverse({30: bar})
    moved = run(1j * COMPLEX_STEP * direction).run().imag / COMPLEX_STEP
    found = (gradient.state * direction).sum()
    assert found == pytest.approx((bar * moved).sum(), rel=1e-12)
    touched = pressed(scene, state).max() > 0.0
    assert touched or what == "slides"


def test_a_block_sinks_into_the_layer_as_its_formula_says():
    thickness, stiffness, weight = 2 * C, 150.0, 10.0 * 4 * C
    gap = thickness * (1.0 - math.sqrt(2.0 * weight / (stiffness * thickness)))
    ground = Ground.floor(4 * C, thickness=thickness, stiffness=stiffness, damping=5.0)
    scene = block(ground, steps=1000)
    particles = discretise(scene)
    state = at_rest(particles)
    state[1] += 4 * C + gap - 5 * C
    end = solid_simulation(scene, particles, state).run()
    assert np.abs(end[2:4]).max() <= 1e-5
    assert pressed(scene, end).sum() == pytest.approx(weight * 4 * C, rel=1e-4)
    assert end[1].min() - 4 * C - C / 4 == pytest.approx(gap, abs=0.02 * thickness)


@pytest.mark.parametrize(("friction", "degrees"), [(0.5, 20.0), (0.5, 30.0), (0.3, 30.0)])
def test_a_block_on_a_slope_holds_below_and_slides_above_the_friction_angle(friction, degrees):
    # In the slope's frame, where gravity leans.
    angle = math.radians(degrees)
    g = 10.0 * np.array([math.sin(angle), -math.cos(angle)])
    thickness, stiffness = C, 4e3
    ground = Ground.floor(
        4 * C, friction, thickness=C, stiffness=stiffness, damping=10.0, creeping_speed=1e-3
    )
    scene = block(
        ground, gravity=tuple(g), steps=400, grid=Grid((48, 16), C),
        material=Material(100.0, 100.0, viscosity=0.3),
        body=(Solid((4 * C, 5 * C), (12 * C, 7 * C)),),
    )  # fmt: skip
    particles = discretise(scene)
    state = at_rest(particles)
    sunk = math.sqrt(-2.0 * g[1] * 2 * C / (stiffness * thickness))
    state[1] += 4 * C + thickness * (1.0 - sunk) - 5 * C
    speeds = solid_simulation(scene, particles, state).run([200, 400])[:, 2].mean(axis=1)
    expected = g[0] + friction * g[1]
    if expected > 0.0:
        assert np.diff(speeds)[0] / (200 * scene.time_step) == pytest.approx(expected, rel=1e-2)
    else:
        assert abs(speeds[1]) <= 1e-3


def test_half_a_body_on_its_half_of_the_ground_is_the_same_solution():
    hill = Ground(((0.0, 0.0), (6 * C, 4 * C), (12 * C, 0.0)), thickness=C, stiffness=4e3)
    whole = block(hill, steps=60, direction=(0.0, 1.0))
    half = block(hill, steps=60, direction=(0.0, 1.0), mirror=Mirror("x", 6 * C))
    ends = []
    for scene in (whole, half):
        particles = discretise(scene)
        ends.append(solid_simulation(scene, particles, at_rest(particles)).run())
    left = ends[0][:, discretise(whole).position[:, 0] < 6 * C]
    assert np.abs(ends[1] - left).max() <= 1e-11
    assert max(kernel_mismatches(half).values()) <= DOT_TOLERANCE


def test_what_the_layer_stores_is_potential_energy():
    ground = Ground.floor(4 * C, thickness=2 * C, stiffness=2e3)
    energies = []
    for each in (ground, dataclasses.replace(ground, points=((0.0, -1.0), (1.0, -1.0)))):
        simulation = solid_simulation(block(each))
        records = kernels.grouped(simulation.initial)
        energies.append(kernels.energy(records, simulation.data, simulation.parameters))
    rows = np.array([1.25, 1.75]) / 2.0  # distances over the thickness, of 8 particles each
    stored = 8 * (C / 2) ** 2 * 2e3 * C * ((1.0 - rows) ** 2).sum()
    assert energies[0][1] - energies[1][1] == pytest.approx(stored)
    assert energies[0][0] == energies[1][0] == 0.0
