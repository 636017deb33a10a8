"""Columns, units and codes of the streams: the data contract as data.

A stream is a set of columns of equal length, one row per sample; its last column is the time. Its
traits (kind, alignment, roles, clock) are stored with it: readers go by them, never by its name.
"""

import math
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Self

import numpy as np

from recorder.errors import SessionError

FORMAT = "tactile-rig session"
ARCHIVE_FORMAT = "tactile-rig markers"
FORMAT_VERSION = 2

# Axes of a wrench, by column.
AXES = ("Fx", "Fy", "Fz", "Tx", "Ty", "Tz")
# Phases of one target, by code.
PHASES = ("normal_inc", "shear_inc", "shear_dec", "normal_dec")
# Ways in which a phase ended, by code.
OUTCOMES = ("complete", "force_limited", "interrupted", "stopped", "unsteady")
# Allowed values of a session's `status`.
STATUSES = ("recording", "complete", "stopped", "recovered")

# Largest rate of a stream or of the frames view; larger ones are mistakes, such as ns for s.
RATE_MAX_HZ = 1e6

_DTYPES = ("uint8", "uint16", "int8", "int16", "int32", "int64", "float32", "float64")
_WRENCH_UNITS = "N, N m"
_POSE_UNITS = "m, rad"
# Units of a row of bytes that hold UTF-8 text, padded with zeros.
TEXT_UNITS = "utf-8"

# Ways to get a stream's value at the capture of the signal; `none` leaves it out of `frames`.
ALIGNMENTS = ("latest", "nearest", "interpolated", "mean", "none")
# Uses of a stream: `signal` is what the sensor shows, `label` is what a model learns to predict,
# `guard` stops the arm at the bench's limits.
ROLES = ("signal", "label", "guard")
# Clocks of a device: none; `device_t` on the host's CLOCK_MONOTONIC; `device_t` on a clock of the
# device; `seq` that counts samples at the device's rate.
CLOCKS = ("none", "monotonic", "device", "counter")
LATE = 0.12  # time after which the last sample of a moment has arrived [s]
# Moment of the exposure that the time stamps of a camera are of: the fraction of the exposure
# that comes after it.
STAMPS: Mapping[str, float] = {"start": 1.0, "middle": 0.5, "end": 0.0}


@dataclass(frozen=True, slots=True)
class KindDefaults:
    """Defaults of a kind of stream. A stream of another kind has those of `values`."""

    align: str
    """Alignment, one of `ALIGNMENTS`."""
    roles: tuple[str, ...]
    """Uses, of `ROLES`."""
    column: str = ""
    """Column of `frames` and `reference` of the first stream of this kind; empty: its name."""
    max_age: float = 0.0
    """Oldest sample that is valid [s], if that is more than two periods."""
    changes: bool = False
    """True if a healthy device never repeats one value for a second."""
    reference: str = ""
    """Value kept without contact: `mean` or `row`; empty for none."""
    tared: bool = False
    """True if `frames` contain the value minus that of the reference."""


KINDS: Mapping[str, KindDefaults] = {
    "camera": KindDefaults("latest", ("signal",), "image", changes=True, reference="row"),
    "depth": KindDefaults("latest", ("signal",), changes=True, reference="row"),
    "taxels": KindDefaults("interpolated", ("signal",), "taxels", changes=True, reference="mean"),
    "force": KindDefaults(
        "mean", ("label", "guard"), "wrench", 0.02, changes=True, reference="mean", tared=True
    ),
    "pose": KindDefaults("interpolated", ("label", "guard"), "pose", 0.02),
    "arm_wrench": KindDefaults(
        "mean", ("guard",), "", 0.02, changes=True, reference="mean", tared=True
    ),
    "joints": KindDefaults("interpolated", ("label",)),
    "events": KindDefaults("latest", (), max_age=math.inf),
    "gripper": KindDefaults("latest", ()),
    "action": KindDefaults("latest", (), max_age=math.inf),
    "values": KindDefaults("interpolated", ("label",)),
    "table": KindDefaults("none", ()),
}


