"""Whether promises hold: scenes that the table was not made from, planned and checked."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

from sim.planner.error_model import BAR_FLOOR, CostRow, Model, Table
from sim.planner.features import GROUPS, KINDS, Choice, Features, Kind

TOLERANCES: dict[Kind, tuple[float, ...]] = {
    "share": (0.2, 0.1, 0.05, 0.03, 0.02, 0.01),
    "force": (0.1, 0.05, 0.02, 0.01),
    "marker": (0.3, 0.1, 0.05, 0.02),
}
"""Tolerances that are asked for: force over the largest force, markers over their motion."""


@dataclass(frozen=True, slots=True)
class Verdict:
    """What came of asking for one tolerance on one scene."""

    scene: str
    group: str
    kind: Kind
    tolerance: float
    choice: Choice | None
    """None: refused, nothing reaches it."""
    error: float
    """True error of the choice; inf where it found no solution."""
    bar: float
    """Error bar of the choice; NaN where it has none."""

    @property
    def kept(self) -> bool:
        """Whether the promise held."""
        return self.error <= self.tolerance

    @property
    def covered(self) -> bool | None:
        """Whether the error bar holds the true error; None without one."""
        return None if math.isnan(self.bar) else self.error <= self.bar


@dataclass(frozen=True, slots=True)
class Validation:
    """Verdicts on all scenes and tolerances, and the scenes that the table does not cover."""

    verdicts: tuple[Verdict, ...]
    outside: dict[str, tuple[str, ...]]
    """For each scene beyond the table, the features that are."""
    scenes: int

    def chosen(self, kind: Kind | None = None, group: str | None = None) -> list[Verdict]:
        """Verdicts that were promises, of a kind and a group."""
        return [
            one
            for one in self.verdicts
            if one.choice is not None
            and (kind is None or one.kind == kind)
            and (group is None or one.group == group)
        ]

    @property
    def planned(self) -> int:
        """Scenes for which at least one promise was made."""
        return len({one.scene for one in self.chosen()})


def validate(model: Model, table: Table) -> Validation:
    """Ask for every tolerance on every scene of `table`, and hold its errors against it.

    The choice is that of `plan`, with fewer elements for cheaper: `layer` first, then ever finer
    meshes of `fem`.
    """
    rows: dict[str, dict[Choice, CostRow]] = {}
    for row in table.rows:
        if row.choice.precision == "float32":
            rows.setdefault(row.scene, {})[row.choice] = row
    verdicts: list[Verdict] = []
    outside: dict[str, tuple[str, ...]] = {}
    for scene, mine in rows.items():
        features = next(iter(mine.values())).features
        beyond = model.outside(features, "fem")
        if beyond:
            outside[scene] = tuple(name for name, *_ in beyond)
            continue
        for kind in KINDS:
            for tolerance in TOLERANCES[kind]:
                verdicts.append(_verdict(model, scene, features, mine, kind, tolerance))
    return Validation(tuple(verdicts), outside, len(rows))


def _verdict(
    model: Model,
    scene: str,
    features: Features,
    mine: dict[Choice, CostRow],
    kind: Kind,
    tolerance: float,
) -> Verdict:
    known = [choice for choice in mine if not model.outside(features, choice.tier)]
    order = sorted(known, key=lambda choice: choice.cells)
    within = [choice for choice in order if model.error(features, choice, kind) <= tolerance]
    group = features.group
    if not within:
        nothing = float("nan")
        return Verdict(scene, group, kind, tolerance, None, nothing, nothing)
    # As `simulate_within` does: what finds no solution is followed by the next dearer one.
    solved = [choice for choice in within if math.isfinite(mine[choice].error[kind])]
    choice = (solved or within)[0]
    row = mine[choice]
    difference = row.bar[kind]
    bar = model.bars[choice.tier, group, kind] * max(difference, BAR_FLOOR[kind])
    if math.isnan(difference):
        bar = float("nan")
    return Verdict(scene, group, kind, tolerance, choice, row.error[kind], bar)


def share_kept(verdicts: Iterable[Verdict]) -> float:
    """Share of promises that held; NaN without any."""
    known = [one.kept for one in verdicts]
    return sum(known) / len(known) if known else float("nan")


def share_covered(verdicts: Iterable[Verdict]) -> float:
    """Share of error bars that hold the true error; NaN without any."""
    known = [one.covered for one in verdicts if one.covered is not None]
    return sum(known) / len(known) if known else float("nan")


def each_bar(model: Model, table: Table) -> list[Verdict]:
    """The error bar of every row of covered scenes, promised or not."""
    found = []
    for row in table.rows:
        if row.choice.precision != "float32" or model.outside(row.features, row.choice.tier):
            continue
        for kind in KINDS:
            if math.isnan(row.bar[kind]) or math.isinf(row.error[kind]):
                continue
            factor = model.bars[row.choice.tier, row.features.group, kind]
            bar = factor * max(row.bar[kind], BAR_FLOOR[kind])
            group = row.features.group
            found.append(
                Verdict(row.scene, group, kind, math.nan, row.choice, row.error[kind], bar)
            )
    return found


def by_group(verdicts: Sequence[Verdict]) -> dict[str, list[Verdict]]:
    """Verdicts of each group."""
    return {group: [one for one in verdicts if one.group == group] for group in GROUPS}
