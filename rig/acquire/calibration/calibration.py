"""What was measured of a sensor on its bench, and how a session is recorded with it."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from rig.bench.bench import Bench
from rig.core.geometry import compose


@dataclass(frozen=True, slots=True)
class HomeCalibration:
    """Where the untouched surface lies along z of the bench file's contact frame."""

    date_utc: str
    """When it was measured, ISO 8601."""
    method: str
    """How."""
    mock: bool
    """Whether on a mock bench."""
    bench_sha256: str
    """Of the bench's content as read."""
    contact_frame: tuple[float, ...] = field(metadata={"pose": True})
    """Contact frame (6,) it was measured in, base frame [m, rad]."""
    tcp: tuple[float, ...] = field(metadata={"pose": True})
    """Tool centre point (6,) it was measured with [m, rad]."""
    shift: float = field(metadata={"unit": "mm"})
    """Surface above (positive) the origin of that frame [m]."""
    interval: tuple[float, float] = field(metadata={"unit": "mm"})
    """95 % interval of the shift [m]."""
    contacts: tuple[float, ...] = field(metadata={"unit": "mm"})
    """The single approaches [m]."""


@dataclass(frozen=True, slots=True)
class LatencyCalibration:
    """How late a signal is."""

    date_utc: str
    """When it was measured, ISO 8601."""
    method: str
    """How."""
    mock: bool
    """Whether on a mock bench."""
    bench_sha256: str
    """Of the bench's content as read."""
    stream: str
    """The signal: `camera` or `taxels`."""
    device: str
    """Kind and address of the device it was measured on."""
    latency: float = field(metadata={"unit": "ms"})
    """End of exposure to arrival: what alignment takes off [s]."""
    interval: tuple[float, float] = field(metadata={"unit": "ms"})
    """95 % interval of it [s]."""
    exposure: float = field(metadata={"unit": "ms"})
    """Exposure it was computed with, stored with it [s]."""
    gel_lead: float = field(metadata={"unit": "ms"})
    """How far the force ran ahead of the indentation, already taken out [s]."""
    ratio: float
    """Highest over second highest peak of the correlation."""
    taps: int
    """Taps it was measured from."""


@dataclass(frozen=True, slots=True)
class Calibration:
    """What one session is recorded with."""

    home: HomeCalibration | None = None
    latency: LatencyCalibration | None = None
    file: str = ""
    """Name of the file it came from."""

    def applied(self, bench: Bench) -> Bench:
        """The bench with its contact frame on the measured surface."""
        if self.home is None:
            return bench
        frame = compose(bench.contact_frame, (0.0, 0.0, self.home.shift, 0.0, 0.0, 0.0))
        return dataclasses.replace(bench, contact_frame=tuple(np.asarray(frame).tolist()))

    def facts(self) -> dict[str, Any]:
        """For the session's attribute `calibration`: SI, empty when there is none."""
        facts: dict[str, Any] = {}
        for name, part in (("home", self.home), ("latency", self.latency)):
            if part is not None:
                facts[name] = {**dataclasses.asdict(part), "file": self.file}
        return facts

    def stream_attrs(self, name: str) -> dict[str, Any]:
        """What the attributes of stream `name` gain: `latency`, `exposure` and where from."""
        found = self.latency
        if found is None or found.stream != name:
            return {}
        return {
            "latency": found.latency,
            "exposure": found.exposure,
            "latency_calibration": {
                "date_utc": found.date_utc,
                "method": found.method,
                "interval_s": list(found.interval),
            },
        }

    def lines(self) -> list[str]:
        """What is printed before anything moves."""
        lines = []
        if self.home is not None:
            low, high = (1e3 * value for value in self.home.interval)
            lines.append(
                f"home     surface {1e3 * self.home.shift:+.3f} mm of the bench file's "
                f"(95 % {low:+.3f} to {high:+.3f}), {self.home.date_utc}, {self.file}"
            )
        if self.latency is not None:
            low, high = (1e3 * value for value in self.latency.interval)
            lines.append(
                f"latency  {self.latency.stream} {1e3 * self.latency.latency:+.1f} ms "
                f"(95 % {low:+.1f} to {high:+.1f}), {self.latency.date_utc}, {self.file}"
            )
        return lines

    @classmethod
    def from_facts(cls, facts: dict[str, Any]) -> Calibration:
        """What `facts` wrote into a session: a resumed one goes on with what it began with."""
        parts: dict[str, Any] = {}
        file = ""
        build_part: type[Any]
        for name, build_part in (("home", HomeCalibration), ("latency", LatencyCalibration)):
            if name in facts:
                stored = dict(facts[name])
                file = str(stored.pop("file", ""))
                values: dict[str, Any] = {
                    k: tuple(v) if isinstance(v, list) else v for k, v in stored.items()
                }
                parts[name] = build_part(**values)
        return cls(**parts, file=file)