@dataclass(frozen=True, slots=True)
class Traits:
    """Properties of a stream that all its readers go by."""

    kind: str
    """A key of `KINDS`, or any other word."""
    align: str
    """One of `ALIGNMENTS`."""
    roles: tuple[str, ...]
    """Some of `ROLES`."""
    clock: str
    """One of `CLOCKS`."""
    stamp: str = "end"
    """One of `STAMPS`: the moment that `device_t` is of, if the clock is `monotonic`."""
    defaults: KindDefaults = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        """Look up the defaults of the kind."""
        object.__setattr__(self, "defaults", KINDS.get(self.kind, KINDS["values"]))

    @classmethod
    def read(cls, name: str, attrs: Mapping[str, Any]) -> Self:
        """Return the traits in a stream's attributes.

        Raises:
            SessionError: One is missing, or has a value that the format does not allow.
        """
        for key in ("kind", "align", "roles", "clock"):
            if key not in attrs:
                raise SessionError(f"{name}: attribute {key!r} is missing")
        kind, align, roles, clock = (attrs[key] for key in ("kind", "align", "roles", "clock"))
        if not isinstance(roles, list | tuple):
            raise SessionError(f"{name}: found roles {roles!r:.80}, expected a list")
        stamp = str(attrs.get("stamp", "end"))
        traits = cls(str(kind), str(align), tuple(map(str, roles)), str(clock), stamp)
        allowed = (
            ("align", (traits.align,), ALIGNMENTS),
            ("roles", traits.roles, ROLES),
            ("clock", (traits.clock,), CLOCKS),
            ("stamp", (traits.stamp,), tuple(STAMPS)),
        )
        for key, values, choices in allowed:
            for value in values:
                if value not in choices:
                    raise SessionError(
                        f"{name}: found {key} {value!r:.80}; known: {', '.join(choices)}"
                    )
        if not re.fullmatch("[a-z][a-z0-9_]{0,39}", traits.kind):
            raise SessionError(f"{name}: found kind {traits.kind!r:.80}, expected a word in a-z_")
        return traits

    def to_json(self) -> dict[str, Any]:
        """Return the attributes that `read` reads."""
        return {
            "kind": self.kind,
            "align": self.align,
            "roles": list(self.roles),
            "clock": self.clock,
            **({} if self.stamp == "end" else {"stamp": self.stamp}),
        }


# Types and channels of images.
_IMAGES = (("uint8", 1), ("uint8", 3), ("uint16", 1))


@dataclass(frozen=True, slots=True)
class Column:
    """One array of a stream."""

    name: str
    """Name of the array in the stream's group."""
    dtype: str
    """Zarr data type, e.g. `float64`."""
    shape: tuple[int, ...] = ()
    """Shape of one row; a row with three dimensions is an image and one chunk."""
    units: str = ""
    """Units as stored; `1` for a pure number, `counts` for raw device values."""
    dims: tuple[str, ...] = ()
    """Dimension names of one row."""
    description: str = ""
    """One sentence for readers who have only the array."""
    codec: str = "zstd"
    """`zstd`, or `jpeg` for an image that arrives and is stored as JPEG."""

    def __post_init__(self) -> None:
        if self.dtype not in _DTYPES:
            dtypes = ", ".join(_DTYPES)
            raise SessionError(f"{self.name}: found dtype {self.dtype}, known: {dtypes}")
        if self.dims and len(self.dims) != len(self.shape):
            raise SessionError(f"{self.name}: found dims {self.dims} for shape {self.shape}")
        if self.codec not in ("zstd", "jpeg"):
            raise SessionError(f"{self.name}: found codec {self.codec!r}, known: zstd, jpeg")
        if self.is_image and (self.dtype, self.shape[2]) not in _IMAGES:
            raise SessionError(
                f"{self.name}: found {self.dtype} {self.shape}, expected uint8 (h, w, 1 or 3) "
                "or uint16 (h, w, 1)"
            )
        if self.codec == "jpeg" and (not self.is_image or self.dtype != "uint8"):
            raise SessionError(
                f"{self.name}: found codec jpeg on {self.dtype} {self.shape}, "
                "expected a uint8 image"
            )

    @property
    def is_image(self) -> bool:
        """True if a row is an image, stored as one chunk."""
        return len(self.shape) == 3

    @property
    def is_number(self) -> bool:
        """True if a row can be interpolated: neither an image nor text."""
        return not self.is_image and self.units != TEXT_UNITS

    @property
    def is_pose(self) -> bool:
        """True if a row is a position [m] and a rotation vector [rad]."""
        return self.shape == (6,) and self.units == _POSE_UNITS


