"""Tracks of a recording made elsewhere: what one file, topic or feature holds, with its times."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal, get_args

import numpy as np
from numpy.typing import NDArray

from recorder.convert.import_force import ForceUnits, Wrenches, from_array, rate_of, wrenches_of
from recorder.convert.import_taxels import Counts, TaxelOrder, counts_of, is_taxels
from recorder.convert.import_video import Film
from recorder.errors import SessionError
from recorder.session.align import NS
from recorder.spec import AXES

Times = NDArray[np.int64]
Floats = NDArray[np.float64]

# What a file can be read as; `skip` leaves it out.
As = Literal["video", "force", "taxels", "pose", "width", "values", "skip"]
KINDS: tuple[As, ...] = get_args(As)
# Words in the names of files, topics and features that tell their kind; the last one counts.
WORDS: Mapping[str, As] = {
    **dict.fromkeys(("video", "image", "images", "img", "camera", "cam", "frames", "rgb"), "video"),
    **dict.fromkeys(("force", "forces", "wrench", "ft", "load", "loads", "newton"), "force"),
    **dict.fromkeys(("taxel", "taxels", "uskin", "xela", "tactile"), "taxels"),
    **dict.fromkeys(("pose", "poses", "tcp"), "pose"),
    **dict.fromkeys(("width", "widths", "opening", "gripper"), "width"),
}


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
class Numbers:
    """Rows of numbers: a pose, the width of a gripper, or anything else."""

    value: Floats
    """Values (n, k)."""
    t_ns: Times
    """Times (n,) since the start of the recording [ns]."""
    units: str
    """Units; `m, rad` for a pose (position and rotation vector)."""
    assumed: list[str] = field(default_factory=list)
    """Messages on assumptions and changes."""

    @property
    def rate_hz(self) -> float:
        """Usual number of rows per second."""
        return rate_of(self.t_ns)


Content = Film | Wrenches | Counts | Numbers


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


def content_of(
    name: str,
    array: NDArray[Any],
    t_ns: Times,
    kind: As,
    *,
    units: ForceUnits,
    order: TaxelOrder | None = None,
    width_unit: str | None = None,
) -> Content:
    """Return an array of numbers (n, ...) at times (n,) [ns] as the content of a track.

    Args:
        name: File, topic or feature, for messages.
        array: Numbers, row by row.
        t_ns: Times of the rows.
        kind: What they are, other than `video` and `skip`.
        units: Units of forces.
        order: Order of the counts of taxels.
        width_unit: `m` or `mm`, of a width.

    Raises:
        SessionError: The numbers cannot be of that kind.
        MissingAnswer: A unit or an order is unknown.
    """
    if len(array) != len(t_ns):
        raise SessionError(f"{name}: found {len(array)} rows and {len(t_ns)} times")
    if kind == "force":
        if units.force is None:
            raise MissingAnswer("units", f"{name}: forces say no unit", ("N", "mN", "gf", "kgf"))
        numbers = np.asarray(array, np.float64).reshape(len(array), -1)
        # An axis without a single number was not measured; any other NaN is refused.
        never = np.asarray(np.isnan(numbers).all(axis=0))
        known = np.where(never, 0.0, numbers)
        shape = np.shape(array)
        value, axes, assumed = from_array(name, known.reshape(shape), units)
        if numbers.shape[1] == 6 and never.any():
            value[:, never] = np.nan
            axes = [AXES[place] for place in np.flatnonzero(~never).tolist()]
        return wrenches_of(name, value, axes, t_ns, assumed=assumed)
    if kind == "taxels":
        return counts_of(name, array, t_ns, order)
    rows = np.asarray(array, np.float64).reshape(len(array), -1)
    if not np.isfinite(rows).all():
        bad = np.flatnonzero(~np.isfinite(rows).all(axis=1))
        raise SessionError(f"{name}: row {bad[0]}: NaN or infinite ({bad.size} such rows)")
    if kind == "width":
        if rows.shape[1] != 1:
            raise SessionError(f"{name}: found shape {array.shape}; allowed for a width: (n,)")
        if width_unit is None:
            raise MissingAnswer("width_unit", f"{name}: the width says no unit", ("m", "mm"))
        return Numbers(rows * {"m": 1.0, "mm": 1e-3}[width_unit], t_ns, "m")
    if kind == "pose":
        return _pose(name, rows, t_ns)
    return Numbers(rows, t_ns, "1")


def _pose(name: str, rows: Floats, t_ns: Times) -> Numbers:
    """Return poses of positions [m] and rotation vectors (n, 6) or quaternions x y z w (n, 7)."""
    if rows.shape[1] == 6:
        told = [f"{name}: poses as position [m] and rotation vector [rad]"]
        return Numbers(rows, t_ns, "m, rad", told)
    if rows.shape[1] != 7:
        raise SessionError(
            f"{name}: found {rows.shape[1]} numbers a pose; allowed: 6 (rotation vector) or 7 "
            "(quaternion x y z w)"
        )
    return Numbers(np.hstack([rows[:, :3], rotation_vectors(rows[:, 3:])]), t_ns, "m, rad")


def rotation_vectors(quaternions: Floats) -> Floats:
    """Return rotation vectors (n, 3) [rad] of quaternions x y z w (n, 4), of any length above 0."""
    length = np.linalg.norm(quaternions, axis=1, keepdims=True)
    unit = quaternions / np.where(length > 0, length, 1.0)
    unit = np.where(unit[:, 3:] < 0, -unit, unit)
    sine = np.linalg.norm(unit[:, :3], axis=1, keepdims=True)
    angle = 2 * np.arctan2(sine, unit[:, 3:])
    # For small rotations the vector is twice the imaginary part.
    scale = np.where(sine > 1e-9, angle / np.where(sine > 1e-9, sine, 1.0), 2.0)
    return np.asarray(unit[:, :3] * scale, np.float64)


def kind_of_array(shape: tuple[int, ...], name: str) -> As | None:
    """Return the kind of an array of numbers by name and shape; None if neither tells."""
    told = kind_of_name(name)
    if told is not None and told != "video":
        return told
    return "taxels" if is_taxels(shape) else None


def named(tracks: Sequence[Track]) -> tuple[Track, ...]:
    """Return the tracks with names of streams that differ; the first of a kind has the kind's."""
    default = {"video": "camera", "force": "force", "taxels": "taxels", "pose": "pose"}
    kept: list[Track] = []
    seen: set[str] = set()
    for track in tracks:
        name = track.stream or default.get(track.kind, track.kind)
        if name in seen:
            name = re.sub("[^A-Za-z0-9_]+", "_", bare_stream(track.source)).strip("_") or name
        number, unique = 2, name
        while unique in seen:
            unique, number = f"{name}_{number}", number + 1
        seen.add(unique)
        kept.append(Track(unique, track.kind, track.content, track.source, track.clock))
    return tuple(kept)


def bare_stream(source: str) -> str:
    """Return a name for the stream of a file, topic or feature; it begins with a letter."""
    name = re.sub("[^A-Za-z0-9]+", "_", source.rpartition(":")[2]).strip("_")[:40]
    return name if name[:1].isalpha() else f"s_{name}"[:40]
