"""Self-contact in the total Lagrangian formulation: its law, its lists, its gradient."""

import math
from typing import Any

import numpy as np
import pytest
from scipy.optimize import brentq

from mpmopt import kernels
from mpmopt.kernels import lagrangian, pairs
from mpmopt.scene import Actuator, Grid, Material, Mirror, Scene, Solid
from mpmopt.scene.ground import Ground
from mpmopt.scene.particles import discretise
from mpmopt.simulation.checkpoints import Checkpointing
from mpmopt.simulation.lagrangian import LagrangianSimulation

C = 1 / 16


def body(*corners, **changes) -> Scene:
    """Blocks, given by corners in cells, of which the first is an actuator."""
    boxes = [[(x * C, y * C) for x, y in pair] for pair in corners]
    scene: dict[str, Any] = {
        "grid": Grid(cells=(16, 16), dx=C),
        "time_step": 3e-3,
        "steps": 40,
        "material": Material(void_density=1e-2, void_stiffness=1e-3, viscosity=0.02),
        "formulation": "total",
        "body": (
            Actuator(boxes[0][0], boxes[0][1]),
            *(Solid(lower, upper) for lower, upper in boxes[1:]),
        ),
    }
    if "mirror" in changes:
        scene["direction"] = (0.0, 1.0) if changes["mirror"].axis == "x" else (1.0, 0.0)
    return Scene(**{**scene, **changes})


# Two blocks on a line; a fork whose prongs begin five cells apart.
APART = ((2, 6), (4, 8)), ((9, 5), (11, 8))
FORK = ((3, 4), (13, 6)), ((3, 6), (5, 10)), ((11, 6), (13, 10))

# Symmetric bodies that are in two parts besides the actuator.
IMAGES = ((6, 3), (10, 4)), ((3, 5), (5, 8)), ((11, 5), (13, 8))
RAILS = ((12, 6), (13, 10)), ((4, 3), (9, 5)), ((4, 11), (9, 13))


def simulation_of(scene, stiffness=None, density=None, **changes) -> Any:
    particles = discretise(scene)
    ones = np.ones(len(particles.position))
    density, stiffness = (ones if each is None else each for each in (density, stiffness))
    t = scene.time_step * np.arange(scene.steps)
    signal = changes.pop("signal", np.sin(20.0 * t)[:, None])
    return LagrangianSimulation(scene, particles, density, stiffness, signal)


def closing(simulation, speed):
    """Gives nodes a velocity towards x = 8 C, in proportion to their distance, and a spin."""
    x, y = simulation.start[:2].real
    simulation.start[2] = speed * (8 * C - x) / (4 * C)
    if simulation.scene.mirror is None:
        simulation.start[3] = 0.1 * speed * np.sign(x - 8 * C)
    lifted = np.clip((y - 5 * C) / (2 * C), 0.0, 1.0)
    if len(simulation.scene.body) == 3:  # the fork's prongs only
        simulation.start[2] *= lifted


def by_hand(simulation, nodes):
    """Forces on the nodes, pair by pair of all particles and images."""
    scene, dx = simulation.scene, simulation.scene.grid.dx
    N = simulation._weights[0].toarray()
    X, x = simulation.particles.position, N @ nodes[:2].T
    gamma = kernels.ungrouped(simulation.data.stiffness, 1, len(X))[0]
    share = np.maximum(gamma - 0.05, 0.0) / 0.95
    material, volume = scene.material, (dx / scene.particles_per_cell) ** 2
    k = 2.0 * material.density * volume * (material.wave_speed / dx) ** 2
    reach, force = 0.75 * dx, np.zeros_like(x)
    others = [(X, x)]
    if scene.mirror is not None:
        flip = np.where(np.arange(2) == scene.mirror.normal, -1.0, 1.0)
        plane = np.where(flip < 0.0, 2.0 * scene.mirror.position, 0.0)
        others.append((plane + flip * X, plane + flip * x))
    for Y, y in others:
        apart = np.linalg.norm(X[:, None] - Y, axis=2) > 4.0 * dx * (1.0 + 1e-12)
        d = x[:, None] - y
        r = np.linalg.norm(d, axis=2)
        touching = apart & (r < reach)
        size = np.where(touching, k * share[:, None] * share * (reach - r), 0.0)
        force += ((size / np.where(touching, r, 1.0))[..., None] * d).sum(axis=1)
    return (N.T @ force).T


