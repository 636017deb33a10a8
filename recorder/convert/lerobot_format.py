"""LeRobot datasets, with pyarrow alone: v3.0 is written, one episode per press of the frames view.

Images remain the camera's JPEG bytes (PNG if pixels were stored) inside the parquet files:
LeRobot's default, video, shifts markers by up to half a pixel. LeRobot's `timestamp` is
frame_index / fps by definition; the true times of a row are `t_ns`, `capture_ns` and `utc_ns`.
"""

import io
import json
import math
import os
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray
from PIL import Image

from recorder.convert import import_tracks
from recorder.convert.export import Options
from recorder.convert.import_numbers import kind_of_array, numbers_of, require_size
from recorder.convert.import_video import film_of_files, open_film
from recorder.convert.runs import RecordedPress, need_presses, utc_offset
from recorder.errors import SessionError
from recorder.progress import ReportItems
from recorder.session.align import NS
from recorder.session.columns import Stream
from recorder.session.reader import Session
from recorder.spec import event_text

Array = np.ndarray[Any, Any]

# Statistics that LeRobot stores for each feature: by its names, but the variance for the standard
# deviation. Rows with a NaN are ignored; images have values of 0 to 1 and the shape (c, 1, 1).
Statistics = dict[str, Any]

# Quantiles by their names in LeRobot.
QUANTILES = {"q01": 0.01, "q10": 0.10, "q50": 0.50, "q90": 0.90, "q99": 0.99}
_SAMPLED = 8  # images per episode that are sampled
_STRIDE = 4  # pixels


def statistics_of(values: Array, count: int | None = None) -> Statistics:
    """Return the statistics of rows (n,) or (n, m), empty without a finite one; count: theirs."""
    rows = np.asarray(values, np.float64).reshape(len(values), -1)
    rows = rows[np.isfinite(rows).all(axis=1)]
    if not len(rows):
        return {}
    cuts = np.quantile(rows, list(QUANTILES.values()), axis=0)
    return {
        "min": rows.min(axis=0),
        "max": rows.max(axis=0),
        "mean": rows.mean(axis=0),
        "var": rows.var(axis=0),
        "count": len(rows) if count is None else count,
        **dict(zip(QUANTILES, cuts, strict=True)),
    }


def _image_statistics(encoded: Sequence[bytes]) -> Statistics:
    chosen = np.unique(np.linspace(0, len(encoded) - 1, _SAMPLED).astype(int))
    pixels = []
    for index in chosen:
        with Image.open(io.BytesIO(encoded[index])) as image:
            array = np.asarray(image)[::_STRIDE, ::_STRIDE]
            most = 65535.0 if image.mode.startswith("I") else 255.0  # depth
        pixels.append(array.reshape(-1, array.shape[2] if array.ndim == 3 else 1) / most)
    return statistics_of(np.concatenate(pixels), len(chosen))


def of_both(one: Statistics, other: Statistics) -> Statistics:
    """Return the statistics of the rows of both.

    Moments are exact (Chan et al. 1979); quantiles are the mean of both weighted by their counts,
    as in LeRobot itself.
    """
    total = one["count"] + other["count"]
    fraction = other["count"] / total
    shift = other["mean"] - one["mean"]
    mixed = {
        name: (1 - fraction) * one[name] + fraction * other[name] for name in ("var", *QUANTILES)
    }
    return {
        **mixed,
        "count": total,
        "min": np.fmin(one["min"], other["min"]),
        "max": np.fmax(one["max"], other["max"]),
        "mean": one["mean"] + fraction * shift,
        "var": mixed["var"] + fraction * (1 - fraction) * shift**2,
    }


def document_of(part: Statistics, *, of_images: bool = False) -> dict[str, list[Any]]:
    """Return statistics as LeRobot stores them."""
    part = {**part, "std": np.sqrt(part["var"]), "count": np.array([part["count"]])}
    names = ("min", "max", "mean", "std", "count", *QUANTILES)
    lists = {name: part[name].tolist() for name in names}
    if of_images:
        lists |= {name: [[[one]] for one in lists[name]] for name in names if name != "count"}
    return lists


