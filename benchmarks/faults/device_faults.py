"""Part `faults`: one short collection a row, with its fault, and what it left behind."""

import contextlib
import shutil
import tempfile
from collections.abc import Sequence
from dataclasses import asdict, fields
from functools import partial
from pathlib import Path
from typing import Any

from benchmarks.faults.collection_run import CollectionRun, Hangs, quick_bench
from benchmarks.faults.judge import RowResult, judge
from benchmarks.faults.program_kills import CannotMount, tmpfs
from benchmarks.faults.rows import PEDAL, QUICK, ROWS, Row
from benchmarks.report import Page, Run, table
from recorder.charts import BLUE, chart
from rig.acquire import streams
from rig.bench.bench import BenchFile, BenchLimits
from rig.core.clock import SystemClock
from rig.core.errors import ConfigError
from rig.core.packaged import BENCHES
from rig.devices.arm.reader import SILENCE
from rig.devices.arm.settings import ArmConfig
from rig.devices.hid.shim import build

# With less free space than this, the next record does not fit [bytes].
_FULL = 1 << 16


def measure(run: Run) -> dict[str, Any]:
    """Run the rows one after the other; return their results, and the reasons of those left out."""
    rows = [row for row in ROWS if not run.quick or row.name in QUICK]
    results: list[dict[str, Any]] = []
    skipped: dict[str, str] = {}
    for number, row in enumerate(rows):
        try:
            result = run.once(row.name, partial(run_row, row, run.folder))
        except (ConfigError, CannotMount) as error:
            skipped[row.name] = str(error)
        else:
            results.append(result)
            run.failures += [f"{row.name}: {what}" for what in result["wrong"]]
        run.progress((number + 1) / len(rows))
    return {"rows": results, "skipped": skipped}


def run_row(row: Row, folder: Path) -> dict[str, Any]:
    """Run one collection with one fault, in a folder of its own, and return its `RowResult`.

    ConfigError is raised if the row needs a compiler and none is installed, CannotMount if it needs
    a disk, which only root can mount.
    """
    with contextlib.ExitStack() as stack:
        scratch = tempfile.TemporaryDirectory(prefix="tactile-rig-", dir=folder)
        folder = Path(stack.enter_context(scratch))
        bench, disk = quick_bench(folder, row.sensor, row.limits, row.more), folder / "disk"
        arguments = ("--bench", str(bench), "--targets", str(row.targets))
        preload = build(folder) if row.more == PEDAL else None
        if row.disk_mb:
            stack.enter_context(tmpfs(disk, row.disk_mb))
        session = (disk if row.disk_mb else folder) / "s.zarr"
        run = CollectionRun.collect(session, *arguments, preload=preload)
        stack.enter_context(run)
        try:
            touched = _with_fault(row, run)
            code = run.wait()
        except (Hangs, LookupError, OSError) as error:
            last = str(error).strip().splitlines() or [""]
            wrong = (f"did not end: {last[0]}", *last[-3:])
            return asdict(RowResult(row.device, row.fault, None, run.last_line, wrong=wrong))
        if row.disk_mb:
            # A technician would make space, then recover.
            run.session = folder / "s.zarr"
            shutil.copytree(session, run.session)
        return asdict(judge(row, run, code, touched))


def _with_fault(row: Row, collection: CollectionRun) -> int:
    """Inject the fault and return the number of messages it touched, or 0 if not counted."""
    collection.until_recording()
    if row.before is not None:
        row.before(collection)
    if row.act is not None:
        collection.until_pressing()
        row.act(collection)
    if row.disk_mb:
        disk = collection.session.parent
        # The collection may end by it first.
        with contextlib.suppress(Hangs):
            collection.until(lambda: shutil.disk_usage(disk).free < _FULL, "a full disk")
            collection.injected_ns = SystemClock().now_ns()
    if row.counts is None:
        return 0
    collection.until(lambda: not collection.tell(row.device, "state").get("active"), "its end")
    return int(collection.tell(row.device, "state")["touched"])


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
session, of those looked for; *rejected* counts samples that arrived and were not stored. MJPEG over
HTTP does not number frames, so those that a camera reorders are stored in order of arrival. *Arm*
is what its emulator reports at the end: `clear` is out of contact, `at -1.1 mm` is below the
surface, where an arm stays that cannot retract, and the rig says so. A hard limit is a share of the
axis's rating in the bench file; `overload` sets a rating of 0.3 N, which a press exceeds."""


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
below {streams.SLOW_FRACTION:.0%} of a stream's rate. A silent arm is sent nothing, so that its own
watchdog stops it; its driver gives it up after {_ms(SILENCE)} without a package."""


def _ms(seconds: Any) -> str:
    return f"{1e3 * seconds:.0f} ms"
