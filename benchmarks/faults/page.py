"""docs/results/reliability.md, from the results."""

from __future__ import annotations

import os
import platform
import re
from collections.abc import Iterable
from dataclasses import fields
from pathlib import Path

from benchmarks.faults.judge import Judgement, Left
from benchmarks.faults.kills import VICTIMS, Kills
from benchmarks.faults.rows import Row
from benchmarks.faults.run import Results
from rig.acquire.progress_line import minutes
from rig.acquire.streams import SILENT, SLOW, SLOW_FRACTION
from rig.bench.bench import BenchLimits, load_bench
from rig.devices.arm.settings import ArmConfig

_LONGEST = 150
# Characters of a reason; what follows is advice to the technician.

_HEAD = (
    "fault",
    "what the rig did",
    "noticed",
    "exit",
    "readable",
    "lost",
    "missing",
    "left out",
    "arm",
    "check",
)

_INTRO = """# Reliability

What the rig does when something breaks, found by breaking it. Every row below is a short
collection on a mock bench, run as a technician runs it (`python -m rig collect`), with a fault
put into the wire of one device, or a process killed, while the arm presses. The real drivers
run; the faults are the emulators' (`rig/core/fault_injection.py`).

Repeat it with `make faults` (`--quick`: 10 kills in place of 100; `--only ROW`, `--list`). The
command fails when any row loses an accepted sample, hangs, leaves the arm moving, stores a
sample twice or out of order, leaves a session that `recorder check` finds broken, or ends with
another exit code than the one that is right.

The judgement does not ask the rig. A sample counts as accepted once the stream showed it in
shared memory, which it does after appending it; an observer notes those about 50 times a second
and looks for each in the session that is left. Missing samples are counted by the devices' own
numbers (the controller's clock for poses, the emulator's stamp in each JPEG). Where the arm is,
and whether it stands, its emulator says through a port of its own.
"""

_READING = """
Reading the tables: *noticed* is the time from the fault to the end of the phase it ended.
*Exit* is 0 done, 3 device lost, 4 safety stop, 130 interrupted. *Readable* counts rows in the
session; *lost* is accepted samples that are not there, of those looked for. *Missing* is what
the device sent, by its own numbers, that never reached the rig: the gaps are in the session,
and counted there. *Left out* is what came and was refused. *Check* is what `recorder check`
says of the session as the fault left it. Times are those of the mock bench (its limits are
looser than a lab's, see below).
"""


def page(results: Results, benches: Path) -> str:
    """The page, in Markdown.

    Args:
        results: Of all rows.
        benches: Folder of the bench files, for the mock bench's limits.
    """
    wrong = results.wrong
    verdict = (
        "Every row was as it should be."
        if not wrong
        else "**Not as it should be:**\n\n" + "\n".join(f"- {_plain(what)}" for what in wrong)
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
        f"{platform.system()} {platform.machine()}, in {minutes(results.seconds)} (min:s)."
    )


def _table(rows: Iterable[tuple[Row, Judgement]]) -> str:
    lines = [f"| {' | '.join(_HEAD)} |", f"|{'---|' * len(_HEAD)}"]
    notes = []
    for row, judged in rows:
        lines.append(f"| {' | '.join(_cells(row, judged))} |")
        if row.disorder:
            notes.append(f"\n{row.fault}: {row.disorder} send them so. {_disordered(judged)}\n")
    return "\n".join(lines) + "\n" + "".join(notes)


def _cells(row: Row, judged: Judgement) -> tuple[str, ...]:
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
    """The reason in the last line that was printed, without the advice after it."""
    if line.startswith("complete"):
        return row.did or ("went on, counted it" if row.counts else "went on")
    found = re.match(r"stopped \((.*)\): \d+ of \d+ targets", line)
    if found is None:
        return line
    first = found[1].split("; ")[0]
    text = first if len(first) <= _LONGEST else f"{first[:_LONGEST]}..."
    return text + ("; said so: not retracted" if "NOT RETRACTED" in found[1] else "")


def _plain(text: str) -> str:
    """`text` for a table: no address and no time of this one run."""
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
        f"{count} {name} {reason}"
        for name, refused in left.refused.items()
        for reason, count in refused.items()
        if count
    ]
    return ", ".join(found) or "0"


def _disordered(judged: Judgement) -> str:
    count = sum(judged.left.disorder.values()) if judged.left is not None else 0
    return f"Stored as they came: {count} frames, told by the emulator's stamp in the JPEG alone."


def _kills(kills: Kills) -> str:
    found = ": as it should be" if not kills.wrong else f"; {len(kills.wrong)} times it was not so"
    victims = "\n".join(f"| {victim} | {kills.victims[victim]} |" for victim in VICTIMS)
    return f"""
## {kills.victims.total()} kills

SIGKILL to a random process at a random moment within the first 3 s of recording, over and over
in the same sessions: killed, recovered (`recorder recover`), resumed, killed again, and in the
end brought to `complete`.

| killed | times |
|---|---|
{victims}

{kills.compared} accepted samples were looked for after the recoveries: **{kills.lost} lost**.
Killed sessions were gone on with {kills.resumed} times; {kills.completed} sessions came to
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
        ("no word to the controller's watchdog for", watchdog, 1 / mock.arm.watchdog_hz),
        ("no camera frame or scan for", SILENT, SILENT),
        (f"below {SLOW_FRACTION:.0%} of the expected rate for", SLOW, SLOW),
    ]
    lines = "\n".join(
        f"| {what} | {1e3 * in_lab:.0f} ms | {1e3 * on_mock:.0f} ms |"
        for what, in_lab, on_mock in rows
    )
    return f"""
## Limits in the lab and here

| stops the arm | lab | mock bench |
|---|---|---|
{lines}

All emulators of a mock bench share the machine's cores with the rig, and a busy or virtual machine
may hold any of them up for 100 ms; so its limits are looser. The lab's are tested to the nanosecond
on a clock that is no machine's (`tests/rig/test_guard.py`, `tests/benchmarks/test_reliability.py`).
"""
