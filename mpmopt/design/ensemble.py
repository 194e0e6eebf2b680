"""A design in several scenes at once: side by side on threads, then one value and one gradient."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import reduce
from typing import TypeVar

import numpy as np

from mpmopt.design.evaluation import Evaluation
from mpmopt.design.task import Task
from mpmopt.simulation.threads import processors

Scene = TypeVar("Scene")
Result = TypeVar("Result")
Other = TypeVar("Other")


def side_by_side(function: Callable[[Scene], Result], scenes: Sequence[Scene]) -> list[Result]:
    """The function of each scene, in their order, on as many threads as there are processors.

    Compiled loops release the interpreter, so that they run at the same time.

    Raises
    ------
    Exception
        What the function of the first scene that fails raises.
    """
    workers = min(len(scenes), processors())
    if workers == 1:
        return [function(scene) for scene in scenes]
    with ThreadPoolExecutor(workers) as pool:
        return list(pool.map(function, scenes))


def meanwhile(
    function: Callable[[], Result], other: Callable[[], Other]
) -> tuple[Result, Callable[[], Other]]:
    """What a function gives, and what asks for that of another, which runs at the same time.

    The other is on a thread of its own; or with one processor, only run when it is asked for. So
    that a Ctrl-C is heard as ever, the first is not.

    Raises
    ------
    Exception
        What the function raises, once the other has ended; what that raises where it is asked for.
    """
    if processors() == 1:
        return function(), other
    with ThreadPoolExecutor(1) as pool:
        found = pool.submit(other)
        return function(), found.result


def together(task: Task, evaluations: Sequence[Evaluation]) -> Evaluation:
    """The evaluation of a task from those in each of its scenes."""
    values = np.array([each.value for each in evaluations])
    value, weights = task.soft(values)
    g = np.array([each.constraints for each in evaluations])  # (S, m)
    worst = g.real.argmax(axis=0)
    columns = np.arange(len(worst))
    has_gradients = evaluations[0].gradient.size > 0
    gradient, jacobian = evaluations[0].gradient, evaluations[0].jacobian
    if has_gradients:
        gradient = weights @ np.array([each.gradient for each in evaluations])
        jacobian = np.array([each.jacobian for each in evaluations])[worst, columns]
    return Evaluation(
        value,
        gradient,
        reduce(lambda a, b: a.join(b), (each.indicators for each in evaluations)),
        min(each.time_step for each in evaluations),
        max(each.halved for each in evaluations),
        g[worst, columns],
        jacobian,
        tuple(values.real.tolist()),
    )
