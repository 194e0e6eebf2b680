"""The steps of `mpmopt.kernels` in NVIDIA Warp, differentiated by its tape.

A kernel takes particles from the grid of one step to that of the next, so that only positions and
deformation gradients are kept. Each array of a step has a gradient, but those of all steps share
one buffer or two, which stay in cache. Launches and tape are captured once and then replayed.
"""

from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
import warp as wp
from numpy.typing import NDArray

from mpmopt.design.objective import Objective
from mpmopt.simulation.simulation import Simulation
from peers import clamped, constants, window

NAME = f"Warp {wp.__version__} tape"

wp.config.quiet = True
flags = wp.config.cpu_compiler_flags or "-march=native"
wp.set_module_options({"enable_backward": True, "cpu_compiler_flags": f"{flags} -ffast-math"})

real: TypeAlias = wp.float64
vec2: TypeAlias = wp.vec2d
vec3: TypeAlias = wp.vec3d
vec4: TypeAlias = wp.vec4d
mat22: TypeAlias = wp.mat22d


@wp.struct
class Setup:
    """Constants of all steps."""

    dt: real
    dx: real
    inverse_dx: real
    scale: real  # 4 / dx^2
    first: wp.vec2i  # first node of the window
    rows: int  # nodes of the window along y
    gravity: vec2
    low: wp.vec2i
    high: wp.vec2i


@wp.func
def cell(x: vec2, setup: Setup):
    """Base node of a position."""
    return wp.vec2i(
        int(x[0] * setup.inverse_dx - real(0.5)), int(x[1] * setup.inverse_dx - real(0.5))
    )


@wp.func
def weights(f: real):
    """Quadratic B-spline weights of three nodes, f cells from the first."""
    return vec3(
        real(0.5) * (real(1.5) - f) * (real(1.5) - f),
        real(0.75) - (f - real(1.0)) * (f - real(1.0)),
        real(0.5) * (f - real(0.5)) * (f - real(0.5)),
    )


@wp.func
def offsets(f: real):
    """From a particle to its three nodes, in cells."""
    return vec3(real(0.0) - f, real(1.0) - f, real(2.0) - f)


@wp.func
def scatter(
    p: int,
    n: int,
    x: vec2,
    v: vec2,
    C: mat22,
    F: mat22,
    setup: Setup,
    volume: wp.array(dtype=real),
    mass: wp.array(dtype=real),
    lame_lambda: wp.array(dtype=real),
    lame_mu: wp.array(dtype=real),
    actuator: wp.array(dtype=int),
    stress: wp.array(dtype=mat22),
    signal: wp.array2d(dtype=real),
    grid: wp.array(dtype=vec4),
):
    """Momentum and mass of a particle to the grid."""
    mu = lame_mu[p]
    m = mass[p]
    H = mat22(mu, real(0.0), real(0.0), mu)
    k = actuator[p]
    if k >= 0:
        H = H + signal[n, k] * stress[k]
    pressure = lame_lambda[p] * wp.log(wp.determinant(F)) - mu
    tau = F * H * wp.transpose(F) + mat22(pressure, real(0.0), real(0.0), pressure)
    A = m * C - (setup.dt * setup.scale * volume[p]) * tau

    base = cell(x, setup)
    fx = x[0] * setup.inverse_dx - real(base[0])
    fy = x[1] * setup.inverse_dx - real(base[1])
    wx = weights(fx)
    wy = weights(fy)
    rx = offsets(fx)
    ry = offsets(fy)
    node = (base[0] - setup.first[0]) * setup.rows + base[1] - setup.first[1]
    q = vec4(m * v[0], m * v[1], m, real(0.0))
    A0 = vec4(A[0, 0], A[1, 0], real(0.0), real(0.0))
    A1 = vec4(A[0, 1], A[1, 1], real(0.0), real(0.0))
    for a in range(3):
        q_a = wx[a] * (q + (setup.dx * rx[a]) * A0)
        A_a = wx[a] * A1
        for b in range(3):
            wp.atomic_add(
                grid,
                node + a * setup.rows + b,
                wy[b] * (q_a + (setup.dx * ry[b]) * A_a),
            )


@wp.func_replay(scatter)
def replay_scatter(
    p: int,
    n: int,
    x: vec2,
    v: vec2,
    C: mat22,
    F: mat22,
    setup: Setup,
    volume: wp.array(dtype=real),
    mass: wp.array(dtype=real),
    lame_lambda: wp.array(dtype=real),
    lame_mu: wp.array(dtype=real),
    actuator: wp.array(dtype=int),
    stress: wp.array(dtype=mat22),
    signal: wp.array2d(dtype=real),
    grid: wp.array(dtype=vec4),
):
    """Nothing: the way back needs no second grid."""


