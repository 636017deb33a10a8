"""Tracks of recordings made elsewhere, and answers to what their files do not tell."""

import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager
from dataclasses import asdict, dataclass, field, fields, replace
from fnmatch import fnmatch
from pathlib import Path
from typing import Any, Literal, Self, get_args

import numpy as np
from numpy.typing import ArrayLike, NDArray

from recorder.command_line.options import numbers
from recorder.errors import SessionError
from recorder.session.align import NS

# What a file can be read as; `skip` leaves it out.
As = Literal["video", "force", "taxels", "pose", "width", "values", "skip"]
KINDS: tuple[As, ...] = get_args(As)
# Order of the 48 numbers of a row: x y z of each taxel in turn, or x of all taxels, then y, then z.
TaxelOrder = Literal["taxel", "axis"]
ORDERS: tuple[TaxelOrder, ...] = get_args(TaxelOrder)

# Newton per unit.
FORCE_UNITS = {
    "N": 1.0,
    "mN": 1e-3,
    "kN": 1e3,
    "gf": 9.80665e-3,
    "kgf": 9.80665,
    "lbf": 4.4482216152605,
}
# Newton metre per unit.
TORQUE_UNITS = {
    "N m": 1.0,
    "N mm": 1e-3,
    "mN m": 1e-3,
    "kgf cm": 9.80665e-2,
    "lbf in": 0.1129848290276167,
}


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
        allowed = f" ({' or '.join(choices)})" if choices else ""
        super().__init__(f"{message}; say {option_flag(option)}{allowed}")
        self.option, self.choices = option, tuple(choices)


# Gives the context of one of several parts of a recording, by its name.
Part = Callable[[str], AbstractContextManager[None]]


@contextmanager
def problems() -> Iterator[Part]:
    """Collect the errors of named parts of a recording, whatever a library raises, in one list."""
    found: dict[str, SessionError] = {}

    @contextmanager
    def part(name: str) -> Iterator[None]:
        try:
            yield
        except ModuleNotFoundError:
            raise
        except Exception as error:
            if not isinstance(error, SessionError):
                why = " ".join(str(error).split())[:200] or type(error).__name__
                error = SessionError(f"{name}: damaged, or no file of its kind: {why}")
            lines = str(error).split("\n- ")
            found.update(dict.fromkeys(lines[1:] or lines, error))

    yield part
    if found:
        # What can be answered is asked for when nothing else is wrong.
        wrong = [line for line, each in found.items() if not isinstance(each, MissingAnswer)]
        wrong = wrong or [*found]
        error = found[wrong[0]]
        if len(wrong) > 1:
            error.args = ("\n- ".join([f"{len(wrong)} problems:", *wrong[:100]]),)
        raise error


def _answer(value: Any, about: str, /, **option: Any) -> Any:
    """Return the field of an answer, whose metadata make its option of the command."""
    return field(default=value, metadata={"help": about, **option})


_FLAG: dict[str, Any] = {"action": "store_true", "default": None}
_RATES: dict[str, Any] = {"action": "append", "metavar": "[STREAM=]HZ"}
_SPANS: dict[str, Any] = {"action": "append", "metavar": "[NAME=]START:END"}


@dataclass(frozen=True, slots=True)
class Answers:
    """Answers to what the files of a recording cannot tell; stored in the session, for `--like`."""

    sensor: str = _answer("", "name of the sensor", metavar="NAME")
    indenter: str = _answer("", "name of what touched it", metavar="NAME")
    by_name: bool = _answer(
        False, "recordings are named after what touched: ball_1, ball_2", **_FLAG
    )
    operator: str = _answer("", "who recorded it", metavar="NAME")
    kinds: tuple[str, ...] = _answer(
        (),
        f"files, topics or features of these names are {', '.join(KINDS)}",
        flag="--as",
        action="append",
        metavar="PATTERN=KIND",
    )
    fps: tuple[str, ...] = _answer((), "images per second", **_RATES)
    force_hz: tuple[str, ...] = _answer((), "rows of forces, widths and poses per second", **_RATES)
    taxels_hz: tuple[str, ...] = _answer((), "scans of taxels per second", **_RATES)
    taxel_order: TaxelOrder | None = _answer(  # noqa: RUF009
        None,
        "order of 48 numbers: taxel (x y z of each in turn) or axis (x of all, then y, then z); "
        "default: by the resting counts",
        choices=ORDERS,
    )
    units: str | None = _answer(None, f"of forces: {', '.join(FORCE_UNITS)}", metavar="UNIT")
    torque_units: str | None = _answer(
        None, f"of torques: {', '.join(TORQUE_UNITS)}", metavar="UNIT"
    )
    width_unit: str | None = _answer(None, "of the width of a gripper", choices=("m", "mm"))
    columns: tuple[Any, ...] = _answer(
        (), "mapping of the columns of tables (YAML)", action="append", metavar="FILE"
    )
    ignore: tuple[str, ...] = _answer(
        (), "leave out this CSV column", action="append", metavar="NAME"
    )
    stills: bool = _answer(False, "each picture of a folder is a contact of its own", **_FLAG)
    trim: bool = _answer(False, "cut files to the shortest of them", **_FLAG)
    no_contact: tuple[str, ...] = _answer(
        (), "seconds without contact in a recording; of single pictures, the name of one", **_SPANS
    )
    press: tuple[str, ...] = _answer(
        (),
        "seconds of a contact in a recording, or none, instead of looking for contacts",
        **_SPANS,
    )
    lag: float | None = _answer(
        None, "how much later the images show what forces show", type=float, metavar="S"
    )
    contact_frame: tuple[float, ...] = _answer(
        (),
        "x y z [m] and rotation vector [rad] in which poses give places and depths",
        type=numbers(6),
        metavar="X,...",
    )

    @staticmethod
    def options() -> Iterator[tuple[str, dict[str, Any]]]:
        """Yield flag and settings of the option of each answer, for a parser."""
        for each in fields(Answers):
            option = dict(each.metadata)
            yield option.pop("flag", option_flag(each.name)), {"dest": each.name, **option}

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
        changes: dict[str, Any] = {
            name: tuple(value) if isinstance(value, list) else value
            for name, value in values.items()
        }
        return replace(self, **changes)


