"""Columns, units and codes of the streams: the data contract as data.

A stream is a set of columns of equal length, one row per sample; its last column is the time.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from recorder.errors import SessionError

FORMAT = "tactile-rig session"
FORMAT_VERSION = 1

# Phases of one target, by code.
PHASES = ("normal_inc", "shear_inc", "shear_dec", "normal_dec")
# Ways in which a phase ended, by code.
OUTCOMES = ("complete", "force_limited", "interrupted", "stopped")
# Allowed values of a session's `status`.
STATUSES = ("recording", "complete", "stopped", "recovered")

_DTYPES = ("uint8", "int8", "int16", "int32", "int64", "float32", "float64")
_WRENCH_UNITS = "N, N m"


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
        """Reject columns that the format cannot hold.

        Raises:
            SessionError: Unknown dtype or codec, or a row shape that does not match them.
        """
        if self.dtype not in _DTYPES:
            known = ", ".join(_DTYPES)
            raise SessionError(f"{self.name}: found dtype {self.dtype}, known: {known}")
        if self.dims and len(self.dims) != len(self.shape):
            raise SessionError(f"{self.name}: found dims {self.dims} for shape {self.shape}")
        if self.codec not in ("zstd", "jpeg"):
            raise SessionError(f"{self.name}: found codec {self.codec!r}, known: zstd, jpeg")
        if self.is_image and (self.dtype != "uint8" or self.shape[2] not in (1, 3)):
            raise SessionError(
                f"{self.name}: found {self.dtype} {self.shape}, expected uint8 (h, w, 1 or 3)"
            )
        if self.codec == "jpeg" and not self.is_image:
            raise SessionError(f"{self.name}: found codec jpeg on shape {self.shape}, not an image")

    @property
    def is_image(self) -> bool:
        """True if a row is an image, stored as one chunk."""
        return len(self.shape) == 3

    @property
    def row_bytes(self) -> int:
        """Size of one decoded row [bytes]."""
        return math.prod(self.shape) * np.dtype(self.dtype).itemsize


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
    """Further properties: bias, exposure [s], latency [s], device_clock, serial numbers."""

    def __post_init__(self) -> None:
        """Reject a stream that the format cannot hold.

        Raises:
            SessionError: No integer time column at the end, a repeated name or two image columns.
        """
        names = [column.name for column in self.columns]
        if len(set(names)) != len(names):
            raise SessionError(f"{self.name}: repeated column in {names}")
        if not self.columns or (self.columns[-1].dtype, self.columns[-1].shape) != ("int64", ()):
            raise SessionError(f"{self.name}: found columns {names}, expected an int64 time last")
        if sum(column.is_image for column in self.columns) > 1:
            raise SessionError(f"{self.name}: found several image columns, at most one is possible")
        if not self.rate_hz > 0:
            raise SessionError(f"{self.name}: found rate_hz {self.rate_hz}, expected more than 0")

    @property
    def block(self) -> int:
        """Rows per chunk of a small column: the power of two nearest to 1.3 s, from 64 to 4096."""
        return int(2 ** min(max(round(math.log2(1.28 * self.rate_hz)), 6), 12))


def _t_ns(description: str = "host arrival time, CLOCK_MONOTONIC of the run") -> Column:
    return Column("t_ns", "int64", units="ns", description=description)


def _device_t(description: str = "the device's own time; NaN when it gives none") -> Column:
    return Column("device_t", "float64", units="s", description=description)


def _seq() -> Column:
    return Column("seq", "int64", units="1", description="the device's sequence number")


def camera_spec(
    rate_hz: float, *, height: int = 480, width: int = 640, codec: str = "jpeg", **attrs: Any
) -> StreamSpec:
    """Return the stream of a camera.

    Args:
        rate_hz: Nominal frame rate.
        height: Rows of an image [px].
        width: Columns of an image [px].
        codec: `jpeg` keeps the camera's own bytes, `zstd` stores decoded images losslessly.
        attrs: Stored with the stream; docs/reference/data-format.md lists those that alignment
            reads.
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
    return StreamSpec("camera", (value, _device_t(), _t_ns()), rate_hz, attrs)


def force_spec(rate_hz: float, **attrs: Any) -> StreamSpec:
    """Return the stream of a force/torque sensor: measured values minus `attrs["bias"]` (6,)."""
    value = Column(
        "value",
        "float64",
        (6,),
        units=_WRENCH_UNITS,
        dims=("axis",),
        description="Fx Fy Fz [N], Tx Ty Tz [N m] in the F/T frame, measured minus attrs bias",
    )
    status = Column("status", "int64", units="1", description="the device's status word")
    attrs.setdefault("bias", [0.0] * 6)
    return StreamSpec("force", (value, _seq(), status, _t_ns()), rate_hz, attrs)


def pose_spec(rate_hz: float, **attrs: Any) -> StreamSpec:
    """Return the stream of the robot's tool pose."""
    value = Column(
        "value",
        "float64",
        (6,),
        units="m, rad",
        dims=("axis",),
        description="x y z [m] and UR rotation vector [rad] in the robot's base frame",
    )
    scaling = Column(
        "speed_scaling", "float64", units="1", description="the controller's speed scaling, 0 to 1"
    )
    return StreamSpec("pose", (value, _device_t(), scaling, _t_ns()), rate_hz, attrs)


def taxels_spec(rate_hz: float, **attrs: Any) -> StreamSpec:
    """Return the stream of a 4x4 three-axis taxel array."""
    value = Column(
        "value",
        "int32",
        (16, 3),
        units="counts",
        dims=("taxel", "axis"),
        description="raw counts x y z, taxels row by row",
    )
    return StreamSpec("taxels", (value, _device_t(), _seq(), _t_ns()), rate_hz, attrs)


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
    attrs={"phases": list(PHASES), "outcomes": list(OUTCOMES)},
)

# One row per no-contact moment.
REFERENCE = StreamSpec(
    "reference",
    (
        Column("point", "int16", units="1", description="contact point, as in targets"),
        Column("image", "int64", units="1", description="row of streams/camera; -1 without one"),
        Column(
            "wrench",
            "float64",
            (6,),
            units=_WRENCH_UNITS,
            dims=("axis",),
            description="mean residual offset without contact, relative to the bias",
        ),
        Column(
            "wrench_std",
            "float64",
            (6,),
            units=_WRENCH_UNITS,
            dims=("axis",),
            description="standard deviation of the samples behind it",
        ),
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
    attrs={},
)

# Units and description of the columns of `targets`.
TARGET_UNITS: Mapping[str, tuple[str, str]] = {
    "point": ("1", "number of the contact point"),
    "depth": ("m", "planned indentation"),
    "direction": ("1", "number of the shear direction, 0 along +x, counter-clockwise; -1 for none"),
    "planned": ("m", "planned place of the tip at full shear, in the robot's base frame"),
}
