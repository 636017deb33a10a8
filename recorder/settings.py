"""Settings: frozen dataclasses from the mappings of strict YAML.

Strict YAML has unique keys, plain scalars of YAML 1.2's core schema, and inheritance by `extends`:
1e-4 and 040 are the numbers 0.0001 and 40; `no`, `on`, `1:30` and `2026-01-31` are text.

A field whose metadata has a `unit` is written in that unit in files, under a key that ends with
it: `depth_max` with unit mm is `depth_max_mm`. Values in memory are SI. A field with metadata
`pose` is written as a `Pose`. Metadata `plausible` is the range of a field's magnitude in the unit
of the file, unless it is 0: a value outside it is probably in another unit, and refused. Where a
field may be one of several dataclasses, the key `kind` names one by its `KIND`; the class of a
family stands for its members. Every error states file, key, the value found, and the allowed ones.
"""

import dataclasses
import difflib
import math
import re
import types
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal, TypeVar, Union, get_args, get_origin, get_type_hints

import yaml

Value = TypeVar("Value")

# SI value of one of each unit, by the suffix of a key. `n_mm` is a torque, `n_per_mm` a stiffness.
SI_PER_UNIT = {
    "um": 1e-6,
    "mm": 1e-3,
    "mm_s": 1e-3,
    "mm_s2": 1e-3,
    "mm_per_px": 1e-3,
    "deg": math.pi / 180,
    "deg_s": math.pi / 180,
    "ms": 1e-3,
    "s": 1.0,
    "min": 60.0,
    "hz": 1.0,
    "kg": 1.0,
    "n": 1.0,
    "n_mm": 1e-3,
    "n_per_mm": 1e3,
    "kpa": 1e3,
    "ma_m2": 1e-3,
    "counts_per_mt": 1e3,
}
# Their symbols, where these are not the suffix.
_SYMBOLS = {
    **{"n": "N", "hz": "Hz", "kpa": "kPa", "n_mm": "N mm", "n_per_mm": "N/mm", "ma_m2": "mA m^2"},
    **{"mm_s": "mm/s", "mm_s2": "mm/s^2", "deg_s": "deg/s", "mm_per_px": "mm/px"},
    "counts_per_mt": "counts/mT",
}
# Units that a value is likely to be in if it is implausible, and how many of them make one: a
# position in m is 1000 times too small for mm.
_MISTAKEN = {
    "mm": (("m", 1e3), ("um", 1e-3)),
    "mm_s": (("m/s", 1e3),),
    "mm_s2": (("m/s^2", 1e3),),
    "deg": (("rad", 180 / math.pi),),
    "ms": (("s", 1e3), ("us", 1e-3)),
    "min": (("s", 1 / 60), ("h", 60.0)),
    "kg": (("g", 1e-3),),
    "n": (("mN", 1e-3),),
    "n_mm": (("N m", 1e3),),
    "n_per_mm": (("N/m", 1e-3),),
}
# Words of errors for the plain values.
_WORDS = {int: "a whole number", bool: "true or false", str: "text"}
_NONE = type(None)


def to_si(value: float, unit: str) -> float:
    """Return `value` in `unit` as SI."""
    return value * SI_PER_UNIT[unit]


def from_si(value: float, unit: str) -> float:
    """Return the SI `value` in `unit`."""
    return value / SI_PER_UNIT[unit]


@dataclass(frozen=True, slots=True)
class Pose:
    """A pose in a file, of which a field with metadata `pose` keeps the six numbers."""

    position: tuple[float, float, float] = field(metadata={"unit": "mm"})
    """Origin [m]."""
    rotation: tuple[float, float, float] = field(default=(0.0, 0.0, 0.0), metadata={"unit": "deg"})
    """UR rotation vector, axis times angle [rad]."""

    @property
    def vector(self) -> tuple[float, ...]:
        """Position and rotation as one (6,) [m, rad]."""
        return (*self.position, *self.rotation)


