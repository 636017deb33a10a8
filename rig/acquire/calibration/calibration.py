"""Calibration of a sensor on its bench, and its application to a session."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from recorder import Session, SessionError, Stream
from rig.bench.bench import Bench
from rig.core.errors import ConfigError
from rig.core.geometry import compose, invert, transform


@dataclass(frozen=True, slots=True)
class HomeCalibration:
    """Height of the undeformed surface along z of the bench file's contact frame."""

    date_utc: str
    """Time of the measurement, ISO 8601."""
    method: str
    """Method of the measurement."""
    mock: bool
    """True if measured on a mock bench."""
    bench_sha256: str
    """Hash of the bench's content as read."""
    contact_frame: tuple[float, ...] = field(metadata={"pose": True})
    """Contact frame (6,) during the measurement, base frame [m, rad]."""
    tcp: tuple[float, ...] = field(metadata={"pose": True})
    """Tool centre point (6,) during the measurement [m, rad]."""
    shift: float = field(metadata={"unit": "mm"})
    """Height of the surface above the origin of that frame [m]."""
    interval: tuple[float, float] = field(metadata={"unit": "mm"})
    """95 % interval of the shift [m]."""
    contacts: tuple[float, ...] = field(metadata={"unit": "mm"})
    """Contact heights of the single approaches [m]."""


@dataclass(frozen=True, slots=True)
class FirstPressRecord:
    """First press of a sensor with an indenter, on a bench without a gauge."""

    date_utc: str
    """Time of the press, ISO 8601."""
    mock: bool
    """True if made on a mock bench."""
    tcp: tuple[float, ...] = field(metadata={"pose": True})
    """Tool centre point (6,) of the press [m, rad]."""
    depth: float = field(metadata={"unit": "mm"})
    """Depth of the last press [m]."""
    signals: tuple[float, ...]
    """Largest signal in each press, from the air to the full depth [px or counts]."""


@dataclass(frozen=True, slots=True)
class LatencyCalibration:
    """Latency of a signal."""

    date_utc: str
    """Time of the measurement, ISO 8601."""
    method: str
    """Method of the measurement."""
    mock: bool
    """True if measured on a mock bench."""
    bench_sha256: str
    """Hash of the bench's content as read."""
    stream: str
    """The signal: `camera` or `taxels`."""
    device: str
    """Kind and address of the measured device."""
    latency: float = field(metadata={"unit": "ms"})
    """Time from the end of exposure to arrival, subtracted by the alignment [s]."""
    interval: tuple[float, float] = field(metadata={"unit": "ms"})
    """95 % interval of the latency [s]."""
    exposure: float = field(metadata={"unit": "ms"})
    """Exposure assumed in the computation and stored with it [s]."""
    gel_lead: float = field(metadata={"unit": "ms"})
    """Lead of the force over the indentation, already removed [s]."""
    ratio: float
    """Ratio of the highest to the second highest correlation peak."""
    taps: int
    """Number of taps in the measurement."""


@dataclass(frozen=True, slots=True)
class Calibration:
    """Calibration that applies to one session, and the acceptance of its bench."""

    home: HomeCalibration | None = None
    latency: LatencyCalibration | None = None
    file: str = ""
    """Name of the file it was loaded from."""
    acceptance: dict[str, Any] | None = None
    """Summary of the bench's acceptance report, see `rig.acquire.acceptance`; None: no report."""

    def applied(self, bench: Bench) -> Bench:
        """Return the bench with its contact frame moved to the measured surface."""
        return bench if self.home is None else at_surface(bench, self.home.shift)

    def attrs(self) -> dict[str, Any]:
        """Return the session's attribute `calibration`: SI units, empty without a calibration."""
        attrs: dict[str, Any] = {}
        for name, part in (("home", self.home), ("latency", self.latency)):
            if part is not None:
                attrs[name] = {**dataclasses.asdict(part), "file": self.file}
        if self.acceptance is not None:
            attrs["acceptance"] = self.acceptance
        return attrs

    def stream_attrs(self, name: str) -> dict[str, Any]:
        """Return the attributes to add to stream `name`: `latency`, `exposure` and their source."""
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
        """Return the lines printed before anything moves."""
        lines = []
        if self.acceptance is not None:
            lines.append(
                f"bench    {self.acceptance['result']}, {self.acceptance['date_utc']}, "
                f"{self.acceptance['report']}"
            )
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
    def from_attrs(cls, attrs: dict[str, Any]) -> Calibration:
        """Restore from the session attribute written by `attrs`; a resumed session keeps it."""
        parts: dict[str, Any] = {}
        file = ""
        build_part: type[Any]
        for name, build_part in (("home", HomeCalibration), ("latency", LatencyCalibration)):
            if name in attrs:
                stored = dict(attrs[name])
                file = str(stored.pop("file", ""))
                values: dict[str, Any] = {
                    k: tuple(v) if isinstance(v, list) else v for k, v in stored.items()
                }
                parts[name] = build_part(**values)
        return cls(**parts, file=file, acceptance=attrs.get("acceptance"))


def at_surface(bench: Bench, shift: float) -> Bench:
    """Return the bench with its contact frame `shift` [m] higher along z."""
    frame = compose(bench.contact_frame, (0.0, 0.0, shift, 0.0, 0.0, 0.0))
    return dataclasses.replace(bench, contact_frame=tuple(np.asarray(frame).tolist()))


def require_gauge(bench: Bench, what: str) -> None:
    """Reject a bench without an F/T sensor, for a command that measures with one."""
    if not bench.gauges:
        raise ConfigError(
            f"{what}: {bench.sensor} has no F/T sensor; allowed: a bench with force, or with a "
            "stream that has the role guard"
        )


def stream_of(session: Session, kind: str) -> Stream:
    """Return a session's first stream of a kind, such as `force` or `pose`."""
    name = session.first(kind)
    if name is None:
        raise SessionError(f"{session.name}: needs a {kind} stream")
    return session.streams[name]


def tip_heights(session: Session) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Return times (n,) [ns] and heights (n,) [m] of the tip in a session's contact frame."""
    pose = stream_of(session, "pose")
    frame = invert(session.attrs["contact_frame"])
    return pose.t_ns, transform(frame, np.asarray(pose.array("value"))[:, :3])[:, 2]
