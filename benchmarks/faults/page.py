"""Write docs/results/reliability.md from the results."""

from __future__ import annotations

import os
import platform
import re
from collections.abc import Iterable
from dataclasses import fields
from pathlib import Path

from benchmarks.faults.judge import FaultResult, Left
from benchmarks.faults.kills import VICTIMS, Kills
from benchmarks.faults.rows import Row
from benchmarks.faults.run import Results
from recorder.progress import duration
from rig.acquire.streams import SILENT, SLOW, SLOW_FRACTION
from rig.bench.bench import BenchLimits, load_bench
from rig.devices.arm.settings import ArmConfig

# Maximum length of a reason; the rest is advice to the technician [characters].
_LONGEST = 150

_HEAD = (
    "fault",
    "reaction of the rig",
    "noticed",
    "exit",
    "readable",
    "lost",
    "missing",
    "rejected",
    "arm",
    "check",
)

# Reasons of rejection as shown, where the key of the session differs.
_SHOWN = {"spoilt": "corrupt"}

_INTRO = """# Reliability

Reaction of the rig to faults, tested by injecting them. Every row below is a short collection on
a mock bench, run as a technician runs it (`python -m rig collect`). A fault is injected into the
connection of one device, or a process is killed, while the arm presses. The drivers are the real
ones; the emulators inject the faults (`rig/core/fault_injection.py`).

Repeat it with `make faults` (`--quick`: 10 kills instead of 100; `--only ROW`, `--list`). The
command fails if any row loses an accepted sample, hangs, leaves the arm moving, stores a sample
twice or out of order, leaves a session that `recorder check` finds corrupt, or ends with the wrong
exit code.

The result does not depend on statements of the rig. A sample counts as accepted once the stream
published it in shared memory, which happens after appending it. An observer notes those samples
about 50 times a second and looks for each in the stored session. Missing samples are counted by
the devices' own numbers (the controller's clock for poses, the emulator's stamp in each JPEG).
The emulator of the arm reports its position and speed through a separate port.
"""

_READING = """
Reading the tables: *noticed* is the time from the fault to the end of the phase it ended.
*Exit* is 0 done, 3 device lost, 4 safety stop, 130 interrupted. *Readable* counts rows in the
session. *Lost* is the number of accepted samples missing from it, of those looked for. *Missing*
counts samples that the device sent, by its own numbers, and that never reached the rig: the gaps
are in the session, and counted there. *Rejected* counts samples that arrived and were not stored.
*Check* lists the findings of `recorder check` in the session as the fault left it. Times are
those of the mock bench (its limits are looser than a lab's, see below).
"""


def page(results: Results, benches: Path) -> str:
    """Return the page as Markdown.

    Args:
        results: Results of all rows.
        benches: Folder of the bench files, for the mock bench's limits.
    """
    wrong = results.wrong
    verdict = (
        "Every row passed."
        if not wrong
        else "**Failures:**\n\n" + "\n".join(f"- {_plain(what)}" for what in wrong)
    )
    parts = [_INTRO, f"\n{verdict}\n\n{_measured(results)}\n", _READING]
    devices = dict.fromkeys(row.device for row, _ in results.rows)
    for device in devices:
        rows = [(row, judged) for row, judged in results.rows if row.device == device]
        parts.append(f"\n## {device[0].upper()}{device[1:]}\n\n{_table(rows)}")
    for name, reason in results.skipped:
        parts.append(f"\nNot run: {name}: {reason}.\n")
    if results.kills is not None:
        parts.append(_kills(results.kills))
    parts.append(_limits(benches))
    return "".join(parts)


def _measured(results: Results) -> str:
    return (
        f"Measured with Python {platform.python_version()} on {os.cpu_count()} cores, "
        f"{platform.system()} {platform.machine()}, in {duration(results.seconds)}."
    )


def _table(rows: Iterable[tuple[Row, FaultResult]]) -> str:
    lines = [f"| {' | '.join(_HEAD)} |", f"|{'---|' * len(_HEAD)}"]
    notes = []
    for row, judged in rows:
        lines.append(f"| {' | '.join(_cells(row, judged))} |")
        if row.disorder:
            notes.append(f"\n{row.fault}: {row.disorder} {_disordered(judged)}\n")
    return "\n".join(lines) + "\n" + "".join(notes)


