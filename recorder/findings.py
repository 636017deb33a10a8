"""Findings reported by a check: faults and warnings, which fail it, and notes, which do not."""

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Literal

# Codes of the faults of a session.
CODES = {
    "unfinished": "the session was not closed",
    "metadata": "a zarr.json that is missing or does not match the format",
    "wrong-dtype": "an array whose type, shape or unit differs from its stream's specification",
    "manifest": "a file that was removed, added or changed after its run was closed",
    "missing-units": "an array without units",
    "unequal-lengths": "columns of one stream or table of different lengths",
    "missing-chunk": "a chunk that an array declares but that does not exist",
    "bad-crc": "bytes that differ from those written",
    "bad-image": "an image that is not a complete JPEG",
    "torn-tail": "a shard that was never sealed",
    "journal-left": "rows, or space reserved for them, never stored as chunks",
    "time-order": "times that repeat or run backward",
    "clock-step": "a step between the host's clock and the device's",
    "missing-array": "a stream, table or column that the session declares and does not have",
    "gap": "an unusually long time without samples, none of which is lost",
    "dropped": "lost samples, by sequence numbers, the device's clock or the declared rate",
    "seq-order": "sequence numbers that repeat or run backward",
    "rate": "a device that ran at another rate than declared",
    "frozen": "the same image or value repeated",
    "truncated": "a stream that ends before the recording does",
    "clipped": "a force at a limit of its device: it was larger than recorded",
    "nan": "values that are not numbers",
    "segment-outside": "a phase that its streams do not cover, or that has an invalid reference",
    "frames-length": "a frames view that does not match the segments",
}
# Codes of the warnings: values that are stored as they came, and can hardly be true.
WARNINGS = {
    "impossible": "a value that no device of this rating sends",
    "untrusted": "samples that the device marks as invalid",
    "clear-force": "a force while nothing is touched",
    "wrong-sign": "a pull while the skin is pressed, or taxels that fall below a press",
    "scale": "a force of another size than the skin's, or than other presses of that depth have",
    "depth-force": "a force that does not rise with the depth",
    "force-step": "a force that is another one from one sample to the next",
    "held": "a gauge or taxels that repeat their values for a part of a second",
    "shear-direction": "side forces that do not follow the shear, or of one axis alone",
    "torque": "torques that are not those of the force at the tip, or at any place",
    "pose-speed": "poses that no arm can have: their speed, jump, reach or turn",
    "pose-place": "presses away from their planned place, a turned tool, or an arm that stands",
    "dark": "pictures without contrast",
    "turned": "pictures or taxels that are turned, mirrored or exchanged",
    "odd-image": "a picture unlike both of its neighbours, which are alike",
    "image-jump": "a picture that is another one all at once",
    "still-image": "pictures that do not change in a press, or come again",
    "force-time": "a gauge that shows presses at other times than the arm",
    "image-time": "pictures or taxels that show presses at other times than force or arm",
    "dead-taxel": "a taxel that always has one value while others change",
    "control": "a press that is repeated at the end, with another force or picture",
}
# Codes of the notes on a session: limits of what it can tell, which are no faults of its data.
NOTES: dict[str, str] = {
    "stalled": "times at which the computer stood still, which explain gaps and frozen values",
    "bench": "a state of bench or computer when a run began",
    "stopped": "why the recording ended early",
    "slow": "an arm that moved slower than planned, by the speed slider of its pendant",
    "unverified": "shown by no known weight, shear or set-up: scale, orientation, side axes",
    "uncalibrated": "a signal whose latency was not measured: an interval is assumed",
    "drops-unseen": "a device without numbers and times: drops are inferred, or not seen",
    "sealed-later": "a manifest that was lost and made again: earlier changes cannot be seen",
}


@dataclass(frozen=True, slots=True)
class Finding:
    """One fault, warning or note, and its location."""

    code: str
    """One of `CODES`, `WARNINGS`, `NOTES`; archives have others (docs/reference/data-format.md)."""
    where: str
    """Path inside the session."""
    message: str
    """Value found and value expected, with the place and time of the first occurrence."""

    @property
    def level(self) -> Literal["note", "warning", "fault"]:
        """Return `note` or `warning` if the code is one of those, else `fault`."""
        if self.code in NOTES:
            return "note"
        return "warning" if self.code in WARNINGS else "fault"

    def __str__(self) -> str:
        level = "" if self.level == "fault" else f"{self.level}: "
        return f"{self.code:15s} {level}{self.where}: {self.message}"


def faults(findings: Iterable[Finding]) -> list[Finding]:
    """Return the findings that are faults, in order."""
    return [finding for finding in findings if finding.level == "fault"]
