"""Widths of members and gaps: known ones, and those of a filtered design."""

import math
import sys

import numpy as np
import pytest

from mpmopt.assess.width import thinnest_gap, thinnest_member
from mpmopt.errors import DesignError, MissingLibraryError


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


def test_widths_need_rings_and_a_library(monkeypatch):
    with pytest.raises(DesignError, match="no ring"):
        thinnest_member([])
    monkeypatch.setitem(sys.modules, "manifold3d", None)
    with pytest.raises(MissingLibraryError, match=r'pip install "mpmopt\[export\]"'):
        thinnest_gap([TABLE])
