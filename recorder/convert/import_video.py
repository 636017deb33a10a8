"""Images from a video file or a folder, as the camera's original JPEG bytes where possible."""

import functools
import io
import mmap
import struct
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from recorder.convert.import_tracks import Film, Times, every, problems, rate_of, require_rate
from recorder.errors import SessionError
from recorder.natural_order import naturally_sorted
from recorder.store import images

# Motion JPEG in an AVI file: the camera's JPEG files are extracted without decoding.
#
# RIFF is a tree of chunks `FOURCC | uint32 size | content`, padded to even sizes; `RIFF` and `LIST`
# chunks hold a form type and further chunks. A stream's header is `strh` (kind, codec, and rate as
# dwRate / dwScale) followed by `strf` (BITMAPINFOHEADER), both in `LIST hdrl`. Its frames are the
# chunks `NNdc` or `NNdb` of `LIST movi`, where NN is the number of the stream. Files beyond 1 GB
# continue in further `RIFF AVIX` chunks (OpenDML). Source: Microsoft, "AVI RIFF File
# Reference"; Matrox, "OpenDML AVI File Format Extensions", 1.02.

_HEAD = struct.Struct("<4sI")
_STRH = struct.Struct("<4s4sIHHIIIII")
_GROUPS = (b"RIFF", b"LIST")
_MJPEG = (b"MJPG", b"mjpg")


@dataclass(frozen=True, slots=True)
class MotionJpeg:
    """Frames of an AVI file."""

    rate_hz: float
    """Frames per second, from the stream's header."""
    frames: list[bytes]
    """One JPEG file per frame; empty for a dropped frame that has a place in the file."""


def read_avi(path: Path) -> MotionJpeg | None:
    """Return the frames of an AVI file with a Motion JPEG stream; None for any other file."""
    with path.open("rb") as file:
        if file.read(12)[:4] != b"RIFF":
            return None
        with mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as data:
            return _read(path, data)


def _read(path: Path, data: mmap.mmap) -> MotionJpeg | None:
    if data[8:12] != b"AVI ":
        return None
    number, rate_hz = -1, 0.0
    streams = 0
    frames: list[bytes] = []
    for kind, start, size in _chunks(path, data, 0, len(data)):
        if kind == b"strh":
            if data[start : start + 4] == b"vids" and number < 0:
                codec = data[start + 4 : start + 8]
                number, rate_hz = streams, _rate(path, data, start, size)
                mjpeg = codec in _MJPEG
            streams += 1
        elif kind == b"strf" and number == streams - 1:
            # If the header's codec name is empty, that of the picture format applies.
            mjpeg = mjpeg or data[start + 16 : start + 20] in _MJPEG
        elif number >= 0 and kind in (b"%02ddc" % number, b"%02ddb" % number):
            if not mjpeg:
                return None
            frames.append(bytes(data[start : start + size]))
    if number < 0 or not frames:
        raise SessionError(f"{path.name}: an AVI file without a frame of video")
    return MotionJpeg(rate_hz, frames)


def _chunks(path: Path, data: mmap.mmap, at: int, end: int) -> Iterator[tuple[bytes, int, int]]:
    """Yield kind, offset and size of every chunk that is not a group, in file order."""
    while at + _HEAD.size <= end:
        kind, size = _HEAD.unpack_from(data, at)
        start = at + _HEAD.size
        if start + size > end:
            missing = start + size - end
            raise SessionError(
                f"{path.name}: cut short: chunk {kind!r} at byte {at} lacks {missing} bytes"
            )
        if kind in _GROUPS:
            yield from _chunks(path, data, start + 4, start + size)
        else:
            yield kind, start, size
        at = start + size + size % 2


def _rate(path: Path, data: mmap.mmap, start: int, size: int) -> float:
    if size < _STRH.size:
        raise SessionError(f"{path.name}: stream header of {size} bytes; expected {_STRH.size}")
    fields = _STRH.unpack_from(data, start)
    scale, rate = fields[6], fields[7]
    if not scale or not rate:
        raise SessionError(f"{path.name}: its stream says no rate; say --fps")
    return require_rate(rate / scale, f"{path.name}: its header's rate")


# JPEG files from cameras: some have no Huffman tables, which still-image decoders need.

