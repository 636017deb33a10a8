"""`tactile evaluate`: report on predictions, translations and force models."""

from __future__ import annotations

import argparse
import re
import sys
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

from learning.cli.archive_join import chosen_sensors, only_sensor
from learning.errors import LearningError
from recorder.command_line.options import add_device, add_value, names
from recorder.progress import ItemProgress

if TYPE_CHECKING:
    from learning.data.matching import SensorSelection
    from learning.evaluation.predictions import Predictions
    from learning.evaluation.translation import TranslationScores
    from recorder import MarkerArchive

ROLES = "new_indenter"
# An archive, or some of its sensors.
_ARCHIVE = re.compile(r"\.markers\.zarr/?(:[^/]*)?$")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of the command."""
    parser.description = (
        "Decides by what it is given. Results of `predict`: one HTML page with CSV tables. An "
        "archive and others that `translate` made of it, with results or without: translated "
        "frames are scored as well (Dice, SSIM, markers [px, mm], distances), and the scores are "
        "kept with the results. A force model and an archive: its forces, and its intervals if it "
        "has any, are compared with labels, on indenters that it did not learn from."
    )
    add = parser.add_argument
    about = "folder of .npz results, X.markers.zarr or X.markers.zarr:SENSOR, a force model"
    add("inputs", nargs="+", metavar="PATH", help=about)
    add_value(parser, "--out", "DIR", Path("report"), "report folder", Path)
    about = "split.json of a training (the one that a training of the archive makes)"
    add("--split", type=Path, metavar="JSON", help=about)
    about = f"which presses are scored ({ROLES})"
    add("--role", type=names, default=ROLES, metavar="ROLE,...", help=about)
    add(
        "--features",
        default="marker-grid",
        metavar="NAME|PATH",
        help="features for distances: marker-grid, the folder of a marker VAE, or "
        "pt_inception-2015-12-05-6726825d.pth, for FID and KID (marker-grid)",
    )
    add_device(parser)


@dataclass(slots=True)
class Inputs:
    """Paths of a call, by their contents."""

    results: Path | None = None
    model: str | None = None
    sensors: list[SensorSelection] = field(default_factory=list)
    """Sensors with real frames."""
    translated: list[MarkerArchive] = field(default_factory=list)


def run(options: argparse.Namespace) -> int:
    """Run the command and return the exit code."""
    inputs = _sorted(options.inputs)
    if inputs.model is not None:
        return _of_model(inputs, options)
    if inputs.translated or inputs.results is not None:
        return _of_results(inputs, options)
    raise LearningError(
        "inputs: found archives alone; allowed: results, translated frames or a model as well; "
        "`tactile force --sensor ARCHIVE --out MODEL` leaves each indenter out in turn"
    )


def _sorted(texts: Sequence[str]) -> Inputs:
    from learning.plugins import plugin_names
    from learning.training.checkpoint import CONFIG

    inputs = Inputs()
    for text in texts:
        if _ARCHIVE.search(text):
            sensors = [*chosen_sensors(text)]
            if all("-to-" in each.sensor for each in sensors):
                inputs.translated.append(sensors[0].archive)
            else:
                inputs.sensors += sensors
        elif (Path(text) / CONFIG).is_file() or text in plugin_names():
            inputs.model = text
        elif Path(text).is_dir():
            inputs.results = Path(text)
        else:
            raise LearningError(
                f"{text}: found no folder; allowed: results of `predict`, X.markers.zarr, a model"
            )
    return inputs


def _of_model(inputs: Inputs, options: argparse.Namespace) -> int:
    """Compare the forces of a model with labels."""
    from learning.cli.predict import predicted
    from learning.force.intervals import read_intervals
    from learning.transfer.score import new_frames, score_of

    model, sensor = str(inputs.model), only_sensor("ARCHIVE", inputs.sensors)
    if read_intervals(Path(model)) is not None:
        lines = [*score_of(new_frames(Path(model), sensor)).lines()]
    else:
        _, lines = predicted(
            model, sensor.archive, sensor.sensor, options.split, options.role, options.device
        )
    print("\n".join(lines))
    return 0


def _of_results(inputs: Inputs, options: argparse.Namespace) -> int:
    """Write the report of predictions, and of translated frames, which are scored first."""
    from learning.evaluation.report import read_folder

    folder = inputs.results or options.out
    if inputs.translated:
        _score_translated(inputs, folder, options)
    _report(*read_folder(folder), options.out, "What was gained")
    return 0


def _score_translated(inputs: Inputs, folder: Path, options: argparse.Namespace) -> None:
    from learning.data.splits import training_split
    from learning.evaluation.distribution import load_extractor
    from learning.evaluation.translation import score_translation

    if not inputs.sensors:
        raise LearningError("ARCHIVE: found none of real frames; allowed: the one translated from")
    archive = inputs.sensors[0].archive
    split = training_split(archive, options.split)
    extractor = load_extractor(options.features, options.device)
    for translated in inputs.translated:
        for name, sensor in translated.items():
            print(f"scoring {name} of {translated.name}", file=sys.stderr)
            with ItemProgress("frames", sys.stderr) as progress:
                scores = score_translation(
                    archive, sensor, split, options.role, extractor, progress=progress
                )
            features = extractor.name.split(":")[-1].split(",")[0]
            scores.write(folder / f"{name}.{scores.translator}.{features}.npz")


def _report(
    predictions: Sequence[Predictions], scores: Sequence[TranslationScores], out: Path, title: str
) -> None:
    from learning.evaluation.report import write_report

    with ItemProgress("parts", sys.stderr) as progress:
        report = write_report(predictions, scores, out, title=title, progress=progress)
    for line in report.lines:
        print(line)
    print(f"{report.files[0]}: written, beside {len(report.files) - 1} tables")
