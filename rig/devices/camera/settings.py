"""Bench file settings of the camera. Imports no vendor library."""

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

    def attrs(self, description: Mapping[str, Any]) -> dict[str, Any]:
        """Return attributes of the stream of the open camera, such as `exposure` [s] and `stamp`.

        Args:
            description: `Driver.describe()`.
        """
        return {}


@dataclass(frozen=True, slots=True)
class CameraConfig(CameraSettings):
    """Settings of a V4L2 camera, or of one that sends MJPEG over HTTP."""

    KIND: ClassVar[str] = "camera"

    address: str = "/dev/video0"
    """A V4L2 node, its number, or http://..."""
    rate_hz: float = 30.0
    """Frame rate requested of a V4L2 camera; a network camera decides its own."""
    width: int = 640
    """[px]"""
    height: int = 480
    """[px]"""
    fourcc: str = "MJPG"
    """Pixel format requested of a V4L2 camera; with MJPG its JPEG bytes are kept."""
    exposure: float | None = field(
        default=None, metadata={"unit": "ms", "plausible": (0.005, 5000)}
    )
    """Manual exposure time [s]; None leaves the camera's own mode."""
    gain: float | None = None
    """In the camera's own unit; None leaves it unchanged."""
    stamp: Literal["start", "middle", "end"] | None = None
    """Moment of the exposure that a V4L2 camera's time stamps are of; None: as its driver says."""
    repeats: bool = False
    """True if equal consecutive frames of a network camera count separately, as in a replay of a
    still scene; else they are one frame sent twice: no two pictures of a sensor are equal."""

    def __post_init__(self) -> None:
        if self.stamp is not None and self.is_network:
            raise ValueError(
                f"stamp: {self.stamp!r}; allowed: with a V4L2 camera, since MJPEG over HTTP has no "
                "time stamps"
            )
        if (self.exposure or 0.0) > 1 / self.rate_hz:
            raise ValueError(
                f"exposure_ms: {1e3 * (self.exposure or 0.0):g}; allowed: up to "
                f"{1e3 / self.rate_hz:.4g} at rate_hz {self.rate_hz:g}"
            )

    def attrs(self, description: Mapping[str, Any]) -> dict[str, Any]:
        """Return exposure and stamp of a V4L2 camera."""
        if self.is_network:
            return {}
        exposure = {} if self.exposure is None else {"exposure": self.exposure}
        return {**exposure, "stamp": self.stamp or description.get("stamp", "end")}

    @property
    def is_network(self) -> bool:
        """True if the camera is read over HTTP; else it is a V4L2 node."""
        return "://" in self.address
