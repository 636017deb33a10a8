"""`python -m learning predict`: predict the forces of frames in an archive."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from learning.errors import LearningError
from learning.evaluation.predictions import METHODS, TRANSLATED
from recorder.command_line.options import add_device, names
from recorder.progress import ItemProgress

ROLES = "new_indenter,new_press"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of the command."""
    parser.description = (
        "Runs a force model over whole presses of a sensor and writes its forces [N] "
        "with the labels [N], for `evaluate`."
    )
    parser.add_argument("model", type=Path, metavar="MODEL", help="folder of a trained force model")
    parser.add_argument("archive", type=Path, metavar="ARCHIVE", help="X.markers.zarr with labels")
    parser.add_argument("--sensor", required=True, metavar="NAME", help="target sensor")
    parser.add_argument("--split", type=Path, required=True, metavar="JSON", help="made by `split`")
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
        choices=METHODS,
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
    from learning.data.presses import Form, load_presses
    from learning.data.splits import read_split
    from learning.evaluation.predictions import predictions_of
    from learning.force import load_force_model
    from learning.metrics import force_errors
    from learning.training.checkpoint import read_model_folder
    from recorder import MarkerArchive

    folder = read_model_folder(options.model, "force")
    source, method = _trained_on(options, folder.config.facts.get("sensors", []))
    archive = MarkerArchive(options.archive)
    if options.sensor not in archive:
        known = ", ".join(archive)
        raise LearningError(f"--sensor: found {options.sensor!r}; known: {known}")
    sensor, split = archive[options.sensor], read_split(options.split)
    split.check(archive)
    rows = np.sort(np.concatenate([split.rows(sensor.table, role) for role in options.role]))
    if not len(rows):
        raise LearningError(
            f"--role: found no frames of {','.join(options.role)} of {options.sensor}"
        )
    if (unlabelled := ~np.isfinite(sensor.table["wrench"][rows]).all(axis=1)).any():
        raise LearningError(
            f"{options.sensor}: found no label in row {rows[unlabelled][0]}, and "
            f"{unlabelled.sum()} such rows; allowed: labelled frames, to compare with"
        )
    model = load_force_model(options.model, options.device)
    form: Form = "field" if model.inputs.form == "field" else "images"
    with ItemProgress("frames", sys.stderr) as progress:
        presses = load_presses(sensor, rows, device=options.device, form=form, progress=progress)
    with ItemProgress("forces", sys.stderr) as progress:
        predicted = model.predict(presses, progress=progress)
    rows = presses.rows.numpy()
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
    )
    made.write(options.out)
    errors = force_errors(made.true, made.predicted, made.label_std)
    mae = "  ".join(f"{name} {value:.3f}" for name, value in zip("xyzt", errors.mae, strict=True))
    print(f"{options.out}: {len(made):,} frames, MAE [N] {mae}, R2 {errors.r2_mean:.3f}")
    return 0


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
