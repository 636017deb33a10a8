"""A replay returns the same bytes through the real drivers, and reports when it cannot."""

import contextlib
import io
import os
import signal
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
from support.replayable import as_devices_send
from support.sessions import Columns, make_session, set_attrs

from benchmarks.fake_clock import FakeClock
from benchmarks.faults.collection_run import CollectionRun
from recorder import Session, SessionError, check, faults
from recorder.info import digests
from rig.core.clock import SECOND_NS
from rig.core.errors import DeviceLost
from rig.core.playback import (
    ENDED,
    PLAYING,
    POSITION,
    SYNC,
    Playback,
    Recording,
    position_path,
    sync_path,
)
from rig.core.realtime import RIG_PRIORITY
from rig.core.shared_memory import SharedLatest
from rig.devices.force.netft_emulator import NetFtEmulatorConfig, emulate, force_counts
from rig.devices.force.netft_wire import Page
from rig.replay import replay as module
from rig.replay.comparison import Retiming, compared
from rig.replay.replay import (
    EXIT_DIFFERENT,
    MISSING_TIMEOUT,
    STALL_TIMEOUT,
    EndOfTape,
    Replay,
    ReplayRequest,
)
from rig.replay.replayable import replayable

ALL = ("camera", "force", "pose", "taxels")
TIMES = {"t_ns"}


def small_session(path: Path, **options: Any) -> Path:
    """Return a session of 2 s with all four streams."""
    chosen = {"seconds": 2.0, "names": ALL, "change": as_devices_send, **options}
    return make_session(path, **chosen)


def replayed(source: Path, out: Path, speed: float = 0.0, **options: Any) -> Session:
    assert Replay(ReplayRequest(source, out, speed, **options)).run() == 0
    return Session(out)


