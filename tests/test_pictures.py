"""Pictures of the pages: drawn of the things that they show."""

import importlib.util
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from recorder.plot import Tile
from sim.indenters import named, tube
from sim.markers import named as pattern_of

# Between pictures of a sheet [px], as in `recorder.plot`.
GAP = 12
DOCS = Path(__file__).parents[1] / "docs"
spec = importlib.util.spec_from_file_location("pictures", DOCS / "pictures.py")
assert spec is not None
assert spec.loader is not None
pictures = importlib.util.module_from_spec(spec)
spec.loader.exec_module(pictures)


@pytest.mark.slow
def test_lengths_and_targets_are_those_of_the_bench(tmp_path: Path) -> None:
    drawn = {}
    for sensor in ("gelsight", "tacpalm"):
        folder = tmp_path / sensor
        folder.mkdir()
        pictures.bench(folder, sensor)
        drawn[sensor] = {path.name: np.asarray(Image.open(path)) for path in folder.iterdir()}
    one, other = drawn.values()
    names = ["frames", "mounting", "plan", "wiring"]
    assert list(sorted(one)) == [f"bench-{name}.png" for name in names]
    for name, pixels in one.items():
        assert np.ptp(pixels) > 200
        # Addresses and frames are the guide's; lengths and plans differ between the sensors.
        same = name in ("bench-wiring.png", "bench-frames.png")
        assert np.array_equal(pixels, other[name]) == same


def test_an_indenter_shows_material_where_there_is_some() -> None:
    tile = 85

    def colour(pixels: np.ndarray, x: float, y: float) -> np.ndarray:
        row, column = (round(tile / 2 + each / pictures.VIEW * tile) for each in (-y, x))
        return pixels[row, column].astype(float)

    ring, moon = (pictures.shaded(each, tile) for each in (tube(4e-3, 2e-3), named("moon")))
    background = colour(ring, 0.0, 0.0)
    assert np.array_equal(colour(ring, 6e-3, 6e-3), background)
    assert np.ptp(background) < 10  # grey
    assert np.ptp(colour(ring, 3e-3, 0.0)) > 40  # brass
    assert np.array_equal(colour(moon, 2e-3, 0.0), background)
    assert np.ptp(colour(moon, -2e-3, 0.0)) > 40


def test_patterns_show_markers_where_they_are(tmp_path: Path) -> None:
    pictures.patterns(tmp_path / "patterns.png")
    with Image.open(tmp_path / "patterns.png") as picture:
        pixels = np.asarray(picture.convert("L")).astype(float)
    left = GAP + pictures.PATTERNS.index("Array3") % pictures.COLUMNS * (200 + GAP)
    top = GAP
    for x, y in list(pattern_of("Array3").places)[:30]:
        column, row = left + 100 + x / 20e-3 * 200, top + 100 - y / 20e-3 * 200
        assert pixels[int(row), int(column)] < 120


def test_a_sheet_has_a_tile_for_each_picture() -> None:
    mask, free = np.zeros((2, 480, 640), bool)
    mask[100:110, 100:110] = True
    free[200:220, 200:220] = True
    pixels = pictures.outlined(mask, free)
    assert (pixels[105, 105] > 230).all()
    assert pixels[200, 210].tolist() == pixels[219, 210].tolist() != pixels[210, 210].tolist()
    tile = Tile(pixels, ("a", "b"))
    one, more = (pictures.tile_sheet([tile] * count, (40, 30), 2).size for count in (1, 3))
    assert more[0] - one[0] == 40 + GAP
    assert 30 + GAP < more[1] - one[1] < 100


@pytest.mark.slow
def test_the_sheet_in_the_documentation_is_the_one_that_is_drawn(tmp_path: Path) -> None:
    pictures.indenters(tmp_path / "sheet.png")
    with (
        Image.open(tmp_path / "sheet.png") as drawn,
        Image.open(DOCS / "images/indenters.png") as stored,
    ):
        change = np.asarray(drawn).astype(int) - np.asarray(stored)
    # Pillow versions differ slightly in how they draw letters.
    assert np.mean(np.abs(change).max(axis=2) > 40) < 0.01
