"""Breaks the adjoint in many ways and prints, as JSON, what each check says of each.

Run as a program with the JIT switched off: every fault is a changed file of kernels put in
the place of the real one.
"""

import json
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
from conftest import small_scene

from mpmopt import kernels
from mpmopt.assess import verify
from mpmopt.design import actuation, chain, objective, problem
from mpmopt.design.problem import Problem
from mpmopt.scene import Ground
from mpmopt.simulation import simulation

# What is replaced in the kernels, by a name of the fault. Each stands in an adjoint kernel.
FAULTS = {
    "sign in the weights' slope": ("c + 1) + ty * curvature", "c + 1) - ty * curvature"),
    "slope of the moments": ("(b1 + tx * b2) * b", "(b1 - tx * b2) * b"),
    "bend of the moments": ("(0.375 - 3.0 * hx) * f2", "(0.375 + 3.0 * hx) * f2"),
    "C_bar transposed": (
        "c0 = pair_of(h, in_tile(t, AFFINE_BAR), in_tile(t, AFFINE_BAR + 2), k)",
        "c0 = pair_of(h, in_tile(t, AFFINE_BAR), in_tile(t, AFFINE_BAR + 1), k)",
    ),
    "position through the affine momentum": (
        "t, k, q, a0, a1)\n            set",
        "t, k, q, 0.0 * a0, a1)\n            set",
    ),
    "affine momentum transposed": (
        "gathered, in_tile(t, AFFINE_BAR + 1), k, along_y[0])",
        "gathered, in_tile(t, AFFINE_BAR + 1), k, along_x[1])",
    ),
    "mass in the momentum": ("+ u * u_bar + v * v_bar)", ")"),
    "mass of a node": ("-fused(v_bar, v, u_bar * u) * per_m", "-fused(v_bar, v, u_bar * u)"),
    "step in the velocity": ("v_bar + dt * x_bar)", "v_bar)"),
    "velocity that went to the nodes": (
        "store(bar, at(g, VELOCITY + axis), none)",
        "store(bar, at(g, VELOCITY + axis), v_bar)",
    ),
    "inertia of the affine velocity": (
        "m = load(data.mass, g)\n        add(bar, at(g, AFFINE), m * a00)",
        "m = 0.0 * load(data.mass, g)\n        add(bar, at(g, AFFINE), m * a00)",
    ),
    "pressure": ("t01 * f10) + pressure * f11", "t01 * f10) - pressure * f11"),
    "shear counted once": ("impulse * (a01 + a10)", "impulse * a01"),
    "stiffness": ("t00 * s00 + t01 * s01 + t11 * s11", "t00 * s00 + t11 * s11"),
    "actuation in F": ("h00, h01 = f00 * s00 + f01 * s01", "h00, h01 = f00 * s00"),
    "signal": ("power + t11 *", "power - t11 *"),
    "C transposed in the deformation": (
        "d01 + dt * (b00 * f10 + b01 * f11)",
        "d01 + dt * (b10 * f00 + b11 * f01)",
    ),
    "old deformation gradient": ("b00 + dt * (c00 * b00 + c10 * b10)", "b00"),
}
# In what Taylor's window does not have.
GROUND_FAULTS = {
    "friction through the normal force": (
        "node_bar[node, 3] = push_bar * parameters.dt * per_m",
        "node_bar[node, 3] = 0.0 * push_bar",
    ),
    "friction through the mass": ("2] -= push_bar * push * per_m", "2] -= 0.0 * push_bar"),
    "slope of the layer": ("-b_bar * capacity / thickness, b_bar", "0.0 * b_bar, b_bar"),
    "stiffness of the layer": ("stiffness * volume * capacity_bar)", "volume * capacity_bar)"),
}
WALL_FAULT = ("u_bar, v_bar = wall_adjoint(", "u_bar, v_bar = (lambda *args: args[-2:])(")


@contextmanager
def broken(old: str, new: str) -> Iterator[None]:
    """Kernels of which one place is changed, wherever they are used."""
    texts = {path: path.read_text() for path in Path(kernels.__file__).parent.glob("*.py")}
    (path,) = (path for path, text in texts.items() if old in text)
    assert texts[path].count(old) == 1, f"{texts[path].count(old)} places for {old}"
    name = f"{kernels.__name__}.{path.stem}"
    changed = {"__name__": name}
    exec(compile(texts[path].replace(old, new), "broken.py", "exec"), changed)
    right = {id(value): key for key, value in vars(sys.modules[name]).items() if callable(value)}
    users = [m for m in sys.modules.values() if m.__name__.startswith(kernels.__name__)]
    replaced = [
        (user, key, value)
        for user in users
        for key, value in vars(user).items()
        if id(value) in right and getattr(value, "__module__", None) == name
    ]
    for user, key, value in replaced:
        setattr(user, key, changed[right[id(value)]])
    yield
    for user, key, value in replaced:
        setattr(user, key, value)


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
    ground = (Ground.floor(3.9 / 16, friction=0.4, thickness=1 / 16),)
    scene = small_scene(particles_per_cell=1, steps=8, transient=3 * 4e-3, ground=ground)
    p = Problem(scene)
    rng = np.random.default_rng(0)
    x = p.join(rng.uniform(-0.5, 0.5, 8), [0.6, 0.5], [-0.3, 0.2], [-0.5, 0.4])
    result = {"nothing": verdicts(scene, x)}
    for name, fault in {**FAULTS, **GROUND_FAULTS, "wall forgotten": WALL_FAULT}.items():
        with broken(*fault):
            result[name] = verdicts(scene, x)

    def scaled(function):
        return lambda *args: tuple(1.001 * bar for bar in function(*args))

    for name, module, attribute, wrong in (
        ("projection", chain, "project_adjoint", lambda phi, beta, bar, threshold: bar * 0.5),
        (
            "phase",
            actuation,
            "signal_adjoint",
            scaled(actuation.signal_adjoint),
        ),
        (
            "transient forgotten",
            simulation.Forward,
            "reverse",
            lambda self, terminal_adjoints, reverse=simulation.Forward.reverse: reverse(
                self, {max(terminal_adjoints): terminal_adjoints[max(terminal_adjoints)]}
            ),
        ),
        (
            "volume in the objective",
            objective.Objective,
            "centroid_adjoint",
            lambda self, state, right=objective.Objective.centroid_adjoint: np.where(
                np.arange(12)[:, None] < 8, right(self, state), 0.0
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
