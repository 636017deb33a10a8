"""`tactile campaign`: a day of sensors and indenters, resumable after any interruption."""

from __future__ import annotations

import argparse
import functools
import sys
from pathlib import Path
from typing import TYPE_CHECKING

from recorder.command_line.errors import EXIT_DONE
from recorder.command_line.options import next_command
from rig.acquire.calibration import store
from rig.bench.bench import BENCHES_FOLDER
from rig.cli.options import banner, bench_file, benches_option, calibration_options
from rig.cli.recording import Recording
from rig.cli.terminal import answer
from rig.core.errors import ConfigError

if TYPE_CHECKING:
    from rig.acquire.campaign import Item, Progress


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


def record_entry(progress: Progress, operator: str, calibrations: Path, world: str | None) -> int:
    """Record or resume an entry of a campaign; return the exit code.

    Args:
        progress: State of the entry.
        operator: Name of the operator.
        calibrations: Folder of the calibrations.
        world: `sim`: mock benches simulate the contact.
    """
    from rig.cli import collect, force_depth

    item, entry = progress.item, progress.item.entry
    resumed = progress.session if progress.state == "to resume" else None
    file = bench_file(item.bench_path, world=world, resume=resumed)
    print(banner(file), flush=True)
    recording = Recording(
        file.with_indenter(entry.indenter),
        calibrations,
        operator,
        progress.session,
        # The technician agreed to motion when the indenter was mounted.
        agreed=True,
        chosen={"bench": item.bench_path, "world": world},
    )
    if resumed is not None:
        again = tuple(number - 1 for number in progress.again)
        return collect.collect(recording, resumed=resumed, again=again)
    if entry.plan == "force_depth":
        return force_depth.press(recording)
    return collect.collect(recording, targets=entry.targets)


def run(options: argparse.Namespace) -> int:
    """List or record; return the exit code."""
    import dataclasses

    from rig.acquire.campaign import load_campaign, progress_of, run_campaign, table
    from rig.acquire.control import apart
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
    ask = _agree if options.yes else functools.partial(_ask, has_lab_benches=bool(lab))

    def record(progress: Progress) -> int:
        chosen = (campaign.operator, options.calibrations, options.world)
        return apart(record_entry, progress, *chosen)

    return run_campaign(
        campaign,
        record,
        ask,
        _say,
        _swap,
        keep_going=options.keep_going,
        go_on=_go_on(options),
    )


def _go_on(options: argparse.Namespace) -> str:
    """Return the command that continues the campaign."""
    elsewhere = options.calibrations != store.FOLDER
    return next_command(
        "campaign",
        file=options.file,
        benches=None if options.benches == BENCHES_FOLDER else options.benches,
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
