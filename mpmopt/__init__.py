"""Topology optimisation of soft bodies that move, with a differentiable material point method."""

from importlib import import_module
from typing import Any

__version__ = "0.1.0"


def __getattr__(name: str) -> Any:
    """Import a module when it is first used, so that ``import mpmopt`` costs nothing."""
    if name == "cheapest":
        return import_module("mpmopt.discretisation").cheapest
    if name == "sweep":
        return import_module("mpmopt.sweeps").sweep
    try:
        return import_module(f"mpmopt.{name}")
    except ModuleNotFoundError as error:
        if error.name != f"mpmopt.{name}":  # one that the module needs
            raise
        raise AttributeError(f"module 'mpmopt' has no attribute {name!r}") from None
