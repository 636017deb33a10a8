"""Settings of trainings: frozen dataclasses from strict YAML, and `key.sub=value` over it.

Every error names file, key, what was found and what is allowed. A file may name another one that it
`extends`; mappings merge key by key, everything else replaces. Where a field may be one of several
dataclasses, `kind` says which: their `KIND`.
"""

from __future__ import annotations

import dataclasses
import math
import re
import types
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Literal, TypeVar, Union, get_args, get_origin, get_type_hints

import yaml

from learning.errors import LearningError

Settings = TypeVar("Settings")

_SUFFIXES = (".yaml", ".yml")
_BOOL = "tag:yaml.org,2002:bool"


class _StrictLoader(yaml.SafeLoader):
    """YAML that refuses a key written twice, and reads plain words as YAML 1.2 does.

    1e-4 is a number, and `no` and `on` are words: only true and false are neither.
    """

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
        seen: set[Any] = set()
        for key_node, _ in node.value:
            key = self.construct_object(key_node, deep=True)
            if key in seen:
                line = key_node.start_mark.line + 1
                raise LearningError(f"{self.name}: line {line}: key {key!r} is written twice")
            seen.add(key)
        return super().construct_mapping(node, deep)


_StrictLoader.yaml_implicit_resolvers = {
    first: [each for each in resolvers if each[0] != _BOOL]
    for first, resolvers in yaml.SafeLoader.yaml_implicit_resolvers.items()
}
_StrictLoader.add_implicit_resolver(_BOOL, re.compile(r"(true|false)$"), list("tf"))
_EXPONENT = (
    "tag:yaml.org,2002:float",
    re.compile(r"[-+]?[0-9]+(\.[0-9]*)?[eE][-+]?[0-9]+$"),
    list("-+0123456789"),
)
_StrictLoader.add_implicit_resolver(*_EXPONENT)


class _StrictDumper(yaml.SafeDumper):
    """YAML that `_StrictLoader` reads as it was: a commit such as 2902e78 is quoted."""


_StrictDumper.add_implicit_resolver(*_EXPONENT)


def yaml_text(content: Mapping[str, Any]) -> str:
    """Return a mapping of plain values as YAML that `read_mapping` reads back."""
    return yaml.dump(content, Dumper=_StrictDumper, sort_keys=False)


def preset_names(preset_dir: Path) -> tuple[str, ...]:
    """Return the names of the presets in a folder."""
    return tuple(sorted(path.stem for path in preset_dir.glob("*.yaml")))


def read_settings(
    kind: type[Settings],
    preset_dir: Path,
    name_or_path: str | Path,
    overrides: Sequence[str] = (),
) -> Settings:
    """Return settings from a preset or a file, with some of them replaced.

    Args:
        kind: Frozen dataclass to build.
        preset_dir: The folder of the presets.
        name_or_path: Name of a preset, or a YAML file of one's own.
        overrides: `key=value` or `key.sub=value`, the value in YAML; later ones win.

    Raises:
        LearningError: No such preset or file, or a key or value that is not allowed.
    """
    path = Path(name_or_path)
    if path.suffix not in _SUFFIXES:
        known = preset_names(preset_dir)
        if str(name_or_path) not in known:
            raise LearningError(
                f"preset: found {str(name_or_path)!r}; known: {', '.join(known)}, or a .yaml file"
            )
        path = preset_dir / f"{name_or_path}.yaml"
    content = read_mapping(path)
    for override in overrides:
        key, equals, text = override.partition("=")
        if not equals or not all(key.split(".")):
            raise LearningError(f"--set: found {override!r}; allowed: key=value or key.sub=value")
        content = _merged(content, _nested(key.split("."), _yaml(text, f"--set {key}")))
    return build(kind, content, str(path))


def read_mapping(path: Path, above: tuple[Path, ...] = ()) -> dict[str, Any]:
    """Return the mapping in a YAML file, merged over the file that its `extends` names.

    Args:
        path: The file; the name that it extends is relative to it.
        above: Files that led here.

    Raises:
        LearningError: No such file, not YAML, not a mapping, or files that extend each other.
    """
    if path.resolve() in above:
        raise LearningError(f"{path}: extends: the files extend each other in a circle")
    try:
        content = _yaml(path.read_text(encoding="utf-8"), str(path))
    except FileNotFoundError:
        raise LearningError(f"{path}: no such file") from None
    except UnicodeDecodeError as error:
        raise LearningError(f"{path}: not YAML: {error}") from None
    if not isinstance(content, dict):
        raise LearningError(f"{path}: found {_said(content)}; allowed: a mapping of keys to values")
    parent = content.pop("extends", None)
    if parent is None:
        return content
    if not isinstance(parent, str):
        raise LearningError(f"{path}.extends: found {_said(parent)}; allowed: the name of a file")
    return _merged(read_mapping(path.parent / parent, (*above, path.resolve())), content)


