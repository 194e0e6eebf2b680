"""Kinematics of particles: how they deform, and how far they are deformed."""

from mpmopt.kernels.arrays import AFFINE, DEFORMATION, at, components
from mpmopt.kernels.compiler import jit
from mpmopt.kernels.simd import logarithm, positive, store, store_tensor, tensor


@jit
def deform(old, new, parameters, log_J, first, last):
    """F' into the new state and ln J'; returns whether no particle is inverted."""
    dt = parameters.dt
    upright = True
    for g in range(first, last):
        c00, c01, c10, c11 = tensor(old, at(g, AFFINE))
        f00, f01, f10, f11 = tensor(old, at(g, DEFORMATION))
        g00 = f00 + dt * (c00 * f00 + c01 * f10)
        g01 = f01 + dt * (c00 * f01 + c01 * f11)
        g10 = f10 + dt * (c10 * f00 + c11 * f10)
        g11 = f11 + dt * (c10 * f01 + c11 * f11)
        J = g00 * g11 - g01 * g10
        upright &= positive(J)
        store_tensor(new, at(g, DEFORMATION), g00, g01, g10, g11)
        store(log_J, g, logarithm(J))
    return upright


@jit
def deform_adjoint(old, parameters, bar, first, last):
    """From F_bar' to F_bar, in place; adds to C_bar."""
    dt = parameters.dt
    for g in range(first, last):
        c00, c01, c10, c11 = tensor(old, at(g, AFFINE))
        f00, f01, f10, f11 = tensor(old, at(g, DEFORMATION))
        d00, d01, d10, d11 = tensor(bar, at(g, AFFINE))
        b00, b01, b10, b11 = tensor(bar, at(g, DEFORMATION))
        store_tensor(
            bar,
            at(g, AFFINE),
            d00 + dt * (b00 * f00 + b01 * f01),
            d01 + dt * (b00 * f10 + b01 * f11),
            d10 + dt * (b10 * f00 + b11 * f01),
            d11 + dt * (b10 * f10 + b11 * f11),
        )
        store_tensor(
            bar,
            at(g, DEFORMATION),
            b00 + dt * (c00 * b00 + c10 * b10),
            b01 + dt * (c00 * b01 + c10 * b11),
            b10 + dt * (c01 * b00 + c11 * b10),
            b11 + dt * (c01 * b01 + c11 * b11),
        )


@jit
def first_inverted(state, first, last):
    """The first particle of groups of four whose deformation gradient is inverted."""
    for p in range(4 * first, 4 * last):
        f, k = at(p // 4, DEFORMATION), p % 4
        if not (state[f, k] * state[f + 3, k] - state[f + 1, k] * state[f + 2, k]).real > 0.0:
            return p
    return -1


@jit
def midway(state, g, k, half):
    """F of a particle after half a step: (I + dt/2 C) F."""
    c00, c01, c10, c11 = components(state, g, AFFINE, k)
    f00, f01, f10, f11 = components(state, g, DEFORMATION, k)
    return (
        f00 + half * (c00 * f00 + c01 * f10),
        f01 + half * (c00 * f01 + c01 * f11),
        f10 + half * (c10 * f00 + c11 * f10),
        f11 + half * (c10 * f01 + c11 * f11),
    )


@jit
def stretches(F):
    """Of a particle's b = F F^T: tr b, and tr^2 b - 4 det b, the square of how far apart its
    eigenvalues are.
    """
    f00, f01, f10, f11 = F
    J = f00 * f11 - f01 * f10
    trace = f00 * f00 + f01 * f01 + f10 * f10 + f11 * f11
    return trace, max(trace * trace - 4.0 * J * J, 0.0)
