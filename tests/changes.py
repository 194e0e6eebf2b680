"""Changes that make the program wrong, and the tests that notice: are they noticed?

Run as a program it makes each change in turn and runs the tests named with it, all of them or those
whose module or name begins with what is given::

    python tests/changes.py [NAME...]

The source is changed while it is imported, so no file is touched. Kernels that are changed run
without the JIT: nothing is compiled for a change, and nothing compiled hides it. Wrong adjoints are
in ``wrong_adjoints.py``, which asks more: that each check of a gradient finds them.
"""

import contextlib
import importlib.abc
import importlib.machinery
import importlib.util
import os
import signal
import sys
import tempfile
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).parent.parent
KERNELS = ("mpm", "energy")  # modules that are compiled
SECONDS = 300  # for the tests of a change


class Change(NamedTuple):
    """What is replaced in a module, and which tests shall fail."""

    name: str
    module: str
    old: str
    new: str
    tests: str  # as pytest takes them, below tests/

    @property
    def text(self) -> str:
        """The module's source with the change."""
        text = (ROOT / "mpmopt" / f"{self.module}.py").read_text()
        if text.count(self.old) != 1:
            raise ValueError(f"{self.name}: {text.count(self.old)} places for {self.old!r}")
        return text.replace(self.old, self.new)


class Importer(importlib.machinery.SourceFileLoader, importlib.abc.MetaPathFinder):
    """Imports the changed module in the place of the real one."""

    def __init__(self, change: Change) -> None:
        name = f"mpmopt.{change.module}"
        super().__init__(name, str(ROOT / "mpmopt" / f"{change.module}.py"))
        self.code = compile(change.text, self.path, "exec", dont_inherit=True)

    def find_spec(self, name, path, target=None):
        if name == self.name:
            return importlib.util.spec_from_file_location(name, self.path, loader=self)
        return None

    def get_code(self, fullname):
        return self.code


def run_tests(tests: Sequence[str], jit: bool, change: Change | None) -> int:
    """Exit code of pytest on a changed program, in a process that has not imported it yet."""
    import numba
    import pytest

    os.environ["NUMBA_DISABLE_JIT"] = str(int(not jit))
    numba.config.reload_config()
    if change is not None:
        sys.meta_path.insert(0, Importer(change))
    sys.path[:0] = [str(ROOT), str(ROOT / "cases"), str(ROOT / "tests")]
    os.chdir(ROOT)
    signal.alarm(SECONDS)
    return pytest.main(["-x", "-q", "-p", "no:cacheprovider", *(f"tests/{test}" for test in tests)])


Job = tuple[Sequence[str], bool, Change | None]


def outcomes(jobs: Sequence[Job]) -> Iterator[tuple[int, int, str]]:
    """Of `run_tests` in a process for each job, as they end: its index, exit code and output.

    What takes long to import they have from this one.
    """
    import h5py  # noqa: F401
    import matplotlib.figure  # noqa: F401
    import numba  # noqa: F401
    import pytest  # noqa: F401
    import scipy.optimize  # noqa: F401

    sys.stdout.flush()
    waiting, running = list(range(len(jobs)))[::-1], {}
    with tempfile.TemporaryDirectory() as folder:
        while waiting or running:
            if waiting and len(running) < (os.cpu_count() or 1):
                index = waiting.pop()
                pid = os.fork()
                if pid == 0:
                    _child(jobs[index], f"{folder}/{index}")
                running[pid] = index
            else:
                pid, status = os.wait()
                index = running.pop(pid)
                output = Path(folder, str(index)).read_text()
                yield index, os.waitstatus_to_exitcode(status), output


def _child(job: Job, output: str) -> None:
    code = 3  # as pytest's for an error of its own
    try:
        file = os.open(output, os.O_CREAT | os.O_WRONLY)
        os.dup2(file, 1)
        os.dup2(file, 2)
        code = int(run_tests(*job))
        sys.stdout.flush()
    finally:
        os._exit(code)


def verdict(code: int, output: str, tests: str) -> str:
    """Empty if the tests noticed a change, else what happened instead."""
    if code == 1:
        return ""
    if code == 0:
        return f"not noticed by {tests}"
    if code == -signal.SIGALRM:
        return f"{tests} did not end within {SECONDS} s"
    return f"{tests} ended with {code}: {output[-500:]}"


def main(names: Sequence[str]) -> int:
    """Exit code: 0 if each change was noticed, and nothing fails without one."""
    changes = [c for c in CHANGES if not names or f"{c.module} {c.name}".startswith(tuple(names))]
    by_jit = {
        jit: [c.tests for c in changes if (c.module not in KERNELS) == jit] for jit in (True, False)
    }
    plain = [
        (sorted({test for text in texts for test in text.split()}), jit, None)
        for jit, texts in by_jit.items()
        if texts
    ]
    for _, code, output in outcomes(plain):
        if code:
            print(f"tests fail without any change:\n{output}")
            return 1
    noticed = 0
    jobs = [(change.tests.split(), change.module not in KERNELS, change) for change in changes]
    for index, code, output in outcomes(jobs):
        what = verdict(code, output, changes[index].tests)
        noticed += not what
        print(f"{changes[index].module:<12}{changes[index].name:<56}{what or 'noticed'}", flush=True)
    print(f"{noticed} of {len(changes)} changes noticed")
    return int(noticed < len(changes))


