"""Bench file settings of the camera. Imports no vendor library."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import ClassVar, Literal

from rig.core.stream_settings import StreamSettings


@dataclass(frozen=True, slots=True)
class CameraConfig(StreamSettings):
    """Settings of a camera that OpenCV can open."""

    KIND: ClassVar[str] = "opencv"
    STREAM: ClassVar[str] = "camera"

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
    silence: float = field(default=1.0, metadata={"unit": "ms", "plausible": (5, 60000)})
    """Silence after which the camera counts as lost [s]."""
    stamp: Literal["start", "middle", "end"] | None = None
    """Moment of the exposure that a V4L2 camera's time stamps are of; None: as its driver says."""
    repeats: bool = False
    """True if equal consecutive frames of a network camera count separately, as in a replay of a
    still scene; else they are one frame sent twice: no two pictures of a sensor are equal."""

    @property
    def is_network(self) -> bool:
        """True if the camera is read over HTTP; else it is a V4L2 node."""
        return "://" in self.address
