"""`python -m sim loop`: press, shear, shear back and lift."""

from __future__ import annotations

import argparse
import math

from recorder.command_line.options import positive, whole
from sim.cli.options import STEPS_MAX, add_scene_options, add_speed, metres
from sim.scene import press_shear_return


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of the command."""
    group = parser.add_argument_group("motion")
    group.add_argument(
        "--depth", type=positive, default=1.0, metavar="MM", help="depth [mm] (%(default)s)"
    )
    group.add_argument(
        "--shear",
        type=positive,
        default=1.0,
        metavar="MM",
        help="lateral displacement at that depth [mm] (%(default)s)",
    )
    group.add_argument(
        "--angle",
        type=float,
        default=0.0,
        metavar="DEG",
        help="direction of the shear, from x towards y [deg] (%(default)s)",
    )
    group.add_argument(
        "--steps",
        type=whole(1, STEPS_MAX),
        default=5,
        metavar="N",
        help="frames of each of the 4 phases (%(default)s)",
    )
    add_speed(group)
    add_scene_options(parser, friction=0.5)


def run(options: argparse.Namespace) -> int:
    """Press, shear, return and lift, show every frame and return the exit code.

    Raises:
        SceneError, SimulationDiverged: Nothing has been written.
    """
    from sim.cli.report import run_motion

    motion = press_shear_return(
        metres(options.depth),
        metres(options.shear),
        angle=math.radians(options.angle),
        steps=options.steps,
        at=(metres(options.at[0]), metres(options.at[1])),
        speed=metres(options.speed),
    )
    return run_motion(options, motion)
