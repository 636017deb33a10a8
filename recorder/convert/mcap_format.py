"""MCAP for Foxglove: every sample as one message, at its arrival time.

`log_time` is the arrival and `publish_time` the capture, both UTC from the anchor of the run;
`sequence` is the row of the stream (modulo 2**32). Images and poses use Foxglove's protobuf
schemas; data without a Foxglove message is JSON with its own schema.
"""

import heapq
import json
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage
from foxglove_schemas_protobuf.FrameTransform_pb2 import FrameTransform
from foxglove_schemas_protobuf.PoseInFrame_pb2 import PoseInFrame
from foxglove_schemas_protobuf.RawImage_pb2 import RawImage
from mcap.writer import CompressionType, Writer
from mcap_protobuf.schema import build_file_descriptor_set

from recorder.convert.export import Options
from recorder.convert.runs import utc_of_rows
from recorder.errors import SessionError
from recorder.progress import ReportItems
from recorder.session.align import captured, quaternion
from recorder.session.columns import Stream
from recorder.session.reader import Session
from recorder.spec import OUTCOMES, PHASES, event_text

# Topic of the first stream of a kind; all others have the stream's name. Poses are also sent as
# transforms on `/tf`; `/segments` and `/reference` always exist.
TOPICS: Mapping[str, str] = {
    "camera": "/camera",
    "pose": "/pose",
    "force": "/wrench",
    "taxels": "/taxels",
}


def topics(session: Session) -> dict[str, str]:
    """Return the topic of each stream, in the session's order."""
    topic_of: dict[str, str] = {}
    for name in session.order:
        kind = session.streams[name].traits.kind
        single = session.first(kind) == name and name not in session.attrs.get("fingers", {})
        topic = TOPICS.get(kind) if single else None
        topic_of[name] = topic or f"/{name}"
    names = [*topic_of.values(), "/tf", "/segments", "/reference"]
    for name, topic in topic_of.items():
        if names.count(topic) > 1:
            raise SessionError(f"{session.name}: stream {name}: {topic} is the name of a topic")
    return topic_of


_TIME = {
    "type": "object",
    "title": "time",
    "properties": {"sec": {"type": "integer"}, "nsec": {"type": "integer"}},
}


def _a(kind: str, description: str) -> dict[str, Any]:
    return {"type": kind, "description": description}


def _vector(description: str) -> dict[str, Any]:
    return {**_a("object", description), "properties": {axis: {"type": "number"} for axis in "xyz"}}


def _list(description: str) -> dict[str, Any]:
    return {"type": "array", "items": {"type": "number"}, "description": description}


def _object(properties: Mapping[str, Any]) -> dict[str, Any]:
    return {"type": "object", "properties": {"timestamp": _TIME, **properties}}


_COUNTS = {
    "type": "array",
    "items": {"type": "array", "items": {"type": "number"}},
    "description": "taxels row by row, raw counts x y z",
}

# Title and JSON schema by kind of stream, and of the two tables.
SCHEMAS: Mapping[str, tuple[str, dict[str, Any]]] = {
    "force": (
        "tactile_rig.Wrench",
        _object(
            {
                "frame_id": {"type": "string"},
                "force": _vector("F/T frame, offset removed [N]; pressing is negative z"),
                "torque": _vector("F/T frame, offset removed [N m]"),
                "seq": _a("integer", "the device's sequence number"),
                "status": _a("integer", "the device's status word"),
            }
        ),
    ),
    "taxels": (
        "tactile_rig.Taxels",
        _object({"counts": _COUNTS, "seq": _a("integer", "the device's sequence number")}),
    ),
    "events": ("tactile_rig.Event", _object({"text": {"type": "string"}})),
    "segments": (
        "tactile_rig.Phase",
        _object(
            {
                "end": _TIME,
                "duration": _a("number", "[s]"),
                "target": _a("integer", "row of targets"),
                "phase": {"type": "string"},
                "outcome": {"type": "string"},
                "run": _a("integer", "entry of the session's runs"),
                "point": _a("integer", "number of the contact point"),
                "depth": _a("number", "planned indentation [m]"),
                "direction": _a("integer", "number of the shear direction, -1 for none"),
                "planned": _list("planned place of the tip at full shear, base frame [m]"),
            }
        ),
    ),
    "reference": (
        "tactile_rig.Reference",
        _object(
            {
                "point": _a("integer", "contact point it belongs to"),
                "image": _a("integer", "row of the camera stream, -1 without one"),
                "wrench": _list("residual offset without contact [N, N m]"),
                "wrench_std": _list("its spread [N, N m]"),
                "taxels": _COUNTS,
                "run": _a("integer", "entry of the session's runs"),
            }
        ),
    ),
}


_BLOCK = 1024  # rows
_IMAGES = 16
_ATTACHED = ("bench", "plan", "calibration", "software")
# Frame names: the robot's base, its tool, the force/torque sensor.
BASE, TOOL, SENSOR = "base", "tool", "ft_sensor"


