"""Settings of a bench, read from YAML: devices and addresses, sensor, limits and plan.

A `BenchStream` is the stream of one of its devices: driver, columns on disk, newest sample.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike

from recorder.command_line.extras import extra_of
from recorder.errors import SessionError
from recorder.spec import (
    Column,
    StreamSpec,
    Traits,
    arm_wrench_spec,
    camera_spec,
    check_streams,
    force_spec,
    gripper_spec,
    pose_spec,
    signal_of,
    taxels_spec,
)
from rig.bench.expected import ExpectedForce, Skin, expected_force
from rig.bench.indenter import find_indenter, paper_indenters
from rig.bench.worlds import WorldSpec
from rig.core.clock import Clock
from rig.core.config import READER as PLAIN_READER
from rig.core.config import from_si, read_yaml
from rig.core.driver import Driver
from rig.core.errors import ConfigError
from rig.core.geometry import Array, compose, invert, matrix_from_vector
from rig.core.names import plain_name, unknown_name
from rig.core.packaged import BENCHES
from rig.core.samples import latest_dtype
from rig.core.stream_settings import StreamSettings
from rig.devices import registry
from rig.devices.arm.settings import ArmConfig
from rig.devices.camera.settings import CameraSettings
from rig.devices.force.settings import ForceSettings
from rig.devices.gripper.settings import RobotiqConfig
from rig.devices.hid.settings import PedalConfig, SpaceMouseConfig
from rig.devices.taxels.settings import TaxelSettings
from trajectories import (
    DryRun,
    ForceDepth,
    Limits,
    Plan,
    Point,
    PressShear,
    Target,
    dry_run,
    move_duration,
)

# Least cosine between the tool's axis and the direction into the sensor.
_POINTS_INTO_SENSOR = 0.7
# Distances from an arm's base that some UR arm can reach [mm].
REACH_MM = (50.0, 2000.0)
# Value of `force` in the file of a bench without a gauge.
NO_GAUGE = "none"
# Folder of a lab's bench files.
BENCHES_FOLDER = Path("benches")
# Placeholder for the address that the emulators are started on.
LOOPBACK = "loopback"
# Placeholder for the folder where emulators of serial devices put links to their ptys.
RUN_FOLDER = "runfolder"
# Reads a field of a family of devices as the one that the file names by its `kind`.
READER = replace(
    PLAIN_READER,
    families={
        ForceSettings: partial(registry.settings_of, stream="force"),
        CameraSettings: partial(registry.settings_of, stream="camera"),
        TaxelSettings: partial(registry.settings_of, stream="taxels"),
        StreamSettings: partial(registry.settings_of, stream=None),
    },
)
# Most targets of a plan. More are a mistake in a unit: they would take days to press.
MOST_TARGETS = 20_000


@dataclass(frozen=True, slots=True)
class BenchLimits(Limits):
    """Limits of sensor, gauge and lab."""

    force_rating: tuple[float, float, float] = field(
        metadata={"unit": "n", "plausible": (0.05, 2000)}
    )
    """Rated force per axis of the weaker of sensor and gauge [N]."""
    torque_rating: tuple[float, float, float] = field(
        metadata={"unit": "n_mm", "plausible": (1, 200000)}
    )
    """Rated torque per axis [N m]."""
    sensor_rating: float | None = field(
        default=None, metadata={"unit": "n", "plausible": (0.05, 2000)}
    )
    """Largest force that the sensor itself withstands [N], in any direction; required on a bench
    without a gauge."""
    soft_fraction: float = 0.85
    """Fraction of the rating that ends a target as force_limited."""
    hard_fraction: float = 1.0
    """Fraction of the rating that stops the session."""
    horizon: float = field(default=0.02, metadata={"unit": "ms", "plausible": (0.5, 1000)})
    """Extrapolation time of the guard's force prediction [s]."""
    stale_force: float = field(default=0.05, metadata={"unit": "ms", "plausible": (2, 5000)})
    """Age of the newest force sample that stops the session [s]."""
    stale_pose: float = field(default=0.1, metadata={"unit": "ms", "plausible": (2, 5000)})
    """Age of the newest pose sample that stops the session [s]."""


