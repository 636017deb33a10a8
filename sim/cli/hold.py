"""`python -m sim hold`: press within a given time, then hold still while the force relaxes."""

from __future__ import annotations

import argparse

from recorder.command_line.options import positive, whole
from sim.cli.options import STEPS_MAX, add_scene_options, metres
from sim.scene import ramp_hold


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of the command."""
    group = parser.add_argument_group("motion")
    group.add_argument(
        "--depth", type=positive, default=1.0, metavar="MM", help="depth [mm] (%(default)s)"
    )
    group.add_argument(
        "--ramp",
        type=positive,
        default=0.1,
        metavar="S",
        help="duration of the press [s] (%(default)s)",
    )
    group.add_argument(
        "--hold",
        type=positive,
        default=2.0,
        metavar="S",
        help="duration of the hold [s] (%(default)s)",
    )
    group.add_argument(
        "--steps",
        type=whole(1, STEPS_MAX),
        default=10,
        metavar="N",
        help="frames of the press, and of the hold (%(default)s)",
    )
    add_scene_options(parser, viscosity="0.5:0.5")


def run(options: argparse.Namespace) -> int:
    """Press and hold, show every frame and return the exit code.

    Raises:
        SceneError, SimulationDiverged: Nothing has been written.
    """
    from sim.cli.report import run_motion

    motion = ramp_hold(
        metres(options.depth),
        ramp=options.ramp,
        hold=options.hold,
        steps=options.steps,
        at=(metres(options.at[0]), metres(options.at[1])),
    )
    return run_motion(options, motion)
