"""Load bench files: strict YAML into frozen dataclasses; errors give file, key, value, allowed.

A field with a `unit` in its metadata is written in that unit in the file, under a key with that
suffix: `depth_max` with unit mm is `depth_max_mm`. A field with metadata `pose` is written as a
`Pose`. All values in memory are SI.
"""

from __future__ import annotations

import dataclasses
import math
import types
import typing
from pathlib import Path
from typing import Any, Literal, TypeVar, Union, get_args, get_origin

from recorder.strict_yaml import YamlError, describe, read_mapping
from rig.core.errors import ConfigError

# Unit conversion happens only in this module.

# SI value of one unit, by the suffix of the key in a bench file (`speed_mm_s: 5`).
#
# `n_mm` is a torque, newton millimetre; `n_per_mm` a stiffness.
SI_PER_UNIT = {
    "mm": 1e-3,
    "mm_s": 1e-3,
    "mm_s2": 1e-3,
    "deg": math.pi / 180,
    "deg_s": math.pi / 180,
    "ms": 1e-3,
    "min": 60.0,
    "kpa": 1e3,
    "n": 1.0,
    "n_mm": 1e-3,
    "n_per_mm": 1e3,
    "hz": 1.0,
    "kg": 1.0,
    "s": 1.0,
}


def to_si(value: float, unit: str) -> float:
    """Convert `value` from `unit` to SI."""
    return value * SI_PER_UNIT[unit]


def from_si(value: float, unit: str) -> float:
    """Convert an SI `value` to `unit`."""
    return value / SI_PER_UNIT[unit]


Spec = TypeVar("Spec")


@dataclasses.dataclass(frozen=True, slots=True)
class Pose:
    """Pose as written in a file; a field with metadata `pose` receives it as six numbers."""

    position: tuple[float, float, float] = dataclasses.field(metadata={"unit": "mm"})
    """Origin [m]."""
    rotation: tuple[float, float, float] = dataclasses.field(
        default=(0.0, 0.0, 0.0), metadata={"unit": "deg"}
    )
    """UR rotation vector, axis times angle [rad]."""

    @property
    def vector(self) -> tuple[float, ...]:
        """Position and rotation as one (6,) vector [m, rad]."""
        return (*self.position, *self.rotation)


def read_yaml(path: Path, library: Path | None = None) -> dict[str, Any]:
    """Return the mapping in a YAML file, merged over the file named by its `extends`.

    Mappings merge key by key; other values are replaced. `extends` is relative to the file. If the
    named file does not exist (`../tacpalm.yaml` in a lab's folder), `library` is searched for it.

    Raises:
        ConfigError: The file is missing, not YAML or not a mapping, or files extend each other.
    """
    try:
        return read_mapping(path, library=library)
    except YamlError as error:
        raise ConfigError(str(error)) from None


def build(spec: type[Spec], content: Any, where: str) -> Spec:
    """Build a dataclass from a mapping loaded from YAML.

    Args:
        spec: Frozen dataclass to build.
        content: The mapping.
        where: File and dotted path, for errors.

    Raises:
        ConfigError: A value is unknown, missing, invalid or of the wrong type.
    """
    if not isinstance(content, dict):
        raise ConfigError(f"{where}: found {describe(content)}; allowed: a mapping")
    expected = getattr(spec, "KIND", None)
    if expected is not None and (kind := content.get("kind", expected)) != expected:
        raise ConfigError(f"{where}.kind: found {kind!r}; allowed: [{expected!r}]")
    hints = typing.get_type_hints(spec)
    fields = {key_of(field): field for field in dataclasses.fields(spec) if field.init}  # type: ignore[arg-type]
    if expected is not None:
        content = {key: value for key, value in content.items() if key != "kind"}
    if unknown := sorted(str(key) for key in set(content) - set(fields)):
        raise ConfigError(f"{where}: unknown {unknown}; known: {sorted(fields)}")
    values: dict[str, Any] = {}
    for key, field in fields.items():
        has_default = (
            field.default is not dataclasses.MISSING
            or field.default_factory is not dataclasses.MISSING
        )
        if key in content:
            place = f"{where}.{key}"
            if field.metadata.get("pose"):
                values[field.name] = build(Pose, content[key], place).vector
            else:
                unit = field.metadata.get("unit")
                values[field.name] = _value(hints[field.name], content[key], place, unit)
        elif not has_default:
            raise ConfigError(f"{where}: missing '{key}'; known: {sorted(fields)}")
    try:
        return spec(**values)
    except ConfigError:
        raise
    except ValueError as error:
        raise ConfigError(f"{where}: {error}") from None


def key_of(field: dataclasses.Field[Any]) -> str:
    """Return the field's key in a file: its name, with the unit appended if it is not plain SI."""
    unit = field.metadata.get("unit")
    return f"{field.name}_{unit}" if unit else field.name


def _value(hint: Any, value: Any, where: str, unit: str | None) -> Any:
    origin = get_origin(hint)
    if origin in (Union, types.UnionType):
        return _union(hint, value, where, unit)
    if origin is Literal:
        if value not in get_args(hint):
            raise ConfigError(f"{where}: found {value!r}; allowed: {list(get_args(hint))}")
        return value
    if origin is tuple:
        return _tuple(hint, value, where, unit)
    if dataclasses.is_dataclass(hint):
        return build(hint, value, where)  # type: ignore[arg-type]
    if hint is float:
        if isinstance(value, bool) or not isinstance(value, int | float):
            raise ConfigError(f"{where}: found {describe(value)}; allowed: a number{_in(unit)}")
        if not math.isfinite(value):
            raise ConfigError(f"{where}: found {value!r}; allowed: a finite number{_in(unit)}")
        return to_si(float(value), unit) if unit else float(value)
    if hint in (int, bool, str):
        if type(value) is not hint:
            raise ConfigError(f"{where}: found {describe(value)}; allowed: {hint.__name__}")
        return value
    raise TypeError(f"{where}: the loader does not support {hint!r}")


def _in(unit: str | None) -> str:
    return f" [{unit}]" if unit else ""


def _tuple(hint: Any, value: Any, where: str, unit: str | None) -> tuple[Any, ...]:
    inner = get_args(hint)
    if not isinstance(value, list):
        raise ConfigError(f"{where}: found {describe(value)}; allowed: a list")
    if inner[-1] is Ellipsis:
        inner = (inner[0],) * len(value)
    if len(inner) != len(value):
        raise ConfigError(f"{where}: found {len(value)} values; allowed: {len(inner)}{_in(unit)}")
    return tuple(
        _value(kind, item, f"{where}[{k}]", unit)
        for k, (kind, item) in enumerate(zip(inner, value, strict=True))
    )


def _union(hint: Any, value: Any, where: str, unit: str | None) -> Any:
    options = get_args(hint)
    if value is None:
        if type(None) in options:
            return None
        raise ConfigError(f"{where}: found nothing; allowed: a value")
    options = tuple(option for option in options if option is not type(None))
    if len(options) == 1:
        return _value(options[0], value, where, unit)
    kinds = {option.KIND: option for option in options}
    if not isinstance(value, dict):
        raise ConfigError(f"{where}: found {describe(value)}; allowed: a mapping with 'kind'")
    kind = value.get("kind")
    if kind not in kinds:
        raise ConfigError(f"{where}.kind: found {kind!r}; allowed: {sorted(kinds)}")
    return build(kinds[kind], value, where)