@dataclass(frozen=True, slots=True)
class StandIns:
    """Limits of the guards that stand in for a force gauge, as far as they depend on the sensor."""

    signal_max: float = field(metadata={"plausible": (0.05, 70000)})
    """Largest motion of a marker [px], or deviation of a taxel [counts], from no contact."""
    stale_signal: float = field(default=0.2, metadata={"unit": "ms", "plausible": (5, 5000)})
    """Longest time without a sample of the signal that differs from the one before [s]."""

    def __post_init__(self) -> None:
        """Reject a limit that bounds nothing."""
        if not self.signal_max > 0:
            raise ValueError(f"signal_max: {self.signal_max!r}; allowed: above 0")


@dataclass(frozen=True, slots=True)
class Preflight:
    """Durations and tolerances of the checks before recording."""

    rate_window: float = 1.0
    """Time over which rates are measured [s]."""
    rate_tolerance: float = 0.15
    """Relative deviation from the expected rate that fails the preflight."""
    tare_window: float = 0.5
    """Time over which the tare is averaged [s]."""
    tare_spread: float = field(default=0.1, metadata={"unit": "n", "plausible": (0.0005, 50)})
    """Largest standard deviation of a force axis over the tare [N]."""
    point_window: float = 0.25
    """Time over which the reference of a contact point is averaged [s]."""
    contact_free: float = field(default=0.3, metadata={"unit": "n", "plausible": (0.0005, 50)})
    """Largest tared force above a contact point; more means there is contact [N]."""
    timeout: float = 5.0
    """Longest time for a device to answer [s]."""


# Streams: their drivers, columns on disk, and records of the newest sample.


# Functions of a rate [Hz] that return the storage of a stream, by the names of
# `recorder.spec.KINDS`. A driver may return more columns than are stored, for the guard.
SPECS: dict[str, Callable[..., StreamSpec]] = {
    "force": force_spec,
    "pose": pose_spec,
    "arm_wrench": arm_wrench_spec,
    "camera": camera_spec,
    "taxels": taxels_spec,
    "gripper": gripper_spec,
}
# Kinds of streams of whose values a mean is meaningful (a tare, a reference).
AVERAGED = ("force", "arm_wrench", "taxels")

_READING = Column(
    "reading", "float64", units="N", description="Fz as read, also while it has not settled"
)


@dataclass(frozen=True, slots=True)
class BenchStream:
    """One stream of a bench."""

    name: str
    """Name of the stream, on disk and on screen."""
    config: Any
    """Settings of its device."""
    listed: bool = False
    """True if the bench file has it under `streams`."""

    @property
    def key(self) -> str:
        """Key of the device in the bench file, for errors."""
        return f"streams.{self.name}" if self.listed else self.name

    @property
    def kind(self) -> str:
        """Kind of the stream: camera, force, pose, taxels or arm_wrench."""
        return str(self.config.STREAM)

    @property
    def rate_hz(self) -> float:
        """Rate that the bench file states [Hz]."""
        return float(self.config.rate_hz)

    @property
    def settling(self) -> float:
        """Time in which its readings settle [s]; 0 for a device without this."""
        return float(getattr(self.config, "hold", 0.0))

    @property
    def shape(self) -> dict[str, int]:
        """Number of taxels and of their axes of a stream of taxels, for its storage."""
        if self.kind != "taxels":
            return {}
        rows, columns, axes = self.config.shape
        return {"taxels": rows * columns, "axes": axes}

    @property
    def uses(self) -> dict[str, Any]:
        """Alignment and roles where the bench file states them, as attributes of the stream."""
        stated = {key: getattr(self.config, key, None) for key in ("align", "roles")}
        return {key: value for key, value in stated.items() if value is not None}

    @property
    def traits(self) -> Traits:
        """Kind, alignment and roles, as they are stored."""
        return self.empty_spec().traits

    @property
    def latest(self) -> np.dtype[Any]:
        """Dtype of its newest sample in shared memory."""
        return latest_dtype(self.kind, tuple(self.shape.values()))

    def empty_spec(self) -> StreamSpec:
        """Return its storage as far as it is known before its device is open."""
        return SPECS[self.kind](self.rate_hz, name=self.name, **self.shape, **self.uses)

    def spec(self, description: dict[str, Any], rate_hz: float, **attrs: Any) -> StreamSpec:
        """Return its storage, with `Driver.describe()` of its opened driver and further attrs."""
        attrs = {**self.uses, **attrs}
        if self.kind == "force":
            counted = "none" if description.get("device_clock") == "none" else "counter"
            attrs = {"clock": counted, **attrs}
        elif self.kind == "camera":
            attrs = {
                "height": description["height"],
                "width": description["width"],
                "codec": "jpeg" if description["jpeg_bytes_kept"] else "zstd",
                "numbered": description.get("numbering") == "device",
                "device_clock": description.get("device_clock", "none"),
                **self.config.attrs(description),
                **attrs,
            }
        make = SPECS[self.kind]
        spec = make(rate_hz, name=self.name, device=description, **self.shape, **attrs)
        if description.get("settles"):
            # Readings that have not settled are no values of the force, but are kept beside them.
            spec = replace(spec, columns=(*spec.columns[:-1], _READING, spec.columns[-1]))
        return spec

    def driver(self, clock: Clock) -> Driver:
        """Create its driver, whose vendor library is imported only here."""
        device = registry.device(self.config.KIND)
        try:
            return device.make_driver(self.config, clock)
        except ImportError as error:
            extra = extra_of(error.name or "", "rig") or "rig"
            cure = f"install the extra: pip install 'tactile-rig[{extra}]'"
            if device.kind not in registry.DEVICES:
                cure = f"the device {device.kind} of another package needs it"
            raise ConfigError(f"{self.name}: {error.name} is not installed; {cure}") from None