def _rate(flag: str, text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        raise SessionError(f"{flag}: found {text!r}; allowed: numbers, or NAME=number") from None
    return require_rate(value, flag)


def require_rate(value: float, where: str) -> float:
    """Return a rate [Hz]; refuse one that no recording has."""
    if not 1e-3 <= value <= 1e5:
        raise SessionError(f"{where}: found {value:g} Hz; allowed: 0.001 to 100000")
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
class RecordedTrack:
    """One stream of a recording."""

    stream: str
    """Name of the stream in the session."""
    kind: As
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
    tracks: tuple[RecordedTrack, ...]
    files: tuple[Path, ...]
    """Files and folders that they come from."""
    assumed: tuple[str, ...] = ()
    """Messages on assumptions and changes."""

    def first(self, kind: As) -> RecordedTrack | None:
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
    tokens = re.findall("[a-z]+", re.sub("(?<=[a-z])(?=[A-Z])", "_", name).lower())
    return next((WORDS[token] for token in reversed(tokens) if token in WORDS), None)


def bare_name(stem: str) -> str:
    """Return the name of a file without the words that only tell its kind: that of its take."""
    parts = re.split("([_. -]+)", stem)
    while len(parts) > 1 and parts[-1].lower() in WORDS:
        parts = parts[:-2]
    while len(parts) > 1 and parts[0].lower() in WORDS:
        parts = parts[2:]
    return "".join(parts) if parts[0].lower() not in WORDS else ""


def named(tracks: Sequence[RecordedTrack]) -> tuple[RecordedTrack, ...]:
    """Return the tracks with names of streams that differ; the first of a kind has the kind's."""
    renamed: list[RecordedTrack] = []
    names: set[str] = set()
    for track in tracks:
        name = track.stream or default_stream(track.kind)
        if name in names:
            name = re.sub("[^A-Za-z0-9]+", "_", track.source.rpartition(":")[2]).strip("_")[:40]
            name = (name if name[:1].isalpha() else f"s_{name}"[:40]).strip("_")
        number, unique = 2, name
        while unique in names:
            unique, number = f"{name}_{number}", number + 1
        names.add(unique)
        renamed.append(replace(track, stream=unique))
    return tuple(renamed)


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


def row_times(
    source: str, count: int, kind: As, stream: str, films: Sequence[RecordedTrack], answers: Answers
) -> tuple[Times, str, list[str]]:
    """Return times and clock of rows without times, and messages on where they come from."""
    rate = answers.rate(kind, stream)
    if rate is not None:
        flag = option_flag(rate_option(kind))
        return every(range(count), rate), source, [f"{source}: {rate:g} rows/s by {flag}"]
    for film in films:
        if film.kind == "video" and len(film.content.t_ns) == count:
            message = f"{source}: as many rows as its video has images, so at their times"
            return film.content.t_ns, film.clock, [message]
    if kind == "video" and answers.stills:
        return every(range(count), 1.0), source, [f"{source}: rows numbered one second apart"]
    raise MissingAnswer(rate_option(kind), f"{source}: {count} rows say no times")


def whole_ns(times: Floats, where: str, first: int) -> Times:
    """Return times (n,) [ns] in whole ns below 30 years; refuse the row that does not advance."""
    whole = np.rint(times)
    bad = np.flatnonzero(~((np.diff(whole, prepend=-1) > 0) & (whole < 1e18)))
    if bad.size:
        raise SessionError(f"{where} {bad[0] + first}: its time does not advance")
    return whole.astype(np.int64)
