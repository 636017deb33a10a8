"""Numbers of the fidelity page are those of the presets, YAML files and modules that it names."""

import importlib
import re
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Any

import pytest

from learning.config import read_settings, settings_to_dict
from learning.force import train as force
from learning.translation.diffusion import train as diffusion
from recorder.settings import Reader

ROOT = Path(__file__).parent.parent
PAGE = ROOT / "docs" / "reference" / "fidelity.md"
KINDS: dict[Path, Any] = {
    force.PRESETS: force.ForceModelSettings,
    diffusion.PRESETS: diffusion.TranslatorSettings,
}
_LINK = re.compile(r"\]\(([^)#]+\.(?:yaml|py))\)")
# `key = value` holds in each file of the row, `file.yaml key = value` in that one.
_BOUND = re.compile(r"`(?:([\w-]+\.(?:yaml|py)) )?([\w.]+) = ([^`]+)`")
ROWS = [
    (line, [(PAGE.parent / link).resolve() for link in _LINK.findall(line.split(" | ")[-1])])
    for line in PAGE.read_text().splitlines()
    if line.startswith("| ") and _LINK.search(line)
]


def value(path: Path, key: str) -> str:
    """Return a value of a module, a preset or a YAML file, as the page writes it."""
    content: Any
    if path.suffix == ".py":
        content = importlib.import_module(".".join(path.relative_to(ROOT).with_suffix("").parts))
    elif path.parent in KINDS:
        content = settings_to_dict(read_settings(KINDS[path.parent], path.parent, path.stem))
    else:
        content = Reader(ValueError).read(path)
    for word in key.split("."):
        if isinstance(content, type) and is_dataclass(content):
            content = {each.name: each.default for each in fields(content)}
        if isinstance(content, dict | list | tuple):
            content = content[word if isinstance(content, dict) else int(word)]
        else:
            content = getattr(content, word)
    return str(content).lower() if content is None or isinstance(content, bool) else str(content)


def wrong(line: str, files: list[Path]) -> list[str]:
    """Return the values that files have where a row says others, and YAML files never read."""
    bound, lines = _BOUND.findall(line), []
    for name, key, written in bound:
        chosen = [path for path in files if name in ("", path.name)]
        has = {path.name: value(path, key) for path in chosen} or {name: "not linked"}
        lines += [f"{file} {key} = {each}" for file, each in has.items() if each != written]
    read = {name for name, _, _ in bound}
    yaml = [path.name for path in files if path.suffix == ".yaml"]
    return lines + [f"{name} is not read" for name in yaml if not read & {"", name}]


@pytest.mark.parametrize("row", ROWS, ids=lambda row: row[0].split(" | ")[0][2:])
def test_a_row_has_the_values_of_its_files(row: tuple[str, list[Path]]) -> None:
    assert not wrong(*row)


def test_another_value_is_noticed() -> None:
    paper = force.PRESETS / "paper.yaml"
    assert wrong("`seed = 7`", [paper]) == ["paper.yaml seed = 0"]
    assert wrong("`other.yaml seed = 0`", [paper])[0] == "other.yaml seed = not linked"
    assert wrong("", [paper]) == ["paper.yaml is not read"]
