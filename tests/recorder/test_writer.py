"""A stream reads back exactly the rows that were appended, through resuming and closing."""

import errno
import os
import tempfile
import threading
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import simplejpeg
import zarr
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from recorder import Column, SessionError, StreamSpec, StreamWriter, camera_spec, force_spec
from recorder.session import stream_writer
from recorder.session.columns import Stream
from recorder.store import journal
from recorder.store.layout import StreamLayout, create_stream, write_table
from recorder.store.reader import Table
from recorder.store.records import header

BLOCK = 64  # rows per journal at camera rates, and frames per image shard


def tiny_camera(path: Path) -> Path:
    """Create a lossless camera stream of 4x4 images."""
    create_stream(path, camera_spec(60, height=4, width=4, codec="zstd"))
    return path


def camera_row(row: int) -> dict[str, Any]:
    """Return a row that encodes its number in every column."""
    pixels = np.full((4, 4, 3), row % 251, np.uint8)
    pixels[0, 0] = [row & 255, row >> 8 & 255, row >> 16]
    return {"value": pixels, "device_t": row / 60, "t_ns": 10**15 + row * 16_666_667}


def assert_holds_exactly(path: Path, rows: int, *, zarr_too: bool = True) -> None:
    """Compare every row of a camera stream, read by our reader and by zarr-python."""
    stream = Stream(path)
    assert len(stream) == rows
    expected = [camera_row(row) for row in range(rows)]
    images = np.array([row["value"] for row in expected], np.uint8).reshape(-1, 4, 4, 3)
    t_ns = np.array([row["t_ns"] for row in expected], np.int64)
    np.testing.assert_array_equal(stream.images(range(rows)), images)
    np.testing.assert_array_equal(stream.t_ns, t_ns)
    if not zarr_too:
        return
    group = zarr.open_group(path, mode="r")
    assert sorted(group.array_keys()) == ["device_t", "t_ns", "value"]
    np.testing.assert_array_equal(np.asarray(group["value"]), images)
    np.testing.assert_array_equal(np.asarray(group["t_ns"]), t_ns)
    np.testing.assert_array_equal(np.asarray(group["device_t"]), [r["device_t"] for r in expected])


@pytest.mark.slow
@settings(max_examples=20, deadline=None, suppress_health_check=list(HealthCheck))
@given(
    parts=st.lists(
        st.one_of(st.integers(0, 5), st.integers(BLOCK - 2, BLOCK + 2), st.just(2 * BLOCK)),
        min_size=1,
        max_size=4,
    )
)
def test_any_sequence_of_appending_closing_and_resuming_equals_a_list(
    parts: list[int], tmp_path_factory: pytest.TempPathFactory
) -> None:
    path = tiny_camera(tmp_path_factory.mktemp("stream") / "camera")
    rows = 0
    for part in parts:
        with StreamWriter.open(path) as stream:
            assert stream.rows == rows
            for _ in range(part):
                assert stream.append(**camera_row(rows)) == rows
                rows += 1
        assert_holds_exactly(path, rows, zarr_too=False)
    assert_holds_exactly(path, rows)


def test_a_stream_longer_than_a_shard_of_small_columns_reads_back(tmp_path: Path) -> None:
    rows = 64 * BLOCK + 100
    spec = StreamSpec(
        "s", (Column("a", "int32", (2,)), Column("b", "float32"), Column("t_ns", "int64")), 50
    )
    create_stream(tmp_path / "s", spec)
    with StreamWriter.open(tmp_path / "s") as stream:
        for row in range(rows):
            stream.append(a=[row, -row], b=row / 2, t_ns=row)
    group = zarr.open_group(tmp_path / "s", mode="r")
    np.testing.assert_array_equal(np.asarray(group["a"])[:, 1], -np.arange(rows))
    np.testing.assert_array_equal(np.asarray(group["b"]), np.arange(rows) / 2)
    np.testing.assert_array_equal(np.asarray(group["t_ns"]), np.arange(rows))


