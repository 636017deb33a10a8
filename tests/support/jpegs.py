"""JPEG files as some cameras send them."""

from __future__ import annotations

from rig.devices.camera.jpeg import segments


def stripped(jpeg: bytes) -> bytes:
    """Return the JPEG without its Huffman tables, as some UVC cameras send it."""
    bare = jpeg
    for marker, at, content in reversed(list(segments(jpeg))):
        if marker == 0xC4:
            bare = bare[:at] + bare[at + 4 + len(content) :]
    return bare
