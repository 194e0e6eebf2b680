"""What is simulated: grid, time, material, body and walls, checked on construction."""

from __future__ import annotations

import dataclasses
import json
import math
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from itertools import islice
from typing import Any, ClassVar, Literal

import numpy as np

from mpmopt.checks import MOST, count, number, shown
from mpmopt.errors import SceneError

MOST_PASSES = 200  # of the design filter
# Numbers in any one array: 0.8 GB. What a scene would take is known before any of it is taken.
MOST_NUMBERS = 10**8
MOST_PER_CELL = 100  # particles, per direction
MOST_PARTS = 1000  # of the body, and walls
MOST_TEXT = 10**6  # characters of a scene's JSON

Vector = tuple[float, float]

# s = a sin(...) + b with a and b within [-1, 1]
LARGEST_SIGNAL = 2.0
# Edges may miss a lattice line by rounding, in units of its spacing.
ROUNDING = 1e-6


def _tuple(owner: str, name: str, value: Any, check: Callable[[Any], Any], length: int) -> tuple:
    try:
        items = tuple(islice(value, length + 1))
    except TypeError:
        items = ()
    if isinstance(value, str) or len(items) != length:
        raise SceneError(f"{owner}: {name} = {shown(value)} must have {length} entries")
    return tuple(check(item) for item in items)


def _vector(owner: str, name: str, value: Any) -> Any:
    return _tuple(owner, name, value, lambda item: number(owner, name, item), 2)


class _Checked:
    """Sets fields of a frozen dataclass to their checked values."""

    def _set(self, **values: Any) -> None:
        for name, value in values.items():
            object.__setattr__(self, name, value)


@dataclass(frozen=True)
class Grid(_Checked):
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
            cells=_tuple("Grid", "cells", self.cells, lambda n: count("Grid", "cells", n, 4), 2),
            dx=number("Grid", "dx", self.dx, above=0.0),
        )

    @property
    def size(self) -> Vector:
        """Width and height of the grid."""
        return self.cells[0] * self.dx, self.cells[1] * self.dx


@dataclass(frozen=True)
class Material(_Checked):
    """Compressible neo-Hookean solid, and how weak its absence is.

    Parameters
    ----------
    lame_lambda, lame_mu : float
        Lame constants (stress).
    density : float
        Reference mass density.
    stiffness_floor, mass_floor : float
        Share of stiffness and of mass that a void particle (gamma = 0) keeps: the paper's
        epsilon, one number each.
    """

    lame_lambda: float = 10.0
    lame_mu: float = 10.0
    density: float = 1.0
    stiffness_floor: float = 1e-3
    mass_floor: float = 1e-3

    def __post_init__(self) -> None:
        for name in ("lame_mu", "density", "stiffness_floor", "mass_floor"):
            self._set(**{name: number("Material", name, getattr(self, name), above=0.0)})
        self._set(lame_lambda=number("Material", "lame_lambda", self.lame_lambda))
        if self.lame_lambda < 0.0:
            raise SceneError(f"Material: lame_lambda = {self.lame_lambda!r} must not be negative")
        for name in ("stiffness_floor", "mass_floor"):
            if getattr(self, name) > 1.0:
                raise SceneError(f"Material: {name} = {getattr(self, name)!r} must be at most 1")

    @property
    def wave_speed(self) -> float:
        """Speed of pressure waves, sqrt((lambda + 2 mu) / rho)."""
        return math.sqrt((self.lame_lambda + 2.0 * self.lame_mu) / self.density)


