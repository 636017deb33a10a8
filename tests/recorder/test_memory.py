"""Memory and reads of sessions are bounded however many are open, and no value suffers by it."""

import os
import pickle
import shutil
import sys
import tracemalloc
from collections import Counter
from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.sessions import record_run

from recorder import Session, SessionError, force_spec, taxels_spec
from recorder.checks.check import check_stream
from recorder.checks.plausible import statements
from recorder.session import columns, frames
from recorder.session.align import align_window
from recorder.session.frames import frames_table
from recorder.session.reader import sources_near, span_of_run, ticks_before
from recorder.session.states import states
from recorder.session.uncertainty import sigmas_of
from recorder.store.reader import RECENT, Kept, Recent


@pytest.fixture(scope="module")
def uneven(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two runs of taxels and force with gaps, bursts of equal times, and clocks that overlap."""
    path, rng = tmp_path_factory.mktemp("uneven") / "s.zarr", np.random.default_rng(1)
    streams = [taxels_spec(60.0, latency=0.004), force_spec(1000.0)]
    for run in range(2):
        few, many = np.arange(300), np.arange(5000)
        taxels = {"value": np.tile(few[:, None, None], (16, 3)).astype(np.int32)}
        taxels |= {"device_t": 0.0 * few, "seq": few + few // 70}
        taxels["t_ns"] = _times(rng, 300, 16_000_000, run)
        force = {"value": np.tile(many[:, None], 6) * 1.0, "seq": many + 2 * (many // 700)}
        force |= {"status": 0 * many, "t_ns": _times(rng, 5000, 1_000_000, run)}
        columns = {"taxels": taxels, "force": force}
        record_run(path, columns, streams=None if run else streams)
    return path


def _times(rng: np.random.Generator, count: int, period: int, run: int) -> list[int]:
    steps = rng.choice([0, period, 2 * period, 400 * period], count, p=[0.1, 0.8, 0.098, 0.002])
    return (10**9 + run * 10**9 + np.cumsum(steps)).tolist()


@pytest.mark.parametrize("method", ["latest", "nearest", "interpolated", "mean"])
def test_a_window_of_nearby_rows_equals_one_of_the_whole_run(uneven: Path, method: str) -> None:
    session = Session(uneven)
    rng = np.random.default_rng(0)
    narrow = 0
    for run in range(2):
        whole = session.sources(run)
        times = [each.times for each in whole.streams.values() if each.traits.roles]
        span = min(int(each[0]) for each in times), max(int(each[-1]) for each in times)
        assert span_of_run(session.run_streams(run)) == span
        for t_ns in rng.integers(span[0] - 10**9, span[1] + 10**9, 60).tolist():
            ticks = ticks_before(t_ns, 8, float(rng.choice([5.0, 40.0, 400.0])))
            near = sources_near(session.run_streams(run), ticks)
            narrow += len(near.streams["force"].times) < len(whole.streams["force"].times)
            signal = method if method in ("latest", "nearest") else "latest"
            methods = {"force": method, "taxels": signal}
            found, expected = (
                align_window(ticks, near, methods),
                align_window(ticks, whole, methods),
            )
            _same(found, expected)
    assert narrow > 20  # otherwise nothing was tested


def _same(found: Any, expected: Any) -> None:
    for name in ("t_ns", "capture_ns", "signal_row"):
        np.testing.assert_array_equal(getattr(found, name), getattr(expected, name))
    for name, stream in expected.streams.items():
        for field in fields(stream):
            one, other = (getattr(each, field.name) for each in (found.streams[name], stream))
            np.testing.assert_array_equal(one, other, err_msg=f"{name}.{field.name}")


def test_a_stream_out_of_order_is_aligned_as_a_whole(tmp_path: Path) -> None:
    times = 10**9 + np.random.default_rng(2).permutation(5000) * 1_000_000
    columns = {"value": np.tile(times[:, None], 6) * 1e-9, "seq": 0 * times, "status": 0 * times}
    columns["t_ns"] = times
    path = tmp_path / "s.zarr"
    session = Session(record_run(path, {"force": columns}, streams=[force_spec(1000.0)]))
    for t_ns in range(2 * 10**9, 5 * 10**9, 10**9):
        ticks = ticks_before(t_ns, 4, 40.0)
        near = sources_near(session.run_streams(0), ticks)
        _same(align_window(ticks, near), align_window(ticks, session.sources(0)))


def test_opening_reads_metadata_files_once(recorded: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    read: Counter[Path] = Counter()
    original = Path.read_bytes

    def count(path: Path) -> bytes:
        read[path] += 1
        return original(path)

    monkeypatch.setattr(Path, "read_bytes", count)
    session = Session(recorded)
    assert read
    assert set(read.values()) == {1}
    assert {path.name for path in read} == {"zarr.json"}
    # Nothing is remembered afterwards: a reader of a growing session sees what is new.
    session.streams["force"].layout.time.rows()
    assert read[recorded / "streams/force/t_ns/zarr.json"] == 2


@pytest.mark.parametrize("cores", [1, 3])
def test_images_are_decoded_into_the_callers_array_on_any_number_of_cores(
    cores: int, recorded: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(os, "cpu_count", lambda: cores)
    camera = Session(recorded).streams["camera"]
    rows = [70, 3, 70, 215, 0]
    many = [*range(40, 29, -1), 35]
    np.testing.assert_array_equal(
        camera.images(many), np.concatenate([camera.images([row]) for row in many])
    )
    expected = np.stack([camera.images([row])[0] for row in rows])
    np.testing.assert_array_equal(camera.images(rows), expected)
    out = np.full((6, *expected.shape[1:]), 7, np.uint8)
    camera.images_into(np.array([70, 3, -1, 70, 215, 0]), out)
    np.testing.assert_array_equal(out[[0, 1, 3, 4, 5]], expected)
    assert (out[2] == 7).all()  # row -1 is left as it is
    with pytest.raises(SessionError, match="no row 216, the stream has 216"):
        camera.images_into(np.array([216]), out[:1])
    with pytest.raises(SessionError, match="no row -1"):
        camera.images([-1])
    with pytest.raises(SessionError, match="found out uint8"):
        camera.images_into(np.array([0, 1]), out[:1])
    with pytest.raises(SessionError, match="contiguous"):
        camera.images_into(np.array([0]), out[:1, :, ::-1])


def test_only_so_much_is_kept() -> None:
    recent, kept = Recent(1000), [np.zeros(40) for _ in range(4)]  # 320 bytes each
    for array in kept:
        recent.keep(array, array.nbytes)
    assert recent.nbytes == 960
    recent.keep(kept[1], 320)  # used again: kept[2] is now the oldest
    recent.keep(kept[0], 320)
    assert [id(array) for array, _ in recent._kept.values()] == [
        id(kept[number]) for number in (3, 1, 0)
    ]
    recent.keep(np.zeros(1000), 8000)  # larger than everything
    assert recent.nbytes == 960


def test_what_was_released_is_read_again_and_a_copy_begins_empty(recorded: Path) -> None:
    session = Session(recorded)
    first = session.streams["force"].array("value")
    assert session.streams["force"].array("value") is first
    expected = first.copy()
    del first
    RECENT.clear()
    np.testing.assert_array_equal(session.streams["force"].array("value"), expected)
    copied = pickle.loads(pickle.dumps(session))
    np.testing.assert_array_equal(copied.streams["force"].array("value"), expected)
    kept: Kept[np.ndarray] = Kept()
    kept.put("a", expected)
    assert pickle.loads(pickle.dumps(kept)).get("a") is None


@pytest.mark.slow
@pytest.mark.timeout(600)  # 200 sessions
def test_windows_over_200_open_sessions_need_no_more_memory(
    recorded: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    RECENT.clear()
    monkeypatch.setattr(RECENT, "limit", 4 << 20)
    rng = np.random.default_rng(0)
    sessions = [Session(recorded) for _ in range(200)]
    span = span_of_run(sessions[0].run_streams(0))
    assert span is not None

    def epoch() -> int:
        for session in sessions:
            assert session.window(int(rng.integers(*span)), 4).image is not None
            session.frames["wrench"]
            session.streams["force"].array("value")
        return tracemalloc.get_traced_memory()[0]

    tracemalloc.start()
    try:
        first = epoch()
        later = [epoch() for _ in range(3)]
    finally:
        tracemalloc.stop()
    # Far less than one column of each session (172 kB), and no growth.
    assert first < RECENT.limit + 200 * 20_000
    assert max(later) < RECENT.limit + 200 * 30_000
    assert max(later[1:]) < later[0] + 200 * 1_000


class WindowsOfSessions:
    """Windows of many sessions at random, as a data set of PyTorch; items are memory in bytes."""

    def __init__(self, paths: list[Path]) -> None:
        self.sessions = [Session(path) for path in paths]
        span = span_of_run(self.sessions[0].run_streams(0))
        assert span is not None
        self.span = span

    def __len__(self) -> int:
        return len(self.sessions)

    def __getitem__(self, number: int) -> int:
        rng = np.random.default_rng()
        for _ in range(4):
            window = self.sessions[number].window(int(rng.integers(*self.span)), 4)
        assert window.image is not None
        rollup = Path("/proc/self/smaps_rollup").read_text()
        return 1024 * int(rollup.split("Anonymous:")[1].split()[0])


@pytest.mark.slow
@pytest.mark.timeout(600)  # 200 sessions
@pytest.mark.skipif(sys.platform != "linux", reason="memory is read from /proc")
def test_a_data_loader_over_200_sessions_does_not_grow_after_its_first_epochs(
    recorded: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    data = pytest.importorskip("torch.utils.data")
    monkeypatch.setattr(RECENT, "limit", 8 << 20)  # full within the first epoch
    paths = [tmp_path / f"{number}.zarr" for number in range(200)]
    for path in paths:
        shutil.copytree(recorded, path, copy_function=os.link)
    loader = data.DataLoader(
        WindowsOfSessions(paths), shuffle=True, num_workers=2, persistent_workers=True
    )
    peaks = [max(int(item) for item in loader) for _ in range(6)]
    assert peaks[0] > 20 << 20  # measured at all
    assert max(peaks[3:]) < peaks[2] + (3 << 20), [peak >> 20 for peak in peaks]


def test_a_long_stream_is_checked_and_aligned_in_parts(
    uneven: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def results() -> tuple[Any, ...]:
        RECENT.clear()
        session = Session(uneven)
        force = session.streams["force"]
        found = [*states(session), *check_stream(session, force, None)]
        found += [str(each) for each in statements(session)]
        sigmas = [of_run["force"].queue for of_run in sigmas_of(session)[:2]]
        return found, frames_table(session, 40.0), sigmas

    whole = results()
    for module, name, value in (
        (columns, "BLOCK", 700),
        (columns, "_WHOLE", 0),
        (frames, "_TICKS", 32),
    ):
        monkeypatch.setattr(module, name, value)
    parts = results()
    assert parts[0] == whole[0]
    assert len(whole[0]) > 3
    for name, values in whole[1].items():
        np.testing.assert_array_equal(parts[1][name], values, err_msg=name)
    for one, other in zip(parts[2], whole[2], strict=True):
        np.testing.assert_array_equal(one, other)


def test_a_check_holds_no_column_of_a_long_stream(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    count = 80_000
    rows = {"value": np.random.default_rng(3).normal(size=(count, 6)), "seq": np.arange(count)}
    rows |= {"status": np.zeros(count, int), "t_ns": 10**9 + np.arange(count) * 1_000_000}
    session = Session(
        record_run(tmp_path / "s.zarr", {"force": rows}, streams=[force_spec(1000.0)])
    )
    for name, value in (("BLOCK", 1000), ("_WHOLE", 0)):
        monkeypatch.setattr(columns, name, value)
    monkeypatch.setattr(RECENT, "limit", 1 << 16)
    RECENT.clear()
    tracemalloc.start()
    try:
        found = [*states(session), *check_stream(session, session.streams["force"], None)]
        assert [each.code for each in found] == ["unverified"]
        assert not [one for one in statements(session) if one.doubtful]
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert peak < rows["value"].nbytes