VERSION = "v3.0"
IMAGE = "observation.images.tactile"
FASTER = 1.05  # rate of a signal over that of the frames from which its windows are written
_CHUNK_FILES = 1000  # files per chunk-NNN folder, LeRobot's default
_FILE_BYTES = 100_000_000  # LeRobot's default: data_files_size_in_mb 100
# Features of the first stream of a kind, by its column of `frames`, in their order.
_NAMES = {
    "image": IMAGE,
    "pose": "observation.state",
    "wrench": "observation.force",
    "taxels": "observation.taxels",
}
_POSE = ("x", "y", "z", "rx", "ry", "rz")
_WRENCH = ("fx", "fy", "fz", "tx", "ty", "tz")
_PATH = "{}/chunk-{{chunk_index:03d}}/file-{{file_index:03d}}.parquet"
_DATA, _EPISODES = _PATH.format("data"), _PATH.format("meta/episodes")


@dataclass(frozen=True, slots=True)
class Feature:
    """One column of the data files, as in meta/info.json."""

    dtype: str
    """LeRobot's name of the type."""
    shape: tuple[int, ...] = (1,)
    """Shape of one value; (1,) is a scalar."""
    names: tuple[str, ...] | None = None
    """Names of its elements."""

    def arrow(self) -> pa.DataType:
        """Return its parquet type, as in the `datasets` library."""
        if self.dtype == "image":
            return pa.struct({"bytes": pa.binary(), "path": pa.string()})
        if self.dtype == "string":
            return pa.string()
        kind = pa.from_numpy_dtype(np.dtype(self.dtype))
        return kind if self.shape == (1,) else pa.list_(kind, self.shape[0])

    def hugging(self) -> dict[str, Any]:
        """Return its description for the `datasets` library."""
        if self.dtype == "image":
            return {"_type": "Image"}
        value = {"dtype": self.dtype, "_type": "Value"}
        if self.shape == (1,):
            return value
        return {"feature": value, "length": self.shape[0], "_type": "List"}


def feature_names(session: Session) -> dict[str, str]:
    """Return features by stream: the first of a kind has LeRobot's name, others their stream's.

    Fingers of a hand have their own; the commands to it are LeRobot's action.
    """
    names, fingers = {}, session.attrs.get("fingers", {})
    for name, column in session.columns.items():
        if column in session.frames:
            image = session.streams[name].layout.image is not None
            own = f"observation.images.{name}" if image else f"observation.{name}"
            own = "action" if session.streams[name].traits.kind == "action" else own
            names[name] = own if name in fingers else _NAMES.get(column, own)
    return names


def features_of(session: Session) -> dict[str, Feature]:
    """Return the features of a session, in the order of their columns."""
    features: dict[str, Feature] = {}
    names = feature_names(session)
    for name in sorted(names, key=lambda name: [*_NAMES.values(), names[name]].index(names[name])):
        features[names[name]] = _feature(session.streams[name])
    for name, most in windows_of(session).items():
        count = math.prod(session.streams[name].layout.columns[0].column.shape)
        features[f"observation.{name}.window"] = Feature("float32", (most * count,))
        features[f"observation.{name}.window_age"] = Feature("float32", (most,))
    if _NAMES["pose"] in features and "action" not in features:
        features["action"] = Feature("float32", (6,), _POSE)
    number, real = Feature("int64"), Feature("float32")
    return features | {
        "depth": real,
        **dict.fromkeys(("phase", "target", "run"), number),
        "valid": Feature("bool"),
        **dict.fromkeys(("t_ns", "capture_ns", "utc_ns"), number),
        "timestamp": real,
        **dict.fromkeys(("frame_index", "episode_index", "index", "task_index"), number),
    }


