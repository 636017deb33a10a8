"""Metadata of sessions, streams and archives: a JSON object per group and array.

Attributes that readers compute with are checked by name before any of them is used. Metadata may
come from anybody: a value of another type, NaN, a huge number or a huge list is refused here, and
not found later as a wrong time or a failed allocation.
"""

import json
import math
import os
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from recorder.errors import SessionError
from recorder.spec import FORMAT, FORMAT_VERSION, RATE_MAX_HZ, STATUSES
from recorder.store.files import LOCAL, Files, replace_file

# Largest file of metadata that is read [bytes]; the manifest of a day has a tenth of it.
DOCUMENT_MAX = 1 << 28
# Most rows of an array.
ROWS_MAX = 1 << 40
# Attribute of a closed session whose derived files are being built again: its status before.
REBUILDING = "rebuilding"


def read_document(files: Files, path: Path) -> dict[str, Any]:
    """Return the JSON object in a file, whose attributes, if any, are an object as well."""
    try:
        check_document_size(files, path)
        document = json.loads(files.read(path))
    except FileNotFoundError:
        raise SessionError(f"{files.name(path)}: missing") from None
    except (OSError, ValueError, RecursionError) as error:
        raise SessionError(f"{files.name(path)}: not readable as JSON: {error}") from error
    if not isinstance(document, dict):
        type_name = type(document).__name__
        raise SessionError(f"{files.name(path)}: found {type_name}, expected a JSON object")
    if not isinstance(document.get("attributes", {}), dict):
        attributes = document["attributes"]
        raise SessionError(
            f"{files.name(path)}: found attributes {attributes!r:.80}, expected a JSON object"
        )
    return document


def check_document_size(files: Files, path: Path) -> None:
    """Reject a local file that is too large for metadata, before it is read."""
    if files.local and (size := path.stat().st_size) > DOCUMENT_MAX:
        raise SessionError(f"{path}: found {size} bytes; allowed for metadata: {DOCUMENT_MAX}")


def write_json(path: Path, document: dict[str, Any], *, durable: bool = True) -> None:
    """Replace a JSON file atomically; if not `durable`, only write it, to be flushed by the caller.

    Numpy scalars and arrays become numbers and lists.
    """
    (replace_file if durable else Path.write_bytes)(path, json_bytes(path, document))


def json_bytes(path: Path, document: dict[str, Any]) -> bytes:
    """Return the content of a JSON file as `write_json` writes it."""
    try:
        return json.dumps(document, indent=2, allow_nan=False, default=_plain).encode()
    except (TypeError, ValueError) as error:
        raise SessionError(f"{path}: not storable as JSON: {error}") from error


def write_group(path: Path, attrs: dict[str, Any], *, durable: bool = True) -> None:
    """Write the metadata of a Zarr group."""
    document = {"zarr_format": 3, "node_type": "group", "attributes": attrs}
    write_json(path / "zarr.json", document, durable=durable)


def merge_attrs(path: Path, attrs: dict[str, Any]) -> None:
    """Merge into the attributes of a group, atomically."""
    document = read_document(LOCAL, path / "zarr.json")
    before = document.get("attributes", {})
    document["attributes"] = {**before, **attrs}
    if document["attributes"] != before:
        write_json(path / "zarr.json", document)


def _plain(value: object) -> object:
    if isinstance(value, np.ndarray):
        return value.tolist()
    if isinstance(value, np.generic):
        return value.item()
    if isinstance(value, os.PathLike):
        return os.fspath(value)
    raise TypeError(f"{type(value).__name__} is not JSON")


# Bounds of attributes.

# Longest latency, exposure and interval [s]; the longest age of a valid sample and sync interval.
SECONDS_MAX, AGE_MAX = 60.0, 1e9
# Least latency [s]: it counts from the end of an exposure, and a picture shows its middle.
LATENCY_LEAST = -0.5
# Largest number of a bias, and of a contact frame [m, rad].
BIAS_MAX, FRAME_MAX = 1e12, 1e4
# Largest number of values of a row of attributes, of entries per run, and of knots of a clock.
VALUES_MAX, ENTRIES_MAX, KNOTS_MAX = 1 << 12, 1 << 16, 1 << 22
# Most runs: each reading of a session looks at all of them, for each of them.
RUNS_MAX = 1 << 12
# Largest time, row and count in attributes.
INT_MAX = (1 << 63) - 1
# Largest clock reading [s] and drift [ppm].
CLOCK_MAX, DRIFT_MAX = 1e12, 1e9


