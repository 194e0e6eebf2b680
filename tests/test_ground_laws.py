"""What rigid bodies do on ground by the laws of contact, of stiff blocks on its layer."""

import math
from dataclasses import replace

import numpy as np
import pytest
from exact import at_rest, solid_simulation
from scipy.optimize import brentq

from mpmopt.scene import Grid, Ground, Material, Scene, Solid
from mpmopt.scene.particles import discretise

G = 10.0
POINT = np.array([0.75, 0.3125])  # of the ground
LOWER, WIDTH, HEIGHT = (0.5, 0.5), 0.25, 0.125  # of the block, before it is placed
LAYER = {"thickness": 0.0625, "stiffness": 1200.0, "creeping_speed": 2e-3, "damping": 5.0}


def at_depth(pressure):
    """Distance d at which the layer bears a pressure: kappa (delta - d)^2 / (2 delta)."""
    delta, kappa = LAYER["thickness"], LAYER["stiffness"]
    return delta - math.sqrt(2.0 * delta * pressure / kappa)


def block(
    degrees, velocity, seconds, *, gravity=(0.0, -G), gap=None, cells=16, height=HEIGHT, **ground
):
    """A block on ground that falls to the right by an angle, with a velocity along and across.

    It is turned with the ground and a gap above it, or has come to rest on it under the part of
    gravity that presses it down. Returns the simulation, and the directions along and across.
    """
    angle = math.radians(degrees)
    frame = np.array([[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]])
    normal = frame[1] @ gravity
    material = Material(4e3, 4e3, viscosity=1.0)
    dt = 0.4 / cells / material.wave_speed
    scene = Scene(
        Grid((2 * cells, cells), 1.0 / cells), dt, round(seconds / dt), gravity=gravity,
        material=material,
        body=(Solid(LOWER, (LOWER[0] + WIDTH, LOWER[1] + height)),),
        ground=(Ground.slope(tuple(POINT), -degrees, **{**LAYER, **ground}),),
    )  # fmt: skip
    particles = discretise(scene)
    local = particles.position - LOWER - (WIDTH / 2, 0.0)
    local[:, 1] += at_depth(-normal * height) if gap is None else gap
    state = at_rest(particles)
    state[:2] = POINT[:, None] + frame.T @ local.T
    if gap is None:
        pressed = replace(scene, gravity=tuple(normal * frame[1]), steps=round(0.3 / dt))
        state = solid_simulation(pressed, particles, state).run()
    state[2:4] += (velocity @ frame)[:, None]
    return solid_simulation(scene, particles, state), frame


def motion(simulation, frame, shares):
    """Times, and mean places and velocities along and across the ground (2, times)."""
    steps = np.round(np.array(shares) * simulation.steps).astype(int)
    states = simulation.run(list(steps))
    x, v = states[:, :2].mean(axis=2).T, states[:, 2:4].mean(axis=2).T
    return steps * simulation.scene.time_step, frame @ (x - POINT[:, None]), frame @ v


def on_incline(degrees, friction, turned, seconds, cells=16):
    """Mean speed along the incline over the second half, and mean acceleration."""
    angle = math.radians(degrees)
    if turned == "ground":
        simulation, frame = block(degrees, (0.0, 0.0), seconds, friction=friction, cells=cells)
    else:
        gravity = (G * math.sin(angle), -G * math.cos(angle))
        simulation, frame = block(
            0.0, (0.0, 0.0), seconds, gravity=gravity, friction=friction, cells=cells
        )
    times, place, velocity = motion(simulation, frame, (0.5, 1.0))
    return np.diff(place[0])[0] / np.diff(times)[0], np.diff(velocity[0])[0] / np.diff(times)[0]


@pytest.mark.parametrize("turned", ["ground", "gravity"])
@pytest.mark.parametrize("degrees", [15.0, 25.0])
def test_a_block_creeps_below_the_friction_angle_as_friction_wants_it(turned, degrees):
    friction = 0.5  # 26.6 degrees
    speed, _ = on_incline(degrees, friction, turned, 0.8)
    # mu x (2 - x) = tan(alpha), x being the speed over the creeping speed.
    ratio = math.tan(math.radians(degrees)) / friction
    expected = LAYER["creeping_speed"] * (1.0 - math.sqrt(1.0 - ratio))
    assert speed == pytest.approx(expected, abs=0.05 * LAYER["creeping_speed"])
    assert speed < LAYER["creeping_speed"]


