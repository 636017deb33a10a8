"""Images from a video file or a folder: the camera's own JPEG bytes where there are any."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from recorder.errors import SessionError
from recorder.importing.avi import read_avi
from recorder.importing.jpeg import whole_jpeg
from recorder.natural import natural_key

_SUFFIXES = (".jpg", ".jpeg", ".png", ".bmp", ".tif", ".tiff")
_JPEG_SUFFIXES = (".jpg", ".jpeg")


@dataclass(frozen=True, slots=True)
class Film:
    """Images to import."""

    codec: str
    """`jpeg`: as the camera sent them; `zstd`: pixels."""
    shape: tuple[int, int]
    """Rows and columns of an image [px]."""
    rate_hz: float
    """Images per second."""
    places: list[int]
    """Place of each image in time, in periods from the first."""
    load: Callable[[], Iterator[Any]]
    """The images: JPEG bytes, or RGB pixels (h, w, 3) uint8."""
    assumed: list[str] = field(default_factory=list)
    """What was assumed or changed, in words."""

    @property
    def seconds(self) -> float:
        """How long it lasts [s]."""
        return (self.places[-1] + 1) / self.rate_hz


def open_film(path: Path, fps: float | None) -> Film:
    """Return the images of a video file, or of a folder in natural order of the names.

    Args:
        path: A video file or a folder.
        fps: Images per second; None: what the video says.

    Raises:
        SessionError: No images, damaged ones, unequal sizes, or a rate that nobody tells.
    """
    if path.is_dir():
        return _folder(path, fps)
    if not path.is_file():
        raise SessionError(f"{path}: no such video file or folder")
    motion = read_avi(path)
    if motion is None:
        return _decoded(path, fps)
    return _jpegs(path.name, motion.frames, fps or motion.rate_hz, said=fps is not None)


def _jpegs(name: str, frames: list[bytes], rate_hz: float, *, said: bool) -> Film:
    assumed = [f"{name}: {rate_hz:g} images/s by {'--fps' if said else 'its header'}"]
    places = [place for place, frame in enumerate(frames) if frame]
    if not places:
        raise SessionError(f"{name}: no image in any of its {len(frames)} frames")
    if len(places) < len(frames):
        assumed.append(
            f"{name}: {len(frames) - len(places)} dropped frames, left out in their time"
        )
    kept: list[bytes] = []
    mended = 0
    for place in places:
        jpeg, changed = whole_jpeg(frames[place], f"{name}: frame {place}")
        kept.append(jpeg)
        mended += changed
    if mended:
        assumed.append(f"{name}: standard Huffman tables put into {mended} images that had none")
    shape = _same_size(
        [_jpeg_size(jpeg, f"{name}: frame {k}") for k, jpeg in enumerate(kept)], name
    )
    return Film("jpeg", shape, rate_hz, places, lambda: iter(kept), assumed)


def _folder(path: Path, fps: float | None) -> Film:
    files = sorted(
        (entry for entry in path.iterdir() if entry.suffix.lower() in _SUFFIXES),
        key=lambda entry: natural_key(entry.name),
    )
    if not files:
        raise SessionError(f"{path}: no image; known: {', '.join(_SUFFIXES)}")
    if fps is None:
        raise SessionError(f"{path}: a folder says no rate; say --fps")
    if all(file.suffix.lower() in _JPEG_SUFFIXES for file in files):
        film = _jpegs(path.name, [file.read_bytes() for file in files], fps, said=True)
        film.assumed.append(f"{path.name}: in order of the names, {files[0].name} first")
        return film
    shape = _same_size([_size(file) for file in files], path.name)
    assumed = [
        f"{path.name}: {fps:g} images/s by --fps, in order of the names, {files[0].name} first",
        f"{path.name}: decoded and stored as pixels, losslessly",
    ]
    return Film("zstd", shape, fps, list(range(len(files))), lambda: map(_pixels, files), assumed)


def _decoded(path: Path, fps: float | None) -> Film:
    try:
        import cv2
    except ImportError:
        raise SessionError(
            f"{path.name}: no Motion JPEG in an AVI file, and decoding others takes OpenCV: "
            "pip install opencv-contrib-python-headless"
        ) from None
    capture = cv2.VideoCapture(str(path), cv2.CAP_FFMPEG)
    try:
        count = int(capture.get(cv2.CAP_PROP_FRAME_COUNT))
        rate_hz = fps or float(capture.get(cv2.CAP_PROP_FPS))
        size = tuple(int(capture.get(p)) for p in (4, 3))
        if not capture.isOpened() or count < 1 or min(size) < 1:
            raise SessionError(f"{path.name}: OpenCV finds no video in it")
        if not rate_hz > 0:
            raise SessionError(f"{path.name}: says no rate; say --fps")
    finally:
        capture.release()

    def load() -> Iterator[Any]:
        again = cv2.VideoCapture(str(path), cv2.CAP_FFMPEG)
        try:
            for place in range(count):
                arrived, image = again.read()
                if not arrived:
                    raise SessionError(
                        f"{path.name}: cut short: {place} of {count} images can be decoded"
                    )
                yield np.ascontiguousarray(image[:, :, ::-1])
        finally:
            again.release()

    assumed = [
        f"{path.name}: {rate_hz:g} images/s by {'--fps' if fps else 'its header'}",
        f"{path.name}: decoded and stored as pixels, losslessly",
    ]
    return Film("zstd", (size[0], size[1]), rate_hz, list(range(count)), load, assumed)


def _size(file: Path) -> tuple[int, int]:
    try:
        with Image.open(file) as image:
            return image.height, image.width
    except (OSError, SyntaxError) as error:
        raise SessionError(f"{file.name}: no image: {error}") from error


def _pixels(file: Path) -> Any:
    try:
        with Image.open(file) as image:
            return np.asarray(image.convert("RGB"))
    except (OSError, SyntaxError) as error:
        raise SessionError(f"{file.name}: damaged: {error}") from error


def _jpeg_size(jpeg: bytes, where: str) -> tuple[int, int]:
    import simplejpeg

    try:
        height, width, *_ = simplejpeg.decode_jpeg_header(jpeg)
    except ValueError as error:
        raise SessionError(f"{where}: no JPEG: {error}") from error
    return int(height), int(width)


def _same_size(sizes: list[tuple[int, int]], name: str) -> tuple[int, int]:
    for place, size in enumerate(sizes):
        if size != sizes[0]:
            first = f"{sizes[0][1]}x{sizes[0][0]}"
            raise SessionError(f"{name}: image {place} is {size[1]}x{size[0]}, the first {first}")
    return sizes[0]
