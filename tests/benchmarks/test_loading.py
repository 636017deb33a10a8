"""The benchmark of loaders reads the same images by both ways, and writes its page."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from benchmarks.__main__ import main
from benchmarks.learning.loading import WINDOW, Files, make
from learning import TactileDataset


def test_both_ways_read_the_same_images(tmp_path: Path) -> None:
    make(tmp_path, 0, 0.6)
    windows, files = TactileDataset(tmp_path / "sessions", WINDOW), Files(tmp_path / "files")
    assert len(windows) == len(files) == 24 - WINDOW + 1
    plain = [files[number]["image"].float() for number in range(8)]
    for number in range(3):
        image = windows[number]["image"].float()
        off = np.sort([float((image - other).abs().mean()) for other in plain])
        assert off[0] < 1  # two decoders
        assert off[1] > 1  # frames in another order


@pytest.mark.slow
def test_the_page_has_a_row_for_each_way(tmp_path: Path) -> None:
    out = tmp_path / "loading.md"
    few = ["--sessions", "1", "--length", "1", "--seconds", "0.5"]
    assert main(["loading", *few, "--out", str(out)]) == 0
    rows = [line for line in out.read_text().splitlines() if line.startswith(("| `", "| plain"))]
    assert len(rows) == 4
