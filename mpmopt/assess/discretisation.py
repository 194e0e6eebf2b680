"""No more model than a scene needs: the cheapest discretisation that is accurate enough.

Found by measuring: a design is evaluated in one discretisation after the other, from the cheapest
on, and compared with the finest that is affordable.
"""

from __future__ import annotations

import itertools
import math
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import cache
from typing import Any, get_args

import numpy as np
from numpy.typing import NDArray

from mpmopt.assess.refinement import other_formulation
from mpmopt.assess.threshold import NO_GAIN
from mpmopt.design.problem import Problem
from mpmopt.design.step_control import LIMITS
from mpmopt.design.task import DEFAULT_TASK, Task
from mpmopt.design.term import Outcome
from mpmopt.design.variables import Variables
from mpmopt.errors import DesignError, SceneError, SimulationError
from mpmopt.scene import Actuator, Grid, Mirror, Scene
from mpmopt.scene.particles import mirror_images
from mpmopt.scene.scene import Formulation
from mpmopt.simulation.checkpoints import Checkpointing
from mpmopt.simulation.indicators import Indicators
from mpmopt.simulation.simulation import Precision
from mpmopt.validation import count, number

# The variables of one robot for whatever problem asks: a function of position, say.
Design = Callable[[Problem], NDArray[np.float64]]

COURANTS = (0.8, 0.6, 0.4, 0.2, 0.1)
# Cell counts are tried in these multiples of the scene's own; the reference is the last affordable.
MULTIPLES = (0.25, 0.5, 0.75, 1.0, 1.5, 2.0)
REFERENCE_COURANT = 0.4
# Of a candidate: multiple of the cells, particles per cell, Courant number, formulation.
Key = tuple[float, int, float, Formulation]


@dataclass(frozen=True)
class Discretisation:
    """How finely, and with which arithmetic, a scene is simulated.

    Attributes
    ----------
    cells : tuple of int
        Cells along x and y.
    steps : int
        Time steps over the scene's duration.
    particles_per_cell : int
        Particles per cell and direction.
    precision : "double" or "single"
    mirror : Mirror or None
        Plane of symmetry below which the body is simulated.
    formulation : "updated" or "total"
        As in `Scene`.
    """

    cells: tuple[int, int]
    steps: int
    particles_per_cell: int = 2
    precision: Precision = "double"
    mirror: Mirror | None = None
    formulation: Formulation = "updated"

    def __str__(self) -> str:
        (nx, ny), k = self.cells, self.particles_per_cell
        half = ", half the body" if self.mirror else ""
        return (
            f"{self.formulation}, {nx} x {ny} cells, {self.steps} steps, {k} x {k} a cell, "
            f"{self.precision}{half}"
        )

    @classmethod
    def of(
        cls, scene: Scene, multiple: float = 1.0, courant: float | None = None, **changes: Any
    ) -> Discretisation:
        """That of a scene, with so many times its cells along each axis at a Courant number.

        Raises
        ------
        SceneError
            If that is no whole number of cells.
        """
        nx, ny = (multiple * n for n in scene.grid.cells)
        if nx != round(nx) or ny != round(ny):
            raise SceneError(f"{multiple:g} times {scene.grid.cells} cells is no whole number")
        courant = scene.courant if courant is None else courant
        steps = scene.duration * scene.wave_speed * multiple / scene.grid.dx / courant
        cells = round(nx), round(ny)
        own = cls(
            cells,
            math.ceil(steps - 1e-6),
            scene.particles_per_cell,
            mirror=scene.mirror,
            formulation=scene.formulation,
        )
        return replace(own, **changes)

    def scene(self, scene: Scene) -> Scene:
        """The scene in this discretisation.

        Raises
        ------
        SceneError
            If it cannot be: edges between particles, a step that is too long, walls in the total
            Lagrangian formulation.
        """
        return replace(
            scene,
            grid=Grid(self.cells, scene.grid.size[0] / self.cells[0]),
            time_step=scene.duration / self.steps,
            steps=self.steps,
            particles_per_cell=self.particles_per_cell,
            mirror=self.mirror,
            formulation=self.formulation,
        )

    def problem(self, scene: Scene, beta: float, **options: Any) -> Problem:
        """The problem of the scene in this discretisation, with further options."""
        return Problem(self.scene(scene), beta, precision=self.precision, **options)


