"""Materials by Young's modulus, by region, and of real silicones."""

import dataclasses
import json

import numpy as np
import pytest
from conftest import small_scene, worst
from silicone import CELL, FOOT, LEFT, silicone_walker

from mpmopt.assess.threshold import solid_body
from mpmopt.assess.verify import DOT_TOLERANCE, complex_step_test, kernel_mismatches
from mpmopt.design.problem import Problem, Variables
from mpmopt.errors import SceneError
from mpmopt.kernels import PARAMETERS, ungrouped
from mpmopt.scene import SILICONES, Material, Mirror, Scene, Solid
from mpmopt.scene.particles import discretise
from mpmopt.simulation.reference import step

STIFF = Material(12.0, 16.0, 1.5, viscosity=0.01, void_stiffness=2e-3, void_density=2e-2)
SOFT = Material(6.0, 5.0, 0.8, void_stiffness=4e-3, void_density=3e-2)


def mixed_scene(**changes):
    """The small scene with a stiff design and a stiff solid, and a soft solid block on it."""
    scene = small_scene(time_step=2e-3, steps=40)
    c = scene.grid.dx
    design, left, beam, right = scene.body
    body = (
        dataclasses.replace(design, material=STIFF),
        left,
        dataclasses.replace(beam, material=STIFF),
        right,
        Solid((4 * c, 7 * c), (6 * c, 8 * c), material=SOFT),
    )
    return dataclasses.replace(scene, body=body, **changes)


def test_young_and_poisson_give_the_lame_constants_of_plane_strain():
    material = Material.from_young(young=100.0, poisson=0.25, density=2.0, viscosity=0.1)
    assert (material.lame_lambda, material.lame_mu) == pytest.approx((40.0, 40.0), rel=1e-14)
    assert (material.density, material.viscosity) == (2.0, 0.1)
    # In plane strain a bar has E / (1 - nu^2): mu (2 lambda + 2 mu) / (lambda + 2 mu) times two.
    la, mu = material.lame_lambda, material.lame_mu
    assert 4.0 * mu * (la + mu) / (la + 2.0 * mu) == pytest.approx(100.0 / (1.0 - 0.25**2))


@pytest.mark.parametrize("poisson", [0.5, -0.1, "soft"])
def test_what_is_incompressible_or_no_ratio_is_refused(poisson):
    with pytest.raises(SceneError, match="poisson"):
        Material.from_young(1.0, poisson, 1.0)


def test_silicones_have_the_moduli_of_their_data_sheets():
    # Nominal stress at twice the length of an incompressible neo-Hookean solid, in psi.
    for name, modulus in (("Ecoflex 00-30", 10.0), ("Dragon Skin 30", 86.0)):
        nominal = SILICONES[name].lame_mu * (2.0 - 2.0**-2)
        assert nominal / 6894.757 == pytest.approx(modulus, rel=1e-12)
    sylgard = SILICONES["Sylgard 184"]
    assert 3.0 * sylgard.lame_mu == pytest.approx(1.32e6)
    for material in SILICONES.values():
        poisson = material.lame_lambda / (2.0 * (material.lame_lambda + material.lame_mu))
        assert poisson == pytest.approx(0.45, rel=1e-12)
        assert material.modulus == pytest.approx(20.0 * material.lame_mu, rel=1e-12)
        assert 1000.0 < material.density < 1100.0


def test_each_particle_is_of_its_regions_material(rng):
    scene = mixed_scene()
    problem = Problem(scene, 2.0)
    x = problem.join(rng.uniform(-1.0, 1.0, 32), 0.9, -0.3, -0.5)
    simulation, field = problem.simulation(x), problem.chain.field(problem.split(x).phi)
    particles = problem.particles
    for k, region in enumerate(scene.body):
        own, material = particles.region == k, scene.material_of(region)
        low, high = np.array(region.lower), np.array(region.upper)
        inside = np.all((particles.position > low) & (particles.position < high), axis=1)
        assert np.array_equal(own, inside)
        for name, constants in zip(PARAMETERS, simulation.data.constants):
            values = ungrouped(constants, 1, len(own))[0][own]
            assert np.all(values == getattr(material, name))
        gamma = field.gamma if k == 0 else 1.0
        for values, solid, floor in (
            (field.density, material.density, material.void_density),
            (field.stiffness, 1.0, material.void_stiffness),
        ):
            expected = solid * ((1.0 - floor) * gamma + floor)
            assert values[own] == pytest.approx(expected * np.ones(own.sum()), rel=1e-14)
    binary = solid_body(scene, np.ones(32, bool), Variables(np.zeros(32), *np.zeros((3, 2))))
    mass = [scene.material_of(region).density for region in scene.body]
    expected = particles.volume * np.array(mass)[particles.region]
    assert ungrouped(binary.data.mass, 1, len(expected))[0] == pytest.approx(expected, rel=1e-14)


