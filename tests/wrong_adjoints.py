"""Breaks the adjoint in many ways and prints, as JSON, what each check says of each.

Run as a program with the JIT switched off: every fault is a changed copy of ``mpm.py`` put in the
place of the real one.
"""

import json
import sys
import types
from pathlib import Path

import numpy as np
from conftest import small_scene

from mpmopt import actuation, design, mpm, objective, problem, simulate, verify
from mpmopt.problem import Problem

# What is replaced in mpm.py, by a name of the fault. Each stands in an adjoint kernel.
FAULTS = {
    "sign of the position's weight slope": (
        "gx += slope_x[a] * across",
        "gx -= slope_x[a] * across",
    ),
    "distance in C_bar forgotten": ("- (c00 * u + c10 * v)", "- (c00 * u + c01 * v)"),
    "position through the affine momentum": (
        "x_bar[0, p] += gx - (a00 * sum_x + a10 * sum_y)",
        "x_bar[0, p] += gx",
    ),
    "mass in the momentum": (
        "body_bar.mass[p] += sum_m + v[0, p] * sum_x + v[1, p] * sum_y",
        "body_bar.mass[p] += sum_m",
    ),
    "mass of a node": (
        "scratch.node_bar[node, 2] = -(u_bar * qx + v_bar * qy) / (m * m)",
        "scratch.node_bar[node, 2] = -(u_bar * qx + v_bar * qy) / m",
    ),
    "step in the velocity": (
        "u_bar = bar[2, p] + world.dt * bar[0, p]",
        "u_bar = bar[2, p]",
    ),
    "pressure": ("+ pressure * f11", "- pressure * f11"),
    "shear counted once": ("t01 = impulse * (a01 + a10)", "t01 = impulse * a01"),
    "lambda": ("trace * scratch.log_J[p]", "trace"),
    "actuation in F": ("b00 += s * (2.0 * t00 * g00", "b00 += s * (t00 * g00"),
    "signal": ("+ t11 * (g10 * f10 + g11 * f11)", "- t11 * (g10 * f10 + g11 * f11)"),
    "C transposed": ("dt * (b00 * h10 + b01 * h11)", "dt * (b10 * h00 + b11 * h01)"),
    "old deformation gradient": (
        "F_bar[0, p] = b00 + dt * (c00 * b00 + c10 * b10)",
        "F_bar[0, p] = b00",
    ),
}
WALL_FAULT = ("u_bar, v_bar = wall_adjoint(", "u_bar, v_bar = (lambda *args: args[-2:])(")


def broken(old: str, new: str) -> types.ModuleType:
    """A copy of mpm.py with one place changed."""
    text = Path(mpm.__file__).read_text()
    start = text.index("def stress_adjoint")
    assert text[start:].count(old) >= 1, old
    module = types.ModuleType("broken")
    exec(compile(text[:start] + text[start:].replace(old, new), "broken.py", "exec"), vars(module))
    return module


def verdicts(scene, x) -> dict[str, bool]:
    """Whether each kind of check passes."""
    dot = max(verify.kernel_mismatches(scene).values()) <= verify.DOT_TOLERANCE
    errors = verify.complex_step_errors(Problem(scene, 2.0), x)
    free = Problem(verify.contact_free(scene), 2.0)
    direction = np.random.default_rng(1).uniform(-1.0, 1.0, x.size)
    order = verify.taylor_test(free, x, direction).order
    return {
        "dot": bool(dot),
        "complex step": max(errors.values()) <= verify.COMPLEX_TOLERANCE,
        "Taylor": bool(np.abs(order - 2.0).max() <= verify.ORDER_TOLERANCE),
    }


def main() -> None:
    scene = small_scene(particles_per_cell=1, steps=8)
    p = Problem(scene)
    rng = np.random.default_rng(0)
    x = p.join(rng.uniform(-0.5, 0.5, 8), [0.6, 0.5], [-0.3, 0.2], [-0.5, 0.4])
    result = {"nothing": verdicts(scene, x)}
    for name, fault in {**FAULTS, "wall forgotten": WALL_FAULT}.items():
        simulate.mpm = verify.mpm = broken(*fault)
        result[name] = verdicts(scene, x)
    simulate.mpm = verify.mpm = mpm

    def scaled(function):
        return lambda *args: tuple(1.001 * bar for bar in function(*args))

    for name, module, attribute, wrong in (
        ("projection", design, "project_adjoint", lambda phi, beta, bar: bar * 0.5),
        (
            "phase",
            actuation,
            "signal_adjoint",
            scaled(actuation.signal_adjoint),
        ),
        (
            "volume in the objective",
            objective.Objective,
            "seed",
            lambda self, state, seed=objective.Objective.seed: np.where(
                np.arange(12)[:, None] < 8, seed(self, state), 0.0
            ),
        ),
    ):
        right = getattr(module, attribute)
        users = [m for m in (module, problem, verify) if getattr(m, attribute, None) is right]
        for user in users:
            setattr(user, attribute, wrong)
        result[name] = verdicts(scene, x)
        for user in users:
            setattr(user, attribute, right)
    json.dump(result, sys.stdout)


if __name__ == "__main__":
    main()