@dataclass(frozen=True)
class Measured:
    """One value and gradient: what it gave and what it cost.

    Attributes
    ----------
    discretisation : Discretisation
    seconds : float
        Of processor time, all threads together; compiling is not counted.
    megabytes : float
        Memory for states and nodes that the schedule of checkpoints takes.
    distance : float
        Objective L less where the body starts.
    gradient : (M,) array
        Its `density`.
    failure : str
        Why there are no numbers, or empty.
    size : float
        Longest side of the grid: a distance of less than 1e-12 of it is rounding.
    """

    discretisation: Discretisation
    seconds: float = math.nan
    megabytes: float = math.nan
    distance: float = math.nan
    gradient: NDArray[np.float64] = field(default_factory=lambda: np.empty(0), repr=False)
    failure: str = ""
    size: float = 0.0

    def errors(self, reference: Measured) -> tuple[float, float, float]:
        """Relative error of distance, relative error of the gradient, and the angle in degrees.

        Against a reference whose gradient is summed over the same patches. Of a body that goes no
        distance, relative to what rounding may do.
        """
        if self.failure or reference.failure:
            return math.nan, math.nan, math.nan
        one, other = self.gradient, reference.gradient
        lengths = float(np.linalg.norm(one)), float(np.linalg.norm(other))
        rounding = NO_GAIN * reference.size

        def relative(difference: float, whole: float) -> float:
            scale = max(whole, rounding)
            return difference / scale if scale > 0.0 else math.inf if difference > 0.0 else 0.0

        distance = relative(abs(self.distance - reference.distance), abs(reference.distance))
        gradient = relative(float(np.linalg.norm(one - other)), lengths[1])
        if not all(lengths):
            return distance, gradient, math.nan
        cosine = float(one @ other) / (lengths[0] * lengths[1])
        return distance, gradient, math.degrees(math.acos(min(1.0, max(-1.0, cosine))))


def density(
    problem: Problem, gradient: NDArray[np.float64], patch: float, plane: Mirror | None = None
) -> NDArray[np.float64]:
    """A gradient summed over squares of the plane, which lattices of particles have in common.

    Parameters
    ----------
    problem : Problem
    gradient : (n,) array
        With respect to its variables.
    patch : float
        Width of the squares, a multiple of the cells' width.
    plane : Mirror, optional
        Fold the body about it, so that whole and half bodies compare.

    Returns
    -------
    (M,) array
        Sums of dL/dphi over the squares of the whole grid, then those of the actuation.
    """
    particles = problem.particles
    position = particles.position[particles.designed]
    if plane is not None:
        across = position[:, plane.normal]
        position[:, plane.normal] = np.minimum(across, 2.0 * plane.position - across)
    phi, *actuation = Variables.of(gradient, problem.scene)
    return np.concatenate([sums(problem.scene, position, phi, patch), *actuation])


def sums(
    scene: Scene, position: NDArray[np.float64], values: NDArray[np.float64], patch: float
) -> NDArray[np.float64]:
    """Sums of values (...) at positions (..., 2) over squares of a width, of the whole grid."""
    columns, rows = (math.ceil(side / patch - 1e-6) for side in scene.grid.size)
    i, j = np.moveaxis(np.floor(position / patch).astype(int), -1, 0)
    found: Any = np.bincount((i * rows + j).ravel(), values.ravel(), columns * rows)
    return found


def timed(run: Callable[[], Any], repeats: int = 1) -> tuple[Any, float]:
    """What a function returns, and the fewest seconds of processor time that it took."""
    result, least = None, math.inf
    for _ in range(repeats):
        began = time.process_time()
        result = run()
        least = min(least, time.process_time() - began)
    return result, least


