"""Find out what files and folders hold, and which of them are one recording."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field, fields, replace
from fnmatch import fnmatch
from pathlib import Path
from typing import Any, Self, get_args

import numpy as np
from numpy.typing import NDArray

from recorder.convert import import_bags, import_lerobot
from recorder.convert.import_force import (
    POSE_AXES,
    ForceUnits,
    forces_of,
    load_npy,
    read_lines,
    read_rows,
    read_table,
    wrenches_of,
)
from recorder.convert.import_taxels import TaxelOrder, counts_of
from recorder.convert.import_tracks import (
    KINDS,
    As,
    Content,
    MissingAnswer,
    Numbers,
    Times,
    Track,
    bare_name,
    bare_stream,
    content_of,
    kind_of_array,
    kind_of_name,
    named,
)
from recorder.convert.import_video import IMAGE_SUFFIXES, every, open_film
from recorder.errors import SessionError
from recorder.strict_yaml import natural_key

VIDEO_SUFFIXES = (".avi", ".mp4", ".m4v", ".mkv", ".mov", ".webm", ".mpg", ".mpeg")
LOG_SUFFIXES = (".jsonl", ".log", ".txt")
# Options of rates by the kind of a file.
RATES: Mapping[str, str] = {"video": "fps", "taxels": "taxels_hz"}


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

    @property
    def force_units(self) -> ForceUnits:
        """Units of forces."""
        return ForceUnits(self.units, self.torque_units, self.ignore)

    def rate(self, kind: As, stream: str) -> float | None:
        """Return the stated rate of a stream; None if there is none.

        Raises:
            SessionError: Not a rate.
        """
        option = RATES.get(kind, "force_hz")
        found: float | None = None
        for text in getattr(self, option):
            name, equals, value = text.rpartition("=")
            if not equals or name == stream:
                found = _rate(option, value)
        return found

    def kind(self, name: str) -> As | None:
        """Return the stated kind of a file, topic or feature; None if none is stated."""
        found: As | None = None
        for text in self.kinds:
            pattern, _, kind = text.rpartition("=")
            if not pattern or kind not in KINDS:
                raise SessionError(
                    f"--as: found {text!r}; allowed: PATTERN=KIND with a KIND of {', '.join(KINDS)}"
                )
            if fnmatch(name, pattern):
                found = next(each for each in get_args(As) if each == kind)
        return found

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


@dataclass(frozen=True, slots=True)
class Take:
    """One recording: tracks that were recorded together."""

    name: str
    tracks: tuple[Track, ...]
    files: tuple[Path, ...]
    """Files and folders that they come from."""
    assumed: tuple[str, ...] = ()
    """Messages on assumptions and changes."""


@dataclass(slots=True)
class _Files:
    """Files of one recording, by kind and stream; an empty stream takes the kind's name."""

    films: list[tuple[str, Path]] = field(default_factory=list)
    others: list[tuple[str, As | None, Path]] = field(default_factory=list)


def find_takes(
    paths: Sequence[Path], stated: Sequence[tuple[As, str, Path]], answers: Answers
) -> list[Take]:
    """Return the recordings in files and folders, in natural order of their names.

    Args:
        paths: Files and folders, whose kinds are found out.
        stated: Kind, stream (or an empty text) and path of files that are one recording.
        answers: What the files cannot tell.

    Raises:
        SessionError: Nothing can be imported, or a file is damaged.
        MissingAnswer: Something that the files do not tell.
    """
    takes: list[Take] = []
    groups: dict[str, _Files] = {}
    left_out: list[str] = []
    for path in _leaves(paths):
        if _is_bag(path):
            tracks, told = import_bags.read_bag(
                path,
                chosen=answers.kind,
                units=answers.force_units,
                order=answers.taxel_order,
                width_unit=answers.width_unit,
            )
            takes.append(Take(path.stem, named(tracks), (path,), tuple(told)))
            continue
        if path.is_dir() and import_lerobot.is_lerobot(path):
            episodes, told = import_lerobot.read_lerobot(
                path,
                chosen=answers.kind,
                units=answers.force_units,
                order=answers.taxel_order,
                width_unit=answers.width_unit,
            )
            takes += [
                Take(name, named(tracks), (path,), tuple(told)) for name, tracks in episodes.items()
            ]
            continue
        kind = answers.kind(path.name)
        if kind == "skip":
            left_out.append(f"{path.name}: left out as stated")
            continue
        known = _is_film(path) or path.suffix.lower() in (".npy", ".npz", ".csv", *LOG_SUFFIXES)
        if not known or (path.suffix.lower() in LOG_SUFFIXES and not _is_uskin_log(path)):
            left_out.append(f"{path.name}: left out, no recording that is known")
            continue
        stem = path.name if path.is_dir() else path.stem
        group = groups.setdefault(bare_name(stem) or path.parent.name or "recording", _Files())
        if _is_film(path):
            group.films.append(("", path))
        else:
            group.others.append(("", kind, path))
    if len(groups) == 2:
        # One video and one file of numbers are one recording, whatever their names.
        one, other = sorted(groups.items(), key=lambda each: not each[1].films)
        if (len(one[1].films), len(other[1].films)) == (1, 0) and not one[1].others:
            groups = {one[0]: _Files(one[1].films, other[1].others)}
    for kind_stated, stream, path in stated:
        group = groups.setdefault(_name_of_stated(stated), _Files())
        if kind_stated == "video":
            group.films.append((stream, path))
        else:
            group.others.append((stream, kind_stated, path))
    takes += [_take(name, group, answers) for name, group in groups.items()]
    if not takes:
        found = "; ".join(left_out) or "no file"
        raise SessionError(f"found nothing to import: {found}")
    takes.sort(key=lambda take: natural_key(take.name))
    if left_out:
        first = takes[0]
        takes[0] = Take(first.name, first.tracks, first.files, (*first.assumed, *left_out))
    return takes


