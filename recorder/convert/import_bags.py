"""Topics of MCAP files and of rosbags 1 and 2, as tracks of one clock.

Messages are known by their fields, whatever their encoding: CDR and ROS 1 by `rosbags`, protobuf
and JSON by `mcap`. A message's own stamp is its time where it has one, else the time of the log;
both are compared, as stamps may be of another clock.
"""

import json
import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np

from recorder.convert import import_tracks, import_video
from recorder.convert.import_numbers import numbers_of, require_size
from recorder.errors import SessionError
from recorder.session.align import NS

SUFFIXES = (".bag", ".mcap", ".db3")

# Channels of a pixel by encoding, bits of each, and their order as indices of red, green and blue.
_ENCODINGS = {
    "rgb8": (3, 8, (0, 1, 2)),
    "bgr8": (3, 8, (2, 1, 0)),
    "8UC3": (3, 8, (2, 1, 0)),
    "rgba8": (4, 8, (0, 1, 2)),
    "bgra8": (4, 8, (2, 1, 0)),
    "mono8": (1, 8, (0, 0, 0)),
    "8UC1": (1, 8, (0, 0, 0)),
    "mono16": (1, 16, (0, 0, 0)),
    "rgb16": (3, 16, (0, 1, 2)),
    "bgr16": (3, 16, (2, 1, 0)),
}
# Names of a stamp's whole seconds and of its nanoseconds.
_STAMPS = (("sec", "nanosec"), ("sec", "nsec"), ("seconds", "nanos"), ("secs", "nsecs"))
# Stamps of one clock are logged up to so long after others, or before them; wander so far; and are
# compared over this time [s].
_BEHIND, _AHEAD, _WANDER, _STEADY = 0.25, 0.02, 0.05, 1.0


@dataclass(slots=True)
class _Topic:
    kind: import_tracks.As
    t_ns: list[int] = field(default_factory=list)
    log_ns: list[int] = field(default_factory=list)
    values: list[Any] = field(default_factory=list)
    """Numbers of each message; shapes of images."""
    jpeg: bool = True
    unstamped: int = 0


def read_bag(path: Path, answers: import_tracks.Answers) -> import_tracks.Take:
    """Return the recording in a `.bag`, `.mcap` or `.db3`, or in the folder of a rosbag 2."""
    topics: dict[str, _Topic] = {}
    left_out: dict[str, str] = {}
    for topic, kind_name, log_ns, message in _messages(path):
        stated = answers.kind(topic)
        if stated == "skip":
            left_out[topic] = "left out as stated"
            continue
        sample = _sample(message)
        if sample is None:
            left_out[topic] = f"{kind_name} holds nothing that a session has a stream for"
            continue
        kind, value = sample
        by_name = import_tracks.kind_of_name(topic)
        kind = stated or (by_name if kind == "values" and by_name not in (None, "video") else kind)
        entry = topics.setdefault(topic, _Topic(kind))
        stamp = _stamp(message)
        entry.unstamped += stamp is None
        entry.t_ns.append(log_ns if stamp is None else stamp)
        entry.log_ns.append(log_ns)
        if kind == "video":
            entry.jpeg = entry.jpeg and isinstance(value, bytes) and value[:2] == import_video.JPEG
            entry.values.append(_size(f"{path.name}:{topic}: image", value))
        else:
            entry.values.append(value)
    if not topics:
        raise SessionError(f"{path.name}: found no topic with images, forces, taxels or numbers")
    clocks, assumed = _on_one_clock(topics, path.name)
    start = min(int(t_ns.min()) for t_ns in clocks.values())
    tracks = []
    assumed += [f"{path.name}: {topic}: {why}" for topic, why in left_out.items()]
    with import_tracks.problems() as part:
        for topic, entry in sorted(topics.items(), key=lambda item: item[1].kind != "video"):
            source = f"{path.name}:{topic}"
            if entry.unstamped:
                assumed.append(f"{source}: {entry.unstamped} messages without a stamp: log time")
            with part(source):
                times = (clocks[topic] - start).astype(np.float64)
                t_ns = import_tracks.whole_ns(times, f"{source}: message", 0)
                if entry.kind == "video":
                    content: import_tracks.Content = _film(path, topic, source, entry, t_ns)
                else:
                    sizes = {np.size(value) for value in entry.values}
                    if len(sizes) > 1:
                        raise SessionError(f"{source}: found messages of {sorted(sizes)} numbers")
                    if entry.kind == "force" and answers.units is None:
                        # The messages' definitions state newton and newton metre.
                        answers = replace(answers, units="N", torque_units="N m")
                    values = np.array(entry.values, np.float64)
                    content = numbers_of(source, values, t_ns, entry.kind, answers)
                tracks.append(
                    import_tracks.RecordedTrack("", entry.kind, content, source, path.name)
                )
    return import_tracks.Take(path.stem, import_tracks.named(tracks), (path,), tuple(assumed))


