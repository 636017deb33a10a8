"""Small multiples of error, or memory, against seconds on log axes, drawn with Pillow."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from PIL import Image, ImageDraw

from recorder.plot import GRID, INK, PANEL, PAPER, SOFT, font

Colour = tuple[int, int, int]
Mark = Literal["disc", "diamond", "left"]

COLUMNS = 4
PANEL_WIDTH, PANEL_HEIGHT = 330, 290
LEFT, RIGHT, TOP, BOTTOM = 58, 12, 34, 36
HEAD = 56
# Supersampling factor: drawn at this scale, then reduced, because Pillow's lines are jagged.
SMOOTH = 2
BAND: Colour = (226, 229, 235)


@dataclass(frozen=True, slots=True)
class Series:
    """Points of one ladder on one device, from coarse to fine."""

    name: str
    colour: Colour
    mark: Mark
    points: tuple[tuple[float, float], ...]
    """(seconds, value); 0 seconds is drawn at the left edge."""
    reach: tuple[float, ...] = ()
    """Upper end of the whisker of each point; empty: no whiskers."""


@dataclass(frozen=True, slots=True)
class Panel:
    """One case."""

    title: str
    series: tuple[Series, ...]
    bound: float = math.nan
    """Uncertainty of the reference, below which errors are unknown; NaN: not available."""


@dataclass(frozen=True, slots=True)
class Scale:
    """Logarithmic axis in pixels."""

    low: float
    high: float
    start: float
    end: float

    def __call__(self, value: float) -> float:
        """Return the pixel of a value; values beyond the axis are clipped to its end."""
        inside = min(max(value, self.low), self.high)
        share = math.log(inside / self.low) / math.log(self.high / self.low)
        return self.start + share * (self.end - self.start)


def save_chart(
    path: Path, title: str, panels: Sequence[Panel], value_label: str, *, note: str
) -> None:
    """Write the panels and, after the last one, their legend as one PNG.

    Args:
        path: Path of the picture.
        title: Title of the picture.
        panels: Cases, which share both axes.
        value_label: Label of the vertical axis, with its unit.
        note: Line below the title.
    """
    rows = math.ceil((len(panels) + 1) / COLUMNS)
    size = COLUMNS * PANEL_WIDTH, HEAD + rows * PANEL_HEIGHT
    page = Image.new("RGB", (size[0] * SMOOTH, size[1] * SMOOTH), PAPER)
    pen = ImageDraw.Draw(page)
    _text(pen, (LEFT, 26), title, INK, 20, "ls")
    _text(pen, (LEFT, 46), note, SOFT, 13, "ls")
    times = [x for panel in panels for one in panel.series for x, _y in one.points if x > 0]
    values = [y for panel in panels for one in panel.series for _x, y in one.points if y > 0]
    limits = _decades(times), _decades(values)
    for index, panel in enumerate(panels):
        corner = index % COLUMNS * PANEL_WIDTH, HEAD + index // COLUMNS * PANEL_HEIGHT
        first = index % COLUMNS == 0
        _panel(pen, corner, panel, limits, value_label if first else "")
    last = len(panels)
    _legend(pen, (last % COLUMNS * PANEL_WIDTH, HEAD + last // COLUMNS * PANEL_HEIGHT), panels)
    path.parent.mkdir(parents=True, exist_ok=True)
    page.resize(size, Image.Resampling.LANCZOS).save(path, "PNG", optimize=True)


def _panel(
    pen: ImageDraw.ImageDraw,
    corner: tuple[int, int],
    panel: Panel,
    limits: tuple[tuple[float, float], tuple[float, float]],
    value_label: str,
) -> None:
    left, top = corner[0] + LEFT, corner[1] + TOP
    right, bottom = corner[0] + PANEL_WIDTH - RIGHT, corner[1] + PANEL_HEIGHT - BOTTOM
    to_x = Scale(*limits[0], left + 8, right)
    to_y = Scale(*limits[1], bottom, top)
    _box(pen, (left, top, right, bottom), PANEL)
    if math.isfinite(panel.bound) and panel.bound > limits[1][0]:
        _box(pen, (left, to_y(panel.bound), right, bottom), BAND)
        _text(pen, (right - 4, bottom - 4), "below the reference's accuracy", SOFT, 11, "rs")
    for tick in _powers(*limits[0]):
        x = to_x(tick)
        _line(pen, [(x, top), (x, bottom)], GRID, 1)
        _text(pen, (x, bottom + 5), _power_text(tick), SOFT, 12, "mt")
    for tick in _powers(*limits[1]):
        y = to_y(tick)
        _line(pen, [(left, y), (right, y)], GRID, 1)
        _text(pen, (left - 6, y), _power_text(tick), SOFT, 12, "rm")
    _text(pen, (left, top - 10), panel.title, INK, 14, "ls")
    _text(pen, (right, bottom + 33), "seconds", SOFT, 12, "rs")
    if value_label:
        _text(pen, (left, bottom + 33), value_label, SOFT, 12, "ls")
    for series in panel.series:
        places = [(to_x(x) if x > 0 else left, to_y(y)) for x, y in series.points if y > 0]
        if len(places) > 1:
            _line(pen, places, series.colour, 2)
        for (x, y), reach in zip(places, series.reach, strict=False):
            if math.isfinite(reach) and reach > 0:
                _line(pen, [(x, y), (x, to_y(reach))], series.colour, 1)
        for place in places:
            _mark(pen, place, series.colour, series.mark)


def _legend(pen: ImageDraw.ImageDraw, corner: tuple[int, int], panels: Sequence[Panel]) -> None:
    known: dict[str, Series] = {}
    for panel in panels:
        for one in panel.series:
            known.setdefault(one.name, one)
    x, y = corner[0] + LEFT + 10, corner[1] + TOP + 14
    for one in known.values():
        if one.mark != "left":
            _line(pen, [(x - 12, y), (x + 12, y)], one.colour, 2)
        _mark(pen, (x, y), one.colour, one.mark)
        _text(pen, (x + 22, y), one.name, INK, 13, "lm")
        y += 22


def _mark(pen: ImageDraw.ImageDraw, place: tuple[float, float], colour: Colour, mark: Mark) -> None:
    x, y = (value * SMOOTH for value in place)
    size = 4.5 * SMOOTH
    if mark == "disc":
        pen.ellipse((x - size, y - size, x + size, y + size), colour, PAPER, SMOOTH)
        return
    if mark == "diamond":
        corners = [(x - 6 * SMOOTH, y), (x, y - 6 * SMOOTH), (x + 6 * SMOOTH, y)]
        corners.append((x, y + 6 * SMOOTH))
    else:
        corners = [(x - size, y), (x + size, y - size), (x + size, y + size)]
    pen.polygon(corners, colour, PAPER, SMOOTH)


def _decades(values: Sequence[float]) -> tuple[float, float]:
    """Return powers of ten around the values, spanning at least one decade."""
    if not values:
        return 0.1, 1.0
    low = 10.0 ** math.floor(math.log10(min(values)) + 1e-9)
    high = 10.0 ** math.ceil(math.log10(max(values)) - 1e-9)
    return low, max(high, 10 * low)


def _powers(low: float, high: float) -> list[float]:
    first, last = round(math.log10(low)), round(math.log10(high))
    return [10.0**power for power in range(first, last + 1)]


def _power_text(value: float) -> str:
    return f"{value:g}" if 1e-4 <= value < 1e5 else f"{value:.0e}".replace("e-0", "e-")


def _text(
    pen: ImageDraw.ImageDraw,
    place: tuple[float, float],
    text: str,
    colour: Colour,
    size: int,
    anchor: str,
) -> None:
    at = place[0] * SMOOTH, place[1] * SMOOTH
    pen.text(at, text, colour, font(size * SMOOTH), anchor=anchor)


def _line(
    pen: ImageDraw.ImageDraw,
    places: Sequence[tuple[float, float]],
    colour: Colour,
    width: int,
) -> None:
    pen.line([(x * SMOOTH, y * SMOOTH) for x, y in places], colour, width * SMOOTH, joint="curve")


def _box(pen: ImageDraw.ImageDraw, box: tuple[float, float, float, float], fill: Colour) -> None:
    pen.rectangle(tuple(value * SMOOTH for value in box), fill)
