"""From a grey block to a robot: stages of moving asymptotes, each sharper than the last."""

from __future__ import annotations

import dataclasses
import logging
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mpmopt import audit
from mpmopt.binary import post_processed
from mpmopt.checkpoints import Checkpointing
from mpmopt.checks import count, flag, instance, number, share, shown
from mpmopt.design import greyness
from mpmopt.errors import DesignError, SceneError, SimulationError
from mpmopt.history import Candidate, Iteration, Leg, Optimisation, StageState
from mpmopt.mma import MovingAsymptotes
from mpmopt.problem import Problem
from mpmopt.scene import Scene
from mpmopt.simulate import Margins

logger = logging.getLogger(__name__)

# Factors on the move limit after a step that went back, and after one that went on.
SHORTEN, LENGTHEN = 0.6, 1.2
# Successful evaluations of a stage before the stop rule may end it.
LEAST = 20
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
    audited : bool
        Whether such a design counts with the least of this and of the same with half the step and
        with cells half as wide (`audit.least`), so that the best is one that keeps its gain. This
        costs four gradients more for each design that goes farther than the best so far.
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
    audited: bool = False
    coarsening: int = 1
    move_limit: float = 0.05
    leave_out: float = 0.0
    most_iterations: int | None = None
    redo: int = 2

    def __post_init__(self) -> None:
        for name in ("beta", "mass_floor", "stiffness_floor", "time_step", "move_limit"):
            value = number("Stage", name, getattr(self, name), above=0.0, error=DesignError)
            object.__setattr__(self, name, value)
        for name in ("mass_floor", "stiffness_floor", "move_limit"):
            if getattr(self, name) > 1.0:
                raise DesignError(f"Stage: {name} = {getattr(self, name)} must be at most 1")
        leave_out = share("Stage", "leave_out", self.leave_out, error=DesignError)
        object.__setattr__(self, "leave_out", leave_out)
        for name in ("solid", "audited"):
            value = flag("Stage", name, getattr(self, name), error=DesignError)
            object.__setattr__(self, name, value)
        if self.audited and not self.solid:
            raise DesignError("Stage: audited = True needs solid = True")
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
        Or a single one.
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
        A stage ends when the moving average changes by no more than this share of the grid's
        longer side.
    least_iterations : int, optional
        Successful evaluations of a stage before the stop rule may end it; default: 20, or
        `most_iterations` if that is less.
    most_iterations : int
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
    least_iterations: int | None = None
    most_iterations: int = 200
    most_failures: int = 8
    scouting: int = 0

    def __post_init__(self) -> None:
        given: Any = self.stages
        stages = tuple(given) if isinstance(given, Iterable) else (given,)
        if not stages or not all(isinstance(stage, Stage) for stage in stages):
            raise DesignError(f"Settings: stages = {shown(given)} must be Stages, at least one")
        object.__setattr__(self, "stages", stages)
        for name in ("adapt_move_limit", "sharpen_asymptotes", "best_first"):
            value = flag("Settings", name, getattr(self, name), error=DesignError)
            object.__setattr__(self, name, value)
        for name in ("window", "least_iterations", "most_iterations", "most_failures"):
            given = getattr(self, name)
            if name != "least_iterations" or given is not None:
                given = count("Settings", name, given, 1, error=DesignError)
                object.__setattr__(self, name, given)
        scouting = count("Settings", "scouting", self.scouting, 0, error=DesignError)
        object.__setattr__(self, "scouting", scouting)
        if scouting > len(self.stages):
            raise DesignError(
                f"Settings: scouting = {scouting} is above the number of stages {len(self.stages)}"
            )
        tolerance = number("Settings", "tolerance", self.tolerance, error=DesignError)
        object.__setattr__(self, "tolerance", tolerance)
        if self.least > self.most_iterations:
            raise DesignError(
                f"Settings: least_iterations = {self.least_iterations} is above "
                f"most_iterations = {self.most_iterations}"
            )
        if self.tolerance < 0.0:
            raise DesignError(f"Settings: tolerance = {self.tolerance} must not be negative")

    @property
    def least(self) -> int:
        """`least_iterations`, or what it is by default."""
        default = min(LEAST, self.most_iterations)
        return default if self.least_iterations is None else self.least_iterations

    @classmethod
    def from_dict(cls, values: Mapping[str, Any]) -> Settings:
        """The settings of which `dataclasses.asdict` makes these values."""
        return cls(**{**values, "stages": tuple(Stage(**stage) for stage in values["stages"])})


