"""Labels by twins under the errors of a bench, compared with the target's own forces.

Each draw plants a GelSight and a TacPalm whose skins differ from their rows, and presses both at
the same places on a bench with errors. Labels of either for the other come from the functions of
`tactile sim labels` and `tactile compensate`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.processes import rows_of
from benchmarks.report import Page, Run, table
from benchmarks.sums import r_squared_of_sums
from benchmarks.twin.pads import DEEPEST, ERRORS, GAUGE, SENSORS, Pad, Pressed, Settings
from benchmarks.twin.pads import table as archive_rows
from learning.compensation.prior import Prior, compensate, curve_of_table, fit_prior
from learning.compensation.search import best_for_priors
from learning.compensation.simulated import simulated_labels, twin_forces
from recorder.charts import BLUE, GREEN, ORANGE, SOFT, chart
from recorder.progress import span_of
from sim.errors import SimulationDiverged
from sim.indenters import NAMES
from sim.sensors import sensor
from sim.sensors.quantities import quantities, with_quantities
from sim.twin.fit import with_effects

Array = NDArray[np.float64]
Values = Mapping[str, Any]

METHODS = {
    "source": "the source's labels",
    "priors": "paper's formulas, `priors`",
    "simulated": "by twins, `simulated`",
    "twin": "the target's twin alone",
    "simulated, no gauge": "`simulated`, the target's row for its twin",
    "twin, no gauge": "the target's row alone",
}
# Resamplings of an interval.
RESAMPLED = 2000
QUICK = Settings(("sphere", "torus"), "layer", grid=24, fits=False)


def measure(run: Run) -> dict[str, Any]:
    """Return sums of forces and of labels' errors, of each draw and error."""
    settings = QUICK if run.quick else Settings(device=run.device)
    errors = ("none",) if run.quick else tuple(ERRORS)
    draws = range(1 if run.quick else run.options.draws)
    gauges = {
        f"twins, draw {draw}, {name}": (draw, name)
        for draw in draws
        for name in errors
        if name in ("none", "all")
    }
    tasks = {f"labels, draw {draw}, {name}": (draw, name) for draw in draws for name in errors}
    progress = span_of(run.progress, 0.0, 0.3)
    gauged = [*rows_of(run, partial(gauge, settings), gauges, progress).values()]
    progress = span_of(run.progress, 0.3, 0.7)
    rows = [*rows_of(run, partial(labelled, settings, gauged), tasks, progress).values()]
    run.seeds = [*draws]
    run.spread = "95 % intervals by drawing draws, and indenters within them, again"
    twins = [{key: row[key] for key in row if key != "curves"} for row in gauged]
    return {"indenters": settings.indenters, "twins": twins, "rows": rows}


def gauge(settings: Settings, task: tuple[int, str]) -> dict[str, Any]:
    """Return twins of both sensors, and forces of their force-depth presses, under an error."""
    draw, error = task
    row: dict[str, Any] = {"draw": draw, "gauge": error, "twins": {}, "curves": {}, "why": ""}
    try:
        for name in SENSORS:
            pad = Pad(name, draw, settings)
            row["twins"][name] = quantities(pad.twin(error))
            row["curves"][name] = pad.force(pad.planned()[-1], error).tolist()
    except SimulationDiverged as diverged:
        row["why"] = reason(diverged)
    return row


