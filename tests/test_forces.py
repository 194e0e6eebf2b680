"""The books of motions: they close, and their entries are what is known of simple motions."""

import csv
import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from exact import at_rest, solid_simulation
from test_energy import one_step
from walker import slanted_legs, walker

from mpmopt import kernels
from mpmopt.__main__ import main
from mpmopt.assess.forces import ENERGIES, WORKS, books, cost_of_transport
from mpmopt.assess.trajectory import Body, Motion, equal_steps
from mpmopt.design.problem import Problem
from mpmopt.design.terms import Displacement
from mpmopt.scene import Grid, Ground, Material, Mirror, Scene, Solid, Wall
from mpmopt.scene.particles import discretise
from mpmopt.view.draw import Arrows, Forces, new_figure, view
from mpmopt.view.film import Screen

C = 1 / 16


def ground(**changes):
    """A level one whose layer the block meets half a cell above it."""
    return (Ground.floor(4 * C, **{"thickness": C, "stiffness": 4e3, **changes}),)


def block(velocity=(0.0, 0.0), gap=0.0, **changes):
    """A block of 4 x 4 cells that moves as it pleases, above a wall."""
    usual = {
        "grid": Grid((24, 16), C), "time_step": 2e-3, "steps": 200,
        "body": (Solid((4 * C, 4 * C), (8 * C, 8 * C)),), "gravity": (0.0, -10.0),
        "walls": () if "ground" in changes else (Wall("y", 4 * C),),
        "material": Material(100.0, 100.0),
    }  # fmt: skip
    scene = Scene(**{**usual, **changes})
    particles = discretise(scene)
    state = at_rest(particles)
    state[1] += gap
    state[2], state[3] = velocity
    return solid_simulation(scene, particles, state)


def unexplained(found):
    return np.abs(found.residual).max() / found.turnover


def legs(**changes):
    """The walker on legs, in which something of everything happens."""
    scene = walker(64, changes.pop("time_step", 8e-4))
    steps = round(0.12 / scene.time_step)
    material = Material(viscosity=0.02)
    problem = Problem(replace(scene, steps=steps, material=material, **changes), 8.0)
    phi = np.where(slanted_legs(problem.particles.position[problem.particles.designed]), 1.0, -1.0)
    return problem.simulation(problem.join(phi, 1.0, -0.3, -0.5))


def test_the_energy_is_that_of_the_kernels(rng):
    simulation = one_step(1e-3, rng)
    found, state = books(simulation), kernels.grouped(simulation.initial)
    kinetic, potential = kernels.energy(state, simulation.data, simulation.parameters)
    assert found.energy["kinetic"][0] == pytest.approx(kinetic, rel=1e-13)
    others = sum(found.energy[kind][0] for kind in ("elastic", "gravity", "layer"))
    assert others == pytest.approx(potential, rel=1e-12)


@pytest.mark.parametrize(
    "changes",
    [
        {"gap": 2 * C},
        {"gap": C, "material": Material(100.0, 100.0, viscosity=0.05)},
        {"velocity": (2.0, 0.0), "walls": (Wall("y", 4 * C, friction=0.3),)},
        {"gap": 1.5 * C, "ground": ground(friction=0.0, damping=0.0)},
        {"gap": 1.5 * C, "ground": ground(friction=0.0)},
        {"gap": 0.65 * C, "velocity": (2.0, 0.0), "ground": ground(friction=0.3)},
        {"velocity": (2.0, -0.5), "ground": ground(friction="stick"), "time_step": 1e-3},
    ],
    ids=["wall", "viscous", "slides on wall", "layer", "damped", "slides", "sticks"],
)
def test_the_books_of_a_block_close(changes):
    found = books(block(**changes))
    assert unexplained(found) <= 1e-3
    ended = {name: values[-1] for name, values in found.work.items()}
    taken = {name for name, value in ended.items() if value < -1e-12 * found.turnover}
    expected = {"transfer"} | ({"viscosity"} if "material" in changes else set())
    if "ground" in changes:
        (below,) = changes["ground"]
        expected |= {name for name in ("friction", "damping") if getattr(below, name) != 0.0}
    else:
        expected |= {"walls"}
    assert taken == expected