@pytest.mark.parametrize("per_cell", [2, 3])
@pytest.mark.parametrize(
    ("corners", "changes"),
    [
        (APART, {}),
        (FORK, {}),
        (FORK, {"mirror": Mirror("x", 8 * C)}),
        (IMAGES, {"mirror": Mirror("x", 8 * C)}),
        (RAILS, {"mirror": Mirror("y", 8 * C)}),
    ],
)
def test_the_force_is_that_of_all_pairs(rng, corners, changes, per_cell):
    scene = body(*corners, particles_per_cell=per_cell, **changes)
    count = len(discretise(scene).position)
    simulation = simulation_of(scene, rng.uniform(0.0, 1.0, count) + 1e-3)
    nodes, touch = simulation.start.copy(), simulation.lattice.touch
    near, seen = pairs.nowhere(touch), 0
    for _ in range(18):  # crumpled more and more: lists are kept, and made anew
        nodes[:2] += 0.15 * (8 * C - nodes[:2])
        nodes[:2] += 0.05 * C * rng.standard_normal((2, nodes.shape[1]))
        near, _ = pairs.renewed(near, nodes, touch)
        assert near.cells.tolist() == sorted(near.cells.tolist())  # so that sums have one order
        force = np.zeros_like(nodes)
        pairs.push_apart(near, nodes, touch, force)
        expected = by_hand(simulation, nodes)
        assert force[:2] == pytest.approx(expected, rel=1e-12, abs=1e-12)
        seen += np.abs(expected).max() > 0.0
    assert seen >= 2


def test_what_moves_alike_keeps_its_lists_but_not_those_of_images(rng):
    whole = simulation_of(body(*FORK))
    touch, nodes = whole.lattice.touch, whole.start.copy()
    near, _ = pairs.renewed(pairs.nowhere(touch), nodes, touch)
    nodes[:2] += 9.0 * C * rng.uniform(-1.0, 1.0, (2, 1))
    kept, room = pairs.renewed(near, nodes, touch)
    assert np.array_equal(kept.cells_at, whole.start[:2])
    assert room == pytest.approx(pairs.HALF * pairs.WIDE_SKIN * C, rel=1e-9)
    for mirror, corners in ((Mirror("x", 8 * C), IMAGES), (Mirror("y", 8 * C), RAILS)):
        half = simulation_of(body(*corners, mirror=mirror))
        touch, nodes = half.lattice.touch, half.start.copy()
        near, seen = pairs.nowhere(touch), 0
        for _ in range(8):
            nodes[mirror.normal] += 0.45 * C
            near, _ = pairs.renewed(near, nodes, touch)
            force, expected = np.zeros_like(nodes), by_hand(half, nodes)
            pairs.push_apart(near, nodes, touch, force)
            assert force[:2] == pytest.approx(expected, rel=1e-12, abs=1e-12)
            seen += np.abs(expected).max() > 0.0
        assert 2 <= seen < 8


