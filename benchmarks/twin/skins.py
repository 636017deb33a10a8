"""Twins of random skins that are known, on a bench with errors that the fit does not know."""

import time
from collections.abc import Iterable, Mapping, Sequence
from functools import partial
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from benchmarks.processes import rows_of
from benchmarks.report import Page, Run, table
from benchmarks.twin.planted import FEM, GAUGE, LAYER, Bench, Truth, observed, random_skin, usual
from recorder.charts import BLUE, SOFT, chart
from sim.cli.twin_plan import CHANGE
from sim.errors import SimulationDiverged
from sim.fem import Fem
from sim.indenters import NAMES
from sim.sensors import sensor
from sim.sensors.quantities import quantities
from sim.twin import TrackModel, fitted, misfit
from sim.twin.fit import Z
from sim.twin.plan import PlannedPresses, Planner, planned_presses, sessions

Array = NDArray[np.float64]

SENSOR, SEED = "gelsight", 0
# Indenter whose forces are predicted: no fit has its presses.
HELD_OUT = "torus"
COLUMNS = ("modulus", "thickness", "relaxation", "friction", "held-out force")
# Minutes of a planned bench, pixels of a fit, and of a quick one.
MINUTES, FIT_GRID, QUICK_GRID = 5.0, 64, 24
# Elements of a quick run.
COARSE = Fem(spacing=1.0e-3)
# Times at which relaxation is compared [s].
TIMES = np.geomspace(0.05, 2.0, 20)


def measure(tier: Literal["layer", "fem"], planned: bool, run: Run) -> dict[str, Any]:
    """Fit twins of random skins and compare them with the truth."""
    presses = tuple(usual(name, SENSOR) for name in GAUGE)
    if planned:
        # A quick run plans on few pixels, and fits nothing.
        planner = Planner(sensor(SENSOR), **({"grid": 16} if run.quick else {}))
        indenters = [name for name in NAMES if name != HELD_OUT][: 1 if run.quick else None]
        candidates = planner.candidates(indenters)
        presses = tuple(sessions(planner.best(candidates, seconds=60 * MINUTES, change=CHANGE)))
    elif run.quick:
        presses = (_short("sphere"),)
    numbers = range(int(not planned) if run.quick else run.options.skins)
    job = partial(identified, tier, presses, run.quick)
    every = rows_of(run, job, {f"skin {number}": number for number in numbers})
    rows = [row for row in every.values() if "errors" in row]
    without = [f"{name}: {row['why']}" for name, row in every.items() if "why" in row]
    run.seeds = [row["number"] for row in rows]
    run.spread = "one fit a skin; quantiles over skins"
    return {
        "tier": tier,
        "grid": QUICK_GRID if run.quick else FIT_GRID,
        "presses": [
            [each.indenter, [*each.depths], each.plan.shear, each.hold] for each in presses
        ],
        "rows": rows,
        "without": without,
    }


def _short(indenter: str) -> PlannedPresses:
    """Return a press of a quick run."""
    return planned_presses(indenter, (0.8e-3,), 0.4e-3, 0.6)


def identified(
    tier: Literal["layer", "fem"], presses: Sequence[PlannedPresses], quick: bool, number: int
) -> dict[str, Any]:
    """Fit a skin's twin, and compare it with the skin; or return why there is none.

    The tier is that of the true forces and of the fit. A quick one has few pixels and elements, and
    no correction by `fem`.
    """
    skin, bench = random_skin(np.random.default_rng([SEED, number]), SENSOR)
    held_out = _short(HELD_OUT) if quick else usual(HELD_OUT, SENSOR)
    truth = Truth(tier, fem=COARSE if quick else FEM)
    grid = QUICK_GRID if quick else FIT_GRID
    every = [(each, bench) for each in presses] + [(held_out, Bench(noise=0.0))]
    try:
        tracks = [
            observed(skin, each, errors, 100 * number + index, truth)
            for index, (each, errors) in enumerate(every)
        ]
        began = time.perf_counter()
        fit = fitted(tracks[:-1], sensor(SENSOR), grid=grid, tier="layer" if quick else tier)
        seconds = time.perf_counter() - began
        true = quantities(skin)
        model = TrackModel(fit.design, tracks[-1:], grid=grid)
        values = {name: fit.values[name] for name in true}
        if fit.tier == "fem":
            model.correct(values)
        missed = misfit(tracks[-1:], model.readings(values))
    except SimulationDiverged as diverged:
        return {"number": number, "why": str(diverged).partition("\n")[0]}
    errors = {
        name: abs(fit.values[name] / true[name] - 1)
        for name in ("modulus", "thickness", "friction")
    }
    relaxed = relaxation(fit.values, true) / relaxation(true, true)
    errors["relaxation"] = float(np.sqrt(np.mean(np.square(relaxed - 1))))
    errors["held-out force"] = missed
    off = {name: fit.distance(name, value) for name, value in true.items()}
    row: dict[str, Any] = {"number": number, "errors": errors, "off": off}
    return row | {"misfit": fit.misfit, "seconds": seconds}