def test_the_books_of_a_walker_close_with_the_square_of_the_step():
    standing = {"walls": (), "ground": (Ground.floor(3 / 64),)}
    coarse, fine = (books(legs(time_step=dt, **standing)) for dt in (8e-4, 4e-4))
    assert unexplained(coarse) <= 5e-4
    assert np.abs(fine.residual).max() <= 0.35 * np.abs(coarse.residual).max()
    for work in ("viscosity", "friction", "damping", "transfer"):
        assert coarse.work[work][-1] < -1e-3 * coarse.turnover
        if work != "transfer":  # which the step itself makes
            assert fine.work[work][-1] == pytest.approx(coarse.work[work][-1], rel=0.3)
    assert coarse.actuation > coarse.work["actuation"].max() > coarse.work["actuation"][-1] > 0.0
    cost = coarse.actuation / (coarse.weight * abs(coarse.travel))
    assert coarse.cost_of_transport == pytest.approx(cost)


@pytest.mark.parametrize("formulation", ["total", "updated"])
def test_a_cost_of_transport_needs_no_books(formulation):
    walls = {"walls": (), "ground": (Ground.floor(3 / 64),)}
    simulation = legs(time_step=8e-4, formulation=formulation, **walls)
    assert cost_of_transport(simulation) == books(simulation).cost_of_transport > 0.0
    assert math.isinf(cost_of_transport(block(gravity=(0.0, 0.0))))


def test_the_books_of_a_total_lagrangian_body_close():
    total = {"formulation": "total", "walls": (), "ground": (Ground.floor(3 / 64),)}
    coarse, fine = (books(legs(time_step=dt, **total)) for dt in (8e-4, 4e-4))
    assert unexplained(coarse) <= 1e-3
    assert np.abs(fine.residual).max() <= 0.35 * np.abs(coarse.residual).max()
    for work in ("viscosity", "friction", "damping"):
        assert coarse.work[work][-1] < -1e-3 * coarse.turnover
        assert fine.work[work][-1] == pytest.approx(coarse.work[work][-1], rel=0.3)
    assert not coarse.work["transfer"].any()
    # The same body in the other formulation.
    other = books(legs(time_step=4e-4, **{**total, "formulation": "updated"}))
    assert fine.weight == pytest.approx(other.weight, rel=1e-12)
    assert fine.actuation == pytest.approx(other.actuation, rel=0.2)
    mean, expected = (found.force.mean(axis=0) for found in (fine, other))
    assert mean[0, 1] == pytest.approx(expected[0, 1], rel=0.05)


def falling(**changes):
    """A block of the formulation "total" that falls onto a slope, or onto a floor."""
    usual: dict[str, Any] = {
        "grid": Grid((24, 16), C), "time_step": 1e-3, "steps": 200, "formulation": "total",
        "body": (Solid((4 * C, 5 * C), (8 * C, 8 * C)),), "gravity": (0.0, -10.0),
        "ground": (Ground.slope((6 * C, 3 * C), 15.0, friction=0.2, thickness=C),),
        "material": Material(100.0, 100.0, viscosity=0.02),
    }  # fmt: skip
    scene = Scene(**{**usual, **changes})
    return Problem(scene, halvings=0, limits=None).simulation(np.zeros(0))


def test_forces_are_what_changes_the_momentum_of_a_lattice():
    simulation = falling()
    found, mass = books(simulation), simulation.data.mass.sum()
    *_, end = simulation.node_states()
    momentum = end[2:] @ simulation.lattice.mass
    weight = found.time[-1] * mass * np.array([0.0, -10.0])
    given = simulation.scene.time_step * found.force.sum(axis=(0, 1)) + weight
    assert given == pytest.approx(momentum, rel=1e-9, abs=1e-12)
    assert np.abs(found.force[:, 0]).max() > found.weight
    assert unexplained(found) <= 1e-3


def colliding(time_step=1e-3, mirror=None):
    """Two blocks that slide on a floor against each other."""
    simulation = falling(
        body=tuple(Solid((x, 4 * C), (x + 3 * C, 7 * C)) for x in (3 * C, 10 * C)),
        ground=(Ground.floor(3.25 * C, friction=0.4, thickness=C),),
        time_step=time_step, steps=round(0.1 / time_step), mirror=mirror, direction=(0.0, 1.0),
    )  # fmt: skip
    x = simulation.start[0]
    simulation.start[2] = np.where(simulation.lattice.mass > 0.0, 4.0 * np.sign(8 * C - x), 0.0)
    return simulation


@pytest.mark.parametrize("mirror", [None, Mirror("x", 8 * C)])
def test_the_books_of_blocks_that_collide_close(mirror):
    coarse, fine = (books(colliding(dt, mirror)) for dt in (1e-3, 5e-4))
    stored = coarse.energy["self-contact"]
    assert stored[0] == 0.0
    assert stored.max() > 0.1 * coarse.energy["kinetic"][0]
    assert unexplained(coarse) <= 3e-3
    assert np.abs(fine.residual).max() <= 0.35 * np.abs(coarse.residual).max()
    assert coarse.work["friction"][-1] < -1e-3 * coarse.turnover