# First bytes of a JPEG file, and its last.
JPEG, _EOI = b"\xff\xd8", b"\xff\xd9"
_DHT = 0xC4


def whole_jpeg(jpeg: bytes, where: str) -> tuple[bytes, bool]:
    """Return the file with Huffman tables, True if they were inserted; padding stays behind."""
    if not jpeg.rstrip(b"\0").endswith(_EOI):
        raise SessionError(f"{where}: no whole JPEG: it does not end with one's end marker")
    if jpeg[:2] != JPEG:
        raise SessionError(f"{where}: no JPEG: it begins with {jpeg[:2]!r}")
    try:
        *parts, (_, at, _) = images.jpeg_segments(jpeg)
    except ValueError:
        raise SessionError(f"{where}: no whole JPEG: its header ends before a picture") from None
    if any(marker == _DHT for marker, _, _ in parts):
        return jpeg, False
    return jpeg[:at] + _standard_tables() + jpeg[at:], True


@functools.cache
def _standard_tables() -> bytes:
    """Return the default tables (ITU-T T.81, Annex K.3) for a file without any."""
    sample = images.encode_jpeg(np.zeros((16, 16, 3), np.uint8), 90)
    parts = images.jpeg_segments(sample)
    tables = ((at, at + 4 + len(content)) for marker, at, content in parts if marker == _DHT)
    return b"".join(sample[start:end] for start, end in tables)


# Rows, columns [px] and bits per channel; 32 are floats.
Size = tuple[int, int, int]
_Load = Callable[[], Iterator[Any]]
# How pixels are stored, by their bits per channel.
_STORED = {
    8: "decoded and stored as pixels, losslessly",
    16: "decoded and stored as pixels of 8 bits, 65535 as 255",
    32: "decoded and stored as pixels of 8 bits, 1.0 as 255",
}
IMAGE_SUFFIXES = (".jpg", ".jpeg", ".png", ".bmp", ".tif", ".tiff")
_JPEG_SUFFIXES = (".jpg", ".jpeg")


def open_film(path: Path, fps: float | None, *, stills: bool = False) -> Film:
    """Return the images of a video file, or of a folder in natural order of the names.

    Without `fps` [Hz], the times are those of the video. `stills` are pictures of a folder that
    show a contact each: they have no times, and are numbered one second apart.
    """
    if path.is_dir():
        return _folder(path, fps, stills)
    if not path.is_file():
        raise SessionError(f"{path}: no such video file or folder")
    motion = read_avi(path)
    if motion is None:
        return _decoded(path, fps)
    name, rate_hz, by = path.name, fps or motion.rate_hz, "--fps" if fps else "its header"
    numbers = [number for number, frame in enumerate(motion.frames) if frame]
    dropped = len(motion.frames) - len(numbers)
    if not numbers:
        raise SessionError(f"{name}: no image in any of its {dropped} frames")
    files = [(f"{name}: frame {number}", motion.frames[number]) for number in numbers]
    film = film_of_files(name, files, every(numbers, rate_hz), f"{rate_hz:g} images/s by {by}")
    if dropped:
        film.assumed.append(f"{name}: {dropped} dropped frames, left out in their time")
    return replace(film, rate_hz=rate_hz)


def _folder(path: Path, fps: float | None, stills: bool) -> Film:
    pictures = (entry for entry in path.iterdir() if entry.suffix.lower() in IMAGE_SUFFIXES)
    files = naturally_sorted(pictures, lambda entry: entry.name)
    if not files:
        raise SessionError(f"{path}: no image; known: {', '.join(IMAGE_SUFFIXES)}")
    if fps is None and not stills:
        raise SessionError(
            f"{path}: a folder says no rate; say --fps, or --stills if each picture is a contact "
            "of its own"
        )
    rate_hz = 1.0 if stills or fps is None else fps
    times = f"{rate_hz:g} images/s by --fps"
    if stills:
        times = "single pictures without times, numbered one second apart"
    times += f", in order of the names, {files[0].name} first"
    named = [(file.name, file) for file in files]
    film = film_of_files(path.name, named, every(range(len(files)), rate_hz), times)
    return replace(film, rate_hz=rate_hz, names=[file.name for file in files] if stills else [])


