"""`python -m sim press`: press straight down to a sequence of depths."""

from __future__ import annotations

import argparse

from recorder.command_line.options import numbers
from sim.cli.options import add_scene_options, add_speed, metres
from sim.errors import SceneError
from sim.scene import press


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of the command."""
    group = parser.add_argument_group("motion")
    group.add_argument(
        "--depths",
        type=numbers(),
        default=(0.5, 1.0, 1.5),
        metavar="MM,...",
        help="depths to go to in turn, from the touched surface [mm] (0.5,1,1.5)",
    )
    add_speed(group)
    add_scene_options(parser)


def run(options: argparse.Namespace) -> int:
    """Press, show the frame of every depth and return the exit code.

    Raises:
        SceneError, SimulationDiverged: Nothing has been written.
    """
    from sim.cli.report import run_motion

    before = 0.0
    for index, depth in enumerate(options.depths):
        if depth == before:
            raise SceneError(
                f"--depths[{index}]: {depth!r} mm; allowed: another depth than {before!r} mm, "
                "where the tip already is"
            )
        before = depth
    motion = press(
        [metres(depth) for depth in options.depths],
        at=(metres(options.at[0]), metres(options.at[1])),
        speed=metres(options.speed),
    )
    return run_motion(options, motion, first=1)
