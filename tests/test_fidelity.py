"""Numbers of the fidelity page are those of the presets, YAML files and modules that it names."""

import importlib
import re
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Any

import pytest
import yaml

from learning.config import read_settings, settings_to_dict
from learning.force import train as force
from learning.translation.diffusion import train as translator

ROOT = Path(__file__).parent.parent
PAGE = ROOT / "docs" / "reference" / "fidelity.md"
PRESETS = {
    force.PRESETS: force.ForceModelSettings,
    translator.PRESETS: translator.TranslatorSettings,
}
_LINK = re.compile(r"\]\(([^)#]+\.(?:yaml|py))\)")
# `key = value` holds in each file of the row, `file.yaml key = value` in that one.
_BOUND = re.compile(r"`(?:([\w-]+\.(?:yaml|py)) )?([\w.]+) = ([^`]+)`")
ROWS = [
    (line, [(PAGE.parent / link).resolve() for link in _LINK.findall(line.split(" | ")[-1])])
    for line in PAGE.read_text().splitlines()
    if line.startswith("| ") and _LINK.search(line)
]


def _content(path: Path) -> Any:
    """Return a module, the settings of a preset, or a YAML file over those that it extends."""
    if path.suffix == ".py":
        name = ".".join(path.relative_to(ROOT).with_suffix("").parts)
        return importlib.import_module(name)
    if path.parent in PRESETS:
        return settings_to_dict(read_settings(PRESETS[path.parent], path.parent, path.stem))
    content = yaml.safe_load(path.read_text())
    parent = content.pop("extends", None)
    return _merged(_content(path.parent / parent), content) if parent else content


def _merged(below: Any, above: Any) -> Any:
    if not isinstance(below, dict) or not isinstance(above, dict):
        return above
    return below | {name: _merged(below.get(name), value) for name, value in above.items()}


def _value(content: Any, key: str) -> Any:
    for word in key.split("."):
        if isinstance(content, type) and is_dataclass(content):
            content = {each.name: each.default for each in fields(content)}
        if isinstance(content, dict):
            content = content[word]
        elif isinstance(content, list | tuple):
            content = content[int(word)]
        else:
            content = getattr(content, word)
    return content


def _written(value: Any) -> str:
    if isinstance(value, bool) or value is None:
        return "none" if value is None else str(value).lower()
    return str(value)


def wrong(line: str, files: list[Path]) -> list[str]:
    """Return the values of a row that its files do not have, with those that they have."""
    lines = []
    for name, key, value in _BOUND.findall(line):
        chosen = [path for path in files if name in ("", path.name)]
        assert chosen, f"{name}: not a file of the row {line[:40]}"
        actual = {path.name: _written(_value(_content(path), key)) for path in chosen}
        lines += [f"{path} {key} = {has}" for path, has in actual.items() if has != value]
    return lines


def _row(row: tuple[str, list[Path]]) -> str:
    return row[0].split(" | ")[0][2:]


@pytest.mark.parametrize("row", ROWS, ids=_row)
def test_a_row_has_the_values_of_its_files(row: tuple[str, list[Path]]) -> None:
    line, files = row
    assert not wrong(line, files)
    named = {name for name, _, _ in _BOUND.findall(line)}
    unread = [path.name for path in files if path.suffix == ".yaml" and not named & {"", path.name}]
    assert not unread, "a YAML file of which nothing is read"


@pytest.mark.parametrize(
    ("text", "file"),
    [
        ("stages.0.learning_rate = 0.2", "learning/force/presets/paper.yaml"),
        ("LAST_TIME = 998", "learning/translation/diffusion/network.py"),
        ("GuardLimits.soft_fraction = 0.9", "rig/core/guard.py"),
        ("trajectory.depth_max_mm = 1.3", "rig/bench/benches/gelsight-hetero.yaml"),
    ],
)
def test_another_value_is_noticed(text: str, file: str) -> None:
    (line,) = wrong(f"| `{text}` |", [ROOT / file])
    assert line.startswith(f"{Path(file).name} {text.split(' = ')[0]} = ")
