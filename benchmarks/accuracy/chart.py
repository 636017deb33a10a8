"""Small multiples of error against seconds on log axes."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from recorder.charts import BAND, chart

if TYPE_CHECKING:
    from recorder.charts import Artist, Axes

# Marks as matplotlib names them: disc, diamond, triangle to the left.
Mark = Literal["o", "D", "<"]

# Most panels in a row, and the columns of the legend.
COLUMNS, LEGEND = 3, 3
# Width and height of a panel [inch].
PANEL = 2.4, 2.5


@dataclass(frozen=True, slots=True)
class Series:
    """Points of one ladder on one device, from coarse to fine."""

    name: str
    colour: str
    mark: Mark
    points: tuple[tuple[float, float], ...]
    """(seconds, value); 0 seconds is drawn at the left edge."""
    joined: bool = True
    """True if a line joins the points."""


@dataclass(frozen=True, slots=True)
class Panel:
    """One case."""

    title: str
    series: tuple[Series, ...]
    bound: float = math.nan
    """Uncertainty of the reference, below which errors are unknown; NaN: not available."""


def save_chart(
    path: Path, title: str, panels: Sequence[Panel], value_label: str, *, note: str
) -> None:
    """Write the panels and, below them, their legend as one picture.

    Args:
        path: Path of the picture.
        title: Title of the picture.
        panels: Cases, which share both axes.
        value_label: Label of the vertical axis, with its unit.
        note: Line below the title.
    """
    columns = min(COLUMNS, len(panels))
    rows = math.ceil(len(panels) / columns)
    with chart(path, PANEL[0] * max(columns, LEGEND) + 0.4, PANEL[1] * rows + 1.1) as figure:
        figure.suptitle(f"{title}\n{note}", x=0.01, ha="left")
        every: list[Axes] = []
        named: dict[str, Artist] = {}
        for index, panel in enumerate(panels):
            first = every[0] if every else None
            axes = figure.add_subplot(rows, columns, index + 1, sharex=first, sharey=first)
            every.append(axes)
            axes.set(title=panel.title, xscale="log", yscale="log", xlabel="time [s]")
            if index % columns == 0:
                axes.set_ylabel(value_label)
            for one in panel.series:
                points = [(x, y) for x, y in one.points if y > 0]
                if not points:
                    continue
                seconds, values = zip(*points, strict=True)
                timed = axes.transData if any(seconds) else axes.get_yaxis_transform()
                (named[one.name],) = axes.plot(
                    seconds,
                    values,
                    color=one.colour,
                    marker=one.mark,
                    linestyle="-" if one.joined else "",
                    transform=timed,
                    clip_on=False,
                )
        low, high = every[0].get_ylim()
        for axes, panel in zip(every, panels, strict=True):
            if panel.bound > low:
                band = axes.axhspan(low, min(panel.bound, high), color=BAND, zorder=0)
                named["below the reference's accuracy"] = band
        every[0].set_ylim(low, high)
        figure.legend(named.values(), named, loc="outside lower left", ncols=LEGEND)
