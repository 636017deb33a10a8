"""What a choice will take: how much work a scene is, and what work costs on a device.

Work (elements, Newton and conjugate-gradient iterations) is read from the cost table, whatever
machine it was measured on: its logarithm is a linear function of the scene's features and of the
logarithms of mesh and steps. Seconds are a sum of shares per press, per iteration and per element
and iteration, with no share below 0, fitted to presses timed one by one on that device.
"""

from __future__ import annotations

import csv
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import nnls

from sim.errors import SceneError
from sim.planner.error_model import Fit, Table, inputs, ridge
from sim.planner.features import Choice, Features

Array = NDArray[np.float64]

STORED = Path(__file__).parent / "seconds.csv"
"""Presses timed one by one, on each device."""
COLUMNS = ("device", "machine", "tier", "cells", "precision", "elements", "newton", "cg",
            "frames", "seconds")  # fmt: skip


@dataclass(frozen=True, slots=True)
class Timed:
    """One press alone."""

    device: str
    """`cpu` or `cuda`."""
    machine: str
    choice: Choice
    elements: float
    newton: float
    cg: float
    frames: int
    seconds: float


@dataclass(frozen=True, slots=True)
class SecondsModel:
    """Predicts seconds; made by `fit_seconds`."""

    work: dict[tuple[str, str], Fit]
    """For each tier and kind of work, its logarithm."""
    shares: dict[tuple[str, str, str], Array]
    """For each device, tier and precision, seconds per term of `_terms`."""

    def __call__(self, features: Features, choice: Choice, device: str) -> float:
        """Seconds of one press, kernels compiled.

        Raises:
            SceneError: Nothing was timed on such a device.
        """
        kind = "cpu" if choice.tier == "layer" else device_kind(device)
        shares = self.shares.get((kind, choice.tier, choice.precision))
        if shares is None:
            known = sorted({one for one, _tier, _precision in self.shares})
            raise SceneError(
                f"device: {device!r} with a tolerance; allowed: {', '.join(known)} (others once "
                "`python -m benchmarks cost-table --seconds` has timed them)"
            )
        work = self.predicted_work(features, choice)
        return float(_terms(work["elements"], work["newton"], work["cg"], choice.tier) @ shares)

    def predicted_work(self, features: Features, choice: Choice) -> dict[str, float]:
        """Elements, Newton and conjugate-gradient iterations of one press."""
        place = _work_inputs(features, choice)
        return {
            name: math.exp(float(self.work[choice.tier, name](place)[0]))
            for name in ("elements", "newton", "cg")
        }


def device_kind(device: str) -> str:
    """`cpu` or `cuda`, of a device such as `cuda:0`."""
    return device.partition(":")[0]


def fit_seconds(table: Table, timed: Sequence[Timed]) -> SecondsModel:
    """The model of a table's work and of timed presses."""
    work: dict[tuple[str, str], Fit] = {}
    for tier in ("layer", "fem"):
        rows = [
            row
            for row in table.rows
            if row.choice.tier == tier and row.choice.precision == "float32" and row.work["newton"]
        ]
        features = np.concatenate([_work_inputs(row.features, row.choice) for row in rows])
        for name in ("elements", "newton", "cg"):
            values = np.log([max(row.work[name], 1.0) for row in rows])
            work[tier, name] = ridge(features, values)
    shares: dict[tuple[str, str, str], Array] = {}
    for key in {(one.device, one.choice.tier, one.choice.precision) for one in timed}:
        mine = [o for o in timed if (o.device, o.choice.tier, o.choice.precision) == key]
        terms = np.array([_terms(o.elements, o.newton, o.cg, key[1]) for o in mine])
        seconds = np.array([one.seconds for one in mine])
        # Relative errors count: a press of milliseconds as much as one of minutes.
        shares[key] = nnls(terms / seconds[:, None], np.ones(len(mine)))[0]
    return SecondsModel(work, shares)


def read(path: Path | None = None) -> list[Timed]:
    """The presses that `write` wrote; the stored ones unless a file is named."""
    with (path or STORED).open(encoding="utf-8", newline="") as file:
        return [
            Timed(
                device=line["device"],
                machine=line["machine"],
                choice=Choice(line["tier"], int(line["cells"]), line["precision"]),  # type: ignore[arg-type]
                elements=float(line["elements"]),
                newton=float(line["newton"]),
                cg=float(line["cg"]),
                frames=int(line["frames"]),
                seconds=float(line["seconds"]),
            )
            for line in csv.DictReader(file)
        ]


def _work_inputs(features: Features, choice: Choice) -> Array:
    """What the logarithm of work is a linear function of (1, M)."""
    mesh = inputs(features, choice)
    more = [math.log(features.steps), math.log(features.width), float(features.friction > 0)]
    return np.concatenate([mesh, more])[None]


def _terms(elements: float, newton: float, cg: float, tier: str) -> Array:
    """What seconds are a sum of shares of."""
    if tier == "layer":
        return np.array([1.0, newton])
    return np.array([1.0, newton, cg, elements * newton, elements * cg])
