"""Affine momentum of particles, of their velocity and of their stress."""

from mpmopt.kernels.actuation import add_actuation, second_piola
from mpmopt.kernels.arrays import AFFINE, AFFINE_BAR, DEFORMATION, at, in_tile
from mpmopt.kernels.compiler import jit
from mpmopt.kernels.material import kirchhoff
from mpmopt.kernels.simd import add, load, store_tensor, tensor, total


@jit
def stress(old, new, log_J, data, parameters, signal, tile, first, last):
    """Affine momentum A dx from C, F' and ln J'."""
    for g in range(first, last):
        c00, c01, c10, c11 = tensor(old, at(g, AFFINE))
        F = tensor(new, at(g, DEFORMATION))
        m, mu = load(data.mass, g), load(data.lame_mu, g)
        lam = load(data.lame_lambda, g)
        tau = kirchhoff(F, load(log_J, g), lam, mu)
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
        c00, c01, c10, c11 = tensor(old, at(g, AFFINE))
        f00, f01, f10, f11 = tensor(new, at(g, DEFORMATION))
        a00, a01, a10, a11 = tensor(tile.gathered, in_tile(g - first, AFFINE_BAR))
        m, mu = load(data.mass, g), load(data.lame_mu, g)
        add(bar, at(g, AFFINE), m * a00)
        add(bar, at(g, AFFINE + 1), m * a01)
        add(bar, at(g, AFFINE + 2), m * a10)
        add(bar, at(g, AFFINE + 3), m * a11)
        add(data_bar.mass, g, a00 * c00 + a01 * c01 + a10 * c10 + a11 * c11)

        # T = tau_bar; tau is symmetric, and t01 gathers both of its places in A.
        impulse = -parameters.dt * (4.0 / parameters.dx**2) * load(data.volume, g)
        t00, t01, t11 = impulse * a00, impulse * (a01 + a10), impulse * a11
        trace = t00 + t11
        stretch = t00 * (f00 * f00 + f01 * f01)
        stretch = stretch + t01 * (f00 * f10 + f01 * f11)
        stretch = stretch + t11 * (f10 * f10 + f11 * f11)
        add(data_bar.lame_mu, g, stretch - trace)
        add(data_bar.lame_lambda, g, trace * load(log_J, g))

        # F_bar' += (T + T^T) F' (mu I + s S) + lambda tr T F'^-T
        pressure = load(data.lame_lambda, g) * trace / (f00 * f11 - f01 * f10)
        h00, h01, h10, h11 = mu * f00, mu * f01, mu * f10, mu * f11
        if data.active[g]:
            s00, s01, s11 = second_piola(data, g, signal)
            h00, h01 = h00 + f00 * s00 + f01 * s01, h01 + f00 * s01 + f01 * s11
            h10, h11 = h10 + f10 * s00 + f11 * s01, h11 + f10 * s01 + f11 * s11
            for k in range(signal.size):
                there = load(data.actuated[k], g)
                s00 = data.actuation_stress[k, 0]
                s01 = data.actuation_stress[k, 1]
                s11 = data.actuation_stress[k, 2]
                g00, g01 = s00 * f00 + s01 * f01, s01 * f00 + s11 * f01  # F' S
                g10, g11 = s00 * f10 + s01 * f11, s01 * f10 + s11 * f11
                power = t00 * (g00 * f00 + g01 * f01)
                power = power + t01 * (g00 * f10 + g01 * f11)
                power = power + t11 * (g10 * f10 + g11 * f11)
                signal_bar[k] += total(there * power)
        b00, b01, b10, b11 = tensor(bar, at(g, DEFORMATION))
        store_tensor(
            bar,
            at(g, DEFORMATION),
            b00 + 2.0 * t00 * h00 + t01 * h10 + pressure * f11,
            b01 + 2.0 * t00 * h01 + t01 * h11 - pressure * f10,
            b10 + t01 * h00 + 2.0 * t11 * h10 - pressure * f01,
            b11 + t01 * h01 + 2.0 * t11 * h11 + pressure * f00,
        )


@jit
def inertia(old, data, parameters, tile, first, last):
    """Affine momentum A dx of the velocity alone, m C dx, in the place of `stress`."""
    for g in range(first, last):
        m = parameters.dx * load(data.mass, g)
        c00, c01, c10, c11 = tensor(old, at(g, AFFINE))
        store_tensor(tile.affine, 4 * (g - first), m * c00, m * c01, m * c10, m * c11)


@jit
def inertia_adjoint(old, data, tile, bar, data_bar, first, last):
    """Adds to C_bar and to the adjoint of the mass."""
    for g in range(first, last):
        inertia_of(old, data, tile, bar, data_bar, g, g - first)


@jit
def inertia_of(old, data, tile, bar, data_bar, g, t):
    """`inertia_adjoint` of group g, which is group t of the tile."""
    c00, c01, c10, c11 = tensor(old, at(g, AFFINE))
    a00, a01, a10, a11 = tensor(tile.gathered, in_tile(t, AFFINE_BAR))
    m = load(data.mass, g)
    add(data_bar.mass, g, a00 * c00 + a01 * c01 + a10 * c10 + a11 * c11)
    add(bar, at(g, AFFINE), m * a00)
    add(bar, at(g, AFFINE + 1), m * a01)
    add(bar, at(g, AFFINE + 2), m * a10)
    add(bar, at(g, AFFINE + 3), m * a11)
