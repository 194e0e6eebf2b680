"""The chart of speed against accuracy, at tiny sizes."""

import csv
import math
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import h5py
import numpy as np
import pytest
import speed_accuracy
from exact import Bar
from speed_accuracy import (
    BETA,
    MORE_PARTICLES,
    PATCH,
    PLAIN,
    ROBOTS,
    SINGLE,
    TOTAL,
    Bench,
    Point,
    at_equal_accuracy,
    design,
    front,
    in_patches,
    robots,
    settings,
    sound,
)

from mpmopt.assess.discretisation import Discretisation, Measured, density
from mpmopt.errors import SceneError, SweepError
from mpmopt.scene.particles import discretise

BARS = (("bar", "updated"), ("bar", "total"))


@pytest.mark.parametrize("name", ROBOTS)
def test_a_robot_is_the_same_on_all_cells_and_so_is_what_its_gradient_tells(name):
    scene, phi = ROBOTS[name]
    solid, tells = [], []
    for n in (64, 128):
        laid = Discretisation.of(scene, n / scene.grid.cells[1], 0.2)
        problem = laid.problem(scene, BETA)
        x = design(phi)(problem)
        volume = problem.particles.volume[0]
        position = problem.particles.position[problem.particles.designed]
        solid.append(density(problem, problem.join(
            volume * problem.gamma(x), 0.0, 0.0, 0.0), PATCH))  # fmt: skip
        # A derivative by gamma that is given as a function of position.
        gamma_bar = volume * np.sin(40.0 * position.sum(axis=1))
        bar = np.zeros(len(problem.particles.position))
        bar[problem.particles.designed] = gamma_bar
        phi_bar = problem.chain.field(problem.split(x).phi).pullback(0.0 * bar, bar)
        by_cell = density(problem, problem.join(phi_bar, 0.0, 0.0, 0.0), 1 / n)
        tells.append(in_patches(problem.scene, by_cell))
        assert tells[-1].sum() == pytest.approx(phi_bar.sum())
    for coarse, fine in (solid, tells):
        assert np.linalg.norm(coarse - fine) < 0.06 * np.linalg.norm(fine)


def bar_errors(n, courant, **options):
    bar = Bar(n, courant, **options)
    (distance, gradient), (exact, exact_gradient) = bar.value_and_gradient(), bar.exact()
    error = np.linalg.norm(gradient - exact_gradient) / np.linalg.norm(exact_gradient)
    return abs(distance / exact - 1.0), error


def test_the_bar_is_off_by_the_volumes_of_the_step_before():
    # Weighed by volumes one step old, the middle is dt (2 / pi - 1 / 2) v0 cos(w t) farther: in
    # units of v0 / (2 w) sin(w t), and with w t = 2 pi + pi / 4, that is (4 / pi - 1) w dt.
    bar = Bar(64, 0.8)
    step = bar.simulation.scene.time_step
    distance, gradient = bar_errors(64, 0.8)
    assert distance == pytest.approx((4.0 / np.pi - 1.0) * bar.omega * step, rel=0.05)
    assert gradient <= 1.2 * distance


def test_the_bar_and_its_gradient_converge_with_cells_and_step_together():
    errors = np.array([bar_errors(n, 0.8) for n in (16, 32, 64)])
    order = np.log2(errors[:-1] / errors[1:])
    assert np.all(order[0] >= 0.55)
    assert np.all(order[1] >= 0.8)


def test_at_small_steps_the_bar_is_right_to_the_order_of_the_cells():
    coarse, fine = np.array([bar_errors(n, 0.1) for n in (16, 32)])
    assert np.all(coarse <= 6e-3)
    assert np.all(fine <= 1e-3)


def test_the_total_lagrangian_bar_converges_with_order_two_at_a_fixed_courant_number():
    errors = np.array([bar_errors(n, 0.4, formulation="total") for n in (8, 16, 32)])
    assert np.all(np.log2(errors[:-1] / errors[1:]) >= 1.8)
    assert np.all(errors[-1] <= 3e-3)
    with pytest.raises(SceneError, match="stability limit"):
        Bar(16, 0.8, formulation="total")


