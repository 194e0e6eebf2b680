"""Bodies at several instants, as pictures, films and exported motions show them."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.typing import NDArray

from mpmopt.assess.threshold import kept, solid_body, solid_reference
from mpmopt.design.problem import Problem
from mpmopt.design.step_control import with_halvings
from mpmopt.design.term import Outcome, Term
from mpmopt.errors import SimulationError
from mpmopt.kernels import parts
from mpmopt.scene import Mirror, Scene
from mpmopt.scene.particles import own
from mpmopt.simulation.simulation import Simulation

logger = logging.getLogger(__name__)

# Particles with less gamma than this are void: they do not count where a body is looked for.
SEEN = 0.1


def with_image(state: NDArray[np.float64], mirror: Mirror) -> NDArray[np.float64]:
    """A state (12, N) and its mirror image (12, 2 N)."""
    image = state.copy()
    k, other = mirror.normal, 1 - mirror.normal
    x, v, C, F = parts(image)
    x[k] = 2.0 * mirror.position - x[k]
    v[k] *= -1.0
    for tensor in (C, F):  # one reflection from each side
        tensor[k, other] *= -1.0
        tensor[other, k] *= -1.0
    return np.concatenate([state, image], axis=1)


@dataclass(frozen=True)
class Body:
    """What is simulated, and how it looks.

    Attributes
    ----------
    name : str
    simulation : Simulation
        Of N particles.
    gamma : (N,) array
        Their material density.
    objective : Term
    design : (D,) array
        Material density of all design particles.
    """

    name: str
    simulation: Simulation
    gamma: NDArray[np.float64]
    objective: Term
    design: NDArray[np.float64]

    def __post_init__(self) -> None:
        own(self, "gamma", "design")


def optimised(problem: Problem, x: NDArray[np.float64]) -> Body:
    """A design as it was optimised, with its void."""
    design = problem.gamma(x)
    gamma = problem.particles.completed(design)
    present = problem.present(problem.split(x).phi)
    simulation, objective = problem.simulation(x), problem.task.maximise
    return Body("optimised design", simulation, gamma[present], objective, design)


def post_processed(problem: Problem, x: NDArray[np.float64]) -> Body:
    """A design without grey: what has gamma >= 0.3 is solid, the rest is removed."""
    keep = kept(problem, x)
    return solid("post-processed design", problem, x, keep)


def reference(problem: Problem, x: NDArray[np.float64]) -> Body:
    """The solid reference design with the actuation of a design."""
    keep = solid_reference(problem.particles.position[problem.particles.designed])
    return solid("solid reference design, same actuation", problem, x, keep)


def solid(name: str, problem: Problem, x: NDArray[np.float64], keep: NDArray[np.bool_]) -> Body:
    """The body of which only the design particles in `keep` (D,) are there, all of them solid."""
    simulation = solid_body(problem.scene, keep, problem.split(x))
    gamma = np.ones(len(simulation.particles.position))
    return Body(name, simulation, gamma, problem.task.maximise, np.array(keep, float))


@dataclass(frozen=True)
class Motion:
    """A body at F instants; of a scene with a mirror both halves: M particles.

    Attributes
    ----------
    name : str
    scene : Scene
    frames : (F,) array of int
        Steps that were made before each instant.
    position : (F, 2, M) array
    velocity : (F, 2, M) array
    deformation : (F, 4, M) array
        Deformation gradient, row by row.
    gamma : (M,) array
        Material density.
    actuation : (F, M) array
        Signal divided by `largest`; zero outside actuators.
    largest : float
        Largest size of all signals from start to end; 1 if there is none.
    objective : (F,) array
        L, as if the motion ended there, though not before the objective's own instants.
    """

    name: str
    scene: Scene
    frames: NDArray[np.int64]
    position: NDArray[np.float32]
    velocity: NDArray[np.float32]
    deformation: NDArray[np.float32]
    gamma: NDArray[np.float64]
    actuation: NDArray[np.float32]
    largest: float
    objective: NDArray[np.float64]

    @classmethod
    def of(cls, body: Body, frames: Sequence[int] | NDArray[np.int64]) -> Motion:
        """Simulate a body.

        Raises
        ------
        DesignError, SimulationError
            As `Simulation.run` does.
        """
        simulation, gamma = body.simulation, body.gamma
        scene, frames = simulation.scene, np.array(frames)
        instants = body.objective.instants(scene)
        ends = [max(int(frame), *instants, 0) for frame in frames]
        wanted = sorted({*map(int, frames), *instants, *ends})
        found = dict(zip(wanted, simulation.run(wanted)))
        states = np.array([found[int(frame)] for frame in frames])
        actuator = simulation.particles.actuator
        values = [
            float(
                body.objective.value(
                    Outcome(
                        simulation, body.design, {step: found[step] for step in (*instants, end)}
                    )
                )
            )
            for end in ends
        ]
        if scene.mirror is not None:
            states = np.array([with_image(state, scene.mirror) for state in states])
            gamma, actuator = np.tile(gamma, 2), np.tile(actuator, 2)
        signal = np.real(simulation.signal)[np.minimum(frames, scene.steps - 1)]
        largest = float(np.abs(simulation.signal).max(initial=0.0)) or 1.0
        actuation = np.zeros((len(frames), len(gamma)), np.float32)
        actuation[:, actuator >= 0] = signal[:, actuator[actuator >= 0]] / largest
        x, v, _, F = parts(states)
        return cls(
            name=body.name,
            scene=scene,
            frames=frames,
            position=x.astype(np.float32),
            velocity=v.astype(np.float32),
            deformation=F.reshape(len(frames), 4, -1).astype(np.float32),
            gamma=gamma,
            actuation=actuation,
            largest=largest,
            objective=np.array(values),
        )

    @property
    def spacing(self) -> float:
        """Width of the undeformed square that a particle stands for."""
        return self.scene.grid.dx / self.scene.particles_per_cell

    @property
    def centroid(self) -> NDArray[np.float64]:
        """Mean place (F, 2) of all material."""
        return self._mean(self.position)

    @property
    def mean_velocity(self) -> NDArray[np.float64]:
        """That of all material (F, 2)."""
        return self._mean(self.velocity)

    def _mean(self, values: NDArray[np.float32]) -> NDArray[np.float64]:
        found: NDArray[np.float64] = values.astype(float) @ self.gamma / self.gamma.sum()
        return found

    @property
    def box(self) -> NDArray[np.float64]:
        """Lower and upper corner (2, 2) of where particles with material are at all instants."""
        seen = self.position[:, :, self.gamma >= SEEN]
        return np.array([seen.min(axis=(0, 2)), seen.max(axis=(0, 2))], dtype=float)


Make = Callable[[Problem, NDArray[np.float64]], Body]
Frames = Callable[[Scene], NDArray[np.int64]]


def moving(
    problem: Problem, x: NDArray[np.float64], makes: Sequence[Make], frames: Frames
) -> Iterator[tuple[Body, Motion]]:
    """A design's bodies and how they move, one after the other.

    Where one fails its step is halved, up to `Problem.halvings` times, since no evaluation has
    simulated this body. One that fails all the same is left out, which a warning tells.

    Parameters
    ----------
    problem : Problem
    x : (n,) array
    makes : sequence of callable
        What makes a body of problem and x, such as `optimised`.
    frames : callable
        Instants of a motion in a body's scene, such as `equal_steps`.

    Raises
    ------
    SimulationError
        As the first body, if none can be simulated.
    """
    failures = []

    def moved(make: Make, scene: Scene) -> tuple[Body, Motion]:
        body = make(problem.at(scene.time_step), x)
        return body, Motion.of(body, frames(body.simulation.scene))

    for make in makes:
        try:
            found, _ = with_halvings(problem.scene, partial(moved, make), problem.halvings)
        except SimulationError as error:
            logger.warning("a body is left out: %s", error)
            failures.append(error)
        else:
            yield found
    if len(failures) == len(makes):
        raise failures[0]


def equal_steps(scene: Scene, count: int, first: int = 0) -> NDArray[np.int64]:
    """Numbers of steps (count,) at equal intervals from the first to the end."""
    return np.rint(np.linspace(first, scene.steps, count)).astype(np.int64)
