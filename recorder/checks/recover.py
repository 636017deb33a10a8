"""Recover a session after its writers were killed, the power failed, or a manifest was lost."""

import os
import shutil
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from recorder.checks.check import check
from recorder.errors import SessionError
from recorder.findings import CODES, faults
from recorder.session.frames import remove_leftovers, write_frames
from recorder.session.reader import Session
from recorder.session.stream_writer import StreamRecovery, recover_streams
from recorder.store.documents import REBUILDING, read_session_attrs
from recorder.store.files import LOCAL, Manifest
from recorder.store.manifest import (
    GROUP,
    manifest_path,
    manifest_runs,
    readable_chain,
    remove_unfinished,
    reopen,
    run_of,
    seal,
    wrong_files,
)

# Faults of what a device sent, which do not mean that a file was lost or changed.
_OF_DEVICES = {"time-order", "clock-step", "gap", "dropped", "seq-order", "rate", "frozen"}
_OF_DEVICES |= {"truncated", "nan", "segment-outside", "bad-image"}
_OF_FILES = CODES.keys() - _OF_DEVICES


@dataclass(frozen=True, slots=True)
class Recovery:
    """Result of recovering a session."""

    streams: tuple[StreamRecovery, ...]
    """Every stream and table."""
    lost_manifests: tuple[int, ...]
    """Runs whose manifest was lost and made again."""
    frames_rebuilt: bool
    """True if the frames view was rebuilt."""
    status: str

    @property
    def touched(self) -> bool:
        """True if the session was changed."""
        changed = any(stream.touched for stream in self.streams)
        return changed or self.frames_rebuilt or bool(self.lost_manifests)


def recover(path: str | os.PathLike[str]) -> Recovery:
    """Close a session that was not closed: seal its streams, build `frames`, set its status.

    A session in status `recording` becomes `recovered`, any other keeps its status. A valid session
    is not changed, so the call is idempotent; if killed half-way, it can be repeated. Of a closed
    session only `frames`, which contain no original data, are built again, and a lost manifest is
    made again if nothing else is lost: attribute `sealed_later` states from then on that a change
    before that moment cannot be seen.

    Raises:
        SessionError: Not a session, one that is being written, or damage that a crash cannot cause.
    """
    session = Path(path)
    attrs = read_session_attrs(session)
    status = str(attrs.get("status"))
    remove_unfinished(session)
    lost = [] if status == "recording" else _sealed_again(session, attrs)
    wrong = list(wrong_files(LOCAL, session, attrs))
    for key, text in wrong:
        if status == "recording" or not key.startswith("frames"):
            raise SessionError(f"{session / key}: {text}")
    leftovers = remove_leftovers(session)
    streams = recover_streams(session)
    touched = leftovers or any(stream.touched for stream in streams)
    rebuild = bool(touched or wrong or status == "recording" or not (session / "frames").exists())
    if rebuild:
        if status == "recording":
            status = attrs.get(REBUILDING, "recovered")
        elif wrong:  # its streams can be read, and it can be sealed, only if it is open
            reopen(session, status)
        write_frames(session, Session(session).rate_hz)
        seal(session, status=status)
    return Recovery(tuple(streams), tuple(lost), rebuild, status)


def _sealed_again(session: Path, attrs: dict[str, Any]) -> list[int]:
    """Make a closed session's lost manifests again, if nothing else is lost; return their runs.

    All that can be checked without it is checked first: the checksum of every chunk, the declared
    lengths, streams and columns, and what the other manifests name.
    """
    last = run_of(attrs)
    chain, broken = readable_chain(LOCAL, session, last)
    if broken is None:
        return []
    for finding in faults(check(session)):
        if finding.code in _OF_FILES and finding.where != GROUP:
            raise SessionError(
                f"{session / finding.where}: {finding.message} ({finding.code}); a session can be "
                "sealed again only if nothing but its manifest is lost"
            )
    earlier = [one.run for one in _newest_chain(session, last)]
    readable_runs = {*earlier, *(one.run for one in chain)}
    lost = [run for run in range(last + 1) if run not in readable_runs]
    for run in manifest_runs(session):
        if run not in (*earlier, last):
            shutil.rmtree(manifest_path(session, run).parent)
    entry = {"utc": time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime()), "lost": lost}
    status = attrs["status"]
    reopen(session, status, sealed_later=[*attrs.get("sealed_later", []), entry])
    seal(session, status=status)
    return lost


def _newest_chain(session: Path, last: int) -> list[Manifest]:
    """Return the newest manifests before the last run that are complete; empty without any."""
    for run in reversed([run for run in manifest_runs(session) if run < last]):
        chain, broken = readable_chain(LOCAL, session, run)
        if broken is None:
            return chain
    return []
