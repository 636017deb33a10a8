"""A session, or an archive, in a page of text."""

import os

import numpy as np

from recorder.align import NS
from recorder.archive.info import describe_archive
from recorder.archive.plan import FORMAT as ARCHIVE
from recorder.attrs import says_it_is
from recorder.files import locate
from recorder.reader import Session, Stream
from recorder.spec import OUTCOMES, PHASES

_TOLD = ("sensor", "indenter", "operator", "mock", "started_utc", "profile", "reason")


def describe(path: str | os.PathLike[str]) -> str:
    """Return what a session holds: origin, streams with their rates, frames and phases.

    Of a marker archive: a line a sensor.

    Raises:
        SessionError: Neither a session nor an archive, or a damaged column.
    """
    files, place = locate(path)
    if says_it_is(place, files, ARCHIVE):
        return describe_archive(path)
    session = Session(path)
    lines = [f"{session.name}  status {session.status}, {len(session.runs)} run(s)"]
    if session.warning:
        lines.append(f"warning: {session.warning}")
    told = {key: session.attrs.get(key, "") for key in _TOLD}
    lines += [f"  {key:12s} {value}" for key, value in told.items() if value != ""]
    lines.append("")
    titles = ("rows", "Hz", "measured", "gap ms", "MB")
    lines.append("stream       " + " ".join(f"{title:>9s}" for title in titles))
    lines += [_stream_line(session, stream) for stream in session.streams.values()]
    lines.append("")
    lines += _frame_lines(session)
    lines += _segment_lines(session)
    return "\n".join(lines)


def _stream_line(session: Session, stream: Stream) -> str:
    rates, gap = [], 0.0
    for run in range(max(len(session.runs), 1)):
        t_ns = stream.t_ns[session.rows_of_run(stream.name, run)]
        if len(t_ns) > 1:
            rates.append((len(t_ns) - 1) / max((int(t_ns[-1]) - int(t_ns[0])) * NS, NS))
            gap = max(gap, float(np.diff(t_ns).max()) * NS)
    measured = f"{np.mean(rates):9.2f}" if rates else f"{'-':>9s}"
    size = sum(session.files.sizes(stream.layout.path).values()) / 1e6
    return (
        f"{stream.name:12s} {len(stream):9d} {stream.rate_hz:9g} {measured} "
        f"{gap * 1e3:9.1f} {size:9.2f}"
    )


def _frame_lines(session: Session) -> list[str]:
    if "target" not in session.frames:
        return ["frames       none yet"]
    target = session.frames["target"]
    count = np.bincount(target[target >= 0]) if (target >= 0).any() else np.zeros(0)
    count = count[count > 0]
    valid = int(session.frames["valid"].sum())
    line = f"frames       {len(session.frames['t_ns'])} at {session.rate_hz:g} Hz, {valid} valid"
    if count.size:
        line += (
            f", {count.min()} to {count.max()} (median {np.median(count):g}) "
            f"on each of {count.size} targets"
        )
    return [line]


def _segment_lines(session: Session) -> list[str]:
    outcome, phase = session.segments["outcome"], session.segments["phase"]
    parts = [f"{name} {int((outcome == code).sum())}" for code, name in enumerate(OUTCOMES)]
    lines = [f"segments     {len(outcome)}: {', '.join(parts)}"]
    counts = [f"{name} {int((phase == code).sum())}" for code, name in enumerate(PHASES)]
    return [*lines, f"phases       {', '.join(counts)}"]
