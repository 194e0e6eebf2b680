"""Kelvin-Voigt viscosity: S = eta dE/dt beside the elastic stress, of which energy is lost.

E is the Green-Lagrange strain, dE/dt = F^T D F with D the symmetric part of the velocity gradient,
so the Kirchhoff stress is F S F^T = eta B D B with B = F F^T. Rigid motion has none. A step takes D
from the particle's affine velocity C, which is as old as the velocities, and the new F.
"""

import numpy as np

from mpmopt.kernels.compiler import jit
from mpmopt.kernels.material import PARAMETERS

VISCOSITY = PARAMETERS.index("viscosity")


@jit
def strains(F, C):
    """B = F F^T and D = sym C: xx, xy, yy."""
    f00, f01, f10, f11 = F
    c00, c01, c10, c11 = C
    B = f00 * f00 + f01 * f01, f00 * f10 + f01 * f11, f10 * f10 + f11 * f11
    return B, (c00, 0.5 * (c01 + c10), c11)


@jit
def between(B, X):
    """B X B of symmetric tensors: xx, xy, yy."""
    b00, b01, b11 = B
    x00, x01, x11 = X
    m00, m01 = b00 * x00 + b01 * x01, b00 * x01 + b01 * x11
    m10, m11 = b01 * x00 + b11 * x01, b01 * x01 + b11 * x11
    return m00 * b00 + m01 * b01, m00 * b01 + m01 * b11, m10 * b01 + m11 * b11


@jit
def add_viscosity(F, C, constants, tau):
    """tau + eta B D B: xx, xy, yy."""
    eta = constants[VISCOSITY]
    B, D = strains(F, C)
    v00, v01, v11 = between(B, D)
    t00, t01, t11 = tau
    return t00 + eta * v00, t01 + eta * v01, t11 + eta * v11


@jit
def viscous_modulus(trace, apart, constants):
    """Largest ratio of B D B eta to D, of a particle as stretched as it is, of one number each.

    eta b^2 with the largest eigenvalue b of B = F F^T, as `stretches` gives tr B and apart.
    """
    b = 0.5 * (trace + np.sqrt(apart))
    return constants[VISCOSITY] * b * b


@jit
def viscosity_adjoint(F, C, constants, tau_bar):
    """C_bar = eta B T B, and F_bar = 2 eta (T B D + D B T) F with T = sym tau_bar.

    The xy of `tau_bar` counts xy and yx.
    """
    eta = constants[VISCOSITY]
    B, D = strains(F, C)
    t00, t01, t11 = tau_bar
    T = t00, 0.5 * t01, t11
    d00, d01, d11 = between(B, T)
    # G = T B D, of which twice the symmetric part is wanted.
    b00, b01, b11 = B
    m00, m01 = T[0] * b00 + T[1] * b01, T[0] * b01 + T[1] * b11
    m10, m11 = T[1] * b00 + T[2] * b01, T[1] * b01 + T[2] * b11
    g00 = 2.0 * (m00 * D[0] + m01 * D[1])
    g01 = m00 * D[1] + m01 * D[2] + m10 * D[0] + m11 * D[1]
    g11 = 2.0 * (m10 * D[1] + m11 * D[2])
    f00, f01, f10, f11 = F
    eta2 = 2.0 * eta
    F_bar = (
        eta2 * (g00 * f00 + g01 * f10),
        eta2 * (g00 * f01 + g01 * f11),
        eta2 * (g01 * f00 + g11 * f10),
        eta2 * (g01 * f01 + g11 * f11),
    )
    return (eta * d00, eta * d01, eta * d11), F_bar