@wp.kernel
def start(
    setup: Setup,
    x: wp.array(dtype=vec2),
    v: wp.array(dtype=vec2),
    C: wp.array(dtype=mat22),
    F: wp.array(dtype=mat22),
    volume: wp.array(dtype=real),
    mass: wp.array(dtype=real),
    lame_lambda: wp.array(dtype=real),
    lame_mu: wp.array(dtype=real),
    actuator: wp.array(dtype=int),
    stress: wp.array(dtype=mat22),
    signal: wp.array2d(dtype=real),
    F_next: wp.array(dtype=mat22),
    grid: wp.array(dtype=vec4),
):
    """From the initial state to the first grid."""
    p = wp.tid()
    F_p = F[p] + setup.dt * (C[p] * F[p])
    F_next[p] = F_p
    scatter(
        p,
        0,
        x[p],
        v[p],
        C[p],
        F_p,
        setup,
        volume,
        mass,
        lame_lambda,
        lame_mu,
        actuator,
        stress,
        signal,
        grid,
    )


@wp.kernel
def move(
    n: int,
    setup: Setup,
    velocity: wp.array(dtype=vec2),
    x: wp.array(dtype=vec2),
    F: wp.array(dtype=mat22),
    volume: wp.array(dtype=real),
    mass: wp.array(dtype=real),
    lame_lambda: wp.array(dtype=real),
    lame_mu: wp.array(dtype=real),
    actuator: wp.array(dtype=int),
    stress: wp.array(dtype=mat22),
    signal: wp.array2d(dtype=real),
    x_next: wp.array(dtype=vec2),
    F_next: wp.array(dtype=mat22),
    grid: wp.array(dtype=vec4),
):
    """From the velocities of one step to the grid of the next one, step n."""
    p = wp.tid()
    x_p = x[p]
    base = cell(x_p, setup)
    fx = x_p[0] * setup.inverse_dx - real(base[0])
    fy = x_p[1] * setup.inverse_dx - real(base[1])
    wx = weights(fx)
    wy = weights(fy)
    rx = offsets(fx)
    ry = offsets(fy)
    node = (base[0] - setup.first[0]) * setup.rows + base[1] - setup.first[1]
    v = vec2()
    c0 = vec2()
    c1 = vec2()
    for a in range(3):
        row = node + a * setup.rows
        u0 = wy[0] * velocity[row]
        u1 = wy[1] * velocity[row + 1]
        u2 = wy[2] * velocity[row + 2]
        u = wx[a] * (u0 + u1 + u2)
        v = v + u
        c0 = c0 + rx[a] * u
        c1 = c1 + wx[a] * (ry[0] * u0 + ry[1] * u1 + ry[2] * u2)
    s = setup.scale * setup.dx
    C = mat22(s * c0[0], s * c1[0], s * c0[1], s * c1[1])
    x_p = x_p + setup.dt * v
    F_p = F[p] + setup.dt * (C * F[p])
    x_next[p] = x_p
    F_next[p] = F_p
    scatter(
        p,
        n,
        x_p,
        v,
        C,
        F_p,
        setup,
        volume,
        mass,
        lame_lambda,
        lame_mu,
        actuator,
        stress,
        signal,
        grid,
    )


@wp.kernel
def finish(
    setup: Setup,
    velocity: wp.array(dtype=vec2),
    x: wp.array(dtype=vec2),
    x_next: wp.array(dtype=vec2),
):
    """The last positions."""
    p = wp.tid()
    x_p = x[p]
    base = cell(x_p, setup)
    wx = weights(x_p[0] * setup.inverse_dx - real(base[0]))
    wy = weights(x_p[1] * setup.inverse_dx - real(base[1]))
    node = (base[0] - setup.first[0]) * setup.rows + base[1] - setup.first[1]
    v = vec2()
    for a in range(3):
        for b in range(3):
            v = v + (wx[a] * wy[b]) * velocity[node + a * setup.rows + b]
    x_next[p] = x_p + setup.dt * v


@wp.kernel
def update(
    setup: Setup,
    grid: wp.array(dtype=vec4),
    velocity: wp.array(dtype=vec2),
):
    """Velocity of the nodes from momentum, gravity and walls."""
    i = wp.tid()
    q = grid[i]
    m = q[2]
    if m > real(0.0):
        u = vec2(q[0] / m, q[1] / m) + setup.dt * setup.gravity
        a = setup.first[0] + i / setup.rows
        b = setup.first[1] + i % setup.rows
        zero = real(0.0)
        stuck = (
            (a < setup.low[0] and u[0] < zero)
            or (a > setup.high[0] and u[0] > zero)
            or (b < setup.low[1] and u[1] < zero)
            or (b > setup.high[1] and u[1] > zero)
        )
        if not stuck:
            velocity[i] = u
        else:
            velocity[i] = vec2()
    else:
        velocity[i] = vec2()


@wp.kernel
def centroid(
    direction: vec2,
    weight: wp.array(dtype=real),
    x: wp.array(dtype=vec2),
    F: wp.array(dtype=mat22),
    sums: wp.array(dtype=vec2),
):
    """Moment and volume of the particles that count."""
    p = wp.tid()
    volume = weight[p] * wp.determinant(F[p])
    wp.atomic_add(sums, 0, vec2(volume * wp.dot(direction, x[p]), volume))


