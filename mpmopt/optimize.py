"""From a grey block to a robot: stages of moving asymptotes, each sharper than the last."""

from __future__ import annotations

import dataclasses
import logging
import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from mpmopt.binary import post_processed
from mpmopt.checkpoints import Checkpointing
from mpmopt.checks import count, number, share
from mpmopt.design import greyness
from mpmopt.errors import DesignError, SimulationError
from mpmopt.mma import MovingAsymptotes
from mpmopt.problem import Problem
from mpmopt.scene import Scene
from mpmopt.simulate import Margins

logger = logging.getLogger(__name__)

# Factors on the move limit after a step that went back, and after one that went on.
SHORTEN, LENGTHEN = 0.6, 1.2
# How often a stage of which no design runs halves its time step before the run gives up.
HALVINGS = 3


@dataclass(frozen=True)
class Stage:
    """What one stage of the continuation holds fixed.

    Attributes
    ----------
    beta : float
        Sharpness of the projection.
    mass_floor, stiffness_floor : float
        Share of mass and stiffness that void keeps.
    time_step : float
    solid : bool
        Whether the best design is the one that goes farthest once its void is removed
        (`binary.post_processed`), which costs a forward run more, instead of as it is. The climb
        itself goes on from the one that goes farthest as it is.
    coarsening : int
        How many of the scene's cells go into the width of this stage's: early stages need no more.
    move_limit : float
        Greatest step of a variable, as a fraction of its range.
    leave_out : float
        Design particles whose gamma is below this are not simulated (`Problem`).
    most_iterations : int, optional
        Successful evaluations of this stage, instead of `Settings.most_iterations`.
    redo : int
        How often an evaluation is redone with half the time step (`Problem`).

    Raises
    ------
    DesignError
        If a number makes no sense.
    """

    beta: float
    mass_floor: float
    stiffness_floor: float
    time_step: float
    solid: bool = False
    coarsening: int = 1
    move_limit: float = 0.05
    leave_out: float = 0.0
    most_iterations: int | None = None
    redo: int = 2

    def __post_init__(self) -> None:
        for name in ("beta", "mass_floor", "stiffness_floor", "time_step", "move_limit"):
            value = number("Stage", name, getattr(self, name), above=0.0, error=DesignError)
            object.__setattr__(self, name, value)
        if self.move_limit > 1.0:
            raise DesignError(f"Stage: move_limit = {self.move_limit} must be at most 1")
        leave_out = share("Stage", "leave_out", self.leave_out, error=DesignError)
        object.__setattr__(self, "leave_out", leave_out)
        if self.most_iterations is not None:
            most = count("Stage", "most_iterations", self.most_iterations, 1, error=DesignError)
            object.__setattr__(self, "most_iterations", most)
        coarsening = count("Stage", "coarsening", self.coarsening, 1, error=DesignError)
        object.__setattr__(self, "coarsening", coarsening)
        redo = count("Stage", "redo", self.redo, 0, error=DesignError)
        object.__setattr__(self, "redo", redo)

    def scene(self, scene: Scene) -> Scene:
        """The scene as this stage simulates it."""
        return scene.vary(
            time_step=self.time_step,
            mass_floor=self.mass_floor,
            stiffness_floor=self.stiffness_floor,
            coarsening=self.coarsening,
        )

    def problem(
        self,
        scene: Scene,
        time_step: float | None = None,
        checkpointing: Checkpointing | None = None,
    ) -> Problem:
        """The problem that this stage solves, in another time step if it ended with one."""
        stage = self if time_step is None else dataclasses.replace(self, time_step=time_step)
        return Problem(stage.scene(scene), self.beta, checkpointing, self.leave_out, self.redo)