class StreamBench:
    """Streams of a bench, as their processes and the checks before recording need them."""

    __slots__ = ()
    preflight: Preflight

    @property
    def rows(self) -> tuple[BenchStream, ...]:
        """All streams, in the order in which they are shown and stored."""
        raise NotImplementedError

    def row(self, name: str) -> BenchStream:
        """Return the stream of a name."""
        for row in self.rows:
            if row.name == name:
                return row
        raise unknown_name("stream", name, [row.name for row in self.rows])

    def of_kind(self, kind: str) -> tuple[BenchStream, ...]:
        """Return the streams of a kind, in order."""
        return tuple(row for row in self.rows if row.kind == kind)

    @property
    def signal(self) -> BenchStream | None:
        """Stream that the others are aligned to; None on a bench without a sensor."""
        name = signal_of([(row.name, row.traits) for row in self.rows])
        return None if name is None else self.row(name)

    @property
    def no_gauge(self) -> bool:
        """True if the signal of its sensor guards an arm in place of an F/T sensor."""
        return False


@dataclass(frozen=True, slots=True)
class Bench(StreamBench):
    """Complete settings of a bench."""

    sensor: str
    """Name of the sensor, of its bench file and in session names."""
    description: str
    mock: bool
    """True if the devices are emulators; written into every session."""
    rate_hz: float
    """Rate of the synchronised view."""
    contact_frame: tuple[float, ...] = field(metadata={"pose": True, "plausible": REACH_MM})
    """Pose (6,) of the contact frame in the base frame [m, rad]."""
    tool_rotation: tuple[float, float, float] = field(metadata={"unit": "deg"})
    """Orientation of the TCP in the contact frame, rotation vector [rad]."""
    arm: ArmConfig
    force: ForceSettings | Literal["none"] | None = field(default=None, kw_only=True)
    """The F/T sensor; `none`: there is no gauge, and other guards stand in (`stand_ins`). Only a
    mock bench may leave it out."""
    limits: BenchLimits
    trajectory: PressShear | ForceDepth
    preflight: Preflight = Preflight()
    approach: float = field(default=0.003, metadata={"unit": "mm", "plausible": (0.05, 100)})
    """Height above the surface at which the tip slows down to contact speed [m]."""
    indenter: str = "cylinder"
    """Name of the indenter on the arm."""
    camera: CameraSettings | None = None
    taxels: TaxelSettings | None = None
    streams: dict[str, StreamSettings] | None = None
    """Further streams by name, each a device with its `kind`; `force`, `camera` and `taxels` are
    streams with the names of their keys, and the arm's poses are the stream `pose`."""
    hold: float = field(default=0.0, metadata={"unit": "ms", "plausible": (10, 600_000)})
    """Time at rest after each recorded move that ends in contact [s]: for gauges that settle."""
    control_press: bool = True
    """True: each collection ends with one of its deepest presses again, to compare both."""
    skin: Skin | None = None
    """Skin of the sensor, of which forces are expected before a session."""
    stand_ins: StandIns | None = None
    """Limits of the guards that stand in for an F/T sensor with `force: none`; otherwise unused."""
    gripper: RobotiqConfig | None = None
    """Holds the indenter; watched while the arm moves."""
    pedal: PedalConfig | None = None
    jog: SpaceMouseConfig | None = None
    """SpaceMouse for moving the arm by hand; only for `tactile jog`."""
    force_depth: ForceDepth | None = None
    """The press that `force-depth` records; None if the sensor has none."""
    world: WorldSpec | None = None
    """Sensor and contact of a mock bench; None on a lab bench."""
    world_frame: tuple[float, ...] | None = field(
        default=None, metadata={"pose": True, "plausible": REACH_MM}
    )
    """True pose (6,) of a mock's surface in the base frame [m, rad]; None: at contact_frame."""

    def __post_init__(self) -> None:
        """Reject contradictions, such as two streams of one name, or an unguarded lab bench."""
        _check_streams(self.rows)
        if self.no_gauge:
            _check_no_gauge(self)
        for row in self.of_kind("force"):
            if self.hold < row.settling:
                raise ValueError(
                    f"hold_ms: {1e3 * self.hold:g}; allowed with {row.key}: at least "
                    f"{1e3 * row.settling:.0f}, in which its readings settle"
                )
        if not self.no_gauge and not self.mock and not self.gauges:
            raise ValueError(
                "force: missing; allowed on a lab bench: an F/T sensor with the role guard, which "
                "stops the arm at limits.force_rating; or none, with limits.sensor_rating_n and "
                "stand_ins"
            )
        if self.mock != (self.world is not None):
            raise ValueError(
                f"mock: {self.mock} with world {'given' if self.world else 'missing'}; "
                "allowed: true with a world, false without one"
            )
        if not self.rate_hz > 0:
            raise ValueError(f"rate_hz: {self.rate_hz!r}; allowed: above 0")
        for name, plan in (("trajectory", self.trajectory), ("force_depth", self.force_depth)):
            if plan is not None and len(plan) > MOST_TARGETS:
                depths = f" at {plan.depth_count} depths" if isinstance(plan, PressShear) else ""
                raise ValueError(
                    f"{name}: found {len(plan)} targets{depths}; allowed: up to {MOST_TARGETS}"
                )

    @property
    def no_gauge(self) -> bool:
        """True if the bench file says that there is no F/T sensor."""
        return self.force == NO_GAUGE

    @property
    def without_gauge(self) -> tuple[StandIns, BenchStream, float]:
        """Limits of guards, signal and rating of the sensor [N] of a bench without a gauge."""
        stand_ins, signal, rating = self.stand_ins, self.signal, self.limits.sensor_rating
        if stand_ins is None or signal is None or rating is None:
            raise ConfigError(f"{self.sensor}.force: has a gauge; allowed: none")
        return stand_ins, signal, rating

    @property
    def rows(self) -> tuple[BenchStream, ...]:
        """All streams, in the order in which they are shown and stored."""
        named = (
            ("force", None if self.no_gauge else self.force),
            ("pose", self.arm),
            ("camera", self.camera),
            ("taxels", self.taxels),
        )
        single = [BenchStream(name, config) for name, config in named if config is not None]
        more = [
            BenchStream(name, config, listed=True) for name, config in (self.streams or {}).items()
        ]
        return (*single, *more)

    def tool_pose(self, tip: Point) -> Array:
        """Return the pose (6,) of the upright tool in the base frame, its tip at a place [m, rad].

        The place is one of the contact frame [m].
        """
        return compose(self.contact_frame, (*tip, *self.tool_rotation))

    def tip(self, pose: ArrayLike) -> Point:
        """Return the place of the tip in the contact frame [m], of a TCP pose (6,) in the base."""
        x, y, z = compose(invert(self.contact_frame), pose)[:3].tolist()
        return (x, y, z)

    @property
    def dome_radius(self) -> float | None:
        """Radius of the sensor's spherical top [m], as its plan states it; None: flat."""
        return getattr(self.trajectory, "dome_radius", None)

    @property
    def expected(self) -> ExpectedForce:
        """Force of the indenter on the arm, by depth."""
        skin = self.skin
        if self.world is not None:
            skin = (
                Skin(self.world.sensor) if skin is None else replace(skin, sensor=self.world.sensor)
            )
        if skin is None:
            raise ConfigError(
                f"{self.sensor}.skin: missing; allowed: sensor, a row of the simulator or a YAML "
                "file like one, and modulus_kpa, the lowest and the highest"
            )
        return expected_force(skin, self.indenter, exact=self.mock)

    def dry_run(self, plan: Plan) -> DryRun:
        """Return a dry run of a plan with the arm's speed, against the limits of the bench."""
        arm, dome = self.arm, self.dome_radius
        speeds = {"speed": arm.speed, "acceleration": arm.acceleration}
        return dry_run(plan, self.limits, **speeds, dome_radius=dome)

    def seconds(self, plan: Plan) -> list[float]:
        """Return the predicted duration of each target [s], with holds, travel and references."""
        arm = self.arm
        seconds: list[float] = []
        before: Target | None = None
        for target in plan.targets():
            moves = plan.moves(target)
            took = 3 * self.hold + len(moves) * arm.settle
            for move in moves:
                length = math.dist(move.start, move.end)
                took += move_duration(length, arm.speed, arm.acceleration)
            if before is None or before.point != target.point:
                took += self.preflight.point_window
                across = 0.0 if before is None else math.dist(before.origin[:2], target.origin[:2])
                for length in (arm.retract, across, arm.retract):
                    took += move_duration(length, arm.travel_speed, arm.travel_acceleration)
            seconds.append(took)
            before = target
        return seconds

    def check_limits(self, plan: Plan) -> DryRun:
        """Return the dry run of a plan, which must break no limit of the bench."""
        walked = self.dry_run(plan)
        if walked.broken:
            raise ConfigError(f"{self.sensor}: the plan breaks a limit: {'; '.join(walked.broken)}")
        return walked

    @property
    def force_rating(self) -> tuple[float, ...]:
        """Largest load per axis (6,) in the F/T frame [N, N m].

        It is the lowest of the bench's `force_rating` and `torque_rating`, of what each gauge is
        rated for, and of the sensor's own rating, which holds for a force of any direction.
        """
        limits = self.limits
        sensor = math.inf if limits.sensor_rating is None else limits.sensor_rating
        ratings = [(*limits.force_rating, *limits.torque_rating), (*[sensor] * 3, *[math.inf] * 3)]
        ratings += [gauge.config.rated for gauge in self.gauges if gauge.config.rated]
        return tuple(map(min, zip(*ratings, strict=True)))

    @property
    def gauges(self) -> tuple[BenchStream, ...]:
        """F/T sensors that stop the arm at the bench's limits, in order."""
        return tuple(row for row in self.of_kind("force") if "guard" in row.traits.roles)


