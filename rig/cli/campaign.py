"""`tactile campaign`: a day of sensors and indenters, resumable after any interruption."""

from __future__ import annotations

import argparse
import functools
import sys
from pathlib import Path
from typing import TYPE_CHECKING

from recorder.command_line.errors import EXIT_DONE
from recorder.command_line.options import next_command
from rig.cli.options import benches_option, calibration_options
from rig.cli.terminal import answer
from rig.core.errors import ConfigError

if TYPE_CHECKING:
    from rig.acquire.campaign import Item


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of the command."""
    parser.add_argument("--file", type=Path, required=True, help="YAML like campaigns/day.yaml")
    benches_option(parser)
    parser.add_argument("--out", type=Path, help="folder of the sessions (default: the file's)")
    parser.add_argument("--list", action="store_true", help="only list finished and open sessions")
    parser.add_argument("--yes", action="store_true", help="mock benches: do not ask for swaps")
    parser.add_argument(
        "--world",
        choices=("sim",),
        help="mock benches: simulate the contact by `sim` in place of the bench files' formulae",
    )
    parser.add_argument(
        "--keep-going",
        action="store_true",
        help="continue with the next session after a lost device or a safety stop",
    )
    calibration_options(parser)


def run(options: argparse.Namespace) -> int:
    """List or record; return the exit code.

    Raises:
        ConfigError: The campaign cannot be run.
    """
    import dataclasses

    from rig.acquire.campaign import Settings, load_campaign, progress_of, run_campaign, table
    from rig.bench.bench import read_content, with_simulated_world

    campaign = load_campaign(options.file, options.benches)
    if options.out is not None:
        campaign = dataclasses.replace(campaign, out=options.out)
    print("\n".join(table(progress_of(campaign))), flush=True)
    if options.list:
        return EXIT_DONE
    lab = sorted({item.bench.sensor for item in campaign.items if not item.bench.mock})
    if lab and options.yes:
        raise ConfigError(f"--yes: {', '.join(lab)}: lab benches; allowed: mock benches only")
    if options.world is not None:
        for item in campaign.items:
            with_simulated_world(read_content(item.bench_path), str(item.bench_path))
    settings = Settings(
        options.benches,
        options.calibrations,
        options.keep_going,
        _go_on(options),
        options.world,
    )
    ask = _agree if options.yes else functools.partial(_ask, has_lab_benches=bool(lab))
    return run_campaign(campaign, settings, ask, _say, _swap)


def _go_on(options: argparse.Namespace) -> str:
    """Return the command that continues the campaign."""
    from rig.acquire.calibration import store

    elsewhere = options.calibrations != store.FOLDER
    return next_command(
        "campaign",
        file=options.file,
        benches=None if options.benches == Path("benches") else options.benches,
        out=options.out,
        calibrations=options.calibrations if elsewhere else None,
        world=options.world,
        yes=options.yes,
        keep_going=options.keep_going,
    )


def _say(line: str) -> None:
    print(line, flush=True)


def _swap(item: Item) -> None:
    """Wait until the gripper of the item's bench holds its indenter."""
    from rig.core.clock import SystemClock
    from rig.devices.gripper.robotiq import RobotiqDriver, swap_held

    config = item.bench.gripper
    if config is None:
        raise ConfigError(f"{item.bench_path}.gripper: missing")
    clock = SystemClock()
    with RobotiqDriver(config, clock) as gripper:
        gripper.open(item.bench.preflight.timeout)
        swap_held(gripper, f"indenter {item.entry.indenter}", clock, _say)


def _agree(question: str) -> bool:
    print(question, flush=True)
    return True


def _ask(question: str, *, has_lab_benches: bool) -> bool:
    """Wait for Enter, with a lab bench for the word `move`; return False for anything else."""
    if not sys.stdin.isatty():
        raise ConfigError("campaign: no terminal to ask on; on mock benches use --yes")
    word = "move" if has_lab_benches else ""
    press = 'type "move" and Enter' if word else "Enter"
    try:
        typed = answer(f"{question}; {press} when it is mounted, anything else to stop: ")
    except KeyboardInterrupt:
        typed = None
    if typed is None:
        print()
    return typed == word
