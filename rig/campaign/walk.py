"""Runs what is left of a campaign: asks for the swap, records, goes on."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from rig.campaign.spec import Campaign, Item
from rig.campaign.state import Progress, progress_of, table
from rig.collect.curve import show_curve
from rig.errors import EXIT_DONE, EXIT_INTERRUPTED, EXIT_WRONG_INPUT

Ask = Callable[[str], bool]
"""Shows a question and waits; False ends the campaign."""
Say = Callable[[str], None]
Swap = Callable[[Item], None]
"""Waits until the gripper of an item's bench holds its indenter; raises DeviceLost."""


@dataclass(frozen=True, slots=True)
class Settings:
    """How a campaign is run."""

    benches: Path
    """Folder of bench files."""
    calibrations: Path
    """Folder of calibrations."""
    keep_going: bool = False
    """After a device or safety stop go on with the next entry."""


def command(progress: Progress, campaign: Campaign, settings: Settings) -> list[str]:
    """Arguments of `python -m rig` that record, or go on with, one entry."""
    entry, bench = progress.item.entry, str(progress.item.bench_path)
    kept = ["--calibrations", str(settings.calibrations)]
    if progress.state == "to resume":
        return ["collect", "--bench", bench, "--resume", str(progress.session), *kept]
    common = ["--bench", bench, "--out", str(progress.session), "--indenter", entry.indenter]
    common += [*kept, *(("--operator", campaign.operator) if campaign.operator else ())]
    if entry.plan == "force_depth":
        return ["force-depth", *common]
    wanted = [] if entry.targets is None else ["--targets", str(entry.targets)]
    return ["collect", *common, *wanted]


def run_campaign(
    campaign: Campaign, settings: Settings, ask: Ask, say: Say, swap: Swap | None = None
) -> int:
    """Record everything that is not done; the exit code.

    A technician is asked to mount each sensor and indenter. Where the bench has a gripper and
    `swap` is given, the indenter is not asked for: the gripper notices it.

    0: all is done. Otherwise that of the session that ended it, or with `keep_going` of the first
    one that failed. Ctrl-C ends the session under way in order and the campaign with it.
    """
    campaign.out.mkdir(parents=True, exist_ok=True)
    failed = EXIT_DONE
    mounted: tuple[str, str] | None = None
    for number in range(len(campaign.items)):
        progress = progress_of(campaign)[number]
        entry = progress.item.entry
        if progress.state == "done":
            continue
        if progress.state == "unreadable":
            say(f"{progress.session}: {progress.note}")
            failed = failed or EXIT_WRONG_INPUT
            if settings.keep_going:
                continue
            break
        if mounted != (entry.sensor, entry.indenter):
            place = f"{number + 1} of {len(campaign.items)}"
            if not _mount(progress.item, place, mounted, ask, swap):
                failed = EXIT_INTERRUPTED
                break
            mounted = (entry.sensor, entry.indenter)
        say(f"recording {progress.session}")
        code = _record(command(progress, campaign, settings))
        if code == EXIT_DONE:
            if progress.state == "to resume" and entry.plan == "force_depth":
                # A resumed one went through `collect`, which knows no curve.
                show_curve(progress.session)
            continue
        say(f"{entry.name}: ended with exit code {code}")
        failed = failed or code
        if code == EXIT_INTERRUPTED or not settings.keep_going:
            break
    found = progress_of(campaign)
    for line in table(found):
        say(line)
    if any(progress.state != "done" for progress in found):
        say("the same command goes on from here")
    return failed


def _mount(
    item: Item, place: str, before: tuple[str, str] | None, ask: Ask, swap: Swap | None
) -> bool:
    """Have an item's sensor and indenter mounted; False when the technician ends it."""
    entry, bench = item.entry, item.bench
    gripped = swap is not None and bench.gripper is not None and not bench.mock
    if not gripped or before is None or before[0] != entry.sensor:
        indenter = "" if gripped else f", indenter {entry.indenter}"
        mock = " (mock bench: nothing to mount)" if bench.mock else ""
        if not ask(f"{place}: mount sensor {entry.sensor}{indenter}{mock}"):
            return False
    if gripped and swap is not None:
        try:
            swap(item)
        except KeyboardInterrupt:
            return False
    return True


def _record(arguments: list[str]) -> int:
    """Run one session in a process of its own; its exit code.

    Ctrl-C reaches that process as well: it ends its session in order, and is waited for.
    """
    # Its output is the terminal's: nothing of ours may stand in a buffer behind it.
    sys.stdout.flush()
    with subprocess.Popen([sys.executable, "-m", "rig", *arguments]) as process:
        interrupted = False
        while True:
            try:
                code = process.wait()
                break
            except KeyboardInterrupt:
                interrupted = True
    return EXIT_INTERRUPTED if interrupted or code < 0 else code