def _refused(where: str, key: str, value: object, allowed: str) -> SessionError:
    return SessionError(f"{where}: found {key} {value!r:.80}; allowed: {allowed}")


# Returns the allowed values of an attribute as text if it has another one.
Rule = Callable[[Any], str | None]


def _is_number(value: object) -> bool:
    number = isinstance(value, int | float) and not isinstance(value, bool)
    return number and (isinstance(value, int) or math.isfinite(value))  # type: ignore[arg-type]


def _number(low: float, high: float) -> Rule:
    allowed = f"{low:g} to {high:g}"
    return lambda value: None if _is_number(value) and low <= value <= high else allowed


def _whole(low: int, high: int) -> Rule:
    allowed = f"a whole number from {low} to {high}"
    return lambda value: None if type(value) is int and low <= value <= high else allowed


def _numbers(most: float, limit: int, count: int | None = None) -> Rule:
    """Return the rule of a list of numbers from -most to most."""
    wanted = f"up to {limit}" if count is None else str(count)

    def rule(value: Any) -> str | None:
        lengths = isinstance(value, list) and len(value) <= limit and count in (None, len(value))
        right = lengths and all(_is_number(each) and abs(each) <= most for each in value)
        return None if right else f"{wanted} numbers from {-most:g} to {most:g}"

    return rule


def _texts(value: Any) -> str | None:
    right = isinstance(value, list) and len(value) <= VALUES_MAX
    right = right and all(isinstance(each, str) for each in value)
    return None if right else f"a list of up to {VALUES_MAX} texts"


def _spans(value: Any) -> str | None:
    right = isinstance(value, list) and len(value) <= VALUES_MAX
    pair = _numbers(INT_MAX, 2, 2)
    right = right and all(pair(each) is None and each[0] <= each[1] for each in value)
    return None if right else f"a list of up to {VALUES_MAX} pairs, beginning and end"


def _speed(value: Any) -> str | None:
    return None if value == "max" else _number(0, 1e9)(value)


@dataclass(frozen=True, slots=True)
class _Entries:
    """A list of attributes of one kind."""

    rules: Mapping[str, Any]
    """Rules of each entry."""
    limit: int = ENTRIES_MAX
    """Most entries."""
    null: bool = True
    """True if an entry may be null."""


_MOMENT = _whole(-INT_MAX, INT_MAX)
# Rules by attribute: one of its value, of the attributes inside of it, or of its entries.
_PIECE = {
    "first_row": _whole(0, INT_MAX),
    "rows": _whole(0, INT_MAX),
    "offset_s": _number(-CLOCK_MAX, CLOCK_MAX),
    "drift_ppm": _number(-DRIFT_MAX, DRIFT_MAX),
    "drift_interval_ppm": _number(0, DRIFT_MAX * 1e3),
    "residual_rms_s": _number(0, CLOCK_MAX),
    "knots_device_t": _numbers(CLOCK_MAX, KNOTS_MAX),
    "knots_host_minus_device": _numbers(CLOCK_MAX, KNOTS_MAX),
}
_FIT = {
    "window_s": _number(0, AGE_MAX),
    "wrap_s": _number(0, CLOCK_MAX),
    "pieces": _Entries(_PIECE, KNOTS_MAX, null=False),
}
_STREAM = {
    "latency": _number(LATENCY_LEAST, SECONDS_MAX),
    "exposure": _number(0, SECONDS_MAX),
    "max_age": _number(0, AGE_MAX),
    "sync_interval": _number(0, AGE_MAX),
    "bias": _numbers(BIAS_MAX, VALUES_MAX),
    "axes_measured": _texts,
    "untrusted": _whole(0, INT_MAX),
    "largest": _numbers(BIAS_MAX, 6, 6),
    "latency_calibration": {"interval_s": _numbers(SECONDS_MAX, 2, 2)},
    "device": {"rate_hz": _number(0, RATE_MAX_HZ), "axes_measured": _texts},
    "clock_fit": _Entries(_FIT),
}
_SESSION = {
    "contact_frame": _numbers(FRAME_MAX, 6, 6),
    "t0_ns": _MOMENT,
    "targets_wanted": _whole(0, INT_MAX),
    "targets_done": _whole(0, INT_MAX),
    "replay_of": {"speed": _speed},
    "runs": _Entries(
        {"t0_ns": _MOMENT, "utc_ns": _MOMENT, "stalls_ns": _spans, "states": _texts}, RUNS_MAX
    ),
    "sealed_later": _Entries({"lost": _numbers(INT_MAX, ENTRIES_MAX)}, null=False),
}


