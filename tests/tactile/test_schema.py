"""JSON Schemas of bench and sensor files, checked with an independent validator."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
import yaml
from jsonschema import Draft202012Validator

from tactile.__main__ import main
from tactile.schema import KINDS, schema_of

ROOT = Path(__file__).parents[2]
FILES = [
    *(("bench", path) for path in sorted((ROOT / "rig/bench/benches").glob("**/*.yaml"))),
    *(("campaign", path) for path in sorted((ROOT / "rig/bench/campaigns").glob("*.yaml"))),
    *(("sensor", path) for path in sorted((ROOT / "sim/sensors/rows").glob("*.yaml"))),
    *(("sensor", path) for path in sorted((ROOT / "examples").glob("demo-*/*.yaml"))),
    *(("bench", path) for path in sorted((ROOT / "examples").glob("*/*-gauge.yaml"))),
    *(("campaign", path) for path in sorted((ROOT / "examples").glob("*/day.yaml"))),
]


@pytest.mark.parametrize(("kind", "path"), FILES, ids=lambda value: getattr(value, "stem", value))
def test_files_of_the_package_fit_their_schema(kind: str, path: Path) -> None:
    Draft202012Validator(schema_of(kind)).validate(yaml.safe_load(path.read_text()))


@pytest.mark.parametrize(
    ("kind", "content", "wrong"),
    [
        ("bench", {"rate": 40.0}, "rate"),
        ("bench", {"limits": {"depth_max": 1.0}}, "depth_max"),
        ("bench", {"rate_hz": "40"}, "'40'"),
        ("bench", {"camera": {"kind": "eye"}}, "eye"),
        ("campaign", {"sessions": [{"sensor": "gelsight", "plan": "wave"}]}, "wave"),
        ("sensor", {"body": {"thickness_mm": "4 mm"}}, "4 mm"),
        ("sensor", {"name": "mine"}, "name"),
    ],
)
def test_wrong_files_do_not_fit(kind: str, content: dict[str, Any], wrong: str) -> None:
    (error,) = Draft202012Validator(schema_of(kind)).iter_errors(content)
    assert wrong in error.message


@pytest.mark.parametrize("kind", KINDS)
def test_the_command_writes_a_valid_schema(
    kind: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["schema", kind]) == 0
    printed = json.loads(capsys.readouterr().out)
    Draft202012Validator.check_schema(printed)
    assert main(["schema", kind, "--out", str(tmp_path / "x.json")]) == 0
    assert json.loads((tmp_path / "x.json").read_text()) == printed
    assert "yaml-language-server: $schema=x.json" in capsys.readouterr().out
