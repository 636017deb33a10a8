"""Part `faults`: one short collection a row, with its fault, and what it left behind."""

from __future__ import annotations

import contextlib
import re
import shutil
import tempfile
from collections.abc import Sequence
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any

from benchmarks.faults.collection_run import CollectionRun, Hangs, quick_bench
from benchmarks.faults.disk import CannotMount, tmpfs
from benchmarks.faults.judge import Stored, arm_in_words, complaints, losses, stored_in
from benchmarks.faults.rows import QUICK, ROWS, Row
from benchmarks.report import Page, Run, table
from recorder import SessionError, recover
from recorder.charts import BLUE, chart
from recorder.command_line.errors import CommandError
from rig.acquire import streams
from rig.bench.bench import BenchFile, BenchLimits
from rig.core import emulation
from rig.core.clock import SECOND_NS, SystemClock
from rig.core.errors import ConfigError
from rig.core.mock_names import PORTS
from rig.core.packaged import BENCHES
from rig.devices.arm.settings import ArmConfig
from rig.devices.hid.shim import build

# Maximum time to wait for a temporary fault to end, so that all its effects are counted [s].
_CLEARING = 5.0
# With less free space than this, the next record does not fit [bytes].
_FULL = 1 << 16
_FILLING = 60.0
UNREPORTED = "the arm is not clear, and this is not reported"
# Maximum length of a reason; the rest is advice to the technician [characters].
_LONGEST = 150


@dataclass(frozen=True, slots=True)
class RowResult:
    """Result of a collection with a fault."""

    device: str
    fault: str
    exit: int | None
    """Exit code, or None if the collection did not end."""
    reaction: str
    """Last message of the rig."""
    noticed: float | None = None
    """Time from the fault to the end of the phase that it ended [s]."""
    looked_for: int = 0
    """Number of samples seen while recording, which were looked for in the session."""
    lost: int = 0
    """Number of those that are missing from the session, plus missing stored rows."""
    arm: str = "not known"
    """State of the arm at the end, in words."""
    wrong: tuple[str, ...] = ()
    """Failures; empty if the row passed."""
    stored: Stored | None = None
    """Content of the session, or None if it cannot be read."""


def measure(run: Run) -> dict[str, Any]:
    """Run the rows one after the other; return their results, and the reasons of those left out."""
    rows, skipped = chosen_rows(run), {}
    results: list[dict[str, Any]] = []
    for number, row in enumerate(rows):
        with tempfile.TemporaryDirectory(prefix="tactile-rig-", dir=run.folder) as folder:
            try:
                result = run_row(row, Path(folder))
            except (ConfigError, CannotMount) as error:
                skipped[row.name] = str(error)
            else:
                results.append(asdict(result))
                run.failures += [f"{row.name}: {what}" for what in result.wrong]
        run.progress((number + 1) / len(rows))
    return {"rows": results, "skipped": skipped}


def chosen_rows(run: Run) -> list[Row]:
    """Return the rows to run: all, a few of a quick run, or those of `--row`.

    Raises:
        CommandError: A name that no row has, or a page of complete runs for a choice of rows.
    """
    names: list[str] = run.options.row or []
    known = [row.name for row in ROWS]
    if unknown := sorted(set(names) - set(known)):
        raise CommandError(f"--row: found {', '.join(unknown)}; allowed: {', '.join(known)}")
    if names and not run.quick and run.options.out is None:
        raise CommandError("--row: found no --quick and no --out; allowed: with one of them")
    names = names or (list(QUICK) if run.quick else known)
    return [row for row in ROWS if row.name in names]


