"""Where the emulated camera's pictures come from: the World, a folder of images, a video."""

from __future__ import annotations

import functools
import itertools
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, Protocol

import cv2
import numpy as np
import numpy.typing as npt

from recorder.strict_yaml import natural_key
from rig.camera.jpeg import is_whole, jpeg_size

Image = npt.NDArray[np.uint8]
SIZE = (640, 480)
"""Width and height of every picture [px]."""
QUALITY_RENDERED = 92
"""About what a webcam delivers."""
QUALITY_CONVERTED = 95
_SUFFIXES_IMAGE = (".png", ".jpg", ".jpeg")
_MJPG = cv2.VideoWriter.fourcc(*"MJPG")


class FrameSource(Protocol):
    """One JPEG file per tick of the camera."""

    def jpeg(self, state: np.void) -> bytes:
        """The picture of a WORLD_STATE record, `SIZE` large."""


class WorldSource:
    """Pictures of the World.

    Args:
        view: Gives the RGB picture (480, 640, 3) of a WORLD_STATE record.
    """

    def __init__(self, view: Callable[[np.void], Image]) -> None:
        self._view = view

    def jpeg(self, state: np.void) -> bytes:
        """The picture of `state`."""
        return _encoded(cv2.cvtColor(self._view(state), cv2.COLOR_RGB2BGR), QUALITY_RENDERED)


class LoopSource:
    """Pictures of a folder or a video, over and over, whatever the World does.

    Args:
        path: A folder of images, taken in natural order, or a video file.
        hold: Ticks for which each picture stays.

    Raises:
        ValueError: There is no picture in `path`.
    """

    def __init__(self, path: Path, *, hold: int = 1) -> None:
        self._frames = _looped(path)
        self._hold = max(hold, 1)
        self._left = self._hold
        try:
            self._shown = next(self._frames)
        except StopIteration:
            raise ValueError(f"{path}: no images and no video") from None

    def jpeg(self, state: np.void) -> bytes:
        """The picture of this tick; `state` plays no part."""
        if self._left == 0:
            self._shown, self._left = next(self._frames), self._hold
        self._left -= 1
        return self._shown


def letterboxed(image: npt.NDArray[Any]) -> npt.NDArray[Any]:
    """The image scaled to fit `SIZE`, its proportions kept, black around it."""
    height, width = image.shape[:2]
    if (width, height) == SIZE:
        return image
    factor = min(SIZE[0] / width, SIZE[1] / height)
    scaled = cv2.resize(
        image,
        (round(width * factor), round(height * factor)),
        interpolation=cv2.INTER_AREA if factor < 1 else cv2.INTER_LINEAR,
    )
    canvas = np.zeros((SIZE[1], SIZE[0], 3), np.uint8)
    top, left = (SIZE[1] - scaled.shape[0]) // 2, (SIZE[0] - scaled.shape[1]) // 2
    canvas[top : top + scaled.shape[0], left : left + scaled.shape[1]] = scaled
    return canvas


def halved(jpeg: bytes) -> bytes:
    """The picture at half its width and height.

    Raises:
        ValueError: It cannot be decoded.
    """
    image = cv2.imdecode(np.frombuffer(jpeg, np.uint8), cv2.IMREAD_COLOR)
    if image is None:
        raise ValueError("no picture")
    return _encoded(cv2.resize(image, None, fx=0.5, fy=0.5), QUALITY_RENDERED)


def _encoded(image: npt.NDArray[Any], quality: int) -> bytes:
    done, data = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, quality])
    if not done:
        raise ValueError(f"image of shape {image.shape} cannot be encoded")
    return data.tobytes()


def _looped(path: Path) -> Iterator[bytes]:
    once = _folder if path.is_dir() else _video
    for _ in itertools.count():
        empty = True
        for jpeg in once(path):
            empty = False
            yield jpeg
        if empty:
            return


def _folder(path: Path) -> Iterator[bytes]:
    names = (p.name for p in path.iterdir() if p.suffix.lower() in _SUFFIXES_IMAGE)
    for name in sorted(names, key=natural_key):
        yield _image(path / name)


@functools.lru_cache(maxsize=256)
def _image(path: Path) -> bytes:
    # Kept: converting takes 10 ms a picture, too long for every tick of a fast camera.
    content = path.read_bytes()
    if _serves_as_it_is(content):
        return content
    image = cv2.imdecode(np.frombuffer(content, np.uint8), cv2.IMREAD_COLOR)
    if image is None:
        raise ValueError(f"{path}: cannot be decoded")
    return _encoded(letterboxed(image), QUALITY_CONVERTED)


def _video(path: Path) -> Iterator[bytes]:
    if not path.is_file():
        return
    capture = cv2.VideoCapture(str(path), cv2.CAP_FFMPEG)
    try:
        # Motion JPEG is a row of JPEG files; anything else must be decoded.
        size = (capture.get(cv2.CAP_PROP_FRAME_WIDTH), capture.get(cv2.CAP_PROP_FRAME_HEIGHT))
        raw = int(capture.get(cv2.CAP_PROP_FOURCC)) == _MJPG and size == SIZE
        if raw:
            capture.set(cv2.CAP_PROP_FORMAT, -1)
        while True:
            arrived, frame = capture.read()
            if not arrived:
                return
            if not raw:
                yield _encoded(letterboxed(frame), QUALITY_CONVERTED)
            elif _serves_as_it_is(jpeg := frame.tobytes()):
                yield jpeg
    finally:
        capture.release()


def _serves_as_it_is(content: bytes) -> bool:
    return is_whole(content) and jpeg_size(content) == SIZE
