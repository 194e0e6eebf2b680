"""Energy from nowhere: what a run's balance shows where the method works, and where it does not."""

from collections.abc import Callable, Iterator
from functools import partial
from typing import Any

import numpy as np
from crawler import crawler
from exact import Bar, at_rest
from walker import walker

from mpmopt.design.problem import Problem
from mpmopt.design.step_control import LIMITS
from mpmopt.errors import SimulationError
from mpmopt.scene import Actuator, Grid, Material, Scene, Solid, Wall
from mpmopt.scene.particles import discretise
from mpmopt.simulation.simulation import Precision, Simulation
from stability.actuation import equilibrium_stretch
from stability.common import Found, Line, Measured, Points, solid
from stability.time_step import MOTIONS, block_scene, isolated
from stability.weak import courant_scene

KICK = 1e-6  # velocity of a perturbation, in wave speeds

Make = Callable[[], Simulation]


def vibrating(precision: Precision) -> Simulation:
    """The bar with an exact answer."""
    return Bar(50, 0.5, precision=precision).simulation


def grey(scene: Scene, precision: Precision) -> Simulation:
    """A random grey design of a scene; none if there is nothing to design."""
    problem = Problem(scene, 2.0, precision=precision)
    if problem.size == 0:
        return problem.simulation(np.zeros(0))
    phi = np.random.default_rng(1).uniform(-1.0, 1.0, problem.size - 3)
    return problem.simulation(problem.join(phi, 1.0, -0.3, -0.5))


def resolved(quick: bool) -> Iterator[tuple[str, Make]]:
    """Motions that the method gets right."""
    precisions: tuple[Precision, ...] = ("double",) if quick else ("double", "single")
    for precision in precisions:
        yield f"bar vibrates, {precision}", partial(vibrating, precision)
        drop = Scene(
            Grid((32, 32), 1 / 32), time_step=2e-3, steps=3000, gravity=(0.0, -10.0),
            body=(Solid((8 / 32, 10 / 32), (16 / 32, 16 / 32)),), walls=(Wall("y", 3 / 32),),
        )  # fmt: skip
        yield f"block bounces, {precision}", partial(grey, drop, precision)
        for name, scene in (("walker", walker(64, 8e-4)), ("crawler", crawler(64, 8e-4))):
            make = partial(grey, scene.vary(void_density=1e-2), precision)
            yield f"{name}, grey, {precision}", make


def block(courant: float, steps: int, kick: float) -> Simulation:
    """A free block that begins with a small random motion."""
    scene = block_scene(steps=steps)
    particles = discretise(scene)
    state, speed = at_rest(particles), scene.material.wave_speed
    noise = np.random.default_rng(1).uniform(-1.0, 1.0, state[2:8].shape)
    state[2:8] = kick * speed * noise
    return solid(scene, particles, state, time_step=courant / speed)


def particle(motion: str, rate: float, courant: float) -> Simulation:
    """An isolated particle that starts with |C| = rate c_p / dx."""
    scene = block_scene(steps=300)
    one = isolated(scene)
    state, speed = at_rest(one), scene.material.wave_speed
    state[4:8, 0] = rate * speed * np.array(MOTIONS[motion]) / np.linalg.norm(MOTIONS[motion])
    return solid(scene, one, state, time_step=courant / speed)


def pushing(strength: float, steps: int) -> Simulation:
    """An actuator in equilibrium that pushes with so many mu, kicked a little."""
    scene = Scene(
        Grid((32, 32), 1.0),
        time_step=0.3 / Material().wave_speed,
        steps=steps,
        body=(Actuator((12.0, 12.0), (20.0, 20.0), stress=((1.0, 0.0), (0.0, 1.0))),),
    )
    particles = discretise(scene)
    state, f = at_rest(particles), equilibrium_stretch(strength)
    state[0:2] = 16.0 + f * (state[0:2] - 16.0)
    state[[8, 11]] = f
    noise = np.random.default_rng(2).uniform(-1.0, 1.0, (2, state.shape[1]))
    state[2:4] = KICK * scene.material.wave_speed * noise
    signal = np.full((steps, 1), -strength * scene.material.lame_mu)
    return solid(scene, particles, state, signal=signal)


def light_void(case: str, seed: int) -> Simulation:
    """A random design at Courant 0.8 whose void weighs 1e-5 of the solid."""
    scene = courant_scene(case, 0.8, 64, Material(void_density=1e-5, void_stiffness=1e-5))
    problem = Problem(scene, 16.0)
    phi = np.random.default_rng(seed).uniform(-1.0, 1.0, problem.size - 3)
    return problem.simulation(problem.join(phi, 1.0, -0.3, -0.5))


def cases(quick: bool) -> Iterator[tuple[str, str, Make]]:
    """All of them: of which kind, what, and what makes the run."""
    for name, make in resolved(quick):
        yield "resolved", name, make
    for courant in (0.8, 1.0):
        yield "resolved", f"free block at Courant {courant:g}", partial(block, courant, 1000, KICK)
    for courant, steps in ((1.2, 40), (1.25, 20), (1.3, 10)):  # until just before it inverts
        yield "unstable", f"free block at Courant {courant:g}", partial(block, courant, steps, KICK)
    for motion, rate in (("spin", 0.1), ("spin", 1.0), ("squeeze", 0.1), ("shear", 1.0)):
        for courant in (0.2, 0.4, 0.6, 0.8):
            name = f"isolated particle, {motion} at {rate:g} c_p / dx, Courant {courant:g}"
            yield "isolated particle", name, partial(particle, motion, rate, courant)
    for strength in (0.9, 0.99):
        yield "resolved", f"actuator pushes with {strength:g} mu", partial(pushing, strength, 2000)
    for case in ("walker", "crawler"):
        for seed in range(1 if quick else 3):
            yield (
                "light void",
                f"{case}, light void, design {seed}",
                partial(light_void, case, seed),
            )


def balance(kind: str, case: str) -> dict[str, Any]:
    """The share of energy that appears in one case."""
    make = next(make for *names, make in cases(quick=False) if names == [kind, case])
    row: dict[str, Any] = {"kind": kind, "case": case, "courant": np.nan, "spin": np.nan,
                           "energy": np.nan, "error": ""}  # fmt: skip
    try:
        indicators = make().watch().indicators
        return row | {
            "courant": indicators.courant,
            "spin": indicators.velocity_increment,
            "energy": indicators.energy,
        }
    except SimulationError as error:
        return row | {"error": error.what}


def points(quick: bool) -> Points:
    """All cases."""
    return {balance: [{"kind": kind, "case": case} for kind, case, _ in cases(quick)]}


def measure(measured: Measured) -> Found:
    """The share of energy that appears in each, and how far both kinds are apart."""
    rows = measured[balance]

    def span(kind: str) -> tuple[float, float]:
        mine = [row["energy"] for row in rows if row["kind"] == kind and not row["error"]]
        return min(mine, default=np.nan), max(mine, default=np.nan)

    line = Line(
        "Energy from nowhere",
        "none",
        f"at most {span('resolved')[1]:.0e} of what is turned over in resolved motions, "
        f"{span('isolated particle')[0]:.0e} to {span('isolated particle')[1]:.1f} for isolated "
        f"particles in fast motion; {span('unstable')[0]:.0f} to {span('unstable')[1]:.0f} where "
        f"the step is unstable; beside light void {span('light void')[1]:.0e}: too light to show",
        f"`Problem` redoes it beyond {LIMITS.energy:g}, then SimulationError.",
    )
    return Found({"energy": rows}, [line])
