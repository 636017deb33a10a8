"""The stated uncertainty of times covers the errors that delays, exposure and latency cause."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import simplejpeg
import zarr
from support.few import few
from support.sessions import DEPTH, T0, depth_at, make_session, reseal, set_attrs

from recorder import Session, SessionError, check
from recorder.info import describe
from recorder.session.frames import write_frames
from recorder.session.uncertainty import sigmas_of

Columns = dict[str, Any]


def session_with(path: Path, camera: dict[str, Any], **options: Any) -> Session:
    make_session(path, seconds=2.4, shape=(24, 32), **options)
    set_attrs(path / "streams/camera", **camera)
    write_frames(path, 40)
    reseal(path)
    return Session(path)


def test_a_latency_that_was_not_measured_is_a_note_and_a_prior_of_three_frames(
    tmp_path: Path,
) -> None:
    session = session_with(tmp_path / "s.zarr", {})
    part = sigmas_of(session)[0]["camera"]
    assert part.prior == pytest.approx(3 / 60)
    assert part.latency == pytest.approx(3 / 60 / np.sqrt(3))
    (note,) = [f for f in check(tmp_path / "s.zarr") if f.code == "uncalibrated"]
    assert note.level == "note"
    assert "camera latency not calibrated: 0 to 50 ms assumed" in note.message
    assert "camera latency not calibrated" in describe(tmp_path / "s.zarr")
    assert session.frames["time_sigma"].min() > part.latency


def test_a_calibrated_latency_counts_by_its_interval(tmp_path: Path) -> None:
    measured = {
        "latency": 0.021,
        "latency_calibration": {"interval_s": [0.0205, 0.0215], "method": "taps"},
    }
    session = session_with(tmp_path / "s.zarr", measured)
    part = sigmas_of(session)[0]["camera"]
    assert part.prior is None
    assert part.latency == pytest.approx(0.5e-3 / 1.96)
    assert "uncalibrated" not in {finding.code for finding in check(tmp_path / "s.zarr")}
    assert "not calibrated" not in describe(tmp_path / "s.zarr")
    # The exposure of 10 ms, and the priors of gauge and arm, are what remains.
    assert np.median(session.frames["time_sigma"]) < 8e-3
    stored = zarr.open_array(session.path / "frames" / "time_sigma", mode="r").attrs
    assert stored["units"] == "s"


@pytest.mark.parametrize(("stamp", "late_ms"), [("start", 10), ("middle", 5), ("end", 0)])
def test_forces_are_averaged_over_the_exposure_wherever_a_camera_stamps_it(
    stamp: str, late_ms: int, tmp_path: Path
) -> None:
    def change(name: str, columns: Columns) -> Columns:
        number = np.arange(len(next(iter(columns.values()))))
        if name == "force":  # one sample a millisecond, whose value is its time
            t_ns = T0 + number * 1_000_000
            return {**columns, "t_ns": t_ns, "value": np.tile(number[:, None], 6) * 1.0}
        if name == "camera":
            device_t = T0 * 1e-9 + 0.0205 + number / 60
            arrived = T0 + 45_000_000 + np.round(number * 1e9 / 60).astype(np.int64)
            return {**columns, "t_ns": arrived, "device_t": device_t}
        return columns

    camera = {"clock": "monotonic", "stamp": stamp, "exposure": 0.010}
    session = session_with(tmp_path / "s.zarr", camera, change=change)
    start_ms = 20.5 + late_ms - 10
    window = session.window(T0 + 31_000_000, 1)
    assert int(window.capture_ns[0]) == pytest.approx(T0 + (start_ms + 10) * 1e6, abs=2)
    assert window.wrench is not None
    assert window.wrench[0, 0] == np.mean(np.arange(np.ceil(start_ms), start_ms + 10))
    period_ms = 1e3 / 60
    assert sigmas_of(session)[0]["camera"].latency == pytest.approx(1e-3 * period_ms / 3**0.5)


def test_an_unknown_exposure_makes_a_stamp_at_its_start_less_certain(tmp_path: Path) -> None:
    latency = {}
    for stamp in ("start", "end"):
        attrs = {"clock": "monotonic", "stamp": stamp, "exposure": None}
        session = session_with(tmp_path / f"{stamp}.zarr", attrs)
        latency[stamp] = sigmas_of(session)[0]["camera"].latency
        moment = " at the start of exposure" * (stamp == "start")
        assert f"its driver stamps its frames{moment} (" in describe(session.path)
    assert latency["start"] == pytest.approx(np.hypot(latency["end"], 1 / 60 / np.sqrt(3)))


def test_an_unknown_moment_of_the_stamp_is_refused_by_name(tmp_path: Path) -> None:
    with pytest.raises(SessionError, match="camera: found stamp 'begin'; known: start"):
        session_with(tmp_path / "s.zarr", {"stamp": "begin"})


def test_a_sample_that_waited_on_the_host_is_less_certain(tmp_path: Path) -> None:
    def stalled(stream: str, columns: Columns) -> Columns:
        if stream != "camera":
            return columns
        t_ns = np.array(columns["t_ns"])
        begin, end = T0 + 1_000_000_000, T0 + 1_200_000_000
        late = (t_ns > begin) & (t_ns < end)
        t_ns[late] = end + np.arange(late.sum()) * 1000
        return {**columns, "t_ns": t_ns}

    session = session_with(tmp_path / "s.zarr", {"latency": 0.0}, change=stalled)
    queue = sigmas_of(session)[0]["camera"].queue
    times = session.streams["camera"].t_ns
    first = int(np.argmax(times > T0 + 1_000_000_000))
    assert queue[first] == pytest.approx(0.19, abs=0.02)
    assert np.delete(queue, np.arange(first, first + 13)).max() < 1e-3


def test_errors_under_random_delays_lie_within_twice_the_uncertainty(tmp_path: Path) -> None:
    rng = np.random.default_rng(5)
    truth: dict[str, np.ndarray] = {}
    latest = {"camera": 0.045, "force": 0.0035, "pose": 0.0035}

    def delayed(stream: str, columns: Columns) -> Columns:
        if stream not in latest:
            return columns
        true = np.array(columns["t_ns"])
        truth[stream] = true
        least = rng.uniform(0, latest[stream])
        waited = rng.exponential(0.004, len(true)) * (rng.random(len(true)) < 0.3)
        arrived = true + np.round((least + waited) * 1e9).astype(np.int64)
        return {**columns, "t_ns": np.maximum.accumulate(arrived) + np.arange(len(true))}

    session = session_with(tmp_path / "s.zarr", {}, change=delayed)
    for name, part in sigmas_of(session)[0].items():
        error = (session.streams[name].t_ns - truth[name]) * 1e-9
        stated = part.of(session.streams[name].t_ns[:])
        assert (np.abs(error) <= 2 * stated).mean() >= 0.95, name


@pytest.mark.parametrize("name", ["camera", "force"])
@pytest.mark.parametrize("how", few(["step", "back", "ramp"], 1))
def test_a_latency_that_steps_or_ramps_is_covered_in_each_third(
    tmp_path: Path, name: str, how: str
) -> None:
    late: list[np.ndarray] = []

    def lit(seconds: float) -> bytes:
        """Return a picture whose middle is the brighter the deeper the press."""
        image = np.full((48, 64, 3), 60, np.uint8)
        image[12:36, 16:48] += np.uint8(150 * max(depth_at(np.array([seconds]))[0] / DEPTH, 0))
        return simplejpeg.encode_jpeg(image)

    def delayed(stream: str, columns: Columns) -> Columns:
        columns = dict(columns)
        if stream == name:
            place = np.linspace(0, 1, len(columns["t_ns"]))
            delay = {"step": place > 0.5, "back": place < 0.5, "ramp": place}[how] * 0.045
            late.append(delay)
            columns["t_ns"] = columns["t_ns"] + (1e9 * delay).astype(np.int64)
            if stream == "camera":
                columns["device_t"] = columns["device_t"] * np.nan
                columns["value"] = [lit(row / 60) for row in range(len(delay))]
        return columns

    path = make_session(
        tmp_path / "s.zarr",
        seconds=13.2,
        names=(name, "force", "pose")[name == "force" :],
        change=delayed,
    )
    exact = {"latency": 0.0, "latency_calibration": {"interval_s": [-5e-4, 5e-4], "method": "taps"}}
    set_attrs(path / "streams" / name, **exact)
    session = Session(path)
    stated = 2 * sigmas_of(session)[0][name].of(session.streams[name].t_ns[:])
    covers = [np.mean(part) for part in np.array_split(late[0] <= stated, 3)]
    assert min(covers) > 0.92, covers
    assert np.median(stated) < 0.1


@pytest.mark.parametrize("name", ["camera", "force"])
def test_a_latency_that_stays_adds_nothing(tmp_path: Path, name: str) -> None:
    session = session_with(tmp_path / "s.zarr", {})
    assert not sigmas_of(session)[0][name].wander[1].any()
