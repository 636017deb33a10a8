"""A session that is being recorded, or whose writer was killed, shows every complete row."""

import errno
import shutil
import threading
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from recorder import (
    Session,
    SessionError,
    SessionWriter,
    StreamWriter,
    camera_spec,
    force_spec,
    recover,
)
from recorder.session.columns import Stream
from recorder.store.journal import Journal
from recorder.store.layout import StreamLayout, create_stream
from recorder.store.reader import LiveStream
from recorder.store.records import HEADER


def force(row: int) -> dict[str, Any]:
    return {"value": np.arange(6.0) + row, "seq": row, "status": 0, "t_ns": 10**9 + row}


def picture(row: int) -> dict[str, Any]:
    pixels = np.full((4, 4, 3), row % 251 + 1, np.uint8)
    return {"value": pixels, "device_t": float(row), "t_ns": 10**9 + row}


def begin(path: Path) -> SessionWriter:
    streams = [camera_spec(20, height=4, width=4, codec="zstd"), force_spec(50)]
    writer = SessionWriter.create(path, attrs={}, streams=streams, targets={})
    writer.begin_run({"t0_ns": 0, "utc": "2026-01-01T00:00:00Z", "boot_id": "b"})
    return writer


def assert_shows(path: Path, count: int) -> None:
    session = Session(path)
    assert session.warning is not None
    assert {name: len(stream) for name, stream in session.streams.items()} == {
        "camera": count,
        "force": count,
    }
    rows = np.arange(count)
    gauge, camera = session.streams["force"], session.streams["camera"]
    np.testing.assert_array_equal(gauge.array("value"), np.arange(6.0) + rows[:, None])
    np.testing.assert_array_equal(gauge.t_ns, 10**9 + rows)
    np.testing.assert_array_equal(camera.images(slice(None))[:, 0, 0, 0], rows % 251 + 1)
    np.testing.assert_array_equal(camera.array("device_t"), rows)
    if count > 2:
        middle = gauge.rows_between("seq", count // 2, count - 1)
        np.testing.assert_array_equal(middle, rows[count // 2 : count - 1])


def test_every_row_is_readable_while_it_is_recorded_and_after_a_kill(tmp_path: Path) -> None:
    path = tmp_path / "s.zarr"
    with (
        begin(path) as writer,
        StreamWriter.open(writer.stream_path("camera"), sync_interval=60) as camera,
        StreamWriter.open(writer.stream_path("force"), sync_interval=60) as gauge,
    ):
        # Blocks of 64 rows; a shard of images holds 64, one of the other columns 4096 rows.
        for row in range(300):
            camera.append(**picture(row))
            gauge.append(**force(row))
            if row in (0, 1, 62, 63, 64, 65, 127, 128, 299):
                assert_shows(path, row + 1)
                killed = tmp_path / f"{row}.zarr"
                shutil.copytree(path, killed, ignore=shutil.ignore_patterns("*.tmp"))
                assert_shows(killed, row + 1)
        assert not Session(path).frames
    recover(killed)
    assert len(Session(killed).streams["force"]) == 300


def test_rows_after_a_flipped_bit_in_a_journal_are_not_shown(tmp_path: Path) -> None:
    path = tmp_path / "s.zarr"
    with begin(path) as writer, StreamWriter.open(writer.stream_path("force")) as gauge:
        for row in range(20):
            gauge.append(**force(row))
        shutil.copytree(path, tmp_path / "killed.zarr")
    journal = tmp_path / "killed.zarr/streams/force/t_ns/journal-0"
    data = bytearray(journal.read_bytes())
    data[12 * (len(data) // 20) + 30] ^= 1
    journal.write_bytes(data)
    np.testing.assert_array_equal(
        Session(tmp_path / "killed.zarr").streams["force"].array("seq"), np.arange(12)
    )


def test_refresh_shows_each_row_in_order_until_the_session_is_closed(tmp_path: Path) -> None:
    path = tmp_path / "s.zarr"
    writer = begin(path)
    session = Session(path)

    def record() -> None:
        with (
            writer,
            StreamWriter.open(writer.stream_path("camera")) as camera,
            StreamWriter.open(writer.stream_path("force")) as gauge,
        ):
            for row in range(1000):
                gauge.append(**force(row))
                if row % 4 == 0:
                    camera.append(**picture(row // 4))
        writer.finish("stopped", rate_hz=20)

    recording = threading.Thread(target=record)
    recording.start()
    camera, gauge = (session.streams[name] for name in ("camera", "force"))
    while recording.is_alive():
        count = len(gauge), len(camera)
        gauge.refresh()
        camera.refresh()
        assert len(gauge) >= count[0]
        assert len(camera) >= count[1]
        np.testing.assert_array_equal(gauge.array("seq"), np.arange(len(gauge)))
    recording.join()
    gauge.refresh()
    camera.refresh()
    np.testing.assert_array_equal(gauge.array("seq"), np.arange(1000))
    shown = camera.images(range(250))[:, 0, 0, 0]
    np.testing.assert_array_equal(shown, np.arange(250) % 251 + 1)


def bytes_read() -> int:
    """Return the bytes that this thread has read from files so far."""
    return int(Path("/proc/thread-self/io").read_text().split()[1])


def test_following_reads_each_byte_once(tmp_path: Path) -> None:
    create_stream(tmp_path / "camera", camera_spec(20, height=64, width=64, codec="zstd"))
    noise = np.random.default_rng(0)
    with StreamWriter.open(tmp_path / "camera") as camera:

        def append() -> int:
            """Append a row and return the size of its records."""
            pixels = noise.integers(0, 255, (64, 64, 3), np.uint8)
            camera.append(value=pixels, device_t=0.0, t_ns=1)
            return pixels.nbytes + 16 + 3 * HEADER.size

        for _ in range(40):
            append()
        tail = LiveStream(StreamLayout.load(tmp_path / "camera"))
        start = bytes_read()
        assert tail.update().rows == 40
        assert bytes_read() - start > 40 * 64 * 64 * 3
        for rows in range(41, 200):  # through three shards of images and of journals
            added = append()
            start = bytes_read()
            assert tail.update().rows == rows
            # A few headers are looked at again, and a new journal or shard is small at first.
            assert bytes_read() - start < added + 2000
        start = bytes_read()
        assert tail.update().rows == 199
        assert bytes_read() - start < 500


def test_rows_that_were_added_last_are_read_after_the_stream_was_closed(tmp_path: Path) -> None:
    create_stream(tmp_path / "camera", camera_spec(20, height=4, width=4, codec="zstd"))
    with StreamWriter.open(tmp_path / "camera") as camera:
        camera.append(**picture(0))
        stream = Stream(tmp_path / "camera", live=True)
        assert stream.images([0])[0, 0, 0, 0] == 1
        for row in range(1, 70):
            camera.append(**picture(row))
    stream.refresh()
    np.testing.assert_array_equal(stream.images(range(70))[:, 0, 0, 0], np.arange(1, 71))
    np.testing.assert_array_equal(stream.t_ns, 10**9 + np.arange(70))


def test_following_sees_that_an_image_was_removed_on_a_full_disk(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    create_stream(tmp_path / "camera", camera_spec(20, height=4, width=4, codec="zstd"))
    tail = LiveStream(StreamLayout.load(tmp_path / "camera"))
    stream = Stream(tmp_path / "camera", live=True)
    with StreamWriter.open(tmp_path / "camera") as camera:
        camera.append(**picture(0))

        def full(*_: Any) -> None:
            tail.update()  # has seen the image whose row cannot be written
            raise OSError(errno.ENOSPC, "full")

        with monkeypatch.context() as patch:
            patch.setattr(Journal, "append", full)
            with pytest.raises(OSError, match="full"):
                camera.append(**picture(1))
        assert tail.readers["value"].held == 2
        assert tail.update().rows == 1
        camera.append(**picture(7))
        assert tail.update().rows == 2
        stream.refresh()
        assert stream.images([1])[0, 0, 0, 0] == 8


def read_force(session: Session, count: int) -> None:
    gauge = session.streams["force"]
    assert len(gauge) == count
    np.testing.assert_array_equal(gauge.array("value"), np.arange(6.0) + np.arange(count)[:, None])
    np.testing.assert_array_equal(gauge.t_ns, 10**9 + np.arange(count))


@pytest.mark.parametrize("more", [0, 7, 200])
def test_rows_seen_before_a_stream_is_resumed_are_read_while_its_last_chunk_moves(
    more: int, tmp_path: Path
) -> None:
    path = tmp_path / "s.zarr"
    with begin(path) as writer:
        with StreamWriter.open(writer.stream_path("force")) as stream:
            for row in range(244):  # three chunks of 64 rows, and a short one
                stream.append(**force(row))
        writer.finish("stopped", rate_hz=50)
    with SessionWriter.resume(path) as writer:
        unread, known = Session(path), Session(path)
        known.streams["force"].rows_between("seq", 0, 200)
        known.streams["force"].rows_between("t_ns", 0, 10)  # its index is known from now on
        with StreamWriter.open(writer.stream_path("force"), sync_interval=1e6) as stream:
            for row in range(244, 244 + more):
                stream.append(**force(row))
            stream._flush()
            read_force(unread, 244)
            read_force(known, 244)
        read_force(Session(path), 244 + more)
        read_force(unread, 244)


def test_a_damaged_chunk_of_a_growing_shard_is_still_refused(tmp_path: Path) -> None:
    path = tmp_path / "s.zarr"
    with (
        begin(path) as writer,
        StreamWriter.open(writer.stream_path("force"), sync_interval=1e6) as stream,
    ):
        for row in range(130):
            stream.append(**force(row))
        stream._flush()
        session = Session(path)
        (partial,) = (path / "streams/force/value/c/0").glob("*.partial")
        data = bytearray(partial.read_bytes())
        data[60] ^= 1
        with partial.open("r+b") as file:
            file.write(data)
        with pytest.raises(SessionError, match=r"chunk 0 \(row 0\) (does not match|is missing)"):
            session.streams["force"].array("value")
        data[60] ^= 1
        with partial.open("r+b") as file:
            file.write(data)
