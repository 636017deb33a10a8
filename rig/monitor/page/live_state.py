"""State of a running collection for the page, from shared records and the open image shard.

Everything here is read-only. Force is sampled at 40 Hz for the traces, only for display; the
session stores it at its full rate.
"""

from __future__ import annotations

import math
from collections import deque
from pathlib import Path
from typing import Any

import numpy as np

from recorder import SessionError
from recorder.session import ImageTail, open_tail
from rig.acquire.stream_process import COUNTERS
from rig.bench.bench import Bench
from rig.bench.stream_kinds import expected_rate, kind_of, stream_names
from rig.core.clock import SECOND_NS
from rig.core.config import from_si
from rig.core.geometry import invert, transform
from rig.core.guard import AXES
from rig.core.shared_memory import AwaitedRecord

TRACE_RATE_HZ = 40.0
TRACE_SECONDS = 20.0

# Time since the page's start [s] and Fx, Fy, Fz [N].
Point = tuple[float, float | None, float | None, float | None]


class LiveState:
    """Newest samples of all streams.

    Args:
        bench: The bench.
        folder: Run folder.
        session: The session, which may not exist yet.
        start_ns: Origin of the traces' times [ns].
    """

    def __init__(self, bench: Bench, folder: Path, session: Path, start_ns: int) -> None:
        self._bench = bench
        self._session = session
        self._start_ns = start_ns
        names = stream_names(bench)
        self._latest = {
            name: AwaitedRecord(folder / f"{name}.latest", kind_of(bench, name).latest)
            for name in names
        }
        self._counters = {
            name: AwaitedRecord(folder / f"{name}.counters", COUNTERS) for name in names
        }
        # The page shows the first stream of each kind, and the rates of all.
        self._first = {row.kind: row.name for row in reversed(bench.rows)}
        self._to_contact = invert(bench.contact_frame)
        self._tail: ImageTail | None = None
        self._image: tuple[int, bytes | None] = (-1, None)
        self._no_contact: np.ndarray | None = None
        self.trace: deque[Point] = deque(maxlen=round(TRACE_SECONDS * TRACE_RATE_HZ))
        """Force during the last TRACE_SECONDS."""
        self.traced = 0
        """Number of points ever added to the trace, including dropped ones."""
        self._traced_ns = 0

    def sample(self) -> None:
        """Add the newest force to the trace, unless it is already there."""
        record = self._newest("force")
        if record is None or int(record["t_ns"]) == self._traced_ns:
            return
        self._traced_ns = int(record["t_ns"])
        seconds = (self._traced_ns - self._start_ns) / SECOND_NS
        x, y, z = (_number(value) for value in record["value"][:3])
        self.trace.append((round(seconds, 3), x, y, z))
        self.traced += 1

    def points_since(self, count: int) -> list[Point]:
        """Return the points after the first `count` of all, as far as the trace reaches back."""
        new = min(self.traced - count, len(self.trace))
        return [self.trace[k] for k in range(len(self.trace) - new, len(self.trace))]

    def streams(self, now_ns: int) -> dict[str, dict[str, Any]]:
        """Return rate, expected rate [Hz], dropped, longest gap and age [ms] of every stream."""
        found = {}
        for name, shared in self._counters.items():
            counters = shared.read()
            newest = self._latest[name].read()
            row: dict[str, Any] = {"expected": expected_rate(self._bench, name)}
            if counters is not None:
                row |= {
                    "rate": _number(counters["rate_hz"], 1),
                    "rows": int(counters["rows"]),
                    "dropped": int(counters["dropped"]),
                    "gap": _number(1e3 * counters["longest_gap"], 1),
                }
            if newest is not None:
                row["age"] = max(round((now_ns - int(newest["t_ns"])) / 1e6), 0)
            found[name] = row
        return found

    def force(self) -> dict[str, Any] | None:
        """Return the wrench [N, N mm] and the fraction of each rating; None before the first."""
        record = self._newest("force")
        if record is None:
            return None
        limits = self._bench.limits
        ratings = (*limits.force_rating, *limits.torque_rating)
        wrench = [float(value) for value in record["value"]]
        shown = (*wrench[:3], *(from_si(value, "n_mm") for value in wrench[3:]))
        return {
            "wrench": [_number(value) for value in shown],
            "load": [
                _number(abs(value) / rating) for value, rating in zip(wrench, ratings, strict=True)
            ],
        }

    def tip(self) -> list[float | None] | None:
        """Return the tip's position in the contact frame (3,) [mm], None before the first pose."""
        record = self._newest("pose")
        if record is None:
            return None
        place = transform(self._to_contact, record["value"][:3])
        return [_number(from_si(float(value), "mm")) for value in place]

    def taxels(self) -> list[list[int]] | None:
        """Return the counts (16, 3) minus the first ones read, or None without taxels."""
        record = self._newest("taxels")
        if record is None:
            return None
        if self._no_contact is None:
            self._no_contact = record["value"]
        change: list[list[int]] = (record["value"] - self._no_contact).tolist()
        return change

    def limits(self) -> dict[str, Any]:
        """Return the constant limits: axes, their ratings, both fractions, the box [mm]."""
        limits = self._bench.limits
        ratings = (*limits.force_rating, *(from_si(v, "n_mm") for v in limits.torque_rating))
        box = (limits.box_x, limits.box_y, (-limits.depth_max, limits.height_max))
        return {
            "axes": [name for name, _ in AXES],
            "ratings": list(ratings),
            "soft": limits.soft_fraction,
            "hard": limits.hard_fraction,
            "box": [[from_si(value, "mm") for value in pair] for pair in box],
        }

    def image(self) -> tuple[int, bytes | None]:
        """Return row and JPEG bytes of the newest stored image; (-1, None) before the first."""
        newest = self._newest("camera")
        row = -1 if newest is None else int(newest["row"])
        if row < 0 or row == self._image[0]:
            return self._image
        try:
            if self._tail is None:
                self._tail = open_tail(self._session / "streams" / self._first["camera"])
            data = self._tail.jpeg(row)
        except (SessionError, OSError):
            # Affects the display only: corrupt sessions are reported by `check`, not by the page.
            return self._image
        if data is not None:
            self._image = (row, data)
        return self._image

    def _newest(self, kind: str) -> np.void | None:
        """Return the newest sample of the first stream of a kind; None before it, or without."""
        name = self._first.get(kind)
        return None if name is None else self._latest[name].read()

    def close(self) -> None:
        """Release all records; may be called twice."""
        for record in (*self._latest.values(), *self._counters.values()):
            record.close()
        if self._tail is not None:
            self._tail.close()
            self._tail = None


def _number(value: Any, digits: int = 3) -> float | None:
    """Return a rounded float for JSON; None if it is not finite."""
    number = float(value)
    return round(number, digits) if math.isfinite(number) else None
