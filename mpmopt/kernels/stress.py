"""Affine momentum of particles, of their velocity and of their stress."""

from mpmopt.kernels.actuation import actuation_adjoint, add_actuation, second_piola
from mpmopt.kernels.arrays import AFFINE, AFFINE_BAR, DEFORMATION, at, in_tile
from mpmopt.kernels.compiler import jit
from mpmopt.kernels.material import (
    constants_of,
    kirchhoff,
    kirchhoff_adjoint,
    solid_constants,
)
from mpmopt.kernels.simd import add, load, store_tensor, tensor
from mpmopt.kernels.viscosity import add_viscosity, viscosity_adjoint


@jit
def stress(old, new, log_J, data, parameters, signal, tile, first, last):
    """Affine momentum A dx from C, F' and ln J'."""
    for g in range(first, last):
        c00, c01, c10, c11 = C = tensor(old, at(g, AFFINE))
        F = tensor(new, at(g, DEFORMATION))
        m, constants = load(data.mass, g), constants_of(data, g)
        tau = kirchhoff(F, load(log_J, g), constants)
        if parameters.viscous:
            tau = add_viscosity(F, C, constants, tau)
        if data.active[g]:
            tau = add_actuation(F, second_piola(data, g, signal), tau)
        t00, t01, t11 = tau
        impulse = (4.0 * parameters.dt / parameters.dx) * load(data.volume, g)
        m = parameters.dx * m
        store_tensor(
            tile.affine,
            4 * (g - first),
            m * c00 - impulse * t00,
            m * c01 - impulse * t01,
            m * c10 - impulse * t01,
            m * c11 - impulse * t11,
        )


@jit
def stress_adjoint(
    old, new, log_J, data, parameters, signal, tile, bar, data_bar, signal_bar, first, last
):
    """From A_bar: adds to C_bar, F_bar' and to the adjoints of the material and the signal."""
    for g in range(first, last):
        c00, c01, c10, c11 = C = tensor(old, at(g, AFFINE))
        F = tensor(new, at(g, DEFORMATION))
        a00, a01, a10, a11 = tensor(tile.gathered, in_tile(g - first, AFFINE_BAR))
        m = load(data.mass, g)
        add(bar, at(g, AFFINE), m * a00)
        add(bar, at(g, AFFINE + 1), m * a01)
        add(bar, at(g, AFFINE + 2), m * a10)
        add(bar, at(g, AFFINE + 3), m * a11)
        add(data_bar.mass, g, a00 * c00 + a01 * c01 + a10 * c10 + a11 * c11)

        # T = tau_bar; tau is symmetric, and t01 gathers both of its places in A.
        impulse = -parameters.dt * (4.0 / parameters.dx**2) * load(data.volume, g)
        t00, t01, t11 = T = impulse * a00, impulse * (a01 + a10), impulse * a11
        constants, solid = constants_of(data, g), solid_constants(data, g)
        tau = kirchhoff(F, load(log_J, g), solid)
        b00, b01, b10, b11 = tensor(bar, at(g, DEFORMATION))
        h00, h01, h10, h11 = kirchhoff_adjoint(F, load(log_J, g), constants, T)
        b00, b01, b10, b11 = b00 + h00, b01 + h01, b10 + h10, b11 + h11
        if parameters.viscous:
            tau = add_viscosity(F, C, solid, tau)
            (d00, d01, d11), (h00, h01, h10, h11) = viscosity_adjoint(F, C, constants, T)
            add(bar, at(g, AFFINE), d00)
            add(bar, at(g, AFFINE + 1), d01)
            add(bar, at(g, AFFINE + 2), d01)
            add(bar, at(g, AFFINE + 3), d11)
            b00, b01, b10, b11 = b00 + h00, b01 + h01, b10 + h10, b11 + h11
        s00, s01, s11 = tau
        add(data_bar.stiffness, g, t00 * s00 + t01 * s01 + t11 * s11)
        if data.active[g]:
            h00, h01, h10, h11 = actuation_adjoint(F, data, g, signal, T, signal_bar)
            b00, b01, b10, b11 = b00 + h00, b01 + h01, b10 + h10, b11 + h11
        store_tensor(bar, at(g, DEFORMATION), b00, b01, b10, b11)
