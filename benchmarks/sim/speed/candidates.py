"""Cost and error of each mesh, and of each pair of meshes, on all presses of the work."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path

from benchmarks.sim.accuracy.chart import Mark, Panel, Series, save_chart
from benchmarks.sim.speed.campaign import meshes_file, presses_file
from benchmarks.sim.speed.forces import (
    SHALLOW_MM,
    Errors,
    Forces,
    errors,
    extrapolated,
    read_forces,
    read_runs,
)
from benchmarks.sim.speed.record import Run, SpeedRecord
from recorder.charts import BLUE, GREEN, PURPLE, RED

# Range of the ratio of the element sizes of two meshes: closer ones amplify random errors.
APART, APART_MOST = 1.3, 5 / 3
# Colours of devices.
COLOURS = (BLUE, RED, GREEN, PURPLE)
# True if there are two meshes, with their mark and name in the chart.
KINDS: tuple[tuple[bool, Mark, str], ...] = (
    (False, "o", "a mesh"),
    (True, "D", "two meshes"),
)


@dataclass(frozen=True, slots=True)
class Candidate:
    """One way to solve all presses, with its cost and errors."""

    spacing_mm: float
    """Element height, of the finer mesh if there are two."""
    coarser_mm: float | None
    """Element height of the coarser mesh; None: there is one mesh."""
    seconds: float
    presses: int
    failed: int
    memory: int
    errors: Errors
    """Errors at depths of at least `SHALLOW_MM`."""

    @property
    def elements(self) -> str:
        """Description of its meshes."""
        if self.coarser_mm is None:
            return f"{self.spacing_mm:.3g} mm"
        return f"{self.coarser_mm:.3g} and {self.spacing_mm:.3g} mm, extrapolated"


def offers_of(record: SpeedRecord, reference: Forces) -> list[Candidate]:
    """Return all meshes of a device from coarse to fine, then all pairs that differ enough.

    Two meshes take the time of both; their forces are extrapolated from both.
    """
    forces = read_runs(meshes_file(record.path))
    forces["all"] = read_forces(presses_file(record.path))
    runs = [*record.of("presses"), *record.of("meshes")]
    runs = sorted((run for run in runs if run.presses), key=lambda run: -run.spacing_mm)
    candidates = [_single(run, forces.get(run.name, {}), reference) for run in runs]
    for coarse, fine in combinations(runs, 2):
        if APART <= coarse.spacing_mm / fine.spacing_mm <= APART_MOST + 1e-3:
            both = forces.get(coarse.name, {}), forces.get(fine.name, {})
            candidates.append(_pair(coarse, fine, *both, reference))
    return candidates


def _single(run: Run, forces: Forces, reference: Forces) -> Candidate:
    off = errors(forces, reference, from_mm=SHALLOW_MM)
    return Candidate(run.spacing_mm, None, run.best, run.presses, run.failed, run.memory, off)


def _pair(coarse: Run, fine: Run, first: Forces, second: Forces, reference: Forces) -> Candidate:
    both = extrapolated(second, first, coarse.spacing_mm / fine.spacing_mm)
    return Candidate(
        spacing_mm=fine.spacing_mm,
        coarser_mm=coarse.spacing_mm,
        seconds=coarse.best + fine.best,
        presses=min(coarse.presses, fine.presses),
        failed=max(coarse.failed, fine.failed),
        memory=max(coarse.memory, fine.memory),
        errors=errors(both, reference, from_mm=SHALLOW_MM),
    )


def cheapest(candidates: Sequence[Candidate], error: float) -> Candidate | None:
    """Return the fastest of the offers that solve every press with mean error up to `error`."""
    good = [one for one in candidates if not one.failed and one.errors.mean <= error]
    return min(good, key=lambda one: one.seconds, default=None)


def save_offer_chart(
    path: Path,
    records: Sequence[SpeedRecord],
    candidates: Sequence[Sequence[Candidate]],
    bound: float,
) -> None:
    """Draw error against seconds of all offers, one panel per summary of the errors.

    Args:
        path: Path of the picture.
        records: Records of all devices.
        candidates: Offers of each device.
        bound: Error of the reference, as a fraction; NaN if unknown.
    """
    panels = []
    for title, measure in (("mean", "mean"), ("95 % below", "most"), ("worst", "worst")):
        series = []
        for record, some, colour in zip(records, candidates, COLOURS, strict=False):
            for two, mark, kind in KINDS:
                points = [
                    (one.seconds, 100 * getattr(one.errors, measure))
                    for one in some
                    if (one.coarser_mm is not None) == two and math.isfinite(one.errors.mean)
                ]
                if points:
                    name = f"{record.machine.name}: {kind}"
                    series.append(Series(name, colour, mark, tuple(sorted(points))))
        panels.append(Panel(title, tuple(series), 100 * bound if measure == "mean" else math.nan))
    save_chart(
        path,
        "Cost of accuracy on the paper's 162 presses",
        panels,
        "error of the force [%]",
        note="Two meshes: their forces extrapolated to zero element size.",
    )