@pytest.mark.parametrize("rows", [0, 1, 8192, 8193, 20_000])
def test_a_table_of_any_length_reads_back(rows: int, tmp_path: Path) -> None:
    numbers = np.arange(rows)
    columns = {"row": numbers, "force": np.stack([numbers + 0.5, -numbers], axis=1)}
    write_table(tmp_path / "table", columns, {})
    table = Table(tmp_path / "table")
    group = zarr.open_group(tmp_path / "table", mode="r")
    for name, values in columns.items():
        np.testing.assert_array_equal(table[name], values)
        np.testing.assert_array_equal(np.asarray(group[name]), values)


def test_other_values_of_a_table_under_the_same_checksum_are_refused(tmp_path: Path) -> None:
    for name, value in (("table", 1.0), ("other", 2.0)):
        write_table(tmp_path / name, {"force": np.full(9, value)}, {})
    chunk, other = (tmp_path / name / "force/c/0" for name in ("table", "other"))
    chunk.write_bytes(other.read_bytes()[:-4] + chunk.read_bytes()[-4:])
    with pytest.raises(SessionError, match=r"force/c/0: the chunk does not match its checksum"):
        Table(tmp_path / "table")["force"]


def test_a_dark_frame_is_stored_like_any_other(tmp_path: Path) -> None:
    path = tiny_camera(tmp_path / "camera")
    with StreamWriter.open(path) as stream:
        stream.append(value=np.zeros((4, 4, 3), np.uint8), device_t=np.nan, t_ns=1)
    assert Stream(path).images([0]).max() == 0
    for shard in path.glob("value/c/0/0/0/0"):
        shard.unlink()
    with pytest.raises(SessionError, match="missing"):
        Stream(path).images([0])


def test_a_closed_stream_leaves_nothing_but_arrays(tmp_path: Path) -> None:
    path = tiny_camera(tmp_path / "camera")
    with StreamWriter.open(path) as stream:
        for row in range(BLOCK + 7):
            stream.append(**camera_row(row))
    names = {entry.name for entry in path.rglob("*") if entry.is_file()}
    assert names == {"zarr.json", "0"}


def test_closing_twice_is_safe_and_leaves_no_thread(tmp_path: Path) -> None:
    before = threading.active_count()
    stream = StreamWriter.open(tiny_camera(tmp_path / "camera"))
    assert threading.active_count() == before + 1
    stream.close()
    stream.close()
    assert threading.active_count() == before
    with pytest.raises(SessionError, match="closed"):
        stream.append(**camera_row(0))


def test_a_stream_has_one_writer_at_a_time(tmp_path: Path) -> None:
    path = tiny_camera(tmp_path / "camera")
    with StreamWriter.open(path), pytest.raises(SessionError, match="being written"):
        StreamWriter.open(path)
    StreamWriter.open(path).close()


def test_attributes_are_merged_and_the_flush_interval_is_stated(tmp_path: Path) -> None:
    create_stream(tmp_path / "force", force_spec(1000, serial="FT1"))
    with StreamWriter.open(tmp_path / "force", sync_interval=0.25) as stream:
        stream.set_attrs(bias=np.arange(6.0), dropped=np.int64(3))
        with pytest.raises(SessionError, match="JSON"):
            stream.set_attrs(bias=np.nan)
    attrs = dict(zarr.open_group(tmp_path / "force", mode="r").attrs)
    assert attrs["bias"] == list(range(6))
    assert (attrs["dropped"], attrs["serial"], attrs["sync_interval"]) == (3, "FT1", 0.25)


REFUSED: dict[str, tuple[dict[str, Any], str]] = {
    "missing column": ({"seq": ...}, r"force: found columns value, status, t_ns; expected"),
    "unknown column": ({"extra": 1}, r"extra; expected value, seq, status, t_ns"),
    "misspelt column": ({"seq": ..., "sequence": 1}, r"expected value, seq"),
    "short vector": ({"value": np.zeros(5)}, r"force\.value: found float64 \(5,\), expected"),
    "ragged list": ({"value": [[1], [1, 2]]}, r"force\.value: found a ragged list"),
    "text": ({"value": "nan"}, r"force\.value: found <U3 \(\)"),
    "fraction in an integer": ({"seq": 1.5}, r"force\.seq: found float 1.5, expected int64"),
    "NaN in an integer": ({"seq": float("nan")}, r"force\.seq: found float nan"),
    "bool in an integer": ({"seq": True}, r"force\.seq: found bool True"),
    "None": ({"seq": None}, r"force\.seq: found NoneType None"),
    "integer too large": ({"seq": 2**63}, r"out of range for int64"),
}