Callback = Callable[[Optimisation], None]
HOW = "write Settings(stages), or call what makes them, such as sharpened(time_step)"


def optimise(
    scene: Scene,
    settings: Settings,
    start: NDArray[np.float64] | Sequence[float] | Sequence[NDArray[np.float64]],
    callbacks: Iterable[Callback] | Callback = (),
    checkpointing: Checkpointing | None = None,
) -> Optimisation:
    """Maximise the distance travelled, stage by stage.

    An evaluation that fails steps back to the stage's farthest design and halves the move limit,
    which then recovers slowly. A stage of which no design ran yet takes the best of the one before,
    and if that fails too, halves its time step.

    Parameters
    ----------
    scene : Scene
    settings : Settings
    start : (n,) array, or several
        First design, within [-1, 1], of the first stage's scene (`Problem.join` makes it). Of
        several the best after `Settings.scouting` stages goes on.
    callbacks : iterable of callable, or one
        Called after each evaluation and once at the end.
    checkpointing : Checkpointing, optional

    Raises
    ------
    DesignError
        If `start` does not fit the scene, there is nothing to design, or anything is of another
        kind.
    SceneError
        If a stage cannot be simulated, nothing actuates the body, it is in several pieces, or has
        one particle per cell; all is checked before the first evaluation.
    StorageError
        If checkpoints cannot be stored.
    """
    return go_on(begin(scene, settings, start), callbacks, checkpointing)


def begin(
    scene: Scene,
    settings: Settings,
    start: NDArray[np.float64] | Sequence[float] | Sequence[NDArray[np.float64]],
) -> Optimisation:
    """An optimisation before its first evaluation, for `go_on`; see `optimise`.

    Raises
    ------
    DesignError, SceneError
        As `optimise`.
    """
    instance("optimise", "scene", scene, Scene)
    instance("optimise", "settings", settings, Settings, HOW)
    several = isinstance(start, Iterable) and not isinstance(start, np.ndarray)
    starts: list[Any] = list(start) if several else [start]
    if starts and all(isinstance(value, (int, float, np.number)) for value in starts):
        starts = [starts]
    scenes = [stage.scene(scene) for stage in settings.stages]
    first = Problem(scenes[0])
    designs = [first.join(*first.split(x)) for x in starts]
    if not designs or first.size == 0:
        raise DesignError("there is nothing to design: give a Design or an Actuator, and a start")
    if len(designs) > 1 and settings.scouting == 0:
        raise DesignError(f"{len(designs)} starts need Settings.scouting >= 1, the stages of each")
    return Optimisation(scene, settings, [Leg(k, x) for k, x in enumerate(designs)])


def refuse_unfit(scene: Scene) -> None:
    """Refuse a body that no optimisation makes a robot of, though it can be simulated.

    Raises
    ------
    SceneError
        If nothing actuates it, any stretch tears it, or it is in several pieces.
    """
    if not any(np.any(actuator.stress) for actuator in scene.actuators):
        raise SceneError(
            "optimise: the body has no Actuator with a stress, so it does not go by itself; add one"
        )
    if scene.particles_per_cell == 1:
        raise SceneError(
            "optimise: particles_per_cell = 1 leaves a cell without a particle at any stretch, and "
            "no body that may crack there counts; take 2 or more"
        )
    first, *apart = scene.body
    held = [first]
    for region in held:  # which grows
        held += [other for other in apart if scene.gap(region, other) is None]
        apart = [other for other in apart if other not in held]
    if not apart:
        return
    gap, region, other = min(
        ((scene.gap(a, b) or 0.0, a, b) for a in apart for b in held), key=lambda item: item[0]
    )
    how = f"is {gap:.4g} ({gap / scene.grid.dx:.4g} cells) from" if gap else "only touches"
    raise SceneError(
        f"optimise: the body is in pieces: {region} {how} {other}{'' if gap else ' at a corner'}; "
        "let them share an edge, or put a Design or a Solid between them"
    )


