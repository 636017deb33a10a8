"""Bench file settings of the cameras. Imports no vendor library."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, ClassVar, Literal

from rig.core.stream_settings import StreamSettings


@dataclass(frozen=True, slots=True)
class CameraSettings(StreamSettings):
    """Settings that all cameras have; each adds a `rate_hz` [Hz] and its address."""

    STREAM: ClassVar[str] = "camera"

    silence: float = field(
        default=1.0, kw_only=True, metadata={"unit": "ms", "plausible": (5, 60000)}
    )
    """Silence after which the camera counts as lost [s]."""
    width: int = field(default=640, kw_only=True)
    """[px]"""
    height: int = field(default=480, kw_only=True)
    """[px]"""

    def attrs(self, description: Mapping[str, Any]) -> dict[str, Any]:
        """Return the stream's attributes, such as `exposure` [s], given `Driver.describe()`."""
        return {}


@dataclass(frozen=True, slots=True)
class V4l2Config(CameraSettings):
    """Settings of a camera on a V4L2 node: most USB cameras."""

    KIND: ClassVar[str] = "v4l2"

    address: str = "/dev/video0"
    """The node, or its number."""
    rate_hz: float = 30.0
    """Frame rate requested of the camera."""
    fourcc: str = "MJPG"
    """Pixel format requested of the camera; with MJPG its JPEG bytes are kept."""
    exposure: float | None = field(
        default=None, metadata={"unit": "ms", "plausible": (0.005, 5000)}
    )
    """Manual exposure time [s]; None leaves the camera's own mode."""
    gain: float | None = None
    """In the camera's own unit; None leaves it unchanged."""
    stamp: Literal["start", "middle", "end"] | None = None
    """Moment of the exposure that the time stamps are of; None: as its driver says."""

    def __post_init__(self) -> None:
        if "://" in self.address:
            raise ValueError(
                f"address: {self.address!r}; allowed with kind v4l2: /dev/videoN, N; MJPEG over "
                "HTTP has kind mjpeg"
            )
        if (self.exposure or 0.0) > 1 / self.rate_hz:
            raise ValueError(
                f"exposure_ms: {1e3 * (self.exposure or 0.0):g}; allowed: up to "
                f"{1e3 / self.rate_hz:.4g} at rate_hz {self.rate_hz:g}"
            )

    def check_mock(self) -> None:
        """Reject this kind on a mock bench, which has no video device."""
        raise ValueError("kind: v4l2; allowed on a mock bench: mjpeg")

    def attrs(self, description: Mapping[str, Any]) -> dict[str, Any]:
        """Return exposure and stamp."""
        exposure = {} if self.exposure is None else {"exposure": self.exposure}
        return {**exposure, "stamp": self.stamp or description.get("stamp", "end")}


@dataclass(frozen=True, slots=True)
class MjpegConfig(CameraSettings):
    """Settings of a camera that sends MJPEG over HTTP, without time stamps."""

    KIND: ClassVar[str] = "mjpeg"

    address: str
    """http://..."""
    rate_hz: float = 30.0
    """Frame rate that the camera sends; it is set on the camera's own server, as its exposure."""
    repeats: bool = False
    """True if equal consecutive frames count separately, as in a replay of a still scene; else they
    are one frame sent twice: no two pictures of a sensor are equal."""

    def __post_init__(self) -> None:
        if not self.address.startswith("http://"):
            raise ValueError(
                f"address: {self.address!r}; allowed with kind mjpeg: http://...; a camera on "
                "/dev/videoN has kind v4l2"
            )
