"""Widths of members and gaps: known ones, and those of a filtered design."""

import math
import sys
from dataclasses import dataclass

import numpy as np
import pytest
from scipy.optimize import brentq
from scipy.sparse import csc_array
from scipy.sparse.linalg import splu
from scipy.special import ndtri

from mpmopt.assess.width import least_width, thinnest_gap, thinnest_member
from mpmopt.design.one_piece import _lattice
from mpmopt.design.problem import Problem
from mpmopt.design.task import AtMost, Task
from mpmopt.design.term import Adjoints, Term
from mpmopt.design.terms import Volume
from mpmopt.design.variation import Variation
from mpmopt.errors import DesignError, MissingLibraryError
from mpmopt.optimisation.loop import optimise
from mpmopt.optimisation.settings import Settings, Stage
from mpmopt.results.outline import outline
from mpmopt.scene import Actuator, Design, Grid, Mirror, Scene


def rectangle(x0, y0, x1, y1):
    return np.array([(x0, y0), (x1, y0), (x1, y1), (x0, y1)], float)


def disc(x, y, r):
    t = np.linspace(0.0, 2.0 * np.pi, 100, endpoint=False)
    return np.stack([x + r * np.cos(t), y + r * np.sin(t)], axis=1)


def hourglass():
    x = np.linspace(-1.0, 1.0, 101)
    y = 0.05 + 0.4 * x**2
    return np.concatenate([np.stack([x, -y], 1), np.stack([x[::-1], y[::-1]], 1)])


def spike(degrees):
    y = math.tan(math.radians(0.5 * degrees))
    return np.array([(0.0, 0.0), (1.0, -y), (1.0, y)])


TABLE = np.array([(0, 0), (0.1, 0), (0.1, 0.6), (0.4, 0.6), (0.4, 0), (0.5, 0), (0.5, 1), (0, 1.0)])


@pytest.mark.parametrize(
    ("rings", "member", "gap"),
    [
        ([rectangle(0, 0, 1, 1)], 1.0, math.inf),
        ([rectangle(2, 3, 3, 3.3)], 0.3, math.inf),
        ([disc(0, 0, 0.5)], 1.0, math.inf),
        ([disc(0, 0, 0.5), disc(0, 0, 0.3)], 0.2, 0.6),
        ([disc(0, 0, 0.5), disc(0.15, 0, 0.3)], 0.05, 0.6),
        ([rectangle(0, 0, 1, 1), rectangle(1.07, 0, 2, 1)], 0.93, 0.07),
        ([TABLE], 0.1, 0.3),
        ([TABLE * 1e-3], 1e-4, 3e-4),
        ([hourglass()], 0.1, None),
        ([disc(0, 0, 0.5), disc(0, 0, 0.2) * (2, 1)], 0.1, None),  # two walls part at once
    ],
)
def test_widths_are_those_by_hand(rings, member, gap):
    # A hole of straight segments is 0.9995 as wide, and the wall beside it so much wider.
    assert thinnest_member(rings) == pytest.approx(member, rel=2e-3)
    if gap is not None:
        assert thinnest_gap(rings) == pytest.approx(gap, rel=2e-3)


def test_corners_are_no_members_unless_they_are_needles():
    assert thinnest_member([spike(60)]) == pytest.approx(2.0 / 3.0, rel=1e-3)  # its incircle's
    assert thinnest_member([spike(25)]) > 0.3
    assert thinnest_member([spike(15)]) < 1e-6
    assert 0.01 < thinnest_member([spike(15)], detail=0.02) < 0.04


def plate(length=1.5, cells=12):
    """A design region of so many cells that hangs on an actuator."""
    c = 1 / 64
    return Scene(
        Grid((cells + 16, 24), c), 1e-4, 1,
        (
            Design((8 * c, 4 * c), ((8 + cells) * c, 12 * c)),
            Actuator((8 * c, 12 * c), ((8 + cells) * c, 20 * c)),
        ),
        filter_length=length * c,
    )  # fmt: skip


@pytest.mark.parametrize("threshold", [0.6, 0.7])
@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_a_bar_that_just_reaches_a_threshold_is_as_wide_as_theory_says(sign, threshold):
    scene = plate()
    problem, c = Problem(scene, 64.0), scene.grid.dx
    x = problem.particles.position[problem.particles.designed][:, 0]

    def bar(half):  # particles at its edges are grey
        share = np.clip((half - np.abs(x - 14 * c)) / (0.5 * c) + 0.5, 0.0, 1.0)
        return 2.0 * share - 1.0

    def peak(half):
        return float((problem.chain.filter @ bar(half)).max() + 1.0) / 2.0

    half = brentq(lambda half: peak(half) - threshold, 0.5 * c, 4.0 * c)
    rings = [
        ring
        for polygon in outline(problem, problem.join(sign * bar(half), 0.0, 0.0, 0.0), 0.5)
        for ring in polygon.rings
    ]
    measured = thinnest_member(rings) if sign > 0.0 else thinnest_gap(rings)
    assert measured == pytest.approx(least_width(scene, threshold), rel=0.03)


