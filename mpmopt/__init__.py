"""Topology optimisation of soft bodies that move, with a differentiable material point method."""

__version__ = "0.1.0"
