"""`tactile sim press`: press to a sequence of depths, and hold or shear there."""

from __future__ import annotations

import argparse
import math

from recorder.command_line.options import numbers, positive, whole
from sim.cli.options import STEPS_MAX, add_scene_options, metres
from sim.errors import SceneError
from sim.scene import Motion, press


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
    group.add_argument(
        "--hold", type=positive, metavar="S", help="rest at the last depth for this time [s] (none)"
    )
    group.add_argument(
        "--shear",
        type=positive,
        metavar="MM",
        help="then move sideways by this length, back, and lift [mm] (none)",
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
        default=1,
        metavar="N",
        help="frames of each press, hold, shear, return and lift (%(default)s)",
    )
    group.add_argument(
        "--speed",
        type=float,
        default=10.0,
        metavar="MM/S",
        help="speed of the tip; matters to viscosity and inertia only [mm/s] (%(default)s)",
    )
    add_scene_options(parser)


def run(options: argparse.Namespace) -> int:
    """Press, show every frame with contact and return the exit code."""
    from sim.cli.report import run_motion

    before = 0.0
    for index, depth in enumerate(options.depths):
        if depth == before:
            raise SceneError(
                f"--depths[{index}]: {depth!r} mm; allowed: another depth than {before!r} mm, "
                "where the tip already is"
            )
        before = depth
    return run_motion(options, motion_of(options))


def motion_of(options: argparse.Namespace) -> Motion:
    """Return the motion that the options describe."""
    return press(
        [metres(depth) for depth in options.depths],
        hold=options.hold or 0.0,
        shear=metres(options.shear or 0.0),
        angle=math.radians(options.angle),
        steps=options.steps,
        at=(metres(options.at[0]), metres(options.at[1])),
        speed=metres(options.speed),
    )
