"""Whether the parts of a scene fit together, and can be simulated."""

from __future__ import annotations

import dataclasses
import math
from typing import TYPE_CHECKING

import numpy as np

from mpmopt.errors import SceneError
from mpmopt.scene.parts import Actuator, Design, Mirror, Region
from mpmopt.validation import shown

if TYPE_CHECKING:
    from mpmopt.scene.scene import Scene

# Numbers in any one array: 0.8 GB. What a scene would take is known before any of it is taken.
MOST_NUMBERS = 10**8
# Edges may miss a lattice line by rounding, in units of its spacing.
ROUNDING = 1e-6


def check_body(scene: Scene) -> None:
    if not any(not isinstance(region, Design) for region in scene.body):
        raise SceneError(
            "Scene: the body has no Solid and no Actuator, but the objective is where these go"
        )
    dx, size = scene.grid.dx, scene.grid.size
    spacing = dx / scene.particles_per_cell
    for region in scene.body:
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
    for i, region in enumerate(scene.body):
        for other in scene.body[i + 1 :]:
            low, high = scene.lattice(region)
            other_low, other_high = scene.lattice(other)
            if all(low[k] < other_high[k] and other_low[k] < high[k] for k in (0, 1)):
                raise SceneError(
                    f"Scene: {type(region).__name__} {region.lower} to {region.upper} overlaps "
                    f"{type(other).__name__} {other.lower} to {other.upper}"
                )


def check_size(scene: Scene) -> None:
    """Refuse what would take more memory than there is, before any is taken."""
    corners = [scene.lattice(region) for region in scene.body]
    lower, upper = (
        [side(c[e][k] for c in corners) for k in (0, 1)] for e, side in ((0, min), (1, max))
    )
    areas = [(x1 - x0) * (y1 - y0) for (x0, y0), (x1, y1) in corners]
    particles, actuators = sum(areas), len(scene.actuators)
    waves = sum(actuator.harmonics for actuator in scene.actuators)
    nodes = math.prod((b - a) // scene.particles_per_cell + 4 for a, b in zip(lower, upper))
    designed = sum(a for a, region in zip(areas, scene.body) if isinstance(region, Design))
    neighbours = min(designed, scene.filter_neighbours)
    for what, numbers, cure in (
        (f"{particles} particles", 12 * particles, "larger cells or fewer particles per cell"),
        (f"a body that spans {nodes} nodes", 4 * nodes, "larger cells or a smaller body"),
        (
            f"{actuators} actuators of {particles} particles",
            actuators * particles,
            "fewer actuators",
        ),
        (
            f"{scene.steps} signals of {actuators} actuators",
            waves * scene.steps,
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


def check_walls(scene: Scene) -> None:
    slack = ROUNDING * scene.grid.dx
    for wall in scene.walls:
        k = "xy".index(wall.axis)
        dx, size = scene.grid.dx, scene.grid.size[k]
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
        for region in scene.body:
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


def check_mirror(scene: Scene) -> None:
    mirror = scene.mirror
    if mirror is None:
        return
    if not isinstance(mirror, Mirror):
        raise SceneError("Scene: mirror must be a Mirror or None")
    name, k, dx = (
        f"Scene: mirror at {mirror.axis} = {mirror.position:g}",
        mirror.normal,
        scene.grid.dx,
    )
    if abs(mirror.position / dx - round(mirror.position / dx)) > ROUNDING:
        raise SceneError(
            f"{name} is on no line of nodes; the nearest is at "
            f"{round(mirror.position / dx) * dx:.10g}"
        )
    for what, vector in (("gravity", scene.gravity), ("direction", scene.direction)):
        if vector[k] != 0.0:
            raise SceneError(f"{name}: {what} {vector} has a component across it, must have 0")
    there = {(type(r), scene.lattice(r), scene.material_of(r)) for r in scene.body}
    for region in scene.body:
        low, high = mirror.image(region.lower), mirror.image(region.upper)
        corners = (
            (min(low[0], high[0]), min(low[1], high[1])),
            (max(low[0], high[0]), max(low[1], high[1])),
        )
        image = scene.lattice(Region(*corners))
        where = f"{type(region).__name__} {region.lower} to {region.upper}"
        if (type(region), image, scene.material_of(region)) not in there:
            raise SceneError(f"{name}: {where} has no mirror image in the body; add it")
        if isinstance(region, Actuator) and (
            image != scene.lattice(region) or region.stress[0][1] != 0.0
        ):
            raise SceneError(
                f"{name}: {where} must be its own mirror image with S_xy = 0, has S_xy = "
                f"{region.stress[0][1]:g}; simulate the whole body instead"
            )
    for wall in scene.walls:
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
            for other in scene.walls
        ):
            raise SceneError(
                f"{name}: the wall at {wall.axis} = {wall.position:g} has no mirror image at "
                f"{image_wall.position:g}; add it"
            )
    for k, ground in enumerate(scene.ground):
        mirrored = ground.image(mirror.normal, mirror.position)
        if not any(other.same(mirrored) for other in scene.ground):
            raise SceneError(
                f"{name}: ground {k} has no mirror image, with points {shown(mirrored.points)}; "
                "add it"
            )


def check_formulation(scene: Scene) -> None:
    if scene.formulation not in ("updated", "total"):
        raise SceneError(
            f'Scene: formulation = {shown(scene.formulation)} must be "updated" or "total"'
        )
    if scene.formulation == "updated":
        return
    if scene.walls:
        raise SceneError(
            f'Scene: the formulation "total" has no grid for {len(scene.walls)} walls; stand the '
            'body on a Ground, or take "updated"'
        )
    for number, clamp in enumerate(scene.clamps):
        if not any(
            all(clamp.lower[k] <= part.upper[k] and part.lower[k] <= clamp.upper[k] for k in (0, 1))
            for part in scene.body
        ):
            raise SceneError(
                f"Scene: clamp {number}, {clamp.lower} to {clamp.upper}, holds nothing of the body "
                'at first, and the formulation "total" takes up nothing later; move it onto the '
                'body, or take "updated"'
            )


def check_stability(scene: Scene) -> None:
    for region in scene.body:
        limit = scene.material_of(region).largest_time_step(scene.grid.dx)
        if scene.formulation == "total":
            limit = scene.largest_time_step_of(scene.material_of(region))
        if scene.time_step <= limit:
            continue
        raise SceneError(
            f"Scene: time_step = {scene.time_step:g} is over the stability limit "
            f"{limit:g} of a single particle of {region}; take a smaller step, larger "
            "cells, a void density that is not below the void stiffness, or less viscosity"
        )
    for actuator in scene.actuators:
        largest = actuator.largest_signal * np.abs(np.linalg.eigvalsh(actuator.stress)).max()
        bearable = scene.material_of(actuator).elliptic_limit
        if bearable - largest <= 0.0:
            raise SceneError(
                f"Scene: ellipticity can be lost: the material bears actuation stresses above "
                f"-{bearable:g}, but they can reach -{largest:g} at a signal of "
                f"{actuator.largest_signal:g}; take a weaker actuator or a stiffer material"
            )