def measure(
    scene: Scene,
    discretisation: Discretisation,
    design: Design,
    beta: float,
    patch: float,
    *,
    subpixel: bool = False,
    void_cutoff: float = 0.0,
    checkpointing: Checkpointing | None = None,
    limits: Indicators | None = None,
    repeats: int = 1,
    task: Task = DEFAULT_TASK,
) -> Measured:
    """Objective and gradient of a design in one discretisation, and their cost.

    Parameters
    ----------
    scene : Scene
    discretisation : Discretisation
    design : callable
        From a `Problem` to its variables.
    beta, subpixel, void_cutoff, checkpointing, limits
        As in `Problem`, whose step is never halved here.
    patch : float
        Width of the squares over which the gradient is summed (`density`).
    repeats : int, optional
        Evaluations of which the fastest counts.
    task : Task, optional
        Whose objective is measured.

    Returns
    -------
    Measured
        A scene that cannot be, or a simulation that fails, says so there.
    """
    number("measure", "patch", patch, above=0.0, error=DesignError)
    count("measure", "repeats", repeats, 1, error=DesignError)
    try:
        problem = discretisation.problem(
            scene,
            beta,
            task=task,
            subpixel=subpixel,
            void_cutoff=void_cutoff,
            checkpointing=checkpointing,
            halvings=0,
            limits=limits,
        )
        x = design(problem)
        simulation = problem.simulation(x)
        rest = dict.fromkeys((*problem.task.instants(problem.scene), 0), simulation.initial)
        start = problem.task.maximise.value(Outcome(simulation, problem.gamma(x), rest))
        with simulation.checkpoints(problem.checkpointing) as store:
            schedule = store.schedule
        _compile(discretisation.precision, discretisation.formulation)
        evaluation, seconds = timed(lambda: problem.evaluate(x), repeats)
    except (SceneError, SimulationError) as error:
        return Measured(discretisation, failure=str(error))
    numbers = (schedule.segment + 1) * schedule.step_bytes
    stored = schedule.stored_bytes if schedule.in_memory else 0
    return Measured(
        discretisation,
        seconds,
        (numbers + stored) / 1e6,
        evaluation.value - start,
        density(problem, evaluation.gradient, patch, discretisation.mirror or scene.mirror),
        size=max(scene.grid.size),
    )


@cache
def _compile(precision: Precision, formulation: Formulation) -> None:
    """Compile the kernels, or load them, before a measurement would."""
    scene = Scene(Grid((8, 8), 1.0), 1e-3, 2, (Actuator((2.0, 2.0), (4.0, 4.0)),))
    here = Discretisation.of(scene, precision=precision, formulation=formulation)
    problem = here.problem(scene, 1.0)
    problem.value_and_gradient(problem.join(np.empty(0), 1.0, 0.0, 0.0))


@dataclass(frozen=True)
class Evidence:
    """One line of the table: a discretisation, its cost and its errors.

    Attributes
    ----------
    measured : Measured
    objective_error, gradient_error : float
        Relative to those of the reference in the same formulation.
    angle : float
        Between the two gradients, in degrees.
    within : bool
        Whether both errors are within the tolerance.
    """

    measured: Measured
    objective_error: float
    gradient_error: float
    angle: float
    within: bool

    def __str__(self) -> str:
        name = f"{self.measured.discretisation}"
        if self.measured.failure:
            return f"{name:<72}  failed: {self.measured.failure}"
        angle = "  none" if math.isnan(self.angle) else f"{self.angle:5.1f} deg"
        return (
            f"{name:<72}  {self.measured.seconds:8.3f} s  distance {self.measured.distance:10.4g}  "
            f"off by {self.objective_error:7.2%}  gradient {self.gradient_error:7.2%}, "
            f"{angle:<9}  {'within' if self.within else ''}"
        )


@dataclass(frozen=True)
class Cheapest:
    """What `cheapest` found.

    Attributes
    ----------
    best : Discretisation
        The cheapest within the tolerance; the scene's own formulation's reference if none is.
    reference : Measured
        The finest affordable in the formulation of the best.
    objective_uncertainty, gradient_uncertainty : float
        How far the next coarser cells at the same Courant number are from the reference: a
        tolerance below these says more than the reference knows.
    other_reference : Measured or None
        The finest affordable in the other formulation; None where the scene has only one.
    objective_apart, gradient_apart : float
        How far that is from the reference: what the formulations disagree by, or not a number.
    rows : tuple of Evidence
        All that was measured besides, in this order.
    tolerance, gradient_tolerance : float
        What was asked for.
    """

    best: Discretisation
    reference: Measured
    objective_uncertainty: float
    gradient_uncertainty: float
    other_reference: Measured | None
    objective_apart: float
    gradient_apart: float
    rows: tuple[Evidence, ...]
    tolerance: float
    gradient_tolerance: float

    @property
    def doubt(self) -> str:
        """Where the tolerances are below what the reference knows, a sentence that says so."""
        parts = (
            ("distance", self.objective_uncertainty, self.tolerance),
            ("the gradient", self.gradient_uncertainty, self.gradient_tolerance),
        )
        unknown = [
            f"{name} {'is not known at all' if math.isnan(own) else f'to {own:.3g}'}, asked for is "
            f"{asked:.3g}"
            for name, own, asked in parts
            if asked < math.inf and not own <= asked
        ]
        apart = [
            f"{name} by {own:.3g}"
            for name, own, asked in (
                ("distance", self.objective_apart, self.tolerance),
                ("the gradient", self.gradient_apart, self.gradient_tolerance),
            )
            if own > asked
        ]
        said = ""
        if unknown:
            said = f"The reference itself knows {'; '.join(unknown)}"
        if apart:
            said += "; the" if said else "The"
            said += f" references of both formulations differ in {', in '.join(apart)}"
        return said and (
            f"{said}: what is within that of it may be further from the truth. Allow more "
            "seconds, give a scene with finer cells, or ask for less."
        )