def _decoded(path: Path, fps: float | None) -> Film:
    import cv2

    capture = cv2.VideoCapture(str(path), cv2.CAP_FFMPEG)
    try:
        nominal = float(capture.get(cv2.CAP_PROP_FPS))
        declared = int(capture.get(cv2.CAP_PROP_FRAME_COUNT))
        size = tuple(int(capture.get(p)) for p in (4, 3))
        if not capture.isOpened() or min(size) < 1:
            raise SessionError(f"{path.name}: OpenCV finds no video in it")
        require_pixels(path.name, size[0], size[1])
        # The packets say how many images there are, and when: a header's count is a promise.
        seconds = []
        while capture.grab():
            seconds.append(1e-3 * float(capture.get(cv2.CAP_PROP_POS_MSEC)))
    finally:
        capture.release()
    count = len(seconds)
    if not count:
        raise SessionError(f"{path.name}: OpenCV finds no video in it")
    if count < declared:
        raise SessionError(f"{path.name}: cut short: {count} of {declared} images can be decoded")
    times, rate_hz, timing = _stamped(path.name, np.array(seconds), nominal, fps)

    def load() -> Iterator[Any]:
        again = cv2.VideoCapture(str(path), cv2.CAP_FFMPEG)
        try:
            for index in range(count):
                arrived, image = again.read()
                if not arrived:
                    raise SessionError(
                        f"{path.name}: cut short: {index} of {count} images can be decoded"
                    )
                yield np.ascontiguousarray(image[:, :, ::-1])
        finally:
            again.release()

    assumed = [timing, f"{path.name}: {_STORED[8]}"]
    return Film("zstd", (size[0], size[1]), rate_hz, times, load, assumed)


# Stamps that depart from even steps by more than this fraction of a period are times of their own.
_UNEVEN = 0.1


def _stamped(
    name: str, seconds: NDArray[np.float64], nominal: float, fps: float | None
) -> tuple[Times, float, str]:
    """Return times [ns] and rate of a video's images, and a message on where they come from."""
    count, steps = len(seconds), np.diff(seconds)
    rate_hz, by = nominal, "its header"
    if fps is not None:
        rate_hz, by = fps, "--fps"
    elif count > 1 and (steps > 0).all():
        middle = float(np.median(steps))
        if float(np.abs(steps - middle).max()) > _UNEVEN * middle:
            times = np.round(1e9 * (seconds - seconds[0])).astype(np.int64)
            message = f"{name}: times by its own stamps, steps {1e3 * steps.min():.1f} to "
            return times, 1.0 / middle, f"{message}{1e3 * steps.max():.1f} ms"
        # Evenly spaced stamps are rounded in the file; the header's rate is exact.
        if abs(nominal * middle - 1) >= 0.01:
            rate_hz, by = (count - 1) / float(seconds[-1] - seconds[0]), "its stamps"
    elif not nominal > 0:
        raise SessionError(f"{name}: says no rate; say --fps")
    return every(range(count), rate_hz), rate_hz, f"{name}: {rate_hz:g} images/s by {by}"


def film_of_pictures(
    source: str, sizes: Sequence[Size], t_ns: Times, load: _Load, *, jpeg: bool, times: str
) -> Film:
    """Return pictures of a source with times of its own; `times` says where these are from.

    `load` yields the bytes of JPEG files, if `jpeg`, else pixels.
    """
    height, width, bits = _same_size(sizes, source)
    assumed = [f"{source}: {times}, {'bytes as they were' if jpeg else _STORED[bits]}"]
    if bits > 8:
        load = _in_8_bits(source, 65535 if bits == 16 else 1, load)
    codec = "jpeg" if jpeg else "zstd"
    return Film(codec, (height, width), rate_of(t_ns), t_ns, load, assumed)


def film_of_files(
    source: str, files: Sequence[tuple[str, Path | bytes]], t_ns: Times, times: str
) -> Film:
    """Return pictures by name and file at times (n,) [ns]; if all are JPEG, as they are."""
    jpeg = all(
        file[:2] == JPEG if isinstance(file, bytes) else file.suffix.lower() in _JPEG_SUFFIXES
        for _, file in files
    )
    sizes: list[Size] = []
    mended = 0
    with problems() as part:
        for name, file in files:
            with part(name):
                sizes.append(size_of_picture(name, file))
                mended += jpeg and whole_jpeg(_bytes(file), name)[1]

    def load() -> Iterator[Any]:
        for name, file in files:
            yield whole_jpeg(_bytes(file), name)[0] if jpeg else pixels_of_picture(name, file)

    film = film_of_pictures(source, sizes, t_ns, load, jpeg=jpeg, times=times)
    if mended:
        text = f"{source}: standard Huffman tables put into {mended} images that had none"
        film.assumed.append(text)
    return film