def two_runs(path: Path) -> Path:
    """Return a session of all four streams; controller and box restarted for its second run."""

    def change(name: str, columns: Columns) -> Columns:
        columns = as_devices_send(name, columns)
        if name == "segments":
            return {key: values[:0] for key, values in columns.items()}
        half = len(columns["t_ns"]) // 2
        for column in ("device_t", "seq"):
            if name in ("force", "pose") and column in columns:
                values = columns[column].copy()
                values[half:] -= values[half] - (1 if column == "seq" else 0)
                columns[column] = values
        return columns

    small_session(path, seconds=1.0, change=change)
    halves = {name: len(stream) // 2 for name, stream in Session(path).streams.items()}
    entry = Session(path).runs[0]
    first_row = {**entry["first_row"], **halves}
    set_attrs(path, runs=[entry, {**entry, "first_row": first_row}])
    return path


class Replays(NamedTuple):
    """Replays and their sources: of two runs, and of one run without its images."""

    two_runs: Path
    source: Path
    fast: Path
    quick: Path
    printed: str


@pytest.fixture(scope="module")
def replays(tmp_path_factory: pytest.TempPathFactory) -> Replays:
    """Replays at maximum speed and at four times the recorded speed."""
    folder = tmp_path_factory.mktemp("replays")
    source, two = small_session(folder / "s.zarr", seconds=1.0), two_runs(folder / "two.zarr")
    fast, quick = folder / "fast.zarr", folder / "quick.zarr"
    with contextlib.redirect_stdout(io.StringIO()) as printed:
        replayed(two, fast)
        replayed(source, quick, 4.0, without=("camera",))
    return Replays(two, source, fast, quick, printed.getvalue())


@pytest.mark.serial
def test_replays_at_maximum_and_at_another_speed_have_the_bytes_of_their_source(
    replays: Replays,
) -> None:
    first, session = Session(replays.fast), Session(replays.two_runs)
    taken, slower = digests(session), digests(Session(replays.source))
    assert digests(first) == taken
    camera = slower.pop("camera")
    assert digests(Session(replays.quick)) == slower
    for name in ("force", "pose", "taxels"):
        for column in set(session.streams[name].names) - TIMES:
            again = first.streams[name].array(column)
            assert again.tobytes() == session.streams[name].array(column).tobytes(), (name, column)
    jpegs = [session.streams["camera"].jpeg(row) for row in range(len(session.streams["camera"]))]
    assert [first.streams["camera"].jpeg(row) for row in range(len(jpegs))] == jpegs
    assert np.isnan(first.streams["camera"].array("device_t")).all()
    assert first.streams["force"].t_ns[0] != session.streams["force"].t_ns[0]
    assert replays.printed.count(camera) == 1
    assert all(digest in replays.printed for digest in (*taken.values(), *slower.values()))
    assert "DIFFERENT" not in replays.printed


@pytest.mark.serial
def test_a_replay_says_what_it_is_of_and_keeps_what_was_planned_and_pressed(
    replays: Replays,
) -> None:
    session, replay = Session(replays.source), Session(replays.quick)
    origin = replay.attrs["replay_of"]
    assert (origin["name"], origin["speed"]) == ("s.zarr", 4.0)
    assert origin["left_out"] == ["camera"]
    assert origin["streams"] == digests(replay)
    assert replay.attrs["mock"] is True
    assert replay.attrs["sensor"] == "wedge"
    for name in session.targets:
        assert np.array_equal(replay.targets[name], session.targets[name])
    for name in ("target", "phase", "outcome"):
        assert np.array_equal(replay.segments[name], session.segments[name])
    lengths = [s.segments["end_ns"] - s.segments["start_ns"] for s in (session, replay)]
    assert np.abs(lengths[0] / 4 - lengths[1]).max() <= 1
    assert np.array_equal(replay.reference["wrench"], session.reference["wrench"])
    assert set(replay.reference["image"]) == {-1}
    assert len(replay.frames["t_ns"]) == len(session.frames["t_ns"])
    excused = {"gap", "clock-step"}
    assert [str(f) for f in faults(check(replays.quick)) if f.code not in excused] == []


@pytest.mark.serial
def test_runs_are_replayed_one_after_the_other_with_clocks_of_their_own(replays: Replays) -> None:
    replay, session = Session(replays.fast), Session(replays.two_runs)
    assert len(replay.runs) == 2
    for name in ALL:
        assert replay.rows_of_run(name, 1) == session.rows_of_run(name, 1)
    assert replay.runs[0]["t0_ns"] < replay.streams["force"].t_ns[0] < replay.runs[1]["t0_ns"]


def test_every_count_of_a_box_comes_back_to_the_last_bit_and_no_other_force_does() -> None:
    rng = np.random.default_rng(5)
    for page in (Page(), Page(force_unit="lbf", torque_unit="lbf-in", counts_per_force=4e5)):
        scale = np.repeat(page.scale(), 3)
        counts = rng.integers(-(2**31) + 1, 2**31, (2000, 6))
        counts[:500] //= 1_000_000
        bias = rng.normal(0, 3, 6)
        value = counts * scale - bias
        assert np.array_equal(force_counts(value, bias, page), counts)
    value = np.zeros((4, 6))
    value[2, 1] = 1.25e-7
    with pytest.raises(SessionError, match=r"row 2: .* is not a whole number of counts"):
        force_counts(value, np.zeros(6), Page())


@pytest.mark.parametrize(
    ("name", "column", "bad", "message"),
    [
        ("force", "seq", 100, "streams/force: row 7: seq does not rise"),
        ("force", "status", -1, "streams/force: row 7: status is not a uint32"),
        ("pose", "device_t", 0.0, "streams/pose: row 7: the controller's clock does not advance"),
        ("taxels", "value", 70_000, "streams/taxels: row 7: a count is not a uint16"),
    ],
)
def test_a_row_that_its_device_cannot_send_is_named(
    name: str, column: str, bad: float, message: str, tmp_path: Path
) -> None:
    def change(stream: str, columns: Columns) -> Columns:
        columns = as_devices_send(stream, columns)
        if stream == name:
            columns[column] = columns[column].copy()
            columns[column][7] = bad
        return columns

    path = make_session(tmp_path / "s.zarr", seconds=0.3, names=(name,), change=change)
    with pytest.raises(SessionError, match=message):
        replayable(Session(path))


def cut(path: Path) -> None:
    shard = next(path for path in path.glob("streams/camera/value/c/**/*") if path.is_file())
    shard.write_bytes(shard.read_bytes()[: shard.stat().st_size // 2])


@pytest.mark.parametrize(
    ("options", "spoil", "message"),
    [
        ({}, cut, "camera"),
        ({"codec": "zstd"}, None, r"streams/camera: stored as pixels.*--without camera"),
        ({"finish": False}, None, "still recording"),
    ],
    ids=["a shard is cut off", "a stream is to be left out", "still being recorded"],
)
def test_a_source_that_cannot_be_replayed_is_refused_before_anything_is_made(
    options: dict[str, Any], spoil: Callable[[Path], None] | None, message: str, tmp_path: Path
) -> None:
    source = small_session(tmp_path / "s.zarr", seconds=0.5, names=("camera",), **options)
    if spoil is not None:
        spoil(source)
    with pytest.raises(SessionError, match=message):
        Replay(ReplayRequest(source, tmp_path / "r.zarr", 0.0)).run()
    assert not (tmp_path / "r.zarr").exists()


@pytest.mark.parametrize(("speed", "found"), [(1.0, {"clock-step"}), (4.0, set()), ("max", set())])
def test_pauses_are_no_fault_of_a_replay_whose_times_are_compressed(
    speed: float | str, found: set[str], tmp_path: Path
) -> None:
    def late(name: str, columns: Columns) -> Columns:
        if name == "pose":
            columns["t_ns"] = columns["t_ns"] + 200_000_000 * (np.arange(len(columns["t_ns"])) > 90)
        return columns

    path = make_session(tmp_path / "s.zarr", seconds=1.0, names=("pose",), change=late)
    set_attrs(path, replay_of={"name": "x.zarr", "speed": speed})
    assert {finding.code for finding in faults(check(path))} == found


def test_different_bytes_are_called_different() -> None:
    rows = {"force": 3, "pose": 3}
    equal, lines = compared({"force": "a", "pose": "b"}, {"force": "a", "pose": "c"}, rows)
    assert not equal
    assert "equal" in lines[0]
    assert "DIFFERENT" in lines[1]
    assert EXIT_DIFFERENT == 1


def test_one_offset_carries_the_recorded_times_over_to_the_new_clock() -> None:
    none = np.zeros(0, np.int64)
    old = 4_000_000_000_000_000_000 + np.array([0, 1, 7_000_000_001])
    at_once = Retiming(int(old[0]), 55, 1.0, none, none)
    assert (at_once(old) - 55).tolist() == [0, 1, 7_000_000_001]
    faster = Retiming(int(old[0]), 55, 4.0, none, none)
    assert (faster(old) - 55).tolist() == [0, 0, 1_750_000_000]
    retimed = Retiming(int(old[0]), 55, 0.0, old, np.array([60, 70, 90]))
    assert retimed(np.array([old[0], (old[1] + old[2]) // 2 + 1])).tolist() == [60, 80]


@pytest.mark.parametrize(
    ("state", "sent", "taken", "gap", "patience", "text"),
    [
        (ENDED, 10, 8, 0.0, MISSING_TIMEOUT + 0.5, "force: 2 of 10 rows are missing"),
        (PLAYING, 4, 4, 2.0, STALL_TIMEOUT + 2, r"no progress.*'force': 6"),
        (ENDED, 10, 11, 0.0, None, "force: 1 rows more than were sent"),
    ],
    ids=["rows are missing", "the tape never ends", "more than were sent"],
)
def test_a_tape_that_does_not_end_well_is_given_up_in_time(
    state: int, sent: int, taken: int, gap: float, patience: float | None, text: str
) -> None:
    end = EndOfTape({"force": 10, "pose": 3}, gap)
    rows = {"force": taken, "pose": 3}
    places: Any = {
        name: np.array((how, row, 0), POSITION)[()]
        for name, how, row in (("force", state, sent), ("pose", ENDED, 3))
    }
    if patience is not None:
        assert not end.reached(0, rows, places)
        assert not end.reached(round((patience - 0.5) * SECOND_NS), rows, places)
    with pytest.raises(DeviceLost, match=text):
        end.reached(round(((patience or 0.0) + 0.5) * SECOND_NS), rows, places)


def test_at_maximum_speed_no_emulator_keeps_a_reader_from_running(tmp_path: Path) -> None:
    source = small_session(tmp_path / "s.zarr", seconds=0.2, names=("force",))
    SharedLatest.create(sync_path(tmp_path), SYNC)
    SharedLatest.create(position_path(tmp_path, "force"), POSITION)
    clock = FakeClock()
    job = Recording(source, "force", tmp_path, ("force",), speed=0.0)
    fast, paced = (
        emulate(NetFtEmulatorConfig(recording=replace(job, speed=speed)), clock)
        for speed in (0.0, 1.0)
    )
    assert fast.priority < RIG_PRIORITY < paced.priority
    looks: list[int] = []

    def a_second_has_passed() -> bool:
        looks.append(clock.now_ns())
        return clock.now_ns() >= SECOND_NS

    assert Playback(job, clock)._waited(a_second_has_passed)
    assert np.diff(looks[:3]).max() < SECOND_NS // 1000
    assert len(looks) < 250


@pytest.fixture(scope="module")
def long(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A session that takes 30 s to replay."""
    path = tmp_path_factory.mktemp("long") / "s.zarr"
    return small_session(path, seconds=30.0, names=("force", "pose"))


@pytest.mark.parametrize(
    ("victim", "code", "word"),
    [
        ("emulator", 3, "force: its emulator ended"),
        pytest.param("stream", 3, "force: its process ended", marks=pytest.mark.slow),
        ("replay", 130, "interrupted by the operator"),
    ],
)
def test_whatever_ends_a_replay_what_was_recorded_is_kept(
    victim: str, code: int, word: str, tmp_path: Path, long: Path
) -> None:
    words = ("replay", "--session", str(long), "--out", str(tmp_path / "r.zarr"))
    replay = CollectionRun(tmp_path / "r.zarr", *words)
    replay.until(lambda: _journalled(tmp_path / "r.zarr") > 20_000, "recording")
    if victim == "replay":
        replay.process.send_signal(signal.SIGINT)
    else:
        os.kill(replay.process_of(f"force {victim}"), signal.SIGKILL)
    assert replay.wait() == code
    assert word in replay.text
    session = Session(tmp_path / "r.zarr")
    assert session.status == "stopped"
    kept = session.streams["force"].array("value")
    assert len(kept) > 100
    assert kept.tobytes() == Session(long).streams["force"].array("value")[: len(kept)].tobytes()
    codes = {finding.code for finding in faults(check(tmp_path / "r.zarr"))}
    assert codes <= {"gap", "clock-step"}


def _journalled(session: Path) -> int:
    return sum(path.stat().st_size for path in session.glob("streams/force/t_ns/journal-*"))


@pytest.mark.slow
def test_a_driver_that_cannot_open_ends_the_replay_before_a_session_is_made(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    source = small_session(tmp_path / "s.zarr", seconds=0.3, names=("force",))

    def deaf(*arguments: Any) -> Any:
        bench = _bench(*arguments)
        preflight = replace(bench.preflight, timeout=1.0)
        return replace(bench, preflight=preflight, force=replace(bench.force, http_port=8079))

    _bench = module.replay_bench
    monkeypatch.setattr(module, "replay_bench", deaf)
    with pytest.raises(DeviceLost, match="8079"):
        Replay(ReplayRequest(source, tmp_path / "r.zarr", 0.0)).run()
    assert not (tmp_path / "r.zarr").exists()
