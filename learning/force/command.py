"""`tactile train force`: train a force model on presses with force labels."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from learning.command import add_settings, add_split
from learning.errors import LearningError
from recorder.command_line.options import names
from recorder.progress import ItemProgress

if TYPE_CHECKING:
    from learning.data.presses import Presses
    from learning.data.splits import Role, Split
    from learning.force.labels import LabelSource
    from learning.force.model import ForceModel
    from learning.force.train import ForceModelSettings
    from learning.training.run import TrainingSession
    from recorder.archive import ArchivedSensor, MarkerArchive

# Card and exported step of a trained model, in its folder.
CARD, ONNX = "card.md", "model.onnx"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of the command."""
    parser.description = (
        "Trains a model of Fx, Fy, Fz [N] on sequences of marker images of a sensor, or of a "
        "translated one (A-to-B), and writes its ONNX and card. After Ctrl-C, the same "
        "command continues. --set plugin=NAME trains another package's model. Several "
        "GPUs: torchrun --nproc-per-node N -m tactile train force ..."
    )
    add = parser.add_argument
    add("archive", type=Path, metavar="ARCHIVE", help="X.markers.zarr")
    add("--sensor", type=names, metavar="NAME,...", help="sensors to train on (the only one)")
    add_split(parser)
    add("--out", type=Path, metavar="DIR", help="the run's folder (runs/force-SENSOR)")
    add_settings(
        parser,
        "",
        "a preset, or your own YAML file (shading for shading, else tiny)",
        example="e.g. sequences.batch=32",
    )
    add("--start-from", metavar="MODEL", help="start from the weights of this model")
    add(
        "--labels",
        metavar="SOURCE",
        help="labels in place of the archive's: a CSV of readings (columns indenter, target, frame "
        "(none: where the press is held), fx_n, fy_n, fz_n [N]); FILE.json or FILE.json:CHOICE of "
        "`tactile compensate`; twin: by forces of twins (tactile sim labels) of both sensors of "
        "the pair, or those of the sensor's own; Y.markers.zarr: the same, if it holds the target",
    )
    add("--pair", metavar="A-to-B", help="labels of A are made for B (default: that of --sensor)")


def run(options: argparse.Namespace) -> int:
    """Train, and return the exit code."""
    from learning.data.presses import load_presses, press_table
    from learning.force.folder import model_name
    from learning.force.labels import label_source
    from learning.force.loading import load_force_model
    from learning.force.made_for import metadata_of
    from learning.force.model import KIND
    from learning.force.train import read_force_settings, train_force
    from learning.train_command import open_data, run_training
    from learning.translation.loading import hash_of
    from recorder.archive import SHADING, archive_fingerprint

    archive, split = open_data(options)
    sensors = _sensors(options.sensor, archive, split)
    out = options.out or Path("runs") / f"force-{'-'.join(sensors)}"
    usual = "shading" if archive[sensors[0]].representation == SHADING else "tiny"
    settings = read_force_settings(options.preset or usual, options.set)
    source = label_source(options.labels, archive, sensors, options.pair)
    data = [archive_fingerprint(archive), split.fingerprint, *sensors, *source.data]
    start_from = None
    if options.start_from is not None:
        begun = model_name(options.start_from)
        start_from = load_force_model(begun)
        data.append(hash_of(begun))
    # A run that could learn nothing is not begun.
    for name in sensors:
        if len(rows := split.rows(archive[name].table, "train")):
            source.of(press_table(archive[name], rows)).require_wrench()

    def train(session: TrainingSession) -> Iterator[str]:
        def load(role: Role) -> list[Presses]:
            loaded = []
            for name in sensors:
                rows, form = split.rows(archive[name].table, role), settings.input.stored_form
                if not len(rows):
                    continue
                with ItemProgress("frames", sys.stderr) as frames:
                    presses = load_presses(
                        archive[name], rows, device=session.device, form=form, progress=frames
                    )
                loaded.append(source.of(presses))
            return loaded

        presses, validation = load("train"), load("validation")
        with session.stop:
            model = train_force(
                presses, settings, session, validation=validation, start_from=start_from
            )
        if not session.run.writes:
            return iter(())
        return _delivered(out, archive, split, settings, model, presses, validation)

    rows_of = {name: split.rows(archive[name].table, "train") for name in sensors}
    metadata = {**metadata_of(archive, rows_of), **_origin(archive[sensors[0]], source)}
    run_training(out, KIND, settings, data, train, split=split, metadata=metadata)
    return 0


