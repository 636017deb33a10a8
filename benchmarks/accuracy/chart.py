"""Panels of points on log axes, with one legend below them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from recorder.charts import BAND, chart

if TYPE_CHECKING:
    from recorder.charts import Artist, Axes

# Most panels in a row, and columns of the legend.
COLUMNS = 3
# Width and height of a panel [inch].
PANEL = 2.4, 2.5


@dataclass(frozen=True, slots=True)
class Series:
    """Points of one way on one device."""

    name: str
    colour: str
    style: str
    """Mark and line as matplotlib names them, e.g. `o-`."""
    points: Sequence[tuple[float, float]]
    """In the order in which they are joined."""


@dataclass(frozen=True, slots=True)
class Panel:
    """One case."""

    title: str
    series: Sequence[Series]
    bound: float = math.nan
    """Uncertainty of the reference, below which errors are unknown; NaN: not available."""


def save_chart(path: Path, title: str, panels: Sequence[Panel], x: str, y: str) -> None:
    """Write panels that share both axes, with the labels `x` and `y`, as one picture."""
    columns = min(COLUMNS, len(panels))
    rows = math.ceil(len(panels) / columns)
    with chart(path, PANEL[0] * COLUMNS + 0.4, PANEL[1] * rows + 1.1) as figure:
        figure.suptitle(title, x=0.01, ha="left")
        every: list[Axes] = []
        named: dict[str, Artist] = {}
        for index, panel in enumerate(panels):
            first = every[0] if every else None
            axes = figure.add_subplot(rows, columns, index + 1, sharex=first, sharey=first)
            every.append(axes)
            axes.set(title=panel.title, xscale="log", yscale="log", xlabel=x)
            if index % columns == 0:
                axes.set_ylabel(y)
            for one in panel.series:
                if not one.points:
                    continue
                across, up = zip(*one.points, strict=True)
                (named[one.name],) = axes.plot(
                    across,
                    up,
                    one.style,
                    color=one.colour,
                    clip_on=False,
                )
        low, high = every[0].get_ylim()
        for axes, panel in zip(every, panels, strict=True):
            if panel.bound > low:
                band = axes.axhspan(low, min(panel.bound, high), color=BAND, zorder=0)
                named["below the reference's accuracy"] = band
        every[0].set_ylim(low, high)
        figure.legend(named.values(), named, loc="outside lower left", ncols=COLUMNS)
