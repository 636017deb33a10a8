"""Charts of the report, one function each, as PNG bytes."""

from __future__ import annotations

import io
import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from learning.evaluation.predictions import AXES_NAMED, ForceRow, Predictions, variant_name
from recorder.strict_yaml import natural_key

Floats = NDArray[np.float64]

# Colours of Fx, Fy, Fz and Ft, and of domains.
COLOURS = ("#3b6fb6", "#d9822b", "#3f9b6b", "#b0413e")
TRUE_COLOUR = "#2b2f38"
_DPI = 90
_TEXT = {"fontsize": 8}


def radar(before: Sequence[ForceRow], after: Sequence[ForceRow], names: tuple[str, str]) -> bytes:
    """Draw radar plots of the errors of all pairs: all axes above, shear alone below.

    Plots side by side have the same scale, so that a smaller star is a smaller error.

    Args:
        before: A row for each pair, source-only.
        after: A row for each pair, transferred.
        names: Names of the two columns.
    """
    figure = Figure(figsize=(9, 8.4), layout="constrained")
    for line, axes_shown in enumerate(((0, 1, 2, 3), (0, 1))):
        largest = max(row.errors.mae[place] for row in (*before, *after) for place in axes_shown)
        for column, (rows, name) in enumerate(zip((before, after), names, strict=True)):
            if not rows:
                continue
            axes: Any = figure.add_subplot(2, 2, 2 * line + column + 1, projection="polar")
            angles = np.linspace(0, 2 * math.pi, len(rows), endpoint=False)
            closed = np.append(angles, angles[:1])
            for place in axes_shown:
                values = np.array([row.errors.mae[place] for row in rows])
                axes.plot(
                    closed,
                    np.append(values, values[:1]),
                    color=COLOURS[place],
                    label=AXES_NAMED[place],
                    marker=".",
                )
            axes.set_xticks(angles, [f"{row.source}\nto {row.target}" for row in rows], fontsize=6)
            axes.set_ylim(0, 1.05 * largest or 1)
            axes.tick_params(axis="y", labelsize=7)
            axes.set_title(f"{name}: mean absolute error [N]", **_TEXT)
            axes.legend(loc="lower left", bbox_to_anchor=(-0.15, -0.12), fontsize=7)
    return _png(figure)


def heatmaps(
    by_variant: Mapping[tuple[str, str], Sequence[ForceRow]], measure: str, title: str, good: str
) -> bytes:
    """Draw a heat map of source against target for each variant, with a common scale.

    Args:
        by_variant: A row for each pair, by method and translator.
        measure: One of `predictions.MEASURES`.
        title: Name of the measure, with its unit.
        good: `low` or `high`: the good end of the scale.
    """
    rows = [row for some in by_variant.values() for row in some]
    names = sorted({name for row in rows for name in (row.source, row.target)}, key=natural_key)
    values = np.array([row.value(measure) for row in rows])
    top = float(np.nanmax(values, initial=1e-9)) if good == "low" else 1.0
    colours = "RdYlGn_r" if good == "low" else "RdYlGn"
    side = 1.2 + 0.5 * len(names)
    figure = Figure(
        figsize=(max(side * len(by_variant), 3.2) + 0.6, side + 0.3), layout="constrained"
    )
    for place, (variant, some) in enumerate(by_variant.items()):
        axes: Any = figure.add_subplot(1, len(by_variant), place + 1)
        grid = np.full((len(names), len(names)), np.nan)
        for row in some:
            grid[names.index(row.source), names.index(row.target)] = row.value(measure)
        image = axes.imshow(grid, cmap=colours, vmin=0, vmax=top)
        for (line, column), value in np.ndenumerate(grid):
            if np.isfinite(value):
                ink = "white" if abs(value / top - 0.5) > 0.4 else TRUE_COLOUR  # both ends are dark
                axes.text(
                    column, line, f"{value:.2f}", ha="center", va="center", fontsize=7, color=ink
                )
        axes.set_xticks(range(len(names)), names, rotation=90, fontsize=7)
        axes.set_yticks(range(len(names)), names, fontsize=7)
        axes.set_xlabel("target", **_TEXT)
        axes.set_ylabel("source", **_TEXT)
        axes.set_title(variant_name(variant), **_TEXT)
    # R2 below 0 is worse than the mean of the labels, and has the colour of 0.
    extended = "neither" if good == "low" else "min"
    figure.colorbar(image, ax=figure.axes, shrink=0.8, extend=extended).ax.tick_params(labelsize=7)
    figure.suptitle(title, fontsize=9)
    return _png(figure)


