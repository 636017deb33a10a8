"""A section through body and indenter along x, true to scale."""

from __future__ import annotations

import numpy as np
from PIL import Image, ImageDraw

from recorder.plot import INK, PANEL, SOFT, font
from sim.picture.sample import Surface
from sim.result import Result

SOFT_BODY, SKIN = (206, 220, 222), (52, 104, 140)
METAL, PLATE = (152, 158, 168), (92, 98, 108)
SMOOTH = 3
"""Drawn this much larger and reduced: Pillow's edges are not smooth."""
HEADROOM = 0.35
"""Free height above the untouched surface, in thicknesses."""
PLATE_SHARE = 0.08
"""Height of the plate below the body, in thicknesses."""


def section_size(result: Result, surface: Surface, width: int) -> tuple[int, int]:
    """Width and height [px] of a section that is `width` wide."""
    body = result.scene.body
    tall = body.thickness * (1 + HEADROOM + PLATE_SHARE)
    return width, max(40, round(width * tall / (2 * surface.half_x)))


def draw_section(
    page: Image.Image, at: tuple[int, int], result: Result, frame: int, surface: Surface, width: int
) -> None:
    """Draw the section through the tip with its upper left corner at `at` [px]."""
    width, height = section_size(result, surface, width)
    body, tip = result.scene.body, result.scene.motion.tip[frame]
    size = width * SMOOTH, height * SMOOTH
    pixel = 2 * surface.half_x / size[0]
    x = (np.arange(size[0]) + 0.5) * pixel - surface.half_x
    top = body.thickness * HEADROOM

    def row(z: np.ndarray | float) -> np.ndarray:
        return np.asarray((top - np.asarray(z)) / pixel)

    rows = np.arange(size[1])[:, None]
    base = row(-body.thickness)
    skin, _ = surface.at(x, np.full_like(x, np.clip(tip[1], -surface.half_y, surface.half_y)))
    known = np.isfinite(skin)
    surface_row = np.where(known, row(np.where(known, skin, 0.0)), np.inf)
    below = (rows >= surface_row) & (rows < base)
    edge = np.abs(rows - surface_row) < SMOOTH
    lower = tip[2] + result.scene.indenter.heights(x - tip[0], np.zeros_like(x), reach=0.1)
    solid = np.isfinite(lower)
    metal = solid & (rows <= row(np.where(solid, lower, 0.0)))
    pixels = np.empty((size[1], size[0], 3), np.uint8)
    pixels[:] = PANEL
    pixels[below] = SOFT_BODY
    pixels[metal] = METAL
    pixels[edge] = SKIN
    pixels[np.broadcast_to(rows >= base, below.shape)] = PLATE
    image = Image.fromarray(pixels).resize((width, height), Image.Resampling.BOX)
    page.paste(image, at)
    pen = ImageDraw.Draw(page)
    pen.text((at[0], at[1] - 10), "section through the tip", INK, font(16), anchor="ls")
    note = f"along x at y = {tip[1] * 1e3 + 0.0:.3g} mm, true to scale"
    pen.text((at[0] + width, at[1] - 10), note, SOFT, font(13), anchor="rs")
