"""Runs one row of the table: a short collection, the fault, the judgement."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from benchmarks.faults.judge import Judgement, arm_in_words, complaints, left_in, losses, readable
from benchmarks.faults.quick import quick_bench
from benchmarks.faults.rows import Row
from benchmarks.faults.trial import Hangs, Trial
from recorder.session.recover import recover
from rig.core import emulation
from rig.core.clock import SECOND_NS, SystemClock
from rig.devices.hid.shim import build

_CLEARING = 5.0
# A fault with an end is waited for, so that all it did can be counted [s].


def run_row(row: Row, folder: Path, benches: Path) -> Judgement:
    """One collection with one fault.

    Args:
        row: Which.
        folder: Empty; the session is made here.
        benches: Folder of the bench files.

    Raises:
        ConfigError: The row needs a compiler, and there is none.
    """
    bench = quick_bench(folder, row.sensor, benches, limits=row.limits, more=row.more)
    session = folder / "s.zarr"
    arguments = ("--bench", str(bench), "--targets", str(row.targets))
    preload = build(folder) if row.pedal else None
    with Trial(session, *arguments, preload=preload) as trial:
        try:
            touched = _with_fault(row, trial)
            code = trial.wait()
        except (Hangs, LookupError, OSError) as error:
            return _unfinished(trial, str(error))
        return judge(row, trial, code, touched)


def _with_fault(row: Row, trial: Trial) -> int:
    """Put the fault in; how many messages it touched, where that is known by the end of it."""
    if row.act is None:
        trial.until_recording()
        return 0
    trial.until_pressing(row.before)
    row.act(trial)
    if row.counts is None:
        return 0
    clock, port = SystemClock(), emulation.PORTS[row.device]
    deadline_ns = clock.now_ns() + round(_CLEARING * SECOND_NS)
    while True:
        state = emulation.inject(trial.host, port, "state")
        if not state.get("active") or clock.now_ns() > deadline_ns:
            return int(state["touched"])
        clock.sleep_until(clock.now_ns() + SECOND_NS // 20)


def judge(row: Row, trial: Trial, code: int, touched: int = 0) -> Judgement:
    """What became of a trial that has ended.

    Args:
        row: What was done to it.
        trial: Ended.
        code: Its exit code.
        touched: Messages the fault touched, where the row says that all must be counted.
    """
    seen = trial.seen()
    wrong = []
    if code not in row.codes:
        wrong.append(f"exit code {code}; right: {' or '.join(map(str, row.codes))}")
    arm, standing = arm_in_words(seen.arm, trial.ended_ns, row.controller_gone)
    if not standing:
        wrong.append(f"the arm: {arm}")
    elif "clear" not in arm and "NOT RETRACTED" not in trial.text:
        wrong.append("the arm is not clear, and nobody is told")
    if not readable(trial.session):
        wrong.append("no session can be read")
        return Judgement(code, trial.last_line, None, None, 0, 0, arm, tuple(wrong))
    # First as it was left: nothing may depend on a recovery that nobody may run.
    shown, lost = losses(trial.session, seen)
    if row.needs_recover:
        recover(trial.session)
        lost += losses(trial.session, seen)[1]
    left = left_in(trial.session)
    if lost:
        wrong.append(f"{lost} accepted samples are not there")
    judged = replace(left, disorder={}) if row.disorder else left
    wrong += complaints(trial.session, judged)
    if row.counts is not None:
        stream, reason = row.counts
        counted = left.refused.get(stream, {}).get(reason, 0)
        # Several clients share the arm's line: its share of what was touched is not known.
        if counted == 0 or (row.device != "arm" and counted != touched):
            wrong.append(f"{stream}: {counted} counted as {reason}, {touched} injected")
    word = trial.last_line.replace(str(trial.session), trial.session.name)
    return Judgement(code, word, trial.noticed(), left, shown, lost, arm, tuple(wrong))


def _unfinished(trial: Trial, why: str) -> Judgement:
    last = why.strip().splitlines()
    words = (f"did not come to its end: {last[0] if last else why}", *last[-3:])
    return Judgement(None, trial.last_line, None, None, 0, 0, "not known", words)
