"""Labels by twins under the errors of a bench, compared with the target's own forces.

    python -m benchmarks twin-labels --tier layer --draws 1 --indenters sphere,wave
    python -m benchmarks twin-labels --draws 4 --out twin-labels.md

Each draw plants a GelSight and a TacPalm whose skins differ from their rows, and presses both at
the same places on a bench with errors. Labels of either for the other come from the functions of
`tactile sim labels` and `tactile compensate`. The page of `--out` is written after every row, and
the same command goes on where it stopped: its rows are beside the page. In simulation.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any, get_args

import numpy as np
from numpy.typing import NDArray

from benchmarks.learning.sums import r_squared_of_sums
from benchmarks.twin.command import each_of, stored
from benchmarks.twin.pads import DEEPEST, ERRORS, GAUGE, SENSORS, STEPS, Pad, Pressed, table
from learning.compensation.prior import Prior, compensate, curve_of_table, fit_prior
from learning.compensation.search import best_for_priors
from learning.compensation.simulated import simulated_labels, twin_forces
from recorder.command_line.options import add_device, add_seed, names, positive, whole
from recorder.pages import render
from recorder.progress import Progress
from sim.errors import SceneError, SimulationDiverged
from sim.indenters import NAMES
from sim.result import ContactTier
from sim.sensors import sensor
from sim.sensors.quantities import quantities, with_quantities
from sim.twin.fit import with_effects

Array = NDArray[np.float64]

INDENTERS = ("sphere_s", "hemisphere", "cylinder", "torus")
METHODS = {
    "source": "the source's labels",
    "priors": "paper's formulas, `priors`",
    "simulated": "by twins, `simulated`",
    "twin": "the target's twin alone",
    "simulated, no gauge": "`simulated`, the target's row in place of its twin",
    "twin, no gauge": "the target's row alone",
}
# Quantities of twins whose errors are shown.
SHOWN = ("modulus", "thickness", "poisson", "friction")
# Resamplings of an interval.
RESAMPLED = 2000


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of the benchmark."""
    add = parser.add_argument
    add(
        "--tier",
        choices=get_args(ContactTier),
        default="fem",
        help="of the true forces (%(default)s)",
    )
    add("--errors", type=names, default=tuple(ERRORS), metavar="NAME,...", help="some (all)")
    add("--indenters", type=names, default=INDENTERS, metavar="NAME,...", help="some of the 18")
    add("--draws", type=whole(1, 1000), default=1, metavar="N", help="pairs of skins (%(default)s)")
    add("--fineness", type=positive, default=0.3, metavar="F", help="of fem (%(default)s)")
    add("--grid", type=whole(23, 256), default=32, metavar="N", help="of fit, labels (%(default)s)")
    add("--processes", type=whole(1, 256), default=1, metavar="N", help="(%(default)s)")
    add("--out", type=Path, metavar="MD", help="page to write, after every row")
    add_device(parser, "device of true forces by fem")
    add_seed(parser)


def run(options: argparse.Namespace) -> int:
    """Compute the missing rows, print and write their page; return 1 if no row has a solution."""
    for name, allowed in (("errors", tuple(ERRORS)), ("indenters", NAMES)):
        if unknown := [each for each in getattr(options, name) if each not in allowed]:
            raise SceneError(f"--{name}: {', '.join(unknown)}; allowed: {', '.join(allowed)}")
    path = None if options.out is None else options.out.with_suffix(".jsonl")
    rows = [] if path is None else stored(path, settings(options))
    done, before = {*map(key, rows)}, len(rows)
    wanted = [each for each in tasks(options) if each not in done]
    with Progress("labels", sys.stderr) as progress:
        # Rows under an error need the gauge presses of their draw.
        for these in (
            [each for each in wanted if each[1] == "gauge"],
            [each for each in wanted if each[1] != "gauge"],
        ):
            for (draw, kind, error), row in each_of(partial(timed, rows, options), these, options):
                rows.append(row)
                progress((len(rows) - before) / len(wanted))
                print(f"draw {draw}, {kind} {error}: {row['seconds']} s {row['why']}", flush=True)
                if path is not None:
                    with path.open("a", encoding="utf-8") as file:
                        file.write(json.dumps(row) + "\n")
                    options.out.write_text(page(rows, options), encoding="utf-8")
    text = page(rows, options)
    if options.out is not None:
        options.out.write_text(text, encoding="utf-8")
    print(text)
    return 0 if any(row.get("sums") for row in rows) else 1


def timed(
    rows: Sequence[Mapping[str, Any]], options: argparse.Namespace, task: tuple[int, str, str]
) -> dict[str, Any]:
    """Return the row of a task, with its time."""
    began = time.perf_counter()
    draw, kind, error = task
    row = gauge(draw, error, options) if kind == "gauge" else labelled(draw, error, rows, options)
    return {**row, "seconds": round(time.perf_counter() - began)}


