"""What the bench file says about the camera. No vendor library here."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import ClassVar


@dataclass(frozen=True, slots=True)
class CameraConfig:
    """A camera OpenCV can open, and what it is set to."""

    KIND: ClassVar[str] = "opencv"

    address: str = "/dev/video0"
    """A V4L2 node, its number, or http://..."""
    rate_hz: float = 30.0
    """Asked of a V4L2 camera; a network camera sends what it sends."""
    width: int = 640
    """[px]"""
    height: int = 480
    """[px]"""
    fourcc: str = "MJPG"
    """Pixel format asked of a V4L2 camera; with MJPG its JPEG bytes are kept."""
    exposure: float | None = field(default=None, metadata={"unit": "ms"})
    """Manual exposure time [s]; None leaves the camera's own mode."""
    gain: float | None = None
    """In the camera's own unit; None leaves it."""
    silence: float = field(default=1.0, metadata={"unit": "ms"})
    """Without a frame for so long the camera counts as lost [s]."""
    repeats: bool = False
    """Whether equal bytes in a row from a network camera are frames of their own, as in a replay of
    a still scene; else they are one frame sent twice: no two pictures of a sensor are equal."""
