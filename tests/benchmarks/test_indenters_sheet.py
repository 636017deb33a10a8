from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from support.commands import run_module

from benchmarks.sim.pictures import indenters
from benchmarks.sim.pictures.indenters import CAPTION, VIEW, draw_sheet
from sim.indenters import named, tube


def test_a_sheet_shows_material_where_there_is_some(tmp_path: Path) -> None:
    tile = 85
    gap = tile // 12
    draw_sheet(tmp_path / "sheet.png", indenters=[tube(4e-3, 2e-3), named("moon")], tile=tile)
    with Image.open(tmp_path / "sheet.png") as picture:
        pixels = np.asarray(picture).astype(float)
    assert pixels.shape == (2 * gap + tile + CAPTION, 3 * gap + 2 * tile, 3)

    def colour(index: int, x: float, y: float) -> np.ndarray:
        column = gap + index * (tile + gap) + tile / 2 + x / VIEW * tile
        row = gap + tile / 2 - y / VIEW * tile
        return pixels[int(row), int(column)]

    background = colour(0, 0.0, 0.0)
    assert np.array_equal(colour(0, 6e-3, 6e-3), background)
    assert np.ptp(background) < 10  # grey
    assert np.ptp(colour(0, 3e-3, 0.0)) > 40  # brass
    assert np.array_equal(colour(1, 2e-3, 0.0), background)
    assert np.ptp(colour(1, -2e-3, 0.0)) > 40


@pytest.mark.slow
def test_the_sheet_in_the_documentation_is_the_one_that_is_drawn(tmp_path: Path) -> None:
    run_module(indenters, tmp_path / "sheet.png")
    shown = Path(__file__).parents[2] / "docs/images/indenters.png"
    with Image.open(tmp_path / "sheet.png") as drawn, Image.open(shown) as kept:
        change = np.asarray(drawn).astype(int) - np.asarray(kept)
    # Pillow versions differ slightly in how they draw letters.
    assert np.mean(np.abs(change).max(axis=2) > 40) < 0.01