def _check_no_gauge(bench: Bench) -> None:
    """Reject a bench without a gauge that lacks what stands in for one, or that has a gauge."""
    if bench.gauges:
        names = ", ".join(gauge.name for gauge in bench.gauges)
        raise ValueError(
            f"force: none, but {names} has the role guard; allowed: force: none without an F/T "
            "sensor that guards"
        )
    if bench.limits.sensor_rating is None:
        raise ValueError(
            "limits.sensor_rating_n: missing; allowed with force: none: the largest force that the "
            "sensor withstands"
        )
    if bench.stand_ins is None:
        raise ValueError("stand_ins: missing; allowed with force: none: signal_max of the sensor")
    if bench.signal is None or bench.signal.kind not in ("camera", "taxels"):
        raise ValueError(
            "force: none, but the bench has no camera or taxels with the role signal; allowed: "
            "force: none with a signal, which stops the arm"
        )


def _check_streams(rows: Sequence[BenchStream]) -> None:
    """Reject names and uses that a session could not store."""
    single = {row.name for row in rows if not row.listed}
    for row in rows:
        if row.listed and row.name in single:
            raise ValueError(f"{row.key}: found twice: the bench has a stream {row.name} already")
        roles = row.uses.get("roles", ())
        if row.kind not in ("force", "arm_wrench") and "guard" in roles:
            raise ValueError(f"{row.key}.roles: found guard; allowed for F/T sensors only")
        if row.kind == "arm_wrench" and set(roles) - {"guard"}:
            raise ValueError(
                f"{row.key}.roles: found {', '.join(roles)}; allowed: guard; the arm's own wrench "
                "is too inaccurate for a label"
            )
    try:
        check_streams([row.empty_spec() for row in rows])
    except SessionError as error:
        raise ValueError(f"streams: {error}") from None


