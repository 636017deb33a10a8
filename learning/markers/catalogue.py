"""Presets in YAML: those that are shipped, by name, and files of one's own."""

from __future__ import annotations

import dataclasses
import types
import typing
from functools import cache
from pathlib import Path
from typing import Any

import yaml

from learning.errors import LearningError
from learning.markers.preset import DETECTORS, CameraPreset, Preset, TaxelPreset

FOLDER = Path(__file__).parent / "presets"
_KINDS: dict[str, type[Preset]] = {"camera": CameraPreset, "taxels": TaxelPreset}


@cache
def names() -> tuple[str, ...]:
    """Return the names of the presets that are shipped."""
    return tuple(sorted(path.stem for path in FOLDER.glob("*.yaml")))


def preset(name: str) -> Preset:
    """Return a preset by name, or from a YAML file if the name ends so.

    Raises:
        LearningError: No such preset, or a file that is none.
    """
    if name.endswith((".yaml", ".yml")):
        return read_preset(Path(name))
    if name not in names():
        raise LearningError(f"preset: found {name!r}; known: {', '.join(names())}, or a .yaml file")
    return read_preset(FOLDER / f"{name}.yaml")


def preset_of_sensor(sensor: str) -> str | None:
    """Return the name of the preset that is meant for a sensor; None: there is none."""
    for name in names():
        if sensor in preset(name).sensors:
            return name
    return None


def read_preset(path: Path) -> Preset:
    """Return the preset in a YAML file.

    Raises:
        LearningError: Not there, not YAML, or a key or value that is not allowed.
    """
    try:
        content = yaml.safe_load(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise LearningError(f"{path}: no such file") from None
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise LearningError(f"{path}: not YAML: {error}") from None
    if not isinstance(content, dict):
        raise LearningError(f"{path}: found {type(content).__name__}; allowed: keys and values")
    made: Preset = _of_kind(content, _KINDS, str(path))
    return made


def _of_kind(content: Any, kinds: dict[str, Any], where: str) -> Any:
    if not isinstance(content, dict):
        raise LearningError(f"{where}: found {content!r}; allowed: keys and values")
    kind = content.get("kind")
    if kind not in kinds:
        raise LearningError(f"{where}.kind: found {kind!r}; allowed: {', '.join(kinds)}")
    rest = {key: value for key, value in content.items() if key != "kind"}
    return _built(kinds[kind], rest, where)


def _built(spec: type[Any], content: Any, where: str) -> Any:
    if not isinstance(content, dict):
        raise LearningError(f"{where}: found {content!r}; allowed: keys and values")
    hints = typing.get_type_hints(spec)
    fields = {field.name: field for field in dataclasses.fields(spec)}
    if unknown := sorted(str(key) for key in content.keys() - fields.keys()):
        raise LearningError(f"{where}: unknown {', '.join(unknown)}; known: {', '.join(fields)}")
    for name, field in fields.items():
        optional = (
            field.default is not dataclasses.MISSING
            or field.default_factory is not dataclasses.MISSING
        )
        if name not in content and not optional:
            raise LearningError(f"{where}: missing {name}; known: {', '.join(fields)}")
    values = {
        name: _value(hints[name], value, f"{where}.{name}") for name, value in content.items()
    }
    try:
        return spec(**values)
    except LearningError as error:
        raise LearningError(f"{where}: {error}") from None


def _value(hint: Any, value: Any, where: str) -> Any:
    origin, arguments = typing.get_origin(hint), typing.get_args(hint)
    if origin in (typing.Union, types.UnionType):
        if set(arguments) == set(DETECTORS.values()):
            return _of_kind(value, DETECTORS, where)
        if value is None and type(None) in arguments:
            return None
        (inner,) = (one for one in arguments if one is not type(None))
        return _value(inner, value, where)
    if origin is tuple:
        return _tuple(arguments, value, where)
    if dataclasses.is_dataclass(hint):
        return _built(typing.cast(type[Any], hint), value, where)
    if origin is typing.Literal:
        if value not in arguments:
            raise LearningError(f"{where}: found {value!r}; allowed: {', '.join(arguments)}")
        return value
    if hint is float and isinstance(value, int) and not isinstance(value, bool):
        return float(value)
    if type(value) is not hint:
        raise LearningError(f"{where}: found {value!r}; allowed: {hint.__name__}")
    return value


def _tuple(arguments: tuple[Any, ...], value: Any, where: str) -> tuple[Any, ...]:
    if not isinstance(value, list):
        raise LearningError(f"{where}: found {value!r}; allowed: a list")
    if len(arguments) == 2 and arguments[1] is Ellipsis:
        arguments = (arguments[0],) * len(value)
    if len(arguments) != len(value):
        raise LearningError(f"{where}: found {len(value)} values; allowed: {len(arguments)}")
    return tuple(
        _value(one, each, f"{where}[{place}]")
        for place, (one, each) in enumerate(zip(arguments, value, strict=True))
    )
