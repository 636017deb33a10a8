"""Page, CSV file and chart of the tables, from the scored cells."""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.learning.gauge_tables.coverage import INTERVAL, RESAMPLES, read_covered
from benchmarks.learning.gauge_tables.jobs import Study, twin_path
from benchmarks.learning.gauge_tables.skins import GAUGE, GAUGE_PRESSES
from benchmarks.learning.sums import r_squared_of_sums
from learning.training.run import generator
from recorder.charts import chart
from recorder.pages import render
from recorder.store import replace_file
from sim.dataset.plan import UNSEEN

Floats = NDArray[np.float64]

OWN = "own labels"
# Difference of R2 to own labels that the project aims at.
GOAL = 0.03
# Methods that are compared with own labels, named before any sealed indenter was tested: the best
# of a table would be chosen by the test.
NAMED = (
    ("own frames, the twin's forces", "displacement"),
    ("displacement, simulated", "displacement"),
    ("field, simulated", "tiny"),
)
# Quantities of twins whose errors are shown.
SHOWN = ("modulus", "thickness", "poisson", "friction")


@dataclass(frozen=True, slots=True, eq=False)
class Line:
    """Scores of a method and net, means over pairs of sensors and seeds."""

    method: str
    net: str
    privileged: bool
    spent: int
    pairs: int
    seeds: int
    sealed: Floats
    """R2 on drawn indenters, then of each resample (1 + RESAMPLES,)."""
    paper: Floats
    """The same on the paper's six indenters."""
    inside: float
    """R2 on drawn indenters, of frames within the range of the target's training labels."""
    outside: float
    """R2 of those beyond."""
    mae: Floats
    """Mean absolute errors on drawn indenters, of shear and Fz (2,) [N]."""

    @property
    def name(self) -> str:
        """Method and net."""
        return self.method if self.net == "-" else f"{self.method} ({self.net})"


def lines_of(cells: Sequence[Mapping[str, Any]]) -> list[Line]:
    """Return a line for each method and net, those that read labels of the target last."""
    found = []
    for method, net in dict.fromkeys((each["method"], each["net"]) for each in cells):
        these = [each for each in cells if (each["method"], each["net"]) == (method, net)]
        ends = list(dict.fromkeys((each["source"], each["target"]) for each in these))
        seeds = sorted({each["seed"] for each in these})
        # A pair that lacks a seed would count for less.
        known = {(each["seed"], each["source"], each["target"]): each["sums"] for each in these}
        whole = [end for end in ends if all((seed, *end) in known for seed in seeds)]
        if not whole:
            continue
        grid = [[known[seed, *end] for end in whole] for seed in seeds]
        sealed = sums_of(grid, lambda name: name not in UNSEEN)
        paper = sums_of(grid, lambda name: name in UNSEEN)
        total = sealed.sum(axis=(2, 3))
        with np.errstate(invalid="ignore"):
            off = np.nanmean(total[:, :, 4] / total[:, :, 0], axis=(0, 1))
        inside, outside = (_mean(r2(sealed[:, :, :, part].sum(axis=2))) for part in (0, 1))
        found.append(
            Line(
                method,
                net,
                bool(these[0]["privileged"]),
                max(each["spent"] for each in these),
                len(whole),
                len(seeds),
                resampled(sealed.sum(axis=3)),
                resampled(paper.sum(axis=3)),
                inside,
                outside,
                np.array([off[:2].mean(), off[2]]),
            )
        )
    return sorted(found, key=lambda line: (line.method == OWN, line.privileged))


def sums_of(grid: Sequence[Sequence[Mapping[str, Any]]], of: Any) -> Floats:
    """Return sums by seed, pair, indenter and range (s, p, k, 2, 5, 3)."""
    names = sorted({name for row in grid for sums in row for name in sums if of(name)})
    none = np.zeros((2, 5, 3))
    parts = [
        [
            [
                np.array([sums[name]["in"], sums[name]["out"]]) if name in sums else none
                for name in names
            ]
            for sums in row
        ]
        for row in grid
    ]
    return np.array(parts, np.float64).reshape(len(grid), len(grid[0]), len(names), 2, 5, 3)


def r2(sums: Floats) -> Floats:
    """Return R2 (...), mean of axes, from sums (..., 5, 3); NaN where forces do not vary."""
    *parts, _ = np.moveaxis(sums, -2, 0)
    found: Floats = r_squared_of_sums(*parts).mean(axis=-1)
    return found


def resampled(sums: Floats) -> Floats:
    """Return the mean R2 over seeds and pairs, then that of each resample (1 + RESAMPLES,).

    Indenters are drawn again, the same for all pairs, and so are seeds.

    Args:
        sums: Sums by seed, pair and indenter (s, p, k, 5, 3).
    """
    seeds, _, indenters = sums.shape[:3]
    if not indenters:
        return np.full(1 + RESAMPLES, np.nan)
    random = generator(0, "resamples")
    taken = random.multinomial(indenters, np.full(indenters, 1 / indenters), RESAMPLES)
    drawn = r2(np.einsum("rk,spkqa->rspqa", taken.astype(float), sums)).mean(axis=2)
    chosen = random.integers(seeds, size=(RESAMPLES, seeds))
    again = np.take_along_axis(drawn, chosen, axis=1).mean(axis=1)
    found: Floats = np.r_[r2(sums.sum(axis=2)).mean(), again]
    return found


