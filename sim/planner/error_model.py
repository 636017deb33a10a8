"""From the table to a promise: what a choice will miss on a scene that is not in it.

log(error) is a linear function of the scene's features and of log(element size over the lengths
that it must resolve), fitted by ridge regression to the scenes that were solved. What the fit
misses is bounded by split-conformal quantiles (Vovk et al., Algorithmic Learning in a Random World,
2005; Lei et al., J. Am. Stat. Assoc. 113 (2018) 1094): each scene of the table is predicted from a
fit without it, and the `PROMISED` quantile of the misses, of scenes of the same group and mesh, is
added. A scene that a choice did not solve counts as missed by any margin.
"""

from __future__ import annotations

import csv
import math
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from sim.planner.features import GROUPS, KINDS, NAMES, Choice, Features, Kind

# The table of errors and work: one row a scene and choice, in a file that people can read.

TRAINING = Path(__file__).parent / "cost_table.csv"
"""What the plans are made from."""
HELD_OUT = Path(__file__).parent / "held_out.csv"
"""Scenes that the plans were not made from, to check them."""

_FORMER = re.compile(r", planted=Planted\((?:\w+=False(?:, )?)*\)")
"""Settings of `fem` that older tables name, all off: they were measured as those without them."""

_WORK = ("elements", "newton", "cg")
_COLUMNS = (
    "scene", "shape", *NAMES, "tier", "cells", "precision", *_WORK, *KINDS,
    *(f"bar_{kind}" for kind in KINDS),
)  # fmt: skip


@dataclass(frozen=True, slots=True)
class CostRow:
    """One scene solved one way."""

    scene: str
    """Its name; rows of one scene share it."""
    shape: str
    features: Features
    choice: Choice
    work: dict[str, float]
    """Elements, Newton and conjugate-gradient iterations of the press; 0 where unsolved."""
    error: dict[Kind, float]
    """Against the reference: of the largest frame and axis; `force` over the probe's largest force,
    `marker` over the markers' motion. inf where it was not solved."""
    bar: dict[Kind, float]
    """Difference from the companion mesh, in the same measures; of float64 from float32 on the same
    mesh. NaN where there is none."""


@dataclass(frozen=True, slots=True)
class Table:
    """Rows, and under what conditions they were measured."""

    conditions: dict[str, str]
    rows: tuple[CostRow, ...]


def write(path: Path, table: Table) -> None:
    """Write a table; numbers to four digits, so that a change of the solver shows line by line."""
    lines = [f"# {name}: {value}" for name, value in table.conditions.items()]
    lines.append(",".join(_COLUMNS))
    for row in table.rows:
        cells = [row.scene, row.shape]
        cells += [_short(value) for value in row.features.values()]
        cells += [row.choice.tier, str(row.choice.cells), row.choice.precision]
        cells += [f"{row.work[name]:.0f}" for name in _WORK]
        cells += [_short(row.error[kind]) for kind in KINDS]
        cells += [_short(row.bar[kind]) for kind in KINDS]
        lines.append(",".join(cells))
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")


def read(path: Path) -> Table:
    """The table that `write` wrote.

    Raises:
        FileNotFoundError: There is no such file.
        ValueError: It has other columns.
    """
    lines = path.read_text(encoding="utf-8").splitlines()
    head = [line[2:].partition(": ") for line in lines if line.startswith("# ")]
    conditions = {name: _FORMER.sub("", value) for name, _colon, value in head}
    reader = csv.DictReader(line for line in lines if not line.startswith("#"))
    if tuple(reader.fieldnames or ()) != _COLUMNS:
        raise ValueError(f"{path}: columns {reader.fieldnames}; allowed: {_COLUMNS}")
    return Table(conditions, tuple(_row(line) for line in reader))


def merged(tables: Sequence[Table]) -> Table:
    """All rows of tables measured under the same conditions.

    Raises:
        ValueError: The conditions differ.
    """
    for table in tables[1:]:
        if table.conditions != tables[0].conditions:
            raise ValueError(f"conditions: {table.conditions} and {tables[0].conditions}")
    return Table(tables[0].conditions, tuple(row for table in tables for row in table.rows))