# Columns of `frames` and `reference` that are no stream's, or the first of a kind's.
_OF_FRAMES = {"t_ns", "run", "is_duplicate", "image_age", "target", "phase", "depth", "skew"}
_OF_FRAMES |= {"valid", "time_sigma", "point", "image", "wrench", "wrench_std", "pose", "taxels"}


@dataclass(frozen=True, slots=True)
class StreamSpec:
    """One stream, declared before recording."""

    name: str
    """Name of the stream's group."""
    columns: tuple[Column, ...]
    """Columns in storage order; the last is the time of the row [ns]."""
    rate_hz: float
    """Nominal rate; sets the number of rows per chunk."""
    attrs: dict[str, Any] = field(default_factory=dict)
    """Further properties: bias, exposure [s], latency [s], serial numbers; and those of `Traits`,
    where they differ from the defaults of the kind."""

    def __post_init__(self) -> None:
        names = [column.name for column in self.columns]
        if len(set(names)) != len(names):
            raise SessionError(f"{self.name}: repeated column in {names}")
        if not self.columns or (self.columns[-1].dtype, self.columns[-1].shape) != ("int64", ()):
            raise SessionError(f"{self.name}: found columns {names}, expected an int64 time last")
        if sum(column.is_image for column in self.columns) > 1:
            raise SessionError(f"{self.name}: found several image columns, at most one is possible")
        if not 0 < self.rate_hz <= RATE_MAX_HZ:
            raise SessionError(
                f"{self.name}: found rate_hz {self.rate_hz}; allowed: above 0 to {RATE_MAX_HZ:g}"
            )
        traits = self.traits
        value = self.value
        allowed = ["none"]
        if value is not None:
            allowed += ["latest", "nearest"]
            allowed += ["interpolated"] if value.is_number else []
            allowed += ["mean"] if value.is_number and not value.is_pose else []
        if traits.align not in allowed:
            raise SessionError(
                f"{self.name}: found align {traits.align!r}; allowed for its columns: "
                f"{', '.join(allowed)}"
            )

    @property
    def traits(self) -> Traits:
        """Kind, alignment, roles and clock."""
        numbers = self.value is not None and self.value.is_number
        kind = self.attrs.get("kind", "values" if numbers else "table")
        defaults = KINDS.get(kind, KINDS["values"])
        clock = "device" if any(column.name == "device_t" for column in self.columns) else "none"
        if self.attrs.get("device_clock") == "monotonic":
            clock = "monotonic"
        own = {"kind": kind, "align": defaults.align, "roles": defaults.roles, "clock": clock}
        return Traits.read(self.name, {**own, **self.attrs})

    @property
    def value(self) -> Column | None:
        """The column `value`; None without one."""
        return next((column for column in self.columns if column.name == "value"), None)

    @property
    def has_jpegs(self) -> bool:
        """True if images are kept as the camera's JPEG."""
        return any(column.codec == "jpeg" for column in self.columns)

    @property
    def block(self) -> int:
        """Rows per chunk of a small column: the power of two nearest to 1.3 s, from 64 to 4096.

        With JPEG images at least 256: other Zarr readers see only full shards of images anyway, and
        every block costs as much as storing ten of them.
        """
        least = 8 if self.has_jpegs else 6
        return int(2 ** min(max(round(math.log2(1.28 * self.rate_hz)), least), 12))


def check_streams(specs: Iterable[StreamSpec]) -> None:
    """Reject streams that one session cannot hold together."""
    by_name: dict[str, StreamSpec] = {}
    specs = list(specs)
    for spec in specs:
        if not re.fullmatch("[A-Za-z][A-Za-z0-9_]{0,39}", spec.name):
            raise SessionError(
                f"stream {spec.name!r:.80}: allowed as a name: a letter, then letters, digits "
                "and _, at most 40"
            )
        if spec.name in by_name:
            raise SessionError(f"stream {spec.name}: found twice; every stream needs its own name")
        by_name[spec.name] = spec
    columns = frame_columns([(spec.name, spec.traits) for spec in specs])
    for name, column in columns.items():
        other = column.removesuffix("_age").removesuffix("_std")
        if column == name and (
            (name in _OF_FRAMES and name != by_name[name].traits.defaults.column)
            or (other != name and other in {*_OF_FRAMES, *columns.values()})
        ):
            raise SessionError(
                f"stream {name}: is the name of a column of frames; choose another name"
            )