@dataclass(frozen=True)
class Settings:
    """How to optimise.

    Attributes
    ----------
    stages : tuple of Stage
    adapt_move_limit : bool
        Shorten the move limit after a step that went back, and lengthen it, up to the stage's,
        after one that went on.
    sharpen_asymptotes : bool
        Initial asymptotes at 0.5 / (beta + 1) of the range instead of 0.5.
    best_first : bool
        Start each stage from the design of the one before that went farthest, instead of its last.
    window : int
        Iterations in the moving average of the stop rule.
    tolerance : float
        A stage ends when the moving average changes by no more than this.
    least_iterations, most_iterations : int
        Successful evaluations of a stage.
    most_failures : int
        Failed evaluations in a row after which the optimisation gives up.
    scouting : int
        Of several starts, each goes through so many of the first stages; then the best goes on.

    Raises
    ------
    DesignError
        If there is no stage or a number makes no sense.
    """

    stages: tuple[Stage, ...]
    adapt_move_limit: bool = True
    sharpen_asymptotes: bool = True
    best_first: bool = True
    window: int = 10
    tolerance: float = 2e-4
    least_iterations: int = 20
    most_iterations: int = 200
    most_failures: int = 8
    scouting: int = 0

    def __post_init__(self) -> None:
        if not self.stages or not all(isinstance(stage, Stage) for stage in self.stages):
            raise DesignError(f"Settings: stages = {self.stages!r} must be Stages, at least one")
        object.__setattr__(self, "stages", tuple(self.stages))
        for name in ("window", "least_iterations", "most_iterations", "most_failures"):
            object.__setattr__(
                self, name, count("Settings", name, getattr(self, name), 1, error=DesignError)
            )
        scouting = count("Settings", "scouting", self.scouting, 0, error=DesignError)
        object.__setattr__(self, "scouting", scouting)
        if scouting > len(self.stages):
            raise DesignError(
                f"Settings: scouting = {scouting} is above the number of stages {len(self.stages)}"
            )
        tolerance = number("Settings", "tolerance", self.tolerance, error=DesignError)
        object.__setattr__(self, "tolerance", tolerance)
        if self.least_iterations > self.most_iterations:
            raise DesignError(
                f"Settings: least_iterations = {self.least_iterations} is above "
                f"most_iterations = {self.most_iterations}"
            )
        if self.tolerance < 0.0:
            raise DesignError(f"Settings: tolerance = {self.tolerance} must not be negative")


@dataclass(frozen=True)
class Iteration:
    """One evaluation.

    Attributes
    ----------
    start : int
        Index of the start that it goes back to.
    stage : int
        Index of the stage.
    beta, move_limit : float
        In force during the evaluation.
    time_step : float
        That the values are of; of the last attempt if it failed.
    x : (n,) array
        The design that was evaluated.
    gamma : (D,) array
        Its material density.
    objective : float
        L, or not a number if the evaluation failed.
    greyness : float
        Mean of 4 gamma (1 - gamma).
    projected_gradient : float
        Greatest change of L per unit of x that the bounds leave free.
    step : float
        Greatest change of a variable since the last evaluation, as a fraction of its range.
    seconds : float
        Since the optimisation began.
    post_processed : float
        L without void, or not a number if the stage does not ask for it or it failed.
    redone : int
        How often the stage's time step was halved for this evaluation.
    courant, spin, jacobian, stretch : float
        Its `simulate.Margins`, or not a number if it failed.
    failure : str
        Why the evaluation failed, or empty.
    """

    start: int
    stage: int
    beta: float
    time_step: float
    move_limit: float
    x: NDArray[np.float64]
    gamma: NDArray[np.float64]
    objective: float
    greyness: float
    projected_gradient: float
    step: float
    seconds: float
    post_processed: float = np.nan
    redone: int = 0
    courant: float = np.nan
    spin: float = np.nan
    jacobian: float = np.nan
    stretch: float = np.nan
    failure: str = ""


@dataclass
class Optimisation:
    """An optimisation as it stands: what `optimise` hands to callbacks and returns.

    Attributes
    ----------
    scene : Scene
    settings : Settings
    history : list of Iteration
        All evaluations.
    best : dict of int to Iteration
        The best evaluation of each stage that had one.
    stop_reason : str
        A sentence; empty while it runs.
    """

    scene: Scene
    settings: Settings
    history: list[Iteration] = field(default_factory=list)
    best: dict[int, Iteration] = field(default_factory=dict)
    stop_reason: str = ""

    @property
    def result(self) -> Iteration:
        """The best evaluation on the last stage's grid.

        That is the one that goes farthest without void, where stages ask for that; else the best of
        the last stage that had one, whose projection is the sharpest.

        Raises
        ------
        DesignError
            If no evaluation succeeded.
        """
        if not self.best:
            last = self.history[-1].failure if self.history else "none was made"
            raise DesignError(f"no evaluation succeeded; the last: {last}")
        stages = self.settings.stages
        grid = stages[max(self.best)].coarsening
        return max(
            (item for stage, item in self.best.items() if stages[stage].coarsening == grid),
            key=lambda item: (np.nan_to_num(item.post_processed, nan=-np.inf), item.stage),
        )

    def problem(self) -> Problem:
        """The problem that `result` solves, in the time step that it was evaluated with."""
        best = self.result
        return self.settings.stages[best.stage].problem(self.scene, best.time_step)

    @property
    def failed_evaluations(self) -> int:
        """Number of evaluations that failed."""
        return sum(bool(iteration.failure) for iteration in self.history)

    @property
    def redone_evaluations(self) -> int:
        """Number of evaluations that were redone with a shorter time step."""
        return sum(iteration.redone > 0 for iteration in self.history)


Callback = Callable[[Optimisation], None]