def _on_one_clock(
    topics: dict[str, _Topic], name: str
) -> tuple[dict[str, import_tracks.Times], list[str]]:
    """Return the times of each topic's messages (n,) [ns], and messages on stamps that were moved.

    Stamps that leave the log are moved by how far they do, by the median of neighbours, so that
    all are on the clock of the topic that agrees with the log best.
    """
    times = {topic: np.array(entry.t_ns, np.int64) for topic, entry in topics.items()}
    late = {topic: np.array(topics[topic].log_ns, np.int64) - times[topic] for topic in topics}
    usual = min((int(np.median(each)) for each in late.values()), key=abs)
    assumed = []
    for topic, t_ns in times.items():
        side = min(round(_STEADY * import_tracks.rate_of(t_ns)), len(t_ns)) // 2
        padded = np.pad(late[topic] - usual, side, mode="edge")
        windows = np.lib.stride_tricks.sliding_window_view(padded, 2 * side + 1)
        moved = np.median(windows, axis=1).round().astype(np.int64)
        low, high = (int(end) * NS for end in (moved.min(), moved.max()))
        if low >= -_AHEAD and high <= _BEHIND and high - low <= _WANDER:
            continue
        times[topic] = t_ns + moved
        assumed.append(
            f"{name}:{topic}: its stamps are of another clock: the log is {moved[0] * NS:+.3f} s "
            f"later at first, {moved[-1] * NS:+.3f} s at last; moved by that"
        )
    return times, assumed


def _film(path: Path, topic: str, source: str, entry: _Topic, t_ns: Any) -> import_tracks.Film:
    def load() -> Iterator[Any]:
        for _, _, _, message in _messages(path, topic):
            sample = _sample(message)
            if sample is not None:
                yield sample[1] if entry.jpeg else _pixels(sample[1])

    times = "times by its own stamps"
    return import_video.film_of_pictures(
        source, entry.values, t_ns, load, jpeg=entry.jpeg, times=times
    )


def _messages(path: Path, only: str | None = None) -> Iterator[tuple[str, str, int, Any]]:
    """Yield topic, type, time of the log [ns] and content of every message in order of time."""
    if path.is_file() and path.suffix == ".mcap":
        yield from _mcap(path, only)
        return
    from rosbags.highlevel import AnyReader
    from rosbags.typesys import Stores, get_typestore

    folder = path.parent if path.suffix == ".db3" else path
    # Older rosbags 2 hold no definitions of their messages.
    store = get_typestore(Stores.ROS2_HUMBLE)
    with AnyReader([folder], default_typestore=store) as reader:
        connections = [each for each in reader.connections if only in (None, each.topic)]
        for connection, t_ns, data in reader.messages(connections=connections):
            message = reader.deserialize(data, connection.msgtype)
            yield connection.topic, connection.msgtype, int(t_ns), message


def _mcap(path: Path, only: str | None) -> Iterator[tuple[str, str, int, Any]]:
    from mcap.reader import make_reader
    from mcap_protobuf.decoder import DecoderFactory

    protobuf, read = DecoderFactory(), 0
    decoders: dict[int, Callable[[bytes], Any] | None] = {}
    with path.open("rb") as file:
        reader = make_reader(file, validate_crcs=True)
        summary = reader.get_summary()
        for chunk in summary.chunk_indexes if summary else ():
            require_size(path, chunk.uncompressed_size)
        for schema, channel, message in reader.iter_messages(topics=only):
            read += 1
            if channel.id not in decoders:
                decoders[channel.id] = (
                    partial(json.loads, object_hook=lambda entry: SimpleNamespace(**entry))
                    if channel.message_encoding == "json"
                    else _ros(channel.message_encoding, schema)
                    if channel.message_encoding in ("cdr", "ros1")
                    else protobuf.decoder_for(channel.message_encoding, schema)
                )
            decode = decoders[channel.id]
            content = SimpleNamespace() if decode is None else decode(message.data)
            name = schema.name if schema is not None else channel.message_encoding
            yield channel.topic, name, int(message.log_time), content
    counted = summary.statistics if summary and only is None else None
    if counted and counted.message_count != read:
        raise SessionError(f"{path.name}: found {read} of {counted.message_count} messages")


