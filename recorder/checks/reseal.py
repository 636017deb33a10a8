"""Make the manifest of a closed session again after it was lost."""

import os
import shutil
import time
from pathlib import Path

from recorder.checks.check import check
from recorder.errors import SessionError
from recorder.findings import CODES, faults
from recorder.store.files import LOCAL
from recorder.store.layout import read_session_attrs
from recorder.store.manifest import (
    GROUP,
    Manifest,
    manifest_path,
    manifest_runs,
    readable_chain,
    remove_unfinished,
    reopen,
    run_of,
    seal,
)

# Faults of what a device sent, which do not mean that a file was lost or changed.
_OF_DEVICES = {"time-order", "clock-step", "gap", "dropped", "seq-order", "rate", "frozen"}
_OF_DEVICES |= {"truncated", "nan", "segment-outside", "bad-image"}
_OF_FILES = CODES.keys() - _OF_DEVICES


def reseal(path: str | os.PathLike[str]) -> list[int]:
    """Make the manifest of a closed session again, if nothing but manifests is lost.

    All that can be checked without it is checked first: the checksum of every chunk, the declared
    lengths, streams and columns, and what the other manifests name. The attribute `sealed_later`
    states from then on that a change before that moment cannot be seen. If killed, the call or
    `recover` can be repeated.

    Returns:
        The runs whose manifest was lost; empty for a session that is sealed as it is, which is not
        changed.

    Raises:
        SessionError: Not a closed session of format 2, or something else is lost or changed.
    """
    session = Path(path)
    attrs = read_session_attrs(session)
    if attrs["status"] == "recording":
        raise SessionError(f"{session}: was not closed (tactile session recover)")
    last = run_of(attrs)
    chain, broken = readable_chain(LOCAL, session, last)
    if broken is None:
        return []
    remove_unfinished(session)
    for finding in faults(check(session)):
        if finding.code in _OF_FILES and finding.where != GROUP:
            raise SessionError(
                f"{session / finding.where}: {finding.message} ({finding.code}); a session can be "
                "sealed again only if nothing but its manifest is lost"
            )
    earlier = [one.run for one in _newest_chain(session, last)]
    known = {*earlier, *(one.run for one in chain)}
    lost = [run for run in range(last + 1) if run not in known]
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