def frame_columns(streams: Iterable[tuple[str, Traits]]) -> dict[str, str]:
    """Return the column of `frames` and `reference` of each stream, in order.

    The first stream of a kind has the kind's column (`image`, `wrench`, `pose`, `taxels`); every
    other is named after its stream. Streams with alignment `none` have no column.
    """
    columns: dict[str, str] = {}
    for name, traits in streams:
        if traits.align != "none":
            default = traits.defaults.column
            columns[name] = default if default and default not in columns.values() else name
    return columns


def signal_of(streams: Iterable[tuple[str, Traits]]) -> str | None:
    """Return the stream that others are aligned to: of role `signal`, cameras first; or None."""
    signals = [(name, traits) for name, traits in streams if "signal" in traits.roles]
    signals = [(name, traits) for name, traits in signals if traits.align != "none"]
    cameras = [name for name, traits in signals if traits.kind == "camera"]
    return next(iter([*cameras, *(name for name, _ in signals)]), None)


# Columns that streams share.
_T_NS = Column(
    "t_ns", "int64", units="ns", description="host arrival time, CLOCK_MONOTONIC of the run"
)
_DEVICE_T = Column(
    "device_t", "float64", units="s", description="the device's own time; NaN when it gives none"
)
_SEQ = Column("seq", "int64", units="1", description="the device's sequence number")


def camera_spec(
    rate_hz: float,
    *,
    name: str = "camera",
    height: int = 480,
    width: int = 640,
    codec: str = "jpeg",
    numbered: bool = False,
    **attrs: Any,
) -> StreamSpec:
    """Return a stream of images (height, width, 3) uint8 at a nominal rate.

    The codec `jpeg` keeps the camera's own bytes, `zstd` stores decoded images losslessly. Frames
    that are `numbered` by the driver have a column `seq`. `docs/reference/data-format.md` lists the
    attributes that alignment reads.
    """
    value = Column(
        "value",
        "uint8",
        (height, width, 3),
        units="1",
        dims=("y", "x", "rgb"),
        description="image as delivered, RGB",
        codec=codec,
    )
    number = (_SEQ,) if numbered else ()
    return _stream("camera", name, (value, _DEVICE_T, *number, _T_NS), rate_hz, attrs)


def depth_spec(
    rate_hz: float,
    *,
    name: str,
    height: int = 480,
    width: int = 640,
    units: str = "mm",
    **attrs: Any,
) -> StreamSpec:
    """Return a stream of depth images (height, width, 1) uint16, lossless; 0 is no measurement."""
    value = Column(
        "value",
        "uint16",
        (height, width, 1),
        units=units,
        dims=("y", "x", "depth"),
        description="distance from the camera; 0 where it could not be measured",
    )
    return _stream("depth", name, (value, _DEVICE_T, _T_NS), rate_hz, attrs)


def force_spec(rate_hz: float, *, name: str = "force", **attrs: Any) -> StreamSpec:
    """Return a stream of forces and torques: measured values minus `attrs["bias"]` (6,)."""
    value = _six_axes(
        _WRENCH_UNITS, "Fx Fy Fz [N], Tx Ty Tz [N m] in the F/T frame, measured minus attrs bias"
    )
    status = Column("status", "int64", units="1", description="the device's status word")
    attrs.setdefault("bias", [0.0] * 6)
    return _stream("force", name, (value, _SEQ, status, _T_NS), rate_hz, attrs)


def arm_wrench_spec(rate_hz: float, *, name: str, **attrs: Any) -> StreamSpec:
    """Return a stream of an arm's own estimate of the force at its tool, as it reports it.

    It is accurate to a few newtons: it stops the arm and is no label.
    """
    value = _six_axes(
        _WRENCH_UNITS, "Fx Fy Fz [N], Tx Ty Tz [N m] as the arm estimates them, without any zero"
    )
    return _stream("arm_wrench", name, (value, _DEVICE_T, _T_NS), rate_hz, attrs)