def test_blocks_that_collide_give_the_ground_nothing_of_what_they_give_each_other():
    simulation = colliding()
    simulation.start[1, simulation.start[0] > 8 * C] += C  # one block flies
    found, m = books(simulation), simulation.lattice.mass
    states = np.array(list(simulation.node_states()))
    momentum = states[:, 2:] @ m
    weight = m.sum() * np.array([0.0, -10.0])
    given = simulation.scene.time_step * (found.force[:, 0] + weight)
    assert np.diff(momentum, axis=0) == pytest.approx(given, abs=1e-12)
    assert found.energy["self-contact"].max() > 0.1 * found.energy["kinetic"][0]


def test_the_books_of_a_lattice_with_a_mirror_are_those_of_the_whole():
    floor = (Ground.floor(3.5 * C, friction=0.2, thickness=C),)
    whole, half = (
        books(falling(ground=floor, direction=(0.0, 1.0), mirror=mirror))
        for mirror in (None, Mirror("x", 6 * C))
    )
    assert unexplained(whole) <= 1e-3
    for name in WORKS:
        assert half.work[name] == pytest.approx(whole.work[name], abs=1e-10 * whole.turnover)
    for name in ENERGIES:
        assert half.energy[name] == pytest.approx(whole.energy[name], abs=1e-10 * whole.turnover)
    assert half.force == pytest.approx(whole.force, abs=1e-9)
    assert half.travel == pytest.approx(whole.travel, abs=1e-12)


def test_forces_are_what_changes_momentum():
    simulation = block(
        (2.0, -1.0), walls=(Wall("y", 4 * C, friction=0.3), Wall("x", 10 * C, "above"))
    )
    found = books(simulation)
    mass, dt = simulation.data.mass.sum(), simulation.scene.time_step
    change = (simulation.run()[2:4] - simulation.initial[2:4]) @ kernels.ungrouped(
        simulation.data.mass, 1, simulation.initial.shape[1]
    )[0]
    given = dt * found.force.sum(axis=(0, 1)) + found.time[-1] * mass * np.array([0.0, -10.0])
    assert given == pytest.approx(change, abs=1e-12)
    assert found.supports == ("walls",)
    assert found.weight == pytest.approx(10.0 * mass)


def test_what_slides_on_a_layer_feels_coulombs_force_which_takes_its_motion():
    found = books(block((3.0, 0.0), gap=0.65 * C, ground=ground(friction=0.3, damping=0.0)))
    assert found.supports == ("ground 0",)
    along, up = found.force[:, 0].T
    assert along == pytest.approx(-0.3 * up, rel=1e-9)
    assert up.mean() == pytest.approx(found.weight, rel=0.05)
    taken = -found.work["friction"][-1]
    assert taken == pytest.approx(-along.mean() * found.travel, rel=0.1)
    x, y = found.place[np.isfinite(found.place[:, 0, 0]), 0].T
    assert x[-1] - x[0] == pytest.approx(found.travel, rel=0.2)
    assert np.all((y > 4 * C) & (y < 5 * C))


def test_an_affine_motion_without_force_loses_nothing_and_viscosity_takes_what_it_must():
    viscous = Material(1e-9, 1e-9, viscosity=5e-3)
    simulation = block(walls=(), gravity=(0.0, 0.0), steps=1, time_step=1e-4, material=viscous)
    rate = np.array([[1.0, 2.0], [-0.5, 0.3]])
    simulation.initial[2:4] = rate @ simulation.initial[:2]
    simulation.initial[4:8] = rate.reshape(4, 1)
    found = books(simulation)
    D = 0.5 * (rate + rate.T)
    expected = 1e-4 * simulation.data.volume.sum() * 5e-3 * (D * D).sum()
    assert -found.work["viscosity"][-1] == pytest.approx(expected, rel=1e-3)
    assert abs(found.work["transfer"][-1]) <= 0.05 * expected
    assert abs(found.residual[-1]) <= 1e-3 * expected


def test_both_halves_of_a_body_with_a_mirror_are_in_its_books():
    whole, half = (
        books(block((0.0, -1.0), direction=(0.0, 1.0), mirror=mirror))
        for mirror in (None, Mirror("x", 6 * C))
    )
    for name in WORKS:
        assert half.work[name] == pytest.approx(whole.work[name], abs=1e-10 * whole.turnover)
    assert half.force == pytest.approx(whole.force, abs=1e-9)
    assert half.place == pytest.approx(whole.place, abs=1e-9, nan_ok=True)