def _name_of_stated(stated: Sequence[tuple[As, str, Path]]) -> str:
    first = next((path for kind, _, path in stated if kind == "video"), stated[0][2])
    stem = first.name if first.is_dir() else first.stem
    return bare_name(stem) or stem


def _leaves(paths: Sequence[Path]) -> Iterator[Path]:
    """Yield files and folders that are read as a whole, in natural order."""
    for path in paths:
        if not path.exists():
            raise SessionError(f"{path}: no such file or folder")
        if path.is_file() or _is_whole(path):
            yield path
            continue
        inside = [each for each in path.iterdir() if not each.name.startswith(".")]
        yield from _leaves(sorted(inside, key=lambda each: natural_key(each.name)))


def _is_whole(path: Path) -> bool:
    images = any(each.suffix.lower() in IMAGE_SUFFIXES for each in path.iterdir())
    return images or _is_bag(path) or import_lerobot.is_lerobot(path)


def _is_bag(path: Path) -> bool:
    if path.is_dir():
        return (path / "metadata.yaml").is_file()
    return path.suffix.lower() in import_bags.SUFFIXES


def _is_film(path: Path) -> bool:
    return path.is_dir() or path.suffix.lower() in VIDEO_SUFFIXES


def _is_uskin_log(path: Path) -> bool:
    with path.open(encoding="utf-8", errors="replace") as file:
        return _scan(file.readline()) is not None


def _take(name: str, group: _Files, answers: Answers) -> Take:
    """Return the recording of some files."""
    tracks: list[Track] = []
    files: list[Path] = []
    for stream, path in group.films:
        film = open_film(
            path, answers.rate("video", stream or "camera"), stills=answers.stills and path.is_dir()
        )
        tracks.append(Track(stream, "video", film, path.name, path.name))
        files.append(path)
    for stream, stated, path in group.others:
        tracks += _numbers(path, stated, stream, tracks, answers)
        files.append(path)
    return Take(name, named(tracks), tuple(files))


def _numbers(
    path: Path, stated: As | None, stream: str, films: Sequence[Track], answers: Answers
) -> Iterator[Track]:
    """Yield the tracks of a file of numbers."""
    suffix = path.suffix.lower()
    if suffix == ".csv":
        yield from _csv(path, stated, stream, films, answers)
    elif suffix in LOG_SUFFIXES:
        array, times = _uskin_log(path)
        counts = counts_of(path.name, array, times, answers.taxel_order)
        yield Track(stream, "taxels", counts, path.name, path.name)
    elif suffix == ".npz":
        for name, array in _arrays(path):
            source = f"{path.name}:{name}"
            kind = answers.kind(name) or stated
            if kind != "skip":
                yield _array(source, array, kind, stream, films, answers)
    elif suffix == ".npy":
        if stated == "taxels" or stated is None:
            _refuse_taxels(path, stated)
        yield _array(path.name, load_npy(path), stated, stream, films, answers)
    else:
        raise SessionError(f"{path.name}: found {path.suffix!r}; allowed: .csv, .npy, .npz")


def _refuse_taxels(path: Path, stated: As | None) -> None:
    """Name a file that was stated to be taxels but is no file."""
    if not path.is_file():
        raise SessionError(f"{path}: no such file")


def _arrays(path: Path) -> Iterator[tuple[str, NDArray[Any]]]:
    try:
        with np.load(path, allow_pickle=False) as archive:
            for name in archive.files:
                yield name, archive[name]
    except (ValueError, OSError, EOFError) as error:
        raise SessionError(f"{path.name}: no whole .npz file of numbers: {error}") from error