@wp.kernel
def ratio(sums: wp.array(dtype=vec2), result: wp.array(dtype=real)):
    """Their ratio, the objective."""
    result[0] = sums[0][0] / sums[0][1]


@dataclass
class Peer:
    """Captured launches of the forward run and of the tape's way back."""

    result: wp.array
    forward: wp.Graph
    backward: wp.Graph
    volume: NDArray[np.float64]
    bars: dict[str, wp.array]
    kept: list[wp.array]  # the launches know only their addresses

    def value(self) -> float:
        """Objective."""
        wp.capture_launch(self.forward)
        return float(self.result.numpy()[0])

    def value_and_gradient(self) -> tuple[float, dict[str, NDArray[np.float64]]]:
        """Objective and its derivatives."""
        value = self.value()
        wp.capture_launch(self.backward)
        bars = {name: bar.numpy().copy() for name, bar in self.bars.items()}
        return value, {**bars, "density": self.volume * bars["density"]}


def prepare(simulation: Simulation, objective: Objective) -> Peer:
    """The scene of a simulation, ready to run in Warp."""
    parameters, data, steps = simulation.parameters, simulation.data, simulation.steps
    N = simulation.initial.shape[1]
    wp.set_device("cpu")

    def array(values, dtype, grad=False):
        return wp.array(np.ascontiguousarray(values), dtype=dtype, requires_grad=grad)

    volumes, masses, lambdas, mus = constants(simulation)

    volume = array(volumes, real)
    mass = array(masses, real, True)
    lam = array(lambdas, real, True)
    mu = array(mus, real, True)
    signal = array(simulation.signal, real, True)
    actuator = array(simulation.particles.actuator, int)
    stress = array(data.actuation_stress[:, [0, 1, 1, 2]].reshape(-1, 2, 2), mat22)
    lo, hi = clamped(parameters)
    low, size = window(simulation)
    nodes = int(size[0] * size[1])
    setup = Setup()
    setup.dt = parameters.dt
    setup.dx = parameters.dx
    setup.inverse_dx = 1 / parameters.dx
    setup.scale = 4 / parameters.dx**2
    setup.first = wp.vec2i(int(low[0]), int(low[1]))
    setup.rows = int(size[1])
    setup.low = wp.vec2i(*lo)
    setup.high = wp.vec2i(*hi)
    setup.gravity = vec2(parameters.gravity_x, parameters.gravity_y)

    def several(count, n, dtype, buffers):
        big = wp.zeros((count, n), dtype=dtype)
        grads = [wp.zeros(n, dtype=dtype) for _ in range(buffers)]
        arrays = [big[k] for k in range(count)]
        for k, a in enumerate(arrays):
            a.grad = grads[k % buffers]
        return big, arrays, grads

    xs, x, _ = several(steps + 1, N, vec2, 2)
    Fs, F, _ = several(steps + 1, N, mat22, 2)
    grids, grid, (grid_bar,) = several(steps, nodes, vec4, 1)
    us, u, _ = several(steps, nodes, vec2, 1)
    state = simulation.initial.real
    x[0].assign(array(state[0:2].T, vec2))
    F[0].assign(array(state[8:12].T.reshape(-1, 2, 2), mat22))
    v0 = array(state[2:4].T, vec2)
    C0 = array(state[4:8].T.reshape(-1, 2, 2), mat22)
    weight = array(objective.weight, real)
    sums = wp.zeros(1, dtype=vec2, requires_grad=True)
    result = wp.zeros(1, dtype=real, requires_grad=True)
    material = [volume, mass, lam, mu, actuator, stress, signal]
    tape = wp.Tape()
    wp.load_module(device="cpu")

    with wp.ScopedCapture(device="cpu") as forward:
        grids.zero_()
        sums.zero_()
        with tape:
            wp.launch(start, N, [setup, x[0], v0, C0, F[0], *material], [F[1], grid[0]])
            for n in range(steps):
                wp.launch(update, nodes, [setup, grid[n]], [u[n]])
                tape.record_func(grid_bar.zero_, [])
                if n + 1 < steps:
                    wp.launch(
                        move,
                        N,
                        [n + 1, setup, u[n], x[n], F[n + 1], *material],
                        [x[n + 1], F[n + 2], grid[n + 1]],
                    )
            wp.launch(finish, N, [setup, u[-1], x[-2]], [x[-1]])
            wp.launch(centroid, N, [vec2(*objective.direction), weight, x[-1], F[-1]], [sums])
            wp.launch(ratio, 1, [sums], [result])
    bars = {
        "density": mass.grad,
        "lame_lambda": lam.grad,
        "lame_mu": mu.grad,
        "signal": signal.grad,
    }
    with wp.ScopedCapture(device="cpu") as backward:
        for bar in [
            *bars.values(),
            sums.grad,
            grid_bar,
            x[0].grad,
            x[1].grad,
            F[0].grad,
            F[1].grad,
        ]:
            bar.zero_()
        tape.backward(result)
    kept = [*material, *x, *F, *grid, *u, xs, Fs, grids, us, v0, C0, weight, sums]
    return Peer(result, forward.graph, backward.graph, volumes, bars, kept)
