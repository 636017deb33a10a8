"""`tactile predict`: predict the forces of frames in an archive."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from learning.errors import LearningError
from learning.evaluation.predictions import METHODS, TRANSLATED, Predictions
from learning.metrics import axis_means, force_errors
from recorder.command_line.options import add_device, names
from recorder.progress import ItemProgress

ROLES = "new_indenter,new_press"
AXES = ("Fx", "Fy", "Fz")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of the command."""
    parser.description = (
        "Runs a force model over whole presses of a sensor and writes its forces [N] "
        "with the labels [N], if it has any, for `evaluate`. A model of `transfer` has intervals, "
        "which are written too."
    )
    parser.add_argument("model", type=Path, metavar="MODEL", help="folder of a trained force model")
    parser.add_argument(
        "archive", type=Path, metavar="ARCHIVE", help="X.markers.zarr, with labels or without"
    )
    parser.add_argument("--sensor", required=True, metavar="NAME", help="target sensor")
    parser.add_argument("--split", type=Path, metavar="JSON", help="roles of presses (the model's)")
    parser.add_argument(
        "--role",
        type=names,
        default=ROLES,
        metavar="ROLE,...",
        help=f"which presses of the split ({ROLES})",
    )
    parser.add_argument(
        "--source", metavar="NAME", help="sensor of its training labels (from the model)"
    )
    parser.add_argument(
        "--method",
        choices=METHODS[:-1],
        help="how it was trained (target if source and sensor are the same, transferred if the "
        "model was trained on translated frames, else source-only)",
    )
    parser.add_argument(
        "--translator", default="", metavar="NAME", help="translator of its training images (none)"
    )
    add_device(parser)
    parser.add_argument("--out", type=Path, required=True, metavar="NPZ", help="file to write")


def run(options: argparse.Namespace) -> int:
    """Run the command and return the exit code."""
    from learning.data.presses import load_presses
    from learning.data.splits import SPLIT, read_split
    from learning.evaluation.predictions import predictions_of
    from learning.force import load_force_model
    from learning.force.intervals import read_intervals
    from learning.training.checkpoint import read_model_folder
    from recorder import MarkerArchive

    folder = read_model_folder(options.model, "force")
    card = folder.config.metadata.get("transfer", {})
    options.method = options.method or card.get("method")
    options.translator = options.translator or card.get("translator", "")
    source, method = _trained_on(options, folder.config.metadata.get("sensors", []))
    archive = MarkerArchive(options.archive)
    if options.sensor not in archive:
        known = ", ".join(archive)
        raise LearningError(f"--sensor: found {options.sensor!r}; known: {known}")
    sensor, split = archive[options.sensor], read_split(options.split or folder.path / SPLIT)
    split.check(archive)
    rows = np.sort(np.concatenate([split.rows(sensor.table, role) for role in options.role]))
    if not len(rows):
        raise LearningError(
            f"--role: found no frames of {','.join(options.role)} of {options.sensor}"
        )
    model = load_force_model(options.model, options.device)
    form = model.inputs.stored_form
    with ItemProgress("frames", sys.stderr) as progress:
        presses = load_presses(sensor, rows, device=options.device, form=form, progress=progress)
    with ItemProgress("forces", sys.stderr) as progress:
        predicted = model.predict(presses, progress=progress)
    rows = presses.rows.numpy()
    intervals = read_intervals(options.model)
    made = predictions_of(
        sensor,
        archive.indenters,
        rows,
        split.role(sensor.table["location"][rows]),
        predicted,
        source=source,
        method=method,
        translator=options.translator,
        model=folder.hash(),
        interval=None if intervals is None else intervals.of(predicted),
    )
    made.write(options.out)
    print(f"{options.out}: {len(made):,} frames, {_told(made)}")
    if intervals is not None:
        print(_covered(made))
    if len(model.axes) < len(AXES):
        print(f"the model predicts {', '.join(model.axes)} only; forces on other axes are NaN")
    return 0


def _told(made: Predictions) -> str:
    """Return the errors of predictions, or their range if no label can be compared with them."""
    if not made.is_scored:
        ranges = "  ".join(
            f"{axis} {column.min():.3f} to {column.max():.3f}"
            for axis, column in zip(AXES, made.predicted.T, strict=True)
            if np.isfinite(column).any()
        )
        return f"no label to compare with; predicted [N] {ranges}"
    errors = force_errors(made.true, made.predicted, made.label_std)
    mae = "  ".join(
        f"{name} {value:.3f}" if np.isfinite(value) else f"{name} -"
        for name, value in zip("xyzt", errors.mae, strict=True)
    )
    labelled = f", {errors.frames:,} of them with a label" if errors.frames < len(made) else ""
    return f"MAE [N] {mae}, R2{errors.of_axes} {errors.r2_mean:.3f}{labelled}"


def _covered(made: Predictions) -> str:
    """Return the mean half-widths of the intervals, and the share of labels within them."""
    width = axis_means(0.5 * (made.high - made.low))
    shares = []
    for place, axis in enumerate(AXES):
        known = np.isfinite(made.true[:, place]) & np.isfinite(made.low[:, place])
        if np.isfinite(width[place]):
            text = f"{axis} +-{width[place]:.3f} N"
            if known.any():
                inside = (made.low <= made.true) & (made.true <= made.high)
                text += f" covers {100 * inside[known, place].mean():.1f} %"
            shares.append(text)
    return f"90 % intervals, in the mean: {', '.join(shares)}"


def _trained_on(options: argparse.Namespace, sensors: Sequence[str]) -> tuple[str, str]:
    """Return the source of a model's labels and its method, from options and training sensors."""
    message, to, target = (sensors[0] if len(sensors) == 1 else "").partition("-to-")
    source = options.source or message
    if not source:
        listed = ", ".join(sensors) or "none"
        raise LearningError(
            f"--source: missing; allowed: a name, as the model was trained on {listed}"
        )
    if to and target != options.sensor:
        raise LearningError(
            f"--sensor: found {options.sensor!r}; allowed: {target!r}, as the model was trained on "
            "frames translated to it"
        )
    usual = "target" if source == options.sensor else "source-only"
    method = str(options.method or ("transferred" if to else usual))
    _require_fitting(method, source, options.sensor, options.translator)
    return source, method


def _require_fitting(method: str, source: str, sensor: str, translator: str) -> None:
    translated = method in TRANSLATED
    if translated and not translator:
        raise LearningError(f"--translator: missing; allowed: a name, as --method is {method}")
    if translator and not translated:
        raise LearningError(
            f"--translator: found {translator!r}; allowed: none, as --method is {method}"
        )
    if (method == "target") != (source == sensor):
        raise LearningError(
            f"--method: found {method} from {source} to {sensor}; allowed: target where they are "
            "the same sensor, another method where they differ"
        )
