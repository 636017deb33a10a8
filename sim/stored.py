"""Scenes to and from JSON: everything a scene is, so that the same one can be built again."""

from __future__ import annotations

import dataclasses
import math
import types
from typing import Any, Literal, TypeVar, Union, get_args, get_origin, get_type_hints

from sim.errors import SceneError
from sim.scene import Scene

Value = TypeVar("Value")


def scene_to_json(scene: Scene) -> dict[str, Any]:
    """The scene as plain JSON values, SI units; every digit is kept, infinity is "inf"."""
    plain: dict[str, Any] = _plain(scene)
    return plain


def scene_from_json(stored: dict[str, Any]) -> Scene:
    """The scene that `scene_to_json` wrote, equal to the one that was given.

    Raises:
        SceneError: A field that is missing, unknown or of the wrong kind, or a value that the
            scene refuses.
    """
    return _dataclass(Scene, stored, "scene")


def _plain(value: Any) -> Any:
    if dataclasses.is_dataclass(value):
        return {
            field.name: _plain(getattr(value, field.name)) for field in dataclasses.fields(value)
        }
    if isinstance(value, tuple | list):
        return [_plain(item) for item in value]
    if isinstance(value, str | bool | int) or value is None:
        return value
    number = float(value)
    return number if math.isfinite(number) else str(number)


def _dataclass(kind: type[Value], stored: Any, where: str) -> Value:
    known = get_type_hints(kind)
    hints = {field.name: known[field.name] for field in dataclasses.fields(kind)}  # type: ignore[arg-type]
    if not isinstance(stored, dict) or set(stored) != set(hints):
        found = sorted(stored) if isinstance(stored, dict) else stored
        raise SceneError(f"{where}: {found!r}; allowed: the fields {sorted(hints)}")
    return kind(
        **{name: _value(hint, stored[name], f"{where}.{name}") for name, hint in hints.items()}
    )


def _value(hint: Any, stored: Any, where: str) -> Any:
    """`stored` as the type that the field's annotation names."""
    kind, inner = get_origin(hint), get_args(hint)
    if kind in (Union, types.UnionType):
        if stored is None:
            return None
        (only,) = (one for one in inner if one is not types.NoneType)
        return _value(only, stored, where)
    if kind is tuple:
        if not isinstance(stored, list):
            raise SceneError(f"{where}: {stored!r}; allowed: a list")
        each = inner[:1] * len(stored) if inner[-1] is Ellipsis else inner
        if len(each) != len(stored):
            raise SceneError(f"{where}: {len(stored)} values; allowed: {len(each)}")
        return tuple(
            _value(one, item, f"{where}[{index}]")
            for index, (one, item) in enumerate(zip(each, stored, strict=True))
        )
    if dataclasses.is_dataclass(hint):
        return _dataclass(hint, stored, where)  # type: ignore[arg-type]
    if hint is float:
        return _number(stored, where)
    if kind is not Literal and hint is not str:
        raise TypeError(f"{where}: no rule for {hint!r}")
    if not isinstance(stored, str):
        raise SceneError(f"{where}: {stored!r}; allowed: text")
    return stored


def _number(stored: Any, where: str) -> float:
    if stored in ("inf", "-inf"):
        return float(stored)
    if isinstance(stored, bool) or not isinstance(stored, int | float):
        raise SceneError(f"{where}: {stored!r}; allowed: a number")
    return stored
