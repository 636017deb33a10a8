"""Experiments on the ways to forces, by which the best that a sensor's data allow is taken.

They are those of `benchmarks/gauge`: planted sensors whose true forces are known, indenters that no
stage saw, means of pairs and seeds.
"""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

from learning.config import READER

# Origins of labels, the best first, and words for them.
OWN, TWIN, SOURCE, BALANCE = "own", "twin", "source", "balance"
LABELS = {
    OWN: "its own labels",
    TWIN: "the forces of its twin",
    SOURCE: "another sensor's labels",
    BALANCE: "balance with the other finger of a hand",
}
FILE = Path(__file__).with_name("evidence.yaml")


def read_evidence() -> list[dict[str, Any]]:
    """Return the rows: origin and way, presses with a gauge, R2 between kinds, skins, patterns."""
    rows: list[dict[str, Any]] = READER.read(FILE)["rows"]
    return rows


def lines_of_way(chosen: str) -> Iterator[str]:
    """Yield the table of the ways, with a mark at the chosen one."""
    yield f"  {'R2, simulated, between':38s} {'kinds':>7s} {'skins':>7s} {'patterns':>8s}  presses"
    for row in read_evidence():
        mark = "*" if row["by"] == chosen else " "
        fits = [row[name] for name in ("kinds", "skins", "patterns")]
        values = f"{fits[0]:7.3f} {fits[1]:7.3f} {fits[2]:8.3f}"
        yield f"{mark} {row['way']:38s} {values}  {row['presses']}"
    if chosen == BALANCE:
        yield f"* {LABELS[BALANCE]}: Fz alone; docs/how-to/calibrate-by-balance.md"
    yield "presses: with a gauge on the sensor; docs/results/gauge.md has intervals"
