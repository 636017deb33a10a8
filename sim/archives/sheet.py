"""One picture for each sensor and indenter of an archive: its deepest state, small multiples."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw

from recorder import MarkerArchive
from recorder.archive import ArchivedSensor
from recorder.markers import unpack
from recorder.plot import INK, PAPER, SOFT, font

TILE, GAP = (144, 108), 6
"""Size of a picture, and the space around it [px]."""
LEFT, TOP = 92, 30
"""Room for the names [px]."""
MARKER, GROUND = (240, 240, 236), (22, 26, 34)
COLOURS = 16


def draw_sheet(archive_path: Path, out: Path) -> None:
    """Write a PNG: a row for each sensor or pattern, a column for each indenter.

    Shown is the deepest frame that is valid, the one nearest to the middle of several, and of these
    the last before it goes up again.

    Raises:
        SessionError: Not an archive, or one that is not complete.
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
    """The row that is shown of each indenter, by its code."""
    table = sensor.table
    aside = np.hypot(*table["position"].T)
    # Frames of the way up come after the shear: a press is deepest until then.
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
