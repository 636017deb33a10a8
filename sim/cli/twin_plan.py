"""`tactile twin plan`: presses that identify a twin best in the time given."""

import argparse
import os
import sys
from collections import Counter
from pathlib import Path

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
    add(
        "--sensor",
        required=True,
        metavar="NAME",
        help="design to begin with: a row of sim/sensors, or a YAML file",
    )
    add(
        "--bench",
        metavar="FILE",
        help="bench file that presses, or a packaged one (that of --sensor)",
    )
    add("--out", type=Path, default=Path("twin-plan"), metavar="PATH", help="folder (%(default)s)")
    about = "time for all presses, with changes of the indenter"
    add_value(parser, "--minutes", "MIN", MINUTES, about, positive)
    add_value(parser, "--change", "S", CHANGE, "time to mount an indenter", positive)
    add("--indenters", type=names, metavar="NAME,...", help="those at hand (all)")
    about = "standard deviation of a reading of the gauge [mN]"
    add_value(parser, "--noise", "MN", 10.0, about, positive)
    add_grid(parser)


def run(options: argparse.Namespace) -> int:
    """Choose, write the files, print the intervals, and return the exit code."""
    from recorder.progress import Progress
    from sim.indenters import NAMES
    from sim.sensors import sensor_of
    from sim.twin.plan import Planner, sessions
    from sim.twin.record import expected_lines, plan_files

    design = sensor_of(options.sensor)
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
    bench = options.bench or f"{Path(options.sensor).stem}.yaml"
    if os.sep in bench or Path(bench).exists():
        bench = os.path.relpath(bench, options.out)
    options.out.mkdir(parents=True, exist_ok=True)
    for name, text in plan_files(planned, bench).items():
        (options.out / name).write_text(text, encoding="utf-8")
    for line in expected_lines(planner, planned, usual, options.change):
        print(line)
    print(next_command("campaign", file=options.out / "campaign.yaml", benches=options.out))
    return 0
