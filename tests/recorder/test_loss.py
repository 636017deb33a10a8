"""Samples deleted from streams are counted and placed; delays and pauses are no losses."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.sessions import RATES, T0, make_session, record_run

from recorder import Session, SessionWriter, camera_spec, check, faults, force_spec, pose_spec
from recorder.info import describe, digests
from recorder.session.loss import (
    ARRIVAL,
    DEVICE_CLOCK,
    NOTHING,
    SEQUENCE,
    find_losses,
    lateness,
    other_rate,
)
from recorder.store.documents import merge_attrs
from tests.support.few import few

Columns = dict[str, Any]

START = 4_000_000_000_000_000


def sampled(
    rate_hz: float, seconds: float, *, actual: float = 1.0, jitter: float = 0.2, seed: int = 0
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return device times [s], arrivals [ns] and numbers of a stream with delays and stalls.

    Its actual rate is a fraction of the declared one, and its mean delay `jitter` periods.
    """
    rng = np.random.default_rng(seed)
    count = int(rate_hz * actual * seconds)
    own = np.arange(count) / (rate_hz * actual)
    arrived = own + rng.exponential(jitter / rate_hz, count)
    for stall in np.arange(1.3, seconds - 1, 3.7):
        length = rng.uniform(0.02, 0.3)
        late = (arrived > stall) & (arrived < stall + length)
        arrived[late] = stall + length + np.arange(late.sum()) * 1e-5
    arrived = np.maximum.accumulate(arrived)
    return own, START + np.round(arrived * 1e9).astype(np.int64), np.arange(count) + 100


def witnesses(own: np.ndarray, seq: np.ndarray, kept: np.ndarray) -> dict[str, dict[str, Any]]:
    """Return the arguments of each witness for the samples that were kept."""
    return {SEQUENCE: {"seq": seq[kept]}, DEVICE_CLOCK: {"device_t": own[kept] + 12.5}, ARRIVAL: {}}