def check_stream_attrs(attrs: Mapping[str, Any], where: str) -> None:
    """Reject attributes of a stream that no device has; `where` names its group in messages."""
    _check(attrs, _STREAM, where)


def check_session_attrs(attrs: Mapping[str, Any], where: str) -> None:
    """Reject attributes that no session has, when they are written or read."""
    _check(attrs, _SESSION, where)


def _check(attrs: Mapping[str, Any], rules: Mapping[str, Any], where: str) -> None:
    for key, rule in rules.items():
        value = attrs.get(key)
        if value is None:
            continue
        if isinstance(rule, _Entries):
            _check_entries(value, rule, key, where)
        elif isinstance(rule, dict):
            if not isinstance(value, dict):
                raise _refused(where, key, value, "a JSON object")
            _check(value, rule, f"{where}: {key}")
        elif (allowed := rule(value)) is not None:
            raise _refused(where, key, value, allowed)


def _check_entries(value: Any, entries: _Entries, key: str, where: str) -> None:
    if not isinstance(value, list) or len(value) > entries.limit:
        raise _refused(where, key, value, f"a list of up to {entries.limit} JSON objects")
    for number, entry in enumerate(value):
        if isinstance(entry, dict):
            _check(entry, entries.rules, f"{where}: {key}[{number}]")
        elif entry is not None or not entries.null:
            allowed = "a JSON object" + " or null" * entries.null
            raise _refused(where, f"{key}[{number}]", entry, allowed)


def check_rate(rate_hz: object, where: str) -> None:
    """Reject a rate that no device has."""
    if not _is_number(rate_hz) or not 0 < rate_hz <= RATE_MAX_HZ:  # type: ignore[operator]
        raise SessionError(
            f"{where}: found rate_hz {rate_hz!r:.80}; allowed: above 0 to {RATE_MAX_HZ:g}"
        )


def read_order(path: Path, files: Files = LOCAL) -> list[str]:
    """Return the names of the streams in the order in which the session declared them."""
    order = read_document(files, path / "zarr.json").get("attributes", {}).get("order")
    if not isinstance(order, list) or not all(isinstance(name, str) for name in order):
        raise SessionError(f"{files.name(path)}: found order {order!r:.80}, expected names")
    return order


class _Attributes(dict[str, Any]):
    """Attributes of a session or an archive; `attrs["x"]` raises `SessionError` without an x."""

    where = ""

    def __missing__(self, key: str) -> Any:
        raise SessionError(f"{self.where}: attribute {key!r} is missing")


def read_session_attrs(path: Path, files: Files = LOCAL) -> dict[str, Any]:
    """Return the attributes of a session."""
    attrs = read_attrs(path, files, what="session", format_=FORMAT, version=FORMAT_VERSION)
    name = files.name(path)
    for key, allowed in (("status", STATUSES), (REBUILDING, STATUSES[1:])):
        value = attrs["status"] if key == "status" else attrs.get(key, allowed[0])
        if value not in allowed:
            choices = ", ".join(allowed)
            raise SessionError(f"{name}: found {key} {value!r:.80}; allowed: {choices}")
    if "rate_hz" in attrs:
        check_rate(attrs["rate_hz"], name)
    check_session_attrs(attrs, name)
    _check_runs(attrs["runs"], name)
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
    """Return the attributes of a session or an archive (`what`) of one format and version."""
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
    attrs = _Attributes(read_document(files, path / "zarr.json").get("attributes", {}))
    attrs.where = name
    if attrs.get("format") != format_:
        raise SessionError(f"{name}: found format {attrs.get('format')!r}, expected {format_!r}")
    stored_version = attrs.get("format_version")
    if stored_version != version or type(stored_version) is not int:
        newer = type(stored_version) is int and stored_version > version
        raise SessionError(
            f"{name}: found format_version {stored_version}, this program reads {version}"
            + "; update it" * newer
        )
    return attrs


def says_it_is(path: Path, files: Files, format_: str) -> bool:
    """Return True if a place is readable and its metadata declares the given format."""
    try:
        attrs = read_document(files, path / "zarr.json").get("attributes", {})
    except SessionError:
        return False
    return bool(attrs.get("format") == format_)
