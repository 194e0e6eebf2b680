"""The books of motions: they close, and their entries are what is known of simple motions."""

from dataclasses import replace

import numpy as np
import pytest
from exact import at_rest, solid_simulation
from test_energy import one_step
from walker import slanted_legs, walker

from mpmopt import kernels
from mpmopt.__main__ import main
from mpmopt.assess.forces import WORKS, books
from mpmopt.design.problem import Problem
from mpmopt.scene import Grid, Ground, Material, Mirror, Scene, Solid, Wall
from mpmopt.scene.particles import discretise

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


def test_forces_of_a_run_are_told_and_drawn(short_path, tmp_path, capsys):
    assert main(["forces", str(short_path), "--out", str(tmp_path)]) == 0
    printed = capsys.readouterr().out
    assert (tmp_path / "forces.png").stat().st_size > 10_000
    for what in (*(f"work of {name}" for name in WORKS), "cost of transport", "force of walls"):
        assert what in printed
