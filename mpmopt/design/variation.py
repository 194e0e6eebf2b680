"""What one scene of an ensemble has otherwise: what nobody knows of the world outside."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any, Literal

from mpmopt.errors import DesignError
from mpmopt.scene import Actuator, Grid, Ground, Material, Scene
from mpmopt.scene.ground import Layer
from mpmopt.scene.parts import Checked
from mpmopt.scene.scene import Formulation
from mpmopt.validation import count, instance, number


@dataclass(frozen=True)
class Variation(Checked):
    """A scene of an ensemble, by what differs from the scene of the optimisation.

    Parameters
    ----------
    ground : tuple of Ground, optional
        Instead of the scene's.
    friction : float or "stick", optional
        Of all ground, instead of its own.
    thickness : float, optional
        Factor on that of the contact layers, which bear the same pressure: softer ground. Its
        points move away by what is added, along gravity.
    strength : float, optional
        Factor on the actuators' stresses.
    viscosity : float, optional
        Factor on that of all materials.
    threshold : float, optional
        Of the projection, between 0 and 1: above 1/2 the design is eroded, below it dilated (Wang,
        Lazarov and Sigmund, 2011).
    refinement : int, optional
        How many cells take the place of one along each axis (`refined`).
    formulation : {"updated", "total"}, optional
        Instead of the scene's.

    Raises
    ------
    DesignError
        If a number makes no sense.
    """

    ground: tuple[Ground, ...] | None = None
    friction: float | Literal["stick"] | None = None
    thickness: float = 1.0
    strength: float = 1.0
    viscosity: float = 1.0
    threshold: float = 0.5
    refinement: int = 1
    formulation: Formulation | None = None

    def __post_init__(self) -> None:
        if self.ground is not None:
            given: Any = self.ground
            grounds = tuple(given) if isinstance(given, Iterable) else (given,)
            for ground in grounds:
                instance("Variation", "ground", ground, Ground)
            self._set(ground=grounds)
        for name in ("thickness", "strength"):
            value = number("Variation", name, getattr(self, name), above=0.0, error=DesignError)
            self._set(**{name: value})
        viscosity = number("Variation", "viscosity", self.viscosity, error=DesignError)
        threshold = number("Variation", "threshold", self.threshold, error=DesignError)
        if viscosity < 0.0:
            raise DesignError(f"Variation: viscosity = {viscosity:g} must not be negative")
        if not 0.0 < threshold < 1.0:
            raise DesignError(f"Variation: threshold = {threshold:g} must be between 0 and 1")
        refinement = count("Variation", "refinement", self.refinement, 1, error=DesignError)
        self._set(viscosity=viscosity, threshold=threshold, refinement=refinement)

    def __str__(self) -> str:
        differs = (
            f"{item.name} {value:g}" if isinstance(value, float) else f"{item.name} {value}"
            for item in dataclasses.fields(self)
            if (value := getattr(self, item.name)) != item.default
        )
        return ", ".join(differs) or "as it is"

    def scene(self, scene: Scene) -> Scene:
        """The scene with what differs.

        Raises
        ------
        SceneError
            If it cannot be simulated so.
        """
        ground = scene.ground if self.ground is None else self.ground
        if self.friction is not None:
            ground = tuple(dataclasses.replace(each, friction=self.friction) for each in ground)
        if self.thickness != 1.0:
            ground = tuple(self._softer(each, scene) for each in ground)

        def material(given: Material) -> Material:
            return dataclasses.replace(given, viscosity=self.viscosity * given.viscosity)

        body = []
        for part in scene.body:
            if part.material is not None:
                part = dataclasses.replace(part, material=material(part.material))
            if isinstance(part, Actuator):
                (xx, xy), (_, yy) = part.stress
                k = self.strength
                stress = (k * xx, k * xy), (k * xy, k * yy)
                part = dataclasses.replace(part, stress=stress)
            body.append(part)
        varied = dataclasses.replace(
            scene,
            ground=ground,
            body=tuple(body),
            material=material(scene.material),
            formulation=self.formulation or scene.formulation,
        )
        return refined(varied, self.refinement)

    def _softer(self, ground: Ground, scene: Scene) -> Ground:
        layer, (gx, gy) = Layer.of(ground, scene), scene.gravity
        thickness = self.thickness * layer.thickness
        fall = (thickness - layer.thickness) / (math.hypot(gx, gy) or 1.0)
        return dataclasses.replace(
            ground,
            points=tuple((x + fall * gx, y + fall * gy) for x, y in ground.points),
            thickness=thickness,
            stiffness=layer.stiffness / self.thickness,
        )


def refined(scene: Scene, times: int) -> Scene:
    """The scene with so many cells in place of one along each axis, and a step as much shorter.

    It is shorter still where viscosity needs that, which bounds it by the square of the cells'
    width. It has no design filter: its design comes from the other lattice.
    """
    if times == 1:
        return scene
    nx, ny = scene.grid.cells
    fine = dataclasses.replace(
        scene,
        filter_length=0.0,
        grid=Grid((times * nx, times * ny), scene.grid.dx / times),
        time_step=scene.time_step / times**2,
        steps=times**2 * scene.steps,
    )
    step = scene.time_step / times
    return fine.vary(time_step=step / max(1, math.ceil(step / fine.largest_time_step - 1e-9)))
