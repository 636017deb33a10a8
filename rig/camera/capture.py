"""Opening cameras with OpenCV so that no wait is long and no frame is queued.

Some of it can be said to OpenCV only through the environment.
"""

from __future__ import annotations

import contextlib
import math
import os
from collections.abc import Iterator
from urllib.parse import urlsplit

import cv2

_OPTIONS = {
    "fflags": "nobuffer",
    "analyzeduration": "0",
    "probesize": "32",
    "fpsprobesize": "0",
    "threads": "1",
}
# No frame is held back to guess a rate from, none is queued for decoding.


def open_stream(url: str, *, open_timeout: float, read_timeout: float) -> cv2.VideoCapture:
    """A capture of the compressed frames of `url`; whether it is open, it tells itself.

    Args:
        url: http://...
        open_timeout: Until the first frame has come [s].
        read_timeout: For each later frame; `read` is False after it [s].
    """
    params = [cv2.CAP_PROP_FORMAT, -1, cv2.CAP_PROP_N_THREADS, 1]
    params += [cv2.CAP_PROP_OPEN_TIMEOUT_MSEC, max(round(open_timeout * 1e3), 1)]
    params += [cv2.CAP_PROP_READ_TIMEOUT_MSEC, max(round(read_timeout * 1e3), 1)]
    options = "|".join(f"{name};{value}" for name, value in _OPTIONS.items())
    # A camera on the bench is never behind a proxy, whatever the environment says.
    host = urlsplit(url).hostname or ""
    with _environment(OPENCV_FFMPEG_CAPTURE_OPTIONS=options, no_proxy=host):
        return cv2.VideoCapture(url, cv2.CAP_FFMPEG, params)


def open_node(address: str, *, first_timeout: float) -> cv2.VideoCapture:
    """A capture of a V4L2 camera; whether it is open, it tells itself.

    Args:
        address: The device file, or its number.
        first_timeout: For the first frame [s], rounded up to whole seconds; for later ones, wait
            with `cv2.VideoCapture.waitAny`.
    """
    target = int(address) if address.isdecimal() else address
    seconds = max(math.ceil(first_timeout), 1)
    # Read by OpenCV once in a process, when it waits for the first frame: so it stays set.
    os.environ.setdefault("OPENCV_VIDEOIO_V4L_SELECT_TIMEOUT", str(seconds))
    return cv2.VideoCapture(target, cv2.CAP_V4L2)


@contextlib.contextmanager
def _environment(**wanted: str) -> Iterator[None]:
    before = {name: os.environ.get(name) for name in wanted}
    os.environ.update(wanted)
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value
