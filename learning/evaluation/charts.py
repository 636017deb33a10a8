"""Charts of the report, one function each, as PNG bytes."""

import io
import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from learning.evaluation.predictions import AXES_NAMED, ForceRow, Predictions, variant_name
from recorder.charts import BAND, FORCES, INK, chart
from recorder.natural_order import natural_key

Floats = NDArray[np.float64]


def radar(before: Sequence[ForceRow], after: Sequence[ForceRow], names: tuple[str, str]) -> bytes:
    """Draw radar plots of all pairs' errors on one scale: all axes above, shear alone below."""
    png = io.BytesIO()
    with chart(png, 9, 8.4) as figure:
        for line, axes_shown in enumerate(((0, 1, 2, 3), (0, 1))):
            every = [row.errors.mae[axis] for row in (*before, *after) for axis in axes_shown]
            largest = max((mae for mae in every if math.isfinite(mae)), default=0.0)
            for column, (rows, name) in enumerate(zip((before, after), names, strict=True)):
                if not rows:
                    continue
                axes: Any = figure.add_subplot(2, 2, 2 * line + column + 1, projection="polar")
                angles = np.linspace(0, 2 * math.pi, len(rows), endpoint=False)
                closed = np.append(angles, angles[:1])
                for axis in axes_shown:
                    values = np.array([row.errors.mae[axis] for row in rows])
                    values = np.append(values, values[:1])
                    color = (*FORCES, INK)[axis]
                    axes.plot(closed, values, label=AXES_NAMED[axis], marker=".", color=color)
                pairs = [f"{row.source}\nto {row.target}" for row in rows]
                axes.set_xticks(angles, pairs, fontsize=6)
                axes.tick_params(axis="x", pad=8)
                axes.set_ylim(0, 1.05 * largest or 1)
                # Few numbers, between two pairs.
                axes.yaxis.get_major_locator().base.set_params(nbins=4)
                axes.set_rlabel_position(180 / len(rows))
                axes.set_title(f"{name}: mean absolute error [N]", loc="center", pad=20)
                axes.legend(loc="lower left", bbox_to_anchor=(-0.15, -0.12))
    return png.getvalue()


def heatmaps(
    by_variant: Mapping[tuple[str, str], Sequence[ForceRow]],
    measure: str,
    title: str,
    good: str,
    *,
    own: Sequence[ForceRow] = (),
) -> bytes:
    """Draw a heat map of source against target for each variant, with a common scale.

    `measure` is one of `predictions.MEASURES`, `good` the end of the scale that is good, `low` or
    `high`; `own` are rows of models from a sensor's own labels, drawn below the pairs.
    """
    rows = [row for some in by_variant.values() for row in some]
    sources = sorted({row.source for row in rows}, key=natural_key)
    targets = sorted({row.target for row in rows}, key=natural_key)
    own = [row for row in own if row.target in targets]
    lines = [*sources, *(["own labels"] if own else [])]
    values = np.array([row.value(measure) for row in (*rows, *own)])
    top = float(np.nanmax(values, initial=1e-9)) if good == "low" else 1.0
    # R2 below 0 is worse than the mean of the labels, and has the colour of 0.
    colours, extended = ("cividis_r", "neither") if good == "low" else ("cividis", "min")
    # Widths of cells and letters [inch]; a panel is as wide as its title.
    cell, letter = max(0.5, 1.3 / len(targets)), 0.08
    below = letter * max(map(len, targets))
    turned = below > cell
    wide = cell * len(targets) * len(by_variant) + letter * max(map(len, lines)) + 1.5
    high = 0.5 * len(lines) + (below if turned else 2 * letter) + 1.1
    png = io.BytesIO()
    with chart(png, wide, high) as figure:
        figure.set_layout_engine("compressed", h_pad=0.1)
        every = figure.subplots(1, len(by_variant), squeeze=False, sharey=True)[0]
        for axes, (variant, some) in zip(every, by_variant.items(), strict=True):
            grid = np.full((len(lines), len(targets)), np.nan)
            for row in some:
                grid[sources.index(row.source), targets.index(row.target)] = row.value(measure)
            for row in own:
                grid[-1, targets.index(row.target)] = row.value(measure)
            image = axes.imshow(grid, cmap=colours, vmin=0, vmax=top, aspect="auto")
            for (line, column), value in np.ndenumerate(grid):
                if np.isfinite(value):
                    dark = (value / top < 0.5) == (good == "high")
                    ink = "white" if dark else INK
                    text = f"{value:.2f}"
                    axes.text(column, line, text, ha="center", va="center", fontsize=7, color=ink)
            if own:
                axes.axhline(len(sources) - 0.5, color=INK, lw=2)
            axes.set_xticks(range(len(targets)), targets, rotation=90 if turned else 0)
            axes.set_yticks(range(len(lines)), lines)
            axes.set(xlabel="target", title=variant_name(variant))
            axes.grid(visible=False)
        every[0].set_ylabel("source")
        figure.colorbar(image, ax=every, shrink=0.8, extend=extended)
        figure.suptitle(title, x=0.01, ha="left")
    return png.getvalue()


