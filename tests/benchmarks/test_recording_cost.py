"""Recording cost: only that the right things are counted; speed itself is not tested."""

from __future__ import annotations

import io
import math
import os
import shutil
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from benchmarks.__main__ import main
from benchmarks.recording import criteria, load, page, store_benchmark
from benchmarks.recording.alignment import (
    Alignment,
    Error,
    Method,
    force_error,
    image_error,
    measure_latency,
    measure_methods,
)
from benchmarks.recording.charts import alignment_chart, stores_chart
from benchmarks.recording.feed import Fed, Feed, record, samples
from benchmarks.recording.frames import GelFrames, number_in_jpeg, number_in_pixels
from benchmarks.recording.lateness import busy_processes, loop
from benchmarks.recording.measure import QUICK, Spread, tree_bytes
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
from benchmarks.recording.page import Results, render
from benchmarks.recording.steps import Steps
from benchmarks.recording.store_benchmark import ChildFailed, Kill, StoreRow, Write
from benchmarks.recording.store_child import inspect, read, write
from benchmarks.recording.stores import STORES, Entry, entry
from recorder import Session, SessionWriter, StreamWriter, Window
from recorder.command_line.errors import EXIT_DONE, EXIT_INTERRUPTED, EXIT_WRONG_INPUT
from recorder.progress import Progress
from rig.core.clock import SECOND_NS, FakeClock
from tests.support.few import few

SECONDS = 3.0


# Numbered frames


@pytest.mark.parametrize("number", [0, 1, 255, 256, 70_000])
def test_a_frame_tells_its_number_as_pixels_and_as_jpeg(number: int) -> None:
    frames = GelFrames()
    assert number_in_pixels(frames.pixels(number)) == number
    assert number_in_jpeg(frames.jpeg(number)) == number


def test_zeros_and_torn_frames_have_no_number() -> None:
    assert number_in_pixels(np.zeros((480, 640, 3), np.uint8)) is None
    torn = GelFrames().pixels(3).copy()
    torn.reshape(-1)[12:] = 0
    assert number_in_pixels(torn) is None
    assert number_in_jpeg(b"\xff\xd8") is None


def test_the_gel_is_as_noisy_as_it_says() -> None:
    frames = GelFrames()
    difference = frames.pixels(0).astype(float) - frames.pixels(1)
    assert difference[2:].std() == pytest.approx(2.0 * np.sqrt(2), rel=0.05)


# Stores


def local_stores() -> list[Entry]:
    return [one for one in STORES if not one.foreign]


def require(one: Entry) -> None:
    for name in one.needs:
        pytest.importorskip(name, reason=f"{name} is not installed: extra bench")


@pytest.mark.parametrize("one", few(local_stores(), 5), ids=lambda one: one.key)
def test_a_store_gives_back_what_was_appended_and_counts_its_bytes(
    one: Entry, tmp_path: Path
) -> None:
    require(one)
    path = tmp_path / "store"
    found = write(one, path, seconds=0.0, most_bytes=1)
    assert len(found["took_ns"]) == 20  # the minimum, since no time was given
    assert found["bytes"] == tree_bytes(path) > 20 * 10_000
    assert inspect(one, path)["left"] == list(range(20))
    with one.make().reader(path) as (count, images):
        assert count == 20
        window = images(3, 16)
    assert window.shape == (16, 480, 640, 3)
    if one.takes == "pixels":
        assert [number_in_pixels(image) for image in window] == [*range(3, 19)] or one.key == "png"
    assert read(one, path, seconds=0.0, seed=0)["frames"] == 0


@pytest.mark.parametrize("key", ["ours-jpeg", "ours-zstd"])
def test_frames_that_were_not_sealed_are_read_without_repair_and_after_it(
    key: str, tmp_path: Path
) -> None:
    one, frames = entry(key), GelFrames()
    make = frames.jpeg if one.takes == "jpeg" else frames.pixels
    appender = one.make().create(tmp_path / "store")
    for number in range(5):
        appender.append(make(number), number)
    # A copy is the state that a kill at this moment would have left.
    shutil.copytree(tmp_path / "store", tmp_path / "killed")
    appender.close()
    found = inspect(one, tmp_path / "killed")
    assert found == {"left": [0, 1, 2, 3, 4], "error": "", "repaired": [0, 1, 2, 3, 4]}


@pytest.mark.slow
def test_a_real_kill_loses_at_most_one_frame_of_ours(tmp_path: Path) -> None:
    one = entry("ours-jpeg")
    found = store_benchmark.kill(sys.executable, one, tmp_path, 0)
    assert found.accepted >= 70
    assert found.wrong == 0
    assert found.repaired is not None
    assert found.accepted - found.repaired <= 1


