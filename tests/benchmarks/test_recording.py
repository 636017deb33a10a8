"""The benchmark of recording counts the right things; speed itself is not tested."""

import shutil
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from benchmarks.__main__ import main
from benchmarks.processes import ChildFailed, alone
from benchmarks.recording import comparison, load, loading
from benchmarks.recording.alignment import (
    force_error,
    image_error,
    measure_latency,
    measure_methods,
    rms_and_most,
)
from benchmarks.recording.command import summary
from benchmarks.recording.feed import Feed, record
from benchmarks.recording.frames import GelFrames, number_in
from benchmarks.recording.measure import WINDOW, tree_bytes
from benchmarks.recording.motion import (
    EXPOSURE,
    LATENCY,
    PEAK,
    PRESS_HZ,
    Motion,
    Recorded,
    record_motion,
    ticks,
)
from benchmarks.recording.stores import MCAP, OURS, STORES
from benchmarks.recording.storing import inspect, read, write
from recorder import Session, SessionWriter, StreamWriter, Window
from recorder.command_line.errors import EXIT_INTERRUPTED
from recorder.session.align import align_window
from rig.core.errors import ConfigError
from tests.support.few import few

pytestmark = pytest.mark.slow

SECONDS = 3.0


# Numbered frames


@pytest.mark.parametrize("number", [0, 255, 70_000])
def test_a_frame_tells_its_number_as_pixels_and_as_jpeg_and_a_torn_one_has_none(
    number: int,
) -> None:
    frames = GelFrames()
    assert number_in(frames.pixels(number)) == number
    assert number_in(frames.jpeg(number)) == number
    torn = frames.pixels(number).copy()
    torn.reshape(-1)[12:] = 0
    assert number_in(torn) is number_in(np.zeros_like(torn)) is None
    assert number_in(b"\xff\xd8") is None


def test_the_gel_is_as_noisy_as_it_says() -> None:
    frames = GelFrames()
    difference = frames.pixels(0).astype(float) - frames.pixels(1)
    assert difference[2:].std() == pytest.approx(2.0 * np.sqrt(2), rel=0.05)


# Stores


@pytest.mark.parametrize("key", few(list(STORES), 3))
def test_a_store_returns_what_was_appended_and_counts_its_bytes(key: str, tmp_path: Path) -> None:
    try:
        store = STORES[key].make()
    except ImportError as error:
        pytest.skip(f"{error.name} is not installed: extra bench")
    path = tmp_path / "store"
    written = write(key, path, 0.0, 1)
    assert written["frames"] == 20  # the minimum, since no time was given
    assert written["bytes"] == tree_bytes(path) > 20 * 10_000
    assert inspect(key, path)["left"] == list(range(20))
    assert read(key, path, 0.0, 0)["frames"] == 16
    with store.reader(path) as (count, images):
        assert count == 20
        window = images(3, 16)
    assert window.shape == (16, 480, 640, 3)
    if STORES[key].frames == "pixels" and key != "png":  # OpenCV's order of colours
        assert [number_in(image) for image in window] == [*range(3, 19)]


@pytest.mark.parametrize("key", ["ours-jpeg", "ours-zstd"])
def test_unsealed_frames_are_read_without_repair_and_after_it(key: str, tmp_path: Path) -> None:
    store, frames = STORES[key].make(), GelFrames()
    make = frames.jpeg if STORES[key].frames == "jpeg" else frames.pixels
    store.create(tmp_path / "store")
    for number in range(5):
        store.append(make(number), number)
    # A copy is the state that a kill at this moment would have left.
    shutil.copytree(tmp_path / "store", tmp_path / "killed")
    store.close()
    after = inspect(key, tmp_path / "killed")
    assert after == {"left": [0, 1, 2, 3, 4], "error": "", "repaired": [0, 1, 2, 3, 4]}


def test_a_real_kill_loses_no_accepted_frame_of_ours(tmp_path: Path) -> None:
    after = comparison.kill(OURS, tmp_path, 0)
    assert after["accepted"] >= 70
    assert (after["wrong"], after["lost"]) == (0, 0)