def _row(line: dict[str, str]) -> CostRow:
    choice = Choice(line["tier"], int(line["cells"]), line["precision"])  # type: ignore[arg-type]
    return CostRow(
        scene=line["scene"],
        shape=line["shape"],
        features=Features(**{name: float(line[name]) for name in NAMES}),
        choice=choice,
        work={name: float(line[name]) for name in _WORK},
        error={kind: float(line[kind]) for kind in KINDS},
        bar={kind: float(line[f"bar_{kind}"]) for kind in KINDS},
    )


def _short(value: float) -> str:
    return f"{value:.4g}" if math.isfinite(value) else str(value)


Array = NDArray[np.float64]

PROMISED = 0.95
"""Share of scenes whose error is to be below the predicted one. 90 % is what is asked for; the rest
is for choosing the cheapest, which favours what is predicted too low."""
FOLDS = 10
RIDGE = 1.0
"""Weight of the ridge, in scenes, on features of unit variance."""
FEW = 1.5
"""Factor on the largest miss where a group has too few scenes for the quantile."""
LEAST = 1e-6
"""Errors below are no smaller than this."""
BAR_FLOOR: dict[Kind, float] = {"share": 1e-3, "force": 1e-3, "marker": 5e-3}
"""Least difference of two meshes that an error bar is made from: a smaller one is chance."""
UNSEEN = {"layer": ("steps",), "fem": ("steps", "width")}
"""Features that do not tell a tier's error. `fem` meshes the sides, and `side` says how near they
are; `layer` has none."""
SLACK = 0.05
"""How far beyond the table's features a scene may lie, in shares of their range."""


@dataclass(frozen=True, slots=True)
class Fit:
    """A linear function of features; `mean` and `scale` make them unit."""

    mean: Array
    scale: Array
    weight: Array

    def __call__(self, features: Array) -> Array:
        """Values (N,) at features (N, M)."""
        unit = (features - self.mean) / self.scale
        return np.asarray(self.weight[0] + unit @ self.weight[1:])


@dataclass(frozen=True, slots=True)
class Model:
    """Predicts errors; made by `fit`."""

    fits: dict[tuple[str, Kind], Fit]
    """For each tier and kind of error."""
    margins: dict[tuple[Choice, str, Kind], float]
    """What is added to log(error), for each choice and group of scenes."""
    bars: dict[tuple[str, str, Kind], float]
    """Factor from the difference of two meshes to an error bar, for each tier and group."""
    low: Array
    """Least features of the table."""
    high: Array
    """Largest features of the table."""
    counts: dict[str, int]
    """Scenes of each group."""

    def error(self, features: Features, choice: Choice, kind: Kind) -> float:
        """Error that `PROMISED` of scenes like it stay below, over the probe's scale."""
        row = inputs(features, choice)[None]
        margin = self.margins[_without_precision(choice), features.group, kind]
        return float(np.exp(self.fits[choice.tier, kind](row)[0] + margin))

    def outside(self, features: Features, tier: str) -> list[tuple[str, float, float, float]]:
        """Features beyond the table that count for a tier: name, value, least, largest allowed."""
        slack = SLACK * (self.high - self.low)
        least, most = self.low - slack, self.high + slack
        found = []
        for name, value, a, b in zip(NAMES, features.values(), least, most, strict=True):
            if name not in UNSEEN[tier] and not a <= value <= b:
                found.append((name, float(value), float(a), float(b)))
        return found

    def choices(self) -> list[Choice]:
        """Every choice that the table has errors of."""
        return sorted({choice for choice, _group, _kind in self.margins})


