"""Contact sheets: rows of captioned pictures, each row under a title, as one PNG."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw

from recorder.plot import INK, PAPER, SOFT, font

# Space around a picture, height of the captions below and of the title above [px].
GAP, CAPTION, HEAD = 10, 40, 34
MARKER, GROUND, ALARM = (240, 240, 236), (22, 26, 34), (220, 60, 50)
COLOURS = 256

Pixels = NDArray[np.uint8]


@dataclass(frozen=True, slots=True, eq=False)
class Tile:
    """One picture."""

    pixels: Pixels
    """(h, w, 3), RGB; of any size."""
    captions: tuple[str, str]
    """Two lines below it."""
    alarm: bool = False
    """True for a red frame."""


def write_sheet(
    rows: Sequence[tuple[str, str, Sequence[Tile]]],
    out: Path,
    columns: int,
    size: tuple[int, int] = (320, 240),
) -> None:
    """Write rows of title, note and pictures, `columns` at most, of a size (width, height) [px]."""
    height = HEAD + size[1] + CAPTION + GAP
    page = Image.new("RGB", (GAP + columns * (size[0] + GAP), GAP + len(rows) * height), PAPER)
    pen = ImageDraw.Draw(page)
    for row, (title, note, tiles) in enumerate(rows):
        top = GAP + row * height
        pen.text((GAP, top + 4), title, INK, font(17))
        pen.text((GAP + 20 + pen.textlength(title, font(17)), top + 6), note, SOFT, font(14))
        for column, tile in enumerate(tiles):
            left, under = GAP + column * (size[0] + GAP), top + HEAD + size[1]
            picture = Image.fromarray(tile.pixels).resize(size, Image.Resampling.LANCZOS)
            page.paste(picture, (left, top + HEAD))
            if tile.alarm:
                box = (left, top + HEAD, left + size[0] - 1, under - 1)
                pen.rectangle(box, outline=ALARM, width=3)
            upper, lower = tile.captions
            pen.text((left, under + 4), upper, ALARM if tile.alarm else INK, font(13))
            pen.text((left, under + 20), lower, SOFT, font(13))
    out.parent.mkdir(parents=True, exist_ok=True)
    page.quantize(COLOURS, dither=Image.Dither.NONE).save(out, "PNG", optimize=True)


def marker_picture(mask: NDArray[np.bool_]) -> Pixels:
    """Return a mask (h, w) as a picture (h, w, 3)."""
    return np.where(mask[..., None], MARKER, GROUND).astype(np.uint8)
