r"""Describe sessions, and compute stream digests that are equal exactly if the data bytes are.

The digest of a stream is the SHA-256 of its columns in the order of attrs `columns`, without the
time column. Each column contributes the line `<name> <dtype> <shape of a row>\n`, then its rows in
order. A row of numbers contributes its little-endian bytes; an image stored as JPEG the number of
its bytes (int64, little-endian) and the bytes; an image stored as pixels its pixels.

The `device_t` and `seq` of a camera are excluded: the host's driver gives them, or nobody does.
"""

import hashlib
import os
from collections.abc import Mapping

import numpy as np

from recorder.archive.reader import describe_archive
from recorder.progress import ReportItems
from recorder.session.columns import Stream
from recorder.session.loss import Account, loss_lines
from recorder.session.reader import Session, accounts_of
from recorder.session.states import state_lines
from recorder.session.uncertainty import time_lines
from recorder.spec import ARCHIVE_FORMAT, OUTCOMES, PHASES
from recorder.store.documents import says_it_is
from recorder.store.files import locate

_LEFT_OUT = {"camera": {"device_t", "seq"}}


def stream_digest(stream: Stream, progress: ReportItems | None = None) -> str:
    """Return the digest of a stream, all of which is read, as 64 hexadecimal digits."""
    digest = hashlib.sha256()
    for layout in stream.layout.columns:
        column = layout.column
        if layout is stream.layout.time or column.name in _LEFT_OUT.get(stream.traits.kind, ()):
            continue
        digest.update(f"{column.name} {column.dtype} {list(column.shape)}\n".encode())
        if not column.is_image:
            digest.update(stream.array(column.name).tobytes())
            continue
        for row in range(len(stream)):
            jpeg = stream.jpeg(row)
            if jpeg is None:
                digest.update(stream.images([row]).tobytes())
            else:
                digest.update(len(jpeg).to_bytes(8, "little"))
                digest.update(jpeg)
            if progress is not None:
                progress(row + 1, len(stream))
    return digest.hexdigest()


def session_digest(digests: Mapping[str, str]) -> str:
    r"""Return one digest of several streams: SHA-256 of the lines `<name> <digest>\n`."""
    lines = "".join(f"{name} {digests[name]}\n" for name in sorted(digests))
    return hashlib.sha256(lines.encode()).hexdigest()


def digests(session: Session) -> dict[str, str]:
    """Return the digest of every stream of a session, by name."""
    return {name: stream_digest(stream) for name, stream in session.streams.items()}


_PROGRAMS = ("tactile-rig", "python", "zarr")
_ATTRIBUTES = ("sensor", "indenter", "operator", "mock", "started_utc", "profile", "reason")


def describe(path: str | os.PathLike[str]) -> str:
    """Return a summary of a session, or of an archive with a line per sensor."""
    files, root = locate(path)
    if says_it_is(root, files, ARCHIVE_FORMAT):
        return describe_archive(path)
    session = Session(path)
    lines = [f"{session.name}  status {session.status}, {len(session.runs)} run(s)"]
    if session.warning:
        lines.append(f"warning: {session.warning}")
    properties = {key: session.attrs.get(key, "") for key in _ATTRIBUTES}
    properties["format"] = f"{session.attrs['format']} {session.attrs['format_version']}"
    software = session.attrs.get("software", {})
    properties["software"] = ", ".join(
        f"{name} {software[name]}" for name in _PROGRAMS if name in software
    )
    lines += [f"  {key:12s} {value}" for key, value in properties.items() if value != ""]
    lines.append("")
    titles = ("rows", "Hz", "measured", "gap ms", "lost", "MB")
    width = max(12, *(len(name) for name in session.streams)) if session.streams else 12
    lines.append(f"{'stream':{width}s} " + " ".join(f"{title:>9s}" for title in titles))
    accounts = accounts_of(session)
    lines += [
        _stream_line(session, stream, accounts[stream.name], width)
        for stream in session.streams.values()
    ]
    lines += [*state_lines(session), *loss_lines(accounts), *time_lines(session)]
    lines.append("")
    lines += _frame_lines(session)
    lines += _segment_lines(session)
    return "\n".join(lines)


def _stream_line(session: Session, stream: Stream, account: Account, width: int) -> str:
    measured = f"{account.measured_hz:9.2f}" if account.measured_hz else f"{'-':>9s}"
    size = sum(session.files.sizes(stream.layout.path).values()) / 1e6
    return (
        f"{stream.name:{width}s} {len(stream):9d} {stream.rate_hz:9g} {measured} "
        f"{account.longest_gap * 1e3:9.1f} {account.lost:9d} {size:9.2f}"
    )


def _frame_lines(session: Session) -> list[str]:
    if "target" not in session.frames:
        return ["frames       none yet"]
    # A target that was pressed again in another run has two presses.
    pressed = np.stack([session.frames["target"], session.frames["run"]], axis=1)
    presses, count = np.unique(pressed[pressed[:, 0] >= 0], axis=0, return_counts=True)
    targets = len(np.unique(presses[:, 0]))
    valid = int(session.frames["valid"].sum())
    line = f"frames       {len(session.frames['t_ns'])} at {session.rate_hz:g} Hz, {valid} valid"
    if count.size:
        of = f"{targets} targets"
        if count.size > targets:
            of = f"{count.size} presses of {of}"
        line += f", {count.min()} to {count.max()} (median {np.median(count):g}) on each of {of}"
    return [line]


def _segment_lines(session: Session) -> list[str]:
    outcome, phase = session.segments["outcome"], session.segments["phase"]
    parts = [f"{name} {int((outcome == code).sum())}" for code, name in enumerate(OUTCOMES)]
    lines = [f"segments     {len(outcome)}: {', '.join(parts)}"]
    counts = [f"{name} {int((phase == code).sum())}" for code, name in enumerate(PHASES)]
    return [*lines, f"phases       {', '.join(counts)}"]