def test_the_time_at_equal_accuracy_is_of_points_that_are_not_right_by_chance():
    def point(n, seconds, error, choice=PLAIN, courant=0.4):
        here = Discretisation((n, n), 1, formulation=choice.formulation)
        measured = Measured(here, seconds, distance=1.0)
        return Point("bar", n, 1, courant, choice.name, measured, distance_error=error)

    points = [
        point(32, 1.0, 0.009), point(64, 4.0, 0.1), point(128, 16.0, 0.01),
        point(32, 0.5, 0.2, TOTAL), point(64, 2.0, 0.01, TOTAL), point(128, 8.0, 0.002, TOTAL),
        point(64, 0.1, 0.001, courant=0.6),  # a step that no finer cells bear
    ]  # fmt: skip
    rows = {row["off by at most"]: row for row in at_equal_accuracy(points, {"bar": (0.003, 1.0)})}
    assert rows["20 %"]["times"] == "2.0"  # 1 s and 0.5 s
    # 32 cells are right by chance; between 64 and 128 an error of 0.1 times 0.5, whose tenth costs
    # four times as much, against one of 0.2 times 0.25, whose twentieth does.
    updated, total = 4.0 * 4.0 ** math.log10(2.0), 0.5 * 4.0 ** math.log(4.0, 20.0)
    assert rows["5 %"]["updated"] == "n = 64 to 128, Courant 0.4, 2 x 2 a cell, double"
    assert float(rows["5 %"]["updated, s"]) == pytest.approx(updated, rel=5e-3)
    assert float(rows["5 %"]["total, s"]) == pytest.approx(total, rel=5e-3)
    assert float(rows["5 %"]["times"]) == pytest.approx(updated / total, rel=1e-2)
    assert rows["0.5 %"]["updated"] == "none"
    assert rows["1 %"]["known to"] == "0.30%"
    assert [*rows][-1] == "0.5 %"  # what the reference itself does not know is left out


def swept(n, choice=PLAIN, seconds=0.4, **errors):
    """Points of the bar by Courant number, with errors of the distance that are ten times those of
    the gradient; a halved step takes twice the time."""
    points = []
    for name, error in errors.items():
        courant = float(name.replace("c", "0."))
        here = Discretisation((n, n), 1, formulation=choice.formulation)
        measured = Measured(here, seconds / courant, distance=1.0)
        points.append(
            Point("bar", n, round(1200 / courant), courant, choice.name, measured,
                  distance_error=error, gradient_error=0.1 * error)
        )  # fmt: skip
    return points


def counts(points, choice, error="distance_error", n=64):
    mine = [p for p in sound(points) if (p.n, p.choice) == (n, choice.name)]
    return {p.courant: getattr(p, error) for p in mine}


def test_what_is_lost_when_the_step_is_refined_does_not_count():
    points = [
        *swept(64, c05=0.5, c2=0.07, c4=0.01, c6=0.0, c8=0.2),
        *swept(64, TOTAL, c2=0.03, c3=0.04, c4=0.02),
        *swept(64, SINGLE, c4=0.02, c8=0.1),
        *swept(64, MORE_PARTICLES, c4=0.001),
        *swept(128, c4=0.002),
    ]
    # What 0.05 loses counts against no point: finer cells were not measured with it.
    wanted = {0.2: 0.07, 0.4: 0.07, 0.6: 0.07, 0.8: 0.2}
    assert counts(points, PLAIN) == wanted
    gradients = counts(points, PLAIN, "gradient_error")
    assert gradients == pytest.approx({c: 0.1 * e for c, e in wanted.items()})
    assert counts(points, TOTAL) == {0.2: 0.03, 0.3: 0.04, 0.4: 0.04}
    assert counts(points, SINGLE) == {0.4: 0.07, 0.8: 0.1}  # double precision speaks for it too
    assert counts(points, MORE_PARTICLES) == {0.4: 0.001}  # other cells and particles do not
    assert counts(points, PLAIN, n=128) == {0.4: 0.002}
    # A shorter step that fails has lost all.
    failed = replace(points[1], distance_error=math.nan)
    lost = counts([failed, *points[2:]], PLAIN)
    assert math.isnan(lost.pop(0.2))
    assert lost == dict.fromkeys((0.4, 0.6, 0.8), math.inf)


@pytest.mark.parametrize("choice", [PLAIN, TOTAL])
@pytest.mark.parametrize("error", ["distance_error", "gradient_error"])
def test_neither_a_front_nor_the_time_at_equal_accuracy_has_luck(choice, error):
    lucky = [*swept(64, choice, c2=0.1, c6=0.0), *swept(128, choice, 1.6, c2=0.02, c6=0.02)]
    scale = 1.0 if error == "distance_error" else 0.1
    best = front(lucky, error)
    assert [(p.n, p.courant) for p in best] == [(64, 0.6), (128, 0.6)]
    assert [getattr(p, error) for p in best] == pytest.approx([0.1 * scale, 0.02 * scale])
    asked = speed_accuracy.cost(lucky, 0.05 * scale, error)
    assert asked is not None and asked.coarse is not None
    assert (asked.coarse.n, asked.fine.n) == (64, 128)
    share = math.log(2.0) / math.log(5.0)
    assert asked.seconds == pytest.approx(0.4 / 0.6 * 4.0**share)
    # Between cells whose step fails when it is refined, and finer ones, nothing is known.
    failed = replace(lucky[0], measured=replace(lucky[0].measured, seconds=math.nan))
    failed = replace(failed, distance_error=math.nan, gradient_error=math.nan)
    asked = speed_accuracy.cost([failed, *lucky[1:]], 0.05 * scale, error)
    assert asked is not None
    assert (asked.coarse, asked.fine.n, asked.fine.courant) == (None, 128, 0.6)