def _mean(values: Floats) -> float:
    """Return the mean of the values that there are; NaN if there is none."""
    known = values[np.isfinite(values)]
    return float(known.mean()) if len(known) else float("nan")


def span(values: Floats) -> tuple[float, float]:
    """Return the 95 % interval of resamples; NaN if there are none."""
    if not np.isfinite(values[1:]).any():
        return float("nan"), float("nan")
    low, high = np.nanquantile(values[1:], INTERVAL)
    return float(low), float(high)


def best_own(lines: Sequence[Line]) -> Line | None:
    """Return the best line of own labels; None without any."""
    own = [line for line in lines if line.method == OWN and np.isfinite(line.sealed[0])]
    return max(own, key=lambda line: line.sealed[0], default=None)


def verdicts(lines: Sequence[Line]) -> list[str]:
    """Return a sentence on each of the named methods, beside own labels on the sealed indenters."""
    own, told = best_own(lines), []
    for line in lines:
        if own is None or (line.method, line.net) not in NAMED:
            continue
        apart = own.sealed - line.sealed
        low, high = span(apart)
        word = "within" if apart[0] <= GOAL else "not within"
        told.append(
            f"{line.name}: R2 {line.sealed[0]:.3f}, own labels ({own.net}) {own.sealed[0]:.3f}, "
            f"difference {apart[0]:.3f} ({low:.3f} to {high:.3f}): {word} {GOAL:g}."
        )
    return told


def write(study: Study, seeds: Sequence[int]) -> list[str]:
    """Write page.md, table.csv and table.png of the cells that there are; return the last lines."""
    cells = [
        json.loads(line)
        for path in sorted(study.cells.glob("*.jsonl"))
        for line in path.read_text(encoding="utf-8").splitlines()
    ]
    cells = [each for each in cells if each["seed"] in seeds or each["net"] == "-"]
    lines = lines_of(cells)
    own = best_own(lines)
    text = render(
        Path(__file__).with_suffix(".md"),
        study=study,
        seeds=seeds,
        lines=lines,
        own=own,
        span=span,
        verdicts=verdicts(lines),
        twins=twins(study),
        covered=read_covered(study, seeds),
        picture="table.png",
        gauge=GAUGE,
        gauge_presses=GAUGE_PRESSES,
        shown=SHOWN,
    )
    replace_file(study.out / "page.md", text.encode())
    if not lines:
        return [f"{study.out / 'page.md'}: no cell yet"]
    table = io.StringIO()
    writer = csv.writer(table)
    ends = [f"{name}{end}" for name in ("sealed", "paper") for end in ("", "_low", "_high")]
    more = ["sealed_in_range", "sealed_out_of_range", "mae_shear_n", "mae_fz_n"]
    writer.writerow(["method", "net", "privileged", "spent", "pairs", "seeds", *ends, *more])
    for line in lines:
        scores = [line.sealed[0], *span(line.sealed), line.paper[0], *span(line.paper)]
        scores += [line.inside, line.outside, *line.mae.tolist()]
        own_words = [line.method, line.net, line.privileged, line.spent, line.pairs, line.seeds]
        writer.writerow([*own_words, *(f"{float(each):.4f}" for each in scores)])
    replace_file(study.out / "table.csv", table.getvalue().encode())
    _draw(lines, study.out / "table.png")
    return verdicts(lines)


def twins(study: Study) -> dict[str, dict[str, float]]:
    """Return by sensor the errors of its twin: relative, but of Poisson's ratio as it is."""
    found = {}
    for name in study.sensors:
        path = twin_path(study.out, name).with_suffix(".json")
        if path.exists():
            told = json.loads(path.read_text(encoding="utf-8"))
            off = {each: told["twin"][each] - told["true"][each] for each in SHOWN}
            off |= {each: off[each] / told["true"][each] for each in SHOWN if each != "poisson"}
            height = told["height"]["twin"] - told["height"]["true"]
            found[name] = {**off, "height": height, "misfit": told["misfit"]}
    return found


def _draw(lines: Sequence[Line], path: Path) -> None:
    shown = [line for line in lines if np.isfinite(line.sealed[0])]
    with chart(path, 7, 1 + 0.24 * len(shown)) as figure:
        axes = figure.subplots()
        for place, line in enumerate(reversed(shown)):
            colour = "C1" if line.privileged else "C0"
            for shift, values, mark in ((0.12, line.sealed, "o"), (-0.12, line.paper, "s")):
                low, high = (max(-0.5, end) for end in span(values))
                axes.plot([low, high], [place + shift] * 2, color=colour, linewidth=1)
                middle = max(-0.5, float(values[0]))
                axes.plot(middle, place + shift, mark, color=colour, markersize=4)
        axes.set_yticks(range(len(shown)), [line.name for line in reversed(shown)])
        axes.set_xlim(-0.55, 1.02)
        axes.set_xlabel("R2 in simulation: sealed indenters (dots), the paper's six (squares)")