def sequences(shown: Sequence[Predictions], presses: int, seed: int) -> bytes:
    """Plot true and predicted forces of some whole presses of one pair, chosen by the seed."""
    different = np.unique(np.concatenate([one.location for one in shown]))
    for one in shown:
        different = np.intersect1d(different, one.location)
    chosen = np.random.default_rng(seed).permutation(different)[:presses]
    png = io.BytesIO()
    with chart(png, 9, 5) as figure:
        every = figure.subplots(3, 1, sharex=True)
        for index, one in enumerate(shown):
            parts = [np.flatnonzero(one.location == location) for location in chosen]
            parts = [part[np.argsort(one.frame[part], kind="stable")] for part in parts]
            rows = np.concatenate([np.empty(0, np.int64), *parts])
            for axis, axes in enumerate(every):
                if index == 0:
                    axes.set_ylabel(f"{AXES_NAMED[axis]} [N]")
                    axes.grid(visible=False, axis="x")
                    axes.plot(one.true[rows, axis], color=INK, label="true")
                    for end in np.flatnonzero(np.diff(one.location[rows])):
                        axes.axvline(end + 0.5, color=BAND, lw=0.6, zorder=0)
                name = variant_name((one.method, one.translator))
                axes.plot(one.predicted[rows, axis], lw=1, label=name)
        every[0].legend(ncols=4, loc="lower right", bbox_to_anchor=(1, 1))
        every[-1].set_xlabel("frame, presses one behind the other")
    return png.getvalue()


def predicted_over_true(shown: Predictions) -> bytes:
    """Plot the predicted over the true forces of each axis, a colour an indenter."""
    true, predicted = shown.true, shown.predicted
    png = io.BytesIO()
    with chart(png, 9, 3.4) as figure:
        for axis, axes in enumerate(figure.subplots(1, 3)):
            known = np.isfinite(true[:, axis] + predicted[:, axis])
            for name in sorted(set(shown.indenter[known].tolist()), key=natural_key):
                own = known & (shown.indenter == name)
                axes.plot(true[own, axis], predicted[own, axis], ".", ms=2, label=name)
            ends = true[known, axis]
            if ends.size:
                axes.plot([ends.min(), ends.max()], [ends.min(), ends.max()], color=INK, lw=0.8)
            axes.set(xlabel=f"true {AXES_NAMED[axis]} [N]", aspect="equal", adjustable="datalim")
        figure.axes[0].set_ylabel("predicted [N]")
        named = [axes for axes in figure.axes if axes.get_legend_handles_labels()[0]]
        for axes in named[:1]:  # of the first axis that is measured
            axes.legend(fontsize=6, markerscale=4)
    return png.getvalue()


def embeddings(
    panels: Sequence[tuple[str, Floats, Floats]], columns: int, names: Sequence[tuple[str, str]]
) -> bytes:
    """Plot features of two sets on a plane, a panel for each pair.

    A panel has a title and the points of both sets (n, 2), (m, 2), which `names` gives the names
    of.
    """
    rows = -(-len(panels) // columns)
    png = io.BytesIO()
    with chart(png, 3.2 * columns, 3.2 * rows) as figure:
        for index, ((title, one, other), message) in enumerate(zip(panels, names, strict=True)):
            axes = figure.add_subplot(rows, columns, index + 1)
            for points, name in zip((one, other), message, strict=True):
                axes.scatter(points[:, 0], points[:, 1], s=7, alpha=0.7, label=name)
            axes.set(title=title, xticks=[], yticks=[])
            axes.legend()
    return png.getvalue()