def _cells(row: Row, judged: FaultResult) -> tuple[str, ...]:
    left = judged.left
    return (
        row.fault,
        _plain(_reason(row, judged.what)),
        "-" if judged.noticed is None else f"{judged.noticed:.2f} s",
        "none" if judged.code is None else str(judged.code),
        "-" if left is None else ", ".join(f"{n} {name}" for name, n in left.rows.items()),
        f"{judged.lost} of {judged.shown}",
        _counted(left.missing) if left is not None else "-",
        _left_out(left) if left is not None else "-",
        judged.arm,
        "-" if left is None else ", ".join(left.findings) or "clean",
    )


def _reason(row: Row, line: str) -> str:
    """Return the reason from the last printed line, without the advice that follows."""
    if line.startswith("complete"):
        return row.did or ("continued, counted it" if row.counts else "continued")
    found = re.match(r"stopped \((.*)\): \d+ of \d+ targets", line)
    if found is None:
        return line
    first = found[1].split("; ")[0]
    text = first if len(first) <= _LONGEST else f"{first[:_LONGEST]}..."
    return text + ("; reported: not retracted" if "NOT RETRACTED" in found[1] else "")


def _plain(text: str) -> str:
    """Return `text` for a table cell, without addresses and times of this run."""
    text = re.sub(r"127(\.\d+){3}", "bench", text)
    text = re.sub(r"'?/\S*/s\.zarr/?([^\s']*)'?", r"\1", text)
    text = re.sub(r"/\S*/tactile-rig-\w+/", "", text)
    text = re.sub(r"t_ns = \d+", "t_ns = ...", text)
    return text.replace("|", "\\|").replace("\n", " ")


def _counted(numbers: dict[str, int] | object) -> str:
    found = dict(numbers) if isinstance(numbers, dict) else {}
    return ", ".join(f"{count} {name}" for name, count in found.items() if count) or "0"


def _left_out(left: Left) -> str:
    found = [
        f"{count} {name} {_SHOWN.get(reason, reason)}"
        for name, rejected in left.rejected.items()
        for reason, count in rejected.items()
        if count
    ]
    return ", ".join(found) or "0"


def _disordered(judged: FaultResult) -> str:
    count = sum(judged.left.disorder.values()) if judged.left is not None else 0
    return f"Stored in order of arrival: {count} frames, known only from the emulator's JPEG stamp."


def _kills(kills: Kills) -> str:
    found = ": all passed" if not kills.wrong else f"; {len(kills.wrong)} failures"
    victims = "\n".join(f"| {victim} | {kills.victims[victim]} |" for victim in VICTIMS)
    return f"""
## {kills.victims.total()} kills

SIGKILL to a random process at a random time within the first 3 s of recording, repeatedly in
the same sessions: killed, recovered (`recorder recover`), resumed, killed again, and finally run to
`complete`.

| killed | times |
|---|---|
{victims}

{kills.compared} accepted samples were looked for after the recoveries: **{kills.lost} lost**.
Killed sessions were resumed {kills.resumed} times; {kills.completed} sessions reached
`complete`. The rows of earlier runs are compared after each recovery and each resume, and no
process may outlive its collection{found}.
"""


def _limits(benches: Path) -> str:
    mock = load_bench(benches / "tacpalm.yaml")[0]
    lab = {item.name: item.default for item in (*fields(BenchLimits), *fields(ArmConfig))}
    watchdog = 1 / float(str(lab["watchdog_hz"]))
    rows = [
        ("no force sample for", float(str(lab["stale_force"])), mock.limits.stale_force),
        ("no pose for", float(str(lab["stale_pose"])), mock.limits.stale_pose),
        ("no message to the controller's watchdog for", watchdog, 1 / mock.arm.watchdog_hz),
        ("no camera frame or scan for", SILENT, SILENT),
        (f"below {SLOW_FRACTION:.0%} of the expected rate for", SLOW, SLOW),
    ]
    lines = "\n".join(
        f"| {what} | {1e3 * in_lab:.0f} ms | {1e3 * on_mock:.0f} ms |"
        for what, in_lab, on_mock in rows
    )
    return f"""
## Limits in the lab and on the mock bench

| stops the arm | lab | mock bench |
|---|---|---|
{lines}

All emulators of a mock bench share the machine's cores with the rig, and a busy or virtual machine
may delay any of them by 100 ms, so the mock bench has looser limits. The lab's limits are tested to
the nanosecond on a simulated clock (`tests/rig/test_guard.py`,
`tests/benchmarks/test_reliability.py`).
"""
