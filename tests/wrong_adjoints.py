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
    "sign of the weights' slope": ("return (f - 1.5) / dx,", "return (1.5 - f) / dx,"),
    "slopes where weights belong": (
        "blends(w_y, s_y), blends(s_x, w_x)\n            v_bar",
        "blends(s_y, w_y), blends(w_x, s_x)\n            v_bar",
    ),
    "C_bar transposed in the position": ("- c00 * u - c10 * v)", "- c00 * u - c01 * v)"),
    "position through the affine momentum": ("- a00 * qx_bar - a10 * qy_bar)", ")"),
    "affine momentum transposed": (
        "gathered, 8 * t + 1, k, mean[2])",
        "gathered, 8 * t + 1, k, along[1])",
    ),
    "mass in the momentum": ("+ u * qx_bar + v * qy_bar)", ")"),
    "mass of a node": ("(u_bar * qx + v_bar * qy) / (m * m)", "(u_bar * qx + v_bar * qy) / m"),
    "step in the velocity": ("add(bar, 12 * g + 2, dt * x_bar)", "pass"),
    "pressure": ("t01 * h10 + pressure * f11", "t01 * h10 - pressure * f11"),
    "shear counted once": ("impulse * (a01 + a10)", "impulse * a01"),
    "lambda": ("trace * load(log_J, g)", "trace"),
    "actuation in F": ("h00 + f00 * s00 + f01 * s01", "h00 + f00 * s00"),
    "signal": ("power + t11 *", "power - t11 *"),
    "C transposed": ("d01 + dt * (b00 * f10 + b01 * f11)", "d01 + dt * (b10 * f00 + b11 * f01)"),
    "old deformation gradient": ("b00 + dt * (c00 * b00 + c10 * b10)", "b00"),
}
WALL_FAULT = ("u_bar, v_bar = wall_adjoint(", "u_bar, v_bar = (lambda *args: args[-2:])(")


def broken(old: str, new: str) -> types.ModuleType:
    """A copy of mpm.py with one place changed."""
    text = Path(mpm.__file__).read_text()
    assert text.count(old) == 1, f"{text.count(old)} places for {old}"
    module = types.ModuleType("broken")
    exec(compile(text.replace(old, new), "broken.py", "exec"), vars(module))
    return module


def verdicts(scene, x) -> dict[str, bool]:
    """Whether each kind of check passes."""
    dot = max(verify.kernel_mismatches(scene).values()) <= verify.DOT_TOLERANCE
    errors = verify.complex_step_test(Problem(scene, 2.0), x)
    free = Problem(verify.contact_free(scene), 2.0)
    direction = np.random.default_rng(1).uniform(-1.0, 1.0, x.size)
    order = verify.taylor_test(free, x, direction).order
    return {
        "dot": bool(dot),
        "complex step": max(e.error for e in errors.values()) <= verify.COMPLEX_TOLERANCE,
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
