"""Line plots of the contact sheet and of presses, and sheets of captioned pictures, by Pillow.

They are drawn on the rig's computer after a recording, without matplotlib: it would add
57 MB to the extra `rig`. All other charts are drawn by `recorder.charts`.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

from recorder.charts import INK, SOFT

Floats = NDArray[np.float64]
Color = tuple[int, int, int]
Font = ImageFont.FreeTypeFont | ImageFont.ImageFont

_GRID: Color = (228, 231, 236)
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
    color: str
    """Colour, such as `recorder.charts.BLUE`."""


# Space around a picture, height of the captions below and of the title above [px].
_GAP, _CAPTION, _HEAD = 12, 42, 36
_ALARM: Color = (220, 60, 50)


@dataclass(frozen=True, slots=True, eq=False)
class Tile:
    """One picture of a sheet."""

    pixels: NDArray[np.uint8]
    """(h, w, 3), RGB; of any size."""
    captions: tuple[str, str]
    """Two lines below it."""
    alarm: bool = False
    """True for a red frame."""


def font(size: int) -> Font:
    """Return the font used in all pictures; `size` in pixels."""
    return ImageFont.load_default(size)


def sheet(
    rows: Sequence[tuple[str, str, Sequence[Tile]]], columns: int, size: tuple[int, int]
) -> Image.Image:
    """Return rows of title, note and pictures; a row without a title follows the one above.

    A row has at most `columns` pictures, each of width and height `size` [px].
    """
    heights = [_HEAD * bool(title) + size[1] + _CAPTION + _GAP for title, _, _ in rows]
    page = Image.new("RGB", (_GAP + columns * (size[0] + _GAP), _GAP + sum(heights)), PAPER)
    pen = ImageDraw.Draw(page)
    top = _GAP
    for (title, note, tiles), height in zip(rows, heights, strict=True):
        pen.text((_GAP, top + 4), title, INK, font(18))
        pen.text((_GAP + 20 + pen.textlength(title, font(18)), top + 7), note, SOFT, font(14))
        under = top + height - _CAPTION - _GAP
        for column, tile in enumerate(tiles):
            left = _GAP + column * (size[0] + _GAP)
            picture = Image.fromarray(tile.pixels).resize(size, Image.Resampling.LANCZOS)
            page.paste(picture, (left, under - size[1]))
            if tile.alarm:
                box = (left, under - size[1], left + size[0] - 1, under - 1)
                pen.rectangle(box, outline=_ALARM, width=3)
            pen.text((left, under + 4), tile.captions[0], _ALARM if tile.alarm else INK, font(14))
            pen.text((left, under + 22), tile.captions[1], SOFT, font(13))
        top += height
    return page


def line_plot(
    size: tuple[int, int],
    x: Floats,
    curves: Sequence[Curve],
    *,
    title: str,
    marks: Floats | tuple[()] = (),
    x_label: str = "",
) -> Image.Image:
    """Return a plot of `size` [px] of curves over a common x (n,), ascending.

    `marks` are positions on x that get a numbered line. Without `x_label` the numbers of the
    abscissa are left out too.
    """
    width, height = size
    left, right, top, bottom = 64, 16, 34, 40 if x_label else 12
    box = (left, top, width - right, height - bottom)
    picture = Image.new("RGB", size, PAPER)
    draw = ImageDraw.Draw(picture)
    draw.rectangle(box, fill=PANEL)
    x_low, x_high = (float(x[0]), float(x[-1])) if len(x) else (0.0, 1.0)
    finite = np.concatenate([np.zeros(1), *(c.values[np.isfinite(c.values)] for c in curves)])
    margin = 0.08 * float(np.ptp(finite)) or 0.5
    y_low, y_high = float(finite.min()) - margin, float(finite.max()) + margin

    def to_x(value: Floats | float) -> Floats:
        return box[0] + (np.asarray(value) - x_low) / max(x_high - x_low, 1e-9) * (box[2] - box[0])

    def to_y(value: Floats | float) -> Floats:
        return box[3] - (np.asarray(value) - y_low) / (y_high - y_low) * (box[3] - box[1])

    for tick in _ticks(y_low, y_high, 4):
        y = float(to_y(tick))
        draw.line((box[0], y, box[2], y), fill=(200, 204, 212) if tick == 0 else _GRID)
        draw.text((left - 8, y), f"{tick:g}", fill=SOFT, font=font(13), anchor="rm")
    for tick in _ticks(x_low, x_high, 10) if x_label else ():
        draw.text((float(to_x(tick)), box[3] + 6), f"{tick:g}", SOFT, font(13), anchor="mt")
    for number, mark in enumerate(marks, 1):
        at = float(to_x(mark))
        draw.line((at, box[1], at, box[3]), fill=(214, 218, 226))
        draw.rounded_rectangle((at - 9, box[1] - 7, at + 9, box[1] + 7), 7, PAPER, _GRID)
        draw.text((at, box[1]), str(number), fill=SOFT, font=font(11), anchor="mm")
    for curve in curves:
        mask = Image.new("L", (width * _SMOOTH, height * _SMOOTH))
        pen = ImageDraw.Draw(mask)
        points = _SMOOTH * np.column_stack([to_x(x), to_y(curve.values)])
        gaps = np.flatnonzero(np.diff(np.isfinite(curve.values))) + 1
        for part in np.split(points, gaps):
            if len(part) > 1 and np.isfinite(part).all():
                pen.line([(a, b) for a, b in part.tolist()], 255, 5, joint="curve")
        picture.paste(curve.color, (0, 0), mask.resize(size, Image.Resampling.BOX))
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


def _ticks(low: float, high: float, about: int) -> list[float]:
    """Return about `about` round numbers inside the limits."""
    raw = (high - low) / about or 1.0
    power = 10.0 ** np.floor(np.log10(raw))
    step = float(min(power * np.array([1, 2, 5, 10]), key=lambda s: abs(s - raw)))
    first = int(np.ceil(low / step))
    return [round(k * step, 10) for k in range(first, int(np.floor(high / step)) + 1)]
