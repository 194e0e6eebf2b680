"""Filter, projection, interpolation."""

import dataclasses
import math
from typing import Any

import numpy as np
import pytest
from conftest import small_scene
from walker import walker

from mpmopt.assess.discretisation import Discretisation, measure
from mpmopt.design.chain import (
    DesignChain,
    filter_matrix,
    interpolate,
    non_discreteness,
)
from mpmopt.design.problem import Problem
from mpmopt.design.projection import (
    REACH,
    lattice_differences,
    project,
    project_adjoint,
    project_subpixel,
    project_subpixel_adjoint,
)
from mpmopt.errors import DesignError
from mpmopt.scene import Design, Grid, Material, Scene, Solid
from mpmopt.scene.particles import discretise


def test_filter_keeps_constants_and_never_amplifies():
    scene = walker(64, 8e-4)
    matrix = filter_matrix(scene, discretise(scene))
    assert matrix.sum(axis=1) == pytest.approx(1.0, abs=1e-14)
    assert matrix.data.min() >= 0.0


def literal_filter(scene, phi):
    """The paper's three steps, loop by loop, on grid nodes that carry design particles."""
    particles = discretise(scene)
    position = particles.position[particles.designed]
    dx = scene.grid.dx
    weight: dict[Any, float] = {}
    value: dict[Any, float] = {}

    def near(x):
        i, j = (int(c / dx - 0.5) for c in x)
        for a in range(3):
            for b in range(3):
                w = 1.0
                for k, c in ((i + a, x[0]), (j + b, x[1])):
                    r = abs(c / dx - k)
                    w *= 0.75 - r**2 if r < 0.5 else 0.5 * (1.5 - r) ** 2
                if w > 0.0:
                    yield (i + a, j + b), w

    for x, v in zip(position, phi, strict=True):
        for node, w in near(x):
            weight[node] = weight.get(node, 0.0) + w
            value[node] = value.get(node, 0.0) + w * v
    value = {node: value[node] / weight[node] for node in value}
    w0, w1, w2 = scene.filter_weights
    smooth = {}
    for i, j in value:
        total = share = 0.0
        for a in (-1, 0, 1):
            for b in (-1, 0, 1):
                if (i + a, j + b) in value:
                    w = (w0, w1, w2)[abs(a) + abs(b)]
                    total += w * value[i + a, j + b]
                    share += w
        smooth[i, j] = total / share
    return [sum(w * smooth[node] for node, w in near(x)) for x in position]


@pytest.mark.parametrize("per_cell", [1, 2])
def test_filter_is_the_papers_three_steps(rng, per_cell):
    c = 1 / 16
    # An L-shaped design domain around a solid corner.
    body = (
        Design((3 * c, 4 * c), (7 * c, 6 * c)),
        Design((3 * c, 6 * c), (5 * c, 8 * c)),
        Solid((5 * c, 6 * c), (7 * c, 8 * c)),
    )
    scene = small_scene(body=body, walls=(), particles_per_cell=per_cell)
    matrix = filter_matrix(scene, discretise(scene))
    phi = rng.uniform(-1.0, 1.0, matrix.shape[1])
    assert matrix @ phi == pytest.approx(literal_filter(scene, phi), abs=1e-14)


def test_filter_does_not_wrap_round_the_edge_of_the_grid(rng):
    dx = 1 / 8
    scene = Scene(
        Grid((8, 8), dx), 1e-3, 1,
        body=(Design((dx, dx), (7 * dx, 6 * dx)), Solid((dx, 6 * dx), (7 * dx, 7 * dx))),
    )  # fmt: skip
    matrix = filter_matrix(scene, discretise(scene))
    phi = rng.uniform(-1.0, 1.0, matrix.shape[1])
    assert matrix @ phi == pytest.approx(literal_filter(scene, phi), abs=1e-14)


@pytest.mark.parametrize("per_cell", [1, 2, 3])
@pytest.mark.parametrize("length", [0.0, 2.0, 3.0])
def test_the_filter_does_not_depend_on_the_unit_of_length(rng, per_cell, length):
    # Lattice sites, edges and halves of cells are where they are but for rounding.
    phi, gamma = rng.uniform(-1.0, 1.0, 24 * per_cell**2), []
    for dx in (1 / 64, 1 / 22, 1 / 7, 0.1, 7.0):
        scene = Scene(
            Grid((20, 20), dx), 1e-4 * dx, 1, filter_length=length * dx,
            particles_per_cell=per_cell,
            body=(
                Design((4 * dx, 4 * dx), (10 * dx, 8 * dx)),
                Solid((4 * dx, 8 * dx), (10 * dx, 9 * dx)),
            ),
        )  # fmt: skip
        gamma.append(DesignChain(scene, discretise(scene), 8.0).field(phi).gamma)
    assert np.ptp(gamma, axis=0).max() <= 1e-14


