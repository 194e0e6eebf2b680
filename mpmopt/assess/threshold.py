"""Bodies without grey: every particle is solid or absent. Post-processing and references."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import label

from mpmopt.design.actuation import sizes
from mpmopt.design.ensemble import side_by_side
from mpmopt.design.problem import Problem
from mpmopt.design.step_control import LIMITS, check_indicators
from mpmopt.design.task import DEFAULT_TASK, Task
from mpmopt.design.term import Outcome
from mpmopt.design.variables import Variables
from mpmopt.design.variation import Variation
from mpmopt.errors import DesignError, SimulationError
from mpmopt.scene import Scene
from mpmopt.scene.particles import Particles, discretise, nearest_designed, of_solid
from mpmopt.simulation.formulations import simulation_of
from mpmopt.simulation.simulation import Simulation
from mpmopt.validation import shown

THRESHOLD = 0.3  # of gamma, as in the paper
NO_GAIN = 1e-12  # over the grid's size: what two equal bodies may differ by
# Beyond a stretch of 1 over the particles per cell some cell has none: a body may crack there. An
# optimiser may pass through (`LIMITS`), but nothing that went so far counts. What a cut carries
# depends on this ratio alone, so one particle per cell bears no stretch at all. Nor does a body
# count whose parts lie in each other.
SOLID_LIMITS = LIMITS._replace(
    courant=np.inf, velocity_increment=np.inf, jacobian=0.0, stretch=1.0, gap=0.5
)

Baseline = Callable[[NDArray[np.float64]], NDArray[np.bool_]]


def solid_body(scene: Scene, keep: NDArray[np.bool_], variables: Variables) -> Simulation:
    """The body of which only some design particles are there, all of them solid.

    Parameters
    ----------
    scene : Scene
    keep : (D,) array of bool
        Design particles that are there; the others are not simulated at all.
    variables : Variables
        All but phi is the actuation.

    Raises
    ------
    DesignError
        If `keep` or the actuation has another size, or that is not within [-1, 1].
    """
    for (name, value), size in zip(list(variables._asdict().items())[1:], sizes(scene)):
        if np.shape(value) != (size,):
            raise DesignError(f"{name} has shape {np.shape(value)}, must have {(size,)}")
        if np.iscomplexobj(value) or not np.all(np.abs(value) <= 1.0):
            raise DesignError(f"{name} = {value} must be real and within [-1, 1]")
    particles = discretise(scene)
    designed = int(particles.designed.sum())
    if np.shape(keep) != (designed,):
        raise DesignError(f"keep has shape {np.shape(keep)}, the design particles {(designed,)}")
    particles = particles.subset(particles.completed(np.asarray(keep, dtype=bool)))
    ones = np.ones(len(particles.position))
    return simulation_of(
        scene,
        particles,
        density=of_solid(scene, particles, "density"),
        stiffness=ones,
        signal=variables.signal(scene),
    )


def distance(
    scene: Scene,
    keep: NDArray[np.bool_],
    variables: Variables,
    task: Task = DEFAULT_TASK,
) -> float:
    """Objective L of a `solid_body`, in all scenes of the task.

    Parameters
    ----------
    scene, keep, variables
        As in `solid_body`.
    task : Task, optional
        Whose objective it is.

    Raises
    ------
    DesignError
        As `solid_body`.
    SimulationError
        If the simulation fails, or goes beyond `SOLID_LIMITS`.
    """

    def in_scene(variation: Variation) -> float:
        there = variation.scene(scene)
        mine = keep
        if variation.refinement > 1:
            mine = keep[nearest_designed(discretise(there), discretise(scene))]
        simulation = solid_body(there, mine, variables)
        end = simulation.watch(task.maximise.instants(there))
        check_indicators(end.indicators, simulation, SOLID_LIMITS)
        return float(task.maximise.value(Outcome(simulation, np.array(mine, float), end.states)))

    values = side_by_side(in_scene, task.scenes or (Variation(),))
    return float(task.soft(np.array(values))[0])


def kept(problem: Problem, x: NDArray, threshold: float = THRESHOLD) -> NDArray[np.bool_]:
    """Which design particles (D,) have gamma >= threshold: post-processing leaves them.

    Raises
    ------
    DesignError
        If x does not fit, or the threshold is not between 0 and 1.
    """
    is_number = isinstance(threshold, (int, float, np.integer, np.floating))
    if not is_number or not 0.0 < threshold < 1.0:
        said = f"{threshold:g}" if is_number else shown(threshold)
        raise DesignError(f"threshold = {said} must be between 0 and 1")
    return problem.gamma(x) >= threshold


def post_processed(problem: Problem, x: NDArray, threshold: float = THRESHOLD) -> float:
    """Objective L once particles with gamma >= threshold are solid and the others removed.

    Raises
    ------
    DesignError
        As `kept`.
    SimulationError
        As `distance`.
    """
    keep, variables = kept(problem, x, threshold), problem.split(x)
    return distance(problem.scene, keep, variables, problem.task)


def retained_share(scene: Scene, retained: float, gain: float) -> float:
    """Share of a gain that is retained; not a number if there was none beyond rounding."""
    gain = beyond_rounding(scene, gain)
    return retained / gain if gain > 0.0 else float("nan")


def beyond_rounding(scene: Scene, gain: float) -> float:
    """A gain, or zero if it is no more than rounding of positions."""
    return 0.0 if abs(gain) <= NO_GAIN * max(scene.grid.size) else gain


def unactuated(problem: Problem, x: NDArray) -> float:
    """Objective L of the post-processed design when no actuator works: how far it merely falls."""
    variables = problem.split(x)
    still = variables._replace(a=0.0 * variables.a, b=0.0 * variables.b)
    return distance(problem.scene, kept(problem, x), still, problem.task)


def pieces(scene: Scene, keep: NDArray[np.bool_]) -> NDArray[np.int64]:
    """Number of the connected piece that each kept design particle belongs to.

    Neighbours on the particles' lattice hold together; piece 0 holds to a solid region.

    Parameters
    ----------
    scene : Scene
    keep : (D,) array of bool
        Design particles that are there.

    Returns
    -------
    (D,) array of int
        0: held; 1, 2, ...: pieces that hang on nothing; -1: not there.
    """
    particles = discretise(scene)
    there = particles.completed(keep)
    labels = connected(scene, particles, there)
    held = np.isin(labels, labels[~particles.designed])
    _, number = np.unique(np.where(held, 0, labels), return_inverse=True)  # solid regions are 0
    return np.where(there, number, -1)[particles.designed]


def connected(scene: Scene, particles: Particles, there: NDArray[np.bool_]) -> NDArray[np.int64]:
    """Number (N,) of the piece that each particle belongs to, from 1 on; 0 of what is not there.

    Particles (N,) that are there hold together over edges of their lattice and not over corners.
    """
    index = np.floor(particles.position * scene.particles_per_cell / scene.grid.dx).astype(int)
    i, j = (index - index.min(axis=0)).T
    lattice = np.zeros((i.max() + 1, j.max() + 1), dtype=bool)
    lattice[i, j] = there
    numbers: NDArray[np.int64] = label(lattice)[0][i, j]
    return numbers


def solid_reference(positions: NDArray[np.float64]) -> NDArray[np.bool_]:
    """A baseline in which all design particles are there: the simplest reference design."""
    return np.ones(len(positions), dtype=bool)


def best_actuated(
    scene: Scene,
    baseline: Baseline,
    *actuations: Variables,
    task: Task = DEFAULT_TASK,
) -> float:
    """Objective L of the baseline design with the best of some actuations, of those that run.

    Parameters
    ----------
    scene : Scene
    baseline : callable
        From the design particles' reference positions (D, 2) to which of them are there (D,).
    actuations : Variables
    task : Task, optional
        As in `distance`.

    Raises
    ------
    SimulationError
        If none runs.
    """
    particles = discretise(scene)
    keep = baseline(particles.position[particles.designed])

    def tried(actuation: Variables) -> float | SimulationError:
        try:
            return distance(scene, keep, actuation, task)
        except SimulationError as error:
            return error

    found = side_by_side(tried, actuations)
    failures = [each for each in found if isinstance(each, SimulationError)]
    values = [each for each in found if not isinstance(each, SimulationError)]
    if failures and not values:
        raise failures[-1]
    return max(values)
