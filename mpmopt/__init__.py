"""Topology optimisation of soft bodies that move, with a differentiable material point method."""

from importlib import import_module
from types import ModuleType

__version__ = "0.1.0"

_MODULES = (
    "actuation", "binary", "case", "checkpoints", "design", "errors", "mma", "mpm", "objective",
    "optimize", "particles", "plot", "problem", "runfile", "scene", "simulate", "verify",
)  # fmt: skip


def __getattr__(name: str) -> ModuleType:
    """Import a module when it is first used, so that ``import mpmopt`` costs nothing."""
    if name in _MODULES:
        return import_module(f"mpmopt.{name}")
    raise AttributeError(f"module 'mpmopt' has no attribute {name!r}")
