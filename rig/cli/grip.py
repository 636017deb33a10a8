"""`tactile grip`: activate the gripper, open it, close it on the indenter."""

import argparse

from rig.bench.bench import BenchFile
from rig.cli.options import banner, bench_options, bench_path, confirm
from rig.core.clock import SystemClock
from rig.core.errors import ConfigError, DeviceLost
from rig.devices.gripper.settings import RobotiqConfig

# Activation opens and closes the fingers once; it takes one to two seconds [s].
_OPENING = 5.0


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of the command."""
    bench_options(parser, mock=False)
    parser.add_argument("--open", action="store_true", help="only open; a held indenter falls")


def run(options: argparse.Namespace) -> int:
    """Activate the gripper, open or close it; return the exit code."""
    from rig.devices.gripper.robotiq import RobotiqDriver

    path = bench_path(options)
    file = BenchFile.read(path)
    bench = file.bench
    if bench.gripper is None:
        raise ConfigError(f"{path}.gripper: missing; allowed: {{kind: robotiq_2f, port: PORT}}")
    if bench.mock:
        raise ConfigError(f"{path}: a mock bench's gripper holds from the start; mock: true")
    print(banner(file).replace("arm", "gripper"), flush=True)
    confirm(grip_lines(bench.gripper, only_open=options.open), "open" if options.open else "grip")
    with RobotiqDriver(bench.gripper, SystemClock()) as gripper:
        gripper.open(bench.preflight.timeout)
        print(f"gripper: {gripper.status().text}", flush=True)
        gripper.activate(_OPENING)
        status = gripper.open_fingers() if options.open else gripper.close_fingers()
    print(f"gripper: {status.text}")
    if not options.open and not status.holding:
        raise DeviceLost("gripper: closed on nothing; put the indenter between the fingers")
    return 0


def grip_lines(gripper: RobotiqConfig, *, only_open: bool) -> list[str]:
    """Return the next motion of a gripper's fingers, with its speed and force, as lines."""
    then = "then stay open" if only_open else "then close on the indenter"
    return [
        f"fingers   close and open once (activation), {then}; an indenter that is held now falls",
        f"speed     {gripper.speed} of 255, after the activation",
        f"force     {gripper.force} of 255",
    ]
