"""Line plots and taxel pictures, using only Pillow."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

Floats = NDArray[np.float64]
Color = tuple[int, int, int]
Font = ImageFont.FreeTypeFont | ImageFont.ImageFont

INK: Color = (38, 42, 51)
SOFT: Color = (120, 127, 140)
GRID: Color = (228, 231, 236)
PAPER: Color = (255, 255, 255)
PANEL: Color = (247, 248, 250)

_SMOOTH = 3  # supersampling factor, since Pillow does not anti-alias lines


@dataclass(frozen=True, slots=True)
class Curve:
    """One curve of a plot."""

    name: str
    """Name in the legend; left out of it if empty."""
    values: Floats
    """Values (n,); NaN leaves a gap."""
    color: Color
    """Colour of the curve."""


def font(size: int) -> Font:
    """Return the font used in all pictures; `size` in pixels."""
    return ImageFont.load_default(size)


def line_plot(
    size: tuple[int, int],
    x: Floats,
    curves: Sequence[Curve],
    *,
    title: str,
    marks: Floats,
    x_label: str = "",
) -> Image.Image:
    """Return a plot of curves over a common x.

    Args:
        size: Width and height [px].
        x: Abscissa (n,), ascending.
        curves: Lines, each with n values.
        title: Quantity plotted, with its unit.
        marks: Positions on x that get a numbered line.
        x_label: Name of the abscissa; if empty, its numbers are left out too.
    """
    width, height = size
    left, right, top, bottom = 64, 16, 34, 40 if x_label else 12
    box = (left, top, width - right, height - bottom)
    picture = Image.new("RGB", size, PAPER)
    draw = ImageDraw.Draw(picture)
    draw.rectangle(box, fill=PANEL)
    x_low, x_high = (float(x[0]), float(x[-1])) if len(x) else (0.0, 1.0)
    y_low, y_high = _limits(curves)

    def to_x(value: Floats | float) -> Floats:
        return box[0] + (np.asarray(value) - x_low) / max(x_high - x_low, 1e-9) * (box[2] - box[0])

    def to_y(value: Floats | float) -> Floats:
        return box[3] - (np.asarray(value) - y_low) / (y_high - y_low) * (box[3] - box[1])

    for tick in _ticks(y_low, y_high, 4):
        y = float(to_y(tick))
        draw.line((box[0], y, box[2], y), fill=(200, 204, 212) if tick == 0 else GRID)
        draw.text((left - 8, y), f"{tick:g}", fill=SOFT, font=font(13), anchor="rm")
    for tick in _ticks(x_low, x_high, 10) if x_label else ():
        draw.text((float(to_x(tick)), box[3] + 6), f"{tick:g}", SOFT, font(13), anchor="mt")
    for number, mark in enumerate(marks, 1):
        at = float(to_x(mark))
        draw.line((at, box[1], at, box[3]), fill=(214, 218, 226))
        draw.rounded_rectangle((at - 9, box[1] - 7, at + 9, box[1] + 7), 7, PAPER, GRID)
        draw.text((at, box[1]), str(number), fill=SOFT, font=font(11), anchor="mm")
    lines = Image.new("L", (width * _SMOOTH, height * _SMOOTH))
    for curve in curves:
        lines.paste(0, (0, 0, *lines.size))
        pen = ImageDraw.Draw(lines)
        for part in _parts(to_x(x), to_y(curve.values), box[2] - box[0]):
            pen.line([(a * _SMOOTH, b * _SMOOTH) for a, b in part], 255, 5, joint="curve")
        mask = lines.resize(size, Image.Resampling.BOX)
        picture.paste(curve.color, (0, 0), mask)
    draw.text((left, top - 10), title, fill=INK, font=font(15), anchor="ls")
    at = float(width - right)
    named = [curve for curve in curves if curve.name]
    for curve in reversed(named) if len(named) > 1 else ():
        at -= draw.textlength(curve.name, font(14))
        draw.text((at, top - 10), curve.name, fill=INK, font=font(14), anchor="ls")
        draw.rounded_rectangle((at - 24, top - 17, at - 8, top - 13), 2, fill=curve.color)
        at -= 44
    if x_label:
        draw.text((width - right, height - 4), x_label, fill=SOFT, font=font(13), anchor="rs")
    return picture


def taxel_picture(size: tuple[int, int], change: Floats, full_scale: float) -> Image.Image:
    """Return a 4x4 taxel pad as discs: shifted by shear, larger and warmer under pressure.

    Args:
        size: Width and height [px].
        change: Counts x y z relative to rest (16, 3).
        full_scale: Counts that give the largest displacement and size.
    """
    width, height = size[0] * _SMOOTH, size[1] * _SMOOTH
    picture = Image.new("RGB", (width, height), (30, 34, 42))
    draw = ImageDraw.Draw(picture)
    pitch = min(width, height) / 4.6
    homes = [
        (width / 2 + (column - 1.5) * pitch, height / 2 + (row - 1.5) * pitch)
        for row in range(4)
        for column in range(4)
    ]
    for home in homes:
        draw.ellipse(_disc(*home, pitch * 0.42), outline=(58, 64, 76), width=2 * _SMOOTH)
    for taxel, home in enumerate(homes):
        shift_x, shift_y, press = np.nan_to_num(change[taxel]) / full_scale
        x = home[0] + float(np.clip(shift_x, -1, 1)) * pitch * 0.45
        y = home[1] + float(np.clip(shift_y, -1, 1)) * pitch * 0.45
        strength = float(np.clip(abs(press), 0, 1))
        radius = pitch * (0.14 + 0.26 * strength)
        draw.line((*home, x, y), fill=(120, 130, 148), width=_SMOOTH)
        cool, warm = np.array([92, 148, 196]), np.array([247, 178, 84])
        tone = tuple(int(value) for value in cool + (warm - cool) * strength)
        draw.ellipse(_disc(x, y, radius), fill=tone)
    return picture.resize(size, Image.Resampling.LANCZOS)


def _disc(x: float, y: float, radius: float) -> tuple[float, float, float, float]:
    return (x - radius, y - radius, x + radius, y + radius)


def _limits(curves: Sequence[Curve]) -> tuple[float, float]:
    known = np.concatenate([np.zeros(1), *(c.values[np.isfinite(c.values)] for c in curves)])
    low, high = float(known.min()), float(known.max())
    margin = 0.08 * (high - low) or 0.5
    return low - margin, high + margin


def _ticks(low: float, high: float, about: int) -> list[float]:
    """Return about `about` round numbers inside the limits."""
    raw = (high - low) / about or 1.0
    power = 10.0 ** np.floor(np.log10(raw))
    step = float(min(power * np.array([1, 2, 5, 10]), key=lambda s: abs(s - raw)))
    first = int(np.ceil(low / step))
    return [round(k * step, 10) for k in range(first, int(np.floor(high / step)) + 1)]


def _parts(x: Floats, y: Floats, pixels: int) -> list[list[tuple[float, float]]]:
    """Return the unbroken parts of a line, reduced to extremes per pixel where it is denser."""
    parts: list[list[tuple[float, float]]] = []
    known = np.isfinite(y)
    breaks = np.flatnonzero(np.diff(np.concatenate([[0], known.astype(np.int8), [0]])))
    for start, stop in breaks.reshape(-1, 2):
        xs, ys = x[start:stop], y[start:stop]
        if len(xs) > 2 * pixels:
            groups = np.array_split(np.arange(len(xs)), pixels)
            order = [i for g in groups for i in sorted({g[ys[g].argmin()], g[ys[g].argmax()]})]
            xs, ys = xs[order], ys[order]
        if len(xs) > 1:
            parts.append(list(zip(xs.tolist(), ys.tolist(), strict=True)))
    return parts
