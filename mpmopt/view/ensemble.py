"""A film of a finished robot in several scenes at once, side by side."""

from __future__ import annotations

import logging
from functools import partial
from pathlib import Path

from mpmopt.assess.robustness import FEW_FRICTIONS, Robot, lasting, unit
from mpmopt.assess.trajectory import Motion, equal_steps
from mpmopt.design.step_control import with_halvings
from mpmopt.design.variation import Variation
from mpmopt.errors import DesignError, SimulationError
from mpmopt.optimisation.history import Optimisation
from mpmopt.scene import Scene
from mpmopt.view.film import LAST, Filmed, Screen, count_frames, write
from mpmopt.view.gait import body_of

logger = logging.getLogger(__name__)

SHOWN = 4.0  # in units of `unit`
SECONDS = 10.0  # that the film takes for it


def film_scenes(path: Path, run: Optimisation, seconds: float = SECONDS) -> Filmed:
    """Write a film of a run's finished robot in all scenes of its task, from rest.

    In scenes of several frictions if the task has none of its own. Where it cannot be simulated,
    with steps halved up to `Problem.halvings` times, a scene is left out.

    Parameters
    ----------
    path : Path
        As in `film.film`.
    run : Optimisation
    seconds : float, optional
        That the film plays.

    Raises
    ------
    DesignError
        If the run has no design or no ground, `path` has another ending, `seconds` makes no sense,
        or no scene can be simulated.
    MissingLibraryError, StorageError
        As `film.film`.
    """
    problem = run.problem()
    if not problem.scene.ground or not problem.scene.actuators:
        raise DesignError(
            "film: only robots on ground, with actuators, are filmed in several scenes"
        )
    count = count_frames(path, seconds)
    scenes = run.task.scenes or tuple(Variation(friction=value) for value in FEW_FRICTIONS)
    robot, shown, motions = Robot.of(problem, run.result.x), SHOWN * unit(problem.scene), []

    def motion(variation: Variation, scene: Scene) -> Motion:
        scene = lasting(variation.scene(scene), shown)
        return Motion.of(body_of(robot, scene, str(variation)), equal_steps(scene, count))

    for variation in scenes:
        try:
            seen, _ = with_halvings(problem.scene, partial(motion, variation), problem.halvings)
            motions.append(seen)
        except SimulationError as error:
            logger.warning("the film is without the scene of %s: %s", variation, error)
    if not motions:
        raise DesignError("film: the robot cannot be simulated in any of its scenes")
    size = write(path, Screen(motions, seconds / shown))
    per_period = count * robot.period(problem.scene) / shown
    return Filmed(count, seconds + LAST, seconds / shown, per_period, size)