def find_bench(sensor: str, folder: Path = BENCHES_FOLDER, where: str = "--sensor") -> Path:
    """Return the lab's bench file of `sensor` if it exists, else the mock bench's.

    Searched are `lab/` in the folder, the folder itself, and the packaged mock benches. Errors name
    `where` the name was given.
    """
    name = f"{plain_name(where, sensor)}.yaml"
    for path in (folder / "lab" / name, folder / name, BENCHES / name):
        if path.exists():
            return path
    folders = (folder / "lab", folder, BENCHES)
    sensors = {path.stem for searched in folders for path in searched.glob("*.yaml")} - {"mock"}
    raise unknown_name(where, sensor, sensors, f"in {folder}/ or packaged")


def with_simulated_world(content: dict[str, Any], where: str) -> dict[str, Any]:
    """Return `content` with a `world` that is solved along the arm's path."""
    if not isinstance(content.get("world"), dict):
        raise ConfigError(f"{where}.world: missing; allowed with --world sim: a mock bench")
    return {**content, "world": {**content["world"], "tier": "layer"}}


def bench_from(content: dict[str, Any], where: str) -> Bench:
    """Build a bench from a mapping as read from YAML."""
    bench = READER.build(Bench, content, where)
    plain_name(f"{where}.sensor", bench.sensor)
    plain_name(f"{where}.indenter", bench.indenter)
    if float(matrix_from_vector(bench.tool_rotation)[2, 2]) > -_POINTS_INTO_SENSOR:
        degrees = [round(from_si(angle, "deg"), 4) for angle in bench.tool_rotation]
        raise ConfigError(
            f"{where}.tool_rotation_deg: found {degrees}, which does not point the tool into the "
            "sensor; allowed: within 45 deg of [180, 0, 0]"
        )
    return bench


