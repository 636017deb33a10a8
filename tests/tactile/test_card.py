"""Cards of sessions, archives and models have one form."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.made_up_archives import made_up_archive
from support.sessions import make_session

from tactile.__main__ import main

SECTIONS = ["## Parts", "## Checks", "## Limits"]


def card(path: Path, capsys: pytest.CaptureFixture[str]) -> str:
    """Return the printed card of a path, whose sections are those of all cards."""
    assert main(["card", str(path)]) == 0
    text = capsys.readouterr().out
    assert text.startswith(f"# {path.name}\n")
    assert [line for line in text.splitlines() if line.startswith("## ")] == SECTIONS
    return text


def test_a_session_has_a_card(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    text = card(make_session(tmp_path / "x.zarr"), capsys)
    assert "| devices | emulators of a mock bench |" in text
    assert "| force | force | 3600 |" in text
    assert "not of a real one" in text


def test_findings_and_a_missing_gauge_are_on_the_card(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    def gap(name: str, columns: Any) -> Any:
        if name != "pose":
            return columns
        return {
            key: np.delete(np.asarray(value), slice(100, 200), 0) for key, value in columns.items()
        }

    path = make_session(tmp_path / "x.zarr", names=("camera", "pose"), change=gap)
    checks = card(path, capsys).partition("## Checks")[2]
    assert "It has no force gauge" in checks
    assert "- dropped streams/pose: 100 samples lost" in checks


def test_an_archive_has_a_card(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "x.markers.zarr"
    archive = made_up_archive(path, ["dots", "grid"], indenters=("sphere", "cone"))
    text = card(path, capsys)
    assert "| sensors | dots, grid |" in text
    rows = len(archive["dots"].table["valid"])
    assert f"| dots | {rows} | cone, sphere |" in text


def test_a_model_has_a_card(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    from learning.training.checkpoint import Config

    Config("force", {"seed": 3}, "abc", "1.2", {"sensors": ["dots"]}, score=0.25).write(tmp_path)
    (tmp_path / "model.safetensors").write_bytes(bytes(200_000))
    text = card(tmp_path, capsys)
    assert "| sensors | dots |" in text
    assert "| seed | 3 |" in text
    assert "validation score: 0.25" in text


def test_other_paths_have_no_card(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["card", str(tmp_path)]) == 2
    assert "found nothing that has a card; allowed:" in capsys.readouterr().err