@dataclass(frozen=True)
class Region(_Checked):
    """Axis-parallel rectangle of the body; its edges lie on lines of the particle lattice.

    Parameters
    ----------
    lower, upper : (float, float)
        Lower left and upper right corner.
    """

    kind: ClassVar[str]

    lower: Vector
    upper: Vector

    def __post_init__(self) -> None:
        owner = type(self).__name__
        self._set(
            lower=_vector(owner, "lower", self.lower), upper=_vector(owner, "upper", self.upper)
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
        omega of the signal s(t) = a sin(omega t + pi theta) + b, per unit of time.
    """

    kind = "actuator"

    stress: tuple[Vector, Vector] = ((2.0, 0.0), (0.0, 2.0))
    angular_frequency: float = 30.0

    def __post_init__(self) -> None:
        super().__post_init__()
        rows = _tuple("Actuator", "stress", self.stress, lambda r: r, 2)
        stress = tuple(_vector("Actuator", "stress", row) for row in rows)
        if stress[0][1] != stress[1][0]:
            raise SceneError(
                f"Actuator: a second Piola-Kirchhoff stress is symmetric, but S_xy = "
                f"{stress[0][1]!r} and S_yx = {stress[1][0]!r}"
            )
        omega = number("Actuator", "angular_frequency", self.angular_frequency, above=0.0)
        self._set(stress=stress, angular_frequency=omega)


@dataclass(frozen=True)
class Wall(_Checked):
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


@dataclass(frozen=True)
class Mirror(_Checked):
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


@dataclass(frozen=True)
class Scene(_Checked):
    """One body, what surrounds it, and the way it shall go.

    Units are free but must agree: with metres, seconds and kilograms per square metre, stresses
    are in newtons per metre.

    Parameters
    ----------
    grid : Grid
    time_step : float
        Length of an explicit step.
    steps : int
        Number of steps.
    body : tuple of Region
        `Design`, `Solid` and `Actuator` rectangles that do not overlap.
    walls : tuple of Wall, optional
    material : Material, optional
    gravity : (float, float), optional
    direction : (float, float), optional
        Unit vector e of the objective.
    particles_per_cell : int, optional
        Particles per cell and direction; `optimise` needs two or more, which bear stretches up to
        as many.
    filter_weights : (float, float, float), optional
        Weights w0, w1, w2 of the design filter's 3 x 3 convolution: w0 + 4 w1 + 4 w2 = 1.
    filter_length : float, optional
        Standard deviation, along each axis, that the filter reaches by as many passes of its
        convolution (`filter_passes`), so that designs do not depend on the grid. Zero is one pass,
        as in the paper.
    mirror : Mirror, optional
        Plane about which all of the scene is symmetric. Body and walls are given whole.
    blend_time : float, optional
        Time tau in which particles lose what the transfer to the grid and back smooths away: they
        keep a share exp(-time_step / tau) of it in every step, so that damping is a rate and not
        a matter of the step. Zero is the affine transfer, as in the paper: they keep nothing.
    transient : float, optional
        Time at the start in which travel does not count, so that a body which tips over once gains
        nothing by it, rounded to whole steps. Zero, as in the paper: all of it counts.

    Raises
    ------
    SceneError
        If anything is of the wrong kind or the parts do not fit together.
    """

    grid: Grid
    time_step: float
    steps: int
    body: tuple[Region, ...]
    walls: tuple[Wall, ...] = ()
    material: Material = Material()
    gravity: Vector = (0.0, 0.0)
    direction: Vector = (1.0, 0.0)
    particles_per_cell: int = 2
    filter_weights: tuple[float, float, float] = (0.64, 0.08, 0.01)
    filter_length: float = 0.0
    mirror: Mirror | None = None
    blend_time: float = 0.0
    transient: float = 0.0

    def __post_init__(self) -> None:
        for name, kind in (("grid", Grid), ("material", Material)):
            if not isinstance(getattr(self, name), kind):
                raise SceneError(f"Scene: {name} must be a {kind.__name__}")
        for name, part in (("body", Region), ("walls", Wall)):
            value = getattr(self, name)
            if not isinstance(value, (tuple, list)) or not all(isinstance(v, part) for v in value):
                raise SceneError(f"Scene: {name} must be a tuple of {part.__name__} objects")
            if any(type(v) is Region for v in value):
                raise SceneError("Scene: a Region must be a Design, a Solid or an Actuator")
            if len(value) > MOST_PARTS:
                raise SceneError(
                    f"Scene: {name} has {len(value)} parts, more than {MOST_PARTS}; join some"
                )
            self._set(**{name: tuple(value)})
        self._set(
            time_step=number("Scene", "time_step", self.time_step, above=0.0),
            steps=count("Scene", "steps", self.steps, 1),
            gravity=_vector("Scene", "gravity", self.gravity),
            direction=_vector("Scene", "direction", self.direction),
            particles_per_cell=count(
                "Scene", "particles_per_cell", self.particles_per_cell, 1, MOST_PER_CELL
            ),
            filter_length=number("Scene", "filter_length", self.filter_length),
            blend_time=number("Scene", "blend_time", self.blend_time),
            transient=number("Scene", "transient", self.transient),
            filter_weights=_tuple(
                "Scene",
                "filter_weights",
                self.filter_weights,
                lambda w: number("Scene", "filter_weights", w, above=0.0),
                3,
            ),
        )
        if abs(math.hypot(*self.direction) - 1.0) > 1e-12:
            raise SceneError(
                f"Scene: direction {self.direction} has length {math.hypot(*self.direction):.15g}, "
                "must have length 1; divide it by its length"
            )
        w0, w1, w2 = self.filter_weights
        if abs(w0 + 4.0 * w1 + 4.0 * w2 - 1.0) > 1e-12:
            raise SceneError(
                f"Scene: filter_weights sum to w0 + 4 w1 + 4 w2 = {w0 + 4 * w1 + 4 * w2:.15g}, "
                "must sum to 1"
            )
        for name in ("filter_length", "blend_time", "transient"):
            if getattr(self, name) < 0.0:
                raise SceneError(f"Scene: {name} = {getattr(self, name):g} must not be negative")
        if self.filter_passes > MOST_PASSES:
            raise SceneError(
                f"Scene: filter_length = {self.filter_length:g} takes {self.filter_passes} passes, "
                f"more than {MOST_PASSES}; take a shorter one, or larger w1 and w2"
            )
        if not self.transient_steps < self.steps:
            raise SceneError(
                f"Scene: transient = {self.transient:g} takes all of the {self.steps} steps; take "
                "more of them"
            )
        self._check_body()
        self._check_size()
        self._check_walls()
        self._check_mirror()
        self._check_stability()

    def __str__(self) -> str:
        nx, ny = self.grid.cells
        kinds = [region.kind for region in self.body]
        body = ", ".join(f"{kinds.count(kind)} {kind}" for kind in dict.fromkeys(kinds))
        walls = ", ".join(
            f"{wall.axis} {'>' if wall.solid_side == 'below' else '<'} {wall.position:g} "
            f"({'stick' if wall.friction == 'stick' else f'friction {wall.friction:g}'})"
            for wall in self.walls
        )
        mirror = ""
        if self.mirror is not None:
            mirror = f", symmetric about {self.mirror.axis} = {self.mirror.position:g}"
        (gx, gy), (ex, ey) = self.gravity, self.direction
        return (
            f"Scene of {nx} x {ny} cells {self.grid.dx:g} wide, {self.steps} steps of "
            f"{self.time_step:g}: a body of regions {body}{mirror}; "
            f"free where {walls or 'the grid is'}; gravity ({gx:g}, {gy:g}); to travel along "
            f"({ex:g}, {ey:g}){f' after {self.transient:g}' if self.transient_steps else ''}"
        )

    def _repr_png_(self) -> bytes:
        """A picture for notebooks."""
        from mpmopt import draw, schematic

        return draw.png(schematic.schematic(self), dpi=80)

    def _check_body(self) -> None:
        if not any(not isinstance(region, Design) for region in self.body):
            raise SceneError(
                "Scene: the body has no Solid and no Actuator, but the objective is where these go"
            )
        dx, size = self.grid.dx, self.grid.size
        spacing = dx / self.particles_per_cell
        for region in self.body:
            name = f"Scene: {type(region).__name__} {region.lower} to {region.upper}"
            for k in (0, 1):
                if region.lower[k] < dx * (1.0 - ROUNDING) or region.upper[k] > size[k] - dx * (
                    1.0 - ROUNDING
                ):
                    raise SceneError(
                        f"{name} must lie within [{dx:g}, {size[k] - dx:g}] along {'xy'[k]}: "
                        f"the grid's size is {size[k]:g}, less one cell at each end"
                    )
                for edge in (region.lower[k], region.upper[k]):
                    if abs(edge / spacing - round(edge / spacing)) > ROUNDING:
                        raise SceneError(
                            f"{name}: edge {'xy'[k]} = {edge:.10g} is no multiple of the particle "
                            f"spacing {spacing:.10g}; the nearest is "
                            f"{round(edge / spacing) * spacing:.10g}"
                        )
        for i, region in enumerate(self.body):
            for other in self.body[i + 1 :]:
                low, high = self.lattice(region)
                other_low, other_high = self.lattice(other)
                if all(low[k] < other_high[k] and other_low[k] < high[k] for k in (0, 1)):
                    raise SceneError(
                        f"Scene: {type(region).__name__} {region.lower} to {region.upper} overlaps "
                        f"{type(other).__name__} {other.lower} to {other.upper}"
                    )

    def _check_size(self) -> None:
        """Refuse what would take more memory than there is, before any is taken."""
        corners = [self.lattice(region) for region in self.body]
        lower, upper = (
            [side(c[e][k] for c in corners) for k in (0, 1)] for e, side in ((0, min), (1, max))
        )
        areas = [(x1 - x0) * (y1 - y0) for (x0, y0), (x1, y1) in corners]
        particles, actuators = sum(areas), len(self.actuators)
        nodes = math.prod((b - a) // self.particles_per_cell + 4 for a, b in zip(lower, upper))
        designed = sum(a for a, region in zip(areas, self.body) if isinstance(region, Design))
        neighbours = min(designed, self.filter_neighbours)
        for what, numbers, cure in (
            (f"{particles} particles", 12 * particles, "larger cells or fewer particles per cell"),
            (f"a body that spans {nodes} nodes", 4 * nodes, "larger cells or a smaller body"),
            (
                f"{actuators} actuators of {particles} particles",
                actuators * particles,
                "fewer actuators",
            ),
            (
                f"{self.steps} signals of {actuators} actuators",
                actuators * self.steps,
                "fewer steps",
            ),
            (
                f"a filter from {designed} particles to {neighbours} each",
                designed * neighbours,
                "a shorter filter_length",
            ),
        ):
            if numbers > MOST_NUMBERS:
                raise SceneError(
                    f"Scene: {what} would take {numbers:.3g} numbers in one array, more than "
                    f"{MOST_NUMBERS:.3g}; take {cure}"
                )

    def _check_walls(self) -> None:
        slack = ROUNDING * self.grid.dx
        for wall in self.walls:
            k = "xy".index(wall.axis)
            dx, size = self.grid.dx, self.grid.size[k]
            if not dx - slack <= wall.position <= size - dx + slack:
                raise SceneError(
                    f"Scene: wall at {wall.axis} = {wall.position:g} must be within [{dx:g}, "
                    f"{size - dx:g}], so that there are nodes behind it"
                )
            line = round(wall.position / dx)
            if abs(wall.position / dx - line) > ROUNDING:
                raise SceneError(
                    f"Scene: wall at {wall.axis} = {wall.position:.10g} is on no line of nodes, of "
                    f"which it clamps those behind it; the nearest is at {line * dx:.10g}"
                )
            for region in self.body:
                depth = (
                    wall.position - region.lower[k]
                    if wall.solid_side == "below"
                    else region.upper[k] - wall.position
                )
                if depth > slack:
                    raise SceneError(
                        f"Scene: {type(region).__name__} {region.lower} to {region.upper} reaches "
                        f"{depth:g} into the wall at {wall.axis} = {wall.position:g}"
                    )

    def _check_mirror(self) -> None:
        mirror = self.mirror
        if mirror is None:
            return
        if not isinstance(mirror, Mirror):
            raise SceneError("Scene: mirror must be a Mirror or None")
        name, k, dx = (
            f"Scene: mirror at {mirror.axis} = {mirror.position:g}",
            mirror.normal,
            self.grid.dx,
        )
        if abs(mirror.position / dx - round(mirror.position / dx)) > ROUNDING:
            raise SceneError(
                f"{name} is on no line of nodes; the nearest is at "
                f"{round(mirror.position / dx) * dx:.10g}"
            )
        for what, vector in (("gravity", self.gravity), ("direction", self.direction)):
            if vector[k] != 0.0:
                raise SceneError(f"{name}: {what} {vector} has a component across it, must have 0")
        there = {(type(region), self.lattice(region)) for region in self.body}
        for region in self.body:
            low, high = mirror.image(region.lower), mirror.image(region.upper)
            corners = (
                (min(low[0], high[0]), min(low[1], high[1])),
                (max(low[0], high[0]), max(low[1], high[1])),
            )
            image = self.lattice(Region(*corners))
            where = f"{type(region).__name__} {region.lower} to {region.upper}"
            if (type(region), image) not in there:
                raise SceneError(f"{name}: {where} has no mirror image in the body; add it")
            if isinstance(region, Actuator) and (
                image != self.lattice(region) or region.stress[0][1] != 0.0
            ):
                raise SceneError(
                    f"{name}: {where} must be its own mirror image with S_xy = 0, has S_xy = "
                    f"{region.stress[0][1]:g}; simulate the whole body instead"
                )
        for wall in self.walls:
            if wall.axis != mirror.axis:
                continue
            image_wall = dataclasses.replace(
                wall,
                position=2.0 * mirror.position - wall.position,
                solid_side="above" if wall.solid_side == "below" else "below",
            )
            if not any(
                abs(other.position - image_wall.position) < ROUNDING * dx
                and (other.axis, other.solid_side, other.friction)
                == (image_wall.axis, image_wall.solid_side, image_wall.friction)
                for other in self.walls
            ):
                raise SceneError(
                    f"{name}: the wall at {wall.axis} = {wall.position:g} has no mirror image at "
                    f"{image_wall.position:g}; add it"
                )

    def _check_stability(self) -> None:
        if self.time_step > self.largest_time_step:
            raise SceneError(
                f"Scene: time_step = {self.time_step:g} is over the stability limit "
                f"{self.largest_time_step:g} of a single particle; take a smaller step, larger "
                "cells or a mass floor that is not below the stiffness floor"
            )
        for actuator in self.actuators:
            largest = LARGEST_SIGNAL * np.abs(np.linalg.eigvalsh(actuator.stress)).max()
            if self.material.lame_mu - largest <= 0.0:
                raise SceneError(
                    f"Scene: ellipticity can be lost: lame_mu = {self.material.lame_mu:g}, but the "
                    f"actuation stress can reach -{largest:g} at a signal of "
                    f"{LARGEST_SIGNAL:g}; keep it below lame_mu"
                )

    def lattice(self, region: Region) -> tuple[tuple[int, int], tuple[int, int]]:
        """Lower and upper corner of a region in particle spacings."""
        spacing = self.grid.dx / self.particles_per_cell
        (x0, y0), (x1, y1) = region.lower, region.upper
        return (round(x0 / spacing), round(y0 / spacing)), (
            round(x1 / spacing),
            round(y1 / spacing),
        )

    def gap(self, region: Region, other: Region) -> float | None:
        """How far two regions are apart; None if they share an edge, which holds them together."""
        (low, high), (other_low, other_high) = self.lattice(region), self.lattice(other)
        apart = [max(low[k] - other_high[k], other_low[k] - high[k]) for k in (0, 1)]
        if max(apart) == 0 and min(apart) < 0:
            return None
        return math.hypot(*(max(a, 0) for a in apart)) * self.grid.dx / self.particles_per_cell

    @property
    def largest_time_step(self) -> float:
        """Stability limit dx sqrt(rho / (2 (mu + lambda))) of an isolated particle.

        The lightest particle counts: a void one where the mass floor is below the stiffness floor.
        """
        material = self.material
        stiffness = 2.0 * (material.lame_mu + material.lame_lambda)
        stiffest = max(1.0, material.stiffness_floor / material.mass_floor)
        return self.grid.dx * math.sqrt(material.density / (stiffness * stiffest))

    @property
    def courant(self) -> float:
        """Courant number of pressure waves in the solid, c_p dt / dx."""
        return self.material.wave_speed * self.time_step / self.grid.dx

    @property
    def actuators(self) -> tuple[Actuator, ...]:
        """The actuators in the body's order, which is that of a, theta and b."""
        return tuple(region for region in self.body if isinstance(region, Actuator))

    @property
    def transient_steps(self) -> int:
        """Steps after which travel counts."""
        return round(min(self.transient / self.time_step, self.steps))

    @property
    def duration(self) -> float:
        """Simulated time."""
        return self.steps * self.time_step

    @property
    def filter_passes(self) -> int:
        """How often the filter's convolution is applied, at least once.

        The two transfers between particles and grid spread by a variance of dx^2 / 4 each, and one
        pass adds that of its weights.
        """
        _, w1, w2 = self.filter_weights
        cells = self.filter_length / self.grid.dx
        passes = (cells**2 - 0.5) / (2.0 * (w1 + 2.0 * w2))
        # Halfway between two numbers, rounding does not choose: it is the upper one.
        return max(1, math.floor(passes + 0.5 + ROUNDING))

    @property
    def filter_radius(self) -> float:
        """Distance, in cells, beyond which the filter takes no notice of a particle.

        Six standard deviations of its passes and three cells more.
        """
        _, w1, w2 = self.filter_weights
        spread = math.sqrt(2.0 * self.filter_passes * (w1 + 2.0 * w2))
        return min(self.filter_passes, 6.0 * spread) + 3.0

    @property
    def filter_neighbours(self) -> int:
        """Particles from which the filter takes at most, where all around are designed."""
        return (2 * math.ceil(self.filter_radius) * self.particles_per_cell) ** 2

    def vary(
        self,
        *,
        time_step: float | None = None,
        mass_floor: float | None = None,
        stiffness_floor: float | None = None,
        coarsening: int = 1,
    ) -> Scene:
        """The same scene and duration with another time step, other floors, or wider cells.

        Parameters
        ----------
        time_step, mass_floor, stiffness_floor : float, optional
            As in `Scene` and `Material`.
        coarsening : int, optional
            How many of this scene's cells go into the width of a new one.

        Raises
        ------
        SceneError
            If the duration is no multiple of the new step, or the result cannot be simulated.
        """
        floors = {"mass_floor": mass_floor, "stiffness_floor": stiffness_floor}
        given = {name: value for name, value in floors.items() if value is not None}
        steps, material = self.steps, dataclasses.replace(self.material, **given)
        if time_step is None:
            time_step = self.time_step
        else:
            time_step = number("Scene", "time_step", time_step, above=0.0)
            if self.duration / time_step > MOST:
                raise SceneError(
                    f"Scene: time_step = {time_step:g} would take more than {MOST:.0e} steps"
                )
            steps = max(1, round(self.duration / time_step))
            if abs(steps * time_step - self.duration) > 1e-9 * self.duration:
                raise SceneError(
                    f"Scene: duration {self.duration:g} is no multiple of time_step = "
                    f"{time_step:g}; the nearest that divides it is {self.duration / steps:.10g}"
                )
        coarsening = count("Scene", "coarsening", coarsening, 1)
        if any(n % coarsening for n in self.grid.cells):
            raise SceneError(
                f"Scene: cells {self.grid.cells} are no multiples of coarsening = {coarsening}"
            )
        nx, ny = (n // coarsening for n in self.grid.cells)
        grid = Grid((nx, ny), self.grid.dx * coarsening)
        return dataclasses.replace(
            self, grid=grid, time_step=time_step, steps=steps, material=material
        )

    def to_json(self) -> str:
        """The scene as JSON text, from which `from_json` makes exactly the same scene."""
        data = dataclasses.asdict(self)
        for region, item in zip(self.body, data["body"], strict=True):
            item["kind"] = region.kind
        return json.dumps(data, indent=1)

    @staticmethod
    def from_json(text: str) -> Scene:
        """The scene that `to_json` wrote.

        Raises
        ------
        SceneError
            If the text is no JSON, keys are unknown or missing, or values do not fit.
        """
        if not isinstance(text, str):
            raise SceneError(f"Scene: {shown(text)} is no JSON text")
        if len(text) > MOST_TEXT:
            raise SceneError(
                f"Scene: JSON text has {len(text)} characters, more than {MOST_TEXT}; a scene has "
                f"{MOST_PARTS} parts at most"
            )
        try:
            data = json.loads(
                text, parse_constant=_refuse_constant, object_pairs_hook=_refuse_duplicates
            )
        except SceneError:
            raise
        except (ValueError, TypeError, RecursionError) as error:
            raise SceneError(f"Scene: not JSON: {error}") from error
        data = dict(_object("Scene", data))
        for name, part in (("grid", Grid), ("material", Material), ("mirror", Mirror)):
            if data.get(name) is not None:
                data[name] = _build(part, data[name])
        if "body" in data:
            kinds = {part.kind: part for part in (Design, Solid, Actuator)}
            regions = []
            for item in _array("body", data["body"]):
                item = dict(_object("Region", item))
                kind = item.pop("kind", None)
                if not isinstance(kind, str) or kind not in kinds:
                    raise SceneError(f"Region: kind = {shown(kind)} must be one of {sorted(kinds)}")
                regions.append(_build(kinds[kind], item))
            data["body"] = tuple(regions)
        if "walls" in data:
            data["walls"] = tuple(_build(Wall, item) for item in _array("walls", data["walls"]))
        return _build(Scene, data)


def _refuse_constant(name: str) -> float:
    raise SceneError(f"Scene: {name} is not a number that a scene can hold")


def _refuse_duplicates(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    data = dict(pairs)
    if len(data) < len(pairs):
        twice = sorted(name for name, n in Counter(name for name, _ in pairs).items() if n > 1)
        raise SceneError(f"Scene: keys {shown(twice)} are there twice; keep one of each")
    return data


def _object(owner: str, data: Any) -> dict[str, Any]:
    if not isinstance(data, dict):
        raise SceneError(f"{owner}: expected a JSON object, got {type(data).__name__}")
    return data


def _array(owner: str, data: Any) -> list[Any]:
    if not isinstance(data, list):
        raise SceneError(f"{owner}: expected a JSON array, got {type(data).__name__}")
    return data


def _build(part: Any, data: Any) -> Any:
    name = part.__name__
    data = _object(name, data)
    fields = {field.name: field for field in dataclasses.fields(part)}
    unknown = sorted(set(data) - set(fields))
    if unknown:
        raise SceneError(f"{name}: unknown keys {shown(unknown)}; known are {sorted(fields)}")
    missing = [
        key
        for key, field in fields.items()
        if field.default is dataclasses.MISSING and key not in data
    ]
    if missing:
        raise SceneError(f"{name}: keys {missing} are missing")
    return part(**data)