def _sensors(names: Sequence[str] | None, archive: MarkerArchive, split: Split) -> list[str]:
    available = ", ".join(archive)
    sensors = [*(names or archive)]
    if names is None and len(sensors) > 1:
        raise LearningError(f"--sensor: missing; known: {available}")
    if unknown := [name for name in sensors if name not in archive]:
        raise LearningError(f"--sensor: found {', '.join(unknown)}; known: {available}")
    if held_out := [name for name in sensors if name in split.held_out_sensors]:
        raise LearningError(
            f"--sensor: found {', '.join(held_out)}, which the split holds out; allowed: "
            f"{', '.join(split.trained_sensors(archive))}"
        )
    return sensors


def _origin(sensor: ArchivedSensor, source: LabelSource) -> dict[str, str]:
    """Return translator and method of a model that is trained on translated frames."""
    if "-to-" not in sensor.name:
        return {}
    return {"method": source.method, "translator": str(sensor.attrs.get("model", "unknown"))}


def _delivered(
    out: Path,
    archive: MarkerArchive,
    split: Split,
    settings: ForceModelSettings,
    model: ForceModel,
    presses: list[Presses],
    validation: list[Presses],
) -> Iterator[str]:
    """Write ONNX and card; yield the lines that report it."""
    from learning.force.export import export_onnx
    from learning.force.made_for import made_for
    from recorder.pages import render
    from recorder.store import replace_file

    def indenters(role: Role) -> list[str]:
        return sorted({press.indenter for press in split.presses if press.role == role})

    yield f"{out}: trained on {sum(map(len, presses)):,} presses"
    yield from _partly_labelled(model, presses)
    errors = [_errors(model, each) for each in validation]
    yield from errors
    difference = export_onnx(model, out / ONNX)
    card = render(
        Path(__file__).with_name(CARD),
        made_for=[str(one) for one in made_for(out)],
        sensors=[each.sensor for each in presses],
        axes=model.axes,
        description=settings.description,
        seed=settings.seed,
        millions=sum(weight.numel() for weight in model.parameters()) / 1e6,
        archive=archive.name,
        presses=sum(map(len, presses)),
        frames=sum(each.frames for each in presses),
        indenters=indenters("train"),
        tested=indenters("new_indenter"),
        errors=errors,
        difference=difference,
    )
    replace_file(out / CARD, card.encode())
    yield f"{out / ONNX}, {out / CARD}: written"


def _partly_labelled(model: ForceModel, presses: Sequence[Presses]) -> Iterator[str]:
    """Yield lines on axes and frames without a label, which the loss ignores."""
    from learning.force.model import AXES

    for each in presses:
        counts = each.wrench.isfinite().sum(dim=0).tolist()
        if min(counts) < each.frames:
            listed = ", ".join(f"{n} {k:,}" for n, k in zip(AXES, counts, strict=True))
            yield f"{each.sensor}: labels in {each.frames:,} frames: {listed}"
    if len(model.axes) < len(AXES):
        axes = ", ".join(model.axes)
        yield f"the model predicts {axes} only; forces on other axes are NaN"


def _errors(model: ForceModel, presses: Presses) -> str:
    """Return a line with the errors of a model on presses for validation."""
    import numpy as np

    from learning.force.model import AXES
    from learning.metrics import axis_means, by_axis

    if not presses.is_labelled:
        return f"{presses.sensor}: no label in validation"
    true = presses.wrench.cpu().numpy().astype(np.float64)
    off = axis_means(abs(model.predict(presses) - true)).tolist()
    return f"{presses.sensor}: off in validation by {by_axis(AXES, off)} N"
