"""What a scene is made of: grid, material, regions of the body, walls, mirror."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from difflib import get_close_matches
from inspect import signature
from itertools import islice
from typing import Any, ClassVar, Literal

from mpmopt.errors import DesignError, SceneError
from mpmopt.validation import count, number, share, shown

Vector = tuple[float, float]


def entries(owner: str, name: str, value: Any, check: Callable[[Any], Any], length: int) -> tuple:
    """`value` as a tuple of so many checked entries, or an error."""
    try:
        items = tuple(islice(value, length + 1))
    except TypeError:
        items = ()
    if isinstance(value, str) or len(items) != length:
        raise SceneError(f"{owner}: {name} = {shown(value)} must have {length} entries")
    return tuple(check(item) for item in items)


def vector(owner: str, name: str, value: Any) -> Any:
    """`value` as a pair of numbers, or an error."""
    return entries(owner, name, value, lambda item: number(owner, name, item), 2)


class Checked:
    """Sets fields of a frozen dataclass to their checked values.

    Raises
    ------
    SceneError
        Or DesignError, if it is given a field that it has not, or not one that it needs.
    """

    def __new__(cls, *values: Any, **given: Any) -> Any:
        """As any object; whether what is given fits the fields is looked at."""
        wanted = signature(cls.__init__)
        try:
            wanted.bind(None, *values, **given)
        except TypeError as error:
            names = [name for name in wanted.parameters if name != "self"]
            says = f": {error}; it has {', '.join(names) or 'no fields'}"
            for name in given:
                if name not in names:
                    nearest = get_close_matches(name, names, 1)
                    it_has = f"did you mean {nearest[0]}?" if nearest else says.split("; ")[1]
                    says = f" has no field {name}; {it_has}"
                    break
            kind = SceneError if cls.__module__.startswith("mpmopt.scene.") else DesignError
            raise kind(cls.__name__ + says) from None
        return super().__new__(cls)

    def __reduce__(self) -> tuple[Any, ...]:
        """For copies and pickles, which begin without fields."""
        return object.__new__, (type(self),), self.__dict__

    def _set(self, **values: Any) -> None:
        for name, value in values.items():
            object.__setattr__(self, name, value)


@dataclass(frozen=True)
class Grid(Checked):
    """Square cells of a Cartesian grid with its corner at the origin.

    Parameters
    ----------
    cells : (int, int)
        Number of cells along x and y.
    dx : float
        Width of a cell, in the scene's unit of length.
    """

    cells: tuple[int, int]
    dx: float

    def __post_init__(self) -> None:
        self._set(
            cells=entries("Grid", "cells", self.cells, lambda n: count("Grid", "cells", n, 4), 2),
            dx=number("Grid", "dx", self.dx, above=0.0),
        )

    @property
    def size(self) -> Vector:
        """Width and height of the grid."""
        return self.cells[0] * self.dx, self.cells[1] * self.dx


@dataclass(frozen=True)
class Material(Checked):
    """Compressible neo-Hookean solid, and how weak its absence is.

    Parameters
    ----------
    lame_lambda, lame_mu : float
        Lame constants (stress).
    density : float
        Reference mass density.
    viscosity : float
        eta of the Kelvin-Voigt stress S = eta dE/dt (stress times time), of the second
        Piola-Kirchhoff stress and the Green-Lagrange strain. Zero, as in the paper: none.
    void_stiffness, void_density : float
        Share of stiffness and of mass that a void particle (gamma = 0) keeps: the paper's
        epsilon, one number each.
    """

    lame_lambda: float = 10.0
    lame_mu: float = 10.0
    density: float = 1.0
    viscosity: float = 0.0
    void_stiffness: float = 1e-3
    void_density: float = 1e-3

    def __post_init__(self) -> None:
        for name in ("lame_mu", "density", "void_stiffness", "void_density"):
            self._set(**{name: number("Material", name, getattr(self, name), above=0.0)})
        for name in ("lame_lambda", "viscosity"):
            self._set(**{name: number("Material", name, getattr(self, name))})
            if getattr(self, name) < 0.0:
                raise SceneError(f"Material: {name} = {getattr(self, name)!r} must not be negative")
        for name in ("void_stiffness", "void_density"):
            if getattr(self, name) > 1.0:
                raise SceneError(f"Material: {name} = {getattr(self, name)!r} must be at most 1")

    @classmethod
    def from_young(cls, young: float, poisson: float, density: float, **others: float) -> Material:
        """The material with a Young's modulus and Poisson's ratio, in plane strain.

        lambda = E nu / ((1 + nu) (1 - 2 nu)) and mu = E / (2 (1 + nu)), those of the solid of
        which the plane is a section.

        Parameters
        ----------
        young : float
            E > 0 (stress).
        poisson : float
            nu, from 0 to below 0.5, where the solid is incompressible and no step is short enough.
        density : float
        **others
            Other fields of `Material`.

        Raises
        ------
        SceneError
            If a number makes no sense.
        """
        E = number("Material", "young", young, above=0.0)
        nu = number("Material", "poisson", poisson)
        if not 0.0 <= nu < 0.5:
            raise SceneError(
                f"Material: poisson = {nu!r} must be from 0 to below 0.5; take 0.45 for what is "
                "nearly incompressible"
            )
        mu = E / (2.0 * (1.0 + nu))
        return cls(2.0 * mu * nu / (1.0 - 2.0 * nu), mu, density, **others)

    @property
    def wave_speed(self) -> float:
        """Speed of pressure waves, sqrt((lambda + 2 mu) / rho)."""
        return math.sqrt((self.lame_lambda + 2.0 * self.lame_mu) / self.density)

    @property
    def modulus(self) -> float:
        """Stiffness 2 (lambda + mu) that an isolated particle at rest bounds the time step by."""
        return 2.0 * (self.lame_mu + self.lame_lambda)

    def largest_time_step(self, dx: float, layer: float = 0.0, least: float = 0.0) -> float:
        """Stability limit of an isolated particle at rest on cells of width dx.

        dt = k / (a + sqrt(a^2 + 1)) with k = dx sqrt(rho / M) and a = k eta / (rho dx^2) (docs:
        theory, "Step control"). A contact layer, whose stiffness over its thickness is `layer`,
        adds layer / (4 rho) to 1 / k^2. M is `modulus`, or `least` where that is more. The lightest
        particle counts: a void one where the void density is below the void stiffness.
        """
        stiffest = max(1.0, self.void_stiffness / self.void_density)
        modulus = max(self.modulus, least) + 0.25 * layer * dx**2
        elastic = dx * math.sqrt(self.density / (modulus * stiffest))
        viscous = elastic * self.viscosity * stiffest / (self.density * dx**2)
        return elastic / (viscous + math.sqrt(viscous**2 + 1.0))

    @property
    def elliptic_limit(self) -> float:
        """Stress mu: actuation that squeezes by as much takes the law's ellipticity."""
        return self.lame_mu