@dataclass(frozen=True, slots=True)
class Message:
    """One message, before a channel number is assigned."""

    topic: str
    log_ns: int
    """Arrival, UTC [ns]."""
    publish_ns: int
    """Capture, UTC [ns]."""
    sequence: int
    data: bytes


def write(session: Session, path: Path, options: Options, progress: ReportItems) -> None:
    """Write a session as one MCAP file."""
    named = topics(session)
    total = sum(len(session.streams[name]) for name in named)
    sources = [_samples(session, session.streams[name], topic) for name, topic in named.items()]
    with path.open("wb") as file:
        writer = Writer(file, compression=CompressionType.ZSTD)
        writer.start(profile="", library="tactile-rig")
        channels = _register(writer, session, named)
        counted = set(named.values())
        done = 0
        merged = heapq.merge(_events(session), *sources, key=lambda message: message.log_ns)
        for message in merged:
            writer.add_message(
                channels[message.topic],
                log_time=message.log_ns,
                publish_time=message.publish_ns,
                sequence=message.sequence & 0xFFFFFFFF,
                data=message.data,
            )
            if message.topic in counted:
                done += 1
                if done % 64 == 0 or done == total:
                    progress(done, total)
        reported = {key: _text(value) for key, value in session.attrs.items()}
        writer.add_metadata("session", reported)
        for name in named:
            attrs = session.streams[name].attrs
            writer.add_metadata(name, {key: _text(value) for key, value in attrs.items()})
        _attach(writer, session)
        writer.finish()  # type: ignore[no-untyped-call]


def _register(writer: Writer, session: Session, named: Mapping[str, str]) -> dict[str, int]:
    """Return the channel of each topic."""
    channels = {}

    def protobuf(topic: str, kind: Any) -> None:
        name, content = str(kind.DESCRIPTOR.full_name), build_file_descriptor_set(kind)
        schema = writer.register_schema(name, "protobuf", content.SerializeToString())
        channels[topic] = writer.register_channel(topic, "protobuf", schema)

    def json_schema(topic: str, title: str, document: dict[str, Any]) -> None:
        schema = writer.register_schema(title, "jsonschema", json.dumps(document).encode())
        channels[topic] = writer.register_channel(topic, "json", schema)

    for table in ("segments", "reference"):
        json_schema(f"/{table}", *SCHEMAS[table])
    for name, topic in named.items():
        stream = session.streams[name]
        if stream.layout.image is not None:
            protobuf(topic, CompressedImage if stream.jpeg_shape is not None else RawImage)
        elif stream.traits.kind == "pose":
            protobuf(topic, PoseInFrame)
            if "/tf" not in channels:
                protobuf("/tf", FrameTransform)
        else:
            json_schema(topic, *SCHEMAS.get(stream.traits.kind, _schema_of(stream)))
    return channels


def _schema_of(stream: Stream) -> tuple[str, dict[str, Any]]:
    """Return title and schema of the columns of a stream that has no schema of its own."""
    columns = [layout.column for layout in stream.layout.small[:-1]]
    properties = {
        column.name: _list(f"{column.description} [{column.units}]")
        if column.shape
        else _a("number", f"{column.description} [{column.units}]")
        for column in columns
    }
    return f"tactile_rig.{stream.name}", _object(properties)


def _samples(session: Session, stream: Stream, topic: str) -> Iterator[Message]:
    """Yield all messages of a stream in the order of its rows."""
    log = utc_of_rows(session, stream.name, stream.t_ns)
    publish = utc_of_rows(session, stream.name, captured(stream))
    block, make = _BLOCK, _documents
    if stream.layout.image is not None:
        block, make = _IMAGES, _images
    elif stream.traits.kind == "pose":
        make = partial(_poses, child=TOOL if topic == TOPICS["pose"] else stream.name)
    for start in range(0, len(stream), block):
        rows = range(start, min(start + block, len(stream)))
        moments = publish[start : rows.stop].tolist()
        for row, contents in zip(rows, make(stream, rows, moments), strict=True):
            for name, data in zip((topic, "/tf"), contents, strict=False):
                yield Message(name, int(log[row]), moments[row - start], row, data)


# A message, and with a pose the transform that it is as well.
_Contents = tuple[bytes] | tuple[bytes, bytes]


def _images(stream: Stream, rows: range, publish: list[int]) -> Iterator[_Contents]:
    message: CompressedImage | RawImage
    stored = stream.jpegs(rows) if stream.jpeg_shape is not None else stream.images(rows)
    for moment, image in zip(publish, stored, strict=True):
        if isinstance(image, bytes):
            message = CompressedImage(frame_id=stream.name, data=image, format="jpeg")
        else:
            height, width, channels = image.shape
            encoding = "rgb8" if channels == 3 else "mono8"
            message = RawImage(
                frame_id=stream.name,
                width=width,
                height=height,
                encoding="16UC1" if image.dtype.itemsize == 2 else encoding,
                step=width * channels * image.dtype.itemsize,
                data=image.tobytes(),
            )
        message.timestamp.FromNanoseconds(moment)
        yield (message.SerializeToString(),)