def windows_of(session: Session) -> dict[str, int]:
    """Return the most samples that signals of numbers faster than the frames have since a tick."""
    most = {}
    frames = session.frames
    for name in feature_names(session):
        stream = session.streams[name]
        is_signal = "signal" in stream.traits.roles and stream.layout.image is None
        if is_signal and stream.rate_hz > FASTER * session.rate_hz:
            parts = [
                _since(session, name, run, frames["t_ns"][frames["run"] == run])
                for run in np.unique(frames["run"]).tolist()
            ]
            most[name] = max(int((ends - starts).max()) for starts, ends in parts)
    return most


def _since(session: Session, name: str, run: int, ticks: Array) -> tuple[Array, Array]:
    """Return the rows of a run (n,) behind the tick before each tick (n,) [ns], and up to it."""
    times, step = session.streams[name].t_ns[session.rows_of_run(name, run)], 1e9 / session.rate_hz
    before = np.r_[ticks[0] - round(step), ticks[:-1]]
    before = np.where(ticks - before < 1.5 * step, before, ticks - round(step))
    starts, ends = (np.searchsorted(times, at, side="right") for at in (before, ticks))
    return starts, ends


def window(session: Session, name: str, run: int, ticks: Array, most: int) -> tuple[Array, Array]:
    """Return the samples of a stream since the tick before each tick (n, most, ...), oldest first.

    Also their ages (n, most) [s]; both after NaN where there are fewer.
    """
    stream, rows = session.streams[name], session.rows_of_run(name, run)
    times, values = stream.t_ns[rows], stream.array("value")[rows]
    starts, ends = (each[:, None] for each in _since(session, name, run, ticks))
    index = ends + np.arange(-most, 0)
    fresh = index >= starts
    ages = np.where(fresh, (ticks[:, None] - times[index]) * NS, np.nan)
    shaped = fresh.reshape(*fresh.shape, *[1] * (values.ndim - 1))
    return np.where(shaped, values[index], np.nan), ages


