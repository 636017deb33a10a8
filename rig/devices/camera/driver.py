"""The driver of a camera, by its address."""

from __future__ import annotations

from rig.core.clock import Clock
from rig.devices.camera.camera import CameraDriver
from rig.devices.camera.settings import CameraConfig


def camera_driver(config: CameraConfig, clock: Clock) -> CameraDriver:
    """Return the driver: by OpenCV for MJPEG over HTTP, else by V4L2 itself."""
    if config.is_network:
        from rig.devices.camera.opencv import OpenCvDriver

        return OpenCvDriver(config, clock)
    from rig.devices.camera.v4l2 import V4l2Driver

    return V4l2Driver(config, clock)
