"""Wire format of ATI's stand-alone F/T controller on RS-232: commands, records in two formats.

A command ends with CR; the controller echoes it, answers, and ends with CR LF `>`:

    CD A, CD B   records as text, or binary       CD R   force and torque, not gauges
    SA n         moving average over n samples    QR     one record
    QS           endless records; any CR ends them

    text    45 bytes   `0,  -102,   -99,  -225,   -20,    39,   -39` CR LF
    binary  13 bytes   uint8 error | int16 Fx Fy Fz Tx Ty Tz, big-endian

The first field is an error number, 0 for none. The calibration sheet gives the counts per unit. A
lost byte shortens a line of text, which is detected; binary records have no start marker.
"""

from __future__ import annotations

import re
import struct
from dataclasses import dataclass
from typing import NamedTuple

from rig.devices.force.settings import RECORD_BYTES

PROMPT = b"\r\n>"
BINARY = struct.Struct(">B6h")
_TEXT = re.compile(rb"(\d)" + rb",([ \d-]{6})" * 6 + rb"\r\n")
_TEXT_EMITTED = b"%d" + b",%6d" * 6 + b"\r\n"


class SerialRecord(NamedTuple):
    """One record."""

    error: int
    """Error number of the controller; 0: none."""
    counts: tuple[int, ...]
    """Fx Fy Fz Tx Ty Tz."""


def emit(record: SerialRecord, form: str) -> bytes:
    """Return the bytes of a record, as text (`ascii`) or `binary`."""
    if form == "binary":
        return BINARY.pack(record.error, *record.counts)
    return _TEXT_EMITTED % (record.error, *record.counts)


def parse(content: bytes, form: str) -> SerialRecord | None:
    """Return the record if `content` is exactly one record, else None."""
    if len(content) != RECORD_BYTES[form]:
        return None
    if form == "binary":
        error, *counts = BINARY.unpack(content)
        return SerialRecord(error, tuple(counts))
    match = _TEXT.fullmatch(content)
    if match is None:
        return None
    try:
        error, *counts = (int(field) for field in match.groups())
    except ValueError:
        return None
    return SerialRecord(error, tuple(counts))


class Found(NamedTuple):
    """A record found in a stream."""

    record: SerialRecord
    behind: int
    """Number of bytes received after it."""
    lost: int
    """Number of records known to be lost just before it."""


class TextFramer:
    """Finds records in a stream of text; a damaged line counts as one lost record."""

    doubtful = False
    """Always False: a line is either complete or damaged."""

    def __init__(self) -> None:
        self._rest = b""
        self._lost = 0

    def feed(self, content: bytes) -> list[Found]:
        """Return the records that `content` completes."""
        *lines, self._rest = (self._rest + content).split(b"\n")
        # Noise without a line end must not accumulate.
        self._rest = self._rest[-4 * RECORD_BYTES["ascii"] :]
        behind = sum(len(line) + 1 for line in lines) + len(self._rest)
        found = []
        for line in lines:
            behind -= len(line) + 1
            record = parse(line + b"\n", "ascii")
            if record is None:
                self._lost += 1
                continue
            found.append(Found(record, behind, self._lost))
            self._lost = 0
        return found


@dataclass(slots=True)
class BinaryFramer:
    """Splits a stream into binary records, and detects likely losses of bytes.

    After a lost byte every later record is composed of parts of two. This shows as an error number
    where none was, or as a jump: the low byte of one number is the high byte of the next. A restart
    reveals where records begin; its first record counts once the second is consistent with it.
    """

    jumps: tuple[float, ...]
    """Largest change of each axis (6,) from one record to the next [counts]."""
    doubtful: bool = False
    """True if a record did not fit the previous one: only a restart shows where records begin."""
    _rest: bytes = b""
    _before: SerialRecord | None = None
    _confirmed: bool = False

    def feed(self, content: bytes) -> list[Found]:
        """Return the records that `content` completes, up to the first doubtful one."""
        self._rest += content
        found = []
        while len(self._rest) >= BINARY.size and not self.doubtful:
            error, *counts = BINARY.unpack_from(self._rest)
            record, before = SerialRecord(error, tuple(counts)), self._before
            self._rest, self._before = self._rest[BINARY.size :], record
            if before is None:
                continue
            if not self._fits(before, record):
                self.doubtful = True
                break
            behind = len(self._rest)
            if not self._confirmed:
                self._confirmed = True
                found.append(Found(before, behind + BINARY.size, 0))
            found.append(Found(record, behind, 0))
        return found

    def _fits(self, before: SerialRecord, record: SerialRecord) -> bool:
        return record.error == before.error and all(
            abs(new - old) <= most
            for new, old, most in zip(record.counts, before.counts, self.jumps, strict=True)
        )