STEPS = "test_step_control.py"
SUMMARY = "test_summary.py"
TRIP = "test_round_trip.py"
NODES = "test_nodes.py"
CORNER = "test_nodes.py::test_two_walls_with_friction_meet_in_a_corner_one_after_the_other"
WALLS = f"test_nodes.py::test_every_branch_of_a_wall_and_of_its_adjoint {CORNER}"
LAW = "test_constitutive.py"
EQUATIONS = "test_mpm.py::test_kernels_do_what_the_equations_say_node_by_node"
HALF = (
    "test_nodes.py::"
    "test_half_a_body_that_blends_is_the_same_solution_and_its_gradient_is_exact"
)
BARELY = (
    "test_nodes.py::test_nodes_with_next_to_no_mass_spoil_no_velocity "
    "test_nodes.py::test_nodes_with_next_to_no_mass_spoil_no_gradient"
)
DESIGN = "test_design.py"
MARGINS = "test_margins.py"
STORES = "test_checkpoints.py"
PROBLEM = "test_problem.py"
STARTS = "test_multistart.py"

# By module, and the tests that shall notice: (name, old, new), or with tests of their own.
TABLE: dict[tuple[str, str], list[tuple[str, ...]]] = {
    ("optimize", STEPS): [
        (
            "the last change stops a stage",
            "abs(np.mean(values[-window:]) - np.mean(values[-window - 1 : -1]))",
            "abs(values[-1] - values[-2])",
        ),
        ("a rise of the mean does not stop, a fall does", "abs(np.mean(values", "(np.mean(values"),
        ("the mean's window is one short", "values[-window:]", "values[1 - window :]"),
        ("the mean before has another window", "values[-window - 1 : -1]", "values[-window : -1]"),
        ("the least number of iterations", "max(settings.least_iterations, window + 1)", "window + 1"),
        ("a mean is taken one too early", "window + 1):", "window):"),
        ("a change of the tolerance does not stop", "if change <= ", "if change < "),
        ("one iteration too many", "if count >= (self.stage", "if count > (self.stage"),
        ("one failure too many", ">= settings.most_failures", "> settings.most_failures"),
        ("failures are not in a row", "self.failures = 0\n            self.v", "self.v"),
        ("one halving too few", "self.failures > HALVINGS", "self.failures >= HALVINGS",
         "test_optimize.py::test_a_stage_that_never_runs_gives_up_after_three_halvings"),
        ("a decrease shortens nothing", "LENGTHEN = 0.6, 1.2", "LENGTHEN = 1.2, 1.2"),
        ("an ascent lengthens nothing", "LENGTHEN = 0.6, 1.2", "LENGTHEN = 0.6, 1.0"),
        ("the move limit adapts unasked", "went_back and self.run.settings.adapt_move_limit", "went_back"),
        ("the move limit exceeds the stage's", "min(self.stage.move_limit, factor * mma.move_limit)",
         "factor * mma.move_limit"),
        ("what stays equal went back", "self.values[-1] < self.values[-2]", "self.values[-1] <= self.values[-2]"),
        ("an ascent went back", "self.values[-1] < self.values[-2]", "self.values[-1] > self.values[-2]"),
        ("a failure halves nothing", "mma.move_limit /= 2.0", "mma.move_limit /= 1.0"),
        ("a failure keeps the asymptotes", "            mma.reset()\n", ""),
        ("a failure goes on from itself", "mma.step(self.farthest.x,", "mma.step(x,"),
        ("a failure goes back with another gradient", "-self.farthest_gradient)", "0.0 - x)"),
        ("a failure goes back to the last", "or candidate.objective > self.farthest.objective", "or True"),
        ("sharper asymptotes ignored",
         "0.5 / (self.stage.beta + 1.0) if settings.sharpen_asymptotes else 0.5", "0.5"),
        ("sharper asymptotes unasked",
         "0.5 / (self.stage.beta + 1.0) if settings.sharpen_asymptotes else 0.5",
         "0.5 / (self.stage.beta + 1.0)"),
        ("a stage's move limit ignored", "move_limit=self.stage.move_limit,", "move_limit=0.05,"),
        ("the projected gradient ignores bounds", "np.abs(gradient * free)", "np.abs(gradient)"),
        ("the projected gradient holds what is free", "x < 1.0, x > -1.0", "x > -1.0, x < 1.0"),
        ("a step is of half the range", "np.abs(x - before).max() / 2.0", "np.abs(x - before).max()"),
        ("the best is the last", "return item.objective > best.objective", "return True"),
        ("without void the objective decides", "return _order(item) > _order(best)",
         "return item.objective > best.objective"),
        ("what no audit saw is the best", "and np.isnan(item.audited)", "and False",
         "test_optimize.py::test_a_design_counts_with_the_least_of_its_audit"),
        ("every design is audited", "hopeful = solid > (best.counted if best else -np.inf)",
         "hopeful = True", "test_optimize.py::test_a_design_counts_with_the_least_of_its_audit"),
        ("a failed audit is none", "audited = -np.inf if np.isnan(audited) else audited", "pass",
         "test_optimize.py::test_a_design_counts_with_the_least_of_its_audit"),
        ("void is removed in the stage's step", "self._without_void(post_processed, problem.at(time_step), x)",
         "self._without_void(post_processed, problem, x)"),
        ("an audit is of the stage's step", "self._without_void(audit.least, problem.at(time_step), x)",
         "self._without_void(audit.least, problem, x)"),
        ("starts compared by their first stage", "item = leg.best[max(leg.best)]", "item = leg.best[min(leg.best)]"),
        ("starts compared with void", "item.counted if run.settings.stages[item.stage].solid else item.objective",
         "item.objective"),
        ("the worst start goes on", "run.leg = max(run.legs", "run.leg = min(run.legs"),
        ("scouts go to the end", "climb.stages(leg, scouting)", "climb.stages(leg, stages)"),
        ("the farthest goes on unasked", "self.farthest is not None and self.run.settings.best_first",
         "self.farthest is not None"),
        ("the last goes on unasked", "self.farthest is not None and self.run.settings.best_first", "False"),
        ("a failed first design is not replaced", "if spare is not None and not np.array_equal(spare, x)",
         "if False", "test_optimize.py::test_a_stage_whose_first_design_fails_takes_the_best_of_the_one_before"),
        ("the step of a stage is not halved", "self._pose(scene.time_step / 2.0)", "self._pose(scene.time_step)"),
        ("a failure's time step", "time_step = problem.scene.time_step / 2.0**redone",
         "time_step = problem.scene.time_step"),
        ("how often a failure was redone", "self.problem, self.problem.redo, Margins", "self.problem, 0, Margins"),
        ("the first evaluation is the last", "run.first = run.first or candidate", "run.first = candidate"),
        ("the time before a stop is forgotten", "run.history[-1].seconds if run.history else 0.0", "0.0"),
        ("failures before a stop are forgotten", "state.values.tolist(), state.failures", "state.values.tolist(), 0"),
        ("objectives before a stop are forgotten", "state.values.tolist(), state.failures", "[], state.failures"),
        ("the farthest before a stop is forgotten", "self.farthest, self.farthest_gradient = state.farthest, state.farthest_gradient", "pass"),
        ("asymptotes before a stop are forgotten", "            self.mma.restore(state.mma)\n", ""),
        ("a halved step is forgotten at a stop", "self._pose(state.time_step if state else None)", "self._pose(None)"),
        ("the stage's own limit of iterations", "self.stage.most_iterations or settings.most_iterations",
         "settings.most_iterations", "test_optimize.py::test_a_stage_may_have_its_own_limit_of_iterations"),
        ("the stage where it gave up", "reached = leg.stage + leg.gave_up", "reached = leg.stage"),
        ("stages share the first one's step", "dataclasses.replace(self, time_step=time_step)", "self"),
        ("greyness of the variables", "greyness=greyness(gamma)", "greyness=greyness(0.5 + 0.5 * x)"),
    ],
    ("history", STEPS): [
        ("the result is of the first stage's grid", "stages[max(self.best)].coarsening", "stages[min(self.best)].coarsening",
         "test_optimize.py::test_a_coarse_stage_hands_its_farthest_design_to_the_finer_grid"),
        ("the result is of the bluntest stage", "return bool(audited), item.counted, item.stage",
         "return bool(audited), item.counted, -item.stage"),
        ("the result is of the last stage", "return bool(audited), item.counted, item.stage",
         "return bool(audited), item.stage, item.counted"),
        ("no audit is preferred", "return bool(audited), item.counted, item.stage",
         "return False, item.counted, item.stage",
         "test_optimize.py::test_the_result_is_never_a_design_that_no_audit_saw_if_there_is_one"),
        ("an audit that failed is preferred", "audited and np.isfinite(item.counted)", "audited",
         "test_optimize.py::test_the_result_is_never_a_design_that_no_audit_saw_if_there_is_one"),
        ("an audit never counts less", "np.fmin(self.post_processed, self.audited)",
         "np.fmax(self.post_processed, self.audited)", "test_optimize.py::test_a_design_counts_with_the_least_of_its_audit"),
        ("all evaluations failed", "sum(bool(iteration.failure)", "sum(True", SUMMARY),
        ("all evaluations were redone", "sum(iteration.redone > 0", "sum(iteration.redone >= 0", SUMMARY),
    ],
    ("case", SUMMARY): [
        ("a gain over the block of the row", "np.fmax(row.reference, block)", "row.reference"),
        ("a gain over the block as designed", "np.fmax(row.reference, block)", "block"),
        ("a gain over the worse block", "np.fmax(row.reference, block)", "np.fmin(row.reference, block)"),
        ("references take the best actuation only", "for item in (first, best)", "for item in (best, best)"),
        ("scouts start half a turn apart", "(0.0, 0.5, 1.0, -0.5)", "(0.0, 1.0, 0.0, 1.0)"),
        ("scouts start an eighth of a turn apart", "(0.0, 0.5, 1.0, -0.5)", "(0.0, 0.25, 0.5, -0.25)"),
        ("a turn goes beyond its bounds", "theta - 2.0 * np.sign(theta)", "np.sign(theta)"),
        ("all starts scout", "turns = QUARTER_TURNS if case.settings.scouting else (0.0,)", "turns = QUARTER_TURNS"),
        ("held particles are loose", "binary.kept(problem, best.x)) > 0)", "binary.kept(problem, best.x)) >= 0)"),
        ("another row's half step", "audits[1].distance", "audits[0].distance"),
        ("the drawing of another grid", "coarsening)\n    actuations", "coarsening + 1)\n    actuations"),
        ("the drawing is the full block", "lambda _: there", "full_block"),
        ("the first actuation is told", "actuation = actuations[1]", "actuation = actuations[0]"),
        ("the start is the best", "_value_or_none(lambda: first.objective)", "best.objective"),
        ("every case is the same", "if not same or not np.array_equal(begun, starts[0])", "if False",
         "test_case.py::test_a_run_of_another_case_is_never_overwritten"),
        ("stages are not sharper", "beta=0.5 * 2**k", "beta=0.5 * 2"),
        ("void is judged late", "solid=k >= 4", "solid=k >= 5"),
        ("coarse stages are audited", "k >= 4 and coarsening == 1", "k >= 4"),
        ("void stays", "leave_out=0.05 if k >= 4 else 0.0", "leave_out=0.0"),
        ("the paper's moves are short", "time_step, move_limit=0.5, redo=0)", "time_step, redo=0)"),
        ("the paper adapts", "adapt_move_limit=False,", "adapt_move_limit=True,"),
        ("the paper sharpens", "sharpen_asymptotes=False,", "sharpen_asymptotes=True,"),
        ("the paper goes on from the best", "best_first=False,", "best_first=True,"),
    ],
    ("audit", SUMMARY): [
        ("a share of the distance", "kept = (row.distance - reference) / gain", "kept = row.distance / gain"),
        ("a share of the row's own gain", "rows[0].distance - rows[0].reference if rows else", "row.distance - reference if rows else"),
        ("a share of a loss", "if gain > 0.0 else np.nan", "if gain != 0.0 else np.nan"),
        ("the most of an audit", "    return min(\n", "    return max(\n"),
        ("half the cells in the same step", "grid=Grid((2 * nx, 2 * ny), scene.grid.dx / 2.0),\n        time_step=scene.time_step / 2.0,\n        steps=2 * scene.steps,",
         "grid=Grid((2 * nx, 2 * ny), scene.grid.dx / 2.0),"),
        ("half the cells for half the time", "steps=2 * scene.steps", "steps=scene.steps"),
        ("the reference is the design", "np.ones_like(keep)", "keep", "test_audit.py"),
        ("the least is of twice the step", "there in (scene.vary(time_step=scene.time_step / 2.0)",
         "there in (scene.vary(time_step=scene.time_step * 2.0)"),
    ],
    ("binary", SUMMARY): [
        ("the threshold is a half", "THRESHOLD = 0.3", "THRESHOLD = 0.5"),
        ("what is at the threshold goes", "problem.gamma(x) >= threshold", "problem.gamma(x) > threshold"),
        ("corners hold", "label(lattice)[0]", "label(lattice, np.ones((3, 3)))[0]"),
        ("nothing is held", "held = np.isin(labels, labels[~particles.designed])", "held = labels < 0"),
        ("a bias works on", "a=0.0 * variables.a, b=0.0 * variables.b", "a=0.0 * variables.a"),
        ("an amplitude works on", "a=0.0 * variables.a, b=0.0 * variables.b", "b=0.0 * variables.b"),
        ("the first actuation counts", "return max(values)", "return values[0]"),
        ("a failed actuation fails all", "if failure is not None and not values", "if failure is not None"),
        ("cracked bodies count", "WHOLE = 1.0", "WHOLE = 1.5",
         "test_margins.py::test_a_body_that_may_be_cracked_is_climbed_through_but_does_not_count"),
        ("the end alone counts", "objective.value(end.state, end.settled)", "objective.value(end.state)"),
    ],
    ("design", DESIGN): [
        ("greyness is squared", "np.mean(4.0 * gamma * (1.0 - gamma))", "np.mean((4.0 * gamma * (1.0 - gamma)) ** 2)"),
        ("one pass of the filter", "range(scene.filter_passes)", "range(1)"),
        ("corners weigh as edges", "(w0, w1, w2)[abs(di) + abs(dj)]", "(w0, w1, w1)[abs(di) + abs(dj)]"),
        ("rows of the filter are not scaled", "convolution = normalised(to_particles.T.tocsr()), normalised(convolution)",
         "convolution = normalised(to_particles.T.tocsr()), convolution"),
        ("floors exchanged", "mass = (1.0 - material.mass_floor) * gamma + material.mass_floor",
         "mass = (1.0 - material.stiffness_floor) * gamma + material.stiffness_floor"),
        ("stiffness is quadratic", "stiffness = (1.0 - material.stiffness_floor) * gamma +",
         "stiffness = (1.0 - material.stiffness_floor) * gamma**2 +"),
        ("the projection is not scaled", "np.tanh(beta * phi) / np.tanh(beta) + 1.0", "np.tanh(beta * phi) + 1.0"),
        ("solid regions are designed", "gamma = np.ones(self._designed.size", "gamma = np.zeros(self._designed.size"),
    ],
    ("actuation", "test_numbers.py"): [
        ("signals begin a step late", "np.arange(scene.steps) * scene.time_step", "(np.arange(scene.steps) + 1) * scene.time_step"),
        ("a phase is of half turns", "+ np.pi * theta", "+ 2.0 * np.pi * theta"),
        ("a cosine", "return a * np.sin(_phase(scene, theta)) + b", "return a * np.cos(_phase(scene, theta)) + b"),
        ("a bias pulls", "np.sin(_phase(scene, theta)) + b", "np.sin(_phase(scene, theta)) - b"),
    ],
    ("objective", "test_numbers.py"): [
        ("designed particles count", "np.where(particles.designed, 0.0, particles.volume)", "particles.volume"),
        ("volumes do not change", "self.weight * (state[8] * state[11] - state[9] * state[10])\n        return volume",
         "self.weight\n        return volume"),
        ("the transient counts", "return self.value(state) - (self.value(settled) - self.start)", "return self.value(state)"),
        ("the start is forgotten", "(self.value(settled) - self.start)", "self.value(settled)"),
    ],
    ("particles", "test_particles.py test_numbers.py"): [
        ("particles by rows", "np.lexsort((j, i))", "np.lexsort((i, j))"),
        ("a volume is a length", "spacing**2)", "spacing)"),
        ("both halves are laid out", "if scene.mirror is None or whole:", "if True:", "test_mirror.py::test_only_the_half_is_laid_out"),
        ("the nearest of all particles", "KDTree(there).query(here)[1]", "0 * KDTree(there).query(here)[1]", SUMMARY),
    ],
    ("simulate", "test_numbers.py"): [
        ("a wall clamps the node that it is on", "math.ceil(wall.position / dx - ROUNDING)", "math.floor(wall.position / dx) + 1"),
        ("no node has next to no mass", "dust = 8.0 *", "dust = 0.0 *", BARELY),
        ("what sticks slides", "np.inf if w.friction == \"stick\"", "0.0 if w.friction == \"stick\""),
        ("walls push the other way", "[1 if w.solid_side == \"below\" else -1", "[-1 if w.solid_side == \"below\" else 1"),
        ("particles keep a share of the step", "math.exp(-scene.time_step / scene.blend_time)", "math.exp(-scene.blend_time)"),
        ("margins are joined by the smallest", "max(self.spin, other.spin)", "min(self.spin, other.spin)"),
        ("margins are joined by the largest J", "min(self.jacobian, other.jacobian)", "max(self.jacobian, other.jacobian)"),
        ("margins of void are torn", "solid = 0.5 * self.scene.material.lame_mu", "solid = 0.0 * self.scene.material.lame_mu", MARGINS + "::test_margins_are_those_of_every_sixteenth_state_and_the_last"),
        ("the last state is not looked at", "slots.append(last - first)", "pass", MARGINS + "::test_margins_are_those_of_every_sixteenth_state_and_the_last"),
        ("a transient ends a step late", "states[transient - first]", "states[transient - first - 1]", PROBLEM + "::test_after_a_transient_only_what_follows_counts_and_the_gradient_is_exact"),
        ("the way back does not stop at the transient", "if start < transient - first < stop:", "if False:", PROBLEM + "::test_after_a_transient_only_what_follows_counts_and_the_gradient_is_exact"),
        ("a signal of another segment", "self.advance(first, last)\n            return", "self.advance(0, last - first)\n            return",
         STORES + "::test_no_schedule_changes_a_bit_of_the_gradient"),
        ("single precision is double", "dtype = np.dtype(np.float32)", "dtype = np.dtype(np.float64)", "test_cheapest.py::test_single_precision_loses_digits_but_few"),
    ],
    ("problem", PROBLEM): [
        ("an edge is left out", ">= self.leave_out", "> self.leave_out", SUMMARY),
        ("the settled body pulls forward", "-objective.seed(settled)", "objective.seed(settled)"),
        ("adjoints of those present first", "bars[:, self.present(phi)] =", "bars[:, : len(gradient.density)] ="),
        ("limits hold for what is left alone", "if self.redo == 0:", "if False:", MARGINS + "::test_no_limit_is_met_by_an_evaluation_that_is_left_alone"),
        ("a limit on J is none", "1.0 / margins.jacobian, 1.0 / LIMITS.jacobian", "1.0 / margins.jacobian, np.inf", MARGINS),
        ("no limit on the Courant number", "margins.courant, LIMITS.courant", "margins.courant, np.inf", MARGINS),
        ("no limit on the spin", "margins.spin, LIMITS.spin", "margins.spin, np.inf", MARGINS),
        ("no limit on the energy", "if not margins.energy <= LIMITS.energy", "if False", "test_energy.py::test_an_evaluation_in_which_energy_appears_fails_and_says_so"),
        ("solid is never torn", "if not margins.stretch <= limit", "if False", MARGINS),
        ("the step is not halved", "problem = problem.at(problem.scene.time_step / 2.0)", "problem = problem.at(problem.scene.time_step)", MARGINS),
        ("what is torn is redone", "            except TornError:\n                raise\n", "", MARGINS),
        ("phi of the first particles", "parts.phi[nearest_designed(self.particles, other.particles)]", "np.resize(parts.phi, int(self.particles.designed.sum()))"),
        ("theta and a exchanged", "return self.join(phi, parts.a, parts.theta, parts.b)", "return self.join(phi, parts.theta, parts.a, parts.b)"),
    ],
    ("checkpoints", STORES + " test_numbers.py"): [
        ("states never fit", "steps * step_bytes <= wish.memory", "steps * step_bytes < 0"),
        ("segments of all steps", "root = math.isqrt(steps - 1) + 1", "root = steps"),
        ("segments of few steps", "root = math.isqrt(steps - 1) + 1", "root = math.isqrt(math.isqrt(steps))"),
        ("a store is never too large", "in_memory = wish.store == \"memory\" or (wish.store is None and fits)", "in_memory = wish.store != \"disk\""),
        ("the last segment may be lost", "self.segments[-1][0]\n\n    @property\n    def stored", "self.segments[-1][1]\n\n    @property\n    def stored"),
        ("every other state", "segment = min(wish.every, steps)", "segment = min(2 * wish.every, steps)"),
    ],
    ("runfile", TRIP): [
        ("whole numbers are no columns", "if f.type in (\"int\", \"float\"))", "if f.type in (\"float\",))"),
        ("failures are not kept", "data=[i.failure for i in run.history]", "data=[\"\" for i in run.history]"),
        ("the first is the last", "first=_read_candidate(file, \"first\")", "first=_read_candidate(file, \"last\")"),
        ("a leg's reason is not kept", "reason=str(attributes[\"reason\"])", "reason=\"\""),
        ("a leg never gave up", "gave_up=bool(attributes[\"gave_up\"])", "gave_up=False"),
        ("the first leg goes on", "leg=int(file.attrs[\"leg\"])", "leg=0"),
        ("failures in a row are not kept", "failures=int(group.attrs[\"failures\"])", "failures=0"),
        ("the gradient is not kept", "gradient=_numbers(group, \"gradient\"),\n        farthest=", "gradient=np.empty(0),\n        farthest="),
        ("objectives are not kept", "values=_numbers(group, \"values\")", "values=_numbers(group, \"gradient\")"),
        ("the farthest is not kept", "_write_candidate(group, \"farthest\", state.farthest)", "pass"),
        ("the stage is not kept", "_read_stage(file[\"stage\"]) if \"stage\" in file else None", "None"),
        ("the drawing is not kept", "in file.get(\"drawing\", {}).items()", "in {}.items()"),
        ("the summary is not kept", "json.dumps(dict(summary or {}))", "json.dumps({})"),
        ("x and gamma exchanged", "group.create_dataset(\"x\", data=item.x,", "group.create_dataset(\"x\", data=item.gamma,"),
    ],
    ("scene", "test_scene.py test_numbers.py"): [
        ("a step may be twice too long", "self.grid.dx * math.sqrt(material.density / (stiffness * stiffest))", "2.0 * self.grid.dx * math.sqrt(material.density / (stiffness * stiffest))"),
        ("void is as stiff as it is light", "stiffest = max(1.0, material.stiffness_floor / material.mass_floor)", "stiffest = 1.0"),
        ("a transient is cut, not rounded", "return round(min(self.transient / self.time_step, self.steps))", "return int(min(self.transient / self.time_step - 0.5, self.steps))"),
        ("the filter's own transfers", "(cells**2 - 0.5)", "cells**2"),
        ("fewer passes", "return max(1, round((", "return max(1, int(0.5 * ("),
        ("another duration", "steps = max(1, round(self.duration / time_step))", "steps = self.steps"),
        ("wider cells, more of them", "nx, ny = (n // coarsening for n in self.grid.cells)", "nx, ny = self.grid.cells"),
        ("ellipticity of half the stress", "largest = LARGEST_SIGNAL *", "largest = 0.5 * LARGEST_SIGNAL *"),
        ("the Courant number of shear", "return self.material.wave_speed * self.time_step", "return 0.5 * self.material.wave_speed * self.time_step"),
    ],
    ("multistart", STARTS): [
        ("the worst is the best", "return max(rows, key=_rank)", "return min(rows, key=_rank)"),
        ("no audit decides", "return audited, gain", "return gain, audited"),
        ("the most of an audit is honest", "np.min([gains[name]", "np.max([gains[name]"),
        ("twice the step is honest", "honest = (\"as designed\", \"half", "honest = (\"twice the step\", \"half"),
        ("starts are half as wild", "AMPLITUDE * math.sqrt(2.0 / WAVES)", "AMPLITUDE * math.sqrt(1.0 / WAVES)"),
        ("starts are finer", "(LENGTH * sides.max())", "(0.5 * LENGTH * sides.max())"),
        ("the plain start is random", "phi=random_start(case.scene, seed) if seed else None", "phi=random_start(case.scene, seed)"),
    ],
    ("motion", "test_film.py::test_both_halves_of_a_symmetric_scene_are_shown "
     "test_mirror.py::test_the_state_and_its_image_are_the_whole_state test_numbers.py"): [
        ("an image moves along", "image[2 + k] *= -1.0", "pass"),
        ("an image is not where it is", "2.0 * mirror.position - state[k]", "mirror.position - state[k]"),
        ("an image is sheared as its half", "image[block + 2 * k + other] *= -1.0", "pass"),
        ("void is shown", "return Body(\"optimised design\", problem.simulation(x), gamma[present])",
         "return Body(\"optimised design\", problem.simulation(x), 0.0 * gamma[present])"),
    ],
    ("energy", LAW): [
        ("no energy of shape", "0.5 * mu * (trace - 2.0)", "0.25 * mu * (trace - 2.0)"),
        ("no energy of pressure", "0.5 * lam * log_J**2", "lam * log_J**2"),
        ("the logarithm counts twice", "- mu * log_J", "- 2.0 * mu * log_J"),
        ("energy of a trace that is not at rest", "(trace - 2.0)", "trace"),
        ("gravity lifts", "potential -= mass * world.gravity_y", "potential += mass * world.gravity_y"),
        ("gravity is along y alone", "potential -= mass * world.gravity_x", "potential -= 0.0 * mass"),
        ("positions half a step late", "(x - half * u)", "x"),
        ("F half a step late", "f00 + half * (c00 * f00 + c01 * f10)", "f00"),
        ("no inertia of the gradient", "inertia = 0.5 * world.dt, 0.25 * world.dx", "inertia = 0.5 * world.dt, 0.0 * world.dx"),
        ("shear works once", "2.0 * s01 * (f00 * f01", "s01 * (f00 * f01"),
        ("actuators squeeze twice", "held += 0.5 * volume", "held += volume"),
        ("actuators squeeze across", "s00 * (f00 * f00 + f10 * f10)", "s00 * (f00 * f00 + f01 * f01)"),
    ],
    ("mpm", WALLS): [
        ("a node leaving a wall is clamped", "if side * un.real < 0.0:", "if True:"),
        ("a node in front is clamped", "> 0:\n            un, ut = (u, v) if normal_is_x else (v, u)\n            if side * un.real", ">= -99:\n            un, ut = (u, v) if normal_is_x else (v, u)\n            if side * un.real"),
        ("the node on a wall is clamped", "> 0:\n            un, ut = (u, v) if normal_is_x else (v, u)\n            if side * un.real", ">= 0:\n            un, ut = (u, v) if normal_is_x else (v, u)\n            if side * un.real"),
        ("friction speeds up", "ut + np.sign(ut.real) * friction * side * un", "ut - np.sign(ut.real) * friction * side * un"),
        ("friction pushes one way", "ut + np.sign(ut.real) * friction * side * un", "ut + friction * side * un"),
        ("friction forgets the side", "ut + np.sign(ut.real) * friction * side * un", "ut + np.sign(ut.real) * friction * un"),
        ("nothing sticks", "if abs(ut.real) <= friction * abs(un.real):", "if friction == np.inf:"),
        ("a wall lets some through", "                un = 0.0 * un\n", "                un = 0.5 * un\n"),
        ("adjoint: a node leaving is clamped", "if side * un < 0.0:", "if True:"),
        ("adjoint: a node in front is clamped", "> 0:\n            un, ut = (u, v) if normal_is_x else (v, u)\n            if side * un <", ">= -99:\n            un, ut = (u, v) if normal_is_x else (v, u)\n            if side * un <"),
        ("adjoint: friction pushes one way", "slope = np.sign(ut) * friction * side", "slope = friction * side"),
        ("adjoint: friction forgets the side", "slope = np.sign(ut) * friction * side", "slope = np.sign(ut) * friction"),
        ("adjoint: friction has no slope", "slope = np.sign(ut) * friction * side", "slope = 0.0"),
        ("adjoint: what sticks slides", "                    keep = 0.0\n", "                    keep = 1.0\n"),
        ("adjoint: the second wall sees the old velocity", "ut = keep * ut + slope * un\n                un = 0.0\n", "pass\n", CORNER),
        ("adjoint: the second wall sees what goes on", "                un = 0.0\n                if normal", "                if normal", CORNER),
        ("adjoint: a wall along x forgets the slope", "keep * d10 + slope * d00, keep * d11 + slope * d01", "keep * d10, keep * d11"),
        ("adjoint: a wall along y forgets the slope", "keep * d00 + slope * d10, keep * d01 + slope * d11", "keep * d00, keep * d01"),
        ("adjoint: a wall along x lets through", "                    d00 = d01 = 0.0\n", ""),
        ("adjoint: a wall along y lets through", "                    d10 = d11 = 0.0\n", ""),
        ("adjoint: not transposed", "d00 * u_bar + d10 * v_bar, d01 * u_bar + d11 * v_bar", "d00 * u_bar + d01 * v_bar, d10 * u_bar + d11 * v_bar"),
        ("adjoint: the other velocity", "u, v = (un, ut) if normal_is_x else (ut, un)\n    return d00", "u, v = ut, un\n    return d00", CORNER),
        ("the other velocity", "u, v = (un, ut) if normal_is_x else (ut, un)\n    return u, v", "u, v = (ut, un) if normal_is_x else (un, ut)\n    return u, v"),
    ],
    ("mpm", BARELY): [
        ("nodes with next to no mass move", "        if m.real > world.dust:\n            per_m = 1.0 / m\n", "        if m.real > 0.0:\n            per_m = 1.0 / m\n"),
        ("adjoint: nodes with next to no mass move", "        if m > world.dust:", "        if m > 0.0:"),
        ("nodes with next to no mass move in the blend", "            if m.real > world.dust:\n                per_m = 1.0 / grid[1, node, 2]", "            if m.real > 0.0:\n                per_m = 1.0 / grid[1, node, 2]"),
    ],
    ("mpm", HALF): [
        ("a plane folds the first sheet", "for sheet in range(sheets):\n                    mirror(grid[sheet]", "for sheet in range(1):\n                    mirror(grid[sheet]"),
        ("adjoint: a plane folds the first sheet", "for sheet in range(sheets):\n                    mirror(scratch.node_bar[sheet]", "for sheet in range(1):\n                    mirror(scratch.node_bar[sheet]"),
        ("adjoint: a plane folds nothing", "        if world.mirror_axis >= 0:\n            if thread == 0:\n", "        if False:\n            if thread == 0:\n"),
        ("an image moves along on nodes", "sign = -1.0 if lane == normal else 1.0", "sign = 1.0"),
        ("an image is a node aside", "image = line * step + (plane - k) * stride", "image = line * step + (plane - k - 1) * stride"),
        ("the plane itself is not folded", "for k in range(count - plane):", "for k in range(1, count - plane):"),
        ("mass is not folded", "for lane in range(3):", "for lane in range(2):"),
        ("images along x alone are in the window", "elif world.mirror_axis == 1:\n        j0 = min", "elif False:\n        j0 = min"),
        ("images along y alone are in the window", "if world.mirror_axis == 0:\n        i0 = min", "if False:\n        i0 = min"),
        ("a plane across x is one across y", "first, count, stride = (i0, ni, nj) if normal == 0", "first, count, stride = (i0, ni, nj) if normal == 9"),
    ],
    ("mpm", EQUATIONS): [
        ("gravity pulls along y alone", "+ world.dt * world.gravity_x\n            v = grid", "+ 0.0 * world.gravity_x\n            v = grid"),
        ("gravity acts in the blend", "u, v = grid[1, node, 0] * per_m, grid[1, node, 1] * per_m\n            velocity", "u, v = grid[1, node, 0] * per_m, grid[1, node, 1] * per_m + world.dt * world.gravity_y\n            velocity"),
        ("positions move before velocities", "load(old, 12 * g) + dt * load(new, 12 * g + 2)", "load(old, 12 * g) + dt * load(old, 12 * g + 2)"),
        ("C is a half", "dt, per_dx = world.dt, 4.0 / world.dx", "dt, per_dx = world.dt, 2.0 / world.dx"),
        ("the blend keeps all", "add(new, 12 * g + 2 + axis, world.keep * lost)", "add(new, 12 * g + 2 + axis, lost)"),
        ("F follows half a step", "g00 = f00 + dt *", "g00 = f00 + 0.5 * dt *"),
        ("F follows C transposed", "g01 = f01 + dt * (c00 * f01 + c01 * f11)", "g01 = f01 + dt * (c00 * f01 + c10 * f11)"),
        ("the stress has no pressure", "load(body.lame_lambda, g) * load(log_J, g) - mu", "-1.0 * mu"),
        ("the stress is that of F^T F", "t01 = mu * (f00 * f10 + f01 * f11)", "t01 = mu * (f00 * f01 + f10 * f11)"),
        ("actuators do not shear", "s01 = s01 + signal[k] * body.actuation_stress[k, 1] * there", "s01 = s01 + 0.0 * there"),
        ("all particles are actuated", "there = load(body.actuated[k], g)\n        s00", "there = 1.0\n        s00"),
        ("the last actuator works", "s00 = s00 + signal[k]", "s00 = 0.0 * s00 + signal[k]"),
        ("affine momentum is lost", "            m * c00 - impulse * t00,", "            -impulse * t00,"),
        ("affine momentum is transposed", "m * c01 - impulse * t01,", "m * c10 - impulse * t01,"),
        ("the blend has no affine part", "store_tensor(tile.affine, 4 * (g - first), m * c00, m * c01, m * c10, m * c11)", "store_tensor(tile.affine, 4 * (g - first), m * c00, m * c01, m * c10, 0.0 * m * c11)"),
        ("places are taken from the corner", "tx, ty = x - (i + 1.0), y - (j + 1.0)", "tx, ty = x - (i + 1.0), y - (j + 0.9)"),
        ("weights are linear", "hx, hy = 0.5 * tx * tx, 0.5 * ty * ty", "hx, hy = 0.5 * tx * tx, 0.4 * ty * ty"),
    ],
    ("mpm", MARGINS + "::test_margins_are_those_of_every_sixteenth_state_and_the_last"): [
        ("margins: stiffness unstretched", "stiffness = lam + mu * trace + ", "stiffness = lam + 2.0 * mu + "),
        ("margins: spin of one entry", "c00 * c00 + c01 * c01 + c10 * c10 + c11 * c11)\n                smallest", "c00 * c00)\n                smallest"),
        ("margins: stretch of all", "if mu >= solid:", "if True:"),
        ("margins: the largest J", "smallest = min(smallest, J)", "smallest = J"),
    ],
}  # fmt: skip


def _changes():
    for (module, tests), rows in TABLE.items():
        for name, old, new, *own in rows:
            yield Change(name, module, old, new, own[0] if own else tests)


CHANGES = tuple(_changes())

if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