def tasks(options: argparse.Namespace) -> list[tuple[int, str, str]]:
    """Return what is computed, in order: draw, `gauge` or `error`, and the name of the error."""
    gauges = dict.fromkeys("all" if error == "all" else "none" for error in options.errors)
    return [
        (draw, kind, name)
        for draw in range(options.draws)
        for gauge in gauges
        for kind, these in (("gauge", (gauge,)), ("error", options.errors))
        for name in these
        if kind == "gauge" or (name == "all") == (gauge == "all")
    ]


def key(row: Mapping[str, Any]) -> tuple[int, str, str]:
    """Return which of the tasks a row is the result of."""
    kind = "gauge" if "gauge" in row else "error"
    return row["draw"], kind, row[kind]


def settings(options: argparse.Namespace) -> dict[str, Any]:
    """Return what the rows of a page must have in common."""
    return {
        name: getattr(options, name) for name in ("tier", "indenters", "fineness", "grid", "seed")
    }


def gauge(draw: int, error: str, options: argparse.Namespace) -> dict[str, Any]:
    """Return twins of both sensors, and forces of their force-depth presses, under an error."""
    row: dict[str, Any] = {"draw": draw, "gauge": error, "twins": {}, "curves": {}, "why": ""}
    try:
        for name in SENSORS:
            pad = Pad(name, draw, options)
            row["twins"][name] = quantities(pad.twin(error))
            row["curves"][name] = pad.force(pad.planned()[-1], error).tolist()
    except SimulationDiverged as diverged:
        row["why"] = reason(diverged)
    return row


def labelled(
    draw: int, error: str, rows: Sequence[Mapping[str, Any]], options: argparse.Namespace
) -> dict[str, Any]:
    """Return sums of a draw and error, by direction: of forces and of what labels miss."""
    of = draw, "gauge", "all" if error == "all" else "none"
    gauged = next(row for row in rows if key(row) == of)
    row: dict[str, Any] = {"draw": draw, "error": error, "why": gauged["why"], "sums": {}}
    if gauged["why"]:
        return row
    left_out: list[str] = []
    by_twins, by_rows = {}, {}
    for name in SENSORS:
        pad = Pad(name, draw, options)
        *presses, force_depth = pad.planned()
        parts = [table(force_depth, np.array(gauged["curves"][name]))]
        for press in presses:
            try:
                force = pad.force(press, error)
            except SimulationDiverged as diverged:
                left_out.append(f"{name}, {press.indenter}: {reason(diverged)}")
                force = np.full((len(press.motion), 3), np.nan)
            parts.append(table(press, force))
        columns = {column: np.concatenate([part[column] for part in parts]) for column in parts[0]}
        pressed, design = Pressed(name, columns), sensor(name)
        twin = with_quantities(with_effects(design), gauged["twins"][name])
        by_twins[name] = pressed.beside(twin, options.grid)
        by_rows[name] = pressed.beside(design, options.grid)
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
    low, high = np.quantile(means.mean(axis=1), (0.025, 0.975))
    axes = np.mean(found, axis=0)
    return [*axes.tolist(), float(axes.mean())], (float(low), float(high))


def page(rows: Sequence[Mapping[str, Any]], options: argparse.Namespace) -> str:
    """Return the results as a page of Markdown."""
    rows = [row for row in rows if row["draw"] < options.draws]
    words = ["--tier", options.tier, "--draws", options.draws, "--fineness", options.fineness]
    words += ["--indenters", ",".join(options.indenters), "--grid", options.grid]
    words += ["--seed", options.seed]
    found: dict[str, dict[str, dict[str, Any]]] = {}
    for error in options.errors:
        these = [row for row in rows if row.get("error") == error and row["sums"]]
        for pair in these[0]["sums"] if these else ():
            parts = [row["sums"][pair] for row in these]
            found.setdefault(pair, {})[error] = {method: r2(parts, method) for method in METHODS}
    return render(
        Path(__file__).with_suffix(".md"),
        command=f"python -m benchmarks twin-labels {' '.join(map(str, words))}",
        options=options,
        rows=rows,
        found=found,
        methods=METHODS,
        gauge=GAUGE,
        twins=twin_errors(rows, options),
        steps=STEPS,
        deepest=DEEPEST,
        draws=len({row["draw"] for row in rows if row.get("sums")}),
        without=[
            f"draw {row['draw']}, {row.get('error', 'gauge presses')}: {row['why']}"
            for row in rows
            if row["why"]
        ],
    )


def twin_errors(
    rows: Sequence[Mapping[str, Any]], options: argparse.Namespace
) -> dict[tuple[str, str], dict[str, float]]:
    """Return the mean size of the errors of twins, by gauge presses and sensor.

    As fractions of the true values; of Poisson's ratio as they are.
    """
    found: dict[tuple[str, str], list[dict[str, float]]] = {}
    for row in rows:
        for name, values in row.get("twins", {}).items():
            true = quantities(Pad(name, row["draw"], options).skin)
            sizes = {each: abs(values[each] - true[each]) for each in SHOWN}
            sizes |= {each: sizes[each] / true[each] for each in SHOWN if each != "poisson"}
            found.setdefault((row["gauge"], name), []).append(sizes)
    return {
        where: {each: float(np.mean([one[each] for one in ones])) for each in SHOWN}
        for where, ones in found.items()
    }
