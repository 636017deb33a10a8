"""Markers before and after a press.

Run with `python -m benchmarks render-picture docs/images/rendering.png`.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from os import PathLike
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw

from benchmarks.sim.render.states import RenderState, solved
from recorder.plot import INK, PANEL, PAPER, SOFT, font
from sim.device import ready_device
from sim.markers import Camera, named
from sim.markers.renderer import Renderer

PATTERNS = ("Array3", "Circle1", "Diamond4")
TILE = (360, 270)
CAPTION, GAP = 30, 14
COLOURS = 64
MARKER = np.array([40.0, 44.0, 54.0])
BEFORE = np.array([232.0, 150.0, 120.0])


def draw(path: str | PathLike[str], states: Sequence[RenderState]) -> None:
    """Write a PNG: a row for each state, a column for each pattern.

    Markers are dark; places with markers only on the undeformed gel are red.
    """
    width = GAP + len(PATTERNS) * (TILE[0] + GAP)
    sheet = Image.new("RGB", (width, GAP + len(states) * (TILE[1] + CAPTION + GAP)), PAPER)
    pen = ImageDraw.Draw(sheet)
    for row, state in enumerate(states):
        renderer = Renderer(state.body, Camera.paper())
        textures = renderer.textures([named(name) for name in PATTERNS])
        before = renderer.undeformed().coverage(textures)[0]
        after = renderer.see(state.x, state.y, state.surface[None]).coverage(textures)[0]
        top = GAP + row * (TILE[1] + CAPTION + GAP)
        for column, name in enumerate(PATTERNS):
            left = GAP + column * (TILE[0] + GAP)
            drawn = Image.fromarray(_drawn(before[column], after[column]))
            sheet.paste(drawn.resize(TILE, Image.Resampling.LANCZOS), (left, top))
            pen.text((left, top + TILE[1] + 6), name, INK, font(15))
            pen.text((left + TILE[0], top + TILE[1] + 8), state.name, SOFT, font(13), anchor="ra")
    sheet.quantize(COLOURS).save(path, optimize=True)


def _drawn(before: NDArray[np.uint8], after: NDArray[np.uint8]) -> NDArray[np.uint8]:
    colours = np.broadcast_to(np.array(PANEL, float), (*before.shape, 3))
    for fraction, colour in ((before, BEFORE), (after, MARKER)):
        part = fraction[..., None] / 255.0
        colours = colours * (1 - part) + colour * part
    drawn: NDArray[np.uint8] = np.round(colours).astype(np.uint8)
    return drawn


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of the benchmark."""
    parser.add_argument("path", type=Path, help="PNG to write")


def run(options: argparse.Namespace) -> int:
    """Solve the presses and draw them."""
    path = options.path
    ready_device("cpu")
    draw(path, solved())
    return 0
