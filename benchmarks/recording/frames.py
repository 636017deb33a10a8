"""Synthetic camera frames that contain their own number, as pixels and as a camera's JPEG.

The image is a gel with soft shading, dark markers and noise of sigma 2 grey levels, which is about
as compressible as the image of a tactile camera. The number is written into the first sixteen bytes
of the pixels, or into a comment of the JPEG, and survives every lossless store. It distinguishes
the frames that a killed writer leaves from zeros and from wrong frames.
"""

from collections.abc import Iterable
from functools import cached_property
from typing import Any

import numpy as np
import simplejpeg
from numpy.typing import NDArray

from rig.devices.camera.jpeg import frame_stamp, stamped

Image = NDArray[np.uint8]
# A frame as it is stored: pixels (480, 640, 3), or a JPEG.
Frame = Image | bytes

SHAPE = HEIGHT, WIDTH, _ = 480, 640, 3
# Standard deviation of the noise [grey levels].
NOISE = 2.0
# JPEG quality, 4:2:2 as UVC cameras send it.
QUALITY = 90
# Number of different noise fields, after which frames repeat.
_DIFFERENT = 8
# Bytes of a number; the same number of bytes holds its complement.
_NUMBER = 8


class GelFrames:
    """Frames with seeded noise, generated before the measurement begins.

    `decoded` ones are pixels of a camera's decoded JPEG, as from a driver that decodes.
    """

    def __init__(self, *, decoded: bool = False, seed: int = 0) -> None:
        rng = np.random.default_rng(seed)
        base = _gel()
        noisy = [base + rng.normal(0.0, NOISE, base.shape) for _ in range(_DIFFERENT)]
        self._pixels = [np.clip(image, 0, 255).round().astype(np.uint8) for image in noisy]
        if decoded:
            self._pixels = [simplejpeg.decode_jpeg(jpeg).copy() for jpeg in self._jpegs]

    @cached_property
    def _jpegs(self) -> list[bytes]:
        return [
            simplejpeg.encode_jpeg(image, quality=QUALITY, colorsubsampling="422")
            for image in self._pixels
        ]

    def pixels(self, number: int) -> Image:
        """Return frame `number` (480, 640, 3) RGB; the array is reused eight frames later."""
        image = self._pixels[number % _DIFFERENT]
        code = number.to_bytes(_NUMBER, "little")
        head = code + bytes(255 - byte for byte in code)
        image.reshape(-1)[: 2 * _NUMBER] = np.frombuffer(head, np.uint8)
        return image

    def jpeg(self, number: int) -> bytes:
        """Return frame `number` as the camera's JPEG."""
        return stamped(self._jpegs[number % _DIFFERENT], number, 0)


def number_in(frame: Frame) -> int | None:
    """Return the number of a stored frame, or None if it is not a complete frame."""
    if isinstance(frame, bytes):
        stamp = frame_stamp(frame)
        return None if stamp is None else stamp[0]
    head = frame.reshape(-1)[: 2 * _NUMBER].tobytes()
    code, complement = head[:_NUMBER], head[_NUMBER:]
    if any(a + b != 255 for a, b in zip(code, complement, strict=True)):
        return None
    return int.from_bytes(code, "little")


def decoded(jpegs: Iterable[Any], count: int) -> Image:
    """Return `count` JPEGs as pixels (count, 480, 640, 3), decoded one after the other."""
    out = np.empty((count, *SHAPE), np.uint8)
    for image, jpeg in zip(out, jpegs, strict=True):
        simplejpeg.decode_jpeg(jpeg, buffer=image)
    return out


def _gel() -> NDArray[np.float64]:
    row, column = np.mgrid[0:HEIGHT, 0:WIDTH]
    across, down = (column - WIDTH / 2) / WIDTH, (row - HEIGHT / 2) / HEIGHT
    lit = 1.0 - 0.45 * (across**2 + down**2)
    tint = np.stack([1 + 0.18 * across, 1 - 0.1 * down, 1 - 0.18 * across], axis=-1)
    image = lit[..., None] * tint * np.array([150.0, 138.0, 120.0])
    pitch, radius = 60, 9
    near = (column % pitch - pitch / 2) ** 2 + (row % pitch - pitch / 2) ** 2 < radius**2
    image[near] = 30.0
    return np.asarray(image)
