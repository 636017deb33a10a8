"""The page's two charts, drawn with Pillow: stores as bars, alignment error against time."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from PIL import Image, ImageDraw

from recorder.plot import GRID, INK, PANEL, PAPER, SOFT, Color, font

OURS: Color = (46, 125, 180)
OTHERS: Color = (178, 186, 198)
_BAR, _GAP, _LABEL = 20, 10, 330
_DOT, _LINE = 6.0, 16.0
Box = tuple[float, float, float, float]


@dataclass(frozen=True, slots=True)
class Bar:
    """One row of a bar chart."""

    name: str
    values: tuple[float, ...]
    """One value per panel; NaN draws no bar."""
    ours: bool


@dataclass(frozen=True, slots=True)
class Point:
    """One point of a scatter."""

    name: str
    x: float
    y: float
    color: Color


def bars(rows: Sequence[Bar], panels: Sequence[str], *, width: int = 1180) -> Image.Image:
    """Draw horizontal bars on a logarithmic scale from 1, with one panel per value of a row.

    Args:
        rows: Rows from the top.
        panels: Title of each panel, with its unit.
        width: Width of the picture [px].
    """
    top, across = 52, (width - _LABEL - 20) // len(panels)
    height = top + len(rows) * (_BAR + _GAP) + 14
    picture = Image.new("RGB", (width, height), PAPER)
    draw = ImageDraw.Draw(picture)
    known = [v for row in rows for v in row.values if np.isfinite(v) and v > 0]
    decades = max(int(np.ceil(np.log10(max([*known, 10.0])))), 1)
    for number, title in enumerate(panels):
        left = _LABEL + number * across
        right = left + across - 90
        draw.text((left, 8), title, INK, font(16))
        draw.rectangle((left, top - 8, right, height - 10), fill=PANEL)
        for decade in range(decades + 1):
            x = left + (right - left) * decade / decades
            draw.line((x, top - 8, x, height - 10), fill=GRID)
            draw.text((x, top - 10), f"{10**decade:g}", SOFT, font(11), anchor="mb")
        for place, row in enumerate(rows):
            y = top + place * (_BAR + _GAP)
            value = row.values[number]
            if not np.isfinite(value) or value <= 0:
                draw.text((left + 6, y + _BAR / 2), "not measured", SOFT, font(12), anchor="lm")
                continue
            end = left + (right - left) * max(np.log10(max(value, 1.0)) / decades, 0.004)
            draw.rectangle((left, y, end, y + _BAR), fill=OURS if row.ours else OTHERS)
            draw.text((end + 6, y + _BAR / 2), f"{value:,.0f}", INK, font(13), anchor="lm")
    for place, row in enumerate(rows):
        middle = top + place * (_BAR + _GAP) + _BAR / 2
        draw.text((_LABEL - 10, middle), row.name, INK, font(14), anchor="rm")
    return picture


def scatter(
    points: Sequence[Point],
    *,
    title: str,
    x_label: str,
    y_label: str,
    size: tuple[int, int] = (580, 380),
) -> Image.Image:
    """Draw named points over two logarithmic axes.

    Args:
        points: Points; those not above zero are skipped.
        title: Title of the chart.
        x_label: Abscissa with its unit.
        y_label: Ordinate with its unit.
        size: Width and height [px].
    """
    width, height = size
    box = (66, 56, width - 24, height - 52)
    picture = Image.new("RGB", size, PAPER)
    draw = ImageDraw.Draw(picture)
    draw.text((box[0], 10), title, INK, font(16))
    draw.text((box[0], 32), y_label, SOFT, font(13))
    draw.text((box[2], height - 8), x_label, SOFT, font(13), anchor="rs")
    draw.rectangle(box, fill=PANEL)
    shown = [point for point in points if point.x > 0 and point.y > 0]
    x_low, x_high = _decades([point.x for point in shown])
    y_low, y_high = _decades([point.y for point in shown])

    def at(value: float, low: float, high: float, start: float, end: float) -> float:
        return start + (float(np.log10(value)) - low) / (high - low) * (end - start)

    for decade in np.arange(np.ceil(x_low), np.floor(x_high) + 1):
        x = at(10.0**decade, x_low, x_high, box[0], box[2])
        draw.line((x, box[1], x, box[3]), fill=GRID)
        draw.text((x, box[3] + 6), f"{10.0**decade:g}", SOFT, font(12), anchor="mt")
    for decade in np.arange(np.ceil(y_low), np.floor(y_high) + 1):
        y = at(10.0**decade, y_low, y_high, box[3], box[1])
        draw.line((box[0], y, box[2], y), fill=GRID)
        draw.text((box[0] - 6, y), f"{10.0**decade:g}", SOFT, font(12), anchor="rm")
    dots = [
        (at(p.x, x_low, x_high, box[0], box[2]), at(p.y, y_low, y_high, box[3], box[1]))
        for p in shown
    ]
    for point, (x, y) in zip(shown, dots, strict=True):
        draw.ellipse((x - _DOT, y - _DOT, x + _DOT, y + _DOT), fill=point.color)
    taken = [(x - _DOT, y - _DOT, x + _DOT, y + _DOT) for x, y in dots]
    for point, (x, y) in zip(shown, dots, strict=True):
        place = _free_place(draw.textlength(point.name, font(13)), x, y, box, taken)
        taken.append(place)
        draw.text(place[:2], point.name, INK, font(13))
    return picture


def beside(pictures: Sequence[Image.Image]) -> Image.Image:
    """Join pictures of equal height side by side."""
    width = sum(picture.width for picture in pictures)
    joined = Image.new("RGB", (width, max(picture.height for picture in pictures)), PAPER)
    left = 0
    for picture in pictures:
        joined.paste(picture, (left, 0))
        left += picture.width
    return joined


def _free_place(width: float, x: float, y: float, inside: Box, taken: Sequence[Box]) -> Box:
    """Return the first box next to, above or below a point in which its name overlaps nothing."""
    for down in (0.0, -20.0, 20.0, -36.0, 36.0, -52.0, 52.0):
        for left in (x + 11, x - 11 - width, x - width / 2 if down else x + 11):
            top = y - _LINE / 2 + down
            place = (left, top, left + width, top + _LINE)
            within = inside[0] <= left and place[2] <= inside[2]
            within = within and inside[1] <= top and place[3] <= inside[3]
            if within and not any(_overlap(place, other) for other in taken):
                return place
    return (x + 11, y - _LINE / 2, x + 11 + width, y + _LINE / 2)


def _overlap(a: Box, b: Box) -> bool:
    return a[0] < b[2] and b[0] < a[2] and a[1] < b[3] and b[1] < a[3]


def _decades(values: Sequence[float]) -> tuple[float, float]:
    """Return limits as powers of ten that include all values and span at least one decade."""
    logs = np.log10(np.array(values)) if values else np.zeros(1)
    low, high = float(np.floor(logs.min())), float(np.ceil(logs.max()))
    return low, max(high, low + 1.0)
