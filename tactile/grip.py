"""`tactile grip`: the gripper of a bench, or grips by force of simulated fingers (`--demo`)."""

import argparse

from recorder.command_line.options import add_seed, add_value, whole
from rig.cli import grip
from rig.core.errors import ConfigError


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of the command."""
    grip.add_options(parser)
    demo = parser.add_argument_group("grip by force, in simulation: no bench is needed")
    about = "lift objects of unknown weight and friction with two simulated fingers"
    demo.add_argument("--demo", action="store_true", help=about)
    add_value(demo, "--lifts", "N", 100, "number of objects", whole(1))
    add_seed(demo)


def run(options: argparse.Namespace) -> int:
    """Lift simulated objects, or grip on a bench; return the exit code."""
    if not options.demo:
        return grip.run(options)
    for name in ("bench", "sensor", "open"):
        if getattr(options, name, None):
            raise ConfigError(f"--{name}: does not go with --demo, which needs no bench")
    from tactile.grasp_demo import demo

    demo(options.seed, options.lifts, lambda text: print(text, flush=True))
    return 0
