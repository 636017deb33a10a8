"""`tactile twin plan`: presses that identify a twin best in the time given."""

from __future__ import annotations

import argparse
import os
import sys
from collections import Counter
from pathlib import Path
from typing import TYPE_CHECKING

from recorder.command_line.options import add_grid, add_value, names, next_command, positive

if TYPE_CHECKING:
    from sim.sensors import SimulatedSensor
    from sim.twin.plan import PlannedPresses

# Most time at the bench [min], and time to mount an indenter [s].
MINUTES, CHANGE = 5.0, 60.0


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of the command."""
    parser.description = (
        "Chooses indenters, depths, shears and holds whose presses narrow the intervals of a twin "
        "most for their time, as far as simulations of the design tell. Writes a bench file for "
        "each session and a campaign that records them all, and prints the 90 % intervals to "
        "expect, with the plan and with four presses by sphere and prism."
    )
    add = parser.add_argument
    about = "design to begin with: a row of sim/sensors, or a YAML file"
    add("--sensor", required=True, metavar="NAME", help=about)
    about = "bench file that presses, or a packaged one (that of --sensor)"
    add("--bench", metavar="FILE", help=about)
    add("--out", type=Path, default=Path("twin-plan"), metavar="PATH", help="folder (%(default)s)")
    about = "time for all presses, with changes of the indenter"
    add_value(parser, "--minutes", "MIN", MINUTES, about, positive)
    add_value(parser, "--change", "S", CHANGE, "time to mount an indenter", positive)
    add("--indenters", type=names, metavar="NAME,...", help="those at hand (all)")
    about = "standard deviation of a reading of the gauge [mN]"
    add_value(parser, "--noise", "MN", 10.0, about, positive)
    add_grid(parser)
    about = "presses and a weight for `twin fit --no-gauge`, which needs no forces"
    add("--no-gauge", action="store_true", help=about)


def run(options: argparse.Namespace) -> int:
    """Choose, write the files, print the intervals, and return the exit code."""
    from recorder.progress import Progress
    from sim.indenters import NAMES
    from sim.sensors import sensor_of
    from sim.twin.plan import Planner, sessions
    from sim.twin.record import expected_lines

    design = sensor_of(options.sensor)
    if options.no_gauge:
        return _without_gauge(options, design)
    planner = Planner(design, noise=1e-3 * options.noise, grid=options.grid)
    candidates = planner.candidates(options.indenters or NAMES)
    with Progress("plan", sys.stderr) as progress:
        chosen = planner.best(
            candidates, seconds=60 * options.minutes, change=options.change, progress=progress
        )
    if rough := planner.rough(candidates):
        left_out = Counter(each.indenter for each in rough)
        every = Counter(each.indenter for each in candidates)
        shares = ", ".join(f"{name} ({count} of {every[name]})" for name, count in left_out.items())
        print(
            f"left out, because forces jump between pixels (a finer --grid has fewer): {shares}",
            file=sys.stderr,
        )
    planned, usual = sessions(chosen), planner.usual()
    _written(options, planned)
    for line in expected_lines(planner, planned, usual, options.change):
        print(line)
    print(next_command("campaign", file=options.out / "campaign.yaml", benches=options.out))
    return 0


def _without_gauge(options: argparse.Namespace, design: SimulatedSensor) -> int:
    """Write presses by smooth indenters, print them with a weight, and return the exit code."""
    from sim.indenters import NAMES
    from sim.twin.gaugeless import BEARS, OF_SENSOR, expected_without_gauge, plan_without_gauge
    from sim.twin.record import expected_line, session_line

    planned, weight = plan_without_gauge(design, options.indenters or NAMES)
    _written(options, planned)
    for each in planned:
        print(session_line(each))
    if weight is None:
        print("weight: none of the usual ones; the skin is too soft for the lightest")
    else:
        print(
            f"weight: {1e3 * weight[1]:g} g, tip and holder included, on {weight[0]} presses "
            f"{1e3 * weight[2]:.2g} mm deep into {1e-3 * design.body.modulus:.3g} kPa; begin with "
            f"a lighter one, and stop at {100 * BEARS:.0f} % of the thickness"
        )
    after = None if weight is None else (weight[0], weight[2])
    spreads = expected_without_gauge(design, planned, after).spreads
    print("90 % interval, +-")
    for name in OF_SENSOR:
        print(expected_line(name, [spreads[name]]))
    print(next_command("campaign", file=options.out / "campaign.yaml", benches=options.out))
    return 0


def _written(options: argparse.Namespace, planned: list[PlannedPresses]) -> None:
    """Write the bench files of a plan and its campaign."""
    from sim.twin.record import plan_files

    bench = options.bench or f"{Path(options.sensor).stem}.yaml"
    if os.sep in bench or Path(bench).exists():
        bench = os.path.relpath(bench, options.out)
    options.out.mkdir(parents=True, exist_ok=True)
    for name, text in plan_files(planned, bench).items():
        (options.out / name).write_text(text, encoding="utf-8")
