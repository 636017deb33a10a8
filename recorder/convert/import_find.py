"""Find out what files and folders hold, and which of them are one recording."""

import json
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from recorder.convert import import_bags
from recorder.convert.import_columns import Table, from_start, read_table, tables_of
from recorder.convert.import_numbers import counts_of, kind_of_array, load_arrays, numbers_of
from recorder.convert.import_tracks import (
    KINDS,
    Answers,
    As,
    MissingAnswer,
    Part,
    RecordedTrack,
    Take,
    Times,
    bare_name,
    named,
    problems,
    row_times,
    whole_ns,
)
from recorder.convert.import_video import IMAGE_SUFFIXES, open_film
from recorder.errors import SessionError
from recorder.natural_order import naturally_sorted

VIDEO_SUFFIXES = (".avi", ".mp4", ".m4v", ".mkv", ".mov", ".webm", ".mpg", ".mpeg")
LOG_SUFFIXES = (".jsonl", ".log", ".txt")

# Stated kind, stream (empty: the kind's name) and path of a file of a recording.
_File = tuple[As | None, str, Path]


def find_takes(
    paths: Sequence[Path], stated: Sequence[tuple[As, str, Path]], answers: Answers
) -> list[Take]:
    """Return recordings in natural order of names; `stated` ones have kind, stream and path."""
    takes: list[Take] = []
    groups: dict[str, list[_File]] = {}
    left_out: list[str] = []
    with problems() as part:
        for path in _leaves(paths):
            if _is_bag(path):
                with part(path.name):
                    takes.append(import_bags.read_bag(path, answers))
                continue
            if _is_lerobot(path):
                from recorder.convert.lerobot_format import read_lerobot

                with part(path.name):
                    takes += read_lerobot(path, answers)
                continue
            kind = answers.kind(path.name)
            if kind == "skip":
                left_out.append(f"{path.name}: left out as stated")
                continue
            suffix = path.suffix.lower()
            is_recording = _is_film(path) or suffix in (".npy", ".npz", ".csv")
            is_log = suffix in LOG_SUFFIXES and _is_uskin_log(path)
            if not (is_recording or is_log or tables_of(path, answers.columns)):
                left_out.append(f"{path.name}: left out, no recording that is known; see --columns")
                continue
            name = bare_name(_stem(path)) or path.parent.name or "recording"
            groups.setdefault(name, []).append(("video" if _is_film(path) else kind, "", path))
        if len(groups) == 2:
            # One video and files of numbers are one recording, whatever their names.
            one, other = sorted(groups, key=lambda name: not any(map(_is_video, groups[name])))
            kinds = [kind for kind, _, _ in groups[one]]
            if kinds == ["video"] and not any(map(_is_video, groups[other])):
                groups = {one: groups[one] + groups[other]}
        if stated:
            stem = _stem(next(filter(_is_video, stated), stated[0])[2])
            groups.setdefault(bare_name(stem) or stem, []).extend(stated)
        files = [path for group in groups.values() for *_, path in group]
        for mapping in answers.columns:
            if not any(tables_of(path, [mapping]) for path in files):
                raise SessionError(f"{mapping[0]}.files: fits no file; allowed: a pattern of names")
        for name, group in groups.items():
            takes.append(_take(name, group, answers, part))
    if not takes:
        raise SessionError(f"found nothing to import: {'; '.join(left_out) or 'no file'}")
    takes = naturally_sorted(takes, lambda take: take.name)
    if left_out:
        takes[0] = replace(takes[0], assumed=(*takes[0].assumed, *left_out))
    return takes


def _is_video(file: _File) -> bool:
    return file[0] == "video"


def _stem(path: Path) -> str:
    return path.name if path.is_dir() else path.stem


def _leaves(paths: Sequence[Path]) -> Iterator[Path]:
    """Yield files and folders that are read as a whole, in natural order."""
    for path in paths:
        if not path.exists():
            raise SessionError(f"{path}: no such file or folder")
        within = [] if path.is_file() else [*path.iterdir()]
        images = any(each.suffix.lower() in IMAGE_SUFFIXES for each in within)
        if path.is_file() or images or _is_bag(path) or _is_lerobot(path):
            yield path
            continue
        inside = [each for each in within if not each.name.startswith(".")]
        if links := [each for each in inside if each.is_symlink() and each.is_dir()]:
            raise SessionError(f"{links[0]}: found a link to a folder; name that folder instead")
        yield from _leaves(naturally_sorted(inside, lambda each: each.name))