def test_zeros_that_a_store_declares_are_wrong_and_not_counted_as_left() -> None:
    numbers: list[int | None] = [0, 1, None, 3]
    assert store_benchmark._right(numbers, 4) == [0, 1, 3]
    assert store_benchmark._wrong(numbers) == 1
    assert store_benchmark._right([0, 1, 2], 2) == [0, 1]  # the third was never accepted


def test_a_store_whose_library_is_missing_says_so(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(store_benchmark, "ask", lambda *_: {"missing": "h5py"})
    row = store_benchmark.measure(entry("h5py-blosc"), QUICK, tmp_path)
    assert row.missing == "h5py not installed: extra bench"
    monkeypatch.delenv(store_benchmark.INTERPRETER, raising=False)
    row = store_benchmark.measure(entry("lerobot-image"), QUICK, tmp_path)
    text = render(Results("m", quick=False, stores=(row,)))
    assert "LEROBOT_PYTHON is not set; measured in another run: 17 frames/s" in text


def test_a_measuring_process_that_fails_gives_its_last_words(tmp_path: Path) -> None:
    with pytest.raises(ChildFailed, match=r"Error.*nowhere"):
        store_benchmark.ask(
            sys.executable,
            entry("ours-zstd"),
            "read",
            tmp_path / "nowhere",
            {"seconds": 0.0, "seed": 0},
        )


# Streams at their rates


@pytest.mark.slow
def test_feeds_are_recorded_whole_at_their_rates(tmp_path: Path) -> None:
    feeds = [Feed("camera", 60.0, "jpeg"), Feed("force", 1000.0), Feed("taxels", 60.0)]
    fed = record(feeds, 0.5, tmp_path / "load")
    assert [one.feed for one in fed] == feeds
    for one in fed:
        assert one.failure == ""
        expected = round(0.5 * one.feed.rate_hz)
        # A frame is either stored or counted as dropped; data waiting in a socket is never lost.
        assert one.rows + one.dropped == expected
        assert one.feed.kind == "camera" or one.dropped == 0
        assert one.nbytes > 0
        assert one.rss_end > 0
        assert one.cpu_share > 0
    assert not (tmp_path / "load").exists()


@pytest.mark.parametrize("feed", load.SINGLE, ids=lambda feed: feed.title)
def test_samples_fit_their_stream(feed: Feed, tmp_path: Path) -> None:
    targets = {"point": np.zeros(0, np.int16)}
    path = tmp_path / "x.zarr"
    session = SessionWriter.create(path, attrs={}, streams=[feed.spec()], targets=targets)
    with session, StreamWriter.open(session.stream_path(feed.kind)) as writer:
        for number in range(3):
            writer.append(**samples(feed)(number), t_ns=number)
    assert len(Session(path).streams[feed.kind]) == 3


@pytest.mark.parametrize("limit", range(12))
@pytest.mark.parametrize("most", [1, 2, 7, 8, 10])
def test_the_largest_number_of_cameras_is_found(limit: int, most: int) -> None:
    tried: list[int] = []

    def holds(count: int) -> bool:
        tried.append(count)
        return count <= limit

    assert load.largest(holds, most) == min(limit, most)
    assert len(tried) == len(set(tried))
    assert max(tried) <= most


def test_a_trial_adds_what_was_dropped_and_counts_a_writer_that_failed() -> None:
    trial = load.load_test_of(
        (fed(dropped=2, late=1, cpu_share=0.2), fed(failure="disk full", cpu_share=0.3))
    )
    assert (trial.cameras, trial.dropped, trial.late) == (2, 3, 1)
    assert trial.cpu_share == pytest.approx(0.5)


def fed(
    *,
    kind: str = "camera",
    dropped: int = 0,
    late: int = 0,
    cpu_share: float = 0.1,
    p99: float = 0.001,
    failure: str = "",
) -> Fed:
    spread = Spread(p99 / 2, p99, 2 * p99)
    feed = Feed(kind, 60.0, "zstd")
    return Fed(feed, 100, dropped, late, cpu_share, spread, 10**6, 10**8, 10**8, True, failure)


def test_a_loop_counts_every_tick_once() -> None:
    missed, late = loop(200.0, 0.2)
    assert missed + len(late) == 40
    assert min(late) >= 0


def test_busy_processes_end_with_their_block() -> None:
    with busy_processes(1):
        pass  # conftest fails a test that leaves a process behind


# Alignment


@pytest.fixture(scope="module")
def motion() -> Motion:
    return Motion(SECONDS)


@pytest.fixture(scope="module")
def recorded(motion: Motion, tmp_path_factory: pytest.TempPathFactory) -> Recorded:
    return record_motion(motion, SECONDS, tmp_path_factory.mktemp("motion") / "motion.zarr")


def test_the_motion_presses_as_hard_and_as_often_as_it_says(motion: Motion) -> None:
    t = np.arange(0.0, SECONDS, 1e-3)
    normal = -motion.wrench(t)[:, 2]
    # The first press meets a relaxed layer; relaxation reduces the force of the later ones.
    assert normal.max() == pytest.approx(PEAK, rel=0.1)
    off = normal < 0.05
    assert np.count_nonzero(off[1:] & ~off[:-1]) == pytest.approx(PRESS_HZ * SECONDS, abs=1)


def test_the_mean_over_an_exposure_is_the_integral_of_the_truth(motion: Motion) -> None:
    start = np.array([0.4, 0.9, 1.31])
    fine = start[:, None] + np.linspace(0, EXPOSURE, 2001)
    expected = np.stack([motion.wrench(row).mean(axis=0) for row in fine])
    assert motion.mean_wrench(start, start + EXPOSURE) == pytest.approx(expected, abs=2e-3)


def test_the_recorded_motion_is_a_sound_session_whose_capture_times_are_the_true_ones(
    recorded: Recorded,
) -> None:
    camera = Session(recorded.path).sources(0).streams["camera"]
    assert camera is not None
    believed = (camera.times - recorded.origin_ns) * 1e-9
    assert len(believed) == len(recorded.captured)
    assert np.mean(believed - recorded.captured) == pytest.approx(0.0, abs=2e-4)
    assert camera.exposure == EXPOSURE
    arrival = (Session(recorded.path).streams["camera"].t_ns - recorded.origin_ns) * 1e-9
    assert np.mean(arrival - recorded.captured) == pytest.approx(LATENCY, abs=2e-4)
    assert (arrival > recorded.captured).all()


def test_methods_rank_as_they_must(motion: Motion, recorded: Recorded) -> None:
    session = Session(recorded.path)
    found = {(one.stream, one.method): one for one in measure_methods(session, motion, recorded)}
    force = {
        name: one.errors["N"].rms for (stream, name), one in found.items() if stream == "force"
    }
    assert min(force, key=lambda name: force[name]) == "mean"
    assert max(force, key=lambda name: force[name]) == "read with the frame"
    pose = {name: one for (stream, name), one in found.items() if stream == "pose"}
    assert pose["interpolated"].errors["mm"].rms < pose["nearest"].errors["mm"].rms
    assert pose["nearest"].errors["mm"].rms < pose["latest"].errors["mm"].rms
    # For a tool that points down, the rotation vector changes sign between samples.
    assert pose["component-wise linear"].errors["deg"].rms > 10
    assert pose["interpolated"].errors["deg"].most < 0.2
    assert found["image", "nearest"].errors["px"].rms < found["image", "latest"].errors["px"].rms
    for one in found.values():
        assert one.rows > 0.9 * len(ticks(recorded))
        assert one.per_window > 0


def test_an_error_is_the_one_that_was_put_in(motion: Motion, recorded: Recorded) -> None:
    from recorder.session.align import align_window

    window = align_window(ticks(recorded), Session(recorded.path).sources(0))
    assert window.wrench is not None
    captured = recorded.captured[window.signal_row]
    exact = _with_wrench(window, motion.mean_wrench(captured - EXPOSURE, captured))
    assert force_error(exact, motion, recorded)["N"].max() == pytest.approx(0.0, abs=1e-9)
    assert exact.wrench is not None
    shifted = _with_wrench(exact, exact.wrench + np.array([0.3, 0.4, 0, 0, 0, 0]))
    assert force_error(shifted, motion, recorded)["N"] == pytest.approx(0.5)
    at_tick = replace(window, t_ns=np.round(captured * 1e9).astype(np.int64) + recorded.origin_ns)
    assert image_error(at_tick, motion, recorded)["px"].max() == pytest.approx(0.0, abs=0.5)


def _with_wrench(window: Window, wrench: np.ndarray) -> Window:
    force = replace(window.streams["force"], value=wrench)
    return replace(window, streams={**window.streams, "force": force})


def test_latency_that_nobody_told_costs_more_the_longer_it_is(
    motion: Motion, recorded: Recorded
) -> None:
    session = Session(recorded.path)
    found = [measure_latency(session, motion, recorded, late) for late in (0.0, 0.008, 0.055)]
    for name in ("force", "position", "angle", "marker"):
        errors = [getattr(one, name).rms for one in found]
        assert errors[0] < errors[1] < errors[2], name


def test_error_of_nothing_is_not_a_number() -> None:
    assert np.isnan(Error.of(np.zeros(0)).rms)
    assert Error.of(np.array([3.0, 4.0])) == Error(np.sqrt(12.5), 4.0)


# The page


def store_row(key: str, *, frames: int = 100, repaired: int | None = 10) -> StoreRow:
    took = Spread(0.001, 0.002, 0.003)
    kill = Kill(accepted=10, left=8, wrong=0, repaired=repaired)
    written = Write(frames, 2.0, 0.5, took, 1_000_000, 921_600)
    return StoreRow(
        key,
        f"store {key}",
        write=written,
        read=1000.0,
        read_cpu=1300.0,
        decode_cpu=1400.0 if "jpeg" in key else 0.0,
        read_two=2600.0,
        kills=(kill,),
    )


def test_the_page_has_absolute_figures_and_ratios() -> None:
    rows = (store_row("ours-zstd"), store_row("png", frames=25))
    text = render(Results("2 cores", quick=False, stores=rows))
    assert "| store ours-zstd | 200 | 1.00 | 50 | 1.00 | 0 | 1.00 / 2.00 / 3.00 | 10.0 |" in text
    assert "| store png | 50 | 0.25 | 12 | 0.25 |" in text
    assert "A quick run" not in text


def test_claims_are_missed_when_the_figures_say_so() -> None:
    lost = criteria.of_stores([store_row("ours-zstd", repaired=7)])
    assert [criterion.met for criterion in lost] == [False, False]
    assert "3 lost at most" in lost[0].measured
    rows = [store_row("ours-jpeg"), store_row("mcap-jpeg", frames=101)]
    jpeg = criteria.of_stores(rows)
    assert [criterion.met for criterion in jpeg] == [True, False, True, False]
    assert jpeg[2].measured == "93 % of 1,400 images per CPU-second"
    assert jpeg[3].measured == "200; MCAP 202"
    killed = replace(store_row("h5py-blosc", frames=900), kills=(Kill(10, None, 0, None),))
    rows = [store_row("ours-zstd"), store_row("zarr-append", frames=99), killed]
    assert criteria.of_stores(rows)[-1].met  # h5py does not survive a kill
    fine = criteria.of_full_load([fed(cpu_share=0.2), fed(cpu_share=0.2)])
    assert [criterion.met for criterion in fine] == [True, True, True]
    bad = criteria.of_full_load([fed(cpu_share=0.4, dropped=1, p99=0.006), fed(cpu_share=0.3)])
    assert [criterion.met for criterion in bad] == [False, False, False]
    failed = criteria.of_full_load([fed(failure="no space left")])
    assert not failed[0].met
    assert "**no**" in render(Results("m", quick=True, full=(fed(dropped=1),), full_seconds=2.0))


def test_the_command_line_knows_every_part() -> None:
    from benchmarks.recording import command as bench_recorder
    from benchmarks.recording.run import PARTS

    assert bench_recorder._PARTS == PARTS
    fields = set(Results.__dataclass_fields__)
    assert set(PARTS) <= fields


def test_ratios_to_a_store_that_was_not_measured_are_dashes() -> None:
    text = render(Results("2 cores", quick=False, stores=(store_row("png"),)))
    row = "| store png | 200 | - | 50 | - | 0 | 1.00 / 2.00 / 3.00 | 10.0 | 1,300 | - | 1,000 | "
    assert row + "2,600 |" in text.splitlines()


def test_page_names_versions_and_no_host() -> None:
    import platform

    text = page.machine(2)
    assert text.startswith("2 cores, Python 3.")
    assert "zarr 3." in text
    assert platform.node() not in text


def test_time_left_follows_the_pace_seen_so_far() -> None:
    clock, out = FakeClock(), io.StringIO()
    shown = Progress("", out, threaded=False, clock=lambda: clock.now_ns() / SECOND_NS)
    steps = Steps(shown, 10.0)
    steps.step("first", 2.0)
    clock.advance(4.0)  # twice as long as announced
    steps.step("second", 8.0)
    assert out.getvalue() == "second: 20 %, 4 s, 16 s left\n"


def test_charts_draw_what_is_known_and_say_what_is_not(tmp_path: Path) -> None:
    rows = (store_row("ours-zstd"), StoreRow("png", "`store` png", "needs cv2"))
    stores_chart(tmp_path / "stores.svg", rows)
    drawn = (tmp_path / "stores.svg").read_text()
    for text in (
        "store ours-zstd",
        "store png",
        "200",
        "1,300",
        "written and closed [frames per CPU-second]",
    ):
        assert f"<!-- {text} -->" in drawn
    assert drawn.count("<!-- not measured -->") == 2
    methods = (
        Method("force", "latest", 9, {"N": Error(0.2, 0.5)}, 2e-5),
        Method("force", "untimed", 9, {"N": Error(0.2, 0.5)}, math.nan),
        Method("pose", "interpolated", 9, {"deg": Error(0.01, 0.1)}, 1e-4),
        Method("image", "nearest", 9, {"px": Error(1.0, 4.0)}, 2e-5),
    )
    alignment_chart(tmp_path / "alignment.svg", Alignment(methods, (), 0.0, 0.0, 0.0, 0.0))
    drawn = (tmp_path / "alignment.svg").read_text()
    for text in ("latest", "interpolated", "error rms [N]", "error rms [deg]"):
        assert f"<!-- {text} -->" in drawn
    assert "untimed" not in drawn
    assert "nearest" not in drawn


# The command


@pytest.mark.slow
def test_one_quick_part_from_the_command_line_writes_its_page(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "docs" / "recording.md"
    scratch = tmp_path / "scratch"
    arguments = ["recording", "--quick", "--only", "alignment"]
    assert main([*arguments, "--scratch", str(scratch), "--out", str(out)]) == EXIT_DONE
    text = out.read_text()
    assert "## Cost of alignment accuracy" in text
    assert "## Stores side by side" not in text
    assert (out.parent / "images" / "recording-alignment.png").stat().st_size > 1000
    assert not list(scratch.iterdir())
    assert "written:" in capsys.readouterr().out


def test_a_scratch_folder_that_cannot_be_is_wrong_input(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / "file"
    file.write_text("")
    arguments = ["recording", "--quick", "--scratch", str(file / "below")]
    assert main(arguments) == EXIT_WRONG_INPUT
    assert "--scratch" in capsys.readouterr().err


def test_too_little_room_is_refused_before_anything_is_written(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(load.shutil, "disk_usage", lambda _: type("Usage", (), {"free": 10**6})())
    steps = Steps(Progress("", io.StringIO(), threaded=False), 1.0)
    with pytest.raises(ValueError, match=r"found 0\.0 GB free; allowed: .* GB or more"):
        load.full_load(QUICK, tmp_path, steps)
    assert not list(tmp_path.iterdir())


@pytest.mark.slow
def test_ctrl_c_leaves_nothing_on_the_disk_and_no_process(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "benchmarks", "recording", "--quick", "--only", "stores"]
    process = subprocess.Popen(
        [*command, "--scratch", str(tmp_path)], stderr=subprocess.PIPE, text=True
    )
    assert process.stderr is not None
    try:
        while not list(tmp_path.glob("*/*/store")):
            assert process.poll() is None, process.stderr.read()
            time.sleep(0.02)
        process.send_signal(signal.SIGINT)
        message = process.communicate(timeout=30)[1]
    finally:
        process.kill()
        process.communicate()
    assert process.returncode == EXIT_INTERRUPTED
    assert "interrupted" in message
    assert not list(tmp_path.iterdir())


@pytest.mark.slow
@pytest.mark.parametrize("key", ["lerobot-image", "lerobot-video"])
def test_lerobot_writes_in_its_own_interpreter(key: str, tmp_path: Path) -> None:
    if not os.environ.get(store_benchmark.INTERPRETER):
        pytest.skip("LEROBOT_PYTHON names no interpreter that has LeRobot")
    row = store_benchmark.measure(entry(key), QUICK, tmp_path)
    assert row.missing == ""
    assert row.write is not None
    assert row.write.frames >= 20
    assert row.write.nbytes > 0


@pytest.mark.serial
@pytest.mark.slow
def test_the_whole_quick_run_writes_every_part(tmp_path: Path) -> None:
    out = tmp_path / "recording.md"
    arguments = ["recording", "--quick", "--scratch", str(tmp_path), "--out", str(out)]
    assert main(arguments) == EXIT_DONE
    text = out.read_text()
    for heading in ("Stores", "CPU of one", "Wake-up", "Number of", "Everything", "Cost of"):
        assert f"## {heading}" in text
    assert str(tmp_path) not in text