def run_row(row: Row, folder: Path) -> RowResult:
    """Run one collection with one fault.

    Args:
        row: The fault.
        folder: Empty folder for the session.

    Raises:
        ConfigError: The row needs a compiler, and none is installed.
        CannotMount: The row needs a disk, which only root can mount.
    """
    bench = quick_bench(folder, row.sensor, limits=row.limits, more=row.more)
    disk = folder / "disk"
    arguments = ("--bench", str(bench), "--targets", str(row.targets))
    preload = build(folder) if row.pedal else None
    with contextlib.ExitStack() as stack:
        if row.disk_mb:
            stack.enter_context(tmpfs(disk, row.disk_mb))
        session = (disk if row.disk_mb else folder) / "s.zarr"
        collection = stack.enter_context(CollectionRun(session, *arguments, preload=preload))
        try:
            touched = _with_fault(row, collection)
            code = collection.wait()
        except (Hangs, LookupError, OSError) as error:
            last = str(error).strip().splitlines() or [""]
            wrong = (f"did not end: {last[0]}", *last[-3:])
            return RowResult(row.device, row.fault, None, collection.last_line, wrong=wrong)
        if row.disk_mb:
            # A technician would make space, then recover.
            collection.session = folder / "s.zarr"
            shutil.copytree(session, collection.session)
        return judge(row, collection, code, touched)


