"""Live forces: the newest frame is used, losses are reported, and a mock bench has a presser."""

import argparse
import contextlib
import csv
import functools
import io
import json
import signal
import subprocess
import sys
import urllib.request
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import simplejpeg
from support.learning_sessions import altered
from support.sessions import make_session
from support.waiting import until
from support.watching import next_state
from support.watching import watch as connected
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import connect

from benchmarks.fake_clock import FakeClock
from learning.force.live import LiveForce, LivePredictor
from recorder import Session, SessionError
from recorder.command_line.options import Parser
from rig.bench.bench import BenchFile
from rig.cli import live
from rig.core.clock import SECOND_NS, SystemClock
from rig.core.errors import ConfigError, DeviceLost
from rig.core.packaged import BENCHES
from rig.monitor.access import AccessPolicy
from rig.monitor.forces import ForceLine, Summary, add_gauge, watch
from rig.monitor.forces_page import ForcesJob, ForcesPage
from rig.monitor.lab import Folders
from rig.monitor.side_by_side import SensorJob, SideBySide
from rig.monitor.watched import GaugeBeside, Watched, mock_bench, replayed

pytestmark = pytest.mark.slow

# Time that the stub needs for a frame.
WORK_NS = 5_000_000


@dataclass
class Stub(LivePredictor):
    """A slow predictor that needs some frames before it begins."""

    clock: FakeClock | None = None
    first: int = 2
    seen: list[Any] = field(default_factory=list)
    no_contact: list[Any] = field(default_factory=list)
    with_intervals: bool = False
    with_before: bool = False

    @property
    def intervals(self) -> Any:
        return True if self.with_intervals else None

    @property
    def has_before(self) -> bool:
        return self.with_before

    def begin(self, frames: Any) -> None:
        self.no_contact += list(frames)

    def step(self, frame: Any, t_ns: int | None = None) -> LiveForce | None:
        self.seen.append(frame)
        if self.clock is not None:
            self.clock.advance(WORK_NS / SECOND_NS)
        if len(self.seen) <= self.first:
            return None
        x, y, z = 0.0, 0.5, -float(np.mean(frame))
        interval = ((x - 1, y - 1, z - 1), (x + 1, y + 1, z + 1))
        return LiveForce(
            (x, y, z),
            True,
            0.0,
            interval=interval if self.with_intervals else None,
            outside=self.with_intervals and z < -3.5,
            before=(x, y, 2 * z) if self.with_before else None,
        )


@dataclass
class Drops:
    """A driver whose frames come in batches, as seen by a slow reader."""

    clock: FakeClock
    portions: list[list[Any]]
    dropped: int = 0

    def read(self, timeout: float) -> list[dict[str, Any]]:
        if not self.portions:
            raise DeviceLost("camera: unplugged")
        portion = self.portions.pop(0)
        if not portion:
            self.clock.advance(timeout)
        return [{"value": value, "t_ns": self.clock.now_ns()} for value in portion]

    def open(self, timeout: float) -> None: ...

    def describe(self) -> dict[str, Any]:
        return {}

    def close(self) -> None: ...


def scan(value: float) -> np.ndarray[Any, Any]:
    return np.full((16, 3), value)


def test_the_newest_frame_is_taken_and_skipped_ones_are_counted(tmp_path: Path) -> None:
    clock = FakeClock(7 * SECOND_NS)
    portions = [[scan(0)], [scan(0)], [scan(1)], [], [scan(2), scan(3)], [scan(4)] * 3]
    driver = Drops(clock, portions, dropped=1)
    begun: list[int] = []
    watched = Watched("uskin", "taxels", driver, begin=lambda: begun.append(len(portions)))
    summary, predictor, out = Summary(), Stub(clock), tmp_path / "forces.csv"
    with pytest.raises(DeviceLost):
        watch(watched, predictor, clock, summary=summary, out=out)
    assert [force[2] for force in summary.force] == [-1.0, -3.0, -4.0]
    assert (summary.frames, summary.skipped) == (3, 3)
    assert begun == [3]
    assert np.allclose(summary.latency, WORK_NS / SECOND_NS)
    with out.open() as file:
        rows = list(csv.DictReader(file))
    assert [float(row["Fz_N"]) for row in rows] == [-1.0, -3.0, -4.0]
    assert [float(row["latency_ms"]) for row in rows] == [5.0] * 3
    assert int(rows[0]["t_ns"]) == 7 * SECOND_NS + 2 * WORK_NS
    with pytest.raises(ConfigError, match="exists"):
        watch(watched, predictor, clock, summary=Summary(), out=out)