@pytest.mark.parametrize("cells", [16, 32])
@pytest.mark.parametrize("turned", ["ground", "gravity"])
def test_a_block_slides_above_the_friction_angle_on_any_cells(turned, cells):
    for degrees, friction in ((30.0, 0.3), (20.0, 0.0)):
        _, acceleration = on_incline(degrees, friction, turned, 0.3, cells)
        alpha = math.radians(degrees)
        expected = G * (math.sin(alpha) - friction * math.cos(alpha))
        assert acceleration == pytest.approx(expected, rel=5e-3)


@pytest.mark.parametrize("cells", [16, 32])
@pytest.mark.parametrize(("friction", "speed"), [(0.5, 1.0), (0.3, 0.8)])
def test_a_block_that_slides_stops_where_its_energy_is_spent(friction, speed, cells):
    expected = speed**2 / (2.0 * friction * G)
    seconds = 1.2 * speed / (friction * G)
    simulation, frame = block(0.0, (speed, 0.0), seconds, friction=friction, cells=cells)
    _, place, velocity = motion(simulation, frame, (0.0, 1.0))
    assert np.diff(place[0])[0] == pytest.approx(expected, rel=1e-2)
    assert abs(velocity[0, 1]) <= 0.04 * speed  # it still rocks


def test_strong_friction_pitches_a_block_and_a_lower_one_stops_as_coulomb_says():
    # Friction acts at the foot, so it pitches a block by its height. Then the layer does not push
    # evenly, and the stop is late: no matter of the law of friction.
    friction, speed = 0.8, 1.2
    expected, late, tilts = speed**2 / (2.0 * friction * G), [], []
    for height in (HEIGHT, HEIGHT / 2):
        simulation, frame = block(
            0.0, (speed, 0.0), 1.2 * speed / (friction * G), friction=friction, height=height,
            cells=32,
        )  # fmt: skip
        _, place, _ = motion(simulation, frame, (0.0, 1.0))
        late.append(np.diff(place[0])[0] / expected - 1.0)
        x, y = simulation.run([simulation.steps // 4])[0][:2]
        tilts.append(np.polyfit(x, y, 1)[0])
    assert late[0] >= 0.02
    assert abs(late[1]) <= 5e-3
    assert tilts[0] < 2.0 * tilts[1] < -0.01


def restitution(alpha):
    """Rebound over impact speed of a mass on a layer of any force f, m dv/dt = f (1 - alpha v).

    m v dv / (1 - alpha v) = f dy, of which the right-hand side is the same in and out, so
    alpha (1 + e) = ln((1 + alpha) / (1 - alpha e)) for an impact speed of one.
    """
    return brentq(
        lambda e: math.log((1.0 + alpha) / (1.0 - alpha * e)) - alpha * (1.0 + e),
        0.0, min(1.0, (1.0 - 1e-12) / alpha),
    )  # fmt: skip


@pytest.mark.parametrize("damping", [0.25, 1.0, 4.0])
@pytest.mark.parametrize(("speed", "stiffness"), [(1.0, 1200.0), (0.5, 600.0)])
def test_restitution_falls_with_damping_times_speed(damping, speed, stiffness):
    simulation, frame = block(
        0.0, (0.0, -speed), 0.3 / speed, gravity=(0.0, 0.0), gap=LAYER["thickness"],
        friction=0.0, damping=damping / speed, stiffness=stiffness,
    )  # fmt: skip
    _, _, velocity = motion(simulation, frame, (0.0, 1.0))
    assert velocity[1, 1] / speed == pytest.approx(restitution(damping), rel=5e-3)


def test_without_damping_a_block_comes_back_as_fast_as_it_came():
    simulation, frame = block(
        0.0, (0.0, -1.0), 0.3, gravity=(0.0, 0.0), gap=LAYER["thickness"], damping=0.0
    )
    assert motion(simulation, frame, (1.0,))[2][1, 0] == pytest.approx(1.0, rel=1e-3)


@pytest.mark.parametrize("cells", [16, 32, 64])
def test_a_block_sinks_as_deep_as_the_layer_says(cells):
    soft = {"thickness": 0.125, "stiffness": 150.0}
    pressure, h = G * HEIGHT, 0.5 / cells  # a row of particles is h high
    depth = math.sqrt(2.0 * soft["thickness"] * pressure / soft["stiffness"])
    simulation, frame = block(
        0.0, (0.0, 0.0), 0.5, cells=cells, gap=soft["thickness"] - depth, damping=5.0, **soft
    )
    _, place, velocity = motion(simulation, frame, (1.0,))
    sunk = soft["thickness"] - (place[1, 0] - HEIGHT / 2)
    assert np.abs(velocity).max() <= 1e-3
    # The sum over rows misses an integral over a ramp by kappa h^2 / (8 delta) at most.
    assert abs(sunk - depth) <= h**2 / (8.0 * depth) + 5e-3 * depth
