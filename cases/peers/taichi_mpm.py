"""The steps of `mpmopt.kernels` in Taichi, differentiated by its kernels' own gradients.

A kernel takes particles from the grid of one step to that of the next, so that only positions,
deformation gradients and nodes of all steps are kept.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import taichi as ti
from numpy.typing import NDArray

from mpmopt.design.objective import Objective
from mpmopt.simulation.simulation import Simulation
from peers import clamped, constants, window

NAME = f"Taichi {'.'.join(map(str, ti.__version__))} autodiff"

real = ti.f64


@dataclass
class Peer:
    """Launches of the forward run, and of the gradients of its kernels in reverse."""

    value: Callable[[], float]
    value_and_gradient: Callable[[], tuple[float, dict[str, NDArray[np.float64]]]]


def prepare(simulation: Simulation, objective: Objective) -> Peer:
    """The scene of a simulation, ready to run in Taichi."""
    ti.init(arch=ti.cpu, default_fp=real, cpu_max_num_threads=2, offline_cache=False)
    parameters, data, steps = simulation.parameters, simulation.data, simulation.steps
    N = simulation.initial.shape[1]
    K = len(data.actuation_stress)
    low, size = window(simulation)
    i0, j0, rows = int(low[0]), int(low[1]), int(size[1])
    nodes = int(size[0] * size[1])
    dt, dx = parameters.dt, parameters.dx
    inv, scale = 1 / dx, 4 / dx**2
    gravity = ti.Vector([dt * parameters.gravity_x, dt * parameters.gravity_y])
    lo, hi = clamped(parameters)
    lox, loy = lo
    hix, hiy = hi

    x = ti.Vector.field(2, real, (steps + 1, N), needs_grad=True)
    F = ti.Matrix.field(2, 2, real, (steps + 1, N), needs_grad=True)
    grid = ti.Vector.field(3, real, (steps, nodes), needs_grad=True)
    u = ti.Vector.field(2, real, (steps, nodes), needs_grad=True)
    mass = ti.field(real, N, needs_grad=True)
    lam = ti.field(real, N, needs_grad=True)
    mu = ti.field(real, N, needs_grad=True)
    signal = ti.field(real, (steps, K), needs_grad=True)
    volume = ti.field(real, N)
    actuator = ti.field(ti.i32, N)
    weight = ti.field(real, N)
    v0 = ti.Vector.field(2, real, N)
    C0 = ti.Matrix.field(2, 2, real, N)
    sums = ti.field(real, 2, needs_grad=True)
    result = ti.field(real, (), needs_grad=True)
    S = [ti.Matrix([[s[0], s[1]], [s[1], s[2]]]) for s in data.actuation_stress]
    ex, ey = (float(d) for d in objective.direction)

    @ti.func
    def scatter(n, p, xp, v, C, Fp):
        m = mass[p]
        H = ti.Matrix([[mu[p], 0.0], [0.0, mu[p]]])
        for k in ti.static(range(K)):
            if actuator[p] == k:
                H += signal[n, k] * S[k]
        pressure = lam[p] * ti.log(Fp.determinant()) - mu[p]
        tau = Fp @ H @ Fp.transpose() + ti.Matrix([[pressure, 0.0], [0.0, pressure]])
        A = m * C - (dt * scale * volume[p]) * tau
        base = ti.cast(xp * inv - 0.5, ti.i32)
        f = xp * inv - ti.cast(base, real)
        w = [0.5 * (1.5 - f) ** 2, 0.75 - (f - 1.0) ** 2, 0.5 * (f - 0.5) ** 2]
        node = (base[0] - i0) * rows + base[1] - j0
        q = ti.Vector([m * v[0], m * v[1], m])
        A0 = ti.Vector([A[0, 0], A[1, 0], 0.0])
        A1 = ti.Vector([A[0, 1], A[1, 1], 0.0])
        for a in ti.static(range(3)):
            qa = w[a][0] * (q + ((a - f[0]) * dx) * A0)
            Aa = w[a][0] * A1
            for b in ti.static(range(3)):
                grid[n, node + a * rows + b] += w[b][1] * (qa + ((b - f[1]) * dx) * Aa)

    @ti.kernel
    def start():
        ti.loop_config(serialize=True)  # no atomics then
        for p in range(N):
            Fp = F[0, p] + dt * C0[p] @ F[0, p]
            F[1, p] = Fp
            scatter(0, p, x[0, p], v0[p], C0[p], Fp)

    @ti.kernel
    def move(n: ti.i32):
        ti.loop_config(serialize=True)  # no atomics then
        for p in range(N):
            xp = x[n, p]
            base = ti.cast(xp * inv - 0.5, ti.i32)
            f = xp * inv - ti.cast(base, real)
            w = [0.5 * (1.5 - f) ** 2, 0.75 - (f - 1.0) ** 2, 0.5 * (f - 0.5) ** 2]
            node = (base[0] - i0) * rows + base[1] - j0
            v = ti.Vector([0.0, 0.0])
            c0 = ti.Vector([0.0, 0.0])
            c1 = ti.Vector([0.0, 0.0])
            for a in ti.static(range(3)):
                r0 = w[0][1] * u[n, node + a * rows]
                r1 = w[1][1] * u[n, node + a * rows + 1]
                r2 = w[2][1] * u[n, node + a * rows + 2]
                r = w[a][0] * (r0 + r1 + r2)
                v += r
                c0 += (a - f[0]) * r
                c1 += w[a][0] * ((0.0 - f[1]) * r0 + (1.0 - f[1]) * r1 + (2.0 - f[1]) * r2)
            C = (scale * dx) * ti.Matrix([[c0[0], c1[0]], [c0[1], c1[1]]])
            xn = xp + dt * v
            Fp = F[n + 1, p] + dt * C @ F[n + 1, p]
            x[n + 1, p] = xn
            F[n + 2, p] = Fp
            scatter(n + 1, p, xn, v, C, Fp)

    @ti.kernel
    def finish():
        for p in range(N):
            xp = x[steps - 1, p]
            base = ti.cast(xp * inv - 0.5, ti.i32)
            f = xp * inv - ti.cast(base, real)
            w = [0.5 * (1.5 - f) ** 2, 0.75 - (f - 1.0) ** 2, 0.5 * (f - 0.5) ** 2]
            node = (base[0] - i0) * rows + base[1] - j0
            v = ti.Vector([0.0, 0.0])
            for a, b in ti.static(ti.ndrange(3, 3)):
                v += w[a][0] * w[b][1] * u[steps - 1, node + a * rows + b]
            x[steps, p] = xp + dt * v

    @ti.kernel
    def update(n: ti.i32):
        ti.loop_config(serialize=True)  # no atomics then
        for i in range(nodes):
            m = grid[n, i][2]
            if m > 0.0:
                a = i0 + i // rows
                b = j0 + i % rows
                un = ti.Vector([grid[n, i][0], grid[n, i][1]]) / m + gravity
                if not (
                    (a < lox and un[0] < 0.0)
                    or (a > hix and un[0] > 0.0)
                    or (b < loy and un[1] < 0.0)
                    or (b > hiy and un[1] > 0.0)
                ):
                    u[n, i] = un
                else:
                    u[n, i] = [0.0, 0.0]
            else:
                u[n, i] = [0.0, 0.0]

    @ti.kernel
    def centroid():
        ti.loop_config(serialize=True)
        for p in range(N):
            V = weight[p] * F[steps, p].determinant()
            sums[0] += V * (ex * x[steps, p][0] + ey * x[steps, p][1])
            sums[1] += V

    @ti.kernel
    def ratio():
        result[None] = sums[0] / sums[1]

    volumes, masses, lambdas, mus = constants(simulation)

    mass.from_numpy(masses)
    lam.from_numpy(lambdas)
    mu.from_numpy(mus)
    volume.from_numpy(volumes)
    actuator.from_numpy(simulation.particles.actuator.astype(np.int32))
    weight.from_numpy(objective.weight)
    signal.from_numpy(simulation.signal)
    st = simulation.initial.real
    v0.from_numpy(np.ascontiguousarray(st[2:4].T))
    C0.from_numpy(np.ascontiguousarray(st[4:8].T.reshape(-1, 2, 2)))

    @ti.kernel
    def setx(a: ti.types.ndarray(), b: ti.types.ndarray()):
        for p in range(N):
            for k in ti.static(range(2)):
                x[0, p][k] = a[p, k]
            for k in ti.static(range(4)):
                F[0, p][k // 2, k % 2] = b[p, k]

    setx(np.ascontiguousarray(st[0:2].T), np.ascontiguousarray(st[8:12].T))

    def value():
        grid.fill(0.0)
        sums.fill(0.0)
        start()
        for n in range(steps - 1):
            update(n)
            move(n)
        update(steps - 1)
        finish()
        centroid()
        ratio()
        return float(result[None])

    def value_and_gradient():
        L = value()
        for f in (x, F, grid, u, mass, lam, mu, signal, sums):
            f.grad.fill(0.0)
        result.grad[None] = 1.0
        ratio.grad()
        centroid.grad()
        finish.grad()
        update.grad(steps - 1)
        for n in range(steps - 2, -1, -1):
            move.grad(n)
            update.grad(n)
        start.grad()
        return L, {
            "density": volume.to_numpy() * mass.grad.to_numpy(),
            "lame_lambda": lam.grad.to_numpy(),
            "lame_mu": mu.grad.to_numpy(),
            "signal": signal.grad.to_numpy(),
        }

    return Peer(value, value_and_gradient)