def test_forces_before_and_after_stand_beside_the_gauge_in_a_table_and_on_a_page(
    tmp_path: Path,
) -> None:
    clock = FakeClock(7 * SECOND_NS)
    gauge = GaugeBeside(Drops(clock, [[np.full(6, 5.0)]]))  # type: ignore[arg-type]
    assert gauge.newest() is None  # its zero is not known before a second is over
    clock.advance(1.0)
    gauge._driver = Drops(clock, [[np.full(6, 5.0)], *([[np.full(6, 3.0)]] * 3)])  # type: ignore[assignment]
    assert gauge.newest() == (0.0, 0.0, 0.0)
    driver = Drops(clock, [[scan(1)], [scan(3)], [scan(4)], []])
    watched = Watched(
        "uskin", "taxels", driver, over=lambda: True, wrench=gauge.wrench, gauge=gauge.newest
    )
    predictor = Stub(clock, first=0, with_intervals=True, with_before=True)
    out, summary, printed = tmp_path / "forces.csv", Summary(), io.StringIO()
    line, access = ForceLine(clock, printed), AccessPolicy(port=0)
    folders = Folders(tmp_path / "none", BENCHES)
    with ForcesPage(access, folders, [ForcesJob("uskin", "REPLAY")]) as page:

        def show(force: LiveForce, t_ns: int, latency: float, beside: Any) -> None:
            line(force, latency)
            page.add(force, t_ns, latency, beside)

        with connected(access, page.port) as client:
            hello = json.loads(client.recv(timeout=240))
            assert (hello["live"], hello["sensor"], hello["lab"]) == ("forces", "uskin", False)
            client.send('{"command": "abort"}')  # it has none
            while not next_state(client)["refused"]:
                pass
            watch(watched, predictor, clock, summary=summary, show=show, out=out)
            points: list[Any] = []
            while len(points) < 3:
                state = next_state(client)
                assert state["status"] == "watching"
                points += state["points"][0]
            _, force, low, high, before, beside, latency, contact, outside, _ = points[-1]
            assert (force, before) == ([0.0, 0.5, -4.0], [0.0, 0.5, -8.0])
            assert (low, high) == ([-1.0, -0.5, -5.0], [1.0, 1.5, -3.0])
            assert (beside, latency, contact, outside) == ([-2.0, -2.0, -2.0], 5.0, True, True)
            page.finish(dict.fromkeys(summary.shows_ns, [-9.0] * 3))
            page.close()
            while (state := next_state(client))["status"] == "watching":
                pass
            # The last forces replace all others: the true ones are known at the end only.
            (last,) = state["points"]
            assert [point[1] for point in last] == [point[1] for point in points]
            assert [point[5] for point in last] == [[-9.0] * 3] * 3
    assert "before Fx  +0.00  Fy  +0.50  Fz   -2.00  after Fx  +0.00 +-1.00" in printed.getvalue()
    add_gauge(out, gauge.wrench(np.array(summary.shows_ns)))
    with out.open() as opened:
        rows = list(csv.DictReader(opened))
    assert [float(row["before_Fz_N"]) for row in rows] == [-2.0, -6.0, -8.0]
    assert [float(row["Fz_low_N"]) for row in rows] == [-2.0, -4.0, -5.0]
    assert [int(row["outside"]) for row in rows] == [0, 0, 1]
    assert rows[0]["gauge_Fz_N"] == "0.0"


def test_it_ends_when_time_is_up_when_it_is_over_and_when_it_is_asked_to(tmp_path: Path) -> None:
    clock = FakeClock()
    many = [[scan(1)] for _ in range(100)]
    watched = Watched("uskin", "taxels", Drops(clock, many, dropped=2))
    summary = Summary()
    watch(watched, Stub(clock), clock, summary=summary, seconds=0.1)
    assert summary.frames == 21
    assert summary.rate_hz == pytest.approx(200.0)
    assert summary.lost == 2
    over = Watched("uskin", "taxels", Drops(clock, [[scan(1)], []]), over=lambda: True)
    watch(over, Stub(clock, first=0), clock, summary=(summary := Summary()))
    assert summary.frames == 1
    out = tmp_path / "none.csv"
    watch(over, Stub(clock), clock, is_over=lambda: True, summary=(summary := Summary()), out=out)
    assert summary.frames == 0
    assert not out.exists()
    assert list(summary.lines()) == ["no force: no frame arrived after the reference frames"]