def test_points_of_other_sources_are_measured_again(tmp_path, monkeypatch):
    measured = []

    def measure_point(name, scene, n, courant, choice, program):
        measured.append(program)
        numbers = {"steps": 1, "seconds": 1.0, "megabytes": 1.0, "distance": float(len(measured))}
        return {**numbers, "gradient": np.ones(1), "failure": ""}

    monkeypatch.setattr(speed_accuracy, "measure_point", measure_point)
    with ThreadPoolExecutor(1) as threads:
        bench = Bench(tmp_path / "points.h5", threads)
        points = [("walker", 64, 0.4, PLAIN)]
        assert [bench.run(points)[0].measured.distance for _ in range(2)] == [1.0, 1.0]
        own = speed_accuracy.sources()
        monkeypatch.setattr(speed_accuracy, "sources", lambda: "others")
        assert bench.run(points)[0].measured.distance == 2.0
    assert measured == [own, "others"]


def test_sources_are_the_package_and_the_cases(tmp_path, monkeypatch):
    package, cases = tmp_path / "mpmopt", tmp_path / "cases"
    files = [package / "__init__.py", package / "kernels" / "step.py", cases / "speed_accuracy.py"]
    for path in files:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text("1\n")
    monkeypatch.setattr(speed_accuracy.mpmopt, "__file__", str(files[0]))
    monkeypatch.setattr(speed_accuracy, "__file__", str(files[2]))
    digest = speed_accuracy.sources
    found = [digest()]
    for path in files:
        path.write_text("2\n")
        found.append(digest())
    assert len(set(found)) == len(files) + 1
    assert digest() == found[-1]


def test_a_worker_with_other_sources_refuses():
    with pytest.raises(SweepError, match="other sources"):
        speed_accuracy.measure_point("bar", "", 8, 0.4, {}, "others")


def test_peers_take_as_long_as_the_particles_and_steps_that_mls_mpm_needs():
    def point(n, seconds, choice, scene="bar", formulation="updated"):
        measured = Measured(Discretisation((n, n), 100, formulation=formulation), seconds)
        return Point(scene, n, 100, 0.4, choice, measured, distance_error=0.04)

    points = [point(32, 1.0, PLAIN.name), point(16, 0.01, TOTAL.name, formulation="total")]
    for peer, seconds in (("Taichi, double", 0.4), ("Warp, double", 0.32), ("Taichi, single", 0.1)):
        points.append(point(128, seconds, peer, "walker"))
    (row,) = speed_accuracy.against_peers(points, {"bar": (0.06, 0.1)})
    # 3200 particles and 100 steps in 0.32 s are a microsecond; the bar has 32 x 2 cells of four.
    assert row["off by at most"] == "10 %"  # others cost the same
    assert (row["fastest peer"], row["its s"]) == ("Warp, double", "0.0256")
    assert row["times"] == "2.6"
    # Of a robot with a plane of symmetry they do both halves.
    whole = speed_accuracy.particles(point(64, 1.0, PLAIN.name, "crawler on ground"))
    scene = speed_accuracy.laid_out(ROBOTS["crawler on ground"][0], 64, 0.2, PLAIN)
    half = len(discretise(scene.scene(ROBOTS["crawler on ground"][0])).position)
    assert whole == 2 * half


def test_a_limit_is_where_errors_of_order_two_vanish():
    cells = (64, 128, 192)
    measured = tuple(
        Measured(
            Discretisation((n, n), 1), distance=2.0 + 3.0 / n**2, gradient=np.array([1.0, h**2])
        )
        for n, h in zip(cells, (3.0, 1.5, 1.0))
    )
    found = speed_accuracy.Limit("walker on ground", "total", 0.2, cells, measured)
    assert found.extrapolated.distance == pytest.approx(2.0, rel=1e-12)
    assert found.distance_left == pytest.approx(1.5 / 192**2, rel=1e-9)
    assert found.extrapolated.gradient is measured[-1].gradient
    # The finest gradient is one off, and as long as the square root of two.
    assert found.gradient_left == pytest.approx(1.0 / np.sqrt(2.0), rel=1e-12)


