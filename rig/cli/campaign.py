"""`tactile campaign`: a day of sensors and indenters, resumable after any interruption."""

import argparse
import dataclasses
import functools
import sys
from collections.abc import Callable
from pathlib import Path

from recorder.catalogue import Catalogue
from recorder.command_line.errors import EXIT_DONE, EXIT_INTERRUPTED, EXIT_WRONG_INPUT
from recorder.command_line.options import next_command
from rig.acquire.calibration import store
from rig.acquire.campaign import (
    Campaign,
    Item,
    Progress,
    load_campaign,
    progress_in,
    progress_of,
    table,
)
from rig.acquire.control import apart
from rig.bench.bench import BENCHES_FOLDER, read_content, with_simulated_world
from rig.cli import force_depth
from rig.cli.options import (
    answer,
    banner,
    bench_file,
    benches_option,
    calibration_options,
    motion_lines,
)
from rig.cli.recording import Recording, collect
from rig.core.errors import ConfigError

_say = functools.partial(print, flush=True)


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
        help="mock benches: solve the contact along the path, not by superposed presses",
    )
    parser.add_argument(
        "--keep-going",
        action="store_true",
        help="continue with the next session after a lost device or a safety stop",
    )
    calibration_options(parser)


def record_entry(progress: Progress, operator: str, calibrations: Path, world: str | None) -> int:
    """Record or resume an entry of a campaign, a mock's in this world; return the exit code."""
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
        return collect(recording, resumed=resumed, again=again)
    if entry.plan == "force_depth":
        return force_depth.press(recording)
    return collect(recording, targets=entry.targets)


def run(options: argparse.Namespace) -> int:
    """List or record; return the exit code."""
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

    keep_going, go_on = options.keep_going, _go_on(options)
    return run_campaign(campaign, record, ask, _swap, keep_going=keep_going, go_on=go_on)


def run_campaign(
    campaign: Campaign,
    record: Callable[[Progress], int],
    ask: Callable[[str], bool],
    swap: Callable[[Item], None] | None = None,
    *,
    keep_going: bool = False,
    go_on: str = "",
) -> int:
    """Record all unfinished sessions and return the exit code.

    A technician is asked to mount each sensor and indenter; False of `ask` ends the campaign. With
    `swap` and a gripper on the bench there is no question about the indenter: `swap` waits until
    the gripper holds it, or raises DeviceLost.

    Exit code 0: all is done. Otherwise it is that of the session that ended the campaign, or with
    `keep_going` of the first session that failed. Ctrl-C ends the current session in order, and the
    campaign. The command `go_on` continues it, and is shown if something is left.
    """
    campaign.out.mkdir(parents=True, exist_ok=True)
    failed = EXIT_DONE
    before: Item | None = None
    catalogue = Catalogue(campaign.out)
    catalogue.refresh()
    for number, item in enumerate(campaign.items):
        progress = progress_in(campaign, item, catalogue)
        entry = progress.item.entry
        if progress.state == "done":
            continue
        if progress.state == "unreadable":
            _say(f"{progress.session}: {progress.note}")
            failed = failed or EXIT_WRONG_INPUT
            if keep_going:
                continue
            break
        ordinal = f"{number + 1} of {len(campaign.items)}"
        if not _mount(item, ordinal, before, ask, swap):
            failed = EXIT_INTERRUPTED
            break
        before = item
        _say(f"recording {progress.session}")
        code = record(progress)
        if code == EXIT_DONE:
            if progress.state == "to resume" and entry.plan == "force_depth":
                # It was resumed by `collect`, which draws no curve.
                force_depth.show_curve(progress.session)
            continue
        _say(f"{item.name}: ended with exit code {code}")
        failed = failed or code
        if code == EXIT_INTERRUPTED or not keep_going:
            break
    states = [progress_in(campaign, item, catalogue) for item in campaign.items]
    catalogue.save()
    for line in table(states):
        _say(line)
    if any(progress.state != "done" for progress in states) and go_on:
        _say(f"to continue: {go_on}")
    return failed


def _mount(
    item: Item,
    place: str,
    before: Item | None,
    ask: Callable[[str], bool],
    swap: Callable[[Item], None] | None,
) -> bool:
    """Have an item's sensor and indenter mounted; return False if the technician stops.

    Another bench file on a lab bench is asked about even if they stay: it moves otherwise.
    """
    entry, bench = item.entry, item.bench
    gripped = swap is not None and bench.gripper is not None and not bench.mock
    new_bench = before is None or before.bench_path != item.bench_path
    new_sensor = before is None or before.bench.sensor != bench.sensor
    new_indenter = new_sensor or before is None or before.entry.indenter != entry.indenter
    if new_sensor or (new_bench and not bench.mock) or (new_indenter and not gripped):
        mount = f"{'mount' if new_indenter else 'keep'} sensor {bench.sensor}"
        indenter = "" if gripped else f", indenter {entry.indenter}"
        own = "" if entry.sensor == bench.sensor else f" (bench file {entry.sensor})"
        mock = " (mock bench: nothing to mount)" if bench.mock else ""
        pressed = dataclasses.replace(bench, indenter=entry.indenter)
        lines = motion_lines(pressed, max(pressed.dry_run(item.plan).depths[: item.total]))
        moves = "" if bench.mock else "\n".join(["", *lines])
        if not ask(f"{place}: {mount}{indenter}{own}{mock}{moves}"):
            return False
    if new_indenter and gripped and swap is not None:
        try:
            swap(item)
        except KeyboardInterrupt:
            return False
    return True


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
    expected = "move" if has_lab_benches else ""
    press = 'type "move" and Enter' if expected else "Enter"
    try:
        typed = answer(f"{question}; {press} when it is mounted, anything else to stop: ")
    except KeyboardInterrupt:
        typed = None
    if typed is None:
        print()
    return typed == expected
