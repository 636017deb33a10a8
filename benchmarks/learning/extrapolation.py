"""Forces beyond the training range: models of a sensor's own labels, within and outside of it.

    python -m benchmarks extrapolation X.markers.zarr --sensor gelsight --device cuda:0

Each preset is trained with each seed on the indenters that the archive lists as seen, and tested on
the unseen ones. A frame is outside the range if a force component exceeds that of all training
labels. The table has the mean and the smallest and largest R2 over the seeds.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from learning.config import read_settings
from learning.data.presses import Presses, load_presses
from learning.data.splits import make_split
from learning.errors import LearningError
from learning.force.model import ForceModel
from learning.force.train import PRESETS, ForceModelSettings, train_force
from learning.metrics import r_squared
from recorder import MarkerArchive
from recorder.command_line.options import add_device
from recorder.progress import ItemProgress

Forces = NDArray[np.float64]


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of the benchmark."""
    parser.description = "R2 of forces within and beyond the range of the training labels."
    parser.add_argument("archive", metavar="ARCHIVE", help="X.markers.zarr with labels")
    parser.add_argument("--sensor", metavar="NAME", help="a sensor of it (the first)")
    presets = "tiny,displacement,superposed"
    parser.add_argument(
        "--presets",
        metavar="NAME,...",
        default=presets,
        help="presets of `train force` (%(default)s)",
    )
    parser.add_argument(
        "--seeds", metavar="N", type=int, default=3, help="trainings of each (%(default)s)"
    )
    parser.add_argument("--epochs", metavar="N", type=int, help="epochs (as in each preset)")
    add_device(parser)


def run(options: argparse.Namespace) -> int:
    """Train, test and print the table."""
    archive = MarkerArchive(Path(options.archive))
    names = list(archive)
    name = options.sensor or names[0]
    if name not in names:
        raise LearningError(f"--sensor: found {name}; known: {', '.join(names)}")
    split, device = make_split(archive), torch.device(options.device)
    loaded: dict[str, tuple[Presses, Presses, Presses]] = {}
    lines = []
    for preset in options.presets.split(","):
        sets = [f"launch.device={device.type}"]
        if options.epochs is not None:
            stage = f"{{epochs: {options.epochs}, learning_rate: 0.001, schedule: cosine}}"
            sets.append(f"stages=[{stage}]")
        settings = read_settings(ForceModelSettings, PRESETS, preset, sets)
        form = settings.input.stored_form
        if form not in loaded:
            with ItemProgress("frames", sys.stderr) as frames:
                sensor = archive[name]
                train, validation, test = (
                    load_presses(
                        sensor,
                        split.rows(sensor.table, role),
                        device=device,
                        form=form,
                        progress=frames,
                    )
                    for role in ("train", "validation", "new_indenter")
                )
            loaded[form] = train, validation, test
        train, validation, test = loaded[form]
        scores = []
        for seed in range(options.seeds):
            settings = read_settings(ForceModelSettings, PRESETS, preset, [*sets, f"seed={seed}"])
            model = train_force(train, settings, validation=validation)
            scores.append([*_scores(model, train, test)])
            print(f"{preset}, seed {seed}: {_line(np.array(scores[-1:]))}", file=sys.stderr)
        lines.append(f"| {preset} | {_line(np.array(scores))} |")
    outside = _outside(loaded[form][0], loaded[form][2])
    print(f"{name}: {len(train)} training presses, {test.frames:,} test frames, of which")
    print(f"{np.mean(outside):.1%} are outside the range of the training labels\n")
    print(
        "| preset | R2, all frames | within the range | outside | without the strongest indenter |"
    )
    print("|---|---|---|---|---|")
    print("\n".join(lines))
    return 0


def _scores(model: ForceModel, train: Presses, test: Presses) -> Iterator[float]:
    """Yield R2, mean over axes: of all frames, in and out of range, without one indenter."""
    true = test.wrench[:, :3].double().cpu().numpy()
    predicted = model.predict(test)
    outside = _outside(train, test)
    strongest = _of_strongest(test, true)
    for rows in (np.ones(len(true), bool), ~outside, outside, ~strongest):
        yield float(r_squared(true[rows], predicted[rows]).mean()) if rows.sum() > 1 else np.nan


def _outside(train: Presses, test: Presses) -> NDArray[np.bool_]:
    known = train.wrench[:, :3].double().cpu().numpy()
    true = test.wrench[:, :3].double().cpu().numpy()
    return np.asarray(((true < known.min(axis=0)) | (true > known.max(axis=0))).any(axis=1))


def _of_strongest(test: Presses, true: Forces) -> NDArray[np.bool_]:
    lengths = test.starts.diff().cpu()
    indenters = test.indenter.cpu().repeat_interleave(lengths).numpy()
    return np.asarray(indenters == indenters[np.abs(true[:, 2]).argmax()])


def _line(scores: Forces) -> str:
    """Return the cells of the table for scores (seeds, columns)."""
    cells = []
    for column in scores.T:
        spread = f" ({column.min():.3f} to {column.max():.3f})" if len(column) > 1 else ""
        cells.append(f"{column.mean():.3f}{spread}")
    return " | ".join(cells)
