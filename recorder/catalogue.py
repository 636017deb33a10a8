"""Catalogue of the sessions below a folder: one row per session, searchable without opening them.

A row is copied from the session's own `zarr.json`, so the catalogue holds nothing that the sessions
do not, except the findings of the last check. It is kept in a file of the folder so that only
sessions that changed are read again. Deleting that file loses nothing but those findings.

Imports only the standard library, so that a list of thousands of sessions appears at once.
"""

import contextlib
import json
import os
from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass, fields, replace
from datetime import date
from pathlib import Path
from typing import Any

from recorder.errors import SessionError

# Name of the file in the folder.
FILE = ".tactile-catalogue.json"
# Status of a folder whose `zarr.json` cannot be read.
UNREADABLE = "unreadable"

_FORMAT = "tactile-rig session"
_METADATA = "zarr.json"
_VERSION = 1
# Largest `zarr.json` of a session that is read [bytes].
_LARGEST = 1 << 26


@dataclass(frozen=True, slots=True)
class Row:
    """Properties of one session."""

    path: str
    """Path of the session, relative to the folder of the catalogue."""
    stamp: tuple[int, int, int]
    """Time of change [ns], size [bytes] and inode of the session's `zarr.json`."""
    format: str = ""
    """Attribute `format`; other Zarr groups are remembered too, but not listed."""
    status: str = ""
    """One of `recorder.spec.STATUSES`, or `unreadable`."""
    reason: str = ""
    """Reason of the status, if any."""
    sensor: str = ""
    indenter: str = ""
    operator: str = ""
    plan: str = ""
    """Kind of the plan, such as `press_shear`; empty for an imported session."""
    targets: int = 0
    """Number of targets that were to be pressed; 0 if the session does not say."""
    done: int | None = None
    """Number of targets that were pressed; None if the session does not say."""
    started_utc: str = ""
    """Start in UTC, ISO 8601."""
    mock: bool = False
    """True if emulators took the place of the devices."""
    runs: int = 0
    dropped: int = 0
    """Samples that the streams of the last run report as dropped."""
    findings: tuple[str, ...] | None = None
    """Codes of the faults of the last check, each once; None if not checked since it changed."""

    @property
    def is_session(self) -> bool:
        """True if it is a session whose metadata can be read."""
        return self.format == _FORMAT

    @property
    def faults(self) -> tuple[str, ...]:
        """Everything known to be wrong: the status if not complete, drops, findings of a check."""
        faults = [] if self.status == "complete" else [self.status]
        faults += [f"{self.dropped} dropped"] if self.dropped else []
        faults += [code for code in self.findings or () if code not in faults]
        return tuple(faults)


@dataclass(frozen=True, slots=True)
class Query:
    """Conditions of a search; an empty one is met by every session."""

    sensor: str = ""
    indenter: str = ""
    plan: str = ""
    status: str = ""
    since: date | None = None
    """First day [UTC]."""
    until: date | None = None
    """Last day, included [UTC]."""
    faults: bool | None = None
    """True for sessions with faults, False for those without."""
    text: str = ""
    """Words that path, sensor, indenter, operator or plan contain, in any case of letters."""

    def accepts(self, row: Row) -> bool:
        """Return True if a session meets all conditions."""
        for name in ("sensor", "indenter", "plan", "status"):
            value = getattr(self, name)
            if value and getattr(row, name) != value:
                return False
        row_text = " ".join((row.path, row.sensor, row.indenter, row.operator, row.plan)).lower()
        if not all(term in row_text for term in self.text.lower().split()):
            return False
        day = row.started_utc[:10]
        if self.since is not None and not day >= self.since.isoformat():
            return False
        if self.until is not None and not (day and day <= self.until.isoformat()):
            return False
        return self.faults is None or bool(row.faults) == self.faults