@dataclass(frozen=True)
class Region(Checked):
    """Axis-parallel rectangle of the body; its edges lie on lines of the particle lattice.

    Parameters
    ----------
    lower, upper : (float, float)
        Lower left and upper right corner.
    material : Material, optional
        What it is made of, by keyword; None: the scene's.
    """

    kind: ClassVar[str]

    lower: Vector
    upper: Vector
    material: Material | None = field(default=None, kw_only=True)

    def __post_init__(self) -> None:
        owner = type(self).__name__
        if self.material is not None and not isinstance(self.material, Material):
            raise SceneError(
                f"{owner}: material = {shown(self.material)} must be a Material, or None for the "
                "scene's"
            )
        self._set(
            lower=vector(owner, "lower", self.lower), upper=vector(owner, "upper", self.upper)
        )
        if not (self.lower[0] < self.upper[0] and self.lower[1] < self.upper[1]):
            raise SceneError(
                f"{owner}: lower corner {self.lower} must be left of and below upper {self.upper}"
            )

    def __str__(self) -> str:
        return f"{type(self).__name__} {self.lower} to {self.upper}"


@dataclass(frozen=True)
class Design(Region):
    """Part of the body whose material is designed."""

    kind = "design"


@dataclass(frozen=True)
class Solid(Region):
    """Part of the body that is solid whatever the design."""

    kind = "solid"