def relaxation(values: Mapping[str, float], names: Iterable[str]) -> Array:
    """Return the relaxation function over that at rest, at `TIMES`, of branches that have names."""
    ratios, times = (
        [values[name] for name in names if name.startswith(word)] for word in ("ratio", "time")
    )
    branches = [r * np.exp(-TIMES / t) for r, t in zip(ratios, times, strict=True)]
    return np.asarray(1.0 + np.sum(branches, axis=0))


def section(title: str, values: Mapping[str, Any], page: Page, *, picture: str = "") -> str:
    """Return the errors of twins and the coverage of their intervals."""
    rows = values["rows"]
    if not rows:
        return f"## {title}\nNo skin was fitted."
    quantity = list(rows[0]["off"])
    columns = [name for name in COLUMNS if name in rows[0]["errors"]]
    errors = np.array([[row["errors"][name] for name in columns] for row in rows])
    off = np.array([[abs(row["off"][name]) for name in quantity] for row in rows])
    lines = [
        [name, *(f"{100 * each:.1f} %" for each in (*np.quantile(column, (0.5, 0.9)), max(column)))]
        for name, column in zip(columns, errors.T, strict=True)
    ]
    covered = (off <= Z).sum(axis=0)
    wider = dict(zip(quantity, np.quantile(off, 0.9, axis=0) / Z, strict=True))
    narrow = [f"{name} {factor:.2f}" for name, factor in wider.items() if factor > 1]
    widest = max(wider, key=wider.__getitem__)
    spare = f"{100 * (1 - wider[widest]):.0f} % narrower and still hold nine of ten ({widest})"
    enough = f"are too narrow, by these factors: {', '.join(narrow)}" if narrow else ""
    indenters: dict[str, int] = {}
    for name, depths, _, _ in values["presses"]:
        indenters[name] = indenters.get(name, 0) + len(depths)
    pressed = ", ".join(f"{count} by `{name}`" for name, count in indenters.items())
    seconds = np.median([row["seconds"] for row in rows])
    how = f"`layer` on {LAYER.grid} pixels, fits by `layer` on {values['grid']}"
    if values["tier"] == "fem":
        how = f"`fem`, fits by `layer` on {values['grid']} pixels, corrected by `fem`"
    texts = [
        f"## {title}",
        f"Presses of each skin: {pressed}; sheared, held, with errors of height, tilt, compliance, "
        f"latency and axes, and 10 mN of noise. True forces by {how}. {len(rows)} skins; median "
        f"time of a fit {seconds:.0f} s.",
        table(["error", "median", "90 % below", "largest"], lines),
        f"{covered.sum()} of {off.size} true values lie in their 90 % intervals "
        f"({100 * covered.sum() / off.size:.0f} %; {', '.join(quantity)}). Intervals "
        f"{enough or f'could be {spare}'}.",
    ]
    if values["without"]:
        texts.append(f"Left out: {'; '.join(values['without'])}.")
    if picture:
        _draw(rows, columns, page, picture)
        texts.append(page.link(picture, "Errors of the twins of all skins"))
    return "\n\n".join(texts)


def _draw(rows: Sequence[Mapping[str, Any]], columns: Sequence[str], page: Page, name: str) -> None:
    """Draw the share of skins below each error."""
    with chart(page.picture(name), 7.0, 2.6) as figure:
        every = figure.subplots(1, len(columns), sharey=True)
        for axes, column in zip(np.atleast_1d(every), columns, strict=True):
            errors = np.sort([100 * row["errors"][column] for row in rows])
            axes.step(errors, np.arange(1, len(errors) + 1) / len(errors), color=BLUE)
            axes.axhline(0.5, color=SOFT, lw=0.7, ls=":")
            axes.axhline(0.9, color=SOFT, lw=0.7, ls=":")
            axes.set_xlim(0, 1.05 * errors[-1])
            axes.set_title(column, fontsize=9)
            axes.set_xlabel("error [%]")
        np.atleast_1d(every)[0].set_ylabel("fraction of skins")
