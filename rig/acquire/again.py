"""Targets of finished sessions that are to be recorded again: a campaign file with such entries."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from recorder import Session
from recorder.store import replace_file
from rig.acquire.campaign import CampaignFile, Entry
from rig.bench.indenter import find_indenter
from rig.core.config import build, read_yaml
from rig.core.errors import ConfigError

_HEAD = "# Targets to record again, marked on the page (tactile page).\n"


def marked(file: Path, session: Path) -> tuple[int, ...]:
    """Return the targets of a session that the file lists, numbered from 1."""
    return next((e.again for e in _entries(file) if Path(e.session) == session), ())


def write_marks(file: Path, path: Path, session: Session, targets: Sequence[int]) -> None:
    """List targets of a session in the file, in place of those that it listed before.

    Args:
        file: The campaign file; it is made if it is missing.
        path: Path of the session, relative to the folder where commands run.
        session: The session.
        targets: Numbers from 1; none: the session is no longer listed.
    """
    kept = [entry for entry in _entries(file) if Path(entry.session) != path]
    if targets:
        indenter = find_indenter(str(session.attrs.get("indenter"))).name
        plan = session.attrs["plan"]["kind"]
        entry = Entry(str(session.attrs["sensor"]), indenter, plan)
        again = tuple(sorted(targets))
        kept.append(replace(entry, session=str(path), again=again, runs=len(session.runs)))
    rows = [
        f"  - {{sensor: {entry.sensor}, indenter: {entry.indenter}, plan: {entry.plan}, "
        f"session: {json.dumps(entry.session)}, again: {list(entry.again)}, runs: {entry.runs}}}\n"
        for entry in kept
    ]
    try:
        if rows:
            file.parent.mkdir(parents=True, exist_ok=True)
            replace_file(file, "".join([_HEAD, "sessions:\n", *rows]).encode())
        else:
            file.unlink(missing_ok=True)
    except OSError as error:
        raise ConfigError(f"{file}: cannot be written ({error})") from error


def _entries(file: Path) -> tuple[Entry, ...]:
    if not file.exists():
        return ()
    entries = build(CampaignFile, read_yaml(file), str(file)).sessions
    if strange := [entry.name for entry in entries if not entry.again]:
        raise ConfigError(f"{file}: found {strange[0]} without `again`; move the file away")
    return entries