def pose_spec(rate_hz: float, *, name: str = "pose", **attrs: Any) -> StreamSpec:
    """Return a stream of a robot's tool pose."""
    value = _six_axes(
        _POSE_UNITS, "x y z [m] and UR rotation vector [rad] in the robot's base frame"
    )
    scaling = Column(
        "speed_scaling", "float64", units="1", description="the controller's speed scaling, 0 to 1"
    )
    return _stream("pose", name, (value, _DEVICE_T, scaling, _T_NS), rate_hz, attrs)


def taxels_spec(
    rate_hz: float, *, name: str = "taxels", taxels: int = 16, axes: int = 3, **attrs: Any
) -> StreamSpec:
    """Return a stream of an array of taxels (taxels, axes)."""
    value = Column(
        "value",
        "int32",
        (taxels, axes),
        units="counts",
        dims=("taxel", "axis"),
        description="raw counts x y z, taxels row by row",
    )
    return _stream("taxels", name, (value, _DEVICE_T, _SEQ, _T_NS), rate_hz, attrs)


def joints_spec(rate_hz: float, *, name: str, joints: int = 6, **attrs: Any) -> StreamSpec:
    """Return a stream of joint states: angles, and speeds (NaN where the device sends none)."""
    value = Column(
        "value", "float64", (joints,), units="rad", dims=("joint",), description="joint angles"
    )
    speed = Column(
        "speed", "float64", (joints,), units="rad/s", dims=("joint",), description="joint speeds"
    )
    return _stream("joints", name, (value, speed, _DEVICE_T, _T_NS), rate_hz, attrs)


def gripper_spec(rate_hz: float, *, name: str = "gripper", **attrs: Any) -> StreamSpec:
    """Return a stream of a gripper's status."""
    columns = (
        Column("value", "float64", units="m", description="opening, in steps of one count"),
        Column("commanded", "float64", units="m", description="opening that was requested"),
        Column("current", "float64", units="A", description="motor current"),
        Column("object", "int8", units="1", description="0 moving, 1 or 2 stopped, 3 at position"),
        Column("fault", "int16", units="1", description="the device's fault code; 0: none"),
        _T_NS,
    )
    return _stream("gripper", name, columns, rate_hz, attrs)


def action_spec(*, name: str = "action", rate_hz: float = 1.0, **attrs: Any) -> StreamSpec:
    """Return a stream of commands to a gripper, one row each; the last one holds."""
    columns = (
        Column("value", "float64", units="m", description="opening to go to"),
        Column("speed", "int16", units="1", description="speed, 0 slowest to 255"),
        Column("force", "int16", units="1", description="force, 0 weakest to 255"),
        Column("by", "int8", units="1", description="0: a plan, 1: a controller"),
        _T_NS,
    )
    return _stream("action", name, columns, rate_hz, attrs)


def events_spec(*, name: str, length: int = 256, rate_hz: float = 1.0, **attrs: Any) -> StreamSpec:
    """Return a stream of text events; `event_text` and `event_row` convert between text and rows.

    `length` is that of the longest text [bytes of UTF-8]; `rate_hz` the expected number of events
    per second.
    """
    value = Column(
        "value",
        "uint8",
        (length,),
        units=TEXT_UNITS,
        dims=("byte",),
        description="text in UTF-8, padded with zeros",
    )
    return _stream("events", name, (value, _T_NS), rate_hz, attrs)


def event_row(text: str, length: int = 256) -> np.ndarray[Any, Any]:
    """Return a text as a row (length,) uint8 of an event stream.

    Raises:
        SessionError: It is longer, or contains a zero character.
    """
    data = text.encode()
    if len(data) > length or b"\0" in data:
        raise SessionError(f"event {text!r:.40}: allowed: {length} bytes of UTF-8 without zeros")
    return np.frombuffer(data.ljust(length, b"\0"), np.uint8)


def event_text(row: np.ndarray[Any, Any]) -> str:
    """Return the text of a row (length,) uint8 of an event stream."""
    return bytes(np.asarray(row, np.uint8)).rstrip(b"\0").decode("utf-8", "replace")


