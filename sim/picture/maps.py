"""Maps of the surface from above: heights as a shaded relief, and the pressure on it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw
from scipy.ndimage import binary_erosion

from recorder.plot import INK, PANEL, SOFT, font
from sim.picture.colours import HEIGHT, PRESSURE, Scale, coloured, round_below, round_numbers
from sim.picture.sample import Surface

Array = NDArray[np.float64]
Box = tuple[int, int, int, int]

LIGHT = np.array([-0.55, 0.55, 0.63])
"""Direction to the lamp: upper left."""
RELIEF = 0.7
"""Steepest slope that the shading shows; flatter reliefs are raised up to `RAISED_MOST` times."""
RAISED_MOST = 12.0
RIM = (176, 182, 192)
"""Colour of the body's outline."""
BAR_GAP, BAR_WIDTH = 14, 14


@dataclass(frozen=True, slots=True)
class Sampled:
    """A surface sampled at the pixels of one map, y up."""

    height: Array
    """(rows, columns) [m]; NaN beside the body."""
    pressure: Array
    """(rows, columns) [Pa]; NaN beside the body."""
    pixel: float
    """Width of a pixel [m]."""
    pressure_max: float
    """Largest pressure of the result [Pa]."""


def sampled(surface: Surface, size: int) -> Sampled:
    """The surface at pixels whose longer side counts `size`."""
    pixel = 2 * max(surface.half_x, surface.half_y) / size
    columns, rows = round(2 * surface.half_x / pixel), round(2 * surface.half_y / pixel)
    x = (np.arange(columns) + 0.5 - columns / 2) * pixel
    y = (rows / 2 - np.arange(rows) - 0.5) * pixel
    height, pressure = surface.at(x[None, :], y[:, None])
    return Sampled(height, pressure, pixel, surface.pressure_max)


def draw_heights(page: Image.Image, at: tuple[int, int], surface: Sampled) -> None:
    """Draw the relief with its upper left corner at `at` [px]."""
    low, high = float(np.nanmin(surface.height)), float(np.nanmax(surface.height))
    # An untouched surface is one height: give its scale some width.
    low, high = (low, high) if high - low > 1e-6 else (low - 5e-7, high + 5e-7)
    colours = coloured((surface.height - low) / (high - low), HEIGHT)
    _paste(page, at, colours * _shade(surface)[..., None], surface)
    _bar(page, at, surface, HEIGHT, (low * 1e3, high * 1e3), "height [mm]")


def draw_pressure(page: Image.Image, at: tuple[int, int], surface: Sampled) -> None:
    """Draw the pressure, faintly shaded, with its upper left corner at `at` [px]."""
    most = max(surface.pressure_max, 1.0)
    colours = coloured(surface.pressure / most, PRESSURE)
    faint = 0.75 + 0.25 * _shade(surface)
    _paste(page, at, colours * np.minimum(faint, 1.04)[..., None], surface)
    _bar(page, at, surface, PRESSURE, (0.0, most / 1e3), "contact pressure [kPa]")


def _shade(surface: Sampled) -> Array:
    """Brightness of each pixel: 1 where the surface is level."""
    down, right = (np.nan_to_num(slope) for slope in np.gradient(surface.height, surface.pixel))
    steepest = float(np.percentile(np.hypot(down, right), 98)) or 1e-9
    raised = float(np.clip(RELIEF / steepest, 1.0, RAISED_MOST))
    normal = np.stack([-right * raised, down * raised, np.ones_like(right)], axis=-1)
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    light = LIGHT / np.linalg.norm(LIGHT)
    lit: Array = np.clip(0.35 + 0.65 * (normal @ light) / light[2], 0.2, 1.25)
    return lit


def _paste(page: Image.Image, at: tuple[int, int], colours: Array, surface: Sampled) -> None:
    inside = np.isfinite(surface.height)
    pixels = np.where(inside[..., None], np.clip(colours, 0, 255), np.array(PANEL, float))
    pixels[inside & ~binary_erosion(inside)] = RIM
    page.paste(Image.fromarray(np.round(pixels).astype(np.uint8)), at)
    rows, columns = surface.height.shape
    left, bottom = at[0] + 14, at[1] + rows - 16
    length = round_below(0.3 * columns * surface.pixel * 1e3)
    right = left + round(length * 1e-3 / surface.pixel)
    pen = ImageDraw.Draw(page)
    pen.rectangle((left - 7, bottom - 24, right + 7, bottom + 8), PANEL)
    pen.line((left, bottom, right, bottom), INK, 3)
    pen.text(((left + right) / 2, bottom - 5), f"{length:g} mm", INK, font(14), anchor="mb")


def _bar(
    page: Image.Image,
    at: tuple[int, int],
    surface: Sampled,
    scale: Scale,
    limits: tuple[float, float],
    title: str,
) -> None:
    """Draw the title above a map and its colour bar to the right."""
    rows, columns = surface.height.shape
    pen = ImageDraw.Draw(page)
    pen.text((at[0], at[1] - 10), title, INK, font(16), anchor="ls")
    pen.text((at[0] + columns, at[1] - 10), "x right, y up", SOFT, font(13), anchor="rs")
    left = at[0] + columns + BAR_GAP
    shares = np.linspace(1, 0, rows)[:, None].repeat(BAR_WIDTH, axis=1)
    strip = np.round(coloured(shares, scale)).astype(np.uint8)
    page.paste(Image.fromarray(strip), (left, at[1]))
    low, high = limits
    for tick in round_numbers(low, high, 7):
        y = at[1] + (rows - 1) * (high - tick) / (high - low)
        pen.line((left + BAR_WIDTH, y, left + BAR_WIDTH + 4, y), SOFT)
        pen.text((left + BAR_WIDTH + 8, y), f"{tick:g}", SOFT, font(13), anchor="lm")
