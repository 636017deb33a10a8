"""Coverage of a transferred model's intervals over skins of random modulus.

    make demo-transfer
    python -m benchmarks transfer-skins runs/demo-transfer --out docs/results/transfer.md

The model of the demo is tested on the same sensor with other skins. In the `layer` tier a skin of
another modulus deforms alike when it is pressed as deep, and its forces are in proportion, so the
demo's frames and scaled forces are those of the other skin.
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from learning.data.matching import SensorSelection
from learning.force.calibrate import presses_of_rows
from learning.force.intervals import Intervals, ScaleSample, measured_scale
from learning.force.model import load_force_model
from learning.transfer.score import NewFrames, Score, new_frames, score_of
from recorder import MarkerArchive
from recorder.command_line.options import positive, whole
from recorder.pages import render
from recorder.store import replace_file

GRAVITY = 9.80665
PAGE = Path(__file__).with_name("page.md")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of the benchmark."""
    parser.description = "Coverage of a transferred model's intervals over random skins."
    parser.add_argument("run", type=Path, metavar="RUN", help="folder of make demo-transfer")
    parser.add_argument("--skins", type=whole(1), default=20, help="(%(default)s)")
    parser.add_argument(
        "--within", type=positive, default=2.0, help="largest factor of their moduli (%(default)s)"
    )
    parser.add_argument(
        "--grams", type=positive, default=200.0, help="mass of the one weight [g] (%(default)s)"
    )
    parser.add_argument("--seed", type=whole(0), default=0, help="(%(default)s)")
    parser.add_argument("--out", type=Path, metavar="PAGE", help="page to write (none)")


@dataclass(frozen=True, slots=True)
class Skin:
    """Scores on one skin."""

    ratio: float
    """Modulus over that of the source's skin."""
    without: Score
    """Without a weight."""
    weighed: Score
    """With one weight."""
    factor: float
    """Factor within which the scale is then known."""


@dataclass(frozen=True, slots=True, eq=False)
class Presses:
    """Force-depth presses, on which weights are laid."""

    true: NDArray[np.float64]
    """Compression (n,) [N]."""
    predicted: NDArray[np.float64]
    """Predicted compression (n,) [N]."""


def run(options: argparse.Namespace) -> int:
    """Measure, print and write the page."""
    archive = MarkerArchive(options.run / "bare.markers.zarr")
    model = options.run / "model"
    frames = new_frames(model, SensorSelection(archive, "bare", "bare"))
    presses = force_depth(archive, model)
    own = modulus(archive)
    stiffness = modulus(MarkerArchive(options.run / "gauge.markers.zarr"))
    random = np.random.default_rng(options.seed)
    ratios = options.within ** random.uniform(-1, 1, options.skins)
    weight = 1e-3 * GRAVITY * options.grams
    skins = [skin_of(ratio, ratio * stiffness / own, frames, presses, weight) for ratio in ratios]
    for skin in sorted(skins, key=lambda each: each.ratio):
        print(
            f"modulus x {skin.ratio:.2f}: without R2 {skin.without.errors.r2_mean:.3f}, coverage "
            f"{100 * skin.without.coverage:.1f} %; one weight R2 "
            f"{skin.weighed.errors.r2_mean:.3f}, coverage {100 * skin.weighed.coverage:.1f} %"
        )
    lines = summary(skins)
    for name, values in lines.items():
        print(f"{name}: " + ", ".join(f"{key} {value}" for key, value in values.items()))
    if options.out is not None:
        page = render(
            PAGE,
            grams=options.grams,
            within=options.within,
            skins=sorted(skins, key=lambda each: each.ratio),
            lines=lines,
        )
        replace_file(options.out, page.encode())
        print(f"{options.out}: written")
    return 0


def modulus(archive: MarkerArchive) -> float:
    """Return the modulus of an archive's only simulated sensor [Pa]."""
    (sensor,) = archive.attrs["plan"]["sensors"]
    return float(sensor["body"]["modulus"])


def force_depth(archive: MarkerArchive, model_folder: Path) -> Presses:
    """Predict the force-depth presses of the target."""
    sensor, model = archive["bare"], load_force_model(model_folder)
    table = sensor.table
    rows = np.flatnonzero((table["location"] < 0) & table["valid"])
    presses = presses_of_rows(sensor, rows, model)
    true = -np.asarray(table["wrench"][presses.rows.numpy(), 2], np.float64)
    return Presses(true, -model.predict(presses)[:, 2])


def skin_of(
    ratio: float, scaled: float, frames: NewFrames, presses: Presses, weight: float
) -> Skin:
    """Return the scores on a skin whose true forces are `scaled` times the demo's."""
    true = scaled * frames.true
    without = score_of(replace(frames, true=true))
    row = int(np.argmin(np.abs(scaled * presses.true - weight)))
    known, predicted = scaled * float(presses.true[row]), float(presses.predicted[row])
    value, intervals = weighed(frames.intervals, known, predicted)
    predicted_then = value * frames.predicted
    found = score_of(replace(frames, predicted=predicted_then, true=true, intervals=intervals))
    return Skin(ratio, without, found, intervals.scale.factor)


def weighed(intervals: Intervals, known: float, predicted: float) -> tuple[float, Intervals]:
    """Return the factor on forces, and the intervals, after one weight [N]."""
    axis = intervals.axes[2]
    if axis is None:
        raise ValueError("the demo's model predicts Fz")
    held = ScaleSample(known, predicted, axis.base + axis.slope * predicted)
    value, scale = measured_scale([held], intervals.scale, "one weight")
    return value, intervals.rescaled(value, scale)


def summary(skins: list[Skin]) -> dict[str, dict[str, str]]:
    """Return mean, least and largest coverage and R2, without and with a weight."""
    found = {}
    for name, scores in (
        ("without a weight", [skin.without for skin in skins]),
        ("with one weight", [skin.weighed for skin in skins]),
    ):
        covered = 100 * np.array([score.coverage for score in scores])
        fits = np.array([score.errors.r2_mean for score in scores])
        width = np.array([score.width[2] for score in scores])
        found[name] = {
            "coverage": f"{covered.mean():.1f} %",
            "least": f"{covered.min():.1f} %",
            "most": f"{covered.max():.1f} %",
            "R2": f"{fits.mean():.3f}",
            "least R2": f"{fits.min():.3f}",
            "interval of Fz": f"+-{width.mean():.3f} N",
        }
    return found
