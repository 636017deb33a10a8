"""Killed at any moment, a stream keeps all accepted rows, adds none and recovers deterministically.

Tested in two ways: by SIGKILL of a real process at random moments, and by stopping before each
file system call of the writer in turn.
"""

import errno
import mmap
import multiprocessing
import os
import random
import shutil
import signal
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import zarr
from numpy.typing import NDArray
from support.crashes import FailingCalls, Killed

from recorder import StreamSpec, StreamWriter, camera_spec, force_spec
from recorder.session import stream_writer
from recorder.session.columns import Stream
from recorder.session.stream_writer import Background, survey, unfinished_files
from recorder.store import journal, shard
from recorder.store.layout import StreamLayout, create_stream
from tests.support.few import few

BLOCK = 64


def image_rows(rows: NDArray[np.int64]) -> dict[str, NDArray[Any]]:
    """Return columns in which every value encodes its row number, never all zero."""
    pixels = np.empty((len(rows), 4, 4, 3), np.uint8)
    pixels[...] = (rows % 251 + 1)[:, None, None, None]
    pixels[:, 0, 0] = np.stack([rows & 255, rows >> 8 & 255, rows >> 16], axis=1)
    return {"value": pixels, "device_t": rows.astype(float), "t_ns": 10**15 + rows}


def force_rows(rows: NDArray[np.int64]) -> dict[str, NDArray[Any]]:
    value = np.repeat(rows[:, None] + 0.5, 6, axis=1)
    return {"value": value, "seq": rows + 1, "status": rows % 7, "t_ns": 10**15 + rows}


def image_row(row: int) -> dict[str, Any]:
    return {name: values[0] for name, values in image_rows(np.array([row])).items()}


def force_row(row: int) -> dict[str, Any]:
    return {name: values[0] for name, values in force_rows(np.array([row])).items()}


def lossless_camera(rate_hz: float) -> StreamSpec:
    return camera_spec(rate_hz, height=4, width=4, codec="zstd")


def assert_every_row_is_itself(path: Path) -> int:
    """Check that all rows a reader sees are those appended, and return their number."""
    stream = Stream(path)
    expected = (force_rows if "value" in stream.small else image_rows)(np.arange(len(stream)))
    for name, values in expected.items():
        found = stream.array(name) if name in stream.small else stream.images(slice(None))
        np.testing.assert_array_equal(found, values, name)
    return len(stream)


def assert_zarr_agrees(path: Path) -> None:
    """Check that every array, up to its own declared length, equals the appended rows."""
    for column in StreamLayout.load(path).columns:
        found = np.asarray(zarr.open_array(column.path, mode="r"))
        make = image_rows if (path / "device_t").exists() else force_rows
        expected = make(np.arange(len(found)))[column.column.name]
        np.testing.assert_array_equal(found, expected, column.column.name)


def recover(path: Path) -> int:
    StreamWriter.open(path).close()
    assert unfinished_files(StreamLayout.load(path)) == ()
    return assert_every_row_is_itself(path)


def test_the_reserved_space_of_a_killed_session_is_given_back(tmp_path: Path) -> None:
    path = tmp_path / "force"
    create_stream(path, force_spec(100))
    StreamWriter.open(path).close()
    (path / "t_ns" / "reserved").write_bytes(bytes(100))
    assert unfinished_files(StreamLayout.load(path)) == (path / "t_ns" / "reserved",)
    assert recover(path) == 0


def record_until_killed(path: Path, accepted: mmap.mmap, slot: int, make: Any) -> None:
    """Append as fast as possible, counting accepted rows in memory shared with the parent."""
    with StreamWriter.open(path, sync_interval=0.01) as stream:
        while True:
            row = stream.append(**make(stream.rows))
            accepted[8 * slot : 8 * slot + 8] = (row + 1).to_bytes(8, "little")


@pytest.mark.parametrize(
    "seed", [pytest.param(seed, marks=() if seed < 2 else pytest.mark.slow) for seed in range(10)]
)
def test_sigkill_loses_at_most_the_row_in_flight(seed: int, tmp_path: Path) -> None:
    dice = random.Random(seed)
    paths = [tmp_path / "camera", tmp_path / "force"]
    create_stream(paths[0], lossless_camera(60))
    create_stream(paths[1], force_spec(100))
    context = multiprocessing.get_context("fork")
    least = [0, 0]
    for _ in range(2):  # a killed stream is resumed, then killed again
        accepted = mmap.mmap(-1, 16)
        children = [
            context.Process(target=record_until_killed, args=(path, accepted, slot, make))
            for slot, (path, make) in enumerate(zip(paths, (image_row, force_row), strict=True))
        ]
        for child in children:
            child.start()
        time.sleep(dice.uniform(0.01, 0.08))
        for child in children:
            os.kill(child.pid or 0, signal.SIGKILL)
            child.join()
        for slot, path in enumerate(paths):
            assert_every_row_is_itself(path)  # also before any recovery
            assert_zarr_agrees(path)
            counted = int.from_bytes(accepted[8 * slot : 8 * slot + 8], "little")
            least[slot] = max(least[slot], counted)
            rows = survey(StreamLayout.load(path)).rows
            assert rows >= least[slot]
            assert rows <= least[slot] + 1 or not counted
            least[slot] = rows
        accepted.close()
    for slot, path in enumerate(paths):
        assert recover(path) == least[slot]
        assert recover(path) == least[slot]
        assert_zarr_agrees(path)


