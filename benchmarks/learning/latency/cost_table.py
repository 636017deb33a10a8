"""Table of the cost of a step, and a plot of accuracy against time."""

from __future__ import annotations

import csv
from collections.abc import Sequence
from dataclasses import asdict, fields
from pathlib import Path

from benchmarks.learning.latency.costs import Cost
from recorder.charts import SOFT, chart
from recorder.pages import render

# Target rate of a live model.
LIVE_HZ = 60
MARKS = {"fp32": "o", "bf16": "s"}


def markdown(rows: Sequence[Cost]) -> str:
    """Return the table in Markdown."""
    return render(Path(__file__).with_suffix(".md"), rows=rows)


def write_csv(rows: Sequence[Cost], path: Path) -> None:
    """Write the table as CSV, with empty cells for unknown values."""
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, [column.name for column in fields(Cost)])
        writer.writeheader()
        writer.writerows(asdict(row) for row in rows)


def draw(rows: Sequence[Cost], path: Path) -> None:
    """Plot accuracy against time; without labels, the difference from fp32 against time."""
    labelled = any(row.mae_n is not None for row in rows)
    runtimes = sorted({row.runtime for row in rows})
    models = list(dict.fromkeys(row.model for row in rows))
    with chart(path, 9, 3.6) as figure:
        every = figure.subplots(1, len(runtimes), sharex=True, sharey=True, squeeze=False)[0]
        for axes, runtime in zip(every, runtimes, strict=True):
            for row in rows:
                height = row.mae_n if labelled else row.difference_n
                if row.runtime == runtime and row.p50_ms is not None and height is not None:
                    colour = f"C{models.index(row.model)}"
                    axes.plot(row.p50_ms, height, MARKS[row.precision], color=colour)
            live = axes.axvline(1e3 / LIVE_HZ, color=SOFT, linestyle=":")
            axes.set(title=runtime, xscale="log", xlabel="time of a frame, median [ms]")
        every[0].set_ylabel(
            "mean absolute error [N]" if labelled else "largest difference from fp32 [N]"
        )
        axes = every[0]
        named = [axes.plot([], [], "o", color=f"C{k}")[0] for k in range(len(models))]
        named += [axes.plot([], [], mark, color=SOFT)[0] for mark in MARKS.values()]
        names = (*models, *MARKS, f"{LIVE_HZ} Hz")
        figure.legend([*named, live], names, loc="outside right upper")