def _feature(stream: Stream) -> Feature:
    value = stream.value_column
    if value is None:
        raise SessionError(f"{stream.name}: has no column value")
    if value.is_image:
        return Feature("image", value.shape, ("height", "width", "channels"))
    if not value.is_number:
        return Feature("string")
    count = math.prod(value.shape)
    names: tuple[str, ...] | None = None
    if stream.traits.kind == "taxels":
        names = tuple(f"{axis}{taxel}" for taxel in range(count // 3) for axis in "xyz")
    elif count == 6:
        names = {"pose": _POSE, "force": _WRENCH}.get(stream.traits.kind)
    return Feature("float32", (count,), names)


def write(session: Session, path: Path, options: Options, progress: ReportItems) -> None:
    """Write a session as a LeRobot dataset folder."""
    episodes = need_presses(session, valid_only=options.valid_only)
    path.mkdir()
    (path / "meta").mkdir()
    out = _Dataset(path, features_of(session), max(round(session.rate_hz), 1))
    total, done = sum(len(press.rows) for press in episodes), 0
    try:
        for press in episodes:
            out.add(_columns(session, press, out), str(task(session)))
            done += len(press.rows)
            progress(done, total)
    finally:
        out.close()
    out.finish()
    _write_json(path / "meta" / "tactile_rig.json", dict(session.attrs))


def task(session: Session) -> str:
    """Return the task text, with indenter and sensor."""
    indenter = session.attrs.get("indenter") or "unknown indenter"
    sensor = session.attrs.get("sensor") or "unknown sensor"
    if "fingers" in session.attrs:
        return f"squeeze {indenter} between the fingers of {sensor}"
    return f"press the {indenter} indenter into the {sensor} sensor and shear it"


@dataclass(slots=True)
class _Dataset:
    """Files of the dataset while they are written."""

    path: Path
    features: dict[str, Feature]
    fps: int
    stats: dict[str, Statistics] = field(default_factory=dict)
    tasks: dict[str, int] = field(default_factory=dict)
    episodes: list[dict[str, Any]] = field(default_factory=list)
    frames: int = 0
    file: int = 0
    file_bytes: int = 0  # bytes in the open file
    writer: pq.ParquetWriter | None = None

    def add(self, columns: dict[str, Any], text: str) -> None:
        """Add one episode, given all columns except the counters."""
        count = len(columns["t_ns"])
        number, task_index = len(self.episodes), self.tasks.setdefault(text, len(self.tasks))
        columns |= {
            "timestamp": (np.arange(count) / self.fps).astype(np.float32),
            "frame_index": np.arange(count),
            "episode_index": np.full(count, number),
            "index": np.arange(self.frames, self.frames + count),
            "task_index": np.full(count, task_index),
        }
        stats = {
            name: part
            for name, feature in self.features.items()
            if feature.dtype not in ("image", "string")
            and (part := statistics_of(np.asarray(columns[name])))
        }
        for name, feature in self.features.items():
            if feature.dtype == "image":
                stats[name] = _image_statistics([entry["bytes"] for entry in columns[name]])
        for name, part in stats.items():
            self.stats[name] = of_both(self.stats[name], part) if name in self.stats else part
        table = pa.table(
            {name: _arrow(columns[name], kind) for name, kind in self.features.items()}
        )
        if self.writer is not None and self.file_bytes + table.nbytes > _FILE_BYTES:
            self.close()
            self.file, self.file_bytes = self.file + 1, 0
        if self.writer is None:
            self.writer = pq.ParquetWriter(self._named(_DATA, self.file), self._schema(table))
        self.writer.write_table(table.cast(self._schema(table)))
        self.file_bytes += table.nbytes
        chunk, file_in_chunk = divmod(self.file, _CHUNK_FILES)
        self.episodes.append(
            {
                "episode_index": number,
                "tasks": [text],
                "length": count,
                "data/chunk_index": chunk,
                "data/file_index": file_in_chunk,
                "dataset_from_index": self.frames,
                "dataset_to_index": self.frames + count,
                "meta/episodes/chunk_index": 0,
                "meta/episodes/file_index": 0,
                **{
                    f"stats/{name}/{key}": value
                    for name, document in self._documents(stats).items()
                    for key, value in document.items()
                },
            }
        )
        self.frames += count

    def close(self) -> None:
        """Close the open data file. May be called twice."""
        if self.writer is not None:
            self.writer.close()
            self.writer = None

    def finish(self) -> None:
        """Write all files below meta/."""
        pq.write_table(pa.Table.from_pylist(self.episodes), self._named(_EPISODES, 0))
        tasks = pa.table(
            {"task_index": list(self.tasks.values()), "__index_level_0__": list(self.tasks)}
        )
        pq.write_table(tasks.replace_schema_metadata(_INDEXED), self.path / "meta/tasks.parquet")
        _write_json(self.path / "meta" / "stats.json", self._documents(self.stats))
        info = {
            "codebase_version": VERSION,
            "robot_type": "tactile-rig",
            "total_episodes": len(self.episodes),
            "total_frames": self.frames,
            "total_tasks": len(self.tasks),
            "chunks_size": _CHUNK_FILES,
            "data_files_size_in_mb": _FILE_BYTES // 1_000_000,
            "video_files_size_in_mb": 200,
            "fps": self.fps,
            "splits": {"train": f"0:{len(self.episodes)}"},
            "data_path": _DATA,
            "video_path": None,
            "features": {name: asdict(kind) for name, kind in self.features.items()},
        }
        _write_json(self.path / "meta" / "info.json", info)

    def _documents(self, stats: dict[str, Statistics]) -> dict[str, dict[str, list[Any]]]:
        return {
            name: document_of(part, of_images=self.features[name].dtype == "image")
            for name, part in stats.items()
        }

    def _schema(self, table: pa.Table) -> pa.Schema:
        described = {name: kind.hugging() for name, kind in self.features.items()}
        text = json.dumps({"info": {"features": described}})
        return table.schema.with_metadata({"huggingface": text})

    def _named(self, pattern: str, file: int) -> Path:
        chunk, file_in_chunk = divmod(file, _CHUNK_FILES)
        path = self.path / pattern.format(chunk_index=chunk, file_index=file_in_chunk)
        path.parent.mkdir(parents=True, exist_ok=True)
        return path


# Metadata that makes pandas read the texts as the index, where LeRobot looks for them.
_KEYS = ("name", "field_name", "pandas_type", "numpy_type", "metadata")
_COLUMNS = (
    ("task_index", "task_index", "int64", "int64", None),
    (None, "__index_level_0__", "unicode", "object", None),
)
_INDEXED = {
    "pandas": json.dumps(
        {
            "index_columns": ["__index_level_0__"],
            "column_indexes": [],
            "columns": [dict(zip(_KEYS, column, strict=True)) for column in _COLUMNS],
            "pandas_version": "2.0.0",
        }
    )
}


def _columns(session: Session, press: RecordedPress, out: _Dataset) -> dict[str, Any]:
    frames, rows = session.frames, press.rows
    ticks, age = frames["t_ns"][rows], frames["image_age"][rows]
    capture = ticks - np.round(np.where(np.isfinite(age), age, 0.0) / NS).astype(np.int64)
    columns: dict[str, Any] = {
        **{name: frames[name][rows] for name in ("depth", "phase", "target", "run", "valid")},
        "t_ns": ticks,
        "capture_ns": capture,
        "utc_ns": capture + utc_offset(session, press.run),
    }
    for name, most in windows_of(session).items():
        values, ages = window(session, name, press.run, ticks, most)
        columns[f"observation.{name}.window"] = values.reshape(len(rows), -1)
        columns[f"observation.{name}.window_age"] = ages
    if "action" in out.features and "action" not in feature_names(session).values():
        state = frames["pose"][rows]
        columns["action"] = np.concatenate([state[1:], state[-1:]])
    for name, feature in feature_names(session).items():
        values, stream = frames[session.columns[name]][rows], session.streams[name]
        kind = out.features[feature].dtype
        if kind == "image":
            columns[feature] = _pictures(stream, values)
        elif kind == "string":
            columns[feature] = _texts(stream, values)
        else:
            columns[feature] = values.reshape(len(rows), -1)
    return columns


def _texts(stream: Stream, rows: Array) -> list[str]:
    """Return the text of each row; empty before the first."""
    texts = {
        int(row): event_text(stream.rows_between("value", int(row), int(row) + 1)[0])
        for row in np.unique(rows[rows >= 0])
    }
    return [texts.get(int(row), "") for row in rows]


def _pictures(camera: Stream, rows: Array) -> list[dict[str, Any]]:
    numbers = [int(row) for row in rows]
    if camera.jpeg_shape is not None:
        suffix, encoded = "jpg", list(camera.jpegs(numbers))
    else:
        suffix, encoded = "png", [_png(camera.images([row])[0]) for row in numbers]
    return [
        {"bytes": data, "path": f"frame-{index:06d}.{suffix}"} for index, data in enumerate(encoded)
    ]


def _png(pixels: Array) -> bytes:
    out = io.BytesIO()
    plain = pixels[..., 0] if pixels.shape[2] == 1 else pixels
    Image.fromarray(plain).save(out, "PNG", compress_level=1)
    return out.getvalue()


def _arrow(values: Any, kind: Feature) -> pa.Array:
    if kind.dtype in ("image", "string"):
        return pa.array(values, kind.arrow())
    array = np.ascontiguousarray(values, kind.dtype)
    if kind.shape == (1,):
        return pa.array(array.reshape(-1), kind.arrow())
    return pa.FixedSizeListArray.from_arrays(pa.array(array.reshape(-1)), kind.shape[0])


def _write_json(path: Path, document: Mapping[str, Any]) -> None:
    path.write_text(json.dumps(document, indent=4))


# Reading: the episodes of a data set (versions 2 and 3), each as the tracks of one recording.

# A field of a template of paths, such as {episode_index:06d}.
_FIELD = re.compile(r"\{(\w+)(?::(\d{1,2}d))?\}")
# Columns that number rows and tasks.
_INDICES = ("timestamp", "frame_index", "episode_index", "index", "task_index")


def read_lerobot(path: Path, answers: import_tracks.Answers) -> list[import_tracks.Take]:
    """Return the episodes of a folder, each as a recording."""
    try:
        info = json.loads((path / "meta" / "info.json").read_text())
        features: dict[str, dict[str, Any]] = info["features"]
        fps = import_tracks.require_rate(float(info["fps"]), f"{path.name}/meta/info.json: fps")
    except (KeyError, TypeError, ValueError) as error:
        raise SessionError(f"{path.name}/meta/info.json: no description: {error}") from error
    files = sorted((path / "data").rglob("*.parquet"))
    if not files:
        raise SessionError(f"{path.name}: found no parquet file in data")
    for file in files:
        about = pq.read_metadata(file)
        require_size(file, about.num_rows * about.num_columns * 8)
    table = pa.concat_tables([pq.read_table(file) for file in files])
    kinds: dict[str, import_tracks.As] = {}
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
        where = f"{path.name}: episode {episode}: row"
        times = import_tracks.whole_ns(1e9 * (seconds[rows] - seconds[rows[0]]), where, 0)
        tracks = []
        for name, kind in kinds.items():
            source = f"{path.name}:{name}"
            if kind == "video":
                content: import_tracks.Content = _film(
                    path, info, name, table, rows, times, int(episode), fps
                )
            else:
                array = np.array(table.column(name).take(rows).to_pylist(), np.float64)
                content = numbers_of(source, array, times, kind, answers)
            tracks.append(import_tracks.RecordedTrack("", kind, content, source, path.name))
        tracks.sort(key=lambda track: track.kind != "video")
        takes.append(
            import_tracks.Take(
                f"episode_{episode:06d}", import_tracks.named(tracks), (path,), tuple(left_out)
            )
        )
    return takes


def _kind(name: str, feature: dict[str, Any]) -> import_tracks.As | None:
    """Return the kind of a feature; None for what no model of forces is learned from."""
    if feature.get("dtype") in ("image", "video"):
        return "video"
    shape = (1, *feature.get("shape", ()))
    kind = kind_of_array(shape, name)
    if kind == "taxels" and int(np.prod(shape)) != 48:
        return None
    return kind


def _film(
    path: Path,
    info: dict[str, Any],
    name: str,
    table: Any,
    rows: NDArray[np.int64],
    times: import_tracks.Times,
    episode: int,
    fps: float,
) -> import_tracks.Film:
    if name in table.column_names:
        images = [entry["bytes"] for entry in table.column(name).take(rows).to_pylist()]
        if not all(isinstance(each, bytes) for each in images):
            raise SessionError(f"{path.name}: {name}: episode {episode}: an image has no bytes")
        source = f"{path.name}:{name}"
        files = [(f"{source}: row {row}", each) for row, each in zip(rows, images, strict=True)]
        return film_of_files(source, files, times, "times of the data set")
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
        template = str(info["video_path"])
        file = path / _FIELD.sub(lambda field: format(fields[field[1]], field[2] or ""), template)
    except (KeyError, ValueError) as error:
        raise SessionError(f"{path.name}: info.json: video_path: {error}") from error
    if not Path(os.path.abspath(file)).is_relative_to(os.path.abspath(path)):
        raise SessionError(f"{path.name}: info.json: video_path: {file} is outside of the data set")
    whole = open_film(file, fps)
    first = round(start * fps)
    if not 0 <= first <= len(whole.t_ns) - len(rows):
        raise SessionError(
            f"{file.name}: found {len(whole.t_ns)} images; episode {episode} needs "
            f"{first} to {first + len(rows)}"
        )

    def load() -> Iterator[Any]:
        for index, image in enumerate(whole.load()):
            if first <= index < first + len(rows):
                yield image

    return replace(whole, t_ns=times, load=load)


def _episode(path: Path, episode: int) -> dict[str, Any]:
    for file in sorted((path / "meta" / "episodes").rglob("*.parquet")):
        for entry in pq.read_table(file).to_pylist():
            if int(entry["episode_index"]) == episode:
                return dict(entry)
    raise SessionError(f"{path.name}: meta/episodes has no episode {episode}")