def fit(table: Table) -> Model:
    """The model of a table.

    Raises:
        ValueError: Fewer scenes than `FOLDS`.
    """
    rows = [row for row in table.rows if row.choice.precision == "float32"]
    scenes = sorted({row.scene for row in rows})
    if len(scenes) < FOLDS:
        raise ValueError(f"{len(scenes)} scenes; allowed: {FOLDS} or more")
    fold = {scene: index % FOLDS for index, scene in enumerate(scenes)}
    fits: dict[tuple[str, Kind], Fit] = {}
    margins: dict[tuple[Choice, str, Kind], float] = {}
    for tier in ("layer", "fem"):
        mine = [row for row in rows if row.choice.tier == tier]
        features = np.array([inputs(row.features, row.choice) for row in mine])
        folds = np.array([fold[row.scene] for row in mine])
        for kind in KINDS:
            error = np.array([row.error[kind] for row in mine])
            value = np.log(np.maximum(error, LEAST))
            good = np.isfinite(value)
            fits[tier, kind] = ridge(features[good], value[good])
            missed = _missed(features, value, folds)
            for choice in sorted({row.choice for row in mine}):
                for group in GROUPS:
                    chosen = [
                        miss
                        for row, miss in zip(mine, missed, strict=True)
                        if row.choice == choice and row.features.group == group
                    ]
                    margins[choice, group, kind] = quantile(chosen)
    first = {row.scene: row.features for row in rows}
    values = np.array([features.values() for features in first.values()])
    counts = {
        group: sum(features.group == group for features in first.values()) for group in GROUPS
    }
    return Model(fits, margins, _bars(rows), values.min(axis=0), values.max(axis=0), counts)


def inputs(features: Features, choice: Choice) -> Array:
    """What the logarithm of an error is a linear function of (M,)."""
    flags = [
        features.poisson,
        min(features.friction, 1.0),
        features.shear,
        features.side,
        features.viscous,
        features.depth / features.contact,
        math.log(features.depth),
    ]
    if choice.tier == "layer":
        lengths = (features.contact, features.sharpest, features.width)
        return np.array([*flags, *(math.log(length) for length in lengths)])
    size = 1 / choice.cells
    lengths = (features.contact_least, features.sharpest, features.contact)
    # An element below a radius by far gains nothing more: the softened logarithm bends there.
    return np.array([*flags, math.log(size), *(math.log(size / one) for one in lengths),
                     math.log1p(size / features.sharpest)])  # fmt: skip


def quantile(missed: Sequence[float], share: float = PROMISED) -> float:
    """The conformal quantile: the ceil((n + 1) share)-th smallest of n.

    Where n is too small to have one, the largest and `FEW` (of a logarithm: its own) on top; inf
    where there is nothing.
    """
    ordered = np.sort(np.asarray(missed, float))
    if not len(ordered):
        return math.inf
    place = math.ceil((len(ordered) + 1) * share)
    if place > len(ordered):
        return float(ordered[-1]) + math.log(FEW)
    return float(ordered[place - 1])


def ridge(features: Array, values: Array) -> Fit:
    """The ridge regression of values (N,) on features (N, M)."""
    mean = features.mean(axis=0)
    scale = features.std(axis=0)
    scale[scale < 1e-12] = 1.0
    unit = np.column_stack([np.ones(len(values)), (features - mean) / scale])
    weight = np.full(unit.shape[1], RIDGE)
    weight[0] = 0.0
    return Fit(mean, scale, np.linalg.solve(unit.T @ unit + np.diag(weight), unit.T @ values))


def _missed(features: Array, value: Array, folds: NDArray[np.int64]) -> list[float]:
    """log(error) less what a fit without the row's scene predicts; inf where it was not solved."""
    missed = np.full(len(value), np.inf)
    good = np.isfinite(value)
    for left_out in np.unique(folds):
        others = ridge(features[good & (folds != left_out)], value[good & (folds != left_out)])
        mine = good & (folds == left_out)
        missed[mine] = value[mine] - others(features[mine])
    return [float(value) for value in missed]


def _bars(rows: Sequence[CostRow]) -> dict[tuple[str, str, Kind], float]:
    found: dict[tuple[str, str, Kind], float] = {}
    for tier in ("layer", "fem"):
        for group in GROUPS:
            for kind in KINDS:
                ratios = [
                    math.log(max(row.error[kind], LEAST) / max(row.bar[kind], BAR_FLOOR[kind]))
                    for row in rows
                    if row.choice.tier == tier
                    and row.features.group == group
                    and math.isfinite(row.bar[kind])
                    and math.isfinite(row.error[kind])
                ]
                found[tier, group, kind] = math.exp(quantile(ratios)) if ratios else math.inf
    return found


def _without_precision(choice: Choice) -> Choice:
    """float32 is as exact as float64 here (docs/results/cost-table.md).

    And goes on in it where it must.
    """
    return Choice(choice.tier, choice.cells)
