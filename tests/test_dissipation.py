"""Damping is a matter of the step without a blend, and a rate with one."""

import numpy as np
import pytest
import walker
from dissipation import spinning_disc, travel, two_discs, vibrating_bar


def test_two_discs_lose_more_with_a_smaller_step_but_not_with_a_blend():
    without = [two_discs(0.0, halvings) for halvings in (0, 2)]
    # Public measurements of this collision, with a step of 1e-3: 0.287.
    assert without[1] == pytest.approx(0.287, abs=0.005)
    assert without[0] > 1.5 * without[1]
    blended = [two_discs(2e-3, halvings) for halvings in (0, 2)]
    assert np.ptp(blended) <= 0.03 * blended[0]
    assert blended[0] > without[0]


def test_a_robot_goes_as_far_with_every_step_if_it_blends():
    without, blended = (
        np.array([travel(walker, tau, halvings) for halvings in (0, 3)]) for tau in (0.0, 2e-3)
    )
    assert np.ptp(without) >= 0.14 * without.mean()
    assert np.ptp(blended) <= 0.07 * blended.mean()


@pytest.mark.parametrize("motion", [spinning_disc, vibrating_bar])
@pytest.mark.parametrize("blend_time", [0.0, 2e-3])
def test_a_blend_makes_no_energy(motion, blend_time):
    # The bar's amplitude is that of its fastest moment, which frames miss by a little.
    assert 0.99 <= motion(blend_time, 0) <= 1.001
