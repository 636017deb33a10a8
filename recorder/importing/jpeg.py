"""JPEG files as cameras send them: some lack the Huffman tables, which decoders of stills need."""

import functools
import struct

import numpy as np

from recorder import images
from recorder.errors import SessionError

_SOI, _EOI = b"\xff\xd8", b"\xff\xd9"
_DHT, _SOS = 0xC4, 0xDA
_STANDALONE = frozenset(range(0xD0, 0xD9)) | {0x01}


def whole_jpeg(jpeg: bytes, where: str) -> tuple[bytes, bool]:
    """Return the file with Huffman tables, and whether they had to be put in.

    What stands behind the end marker (cameras pad their buffers) is left as it is.

    Args:
        jpeg: One file.
        where: What it is called in errors.

    Raises:
        SessionError: No JPEG, or cut short.
    """
    if not jpeg.rstrip(b"\0").endswith(_EOI):
        raise SessionError(f"{where}: no whole JPEG: it does not end with one's end marker")
    tables, at = _header(jpeg, where)
    if tables:
        return jpeg, False
    return jpeg[:at] + _standard_tables() + jpeg[at:], True


def _header(jpeg: bytes, where: str) -> tuple[bool, int]:
    """Whether there are Huffman tables, and the place of SOS."""
    if jpeg[:2] != _SOI:
        raise SessionError(f"{where}: no JPEG: it begins with {jpeg[:2]!r}")
    at, tables = 2, False
    while at + 4 <= len(jpeg) and jpeg[at] == 0xFF:
        marker = jpeg[at + 1]
        if marker == 0xFF or marker in _STANDALONE:
            at += 1 if marker == 0xFF else 2
            continue
        if marker == _SOS:
            return tables, at
        tables = tables or marker == _DHT
        at += 2 + int(struct.unpack_from(">H", jpeg, at + 2)[0])
    raise SessionError(f"{where}: no whole JPEG: its header ends before a picture")


@functools.cache
def _standard_tables() -> bytes:
    """The tables a file without any means (ITU-T T.81, Annex K.3), as an encoder writes them."""
    sample = images.encode_jpeg(np.zeros((16, 16, 3), np.uint8), 90)
    at, found = 2, b""
    while sample[at + 1] != _SOS:
        length = 2 + int(struct.unpack_from(">H", sample, at + 2)[0])
        if sample[at + 1] == _DHT:
            found += sample[at : at + length]
        at += length
    return found