def go_on(
    run: Optimisation,
    callbacks: Iterable[Callback] | Callback = (),
    checkpointing: Checkpointing | None = None,
) -> Optimisation:
    """Go on with an optimisation from where it stands to its end; see `optimise`.

    What a callback saw after an evaluation is all that this needs: from there it takes, bit for
    bit, the way of an optimisation that was never stopped.

    Raises
    ------
    SceneError, StorageError
        As `optimise`.
    DesignError
        If its legs do not fit its settings, or a callback is none.
    """
    instance("go_on", "run", run, Optimisation)
    several = isinstance(callbacks, Iterable) and not callable(callbacks)
    all_callbacks: list[Any] = list(callbacks) if several else [callbacks]  # type: ignore[arg-type]
    for callback in all_callbacks:
        if isinstance(callback, type) or not callable(callback):
            raise DesignError(
                f"callback {shown(callback)} must be a function of the run, or an object that is "
                "called like one, such as ProgressBar()"
            )
    stages = len(run.settings.stages)
    for index, leg in enumerate(run.legs):
        if leg.start != index or not 0 <= leg.stage <= stages:
            raise DesignError(
                f"leg {index} is of start {leg.start}, at stage {leg.stage} of {stages}: the run "
                "was changed, take a copy of it"
            )
    if not run.history:
        refuse_unfit(run.scene)
    climb = _Climb(run, tuple(all_callbacks), checkpointing)
    if run.stop_reason:
        return run
    scouting = run.settings.scouting if len(run.legs) > 1 else 0
    for leg in run.legs:
        if leg.stage < scouting and not leg.gave_up:
            run.leg = leg.start
            climb.stages(leg, scouting)
    run.leg = max(run.legs, key=lambda leg: _merit(run, leg)).start
    leg = run.legs[run.leg]
    climb.stages(leg, stages)
    reached = leg.stage + leg.gave_up
    run.stop_reason = f"Stage {reached} of {stages} was the last: {leg.reason}"
    climb.report()
    return run


def _merit(run: Optimisation, leg: Leg) -> tuple[int, float]:
    """What starts are compared by: the last stage that had a design, and its best."""
    if not leg.best:
        return -1, -np.inf
    item = leg.best[max(leg.best)]
    return item.stage, item.counted if run.settings.stages[item.stage].solid else item.objective


class _Climb:
    """An optimisation on its way through the stages."""

    def __init__(
        self,
        run: Optimisation,
        callbacks: tuple[Callback, ...],
        checkpointing: Checkpointing | None,
    ) -> None:
        self.run, self.callbacks, self.checkpointing = run, callbacks, checkpointing
        self.scenes = [stage.scene(run.scene) for stage in run.settings.stages]
        self.began = time.monotonic() - (run.history[-1].seconds if run.history else 0.0)

    def report(self) -> None:
        for callback in self.callbacks:
            callback(self.run)

    def stages(self, leg: Leg, last: int) -> None:
        """Climb from where a leg stands through the stages before `last`."""
        stages = self.run.settings.stages
        while leg.stage < last and not leg.gave_up:
            stage = _StageRun(self, leg)
            before = leg.stage - 1
            begins = self.run.stage_state is None and before >= 0
            if begins and stage.stage.coarsening != stages[before].coarsening:
                leg.x = stage.problem.transfer(Problem(self.scenes[before]), leg.x)
            leg.x, leg.reason, leg.gave_up = stage.climb()
            self.run.stage_state = None
            logger.info("start %d, stage %d: %s", leg.start, leg.stage, leg.reason)
            leg.stage += not leg.gave_up


def _order(item: Iteration) -> tuple[float, float, float]:
    """What solid designs are compared by."""
    return item.counted, float(np.nan_to_num(item.post_processed, nan=-np.inf)), item.objective


