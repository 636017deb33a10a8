"""Table of the cost of a step, and a plot of accuracy against time."""

from __future__ import annotations

import csv
from collections.abc import Sequence
from dataclasses import asdict, fields
from pathlib import Path

from benchmarks.learning.latency.costs import Cost
from recorder.pages import render

# Target rate of a live model.
LIVE_HZ = 60


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
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    labelled = any(row.mae_n is not None for row in rows)
    figure, axes = pyplot.subplots(figsize=(8, 5), layout="constrained")
    markers = dict(zip(("fp32", "bf16", "int8"), "os^", strict=True))
    runtimes = sorted({row.runtime for row in rows})
    for row in rows:
        height = row.mae_n if labelled else row.difference_n
        if row.p50_ms is None or height is None:
            continue
        colour = f"C{runtimes.index(row.runtime)}"
        axes.plot(row.p50_ms, height, markers[row.precision], color=colour)
        axes.annotate(f" {row.model}", (row.p50_ms, height), fontsize=7, va="bottom", color=colour)
    for number, runtime in enumerate(runtimes):
        axes.plot([], [], "o", color=f"C{number}", label=runtime)
    for precision, marker in markers.items():
        axes.plot([], [], marker, color="grey", label=precision)
    axes.axvline(1e3 / LIVE_HZ, color="grey", linestyle=":", linewidth=1)
    axes.text(1e3 / LIVE_HZ, axes.get_ylim()[1], f"{LIVE_HZ} Hz ", ha="right", va="top", fontsize=8)
    axes.set_xscale("log")
    axes.set_xlabel("time of a frame, median [ms]")
    axes.set_ylabel("mean absolute error [N]" if labelled else "largest difference from fp32 [N]")
    axes.legend(fontsize=8)
    figure.savefig(path, dpi=150)
    pyplot.close(figure)
