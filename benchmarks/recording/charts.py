"""The page's two charts: stores as bars, alignment error against time."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

from benchmarks.recording.alignment import Alignment
from benchmarks.recording.store_benchmark import StoreRow
from recorder.charts import BLUE, SKY, chart

_PANELS = (("force", "N", "Force label"), ("pose", "deg", "Orientation label"))
_MARKS = "osD^vP"


def stores_chart(path: Path, rows: Sequence[StoreRow]) -> None:
    """Plot frames per CPU-second written and read, one bar each on a logarithmic scale from 1."""
    written = [0.0 if row.write is None else row.rate_cpu for row in rows]
    panels = (
        ("written and closed [frames per CPU-second]", written),
        ("random windows of 16 [images per CPU-second]", [row.read_cpu for row in rows]),
    )
    with chart(path, 9, 0.8 + 0.23 * len(rows)) as figure:
        every = figure.subplots(1, 2, sharey=True)
        for axes, (title, values) in zip(every, panels, strict=True):
            bars = axes.barh(
                [row.title.replace("*", "").replace("`", "") for row in rows],
                [max(value, 1) for value in values],
                color=[BLUE if row.key.startswith("ours") else SKY for row in rows],
            )
            labels = [f"{value:,.0f}" if value > 0 else "not measured" for value in values]
            axes.bar_label(bars, labels, padding=3, fontsize="small")
            axes.set(xlabel=title, xscale="log", xlim=(1, 6 * max(*values, 10)))
            axes.grid(visible=False, axis="y")
            axes.margins(y=0.01)
        every[0].invert_yaxis()


def alignment_chart(path: Path, found: Alignment) -> None:
    """Plot error against time per window: force in N, and orientation in degrees."""
    with chart(path, 9, 3) as figure:
        for axes, (stream, unit, title) in zip(figure.subplots(1, 2), _PANELS, strict=True):
            methods = [one for one in found.methods if one.stream == stream and unit in one.errors]
            for mark, one in zip(_MARKS, methods, strict=False):
                took, error = 1e6 * one.per_window, one.errors[unit].rms
                if math.isfinite(took) and error > 0:
                    axes.plot(took, error, mark, label=one.method)
            axes.set(title=title, xscale="log", yscale="log")
            axes.set(xlabel="time of a window of 16 [us]", ylabel=f"error rms [{unit}]")
            axes.legend(loc="upper left", bbox_to_anchor=(1, 1))
