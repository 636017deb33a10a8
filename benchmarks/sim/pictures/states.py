"""Draw the deepest press of each indenter under each sensor or pattern of an archive.

python -m benchmarks states data/states.markers.zarr docs/images/simulated.png
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw

from recorder import MarkerArchive
from recorder.archive import ArchivedSensor
from recorder.markers import unpack
from recorder.plot import INK, PAPER, SOFT, font

# Size of a picture, and the gap between pictures [px].
TILE, GAP = (144, 108), 6
# Margins for the names [px].
LEFT, TOP = 92, 30
MARKER, GROUND = (240, 240, 236), (22, 26, 34)
COLOURS = 16


def draw_sheet(archive_path: Path, out: Path) -> None:
    """Write a PNG with a row for each sensor or pattern and a column for each indenter.

    Each picture shows the deepest valid frame: of several, the one nearest to the middle, and of
    these the last before the indenter rises.
    """
    archive = MarkerArchive(archive_path)
    shown = {name: _deepest(sensor) for name, sensor in archive.items()}
    codes = sorted({code for rows in shown.values() for code in rows})
    width, height = TILE[0] + GAP, TILE[1] + GAP
    page = Image.new(
        "RGB", (LEFT + len(codes) * width + GAP, TOP + len(shown) * height + GAP), PAPER
    )
    pen = ImageDraw.Draw(page)
    for column, code in enumerate(codes):
        middle = LEFT + column * width + TILE[0] // 2
        pen.text((middle, TOP - 10), archive.indenters[code], INK, font(14), anchor="ms")
    for row, (name, rows) in enumerate(shown.items()):
        top = TOP + row * height
        pen.text((GAP, top + TILE[1] // 2), name, INK, font(14), anchor="lm")
        for column, code in enumerate(codes):
            place = (LEFT + column * width, top)
            if code not in rows:
                pen.text(place, "none", SOFT, font(12))
                continue
            page.paste(_picture(archive[name].packed([rows[code]])), place)
    out.parent.mkdir(parents=True, exist_ok=True)
    page.quantize(COLOURS).save(out, "PNG", optimize=True)


def _deepest(sensor: ArchivedSensor) -> dict[int, int]:
    """Return the row to show of each indenter, by the indenter's code."""
    table = sensor.table
    aside = np.hypot(*table["position"].T)
    # The release comes after the shear; until then a press is deepest.
    going_down = table["phase"] <= 1
    order = np.lexsort((table["frame"], -aside.round(6), table["depth"].round(9)))
    rows = {}
    for row in order:
        if table["valid"][row] and going_down[row]:
            rows[int(table["indenter"][row])] = int(row)
    return rows


def _picture(packed: NDArray[np.uint8]) -> Image.Image:
    (mask,) = unpack(packed)
    pixels = np.where(mask[..., None], MARKER, GROUND).astype(np.uint8)
    return Image.fromarray(pixels).resize(TILE, Image.Resampling.BOX)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of the benchmark."""
    parser.add_argument("archive", type=Path, help="archive to draw")
    parser.add_argument("path", type=Path, help="PNG to write")


def run(options: argparse.Namespace) -> int:
    """Draw the sheet of an archive."""
    draw_sheet(options.archive, options.path)
    return 0
