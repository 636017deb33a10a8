"""MCAP exports, read back with the mcap and mcap-protobuf readers, with checksums verified."""

import json
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.reader import McapReader, make_reader
from mcap_protobuf.decoder import DecoderFactory
from support.sessions import T0, make_session, set_attrs

from recorder import PHASES, Session, SessionError
from recorder.convert import Answers, draft_recordings, export
from recorder.convert.import_bags import read_bag
from recorder.convert.runs import parse_utc
from recorder.session.align import quaternion

OFFSET = parse_utc("2026-01-01T00:00:00Z") - T0


@pytest.fixture(scope="module")
def both(tmp_path_factory: pytest.TempPathFactory) -> tuple[Session, Path]:
    folder = tmp_path_factory.mktemp("mcap")
    path = make_session(folder / "s.zarr", names=("camera", "force", "pose", "taxels"))
    export(path, folder / "s.mcap", "mcap")
    return Session(path), folder / "s.mcap"


@contextmanager
def reader_of(path: Path) -> Iterator[McapReader]:
    with path.open("rb") as file:
        yield make_reader(file, validate_crcs=True, decoder_factories=[DecoderFactory()])


def messages(path: Path, topic: str) -> list[tuple[Any, Any]]:
    with reader_of(path) as reader:
        return [(each[2], each[3]) for each in reader.iter_decoded_messages(topics=[topic])]


def documents(path: Path, topic: str) -> list[Any]:
    """Return the messages of a topic that are JSON."""
    with reader_of(path) as reader:
        return [json.loads(each.data) for _, _, each in reader.iter_messages(topics=[topic])]


def test_images_are_the_bytes_of_the_camera_at_their_times(both: tuple[Session, Path]) -> None:
    session, path = both
    camera = session.streams["camera"]
    found = messages(path, "/camera")
    assert [decoded.data for _, decoded in found] == [*camera.jpegs(range(len(camera)))]
    assert [message.log_time for message, _ in found] == (camera.t_ns + OFFSET).tolist()
    assert [message.sequence for message, _ in found] == list(range(len(camera)))
    stamps = [decoded.timestamp.ToNanoseconds() for _, decoded in found]
    assert stamps == [message.publish_time for message, _ in found]
    assert {decoded.format for _, decoded in found} == {"jpeg"}


def test_poses_and_transforms_are_those_of_the_stream(both: tuple[Session, Path]) -> None:
    session, path = both
    values = session.streams["pose"].array("value")
    poses, moved = messages(path, "/pose"), messages(path, "/tf")
    assert len(poses) == len(moved) == len(values)
    places = [(p.pose.position.x, p.pose.position.y, p.pose.position.z) for _, p in poses]
    np.testing.assert_array_equal(places, values[:, :3])
    turned = [(t.rotation.w, t.rotation.x, t.rotation.y, t.rotation.z) for _, t in moved]
    np.testing.assert_array_equal(turned, quaternion(values[:, 3:]))
    assert {(t.parent_frame_id, t.child_frame_id) for _, t in moved} == {("base", "tool")}


def test_wrenches_and_taxels_are_json_with_a_schema(both: tuple[Session, Path]) -> None:
    session, path = both
    force, taxels = session.streams["force"], session.streams["taxels"]
    found = documents(path, "/wrench")
    values = [[*d["force"].values(), *d["torque"].values()] for d in found]
    np.testing.assert_array_equal(values, force.array("value"))
    np.testing.assert_array_equal([d["seq"] for d in found], force.array("seq"))
    found = documents(path, "/taxels")
    np.testing.assert_array_equal([d["counts"] for d in found], taxels.array("value"))
    with reader_of(path) as reader:
        summary = reader.get_summary()
    assert summary is not None
    schemas = {schema.name: schema for schema in summary.schemas.values()}
    assert json.loads(schemas["tactile_rig.Wrench"].data)["properties"]["force"]["type"] == "object"
    assert schemas["foxglove.CompressedImage"].encoding == "protobuf"


def test_phases_are_events_and_the_rest_is_metadata(both: tuple[Session, Path]) -> None:
    session, path = both
    phases = documents(path, "/segments")
    assert [d["phase"] for d in phases] == [PHASES[p] for p in session.segments["phase"]]
    assert phases[0]["duration"] == pytest.approx(0.36)
    assert phases[0]["depth"] == session.targets["depth"][0]
    (reference,) = documents(path, "/reference")
    assert reference["wrench"] == [0.25] * 3 + [0.0] * 3
    with reader_of(path) as reader:
        metadata = {record.name: record.metadata for record in reader.iter_metadata()}
        attached = {record.name: record.data for record in reader.iter_attachments()}
    reported = {name: value for name, value in metadata["session"].items() if name != "runs"}
    assert reported["sensor"] == "wedge"
    assert json.loads(reported["contact_frame"]) == session.attrs["contact_frame"]
    assert json.loads(attached["targets.json"])["depth"] == session.targets["depth"].tolist()


def test_messages_lie_in_the_order_of_their_arrival(both: tuple[Session, Path]) -> None:
    session, path = both
    with reader_of(path) as reader:
        times = [m.log_time for _, _, m in reader.iter_messages(log_time_order=False)]
    assert times == sorted(times)
    samples = sum(len(stream) for stream in session.streams.values())
    events = len(session.segments["t_ns" if "t_ns" in session.segments else "end_ns"]) + 1
    assert len(times) == samples + len(session.streams["pose"]) + events


def test_lossless_images_become_raw_images(tmp_path: Path) -> None:
    path = make_session(tmp_path / "s.zarr", names=("camera",), codec="zstd", seconds=1.0)
    export(path, tmp_path / "s.mcap", "mcap")
    expected = Session(path).streams["camera"].images(slice(None))
    for (_, image), pixels in zip(messages(tmp_path / "s.mcap", "/camera"), expected, strict=True):
        assert (image.encoding, image.width, image.height, image.step) == ("rgb8", 64, 48, 192)
        assert image.data == pixels.tobytes()


def test_latency_moves_the_capture_and_not_the_arrival(tmp_path: Path) -> None:
    path = make_session(tmp_path / "s.zarr", names=("camera",), seconds=1.0)
    set_attrs(path / "streams/camera", latency=0.055)
    export(path, tmp_path / "s.mcap", "mcap")
    found = messages(tmp_path / "s.mcap", "/camera")
    assert {m.log_time - m.publish_time for m, _ in found} == {55_000_000}


def test_a_flipped_bit_is_refused_by_name_and_never_imported(tmp_path: Path) -> None:
    path = make_session(tmp_path / "s.zarr", names=("taxels",), seconds=0.5)
    export(path, tmp_path / "s.mcap", "mcap")
    whole = (tmp_path / "s.mcap").read_bytes()
    answers = Answers(sensor="a", indenter="b", press=("none",), taxel_order="taxel")
    values = read_bag(tmp_path / "s.mcap", answers).tracks[0].content
    rng, refused = np.random.default_rng(0), []
    for _ in range(30):
        data = bytearray(whole)
        data[rng.integers(len(data))] ^= 1 << rng.integers(8)
        (tmp_path / "flip.mcap").write_bytes(data)
        try:
            (draft,) = draft_recordings([tmp_path / "flip.mcap"], [], answers)
        except SessionError as error:
            refused.append(str(error))
            continue
        found = draft.take.tracks[0].content
        np.testing.assert_array_equal(found.value, values.value)
        np.testing.assert_array_equal(found.t_ns, values.t_ns)
    assert len(refused) > 5
    assert all("flip" in each for each in refused)
