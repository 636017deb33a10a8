"""Read strict YAML into frozen values; errors name file, key, the found and the allowed value.

A number that is not in plain SI has its unit in its key: `modulus_kpa: 145`. Classes of this
package give the unit in the metadata of a field; for those of the rest of `sim`, which are in SI,
it is in `UNITS`.
"""

from __future__ import annotations

import dataclasses
import math
import types
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal, TypeVar, Union, get_args, get_origin, get_type_hints

from recorder import strict_yaml
from recorder.strict_yaml import YamlError, describe
from sim.effects import Viscosity
from sim.errors import SceneError
from sim.scene import Body

Value = TypeVar("Value")

# Value of each unit in SI, by the suffix of a key.
SI_PER_UNIT = {
    "um": 1e-6,
    "mm": 1e-3,
    "mm_s": 1e-3,
    "mm_per_px": 1e-3,
    "deg": math.pi / 180,
    "kpa": 1e3,
    "s": 1.0,
    "ma_m2": 1e-3,
    "counts_per_mt": 1e3,
}

UNITS: Mapping[type, Mapping[str, str]] = {
    Body: {
        "size_x": "mm",
        "size_y": "mm",
        "thickness": "mm",
        "dome_radius": "mm",
        "modulus": "kpa",
    },
    Viscosity: {"times": "s"},
}


def read_mapping(path: Path) -> dict[str, Any]:
    """Read the mapping in a YAML file, merged over the file that its `extends` names.

    Raises:
        SceneError: The file is missing, not YAML or not a mapping, or files extend each other.
    """
    try:
        return strict_yaml.read_mapping(path)
    except YamlError as error:
        raise SceneError(str(error)) from None


def build(kind: type[Value], content: Any, where: str) -> Value:
    """Build the dataclass `kind` from a YAML mapping; errors begin with `where`, file and path.

    Raises:
        SceneError: A key is unknown or missing, or a value is of the wrong type or rejected.
    """
    if not isinstance(content, dict):
        raise SceneError(f"{where}: found {describe(content)}; allowed: a mapping")
    content = dict(content)
    word = getattr(kind, "KIND", None)
    if word is not None and (found := content.pop("kind", word)) != word:
        raise SceneError(f"{where}.kind: found {found!r}; allowed: {word!r}")
    hints = get_type_hints(kind)
    fields = {key_of(kind, each): each for each in dataclasses.fields(kind)}  # type: ignore[arg-type]
    if unknown := sorted(str(key) for key in set(content) - set(fields)):
        raise SceneError(f"{where}: unknown {unknown}; allowed: {sorted(fields)}")
    values = {}
    for key, each in fields.items():
        if key in content:
            unit = _unit(kind, each)
            values[each.name] = _value(hints[each.name], content[key], f"{where}.{key}", unit)
        elif each.default is dataclasses.MISSING and each.default_factory is dataclasses.MISSING:
            raise SceneError(f"{where}: missing {key!r}; allowed: {sorted(fields)}")
    try:
        return kind(**values)
    except ValueError as error:
        raise SceneError(f"{where}: {error}") from None


def key_of(kind: type, field: dataclasses.Field[Any]) -> str:
    """Return the key of a field in a file: its name, followed by its unit if any."""
    unit = _unit(kind, field)
    return f"{field.name}_{unit}" if unit else field.name


def _unit(kind: type, field: dataclasses.Field[Any]) -> str | None:
    unit: str | None = field.metadata.get("unit") or UNITS.get(kind, {}).get(field.name)
    return unit


def _value(hint: Any, value: Any, where: str, unit: str | None) -> Any:
    """Convert `value` to the type of the field's annotation, in SI."""
    origin, inner = get_origin(hint), get_args(hint)
    if origin in (Union, types.UnionType):
        return _union(inner, value, where, unit)
    if origin is Literal:
        if value not in inner:
            raise SceneError(f"{where}: found {value!r}; allowed: {list(inner)}")
        return value
    if origin is tuple:
        if not isinstance(value, list):
            raise SceneError(f"{where}: found {describe(value)}; allowed: a list")
        each = inner[:1] * len(value) if inner[-1] is Ellipsis else inner
        if len(each) != len(value):
            raise SceneError(f"{where}: found {len(value)} values; allowed: {len(each)}")
        return tuple(
            _value(one, item, f"{where}[{index}]", unit)
            for index, (one, item) in enumerate(zip(each, value, strict=True))
        )
    if dataclasses.is_dataclass(hint):
        return build(hint, value, where)  # type: ignore[arg-type]
    if hint is float:
        if isinstance(value, bool) or not isinstance(value, int | float):
            text = f" [{unit}]" if unit else ""
            raise SceneError(f"{where}: found {describe(value)}; allowed: a number{text}")
        if not math.isfinite(value):
            raise SceneError(f"{where}: found {value!r}; allowed: a finite number")
        return float(value) * (SI_PER_UNIT[unit] if unit else 1.0)
    if hint in (int, str, bool):
        if type(value) is not hint:
            raise SceneError(f"{where}: found {describe(value)}; allowed: {hint.__name__}")
        return value
    raise TypeError(f"{where}: unsupported type {hint!r}")


def _union(options: tuple[Any, ...], value: Any, where: str, unit: str | None) -> Any:
    if value is None and types.NoneType in options:
        return None
    options = tuple(option for option in options if option is not types.NoneType)
    if len(options) == 1:
        return _value(options[0], value, where, unit)
    kinds = {option.KIND: option for option in options}
    kind = value.get("kind") if isinstance(value, dict) else value
    if not isinstance(value, dict) or kind not in kinds:
        raise SceneError(
            f"{where}: found kind {kind!r}; allowed: a mapping with kind {' or '.join(kinds)}"
        )
    return build(kinds[kind], value, where)