def _six_axes(units: str, description: str, *, name: str = "value") -> Column:
    return Column(name, "float64", (6,), units=units, dims=("axis",), description=description)


def _stream(
    kind: str, name: str, columns: tuple[Column, ...], rate_hz: float, attrs: dict[str, Any]
) -> StreamSpec:
    return StreamSpec(name, columns, rate_hz, {"kind": kind, **attrs})


# One row per recorded phase.
SEGMENTS = StreamSpec(
    "segments",
    (
        Column("target", "int32", units="1", description="row of targets"),
        Column("phase", "int8", units="1", description="code, see attrs phases"),
        Column("outcome", "int8", units="1", description="code, see attrs outcomes"),
        Column("run", "int16", units="1", description="entry of the session's attrs runs"),
        Column("start_ns", "int64", units="ns", description="first moment of the phase"),
        Column("end_ns", "int64", units="ns", description="first moment behind the phase"),
    ),
    rate_hz=1.0,
    attrs={"kind": "table", "phases": list(PHASES), "outcomes": list(OUTCOMES)},
)

# One row per no-contact moment, in a session with one stream of each kind.
REFERENCE = StreamSpec(
    "reference",
    (
        Column("point", "int16", units="1", description="contact point, as in targets"),
        Column("image", "int64", units="1", description="row of streams/camera; -1 without one"),
        _six_axes(
            _WRENCH_UNITS,
            "mean residual offset without contact, relative to the bias",
            name="wrench",
        ),
        _six_axes(_WRENCH_UNITS, "standard deviation of the samples behind it", name="wrench_std"),
        Column(
            "taxels",
            "float64",
            (16, 3),
            units="counts",
            dims=("taxel", "axis"),
            description="mean counts without contact; NaN without taxels",
        ),
        Column("run", "int16", units="1", description="entry of the session's attrs runs"),
        Column("t_ns", "int64", units="ns", description="when it was taken"),
    ),
    rate_hz=1.0,
    attrs={"kind": "table"},
)


def reference_spec(streams: Sequence[StreamSpec]) -> StreamSpec:
    """Return the columns of `reference` in a session of these streams.

    To the columns of `REFERENCE` come those of further streams of a kind: the row of an image, or
    the mean of a value and its standard deviation (`<stream>_std`).
    """
    columns = {column.name: column for column in REFERENCE.columns[:-2]}
    column_names = frame_columns((spec.name, spec.traits) for spec in streams)
    for spec in streams:
        kind, column_name = spec.traits.defaults, column_names.get(spec.name)
        value = spec.value
        if column_name is None or value is None or not kind.reference:
            continue
        if kind.reference == "row":
            about = f"row of streams/{spec.name}; -1 without one"
            columns[column_name] = Column(column_name, "int64", units="1", description=about)
            continue
        about = (
            columns[column_name].description if column_name in columns else "mean without contact"
        )
        columns[column_name] = replace(value, name=column_name, dtype="float64", description=about)
        if kind.tared:
            about = "standard deviation of the samples behind it"
            std = f"{column_name}_std"
            columns[std] = replace(columns[column_name], name=std, description=about)
    return replace(REFERENCE, columns=(*columns.values(), *REFERENCE.columns[-2:]))


# Units and description of the columns of `targets`.
TARGET_UNITS: Mapping[str, tuple[str, str]] = {
    "point": ("1", "number of the contact point"),
    "depth": ("m", "planned indentation"),
    "direction": ("1", "number of the shear direction, 0 along +x, counter-clockwise; -1 for none"),
    "planned": ("m", "planned place of the tip at full shear, in the robot's base frame"),
    "object": ("1", "number of the object in attrs plan"),
    "turn": ("1", "unit vector of gravity in the frame of the hand"),
    "step": ("1", "number of the step of the squeeze"),
    "opening": ("m", "commanded distance between the undeformed skins"),
    "width": ("m", "width of the object along the grip axis"),
    "mass": ("kg", "mass of the object"),
    "lifted": ("1", "1 if only the fingers carry the object"),
    "control": ("1", "row of the target that this press repeats, outside of the plan; -1 for none"),
}
