"""`python -m learning train-force`: train a force model on presses with force labels."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

from command_line.options import names
from learning.command import add_resume, add_settings
from learning.errors import LearningError
from recorder.progress import ItemProgress

if TYPE_CHECKING:
    import torch

    from learning.data.presses import Presses
    from learning.data.splits import Role, Split
    from learning.force.data import Compensation
    from learning.force.model import ForceSettings
    from recorder import MarkerArchive
    from recorder.archive import ArchivedSensor


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of the command."""
    parser.description = (
        "Trains a model of Fx, Fy, Fz [N] on sequences of marker images of a sensor, "
        "or of a translated one (A-to-B). Ctrl-C saves a checkpoint; --resume continues from it."
    )
    parser.add_argument("archive", type=Path, metavar="ARCHIVE", help="X.markers.zarr")
    parser.add_argument(
        "--sensor", type=names, metavar="NAME,...", required=True, help="sensors to train on"
    )
    parser.add_argument("--split", type=Path, metavar="FILE", required=True, help="split.json")
    parser.add_argument("--out", type=Path, metavar="DIR", required=True, help="the run's folder")
    add_settings(
        parser,
        "half",
        "a preset, or your own YAML file (half)",
        example="e.g. sequences.batch=32",
    )
    parser.add_argument(
        "--start-from", type=Path, metavar="MODEL", help="start from the weights of this model"
    )
    parser.add_argument(
        "--compensation", type=Path, metavar="FILE", help="compensate labels for another material"
    )
    parser.add_argument(
        "--pair", metavar="A-to-B", help="the compensated pair (default: that of --sensor)"
    )
    parser.add_argument(
        "--choice", default="default", metavar="NAME", help="its choice of d0 and lambda (default)"
    )
    add_resume(parser, "continue the run in --out")


def run(options: argparse.Namespace) -> int:
    """Run the command and return the exit code."""
    from learning.archive_writer import archive_fingerprint
    from learning.config import read_settings
    from learning.force.data import labels_of
    from learning.force.model import PRESETS, ForceSettings
    from learning.force.predict import KIND, ForcePredictor, load_force_model
    from learning.force.train import train_force
    from learning.train_command import Training, open_data, run_training

    settings = read_settings(ForceSettings, PRESETS, options.preset, options.set)
    archive, split = open_data(options)
    sensors = _sensors(options, archive, split)
    compensation = _compensation(options, sensors)
    start_from = None if options.start_from is None else load_force_model(options.start_from)

    def train(training: Training) -> Iterator[str]:
        presses, validation = (
            [
                found
                for name in sensors
                if len(found := _presses(archive[name], split, role, settings, training.device))
            ]
            for role in ("train", "validation")
        )
        with training.stop:
            predictor = train_force(
                presses,
                settings,
                training.run,
                validation=validation,
                start_from=start_from,
                compensation=compensation,
                accelerator=training.accelerator,
                stopped=training.stopping,
                progress=training.steps,
            )
        return told(predictor, presses, validation) if training.run.writes else iter(())

    def told(
        predictor: ForcePredictor, presses: list[Presses], validation: list[Presses]
    ) -> Iterator[str]:
        yield f"{options.out}: trained on {sum(map(len, presses)):,} presses"
        for each in validation:
            wanted = labels_of(each, compensation).cpu().numpy()
            x, y, z = abs(predictor.predict(each) - wanted).mean(axis=0)
            yield f"{each.sensor}: off in validation by Fx {x:.3f}  Fy {y:.3f}  Fz {z:.3f} N"

    data = [archive_fingerprint(archive), split.fingerprint, *sensors, *_begun_with(options)]
    facts = {"sensors": sensors}
    return run_training(options, KIND, settings, " ".join(data), train, facts=facts)


def _sensors(options: argparse.Namespace, archive: MarkerArchive, split: Split) -> list[str]:
    sensors: list[str] = [*options.sensor]
    if unknown := [name for name in sensors if name not in archive]:
        raise LearningError(f"--sensor: found {', '.join(unknown)}; known: {', '.join(archive)}")
    if held_out := [name for name in sensors if name in split.held_out_sensors]:
        raise LearningError(
            f"--sensor: found {', '.join(held_out)}, which {options.split} holds out; allowed: "
            f"{', '.join(split.trained_sensors(archive))}"
        )
    return sensors


def _begun_with(options: argparse.Namespace) -> list[str]:
    """Return the other dependencies of a run: hashes of files, and the selection in them."""
    from learning.training.checkpoint import weights_hash

    found = []
    if options.start_from is not None:
        found.append(weights_hash(options.start_from / "model.safetensors"))
    if options.compensation is not None:
        found += [weights_hash(options.compensation), options.pair or "", options.choice]
    return found


def _presses(
    sensor: ArchivedSensor, split: Split, role: Role, settings: ForceSettings, device: torch.device
) -> Presses:
    from learning.data.presses import load_presses

    rows = split.rows(sensor.table, role)
    with ItemProgress("frames", sys.stderr) as frames:
        return load_presses(
            sensor, rows, device=device, form=settings.input.stored_form, progress=frames
        )


def _compensation(options: argparse.Namespace, sensors: list[str]) -> Compensation | None:
    from learning.compensation import read_stored

    if options.compensation is None:
        if options.pair is not None:
            raise LearningError("--pair: found without --compensation; allowed: both")
        return None
    source, to, target = (options.pair or sensors[0]).partition("-to-")
    if not to or (options.pair is None and len(sensors) > 1):
        raise LearningError(
            f"--pair: found {options.pair or ','.join(sensors)}; allowed: A-to-B, of one pair"
        )
    return read_stored(options.compensation).pair(source, target, options.choice).applied
