"""Tracks of recordings made elsewhere, and answers to what their files do not tell."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field, fields, replace
from fnmatch import fnmatch
from pathlib import Path
from typing import Any, Literal, Self, get_args

import numpy as np
from numpy.typing import ArrayLike, NDArray

from recorder.errors import SessionError
from recorder.session.align import NS

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


def option_flag(option: str) -> str:
    """Return the option of the command that sets a field of `Answers`."""
    return "--" + option.replace("_", "-")


class MissingAnswer(SessionError):
    """Raised for what the recording cannot tell; an option answers it, or a person at a terminal.

    Attributes:
        option: Option that answers, without dashes and with underscores.
        choices: Allowed answers; empty if there are too many to list.
    """

    def __init__(self, option: str, message: str, choices: Sequence[str] = ()) -> None:
        known = f" ({' or '.join(choices)})" if choices else ""
        super().__init__(f"{message}; say {option_flag(option)}{known}")
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
        """Return the stated rate of a stream (empty: the first of its kind), or None."""
        option, rate = rate_option(kind), None
        for text in getattr(self, option):
            name, equals, value = text.rpartition("=")
            if not equals or name == (stream or default_stream(kind)):
                rate = _rate(option_flag(option), value)
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
        """Return stored answers."""
        if not isinstance(stored, dict) or not stored.keys() <= {one.name for one in fields(cls)}:
            raise SessionError(f"{where}: holds no answers of an import")
        return cls().with_values(stored)

    def with_values(self, values: Mapping[str, Any]) -> Self:
        """Return the answers with others in place of some; lists become tuples."""
        given: dict[str, Any] = {
            name: tuple(value) if isinstance(value, list) else value
            for name, value in values.items()
        }
        return replace(self, **given)


def _rate(flag: str, text: str) -> float:
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


Times = NDArray[np.int64]
Floats = NDArray[np.float64]

# Words in the names of files, topics and features that tell their kind; the last one counts.
WORDS: Mapping[str, As] = {
    **dict.fromkeys(("video", "image", "images", "img", "camera", "cam", "frames", "rgb"), "video"),
    **dict.fromkeys(("force", "forces", "wrench", "ft", "load", "loads", "newton"), "force"),
    **dict.fromkeys(("taxel", "taxels", "uskin", "xela", "tactile"), "taxels"),
    **dict.fromkeys(("pose", "poses", "tcp"), "pose"),
    **dict.fromkeys(("width", "widths", "opening", "gripper"), "width"),
}


@dataclass(frozen=True, slots=True)
class Film:
    """Images to import."""

    codec: str
    """`jpeg`: the camera's bytes; `zstd`: pixels."""
    shape: tuple[int, int]
    """Rows and columns of an image [px]."""
    rate_hz: float
    """Images per second."""
    t_ns: Times
    """Time of each image (n,) since the start of the recording [ns]."""
    load: Callable[[], Iterator[Any]]
    """Load the images: JPEG bytes, or RGB pixels (h, w, 3) uint8."""
    assumed: list[str] = field(default_factory=list)
    """Messages on assumptions and changes."""
    names: list[str] = field(default_factory=list)
    """Names of the files of single pictures, each of a contact of its own; empty for a film."""


@dataclass(frozen=True, slots=True)
class Numbers:
    """Rows of numbers to import."""

    value: NDArray[Any]
    """Forces (n, 6) [N, N m], NaN for axes that were not measured; counts (n, 16, 3); poses (n, 6)
    [m, rad] of position and rotation vector; widths (n, 1) [m]; or anything else (n, k)."""
    t_ns: Times
    """Times (n,) since the start of the recording [ns]."""
    rate_hz: float
    """Rows per second."""
    assumed: list[str] = field(default_factory=list)
    """Messages on assumptions and changes."""
    attrs: dict[str, Any] = field(default_factory=dict)
    """Stream attributes of forces: device, axes_measured."""


Content = Film | Numbers


