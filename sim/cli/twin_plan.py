"""`tactile twin plan`: presses that identify a twin best in the time given."""

import argparse
import os
import sys
from collections import Counter
from pathlib import Path
from typing import Any

from recorder.command_line.options import add_grid, add_value, names, next_command, positive

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
    from sim.twin.record import plan_files

    planned, report = (_without_gauge if options.no_gauge else _with_gauge)(options)
    bench = options.bench or f"{Path(options.sensor).stem}.yaml"
    if os.sep in bench or Path(bench).exists():
        bench = os.path.relpath(bench, options.out)
    options.out.mkdir(parents=True, exist_ok=True)
    for name, text in plan_files(planned, bench).items():
        (options.out / name).write_text(text, encoding="utf-8")
    print("\n".join(report))
    print(next_command("campaign", file=options.out / "campaign.yaml", benches=options.out))
    return 0


def _with_gauge(options: argparse.Namespace) -> tuple[list[Any], list[str]]:
    from recorder.progress import Progress
    from sim.indenters import NAMES
    from sim.sensors import sensor_of
    from sim.twin.plan import Planner, sessions
    from sim.twin.record import expected_lines

    planner = Planner(sensor_of(options.sensor), noise=1e-3 * options.noise, grid=options.grid)
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
    return planned, expected_lines(planner, planned, usual, options.change)


def _without_gauge(options: argparse.Namespace) -> tuple[list[Any], list[str]]:
    from sim.indenters import NAMES
    from sim.sensors import sensor_of
    from sim.twin.gaugeless import BEARS, plan_without_gauge
    from sim.twin.record import session_line

    design = sensor_of(options.sensor)
    planned, weight = plan_without_gauge(design, options.indenters or NAMES)
    line = "weight: none of the usual ones; the skin is too soft for the lightest"
    if weight is not None:
        line = (
            f"weight: {1e3 * weight[1]:g} g, tip and holder included, on {weight[0]} presses "
            f"{1e3 * weight[2]:.2g} mm deep into {1e-3 * design.body.modulus:.3g} kPa; begin with "
            f"a lighter one, and stop at {100 * BEARS:.0f} % of the thickness"
        )
    return planned, [*map(session_line, planned), line]
