"""Settings of trainings: frozen dataclasses read from strict YAML, with `key.sub=value` overrides.

Every error names file, key, value and allowed values. A file can name another that it `extends`;
mappings are merged key by key, other values are replaced. Where a field can be one of several
dataclasses, `kind` selects one by its `KIND`.
"""

from __future__ import annotations

import dataclasses
import math
import types
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Literal, TypeVar, Union, get_args, get_origin, get_type_hints

from learning.errors import LearningError
from recorder import strict_yaml
from recorder.strict_yaml import YamlError, describe, merged

Settings = TypeVar("Settings")

_SUFFIXES = (".yaml", ".yml")


def preset_names(preset_dir: Path) -> tuple[str, ...]:
    """Return the names of the presets in a folder."""
    return tuple(sorted(path.stem for path in preset_dir.glob("*.yaml")))


def preset_path(preset_dir: Path, name_or_path: str | Path) -> Path:
    """Return the file of a preset in a folder, or the given path if it is a YAML file.

    Raises:
        LearningError: There is no preset of that name.
    """
    path = Path(name_or_path)
    if path.suffix in _SUFFIXES:
        return path
    known = preset_names(preset_dir)
    if str(name_or_path) not in known:
        raise LearningError(
            f"preset: found {str(name_or_path)!r}; known: {', '.join(known)}, or a .yaml file"
        )
    return preset_dir / f"{name_or_path}.yaml"


def read_settings(
    kind: type[Settings],
    preset_dir: Path,
    name_or_path: str | Path,
    overrides: Sequence[str] = (),
) -> Settings:
    """Read settings from a preset or a file and apply overrides.

    Args:
        kind: Frozen dataclass to build.
        preset_dir: Folder of the presets.
        name_or_path: Name of a preset, or path of a YAML file.
        overrides: `key=value` or `key.sub=value`, the value in YAML; later ones win.

    Raises:
        LearningError: The preset or file does not exist, or a key or value is not allowed.
    """
    path = preset_path(preset_dir, name_or_path)
    content = read_mapping(path)
    for override in overrides:
        key, equals, text = override.partition("=")
        if not equals or not all(key.split(".")):
            raise LearningError(f"--set: found {override!r}; allowed: key=value or key.sub=value")
        try:
            value = strict_yaml.parse(text, f"--set {key}")
        except YamlError as error:
            raise LearningError(str(error)) from None
        content = merged(content, _nested(key.split("."), value))
    return build(kind, content, str(path))


def read_mapping(path: Path) -> dict[str, Any]:
    """Read a YAML mapping, merged over the file that its `extends` names.

    Raises:
        LearningError: A file is missing, is not a YAML mapping, or files extend each other.
    """
    try:
        return strict_yaml.read_mapping(path)
    except YamlError as error:
        raise LearningError(str(error)) from None


def build(kind: type[Settings], content: Any, where: str) -> Settings:
    """Build a dataclass from a mapping read from YAML.

    Args:
        kind: Frozen dataclass.
        content: The mapping.
        where: File and dotted path, for errors.

    Raises:
        LearningError: A key is unknown or missing, or a value has the wrong type or is rejected.
    """
    if not isinstance(content, dict):
        raise LearningError(
            f"{where}: found {describe(content)}; allowed: a mapping of keys to values"
        )
    content = dict(content)
    word = getattr(kind, "KIND", None)
    if word is not None and (found := content.pop("kind", word)) != word:
        raise LearningError(f"{where}.kind: found {found!r}; allowed: {word}")
    hints = get_type_hints(kind)
    fields = {each.name: each for each in dataclasses.fields(kind) if each.init}  # type: ignore[arg-type]
    if unknown := sorted(str(key) for key in content.keys() - fields.keys()):
        raise LearningError(f"{where}: unknown {', '.join(unknown)}; known: {', '.join(fields)}")
    for name, each in fields.items():
        required = each.default is dataclasses.MISSING
        if name not in content and required and each.default_factory is dataclasses.MISSING:
            raise LearningError(f"{where}: missing {name}; known: {', '.join(fields)}")
    values = {
        name: _value(hints[name], value, f"{where}.{name}") for name, value in content.items()
    }
    try:
        return kind(**values)
    except ValueError as error:
        raise LearningError(f"{where}: {error}") from None


