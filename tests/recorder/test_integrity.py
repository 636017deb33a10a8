"""A changed byte is never read as data: checksums of chunks, bounds of metadata, failed threads."""

import contextlib
import json
import random
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import simplejpeg
import zarr
from support.sessions import make_session

from recorder import Session, SessionError, SessionWriter, StreamWriter, force_spec
from recorder.session.reader import Stream
from recorder.store.images import compress, decode_jpeg, decompress
from recorder.store.layout import StreamLayout, create_stream

# Recorded by format version 1: no checksums in the chunks, no manifest.
OLD = Path(__file__).parents[1] / "golden" / "data"


@pytest.fixture(scope="module")
def jpeg_session(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make_session(tmp_path_factory.mktemp("jpeg") / "s.zarr", seconds=1.2, shape=(16, 24))


@pytest.fixture(scope="module")
def lossless_session(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("lossless") / "s.zarr"
    return make_session(path, seconds=1.2, shape=(16, 24), codec="zstd", names=("camera", "force"))


def columns_of(stream: Stream) -> dict[str, Any]:
    found = {name: stream.array(name) for name in stream.small}
    if stream.layout.image is not None:
        found["images"] = stream.images(slice(None))
    return found


def zarr_columns(stream: Stream) -> dict[str, Any]:
    arrays = (layout.path for layout in stream.layout.columns)
    return {path.name: np.asarray(zarr.open_array(path, mode="r")) for path in arrays}


def same(a: dict[str, Any], b: dict[str, Any]) -> bool:
    return all(np.array_equal(a[name], b[name], equal_nan=a[name].dtype.kind == "f") for name in b)


def flip(path: Path, bit: int) -> None:
    data = bytearray(path.read_bytes())
    data[bit // 8] ^= 1 << bit % 8
    path.write_bytes(data)


@pytest.mark.parametrize("kind", ["jpeg_session", "lossless_session"])
def test_a_flipped_bit_in_a_shard_is_refused_or_changes_no_value(
    kind: str, request: pytest.FixtureRequest, tmp_path: Path
) -> None:
    path = tmp_path / "s.zarr"
    shutil.copytree(request.getfixturevalue(kind), path)
    session, dice = Session(path), random.Random(7)
    refused = 0
    for name, stream in session.streams.items():
        good, good_zarr = columns_of(stream), zarr_columns(stream)
        for shard in sorted(p for p in stream.layout.path.glob("*/c/**/*") if p.is_file()):
            whole = shard.read_bytes()
            for _ in range(3):
                flip(shard, dice.randrange(8 * len(whole)))
                try:
                    assert same(columns_of(Stream(stream.layout.path)), good), f"{name} {shard}"
                except SessionError:
                    refused += 1
                with contextlib.suppress(ValueError, RuntimeError):
                    assert same(zarr_columns(stream), good_zarr), f"{name} {shard}"
                shard.write_bytes(whole)
    assert refused > 10


def test_a_swapped_chunk_is_refused_although_its_own_checksum_matches(tmp_path: Path) -> None:
    create_stream(tmp_path / "force", force_spec(1000))
    with StreamWriter.open(tmp_path / "force") as writer:
        for t_ns in range(2048):
            writer.append(value=np.arange(6.0), seq=1, status=5 + t_ns // 1024, t_ns=t_ns)
    (layout,) = (
        c for c in StreamLayout.load(tmp_path / "force").columns if c.path.name == "status"
    )
    data = layout.shard(0).read_bytes()
    offsets = np.frombuffer(data[-1028:-4], "<u8").reshape(64, 2)[:2].astype(int)
    first, second = (data[start : start + size] for start, size in offsets)
    assert len(first) == len(second)
    assert first != second
    changed = data[: offsets[0, 0]] + second + data[offsets[0].sum() :]
    layout.shard(0).write_bytes(changed)
    with pytest.raises(SessionError, match=r"chunk 0 \(row 0\) does not match its checksum"):
        Stream(tmp_path / "force").array("status")


@pytest.mark.parametrize("name", ["gelsight.zarr", "uskin.zarr"])
def test_sessions_of_format_1_open_are_verified_by_their_records_and_can_be_resumed(
    name: str, tmp_path: Path
) -> None:
    path = tmp_path / name
    shutil.copytree(OLD / name, path)
    session = Session(path)
    good = {name: columns_of(stream) for name, stream in session.streams.items()}
    shard = session.streams["force"].layout.columns[0].shard(0)
    whole = shard.read_bytes()
    for bit in range(8 * 30, 8 * 60, 11):  # of the first chunk
        flip(shard, bit)
        with pytest.raises(SessionError, match="does not match its checksum"):
            Session(path).streams["force"].array("value")
        shard.write_bytes(whole)
    writer = SessionWriter.resume(path)
    writer.begin_run({"t0_ns": 0, "utc": "2026-01-01T00:00:00Z", "boot_id": "b"})
    with StreamWriter.open(writer.stream_path("force")) as force:
        force.append(value=np.ones(6), seq=1, status=0, t_ns=10**18)
    writer.finish("stopped", rate_hz=40)
    resumed = Session(path)
    assert len(resumed.streams["force"]) == len(good["force"]["t_ns"]) + 1
    for stream, columns in good.items():
        count = len(columns["t_ns"])
        found = {k: v[:count] for k, v in columns_of(resumed.streams[stream]).items()}
        assert same(found, columns)


def edit(path: Path, change: Callable[[dict[str, Any]], None]) -> None:
    document = json.loads(path.read_text())
    change(document)
    path.write_text(json.dumps(document))


HOSTILE: dict[str, tuple[str, Callable[[dict[str, Any]], Any], str]] = {
    "72 TiB of rows": (
        "streams/force/value",
        lambda d: d.update(shape=[10**13, 6]),
        "allowed: up to",
    ),
    "rows without shards": (
        "streams/force/value",
        lambda d: d.update(shape=[10**12, 6]),
        "shard missing",
    ),
    "negative rows": ("streams/force/value", lambda d: d.update(shape=[-1, 6]), "found shape"),
    "a row of 2^40 values": (
        "streams/force/value",
        lambda d: d.update(shape=[5, 1 << 40]),
        "found shape",
    ),
    "shape not a list": ("streams/force/value", lambda d: d.update(shape="x"), "found shape"),
    "a chunk of 2^40 rows": (
        "streams/force/value",
        lambda d: d["codecs"][0]["configuration"].update(chunk_shape=[1 << 40, 6]),
        "found chunk_shape",
    ),
    "1e12 Hz": (
        "streams/force",
        lambda d: d["attributes"].update(rate_hz=1e12),
        "found rate_hz 1000000000000.0; allowed: above 0 to 1e",
    ),
    "rate that is text": (
        "streams/force",
        lambda d: d["attributes"].update(rate_hz="fast"),
        "found rate_hz 'fast'",
    ),
    "rate of the session": (".", lambda d: d["attributes"].update(rate_hz=1e12), "found rate_hz"),
    "runs not a list": (".", lambda d: d["attributes"].update(runs={"a": 1}), "found runs"),
    "a run that is a number": (".", lambda d: d["attributes"].update(runs=[3]), r"found runs\[0\]"),
    "a run that starts before the one before": (
        ".",
        lambda d: d["attributes"].update(
            runs=[{"first_row": {"force": 5}}, {"first_row": {"force": 4}}]
        ),
        r"found runs\[1\] first_row force 4; allowed: 5 to",
    ),
    "unknown status": (".", lambda d: d["attributes"].update(status="fine"), "found status 'fine'"),
    "a table of 10^12 rows": (
        "targets/planned",
        lambda d: d.update(shape=[10**12, 3]),
        "chunk missing",
    ),
}


@pytest.mark.parametrize("case", HOSTILE)
def test_impossible_metadata_is_refused_by_name(case: str, tmp_path: Path) -> None:
    path = tmp_path / "s.zarr"
    shutil.copytree(OLD / "gelsight.zarr", path)
    where, change, message = HOSTILE[case]
    edit(path / where / "zarr.json", change)

    def read() -> None:
        session = Session(path)
        columns_of(session.streams["force"])
        dict(session.targets)

    with pytest.raises(SessionError, match=message):
        read()


def test_a_jpeg_is_refused_by_its_header_before_its_pixels_are_decoded() -> None:
    small = bytearray(simplejpeg.encode_jpeg(np.zeros((16, 24, 3), np.uint8)))
    size = small.index(b"\xff\xc0") + 5
    small[size : size + 4] = (65500).to_bytes(2, "big") * 2
    with pytest.raises(SessionError, match=r"found \(65500, 65500\), expected \(16, 24, 3\)"):
        decode_jpeg(bytes(small), (16, 24, 3))


@pytest.mark.parametrize("nbytes", [1, 255, 256, 300, 65_791, 65_792, 200_000])
def test_a_zstd_frame_is_refused_by_the_length_it_declares(nbytes: int) -> None:
    frame = compress(bytes(nbytes))
    assert decompress(frame, nbytes) == bytes(nbytes)
    with pytest.raises(SessionError, match=f"found {nbytes} bytes, expected {nbytes + 1}"):
        decompress(frame, nbytes + 1)


def test_any_error_of_the_background_thread_stops_the_recording(tmp_path: Path) -> None:
    path = tmp_path / "force"
    create_stream(path, force_spec(50))  # 64 rows a block, 64 blocks a shard
    row = {"value": np.arange(6.0), "seq": 1, "status": 0}
    writer = StreamWriter.open(path, sync_interval=0.01)
    (path / "value" / "zarr.json").write_text("garbled")  # read when a shard is sealed

    def record() -> None:
        for t_ns in range(100_000):
            writer.append(**row, t_ns=t_ns)

    with pytest.raises(SessionError, match=r"recording stopped.*not readable as JSON"):
        record()
    accepted = writer.rows
    with pytest.raises(SessionError, match="not readable as JSON"):
        writer.close()
    shutil.copy(path / "seq" / "zarr.json", path / "value" / "zarr.json")
    edit(path / "value" / "zarr.json", lambda d: d.update(_as_value(d)))
    StreamWriter.open(path).close()
    assert len(Stream(path)) == accepted


def _as_value(document: dict[str, Any]) -> dict[str, Any]:
    """Return the metadata of `value` (n, 6) float64 after that of a scalar column."""
    grid = document["chunk_grid"]["configuration"]["chunk_shape"]
    codecs = document["codecs"]
    codecs[0]["configuration"]["chunk_shape"].append(6)
    return {
        "shape": [document["shape"][0], 6],
        "data_type": "float64",
        "fill_value": "NaN",
        "chunk_grid": {"name": "regular", "configuration": {"chunk_shape": [*grid, 6]}},
        "codecs": codecs,
        "attributes": {"units": "N, N m", "description": "d"},
        "dimension_names": ["row", "axis"],
    }
