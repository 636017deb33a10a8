"""Wire format of ATI's stand-alone F/T controller on RS-232: commands, and records in two forms.

A command ends with CR; the controller repeats it, answers, and ends with CR LF `>`:

    CD A, CD B   records as text, or binary       CD R   force and torque, not gauges
    SA n         moving average over n samples    QR     one record
    QS           records without end; any CR ends them

    text    45 bytes   `0,  -102,   -99,  -225,   -20,    39,   -39` CR LF
    binary  13 bytes   uint8 error | int16 Fx Fy Fz Tx Ty Tz, big-endian

The first field is an error number, 0 for none. Counts become units by the calibration sheet. A lost
byte shortens a line of text, which is seen; binary records have no mark where one begins.
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


class Record(NamedTuple):
    """One record."""

    error: int
    """What the controller finds wrong; 0: nothing."""
    counts: tuple[int, ...]
    """Fx Fy Fz Tx Ty Tz."""


def emit(record: Record, form: str) -> bytes:
    """The bytes of a record, as text (`ascii`) or `binary`."""
    if form == "binary":
        return BINARY.pack(record.error, *record.counts)
    return _TEXT_EMITTED % (record.error, *record.counts)


def parse(content: bytes, form: str) -> Record | None:
    """The record that `content` is from its first byte to its last, or None."""
    if len(content) != RECORD_BYTES[form]:
        return None
    if form == "binary":
        error, *counts = BINARY.unpack(content)
        return Record(error, tuple(counts))
    match = _TEXT.fullmatch(content)
    if match is None:
        return None
    try:
        error, *counts = (int(field) for field in match.groups())
    except ValueError:
        return None
    return Record(error, tuple(counts))


class Found(NamedTuple):
    """A record and where it ended."""

    record: Record
    behind: int
    """Bytes that had come after it."""
    lost: int
    """Records known to be lost just before it."""


class TextFramer:
    """Finds the records in a stream of text: a damaged line counts as one lost record."""

    doubtful = False
    """A line is whole or it is not."""

    def __init__(self) -> None:
        self._rest = b""
        self._lost = 0

    def feed(self, content: bytes) -> list[Found]:
        """The records that are complete with `content`."""
        *lines, self._rest = (self._rest + content).split(b"\n")
        # Noise without a line's end must not pile up.
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
    """Cuts a stream of binary records, and doubts where a lost byte would show.

    After one lost byte every later record is put together of parts of two. That shows as an error
    number where none was, or as a jump: the low byte of one number is the high byte of the next.
    A new start tells where records begin; its first record counts once the second one fits it.
    """

    jumps: tuple[float, ...]
    """Largest change of each axis (6,) from one record to the next [counts]."""
    doubtful: bool = False
    """A record did not fit the one before: only a new start tells where records begin."""
    _rest: bytes = b""
    _before: Record | None = None
    _confirmed: bool = False

    def feed(self, content: bytes) -> list[Found]:
        """The records that are complete with `content`, up to the first that is doubted."""
        self._rest += content
        found = []
        while len(self._rest) >= BINARY.size and not self.doubtful:
            error, *counts = BINARY.unpack_from(self._rest)
            record, before = Record(error, tuple(counts)), self._before
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

    def _fits(self, before: Record, record: Record) -> bool:
        return record.error == before.error and all(
            abs(new - old) <= most
            for new, old, most in zip(record.counts, before.counts, self.jumps, strict=True)
        )
