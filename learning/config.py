"""Settings of trainings: frozen dataclasses read from strict YAML, with `key.sub=value` overrides.

Every error names file, key, value and allowed values. A file can name another that it `extends`;
mappings are merged key by key, other values are replaced. Where a field can be one of several
dataclasses, `kind` selects one by its `KIND`.
"""

import dataclasses
import json
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, TypeVar

from learning.errors import LearningError
from recorder.settings import Reader, merged
from recorder.store import replace_file

Settings = TypeVar("Settings")

READER = Reader(LearningError)

_SUFFIXES = (".yaml", ".yml")


def preset_names(preset_dir: Path) -> tuple[str, ...]:
    """Return the names of the presets in a folder."""
    return tuple(sorted(path.stem for path in preset_dir.glob("*.yaml")))


def preset_path(preset_dir: Path, name_or_path: str | Path) -> Path:
    """Return the file of a preset in a folder, or the given path if it is a YAML file."""
    path = Path(name_or_path)
    if path.suffix in _SUFFIXES:
        return path
    names = preset_names(preset_dir)
    if str(name_or_path) not in names:
        raise LearningError(
            f"preset: found {str(name_or_path)!r}; known: {', '.join(names)}, or a .yaml file"
        )
    return preset_dir / f"{name_or_path}.yaml"


def read_settings(
    kind: type[Settings], preset_dir: Path, name_or_path: str | Path, overrides: Sequence[str] = ()
) -> Settings:
    """Read settings from a preset's name or a YAML file and apply overrides.

    These are `key=value` or `key.sub=value`, the value in YAML; later ones win.
    """
    path = preset_path(preset_dir, name_or_path)
    content = READER.read(path)
    for override in overrides:
        key, equals, text = override.partition("=")
        if not equals or not all(key.split(".")):
            raise LearningError(f"--set: found {override!r}; allowed: key=value or key.sub=value")
        value = READER.parse(text, f"--set {key}")
        for part in reversed(key.split(".")):
            value = {part: value}
        content = merged(content, value)
    try:
        return READER.build(kind, content, str(path))
    except LearningError as error:
        # The file may be right, and the override wrong.
        keys = ", ".join(each.partition("=")[0] for each in overrides)
        raise LearningError(f"{error} (with --set {keys})" if keys else str(error)) from None


def require(
    settings: Any,
    *names: str,
    least: float = -math.inf,
    above: float = -math.inf,
    most: float = math.inf,
    below: float = math.inf,
) -> None:
    """Reject fields of settings outside a range. None is allowed; a tuple is checked by item."""
    low = f"above {above}" if above > least else str(least)
    if below < math.inf:
        allowed = f"{low} to less than {below}"
    elif most == math.inf:
        allowed = low if above > least else f"{low} or more"
    else:
        allowed = f"{low} to {most}" if max(least, above) > -math.inf else f"{most} or less"
    for name in names:
        value = getattr(settings, name)
        for each in value if isinstance(value, tuple) else (value,):
            if each is not None and not (least <= each <= most and above < each < below):
                raise LearningError(f"{name}: found {value}; allowed: {allowed}")


def settings_to_dict(settings: Any) -> dict[str, Any]:
    """Return settings as plain values from which `build` restores them; tuples become lists."""
    plain = {"kind": settings.KIND} if hasattr(settings, "KIND") else {}
    fields = (each for each in dataclasses.fields(settings) if each.init)
    return plain | {each.name: _plain(getattr(settings, each.name)) for each in fields}


def read_json(path: Path) -> Any:
    """Return the content of a JSON file."""
    try:
        return json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise LearningError(f"{path}: no such file") from None
    except (json.JSONDecodeError, UnicodeDecodeError) as error:
        raise LearningError(f"{path}: not JSON: {error}") from None


def require_same(path: Path, content: Mapping[str, Any]) -> None:
    """Write the sources of a folder's results to a JSON file, or check that it is the same."""
    plain: dict[str, Any] = json.loads(json.dumps(content))
    if not path.exists():
        replace_file(path, (json.dumps(plain, indent=1) + "\n").encode())
        return
    stored = json.loads(path.read_text(encoding="utf-8"))
    for key, value in plain.items():
        if stored.get(key) != value:
            raise LearningError(
                f"{path}.{key}: found {stored.get(key)!r}, asked for {value!r}; allowed: the same "
                f"{path.stem}, or another folder"
            )


def _plain(value: Any) -> Any:
    if dataclasses.is_dataclass(value):
        return settings_to_dict(value)
    if isinstance(value, tuple):
        return [_plain(each) for each in value]
    return value
