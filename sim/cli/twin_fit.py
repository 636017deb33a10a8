"""`tactile twin fit`: identify a simulated twin of a sensor from recorded presses."""

import argparse
import json
import os
import sys
from pathlib import Path
from typing import Any

from recorder.command_line.options import (
    add_device,
    add_grid,
    add_value,
    next_command,
    positive,
    whole,
)
from sim.errors import SceneError

# Difference of forces at rest above which a twin is refused [%].
REFUSED = 5.0
# Difference of markers at rest over their motion from which a twin is refused [%].
REFUSED_MARKERS = 25.0
# Pixels of the fit.
GRID = 96
# Twin, result for programs, result in words, and why it is refused.
_Outcome = tuple[Any, dict[str, Any], list[str], list[str]]


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of the command."""
    parser.description = (
        "Fits modulus, thickness, Poisson's ratio, relaxation and friction of a sensor, with the "
        "height of its surface, tilt of its pad, compliance of arm and mount and axes of the "
        "gauge, to presses "
        "that stand still for a while: see `tactile twin plan`. Writes a row that "
        "simulations and mock benches take as a sensor, with its uncertainty, and a picture. "
        "Refuses a twin that does not explain the forces. With the marker archive of the "
        "sessions, also the camera and the layout of its markers."
    )
    add = parser.add_argument
    add("sessions", nargs="+", type=Path, metavar="SESSION", help="sessions of one sensor")
    about = "design to begin with: a row of sim/sensors, or a YAML file"
    add("--sensor", required=True, metavar="NAME", help=about)
    about = "marker archives of these sessions (tactile markers), for camera and layout"
    add("--markers", nargs="+", type=Path, default=[], metavar="ARCHIVE", help=about)
    about = "fit without forces: the skin by the motion of its markers"
    add("--no-gauge", action="store_true", help=about)
    about = "without a gauge: mass of weight, tip and holder, and the marker archive under it"
    add("--weight", action="append", default=[], metavar="MASS=ARCHIVE", help=about)
    about = "the same of a weight that is not fitted but foretold"
    add("--check-weight", action="append", default=[], metavar="MASS=ARCHIVE", help=about)
    about = "sessions that are not fitted but foretold"
    add("--held-out", nargs="+", type=Path, default=[], metavar="SESSION", help=about)
    add("--out", type=Path, default=Path("twin.yaml"), metavar="PATH", help="row (%(default)s)")
    add("--picture", type=Path, metavar="PATH", help="picture (beside --out, .png)")
    add("--json", action="store_true", help="print the result as JSON")
    about = "largest difference of forces at rest"
    add_value(parser, "--misfit", "PERCENT", REFUSED, about, positive)
    about = "largest difference of markers at rest, over how far they moved"
    add_value(parser, "--misfit-markers", "PERCENT", REFUSED_MARKERS, about, positive)
    add(
        "--tier",
        choices=("layer", "fem"),
        help="law of the forces: layer: small strain; fem: corrected for large strain, in "
        "minutes; from a depth of a sixth of the thickness on it matters (layer; without a gauge "
        "fem)",
    )
    add_device(parser, "device of tier fem")
    add_grid(parser, GRID)
    add_value(parser, "--processes", "N", 2, "processes", whole(1))


def run(options: argparse.Namespace) -> int:
    """Fit, write row and picture, and return the exit code: 1 if the twin is refused."""
    from recorder.archive import MarkerArchive
    from recorder.progress import Progress
    from sim.sensors import NAMES, sensor_of
    from sim.sensors.sensor import ROWS
    from sim.twin.record import twin_yaml

    design, archives = sensor_of(options.sensor), [MarkerArchive(path) for path in options.markers]
    fit = _without_gauge if options.no_gauge else _with_gauge
    with Progress("twin", sys.stderr) as progress:
        twin, content, report, refused = fit(options, design, archives, progress)
    text = json.dumps({**content, "refused": bool(refused)}, indent=1)
    print(text if options.json else "\n".join(report))
    if refused:
        print(f"refused: {'; '.join(refused)}", file=sys.stderr)
        return 1
    own = options.sensor not in NAMES
    extends = os.path.relpath(options.sensor, options.out.parent) if own else f"{twin.name}.yaml"
    assert own or (ROWS / extends).exists()
    options.out.parent.mkdir(parents=True, exist_ok=True)
    row = twin_yaml(twin, extends, [path.name for path in options.sessions])
    options.out.write_text(row, encoding="utf-8")
    if not options.json:
        print(options.out)
        labels = next_command("sim", "labels", "ARCHIVE", sensor="NAME", twin=options.out)
        print(f"labels by it: {labels}")
    return 0


def _with_gauge(options: argparse.Namespace, design: Any, archives: Any, progress: Any) -> _Outcome:
    """Fit to forces, draw, and return twin, result for programs and in words, and refusals."""
    from recorder.session import Session
    from sim.twin import fitted, fitted_camera, held_out_predictions, marker_observations, tracks_of
    from sim.twin.record import draw, lines, summary

    if options.weight or options.check_weight:
        raise SceneError("--weight: with a gauge; allowed: with --no-gauge")
    if both := [path.name for path in options.held_out if path in options.sessions]:
        raise SceneError(f"--held-out: {', '.join(both)}, fitted as well; allowed: other sessions")
    tracks, others = (
        [track for path in paths for track in tracks_of(Session(path))]
        for paths in (options.sessions, options.held_out)
    )
    observations = marker_observations([*tracks, *others], archives)
    of_fit = [each for each in observations if each.track in tracks]
    if options.markers and not of_fit:
        raise SceneError("--markers: of held-out sessions alone; allowed: of fitted ones as well")
    grid, camera_fit, held_out = options.grid, None, None
    part = 0.8 if of_fit else 1.0
    fit = fitted(
        tracks,
        design,
        grid=grid,
        tier=options.tier or "layer",
        device=options.device,
        processes=options.processes,
        progress=lambda done: progress(part * done),
    )
    if of_fit:
        name = options.out.stem
        camera_fit = fitted_camera(
            fit, of_fit, name=name, grid=grid, progress=lambda done: progress(0.8 + 0.2 * done)
        )
    if others:
        rest = [each for each in observations if each.track in others]
        held_out = held_out_predictions(fit, camera_fit, others, rest, grid)
    picture = options.picture or options.out.with_suffix(".png")
    title = f"Twin of {design.name}: misfit {100 * fit.misfit:.2f} %"
    draw(fit, picture, title, camera_fit, held_out)
    refused = []
    if 100 * fit.misfit > options.misfit:
        refused.append(
            f"forces at rest differ by {100 * fit.misfit:.1f} %; allowed: up to "
            f"{options.misfit:g} % (--misfit)"
        )
    twin = fit.sensor
    if camera_fit is not None:
        refused += _markers_off(options, camera_fit.observations, camera_fit.predicted)
        twin = camera_fit.sensor
    report = [*lines(fit, camera_fit, held_out), f"picture: {picture}"]
    return twin, summary(fit, camera_fit, held_out), report, refused


def _without_gauge(
    options: argparse.Namespace, design: Any, archives: Any, progress: Any
) -> _Outcome:
    """Fit by markers alone, and return as `_with_gauge` does."""
    from recorder.session import Session
    from sim import twin
    from sim.twin.record import lines_without_gauge, values_of

    if not options.markers or options.held_out:
        raise SceneError("--no-gauge: allowed: with --markers, without --held-out")
    tracks = [t for path in options.sessions for t in twin.tracks_of(Session(path), gauge=False)]
    presses = twin.marked_presses(twin.marker_observations(tracks, archives))
    weights, checks = (
        [twin.weighed_press(text, number) for number, text in enumerate(texts, len(tracks))]
        for texts in (options.weight, options.check_weight)
    )
    fit = twin.fitted_without_gauge(
        [*presses, *weights],
        design,
        tier=options.tier or "fem",
        device=options.device,
        processes=options.processes,
        progress=progress,
    )
    foretold = [(check, *fit.force_of(check)) for check in checks]
    checked = [[check.weight, force, spread] for check, force, spread in foretold]
    content = {**values_of(fit), "checks": checked}
    refused = _markers_off(options, fit.presses, fit.predicted)
    return fit.sensor, content, lines_without_gauge(fit, foretold), refused


def _markers_off(options: argparse.Namespace, seen: Any, predicted: Any) -> list[str]:
    """Return why a twin whose markers differ too much is refused, if it is."""
    from sim.twin.camera import differences

    off, way = differences(seen, predicted)
    if 100 * off <= options.misfit_markers * way:
        return []
    return [
        f"markers at rest differ by {off:.2f} px, {100 * off / way:.0f} % of the {way:.2f} px that "
        f"they moved; allowed: up to {options.misfit_markers:g} % (--misfit-markers)"
    ]