@dataclass(frozen=True, slots=True)
class Reader:
    """Builds dataclasses from mappings."""

    error: type[Exception]
    """Raised for every invalid key or value."""
    stored: bool = False
    """True for values stored by a program: SI under the names of the fields, infinity as `inf`."""
    families: Mapping[Any, Callable[[Any], Mapping[str, type]]] = field(default_factory=dict)
    """Families of dataclasses, by the class that stands for one: a function of the `kind` in the
    file that returns the members."""

    def read(
        self, path: Path, library: Path | None = None, above: tuple[Path, ...] = ()
    ) -> dict[str, Any]:
        """Return the mapping in a YAML file, merged over the file named by its `extends`.

        That name is relative to the file; if it is `NAME` or `../NAME` and does not exist, the
        folder `library` is searched as well. `above` are the files that led here by `extends`.
        """
        if path.resolve() in above:
            raise self.error(f"{path}: extends: the files extend each other in a circle")
        try:
            content = self.parse(path.read_text(encoding="utf-8"), str(path))
        except FileNotFoundError:
            raise self.error(f"{path}: no such file") from None
        except UnicodeDecodeError as fault:
            raise self.error(f"{path}: not YAML: {fault}") from None
        if not isinstance(content, dict):
            raise self._wrong(str(path), content, "a mapping of keys to values")
        parent = content.pop("extends", None)
        if parent is None:
            return content
        if not isinstance(parent, str):
            raise self._wrong(f"{path}.extends", parent, "the name of a file")
        extended = path.parent / parent
        if library is not None and not extended.exists() and set(Path(parent).parts[:-1]) <= {".."}:
            shared = library / Path(parent).name
            extended = shared if shared.is_file() else extended
        if not extended.exists():
            raise self.error(
                f"{path}.extends: found {parent!r}; no such file beside it or packaged"
            )
        below = self.read(extended, library, (*above, path.resolve()))
        return merged(below, content)

    def parse(self, text: str, where: str) -> Any:
        """Return the content of a YAML text; `where` is its origin, for messages."""
        try:
            loader = _StrictLoader(text)
            loader.name, loader.error = where, self.error
            try:
                return loader.get_single_data()
            finally:
                loader.dispose()
        except yaml.MarkedYAMLError as fault:
            raise self.error(f"{where}: not YAML: {_in_one_line(fault)}") from None
        except yaml.YAMLError as fault:
            raise self.error(f"{where}: not YAML: {fault}") from None

    def build(self, kind: type[Value], content: Any, where: str) -> Value:
        """Return the frozen dataclass of a mapping of YAML; `where` is its place, for errors."""
        if not isinstance(content, dict):
            raise self._wrong(where, content, "a mapping of keys to values")
        content = dict(content)
        kind_name = getattr(kind, "KIND", None)
        if kind_name is not None and (stated_kind := content.pop("kind", kind_name)) != kind_name:
            raise self.error(f"{where}.kind: found {stated_kind!r}; allowed: {kind_name}")
        hints = get_type_hints(kind)
        fields = dict(self._fields(kind))
        if unknown := sorted(str(key) for key in content.keys() - fields.keys()):
            raise self.error(
                f"{where}: unknown {', '.join(unknown)}; {_suggestion(unknown, fields)}"
            )
        for key, each in fields.items():
            if key not in content and each.default is each.default_factory is dataclasses.MISSING:
                raise self.error(f"{where}: missing {key}; known: {', '.join(fields)}")
        values = {
            fields[key].name: self._field(fields[key], hints, value, f"{where}.{key}")
            for key, value in content.items()
        }
        try:
            return kind(**values)
        except ValueError as error:
            as_written = self._as_written(str(error), fields, content)
            raise self.error(f"{where}: {error}{as_written}") from None

    def build_one_of(self, kinds: Sequence[Any], content: Any, where: str) -> Any:
        """Return the one of several dataclasses whose `KIND` a mapping names as its `kind`."""
        by_kind = {kind.KIND: kind for kind in kinds}
        if not isinstance(content, dict):
            raise self._wrong(where, content, f"a mapping with kind {' or '.join(by_kind)}")
        if (kind := content.get("kind")) not in by_kind:
            problem = f"found {kind!r}" if "kind" in content else "missing"
            raise self.error(f"{where}.kind: {problem}; allowed: {', '.join(by_kind)}")
        keys = {name: dict(self._fields(each)).keys() for name, each in by_kind.items()}
        unknown = content.keys() - {"kind"} - keys[kind]
        others = [name for name in keys if unknown <= keys[name]]
        if unknown and others:
            raise self.error(
                f"{where}: unknown {', '.join(sorted(map(str, unknown)))} with kind {kind}; kind "
                f"{' or '.join(others)} has it; known: {', '.join(keys[kind])}"
            )
        return self.build(by_kind[kind], content, where)

    def key_of(self, each: dataclasses.Field[Any]) -> str:
        """Return the key of a field in files: its name, and its unit unless that is SI."""
        unit = self._unit(each)
        return f"{each.name}_{unit}" if unit else each.name

    def _wrong(self, where: str, value: Any, allowed: str) -> Exception:
        return self.error(f"{where}: found {describe(value)}; allowed: {allowed}")

    def _fields(self, kind: type) -> Iterator[tuple[str, dataclasses.Field[Any]]]:
        for each in dataclasses.fields(kind):
            if each.init:
                yield self.key_of(each), each

    def _as_written(
        self, message: str, fields: Mapping[str, Any], content: Mapping[str, Any]
    ) -> str:
        """Return the key and value that a message about a field in SI does not show."""
        name = message.partition(":")[0].rpartition(".")[2]
        for key, each in fields.items():
            if each.name == name != key and key in content:
                return f" (in SI units; the file has {key}: {content[key]})"
        return ""

    def _unit(self, each: dataclasses.Field[Any]) -> str | None:
        return None if self.stored else each.metadata.get("unit")

    def _field(
        self, each: dataclasses.Field[Any], hints: Mapping[str, Any], value: Any, at: str
    ) -> Any:
        unit = self._unit(each)
        if each.metadata.get("pose"):
            if value is None:
                return None
            pose = self.build(Pose, value, at)
            distance = from_si(math.hypot(*pose.position), "mm")
            self._refuse_implausible(
                each, distance, f"{at}.position_mm", "mm", value["position_mm"]
            )
            turn = from_si(math.hypot(*pose.rotation), "deg")
            self._refuse_radians(turn, f"{at}.rotation_deg", value.get("rotation_deg"))
            return pose.vector
        converted = self._value(hints[each.name], value, at, unit)
        for number in value if isinstance(value, list) else [value]:
            self._refuse_implausible(each, number, at, unit, value)
        if unit == "deg" and isinstance(value, list):
            self._refuse_radians(math.hypot(*value), at, value)
        return converted

    def _refuse_implausible(
        self, each: dataclasses.Field[Any], number: Any, at: str, unit: str | None, written: Any
    ) -> None:
        """Reject a number whose magnitude is not that of any real value of the field."""
        span = each.metadata.get("plausible")
        if span is None or self.stored or not isinstance(number, int | float) or not number:
            return
        low, high = span
        if low <= abs(number) <= high:
            return
        meant = [
            f"; is it in {name}? then write {number * factor:.6g}"
            for name, factor in _MISTAKEN.get(unit or "", ())
            if low <= abs(number * factor) <= high
        ]
        if isinstance(written, list):
            meant = [text.partition("?")[0] + "?" for text in meant]
        raise self.error(
            f"{at}: found {written}; plausible: {low:g} to {high:g}{_in(unit)}{''.join(meant[:1])}"
        )

    def _refuse_radians(self, turn: float, at: str, written: Any) -> None:
        """Reject a rotation by a quarter, half or three quarters of a turn, taken as degrees."""
        if self.stored:
            return
        quarters = turn / (math.pi / 2)
        if round(quarters) in (1, 2, 3) and abs(quarters - round(quarters)) < 1e-3:
            raise self.error(
                f"{at}: found {written}, a turn of {turn:.4g} deg; is it in rad? then write "
                f"{90 * round(quarters)} deg"
            )

    def _value(self, hint: Any, value: Any, where: str, unit: str | None) -> Any:
        origin, inner = get_origin(hint), get_args(hint)
        if origin in (Union, types.UnionType):
            return self._union(inner, value, where, unit)
        if origin is Literal:
            # True is 1 and 1.0 is 1 for Python, not for whoever reads the file.
            if not any(type(value) is type(each) and value == each for each in inner):
                raise self._wrong(where, value, ", ".join(map(str, inner)))
            return value
        if origin is tuple:
            return self._tuple(inner, value, where, unit)
        if origin is dict:
            return self._mapping(inner[1], value, where, unit)
        if hint in self.families:
            return self.build_one_of(self._members([hint], value), value, where)
        if dataclasses.is_dataclass(hint):
            return self.build(hint, value, where)  # type: ignore[arg-type]
        if hint is float:
            if self.stored and value in ("inf", "-inf"):
                return float(value)
            if isinstance(value, bool) or not isinstance(value, int | float):
                raise self._wrong(where, value, f"a number{_in(unit)}")
            if not math.isfinite(value):
                raise self.error(f"{where}: found {value}; allowed: a finite number{_in(unit)}")
            return to_si(float(value), unit) if unit else float(value)
        if hint in (int, str, bool):
            if type(value) is not hint:
                raise self._wrong(where, value, _WORDS[hint])
            return value
        if hint is Path:
            return Path(self._value(str, value, where, unit))
        raise TypeError(f"{where}: the reader knows no {hint!r}")

    def _tuple(
        self, inner: tuple[Any, ...], value: Any, where: str, unit: str | None
    ) -> tuple[Any, ...]:
        if not isinstance(value, list):
            raise self._wrong(where, value, "a list")
        each = inner[:1] * len(value) if inner[-1] is Ellipsis else inner
        if len(each) != len(value):
            raise self.error(f"{where}: found {len(value)} values; allowed: {len(each)}{_in(unit)}")
        return tuple(
            self._value(one, item, f"{where}[{index}]", unit)
            for index, (one, item) in enumerate(zip(each, value, strict=True))
        )

    def _mapping(self, hint: Any, value: Any, where: str, unit: str | None) -> dict[str, Any]:
        """Return the values of a mapping from names to values of one type.

        A name without a value is left out: so a file removes one of the file that it extends.
        """
        if not isinstance(value, dict) or not all(isinstance(key, str) for key in value):
            raise self._wrong(where, value, "a mapping from names to values")
        return {
            key: self._value(hint, item, f"{where}.{key}", unit)
            for key, item in value.items()
            if item is not None
        }

    def _union(self, options: tuple[Any, ...], value: Any, where: str, unit: str | None) -> Any:
        if value is None and _NONE in options:
            return None
        options = tuple(option for option in options if option is not _NONE)
        if len(options) == 1:
            return self._value(options[0], value, where, unit)
        mapping_options = [
            each for each in options if hasattr(each, "KIND") or each in self.families
        ]
        kinds = self._members(mapping_options, value)
        if kinds and (len(mapping_options) == len(options) or isinstance(value, dict)):
            return self.build_one_of(kinds, value, where)
        allowed = []
        if kinds:
            allowed.append(f"a mapping with kind {' or '.join(each.KIND for each in kinds)}")
        for option in (each for each in options if each not in mapping_options):
            try:
                return self._value(option, value, where, unit)
            except self.error as error:
                allowed.append(str(error).rpartition("allowed: ")[2])
        raise self._wrong(where, value, ", or ".join(allowed))

    def _members(self, hints: Sequence[Any], value: Any) -> list[Any]:
        """Return the dataclasses that a mapping may describe, with the members of families."""
        kind = value.get("kind") if isinstance(value, dict) else None
        members: list[Any] = []
        for hint in hints:
            family = self.families.get(hint)
            members += [hint] if family is None else family(kind).values()
        return members


