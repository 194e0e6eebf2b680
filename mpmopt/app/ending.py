"""What a case says at its end: what it found, where it is, and what to type next."""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from mpmopt.app.case import RESULTS
from mpmopt.io.console import command
from mpmopt.optimisation.history import Optimisation
from mpmopt.results import runfile
from mpmopt.validation import digits


def ending(path: str | os.PathLike[str]) -> str:
    """A short table of a finished run, for a terminal.

    Lengths are displacements, if that is what the objective counts, not places.

    Parameters
    ----------
    path : str or path
        Of the run file.

    Raises
    ------
    RunFileError
        As `runfile.read_run`.
    """
    path = Path(os.path.realpath(path))
    found = runfile.read_run(path)
    run, summary = found.run, found.summary
    last = len(run.settings.stages)
    best = run.result
    failed = run.failed_evaluations
    lines = {
        **({"verdict": summary["verdict"]} if "verdict" in summary else {}),
        run.measure: _travel(run, summary),
        "gain": _gain(summary),
        **_elsewhere(summary),
        "pieces": _pieces(summary),
        "chosen": f"evaluation {run.chosen} of {len(run.history)}, stage {best.stage + 1} of "
        f"{last}, beta {best.beta:g}",
        **({"failed": f"{failed} evaluations, each stepped back from"} if failed else {}),
        "stopped": run.stop_reason,
        "files": f"{path.parent}: {', '.join(_files(path))}",
        "next": command("-m", "mpmopt", "film", str(path)),
    }
    width = max(map(len, lines))
    return "\n".join(f"{name:<{width}}  {text}" for name, text in lines.items())


def _shown(value: Any) -> str:
    return "-" if value is None else digits(value, 3)


def _travel(run: Optimisation, summary: Mapping[str, Any]) -> str:
    """How far the design goes without grey, how fast, and how far it went with its void."""
    solid, grey = (summary[name] for name in ("post_processed", "optimised"))
    if solid is None:
        return f"none: the design fails without its void; with it {_shown(grey - run.origin)}"
    solid -= run.origin
    text = f"{_shown(solid)} without grey, {_shown(grey - run.origin)} as optimised"
    if run.measure == "displacement":
        time = run.scene.duration - run.scene.transient
        text += f"; in {_shown(time)}"
        if "speed" not in summary:
            text += f", a speed of {_shown(solid / time)}"
    return text


def _gain(summary: Mapping[str, Any]) -> str:
    """Gain over the solid block, and what of it the study retains."""
    kept, steps = summary["retained_gain"].items(), summary.get("shorter_steps", {})
    shares = ", ".join(
        f"{'-' if each is None else f'{each:.0%}'} with {name}"
        f"{f' (step {digits(steps[name], 2)})' if name in steps else ''}"
        for name, each in kept
    )
    return f"{_shown(summary['gain']['as designed'])} over the solid block; retained: {shares}"


def _elsewhere(summary: Mapping[str, Any]) -> dict[str, str]:
    """What the short study found (`robustness.study`), if the scene has one."""
    if "speed" not in summary:
        return {}
    table = summary["speed_by_friction"].items()
    by_friction = ", ".join(f"{_shown(speed)} at {friction}" for friction, speed in table)
    driven = summary["driven_share"]
    share = "" if driven is None else f"; {driven:.0%} of the speed is driven"
    speed = f"{_shown(summary['speed'])} after the transient{share}"
    followed = summary.get("followed") or {"end": "goes on"}
    end = followed["end"]
    way = summary.get("way") or "goes"
    slow = "" if way == "goes" else f"; it {way}"
    went = slow if end == "goes on" else f"; at {digits(followed['seconds'], 3)}: {end}"
    return {"speed": f"{speed}{went}; by friction: {by_friction}"}


def _pieces(summary: Mapping[str, Any]) -> str:
    loose, count = summary["disconnected_particles"], summary.get("components", 1)
    if not loose:
        return f"{count}, nothing is loose"
    return f"{count}, {loose} particles hang on nothing: they count in displacement, not in speed"


def _files(path: Path) -> list[str]:
    names = "report.html", path.name, *RESULTS
    return [name for name in dict.fromkeys(names) if (path.parent / name).exists()]
