"""A scene: one body, what surrounds it, and the way it shall go."""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass, field
from typing import Literal

from mpmopt.errors import SceneError
from mpmopt.scene.checks import (
    ROUNDING,
    check_body,
    check_formulation,
    check_mirror,
    check_size,
    check_stability,
    check_walls,
)
from mpmopt.scene.clamp import Clamp, check_clamps
from mpmopt.scene.ground import Ground, Layer, check_ground
from mpmopt.scene.parts import (
    Actuator,
    Checked,
    Grid,
    Material,
    Mirror,
    Region,
    Vector,
    Wall,
    entries,
    vector,
)
from mpmopt.scene.serial import parsed, written
from mpmopt.validation import MOST, count, number

# Share of the limit of an isolated particle in the updated formulation.
LAGRANGIAN_LIMIT = 0.8
Formulation = Literal["updated", "total"]
MOST_PASSES = 200  # of the design filter
MOST_PER_CELL = 100  # particles, per direction
MOST_PARTS = 1000  # of the body, and walls


@dataclass(frozen=True)
class Scene(Checked):
    """One body, what surrounds it, and the way it shall go.

    Units are free but must agree: with metres, seconds and kilograms per cubic metre, stresses are
    in pascals, and forces and energies are those of a metre of depth.

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
    ground : tuple of Ground, optional
    clamps : tuple of Clamp, optional
    material : Material, optional
        Of the regions that have none of their own.
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
        Plane about which all of the scene is symmetric. Body, walls and ground are given whole.
    formulation : {"updated", "total"}, optional
        "updated" is MLS-MPM, the paper's: a grid is laid anew at every step, and solid may tear.
        "total" is total Lagrangian: the body keeps the lattice of its reference configuration, at a
        fraction of the cost, and stands on `ground`. Parts that come near push each other apart.
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
    material: Material = field(default_factory=Material)
    gravity: Vector = (0.0, 0.0)
    direction: Vector = (1.0, 0.0)
    particles_per_cell: int = 2
    filter_weights: tuple[float, float, float] = (0.64, 0.08, 0.01)
    filter_length: float = 0.0
    mirror: Mirror | None = None
    formulation: Formulation = "updated"
    transient: float = 0.0
    ground: tuple[Ground, ...] = ()
    clamps: tuple[Clamp, ...] = ()

    def __post_init__(self) -> None:
        for name, kind in (("grid", Grid), ("material", Material)):
            if not isinstance(getattr(self, name), kind):
                raise SceneError(f"Scene: {name} must be a {kind.__name__}")
        for name, part in (
            ("body", Region),
            ("walls", Wall),
            ("ground", Ground),
            ("clamps", Clamp),
        ):
            value = getattr(self, name)
            if not isinstance(value, (tuple, list)) or not all(isinstance(v, part) for v in value):
                raise SceneError(
                    f"Scene: {name} must be a tuple of {part.__name__} objects; a single one is "
                    f"written {name}=(...,)"
                )
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
            gravity=vector("Scene", "gravity", self.gravity),
            direction=vector("Scene", "direction", self.direction),
            particles_per_cell=count(
                "Scene", "particles_per_cell", self.particles_per_cell, 1, MOST_PER_CELL
            ),
            filter_length=number("Scene", "filter_length", self.filter_length),
            transient=number("Scene", "transient", self.transient),
            filter_weights=entries(
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
        for name in ("filter_length", "transient"):
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
        check_body(self)
        check_size(self)
        check_walls(self)
        check_ground(self)
        check_mirror(self)
        check_clamps(self)
        check_formulation(self)
        check_stability(self)

    def __str__(self) -> str:
        nx, ny = self.grid.cells
        kinds = [region.kind for region in self.body]
        body = ", ".join(f"{kinds.count(kind)} {kind}" for kind in dict.fromkeys(kinds))
        walls = ", ".join(
            f"{wall.axis} {'>' if wall.solid_side == 'below' else '<'} {wall.position:g} "
            f"({'stick' if wall.friction == 'stick' else f'friction {wall.friction:g}'})"
            for wall in self.walls
        )
        ground = "".join(
            f"; on ground from {ground.points[0]} to {ground.points[-1]}: {ground.profile} "
            f"(friction {ground.friction})"
            for ground in self.ground
        )
        if self.clamps:
            moved = sum(bool(clamp.path) for clamp in self.clamps)
            ground += f"; {len(self.clamps)} clamps, of which {moved} move"
        mirror = ""
        if self.mirror is not None:
            mirror = f", symmetric about {self.mirror.axis} = {self.mirror.position:g}"
        (gx, gy), (ex, ey) = self.gravity, self.direction
        return (
            f"Scene of {nx} x {ny} cells {self.grid.dx:g} wide, {self.steps} steps of "
            f"{self.time_step:g}: a body of regions {body}{mirror}; "
            f"free where {walls or 'the grid is'}{ground}; gravity ({gx:g}, {gy:g}); to travel "
            f"along ({ex:g}, {ey:g}){f' after {self.transient:g}' if self.transient_steps else ''}"
        )

    def _repr_png_(self) -> bytes:
        """A picture for notebooks."""
        from mpmopt.view import draw, schematic

        return draw.png(schematic.schematic(self), dpi=80)

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
        """Stability limit of an isolated particle (`Material.largest_time_step`).

        A particle in the total Lagrangian formulation bears 0.9 of it: `LAGRANGIAN_LIMIT` counts.
        So do parts that touch, whose pairs of particles have omega^2 up to 5.5 + 0.65 n^2 times
        (c_p / dx)^2 with n particles per cell and direction (measured, with the material's own).
        """
        return min(self.largest_time_step_of(material) for material in self.materials)

    def largest_time_step_of(self, material: Material) -> float:
        """`largest_time_step` for what is made of a material."""
        dx = self.grid.dx
        layer = max((layer.stiffness / layer.thickness for layer in self.layers), default=0.0)
        if self.formulation == "updated":
            return material.largest_time_step(dx, layer)
        # dt = 2 / omega, after the factor below.
        rate = 5.5 + 0.65 * self.particles_per_cell**2
        touching = 0.25 * rate * LAGRANGIAN_LIMIT**2 * material.density * material.wave_speed**2
        return LAGRANGIAN_LIMIT * material.largest_time_step(dx, layer, touching)

    @property
    def layers(self) -> tuple[Layer, ...]:
        """The layers of the ground, with numbers for all that follows from the scene."""
        return tuple(Layer.of(ground, self) for ground in self.ground)

    @property
    def extent(self) -> Vector:
        """Width and height of the body."""
        corners = [region.lower for region in self.body], [region.upper for region in self.body]
        return tuple(  # type: ignore[return-value]
            max(c[k] for c in corners[1]) - min(c[k] for c in corners[0]) for k in (0, 1)
        )

    @property
    def courant(self) -> float:
        """Courant number of pressure waves in the solid, c_p dt / dx; the fastest count."""
        return self.wave_speed * self.time_step / self.grid.dx

    @property
    def wave_speed(self) -> float:
        """Speed of the fastest pressure waves (`Material.wave_speed`)."""
        return max(material.wave_speed for material in self.materials)

    @property
    def materials(self) -> tuple[Material, ...]:
        """What the body is made of, each once."""
        return tuple(dict.fromkeys(self.material_of(region) for region in self.body))

    def material_of(self, region: Region) -> Material:
        """A region's own material, or the scene's."""
        return self.material if region.material is None else region.material

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
    def filter_spread(self) -> float:
        """Standard deviation of the filter: `filter_length`, but for whole passes."""
        _, w1, w2 = self.filter_weights
        return self.grid.dx * math.sqrt(0.5 + 2.0 * self.filter_passes * (w1 + 2.0 * w2))

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
        void_density: float | None = None,
        void_stiffness: float | None = None,
    ) -> Scene:
        """The same scene and duration with another time step or other floors.

        Floors are those of all materials.

        Parameters
        ----------
        time_step, void_density, void_stiffness : float, optional
            As in `Scene` and `Material`.

        Raises
        ------
        SceneError
            If the duration is no multiple of the new step, or the result cannot be simulated.
        """
        floors = {"void_density": void_density, "void_stiffness": void_stiffness}
        given = {name: value for name, value in floors.items() if value is not None}
        steps, material = self.steps, dataclasses.replace(self.material, **given)
        body = tuple(
            region
            if region.material is None
            else dataclasses.replace(region, material=dataclasses.replace(region.material, **given))
            for region in self.body
        )
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
        return dataclasses.replace(
            self, time_step=time_step, steps=steps, body=body, material=material
        )

    def to_json(self) -> str:
        """The scene as JSON text, from which `from_json` makes exactly the same scene."""
        return written(self)

    @staticmethod
    def from_json(text: str) -> Scene:
        """The scene that `to_json` wrote.

        Raises
        ------
        SceneError
            If the text is no JSON, keys are unknown or missing, or values do not fit.
        """
        scene: Scene = parsed(Scene, text)
        return scene
