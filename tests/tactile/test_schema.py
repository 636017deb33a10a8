"""JSON Schemas of bench and sensor files, checked with an independent validator."""

from __future__ import annotations

import json
import sys
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


def test_a_lab_gets_valid_schemas(tmp_path: Path) -> None:
    assert main(["init", str(tmp_path / "lab")]) == 0
    for kind in KINDS:
        text = (tmp_path / "lab" / "schemas" / f"{kind}.schema.json").read_text()
        Draft202012Validator.check_schema(json.loads(text))
        assert json.loads(text) == schema_of(kind)
    day = tmp_path / "lab" / "campaigns" / "day.yaml"
    _, named = day.read_text().splitlines()[0].split("$schema=")
    schema = json.loads((day.parent / named).read_text())
    Draft202012Validator(schema).validate(yaml.safe_load(day.read_text()))


def test_a_lab_without_the_simulator_has_the_other_schemas(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "sim.sensors.config", None)
    assert main(["init", str(tmp_path / "lab")]) == 0
    names = sorted(path.name for path in (tmp_path / "lab" / "schemas").iterdir())
    assert names == ["bench.schema.json", "campaign.schema.json"]
