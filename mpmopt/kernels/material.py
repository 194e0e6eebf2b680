"""The constitutive law, neo-Hookean, and its adjoint. Whoever needs stress or energy asks here.

The law is linear in its constants. A particle has those of the solid it is made of, times its
stiffness gamma_k, so the stress of the solid is its derivative by gamma_k. F is a deformation
gradient (f00, f01, f10, f11) and `log_J` the logarithm of its determinant; they and the constants
are numbers of one particle, or records of a group's four. tau derives from Psi: tau = dPsi/dF F^T.
"""

import numpy as np

from mpmopt.kernels.compiler import jit
from mpmopt.kernels.simd import load, product

# Attributes of a scene's material, in the order of `ParticleData.constants`.
PARAMETERS = ("lame_lambda", "lame_mu", "viscosity")


@jit
def solid_constants(data, g):
    """Of the solid that a group's particles are made of."""
    return load(data.constants[0], g), load(data.constants[1], g), load(data.constants[2], g)


@jit
def constants_of(data, g):
    """Of a group's particles."""
    lam, mu, eta = solid_constants(data, g)
    stiffness = load(data.stiffness, g)
    return product(stiffness, lam), product(stiffness, mu), product(stiffness, eta)


@jit
def constants_of_one(data, g, k):
    """Of particle k of group g, real parts."""
    stiffness, solid = float(data.stiffness[g, k].real), data.constants[:, g, k]
    return stiffness * float(solid[0]), stiffness * float(solid[1]), stiffness * float(solid[2])


@jit
def energy_density(F, log_J, constants):
    """Psi = mu/2 (tr F^T F - 2) - mu ln J + lambda/2 ln^2 J, per volume of the reference."""
    lam, mu = constants[:2]
    f00, f01, f10, f11 = F
    trace = f00 * f00 + f01 * f01 + f10 * f10 + f11 * f11
    return 0.5 * mu * (trace - 2.0) - mu * log_J + 0.5 * lam * log_J**2


@jit
def kirchhoff(F, log_J, constants):
    """Kirchhoff stress tau = mu (F F^T - I) + lambda ln J I: xx, xy, yy."""
    lam, mu = constants[:2]
    f00, f01, f10, f11 = F
    spherical = lam * log_J - mu
    t00 = mu * (f00 * f00 + f01 * f01) + spherical
    t01 = mu * (f00 * f10 + f01 * f11)
    t11 = mu * (f10 * f10 + f11 * f11) + spherical
    return t00, t01, t11


@jit
def kirchhoff_adjoint(F, log_J, constants, tau_bar):
    """F_bar = (T + T^T) F mu + lambda tr T F^-T with T = tau_bar; its xy counts xy and yx."""
    lam, mu = constants[:2]
    f00, f01, f10, f11 = F
    t00, t01, t11 = tau_bar
    pressure = lam * (t00 + t11) / (f00 * f11 - f01 * f10)
    return (
        mu * (2.0 * t00 * f00 + t01 * f10) + pressure * f11,
        mu * (2.0 * t00 * f01 + t01 * f11) - pressure * f10,
        mu * (t01 * f00 + 2.0 * t11 * f10) - pressure * f01,
        mu * (t01 * f01 + 2.0 * t11 * f11) + pressure * f00,
    )


@jit
def wave_modulus(trace, apart, constants):
    """Stiffness M against plane waves of a particle as stretched as it is, of one number each.

    lambda + mu tr b + sqrt(mu^2 apart + lambda^2) with b = F F^T, as `stretches` gives tr b and
    apart; M / rho is the square of the fastest wave's speed in the reference configuration.
    """
    lam, mu = constants[:2]
    return lam + mu * trace + np.sqrt(mu * mu * apart + lam * lam)
