"""The constitutive law: neo-Hookean. Whoever needs stress, energy or stiffness asks here.

F is a deformation gradient (f00, f01, f10, f11) and `log_J` the logarithm of its determinant; all
are numbers of one particle, or records of a group's four. tau derives from Psi: tau = dPsi/dF F^T.
"""

import math

from mpmopt.kernels.compiler import jit


@jit
def energy_density(F, log_J, lam, mu):
    """Psi = mu/2 (tr F^T F - 2) - mu ln J + lambda/2 ln^2 J, per volume of the reference."""
    f00, f01, f10, f11 = F
    trace = f00 * f00 + f01 * f01 + f10 * f10 + f11 * f11
    return 0.5 * mu * (trace - 2.0) - mu * log_J + 0.5 * lam * log_J**2


@jit
def kirchhoff(F, log_J, lam, mu):
    """Kirchhoff stress tau = mu (F F^T - I) + lambda ln J I: xx, xy, yy."""
    f00, f01, f10, f11 = F
    spherical = lam * log_J - mu
    t00 = mu * (f00 * f00 + f01 * f01) + spherical
    t01 = mu * (f00 * f10 + f01 * f11)
    t11 = mu * (f10 * f10 + f11 * f11) + spherical
    return t00, t01, t11


@jit
def wave_modulus(trace, apart, lam, mu):
    """Stiffness M against plane waves of a particle as stretched as it is, of one number each.

    lambda + mu tr b + sqrt(mu^2 apart + lambda^2) with b = F F^T, as `stretches` gives tr b and
    apart; M / rho is the square of the fastest wave's speed in the reference configuration.
    """
    return lam + mu * trace + math.sqrt(mu * mu * apart + lam * lam)