@pytest.mark.parametrize("beta", [1.0, 7.0, 32.0])
@pytest.mark.parametrize("end", [-1.0, 1.0])
def test_no_particle_is_more_than_solid_or_less_than_void(beta, end):
    # Weights sum to one but for rounding, which must take no particle beyond its bounds.
    c = 1 / 16
    body = (Design((4 * c, 4 * c), (8 * c, 8 * c)), Solid((4 * c, 8 * c), (8 * c, 9 * c)))
    problem = Problem(Scene(Grid((16, 16), c), 1e-3, 1, body), beta)
    x = problem.join(end, *3 * [np.empty(0)])
    gamma = problem.gamma(x)
    assert 0.0 <= gamma.min() <= gamma.max() <= 1.0
    assert gamma == pytest.approx(float(end > 0.0), abs=1e-14)
    assert problem.present(problem.split(x).phi).all()


@pytest.mark.parametrize("length", [1 / 64, 1 / 80])
def test_a_filter_length_is_the_same_on_every_grid(length):
    fields = []
    for n in (64, 128):
        c = 1 / 64
        scene = Scene(
            Grid((n, n), 1 / n), 1e-4, 1, filter_length=length,
            body=(
                Design((24 * c, 24 * c), (40 * c, 40 * c)),
                Solid((24 * c, 40 * c), (40 * c, 42 * c)),
            ),
        )  # fmt: skip
        particles = discretise(scene)
        x, y = particles.position[particles.designed].T - 0.5
        matrix = filter_matrix(scene, particles)
        assert matrix.sum(axis=1) == pytest.approx(1.0, abs=1e-13)
        # Of a particle in the middle, far from the edges.
        middle = np.argmin(x**2 + y**2)
        weights = matrix[[middle]].toarray()[0]
        variance = weights @ (x - x[middle]) ** 2, weights @ (y - y[middle]) ** 2
        # The nearest number of passes: within half a pass, 0.1 cells^2, of what was asked for.
        assert variance == pytest.approx([length**2] * 2, abs=0.12 / n**2)
        step = matrix @ np.where(x > 0.0, 1.0, -1.0)
        fields.append(np.interp(np.linspace(-0.1, 0.1, 9), x[y == y[middle]], step[y == y[middle]]))
    assert fields[0] == pytest.approx(fields[1], abs=0.02)


def test_a_filter_length_below_one_pass_is_one_pass(scene):
    assert scene.filter_passes == dataclasses.replace(scene, filter_length=1e-3).filter_passes == 1


@pytest.mark.parametrize("beta", [0.5, 1.0, 16.0])
def test_projection_hits_its_ends_and_is_odd_about_a_half(beta):
    assert project(np.array([-1.0, 0.0, 1.0]), beta) == pytest.approx([0.0, 0.5, 1.0], abs=1e-15)
    phi = np.linspace(-1.0, 1.0, 21)
    gamma = project(phi, beta)
    assert np.all(np.diff(gamma) >= 0.0)
    assert gamma + gamma[::-1] == pytest.approx(1.0, abs=1e-15)


def test_interpolation_reaches_solid_and_both_floors():
    material = Material(2.0, 3.0, density=5.0, void_stiffness=1e-3, void_density=1e-2)
    density, stiffness = interpolate(material, np.array([0.0, 0.5, 1.0]))
    assert density == pytest.approx([0.05, 2.525, 5.0], rel=1e-14)
    assert stiffness == pytest.approx([1e-3, 0.5005, 1.0], rel=1e-14)


def test_undesigned_particles_are_solid_whatever_the_design(scene):
    particles = discretise(scene)
    chain = DesignChain(scene, particles, 1.0)
    for density in (chain.field(np.full(particles.designed.sum(), v)).density for v in (-1.0, 1.0)):
        assert np.all(density[~particles.designed] == scene.material.density)


def test_greyness():
    assert non_discreteness(np.array([0.0, 1.0])) == 0.0
    assert non_discreteness(np.full(3, 0.5)) == 1.0
    assert non_discreteness(np.full(3, 0.25)) == 0.75
    assert non_discreteness(np.zeros(0)) == 0.0


@pytest.mark.parametrize("beta", [0.0, -1.0, np.nan, np.inf])
def test_senseless_beta_is_refused(scene, beta):
    with pytest.raises(DesignError, match="beta"):
        DesignChain(scene, discretise(scene), beta)


def test_a_body_without_design_domain_has_no_variables_to_filter():
    scene = small_scene()
    scene = dataclasses.replace(scene, body=scene.body[1:])
    chain = DesignChain(scene, discretise(scene), 1.0)
    field = chain.field(np.zeros(0))
    assert field.gamma.shape == (0,)
    assert np.all(field.density == 1.0)