@pytest.mark.parametrize("mirror", [None, Mirror("x", 8 * C), Mirror("y", 8 * C)])
def test_no_particle_moves_farther_than_influence_tells(rng, mirror):
    corners = RAILS if mirror == Mirror("y", 8 * C) else IMAGES
    scene = body(*corners, **({"mirror": mirror} if mirror else {}))
    particles = discretise(scene)
    particles = particles.subset(rng.uniform(size=len(particles.position)) < 0.6)
    ones = np.ones(len(particles.position))
    simulation = LagrangianSimulation(scene, particles, ones, ones, np.zeros((scene.steps, 1)))
    weights, lattice, touch = simulation._weights[0], simulation.lattice, simulation.lattice.touch
    there = lattice.squared_influence > 0.0
    assert np.array_equal(there, lattice.mass > 0.0)
    assert lattice.squared_influence.max() < 1.5 and lattice.squared_influence[there].min() < 0.03
    # As fast as may be: some particle is as fast as is told, and none is faster.
    speed = np.divide(
        1.0, np.sqrt(lattice.squared_influence), out=np.zeros(len(there)), where=there
    )
    assert (weights @ speed).max() == pytest.approx(1.0, rel=1e-12)
    other = 0 if mirror is None else 1 - mirror.normal
    turned = np.where(np.arange(2) == other, 1.0, -1.0)  # as an image goes
    for some in (there, there & (lattice.squared_influence < 1.0)):  # the others are at corners
        nodes = simulation.start.copy()
        nodes[:2] += some * rng.uniform(-1.0, 1.0, (2, len(there))) * speed
        nodes[other] += 50.0  # which all share
        moved = weights @ (nodes[:2] - simulation.start[:2]).T  # (N, 2)
        both = moved if mirror is None else np.concatenate([moved, turned * moved])
        apart = np.hypot(*(moved[:, None] - both).T).max()
        told = kernels.plain(pairs.strayed)(nodes, simulation.start[:2], touch)
        assert 0.0 < 0.5 * apart <= told < 5.0


def collided(simulation, speed):
    closing(simulation, speed)
    steps = simulation.steps
    states = np.zeros((steps + 1, *simulation.start.shape))
    states[0] = simulation.start
    lattice, signal = simulation.lattice, simulation.signal
    assert lagrangian.advance_lattice(states, 0, steps, lattice, signal)[1] < 0
    return states


def test_blocks_that_collide_keep_their_momenta_and_bounce():
    simulation = simulation_of(body(*APART, steps=80))
    states = collided(simulation, 3.0)
    x, v, m = states[:, :2], states[:, 2:], simulation.lattice.mass
    linear = np.einsum("m,skm->sk", m, v)
    before = x - simulation.scene.time_step * v
    angular = np.einsum("m,sm->s", m, before[:, 0] * v[:, 1] - before[:, 1] * v[:, 0])
    scale = np.abs(m * v[0]).sum()
    assert np.abs(linear - linear[0]).max() <= 1e-13 * scale
    assert np.abs(angular - angular[0]).max() <= 1e-13 * scale
    left = simulation.particles.position[:, 0] < 6 * C
    speeds = [simulation.particle_state(each)[2, left].mean() for each in states]
    assert speeds[0] > 1.0
    assert speeds[-1] < 0.0
    gaps = [simulation.look(states, [n]).gap for n in range(0, 81, 8)]
    assert 0.3 < min(gaps) < 1.5


CASES: dict[str, Any] = {
    "apart": (APART, {}),
    "fork": (FORK, {}),
    "half of a fork": (FORK, {"mirror": Mirror("x", 8 * C)}),
    "three per cell": (APART, {"particles_per_cell": 3}),
}


@pytest.mark.parametrize("case", CASES)
def test_the_gradient_is_exact_through_self_contact(rng, case):
    corners, changes = CASES[case]
    scene = body(*corners, **changes)
    count = len(discretise(scene).position)
    inputs = {
        "stiffness": rng.uniform(0.01, 1.0, count),
        "density": rng.uniform(0.5, 1.0, count),
        "signal": rng.uniform(-0.5, 0.5, (scene.steps, 1)),
    }
    simulation = simulation_of(scene, **inputs)
    closing(simulation, 4.0)
    terminal = rng.standard_normal(simulation.initial.shape)
    terminal[4:8] = 0.0
    with simulation.checkpoints(Checkpointing()) as checkpoints:
        gradient = simulation.forward(checkpoints).reverse({scene.steps: terminal})
    directions = {name: rng.standard_normal(each.shape) for name, each in inputs.items()}
    expected = sum((getattr(gradient, name) * directions[name]).sum() for name in inputs)
    h = 1e-30
    moved = simulation_of(scene, **{n: a + 1j * h * directions[n] for n, a in inputs.items()})
    turned = rng.standard_normal(simulation.start.shape)
    moved.start[:] = simulation.start + 1j * h * turned
    expected += (gradient.state * turned).sum()
    found = (terminal * moved.run()).sum().imag / h
    assert expected == pytest.approx(found, rel=1e-12)
    # It depends on the contact.
    free = simulation_of(scene, **inputs)
    closing(free, 4.0)
    free.lattice = free.lattice._replace(
        touch=free.lattice.touch._replace(
            influence=np.zeros(free.nodes), cells=np.empty(0, np.int64)
        )
    )
    assert np.abs(free.run() - simulation.run()).max() > 0.1 * C


