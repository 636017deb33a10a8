"""`tactile twin fit`: identify a simulated twin of a sensor from recorded presses."""

from __future__ import annotations

import argparse
import json
import os
import sys
from pathlib import Path

from recorder.command_line.options import add_grid, positive
from sim.errors import SceneError

# Difference of forces at rest above which a twin is refused [%].
REFUSED = 5.0
# Pixels of the fit.
GRID = 96


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of the command."""
    parser.description = (
        "Fits modulus, thickness, Poisson's ratio, relaxation and friction of a sensor, with the "
        "height of its surface, tilt of its pad, compliance of arm and mount and axes of the "
        "gauge, to presses "
        "that stand still for a while: see `tactile twin plan`. Writes a row that "
        "simulations and mock benches take as a sensor, with its uncertainty, and a picture. "
        "Refuses a twin that does not explain the forces."
    )
    add = parser.add_argument
    add("sessions", nargs="+", type=Path, metavar="SESSION", help="sessions of one sensor")
    add(
        "--sensor",
        required=True,
        metavar="NAME",
        help="design to begin with: a row of sim/sensors, or a YAML file",
    )
    add("--out", type=Path, default=Path("twin.yaml"), metavar="PATH", help="row (%(default)s)")
    add("--picture", type=Path, metavar="PATH", help="picture (beside --out, .png)")
    add("--json", action="store_true", help="print the result as JSON")
    add(
        "--misfit",
        type=positive,
        default=REFUSED,
        metavar="PERCENT",
        help="largest difference of forces at rest (%(default)g)",
    )
    add_grid(parser, GRID)


def run(options: argparse.Namespace) -> int:
    """Fit, write row and picture, and return the exit code: 1 if the twin is refused.

    Raises:
        SceneError: A session or the sensor cannot be used.
        SimulationDiverged: A candidate has no solution.
    """
    from recorder import Session, SessionError
    from recorder.progress import Progress
    from sim.sensors import NAMES, sensor_of
    from sim.sensors.sensor import ROWS
    from sim.twin import fitted, tracks_of
    from sim.twin.record import draw, lines, summary, twin_yaml

    design = sensor_of(options.sensor)
    tracks = []
    for path in options.sessions:
        try:
            tracks += tracks_of(Session(path))
        except SessionError as error:
            raise SceneError(str(error)) from error
    with Progress("twin", sys.stderr) as progress:
        fit = fitted(tracks, design, grid=options.grid, progress=progress)
    picture = options.picture or options.out.with_suffix(".png")
    names = [path.name for path in options.sessions]
    draw(fit, picture, f"Twin of {design.name}: misfit {100 * fit.misfit:.2f} %")
    refused = 100 * fit.misfit > options.misfit
    if options.json:
        print(json.dumps({**summary(fit), "refused": refused}, indent=1))
    else:
        print("\n".join(lines(fit)))
    if refused:
        print(
            f"refused: forces at rest differ by {100 * fit.misfit:.1f} %; allowed: up to "
            f"{options.misfit:g} % (--misfit); see {picture}",
            file=sys.stderr,
        )
        return 1
    own = options.sensor not in NAMES
    extends = os.path.relpath(options.sensor, options.out.parent) if own else f"{design.name}.yaml"
    assert own or (ROWS / extends).exists()
    options.out.parent.mkdir(parents=True, exist_ok=True)
    options.out.write_text(twin_yaml(fit, extends, names), encoding="utf-8")
    if not options.json:
        print(f"{options.out}\n{picture}")
    return 0