@pytest.mark.parametrize("rate_hz", [30.0, 60.0, 125.0, 500.0])
@pytest.mark.parametrize("actual", [1.0, 1.01, 0.985])
@pytest.mark.parametrize("every", [2, 3, 10])
def test_every_nth_sample_deleted_is_counted(rate_hz: float, actual: float, every: int) -> None:
    own, t_ns, seq = sampled(rate_hz, 20, actual=actual)
    kept = np.arange(len(own)) % every != every // 2
    true = int(np.flatnonzero(kept)[-1] + 1 - kept.sum()) - int(kept.argmax())
    for source, arguments in witnesses(own, seq, kept).items():
        losses = find_losses(t_ns[kept], rate_hz, **arguments)
        assert losses.source == source
        # Arrivals alone count within the tolerance of the rate and the delays of the stalls.
        tolerance = 0 if source != ARRIVAL else 0.03 * true + 2
        assert abs(losses.total - true) <= tolerance


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("rate_hz", [30.0, 125.0, 1000.0])
def test_bursts_are_counted_and_placed_in_time(rate_hz: float, seed: int) -> None:
    own, t_ns, seq = sampled(rate_hz, 12, jitter=0.1, seed=seed)
    rng = np.random.default_rng(seed)
    kept = np.ones(len(own), bool)
    places = np.sort(rng.choice(np.arange(2, len(own) // 30 - 2), 6, replace=False)) * 30
    sizes = rng.integers(2, 9, len(places))
    for place, size in zip(places, sizes, strict=True):
        kept[place : place + size] = False
    for source, arguments in witnesses(own, seq, kept).items():
        losses = find_losses(t_ns[kept], rate_hz, **arguments)
        assert losses.total == sizes.sum(), source
        if source == ARRIVAL:
            continue
        assert losses.count.tolist() == sizes.tolist()
        assert np.flatnonzero(kept)[losses.row].tolist() == (places + sizes).tolist()
        inside = losses.inside(t_ns[places - 1], t_ns[places + sizes])
        assert inside.tolist() == sizes.tolist()


@pytest.mark.parametrize("rate_hz", [30.0, 60.0, 125.0, 1000.0])
@pytest.mark.parametrize("actual", [1.0, 1.015, 0.985])
@pytest.mark.parametrize("jitter", [0.1, 0.5])
def test_delays_stalls_and_a_rate_a_little_off_lose_nothing(
    rate_hz: float, actual: float, jitter: float
) -> None:
    for seed in range(2):
        own, t_ns, seq = sampled(rate_hz, 15, actual=actual, jitter=jitter, seed=seed)
        for arguments in witnesses(own, seq, np.ones(len(own), bool)).values():
            losses = find_losses(t_ns, rate_hz, **arguments)
            assert losses.total == 0
            assert other_rate(t_ns, rate_hz, losses) is None


@pytest.mark.parametrize("factor", [1.25, 1.5, 2.0, 3.0])
def test_a_rate_that_falls_midway_loses_what_is_missing(factor: float) -> None:
    rate_hz = 60.0
    own = np.concatenate(
        [np.arange(600) / rate_hz, 10 + np.arange(int(600 / factor)) / rate_hz * factor]
    )
    rng = np.random.default_rng(1)
    t_ns = START + np.round((own + rng.uniform(0, 2e-3, len(own))) * 1e9).astype(np.int64)
    missing = 600 * (1 - 1 / factor)
    for arguments in ({}, {"device_t": own}):
        losses = find_losses(t_ns, rate_hz, **arguments)
        assert losses.total == pytest.approx(missing, abs=4)
        assert losses.start_ns[0] == pytest.approx(START + 10_000_000_000, abs=1e9)
        assert other_rate(t_ns, rate_hz, losses) is None
    # A device that numbers what it sends lost nothing: it ran at another rate.
    losses = find_losses(t_ns, rate_hz, seq=np.arange(len(own)))
    assert losses.total == 0
    found = other_rate(t_ns, rate_hz, losses)
    assert found is not None
    assert found[2] == pytest.approx(rate_hz / factor, rel=0.15)


def test_numbers_that_begin_anew_are_no_loss_and_those_in_tens_are_consecutive() -> None:
    _, t_ns, seq = sampled(100.0, 10)
    again = np.where(seq < 600, seq + 50_000, seq)
    assert find_losses(t_ns, 100.0, seq=again).total == 0
    assert find_losses(t_ns, 100.0, seq=10 * seq).total == 0
    half = np.arange(0, len(seq), 2)
    assert find_losses(t_ns[half], 100.0, seq=seq[half]).total == len(half) - 1


def test_in_a_replay_at_another_speed_only_the_device_tells() -> None:
    own, t_ns, seq = sampled(100.0, 10)
    kept = np.arange(len(own)) % 5 != 2
    quick = START + (t_ns - START) // 8
    assert find_losses(quick[kept], 100.0, timed=False).source == NOTHING
    for arguments in ({"seq": seq[kept]}, {"device_t": own[kept]}):
        losses = find_losses(quick[kept], 100.0, timed=False, **arguments)
        assert losses.total == (~kept[: int(np.flatnonzero(kept)[-1])]).sum()


def test_nonsense_is_counted_without_allocating() -> None:
    t_ns = np.array([0, 10**18], np.int64)
    losses = find_losses(t_ns, 1e12)
    assert losses.total > 10**14
    assert losses.inside(t_ns[:1], t_ns[1:])[0] > 10**14


def test_the_waiting_of_a_sample_is_told_from_its_delay() -> None:
    own, t_ns, _ = sampled(100.0, 20, jitter=0.02)
    losses = find_losses(t_ns, 100.0)
    waited, wander = lateness(t_ns, 100.0, losses)
    true = (t_ns - START) * 1e-9 - own
    assert np.abs(waited - true).max() < 1e-3
    assert wander < 1e-3


# Sessions.


def deleting(name: str, kept: Any) -> Any:
    """Return a change that keeps only some rows of one stream."""

    def change(stream: str, columns: Columns) -> Columns:
        if stream != name:
            return columns
        rows = np.flatnonzero(kept(np.arange(len(columns["t_ns"]))))
        return {key: [values[row] for row in rows] for key, values in columns.items()}

    return change


PATTERNS: dict[str, Any] = {
    "every 2nd": lambda row: row % 2 == 0,
    "every 3rd": lambda row: row % 3 != 1,
    "every 10th": lambda row: row % 10 != 5,
    "a burst of 2": lambda row: (row < 60) | (row >= 62),
    "a third of the rate midway": lambda row: (row < 100) | (row % 3 == 0),
}


@pytest.mark.parametrize("pattern", few(PATTERNS, 2))
@pytest.mark.parametrize("name", ["camera", "force", "pose", "taxels"])
def test_what_is_deleted_from_a_stream_is_found_in_that_stream_alone(
    name: str, pattern: str, tmp_path: Path
) -> None:
    kept = PATTERNS[pattern]
    names = ("taxels", "force", "pose") if name == "taxels" else ("camera", "force", "pose")
    path = make_session(
        tmp_path / "s.zarr", names=names, seconds=2.4, shape=(24, 32), change=deleting(name, kept)
    )
    (found,) = faults(check(path))
    assert (found.code, found.where) == ("dropped", f"streams/{name}")
    session = Session(path)
    rows = np.arange(int(2.4 * RATES[name]))
    there = np.flatnonzero(kept(rows))
    lost = int(there[-1] + 1 - len(there))
    account = session.account(name)
    assert account.lost == lost
    assert found.message.startswith(f"{lost} samples lost in {account.gaps} places")
    # Each target's part, by the times of the samples that are gone.
    gone = T0 + np.setdiff1d(rows[: there[-1]], there) / RATES[name] * 1e9
    segments = session.segments
    for target in np.unique(segments["target"]):
        own = segments["target"] == target
        ends = zip(segments["start_ns"][own], segments["end_ns"][own], strict=True)
        true = sum(int(((gone >= start) & (gone < end)).sum()) for start, end in ends)
        assert account.by_target.get(int(target), 0) == pytest.approx(true, abs=4)
    assert f"{lost}" in describe(path).split(f"{name} ", 1)[1].splitlines()[0]


def test_a_row_is_invalid_where_a_sample_that_it_needs_is_lost(tmp_path: Path) -> None:
    whole = make_session(tmp_path / "a.zarr", seconds=2.4, shape=(24, 32))
    assert Session(whole).frames["valid"].all()
    for name, gap in (("camera", (69, 72)), ("force", (1200, 1214)), ("pose", (150, 155))):
        change = deleting(name, lambda row, gap=gap: (row < gap[0]) | (row >= gap[1]))
        path = make_session(tmp_path / f"{name}.zarr", seconds=2.4, shape=(24, 32), change=change)
        frames = Session(path).frames
        bad = frames["t_ns"][~frames["valid"]]
        assert 1 <= len(bad) <= 3
        lost_ns = T0 + gap[0] / RATES[name] * 1e9
        assert np.abs(bad - lost_ns).max() < 60e6


def test_a_stream_without_numbers_or_times_says_that_drops_are_inferred(tmp_path: Path) -> None:
    def silent(stream: str, columns: Columns) -> Columns:
        if stream != "camera":
            return columns
        return {**columns, "device_t": np.full(len(columns["t_ns"]), np.nan)}

    path = make_session(tmp_path / "s.zarr", seconds=1.6, shape=(24, 32), change=silent)
    notes = {finding.code: finding for finding in check(path) if finding.level == "note"}
    assert notes["drops-unseen"].where == "streams/camera"
    assert "drops are inferred" in notes["drops-unseen"].message
    assert "drops are inferred" in describe(path)
    assert faults(check(path)) == []


def test_numbers_of_a_camera_count_its_losses_and_are_no_part_of_its_digest(tmp_path: Path) -> None:
    pixels = np.random.default_rng(0).integers(0, 255, (40, 8, 8, 3), np.uint8)
    row = np.arange(40)
    frame = row + (row >= 20) + 2 * (row >= 30)
    t_ns = T0 + np.round(frame / 30 * 1e9).astype(np.int64)
    columns = {"value": pixels, "device_t": np.full(40, np.nan), "t_ns": t_ns}
    sessions = []
    for numbers in ({"seq": frame + 7}, {}):
        spec = camera_spec(30.0, height=8, width=8, codec="zstd", numbered=bool(numbers))
        path, rows = tmp_path / f"{len(numbers)}.zarr", {**columns, **numbers}
        sessions.append(Session(record_run(path, {"camera": rows}, streams=[spec], rate_hz=30)))
    numbered, other = sessions
    account = numbered.account("camera")
    assert (account.source, account.lost, account.gaps) == (SEQUENCE, 3, 2)
    assert other.account("camera").lost == 3
    assert digests(numbered) == digests(other)


def resumed(path: Path, *, pause: float) -> Path:
    """Record two runs of a force and a pose stream with a pause between them [s]."""
    rng = np.random.default_rng(0)
    for run, start in enumerate((0.0, 3.0 + pause)):
        at, seq = start + np.arange(300) / 100, np.arange(600)
        value = np.zeros((300, 6))
        value[:, 2] = np.arange(300) * 1e-6
        pose = {"value": value, "device_t": at, "speed_scaling": np.ones(300)}
        force = {"value": rng.normal(size=(600, 6)), "seq": seq, "status": 0 * seq}
        times = {"pose": at, "force": start + seq / 200}
        t_ns = {name: T0 + np.round(each * 1e9).astype(np.int64) for name, each in times.items()}
        begin = T0 + round((start + 0.5) * 1e9)
        record_run(
            path,
            {"force": {**force, "t_ns": t_ns["force"]}, "pose": {**pose, "t_ns": t_ns["pose"]}},
            streams=[force_spec(200.0), pose_spec(100.0)] if run == 0 else None,
            targets={"point": np.zeros(2, np.int16)},
            segment={"target": run, "phase": 0, "outcome": 0, "run": run}
            | {"start_ns": begin, "end_ns": begin + 2_000_000_000},
        )
    return path


def test_the_pause_before_a_resume_is_neither_a_loss_nor_part_of_the_rate(tmp_path: Path) -> None:
    path = resumed(tmp_path / "s.zarr", pause=30.0)
    assert faults(check(path)) == []
    session = Session(path)
    for name, rate in (("force", 200.0), ("pose", 100.0)):
        account = session.account(name)
        assert account.lost == 0
        assert account.measured_hz == pytest.approx(rate, rel=0.01)
        assert account.longest_gap < 0.1
    assert " 200.00 " in describe(path)


@pytest.mark.parametrize("number", few(range(20), 5))
def test_nothing_is_found_in_healthy_sessions(number: int, tmp_path: Path) -> None:
    """Mixed kinds, codecs and lengths, delays and stalls, resumed ones and quick replays."""
    path = tmp_path / "s.zarr"
    if number % 5 == 4:
        resumed(path, pause=float(number))
        assert faults(check(path)) == []
        return
    rng = np.random.default_rng(number)
    seconds = (0.9, 1.5, 2.5, 4.0)[number % 4]

    def scaled(t_ns: np.ndarray) -> np.ndarray:
        return T0 + (t_ns - T0) // 4 if number % 3 == 1 else t_ns

    def delayed(stream: str, columns: Columns) -> Columns:
        if stream == "segments":
            times = {name: columns[name] for name in ("start_ns", "end_ns")}
            return {**columns, **{name: scaled(t_ns) for name, t_ns in times.items()}}
        t_ns = np.array(columns["t_ns"]) + rng.integers(0, 3_000_000, len(columns["t_ns"]))
        stall = T0 + round(seconds / 2 * 1e9)
        held = (t_ns > stall) & (t_ns < stall + 25_000_000)
        t_ns[held] = stall + 25_000_000 + np.arange(held.sum())
        t_ns = np.maximum.accumulate(t_ns) + np.arange(len(t_ns))
        return {**columns, "t_ns": scaled(t_ns) + np.arange(len(t_ns))}

    names = (("camera", "force", "pose"), ("taxels", "force", "pose"), ("camera",))[number % 3]
    make_session(
        path,
        seconds=seconds,
        names=names,
        codec=("jpeg", "zstd")[number % 2],
        shape=(24, 32),
        change=delayed,
        finish=number % 3 != 1,
    )
    if number % 3 == 1:
        quicken(path)
    assert faults(check(path)) == []


def quicken(path: Path) -> None:
    """Finish a session whose times are four times as fast as its devices' clocks."""
    merge_attrs(path, {"replay_of": {"speed": 4.0}})
    with SessionWriter.resume(path) as session:
        session.finish("complete", rate_hz=40)