def test_zeros_that_a_store_declares_are_wrong_and_not_counted_as_left() -> None:
    torn = {"left": [0, 1, None, 3], "repaired": None}
    assert comparison.left_after_kill(4, torn) == {"accepted": 4, "wrong": 1, "lost": 1}
    # The third was stored, but its append had not returned.
    repaired = comparison.left_after_kill(2, {"left": None, "repaired": [0, 1, 2]})
    assert repaired == {"accepted": 2, "wrong": 0, "lost": 0}


def test_a_measuring_process_that_fails_gives_its_error(tmp_path: Path) -> None:
    with pytest.raises(ChildFailed, match=r"Error.*nowhere"):
        alone(read, "ours-zstd", tmp_path / "nowhere", 0.0, 0)


# Streams at their rates


def test_feeds_are_recorded_whole_at_their_rates(tmp_path: Path) -> None:
    feeds = [Feed("camera", 60.0, "jpeg"), Feed("force", 1000.0), Feed("taxels", 60.0)]
    for feed, one in zip(feeds, record(feeds, 0.5, tmp_path / "load"), strict=True):
        assert (one["title"], one["failure"]) == (feed.title, "")
        # A frame is either stored or counted as dropped; data waiting in a socket is never lost.
        assert one["rows"] + one["dropped"] == round(0.5 * feed.rate_hz)
        assert feed.kind == "camera" or one["dropped"] == 0
        assert min(one["bytes"], one["rss_end"], one["cpu"]) > 0
    assert not (tmp_path / "load").exists()


@pytest.mark.parametrize("feed", load.SINGLE, ids=lambda feed: feed.title)
def test_samples_fit_their_stream(feed: Feed, tmp_path: Path) -> None:
    targets = {"point": np.zeros(0, np.int16)}
    path = tmp_path / "x.zarr"
    session = SessionWriter.create(path, attrs={}, streams=[feed.spec()], targets=targets)
    with session, StreamWriter.open(session.stream_path(feed.kind)) as writer:
        for number in range(3):
            writer.append(**feed.samples()(number), t_ns=number)
    assert len(Session(path).streams[feed.kind]) == 3


def fed(
    *, dropped: int = 0, cpu: float = 0.1, p99: float = 1.0, failure: str = ""
) -> dict[str, Any]:
    counts = {"title": "camera", "rows": 100, "dropped": dropped, "late": 1, "bytes": 10**6}
    times = {"p50": p99 / 2, "p99": p99, "most": 2 * p99}
    memory = {"rss_start": 10**8, "rss_end": 10**8, "punctual": True}
    return {**counts, **memory, "cpu": cpu, "append_ms": times, "failure": failure}


def test_a_trial_adds_what_was_dropped_and_counts_a_writer_that_failed() -> None:
    trial = load.trial_of([fed(dropped=2, cpu=0.2), fed(failure="disk full", cpu=0.3)])
    assert (trial["cameras"], trial["dropped"], trial["late"]) == (2, 3, 2)
    assert trial["cpu"] == pytest.approx(0.5)


def test_too_little_room_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(shutil, "disk_usage", lambda _: SimpleNamespace(free=10**6))
    with pytest.raises(ConfigError, match=r"found 0\.0 GB free; allowed: 1\.5 GB or more"):
        load.require_room(tmp_path, 1e9)


# Alignment


@pytest.fixture(scope="module")
def motion() -> Motion:
    return Motion(SECONDS)


@pytest.fixture(scope="module")
def recorded(motion: Motion, tmp_path_factory: pytest.TempPathFactory) -> Recorded:
    return record_motion(motion, SECONDS, tmp_path_factory.mktemp("motion") / "motion.zarr")


def test_the_motion_presses_as_hard_and_as_often_as_it_says(motion: Motion) -> None:
    normal = -motion.wrench(np.arange(0.0, SECONDS, 1e-3))[:, 2]
    # The first press meets a relaxed layer; relaxation reduces the force of the later ones.
    assert normal.max() == pytest.approx(PEAK, rel=0.1)
    off = normal < 0.05
    assert np.count_nonzero(off[1:] & ~off[:-1]) == pytest.approx(PRESS_HZ * SECONDS, abs=1)


