"""The package's own errors: each says what was found, what was needed, and what to do."""

from __future__ import annotations


class MpmoptError(Exception):
    """Anything that mpmopt refuses or could not do."""


class SceneError(MpmoptError, ValueError):
    """A scene that cannot be simulated, or JSON that is not a scene."""


class DesignError(MpmoptError, ValueError):
    """Design variables or a body that do not fit the scene."""


class SimulationError(MpmoptError, ArithmeticError):
    """A simulation that left the region where its numbers mean anything.

    Attributes
    ----------
    step : int
        Step in which it happened.
    particle : int
        First particle concerned, or -1 if it concerns the whole body.
    position : tuple of float
        Where that particle was, in the scene's unit of length.
    """

    def __init__(
        self, what: str, step: int, particle: int, position: tuple[float, float], hint: str
    ) -> None:
        super().__init__(what, step, particle, position, hint)
        self.what, self.step, self.particle = what, step, particle
        self.position, self.hint = position, hint

    def __str__(self) -> str:
        x, y = self.position
        where = f"particle {self.particle} at ({x:.6g}, {y:.6g})" if self.particle >= 0 else "body"
        return f"step {self.step}, {where}: {self.what}; {self.hint}"


class FractureError(SimulationError):
    """Solid stretched so far that nothing holds its particles together; no step mends that."""


class OverlapError(SimulationError):
    """Parts of a body that were far apart and came to lie in each other."""


class StorageError(MpmoptError, OSError):
    """A file that could not be written or read back, or a disk without room for it."""


class RunFileError(MpmoptError, ValueError):
    """A file that is not a run file of this package, or a damaged one."""


class MissingLibraryError(MpmoptError, ImportError):
    """An optional library that something needs and that is not installed."""


class SweepError(MpmoptError, RuntimeError):
    """A sweep that cannot be made, continued or read, or a point of it that failed."""


class ExportError(MpmoptError, ValueError):
    """A design that cannot be written as asked: a size that makes no sense."""
