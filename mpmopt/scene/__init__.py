"""What is simulated: grid, time, material, body, walls and ground."""

from mpmopt.scene.ground import Ground
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

__all__ = [
    "Actuator",
    "Design",
    "Grid",
    "Ground",
    "Material",
    "Mirror",
    "Region",
    "Scene",
    "Solid",
    "Vector",
    "Wall",
]
