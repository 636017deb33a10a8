"""`tactile predict`: predict the forces of frames in an archive."""

import argparse
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from learning.data.splits import SPLIT, Role, split_by_indenters, training_split
from learning.errors import LearningError
from learning.evaluation.predictions import Predictions, predictions_of
from learning.metrics import axis_means, by_axis, force_errors
from recorder.archive import MarkerArchive
from recorder.command_line.options import add_device, names
from recorder.progress import ItemProgress

ROLES = "new_indenter,new_press"
AXES = ("Fx", "Fy", "Fz")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of the command."""
    parser.description = (
        "Runs a force model over whole presses of a sensor and writes its forces [N] "
        "with the labels [N], if it has any, for `evaluate`. Intervals of a model "
        "are written too."
    )
    add = parser.add_argument
    add(
        "model",
        metavar="MODEL",
        help="folder of a trained force model, its web address, demo, or the name of one that an "
        "installed package offers",
    )
    add("archive", type=Path, metavar="ARCHIVE", help="X.markers.zarr, with labels or without")
    add("--sensor", metavar="NAME", help="target sensor (that of the model, or the only one)")
    add("--split", type=Path, metavar="JSON", help="roles of presses (the model's)")
    about = f"which presses of the split ({ROLES})"
    add("--role", type=names, default=ROLES, metavar="ROLE,...", help=about)
    add_device(parser)
    add("--out", type=Path, required=True, metavar="NPZ", help="file to write")


def run(options: argparse.Namespace) -> int:
    """Run the command and return the exit code."""
    archive = MarkerArchive(options.archive)
    predictions, lines = predicted(
        options.model, archive, options.sensor, options.split, options.role, options.device
    )
    predictions.write(options.out)
    print("\n".join([f"{options.out}: {lines[0]}", *lines[1:]]))
    return 0


def predicted(
    name_or_folder: str,
    archive: MarkerArchive,
    sensor_name: str | None,
    split_file: Path | None,
    roles: Sequence[Role],
    device: str,
) -> tuple[Predictions, list[str]]:
    """Return the forces that a model predicts on some presses of a sensor, and lines about them.

    `name_or_folder` is as for `load_force_model`. Without a name the sensor is the model's target,
    or the only one; without a file the split is that of the model's training, else of the archive.
    """
    from learning.data.presses import load_presses
    from learning.force import load_force_model
    from learning.force.folder import model_name
    from learning.force.intervals import read_intervals
    from learning.force.made_for import CHOICE
    from learning.training.checkpoint import CONFIG, read_config
    from learning.translation.loading import hash_of

    name = model_name(name_or_folder)
    folder = Path(name)
    metadata = read_config(folder).metadata if (folder / CONFIG).is_file() else {}
    target, origin = _origin(metadata, archive, sensor_name)
    sensor = archive[target]
    own = folder / SPLIT
    if split_file is None and (choice := metadata.get(CHOICE)):
        split = split_by_indenters(archive, choice["seen"])
    else:
        split = training_split(archive, split_file or (own if own.is_file() else None))
    rows = np.sort(np.concatenate([split.rows(sensor.table, role) for role in roles]))
    if not len(rows):
        raise LearningError(f"--role: found no frames of {','.join(roles)} of {sensor.name}")
    model = load_force_model(name, device)
    form = model.inputs.stored_form
    with ItemProgress("frames", sys.stderr) as progress:
        presses = load_presses(sensor, rows, device=device, form=form, progress=progress)
    with ItemProgress("forces", sys.stderr) as progress:
        forces = model.predict(presses, progress=progress)
    rows = presses.rows.numpy()
    intervals = read_intervals(folder)
    predictions = predictions_of(
        sensor,
        archive.indenters,
        rows,
        split.role(sensor.table["location"][rows]),
        forces,
        **origin,
        model=hash_of(name),
        interval=None if intervals is None else intervals.of(forces),
    )
    lines = [f"{len(predictions):,} frames, {_accuracy(predictions)}"]
    if intervals is not None:
        lines.append(_covered(predictions))
    if len(model.axes) < len(AXES):
        axes = ", ".join(model.axes)
        lines.append(f"the model predicts {axes} only; forces on other axes are NaN")
    return predictions, lines


def _accuracy(predictions: Predictions) -> str:
    """Return the errors of predictions, or their range if no label can be compared with them."""
    if not predictions.is_scored:
        ranges = "  ".join(
            f"{axis} {column.min():.3f} to {column.max():.3f}"
            for axis, column in zip(AXES, predictions.predicted.T, strict=True)
            if np.isfinite(column).any()
        )
        return f"no label to compare with; predicted [N] {ranges}"
    errors = force_errors(predictions.true, predictions.predicted, predictions.label_std)
    labelled = (
        f", {errors.frames:,} of them with a label" if errors.frames < len(predictions) else ""
    )
    mae = by_axis("xyzt", errors.mae)
    return f"MAE [N] {mae}, R2{errors.of_axes} {errors.r2_mean:.3f}{labelled}"


def _covered(predictions: Predictions) -> str:
    """Return the mean half-widths of the intervals, and the share of labels within them."""
    true, low, high = predictions.true, predictions.low, predictions.high
    width = axis_means(0.5 * (high - low))
    inside, known = (low <= true) & (true <= high), np.isfinite(true) & np.isfinite(low)
    shares = []
    for column, axis in enumerate(AXES):
        labelled = known[:, column]
        if np.isfinite(width[column]):
            text = f"{axis} +-{width[column]:.3f} N"
            if labelled.any():
                text += f" covers {100 * inside[labelled, column].mean():.1f} %"
            shares.append(text)
    return f"90 % intervals, in the mean: {', '.join(shares)}"


def _origin(
    metadata: Mapping[str, Any], archive: MarkerArchive, sensor: str | None
) -> tuple[str, dict[str, str]]:
    """Return the sensor that a model predicts, and the source, method and translator of its run."""
    sensors = metadata.get("sensors", [])
    source, to, target = (sensors[0] if len(sensors) == 1 else "").partition("-to-")
    source = source or "+".join(sensors) or "another package"
    if sensor is None:
        usual = [name for name in (target, source, *archive) if name in archive]
        if len(archive) > 1 and usual[0] not in (target, source):
            raise LearningError(f"--sensor: missing; known: {', '.join(archive)}")
        sensor = usual[0]
    if sensor not in archive:
        raise LearningError(f"--sensor: found {sensor!r}; known: {', '.join(archive)}")
    if to and target != sensor:
        raise LearningError(
            f"--sensor: found {sensor!r}; allowed: {target!r}, as the model was trained on frames "
            "translated to it"
        )
    usual_method = "transferred" if to else "target" if source == sensor else "source-only"
    method, translator = metadata.get("method", usual_method), metadata.get("translator", "")
    translator = translator or ("unknown" if to else "")
    return sensor, {"source": source, "method": method, "translator": translator}
