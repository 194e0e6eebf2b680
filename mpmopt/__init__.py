"""Topology optimisation of soft bodies that move, with a differentiable material point method."""

from importlib import import_module
from typing import TYPE_CHECKING, Any

__version__ = "0.1.0"

# Public names, and the modules they are imported from when they are first used: ``import mpmopt``
# costs nothing.
_HOMES = {
    "Scene": "mpmopt.scene",
    "Grid": "mpmopt.scene",
    "Material": "mpmopt.scene",
    "Design": "mpmopt.scene",
    "Solid": "mpmopt.scene",
    "Actuator": "mpmopt.scene",
    "Wall": "mpmopt.scene",
    "Ground": "mpmopt.scene",
    "Clamp": "mpmopt.scene",
    "Mirror": "mpmopt.scene",
    "SILICONES": "mpmopt.scene",
    "Problem": "mpmopt.design.problem",
    "Task": "mpmopt.design.task",
    "AtMost": "mpmopt.design.task",
    "Frozen": "mpmopt.design.variables",
    "Bounded": "mpmopt.design.variables",
    "Tied": "mpmopt.design.variables",
    "Displacement": "mpmopt.design.terms",
    "Speed": "mpmopt.design.terms",
    "Height": "mpmopt.design.places",
    "PeakHeight": "mpmopt.design.places",
    "Distance": "mpmopt.design.places",
    "Driven": "mpmopt.design.driven",
    "Effort": "mpmopt.design.terms",
    "Volume": "mpmopt.design.terms",
    "OnePiece": "mpmopt.design.one_piece",
    "Variation": "mpmopt.design.variation",
    "Settings": "mpmopt.optimisation.settings",
    "Stage": "mpmopt.optimisation.settings",
    "optimise": "mpmopt.optimisation.loop",
    "minimize": "mpmopt.optimisation.minimize",
    "read_run": "mpmopt.results.runfile",
    "cheapest": "mpmopt.assess.discretisation",
    "sweep": "mpmopt.app.sweeps",
}

if TYPE_CHECKING:
    from mpmopt.app.sweeps import sweep as sweep
    from mpmopt.assess.discretisation import cheapest as cheapest
    from mpmopt.design.driven import Driven as Driven
    from mpmopt.design.one_piece import OnePiece as OnePiece
    from mpmopt.design.places import Distance as Distance
    from mpmopt.design.places import Height as Height
    from mpmopt.design.places import PeakHeight as PeakHeight
    from mpmopt.design.problem import Problem as Problem
    from mpmopt.design.task import AtMost as AtMost
    from mpmopt.design.task import Task as Task
    from mpmopt.design.terms import Displacement as Displacement
    from mpmopt.design.terms import Effort as Effort
    from mpmopt.design.terms import Speed as Speed
    from mpmopt.design.terms import Volume as Volume
    from mpmopt.design.variables import Bounded as Bounded
    from mpmopt.design.variables import Frozen as Frozen
    from mpmopt.design.variables import Tied as Tied
    from mpmopt.design.variation import Variation as Variation
    from mpmopt.optimisation.loop import optimise as optimise
    from mpmopt.optimisation.minimize import minimize as minimize
    from mpmopt.optimisation.settings import Settings as Settings
    from mpmopt.optimisation.settings import Stage as Stage
    from mpmopt.results.runfile import read_run as read_run
    from mpmopt.scene import SILICONES as SILICONES
    from mpmopt.scene import Actuator as Actuator
    from mpmopt.scene import Clamp as Clamp
    from mpmopt.scene import Design as Design
    from mpmopt.scene import Grid as Grid
    from mpmopt.scene import Ground as Ground
    from mpmopt.scene import Material as Material
    from mpmopt.scene import Mirror as Mirror
    from mpmopt.scene import Scene as Scene
    from mpmopt.scene import Solid as Solid
    from mpmopt.scene import Wall as Wall
else:
    __all__ = [*_HOMES]

    def __getattr__(name: str) -> Any:
        if name in _HOMES:
            return getattr(import_module(_HOMES[name]), name)
        raise AttributeError(f"module 'mpmopt' has no attribute {name!r}")

    def __dir__() -> list[str]:
        return sorted([*globals(), *_HOMES])
