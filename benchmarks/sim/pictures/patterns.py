"""Contact sheet of patterns: `python -m benchmarks patterns docs/images/patterns.png`."""

from __future__ import annotations

import argparse
import math
from collections.abc import Sequence
from os import PathLike
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw

from recorder.plot import INK, PANEL, PAPER, SOFT, font
from sim.markers import HEIGHT, WIDTH, Camera
from sim.markers.pattern import HOMOGENEOUS, NAMES, SIMULATED, Pattern, named

COLUMNS = 6
# Height of the text under a tile [px].
CAPTION = 42
# Side of the gel in a tile, unless the pattern is wider [m].
GEL = 20e-3
MARKER = np.array([40.0, 44.0, 54.0])
# Colour of the camera's field of view.
FRAME = (196, 78, 62)
GELSIGHT_MM_PER_PX = 0.0249


def draw_sheet(path: str | PathLike[str], names: Sequence[str] = NAMES, *, tile: int = 200) -> None:
    """Write a PNG with a tile (of `tile` pixels) for each of the patterns.

    A tile shows the whole gel, x to the right and y up; the frame is the camera's field of view.
    Captions give the number of markers and the width of one.
    """
    across = min(COLUMNS, len(names))
    down = -(-len(names) // across)
    gap = tile // 12
    size = gap + across * (tile + gap), gap + down * (tile + CAPTION + gap)
    sheet = Image.new("RGB", size, PAPER)
    pen = ImageDraw.Draw(sheet)
    for index, name in enumerate(names):
        pattern = named(name)
        left = gap + index % across * (tile + gap)
        top = gap + index // across * (tile + CAPTION + gap)
        gel = _gel(pattern)
        sheet.paste(Image.fromarray(_drawn(pattern, gel, tile)), (left, top))
        view = _view(name)
        if view is not None:
            _frame(pen, left, top, tile, view, gel)
        pen.text((left, top + tile + 4), name, INK, font(15))
        told = f"{len(pattern)} {pattern.shape}s of {pattern.size * 1e3:g} mm"
        pen.text((left, top + tile + 24), told, SOFT, font(12))
    sheet.save(path)


def _gel(pattern: Pattern) -> float:
    reach = float(np.abs(pattern.centres).max()) + pattern.reach
    return max(GEL, 2e-3 * math.ceil(reach * 1e3))


def _drawn(pattern: Pattern, gel: float, tile: int) -> NDArray[np.uint8]:
    pixel = gel / tile
    along = (np.arange(tile, dtype=np.float64) + 0.5 - tile / 2) * pixel
    fraction = np.clip(0.5 - pattern.distance(along, along, 2 * pixel) / pixel, 0, 1)[::-1, :, None]
    colours = np.array(PANEL, float) * (1 - fraction) + MARKER * fraction
    drawn: NDArray[np.uint8] = np.round(colours).astype(np.uint8)
    return drawn


def _view(name: str) -> Camera | None:
    """Return the camera that the pattern is known for."""
    if name in SIMULATED:
        return Camera.paper()
    return Camera.of_scale(GELSIGHT_MM_PER_PX) if name in HOMOGENEOUS else None


def _frame(
    pen: ImageDraw.ImageDraw, left: int, top: int, tile: int, view: Camera, gel: float
) -> None:
    """Draw the edges of the image where they lie on the gel."""
    pixel = view.mm_per_px * 1e-3 * tile / gel
    for length, horizontal in ((HEIGHT, True), (WIDTH, False)):
        offset = length * pixel / 2
        if offset >= tile / 2:
            continue
        other = min((WIDTH if horizontal else HEIGHT) * pixel / 2, tile / 2 - 1)
        for sign in (-1, 1):
            at = tile / 2 + sign * offset
            low, high = tile / 2 - other, tile / 2 + other
            ends = (low, at, high, at) if horizontal else (at, low, at, high)
            pen.line([end + (left, top)[k % 2] for k, end in enumerate(ends)], FRAME, 1)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of the benchmark."""
    parser.add_argument("path", type=Path, help="PNG to write")


def run(options: argparse.Namespace) -> int:
    """Draw the sheet of every named pattern."""
    draw_sheet(options.path)
    return 0
