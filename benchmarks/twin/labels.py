"""Labels by twins under the errors of a bench, compared with the target's own forces.

Each draw plants a GelSight and a TacPalm whose skins differ from their rows, and presses both at
the same places on a bench with errors. Labels of either for the other come from the functions of
`tactile sim labels` and `tactile compensate`.
"""

from collections.abc import Mapping, Sequence
from functools import partial
from itertools import permutations, product
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.processes import rows_of
from benchmarks.report import Page, Run, table
from benchmarks.sums import RESAMPLES, interval, r2_of, resampled, sums_by_indenter
from benchmarks.twin.pads import ALL, DEEPEST, ERRORS, GRIDS, INDENTERS, SENSORS, Pad, Pressed
from benchmarks.twin.pads import table as archive_rows
from benchmarks.twin.planted import GAUGE
from learning.compensation.prior import Prior, compensate, curve_of_table, fit_prior
from learning.compensation.search import best_for_priors
from learning.compensation.simulated import simulated_labels, twin_forces
from recorder.charts import BLUE, GREEN, ORANGE, SOFT, chart
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


def measure(run: Run) -> dict[str, Any]:
    """Return sums of labels' errors, of each draw and error."""
    draws = range(1 if run.quick else run.options.draws)
    # Presses of twins have the first error of a group, those with labels each.
    groups = [("none",)] if run.quick else [("none", *ALL), ("all",)]
    tasks = {f"draw {draw}, {some[-1]}": (draw, some) for draw, some in product(draws, groups)}
    every = rows_of(run, partial(labelled, run.quick, run.device), tasks)
    rows = [row for some in every.values() for row in some]
    run.seeds = [*draws]
    run.spread = "95 % intervals by drawing draws, and indenters within them, again"
    return {"indenters": INDENTERS[run.quick], "rows": rows}


def labelled(quick: bool, device: str, task: tuple[int, tuple[str, ...]]) -> list[dict[str, Any]]:
    """Return sums of a draw by direction, for each error; twins are fitted under the first."""
    draw, errors = task
    pads = [Pad(name, draw, quick, device) for name in SENSORS]
    try:
        twins = [quantities(pad.twin(errors[0])) for pad in pads]
        curves = [pad.force(pad.planned()[-1], errors[0]) for pad in pads]
    except SimulationDiverged as diverged:
        none = {"why": reason(diverged), "sums": {}}
        return [{"draw": draw, "error": error, **none} for error in errors]
    rows = []
    for error in errors:
        left_out: list[str] = []
        by_twins, by_rows = {}, {}
        for pad, values, curve in zip(pads, twins, curves, strict=True):
            pressed, design = _pressed(pad, curve, error, left_out), sensor(pad.name)
            twin = with_quantities(with_effects(design), values)
            by_twins[pad.name] = pressed.beside(twin, GRIDS[quick])
            by_rows[pad.name] = pressed.beside(design, GRIDS[quick])
        row: dict[str, Any] = {"draw": draw, "error": error, "why": "; ".join(left_out)}
        row["sums"] = {
            f"{source}, {target}": sums(by_twins[source], by_twins[target], by_rows[target])
            for source, target in permutations(SENSORS)
        }
        rows.append(row)
    return rows


def _pressed(pad: Pad, curve: Array, error: str, left_out: list[str]) -> Pressed:
    """Return a pad's presses under an error; those without a solution are appended to a list."""
    *presses, force_depth = pad.planned()
    parts = [archive_rows(force_depth, curve)]
    for press in presses:
        try:
            force = pad.force(press, error)
        except SimulationDiverged as diverged:
            left_out.append(f"{pad.name}, {press.indenter}: {reason(diverged)}")
            force = np.full((len(press.motion), 3), np.nan)
        parts.append(archive_rows(press, force))
    columns = {column: np.concatenate([part[column] for part in parts]) for column in parts[0]}
    return Pressed(pad.name, columns)


def reason(diverged: SimulationDiverged) -> str:
    """Return why a press has no solution, in short."""
    return str(diverged).split(";")[0].split("\n")[0]


def sums(source: Pressed, target: Pressed, by_row: Pressed) -> dict[str, Any]:
    """Return sums of labels' errors by method and indenter (`sums_by_indenter`).

    Source and target have the forces of their twins, `by_row` is the target with those of its row.
    """
    predicted = {"source": source.table["wrench"][:, :3], "priors": by_priors(source, target)}
    for word, there in (("", target), (", no gauge", by_row)):
        predicted[f"simulated{word}"] = simulated_labels(source.archived, there.archived).force
        predicted[f"twin{word}"] = twin_forces(there.archived).force
    # Rows of both are those of the same targets, in the same order.
    true = target.table["wrench"][:, :3]
    finite = np.isfinite([true, *predicted.values()]).all(axis=(0, 2))
    rows = np.flatnonzero(finite & (source.table["location"] >= 0))
    names = np.array(NAMES)[source.table["indenter"][rows]]
    return {
        method: sums_by_indenter(true[rows], labels[rows], names)
        for method, labels in predicted.items()
    }


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


def r2(parts: Sequence[Values], method: str) -> tuple[float, tuple[float, float]]:
    """Return R2 of one of `METHODS`, mean of Fx, Fy and Fz, and its 95 % interval.

    R2 of each draw, over all frames, is averaged over draws. The interval is that of drawing draws,
    and indenters within them, again. `parts` are the sums of each draw, by method and indenter.
    """
    random = np.random.default_rng(0)
    sums = [np.array([*part[method].values()]) for part in parts]
    again = np.array([resampled(rows, random) for rows in sums])
    drawn = random.integers(len(parts), size=(RESAMPLES, len(parts)))
    means = again[drawn, random.integers(RESAMPLES, size=drawn.shape)]
    # Indenters without any force along an axis have no R2 there.
    low, high = interval(means.mean(axis=1))
    return float(np.mean([r2_of(rows.sum(axis=0)) for rows in sums])), (float(low), float(high))


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
them too. The paper's formulas scale the source's labels; twins give the ratio of two simulated
presses, or the target's twin gives the force itself. A sensor's row is its design, not a fit."""
    ]
    for pair, errors in scores.items():
        source, target = pair.split(", ")
        lines = [
            [error, *(f"{mean:.2f} ({low:.2f} to {high:.2f})" for mean, (low, high) in row)]
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
                    mean, (low, high) = cells[method]
                    x = place + 0.18 * (index - 1.5)
                    axes.plot([x, x], [max(low, -0.5), high], color=color, lw=1.5)
                    label = METHODS[method].replace("`", "") if place == 0 else None
                    axes.plot(x, max(mean, -0.5), "o", ms=4, color=color, label=label)
            axes.set_xticks(range(len(errors)), errors, rotation=30)
            axes.set_ylim(-0.5, 1.02)
            axes.set_title("labels of {} for {}".format(*pair.split(", ")), fontsize=9)
        np.atleast_1d(every)[0].set_ylabel("R2 (lines: 95 %; below -0.5 cut)")
        handles, names = np.atleast_1d(every)[0].get_legend_handles_labels()
        figure.legend(handles, names, loc="outside lower center", ncols=2, fontsize=8)
