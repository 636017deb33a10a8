"""JPEG files as some cameras send them."""

from recorder.store import jpeg_segments
from rig.devices.camera.jpeg import SOI, frame_stamp


def stripped(jpeg: bytes) -> bytes:
    """Return the JPEG without its Huffman tables, as some UVC cameras send it."""
    bare = jpeg
    for marker, at, content in reversed(list(jpeg_segments(jpeg))):
        if marker == 0xC4:
            bare = bare[:at] + bare[at + 4 + len(content) :]
    return bare


def without_stamp(jpeg: bytes) -> bytes:
    """Return the file as it was before `stamped`."""
    if frame_stamp(jpeg) is None:
        return jpeg
    return SOI + jpeg[4 + int.from_bytes(jpeg[4:6], "big") :]