def _with_fault(row: Row, collection: CollectionRun) -> int:
    """Inject the fault and return the number of messages it touched, or 0 if not counted."""
    if row.disk_mb:
        _fill(collection)
    elif row.act is None:
        collection.until_recording()
    else:
        collection.until_pressing(row.before)
        row.act(collection)
    if row.counts is None:
        return 0
    clock, port = SystemClock(), PORTS[row.device]
    deadline_ns = clock.now_ns() + round(_CLEARING * SECOND_NS)
    while True:
        state = emulation.inject(collection.host, port, "state")
        if not state.get("active") or clock.now_ns() > deadline_ns:
            return int(state["touched"])
        clock.sleep_until(clock.now_ns() + SECOND_NS // 20)


def _fill(collection: CollectionRun) -> None:
    """Wait until the disk is full, or the collection has ended by it."""
    collection.until_pressing()
    disk = collection.session.parent
    with contextlib.suppress(Hangs):
        collection.until(lambda: shutil.disk_usage(disk).free < _FULL, "a full disk", _FILLING)
        collection.injected_ns = SystemClock().now_ns()


def judge(row: Row, collection: CollectionRun, code: int, touched: int = 0) -> RowResult:
    """Judge a trial that has ended.

    Args:
        row: The fault that was injected.
        collection: Ended.
        code: Its exit code.
        touched: Number of messages the fault touched, if the row requires all to be counted.
    """
    observed, session = collection.observed(), collection.session
    wrong = []
    if code not in row.codes:
        wrong.append(f"exit code {code}; right: {' or '.join(map(str, row.codes))}")
    arm, standing = arm_in_words(observed, collection.ended_ns, row.controller_gone)
    if not standing:
        wrong.append(f"the arm: {arm}")
    elif "clear" not in arm and "NOT RETRACTED" not in collection.text:
        wrong.append(UNREPORTED)
    reaction = reaction_of(row, collection.last_line.replace(str(session), session.name))
    try:
        # Check before recovery: the samples must be readable even if nobody runs it.
        looked_for, lost = losses(session, observed)
        if row.needs_recover:
            recover(session)
            lost += losses(session, observed)[1]
        stored = stored_in(session)
    except (SessionError, OSError):
        wrong.append("no session can be read")
        return RowResult(row.device, row.fault, code, reaction, arm=arm, wrong=tuple(wrong))
    if lost:
        wrong.append(f"{lost} accepted samples are missing")
    wrong += complaints(session, {} if row.disorder else stored.disorder)
    if row.counts is not None:
        stream, reason = row.counts
        counted = stored.rejected.get(stream, {}).get(reason, 0)
        # Several clients share the arm's line, so its fraction of the touched messages is unknown.
        if counted == 0 or (row.device != "arm" and counted != touched):
            wrong.append(f"{stream}: {counted} counted as {reason}, {touched} injected")
    return RowResult(
        row.device,
        row.fault,
        code,
        reaction,
        collection.noticed(),
        looked_for,
        lost,
        arm,
        tuple(wrong),
        stored,
    )


def reaction_of(row: Row, line: str) -> str:
    """Return the reason from the last printed line, without advice, addresses and times."""
    if line.startswith("complete"):
        return row.did or ("continued, counted it" if row.counts else "continued")
    if stopped := re.match(r"stopped \((.*)\): \d+ of \d+ targets", line):
        first = stopped[1].split("; ")[0]
        text = first if len(first) <= _LONGEST else f"{first[:_LONGEST]}..."
        line = text + ("; reported: not retracted" if "NOT RETRACTED" in stopped[1] else "")
    line = re.sub(r"127(\.\d+){3}", "bench", line)
    line = re.sub(r"'?/\S*/s\.zarr/?([^\s']*)'?", r"\1", line)
    line = re.sub(r"/\S*/tactile-rig-\w+/", "", line)
    return re.sub(r"t_ns = \d+", "t_ns = ...", line)


def section(values: dict[str, Any], page: Page) -> str:
    """Return the tables by device, the limits, and the chart of the times until notice."""
    rows = values["rows"]
    parts = [_INTRODUCTION]
    if noticed := [row for row in rows if row["noticed"] is not None]:
        with chart(page.picture("noticed"), 8, 0.8 + 0.17 * len(noticed)) as figure:
            axes = figure.subplots()
            names = [f"{row['device']}: {row['fault']}" for row in noticed]
            axes.plot([max(row["noticed"], 1e-3) for row in noticed], names, "o", color=BLUE)
            axes.set(xscale="log", xlabel="time from the fault to the end of the motion [s]")
            axes.set(ylim=(len(noticed) - 0.5, -0.5))
        parts.append(page.link("noticed", "Time until each fault ended the motion"))
    head = ("fault", "reaction of the rig", "noticed", "exit", "lost", "rejected", "arm")
    parts.append(table(head, [_cells(row) for row in rows]))
    parts += [f"Not run: {name}: {why}." for name, why in values["skipped"].items()]
    return "\n\n".join([*parts, _limits()])


def _cells(row: dict[str, Any]) -> Sequence[object]:
    rejected = row["stored"]["rejected"] if row["stored"] else {}
    counts = [
        f"{count} {stream} {reason}"
        for stream, reasons in rejected.items()
        for reason, count in reasons.items()
        if count
    ]
    return (
        f"{row['device']}: {row['fault']}",
        row["reaction"].replace("|", "\\|"),
        "-" if row["noticed"] is None else f"{row['noticed']:.2f} s",
        "none" if row["exit"] is None else row["exit"],
        f"{row['lost']} of {row['looked_for']}",
        ", ".join(counts) or 0,
        row["arm"],
    )


_INTRODUCTION = """## Faults of devices

Each row is a short collection on a mock bench, run as a technician runs it (`tactile collect`). A
fault is injected into the connection of one device, or a process is killed, while the arm presses.
The drivers are the real ones; the emulators inject the faults (`rig/core/fault_injection.py`).

The result does not depend on statements of the rig. A sample counts as accepted once the stream
published it in shared memory, which happens after appending it. An observer notes those samples
about 50 times a second and looks for each in the stored session. The emulator of the arm reports
its position and speed through a separate port.

*Noticed* is the time from the fault to the end of the phase it ended. *Exit* is 0 done, 3 device
lost, 4 safety stop, 130 interrupted. *Lost* is the number of accepted samples missing from the
session, of those looked for; *rejected* counts samples that arrived and were not stored. Rows by
stream, gaps by the devices' own numbers and the findings of `tactile session check` are in the JSON
file. MJPEG over HTTP does not number frames, so frames that a camera reorders are stored in order
of arrival."""


def _limits() -> str:
    defaults = (*fields(BenchLimits), *fields(ArmConfig))
    lab: dict[str, Any] = {item.name: item.default for item in defaults}
    mock = BenchFile.read(BENCHES / "tacpalm.yaml").bench
    watchdogs = [_ms(1 / hertz) for hertz in (mock.arm.watchdog_hz, lab["watchdog_hz"])]
    return f"""The emulators of a mock bench share the cores with the rig, so its limits are looser
than a lab's: the arm stops after {_ms(mock.limits.stale_force)} without a force sample (lab:
{_ms(lab["stale_force"])}), {_ms(mock.limits.stale_pose)} without a pose ({_ms(lab["stale_pose"])}),
{watchdogs[0]} without a message to the watchdog ({watchdogs[1]}).
On both it stops after {_ms(streams.SILENT)} without a frame or scan, and after {_ms(streams.SLOW)}
below {streams.SLOW_FRACTION:.0%} of a stream's rate."""


def _ms(seconds: Any) -> str:
    return f"{1e3 * seconds:.0f} ms"
