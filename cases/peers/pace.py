"""How fast peers are: each run in a process of its own, so that two can be timed side by side."""

import importlib
import subprocess
import sys
from pathlib import Path
from types import TracebackType

CASES = Path(__file__).parent.parent
PROGRAM = "import sys; sys.path.insert(0, sys.argv[1]); from peers.pace import serve; serve()"


class Runner:
    """A peer that does a value and a gradient of the paper's walker as often as it is told to.

    Parameters
    ----------
    module : str
        Of this package.
    cells : int
        Along the unit square.
    steps : int
    """

    def __init__(self, module: str, cells: int, steps: int) -> None:
        self._process = subprocess.Popen(
            [sys.executable, "-c", PROGRAM, str(CASES), module, str(cells), str(steps)],
            stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, bufsize=1,
        )  # fmt: skip
        self._steps = steps

    def ready(self) -> int:
        """Wait until it is compiled; particles times steps."""
        while not (line := self._said()).startswith("particles "):
            pass  # libraries greet on the same stream
        return int(line.split()[1]) * self._steps

    def start(self) -> None:
        """Begin an evaluation."""
        assert self._process.stdin is not None
        self._process.stdin.write("go\n")
        self._process.stdin.flush()

    def finish(self) -> None:
        """Wait for its end."""
        while self._said() != "done":
            pass

    def _said(self) -> str:
        assert self._process.stdout is not None
        line = self._process.stdout.readline()
        if not line:
            raise SystemExit("a peer ended before it was told to")
        return line.strip()

    def __enter__(self) -> "Runner":
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self._process.terminate()
        self._process.wait()


def together(*runners: Runner) -> None:
    """An evaluation of each, side by side."""
    for runner in runners:
        runner.start()
    for runner in runners:
        runner.finish()


def serve() -> None:
    """In the process of a `Runner`: an evaluation for each line that comes."""
    from benchmark import problem_of

    from mpmopt.design.objective import Objective

    module, cells, steps = sys.argv[2], int(sys.argv[3]), int(sys.argv[4])
    problem, x = problem_of(cells, steps)
    simulation = problem.simulation(x)
    objective = Objective.of(problem.scene, simulation.particles)
    peer = importlib.import_module(f"peers.{module}").prepare(simulation, objective)
    peer.value_and_gradient()  # compiled then
    print(f"particles {simulation.initial.shape[1]}", flush=True)
    for _ in sys.stdin:
        peer.value_and_gradient()
        print("done", flush=True)