def labelled(settings: Settings, twins: Sequence[Values], task: tuple[int, str]) -> dict[str, Any]:
    """Return sums of a draw and error, by direction: of forces and of labels' errors."""
    draw, error = task
    under = "all" if error == "all" else "none"
    gauged = next(row for row in twins if (row["draw"], row["gauge"]) == (draw, under))
    row: dict[str, Any] = {"draw": draw, "error": error, "why": gauged["why"], "sums": {}}
    if gauged["why"]:
        return row
    left_out: list[str] = []
    by_twins, by_rows = {}, {}
    for name in SENSORS:
        pad = Pad(name, draw, settings)
        *presses, force_depth = pad.planned()
        parts = [archive_rows(force_depth, np.array(gauged["curves"][name]))]
        for press in presses:
            try:
                force = pad.force(press, error)
            except SimulationDiverged as diverged:
                left_out.append(f"{name}, {press.indenter}: {reason(diverged)}")
                force = np.full((len(press.motion), 3), np.nan)
            parts.append(archive_rows(press, force))
        columns = {column: np.concatenate([part[column] for part in parts]) for column in parts[0]}
        pressed, design = Pressed(name, columns), sensor(name)
        twin = with_quantities(with_effects(design), gauged["twins"][name])
        by_twins[name] = pressed.beside(twin, settings.grid)
        by_rows[name] = pressed.beside(design, settings.grid)
    for source, target in (SENSORS, SENSORS[::-1]):
        row["sums"][f"{source}, {target}"] = sums(
            by_twins[source], by_twins[target], by_rows[target]
        )
    return {**row, "why": "; ".join(left_out)}


def reason(diverged: SimulationDiverged) -> str:
    """Return why a press has no solution, in short."""
    return str(diverged).split(";")[0].split("\n")[0]


def sums(source: Pressed, target: Pressed, by_row: Pressed) -> dict[str, Any]:
    """Return sums of each indenter: of the target's forces, and squares of what labels miss.

    Args:
        source: Source with the forces of its twin.
        target: Target with the forces of its twin.
        by_row: Target with the forces of its row.
    """
    predicted = {"source": source.table["wrench"][:, :3], "priors": by_priors(source, target)}
    for word, there in (("", target), (", no gauge", by_row)):
        predicted[f"simulated{word}"] = simulated_labels(source.archived, there.archived).force
        predicted[f"twin{word}"] = twin_forces(there.archived).force
    # Rows of both are those of the same targets, in the same order.
    true, found = target.table["wrench"][:, :3], {}
    known = np.isfinite([true, *predicted.values()]).all(axis=(0, 2)) & (
        source.table["location"] >= 0
    )
    for each in np.unique(source.table["indenter"][known]):
        rows = known & (source.table["indenter"] == each)
        found[NAMES[each]] = {
            "count": int(rows.sum()),
            "sum": true[rows].sum(axis=0).tolist(),
            "square": np.square(true[rows]).sum(axis=0).tolist(),
            "missed": {
                method: np.square(labels[rows] - true[rows]).sum(axis=0).tolist()
                for method, labels in predicted.items()
            },
        }
    return found


def by_priors(source: Pressed, target: Pressed) -> Array:
    """Return labels (n, 3) [N] by the paper's formulas, as the choice `priors` of `compensate`."""
    own, other = (prior(each) for each in (source, target))
    choice = best_for_priors(own, other)
    assert choice is not None
    table = source.table
    wrench = table["wrench"][:, :3]
    return compensate(wrench, table["depth"], table["phase"], own, other, *choice)[0]


def prior(pressed: Pressed) -> Prior:
    """Return the prior of a sensor: the force of its force-depth press."""
    curve = curve_of_table(pressed.name, pressed.table, NAMES)
    if curve is None:
        raise SimulationDiverged(f"{pressed.name}: no force-depth press")
    trajectory = sensor(pressed.name).trajectory
    assert trajectory is not None
    return fit_prior(curve, trajectory.depth_max)


def r2(parts: Sequence[Mapping[str, Any]], method: str) -> tuple[list[float], tuple[float, float]]:
    """Return R2 of Fx, Fy, Fz and their mean (4,), and the mean's 95 % interval.

    R2 of each draw, over all frames, is averaged over draws. The interval is that of drawing draws,
    and indenters within them, again.

    Args:
        parts: Sums of each draw, by indenter.
        method: One of `METHODS`.
    """
    random = np.random.default_rng(0)
    found, again = [], []
    for part in parts:
        rows = [
            np.array(
                [np.full(3, each["count"]), each["sum"], each["square"], each["missed"][method]]
            )
            for each in part.values()
        ]
        found.append(r_squared_of_sums(*np.sum(rows, axis=0)))
        taken = random.multinomial(len(rows), np.full(len(rows), 1 / len(rows)), RESAMPLED)
        again.append(r_squared_of_sums(*np.einsum("rk,kqa->qra", taken, rows)).mean(axis=-1))
    drawn = random.integers(len(parts), size=(RESAMPLED, len(parts)))
    means = np.array(again)[drawn, random.integers(RESAMPLED, size=drawn.shape)]
    # Indenters without any force along an axis have no R2 there.
    low, high = np.nanquantile(means.mean(axis=1), (0.025, 0.975))
    axes = np.mean(found, axis=0)
    return [*axes.tolist(), float(axes.mean())], (float(low), float(high))


