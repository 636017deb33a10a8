"""Run one row of the table: a short collection, the fault, the judgement."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from benchmarks.faults.collection_run import CollectionRun, Hangs
from benchmarks.faults.judge import FaultResult, arm_in_words, complaints, left_in, losses, readable
from benchmarks.faults.quick import quick_bench
from benchmarks.faults.rows import Row
from recorder import recover
from rig.core import emulation
from rig.core.clock import SECOND_NS, SystemClock
from rig.core.mock_names import PORTS
from rig.devices.hid.shim import build

# Maximum time to wait for a temporary fault to end, so that all its effects are counted [s].
_CLEARING = 5.0


def run_row(row: Row, folder: Path, benches: Path) -> FaultResult:
    """Run one collection with one fault.

    Args:
        row: The fault.
        folder: Empty folder for the session.
        benches: Folder of the bench files.

    Raises:
        ConfigError: The row needs a compiler, and none is installed.
    """
    bench = quick_bench(folder, row.sensor, benches, limits=row.limits, more=row.more)
    session = folder / "s.zarr"
    arguments = ("--bench", str(bench), "--targets", str(row.targets))
    preload = build(folder) if row.pedal else None
    with CollectionRun(session, *arguments, preload=preload) as collection:
        try:
            touched = _with_fault(row, collection)
            code = collection.wait()
        except (Hangs, LookupError, OSError) as error:
            return _unfinished(collection, str(error))
        return judge(row, collection, code, touched)


def _with_fault(row: Row, collection: CollectionRun) -> int:
    """Inject the fault and return the number of messages it touched, or 0 if not counted."""
    if row.act is None:
        collection.until_recording()
        return 0
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


def judge(row: Row, collection: CollectionRun, code: int, touched: int = 0) -> FaultResult:
    """Judge a trial that has ended.

    Args:
        row: The fault that was injected.
        collection: Ended.
        code: Its exit code.
        touched: Number of messages the fault touched, if the row requires all to be counted.
    """
    seen = collection.seen()
    wrong = []
    if code not in row.codes:
        wrong.append(f"exit code {code}; right: {' or '.join(map(str, row.codes))}")
    arm, standing = arm_in_words(seen, collection.ended_ns, row.controller_gone)
    if not standing:
        wrong.append(f"the arm: {arm}")
    elif "clear" not in arm and "NOT RETRACTED" not in collection.text:
        wrong.append("the arm is not clear, and this is not reported")
    if not readable(collection.session):
        wrong.append("no session can be read")
        return FaultResult(code, collection.last_line, None, None, 0, 0, arm, tuple(wrong))
    # Check before recovery: the samples must be readable even if nobody runs it.
    shown, lost = losses(collection.session, seen)
    if row.needs_recover:
        recover(collection.session)
        lost += losses(collection.session, seen)[1]
    left = left_in(collection.session)
    if lost:
        wrong.append(f"{lost} accepted samples are missing")
    judged = replace(left, disorder={}) if row.disorder else left
    wrong += complaints(collection.session, judged)
    if row.counts is not None:
        stream, reason = row.counts
        counted = left.rejected.get(stream, {}).get(reason, 0)
        # Several clients share the arm's line, so its fraction of the touched messages is unknown.
        if counted == 0 or (row.device != "arm" and counted != touched):
            wrong.append(f"{stream}: {counted} counted as {reason}, {touched} injected")
    word = collection.last_line.replace(str(collection.session), collection.session.name)
    return FaultResult(code, word, collection.noticed(), left, shown, lost, arm, tuple(wrong))


def _unfinished(collection: CollectionRun, why: str) -> FaultResult:
    last = why.strip().splitlines()
    words = (f"did not end: {last[0] if last else why}", *last[-3:])
    return FaultResult(None, collection.last_line, None, None, 0, 0, "not known", words)
