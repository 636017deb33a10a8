"""Strict YAML: unique keys, plain scalars as in YAML 1.2, and inheritance by `extends`.

1e-4 is a number; `no` and `on` are strings. The only booleans are true and false.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import yaml

_BOOL = "tag:yaml.org,2002:bool"
_EXPONENT = (
    "tag:yaml.org,2002:float",
    re.compile(r"[-+]?[0-9]+(\.[0-9]*)?[eE][-+]?[0-9]+$"),
    list("-+0123456789"),
)


_KINDS: dict[type[Any], str] = {str: "text ", list: "the list ", dict: "the mapping "}


class _StrictLoader(yaml.SafeLoader):
    """Loader that rejects a repeated key; PyYAML would silently keep the second."""

    error: type[ValueError]

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
        seen: set[Any] = set()
        for key_node, _ in node.value:
            key = self.construct_object(key_node, deep=True)
            if key in seen:
                line = key_node.start_mark.line + 1
                raise self.error(f"{self.name}: line {line}: key {key!r} is written twice")
            seen.add(key)
        return super().construct_mapping(node, deep)


_StrictLoader.yaml_implicit_resolvers = {
    first: [each for each in resolvers if each[0] != _BOOL]
    for first, resolvers in yaml.SafeLoader.yaml_implicit_resolvers.items()
}
_StrictLoader.add_implicit_resolver(_BOOL, re.compile(r"(true|false)$"), list("tf"))
_StrictLoader.add_implicit_resolver(*_EXPONENT)


class _StrictDumper(yaml.SafeDumper):
    """Dumper whose output `_StrictLoader` reads unchanged: a commit such as 2902e78 is quoted."""


_StrictDumper.add_implicit_resolver(*_EXPONENT)


def yaml_text(content: Mapping[str, Any]) -> str:
    """Return a mapping of plain values as YAML that `parse` reads back."""
    return yaml.dump(content, Dumper=_StrictDumper, sort_keys=False)


def parse(text: str, name: str, error: type[ValueError]) -> Any:
    """Return the content of a YAML text; `name` is its origin, for messages of an `error`."""
    try:
        loader = _StrictLoader(text)
        loader.name, loader.error = name, error
        try:
            return loader.get_single_data()
        finally:
            loader.dispose()
    except yaml.MarkedYAMLError as fault:
        raise error(f"{name}: not YAML: {_in_one_line(fault)}") from None
    except yaml.YAMLError as fault:
        raise error(f"{name}: not YAML: {fault}") from None


def _in_one_line(error: yaml.MarkedYAMLError) -> str:
    """Return what is wrong and where, and where the part begins that contains it."""
    marks = (error.problem, error.problem_mark), (error.context, error.context_mark)
    return ", ".join(
        f"{text} (line {mark.line + 1})" if mark else text for text, mark in marks if text
    )


def read_mapping(
    path: Path, error: type[ValueError], library: Path | None, above: tuple[Path, ...] = ()
) -> dict[str, Any]:
    """Return the mapping in a YAML file, merged over the file named by its `extends`.

    That name is relative to the file; if it is `NAME` or `../NAME` and does not exist, the folder
    `library` is searched as well. `above` are the files that led here through `extends`.
    """
    if path.resolve() in above:
        raise error(f"{path}: extends: the files extend each other in a circle")
    try:
        content = parse(path.read_text(encoding="utf-8"), str(path), error)
    except FileNotFoundError:
        raise error(f"{path}: no such file") from None
    except UnicodeDecodeError as fault:
        raise error(f"{path}: not YAML: {fault}") from None
    if not isinstance(content, dict):
        raise error(f"{path}: found {describe(content)}; allowed: a mapping of keys to values")
    parent = content.pop("extends", None)
    if parent is None:
        return content
    if not isinstance(parent, str):
        raise error(f"{path}.extends: found {describe(parent)}; allowed: the name of a file")
    extended = path.parent / parent
    if library is not None and not extended.exists() and set(Path(parent).parts[:-1]) <= {".."}:
        shared = library / Path(parent).name
        extended = shared if shared.is_file() else extended
    if not extended.exists():
        raise error(f"{path}.extends: found {parent!r}; no such file beside it")
    below = read_mapping(extended, error, library, (*above, path.resolve()))
    return merged(below, content)


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


def describe(value: Any) -> str:
    """Return a value for error messages, as a file has it: a text in quotes, with its kind."""
    if value is None:
        return "nothing"
    if isinstance(value, bool):
        return str(value).lower()
    return f"{_KINDS.get(type(value), '')}{value!r}"


# Natural sort order.


def natural_key(name: str) -> list[tuple[int, int, str]]:
    """Return the key that sorts image_2 before image_10."""
    return [(0, int(p), "") if p.isdecimal() else (1, 0, p) for p in re.split(r"(\d+)", name)]