@pytest.mark.parametrize("beta", [1.0, 16.0, 32.0])
def test_the_slope_of_the_projection_keeps_its_digits_where_it_saturates(beta):
    # d gamma / d phi = beta / (2 tanh beta cosh^2 beta phi), which 1 - tanh^2 would cancel to zero.
    phi = np.array([-1.0, 0.7, 1.0])
    exact = [beta / (2.0 * math.tanh(beta) * math.cosh(beta * p) ** 2) for p in phi]
    assert project_adjoint(phi, beta, np.ones(3)) == pytest.approx(exact, rel=1e-13)


def field_of(scene, function):
    """A function of position on the design particles, in units of their spacing from a corner."""
    particles = discretise(scene)
    place = particles.position[particles.designed]
    spacing = scene.grid.dx / scene.particles_per_cell
    return particles, function(*((place - place.min(axis=0)) / spacing).T)


def test_differences_are_exact_for_a_quadratic_field_inside():
    particles, field = field_of(small_scene(), lambda x, y: 2.0 * x - y + 0.5 * x**2 + 3.0 * x * y)
    x, y = field_of(small_scene(), lambda x, y: np.array([x, y]))[1]
    inside = (x > 1) & (x < x.max() - 1) & (y > 1) & (y < y.max() - 1)
    dx, dy, xx, yy, xy = (
        (matrix @ field)[inside] for matrix in lattice_differences(small_scene(), particles)
    )
    assert dx == pytest.approx((2.0 + x + 3.0 * y)[inside])
    assert dy == pytest.approx((-1.0 + 3.0 * x)[inside])
    assert xx == pytest.approx(REACH * 1.0) and yy == pytest.approx(0.0, abs=1e-12)
    assert xy == pytest.approx(math.sqrt(2.0) * REACH * 3.0)


@pytest.mark.parametrize("slope", [1e-3, 0.1, 1.0])
def test_a_subpixel_edge_is_as_wide_as_a_particle_however_slowly_the_design_varies(slope):
    particles, field = field_of(small_scene(), lambda x, y: slope * (x - 4.25))
    differences = lattice_differences(small_scene(), particles)
    gamma = project_subpixel(field, 100.0, 0.5, differences)
    x = field / slope
    assert np.all(gamma[x < -REACH] < 0.5 * math.exp(-100.0 * slope) + 1e-12)
    grey = (gamma > 0.01) & (gamma < 0.99)
    assert np.all(abs(x[grey]) < max(REACH, 0.03 / slope))
    if slope >= 0.1:  # a quarter of a spacing inside, where the curve and no tanh says how much
        assert gamma[np.isclose(x, 0.25)] == pytest.approx(0.885, abs=0.05)


def test_a_design_that_does_not_vary_is_projected_as_ever():
    particles, field = field_of(small_scene(), lambda x, y: np.full(x.shape, 0.3))
    gamma = project_subpixel(field, 4.0, 0.4, lattice_differences(small_scene(), particles))
    assert gamma == pytest.approx(project(field, 4.0, 0.4), rel=1e-12)


@pytest.mark.parametrize("beta", [2.0, 100.0])
@pytest.mark.parametrize("threshold", [0.4, 0.5])
def test_the_adjoint_of_the_subpixel_projection_is_its_complex_step(beta, threshold):
    rng = np.random.default_rng(3)
    particles, field = field_of(small_scene(), lambda x, y: rng.uniform(-0.9, 0.9, x.shape))
    differences = lattice_differences(small_scene(), particles)
    direction, bar = rng.standard_normal((2, field.size))
    moved = project_subpixel(field + 1e-30j * direction, beta, threshold, differences)
    phi_bar = project_subpixel_adjoint(field, beta, bar, threshold, differences)
    assert direction @ phi_bar == pytest.approx(bar @ moved.imag / 1e-30, rel=1e-12)


def test_a_subpixel_design_is_measured_as_such_in_other_discretisations():
    scene = small_scene(steps=4)
    _, field = field_of(scene, lambda x, y: 0.02 * (x - 3.3))
    plain, subpixel = (
        measure(
            scene,
            Discretisation.of(scene),
            lambda problem: problem.join(field, 0.5, 0.0, 0.0),
            2.0,
            scene.grid.dx,
            subpixel=whether,
        )
        for whether in (False, True)
    )
    assert not plain.failure and not subpixel.failure
    problems = [Problem(scene, 2.0, subpixel=whether) for whether in (False, True)]
    own, other = (problem.value(problem.join(field, 0.5, 0.0, 0.0)) for problem in problems)
    assert own != other
    assert subpixel.distance - plain.distance == pytest.approx(other - own, abs=1e-14)


@pytest.mark.parametrize("subpixel", [False, True])
def test_all_particles_are_simulated_where_no_void_is_cut_off(rng, subpixel):
    # In complex arithmetic gamma of void is below zero by rounding.
    problem = Problem(small_scene(), 100.0, subpixel=subpixel)
    phi = np.where(rng.uniform(size=problem.size - 3) > 0.5, 1.0, -1.0)
    assert problem.present(phi).all()
    assert problem.present(phi + 1e-30j * rng.standard_normal(phi.size)).all()