def test_the_mean_over_an_exposure_is_the_integral_of_the_truth(motion: Motion) -> None:
    start = np.array([0.4, 0.9, 1.31])
    fine = start[:, None] + np.linspace(0, EXPOSURE, 2001)
    expected = np.stack([motion.wrench(row).mean(axis=0) for row in fine])
    assert motion.mean_wrench(start, start + EXPOSURE) == pytest.approx(expected, abs=2e-3)


def test_the_recorded_motion_has_the_true_capture_times(recorded: Recorded) -> None:
    session = Session(recorded.path)
    camera = session.sources(0).streams["camera"]
    believed = (camera.times - recorded.origin_ns) * 1e-9
    assert len(believed) == len(recorded.captured)
    assert np.mean(believed - recorded.captured) == pytest.approx(0.0, abs=2e-4)
    assert camera.exposure == EXPOSURE
    arrival = (session.streams["camera"].t_ns - recorded.origin_ns) * 1e-9
    assert np.mean(arrival - recorded.captured) == pytest.approx(LATENCY, abs=2e-4)
    assert (arrival > recorded.captured).all()


def test_methods_rank_as_they_must(motion: Motion, recorded: Recorded) -> None:
    rows = measure_methods(Session(recorded.path), motion, recorded)
    found = {(one["stream"], one["method"]): one for one in rows}
    force = {name: one["N"]["rms"] for (stream, name), one in found.items() if stream == "force"}
    assert min(force, key=lambda name: force[name]) == "mean"
    assert max(force, key=lambda name: force[name]) == "read with the frame"
    pose = {name: one for (stream, name), one in found.items() if stream == "pose"}
    assert pose["interpolated"]["mm"]["rms"] < pose["nearest"]["mm"]["rms"]
    assert pose["nearest"]["mm"]["rms"] < pose["latest"]["mm"]["rms"]
    # For a tool that points down, the rotation vector changes sign between samples.
    assert pose["by component"]["deg"]["rms"] > 10
    assert pose["interpolated"]["deg"]["most"] < 0.2
    assert found["camera", "nearest"]["px"]["rms"] < found["camera", "latest"]["px"]["rms"]
    assert all(one["rows"] > 0.9 * len(ticks(recorded)) for one in rows)
    assert all(one["window_us"] > 0 for one in rows)


def test_an_error_is_the_one_that_was_put_in(motion: Motion, recorded: Recorded) -> None:
    window = align_window(ticks(recorded), Session(recorded.path).sources(0))
    captured = recorded.captured[window.signal_row]
    exact = _with_wrench(window, motion.mean_wrench(captured - EXPOSURE, captured))
    assert force_error(exact, motion, recorded)["N"].max() == pytest.approx(0.0, abs=1e-9)
    assert exact.wrench is not None
    shifted = _with_wrench(exact, exact.wrench + np.array([0.3, 0.4, 0, 0, 0, 0]))
    assert force_error(shifted, motion, recorded)["N"] == pytest.approx(0.5)
    at_tick = replace(window, t_ns=np.round(captured * 1e9).astype(np.int64) + recorded.origin_ns)
    assert image_error(at_tick, motion, recorded)["px"].max() == pytest.approx(0.0, abs=0.5)
    assert rms_and_most(np.array([3.0, 4.0])) == {"rms": np.sqrt(12.5), "most": 4.0}
    assert np.isnan(rms_and_most(np.zeros(0))["rms"])


def _with_wrench(window: Window, wrench: np.ndarray) -> Window:
    force = replace(window.streams["force"], value=wrench)
    return replace(window, streams={**window.streams, "force": force})


def test_latency_that_is_not_corrected_costs_more_the_longer_it_is(
    motion: Motion, recorded: Recorded
) -> None:
    session = Session(recorded.path)
    found = [measure_latency(session, motion, recorded, late) for late in (0.0, 0.008, 0.055)]
    for unit in ("N", "mm", "deg", "px"):
        errors = [one[unit]["rms"] for one in found]
        assert errors[0] < errors[1] < errors[2], unit


