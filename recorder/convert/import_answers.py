"""Answers to what recordings made elsewhere do not tell, and the error that asks for one."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, fields, replace
from fnmatch import fnmatch
from typing import Any, Literal, Self, get_args

from recorder.errors import SessionError

# What a file can be read as; `skip` leaves it out.
As = Literal["video", "force", "taxels", "pose", "width", "values", "skip"]
KINDS: tuple[As, ...] = get_args(As)
# Order of the 48 numbers of a row: x y z of each taxel in turn, or x of all taxels, then y, then z.
TaxelOrder = Literal["taxel", "axis"]
ORDERS: tuple[TaxelOrder, ...] = get_args(TaxelOrder)


def rate_option(kind: As) -> str:
    """Return the field of `Answers` with the rates of files of a kind."""
    return {"video": "fps", "taxels": "taxels_hz"}.get(kind, "force_hz")


def default_stream(kind: As) -> str:
    """Return the name of the first stream of a kind."""
    return "camera" if kind == "video" else kind


class MissingAnswer(SessionError):
    """Raised for what the recording cannot tell; an option answers it, or a person at a terminal.

    Attributes:
        option: Option that answers, without dashes and with underscores.
        choices: Allowed answers; empty if there are too many to list.
    """

    def __init__(self, option: str, message: str, choices: Sequence[str] = ()) -> None:
        known = f" ({' or '.join(choices)})" if choices else ""
        super().__init__(f"{message}; say --{option.replace('_', '-')}{known}")
        self.option, self.choices = option, tuple(choices)


@dataclass(frozen=True, slots=True)
class Answers:
    """Answers to what the files of a recording cannot tell; stored in the session, for `--like`."""

    sensor: str = ""
    """Name of the sensor."""
    indenter: str = ""
    """Name of what touched it."""
    by_name: bool = False
    """True if each recording is named after what touched it: `ball_2` is `ball`."""
    operator: str = ""
    """Person who made the recordings."""
    kinds: tuple[str, ...] = ()
    """`PATTERN=KIND`: files, topics and features of these names are of that kind."""
    fps: tuple[str, ...] = ()
    """Images per second, `[STREAM=]HZ`."""
    force_hz: tuple[str, ...] = ()
    """Rows of forces per second, likewise; of widths and poses too."""
    taxels_hz: tuple[str, ...] = ()
    """Scans of taxels per second, likewise."""
    taxel_order: TaxelOrder | None = None
    """Order of the numbers in a row of taxels."""
    units: str | None = None
    """Unit of forces without a unit."""
    torque_units: str | None = None
    """Unit of torques without a unit."""
    width_unit: str | None = None
    """Unit of the width of a gripper: m or mm."""
    ignore: tuple[str, ...] = ()
    """Columns of CSV files to leave out."""
    stills: bool = False
    """True if each picture of a folder shows a contact of its own."""
    trim: bool = False
    """True to cut all tracks of a recording to the shortest."""
    no_contact: tuple[str, ...] = ()
    """`[RECORDING=]START:END` without contact [s]; of single pictures the name of one."""
    press: tuple[str, ...] = ()
    """`[RECORDING=]START:END` of a contact [s], or `none`; without one they are looked for."""
    lag: float | None = None
    """Seconds by which images or taxels show a contact later than the force, on their clocks."""
    contact_frame: tuple[float, ...] = ()
    """x y z [m] and rotation vector [rad] of the contact frame in which poses give a depth."""

    def rate(self, kind: As, stream: str) -> float | None:
        """Return the stated rate of a stream (empty: the first of its kind), or None.

        Raises:
            SessionError: Not a rate.
        """
        option, rate = rate_option(kind), None
        for text in getattr(self, option):
            name, equals, value = text.rpartition("=")
            if not equals or name == (stream or default_stream(kind)):
                rate = _rate(option, value)
        return rate

    def kind(self, name: str) -> As | None:
        """Return the stated kind of a file, topic or feature; None if none is stated."""
        stated: As | None = None
        for text in self.kinds:
            pattern, _, kind = text.rpartition("=")
            if not pattern or kind not in KINDS:
                raise SessionError(
                    f"--as: found {text!r}; allowed: PATTERN=KIND with a KIND of {', '.join(KINDS)}"
                )
            if fnmatch(name, pattern):
                stated = next(each for each in KINDS if each == kind)
        return stated

    def spans(self, option: str, take: str) -> list[str]:
        """Return an option's texts for a recording: those with its name, else those without."""
        texts = [text.rpartition("=") for text in getattr(self, option)]
        own = [value for name, equals, value in texts if equals and name == take]
        return own or [value for _, equals, value in texts if not equals]

    def to_json(self) -> dict[str, Any]:
        """Return the answers that were given."""
        defaults = Answers()
        return {
            name: list(value) if isinstance(value, tuple) else value
            for name, value in asdict(self).items()
            if value != getattr(defaults, name)
        }

    @classmethod
    def from_json(cls, stored: Any, where: str) -> Self:
        """Return stored answers.

        Raises:
            SessionError: They are none.
        """
        known = {field.name for field in fields(cls)}
        if not isinstance(stored, dict) or not stored.keys() <= known:
            raise SessionError(f"{where}: holds no answers of an import")
        return cls().with_values(stored)

    def with_values(self, values: Mapping[str, Any]) -> Self:
        """Return the answers with others in place of some; lists become tuples."""
        given: dict[str, Any] = {
            name: tuple(value) if isinstance(value, list) else value
            for name, value in values.items()
        }
        return replace(self, **given)


def _rate(option: str, text: str) -> float:
    flag = "--" + option.replace("_", "-")
    try:
        value = float(text)
    except ValueError:
        raise SessionError(f"{flag}: found {text!r}; allowed: numbers, or NAME=number") from None
    if not 0 < value <= 100_000:
        raise SessionError(f"{flag}: found {value:g}; allowed: above 0 to 100000")
    return value


def indenter_of(take: str, answers: Answers) -> str:
    """Return the name of what touched the sensor in a recording."""
    if answers.indenter:
        return answers.indenter
    by_name = re.sub(r"[_\-. ]*\d+$", "", take)
    if not answers.by_name or not by_name:
        raise MissingAnswer(
            "indenter",
            f"{take}: nothing tells what touched the sensor; --by-name would call it "
            f"{by_name or take!r}",
        )
    return by_name