class Catalogue:
    """The sessions below a folder."""

    def __init__(self, folder: str | os.PathLike[str]) -> None:
        """Load the catalogue of a folder; `refresh` brings it up to date."""
        self.folder = Path(folder)
        if not self.folder.is_dir():
            raise SessionError(f"{self.folder}: no such folder")
        self._rows = _load(self.folder / FILE)

    def __iter__(self) -> Iterator[Row]:
        """Iterate over the sessions, the oldest first."""
        listed = (row for row in self._rows.values() if row.is_session or row.status == UNREADABLE)
        return iter(sorted(listed, key=lambda row: (row.started_utc, row.path)))

    def refresh(self) -> None:
        """Read every session that is new or has changed, and forget those that are gone."""
        before = self._rows
        self._rows = {}
        for path, stamp in _groups_below(self.folder, ""):
            row = before.get(path)
            self._rows[path] = (
                row if row and row.stamp == stamp else _read(self.folder, path, stamp)
            )
        if self._rows != before:
            self.save()

    def look(self, path: str) -> Row | None:
        """Return the row of a session by its path in the folder, read again if changed, or None."""
        try:
            stamp = _stamp(os.stat(self.folder / path / _METADATA))
        except (FileNotFoundError, NotADirectoryError):
            self._rows.pop(path, None)
            return None
        row = self._rows.get(path)
        if row is None or row.stamp != stamp:
            row = self._rows[path] = _read(self.folder, path, stamp)
        return row

    def find(self, query: Query) -> list[Row]:
        """Return the sessions that meet a query, the oldest first."""
        return [row for row in self if query.accepts(row)]

    def record_check(self, row: Row, codes: set[str]) -> Row:
        """Keep the codes of the faults that a check found in a session; return its new row."""
        checked = replace(row, findings=tuple(sorted(codes)))
        self._rows[row.path] = checked
        return checked

    def save(self) -> None:
        """Write the catalogue's file; a folder that cannot be written is left without one."""
        document = {"version": _VERSION, "rows": [asdict(row) for row in self._rows.values()]}
        final = self.folder / FILE
        temporary = final.with_name(f"{FILE}.{os.getpid()}.tmp")
        try:
            temporary.write_text(json.dumps(document))
            temporary.replace(final)
        except OSError:
            # A read-only or full disk: the catalogue works without its file, only slower.
            with contextlib.suppress(OSError):
                temporary.unlink()


def _load(path: Path) -> dict[str, Row]:
    """Return the rows of a catalogue's file; none if it is missing, damaged or another version."""
    try:
        document = json.loads(path.read_text())
        if document["version"] != _VERSION:
            return {}
        rows = [_row(row) for row in document["rows"]]
    except (OSError, ValueError, KeyError, TypeError):
        return {}
    return {row.path: row for row in rows}


def _row(stored: dict[str, Any]) -> Row:
    if set(stored) != {field.name for field in fields(Row)}:
        raise ValueError("unknown columns")
    findings = stored.pop("findings")
    stamp = tuple(stored.pop("stamp"))
    row = Row(**stored, stamp=stamp, findings=None if findings is None else tuple(findings))
    if any(type(stored[name]) is not type(getattr(_ANY, name)) for name in stored):
        raise ValueError("a column of another type")
    return row


_ANY = Row("", (0, 0, 0))


def _groups_below(folder: Path, inside: str) -> Iterator[tuple[str, tuple[int, int, int]]]:
    """Yield the Zarr groups below a folder with their stamps; groups are not entered."""
    with os.scandir(folder / inside) as entries:
        directories = [entry for entry in entries if entry.is_dir(follow_symlinks=False)]
    for entry in sorted(directories, key=lambda entry: entry.name):
        path = f"{inside}/{entry.name}" if inside else entry.name
        try:
            yield path, _stamp(os.stat(os.path.join(entry.path, _METADATA)))
        except FileNotFoundError:
            try:
                yield from _groups_below(folder, path)
            except (PermissionError, FileNotFoundError):
                continue


def _stamp(status: os.stat_result) -> tuple[int, int, int]:
    return status.st_mtime_ns, status.st_size, status.st_ino


def _read(folder: Path, path: str, stamp: tuple[int, int, int]) -> Row:
    file = folder / path / _METADATA
    try:
        if stamp[1] > _LARGEST:
            raise ValueError(f"{stamp[1]} bytes; allowed: up to {_LARGEST}")
        attrs = json.loads(file.read_bytes()).get("attributes", {})
        if attrs.get("format") != _FORMAT:
            return Row(path, stamp, str(attrs.get("format", "other")))
        return _row_of(path, stamp, attrs)
    except (OSError, ValueError, TypeError, AttributeError) as error:
        return Row(path, stamp, status=UNREADABLE, reason=f"{file}: {error}")


def _row_of(path: str, stamp: tuple[int, int, int], attrs: Mapping[str, Any]) -> Row:
    def text(key: str) -> str:
        value = attrs.get(key)
        return "" if value is None else str(value)

    plan = attrs.get("plan")
    summary = attrs.get("summary") or {}
    return Row(
        path,
        stamp,
        format=_FORMAT,
        status=text("status"),
        reason=text("reason"),
        sensor=text("sensor"),
        indenter=text("indenter"),
        operator=text("operator"),
        plan=str(plan.get("kind", "")) if isinstance(plan, dict) else "",
        targets=int(attrs.get("targets_wanted") or 0),
        done=None if attrs.get("targets_done") is None else int(attrs["targets_done"]),
        started_utc=text("started_utc"),
        mock=bool(attrs.get("mock")),
        runs=len(attrs.get("runs") or ()),
        dropped=sum(int(stream.get("dropped", 0)) for stream in summary.values()),
    )