def _bytes(file: Path | bytes) -> bytes:
    return file if isinstance(file, bytes) else file.read_bytes()


# Pixels of the largest picture; decoded, it takes 100 MB.
_PIXELS_MAX = 1 << 25
# Bits per channel by Pillow's mode, if it can be shown as RGB exactly; 32 are floats.
_BITS = dict.fromkeys(("1", "L", "LA", "P", "PA", "RGB", "RGBA", "YCbCr"), 8)
_BITS |= {"I;16": 16, "I;16L": 16, "I;16B": 16, "F": 32}


def require_pixels(name: str, height: int, width: int) -> None:
    """Refuse the size of a picture that no camera has, before anything is allocated for it."""
    if height < 1 or width < 1 or height * width > _PIXELS_MAX:
        raise SessionError(f"{name}: found {width}x{height}; allowed: up to {_PIXELS_MAX} pixels")


@contextmanager
def _opened(name: str, picture: Path | bytes) -> Iterator[tuple[Image.Image, int]]:
    """Yield a picture that is still to be decoded, and its bits per channel."""
    file = io.BytesIO(picture) if isinstance(picture, bytes) else picture
    if isinstance(file, Path) and not file.is_file():
        raise SessionError(f"{name}: found no file")
    try:
        with Image.open(file, formats=("PNG", "BMP", "TIFF", "JPEG", "WEBP")) as image:
            require_pixels(name, image.height, image.width)
            pages = 1 if image.format == "MPO" else getattr(image, "n_frames", 1)
            if image.mode not in _BITS or pages > 1:
                raise SessionError(
                    f"{name}: found {pages} pictures of mode {image.mode}; allowed: one, grey or "
                    "RGB of 8 or 16 bits, or of floats from 0 to 1"
                )
            # Of 16 bits in each of several channels, Pillow returns the upper 8.
            yield image, 16 if ";16" in str(image.tile) else _BITS[image.mode]
    except (OSError, SyntaxError, ValueError, Image.DecompressionBombError) as error:
        raise SessionError(f"{name}: no whole picture: {error}") from error


def size_of_picture(name: str, picture: Path | bytes) -> Size:
    """Return the size of the content of a picture's file."""
    with _opened(name, picture) as (image, bits):
        return image.height, image.width, bits


def pixels_of_picture(name: str, picture: Path | bytes) -> Any:
    """Return the pixels (h, w, 3) RGB of a picture's file: uint8, or uint16 or floats if so."""
    with _opened(name, picture) as (image, bits):
        if _BITS[image.mode] > 8:
            return np.repeat(np.asarray(image)[..., None], 3, axis=2)
        pixels = np.asarray(image.convert("RGB"))
        return pixels if bits == 8 else pixels * np.uint16(257)


def _in_8_bits(name: str, full: int, load: _Load) -> _Load:
    """Return `load` with pictures scaled from `full` to 255, all by one factor."""
    spans = np.array([(image.min(), image.max()) for image in load()])
    low, high = float(spans[:, 0].min()), float(spans[:, 1].max())
    if not (low >= 0 and full / 4 <= high <= full):
        raise SessionError(
            f"{name}: found values from {low:g} to {high:g}, to be stored in 8 bits; allowed: from "
            f"0 to at least {full / 4:g}, so that grey levels are left, and at most {full}"
        )
    return lambda: (np.rint(image * (255 / full)).astype(np.uint8) for image in load())


def _same_size(sizes: Sequence[Size], name: str) -> Size:
    text = "{1}x{0} with {2} bits".format
    for index, size in enumerate(sizes):
        if size != sizes[0]:
            found, first = text(*size), text(*sizes[0])
            raise SessionError(f"{name}: image {index} is {found}, the first {first}")
    return sizes[0]
