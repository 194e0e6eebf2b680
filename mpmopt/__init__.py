"""Topology optimisation of soft bodies that move, with a differentiable material point method."""

from importlib import import_module
from typing import Any

__version__ = "0.1.0"

_MODULES = (
    "actuation", "audit", "binary", "case", "checkpoints", "design", "discretisation", "draw",
    "errors", "export", "files", "film", "history", "interrupt", "mma", "motion", "mpm",
    "multistart", "objective", "optimize", "outline", "particles", "plot", "problem",
    "progress", "runfile", "scene", "schematic", "simulate", "sweeps", "verify", "vtkhdf",
)  # fmt: skip


def __getattr__(name: str) -> Any:
    """Import a module when it is first used, so that ``import mpmopt`` costs nothing."""
    if name == "cheapest":
        return import_module("mpmopt.discretisation").cheapest
    if name == "sweep":
        return import_module("mpmopt.sweeps").sweep
    if name in _MODULES:
        return import_module(f"mpmopt.{name}")
    raise AttributeError(f"module 'mpmopt' has no attribute {name!r}")