def _suggestion(unknown: Sequence[str], fields: Mapping[str, Any]) -> str:
    """Return the likely key for the first unknown one, and all keys."""
    likely = difflib.get_close_matches(unknown[0], fields, n=1)
    meant = f"did you mean {likely[0]}? " if likely else ""
    return f"{meant}known: {', '.join(fields)}"


def _in(unit: str | None) -> str:
    return f" [{_SYMBOLS.get(unit, unit)}]" if unit else ""


# Strict YAML.

# Plain scalars by tag, with the characters that they begin with: YAML 1.2.2, section 10.3.2.
_INT = "tag:yaml.org,2002:int"
_PLAIN = (
    ("tag:yaml.org,2002:null", r"(~|null|Null|NULL|)$", ["~", "n", "N", ""]),
    ("tag:yaml.org,2002:bool", r"(true|True|TRUE|false|False|FALSE)$", list("tTfF")),
    (_INT, r"([-+]?[0-9]+|0o[0-7]+|0x[0-9a-fA-F]+)$", list("-+0123456789")),
    (
        "tag:yaml.org,2002:float",
        r"([-+]?(\.[0-9]+|[0-9]+(\.[0-9]*)?)([eE][-+]?[0-9]+)?|[-+]?\.(inf|Inf|INF)|\.(nan|NaN|NAN))$",
        list("-+.0123456789"),
    ),
)


