"""What is simulated: grid, time, material, body, walls, ground and clamps."""

from mpmopt.scene.clamp import Clamp
from mpmopt.scene.ground import Ground, Layer, Line
from mpmopt.scene.parts import (
    Actuator,
    Design,
    Grid,
    Material,
    Mirror,
    Region,
    Solid,
    Vector,
    Wall,
)
from mpmopt.scene.scene import Scene
from mpmopt.scene.silicones import SILICONES

__all__ = [
    "SILICONES",
    "Actuator",
    "Clamp",
    "Design",
    "Grid",
    "Ground",
    "Layer",
    "Line",
    "Material",
    "Mirror",
    "Region",
    "Scene",
    "Solid",
    "Vector",
    "Wall",
]