def test_a_damaged_picture_is_counted_and_left_out() -> None:
    clock = FakeClock()
    good = simplejpeg.encode_jpeg(np.full((480, 640, 3), 90, np.uint8))
    driver = Drops(clock, [[good], [good[:200]], [good], []])
    watched = Watched("tacpalm", "camera", driver, over=lambda: True)
    predictor = Stub(clock, first=0)
    watch(watched, predictor, clock, summary=(summary := Summary()))
    assert (summary.frames, summary.lost) == (2, 1)
    assert all(frame.shape == (480, 640, 3) for frame in predictor.seen)


def test_the_summary_says_rate_latency_and_how_far_it_was_from_the_truth() -> None:
    summary = Summary(skipped=3, lost=1)
    force = LiveForce((0.0, 0.0, -1.0), True, 0.0)
    for number in range(101):
        now_ns = number * SECOND_NS // 100
        summary.add(force, now_ns - number * 100_000, now_ns, now_ns)
    wrench = np.zeros((101, 6))
    wrench[:, 2] = -1.5
    wrench[0] = np.nan
    text = "\n".join(summary.lines(wrench))
    assert "101 forces in 1.0 s, 100.0 a second; 3 frames skipped" in text
    assert "p50 5.0 ms, p99 9.9 ms, worst 10.0 ms" in text
    assert "Fz 0.50 N (of 1.50)" in text
    assert "error" not in "\n".join(summary.lines(np.full((101, 6), np.nan)))


def test_forces_are_shown_no_more_often_than_they_can_be_read() -> None:
    class Terminal(io.StringIO):
        def isatty(self) -> bool:
            return True

    clock = FakeClock()
    for out, every in ((Terminal(), 10), (io.StringIO(), 1)):
        line = ForceLine(clock, out)
        for _ in range(200):
            line(LiveForce((0.1, -0.2, -3.0), True, 0.0), 0.008)
            clock.advance(0.01)
        line.close()
        line.close()
        assert out.getvalue().count("Fz") == 2 * every
        assert "Fz   -3.00 N  contact    8.0 ms" in out.getvalue()


def test_the_finger_of_a_mock_bench_presses_once_the_sensor_was_seen_without_contact(
    tmp_path: Path,
) -> None:
    file = BenchFile.read(BENCHES / "uskin.yaml")
    clock, predictor, summary = SystemClock(), Stub(first=20), Summary()
    with mock_bench(file, tmp_path, clock, rate_hz=100.0) as watched:
        assert watched.driver.describe()["rate_hz"] in (None, 100.0)
        watch(
            watched,
            predictor,
            clock,
            summary=summary,
            is_over=lambda: summary.frames > 20 and summary.seconds > 1.2,
        )
        assert watched.wrench is not None
        wrench = watched.wrench(np.array(summary.shows_ns))
    counts = np.array(predictor.seen, float)
    spread = np.abs(counts - counts[:20].mean(axis=0)).max(axis=(1, 2))
    assert spread[:20].max() < 20
    assert spread[20:].max() > 200
    assert wrench[:, 2].min() < -0.2


def test_a_session_is_watched_at_its_recorded_times(tmp_path: Path) -> None:
    made = make_session(tmp_path / "made.zarr", seconds=1.0, names=("force", "taxels"))
    taken_ns = int(Session(made).streams["taxels"].t_ns[4])
    source = altered(made, tmp_path / "s.zarr", {"reference/t_ns": taken_ns})
    recorded = Session(source)
    clock, predictor, summary = FakeClock(7 * SECOND_NS), Stub(first=0), Summary()
    with replayed(source, clock) as watched:
        assert (watched.sensor, watched.stream) == ("wedge", "taxels")
        watch(watched, predictor, clock, summary=summary)
        assert watched.wrench is not None
        wrench = watched.wrench(np.array(summary.shows_ns))
    rows = len(recorded.streams["taxels"])
    assert np.array_equal(predictor.no_contact, recorded.streams["taxels"].array("value")[:5])
    assert summary.frames + summary.skipped == rows
    recorded_ns = recorded.streams["taxels"].t_ns
    assert np.isin(
        np.subtract(summary.shows_ns, summary.shows_ns[0]), recorded_ns - recorded_ns[0]
    ).all()
    values = np.asarray(recorded.streams["taxels"].array("value"))
    assert np.array_equal(predictor.seen[-1], values[-1])
    assert np.isfinite(wrench).all(axis=1).sum() > 0.8 * summary.frames


