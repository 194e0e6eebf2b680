"""What tests sweep. Processes that compute import it from here, and little else."""

import os
import signal
import time
from pathlib import Path


def note(log, text):
    """One line at the end of a file, whole, whoever else writes."""
    handle = os.open(log, os.O_WRONLY | os.O_APPEND | os.O_CREAT)
    os.write(handle, f"{text}\n".encode())
    os.close(handle)


def noted(log):
    return log.read_text().split() if log.exists() else []


def square(x, log=os.devnull):
    note(log, x)
    return {"square": x * x}


def held_square(x, log, go):
    """From the fourth point on, waits until there is a file."""
    note(log, os.getpid())
    try:
        while x >= 3 and not Path(go).exists():
            time.sleep(0.02)
    except KeyboardInterrupt:
        note(log, "interrupted")
    return {"square": x * x}


def picky(x, log, refused):
    note(log, x)
    if x in refused:
        raise ValueError(f"{x} is refused\0\nfor good")
    return {"square": x * x}


def deadly(x, log, once):
    """Kills its own process when it comes to a point for the first time."""
    note(log, x)
    if x == once and noted(log).count(str(x)) == 1:
        time.sleep(0.2)  # others are under way
        os.kill(os.getpid(), signal.SIGKILL)
    return {"square": x * x}


def surroundings():
    threads = [os.environ.get(name) for name in ("MPMOPT_THREADS", "OPENBLAS_NUM_THREADS")]
    return {"threads": str(threads), "process": os.getpid()}


def gradient(scene, phi):
    import numpy as np

    from mpmopt.design.problem import Problem
    from mpmopt.scene import Scene

    problem = Problem(Scene.from_json(scene))
    value, slope = problem.value_and_gradient(problem.join(np.array(phi), 0.7, -0.3, -0.5))
    return {"value": value, "gradient": slope, "steps": problem.scene.steps, "name": "small"}


def whatever(kind):
    return {"none": {"x": None}, "nested": {"x": {"y": 1}}, "slash": {"x/y": 1.0}, "no": 3}[kind]