@pytest.mark.parametrize("case", REFUSED)
def test_a_wrong_row_is_refused_by_name_and_not_stored(case: str, tmp_path: Path) -> None:
    changes, message = REFUSED[case]
    row = {"value": np.zeros(6), "seq": 0, "status": 0, "t_ns": 5, **changes}
    row = {name: value for name, value in row.items() if value is not ...}
    create_stream(tmp_path / "force", force_spec(1000))
    with StreamWriter.open(tmp_path / "force") as stream:
        with pytest.raises(SessionError, match=message):
            stream.append(**row)
        assert stream.rows == 0
    assert len(Stream(tmp_path / "force")) == 0


def test_integers_and_nan_are_welcome_in_float_columns(tmp_path: Path) -> None:
    create_stream(tmp_path / "force", force_spec(1000))
    with StreamWriter.open(tmp_path / "force") as stream:
        stream.append(value=[1, 2, 3, 4, 5, np.nan], seq=np.int32(7), status=0, t_ns=np.int64(1))
        stream.append(value=np.arange(6, dtype=">f4"), seq=8, status=0, t_ns=2)
    value = Stream(tmp_path / "force").array("value")
    np.testing.assert_array_equal(value[0], [1, 2, 3, 4, 5, np.nan])
    np.testing.assert_array_equal(value[1], np.arange(6))


@pytest.mark.parametrize(
    ("codec", "image", "message"),
    [
        ("jpeg", np.zeros((4, 4, 3), np.uint8), "found ndarray, expected JPEG bytes"),
        ("jpeg", b"no jpeg", "found no JPEG"),
        ("zstd", b"\xff\xd8", "found bytes, expected pixels"),
        ("zstd", np.zeros((4, 4, 3), np.float32), "found float32"),
        ("zstd", np.zeros((4, 5, 3), np.uint8), r"found uint8 \(4, 5, 3\)"),
    ],
)
def test_a_wrong_image_is_refused(codec: str, image: Any, message: str, tmp_path: Path) -> None:
    create_stream(tmp_path / "camera", camera_spec(60, height=4, width=4, codec=codec))
    with StreamWriter.open(tmp_path / "camera") as stream:
        with pytest.raises(SessionError, match=message):
            stream.append(value=image, device_t=0.0, t_ns=1)
        assert stream.rows == 0


def test_a_wrong_jpeg_after_right_ones_is_refused(tmp_path: Path) -> None:
    def jpeg(value: int, side: int = 16) -> bytes:
        return simplejpeg.encode_jpeg(np.full((side, 16, 3), value, np.uint8))

    create_stream(tmp_path / "camera", camera_spec(60, height=16, width=16, codec="jpeg"))
    right = jpeg(1)
    cut = right[: right.index(b"\xff\xda")]  # before its coded picture
    commented = right[:2] + b"\xff\xfe\x00\x06abcd" + right[2:]
    accepted = [right, jpeg(200), commented, commented, right]
    with StreamWriter.open(tmp_path / "camera") as stream:
        for image in accepted:
            stream.append(value=image, device_t=0.0, t_ns=1)
            for wrong in (jpeg(1, side=32), cut, commented[:40], b"\x00" + image[1:]):
                with pytest.raises(SessionError, match=r"found no JPEG|found JPEG 32x16"):
                    stream.append(value=wrong, device_t=0.0, t_ns=1)
    assert list(Stream(tmp_path / "camera").jpegs(range(5))) == accepted