def test_pixels_can_be_watched_and_a_session_without_a_signal_cannot(tmp_path: Path) -> None:
    source = make_session(tmp_path / "s.zarr", seconds=0.3, names=("camera",), codec="zstd")
    clock, predictor, summary = FakeClock(7 * SECOND_NS), Stub(first=0), Summary()
    with replayed(source, clock) as watched:
        watch(watched, predictor, clock, summary=summary)
    stream = Session(source).streams["camera"]
    assert summary.frames + summary.skipped == len(stream)
    assert np.array_equal(predictor.seen[-1], stream.images([len(stream) - 1])[0])
    blind = make_session(tmp_path / "blind.zarr", seconds=0.2, names=("force", "pose"))
    with pytest.raises(SessionError, match="neither camera nor taxels"), replayed(blind, clock):
        pass


def live_options(*words: str, model: str = "demo") -> argparse.Namespace:
    parser = Parser()
    live.add_arguments(parser)
    return parser.parse_args(["--model", model, *words])


def source(*words: str) -> Any:
    return live._source(live._sensors(live_options(*words))[""])


def test_the_finger_of_a_mock_bench_has_the_named_indenter(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    opened: list[str] = []

    def mock(file: BenchFile, folder: Path, clock: Any, *, rate_hz: float | None) -> Any:
        opened.append(file.bench.indenter)

    monkeypatch.setattr("rig.monitor.watched.mock_bench", mock)
    for words in ((), ("--indenter", "cone")):
        source("--sensor", "gelsight", *words).open(tmp_path, SystemClock())
    assert opened == [BenchFile.read(BENCHES / "gelsight.yaml").bench.indenter, "cone"]


def test_the_page_of_live_is_served_at_the_address_that_is_printed(
    capsys: pytest.CaptureFixture[str],
) -> None:
    options = live_options("--sensor", "uskin", "--page", "0")
    with contextlib.ExitStack() as stack:
        page = live._opened_page(options, [ForcesJob("uskin", "MOCK BENCH")], stack)
        assert page is not None
        address = capsys.readouterr().out.removeprefix("watch it at ").strip()
        assert address == f"http://127.0.0.1:{page.port}/"
        with urllib.request.urlopen(address, timeout=240) as answer:
            assert answer.status == 200


def test_sensors_have_names_and_options_of_their_own(tmp_path: Path) -> None:
    words = ("--model", "right=b", "--session", str(tmp_path / "s.zarr"), "--out", "f.csv")
    both = live._sensors(live_options(*words, model="left=a"))
    assert {name: (one.model, one.stream, str(one.out)) for name, one in both.items()} == {
        "left": ("a", "left", "f-left.csv"),
        "right": ("b", "right", "f-right.csv"),
    }
    words = ("--model", "right=b", "--sensor", "left=uskin", "--sensor", "right=gelsight")
    both = live._sensors(live_options(*words, model="left=a"))
    assert [(one.sensor, one.stream) for one in both.values()] == [("uskin", ""), ("gelsight", "")]
    alone = live._sensors(live_options("--sensor", "uskin", "--out", "f.csv", model="x/y=1"))
    assert [(one.model, str(one.out)) for one in alone.values()] == [("x/y=1", "f.csv")]
    wrong = [
        (("--model", "b"), "left=a", "NAME=b"),
        (("--model", "left=b"), "left=a", "NAME=b"),
        (("--sensor", "uskin", "--sensor", "gelsight"), "a", "NAME=uskin"),
        (("--sensor", "left=uskin"), "a", "it has none"),
        (("--model", "right=b", "--sensor", "left=uskin"), "left=a", "left, right"),
    ]
    for words, model, text in wrong:
        with pytest.raises(ConfigError, match=text):
            live._sensors(live_options(*words, model=model))
    mock = live._sensors(live_options("--sensor", "uskin", model="left=a"))["left"]
    with pytest.raises(ConfigError, match="--sensor left="):
        live._source(mock)


def test_two_sensors_of_a_session_are_played_side_by_side_to_page_and_socket(
    tmp_path: Path,
) -> None:
    session, model = tmp_path / "s.zarr", tmp_path / "model"
    make_session(session, seconds=3.0, names=("taxels", "taxels_2"))
    write_model(model)
    given = {"model": str(model), "sensor": "uskin", "signal": "taxels", "description": ""}
    given |= {"depth": 1e-3, "preset_name": "uskin"}
    jobs = [
        SensorJob(
            name, functools.partial(live._replayed, session, stream), given, out=tmp_path / name
        )
        for name, stream in (("left", "taxels"), ("right", "taxels_2"))
    ]
    access = AccessPolicy(port=0)
    shown = [ForcesJob("uskin", "REPLAY", name=name) for name in ("left", "right")]
    received: list[dict[str, Any]] = []
    with (
        SideBySide(jobs) as sensors,
        ForcesPage(access, Folders(tmp_path / "none", BENCHES), shown) as page,
        connect(f"ws://127.0.0.1:{page.port}/forces") as program,
    ):
        felt: list[Any] = []
        sensors.begin()
        while not sensors.over:
            for name, reading, t_ns, latency, gauge in sensors.news(0.1):
                felt.append((name, t_ns, reading.force, reading.slip))
                page.add(reading, t_ns, latency, gauge, name)
        page.close()
        with contextlib.suppress(ConnectionClosed):
            while True:
                received.append(json.loads(program.recv(timeout=60)))
    assert len(received) == len(felt) > 200
    for message, (name, t_ns, force, slip) in zip(received, felt, strict=True):
        assert (message["finger"], message["t_ns"], message["slip"]) == (name, t_ns, slip)
        assert message["force"] == pytest.approx(force, abs=1e-4)
        assert message["half_width"] == [None] * 3
    assert {slip for *_, slip in felt} <= {"none", "incipient", "gross"}
    # Both are played by one clock, as they were recorded together.
    first = [next(t_ns for name, t_ns, *_ in felt if name == one) for one in ("left", "right")]
    recorded = [Session(session).streams[one].t_ns for one in ("taxels", "taxels_2")]
    rows = [
        np.searchsorted(t, t[0] + at - min(first)) for t, at in zip(recorded, first, strict=True)
    ]
    apart = recorded[0][rows[0]] - recorded[1][rows[1]]
    assert abs((first[0] - first[1]) - apart) < 20_000_000
    assert all("p50" in sensors.ends[name].lines[1] for name in ("left", "right"))
    for name in ("left", "right"):
        assert (tmp_path / name).read_text().count("\n") == 1 + sum(f[0] == name for f in felt)


def test_a_sensor_that_cannot_be_opened_ends_the_others(tmp_path: Path) -> None:
    model = tmp_path / "model"
    write_model(model)
    session = make_session(tmp_path / "s.zarr", seconds=0.5, names=("taxels",))
    given = {"model": str(model), "sensor": "uskin", "signal": "taxels", "description": ""}
    given |= {"depth": 1e-3, "preset_name": "uskin"}
    jobs = [
        SensorJob(name, functools.partial(live._replayed, session, stream), given)
        for name, stream in (("left", ""), ("right", "nothing"))
    ]
    with pytest.raises(SessionError, match=r"right: .*nothing; allowed: taxels"), SideBySide(jobs):
        pass


@pytest.mark.serial
def test_a_model_says_forces_of_a_mock_bench_until_ctrl_c(tmp_path: Path) -> None:
    model, out = tmp_path / "model", tmp_path / "forces.csv"
    write_model(model)
    command = [sys.executable, "-u", "-m", "tactile", "live", "--model", str(model), "--sensor"]
    process = subprocess.Popen(
        [*command, "uskin", "--out", str(out)],
        cwd=BENCHES.parent,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    )

    def hundred() -> bool:
        return out.exists() and out.read_text().count("\n") > 100

    until(lambda: process.poll() is not None or hundred(), 0.1)
    process.send_signal(signal.SIGINT)
    printed, _ = process.communicate(timeout=240)
    assert process.returncode == 0, printed
    assert "latency, frame in to force out: p50" in printed
    assert "mean absolute error compared with the true force" in printed
    with out.open() as file:
        rows = list(csv.DictReader(file))
    assert {row["contact"] for row in rows} == {"0", "1"}
    assert all(np.isfinite(float(row["Fz_N"])) for row in rows)


def write_model(folder: Path) -> None:
    """Export an untrained model of a few thousand weights."""
    import torch

    from learning.config import read_settings
    from learning.data.presses import AUTHORS
    from learning.force.export import export_onnx
    from learning.force.model import ForceModel
    from learning.force.train import PRESETS, ForceModelSettings

    settings = read_settings(ForceModelSettings, PRESETS, "tiny", [])
    torch.manual_seed(0)
    model = ForceModel(settings.network, settings.input).eval()
    model.set_range(AUTHORS)
    folder.mkdir()
    export_onnx(model, folder / "model.onnx")
