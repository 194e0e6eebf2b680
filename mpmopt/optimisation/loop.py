"""From a grey block to a robot: stages of moving asymptotes, each sharper than the last."""

from __future__ import annotations

import logging
import sys
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mpmopt.assess import refinement
from mpmopt.assess.threshold import post_processed
from mpmopt.design.chain import non_discreteness
from mpmopt.design.ensemble import meanwhile
from mpmopt.design.problem import Problem
from mpmopt.design.task import DEFAULT_TASK, Task
from mpmopt.design.variables import START, Freedom, completed
from mpmopt.errors import DesignError, SceneError, SimulationError
from mpmopt.optimisation.history import Candidate, Iteration, Optimisation, StageState
from mpmopt.optimisation.mma import MovingAsymptotes
from mpmopt.optimisation.settings import DEFAULT_SETTINGS, Settings
from mpmopt.optimisation.starts import disturbed
from mpmopt.scene import Scene
from mpmopt.simulation.checkpoints import Checkpointing
from mpmopt.simulation.indicators import Indicators
from mpmopt.validation import instance, shown

logger = logging.getLogger(__name__)

# Factors on the move limit after a step that went back, and after one that went on.
SHORTEN, LENGTHEN = 0.6, 1.2
# How often a stage of which no design runs halves its time step before the run gives up.
HALVINGS = 3


Callback = Callable[[Optimisation], None]
HOW = "write Settings(most_iterations=25), or call what makes them, such as continuation()"


