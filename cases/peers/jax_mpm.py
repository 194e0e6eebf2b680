"""The steps of `mpmopt.kernels` in JAX: a scan of checkpointed steps, differentiated by grad.

A step takes particles from one grid to the next, so that positions, deformation gradients and nodes
are all that the scan carries.
"""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from numpy.typing import NDArray

from mpmopt.design.objective import Objective
from mpmopt.simulation.simulation import Simulation
from peers import clamped, constants, window

jax.config.update("jax_enable_x64", True)

NAME = f"JAX {jax.__version__} jit, checkpointed scan"


def kept(values):
    """The same values, computed once: XLA on the CPU repeats what it fuses, but no conditional.

    `lax.optimization_barrier` is dropped there before fusion.
    """
    first = jax.tree.leaves(values)[0].ravel()[0]
    return lax.cond(first < 1e300, lambda v: v, lambda v: jax.tree.map(jnp.zeros_like, v), values)


class Peer:
    """The compiled forward run and its gradient."""

    def __init__(self, run, args, volume):
        options = {"xla_cpu_enable_fast_math": True}
        self.args, self.volume = args, volume
        self.forward = jax.jit(run, compiler_options=options)
        self.gradient = jax.jit(
            jax.value_and_grad(run, argnums=(0, 1, 2, 3)), compiler_options=options
        )

    def value(self) -> float:
        """Objective."""
        return float(self.forward(*self.args))

    def value_and_gradient(self) -> tuple[float, dict[str, NDArray[np.float64]]]:
        """Objective and its derivatives."""
        value, bars = self.gradient(*self.args)
        mass, lam, mu, signal = (np.asarray(bar) for bar in bars)
        names = {"density": self.volume * mass, "lame_lambda": lam, "lame_mu": mu}
        return float(value), {**names, "signal": signal}


