"""Record format for all data that must survive a crash, and the CRC-32C of its chunks.

A log is a file of records, one after the other, with nothing between them::

    magic   4 bytes  b"TRL1" or b"TRL2"
    nbytes  uint32   length of the payload
    crc     uint32   CRC-32C of t_ns, index and payload (TRL1) or end of the payload (TRL2)
    t_ns    int64    time of the (last) sample in the payload [ns]
    index   uint32   number of the payload in its column or journal, modulo 2**32
    payload nbytes

All little-endian. The payload of a TRL2 record is a chunk that ends with the CRC-32C of its other
bytes, as Zarr's codec `crc32c` writes it, so its bytes are summed only once. A record that is
short or whose checksum does not match was being written when the writer died; it and everything
after it are ignored.
"""

import struct

import google_crc32c

CRC_BYTES = 4
# CRC-32C of any bytes followed by their own CRC-32C.
_RESIDUE = 0x48674BC7

MAGIC = b"TRL1"
CHUNK_MAGIC = b"TRL2"
HEADER = struct.Struct("<4sIIqI")
_STAMP = struct.Struct("<qI")
_FRAME = struct.Struct("<4sII")


def packed_crc(data: bytes) -> bytes:
    """Return the checksum that Zarr's codec `crc32c` appends to a chunk."""
    return int(google_crc32c.value(data)).to_bytes(CRC_BYTES, "little")


def ends_with_its_crc(data: bytes) -> bool:
    """Return True if the last four bytes are the CRC-32C of the others."""
    return len(data) >= CRC_BYTES and google_crc32c.value(data) == _RESIDUE


def checksum(payload: bytes, t_ns: int, index: int) -> int:
    """Return the CRC-32C of a payload together with its index and time."""
    stamp = _STAMP.pack(t_ns, index & 0xFFFFFFFF)
    crc: int = google_crc32c.value(stamp + payload)
    return crc


def header(payload: bytes, t_ns: int, index: int) -> bytes:
    """Return the 24-byte header of a payload."""
    stamp = _STAMP.pack(t_ns, index & 0xFFFFFFFF)
    return _FRAME.pack(MAGIC, len(payload), google_crc32c.value(stamp + payload)) + stamp


def chunk_header(nbytes: int, crc: bytes, t_ns: int, index: int) -> bytes:
    """Return the 24-byte header of a chunk of `nbytes`, followed by its checksum `crc`."""
    stamp = _STAMP.pack(t_ns, index & 0xFFFFFFFF)
    return _FRAME.pack(CHUNK_MAGIC, nbytes + CRC_BYTES, google_crc32c.value(stamp + crc)) + stamp


def record_matches(head: bytes, payload: bytes, index: int) -> bool:
    """Return True if a header is that of a payload with this number, and its checksum matches."""
    if len(head) != HEADER.size:
        return False
    magic, nbytes, crc, t_ns, stored_index = HEADER.unpack(head)
    if nbytes != len(payload) or stored_index != index & 0xFFFFFFFF:
        return False
    if magic == MAGIC:
        return bool(crc == checksum(payload, t_ns, index))
    return (
        magic == CHUNK_MAGIC
        and crc == google_crc32c.value(head[12:] + payload[-CRC_BYTES:])
        and ends_with_its_crc(payload)
    )