def carried(problem: Problem, x: NDArray[np.float64]) -> Design:
    """A design of one problem as one for all others, by `Problem.transfer`."""
    x = np.array(x)
    return lambda there: there.transfer(problem, x)


def symmetry(scene: Scene, design: Design, beta: float) -> Mirror | None:
    """The plane about which a scene and a design are symmetric: the scene's own, or one found."""
    if scene.mirror is not None:
        return scene.mirror
    corners = np.array([(region.lower, region.upper) for region in scene.body])
    middle = (corners.min(axis=(0, 1)) + corners.max(axis=(0, 1))) / 2.0
    for k in (0, 1):
        plane = Mirror("xy"[k], float(middle[k]))  # type: ignore[arg-type]
        try:
            half = Problem(replace(scene, mirror=plane), beta)
        except SceneError:
            continue
        whole = Problem(scene, beta)
        image = mirror_images(
            half.scene,
            half.particles.subset(half.particles.designed),
            whole.particles.subset(whole.particles.designed),
        )
        phi = half.split(design(half)).phi
        if np.allclose(whole.split(design(whole)).phi, phi[image], rtol=0.0, atol=1e-9):
            return plane
    return None


def cheapest(
    scene: Scene,
    design: NDArray[np.float64] | Design,
    tolerance: float,
    *,
    beta: float = 1.0,
    subpixel: bool = False,
    void_cutoff: float = 0.0,
    gradient_tolerance: float | None = None,
    seconds: float = 60.0,
    progress: Callable[[Evidence], None] | None = None,
    task: Task = DEFAULT_TASK,
) -> Cheapest:
    """The cheapest discretisation whose objective and gradient are within a tolerance.

    Of both formulations where the scene can be laid out in both, else of its own. In each, the
    finest cells that are affordable, up to twice the scene's own along each axis, at the largest
    Courant number up to 0.4 that does not fail, are the reference. The others are measured in order
    of what they should take, until one is within the tolerance of its formulation's reference and
    its neighbour with the next finer cells is too, so that no error that only happens to vanish is
    taken for accuracy. What goes beyond `step_control.LIMITS` counts as failed. Single precision
    is tried where double suffices, and taken where it took less time; one half is simulated where
    scene and design are symmetric. The filter keeps the scene's length.

    Parameters
    ----------
    scene : Scene
    design : (n,) array, or callable
        Variables of the scene's own `Problem`, or a function from any `Problem` to its variables.
    tolerance : float
        Relative, of the distance travelled and of the gradient as a density.
    beta, subpixel, void_cutoff : optional
        As in `Problem`.
    gradient_tolerance : float, optional
        Another tolerance for the gradient; infinity leaves it out.
    seconds : float, optional
        Processor time that each reference may take.
    progress : callable, optional
        Called with each line of evidence.
    task : Task, optional
        Whose objective is measured.

    Returns
    -------
    Cheapest

    Raises
    ------
    DesignError
        If the design does not fit, a tolerance or `seconds` is not above zero, or no reference can
        be had.
    """
    tolerance = number("cheapest", "tolerance", tolerance, above=0.0, error=DesignError)
    gradient_tolerance = _limit(
        "gradient_tolerance", tolerance if gradient_tolerance is None else gradient_tolerance
    )
    seconds = _limit("seconds", seconds)
    options: dict[str, Any] = {
        "subpixel": subpixel, "void_cutoff": void_cutoff, "limits": LIMITS, "task": task
    }  # fmt: skip
    if not callable(design):
        design = carried(Problem(scene, beta), design)
    # Half a body is the same solution, but another objective may not be symmetric.
    plane = symmetry(scene, design, beta) if task == DEFAULT_TASK else scene.mirror
    scene = replace(scene, filter_length=scene.filter_spread)
    grid = _candidates(scene, plane)
    patch = max(scene.grid.size[0] / item.cells[0] for item in grid.values())
    found: dict[Discretisation, Measured] = {}

    def result(item: Discretisation) -> Measured:
        if item not in found:
            found[item] = measure(scene, item, design, beta, patch, **options)
        return found[item]

    own = Discretisation.of(scene, mirror=plane)
    pace: dict[Formulation, float] = {}

    def finest(formulation: Formulation) -> Key:
        """The finest cells of a formulation that are affordable and do not fail."""
        mine = [key for key in grid if key[3] == formulation]
        tried = sorted((grid[key] for key in mine), key=_work)
        if formulation == scene.formulation:
            tried.insert(0, own)
        first = next((item for item in tried if not result(item).failure), None)
        if first is None:
            raise DesignError(f"cheapest: nothing could be simulated: {result(own).failure}")
        pace[formulation] = result(first).seconds / _work(first)
        affordable = [
            key
            for key in mine
            if key[1] == scene.particles_per_cell
            and key[2] <= REFERENCE_COURANT
            and not pace[formulation] * _work(grid[key]) > seconds
        ]
        affordable.sort(reverse=True)
        at = next((key for key in affordable if not result(grid[key]).failure), None)
        if at is None:
            failures = {result(grid[key]).failure for key in affordable}
            raise DesignError(
                f"cheapest: no reference could be simulated within seconds = {seconds:g}: "
                f"{'; '.join(failures) or 'allow more'}"
            )
        return at

    references = {scene.formulation: finest(scene.formulation)}
    with suppress(DesignError):
        other = other_formulation(scene)
        references[other] = finest(other)
    rows: dict[Discretisation, Evidence] = {}

    def reference_of(item: Discretisation) -> Measured:
        return result(grid[references[item.formulation]])

    def within(item: Discretisation) -> bool:
        if item not in rows:
            measured = result(item)
            objective, gradient, angle = measured.errors(reference_of(item))
            fits = objective <= tolerance and not gradient > gradient_tolerance
            rows[item] = Evidence(measured, objective, gradient, angle, fits)
            if progress is not None:
                progress(rows[item])
        return rows[item].within

    def expected(item: Discretisation) -> float:
        return pace[item.formulation] * _work(item)

    within(own)
    coarser: dict[Formulation, Discretisation] = {}
    for formulation, at in references.items():
        within(grid[at])
        below = [key for key in grid if key[0] < at[0] and key[1:] == at[1:]]
        if below:
            coarser[formulation] = grid[max(below)]
            within(coarser[formulation])
    best = grid[references[scene.formulation]]
    candidates = [key for key in grid if key[3] in references and key[0] <= references[key[3]][0]]
    for key in sorted(candidates, key=lambda key: expected(grid[key])):
        item = grid[key]
        if expected(item) >= expected(best):
            break
        finer = [other for other in candidates if key[0] < other[0] and other[1:] == key[1:]]
        if within(item) and (not finer or within(grid[min(finer)])):
            best = item
    single = replace(best, precision="single")
    in_single = best.formulation == "updated" and within(single)  # the other one has no single
    if in_single and result(single).seconds < result(best).seconds:
        best = single
    if plane is not None and scene.mirror is None:
        within(replace(best, mirror=None))
    reference, known, apart = reference_of(best), (math.nan, math.nan), (math.nan, math.nan)
    if best.formulation in coarser:
        known = result(coarser[best.formulation]).errors(reference)[:2]
    others = [result(grid[at]) for name, at in references.items() if name != best.formulation]
    if others:
        apart = others[0].errors(reference)[:2]
    return Cheapest(
        best,
        reference,
        *known,
        others[0] if others else None,
        *apart,
        tuple(rows.values()),
        tolerance,
        gradient_tolerance,
    )


def _limit(name: str, value: Any) -> float:
    """A number above zero, or infinity for no limit."""
    if isinstance(value, float) and value == math.inf:
        return math.inf
    return number("cheapest", name, value, above=0.0, error=DesignError)


def _candidates(scene: Scene, plane: Mirror | None) -> dict[Key, Discretisation]:
    """All in double precision that the scene can be laid out in."""
    grid = {}
    for multiple, formulation in itertools.product(MULTIPLES, get_args(Formulation)):
        for per_cell in sorted({2, 3, scene.particles_per_cell}):
            for courant in COURANTS:
                try:
                    item = Discretisation.of(
                        scene, multiple, courant, particles_per_cell=per_cell, mirror=plane,
                        formulation=formulation,
                    )  # fmt: skip
                    item.scene(scene)
                except SceneError:
                    continue
                grid[multiple, per_cell, courant, formulation] = item
    return grid


def _work(item: Discretisation) -> float:
    """What cost is proportional to in a formulation: particles of a full grid, times steps."""
    half = 0.5 if item.mirror else 1.0
    return half * math.prod(item.cells) * item.particles_per_cell**2 * item.steps