# Windows for a training


def test_all_ways_read_the_same_images(tmp_path: Path) -> None:
    loading.make(tmp_path, 0, 0.6)
    windows, files = loading.opened("ours", tmp_path), loading.opened("plain", tmp_path)
    assert len(windows) == len(files) == 24 - WINDOW + 1  # type: ignore[arg-type]
    plain = [files[number]["image"].float() for number in range(8)]
    for number in range(3):
        image = windows[number]["image"].float()
        off = np.sort([float((image - other).abs().mean()) for other in plain])
        assert off[0] < 1 < off[1]  # two decoders; frames in another order


# The page


def store_row(key: str, frames: int = 100, *, lost: int = 0, wrong: int = 0) -> dict[str, Any]:
    kill = {"accepted": 10, "wrong": wrong, "lost": lost}
    times = {"p50": 1.0, "p99": 2.0, "most": 3.0}
    written = {"frames": frames, "seconds": 2.0, "cpu": 0.5, "append_ms": times, "bytes": 10**6}
    read = {"frames": frames, "seconds": 1.0, "cpu": 0.8}
    rows = {"written": [written], "read": [read], "decoded": [read] if key == OURS else []}
    return {"key": key, "missing": "", "kills": [kill], **rows}


def test_goals_are_missed_when_the_figures_say_so() -> None:
    stores = [store_row(OURS), store_row(MCAP, 101), store_row("ours-zstd"), store_row("png", 99)]
    dead = store_row("h5py-blosc", 900, lost=10)  # does not survive a kill
    lines = summary({"stores": [*stores, dead]}).splitlines()[2:]
    assert [line.split("|")[-2].strip() for line in lines] == [
        "yes",  # kills
        *["**no**"] * 4,  # beside MCAP
        "yes",  # lossless
    ]
    assert "| 0.99 |" in lines[1]
    lines = summary({"stores": [store_row(OURS, lost=3, wrong=1)]}).splitlines()
    assert lines[2].endswith("| 3 lost at most, 1 invented, in 1 kills | **no** |")
    fine, bad = [fed(cpu=0.2), fed(cpu=0.2)], [fed(cpu=0.4, dropped=1, p99=6.0), fed(cpu=0.3)]
    assert summary({"load": {"together": fine}}).count("| yes |") == 3
    assert summary({"load": {"together": bad}}).count("| **no** |") == 3
    assert "**no**" in summary({"load": {"together": [fed(failure="no space left")]}})


# The command


def test_ctrl_c_leaves_no_store_on_the_disk_and_no_process(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "benchmarks", "recording", "--quick", "--only", "stores"]
    environment = {"TMPDIR": str(tmp_path), "PATH": "/usr/bin:/bin"}
    process = subprocess.Popen(
        [*command, "--out", str(tmp_path / "page.md")],
        stderr=subprocess.PIPE,
        text=True,
        env=environment,
    )
    assert process.stderr is not None
    try:
        while not list(tmp_path.glob("recording-*/*")):
            assert process.poll() is None, process.stderr.read()
            time.sleep(0.02)
        process.send_signal(signal.SIGINT)
        message = process.communicate(timeout=60)[1]
    finally:
        process.kill()
        process.communicate()
    assert process.returncode == EXIT_INTERRUPTED
    assert "interrupted" in message
    # The rows that were measured stay for the next run.
    assert [each.name for each in tmp_path.iterdir()] == ["page.json"]


@pytest.mark.serial
def test_the_whole_quick_run_writes_every_part(tmp_path: Path) -> None:
    assert main(["recording", "--quick", "--out", str(tmp_path / "recording.md")]) == 0
    text = (tmp_path / "recording.md").read_text()
    for heading in ("Stores", "Load", "Alignment", "Windows", "Latency"):
        assert f"\n## {heading}" in text
    assert str(tmp_path) not in text
    assert len(list((tmp_path / "images").iterdir())) == 3
