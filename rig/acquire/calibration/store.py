"""Calibrations on disk: `calibrations/<sensor>.yaml`, mm and ms under keys with the unit.

`home` holds the height of the surface for each indenter, `latency` the lag of a signal. A session
applies, prints and stores its calibration; one that belongs to another bench is rejected.
"""

import dataclasses
import hashlib
import json
import math
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from recorder.command_line.options import next_command
from recorder.errors import SessionError
from recorder.session import Session, Stream
from recorder.settings import describe, yaml_text
from recorder.store import replace_file
from rig.bench.bench import Bench
from rig.core.clock import ClockAnchor
from rig.core.config import READER, build, from_si, read_yaml
from rig.core.errors import ConfigError
from rig.core.geometry import compose, invert, transform

# Time in which an arm answers a force unless it was measured [s]: a busy computer's. An idle one
# takes about 20 ms.
REACTION = 0.1


@dataclass(frozen=True, slots=True)
class Measurement:
    """Statement of every calibration about its measurement."""

    date_utc: str
    """Time of the measurement, ISO 8601."""
    method: str
    """Method of the measurement."""
    mock: bool
    """True if measured on a mock bench."""
    bench_sha256: str
    """Hash of the bench's content as read."""


@dataclass(frozen=True, slots=True)
class HomeCalibration(Measurement):
    """Height of the undeformed surface along z of the bench file's contact frame."""

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
class LatencyCalibration(Measurement):
    """Latency of a signal."""

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
    reaction: float = field(default=REACTION, metadata={"unit": "ms"})
    """Longest time from a force to the arm's answer in the taps [s]."""


