"""Of `tactile force`: newtons from a sensor's frames, by the best way that its data allow."""

from __future__ import annotations

import argparse
import math
import shutil
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from learning.choice.evidence import BALANCE, LABELS, OWN, SOURCE, TWIN, lines_of_way
from learning.cli.archive_join import add_tolerances, chosen_sensors, only_sensor, tolerances_of
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
    from learning.choice.run import Origin, Request
    from learning.data.matching import SensorSelection

# Folder, within that of the model, of one with the scale of a few labels.
SCALED = "scaled"


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
        choices=tuple(LABELS),
        help="labels to learn from: its own, forces of its twin, or the source's (the first of "
        "these that is there); or balance with the source, the other finger of a hand, by "
        "--source-model or by known weights alone; but for own, its own are not read",
    )
    about = "compare these alone, with models of other packages by name (all ways of this one)"
    add("--ways", type=names, metavar="NAME,...", help=about)
    about = "indenters that no stage uses (as in the archives; none: '')"
    add("--unseen", type=names_or_none, metavar="NAME,...", help=about)
    add("--explain", action="store_true", help="print the way, and its results in the experiments")
    add_seed(parser)
    add = parser.add_argument_group("from another sensor").add_argument
    add(
        "--priors",
        type=Path,
        nargs="+",
        default=[],
        metavar="PATH",
        help="force-depth curves: sessions of `tactile force-depth`, a folder of published "
        "coefficients, or the sensor's archive if it has such presses (none: scale assumed, unless "
        "both archives have forces of twins)",
    )
    about = "labels of the source, as readings typed in, in place of those of its archive"
    add("--source-labels", type=Path, metavar="CSV", help=about)
    about = "model of the source's forces, a finger that squeezes the same objects (--by balance)"
    add("--source-model", metavar="MODEL", help=about)
    about = "assumed force of the sensor over the source's at the same fraction of depth (1)"
    add("--force-ratio", type=positive, metavar="R", help=about)
    add(
        "--scale-within",
        type=positive,
        metavar="K",
        help="true forces are assumed to be within 1/K and K times the predicted ones, at 90 %% "
        "(2; with force-depth curves of both skins 1.25)",
    )
    add_tolerances(parser)
    add_device(parser)
    parser.add_argument("--out", type=Path, metavar="MODEL", help="folder of the model")


def make_model(options: argparse.Namespace) -> int:
    """Run the command and return the exit code."""
    from learning.choice.run import Request, own_labels, run_choice, twin_labels

    if options.scale_within is not None and not 1 < options.scale_within < math.inf:
        raise LearningError(f"--scale-within: found {options.scale_within}; allowed: above 1")
    request = Request(
        sensor=only_sensor("--sensor", [*chosen_sensors(options.sensor)]),
        out=options.out or Path(),
        source=options.source and only_sensor("--source", [*chosen_sensors(options.source)]),
        ways=options.ways and tuple(options.ways),
        unseen=None if options.unseen is None else tuple(options.unseen),
        seed=options.seed,
        device=options.device,
    )
    by = options.by or (BALANCE if options.source_model else best_of(request, options.labels))
    _require_used(options, by)
    sensor = request.sensor
    print("\n".join(lines_of_way(by) if options.explain else [f"{sensor.sensor}: by {LABELS[by]}"]))
    if options.explain:
        return 0
    if options.out is None:
        raise LearningError("--out: missing; allowed: the folder of the model, or --explain")
    if by == OWN:
        origin = own_labels(request, options.labels)
    elif by == TWIN:
        origin = twin_labels(request)
    elif by == BALANCE:
        request, origin = _by_balance(request, options.source_model)
    else:
        request, origin = _from_source(request, options)
    run_choice(request, origin, lambda line: print(line, flush=True))
    out = options.out
    shutil.rmtree(out / SCALED, ignore_errors=True)
    if by == SOURCE and options.labels is not None:
        out = _scaled(out, sensor, options.labels)
    print(f"{out}: model, ONNX, intervals; {out / 'card.md'}: card")
    print(f"next: {next_command('live', model=out, session='SESSION')}, or --sensor of a bench")
    return 0


def _scaled(model: Path, sensor: SensorSelection, csv: Path) -> Path:
    """Write the model with the scale of a few labels of its sensor; return its folder."""
    from learning.data.labels import read_labels
    from learning.transfer.scale import scaled_by_labels

    out = model / SCALED
    labels = read_labels(csv, sensor.archive, sensor.sensor)
    print(scaled_by_labels(model, out, labels, sensor.archived))
    return out


def _require_used(options: argparse.Namespace, by: str) -> None:
    """Reject options that the origin of the labels has no use for."""
    of_source = ("priors", "source_labels", "force_ratio", "scale_within")
    unused = [name for name in of_source if by != SOURCE and getattr(options, name)]
    if by in (TWIN, BALANCE) and options.labels is not None:
        unused.append("labels")
    if by != BALANCE and options.source_model is not None:
        unused.append("source_model")
    if unused:
        names = ", ".join(f"--{name.replace('_', '-')}" for name in unused)
        raise LearningError(
            f"{names}: found with labels by {by}; allowed: --by source, or "
            "--by balance with --source-model"
        )


def best_of(request: Request, labels: Path | None) -> str:
    """Return the best origin of labels that a request has (`learning.choice.evidence`).

    Raises:
        LearningError: It has none.
    """
    from learning.choice.nested import FEWEST
    from learning.choice.run import indenters_labelled, own_labels

    count = indenters_labelled(request, own_labels(request, labels).labels)
    if count >= FEWEST:
        return OWN
    if request.sensor.archived.simulated is not None:
        return TWIN
    if request.source is not None:
        return SOURCE
    if count > 1:
        return OWN
    raise LearningError(
        f"--sensor: found labels of {request.sensor.sensor} on {count} indenters and no twin's "
        "forces; allowed: labels on two indenters or more, --twin TWIN.yaml, or --source of a "
        "sensor with labels"
    )


def _by_balance(request: Request, model: str | None) -> tuple[Request, Origin]:
    """Label by balance with the other finger; return the request without it."""
    from learning.choice.balance import by_model, by_weights

    if (source := request.source) is None:
        raise LearningError("--source: missing; allowed: the other finger, X.markers.zarr")
    one = replace(request, source=None)
    labelled = by_model(one, source, model, print) if model else by_weights(one, source, print)
    return one, labelled


def _from_source(request: Request, options: argparse.Namespace) -> tuple[Request, Origin]:
    """Carry labels over from another sensor; return the request for the joined archive."""
    from learning.choice.run import carried_labels
    from learning.data.matching import SensorSelection
    from learning.transfer.carry import CarryRequest, carry

    if request.source is None:
        raise LearningError("--source: missing; allowed: another sensor with labels")
    matched = carry(
        CarryRequest(
            source=request.source,
            target=request.sensor,
            out=request.out / "steps",
            priors=tuple(options.priors),
            source_labels=options.source_labels,
            ratio=options.force_ratio,
            within=options.scale_within,
            unseen=request.unseen,
            tolerances=tolerances_of(options),
        ),
        lambda line: print(line, flush=True),
    )
    name = request.sensor.name
    origin = carried_labels(matched, request.source.name)
    return replace(
        request, sensor=SensorSelection(matched.archive, name, name), source=None
    ), origin