def _ros(encoding: str, schema: Any) -> Callable[[bytes], Any] | None:
    """Return the decoder of a ROS message by its definition in the file."""
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    if schema is None or schema.encoding not in ("ros2msg", "ros1msg"):
        return None
    store = get_typestore(Stores.EMPTY if encoding == "ros1" else Stores.ROS2_HUMBLE)
    name = schema.name if "/msg/" in schema.name else schema.name.replace("/", "/msg/")
    if encoding == "ros1" or name not in store.fielddefs:
        store.register(get_types_from_msg(schema.data.decode(), name))
    read = store.deserialize_ros1 if encoding == "ros1" else store.deserialize_cdr
    return lambda data: read(data, name)


def _sample(message: Any) -> tuple[import_tracks.As, Any] | None:
    """Return kind and value of a message by its fields; None if it has no stream."""
    for inner in ("wrench", "pose", "twist"):
        if hasattr(message, inner) and not hasattr(message, "force"):
            message = getattr(message, inner)
    if hasattr(message, "force") and hasattr(message, "torque"):
        force, torque = _xyz(message.force), _xyz(message.torque)
        complete = force is not None and torque is not None
        return ("force", np.array([*force, *torque])) if complete else None  # type: ignore[misc]
    if hasattr(message, "position") and hasattr(message, "orientation"):
        turned = message.orientation
        position = _xyz(message.position)
        return (
            None
            if position is None
            else ("pose", np.array([*position, turned.x, turned.y, turned.z, turned.w]))
        )
    data = getattr(message, "data", None)
    if data is not None and hasattr(message, "encoding") and hasattr(message, "height"):
        return "video", message
    if data is not None and hasattr(message, "format"):
        return "video", bytes(data)
    if (counts := getattr(message, "counts", None)) is not None:
        return "taxels", np.asarray(counts, np.float64)
    if isinstance(getattr(message, "position", None), list | np.ndarray):
        return "values", np.asarray(message.position, np.float64)
    if isinstance(data, int | float) and not isinstance(data, bool):
        return "values", np.array([float(data)])
    if isinstance(data, list | np.ndarray) and len(data):
        numbers = np.asarray(data)
        if numbers.dtype.kind in "iuf":
            return ("taxels" if numbers.size == 48 else "values"), numbers.astype(np.float64)
    return None


def _xyz(vector: Any) -> tuple[float, float, float] | None:
    if isinstance(vector, list) and len(vector) == 3:
        return float(vector[0]), float(vector[1]), float(vector[2])
    if not all(hasattr(vector, axis) for axis in "xyz"):
        return None
    # JSON has null for an axis that was not measured.
    x, y, z = (
        math.nan if value is None else float(value) for value in (vector.x, vector.y, vector.z)
    )
    return x, y, z


def _stamp(message: Any) -> int | None:
    """Return a message's own time [ns]; None if it has none, or one that was never set."""
    stamp = getattr(getattr(message, "header", message), "stamp", None)
    stamp = getattr(message, "timestamp", None) if stamp is None else stamp
    for whole, parts in _STAMPS:
        if hasattr(stamp, whole) and hasattr(stamp, parts):
            stamp_ns = int(getattr(stamp, whole)) * 10**9 + int(getattr(stamp, parts))
            return stamp_ns or None
    return None


def _size(where: str, value: Any) -> import_video.Size:
    """Return the size of an image message, which must be one that can be read."""
    if isinstance(value, bytes):
        return import_video.size_of_picture(where, value)
    if value.encoding not in _ENCODINGS:
        raise SessionError(
            f"{where}: found encoding {value.encoding!r}; allowed: {', '.join(_ENCODINGS)}"
        )
    channels, bits, _ = _ENCODINGS[value.encoding]
    import_video.require_pixels(where, value.height, value.width)
    if len(value.data) < value.height * max(value.step, value.width * channels * bits // 8):
        raise SessionError(f"{where}: found {len(value.data)} bytes, too few for its size")
    return value.height, value.width, bits


def _pixels(value: Any) -> Any:
    """Return an image message as pixels (h, w, 3) uint8 or uint16, RGB."""
    if isinstance(value, bytes):
        return import_video.pixels_of_picture("image", value)
    channels, bits, order = _ENCODINGS[value.encoding]
    used = value.width * channels * bits // 8
    step = max(value.step, used)
    rows = np.frombuffer(bytes(value.data), np.uint8, step * value.height).reshape(-1, step)
    kind = f"{'>' if getattr(value, 'is_bigendian', 0) else '<'}u{bits // 8}"
    pixels = np.ascontiguousarray(rows[:, :used]).view(kind).reshape(*rows.shape[:1], -1, channels)
    return np.ascontiguousarray(pixels[..., list(order)], f"u{bits // 8}")
