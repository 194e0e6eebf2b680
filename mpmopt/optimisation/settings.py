"""How to optimise: stages of a continuation, and what ends them."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import Any

from mpmopt.design.problem import Problem
from mpmopt.design.step_control import LIMITS
from mpmopt.design.task import DEFAULT_TASK, Task
from mpmopt.errors import DesignError
from mpmopt.scene import Scene
from mpmopt.scene.parts import Checked
from mpmopt.scene.scene import Formulation
from mpmopt.simulation.checkpoints import Checkpointing
from mpmopt.validation import count, flag, number, share, shown

# Successful evaluations of a stage before the stop rule may end it.
LEAST = 20
# Density and stiffness of void, over those of solid. In the updated formulation void is torn and
# flung when it is lighter; in the total Lagrangian it may be light.
FLOORS: Mapping[Formulation, tuple[float, float]] = {"updated": (1e-2, 1e-3), "total": (2e-3, 2e-4)}


def _take(owner: Any, check: Callable[..., Any], names: str, **limits: float) -> None:
    """Check fields, and set them to what the check makes of them; what may be None may stay so."""
    for name in names.split():
        value, optional = getattr(owner, name), getattr(type(owner), name, 0) is None
        if value is not None or not optional:
            value = check(type(owner).__name__, name, value, error=DesignError, **limits)
        object.__setattr__(owner, name, value)


@dataclass(frozen=True)
class Stage(Checked):
    """What one stage of the continuation holds fixed.

    Attributes
    ----------
    beta : float
        Sharpness of the projection.
    void_density, void_stiffness : float, optional
        Share of mass and stiffness that void keeps; default: `FLOORS` of the scene's formulation.
    time_step : float, optional
        Default: the scene's.
    solid : bool
        Whether the best design is the one that goes farthest once its void is removed
        (`threshold.post_processed`), which costs a forward run more, instead of as it is. The
        ascent goes on from the one that goes farthest as it is.
    refined : bool
        Whether such a design counts with the least of this and of the same with half the step and
        with cells half as wide (`refinement.least`), so that the best is one that keeps its gain.
        This costs four gradients more for each design that goes farther than the best so far.
    move_limit : float
        Greatest step of a variable, as a fraction of its range.
    void_cutoff : float
        Design particles whose gamma is below this are not simulated (`Problem`).
    most_iterations : int, optional
        Successful evaluations of this stage, instead of `Settings.most_iterations`.
    halvings : int
        How often an evaluation is made again with half the time step (`Problem`).
    limited : bool
        Whether an evaluation that goes beyond `step_control.LIMITS` is rejected too, or only one
        that fails.
    subpixel : bool
        Whether edges of the design are at least as wide as a particle, however large beta is
        (`projection.project_subpixel`); with a large one, such as 100, the rest is black and white.
    disturbed : int, optional
        Begin at the run's start with the `starts.random_start` of this seed added to its phi,
        instead of where the stage before ended. Not for the first stage.

    Raises
    ------
    DesignError
        If a number makes no sense.
    """

    beta: float
    void_density: float | None = None
    void_stiffness: float | None = None
    time_step: float | None = None
    solid: bool = False
    refined: bool = False
    move_limit: float = 0.05
    void_cutoff: float = 0.0
    most_iterations: int | None = None
    halvings: int = 2
    limited: bool = True
    subpixel: bool = False
    disturbed: int | None = None

    def __post_init__(self) -> None:
        _take(self, number, "beta void_density void_stiffness time_step move_limit", above=0.0)
        for name in ("void_density", "void_stiffness", "move_limit"):
            value = getattr(self, name)
            if value is not None and value > 1.0:
                raise DesignError(f"Stage: {name} = {value} must be at most 1")
        _take(self, share, "void_cutoff")
        _take(self, flag, "solid refined limited subpixel")
        if self.refined and not self.solid:
            raise DesignError("Stage: refined = True needs solid = True")
        _take(self, count, "most_iterations", least=1)
        _take(self, count, "halvings disturbed", least=0)

    def scene(self, scene: Scene) -> Scene:
        """The scene as this stage simulates it."""
        density, stiffness = FLOORS[scene.formulation]
        return scene.vary(
            time_step=self.time_step,
            void_density=density if self.void_density is None else self.void_density,
            void_stiffness=stiffness if self.void_stiffness is None else self.void_stiffness,
        )

    def problem(
        self,
        scene: Scene,
        time_step: float | None = None,
        checkpointing: Checkpointing | None = None,
        task: Task = DEFAULT_TASK,
    ) -> Problem:
        """The problem that this stage solves, in another time step if it ended with one."""
        stage = self if time_step is None else dataclasses.replace(self, time_step=time_step)
        return Problem(
            stage.scene(scene),
            self.beta,
            checkpointing,
            self.void_cutoff,
            self.halvings,
            LIMITS if self.limited else None,
            task=task,
            subpixel=self.subpixel,
        )


# A short continuation for any scene; the last stage counts designs without their void.
STAGES = (Stage(1.0), Stage(4.0), Stage(16.0, solid=True, void_cutoff=0.05))


@dataclass(frozen=True)
class Settings(Checked):
    """How to optimise.

    Attributes
    ----------
    stages : tuple of Stage, optional
        Or a single one; default: `STAGES`.
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

    Raises
    ------
    DesignError
        If there is no stage, the first is disturbed, or a number makes no sense.
    """

    stages: tuple[Stage, ...] = STAGES
    adapt_move_limit: bool = True
    sharpen_asymptotes: bool = True
    best_first: bool = True
    window: int = 10
    tolerance: float = 2e-4
    least_iterations: int | None = None
    most_iterations: int = 200
    most_failures: int = 8

    def __post_init__(self) -> None:
        given: Any = self.stages
        stages = tuple(given) if isinstance(given, Iterable) else (given,)
        if not stages or not all(isinstance(stage, Stage) for stage in stages):
            raise DesignError(f"Settings: stages = {shown(given)} must be Stages, at least one")
        if stages[0].disturbed is not None:
            raise DesignError(
                "Settings: the first stage begins at the start, not at a disturbed one"
            )
        object.__setattr__(self, "stages", stages)
        _take(self, flag, "adapt_move_limit sharpen_asymptotes best_first")
        _take(self, count, "window least_iterations most_iterations most_failures", least=1)
        _take(self, number, "tolerance")
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


DEFAULT_SETTINGS = Settings()
