"""Coverage of a transferred model's intervals over skins of random modulus.

The model of `make demo-transfer` is tested on the same sensor with other skins. In the `layer` tier
a skin of another modulus deforms alike when it is pressed as deep, and its forces are in
proportion, so the demo's frames and scaled forces are those of the other skin.
"""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.paper.study import folder_of, simulate
from benchmarks.report import ROOT, Page, Run, table
from learning.choice.run import Request, carried_labels, run_choice
from learning.data.matching import SensorSelection
from learning.force.calibrate import presses_of_rows
from learning.force.intervals import ScaleSample, measured_scale
from learning.force.loading import load_force_model
from learning.transfer.carry import CarryRequest, carry
from learning.transfer.score import NewFrames, new_frames, score_of
from recorder import MarkerArchive
from recorder.progress import span_of
from sim.dataset import DatasetPlan, Solving
from sim.sensors import sensor_of

Floats = NDArray[np.float64]
GRAVITY = 9.80665
# Largest factor of the moduli, mass of the weight [g], number of skins, and seed of all draws.
WITHIN, GRAMS, SKINS, SEED = 2.0, 200.0, 20, 0
SOURCE, TARGET = "gauge", "bare"
FRACTION, PHASE = 0.025, 4
# Ways of the demo: nets take much longer.
WAYS = ("mean", "ridge", "cells", "kernel")
TOY: dict[str, Any] = {"indenters": ("sphere", "sphere_s", "prism"), "fraction": 0.01, "steps": 2}


def measure(run: Run) -> dict[str, Any]:
    """Transfer to a sensor without a gauge, and score its model on random skins."""
    folder, archives = folder_of(run, "gauge-coverage"), {}
    for done, name in enumerate((SOURCE, TARGET)):
        row = sensor_of(str(ROOT / "examples" / "demo-transfer" / f"{name}.yaml"))
        amount: dict[str, Any] = TOY if run.quick else {"fraction": FRACTION, "steps": PHASE}
        plan = DatasetPlan("targets", (row,), solving=Solving(tier="layer"), **amount)
        path = folder / f"{name}.markers.zarr"
        progress = span_of(run.progress, 0.2 * done, 0.2)
        archives[name] = simulate(path, plan, run, progress, "cpu")
    source, target = (SensorSelection(archives[name], name, name) for name in (SOURCE, TARGET))
    matched = carry(CarryRequest(source, target, folder / "steps"), lambda line: None)
    joined = SensorSelection(matched.archive, TARGET, TARGET)
    ways = ("ridge",) if run.quick else WAYS
    one = Request(joined, folder / "model", ways=ways, device=run.device)
    run_choice(one, carried_labels(matched, SOURCE), lambda line: None)
    run.progress(0.9)
    count = 4 if run.quick else SKINS
    run.seeds, run.spread = (SEED,), f"{count} skins; one training"
    frames = new_frames(one.out, target)
    own, stiffness = (
        float(archive.attrs["plan"]["sensors"][0]["body"]["modulus"])
        for archive in (archives[TARGET], archives[SOURCE])
    )
    pressed = force_depth(archives[TARGET], one.out)
    ratios = sorted(WITHIN ** np.random.default_rng(SEED).uniform(-1, 1, count))
    return {
        "skins": [of_skin(ratio, ratio * stiffness / own, frames, *pressed) for ratio in ratios]
    }


def force_depth(archive: MarkerArchive, folder: Path) -> tuple[Floats, Floats]:
    """Return true and predicted compression (n,) [N] of the target's force-depth presses."""
    one, model = archive[TARGET], load_force_model(folder)
    rows = np.flatnonzero((one.table["location"] < 0) & one.table["valid"])
    presses = presses_of_rows(one, rows, model)
    true = -np.asarray(one.table["wrench"][presses.rows.numpy(), 2], np.float64)
    return true, -model.predict(presses)[:, 2]


def of_skin(
    ratio: float, scaled: float, frames: NewFrames, true_n: Floats, predicted_n: Floats
) -> dict[str, Any]:
    """Return the scores on a skin whose true forces are `scaled` times the demo's.

    Without a weight, and with the one whose force-depth frame is nearest to its force.
    """
    true = scaled * frames.true
    row = int(np.argmin(np.abs(scaled * true_n - 1e-3 * GRAVITY * GRAMS)))
    known, predicted = scaled * float(true_n[row]), float(predicted_n[row])
    axis = frames.intervals.axes[2]
    assert axis is not None
    held = ScaleSample(known, predicted, axis.base + axis.slope * predicted)
    value, scale = measured_scale([held], frames.intervals.scale, "one weight")
    after = replace(
        frames,
        predicted=value * frames.predicted,
        true=true,
        intervals=frames.intervals.rescaled(value, scale),
    )
    scores = {"without": score_of(replace(frames, true=true)), "weighed": score_of(after)}
    return {"modulus": float(ratio)} | {
        name: {
            "coverage": score.coverage,
            "r2": score.errors.r2_mean,
            "width_fz_n": float(score.width[2]),
        }
        for name, score in scores.items()
    }


def section(values: dict[str, Any], page: Page) -> str:
    """Return coverage and R2 over the skins."""
    lines = []
    for words, key in (("without a weight", "without"), (f"with one of {GRAMS:g} g", "weighed")):
        parts = [skin[key] for skin in values["skins"]]
        covered = 100 * np.array([each["coverage"] for each in parts])
        fits = np.array([each["r2"] for each in parts])
        spread = f"{covered.min():.1f} to {covered.max():.1f} %"
        width = np.mean([each["width_fz_n"] for each in parts])
        r2 = f"{fits.mean():.3f} ({fits.min():.3f} to {fits.max():.3f})"
        lines.append([words, f"{covered.mean():.1f} %", spread, r2, f"+-{width:.3f} N"])
    head = ["", "coverage of 90 % intervals", "of a skin", "R2 (of a skin)", "interval of Fz"]
    return f"""## Coverage of intervals over skins

The model of `make demo-transfer` on {len(values["skins"])} skins, whose moduli are drawn
log-uniformly from 1/{WITHIN:g} to {WITHIN:g} times that of the source's. It knows none of them:
without a weight the scale is assumed within a factor of 2; a weight measures it. Six indenters that
no stage saw. By tier `layer`, in which another modulus scales the forces of a press and leaves its
pictures as they are: skins of another thickness are not among them.

{table(head, lines)}"""
