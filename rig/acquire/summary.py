"""Summary printed at the end: rates and gaps of the streams, and the recorded targets."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from recorder import Session, SessionError
from recorder.progress import duration
from recorder.session import (
    accounts_of,
    loss_lines,
    press_curves,
    save_curves,
    time_lines,
)
from rig.bench.bench import Bench


def cadence(bench: Bench, session: Session, summaries: Mapping[str, Any]) -> str:
    """Return a table of the streams: expected and measured rate, longest gap, losses, skew."""
    accounts = accounts_of(session)
    width = max(8, *(len(name) + 1 for name in accounts)) if accounts else 8
    lines = [f"{'stream':<{width}}{'expected':>10}{'measured':>10}{'longest gap':>13}{'lost':>9}"]
    for name, account in accounts.items():
        summary = summaries.get(name, {})
        lines.append(
            f"{name:<{width}}{bench.row(name).rate_hz:>7.0f} Hz{account.measured_hz:>7.1f} Hz"
            f"{1e3 * account.longest_gap:>10.1f} ms{account.lost:>9}"
            + omitted(summary.get("refused", {}))
        )
    lines += [*loss_lines(accounts), *time_lines(session)]
    frames = session.frames
    valid = np.asarray(frames["valid"], dtype=bool) if len(frames) else np.zeros(0, dtype=bool)
    if valid.any():
        skew = np.asarray(frames["skew"])[valid]
        invalid = int((~valid).sum())
        lines.append(
            f"{len(valid)} frames at {bench.rate_hz:.0f} Hz, {invalid} invalid, "
            f"worst skew {1e3 * skew.max():.1f} ms (median {1e3 * np.median(skew):.2f} ms)"
        )
        lines.append(frames_per_target(session))
    return "\n".join(lines)


def omitted(rejected: Mapping[str, int]) -> str:
    """Return the counts of samples that were received but not stored, as text; empty if none."""
    counts = [f"{count} {reason}" for reason, count in rejected.items() if count]
    return f"  left out: {', '.join(counts)}" if counts else ""


def frames_per_target(session: Session) -> str:
    """Return the frames per target, next to the paper's 20 to 60, as text."""
    frames = session.frames
    pressed = np.asarray(frames["target"]) >= 0
    # A target that was pressed again in another run counts for itself.
    presses = np.stack([np.asarray(frames[name])[pressed] for name in ("target", "run")], axis=1)
    fresh = ~np.asarray(frames["is_duplicate"], dtype=bool)[pressed]
    counts = np.unique(presses, axis=0, return_counts=True)[1]
    fresh_counts = np.unique(presses[fresh], axis=0, return_counts=True)[1]
    if not len(counts) or not len(fresh_counts):
        return "no frames in any target"
    return (
        f"frames per target: {counts.min()} to {counts.max()}, mean {counts.mean():.0f} "
        f"(without repeats: mean {fresh_counts.mean():.0f}; paper: 20 to 60)"
    )


def last_line(
    status: str, reason: str, path: Path, *, done: int, limited: int, total: int, seconds: float
) -> str:
    """Return one line with the status, the number of targets and the path.

    Args:
        status: Status of the session.
        reason: Why it was stopped, or empty.
        path: The session.
        done: Number of finished targets.
        limited: Targets of this run that ended at the soft force limit.
        total: Number of targets to press.
        seconds: Wall time of this run [s].
    """
    why = f" ({reason})" if reason else ""
    ended = f", {limited} of them at the force limit," if limited else ""
    took = duration(seconds)
    return f"{status}{why}: {done} of {total} targets{ended} in {took}; readable at {path}"


# Display of a force-depth session after it is recorded.


def show_curve(path: Path) -> None:
    """Print the table of a session of presses and write its curve to a PNG."""
    try:
        session = Session(path)
        curves = press_curves(session)
    except SessionError as error:
        print(f"no curve: {error}")
        return
    print("\n".join(curves.lines()))
    picture = path.with_suffix(".curve.png")
    try:
        save_curves(curves, picture, f"{session.attrs['sensor']}, {session.attrs['indenter']}")
    except OSError as error:
        print(f"no curve: {picture}: {error}")
    else:
        print(f"force-depth curve: {picture}")