def test_the_bits_are_those_of_any_checkpoints_and_lists(rng):
    scene = body(*FORK)
    count = len(discretise(scene).position)
    stiffness, terminal = rng.uniform(0.2, 1.0, count), np.zeros((12, count))
    terminal[:4] = rng.standard_normal((4, count))

    def found(wish):
        simulation = simulation_of(scene, stiffness)
        closing(simulation, 4.0)
        with simulation.checkpoints(wish) as checkpoints:
            forward = simulation.forward(checkpoints)
            return forward.states[scene.steps], forward.reverse({scene.steps: terminal})

    state, gradient = found(Checkpointing())
    for every in (1, 7, "all"):
        other, again = found(Checkpointing(every=every))
        assert np.array_equal(state, other)
        for name in ("stiffness", "density", "signal", "state"):
            assert np.array_equal(getattr(gradient, name), getattr(again, name))
    simulation = simulation_of(scene, stiffness)
    closing(simulation, 4.0)
    *_, last = simulation.states()  # lists anew in every step
    assert np.array_equal(state, last)


@pytest.mark.parametrize("corners", [IMAGES, FORK])
def test_half_a_body_pushes_its_image_as_the_whole_one_does(corners):
    whole = simulation_of(body(*corners, steps=60))
    half = simulation_of(body(*corners, steps=60, mirror=Mirror("x", 8 * C)))
    for each in (whole, half):
        closing(each, 4.0)
        each.start[3] = 0.0
    left = whole.particles.position[:, 0] < 8 * C
    expected = whole.run()[:, left]
    own, position = half.particles.position, whole.particles.position[left]
    order = [np.abs(own - each).sum(axis=1).argmin() for each in position]
    assert half.run()[:, order] == pytest.approx(expected, rel=1e-9, abs=1e-10)
    assert half.look(half.start[None], [0]).gap == math.inf


def test_a_block_rests_on_another_at_the_gap_that_bears_it():
    g = 10.0
    scene = body(
        ((4, 4), (9, 6)), ((4, 11), (9, 13)), steps=600, time_step=2e-3, gravity=(0.0, -g),
        material=Material(viscosity=0.2),
        ground=(Ground(((0.0, 4 * C), (1.0, 4 * C)), friction="stick", thickness=C / 2),),
    )  # fmt: skip
    simulation = simulation_of(scene, signal=np.zeros((600, 1)))
    material, s = scene.material, C / 2
    k = 2.0 * material.density * s * s * (material.wave_speed / C) ** 2
    reach = 0.75 * C

    def borne(gap):
        """Force between rows of ten particles, each above a gap of the other, and rows behind."""
        total = 0.0
        for rows, y in ((1, gap), (2, gap + s)):
            for m in range(-9, 10):
                r = math.hypot((m + 0.5) * s, y)
                total += rows * (10 - abs(m)) * k * max(reach - r, 0.0) * y / r
        return total

    weight = g * material.density * 10 * 4 * s * s
    gap = brentq(lambda y: borne(y) - weight, 0.1 * C, reach)
    upper = simulation.start[1] > 8 * C
    simulation.start[0, upper] += 0.5 * s
    simulation.start[1, upper] -= 5 * C + s - gap
    found = []
    for state in simulation.run(range(200, 601, 4)):
        low = simulation.particles.position[:, 1] < 8 * C
        y = state[1]
        found.append(y[~low].reshape(10, -1)[:, 0].mean() - y[low].reshape(10, -1)[:, -1].mean())
    assert np.mean(found) == pytest.approx(gap, rel=0.03)
    assert np.ptp(found) < 0.1 * C


