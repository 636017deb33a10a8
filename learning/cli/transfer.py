"""`tactile transfer`: forces on a sensor without a gauge, from one command."""

import argparse
import math
from pathlib import Path

from learning.cli.archive_join import add_tolerances, chosen_sensors, only_sensor, tolerances_of
from learning.command import add_settings
from learning.errors import LearningError
from recorder.command_line.options import add_device, names, next_command, positive


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of the command."""
    parser.description = (
        "Trains a force model of a sensor that was recorded without a gauge (the target), from a "
        "sensor that was recorded with one (the source) or simulated: presses match by place, "
        "frames of the source are translated, its labels scaled between the skins (by force-depth "
        "curves, or with --set compensation=[simulated] by twins of both), and intervals "
        "that contain 90 % of the true forces are measured on indenters that no model saw. Labels "
        "of the target are not read, unless --labels names some. Writes RUN/model (weights, ONNX, "
        "intervals, card), RUN/before (the source's model) and RUN/report.html. Repeat the command "
        "to continue."
    )
    for name, text in (("source", "sensor with labels"), ("target", "sensor without a gauge")):
        parser.add_argument(
            f"--{name}",
            required=True,
            metavar="ARCHIVE:SENSOR[=NAME]",
            help=f"{text}, X.markers.zarr",
        )
    parser.add_argument(
        "--source-model",
        type=Path,
        metavar="MODEL",
        help="use this force model of the source, such as an imported one of the authors, in place "
        "of training one; it has seen all indenters that it was trained on elsewhere",
    )
    parser.add_argument(
        "--priors",
        type=Path,
        nargs="+",
        default=[],
        metavar="PATH",
        help="force-depth curves: sessions of `tactile force-depth`, a folder of published "
        "coefficients, or the target's archive if it has such presses (none: scale assumed)",
    )
    parser.add_argument(
        "--labels",
        type=Path,
        metavar="CSV",
        help="a few labels of the target: columns indenter, target, frame, fx_n, fy_n, fz_n [N]",
    )
    parser.add_argument(
        "--source-labels",
        type=Path,
        metavar="CSV",
        help="labels of the source, as readings typed in, in place of those of its archive",
    )
    parser.add_argument(
        "--force-ratio",
        type=positive,
        metavar="R",
        help="assumed force of the target over the source's at the same fraction of depth (1)",
    )
    parser.add_argument(
        "--scale-within",
        type=positive,
        metavar="K",
        help="true forces are assumed to be within 1/K and K times the predicted ones, at 90 %% "
        "(2; with force-depth curves of both skins 1.25)",
    )
    parser.add_argument(
        "--calibrate-on",
        type=names,
        metavar="NAME,...",
        help="indenters that calibrate the intervals, then are trained on (a quarter)",
    )
    parser.add_argument(
        "--unseen",
        type=names,
        metavar="NAME,...",
        help="indenters that no stage uses (as in the archives)",
    )
    add_tolerances(parser)
    add_settings(parser, "transfer")
    add_device(parser)
    parser.add_argument("--out", type=Path, required=True, metavar="RUN", help="folder of the run")


def run(options: argparse.Namespace) -> int:
    """Run the command and return the exit code."""
    from learning.config import read_settings
    from learning.experiment.settings import PRESETS, ExperimentSettings
    from learning.transfer.run import TransferRequest, run_transfer

    if options.scale_within is not None and not 1 < options.scale_within < math.inf:
        raise LearningError(f"--scale-within: found {options.scale_within}; allowed: above 1")
    source, target = (
        only_sensor(f"--{name}", [*chosen_sensors(getattr(options, name))])
        for name in ("source", "target")
    )
    request = TransferRequest(
        source=source,
        target=target,
        out=options.out,
        settings=read_settings(ExperimentSettings, PRESETS, options.preset, options.set),
        source_model=options.source_model,
        priors=tuple(options.priors),
        labels=options.labels,
        source_labels=options.source_labels,
        ratio=options.force_ratio,
        within=options.scale_within,
        calibrate_on=options.calibrate_on and tuple(options.calibrate_on),
        unseen=options.unseen and tuple(options.unseen),
        tolerances=tolerances_of(options),
        device=options.device,
    )
    run_transfer(request, lambda line: print(line, flush=True))
    print(f"{request.out / 'report.html'}: report; {request.model / 'card.md'}: card")
    sensor = request.target.sensor
    print(
        f"next: {next_command('live', sensor=sensor, model=request.model, before=request.before)}"
    )
    return 0