def _poses(stream: Stream, rows: range, publish: list[int], *, child: str) -> Iterator[_Contents]:
    values = stream.rows_between("value", rows.start, rows.stop)
    for moment, value, quat in zip(publish, values, quaternion(values[:, 3:]), strict=True):
        pose = PoseInFrame(frame_id=BASE)
        moved = FrameTransform(parent_frame_id=BASE, child_frame_id=child)
        for message, position, rotation in (
            (pose, pose.pose.position, pose.pose.orientation),
            (moved, moved.translation, moved.rotation),
        ):
            message.timestamp.FromNanoseconds(moment)
            position.x, position.y, position.z = (float(v) for v in value[:3])
            rotation.w, rotation.x, rotation.y, rotation.z = (float(v) for v in quat)
        yield pose.SerializeToString(), moved.SerializeToString()


def _documents(stream: Stream, rows: range, publish: list[int]) -> Iterator[_Contents]:
    """Yield the rows of a stream as JSON, by its kind or by the names of its columns."""
    kind, columns = stream.traits.kind, {}
    for name in stream.small[:-1]:
        values = stream.rows_between(name, rows.start, rows.stop)
        columns[name] = values if kind == "events" else values.tolist()
    for index, moment in enumerate(publish):
        document: dict[str, Any] = {name: values[index] for name, values in columns.items()}
        value: Any = document.get("value")
        if kind == "events":
            document = {"text": event_text(value)}
        elif kind == "force":
            document = {
                "frame_id": SENSOR if stream.name == "force" else stream.name,
                "force": dict(zip("xyz", value[:3], strict=True)),
                "torque": dict(zip("xyz", value[3:], strict=True)),
                "seq": document["seq"],
                "status": document["status"],
            }
        elif kind == "taxels":
            document = {"counts": value, "seq": document["seq"]}
        yield (_packed({"timestamp": _stamp(moment), **document}),)


def _events(session: Session) -> Iterator[Message]:
    """Yield one message per phase at its start, and one per no-contact reference, in order."""
    segments, reference, targets = session.segments, session.reference, session.targets
    messages = []
    begins = utc_of_rows(session, "segments", segments["start_ns"])
    ends = utc_of_rows(session, "segments", segments["end_ns"])
    for row, (begin, end) in enumerate(zip(begins.tolist(), ends.tolist(), strict=True)):
        target = int(segments["target"][row])
        document = {
            "timestamp": _stamp(begin),
            "end": _stamp(end),
            "duration": (end - begin) * 1e-9,
            "target": target,
            "phase": PHASES[int(segments["phase"][row])],
            "outcome": OUTCOMES[int(segments["outcome"][row])],
            "run": int(segments["run"][row]),
        }
        document |= {
            name: values[target].tolist()
            for name, values in targets.items()
            if target < len(values)
        }
        messages.append(Message("/segments", begin, begin, row, _packed(document)))
    reference_ns = utc_of_rows(session, "reference", reference["t_ns"]).tolist()
    for row, moment in enumerate(reference_ns):
        document = {"timestamp": _stamp(moment)}
        document |= {
            name: values[row].tolist() for name, values in reference.items() if name != "t_ns"
        }
        messages.append(Message("/reference", moment, moment, row, _packed(document)))
    return iter(sorted(messages, key=lambda message: message.log_ns))


def _attach(writer: Writer, session: Session) -> None:
    created = min((int(run.get("utc_ns", 0)) for run in session.runs), default=0)
    contents = {name: session.attrs[name] for name in _ATTACHED if name in session.attrs}
    contents["targets"] = {name: values.tolist() for name, values in session.targets.items()}
    for name, content in contents.items():
        data = json.dumps(content, indent=1).encode()
        writer.add_attachment(created, created, f"{name}.json", "application/json", data)


def _stamp(t_ns: int) -> dict[str, int]:
    return {"sec": t_ns // 10**9, "nsec": t_ns % 10**9}


def _finite(value: Any) -> Any:
    """Return a value with null in place of numbers that JSON cannot represent."""
    if isinstance(value, dict):
        return {key: _finite(entry) for key, entry in value.items()}
    if isinstance(value, list):
        return [_finite(entry) for entry in value]
    return None if isinstance(value, float) and not np.isfinite(value) else value


def _packed(document: dict[str, Any]) -> bytes:
    return json.dumps(_finite(document), separators=(",", ":"), allow_nan=False).encode()


def _text(value: object) -> str:
    return value if isinstance(value, str) else json.dumps(value)
