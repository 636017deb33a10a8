"""Do 90 % intervals contain 90 % of the forces, on drawn indenters that nothing else uses?

Intervals are those of a delivered model (`learning.force.intervals`): calibrated on some drawn
indenters, tested on others.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.learning.gauge_tables.jobs import Study, further_path, trained
from learning.compensation.simulated import twin_forces
from learning.data.presses import load_presses
from learning.force.calibrate import scale_of_twin
from learning.force.intervals import Intervals, LearnedShapes, Scale, fit_errors
from learning.force.labels import by_twins
from learning.training.run import generator
from recorder import MarkerArchive
from recorder.store import replace_file
from sim.indenters import drawn_name

Floats = NDArray[np.float64]

NET = "displacement"
TWIN, TRUE = "the twin's forces", "true forces"
# Labels that a net learns from, and forces that its intervals are calibrated with.
CASES = ((TWIN, TWIN), (TWIN, TRUE), (TRUE, TRUE))
# Resamples of test indenters, and the interval between their quantiles.
RESAMPLES, INTERVAL = 2000, (0.025, 0.975)


def coverage_path(out: Path, sensor: str, seed: int) -> Path:
    """Return the path of the coverage of a sensor's intervals."""
    return out / "coverage" / f"{sensor}-{seed}.jsonl"


def run_job(study: Study, name: str) -> None:
    """Train nets on a sensor's frames, and write the coverage of their intervals.

    Raises:
        LearningError: A sensor has no forces of a twin, or a training diverged.
    """
    _, sensor, seed = name.split()
    told = list(_covered(replace(study, seed=int(seed)), sensor))
    path = coverage_path(study.out, sensor, int(seed))
    path.parent.mkdir(parents=True, exist_ok=True)
    replace_file(path, "".join(json.dumps(each) + "\n" for each in told).encode())
    for each in told:
        print(json.dumps({**each, "indenters": "..."}), flush=True)


def _covered(study: Study, sensor: str) -> Iterator[dict[str, Any]]:
    presses = study.presses(sensor, "train", "field")
    labels = twin_forces(study.archive[sensor])
    models = {
        TWIN: trained(study, NET, by_twins(labels).of(presses)),
        TRUE: trained(study, NET, presses),
    }
    archive = MarkerArchive(further_path(study.out, sensor))
    other = archive[sensor]
    first, (calibrating, _) = study.of.drawn, study.of.further
    table = other.table
    names = np.array(archive.indenters)[table["indenter"]]
    known = [drawn_name(number) for number in range(first, first + sum(study.of.further))]
    rows = np.flatnonzero(table["valid"] & (table["location"] >= 0) & np.isin(names, known))
    frames = load_presses(other, rows, device=study.device, form="field")
    rows = frames.rows.numpy()
    forces = {
        TRUE: table["wrench"][rows, :3].astype(np.float64),
        TWIN: twin_forces(other).force[rows],
    }
    names = names[rows]
    calibrates = np.isin(names, known[:calibrating])
    for learned, wanted in CASES:
        predicted = models[learned].predict(frames)
        scale = (
            scale_of_twin(other, rows[calibrates])
            if wanted == TWIN
            else Scale(1.0, "labels", False)
        )
        axes = fit_errors(predicted[calibrates], forces[wanted][calibrates], names[calibrates])
        intervals = Intervals(
            axes=axes,
            scale=scale,
            largest=(None, None, None),
            learned=LearnedShapes((), (), math.inf),
            frames=int(calibrates.sum()),
            indenters=tuple(known[:calibrating]),
            errors_from=wanted,
        )
        low, high = intervals.of(predicted)
        inside = (low <= forces[TRUE]) & (forces[TRUE] <= high)
        tested = {
            str(name): inside[names == name].mean(axis=0).tolist()
            for name in np.unique(names[~calibrates])
        }
        yield {
            "learned": learned,
            "calibrated": wanted,
            "sensor": sensor,
            "seed": study.seed,
            "scale": scale.factor,
            "width": ((high - low)[~calibrates].mean(axis=0) / 2).tolist(),
            "error": np.abs(predicted - forces[TRUE])[~calibrates].mean(axis=0).tolist(),
            "indenters": tested,
        }


@dataclass(frozen=True, slots=True)
class Covered:
    """Coverage of the intervals of one kind, mean over axes, sensors and seeds."""

    learned: str
    calibrated: str
    sensors: int
    seeds: int
    indenters: int
    fraction: float
    """Fraction of frames whose force is in its interval; each indenter counts alike."""
    low: float
    high: float
    """95 % interval of the fraction, by drawing indenters again."""
    least: float
    """Fraction of the sensor with the smallest one."""
    width: tuple[float, float]
    """Mean half-width of shear and Fz [N]."""
    error: tuple[float, float]
    """Mean absolute error of shear and Fz [N]."""


def read_covered(study: Study, seeds: Sequence[int]) -> list[Covered]:
    """Return the coverage of what has run."""
    paths = [coverage_path(study.out, name, seed) for name in study.sensors for seed in seeds]
    told = [
        json.loads(line)
        for path in paths
        if path.exists()
        for line in path.read_text(encoding="utf-8").splitlines()
    ]
    found = []
    for case in CASES:
        these = [each for each in told if (each["learned"], each["calibrated"]) == case]
        if these:
            found.append(_summary(*case, these))
    return found


def _summary(learned: str, calibrated: str, these: Sequence[Mapping[str, Any]]) -> Covered:
    known = sorted({name for each in these for name in each["indenters"]})
    # A press without a solution has no frame: NaN. By run and indenter, mean over axes.
    shares = np.array(
        [[np.mean(each["indenters"].get(name, np.nan)) for name in known] for each in these]
    )
    random = generator(0, "coverage")
    drawn = random.integers(len(known), size=(RESAMPLES, len(known)))
    again = np.nanmean(np.nanmean(shares, axis=0)[drawn], axis=1)
    low, high = np.quantile(again, INTERVAL)
    by_run = np.nanmean(shares, axis=1)
    sensors = sorted({each["sensor"] for each in these})
    of_sensor = [by_run[[each["sensor"] == name for each in these]].mean() for name in sensors]
    width, error = (np.mean([each[name] for each in these], axis=0) for name in ("width", "error"))
    return Covered(
        learned,
        calibrated,
        len(sensors),
        len({each["seed"] for each in these}),
        len(known),
        float(np.nanmean(shares)),
        float(low),
        float(high),
        float(min(of_sensor)),
        (float(width[:2].mean()), float(width[2])),
        (float(error[:2].mean()), float(error[2])),
    )