@dataclass(frozen=True, slots=True)
class Calibration:
    """Calibration that applies to one session, and the acceptance of its bench."""

    home: HomeCalibration | None = None
    latency: LatencyCalibration | None = None
    file: str = ""
    """Name of the file it was loaded from."""
    acceptance: dict[str, Any] | None = None
    """Summary of the bench's acceptance report, see `rig.acquire.acceptance`; None: no report."""

    @property
    def reaction(self) -> float:
        """Time in which the arm answers a force [s], measured or assumed."""
        return REACTION if self.latency is None else self.latency.reaction

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
        latency = self.latency
        if latency is None or latency.stream != name:
            return {}
        return {
            "latency": latency.latency,
            "exposure": latency.exposure,
            "latency_calibration": {
                "date_utc": latency.date_utc,
                "method": latency.method,
                "interval_s": list(latency.interval),
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
    def from_attrs(cls, attrs: dict[str, Any]) -> Self:
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


# Folder of the calibration files.
FOLDER = Path("calibrations")
# Ending of the name of a set-up's file, after that of the sensor.
SETUP = ".setup.json"
# An older calibration is used with a warning.
STALE_DAYS = 7.0
_NOTE = "# Measured, not written by hand: tactile home, tactile calibrate-latency.\n"
# Frames that differ by less are the same [m, rad]: YAML keeps mm to nine digits.
_SAME_PLACE, _SAME_ANGLE = 1e-6, 1e-6


def bench_hash(content: dict[str, Any]) -> str:
    """Return the SHA-256 of a bench's content as read, independent of the order of its keys."""
    return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()


def device_name(bench: Bench, stream: str) -> str:
    """Return the kind and address of the device behind a signal."""
    config = bench.row(stream).config
    return f"{config.KIND} {config.address}"


def load(folder: Path, bench: Bench, indenter: str) -> tuple[Calibration, list[str]]:
    """Load the calibration of a bench as in its file, with an indenter, and warnings about it."""
    path = folder / f"{bench.sensor}.yaml"
    acceptance = acceptance_of(folder, bench)
    if not path.exists():
        return Calibration(acceptance=acceptance), []
    content = read_yaml(path)
    again = "measure again, or remove the file"
    if content.get("sensor") != bench.sensor:
        raise ConfigError(
            f"{path}.sensor: found {content.get('sensor')!r}; allowed: {bench.sensor!r}; {again}"
        )
    parts = ("first_press", "home", "latency", "sensor")
    if unknown := sorted(set(content) - set(parts)):
        raise ConfigError(f"{path}: unknown {', '.join(unknown)}; known: {', '.join(parts)}")
    homes = content.get("home") or {}
    if not isinstance(homes, dict):
        raise ConfigError(f"{path}.home: found {describe(homes)}; allowed: a mapping by indenter")
    warnings: list[str] = []
    home = latency = None
    if indenter in homes:
        home = build(HomeCalibration, homes[indenter], f"{path}.home.{indenter}")
        _refuse_foreign(home.mock, bench, f"{path}.home.{indenter}")
        for name, stored, wanted in (
            ("contact_frame", home.contact_frame, bench.contact_frame),
            ("tcp", home.tcp, bench.arm.tcp),
        ):
            if not _same(stored, wanted):
                raise ConfigError(
                    f"{path}.home.{indenter}.{name}: it was measured with another {name} than the "
                    f"bench file's; {again} ({next_command('home', sensor=bench.sensor)})"
                )
        _warn_stale(warnings, home.date_utc, f"{path}.home.{indenter}")
    elif homes:
        warnings.append(
            f"{path}.home: known for {', '.join(sorted(homes))}, not for {indenter}: the bench "
            "file's contact frame is used ("
            f"{next_command('home', sensor=bench.sensor, indenter=indenter)})"
        )
    if content.get("latency"):
        latency = build(LatencyCalibration, content["latency"], f"{path}.latency")
        _refuse_foreign(latency.mock, bench, f"{path}.latency")
        streams = {row.name for row in bench.rows}
        if latency.stream not in streams or latency.device != device_name(bench, latency.stream):
            raise ConfigError(
                f"{path}.latency.device: found {latency.device!r}; the bench file has another "
                f"{latency.stream}; {again} ("
                f"{next_command('calibrate-latency', sensor=bench.sensor)})"
            )
        _warn_stale(warnings, latency.date_utc, f"{path}.latency")
    return Calibration(home, latency, str(path), acceptance), warnings


def setup_path(folder: Path, sensor: str) -> Path:
    """Return the file of `tactile setup`, with its answers and findings."""
    return folder / f"{sensor}{SETUP}"


def report_path(folder: Path, sensor: str) -> Path:
    """Return the file of the acceptance report."""
    return folder / f"{sensor}.acceptance.html"


def acceptance_of(folder: Path, bench: Bench) -> dict[str, Any] | None:
    """Return the summary of a bench's acceptance report; None if it was not set up to the end."""
    return read_setup(folder, bench).get("acceptance")


def read_setup(folder: Path, bench: Bench) -> dict[str, Any]:
    """Return the stored set-up of a bench; empty without one, or if it is of the other kind."""
    path = setup_path(folder, bench.sensor)
    try:
        setup: dict[str, Any] = json.loads(path.read_text()) if path.exists() else {}
        if not isinstance(setup, dict):
            raise ValueError("found no mapping")
    except (OSError, ValueError) as error:
        raise ConfigError(f"{path}: {error}; remove the file, and set up again") from None
    return setup if setup.get("mock") == bench.mock else {}


def pressed_before(folder: Path, bench: Bench, indenter: str, depth: float) -> bool:
    """Return True if a sensor was pressed in steps with this indenter and TCP to this depth [m]."""
    path = folder / f"{bench.sensor}.yaml"
    content = read_yaml(path) if path.exists() else {}
    entry = (content.get("first_press") or {}).get(indenter)
    if entry is None:
        return False
    press = build(FirstPressRecord, entry, f"{path}.first_press.{indenter}")
    deep_enough = press.depth > depth - _SAME_PLACE
    return deep_enough and press.mock == bench.mock and _same(press.tcp, bench.arm.tcp)


def store(
    folder: Path,
    sensor: str,
    *,
    home: dict[str, HomeCalibration] | None = None,
    latency: LatencyCalibration | None = None,
    first_press: dict[str, FirstPressRecord] | None = None,
) -> Path:
    """Add to a sensor's calibration file, atomically; other entries stay."""
    path = folder / f"{sensor}.yaml"
    content: dict[str, Any] = read_yaml(path) if path.exists() else {"sensor": sensor}
    if content.get("sensor") != sensor:
        raise ConfigError(
            f"{path}.sensor: found {content.get('sensor')!r}; allowed: {sensor!r}; remove the file"
        )
    for indenter, calibration in (home or {}).items():
        content.setdefault("home", {})[indenter] = _plain(calibration)
    for indenter, press in (first_press or {}).items():
        content.setdefault("first_press", {})[indenter] = _plain(press)
    if latency is not None:
        content["latency"] = _plain(latency)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        replace_file(path, (_NOTE + yaml_text(content)).encode())
    except OSError as error:
        raise ConfigError(f"{path}: cannot be written ({error})") from error
    return path


def now_utc() -> str:
    """Return the current UTC, ISO 8601 to the second."""
    return f"{np.datetime64(ClockAnchor.take().utc_ns, 'ns').astype('datetime64[s]')}Z"


def _plain(spec: Any) -> dict[str, Any]:
    """Convert a calibration for YAML: mm, deg, ms under keys with the unit."""
    out: dict[str, Any] = {}
    for item in dataclasses.fields(spec):
        value, unit = getattr(spec, item.name), item.metadata.get("unit")
        key = READER.key_of(item)
        if item.metadata.get("pose"):
            position = [round(1e3 * number, 9) for number in value[:3]]
            rotation = [round(math.degrees(number), 9) for number in value[3:]]
            out[key] = {"position_mm": position, "rotation_deg": rotation}
        elif isinstance(value, tuple):
            out[key] = [round(from_si(n, unit), 9) if unit else n for n in value]
        else:
            out[key] = round(from_si(value, unit), 9) if unit else value
    return out


def _same(one: tuple[float, ...], other: tuple[float, ...]) -> bool:
    difference = np.abs(np.subtract(one, other))
    return bool((difference[:3] < _SAME_PLACE).all() and (difference[3:] < _SAME_ANGLE).all())


def _refuse_foreign(mock: bool, bench: Bench, where: str) -> None:
    if mock != bench.mock:
        kinds = {True: "a mock bench", False: "a lab bench"}
        raise ConfigError(
            f"{where}.mock: {mock}: measured on {kinds[mock]}, this is {kinds[bench.mock]}; "
            "measure again, or remove the file"
        )


def age_hours(date_utc: str, where: str = "home") -> float:
    """Return the age of a calibration [h]."""
    try:
        then = np.datetime64(date_utc.removesuffix("Z"), "s")
    except ValueError:
        raise ConfigError(f"{where}.date_utc: found {date_utc!r}; allowed: ISO 8601") from None
    now = np.datetime64(now_utc().removesuffix("Z"), "s")
    return float((now - then) / np.timedelta64(1, "h"))


def _warn_stale(warnings: list[str], date_utc: str, where: str) -> None:
    days = age_hours(date_utc, where) / 24
    if days > STALE_DAYS:
        warnings.append(f"{where}: {days:.0f} days old; after {STALE_DAYS:.0f} measure again")