def prepare(simulation: Simulation, objective: Objective) -> Peer:
    """The scene of a simulation, ready to run in JAX."""
    parameters, data = simulation.parameters, simulation.data
    N = simulation.initial.shape[1]
    K = len(data.actuation_stress)
    low, size = window(simulation)
    i0, j0, ni, nj = int(low[0]), int(low[1]), int(size[0]), int(size[1])
    M = ni * nj
    dt, dx = parameters.dt, parameters.dx
    inv, scale = 1 / dx, 4 / dx**2
    gravity = dt * np.array([parameters.gravity_x, parameters.gravity_y])
    lo, hi = clamped(parameters)
    ii, jj = np.meshgrid(np.arange(i0, i0 + ni), np.arange(j0, j0 + nj), indexing="ij")
    below = np.stack([ii < lo[0], jj < lo[1]], -1).reshape(M, 2)
    above = np.stack([ii > hi[0], jj > hi[1]], -1).reshape(M, 2)
    volume, masses, lambdas, mus = constants(simulation)

    impulse = dt * scale * volume
    actuator = simulation.particles.actuator
    onehot = (actuator == np.arange(K)[:, None]).astype(float)
    S = data.actuation_stress
    st = simulation.initial.real
    w_obj = objective.weight
    ex, ey = objective.direction

    def near(x, y):
        i = (x * inv - 0.5).astype(jnp.int32)
        j = (y * inv - 0.5).astype(jnp.int32)
        fx, fy = x * inv - i, y * inv - j
        node = (i - i0) * nj + (j - j0)
        return node[:, None] + nj * np.arange(3, dtype=np.int32), fx, fy

    def wts(f):
        return 0.5 * (1.5 - f) ** 2, 0.75 - (f - 1.0) ** 2, 0.5 * (f - 0.5) ** 2

    def scatter(idx, vals):
        dn = lax.ScatterDimensionNumbers(
            update_window_dims=(2,), inserted_window_dims=(), scatter_dims_to_operand_dims=(0,)
        )
        return lax.scatter_add(
            jnp.zeros(M * 3), (3 * idx)[..., None], vals, dn, mode="promise_in_bounds"
        )

    def gather(u, idx):
        return lax.gather(
            u,
            (2 * idx)[..., None],
            lax.GatherDimensionNumbers((2,), (), (0,)),
            (6,),
            mode="promise_in_bounds",
        )

    def p2g(mat, n_signal, x, y, u, v, C, F):
        m, lam, mu = mat
        c00, c01, c10, c11 = C
        f00, f01, f10, f11 = F
        idx, fx, fy = near(x, y)
        s00 = mu
        s01 = 0.0
        s11 = mu
        for k in range(K):
            sk = n_signal[k] * onehot[k]
            s00 = s00 + sk * S[k, 0]
            s01 = s01 + sk * S[k, 1]
            s11 = s11 + sk * S[k, 2]
        pr = lam * jnp.log(f00 * f11 - f01 * f10) - mu
        h00, h01 = f00 * s00 + f01 * s01, f00 * s01 + f01 * s11
        h10, h11 = f10 * s00 + f11 * s01, f10 * s01 + f11 * s11
        t00 = h00 * f00 + h01 * f01 + pr
        t01 = h00 * f10 + h01 * f11
        t11 = h10 * f10 + h11 * f11 + pr
        a00 = m * c00 - impulse * t00
        a01 = m * c01 - impulse * t01
        a10 = m * c10 - impulse * t01
        a11 = m * c11 - impulse * t11
        m, u, v, a00, a01, a10, a11, fx, fy = kept((m, u, v, a00, a01, a10, a11, fx, fy))
        wx, wy = (wts(fx), wts(fy))
        out = []
        for a in range(3):
            rx = (a - fx) * dx
            qx, qy, qm = wx[a] * (m * u + rx * a00), wx[a] * (m * v + rx * a10), wx[a] * m
            bx, by = wx[a] * a01, wx[a] * a11
            for b in range(3):
                ry = (b - fy) * dx
                out += [wy[b] * (qx + ry * bx), wy[b] * (qy + ry * by), wy[b] * qm]
        vals = jnp.stack(out, 1).reshape(N, 3, 9)
        return scatter(idx, vals)

    def grid_update(g):
        g = g.reshape(M, 3)
        m = g[:, 2:]
        has = m > 0.0
        vel = jnp.where(has, g[:, :2] / jnp.where(has, m, 1.0) + gravity, 0.0)
        stuck = jnp.any((below & (vel < 0.0)) | (above & (vel > 0.0)), axis=1, keepdims=True)
        return jnp.where(stuck, 0.0, vel).reshape(-1)

    def g2p(vel, x, y):
        idx, fx, fy = near(x, y)
        G = gather(vel, idx)
        fx, fy = kept((fx, fy))
        wx, wy = (wts(fx), wts(fy))
        s = scale * dx
        # Not slices: their transpose is a sum of padded arrays, that of a split a concatenation.
        G = [g[0] for g in lax.split(G.reshape(N, 18).T, [1] * 18, axis=0)]
        moved = []
        for c in range(2):
            V = c0 = c1 = 0.0
            for a in range(3):
                r0, r1, r2 = (wy[b] * G[6 * a + 2 * b + c] for b in range(3))
                row = wx[a] * (r0 + r1 + r2)
                V, c0 = V + row, c0 + (a - fx) * row
                c1 = c1 + wx[a] * ((0 - fy) * r0 + (1 - fy) * r1 + (2 - fy) * r2)
            moved.append((V, s * c0, s * c1))
        (u, c00, c01), (v, c10, c11) = moved
        return u, v, (c00, c01, c10, c11)

    def deform(C, F):
        c00, c01, c10, c11 = C
        f00, f01, f10, f11 = F
        return (
            f00 + dt * (c00 * f00 + c01 * f10),
            f01 + dt * (c00 * f01 + c01 * f11),
            f10 + dt * (c10 * f00 + c11 * f10),
            f11 + dt * (c10 * f01 + c11 * f11),
        )

    def step(mat, carry, sig):
        x, y, F, vel = carry
        u, v, C = g2p(vel, x, y)
        x, y = x + dt * u, y + dt * v
        x, y, u, v, C = kept((x, y, u, v, C))
        F = deform(C, F)
        g = p2g(mat, sig, x, y, u, v, C, F)
        return (x, y, F, grid_update(kept(g))), None

    def run(m, lam, mu, signal):
        mat = (m, lam, mu)
        x, y = st[0], st[1]
        C = tuple(st[4:8])
        F = deform(C, tuple(st[8:12]))
        vel = grid_update(p2g(mat, signal[0], x, y, st[2], st[3], C, F))
        carry = (jnp.asarray(x), jnp.asarray(y), F, vel)
        f = partial(step, mat)
        carry, _ = lax.scan(jax.checkpoint(f), carry, signal[1:])
        x, y, F, vel = carry
        u, v, _ = g2p(vel, x, y)
        x, y = x + dt * u, y + dt * v
        V = w_obj * (F[0] * F[3] - F[1] * F[2])
        return (V * (ex * x + ey * y)).sum() / V.sum()

    args = tuple(
        jnp.array(a)
        for a in (
            masses,
            lambdas,
            mus,
            simulation.signal,
        )
    )
    return Peer(run, args, volume)