def _is_bag(path: Path) -> bool:
    if path.is_dir():
        return (path / "metadata.yaml").is_file()
    return path.suffix.lower() in import_bags.SUFFIXES


def _is_lerobot(path: Path) -> bool:
    return (path / "meta" / "info.json").is_file() and (path / "data").is_dir()


def _is_film(path: Path) -> bool:
    return path.is_dir() or path.suffix.lower() in VIDEO_SUFFIXES


def _is_uskin_log(path: Path) -> bool:
    with path.open(encoding="utf-8", errors="replace") as file:
        return _scan(file.readline(1 << 16)) is not None


def _take(name: str, files: Sequence[_File], answers: Answers, part: Part) -> Take:
    """Return the recording of some files; numbers may have the times of its videos."""
    films: list[RecordedTrack] = []
    tracks: list[RecordedTrack] = []
    files = sorted(files, key=lambda file: not _is_video(file))
    for stated, stream, path in files:
        with part(path.name):
            if stated == "video":
                rate = answers.rate("video", stream)
                film = open_film(path, rate, stills=answers.stills and path.is_dir())
                films.append(RecordedTrack(stream, "video", film, path.name, path.name))
            elif path.is_file():
                tracks += _numbers(path, stated, stream, films, answers)
            else:
                raise SessionError(f"{path}: no such file")
    return Take(name, named([*films, *from_start(tracks)]), tuple(path for _, _, path in files))


def _numbers(
    path: Path, stated: As | None, stream: str, films: Sequence[RecordedTrack], answers: Answers
) -> Iterator[RecordedTrack]:
    suffix = path.suffix.lower()
    tables = tables_of(path, answers.columns)
    if tables or suffix == ".csv":
        for table in tables or [Table()]:
            yield from read_table(path, table, stream, films, answers)
    elif suffix in LOG_SUFFIXES:
        array, times = _uskin_log(path)
        counts = counts_of(path.name, array, times, answers.taxel_order)
        yield RecordedTrack(stream, "taxels", counts, path.name, path.name)
    elif suffix in (".npy", ".npz"):
        for source, array in load_arrays(path).items():
            kind = answers.kind(source.removeprefix(f"{path.name}:")) or stated
            if kind != "skip":
                yield _array(source, array, kind, stream, films, answers)
    else:
        raise SessionError(f"{path.name}: found {path.suffix!r}; allowed: .csv, .npy, .npz")


def _array(
    source: str,
    array: NDArray[Any],
    stated: As | None,
    stream: str,
    films: Sequence[RecordedTrack],
    answers: Answers,
) -> RecordedTrack:
    """Return the track of an array, whose rows have a rate, or are those of the images."""
    _, is_inside, inner = source.rpartition(":")
    kind = stated or kind_of_array(array.shape, inner if is_inside else Path(source).stem)
    if kind is None:
        raise MissingAnswer(
            "as",
            f"{source}: an array {array.shape} whose name does not tell what it holds",
            [f"{source}={each}" for each in KINDS if each != "video"],
        )
    times, clock, messages = row_times(source, len(array), kind, stream, films, answers)
    content = numbers_of(source, array, times, kind, answers)
    content.assumed[:0] = messages
    return RecordedTrack(stream, kind, content, source, clock)


# Logs of XELA's server: one message of JSON a line, as it sends them.


def _scan(line: str) -> tuple[float | None, list[int]] | None:
    """Return time [s] and counts (48,) of a message; None for anything else."""
    try:
        message = json.loads(line)
        sensor = message["1"]
        fields = str(sensor["data"]).split(",")
        counts = [int(field, 16) for field in fields]
        time = next((each.get("time") for each in (sensor, message) if each.get("time")), None)
        stamp = float(time) if isinstance(time, int | float) else None
    except (ValueError, KeyError, TypeError, AttributeError, OverflowError, RecursionError):
        return None
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
    times = whole_ns(1e9 * (np.array(stamps) - stamps[0]), f"{path.name}: line", 2)
    return np.array(rows, np.float64).reshape(-1, 16, 3), times
