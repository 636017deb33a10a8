"""Tracks of a recording made elsewhere: what one file, topic or feature holds, with its times."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from recorder.convert.import_answers import As, default_stream
from recorder.session.align import NS

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