class SmallDisk:
    """Replacement for the writer's file system calls, with limited capacity.

    Like a real disk it shortens the write that does not fit, and rejects the next.
    """

    def __init__(self, monkeypatch: pytest.MonkeyPatch, room: int) -> None:
        self.room = room
        self._monkeypatch = monkeypatch
        for name in ("pwrite", "pwritev", "write"):
            monkeypatch.setattr(os, name, getattr(self, name))

    def _granted(self, wanted: int) -> int:
        if self.room <= 0:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        granted = min(wanted, self.room)
        self.room -= granted
        return granted

    def pwrite(self, fd: int, data: bytes, offset: int, _real: Any = os.pwrite) -> int:
        return int(_real(fd, data[: self._granted(len(data))], offset))

    def pwritev(self, fd: int, parts: list[bytes], offset: int, _real: Any = os.pwrite) -> int:
        return self.pwrite(fd, b"".join(parts), offset)

    def write(self, fd: int, data: Any, _real: Any = os.write) -> int:
        return int(_real(fd, bytes(data)[: self._granted(len(data))]))


@pytest.mark.parametrize("room", [10, 30, 500, 4_000, 10_000, 20_000])
def test_a_full_disk_loses_no_accepted_row_and_can_be_closed(
    room: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tiny_camera(tmp_path / "camera")
    stream = StreamWriter.open(path, sync_interval=30)
    disk = SmallDisk(monkeypatch, room)
    accepted = 0
    with pytest.raises(OSError, match="No space left"):  # noqa: PT012
        while True:
            stream.append(**camera_row(accepted))
            accepted += 1
    with pytest.raises(OSError, match="No space left"):
        stream.append(**camera_row(accepted))
    assert stream.rows == accepted
    disk.room = stream_writer._RESERVED_BYTES  # space that closing frees before it seals
    stream.close()
    assert_holds_exactly(path, accepted)


def test_the_reserved_space_covers_what_closing_writes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tiny_camera(tmp_path / "camera")
    stream = StreamWriter.open(path, sync_interval=30)
    for row in range(BLOCK - 1):
        stream.append(**camera_row(row))
    reserved_space = (path / "t_ns" / "reserved").stat().st_size
    disk = SmallDisk(monkeypatch, reserved_space)
    stream.close()
    assert disk.room > 0


def test_a_closed_disk_error_keeps_the_rows_for_recovery(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tiny_camera(tmp_path / "camera")
    stream = StreamWriter.open(path, sync_interval=30)
    for row in range(5):
        stream.append(**camera_row(row))
    with monkeypatch.context() as patch:
        SmallDisk(patch, 0)
        with pytest.raises(OSError, match="No space left"):
            stream.close()
    StreamWriter.open(path).close()
    assert_holds_exactly(path, 5)


def test_the_declared_length_never_exceeds_what_is_sealed(tmp_path: Path) -> None:
    path = tiny_camera(tmp_path / "camera")
    layout = StreamLayout.load(path)
    with StreamWriter.open(path) as stream:
        for row in range(3 * BLOCK + 1):
            stream.append(**camera_row(row))
            declared = layout.columns[0].rows()
            assert declared <= stream.rows
            assert declared % BLOCK == 0
            assert all(layout.columns[0].shard(s).exists() for s in range(declared // BLOCK))


def records(data: bytes, first_index: int) -> list[journal.JournalRecord]:
    with tempfile.NamedTemporaryFile() as file:
        Path(file.name).write_bytes(data)
        log = journal.GrowingLog(Path(file.name), first_index=first_index, limit=1)
        log.update()
        return log.records


@given(data=st.binary(max_size=200), cut=st.integers(0, 300), flip=st.integers(0, 8 * 224 - 1))
def test_a_record_is_whole_or_does_not_count(data: bytes, cut: int, flip: int) -> None:
    log = header(data, -5, 7) + data
    assert [r.nbytes for r in records(log, 7)] == [len(data)]
    if cut < len(log):
        assert not records(log[:cut], 7)
    damaged = bytearray(log)
    damaged[flip // 8 % len(log)] ^= 1 << flip % 8
    assert not records(bytes(damaged), 7)
    assert not records(log, 8)