def section(values: Values, page: Page) -> str:
    """Return R2 of labels by error of the bench, both ways."""
    scores: dict[str, dict[str, dict[str, Any]]] = {}
    for error in ERRORS:
        these = [row["sums"] for row in values["rows"] if row["error"] == error and row["sums"]]
        for pair in these[0] if these else ():
            parts = [sums[pair] for sums in these]
            scores.setdefault(pair, {})[error] = {name: r2(parts, name) for name in METHODS}
    draws = len({row["draw"] for row in values["rows"] if row["sums"]})
    deepest = ", ".join(f"{1e3 * DEEPEST[name]:g} mm ({name})" for name in SENSORS)
    texts = [
        f"""## Labels by twins under the errors of a bench
A GelSight and a TacPalm with planted skins, pressed at the same places to {deepest}
and sheared by {", ".join(values["indenters"])}: {draws} pairs of skins.
R2 is that of labels as predictions of the target's own forces, mean of Fx, Fy and Fz over all
frames of a draw, then over draws, with 95 % intervals. Twins are fitted by `layer` to presses of
{" and ".join(GAUGE)}; true forces are of tier `fem`. Errors are drawn for each mount of an indenter
(place 0.3 mm, tilt 1 deg, height 30 um), for each indenter (size 0.1 mm), and the mount yields by
20 um/N. Each error alone is one of the labelled presses; with all, the presses of the twins have
them too."""
    ]
    for pair, errors in scores.items():
        source, target = pair.split(", ")
        lines = [
            [error, *(f"{axes[3]:.2f} ({low:.2f} to {high:.2f})" for axes, (low, high) in row)]
            for error, row in ((error, cells.values()) for error, cells in errors.items())
        ]
        texts.append(f"Labels of {source} for {target}:")
        texts.append(table(["error", *METHODS.values()], lines))
    if scores:
        _draw(scores, page)
        texts.append(page.link("labels", "R2 of labels under each error of the bench"))
    if without := [f"draw {row['draw']}: {row['why']}" for row in values["rows"] if row["why"]]:
        texts.append(f"Left out, without a solution: {'; '.join(without)}.")
    return "\n\n".join(texts)


def _draw(scores: Mapping[str, Mapping[str, Mapping[str, Any]]], page: Page) -> None:
    """Draw R2 of three methods under each error, both ways."""
    drawn = {"priors": SOFT, "simulated": BLUE, "twin": ORANGE, "simulated, no gauge": GREEN}
    with chart(page.picture("labels"), 8.0, 3.4) as figure:
        every = figure.subplots(1, len(scores), sharey=True)
        for axes, (pair, errors) in zip(np.atleast_1d(every), scores.items(), strict=True):
            for index, (method, color) in enumerate(drawn.items()):
                for place, cells in enumerate(errors.values()):
                    values, (low, high) = cells[method]
                    x = place + 0.18 * (index - 1.5)
                    axes.plot([x, x], [max(low, -0.5), high], color=color, lw=1.5)
                    label = METHODS[method].replace("`", "") if place == 0 else None
                    axes.plot(x, max(values[3], -0.5), "o", ms=4, color=color, label=label)
            axes.set_xticks(range(len(errors)), errors, rotation=30)
            axes.set_ylim(-0.5, 1.02)
            axes.set_title("labels of {} for {}".format(*pair.split(", ")), fontsize=9)
        np.atleast_1d(every)[0].set_ylabel("R2 (lines: 95 %; below -0.5 cut)")
        handles, names = np.atleast_1d(every)[0].get_legend_handles_labels()
        figure.legend(handles, names, loc="outside lower center", ncols=2, fontsize=8)
