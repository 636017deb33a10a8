"""Report of the long run, as numbers and as a page."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from benchmarks.endurance.long_run import LongRun
from benchmarks.endurance.processes import Track
from recorder import Session, check, faults
from recorder.pages import render

# Buffers, caches and the first shards fill during this time [s].
_WARM_UP = 120.0


@dataclass(frozen=True, slots=True)
class Growth:
    """Change of one process's memory after the warm-up."""

    role: str
    first: float
    """Median of the first minute [bytes]."""
    last: float
    """Median of the last minute [bytes]."""
    slope: float
    """Slope of a straight-line fit [bytes per hour]."""
    spread: float
    """Standard deviation around that line [bytes]."""
    files: tuple[int, int]
    """Number of open files at the first and the last observation."""
    cpu_share: float
    """CPU time over wall time."""


def growth_of(
    track: Track, seconds: float, warm_up: float = _WARM_UP, until: float = np.inf
) -> Growth | None:
    """Return the growth of one process, or None if it was observed too briefly.

    Args:
        track: The process.
        seconds: Length of the whole run [s].
        warm_up: Start of the range that is evaluated [s].
        until: End of that range, for example when the session begins to close [s].
    """
    times = np.array(track.seconds)
    late = (times >= warm_up) & (times <= until)
    if late.sum() < 3:
        return None
    first, last = np.flatnonzero(late)[[0, -1]].tolist()
    times, memory = times[late], np.array(track.memory)[late]
    line = np.polyfit(times, memory, 1)
    return Growth(
        track.role,
        float(np.median(memory[times <= times[0] + 60])),
        float(np.median(memory[times >= times[-1] - 60])),
        float(line[0]) * 3600,
        float(np.std(memory - np.polyval(line, times))),
        (track.files[first], track.files[last]),
        track.cpu / seconds,
    )


def page(run: LongRun) -> str:
    """Return the page as Markdown."""
    session = Session(run.session)
    # After recording, the session is closed and its frames are built, which needs memory.
    end = min(track.seconds[-1] for track in run.tracks if track.role.endswith("stream"))
    growths = [
        found
        for track in run.tracks
        if (found := growth_of(track, run.seconds, until=end)) is not None
    ]
    return render(
        Path(__file__).with_suffix(".md"),
        run=run,
        session=session,
        findings=faults(check(run.session)),
        growths=sorted(growths, key=lambda growth: growth.role),
        size=sum(path.stat().st_size for path in run.session.rglob("*") if path.is_file()),
        warm_up=_WARM_UP,
    )
