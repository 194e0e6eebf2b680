"""What actuators add to the stress: tau += F S F^T, with S the sum of signals times stresses."""

from mpmopt.kernels.compiler import jit
from mpmopt.kernels.simd import load, total


@jit
def second_piola(data, g, signal):
    """s S of the actuators of four particles: xx, xy, yy."""
    s00 = s01 = s11 = 0.0 * load(data.stiffness, g)
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
def actuation_adjoint(F, data, g, signal, tau_bar, signal_bar):
    """F_bar = (T + T^T) F s S with T = tau_bar, whose xy counts xy and yx; adds to signal_bar."""
    f00, f01, f10, f11 = F
    t00, t01, t11 = tau_bar
    for k in range(signal.size):
        there = load(data.actuated[k], g)
        s00 = data.actuation_stress[k, 0]
        s01 = data.actuation_stress[k, 1]
        s11 = data.actuation_stress[k, 2]
        g00, g01 = s00 * f00 + s01 * f01, s01 * f00 + s11 * f01  # F S
        g10, g11 = s00 * f10 + s01 * f11, s01 * f10 + s11 * f11
        power = t00 * (g00 * f00 + g01 * f01)
        power = power + t01 * (g00 * f10 + g01 * f11)
        power = power + t11 * (g10 * f10 + g11 * f11)
        signal_bar[k] += total(there * power)
    s00, s01, s11 = second_piola(data, g, signal)
    h00, h01 = f00 * s00 + f01 * s01, f00 * s01 + f01 * s11
    h10, h11 = f10 * s00 + f11 * s01, f10 * s01 + f11 * s11
    return (
        2.0 * t00 * h00 + t01 * h10,
        2.0 * t00 * h01 + t01 * h11,
        t01 * h00 + 2.0 * t11 * h10,
        t01 * h01 + 2.0 * t11 * h11,
    )


@jit
def squeezed(F, s00, s01, s11):
    """S : F^T F, twice the energy density at a signal of 1, of one particle."""
    f00, f01, f10, f11 = F
    stretch = s00 * (f00 * f00 + f10 * f10) + s11 * (f01 * f01 + f11 * f11)
    stretch += 2.0 * s01 * (f00 * f01 + f10 * f11)
    return stretch
