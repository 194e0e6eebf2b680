"""Scenes to JSON text and back."""

from __future__ import annotations

import dataclasses
import json
from collections import Counter
from typing import Any

from mpmopt.errors import SceneError
from mpmopt.scene.clamp import Clamp
from mpmopt.scene.ground import Ground
from mpmopt.scene.parts import Actuator, Design, Grid, Material, Mirror, Solid, Wall
from mpmopt.validation import shown

MOST_TEXT = 10**6  # characters


def written(scene: Any) -> str:
    """A scene as JSON text."""
    data = dataclasses.asdict(scene)
    for region, item in zip(scene.body, data["body"], strict=True):
        item["kind"] = region.kind
    return json.dumps(data, indent=1)


def parsed(scene_type: type, text: str) -> Any:
    """The scene, of its type, that `written` made a text of.

    Raises
    ------
    SceneError
        If the text is no JSON, keys are unknown or missing, or values do not fit.
    """
    if not isinstance(text, str):
        raise SceneError(f"Scene: {shown(text)} is no JSON text")
    if len(text) > MOST_TEXT:
        raise SceneError(
            f"Scene: JSON text has {len(text)} characters, more than {MOST_TEXT}; take fewer parts"
        )
    try:
        data = json.loads(
            text, parse_constant=_refuse_constant, object_pairs_hook=_refuse_duplicates
        )
    except SceneError:
        raise
    except (ValueError, TypeError, RecursionError) as error:
        raise SceneError(f"Scene: not JSON: {error}") from error
    data = dict(_object("Scene", data))
    for name, part in (("grid", Grid), ("material", Material), ("mirror", Mirror)):
        if data.get(name) is not None:
            data[name] = _build(part, data[name])
    if "body" in data:
        kinds = {part.kind: part for part in (Design, Solid, Actuator)}
        regions = []
        for item in _array("body", data["body"]):
            item = dict(_object("Region", item))
            name = item.pop("kind", None)
            if not isinstance(name, str) or name not in kinds:
                raise SceneError(f"Region: kind = {shown(name)} must be one of {sorted(kinds)}")
            if item.get("material") is not None:
                item["material"] = _build(Material, item["material"])
            regions.append(_build(kinds[name], item))
        data["body"] = tuple(regions)
    for name, kind in (("walls", Wall), ("ground", Ground), ("clamps", Clamp)):
        if name in data:
            data[name] = tuple(_build(kind, item) for item in _array(name, data[name]))
    return _build(scene_type, data)


def _refuse_constant(name: str) -> float:
    raise SceneError(f"Scene: {name} is not a number that a scene can hold")


def _refuse_duplicates(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    data = dict(pairs)
    if len(data) < len(pairs):
        twice = sorted(name for name, n in Counter(name for name, _ in pairs).items() if n > 1)
        raise SceneError(f"Scene: keys {shown(twice)} are there twice; keep one of each")
    return data


def _object(owner: str, data: Any) -> dict[str, Any]:
    if not isinstance(data, dict):
        raise SceneError(f"{owner}: expected a JSON object, got {type(data).__name__}")
    return data


def _array(owner: str, data: Any) -> list[Any]:
    if not isinstance(data, list):
        raise SceneError(f"{owner}: expected a JSON array, got {type(data).__name__}")
    return data


def _build(part: Any, data: Any) -> Any:
    name = part.__name__
    data = _object(name, data)
    fields = {field.name: field for field in dataclasses.fields(part)}
    unknown = sorted(set(data) - set(fields))
    if unknown:
        raise SceneError(f"{name}: unknown keys {shown(unknown)}; known are {sorted(fields)}")
    missing = [
        key
        for key, field in fields.items()
        if field.default is field.default_factory is dataclasses.MISSING and key not in data
    ]
    if missing:
        raise SceneError(f"{name}: keys {missing} are missing")
    return part(**data)
