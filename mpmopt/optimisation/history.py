"""An optimisation as it stands: its evaluations, its best designs, and what it needs to go on."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mpmopt.design.objective import Objective
from mpmopt.design.problem import Problem
from mpmopt.design.task import FEASIBLE, Task
from mpmopt.design.terms import Displacement
from mpmopt.errors import DesignError
from mpmopt.optimisation.settings import Settings
from mpmopt.scene import Scene
from mpmopt.scene.particles import discretise, own
from mpmopt.validation import digits


@dataclass(frozen=True, kw_only=True)
class Iteration:
    """One evaluation, in numbers.

    Attributes
    ----------
    stage : int
        Index of the stage.
    beta, move_limit : float
        In force during the evaluation.
    time_step : float
        That the values are of; of the last attempt if it failed.
    objective : float
        L, or not a number if the evaluation failed.
    non_discreteness : float
        Mean of 4 gamma (1 - gamma).
    projected_gradient : float
        Greatest change of L per unit of x that the bounds leave free.
    step : float
        Greatest change of a variable since the last evaluation, as a fraction of its range.
    seconds : float
        Since the optimisation began, without the time between a stop and going on.
    post_processed : float
        L without void, or not a number if the stage does not ask for it or it failed.
    refined : float
        L without void with half the step or cells half as wide, whichever is less; not a number if
        the stage does not ask for it or the design could not be its best anyway, minus infinity if
        it failed.
    halved : int
        How often the stage's time step was halved for this evaluation.
    courant, velocity_increment, jacobian, stretch, energy, gap : float
        Its `indicators.Indicators`, or not a number if it failed.
    violation : float
        By how much it misses the constraint that it misses most, in that one's scale; 0 if it meets
        all (`task.FEASIBLE`), or not a number if it failed.
    constraints : tuple of float
        Values of the constraints' terms, in the task's order.
    scenes : tuple of float
        L in each scene of the task; empty if it has one.
    multipliers : tuple of float
        By how much L rises with each bound, as the step that led here took it; zeros for the first.
    failure : str
        Why the evaluation failed, or empty.
    """

    stage: int
    beta: float
    time_step: float
    move_limit: float
    objective: float
    non_discreteness: float
    projected_gradient: float
    step: float
    seconds: float
    post_processed: float = np.nan
    refined: float = np.nan
    halved: int = 0
    courant: float = np.nan
    velocity_increment: float = np.nan
    jacobian: float = np.nan
    stretch: float = np.nan
    energy: float = np.nan
    gap: float = np.nan
    violation: float = 0.0
    constraints: tuple[float, ...] = ()
    scenes: tuple[float, ...] = ()
    multipliers: tuple[float, ...] = ()
    failure: str = ""

    @property
    def counted(self) -> float:
        """L without void, the least that was found; minus infinity if there is none."""
        least = float(np.fmin(self.post_processed, self.refined))
        return -np.inf if np.isnan(least) else least

    def numbers(self) -> dict[str, Any]:
        """The fields above by name, without the design of a `Candidate`."""
        return {item.name: getattr(self, item.name) for item in dataclasses.fields(Iteration)}


@dataclass(frozen=True, kw_only=True)
class Candidate(Iteration):
    """An evaluation with the design that was evaluated.

    Attributes
    ----------
    x : (n,) array
        Design variables.
    gamma : (D,) array
        Their material density.
    """

    x: NDArray[np.float64]
    gamma: NDArray[np.float64]

    def __post_init__(self) -> None:
        own(self, "x", "gamma")


@dataclass(frozen=True)
class StageState:
    """A stage just after an evaluation: all that its next step depends on.

    Attributes
    ----------
    time_step : float
    failures : int
        Failed evaluations in a row.
    values : (k,) array
        Objectives of those that succeeded.
    gradients : (1 + m, n) array
        Of objective and constraints at the last evaluation, empty if it failed.
    incumbent : Candidate or None
        The one with the largest objective of those that meet the constraints best.
    incumbent_gradients : (1 + m, n) array
        Its gradients, empty if there is none.
    mma : mapping of str to array or number
        `MovingAsymptotes.state` before the step.
    """

    time_step: float
    failures: int
    values: NDArray[np.float64]
    gradients: NDArray[np.float64]
    incumbent: Candidate | None
    incumbent_gradients: NDArray[np.float64]
    mma: Mapping[str, Any]

    def __post_init__(self) -> None:
        own(self, "values", "gradients", "incumbent_gradients")


@dataclass(repr=False)
class Optimisation:
    """An optimisation as it stands: what `optimise` hands to callbacks and returns.

    Attributes
    ----------
    scene : Scene
    settings : Settings
    task : Task
    x : (n,) array
        The design that its stage began with.
    stage : int
        The stage that it is in, or after the last.
    reason : str
        Why its last stage ended; empty before.
    gave_up : bool
        Whether that stage failed.
    best : dict of int to Candidate
        The best evaluation of each stage that had one.
    history : list of Iteration
        All evaluations.
    designs : list of (D,) arrays of bytes
        Their designs, for pictures: 255 gamma, rounded.
    first, last : Candidate or None
        The first and the last evaluation.
    stage_state : StageState or None
        Of the stage that is under way, after its last evaluation.
    stop_reason : str
        A sentence; empty while it runs.
    """

    scene: Scene
    settings: Settings
    task: Task
    x: NDArray[np.float64]
    stage: int = 0
    reason: str = ""
    gave_up: bool = False
    best: dict[int, Candidate] = field(default_factory=dict)
    history: list[Iteration] = field(default_factory=list)
    designs: list[NDArray[np.uint8]] = field(default_factory=list)
    first: Candidate | None = None
    last: Candidate | None = None
    stage_state: StageState | None = None
    stop_reason: str = ""

    @property
    def result(self) -> Candidate:
        """The best evaluation.

        That is, of the best of each stage, the one that goes farthest without void, but one of a
        refined stage comes before the rest, however far those go; without void none may count, then
        it is that of the last stage. Those that meet the constraints come first.

        Raises
        ------
        DesignError
            If no evaluation succeeded.
        """
        if not self.best:
            last = f"; the last: {self.history[-1].failure}" if self.history else ""
            raise DesignError(f"there is no design: no evaluation succeeded yet{last}")
        stages = self.settings.stages

        def merit(item: Candidate) -> tuple[float, bool, float, int]:
            refined = stages[item.stage].refined and np.isfinite(item.counted)
            return -item.violation, bool(refined), item.counted, item.stage

        return max(self.best.values(), key=merit)

    def problem(self) -> Problem:
        """The problem that `result` solves, in the time step that it was evaluated with."""
        best = self.result
        return self.settings.stages[best.stage].problem(self.scene, best.time_step, task=self.task)

    @property
    def chosen(self) -> int:
        """Number, from 1, of the evaluation that `result` is of."""
        return self.number_of(self.result)

    def number_of(self, item: Candidate) -> int:
        """Number, from 1, of the evaluation that a design is of: no two are of the same time."""
        return 1 + next(k for k, each in enumerate(self.history) if each.seconds == item.seconds)

    @property
    def missed(self) -> list[str]:
        """The constraints that the best design breaks, with their values; none without a design."""
        pairs = zip(self.task.subject_to, self.result.constraints) if self.best else ()
        return [f"{each}, is {value:.4g}" for each, value in pairs if each.g(value) > FEASIBLE]

    @property
    def measure(self) -> str:
        """What the objective is called: that of the paper is a displacement, from `origin` on."""
        return "displacement" if isinstance(self.task.maximise, Displacement) else "objective"

    @property
    def origin(self) -> float:
        """The objective of a body that stays put, if it is a displacement; else 0."""
        term = self.task.maximise
        if not isinstance(term, Displacement):
            return 0.0
        particles = discretise(self.scene)
        return Objective.of(self.scene, particles, term.direction, term.region).start

    def __repr__(self) -> str:
        found, stages = "no design yet", self.settings.stages
        if self.best:
            best = self.result
            found = (
                f"best L = {digits(best.objective)} at stage {best.stage + 1} of {len(stages)}, "
                f"beta {best.beta:g}"
            )
        return (
            f"Run of {len(self.history)} evaluations, {self.failed_evaluations} failed: {found}. "
            f"{self.stop_reason or 'Not finished.'}"
        )

    def _repr_png_(self) -> bytes | None:
        """A picture for notebooks, once there is a design."""
        if not self.best:
            return None
        from mpmopt.view import draw, plot

        return draw.png(plot.overview(self), dpi=80)

    @property
    def failed_evaluations(self) -> int:
        """Number of evaluations that failed."""
        return sum(bool(iteration.failure) for iteration in self.history)

    @property
    def halved_evaluations(self) -> int:
        """Number of evaluations that were repeated with a shorter time step."""
        return sum(iteration.halved > 0 for iteration in self.history)
