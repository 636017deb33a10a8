"""Of `tactile force`: newtons from a sensor's frames, by the best way that its data allow."""

from __future__ import annotations

import argparse
import math
import shutil
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from learning.cli.archive_join import add_tolerances, chosen_sensors, only_sensor, tolerances_of
from learning.command import add_settings
from learning.errors import LearningError
from recorder.command_line.options import (
    add_device,
    add_seed,
    names,
    names_or_none,
    next_command,
    positive,
)

if TYPE_CHECKING:
    from learning.choice.run import Request

# Origins of the labels, the best first.
OWN, TWIN, SOURCE = "own", "twin", "source"


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of the command."""
    parser.description = (
        "Makes a force model of a sensor. With labels of its own, of the forces of its twin, or of "
        "--labels, on three indenters or more: ways from a ridge regression to nets are compared "
        "on indenters left out, the simplest that no other clearly beats is trained on all, and "
        "the report is of indenters that had no part in choice, training or calibration. Without "
        "labels: from another sensor (--source), whose presses match by place, with labels scaled "
        "between the skins. Either has 90 %% intervals, ONNX and a card. Repeat the command to "
        "continue. --explain prints the way and trains nothing."
    )
    add = parser.add_argument
    about = "sensor whose forces are wanted, X.markers.zarr"
    add("--sensor", required=True, metavar="ARCHIVE[:SENSOR[=NAME]]", help=about)
    about = "another sensor with labels, X.markers.zarr"
    add("--source", metavar="ARCHIVE[:SENSOR[=NAME]]", help=about)
    about = (
        "labels in place of its archive's: columns indenter, target, frame, fx_n, fy_n, fz_n [N]"
    )
    add("--labels", type=Path, metavar="CSV", help=about)
    add(
        "--by",
        choices=(OWN, TWIN, SOURCE),
        help="labels to learn from: its own, forces of its twin, or the source's (the first of "
        "these that is there); with twin or source its own are not read",
    )
    add("--ways", type=names, metavar="NAME,...", help="compare these alone (all)")
    about = "indenters that no stage uses (as in the archives; none: '')"
    add("--unseen", type=names_or_none, metavar="NAME,...", help=about)
    add("--explain", action="store_true", help="print the way, and its results in the experiments")
    add_seed(parser)
    group = parser.add_argument_group("from another sensor")
    add = group.add_argument
    add(
        "--source-model",
        type=Path,
        metavar="MODEL",
        help="use this force model of the source, such as an imported one of the authors, in place "
        "of training one; it has seen all indenters that it was trained on elsewhere",
    )
    add(
        "--priors",
        type=Path,
        nargs="+",
        default=[],
        metavar="PATH",
        help="force-depth curves: sessions of `tactile force-depth`, a folder of published "
        "coefficients, or the target's archive if it has such presses (none: scale assumed)",
    )
    about = "labels of the source, as readings typed in, in place of those of its archive"
    add("--source-labels", type=Path, metavar="CSV", help=about)
    about = "assumed force of the sensor over the source's at the same fraction of depth (1)"
    add("--force-ratio", type=positive, metavar="R", help=about)
    add(
        "--scale-within",
        type=positive,
        metavar="K",
        help="true forces are assumed to be within 1/K and K times the predicted ones, at 90 %% "
        "(2; with force-depth curves of both skins 1.25)",
    )
    about = "indenters that calibrate the intervals, then are trained on (a quarter)"
    add("--calibrate-on", type=names, metavar="NAME,...", help=about)
    add_tolerances(parser)
    add_settings(parser, "transfer")
    add_device(parser)
    parser.add_argument("--out", type=Path, metavar="MODEL", help="folder of the model")


def make_model(options: argparse.Namespace) -> int:
    """Run the command and return the exit code."""
    from learning.choice.evidence import LABELS, lines_of_way
    from learning.choice.run import Request, run_choice

    if options.scale_within is not None and not 1 < options.scale_within < math.inf:
        raise LearningError(f"--scale-within: found {options.scale_within}; allowed: above 1")
    sensor = only_sensor("--sensor", [*chosen_sensors(options.sensor)])
    source = None
    if options.source is not None:
        source = only_sensor("--source", [*chosen_sensors(options.source)])
    request = Request(
        sensor=sensor,
        out=options.out or Path(),
        labels=options.labels and str(options.labels),
        source=source,
        ways=options.ways and tuple(options.ways),
        unseen=None if options.unseen is None else tuple(options.unseen),
        seed=options.seed,
        device=options.device,
    )
    by = options.by or best_of(request)
    request = replace(request, labels=TWIN) if by == TWIN else request
    print("\n".join(lines_of_way(by) if options.explain else [f"{sensor.name}: by {LABELS[by]}"]))
    if options.explain:
        return 0
    if options.out is None:
        raise LearningError("--out: missing; allowed: the folder of the model, or --explain")
    before = None
    if by == SOURCE:
        before = _from_source(request, options)
    else:
        run_choice(request, lambda line: print(line, flush=True))
    print(f"{options.out}: model, ONNX, intervals; {options.out / 'card.md'}: card")
    print(f"next: {next_command('live', sensor=sensor.name, model=options.out, before=before)}")
    return 0


def best_of(request: Request) -> str:
    """Return the best origin of labels that a request has (`learning.choice.evidence`).

    Raises:
        LearningError: It has none.
    """
    from learning.choice.nested import FEWEST
    from learning.choice.run import indenters_labelled

    count = indenters_labelled(request)
    if count >= FEWEST:
        return OWN
    if request.sensor.archive[request.sensor.sensor].simulated is not None:
        return TWIN
    if request.source is not None:
        return SOURCE
    if count > 1:
        return OWN
    raise LearningError(
        f"--sensor: found labels of {request.sensor.name} on {count} indenters and no twin's "
        "forces; allowed: labels on two indenters or more, --twin TWIN.yaml, or --source of a "
        "sensor with labels"
    )


def _from_source(request: Request, options: argparse.Namespace) -> Path:
    """Carry a model over from another sensor; return the folder of the other's own model."""
    from learning.config import read_settings
    from learning.experiment.settings import PRESETS, ExperimentSettings
    from learning.transfer.run import TransferRequest, run_transfer

    if request.source is None:
        raise LearningError("--source: missing; allowed: another sensor with labels")
    transfer = TransferRequest(
        source=request.source,
        target=request.sensor,
        out=request.out / "steps",
        settings=read_settings(ExperimentSettings, PRESETS, options.preset, options.set),
        source_model=options.source_model,
        priors=tuple(options.priors),
        labels=options.labels,
        source_labels=options.source_labels,
        ratio=options.force_ratio,
        within=options.scale_within,
        calibrate_on=options.calibrate_on and tuple(options.calibrate_on),
        unseen=request.unseen,
        tolerances=tolerances_of(options),
        device=options.device,
    )
    run_transfer(transfer, lambda line: print(line, flush=True))
    for file in (*sorted(transfer.model.iterdir()), transfer.out / "report.html"):
        shutil.copyfile(file, request.out / file.name)
    return transfer.before