@dataclass(frozen=True, slots=True)
class Track:
    """One stream of a recording."""

    stream: str
    """Name of the stream in the session."""
    kind: As
    """Kind of its content."""
    content: Content
    """Its samples."""
    source: str
    """File, topic or feature, for messages."""
    clock: str
    """Name of the clock of its times; tracks of one clock need no alignment."""

    @property
    def seconds(self) -> float:
        """Duration [s]."""
        return float(self.content.t_ns[-1]) * NS + 1.0 / self.content.rate_hz


@dataclass(frozen=True, slots=True)
class Take:
    """One recording: tracks that were recorded together."""

    name: str
    tracks: tuple[Track, ...]
    files: tuple[Path, ...]
    """Files and folders that they come from."""
    assumed: tuple[str, ...] = ()
    """Messages on assumptions and changes."""

    def first(self, kind: As) -> Track | None:
        """Return the first track of a kind; None without one."""
        return next((track for track in self.tracks if track.kind == kind), None)

    @property
    def film(self) -> Film | None:
        """Pictures of the first camera; None without one."""
        track = self.first("video")
        return track.content if track is not None and isinstance(track.content, Film) else None

    def numbers(self, kind: As) -> Numbers | None:
        """Return the numbers of the first track of a kind; None without one."""
        track = self.first(kind)
        return track.content if track is not None and isinstance(track.content, Numbers) else None


def kind_of_name(name: str) -> As | None:
    """Return the kind that a name tells by its last known word; None if it tells none."""
    words = re.findall("[a-z]+", re.sub("(?<=[a-z])(?=[A-Z])", "_", name).lower())
    return next((WORDS[word] for word in reversed(words) if word in WORDS), None)


def bare_name(stem: str) -> str:
    """Return the name of a file without the words that only tell its kind: that of its take."""
    parts = re.split("([_. -]+)", stem)
    while len(parts) > 1 and parts[-1].lower() in WORDS:
        parts = parts[:-2]
    while len(parts) > 1 and parts[0].lower() in WORDS:
        parts = parts[2:]
    return "".join(parts) if parts[0].lower() not in WORDS else ""


def named(tracks: Sequence[Track]) -> tuple[Track, ...]:
    """Return the tracks with names of streams that differ; the first of a kind has the kind's."""
    kept: list[Track] = []
    seen: set[str] = set()
    for track in tracks:
        name = track.stream or default_stream(track.kind)
        if name in seen:
            name = re.sub("[^A-Za-z0-9_]+", "_", bare_stream(track.source)).strip("_") or name
        number, unique = 2, name
        while unique in seen:
            unique, number = f"{name}_{number}", number + 1
        seen.add(unique)
        kept.append(replace(track, stream=unique))
    return tuple(kept)


def bare_stream(source: str) -> str:
    """Return a name for the stream of a file, topic or feature; it begins with a letter."""
    name = re.sub("[^A-Za-z0-9]+", "_", source.rpartition(":")[2]).strip("_")[:40]
    return name if name[:1].isalpha() else f"s_{name}"[:40]


def every(places: ArrayLike, rate_hz: float) -> Times:
    """Return times [ns] of places counted in periods of a rate."""
    return np.round(np.asarray(places) * (1e9 / rate_hz)).astype(np.int64)


def rate_of(t_ns: NDArray[np.int64]) -> float:
    """Return the usual number of rows a second at times (n,) [ns]; 1 for a single row."""
    if len(t_ns) < 2:
        return 1.0
    step = max(float(np.median(np.diff(t_ns))), 1.0)
    rate = round(1e9 / step, 3)
    # Times are whole nanoseconds, which rates such as 60 Hz do not divide.
    return rate if rate > 0 and abs(1e9 / rate - step) < 1.0 else 1e9 / step


def require_advance(t_ns: Times, where: str, second: int) -> None:
    """Refuse times (n,) that do not ascend, by the number of the row; the second one's is given."""
    if (backward := np.flatnonzero(np.diff(t_ns) <= 0)).size:
        raise SessionError(f"{where} {backward[0] + second}: its time does not advance")
