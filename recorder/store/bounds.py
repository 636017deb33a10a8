"""Bounds of the attributes that readers compute with, checked by name before any of them is used.

Metadata may come from anybody: a value of another type, NaN, a huge number or a huge list is
refused here, and not found later as a wrong time or a failed allocation.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

from recorder.errors import SessionError
from recorder.spec import RATE_MAX_HZ

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