def optimise(
    scene: Scene,
    settings: Settings,
    start: NDArray[np.float64] | Sequence[NDArray[np.float64]],
    callbacks: Iterable[Callback] = (),
    checkpointing: Checkpointing | None = None,
) -> Optimisation:
    """Maximise the distance travelled, stage by stage.

    An evaluation that fails steps back to the stage's farthest design and halves the move limit,
    which then recovers slowly. A stage of which no design ran yet halves its time step instead.

    Parameters
    ----------
    scene : Scene
    settings : Settings
    start : (n,) array, or several
        First design, within [-1, 1], of the first stage's scene (`Problem.join` makes it). Of
        several the best after `Settings.scouting` stages goes on.
    callbacks : iterable of callable
        Called after each evaluation and once at the end.
    checkpointing : Checkpointing, optional

    Raises
    ------
    DesignError
        If `start` does not fit the scene, or there is nothing to design.
    SceneError
        If a stage cannot be simulated; all are checked before the first evaluation.
    StorageError
        If checkpoints cannot be stored.
    """
    starts = [start] if isinstance(start, np.ndarray) else list(start)
    scenes = [stage.scene(scene) for stage in settings.stages]
    first = Problem(scenes[0])
    designs = [first.join(*first.split(x)) for x in starts]
    if not designs or first.size == 0:
        raise DesignError("there is nothing to design: give a Design or an Actuator, and a start")
    if len(designs) > 1 and settings.scouting == 0:
        raise DesignError(f"{len(designs)} starts need Settings.scouting >= 1, the stages of each")
    climb = _Climb(Optimisation(scene, settings), scenes, tuple(callbacks), checkpointing)
    scouting = settings.scouting if len(designs) > 1 else 0
    scouted = [climb.stages(0, scouting, number, x) for number, x in enumerate(designs)]
    chosen = max(scouted, key=lambda leg: leg.merit)
    climb.run.best = chosen.best
    last = chosen if chosen.gave_up else climb.stages(scouting, len(scenes), chosen.start, chosen.x)
    reached = last.stage + 1
    climb.run.stop_reason = f"Stage {reached} of {len(scenes)} was the last: {last.reason}"
    climb.report()
    return climb.run


@dataclass
class _Leg:
    """How far one start has come."""

    start: int
    x: NDArray[np.float64]
    stage: int = 0
    reason: str = ""
    gave_up: bool = False
    best: dict[int, Iteration] = field(default_factory=dict)

    @property
    def merit(self) -> tuple[int, float]:
        """What the starts are compared by: the last stage that had a design, and its best."""
        if not self.best:
            return -1, -np.inf
        item = self.best[max(self.best)]
        return item.stage, item.objective if np.isnan(item.post_processed) else item.post_processed


class _Climb:
    """An optimisation on its way through the stages."""

    def __init__(
        self,
        run: Optimisation,
        scenes: list[Scene],
        callbacks: tuple[Callback, ...],
        checkpointing: Checkpointing | None,
    ) -> None:
        self.run, self.scenes = run, scenes
        self.callbacks, self.checkpointing = callbacks, checkpointing
        self.began = time.monotonic()

    def report(self) -> None:
        for callback in self.callbacks:
            callback(self.run)

    def stages(self, first: int, last: int, start: int, x: NDArray[np.float64]) -> _Leg:
        """Climb from x through the stages from `first` to before `last`."""
        leg = _Leg(start, x)
        if first == 0:
            self.run.best = {}
        for index in range(first, last):
            stage = _StageRun(self, index, start)
            if (
                index > 0
                and stage.stage.coarsening != self.run.settings.stages[index - 1].coarsening
            ):
                leg.x = stage.problem.transfer(Problem(self.scenes[index - 1]), leg.x)
            leg.stage = index
            leg.x, leg.reason, leg.gave_up = stage.climb(leg.x)
            logger.info("start %d, stage %d: %s", start, index, leg.reason)
            if leg.gave_up:
                break
        leg.best = dict(self.run.best)
        return leg


