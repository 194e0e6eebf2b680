"""Which simulation a scene asks for."""

from __future__ import annotations

from typing import Any

from mpmopt.scene import Scene
from mpmopt.simulation.lagrangian import LagrangianSimulation
from mpmopt.simulation.simulation import Simulation


def simulation_of(scene: Scene, *args: Any, **kwargs: Any) -> Simulation:
    """The `Simulation` of a body in the scene's formulation; its arguments are those of both."""
    kind = LagrangianSimulation if scene.formulation == "total" else Simulation
    return kind(scene, *args, **kwargs)