def build_one_of(kinds: Sequence[Any], content: Any, where: str) -> Any:
    """Build the dataclass among several whose `KIND` equals the mapping's `kind`.

    Raises:
        LearningError: No dataclass has that kind, or `build` fails.
    """
    by_kind = {kind.KIND: kind for kind in kinds}
    if not isinstance(content, dict):
        allowed = f"a mapping with kind {' or '.join(by_kind)}"
        raise LearningError(f"{where}: found {describe(content)}; allowed: {allowed}")
    if (kind := content.get("kind")) not in by_kind:
        raise LearningError(f"{where}.kind: found {kind!r}; allowed: {', '.join(by_kind)}")
    return build(by_kind[kind], content, where)


def settings_to_dict(settings: Any) -> dict[str, Any]:
    """Return settings as plain values from which `build` restores them; tuples become lists."""
    plain = {"kind": settings.KIND} if hasattr(settings, "KIND") else {}
    fields = (each for each in dataclasses.fields(settings) if each.init)
    return plain | {each.name: _plain(getattr(settings, each.name)) for each in fields}


def differing_keys(one: Any, other: Any, where: str = "") -> list[str]:
    """Return the dotted keys under which two plain mappings differ, in alphabetical order."""
    if not isinstance(one, Mapping) or not isinstance(other, Mapping):
        return [] if one == other else [where or "all of it"]
    different = []
    for key in sorted(one.keys() | other.keys(), key=str):
        below = f"{where}.{key}" if where else str(key)
        if key in one and key in other:
            different += differing_keys(one[key], other[key], below)
        else:
            different.append(below)
    return different


def _value(hint: Any, value: Any, where: str) -> Any:
    origin, inner = get_origin(hint), get_args(hint)
    if origin in (Union, types.UnionType):
        return _union(inner, value, where)
    if origin is Literal:
        # Python equates True with 1 and 1.0 with 1; readers of the file do not.
        if not any(type(value) is type(each) and value == each for each in inner):
            allowed = ", ".join(map(str, inner))
            raise LearningError(f"{where}: found {describe(value)}; allowed: {allowed}")
        return value
    if origin is tuple:
        return _tuple(inner, value, where)
    if dataclasses.is_dataclass(hint):
        return build(hint, value, where)  # type: ignore[arg-type]
    if hint is float:
        if isinstance(value, bool) or not isinstance(value, int | float):
            raise LearningError(f"{where}: found {describe(value)}; allowed: a number")
        if not math.isfinite(value):
            raise LearningError(f"{where}: found {value}; allowed: a finite number")
        return float(value)
    if hint in (int, str, bool):
        if type(value) is not hint:
            raise LearningError(f"{where}: found {describe(value)}; allowed: {hint.__name__}")
        return value
    raise TypeError(f"{where}: unsupported type {hint!r}")


def _union(options: tuple[Any, ...], value: Any, where: str) -> Any:
    if value is None and types.NoneType in options:
        return None
    options = tuple(option for option in options if option is not types.NoneType)
    if len(options) == 1:
        return _value(options[0], value, where)
    if not all(hasattr(option, "KIND") for option in options):
        return _either(options, value, where)
    return build_one_of(options, value, where)


def _either(options: tuple[Any, ...], value: Any, where: str) -> Any:
    """Convert a value to the first of several plain types that accepts it."""
    refused = []
    for option in options:
        try:
            return _value(option, value, where)
        except LearningError as error:
            refused.append(str(error).rpartition("allowed: ")[2])
    raise LearningError(f"{where}: found {describe(value)}; allowed: {', or '.join(refused)}")


def _tuple(inner: tuple[Any, ...], value: Any, where: str) -> tuple[Any, ...]:
    if not isinstance(value, list):
        raise LearningError(f"{where}: found {describe(value)}; allowed: a list")
    each = inner[:1] * len(value) if inner[-1] is Ellipsis else inner
    if len(each) != len(value):
        raise LearningError(f"{where}: found {len(value)} values; allowed: {len(each)}")
    return tuple(
        _value(one, item, f"{where}[{place}]")
        for place, (one, item) in enumerate(zip(each, value, strict=True))
    )


def _nested(keys: list[str], value: Any) -> dict[str, Any]:
    for key in reversed(keys):
        value = {key: value}
    nested: dict[str, Any] = value
    return nested


def _plain(value: Any) -> Any:
    if dataclasses.is_dataclass(value):
        return settings_to_dict(value)
    if isinstance(value, tuple):
        return [_plain(each) for each in value]
    return value