class _StageRun:
    """One stage on its way."""

    def __init__(self, whole: _Climb, index: int, start: int) -> None:
        self.whole, self.run, self.index, self.start = whole, whole.run, index, start
        self.stage = self.run.settings.stages[index]
        self.problem = self.stage.problem(self.run.scene, None, whole.checkpointing)
        self.best_merit: tuple[float, ...] | None = None
        self.farthest: tuple[Iteration, NDArray[np.float64]] | None = None  # and its gradient

    def climb(self, x: NDArray[np.float64]) -> tuple[NDArray[np.float64], str, bool]:
        """Climb from x to where the stop rule ends the stage.

        Returns the design that the next stage starts from, why it stopped, and whether to give up.
        """
        settings = self.run.settings
        mma = MovingAsymptotes(
            -np.ones(x.size),
            np.ones(x.size),
            move_limit=self.stage.move_limit,
            asymptote_initial=0.5 / (self.stage.beta + 1.0) if settings.sharpen_asymptotes else 0.5,
        )
        values: list[float] = []
        failures = 0
        while True:
            evaluated = self._evaluate(x, mma.move_limit)
            if evaluated is None:
                failures += 1
                none_ran = self.farthest is None
                if failures >= settings.most_failures or (none_ran and failures > HALVINGS):
                    why = f"it gave up after {failures} failed evaluations in a row."
                    return x, why, True
                if self.farthest is None:
                    self._halve_time_step()
                    continue
                mma.reset()
                mma.move_limit /= 2.0
                item, gradient = self.farthest
                x = mma.step(item.x, -item.objective, -gradient)
                continue
            failures = 0
            value, gradient = evaluated
            values.append(value)
            stop = self._stop_reason(values)
            if stop:
                onward = self.farthest[0].x if self.farthest and settings.best_first else x
                return onward, stop, False
            went_back = len(values) > 1 and value < values[-2]
            factor = SHORTEN if went_back and settings.adapt_move_limit else LENGTHEN
            mma.move_limit = min(self.stage.move_limit, factor * mma.move_limit)
            x = mma.step(x, -value, -gradient)

    def _evaluate(
        self, x: NDArray[np.float64], move_limit: float
    ) -> tuple[float, NDArray[np.float64]] | None:
        """Value and gradient, recorded; None if the simulation failed."""
        run = self.run
        value, failure = np.nan, ""
        gradient: NDArray[np.float64] = np.full(x.size, np.nan)
        problem, redone, margins = self.problem, self.problem.redo, Margins(*4 * (np.nan,))
        time_step = problem.scene.time_step / 2.0**redone
        try:
            evaluation = problem.evaluate(x)
            value, gradient = evaluation.value, evaluation.gradient
            redone, margins = evaluation.redone, evaluation.margins
            time_step = evaluation.time_step
        except SimulationError as error:
            failure = str(error)
            logger.warning("evaluation %d failed: %s", len(run.history), error)
        solid = np.nan
        if self.stage.solid and not failure:
            solid = self._without_void(problem.at(time_step), x)
        before = run.history[-1].x if run.history else x
        if before.size != x.size:  # another grid
            before = x
        free = np.where(gradient > 0.0, x < 1.0, x > -1.0)
        gamma = self.problem.gamma(x)
        iteration = Iteration(
            start=self.start,
            stage=self.index,
            beta=self.stage.beta,
            time_step=time_step,
            move_limit=move_limit,
            x=x.copy(),
            gamma=gamma,
            objective=value,
            greyness=greyness(gamma),
            projected_gradient=float(np.abs(gradient * free).max()),
            step=float(np.abs(x - before).max() / 2.0),
            seconds=time.monotonic() - self.whole.began,
            post_processed=solid,
            redone=redone,
            courant=margins.courant,
            spin=margins.spin,
            jacobian=margins.jacobian,
            stretch=margins.stretch,
            failure=failure,
        )
        run.history.append(iteration)
        merit = (np.nan_to_num(solid, nan=-np.inf), value) if self.stage.solid else (value,)
        if not failure and (self.farthest is None or value > self.farthest[0].objective):
            self.farthest = iteration, gradient
        if not failure and (self.best_merit is None or merit > self.best_merit):
            run.best[self.index] = iteration
            self.best_merit = merit
        self.whole.report()
        return None if failure else (value, gradient)

    def _without_void(self, problem: Problem, x: NDArray[np.float64]) -> float:
        try:
            return post_processed(problem, x)
        except SimulationError as error:
            logger.warning("the design fails without void: %s", error)
            return np.nan

    def _halve_time_step(self) -> None:
        scene = self.problem.scene
        logger.warning("no design of this stage ran yet: time step %g halved", scene.time_step)
        self.problem = self.stage.problem(
            self.run.scene, scene.time_step / 2.0, self.whole.checkpointing
        )

    def _stop_reason(self, values: list[float]) -> str:
        """Why the stage ends after these objective values, or nothing."""
        settings = self.run.settings
        count, window = len(values), settings.window
        if count >= max(settings.least_iterations, window + 1):
            change = abs(np.mean(values[-window:]) - np.mean(values[-window - 1 : -1]))
            if change <= settings.tolerance:
                last = self.run.history[-1]
                return (
                    f"the mean objective over {window} iterations changed by {change:.1e} <= "
                    f"{settings.tolerance:.1e} after {count} of them (last step {last.step:.1e} of "
                    f"the range, projected gradient {last.projected_gradient:.1e})."
                )
        if count >= (self.stage.most_iterations or settings.most_iterations):
            return f"it reached its limit of {count} iterations."
        return ""
