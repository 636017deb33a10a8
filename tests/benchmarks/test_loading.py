"""The benchmark of loaders reads the same images by all ways, and writes its page."""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest
from PIL import Image

from benchmarks.__main__ import main
from benchmarks.learning.loading import make
from benchmarks.learning.loading_child import IMAGE, WINDOW, opened


@pytest.mark.slow
def test_all_ways_read_the_same_images(tmp_path: Path) -> None:
    make(tmp_path, 0, 0.6)
    (windows, key), (files, _) = opened("ours", tmp_path), opened("plain", tmp_path)
    assert len(windows) == len(files) == 24 - WINDOW + 1  # type: ignore[arg-type]
    plain = [files[number][key].float() for number in range(8)]
    for number in range(3):
        image = windows[number][key].float()
        off = np.sort([float((image - other).abs().mean()) for other in plain])
        assert off[0] < 1  # two decoders
        assert off[1] > 1  # frames in another order
    (parquet,) = (tmp_path / "lerobot" / "0").glob("data/*/*.parquet")
    column = pq.read_table(parquet)[IMAGE].to_pylist()
    assert len(column) == 24
    for row in (0, 23):
        pixels = np.asarray(Image.open(io.BytesIO(column[row]["bytes"])))
        stored = np.asarray(Image.open(tmp_path / "files" / "0" / f"{row:05d}.jpg"))
        np.testing.assert_array_equal(pixels, stored)


@pytest.mark.slow
def test_the_page_has_a_row_for_each_way(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.delenv("LEROBOT_PYTHON", raising=False)
    out = tmp_path / "loading.md"
    few = ["--sessions", "1", "--length", "1", "--seconds", "0.5"]
    assert main(["loading", *few, "--out", str(out)]) == 0
    rows = [line for line in out.read_text().splitlines() if line.startswith(("| `", "| plain"))]
    assert len(rows) == 4
    assert "LEROBOT_PYTHON is not set" in capsys.readouterr().out
    # Another Python that has no LeRobot is named, and its error shown.
    monkeypatch.setenv("LEROBOT_PYTHON", "/bin/false")
    assert main(["loading", *few]) == 2
