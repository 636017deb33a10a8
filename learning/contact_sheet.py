"""Contact sheets of markers, as PNG files of few colours."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from recorder.plot import Tile, sheet

MARKER, GROUND = (240, 240, 236), (22, 26, 34)
COLOURS = 256

Pixels = NDArray[np.uint8]


def write_sheet(
    rows: Sequence[tuple[str, str, Sequence[Tile]]],
    out: Path,
    columns: int,
    size: tuple[int, int] = (320, 240),
) -> None:
    """Write rows of title, note and pictures of a size [px], at most `columns` in a row."""
    out.parent.mkdir(parents=True, exist_ok=True)
    page = sheet(rows, columns, size).quantize(COLOURS, dither=Image.Dither.NONE)
    page.save(out, "PNG", optimize=True)


def marker_picture(mask: NDArray[np.bool_]) -> Pixels:
    """Return a mask (h, w) as a picture (h, w, 3)."""
    return np.where(mask[..., None], MARKER, GROUND).astype(np.uint8)
