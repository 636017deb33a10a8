"""JPEG files as sent by a camera: their segments, without decoding a pixel.

Some UVC cameras omit the Huffman tables (DHT), as Motion JPEG allows; decoders of still images then
fail.
"""

import functools
import random
import re
import struct

import numpy as np
import simplejpeg

from recorder.store import jpeg_segments

SOI = b"\xff\xd8"
EOI = b"\xff\xd9"
_DHT, _SOS = 0xC4, 0xDA
_SOF = frozenset(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}
_BASELINE = frozenset({0xC0, 0xC1})
_UNCODED = re.compile(rb"\xff[^\x00\xd0-\xd7\xff]")

_STAMP = re.compile(rb"tactile-rig emulator seq=(\d+) state_t_ns=(-?\d+)")


def jpeg_size(jpeg: bytes) -> tuple[int, int]:
    """Return width and height [px]."""
    for marker, _, content in jpeg_segments(jpeg):
        if marker in _SOF and len(content) >= 5:
            height, width = struct.unpack(">HH", content[1:5])
            return width, height
    raise ValueError("no SOF")


def is_whole(jpeg: bytes) -> bool:
    """Return True if the file begins with SOI, has a readable header and ends with EOI.

    Zeros after EOI are accepted: cameras pad their buffers. In a baseline file only stuffed zeros,
    restart markers and fill bytes may follow an FF of the coded picture (ITU-T T.81, B.1.1.5), so a
    torn one is detected without decoding it.
    """
    if not jpeg.endswith(EOI):
        jpeg = jpeg.rstrip(b"\0")
        if not jpeg.endswith(EOI):
            return False
    try:
        parts = list(jpeg_segments(jpeg))
        jpeg_size(jpeg)
    except ValueError:
        return False
    if not any(marker in _BASELINE for marker, _, _ in parts):
        return True
    _, at, content = parts[-1]
    coded = jpeg[at + 4 + len(content) : -len(EOI)]
    return _UNCODED.search(coded) is None


def with_huffman_tables(jpeg: bytes) -> bytes:
    """Return the file with the standard tables added if it has none, else unchanged."""
    for marker, at, _ in jpeg_segments(jpeg):
        if marker == _DHT:
            return jpeg
        if marker == _SOS:
            return jpeg[:at] + huffman_segment() + jpeg[at:]
    raise ValueError("no SOS")


@functools.cache
def huffman_segment() -> bytes:
    """Return the tables implied by a stream without DHT (ITU-T T.81, Annex K.3), as one segment.

    Every file that libjpeg encodes without optimisation has them.
    """
    sample = simplejpeg.encode_jpeg(np.zeros((16, 16, 3), np.uint8))
    tables = b"".join(content for marker, _, content in jpeg_segments(sample) if marker == _DHT)
    return b"\xff\xc4" + struct.pack(">H", len(tables) + 2) + tables


def stamped(jpeg: bytes, seq: int, t_ns: int) -> bytes:
    """Return the file with frame number and time of the World's state in a comment after SOI."""
    text = b"tactile-rig emulator seq=%d state_t_ns=%d" % (seq, t_ns)
    return SOI + b"\xff\xfe" + struct.pack(">H", len(text) + 2) + text + jpeg[2:]


def frame_stamp(jpeg: bytes) -> tuple[int, int] | None:
    """Return frame number and time of the World's state [ns], or None without a stamp."""
    if jpeg[2:4] != b"\xff\xfe":
        return None
    length = int.from_bytes(jpeg[4:6], "big")
    match = _STAMP.fullmatch(jpeg[6 : 4 + length])
    return None if match is None else (int(match[1]), int(match[2]))


# Line between the parts of an MJPEG stream over HTTP that emulators send.
BOUNDARY = "tactile-rig-frame"


def multipart(jpeg: bytes) -> bytes:
    """Return the file as a part of an MJPEG stream."""
    head = f"--{BOUNDARY}\r\nContent-Type: image/jpeg\r\nContent-Length: {len(jpeg)}\r\n\r\n"
    return head.encode() + jpeg + b"\r\n"


def torn(jpeg: bytes, rng: random.Random) -> bytes:
    """Return the frame with its middle third replaced by noise, beginning and end intact."""
    third = len(jpeg) // 3
    return jpeg[:third] + rng.randbytes(third) + jpeg[2 * third :]