def _array(
    source: str,
    array: NDArray[Any],
    stated: As | None,
    stream: str,
    films: Sequence[Track],
    answers: Answers,
) -> Track:
    """Return the track of an array, whose rows have a rate, or are those of the images."""
    _, is_inside, inner = source.rpartition(":")
    kind = stated or kind_of_array(array.shape, inner if is_inside else Path(source).stem)
    if kind is None:
        raise MissingAnswer(
            "as",
            f"{source}: an array {array.shape} whose name does not tell what it holds",
            [f"{source}={each}" for each in KINDS if each != "video"],
        )
    times, clock, told = _times(source, len(array), kind, stream, films, answers)
    content = content_of(
        source,
        array,
        times,
        kind,
        units=answers.force_units,
        order=answers.taxel_order,
        width_unit=answers.width_unit,
    )
    content.assumed.insert(0, told)
    default = stream if kind not in ("width", "values") else stream or bare_stream(kind)
    return Track(default, kind, content, source, clock)


def _times(
    source: str, count: int, kind: As, stream: str, films: Sequence[Track], answers: Answers
) -> tuple[Times, str, str]:
    """Return times and clock of rows without times, and a message on where they come from."""
    option = "--" + RATES.get(kind, "force_hz").replace("_", "-")
    rate = answers.rate(kind, stream or kind)
    if rate is not None:
        return every(range(count), rate), source, f"{source}: {rate:g} rows/s by {option}"
    for film in films:
        if film.kind == "video" and len(film.content.t_ns) == count:
            told = f"{source}: as many rows as its video has images, so at their times"
            return film.content.t_ns, film.clock, told
    raise MissingAnswer(RATES.get(kind, "force_hz"), f"{source}: {count} rows say no times")


def _csv(
    path: Path, stated: As | None, stream: str, films: Sequence[Track], answers: Answers
) -> Iterator[Track]:
    name, lines = path.name, read_lines(path)
    if len(lines[0]) == 48:
        header = not _is_number(lines[0][0])
        rows = read_rows(name, lines, list(range(48)), int(header))
        yield _array(name, rows, "taxels", stream, films, answers)
        return
    table = read_table(name, lines, answers.force_units)
    # Columns of forces come first: their rate is that of the file.
    value, axes = forces_of(table)
    kind: As = "force" if axes else "width"
    rate = answers.rate(kind, stream or kind)
    if table.t_ns is not None:
        if rate is not None:
            raise SessionError(f"{name}: has a time column; --force-hz does not go with it")
        times, clock, told = table.t_ns, name, ""
    else:
        times, clock, told = _times(name, len(table), kind, stream, films, answers)
    given = [told] if told else []
    if axes:
        wrenches = wrenches_of(name, value, axes, times, rate_hz=rate, assumed=given)
        yield Track(stream, "force", wrenches, name, clock)
    if "width" in table.columns:
        width = Numbers(table.columns["width"][:, None], times, "m", list(given))
        yield Track("width", "width", width, name, clock)
    pose = [table.columns.get(axis) for axis in POSE_AXES]
    if any(column is not None for column in pose):
        missing = [axis for axis, column in zip(POSE_AXES, pose, strict=True) if column is None]
        if missing:
            raise SessionError(f"{name}: found part of a pose; {', '.join(missing)} missing")
        rows = np.stack([column for column in pose if column is not None], axis=1)
        yield Track("pose", "pose", Numbers(rows, times, "m, rad", list(given)), name, clock)


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True


# Logs of XELA's server: one message of JSON a line, as it sends them.


def _scan(line: str) -> tuple[float | None, list[int]] | None:
    """Return time [s] and counts (48,) of a message; None for anything else."""
    try:
        message = json.loads(line)
        sensor = message["1"]
        words = str(sensor["data"]).split(",")
        counts = [int(word, 16) for word in words]
    except (ValueError, KeyError, TypeError):
        return None
    time = next((each.get("time") for each in (sensor, message) if each.get("time")), None)
    stamp = float(time) if isinstance(time, int | float) else None
    return (stamp, counts) if len(counts) == 48 else None


def _uskin_log(path: Path) -> tuple[NDArray[np.float64], Times]:
    """Return counts (n, 16, 3) and times (n,) of a log; the server sends x y z of each taxel."""
    stamps, rows = [], []
    for number, line in enumerate(path.read_text(encoding="utf-8").splitlines(), 1):
        if not line.strip():
            continue
        scan = _scan(line)
        if scan is None or scan[0] is None:
            raise SessionError(f"{path.name}: line {number}: no scan of 16 taxels with its time")
        stamps.append(scan[0])
        rows.append(scan[1])
    times = np.round(1e9 * (np.array(stamps) - stamps[0])).astype(np.int64)
    if (backward := np.flatnonzero(np.diff(times) <= 0)).size:
        raise SessionError(f"{path.name}: line {backward[0] + 2}: its time does not advance")
    return np.array(rows, np.float64).reshape(-1, 16, 3), times


def indenter_of(take: str, answers: Answers) -> str:
    """Return the name of what touched the sensor in a recording.

    Raises:
        MissingAnswer: Neither a name nor that recordings are named after it.
    """
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


__all__ = [
    "Answers",
    "Content",
    "MissingAnswer",
    "Take",
    "find_takes",
    "indenter_of",
    "kind_of_name",
]