class InlineBackground(Background):
    """Run the background work synchronously, so that crash points are reproducible.

    Or never, as if the disk were too slow.
    """

    keeps_up = True

    def __init__(self, flush: Callable[[], None], *, interval: float, name: str) -> None:
        self.failure = None

    def submit(self, job: Callable[[], None]) -> None:
        if self.keeps_up:
            job()

    def stop(self) -> None:
        pass

    def drain(self) -> None:
        pass


def open_below(path: Path) -> set[int]:
    """Return the descriptors of open files below a path, and of no other thread's files."""
    found = set()
    for name in os.listdir("/proc/self/fd"):
        with suppress(OSError):  # closed meanwhile, such as the one that lists them
            if Path(os.readlink(f"/proc/self/fd/{name}")).is_relative_to(path):
                found.add(int(name))
    return found


@contextmanager
def killed_at(call: int | None, path: Path) -> Iterator[None]:
    """Kill the code that writes below `path` before its file operation `call`, or at the end."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(stream_writer, "Background", InlineBackground)
        patch.setattr(stream_writer, "_PENDING_MAX", 1)  # as often as possible
        FailingCalls(patch, call)
        with suppress(Killed):
            yield
    for left in open_below(path):
        os.close(left)


def append_rows(path: Path, make: Callable[[int], dict[str, Any]], count: int) -> Iterator[int]:
    """Resume, append and close; yield the number of rows that are guaranteed to exist."""
    stream = StreamWriter.open(path)
    yield stream.rows
    for _ in range(count):
        stream.append(**make(stream.rows))
        yield stream.rows
    stream.close()


SCENARIOS = {
    "begin and end within a block": (0, 3),
    "resume a short block": (5, 3),
    "fill a block and a shard of images exactly": (BLOCK - 2, 2),
    "cross a block and a shard of images": (BLOCK - 2, 4),
    "resume on the boundary": (BLOCK, 2),
    "resume and add nothing": (BLOCK + 1, 0),
}


@pytest.mark.parametrize(
    ("kind", "scenario"),
    few([pytest.param("images", scenario) for scenario in SCENARIOS], 3)
    + few(
        [
            pytest.param(kind, scenario)
            for kind in ("images ahead of which the file grows", "numbers")
            for scenario in ("resume a short block", "cross a block and a shard of images")
        ],
        2,
    ),
)
def test_dying_in_front_of_any_file_operation_loses_nothing(
    kind: str, scenario: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    before, count = SCENARIOS[scenario]
    if "ahead" in kind:
        monkeypatch.setattr(journal, "_AHEAD_FROM", 1)
        monkeypatch.setattr(shard, "STEP", 1000)
    kind = kind.split()[0]
    make = image_row if kind == "images" else force_row
    origin = tmp_path / "origin"
    create_stream(origin, lossless_camera(60) if kind == "images" else force_spec(60))
    list(append_rows(origin, make, before))
    check_every_crash_point(tmp_path, origin, lambda path: append_rows(path, make, count))


@pytest.mark.slow
@pytest.mark.parametrize("keeps_up", few([True, False], 1), ids=["idle", "behind"])
def test_dying_in_front_of_any_file_operation_of_a_recovery_loses_nothing(
    keeps_up: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    origin = tmp_path / "origin"
    create_stream(origin, lossless_camera(60))
    list(append_rows(origin, image_row, BLOCK - 3))
    with killed_at(None, origin), monkeypatch.context() as patch:
        patch.setattr(InlineBackground, "keeps_up", keeps_up)
        for rows in append_rows(origin, image_row, 3 * BLOCK):
            if rows == 2 * BLOCK + 3:
                break
    assert len(list(origin.glob("t_ns/journal-*[0-9]"))) == (1 if keeps_up else 3)
    check_every_crash_point(tmp_path, origin, lambda path: append_rows(path, image_row, 0))


def check_every_crash_point(
    tmp_path: Path, origin: Path, scenario: Callable[[Path], Iterator[int]]
) -> None:
    """Run a scenario once per file operation in it, dying before that operation."""
    crashes = 0
    while True:
        crashes += 1
        path = tmp_path / "crashed"
        shutil.copytree(origin, path)
        accepted = survey(StreamLayout.load(origin)).rows
        finished = False
        with killed_at(crashes, path):
            for rows in scenario(path):
                accepted = rows
            finished = True
        if crashes % 3 == 0:
            assert_every_row_is_itself(path)
        rows = survey(StreamLayout.load(path)).rows
        assert accepted <= rows <= accepted + 1, f"crash point {crashes}"
        assert recover(path) == rows, f"crash point {crashes}"
        if crashes % 10 == 0:
            assert_zarr_agrees(path)
        shutil.rmtree(path)
        if finished:
            break
    assert crashes > 20


def abandoned_with_nine_images(folder: Path) -> Path:
    path = folder / "camera"
    create_stream(path, lossless_camera(60))
    with killed_at(None, path):
        for rows in append_rows(path, image_row, 10):
            if rows == 9:
                break
    return path


def test_a_torn_tail_is_dropped_and_the_rest_kept(tmp_path: Path) -> None:
    path = abandoned_with_nine_images(tmp_path)
    images = next(path.glob("value/c/0/0/0/*.partial"))
    images.write_bytes(images.read_bytes()[:-1])
    rows = next(path.glob("t_ns/journal-0"))
    rows.write_bytes(rows.read_bytes() + b"TRL1 half a record")
    state = survey(StreamLayout.load(path))
    assert (state.rows, state.dropped_rows) == (8, 1)
    assert state.torn_bytes > len(b"half a record")
    assert recover(path) == 8


def test_an_image_without_its_row_does_not_count(tmp_path: Path) -> None:
    path = abandoned_with_nine_images(tmp_path)
    rows = next(path.glob("t_ns/journal-0"))
    rows.write_bytes(rows.read_bytes()[:-1])
    assert recover(path) == 8


def test_zeros_ahead_of_the_records_are_no_torn_bytes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(journal, "_AHEAD_FROM", 1)
    path = abandoned_with_nine_images(tmp_path)
    assert next(path.glob("value/c/0/0/0/*.partial")).stat().st_size == shard.STEP
    assert survey(StreamLayout.load(path)).torn_bytes == 0
    assert recover(path) == 9
    assert next(path.glob("value/c/0/0/0/0")).stat().st_size < shard.STEP


@pytest.mark.parametrize("room", [100, 1000, 5000])
def test_a_disk_that_fills_while_the_file_grows_ahead_loses_no_row(
    room: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(journal, "_AHEAD_FROM", 1)
    monkeypatch.setattr(shard, "STEP", 1000)
    path = tmp_path / "camera"
    create_stream(path, lossless_camera(60))
    stream = StreamWriter.open(path)
    write = os.pwrite
    left = room

    def pwrite(fd: int, data: bytes, offset: int) -> int:
        nonlocal left
        if not left:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        # Only bytes behind the end of the file need space.
        held = max(os.fstat(fd).st_size - offset, 0)
        written = write(fd, data[: held + left], offset)
        left -= max(written - held, 0)
        return written

    def posix_fallocate(fd: int, offset: int, nbytes: int) -> None:
        nonlocal left
        os.ftruncate(fd, offset + min(nbytes, left))
        if nbytes > left:  # the file has grown by what there was
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        left -= nbytes

    with monkeypatch.context() as patch:
        patch.setattr(os, "posix_fallocate", posix_fallocate)
        patch.setattr(os, "pwrite", pwrite)
        patch.setattr(os, "pwritev", lambda fd, parts, at: pwrite(fd, b"".join(parts), at))
        with pytest.raises(OSError, match="No space left"):  # noqa: PT012
            while True:
                stream.append(**image_row(stream.rows))
    accepted = stream.rows
    stream.close()
    assert assert_every_row_is_itself(path) == accepted


def test_a_file_that_cannot_grow_ahead_still_ends_with_its_index(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def posix_fallocate(fd: int, offset: int, nbytes: int) -> None:
        os.ftruncate(fd, offset + nbytes // 2)
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(os, "posix_fallocate", posix_fallocate)
    monkeypatch.setattr(journal, "_AHEAD_FROM", 1)
    create_stream(tmp_path / "camera", lossless_camera(60))
    assert list(append_rows(tmp_path / "camera", image_row, 3)) == [0, 1, 2, 3]
    assert assert_every_row_is_itself(tmp_path / "camera") == 3
    assert_zarr_agrees(tmp_path / "camera")
