"""What a check reports."""

from dataclasses import dataclass

# Everything that a check can find, by code.
CODES = {
    "unfinished": "the session was not closed",
    "metadata": "a zarr.json that is missing or not as the format has it",
    "wrong-dtype": "an array of another type, shape or unit than its stream prescribes",
    "missing-units": "an array that does not say its units",
    "unequal-lengths": "columns of one stream or table of different length",
    "missing-chunk": "data that an array declares and that is not there",
    "bad-crc": "bytes that are not those that were written",
    "bad-image": "an image that is no whole JPEG",
    "torn-tail": "a shard that was never sealed",
    "journal-left": "rows, or room for them, that were never stored as chunks",
    "time-order": "times that repeat or run backward",
    "clock-step": "a step between the host's clock and the device's",
    "gap": "a longer time without samples",
    "dropped": "sequence numbers that are missing",
    "frozen": "the same image or value over and over",
    "truncated": "a stream that ends before the recording does",
    "nan": "values that are no numbers",
    "segment-outside": "a phase that its streams do not cover, or that points nowhere",
    "frames-length": "a frames view that does not fit the segments",
}


@dataclass(frozen=True, slots=True)
class Finding:
    """One thing that is wrong, and where."""

    code: str
    """One of `CODES`; of an archive, one of `archive.check.CODES`."""
    where: str
    """Path inside the session."""
    message: str
    """What was found and what was expected, with the place and time of the first occurrence."""

    def __str__(self) -> str:
        """Return the line that is printed."""
        return f"{self.code:15s} {self.where}: {self.message}"
