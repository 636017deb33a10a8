"""States of bench and computer that a session shows: they explain its data, or corrupt it."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import product
from typing import Any

import numpy as np
from numpy.typing import NDArray

from recorder.command_line.options import next_command
from recorder.findings import Finding
from recorder.session.columns import Stream, blocks
from recorder.session.reader import Session
from recorder.spec import AXES

Times = NDArray[np.int64]

# Median speed scaling of the controller below which the arm was slow.
FULL_SPEED = 0.99
# A force is clipped if its largest value is there for this long [s], this often, and this many
# times as often as the next one: noise makes the largest the rarest.
CLIPPED, CLIPPED_SAMPLES, CLIPPED_TIMES = 0.02, 10, 10.0
# Column of a gauge that settles: its reading, also where that is no value.
READING = "reading"


def stalls(session: Session, run: int) -> Times:
    """Return beginning and end (n, 2) [ns] of the times for which the computer stood still."""
    entries = session.runs
    found = entries[run].get("stalls_ns", []) if run < len(entries) else []
    return np.array(found, np.int64).reshape(-1, 2)


def in_stalls(stood: Times, start_ns: Times, end_ns: Times) -> NDArray[np.bool_]:
    """Return True where at least half of an interval [start, end] (n,) lies in stalls (m, 2)."""
    covered = np.zeros(len(start_ns))
    for start, end in stood.tolist():
        covered += np.clip(np.minimum(end_ns, end) - np.maximum(start_ns, start), 0, None)
    return np.asarray((covered > 0) & (2 * covered >= end_ns - start_ns))


def states(session: Session) -> Iterator[Finding]:
    """Yield the troubles of the bench and its computer, the computer first."""
    for run, entry in enumerate(session.runs):
        of = _of(session, run)
        lasting = np.diff(stalls(session, run), axis=1) * 1e-9
        if len(lasting):
            yield Finding(
                "stalled",
                ".",
                f"{of}this computer stood still {len(lasting)} times, longest "
                f"{lasting.max():.2f} s; gaps and frozen values at those times are its own",
            )
        for text in entry.get("states") or ():
            yield Finding("bench", ".", f"{of}{text}")
    if session.status == "stopped" and session.attrs.get("reason"):
        yield Finding("stopped", ".", str(session.attrs["reason"]))
    for stream in session.streams.values():
        if stream.traits.kind == "pose" and "speed_scaling" in stream.names:
            yield from _slow(session, stream)
        if stream.traits.kind == "force" and READING not in stream.names:
            yield from _clipped(stream)
    steps, gauge = session.setting("calibration", "acceptance", "steps"), session.first("force")
    if gauge is not None and steps.get("gauge") != "well":
        text = f"scale of the gauge not verified by a known weight ({next_command('setup')})"
        yield Finding("unverified", f"streams/{gauge}", text)


def state_lines(session: Session) -> list[str]:
    """Return a line for each of `states`, for a summary, which tells why it stopped itself."""
    return [f"{each.code:12} {each.message}" for each in states(session) if each.code != "stopped"]


def _of(session: Session, run: int) -> str:
    """Return which run a message is about, if there are several."""
    return f"run {run}: " if len(session.runs) > 1 else ""


def _slow(session: Session, stream: Stream) -> Iterator[Finding]:
    segments = session.segments
    for run in range(max(len(session.runs), 1)):
        rows = session.rows_of_run(stream.name, run)
        t_ns, of_run = stream.t_ns[rows], segments["run"] == run
        starts, ends = (np.sort(segments[name][of_run]) for name in ("start_ns", "end_ns"))
        begun = np.searchsorted(starts, t_ns, side="right")
        moving = begun > np.searchsorted(ends, t_ns, side="left")
        if not moving.any():
            continue
        scaling = float(np.median(stream.array("speed_scaling")[rows][moving]))
        if 0 < scaling < FULL_SPEED:
            message = f"{_of(session, run)}the speed slider was at {scaling:.0%}: phases take"
            yield Finding(
                "slow", f"streams/{stream.name}", f"{message} {1 / scaling:.2g} times as long"
            )


def _clipped(stream: Stream) -> Iterator[Finding]:
    measured: Any = stream.attrs.get("axes_measured") or AXES
    axes = [axis for axis, name in enumerate(AXES) if name in measured]
    # Largest and least value of each axis, and how often it is there.
    limits = {key: (-np.inf, 0) for key in product(axes, (1, -1))}
    for part in blocks(len(stream)):
        values = np.asarray(stream.rows("value", part)[:], np.float64)
        for (axis, sign), (most, often) in limits.items():
            series = sign * values[:, axis]
            often *= not (top := series.max()) > most
            most = max(most, top)
            limits[axis, sign] = most, often + int((series == most).sum())
    for (axis, sign), (_, often) in limits.items():
        if not max(CLIPPED_SAMPLES, CLIPPED * stream.rate_hz) <= often < len(stream):
            continue
        values = np.asarray(stream.array("value"), np.float64)
        series = sign * values[:, axis]
        if not np.isfinite(series).all():
            continue
        at_limit = series == series.max()
        count = int(at_limit.sum())
        following = series[~at_limit].max()
        # All axes at rest are a hold without noise, or frozen.
        varied = len(axes) == 1 or np.ptp(values[at_limit][:, axes], axis=0).any()
        if varied and count >= CLIPPED_TIMES * int((series == following).sum()):
            limit, row = sign * series[at_limit][0], int(at_limit.argmax())
            units = "N" if axis < 3 else "N m"
            yield Finding(
                "clipped",
                f"streams/{stream.name}/value",
                f"{AXES[axis]} never passes {limit:+.4g} {units} and is exactly that in "
                f"{count} samples, first row {row}: a limit of its device clips it",
            )