_KINDS: dict[type[Any], str] = {str: "text ", list: "the list ", dict: "the mapping "}


class _StrictLoader(yaml.SafeLoader):
    """Loader that rejects a repeated key; PyYAML would silently keep the second."""

    error: type[Exception]

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
        keys: set[Any] = set()
        for key_node, _ in node.value:
            key = self.construct_object(key_node, deep=True)
            if key in keys:
                line = key_node.start_mark.line + 1
                raise self.error(f"{self.name}: line {line}: key {key!r} is written twice")
            keys.add(key)
        return super().construct_mapping(node, deep)


class _StrictDumper(yaml.SafeDumper):
    """Dumper whose output `_StrictLoader` reads unchanged: a commit such as 2902e78 is quoted."""


_StrictLoader.yaml_implicit_resolvers = {}
for _tag, _pattern, _first in _PLAIN:
    for _class in (_StrictLoader, _StrictDumper):
        _class.add_implicit_resolver(_tag, re.compile(_pattern), _first)
_StrictLoader.add_constructor(
    _INT,
    lambda loader, node: int(node.value, {"0o": 8, "0x": 16}.get(node.value[:2], 10)),
)


def yaml_text(content: Mapping[str, Any]) -> str:
    """Return a mapping of plain values as YAML that `Reader.parse` reads back."""
    return yaml.dump(content, Dumper=_StrictDumper, sort_keys=False)