def build(kind: type[Settings], content: Any, where: str) -> Settings:
    """Return the dataclass `kind` of a mapping as YAML gives it.

    Args:
        kind: Frozen dataclass.
        content: The mapping.
        where: File and dotted path, for errors.

    Raises:
        LearningError: A key that is unknown or missing, or a value of the wrong kind or refused.
    """
    if not isinstance(content, dict):
        raise LearningError(
            f"{where}: found {_said(content)}; allowed: a mapping of keys to values"
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


def settings_to_dict(settings: Any) -> dict[str, Any]:
    """Return settings as plain values that `build` makes the same ones of; tuples become lists."""
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
        # True is 1 and 1.0 is 1 for Python, not for whoever reads the file.
        if not any(type(value) is type(each) and value == each for each in inner):
            allowed = ", ".join(map(str, inner))
            raise LearningError(f"{where}: found {_said(value)}; allowed: {allowed}")
        return value
    if origin is tuple:
        return _tuple(inner, value, where)
    if dataclasses.is_dataclass(hint):
        return build(hint, value, where)  # type: ignore[arg-type]
    if hint is float:
        if isinstance(value, bool) or not isinstance(value, int | float):
            raise LearningError(f"{where}: found {_said(value)}; allowed: a number")
        if not math.isfinite(value):
            raise LearningError(f"{where}: found {value}; allowed: a finite number")
        return float(value)
    if hint in (int, str, bool):
        if type(value) is not hint:
            raise LearningError(f"{where}: found {_said(value)}; allowed: {hint.__name__}")
        return value
    raise TypeError(f"{where}: the reader knows no {hint!r}")


def _union(options: tuple[Any, ...], value: Any, where: str) -> Any:
    if value is None and types.NoneType in options:
        return None
    options = tuple(option for option in options if option is not types.NoneType)
    if len(options) == 1:
        return _value(options[0], value, where)
    if not all(hasattr(option, "KIND") for option in options):
        return _either(options, value, where)
    kinds = {option.KIND: option for option in options}
    kind = value.get("kind") if isinstance(value, dict) else value
    if not isinstance(value, dict) or kind not in kinds:
        raise LearningError(
            f"{where}: found kind {kind!r}; allowed: a mapping with kind {' or '.join(kinds)}"
        )
    return build(kinds[kind], value, where)


def _either(options: tuple[Any, ...], value: Any, where: str) -> Any:
    """Return a value as the first of several plain types that takes it."""
    refused = []
    for option in options:
        try:
            return _value(option, value, where)
        except LearningError as error:
            refused.append(str(error).rpartition("allowed: ")[2])
    raise LearningError(f"{where}: found {_said(value)}; allowed: {', or '.join(refused)}")


def _tuple(inner: tuple[Any, ...], value: Any, where: str) -> tuple[Any, ...]:
    if not isinstance(value, list):
        raise LearningError(f"{where}: found {_said(value)}; allowed: a list")
    each = inner[:1] * len(value) if inner[-1] is Ellipsis else inner
    if len(each) != len(value):
        raise LearningError(f"{where}: found {len(value)} values; allowed: {len(each)}")
    return tuple(
        _value(one, item, f"{where}[{place}]")
        for place, (one, item) in enumerate(zip(each, value, strict=True))
    )


def _merged(below: dict[str, Any], over: Mapping[str, Any]) -> dict[str, Any]:
    result: dict[str, Any] = dict(below)
    for key, value in over.items():
        old: Any = result.get(key)
        result[key] = value
        mappings = isinstance(old, dict) and isinstance(value, dict)
        # A mapping of another kind replaces: its keys would not fit.
        if mappings and value.get("kind", old.get("kind")) == old.get("kind"):
            result[key] = _merged(old, value)
    return result


def _nested(keys: list[str], value: Any) -> dict[str, Any]:
    for key in reversed(keys):
        value = {key: value}
    nested: dict[str, Any] = value
    return nested


def _yaml(text: str, name: str) -> Any:
    try:
        loader = _StrictLoader(text)
        loader.name = name
        try:
            return loader.get_single_data()
        finally:
            loader.dispose()
    except yaml.YAMLError as error:
        raise LearningError(f"{name}: not YAML: {error}") from None


def _plain(value: Any) -> Any:
    if dataclasses.is_dataclass(value):
        return settings_to_dict(value)
    if isinstance(value, tuple):
        return [_plain(each) for each in value]
    return value


def _said(value: Any) -> str:
    return f"{type(value).__name__} {value!r}"