def optimise(
    scene: Scene,
    settings: Settings = DEFAULT_SETTINGS,
    start: NDArray[np.float64] | Sequence[float] | Mapping[str, Any] = START,
    callbacks: Iterable[Callback] | Callback = (),
    checkpointing: Checkpointing | None = None,
    task: Task = DEFAULT_TASK,
) -> Optimisation:
    """Maximise a task's objective subject to its constraints, stage by stage.

    In a notebook a bar shows how far it is, and a picture below it the best design so far.

    An evaluation that fails steps back to the stage's incumbent and halves the move limit, which
    then recovers slowly. A stage of which no design ran yet takes the best of the one before, and
    if that fails too, halves its time step. A design that meets all constraints is better than any
    that does not.

    Parameters
    ----------
    scene : Scene
    settings : Settings, optional
        Default: up to 200 iterations of each of `settings.STAGES`.
    start : mapping or (n,) array, optional
        First design, within [-1, 1]: what `Problem.join` takes, by name, such as
        ``{"phi": picture}``, the rest as in `variables.START`; or the vector that it makes for the
        first stage's scene.
    callbacks : iterable of callable, or one
        Called after each evaluation and once at the end.
    checkpointing : Checkpointing, optional
    task : Task, optional
        Default: the displacement, without constraints.

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
    return go_on(begin(scene, settings, start, task), callbacks, checkpointing)


def begin(scene: Scene, settings: Settings, start: Any, task: Task = DEFAULT_TASK) -> Optimisation:
    """An optimisation before its first evaluation, for `go_on`; see `optimise`.

    Raises
    ------
    DesignError, SceneError
        As `optimise`.
    """
    instance("optimise", "scene", scene, Scene)
    instance("optimise", "settings", settings, Settings, HOW)
    scenes = [stage.scene(scene) for stage in settings.stages]
    first = Problem(scenes[0], task=task)
    if first.size == 0:
        raise DesignError("there is nothing to design: give a Design or an Actuator")
    check_body_fits(scene)
    if isinstance(start, Mapping):
        start = first.join(**completed("optimise", start))
    freedom = Freedom(scene, first.size, task.variables)
    if freedom.lower.size == 0:
        raise DesignError("there is nothing to design: the task's variables leave none free")
    return Optimisation(scene, settings, task, freedom.started(first.join(*first.split(start))))


def check_body_fits(scene: Scene) -> None:
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
        If its stage does not fit its settings, or a callback is none.
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
    stages = run.settings.stages
    if not 0 <= run.stage <= len(stages):
        raise DesignError(
            f"the run is at stage {run.stage} of {len(stages)}: it was changed, take a copy of it"
        )
    if run.stop_reason:
        return run
    if "ipykernel" in sys.modules:  # in a notebook
        from mpmopt.view.live import watched

        all_callbacks = watched(all_callbacks)
    began = time.monotonic() - (run.history[-1].seconds if run.history else 0.0)

    def report() -> None:
        for callback in all_callbacks:
            callback(run)

    while run.stage < len(stages) and not run.gave_up:
        ascent = _Ascent(run, report, checkpointing, began)
        run.x, run.reason, run.gave_up = ascent.to_end()
        run.stage_state = None
        logger.info("stage %d: %s", run.stage, run.reason)
        if any(stage.disturbed is not None for stage in stages[run.stage + 1 : run.stage + 2]):
            run.gave_up = False  # the next one begins anew
        run.stage += not run.gave_up
    reached = run.stage + run.gave_up
    run.stop_reason = f"Stage {reached} of {len(stages)} was the last: {run.reason}"
    if run.missed:
        text = f" No design met all constraints: the best breaks {'; '.join(run.missed)}."
        logger.warning(text.strip())
        run.stop_reason += text
    report()
    return run


def _rank(item: Iteration) -> tuple[float, float]:
    """What designs are compared by as they are: first whether they meet the constraints."""
    return -item.violation, item.objective


def _order(item: Iteration) -> tuple[float, float, float, float]:
    """What solid designs are compared by."""
    return (
        -item.violation,
        item.counted,
        float(np.nan_to_num(item.post_processed, nan=-np.inf)),
        item.objective,
    )


class _Ascent:
    """The ascent of one stage: from its first design, or from its state after an evaluation."""

    def __init__(
        self,
        run: Optimisation,
        report: Callable[[], None],
        checkpointing: Checkpointing | None,
        began: float,
    ) -> None:
        self.run, self.report = run, report
        self.checkpointing, self.began = checkpointing, began
        settings = run.settings
        self.stage = settings.stages[run.stage]
        # All lengths are taken in these, so that no unit decides anything.
        self.width = max(self.run.scene.grid.size)
        state = self.run.stage_state
        self._pose(state.time_step if state else None)
        self.freedom = Freedom(self.run.scene, self.problem.size, run.task.variables)
        self.mma = MovingAsymptotes(
            self.freedom.lower,
            self.freedom.upper,
            move_limit=self.stage.move_limit,
            asymptote_initial=0.5 / (self.stage.beta + 1.0) if settings.sharpen_asymptotes else 0.5,
        )
        self.values: list[float] = []
        self.failures = 0
        self.incumbent: Candidate | None = None
        self.gradients = self.incumbent_gradients = np.empty((0, 0))
        self.multipliers = len(run.task.subject_to) * (0.0,)
        if state:
            self.mma.restore(state.mma)
            self.values, self.failures = state.values.tolist(), state.failures
            self.gradients = state.gradients
            self.incumbent, self.incumbent_gradients = state.incumbent, state.incumbent_gradients

    def _pose(self, time_step: float | None) -> None:
        self.problem = self.stage.problem(
            self.run.scene, time_step, self.checkpointing, self.run.task
        )

    def state(self) -> StageState:
        """All that the next step depends on."""
        return StageState(
            time_step=self.problem.scene.time_step,
            failures=self.failures,
            values=np.array(self.values),
            gradients=self.gradients,
            incumbent=self.incumbent,
            incumbent_gradients=self.incumbent_gradients,
            mma=self.mma.state(),
        )

    def to_end(self) -> tuple[NDArray[np.float64], str, bool]:
        """Go to where the stop rule ends the stage.

        Returns the design that the next stage starts from, why it stopped, and whether to give up.
        """
        if self.run.stage_state is None:
            self._evaluate(self._first())
        while True:
            assert self.run.last is not None
            x, reason = self.run.last.x, self._stop_reason()
            if not reason:
                self._evaluate(self._step(x))
            elif self.failures:
                return x, reason, True
            elif self.incumbent is not None and self.run.settings.best_first:
                return self.incumbent.x, reason, False
            else:
                return x, reason, False

    def _first(self) -> NDArray[np.float64]:
        """The design that the stage begins with."""
        run, seed, problem, freedom = self.run, self.stage.disturbed, self.problem, self.freedom
        if seed is None:
            return run.x
        assert run.first is not None  # no first stage is disturbed
        start = run.first.x
        named = problem.split(start)
        phi = disturbed(named.phi, run.scene, seed)
        x = freedom.started(problem.join(**{**named._asdict(), "phi": phi}))
        return freedom.whole(start, freedom.reduced(x))

    def _step(self, x: NDArray[np.float64]) -> NDArray[np.float64]:
        """The design to evaluate after x."""
        mma = self.mma
        if self.failures and self.incumbent is None:
            spare = self._best_before() if self.stage.disturbed is None else None
            if spare is not None and not np.array_equal(spare, x):
                return spare
            scene = self.problem.scene
            logger.info("no design of this stage ran yet: time step %g halved", scene.time_step)
            self._pose(scene.time_step / 2.0)
            return x
        if self.failures and self.incumbent is not None:
            mma.reset()
            mma.move_limit /= 2.0
            return self._move(self.incumbent, self.incumbent_gradients)
        factor = SHORTEN if self._went_back() and self.run.settings.adapt_move_limit else LENGTHEN
        mma.move_limit = min(self.stage.move_limit, factor * mma.move_limit)
        assert self.run.last is not None
        return self._move(self.run.last, self.gradients)

    def _went_back(self) -> bool:
        """Whether the last one that ran is worse than the one before."""
        done = [i for i in self.run.history if i.stage == self.run.stage and not i.failure][-2:]
        return len(done) == 2 and _rank(done[1]) < _rank(done[0])

    def _move(self, item: Candidate, gradients: NDArray[np.float64]) -> NDArray[np.float64]:
        """The step of the moving asymptotes from a design."""
        x, gradients = self.freedom.reduced(item.x), self.freedom.pullback(gradients)
        f, dfdx = -item.objective / self.width, -gradients[0] / self.width
        constraints = self.run.task.subject_to
        self.mma.forget_gradients()
        if not constraints:
            return self.freedom.whole(item.x, self.mma.step(x, f, dfdx))
        scale = np.array([constraint.scale for constraint in constraints])
        g = [constraint.g(value) for constraint, value in zip(constraints, item.constraints)]
        x = self.mma.step(x, f, dfdx, g, gradients[1:] / scale[:, None])
        self.multipliers = tuple((self.mma.multipliers * self.width / scale).tolist())
        return self.freedom.whole(item.x, x)

    def _best_before(self) -> NDArray[np.float64] | None:
        """The best design of the stage before."""
        before = self.run.best.get(self.run.stage - 1)
        return before.x if before else None

    def _evaluate(self, x: NDArray[np.float64]) -> None:
        """Value and gradient, recorded, even of a simulation that failed."""
        run = self.run
        value, failure, violation = np.nan, "", np.nan
        scenes = len(run.task.scenes) * (np.nan,)
        constraints = np.full(len(run.task.subject_to), np.nan)
        gradients: NDArray[np.float64] = np.full((1, x.size), np.nan)
        problem, halved = self.problem, self.problem.halvings
        indicators = Indicators(*len(Indicators._fields) * (np.nan,))
        time_step = problem.scene.time_step / 2.0**halved
        gamma = problem.gamma(x)  # once, before two threads ask for it
        try:
            evaluation, given = meanwhile(
                lambda: problem.evaluate(x),
                lambda: self._solid(problem.scene.time_step, x),  # which most evaluations end with
            )
            value, constraints = evaluation.value, evaluation.constraints
            scenes = evaluation.scenes
            gradients = evaluation.gradients
            violation = run.task.violation(constraints)
            halved, indicators = evaluation.halved, evaluation.indicators
            time_step = evaluation.time_step
        except SimulationError as error:
            failure = str(error)
            logger.info("evaluation %d failed: %s", len(run.history), error)
        solid = refined = np.nan
        if self.stage.solid and not failure:
            solid = self._solid(time_step, x) if halved else given()
            best = run.best.get(run.stage)
            least = (-best.violation, best.counted) if best else (-np.inf, -np.inf)
            hopeful = (-violation, solid) > least
            if self.stage.refined and hopeful:
                refined = self._without_void(refinement.least, problem.at(time_step), x)
                refined = -np.inf if np.isnan(refined) else refined
        before = run.last.x if run.last else x
        slope, free = self.freedom.pullback(gradients[0]), self.freedom.reduced(x)
        movable = np.where(slope > 0.0, free < self.freedom.upper, free > self.freedom.lower)
        candidate = Candidate(
            stage=run.stage,
            beta=self.stage.beta,
            time_step=time_step,
            move_limit=self.mma.move_limit,
            x=x,
            gamma=gamma,
            objective=value,
            non_discreteness=non_discreteness(gamma),
            projected_gradient=float(np.abs(slope * movable).max()),
            step=float(np.abs(x - before).max() / 2.0),
            seconds=time.monotonic() - self.began,
            post_processed=solid,
            refined=refined,
            halved=halved,
            courant=indicators.courant,
            velocity_increment=indicators.velocity_increment,
            jacobian=indicators.jacobian,
            stretch=indicators.stretch,
            energy=indicators.energy,
            gap=indicators.gap,
            violation=violation,
            constraints=tuple(constraints.tolist()),
            scenes=scenes,
            multipliers=self.multipliers,
            failure=failure,
        )
        self._record(candidate, gradients)
        self.report()

    def _record(self, candidate: Candidate, gradients: NDArray[np.float64]) -> None:
        run = self.run
        run.first = run.first or candidate
        run.last = candidate
        run.history.append(Iteration(**candidate.numbers()))
        run.designs.append(np.rint(255.0 * candidate.gamma).astype(np.uint8))
        if candidate.failure:
            self.failures += 1
            self.gradients = np.empty((0, 0))
        else:
            self.failures = 0
            self.values.append(candidate.objective)
            self.gradients = gradients
            if self.incumbent is None or _rank(candidate) > _rank(self.incumbent):
                self.incumbent, self.incumbent_gradients = candidate, gradients
            if self._is_best(candidate):
                run.best[candidate.stage] = candidate
        run.stage_state = self.state()

    def _is_best(self, item: Candidate) -> bool:
        """Whether it is better than the best of its stage so far."""
        best = self.run.best.get(item.stage)
        if best is None:
            return True
        if not self.stage.solid:
            return _rank(item) > _rank(best)
        if self.stage.refined and np.isnan(item.refined):
            return False
        return _order(item) > _order(best)

    def _solid(self, time_step: float, x: NDArray[np.float64]) -> float:
        """L without void in a time step; not a number if the stage does not ask, or it failed."""
        if not self.stage.solid:
            return np.nan
        return self._without_void(post_processed, self.problem.at(time_step), x)

    def _without_void(
        self,
        distance: Callable[[Problem, NDArray[np.float64]], float],
        problem: Problem,
        x: NDArray[np.float64],
    ) -> float:
        try:
            return distance(problem, x)
        except (SceneError, SimulationError) as error:
            logger.info("the design fails without void: %s", error)
            return np.nan

    def _stop_reason(self) -> str:
        """Why the stage ends after its last evaluation, or nothing."""
        settings = self.run.settings
        if self.failures:
            none_ran = self.incumbent is None
            if self.failures >= settings.most_failures or (none_ran and self.failures > HALVINGS):
                return f"it gave up after {self.failures} failed evaluations in a row."
            return ""
        values, count, window = self.values, len(self.values), settings.window
        if count >= max(settings.least, window + 1):
            change = abs(np.mean(values[-window:]) - np.mean(values[-window - 1 : -1]))
            limit = settings.tolerance * self.width
            if change <= limit and not self.run.history[-1].violation:
                last = self.run.history[-1]
                return (
                    f"the mean objective over {window} iterations changed by {change:.1e} <= "
                    f"{limit:.1e} after {count} of them (last step {last.step:.1e} of the range, "
                    f"projected gradient {last.projected_gradient:.1e})."
                )
        if count >= (self.stage.most_iterations or settings.most_iterations):
            return f"it reached its limit of {count} iterations."
        return ""