@dataclass(frozen=True)
class Actuator(Region):
    """Solid part of the body that an actuation stress squeezes.

    Parameters
    ----------
    stress : ((float, float), (float, float))
        Second Piola-Kirchhoff stress S of a unit signal; symmetric.
    angular_frequency : float
        omega of the signal s(t) = b + sum_h a_h sin(h omega t + pi theta_h), per unit of time.
    harmonics : int
        Number H of sines; one, as in the paper.
    detuning : float
        By how much of itself omega may change, as a design variable: from 0, where it is none, to
        below 1.
    """

    kind = "actuator"

    stress: tuple[Vector, Vector] = ((2.0, 0.0), (0.0, 2.0))
    angular_frequency: float = 30.0
    harmonics: int = 1
    detuning: float = 0.0

    def __post_init__(self) -> None:
        super().__post_init__()
        rows = entries("Actuator", "stress", self.stress, lambda r: r, 2)
        stress = tuple(vector("Actuator", "stress", row) for row in rows)
        if stress[0][1] != stress[1][0]:
            raise SceneError(
                f"Actuator: a second Piola-Kirchhoff stress is symmetric, but S_xy = "
                f"{stress[0][1]!r} and S_yx = {stress[1][0]!r}"
            )
        omega = number("Actuator", "angular_frequency", self.angular_frequency, above=0.0)
        harmonics = count("Actuator", "harmonics", self.harmonics, 1)
        detuning = share("Actuator", "detuning", self.detuning)
        self._set(stress=stress, angular_frequency=omega, harmonics=harmonics, detuning=detuning)

    @property
    def largest_signal(self) -> float:
        """The largest |s|: bias and amplitudes are at most 1 in size, so it is 1 + H."""
        return 1.0 + self.harmonics


@dataclass(frozen=True)
class Wall(Checked):
    """Axis-parallel rigid wall on a line of nodes: those behind are clamped while they approach it.

    Bodies touch it when their kernels do, with a softness of about a cell; the lowest particles of
    a resting body lie about at `position`.

    Parameters
    ----------
    axis : {"x", "y"}
        Axis of the wall's normal: a floor has "y".
    position : float
        Coordinate of the wall on that axis; on a line of nodes.
    solid_side : {"below", "above"}
        Side of `position` that is solid, towards smaller or larger coordinates.
    friction : float or "stick"
        Coulomb's coefficient (0: free slip), or no slip at all while approaching.
    """

    axis: Literal["x", "y"]
    position: float
    solid_side: Literal["below", "above"] = "below"
    friction: float | Literal["stick"] = "stick"

    def __post_init__(self) -> None:
        if self.axis not in ("x", "y"):
            raise SceneError(f'Wall: axis = {shown(self.axis)} must be "x" or "y"')
        if self.solid_side not in ("below", "above"):
            raise SceneError(
                f'Wall: solid_side = {shown(self.solid_side)} must be "below" or "above"'
            )
        self._set(position=number("Wall", "position", self.position))
        if self.friction != "stick":
            friction = number("Wall", 'friction (or "stick")', self.friction)
            if friction < 0.0:
                raise SceneError(f"Wall: friction = {friction!r} must not be negative")
            self._set(friction=friction)

    def row(self, dx: float) -> tuple[float, ...]:
        """The wall as kernels see it, on cells of width dx: the columns of `kernels.contact`."""
        return (
            "xy".index(self.axis),
            1.0 if self.solid_side == "below" else -1.0,
            round(self.position / dx),
            math.inf if self.friction == "stick" else self.friction,
        )


@dataclass(frozen=True)
class Mirror(Checked):
    """Plane of symmetry: only the half below it is simulated, which is the same solution.

    Parameters
    ----------
    axis : {"x", "y"}
        Axis of the plane's normal.
    position : float
        Coordinate of the plane on that axis; on a line of nodes.
    """

    axis: Literal["x", "y"]
    position: float

    def __post_init__(self) -> None:
        if self.axis not in ("x", "y"):
            raise SceneError(f'Mirror: axis = {shown(self.axis)} must be "x" or "y"')
        self._set(position=number("Mirror", "position", self.position))

    @property
    def normal(self) -> int:
        """Index of the axis."""
        return "xy".index(self.axis)

    def image(self, corner: Vector) -> Vector:
        """Mirror image of a point."""
        return tuple(  # type: ignore[return-value]
            2.0 * self.position - c if k == self.normal else c for k, c in enumerate(corner)
        )