def _in_one_line(error: yaml.MarkedYAMLError) -> str:
    """Return what is wrong and where, and where the part begins that contains it."""
    marks = (error.problem, error.problem_mark), (error.context, error.context_mark)
    return ", ".join(
        f"{text} (line {mark.line + 1})" if mark else text for text, mark in marks if text
    )


def merged(below: Mapping[str, Any], over: Mapping[str, Any]) -> dict[str, Any]:
    """Return one mapping over another, merged key by key; other values are replaced.

    A mapping of a different `kind` is replaced too, since its keys would not fit.
    """
    result = dict(below)
    for key, value in over.items():
        old: Any = result.get(key)
        result[key] = value
        mappings = isinstance(old, dict) and isinstance(value, dict)
        if mappings and value.get("kind", old.get("kind")) == old.get("kind"):
            result[key] = merged(old, value)
    return result


def differing_keys(one: Any, other: Any, where: str = "") -> list[str]:
    """Return the innermost keys in which two plain documents differ, such as `sensors[0].seed`."""
    if isinstance(one, Mapping) and isinstance(other, Mapping):
        names = sorted(one.keys() | other.keys(), key=str)
        dot = "." if where else ""
        parts = [
            (one.get(name, ...), other.get(name, ...), f"{where}{dot}{name}") for name in names
        ]
    elif isinstance(one, list) and isinstance(other, list) and len(one) == len(other):
        parts = [
            (each, its, f"{where}[{i}]")
            for i, (each, its) in enumerate(zip(one, other, strict=True))
        ]
    else:
        return [] if one == other else [where]
    return [key for part in parts for key in differing_keys(*part)]


def describe(value: Any) -> str:
    """Return a value for error messages, as a file has it: a text in quotes, with its kind."""
    if value is None:
        return "nothing"
    if isinstance(value, bool):
        return str(value).lower()
    return f"{_KINDS.get(type(value), '')}{value!r}"