def test_forces_around_instants_are_those_of_the_steps_nearest_to_them():
    found = books(block(steps=60, gap=C, ground=ground()))
    force, place = found.around(np.array([0, 20, 30, 60]))
    for k, (first, last) in enumerate([(0, 10), (10, 25), (25, 45), (45, 60)]):
        assert force[k] == pytest.approx(found.force[first:last].mean(axis=0), rel=1e-12)
        there = found.place[first:last][np.isfinite(found.place[first:last, 0, 0])]
        expected = there.mean(axis=0) if len(there) else np.full((1, 2), np.nan)
        assert place[k] == pytest.approx(expected, rel=1e-12, nan_ok=True)
    assert np.isnan(place[0]).all() and np.isfinite(place[3]).all()
    # More instants than steps, and all of them as in the means.
    often, _ = found.around(np.rint(np.linspace(0, 60, 200)).astype(int))
    assert often[[0, -1]] == pytest.approx(found.force[[0, -1]], abs=1e-14)


def test_the_table_of_forces_ends_with_all_that_was_done():
    found = books(block(velocity=(2.0, 0.0), steps=100, ground=ground()))
    rows = found.rows(10)
    assert len(rows) == 10
    _, force, place = found.means(10)
    for n, row in enumerate(rows):
        assert row["time"] == pytest.approx(found.time[10 * n + 5])
        for name, values in found.work.items():
            assert row[f"work of {name}"] == values[10 * n + 10]
        for name, values in found.energy.items():
            assert row[f"energy, {name}"] == values[10 * n + 10]
        given = [row[f"{what} of ground 0, {k}"] for what in ("force", "place") for k in "xy"]
        assert given == pytest.approx([*force[n, 0], *place[n, 0]], nan_ok=True)


def test_arrows_end_where_forces_act_and_are_as_long_as_these_are():
    simulation = block(velocity=(2.0, 0.0), gap=0.65 * C, steps=100, ground=ground())
    found, count = books(simulation), simulation.initial.shape[1]
    body = Body("block", simulation, np.ones(count), Displacement(), np.ones(0))
    motion = Motion.of(body, equal_steps(simulation.scene, 6))
    forces = Forces.of([motion], [found])
    (force, place), *others = forces.values
    assert not others
    assert forces.largest == pytest.approx(np.hypot(*force[:, 0].T).max())
    seen = view([motion])
    width = np.ptp(seen, axis=0).max()
    assert forces.scale * forces.largest == pytest.approx(0.15 * width)
    axes = new_figure(3.0, 3.0).add_subplot()
    arrows = Arrows(axes, force, place, forces.scale)
    shown = 0
    for k in range(6):
        arrows.show(k)
        (patch,) = arrows.patches
        assert patch.get_visible() == bool(np.isfinite(place[k]).all())
        if patch.get_visible():
            tail, tip = vars(patch)["_posA_posB"]
            assert tip == pytest.approx(place[k, 0])
            assert np.subtract(tip, tail) == pytest.approx(forces.scale * force[k, 0])
            assert np.all((forces.box[0] <= tail) & (tail <= forces.box[1]))
            shown += 1
    assert shown >= 4
    elsewhere = Forces.of([motion], [replace(found, place=found.place - 1.0)])
    assert elsewhere.box[0, 1] < forces.box[0, 1] - 0.5
    hidden = replace(found, place=np.full_like(found.place, np.nan))
    bare, pushed = (Screen([motion], 1.0, [each]).frame(5) for each in (hidden, found))
    assert bare.shape == pushed.shape
    changed = np.argwhere((bare != pushed).any(axis=2))
    assert len(changed) >= 40
    assert (pushed[tuple(changed.T)] < 60).all(axis=1).mean() >= 0.2  # black, and its edges


def test_forces_of_a_run_are_told_and_drawn(short_path, tmp_path, capsys):
    assert main(["forces", str(short_path), "--out", str(tmp_path)]) == 0
    printed = capsys.readouterr().out
    for name in ("forces.png", "forces_motion.png"):
        assert (tmp_path / name).stat().st_size > 10_000
    with (tmp_path / "forces.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == 40  # as many as there are steps
    assert {"time", "work of walls", "force of walls, y", "place of walls, x"} <= set(rows[0])
    for what in (*(f"work of {name}" for name in WORKS), "cost of transport", "force of walls"):
        assert what in printed
