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
    "sign in the weights' slope": ("c + 1) + ty * curvature", "c + 1) - ty * curvature"),
    "slope of the moments": ("(b1 + tx * b2) * b", "(b1 - tx * b2) * b"),
    "bend of the moments": ("(0.375 - 3.0 * hx) * f2", "(0.375 + 3.0 * hx) * f2"),
    "C_bar transposed": (
        "c0 = pair(number(h, 9 * t + 2, k), number(h, 9 * t + 4, k))",
        "c0 = pair(number(h, 9 * t + 2, k), number(h, 9 * t + 3, k))",
    ),
    "position through the affine momentum": (
        "t, k, q, a0, a1)\n            set",
        "t, k, q, 0.0 * a0, a1)\n            set",
    ),
    "affine momentum transposed": (
        "gathered, 9 * t + 1, k, along_y[0])",
        "gathered, 9 * t + 1, k, along_x[1])",
    ),
    "mass in the momentum": ("+ u * u_bar + v * v_bar)", ")"),
    "mass of a node": ("-fused(v_bar, v, u_bar * u) * per_m", "-fused(v_bar, v, u_bar * u)"),
    "step in the velocity": ("v_bar + dt * load(bar, 12 * g + axis)", "v_bar"),
    "what the blend keeps": (
        "store(bar, 12 * g + 2 + axis, world.keep * v_bar)",
        "store(bar, 12 * g + 2 + axis, none)",
    ),
    "what the blend takes": (
        "v_bar = pair(-number(bar, 12 * g + 2, k)",
        "v_bar = pair(number(bar, 12 * g + 2, k)",
    ),
    "inertia of the affine velocity": (
        "m = load(body.mass, g)\n        add(body_bar.mass",
        "m = 0.0 * load(body.mass, g)\n        add(body_bar.mass",
    ),
    "pressure": ("t01 * h10 + pressure * f11", "t01 * h10 - pressure * f11"),
    "shear counted once": ("impulse * (a01 + a10)", "impulse * a01"),
    "lambda": ("trace * load(log_J, g)", "trace"),
    "actuation in F": ("h00 + f00 * s00 + f01 * s01", "h00 + f00 * s00"),
    "signal": ("power + t11 *", "power - t11 *"),
    "C transposed in the deformation": (
        "d01 + dt * (b00 * f10 + b01 * f11)",
        "d01 + dt * (b10 * f00 + b11 * f01)",
    ),
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
    scene = small_scene(particles_per_cell=1, steps=8, blend_time=5e-3, transient=3 * 4e-3)
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
            "transient forgotten",
            simulate.Forward,
            "reverse",
            lambda self, seed, *_, reverse=simulate.Forward.reverse: reverse(self, seed),
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