def test_no_filtered_design_falls_off_faster_than_a_straight_edge(rng):
    scene = plate(2.0)
    problem, spread = Problem(scene), scene.filter_spread
    position = problem.particles.position[problem.particles.designed]
    i, j = np.triu_indices(len(position), 1)
    apart = np.hypot(*(position[i] - position[j]).T)
    near = apart < 2.0 * spread
    i, j, apart = i[near], j[near], apart[near]

    def steepest(phi):
        """Greatest slope of the Gaussian's inverse distribution of the filtered density."""
        density = 0.5 * (1.0 + problem.chain.filter @ phi)
        middle = (np.abs(density - 0.5) < 0.2)[[i, j]].all(axis=0)
        values = ndtri(np.clip(density, 0.2, 0.8))
        return spread * float((np.abs(values[i] - values[j]) / apart)[middle].max(initial=0.0))

    for angle in rng.uniform(0.0, np.pi, 4):
        across = (position - position.mean(axis=0)) @ (np.cos(angle), np.sin(angle))
        assert steepest(np.sign(across)) == pytest.approx(1.0, abs=0.06)
    for _ in range(20):
        smooth = problem.chain.filter @ rng.normal(size=len(position))
        for phi in (np.sign(smooth), rng.uniform(-1.0, 1.0, len(position))):
            assert steepest(phi) <= 1.06


def test_the_least_width_is_that_of_a_gaussian_and_needs_a_threshold():
    scene = plate()
    assert least_width(scene, 0.6) == pytest.approx(1.3610870502 * scene.filter_spread, rel=1e-9)
    assert abs(scene.filter_spread / scene.filter_length - 1.0) < 0.05
    for wrong in (0.5, 1.0):
        with pytest.raises(DesignError, match=f"{wrong:g} must be between"):
            least_width(scene, wrong)


@dataclass(frozen=True)
class Cooled(Term):
    """Minus the thermal compliance of a plate that is heated evenly and cooled where it hangs."""

    def _solved(self, outcome):
        edges, g = _lattice(outcome.simulation.scene), np.append(outcome.gamma, 1.0)
        a, b, size = edges.first, edges.second, edges.designed
        k = 1e-3 + 0.999 * (g[a] * g[b]) ** 2
        places = np.concatenate([a, b, a, b]), np.concatenate([a, b, b, a])
        K = csc_array((np.concatenate([k, k, -k, -k]), places))[:size, :size]
        heat = np.full(size, 1.0 / size)
        return a, b, g, heat, splu(K.tocsc(), permc_spec="MMD_AT_PLUS_A").solve(heat)

    def value(self, outcome):
        *_, heat, T = self._solved(outcome)
        return -float(heat @ T)

    def adjoints(self, outcome):
        a, b, g, _, T = self._solved(outcome)
        t = np.append(T, 0.0)
        k_bar = (t[a] - t[b]) ** 2
        k_bar *= 2.0 * 0.999 * g[a] * g[b]
        g_bar = np.zeros(g.size)
        np.add.at(g_bar, a, g[b] * k_bar)
        np.add.at(g_bar, b, g[a] * k_bar)
        return Adjoints(gamma=g_bar[:-1])


def cooled(thresholds, cells=24, iterations=15):
    """The best design of a plate and its problem, with a scene for each threshold."""
    c = 1 / 64
    middle = 4 + cells // 2
    scene = Scene(
        Grid((cells + 10, cells + 8), c), 1e-4, 1,
        (
            Design((6 * c, 4 * c), ((6 + cells) * c, (4 + cells) * c)),
            Actuator((4 * c, (middle - 2) * c), (6 * c, (middle + 2) * c)),
        ),
        filter_length=c,
        mirror=Mirror("y", middle * c),
    )  # fmt: skip
    task = Task(
        Cooled(),
        (AtMost(Volume(), 0.5),),
        tuple(Variation(threshold=each) for each in thresholds),
        soft_minimum=20.0,
    )
    stages = tuple(Stage(beta, move_limit=0.2) for beta in (2.0, 8.0, 32.0))
    settings = Settings(stages, most_iterations=iterations, tolerance=0.0)
    run = optimise(scene, settings, {"phi": 0.2}, task=task)
    return run.problem(), run.result.x


def rings_at(problem, x, eta):
    """The outline where the filtered density is above eta, as rings."""
    beta = problem.chain.beta
    gamma = 0.5 * (np.tanh(beta * (2.0 * eta - 1.0)) / np.tanh(beta) + 1.0)
    return [ring for polygon in outline(problem, x, gamma) for ring in polygon.rings]


@pytest.mark.case
def test_a_robust_design_is_as_wide_as_its_filter_promises_and_another_is_not():
    problem, x = cooled((0.4, 0.5, 0.6))
    promised = least_width(problem.scene, 0.6)
    # All that is there is there eroded and dilated too: this is what the promise asks for.
    assert len({len(rings_at(problem, x, eta)) for eta in (0.4, 0.5, 0.6)}) == 1
    rings = [ring for polygon in outline(problem, x) for ring in polygon.rings]
    member, gap = thinnest_member(rings), thinnest_gap(rings)
    assert member >= promised
    assert math.inf > gap >= promised
    problem, x = cooled((0.5,))
    rings = [ring for polygon in outline(problem, x) for ring in polygon.rings]
    assert min(thinnest_member(rings), thinnest_gap(rings)) < promised


def test_widths_need_rings_and_a_library(monkeypatch):
    with pytest.raises(DesignError, match="no ring"):
        thinnest_member([])
    monkeypatch.setitem(sys.modules, "manifold3d", None)
    with pytest.raises(MissingLibraryError, match=r'pip install "mpmopt\[export\]"'):
        thinnest_gap([TABLE])
