"""State of a running collection for the page, from shared records and the open image shard.

Everything here is read-only. Force is sampled at 40 Hz for the traces, only for display; the
session stores it at its full rate.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from recorder import SessionError
from recorder.store import ImageTail, open_tail
from rig.acquire.stream_process import COUNTERS
from rig.bench.bench import Bench
from rig.core.clock import SECOND_NS
from rig.core.config import from_si
from rig.core.geometry import invert, transform
from rig.core.guard import AXES
from rig.core.shared_memory import AwaitedRecord
from rig.monitor.live_view import SAMPLE_RATE_HZ, Backlog, number
from trajectories import dome_height

# Time that traces reach back [s].
TRACE_SECONDS = 20.0

# Most pictures and plots that the page shows; the table lists every stream.
MOST_PICTURES, MOST_PLOTS, MOST_ARMS = 6, 4, 4

# Time since the page's start [s] and Fx, Fy, Fz [N].
Point = tuple[float, float | None, float | None, float | None]


class Trace(Backlog[Point]):
    """Force of one gauge during the last seconds."""

    def __init__(self) -> None:
        super().__init__(round(TRACE_SECONDS * SAMPLE_RATE_HZ))
        self._newest_ns = 0

    def sample(self, record: np.void, start_ns: int) -> None:
        """Add a sample, unless it is already there."""
        t_ns = int(record["t_ns"])
        if t_ns != self._newest_ns:
            self._newest_ns = t_ns
            x, y, z = (number(value) for value in record["value"][:3])
            self.add((round((t_ns - start_ns) / SECOND_NS, 3), x, y, z))


class Picture:
    """Newest image of one camera, from the open shard."""

    def __init__(self, group: Path) -> None:
        self._group = group
        self._tail: ImageTail | None = None
        self.row = -1
        """Row of the image; -1 before the first."""
        self.jpeg: bytes | None = None
        """Its JPEG bytes."""

    def look(self, newest: np.void | None) -> None:
        """Read the image of the newest sample, if it is another one."""
        row = -1 if newest is None else int(newest["row"])
        if row < 0 or row == self.row:
            return
        try:
            if self._tail is None:
                self._tail = open_tail(self._group)
            data = self._tail.jpeg(row)
        except (SessionError, OSError):
            # Affects the display only: corrupt sessions are reported by `check`, not by the page.
            return
        if data is not None:
            self.row, self.jpeg = row, data


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
        self._start_ns = start_ns
        self._latest = {
            row.name: AwaitedRecord(folder / f"{row.name}.latest", row.latest) for row in bench.rows
        }
        self._counters = {
            name: AwaitedRecord(folder / f"{name}.counters", COUNTERS) for name in self._latest
        }
        self._to_contact = invert(bench.contact_frame)
        self._dome_radius = bench.dome_radius
        of_kind = {
            kind: [row.name for row in bench.of_kind(kind)]
            for kind in ("camera", "taxels", "force", "pose")
        }
        signal = None if bench.signal is None else bench.signal.name
        signals = sorted([*of_kind["camera"], *of_kind["taxels"]], key=lambda name: name != signal)
        self.kinds = {name: bench.row(name).kind for name in signals[:MOST_PICTURES]}
        """Kind of each stream that is shown as a picture; the first stands large on the page."""
        self._gauges = of_kind["force"][:MOST_PLOTS]
        self._arms = of_kind["pose"][:MOST_ARMS]
        self.pictures = {
            name: Picture(session / "streams" / name)
            for name, kind in self.kinds.items()
            if kind == "camera"
        }
        """Newest image of each camera that is shown."""
        self._no_contact: dict[str, np.ndarray] = {}
        self.traces = {name: Trace() for name in self._gauges}
        """Trace of each gauge that is shown."""

    def sample(self) -> None:
        """Add the newest forces to the traces."""
        for name, trace in self.traces.items():
            record = self._latest[name].read()
            if record is not None:
                trace.sample(record, self._start_ns)

    def streams(self, now_ns: int) -> dict[str, dict[str, Any]]:
        """Return rate, expected rate [Hz], dropped, longest gap and age [ms] of every stream."""
        rows = {}
        for name, shared in self._counters.items():
            counters = shared.read()
            newest = self._latest[name].read()
            row: dict[str, Any] = {"expected": self._bench.row(name).rate_hz}
            if counters is not None:
                row |= {
                    "rate": number(counters["rate_hz"], 1),
                    "rows": int(counters["rows"]),
                    "dropped": int(counters["dropped"]),
                    "gap": number(1e3 * counters["longest_gap"], 1),
                }
            if newest is not None:
                row["age"] = max(round((now_ns - int(newest["t_ns"])) / 1e6), 0)
            rows[name] = row
        return rows

    def forces(self) -> dict[str, dict[str, Any]]:
        """Return the wrench [N, N mm] of each gauge, and the fraction of each rating."""
        ratings = self._bench.force_rating
        forces = {}
        for name in self._gauges:
            record = self._latest[name].read()
            if record is None:
                continue
            wrench = [float(value) for value in record["value"]]
            values = (*wrench[:3], *(from_si(value, "n_mm") for value in wrench[3:]))
            pairs = zip(wrench, ratings, strict=True)
            forces[name] = {
                "wrench": [number(value) for value in values],
                "load": [number(abs(value) / rating) for value, rating in pairs],
                "guards": any(gauge.name == name for gauge in self._bench.gauges),
            }
        return forces

    def tips(self) -> dict[str, list[float | None]]:
        """Return the position of each arm's tip (3,) [mm].

        x and y are in the contact frame, z is the height above the undeformed surface there.
        """
        tips = {}
        for name in self._arms:
            record = self._latest[name].read()
            if record is not None:
                tip = transform(self._to_contact, record["value"][:3])
                tip[2] -= dome_height(self._dome_radius, *tip[:2].tolist())
                tips[name] = [number(from_si(float(value), "mm")) for value in tip]
        return tips

    def taxels(self) -> dict[str, list[list[int]]]:
        """Return counts (taxels, axes) of each array that is shown, minus the first ones read."""
        counts = {}
        for name in self.kinds:
            record = self._latest[name].read() if name not in self.pictures else None
            if record is not None:
                no_contact = self._no_contact.setdefault(name, record["value"].copy())
                counts[name] = (record["value"] - no_contact).tolist()
        return counts

    def constants(self) -> dict[str, Any]:
        """Return the streams that are shown, and the limits: ratings [N, N mm], the box [mm]."""
        limits, rating = self._bench.limits, self._bench.force_rating
        box = (limits.box_x, limits.box_y, (-limits.depth_max, limits.height_max))
        return {
            "pictures": self.kinds,
            "plots": self._gauges,
            "arms": self._arms,
            "seconds": TRACE_SECONDS,
            "limits": {
                "axes": [name for name, _ in AXES],
                "ratings": [*rating[:3], *(from_si(torque, "n_mm") for torque in rating[3:])],
                "soft": limits.soft_fraction,
                "hard": limits.hard_fraction,
                "box": [[from_si(value, "mm") for value in pair] for pair in box],
            },
        }

    def images(self) -> dict[str, int]:
        """Read the newest image of each camera that is shown; return their rows."""
        for name, picture in self.pictures.items():
            picture.look(self._latest[name].read())
        return {name: picture.row for name, picture in self.pictures.items()}

    def new_pictures(self, sent: Counter[str]) -> Iterator[bytes]:
        """Yield the number of a picture, as a byte, and its JPEG, if it is new to a client.

        These are the first camera, and one of the others in turn, so that the data sent in one
        period do not grow with the number of cameras.
        """
        sent["turn"] += 1
        first, *others = [*self.pictures] or [""]
        for name in (first, *others[sent["turn"] % max(len(others), 1) :][:1]):
            picture = self.pictures.get(name)
            if picture and picture.jpeg is not None and picture.row + 1 != sent[f"image {name}"]:
                sent[f"image {name}"] = picture.row + 1
                yield bytes([list(self.kinds).index(name)]) + picture.jpeg

    def close(self) -> None:
        """Release all records; may be called twice."""
        for record in (*self._latest.values(), *self._counters.values()):
            record.close()
