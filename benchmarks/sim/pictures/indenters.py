"""Contact sheet: the tip of every named indenter as a shaded height map."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from os import PathLike
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

from sim.indenters.indenter import Indenter
from sim.indenters.shapes import NAMES, named

Array = NDArray[np.float64]

# Width of the view in a tile [m]: the widest indenter and a margin.
VIEW = 17e-3
# Heights beyond this are not drawn [m], because no press goes that deep.
REACH = 5e-3
COLUMNS = 6
# Samples along each side of a pixel.
SAMPLES = 2
# Height of the text under a tile [px].
CAPTION = 40
# Length of the scale bar [m].
SCALE = 5e-3

PAPER, INK, GREY = (250, 250, 248), (32, 36, 44), (120, 126, 134)
# Colours of the tip plane and of points REACH above it.
NEAR, FAR = np.array([236.0, 196.0, 128.0]), np.array([44.0, 74.0, 112.0])
# Direction to the lamp: over the viewer's left shoulder.
LIGHT = np.array([-0.5, 0.6, -0.62]) / np.linalg.norm([-0.5, 0.6, -0.62])


def draw_sheet(
    path: str | PathLike[str], *, indenters: Sequence[Indenter] | None = None, tile: int = 200
) -> None:
    """Write a PNG with a tile (of `tile` pixels) for each indenter, by default all 18.

    A tile shows x to the right and y up. The tip plane is bright and higher points are darker;
    the lamp is at the upper left. Each caption gives the name and the edge radius.
    """
    shown = [named(name) for name in NAMES] if indenters is None else list(indenters)
    across = min(COLUMNS, len(shown))
    down = -(-len(shown) // across)
    gap = tile // 12
    size = gap + across * (tile + gap), gap + down * (tile + CAPTION + gap)
    sheet = Image.new("RGB", size, PAPER)
    pen = ImageDraw.Draw(sheet)
    for index, indenter in enumerate(shown):
        left = gap + index % across * (tile + gap)
        top = gap + index // across * (tile + CAPTION + gap)
        sheet.paste(Image.fromarray(_shaded(indenter, tile)), (left, top))
        below, bar = top + tile, round(tile * SCALE / VIEW)
        _write(pen, (left, below + 4), indenter.name, 15, INK)
        radius = indenter.edge_radius * 1e3
        _write(pen, (left, below + 23), f"edges {radius:g} mm" if radius else "no edge", 11, GREY)
        right = left + tile
        pen.line([(right - bar, below + 16), (right, below + 16)], INK, 2)
        _write(pen, (right - bar, below + 23), f"{SCALE * 1e3:g} mm", 11, GREY)
    sheet.save(path)


def _shaded(indenter: Indenter, tile: int) -> NDArray[np.uint8]:
    """Return an image of the tip (tile, tile, 3)."""
    count = tile * SAMPLES
    along = ((np.arange(count) + 0.5) / count - 0.5) * VIEW
    x, y = np.meshgrid(along, -along)
    height = indenter.heights(x, y, reach=REACH)
    hit = np.isfinite(height)
    points = np.stack([x[hit], y[hit], height[hit]], axis=1)
    _, normal = indenter.distance(points)
    bright = 0.4 + 0.8 * np.maximum(normal @ LIGHT, 0)
    fraction = (height[hit] / REACH)[:, None]
    image = np.empty((count, count, 3))
    image[:] = (236.0, 237.0, 238.0)
    image[hit] = np.clip((NEAR * (1 - fraction) + FAR * fraction) * bright[:, None], 0, 255)
    blocks = image.reshape(tile, SAMPLES, tile, SAMPLES, 3)
    pixels: NDArray[np.uint8] = np.round(blocks.mean(axis=(1, 3))).astype(np.uint8)
    return pixels


def _write(
    pen: ImageDraw.ImageDraw, at: tuple[int, int], text: str, size: int, colour: tuple[int, ...]
) -> None:
    pen.text(at, text, fill=colour, font=ImageFont.load_default(size))


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of the benchmark."""
    parser.add_argument("path", type=Path, help="PNG to write")


def run(options: argparse.Namespace) -> int:
    """Run `python -m benchmarks indenters PATH`, which draws the sheet of all 18."""
    draw_sheet(options.path)
    return 0
