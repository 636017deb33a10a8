"""Episodes of a LeRobot data set (versions 2 and 3), each as the tracks of one recording."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from recorder.convert.import_numbers import kind_of_array, numbers_of
from recorder.convert.import_tracks import Answers, As, Content, Film, Take, Times, Track, named
from recorder.convert.import_video import (
    JPEG,
    film_of_pictures,
    open_film,
    pixels_of_picture,
    size_of_picture,
)
from recorder.errors import SessionError

# Columns that number rows and tasks.
_INDICES = ("timestamp", "frame_index", "episode_index", "index", "task_index")


def is_lerobot(path: Path) -> bool:
    """Return True if a folder is a LeRobot data set."""
    return (path / "meta" / "info.json").is_file() and (path / "data").is_dir()


def read_lerobot(path: Path, answers: Answers) -> list[Take]:
    """Return the episodes of a folder, each as a recording."""
    try:
        import pyarrow as pa
        import pyarrow.parquet as pq
    except ImportError:
        raise SessionError(
            f"{path.name}: reading LeRobot takes pyarrow: pip install 'tactile-rig[export]'"
        ) from None
    try:
        info = json.loads((path / "meta" / "info.json").read_text())
        features: dict[str, dict[str, Any]] = info["features"]
        fps = float(info["fps"])
    except (KeyError, TypeError, ValueError) as error:
        raise SessionError(f"{path.name}/meta/info.json: no description: {error}") from error
    files = sorted((path / "data").rglob("*.parquet"))
    if not files:
        raise SessionError(f"{path.name}: found no parquet file in data")
    try:
        table = pa.concat_tables([pq.read_table(file) for file in files])
    except (pa.ArrowInvalid, OSError) as error:
        raise SessionError(f"{path.name}: a damaged parquet file: {error}") from error
    kinds: dict[str, As] = {}
    left_out = []
    for name, feature in features.items():
        if name in _INDICES:
            continue
        kind = answers.kind(name) or _kind(name, feature)
        if kind is None or kind == "skip":
            left_out.append(f"{path.name}: {name}: left out")
        else:
            kinds[name] = kind
    if not kinds:
        raise SessionError(f"{path.name}: found no feature of a sensor in {', '.join(features)}")
    number = np.asarray(table.column("episode_index"))
    # Rows that our own export left out, and time stamps of a robot, are not evenly spaced.
    seconds = np.asarray(table.column("timestamp"), np.float64)
    if "capture_ns" in table.column_names:
        seconds = 1e-9 * np.asarray(table.column("capture_ns"), np.float64)
    takes = []
    for episode in np.unique(number).tolist():
        rows = np.flatnonzero(number == episode)
        times = np.round(1e9 * (seconds[rows] - seconds[rows[0]])).astype(np.int64)
        if (np.diff(times) <= 0).any():
            raise SessionError(f"{path.name}: episode {episode}: its time does not advance")
        tracks = []
        for name, kind in kinds.items():
            source = f"{path.name}:{name}"
            if kind == "video":
                content: Content = _film(path, info, name, table, rows, times, int(episode), fps)
            else:
                array = np.array(table.column(name).take(rows).to_pylist(), np.float64)
                content = numbers_of(source, array, times, kind, answers)
            tracks.append(Track("", kind, content, source, path.name))
        tracks.sort(key=lambda track: track.kind != "video")
        takes.append(Take(f"episode_{episode:06d}", named(tracks), (path,), tuple(left_out)))
    return takes


def _kind(name: str, feature: dict[str, Any]) -> As | None:
    """Return the kind of a feature; None for what no model of forces is learned from."""
    if feature.get("dtype") in ("image", "video"):
        return "video"
    shape = (1, *feature.get("shape", ()))
    found = kind_of_array(shape, name)
    if found == "taxels" and int(np.prod(shape)) != 48:
        return None
    return found


def _film(
    path: Path,
    info: dict[str, Any],
    name: str,
    table: Any,
    rows: NDArray[np.int64],
    times: Times,
    episode: int,
    fps: float,
) -> Film:
    if name in table.column_names:
        images = [entry["bytes"] for entry in table.column(name).take(rows).to_pylist()]
        if not all(isinstance(each, bytes) for each in images):
            raise SessionError(f"{path.name}: {name}: episode {episode}: an image has no bytes")
        return _of_bytes(f"{path.name}:{name}", images, times)
    chunk = episode // int(info.get("chunks_size", 1000))
    fields = {"video_key": name, "episode_chunk": chunk, "episode_index": episode}
    start = 0.0
    if "file_index" in str(info.get("video_path", "")):
        entry = _episode(path, episode)
        prefix = f"videos/{name}/"
        fields |= {
            "chunk_index": int(entry[f"{prefix}chunk_index"]),
            "file_index": int(entry[f"{prefix}file_index"]),
        }
        start = float(entry[f"{prefix}from_timestamp"])
    try:
        file = path / str(info["video_path"]).format(**fields)
    except (KeyError, ValueError) as error:
        raise SessionError(f"{path.name}: info.json: video_path: {error}") from error
    whole = open_film(file, fps)
    first = round(start * fps)
    if first + len(rows) > len(whole.t_ns):
        raise SessionError(
            f"{file.name}: found {len(whole.t_ns)} images; episode {episode} needs "
            f"{first + len(rows)}"
        )

    def load() -> Iterator[Any]:
        for place, image in enumerate(whole.load()):
            if first <= place < first + len(rows):
                yield image

    return replace(whole, t_ns=times, load=load)


def _episode(path: Path, episode: int) -> dict[str, Any]:
    import pyarrow.parquet as pq

    for file in sorted((path / "meta" / "episodes").rglob("*.parquet")):
        for entry in pq.read_table(file).to_pylist():
            if int(entry["episode_index"]) == episode:
                return dict(entry)
    raise SessionError(f"{path.name}: meta/episodes has no episode {episode}")


def _of_bytes(name: str, images: list[bytes], times: Times) -> Film:
    sizes = [size_of_picture(name, each) for each in images]
    jpeg = all(each[:2] == JPEG for each in images)

    def load() -> Iterator[Any]:
        for each in images:
            yield each if jpeg else pixels_of_picture(name, each)

    about = "times of the data set", "the files' bytes"
    return film_of_pictures(name, sizes, times, load, jpeg=jpeg, about=about)