def test_the_front_is_a_front():
    rng = np.random.default_rng(5)
    here = Discretisation((4, 4), 1)
    points = [
        Point("bar", 32, 1, 0.4, PLAIN.name, Measured(here, seconds), distance_error=error)
        for seconds, error in rng.uniform(0.1, 1.0, (50, 2))
    ]
    points.append(replace(points[0], distance_error=np.nan))
    best = front(points, "distance_error")
    assert 2 <= len(best) < 50

    def beats(one, other):
        return (
            one.measured.seconds <= other.measured.seconds
            and one.distance_error <= other.distance_error
            and one is not other
        )

    for point in points[:-1]:
        assert any(one is point or beats(one, point) for one in best)
        assert (point in best) == (not any(beats(other, point) for other in points))


@pytest.mark.parametrize("quick", [True, False])
def test_all_points_can_be_laid_out_and_are_measured_once(quick):
    points = settings(quick)
    assert len(set(points)) == len(points)
    for name, (scene, _) in ROBOTS.items():
        for n, courant, choice in points:
            here = speed_accuracy.laid_out(scene, n, courant, choice)
            if not speed_accuracy.is_possible(name, n, courant, choice):
                with pytest.raises(SceneError, match=r"stability limit|formulation"):
                    here.scene(scene)
                continue
            assert here.scene(scene).courant <= courant * (1.0 + 1e-9), name
            assert here.formulation == choice.formulation
    for n in {n for n, *_ in points}:  # all cells are judged by the same steps
        for choice in (PLAIN, TOTAL):
            assert (n, speed_accuracy.LEAST, choice) in points
    assert (64, speed_accuracy.LEAST, MORE_PARTICLES) in points
    if not quick:
        assert speed_accuracy.PAPER in points
        assert speed_accuracy.RECOMMENDED in points


@pytest.mark.process
def test_the_script_has_its_points_measured_by_processes(tmp_path):
    command = [sys.executable, speed_accuracy.__file__, "--quick", "--out", str(tmp_path)]
    process = subprocess.Popen(command, stderr=subprocess.PIPE, text=True)
    assert process.stderr
    try:
        said = process.stderr.readline()
    finally:
        process.kill()
        process.communicate()
    assert " points, " in said and "Error" not in said


@pytest.mark.process
@pytest.mark.parametrize("drawn", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_a_chart_is_left_with_its_tables(tmp_path, monkeypatch, drawn):
    if not drawn:
        monkeypatch.setattr(speed_accuracy, "draw", lambda path, points, known: path.touch())
    for name, (scene, phi) in ROBOTS.items():
        monkeypatch.setitem(ROBOTS, name, (speed_accuracy.lasting(scene, 0.02), phi))
    monkeypatch.setattr(Bar, "duration", 1.0)
    points = [(32, 0.4, PLAIN), (32, 0.8, PLAIN), (64, 0.8, PLAIN), (32, 0.4, TOTAL)]
    monkeypatch.setattr(speed_accuracy, "settings", lambda quick: points)
    monkeypatch.setattr(speed_accuracy, "QUICK_REFERENCE", (96, 0.8, PLAIN))
    monkeypatch.setattr(speed_accuracy, "QUICK_LIMITS", (32, 64, 96))
    assert speed_accuracy.main(["--quick", "--out", str(tmp_path)]) == 0
    assert ((tmp_path / "speed_accuracy.png").stat().st_size > 10_000) == drawn
    with (tmp_path / "speed_accuracy.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [(row["scene"], row["n"], row["choice"]) for row in rows] == [
        *(("bar", n, PLAIN.name) for n in ("32", "32", "64")),
        ("bar", "32", TOTAL.name),
        *((name, n, PLAIN.name) for name in ("walker", "crawler") for n in ("32", "32", "64")),
        *((f"{name} on ground", "32", choice.name) for name in ("walker", "crawler")
          for choice in (PLAIN, PLAIN, TOTAL)),
    ]  # fmt: skip
    assert not any(row["failure"] for row in rows)
    with h5py.File(tmp_path / "speed_accuracy.h5") as file:
        assert list(file) == sorted(f"{name}, {f}" for name, f in [*BARS, *robots()])
        for name, formulation in robots():
            group = file[f"{name}, {formulation}"]
            distance = group["distance"][:] / group.attrs["reference distance"]
            assert np.abs(distance - 1.0) == pytest.approx(group["distance_error"][:])
            apart = np.linalg.norm(group["gradient"][:] - group["reference gradient"][:], axis=1)
            norm = np.linalg.norm(group["reference gradient"][:])
            assert apart / norm == pytest.approx(group["gradient_error"][:])