def test_void_pushes_nothing_and_solid_takes_no_notice_of_it():
    scene = body(*APART)
    position = discretise(scene).position
    stiffness = np.where(position[:, 0] < 6 * C, 1.0, pairs.LEAST_STIFFNESS)
    simulation = simulation_of(scene, stiffness)
    nodes, touch = simulation.start.copy(), simulation.lattice.touch
    nodes[0, nodes[0] > 6.5 * C] -= 6 * C
    near, _ = pairs.renewed(pairs.nowhere(touch), nodes, touch)
    assert len(near.cells) == 0


@pytest.mark.slow
@pytest.mark.parametrize(("corners", "duration"), [(APART, 0.2), (FORK, 0.3)])
def test_parts_that_meet_do_the_same_on_all_cells(corners, duration):
    # At half the speed of waves they bounce; or bend, press each other and swing back.
    speeds, places = [], []
    for finer in (4, 8, 16):  # 64, 128 and 256 cells
        steps = math.ceil(duration * finer / 2.7e-3)
        grid = Grid((16 * finer, 16 * finer), C / finer)
        scene = body(*corners, grid=grid, steps=steps, time_step=duration / steps)
        simulation = simulation_of(scene, signal=np.zeros((steps, 1)))
        closing(simulation, 3.0)
        x, y = simulation.particles.position.T
        left = (x < 6 * C) if corners is APART else (x < 5 * C) & (y > 8 * C)
        states = simulation.run(np.linspace(0, steps, 7).astype(int))
        speeds.append(states[-1, 2, left].mean())
        places.append(states[:, 0, left].mean(axis=1))
    assert max(speeds) < -1.0
    assert np.ptp(speeds) <= 0.03 * abs(speeds[-1])
    assert np.ptp(places, axis=0).max() <= 0.03 * np.ptp(places[-1])


@pytest.mark.parametrize(("per_cell", "lam"), [(2, 0.0), (2, 10.0), (3, 10.0), (4, 0.0)])
def test_blocks_pressed_into_each_other_are_stable_at_the_largest_step(per_cell, lam):
    material = Material(lame_lambda=lam)
    scene = body(
        ((3, 4), (4, 6)), ((9, 4), (10, 6)),
        particles_per_cell=per_cell, material=material, time_step=1e-3,
    )  # fmt: skip
    step = scene.largest_time_step
    count = len(discretise(scene).position)
    simulation = simulation_of(scene, np.ones(count) + 0j, signal=np.zeros((40, 1)))
    m = simulation.lattice.mass.real
    there, right = np.nonzero(m > 0.0)[0], simulation.start[0].real > 6.5 * C
    worst = 0.0
    for gap in (0.45, 0.3, 0.15, 0.0, -0.3):  # between the next particles, in cells
        pressed = simulation.start.copy()
        pressed[0, right] -= (5.0 + 1.0 / per_cell - gap) * C
        stiffness = []
        for axis in (0, 1):
            for k in there:
                states = np.zeros((2, *pressed.shape), complex)
                states[0] = pressed
                states[0, axis, k] += 1e-30j
                lagrangian.advance_lattice(states, 0, 1, simulation.lattice, simulation.signal)
                stiffness.append(-(m * states[1, 2:].imag)[:, there].ravel() / 1e-33)
        scale = np.tile(np.sqrt(m[there]), 2)
        matrix = np.array(stiffness) / scale / scale[:, None]
        worst = max(worst, np.linalg.eigvalsh(0.5 * (matrix + matrix.T)).max())
    assert 0.7 < step * math.sqrt(worst) / 2.0 < 1.0
