"""Attributes of sessions, streams and archives, and the bounds of those that readers compute with.

They are checked by name before any of them is used. Metadata may come from anybody: a value of
another type, NaN, a huge number or a huge list is refused here, and not found later as a wrong time
or a failed allocation.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from recorder.errors import SessionError
from recorder.spec import FORMAT, FORMAT_VERSION, RATE_MAX_HZ, STATUSES
from recorder.store.array import ROWS_MAX
from recorder.store.files import LOCAL, Files, read_document

# Attribute of a closed session whose derived files are being built again: its status before.
REBUILDING = "rebuilding"

# Longest latency, exposure and interval [s]; the longest age of a valid sample and sync interval.
SECONDS_MAX, AGE_MAX = 60.0, 1e9
# Least latency [s]: it counts from the end of an exposure, and a picture shows its middle.
LATENCY_LEAST = -0.5
# Largest number of a bias, and of a contact frame [m, rad].
BIAS_MAX, FRAME_MAX = 1e12, 1e4
# Largest number of values of a row of attributes, of entries per run, and of knots of a clock.
VALUES_MAX, ENTRIES_MAX, KNOTS_MAX = 1 << 12, 1 << 16, 1 << 22
# Largest time, row and count in attributes.
INT_MAX = (1 << 63) - 1
# Largest clock reading [s] and drift [ppm].
CLOCK_MAX, DRIFT_MAX = 1e12, 1e9


class _Attributes:
    """Attributes of one group, which are refused by name."""

    def __init__(self, attrs: Mapping[str, Any], where: str) -> None:
        self._attrs, self._where = attrs, where

    def get(self, key: str) -> Any:
        """Return an attribute; None if it is missing."""
        return self._attrs.get(key)

    def refuse(self, key: str, value: object, allowed: str) -> SessionError:
        return SessionError(f"{self._where}: found {key} {value!r:.80}; allowed: {allowed}")

    def number(self, key: str, low: float, high: float) -> None:
        """Reject anything but a number from `low` to `high`, or null."""
        value = self._attrs.get(key)
        if value is None:
            return
        if not _is_number(value) or not low <= value <= high:
            raise self.refuse(key, value, f"{low:g} to {high:g}")

    def whole(self, key: str, low: int, high: int) -> None:
        """Reject anything but a whole number from `low` to `high`, or null."""
        value = self._attrs.get(key)
        if value is not None and (type(value) is not int or not low <= value <= high):
            raise self.refuse(key, value, f"a whole number from {low} to {high}")

    def numbers(self, key: str, most: float, *, count: int | None, limit: int) -> None:
        """Reject anything but a list of `count` numbers from -most to most, or null."""
        value = self._attrs.get(key)
        if value is None:
            return
        wanted = f"up to {limit}" if count is None else str(count)
        if (
            not isinstance(value, list)
            or len(value) > limit
            or (count is not None and len(value) != count)
            or not all(_is_number(each) and abs(each) <= most for each in value)
        ):
            raise self.refuse(key, value, f"{wanted} numbers from {-most:g} to {most:g}")

    def words(self, key: str) -> None:
        """Reject anything but a list of texts, or null."""
        value = self._attrs.get(key)
        if value is None:
            return
        if (
            not isinstance(value, list)
            or len(value) > VALUES_MAX
            or not all(isinstance(each, str) for each in value)
        ):
            raise self.refuse(key, value, f"a list of up to {VALUES_MAX} texts")

    def inner(self, key: str) -> _Attributes:
        """Return the attributes inside of one, empty if it is missing or null."""
        value = self._attrs.get(key)
        if value is not None and not isinstance(value, dict):
            raise self.refuse(key, value, "a JSON object")
        return _Attributes(value or {}, f"{self._where}: {key}")

    def entries(self, key: str, limit: int = ENTRIES_MAX) -> list[_Attributes | None]:
        """Return the attributes inside of each entry of a list; None for null."""
        value = self._attrs.get(key)
        if value is None:
            return []
        if not isinstance(value, list) or len(value) > limit:
            raise self.refuse(key, value, f"a list of up to {limit} JSON objects")
        found: list[_Attributes | None] = []
        for number, entry in enumerate(value):
            if entry is not None and not isinstance(entry, dict):
                raise self.refuse(f"{key}[{number}]", entry, "a JSON object or null")
            part = f"{self._where}: {key}[{number}]"
            found.append(None if entry is None else _Attributes(entry, part))
        return found


def _is_number(value: object) -> bool:
    number = isinstance(value, int | float) and not isinstance(value, bool)
    return number and (isinstance(value, int) or math.isfinite(value))  # type: ignore[arg-type]


def check_stream_attrs(attrs: Mapping[str, Any], where: str) -> None:
    """Reject attributes of a stream that no device has.

    Args:
        attrs: Attributes of its group.
        where: Place of the group, for messages.
    """
    stream = _Attributes(attrs, where)
    stream.number("latency", LATENCY_LEAST, SECONDS_MAX)
    stream.number("exposure", 0, SECONDS_MAX)
    stream.number("max_age", 0, AGE_MAX)
    stream.number("sync_interval", 0, AGE_MAX)
    stream.numbers("bias", BIAS_MAX, count=None, limit=VALUES_MAX)
    stream.words("axes_measured")
    stream.inner("latency_calibration").numbers("interval_s", SECONDS_MAX, count=2, limit=2)
    device = stream.inner("device")
    device.number("rate_hz", 0, RATE_MAX_HZ)
    device.words("axes_measured")
    for fit in stream.entries("clock_fit"):
        if fit is not None:
            _check_fit(fit)


def _check_fit(fit: _Attributes) -> None:
    fit.number("window_s", 0, AGE_MAX)
    fit.number("wrap_s", 0, CLOCK_MAX)
    for piece in fit.entries("pieces", KNOTS_MAX):
        if piece is None:
            raise fit.refuse("pieces", None, "JSON objects")
        piece.whole("first_row", 0, INT_MAX)
        piece.whole("rows", 0, INT_MAX)
        piece.number("offset_s", -CLOCK_MAX, CLOCK_MAX)
        piece.number("drift_ppm", -DRIFT_MAX, DRIFT_MAX)
        piece.number("drift_interval_ppm", 0, DRIFT_MAX * 1e3)
        piece.number("residual_rms_s", 0, CLOCK_MAX)
        for key in ("knots_device_t", "knots_host_minus_device"):
            piece.numbers(key, CLOCK_MAX, count=None, limit=KNOTS_MAX)


def check_session_attrs(attrs: Mapping[str, Any], where: str) -> None:
    """Reject attributes that no session has, when they are written or read.

    See `check_stream_attrs`.
    """
    session = _Attributes(attrs, where)
    session.numbers("contact_frame", FRAME_MAX, count=6, limit=6)
    session.whole("t0_ns", -INT_MAX, INT_MAX)
    session.whole("targets_wanted", 0, INT_MAX)
    replay = session.inner("replay_of")
    if replay.get("speed") != "max":
        replay.number("speed", 0, 1e9)
    for run in session.entries("runs"):
        if run is not None:
            run.whole("t0_ns", -INT_MAX, INT_MAX)
            run.whole("utc_ns", -INT_MAX, INT_MAX)
    for number, entry in enumerate(session.entries("sealed_later")):
        if entry is None:
            raise session.refuse(f"sealed_later[{number}]", None, "a JSON object")
        entry.numbers("lost", INT_MAX, count=None, limit=ENTRIES_MAX)


def check_rate(rate_hz: object, where: str) -> None:
    """Reject a rate that no device has."""
    number = isinstance(rate_hz, int | float) and not isinstance(rate_hz, bool)
    if not number or not 0 < rate_hz <= RATE_MAX_HZ:  # type: ignore[operator]
        raise SessionError(
            f"{where}: found rate_hz {rate_hz!r:.80}; allowed: above 0 to {RATE_MAX_HZ:g}"
        )


def read_order(path: Path, files: Files = LOCAL) -> list[str]:
    """Return the names of the streams in the order in which the session declared them."""
    order = read_document(files, path / "zarr.json").get("attributes", {}).get("order")
    if not isinstance(order, list) or not all(isinstance(name, str) for name in order):
        raise SessionError(f"{files.name(path)}: found order {order!r:.80}, expected names")
    return order


# Attributes of a session or an archive.


class _Required(dict[str, Any]):
    """Attributes of a session or an archive; `attrs["x"]` raises `SessionError` without an x."""

    where = ""

    def __missing__(self, key: str) -> Any:
        raise SessionError(f"{self.where}: attribute {key!r} is missing")


def read_session_attrs(path: Path, files: Files = LOCAL) -> dict[str, Any]:
    """Return the attributes of a session."""
    attrs = read_attrs(path, files, what="session", format_=FORMAT, version=FORMAT_VERSION)
    name = files.name(path)
    for key, allowed in (("status", STATUSES), (REBUILDING, STATUSES[1:])):
        found = attrs["status"] if key == "status" else attrs.get(key, allowed[0])
        if found not in allowed:
            known = ", ".join(allowed)
            raise SessionError(f"{name}: found {key} {found!r:.80}; allowed: {known}")
    if "rate_hz" in attrs:
        check_rate(attrs["rate_hz"], name)
    _check_runs(attrs["runs"], name)
    check_session_attrs(attrs, name)
    return attrs


def _check_runs(runs: object, name: str) -> None:
    if not isinstance(runs, list):
        raise SessionError(f"{name}: found runs {runs!r:.80}, expected a list")
    before: dict[str, int] = {}
    for number, run in enumerate(runs):
        first_row = run.get("first_row") if isinstance(run, dict) else None
        if not isinstance(first_row, dict):
            raise SessionError(f"{name}: found runs[{number}] {run!r:.80}, expected its first_row")
        for stream, row in first_row.items():
            least = before.get(stream, 0)
            if type(row) is not int or not least <= row <= ROWS_MAX:
                raise SessionError(
                    f"{name}: found runs[{number}] first_row {stream} {row!r:.80}; allowed: "
                    f"{least} to {ROWS_MAX}"
                )
            before[stream] = row


def read_attrs(
    path: Path, files: Files, *, what: str, format_: str, version: int
) -> dict[str, Any]:
    """Return the attributes of a session or an archive.

    Args:
        path: Its directory.
        files: File access for the directory.
        what: Kind of object, for messages.
        format_: Expected value of `format`.
        version: The `format_version` that can be read.
    """
    name = files.name(path)
    if files.local and path.is_file():
        raise SessionError(f"{name}: found a file; allowed: the folder of a session or an archive")
    if files.local and not path.is_dir():
        raise SessionError(f"{name}: no such {what}")
    try:
        files.read(path / "zarr.json")
    except FileNotFoundError as error:
        if not files.local:  # the store's error shows if the bucket itself is missing
            raise SessionError(f"{name}: no such {what} ({error})") from None
    except OSError as error:
        raise SessionError(f"{name}: {error}") from error
    attrs = _Required(read_document(files, path / "zarr.json").get("attributes", {}))
    attrs.where = name
    if attrs.get("format") != format_:
        raise SessionError(f"{name}: found format {attrs.get('format')!r}, expected {format_!r}")
    found = attrs.get("format_version")
    if found != version or type(found) is not int:
        newer = type(found) is int and found > version
        raise SessionError(
            f"{name}: found format_version {found}, this program reads {version}"
            + "; update it" * newer
        )
    return attrs


def says_it_is(path: Path, files: Files, format_: str) -> bool:
    """Return True if a place is readable and its metadata declares the given format."""
    try:
        attrs = read_document(files, path / "zarr.json").get("attributes", {})
    except SessionError:
        return False
    return isinstance(attrs, dict) and attrs.get("format") == format_
