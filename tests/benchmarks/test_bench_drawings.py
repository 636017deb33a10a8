"""Drawings of a bench: made of its file, for any sensor, and those that the guide shows."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from benchmarks.__main__ import main

GUIDE = Path(__file__).parents[2] / "docs" / "how-to" / "set-up-a-bench.md"
NAMES = {"bench-wiring.png", "bench-mounting.png", "bench-frames.png"}


def test_the_lengths_and_targets_are_those_of_the_bench(tmp_path: Path) -> None:
    assert all(f"../images/{name}" in GUIDE.read_text() for name in NAMES)
    pictures = {}
    for sensor in ("gelsight", "tacpalm"):
        assert main(["bench-drawings", "--sensor", sensor, "--out", str(tmp_path / sensor)]) == 0
        folder = tmp_path / sensor
        assert {path.name for path in folder.iterdir()} == NAMES
        pictures[sensor] = {name: np.asarray(Image.open(folder / name)) for name in NAMES}
    for name in NAMES:
        one, other = (found[name] for found in pictures.values())
        assert np.ptp(one) > 200
        # Addresses are the guide's; lengths and plans differ between the sensors.
        assert np.array_equal(one, other) == (name == "bench-wiring.png")


def test_an_unknown_sensor_is_named(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["bench-drawings", "--sensor", "nosuch", "--out", str(tmp_path)]) == 2
    assert "nosuch" in capsys.readouterr().err