def test_the_gradient_of_a_body_of_several_materials_is_exact(rng):
    scene = mixed_scene()
    assert max(kernel_mismatches(scene).values()) <= DOT_TOLERANCE
    problem = Problem(scene, 2.0, halvings=0, limits=None)
    x = problem.join(rng.uniform(-1.0, 1.0, 32), [0.9, 0.5], [-0.3, 0.2], [-0.5, 0.1])
    assert worst(complex_step_test(problem, x)) <= 1e-12


def test_a_step_of_several_materials_is_what_the_equations_say(rng):
    # Some of them are viscous.
    scene = mixed_scene()
    problem = Problem(scene)
    simulation = problem.simulation(problem.join(0.3, 0.9, -0.3, -0.5))
    state = simulation.initial.copy()
    state[4:8] = rng.uniform(-20.0, 20.0, (4, state.shape[1]))
    state[8:12] += rng.uniform(-0.2, 0.2, (4, state.shape[1]))
    simulation.initial = state
    expected = step(simulation, state, 0)
    assert np.abs(simulation.run([1])[0] - expected).max() <= 1e-12 * np.abs(expected).max()


def test_a_scene_of_several_materials_is_checked_by_region():
    scene = mixed_scene()
    assert scene.materials == (STIFF, scene.material, SOFT)
    steps = [material.largest_time_step(scene.grid.dx) for material in scene.materials]
    assert scene.largest_time_step == min(steps) < max(steps)
    assert scene.wave_speed == max(material.wave_speed for material in scene.materials)
    with pytest.raises(SceneError, match=r"single particle of Design \(0\.1875, 0\.25\)"):
        mixed_scene(time_step=1.001 * steps[0])
    weak = Material(lame_mu=3.0)
    left = dataclasses.replace(scene.body[1], material=weak)
    with pytest.raises(SceneError, match=r"above -3, .* reach -4"):
        dataclasses.replace(scene, body=(scene.body[0], left, *scene.body[2:]))
    with pytest.raises(SceneError, match="Solid: material = 3 must be a Material"):
        Solid((0.0, 0.0), (1.0, 1.0), material=3)  # type: ignore[arg-type]


def test_other_floors_are_those_of_all_materials():
    scene = mixed_scene().vary(void_density=0.1)
    assert {material.void_density for material in scene.materials} == {0.1}
    assert {material.void_stiffness for material in scene.materials} == {1e-3, 2e-3, 4e-3}


def test_a_mirror_image_is_of_the_same_material():
    c = 1 / 16
    body = (
        Solid((4 * c, 4 * c), (6 * c, 6 * c), material=STIFF),
        Solid((10 * c, 4 * c), (12 * c, 6 * c), material=STIFF),
    )
    core = Solid((6 * c, 4 * c), (10 * c, 6 * c))
    mirrored = {"walls": (), "gravity": (0.0, 0.0), "direction": (0.0, 1.0), "time_step": 1e-3}
    mirrored["mirror"] = Mirror("x", 8 * c)
    small_scene(body=(*body, core), **mirrored)
    other = dataclasses.replace(body[1], material=SOFT)
    with pytest.raises(SceneError, match="no mirror image"):
        small_scene(body=(body[0], other, core), **mirrored)


def test_scenes_of_several_materials_go_to_json_and_back():
    for scene in (mixed_scene(), silicone_walker()):
        assert Scene.from_json(scene.to_json()) == scene
    old = json.loads(small_scene().to_json())
    for region in old["body"]:
        assert region.pop("material") is None
    del old["material"]["viscosity"]
    assert Scene.from_json(json.dumps(old)) == small_scene()


def test_a_silicone_robot_moves_in_metres_and_seconds():
    # With two slanted legs: it stands in the layer, 4.5 to 6 mm high, or hops, and goes some mm.
    scene = dataclasses.replace(silicone_walker(), steps=2000, transient=0.0)
    assert 0.5 < scene.time_step / scene.largest_time_step < 1.0
    assert max(scene.extent) == pytest.approx(0.06)
    particles = discretise(scene)
    x, y = (particles.position[particles.designed] - (LEFT, FOOT)).T / CELL
    keep = np.any([abs(x + 3.3 * (7 - y) / 7 - top) <= 1.0 for top in (12, 20, 21)], axis=0)
    actuation = np.array([[1.0], [-0.3], [-0.5], [0.0]])
    body = solid_body(scene, keep, Variables(np.zeros(0), *actuation))
    mass = float(body.data.mass.sum())  # kg per metre of depth
    assert 0.8 < mass < 1.1
    run = body.watch()
    assert run.indicators.courant < 1.0
    assert run.indicators.jacobian > 0.9
    end = run.states[scene.steps]
    assert 4.5e-3 < end[1].min() < 12e-3
    gone = (end[0] - body.initial[0])[~body.particles.designed].mean()
    assert 2e-3 < gone < 2e-2