@dataclass(frozen=True, slots=True)
class BenchFile:
    """A bench file, and the bench that is built of its content, once."""

    path: Path
    content: dict[str, Any]
    """Content as it is used; stored in every session."""
    bench: Bench

    @classmethod
    def of(cls, content: dict[str, Any], path: Path) -> BenchFile:
        """Build the bench of a content as read from YAML."""
        if "fingers" in content:
            raise ConfigError(
                f"{path}: a bench with a hand; allowed: tactile collect without --resume, and "
                "tactile replay of its sessions"
            )
        return cls(path, content, bench_from(content, str(path)))

    @classmethod
    def read(cls, path: Path) -> BenchFile:
        """Read a bench file; its `extends` may name a packaged bench as one in `benches/`."""
        return cls.of(read_content(path), path)

    def with_indenter(self, name: str) -> BenchFile:
        """Return the file with an indenter on the arm; an empty name: the file's own."""
        indenter = find_indenter(name or self.bench.indenter)
        own = indenter.source is not None
        if own and indenter.stl is None and self.bench.mock:
            raise ConfigError(
                f"{indenter.source}.stl: missing; allowed on a mock bench: an STL file, or one of "
                f"the paper's indenters: {', '.join(paper_indenters())}"
            )
        content = {**self.content, "indenter": indenter.name}
        return BenchFile(self.path, content, replace(self.bench, indenter=indenter.name))

    def at(self, host: str, folder: Path) -> BenchFile:
        """Return a mock bench's file with host and run folder of its emulators filled in."""
        return BenchFile.of(filled(self.content, host, folder), self.path)


def filled(value: Any, host: str, folder: Path) -> Any:
    """Return a content with host and run folder of emulators in place of their placeholders."""
    if isinstance(value, str):
        return value.replace(LOOPBACK, host).replace(RUN_FOLDER, str(folder))
    if isinstance(value, dict):
        return {key: filled(item, host, folder) for key, item in value.items()}
    if isinstance(value, list):
        return [filled(item, host, folder) for item in value]
    return value


def read_content(path: Path) -> dict[str, Any]:
    """Return the content of a bench file, with what it `extends`."""
    return read_yaml(path, BENCHES)
