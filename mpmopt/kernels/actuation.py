"""What actuators add to the stress: tau += F S F^T, with S the sum of signals times stresses."""

from mpmopt.kernels.compiler import jit
from mpmopt.kernels.simd import load


@jit
def second_piola(data, g, signal):
    """s S of the actuators of four particles: xx, xy, yy."""
    s00 = s01 = s11 = 0.0 * load(data.mass, g)
    for k in range(signal.size):
        there = load(data.actuated[k], g)
        s00 = s00 + signal[k] * data.actuation_stress[k, 0] * there
        s01 = s01 + signal[k] * data.actuation_stress[k, 1] * there
        s11 = s11 + signal[k] * data.actuation_stress[k, 2] * there
    return s00, s01, s11


@jit
def add_actuation(F, S, tau):
    """tau + F S F^T: xx, xy, yy."""
    f00, f01, f10, f11 = F
    s00, s01, s11 = S
    t00, t01, t11 = tau
    t00 = t00 + f00 * (s00 * f00 + s01 * f01) + f01 * (s01 * f00 + s11 * f01)
    t01 = t01 + f00 * (s00 * f10 + s01 * f11) + f01 * (s01 * f10 + s11 * f11)
    t11 = t11 + f10 * (s00 * f10 + s01 * f11) + f11 * (s01 * f10 + s11 * f11)
    return t00, t01, t11


@jit
def squeezed(F, s00, s01, s11):
    """S : F^T F, twice the energy density at a signal of 1, of one particle."""
    f00, f01, f10, f11 = F
    stretch = s00 * (f00 * f00 + f10 * f10) + s11 * (f01 * f01 + f11 * f11)
    stretch += 2.0 * s01 * (f00 * f01 + f10 * f11)
    return stretch
