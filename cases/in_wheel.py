"""What wheels have of the cases: the robots, as ``mpmopt/cases/NAME.py``.

``setup.cfg`` names this class. A mapping of folders there would do the same, but then an editable
install is no entry of the path any more.
"""

from typing import Any

from setuptools.command.build_py import build_py

ROBOTS = ("walker", "crawler", "climber", "silicone", "terrain")


class WithRobots(build_py):
    """Setuptools' command that gathers modules, with the robots among those of `mpmopt`."""

    def find_package_modules(self, package: str, package_dir: str) -> list[Any]:
        """(package, module, file) of each module."""
        found: list[Any] = super().find_package_modules(package, package_dir)
        if package == "mpmopt":
            found += [(package, f"cases/{name}", f"cases/{name}.py") for name in ROBOTS]
        return found