def sequences(shown: Sequence[Predictions], presses: int, seed: int) -> bytes:
    """Plot true and predicted forces of some whole presses, one after another.

    Args:
        shown: Predictions of one pair, before and after; all show the same presses.
        presses: Number of presses.
        seed: Seed of their choice.
    """
    different = np.unique(np.concatenate([one.location for one in shown]))
    for one in shown:
        different = np.intersect1d(different, one.location)
    chosen = np.random.default_rng(seed).permutation(different)[:presses]
    figure = Figure(figsize=(11, 5), layout="constrained")
    for axis in range(3):
        axes: Any = figure.add_subplot(3, 1, axis + 1)
        for place, one in enumerate(shown):
            rows = _of_presses(one, chosen)
            if place == 0:
                axes.plot(one.true[rows, axis], color=TRUE_COLOUR, lw=1.6, label="true")
                for end in np.flatnonzero(np.diff(one.location[rows])):
                    axes.axvline(end + 0.5, color="#e2e5ea", lw=0.6, zorder=0)
            name = variant_name((one.method, one.translator))
            axes.plot(one.predicted[rows, axis], color=COLOURS[place % 4], lw=1, label=name)
        axes.set_ylabel(f"{AXES_NAMED[axis]} [N]", **_TEXT)
        axes.tick_params(labelsize=7)
        if axis == 0:
            axes.legend(fontsize=7, ncols=4, loc="lower right", bbox_to_anchor=(1, 1))
    axes.set_xlabel("frame, presses one behind the other", **_TEXT)
    return _png(figure)


def embeddings(
    panels: Sequence[tuple[str, Floats, Floats]], columns: int, names: Sequence[tuple[str, str]]
) -> bytes:
    """Plot features of two sets on a plane, a panel for each pair.

    Args:
        panels: Title, and points of both sets (n, 2), (m, 2).
        columns: Number of panels in a row.
        names: Names of the two sets of each panel.
    """
    rows = -(-len(panels) // columns)
    figure = Figure(figsize=(3.2 * columns, 3.2 * rows), layout="constrained")
    for place, ((title, one, other), message) in enumerate(zip(panels, names, strict=True)):
        axes: Any = figure.add_subplot(rows, columns, place + 1)
        for places, name, colour in zip((one, other), message, COLOURS, strict=False):
            axes.scatter(places[:, 0], places[:, 1], s=7, color=colour, alpha=0.7, label=name)
        axes.set_title(title, **_TEXT)
        axes.set_xticks([])
        axes.set_yticks([])
        axes.legend(fontsize=6)
    return _png(figure)


def _of_presses(one: Predictions, locations: NDArray[Any]) -> NDArray[np.int64]:
    """Return the indices of the frames of some presses, ordered by press and time."""
    parts = [np.flatnonzero(one.location == location) for location in locations]
    ordered = [part[np.argsort(one.frame[part], kind="stable")] for part in parts]
    return np.concatenate([np.empty(0, np.int64), *ordered])


def _png(figure: Figure) -> bytes:
    buffer = io.BytesIO()
    # Without a version string, equal images are equal bytes.
    figure.savefig(buffer, format="png", dpi=_DPI, metadata={"Software": None})
    return buffer.getvalue()