class _StageRun:
    """One stage on its way: from its first design, or from its state after an evaluation."""

    def __init__(self, whole: _Climb, leg: Leg) -> None:
        self.whole, self.run, self.leg = whole, whole.run, leg
        settings = self.run.settings
        self.stage = settings.stages[leg.stage]
        # All lengths are taken in these, so that no unit decides anything.
        self.width = max(self.run.scene.grid.size)
        state = self.run.stage_state
        self._pose(state.time_step if state else None)
        self.mma = MovingAsymptotes(
            -np.ones(self.problem.size),
            np.ones(self.problem.size),
            move_limit=self.stage.move_limit,
            asymptote_initial=0.5 / (self.stage.beta + 1.0) if settings.sharpen_asymptotes else 0.5,
        )
        self.values: list[float] = []
        self.failures = 0
        self.farthest: Candidate | None = None
        self.gradient = self.farthest_gradient = np.empty(0)
        if state:
            self.mma.restore(state.mma)
            self.values, self.failures = state.values.tolist(), state.failures
            self.gradient = state.gradient
            self.farthest, self.farthest_gradient = state.farthest, state.farthest_gradient

    def _pose(self, time_step: float | None) -> None:
        self.problem = self.stage.problem(self.run.scene, time_step, self.whole.checkpointing)

    def state(self) -> StageState:
        """All that the next step depends on."""
        return StageState(
            time_step=self.problem.scene.time_step,
            failures=self.failures,
            values=np.array(self.values),
            gradient=self.gradient,
            farthest=self.farthest,
            farthest_gradient=self.farthest_gradient,
            mma=self.mma.state(),
        )

    def climb(self) -> tuple[NDArray[np.float64], str, bool]:
        """Climb to where the stop rule ends the stage.

        Returns the design that the next stage starts from, why it stopped, and whether to give up.
        """
        if self.run.stage_state is None:
            self._evaluate(self.leg.x)
        while True:
            assert self.run.last is not None
            x, reason = self.run.last.x, self._stop_reason()
            if not reason:
                self._evaluate(self._step(x))
            elif self.failures:
                return x, reason, True
            elif self.farthest is not None and self.run.settings.best_first:
                return self.farthest.x, reason, False
            else:
                return x, reason, False

    def _step(self, x: NDArray[np.float64]) -> NDArray[np.float64]:
        """The design to evaluate after x."""
        mma = self.mma
        if self.failures and self.farthest is None:
            spare = self._best_before()
            if spare is not None and not np.array_equal(spare, x):
                return spare
            scene = self.problem.scene
            logger.warning("no design of this stage ran yet: time step %g halved", scene.time_step)
            self._pose(scene.time_step / 2.0)
            return x
        if self.failures and self.farthest is not None:
            mma.reset()
            mma.move_limit /= 2.0
            return self._move(self.farthest.x, self.farthest.objective, self.farthest_gradient)
        went_back = len(self.values) > 1 and self.values[-1] < self.values[-2]
        factor = SHORTEN if went_back and self.run.settings.adapt_move_limit else LENGTHEN
        mma.move_limit = min(self.stage.move_limit, factor * mma.move_limit)
        return self._move(x, self.values[-1], self.gradient)

    def _move(
        self, x: NDArray[np.float64], value: float, gradient: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """The step of the moving asymptotes from x."""
        return self.mma.step(x, -value / self.width, -gradient / self.width)

    def _best_before(self) -> NDArray[np.float64] | None:
        """The best design of the stage before, on this stage's grid."""
        before = self.run.best.get(self.leg.stage - 1)
        if before is None or before.x.size == self.problem.size:
            return before.x if before else None
        return self.problem.transfer(Problem(self.whole.scenes[before.stage]), before.x)

    def _evaluate(self, x: NDArray[np.float64]) -> None:
        """Value and gradient, recorded, even of a simulation that failed."""
        run = self.run
        value, failure = np.nan, ""
        gradient: NDArray[np.float64] = np.full(x.size, np.nan)
        problem, redone, margins = self.problem, self.problem.redo, Margins(*5 * (np.nan,))
        time_step = problem.scene.time_step / 2.0**redone
        try:
            evaluation = problem.evaluate(x)
            value, gradient = evaluation.value, evaluation.gradient
            redone, margins = evaluation.redone, evaluation.margins
            time_step = evaluation.time_step
        except SimulationError as error:
            failure = str(error)
            logger.warning("evaluation %d failed: %s", len(run.history), error)
        solid = audited = np.nan
        if self.stage.solid and not failure:
            solid = self._without_void(post_processed, problem.at(time_step), x)
            best = run.best.get(self.leg.stage)
            hopeful = solid > (best.counted if best else -np.inf)
            if self.stage.audited and hopeful:
                audited = self._without_void(audit.least, problem.at(time_step), x)
                audited = -np.inf if np.isnan(audited) else audited
        before = run.last.x if run.last else x
        if before.size != x.size:  # another grid
            before = x
        free = np.where(gradient > 0.0, x < 1.0, x > -1.0)
        gamma = self.problem.gamma(x)
        candidate = Candidate(
            start=self.leg.start,
            stage=self.leg.stage,
            beta=self.stage.beta,
            time_step=time_step,
            move_limit=self.mma.move_limit,
            x=x,
            gamma=gamma,
            objective=value,
            greyness=greyness(gamma),
            projected_gradient=float(np.abs(gradient * free).max()),
            step=float(np.abs(x - before).max() / 2.0),
            seconds=time.monotonic() - self.whole.began,
            post_processed=solid,
            audited=audited,
            redone=redone,
            courant=margins.courant,
            spin=margins.spin,
            jacobian=margins.jacobian,
            stretch=margins.stretch,
            energy=margins.energy,
            failure=failure,
        )
        self._record(candidate, gradient)
        self.whole.report()

    def _record(self, candidate: Candidate, gradient: NDArray[np.float64]) -> None:
        run = self.run
        run.first = run.first or candidate
        run.last = candidate
        run.history.append(Iteration(**candidate.numbers()))
        if candidate.failure:
            self.failures += 1
            self.gradient = np.empty(0)
        else:
            self.failures = 0
            self.values.append(candidate.objective)
            self.gradient = gradient
            if self.farthest is None or candidate.objective > self.farthest.objective:
                self.farthest, self.farthest_gradient = candidate, gradient
            if self._is_best(candidate):
                run.best[candidate.stage] = candidate
        run.stage_state = self.state()

    def _is_best(self, item: Candidate) -> bool:
        """Whether it is better than the best of its stage so far."""
        best = self.run.best.get(item.stage)
        if best is None:
            return True
        if not self.stage.solid:
            return item.objective > best.objective
        if self.stage.audited and np.isnan(item.audited):
            return False
        return _order(item) > _order(best)

    def _without_void(
        self,
        distance: Callable[[Problem, NDArray[np.float64]], float],
        problem: Problem,
        x: NDArray[np.float64],
    ) -> float:
        try:
            return distance(problem, x)
        except (SceneError, SimulationError) as error:
            logger.warning("the design fails without void: %s", error)
            return np.nan

    def _stop_reason(self) -> str:
        """Why the stage ends after its last evaluation, or nothing."""
        settings = self.run.settings
        if self.failures:
            none_ran = self.farthest is None
            if self.failures >= settings.most_failures or (none_ran and self.failures > HALVINGS):
                return f"it gave up after {self.failures} failed evaluations in a row."
            return ""
        values, count, window = self.values, len(self.values), settings.window
        if count >= max(settings.least, window + 1):
            change = abs(np.mean(values[-window:]) - np.mean(values[-window - 1 : -1]))
            limit = settings.tolerance * self.width
            if change <= limit:
                last = self.run.history[-1]
                return (
                    f"the mean objective over {window} iterations changed by {change:.1e} <= "
                    f"{limit:.1e} after {count} of them (last step {last.step:.1e} of the range, "
                    f"projected gradient {last.projected_gradient:.1e})."
                )
        if count >= (self.stage.most_iterations or settings.most_iterations):
            return f"it reached its limit of {count} iterations."
        return ""
