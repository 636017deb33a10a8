"""Targets that are done, or pressed again, and the live line that shows the progress."""

import io
import logging
import math
from contextlib import nullcontext
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.collecting import pressed_session

from benchmarks.fake_clock import FakeClock
from recorder import OUTCOMES
from recorder.findings import Finding
from rig.acquire.collector import CollectRequest, target_table
from rig.acquire.completed import first_open_target
from rig.acquire.plan_runner import LiveLine
from rig.acquire.stream_process import COUNTERS
from rig.acquire.streams import Streams
from rig.bench.bench import BenchFile
from rig.cli import recording
from rig.core.packaged import BENCHES
from rig.core.samples import FORCE_LATEST
from rig.mock.bench import MockBench
from tactile.__main__ import main
from trajectories import PressShear

PLAN = PressShear(3e-3, 4e-3, 0.3e-3, 1.2e-3, math.radians(30), 1e-3, points=(1,))
COMPLETE, LIMITED, INTERRUPTED, STOPPED = (
    OUTCOMES.index(name) for name in ("complete", "force_limited", "interrupted", "stopped")
)
Row = tuple[int, int, int, int]


def table(rows: list[Row]) -> dict[str, np.ndarray]:
    columns = np.array(rows, dtype=int).reshape(-1, 4).T
    return dict(zip(("target", "phase", "outcome", "run"), columns, strict=True))


def whole(target: int, run: int = 0) -> list[Row]:
    return [(target, phase, COMPLETE, run) for phase in range(4)]


@given(st.integers(0, 48))
def test_it_goes_on_after_the_targets_that_are_complete(done: int) -> None:
    rows = [row for target in range(done) for row in whole(target)]
    assert first_open_target(PLAN, table(rows), 48) == done


@given(st.integers(0, 47), st.integers(0, 3), st.sampled_from((INTERRUPTED, STOPPED)))
def test_a_target_that_broke_off_is_pressed_again(target: int, phase: int, outcome: int) -> None:
    rows = [row for before in range(target) for row in whole(before)]
    rows += [(target, before, COMPLETE, 0) for before in range(phase)]
    rows += [(target, phase, outcome, 0)]
    assert first_open_target(PLAN, table(rows), 48) == target


def test_two_halves_of_two_runs_make_no_whole_target() -> None:
    halves = [(0, 0, COMPLETE, 0), (0, 1, COMPLETE, 0), (0, 2, COMPLETE, 1), (0, 3, COMPLETE, 1)]
    assert first_open_target(PLAN, table(halves), 48) == 0
    assert first_open_target(PLAN, table(halves + whole(0, run=2)), 48) == 1


def test_a_target_interrupted_and_pressed_again_in_the_same_run_is_done() -> None:
    broken = [(0, 0, COMPLETE, 0), (0, 1, INTERRUPTED, 0)]
    assert first_open_target(PLAN, table(broken), 48) == 0
    assert first_open_target(PLAN, table(broken + whole(0)), 48) == 1
    assert first_open_target(PLAN, table(broken + broken + whole(0)), 48) == 1
    # Two broken attempts in one run make no whole target.
    first, rest = whole(0)[:2], whole(0)[2:]
    assert first_open_target(PLAN, table([*first, (0, 2, INTERRUPTED, 0), *rest]), 48) == 0
    assert first_open_target(PLAN, table([*first, *first, rest[0]]), 48) == 0


def test_a_force_limited_target_is_done() -> None:
    assert first_open_target(PLAN, table([(0, 0, LIMITED, 0), *whole(1)]), 48) == 2


def test_only_the_wanted_targets_count() -> None:
    rows = [row for target in range(8) for row in whole(target)]
    assert first_open_target(PLAN, table(rows), 8) == 8


def test_targets_are_pressed_again_in_order_before_those_that_are_open() -> None:
    request = CollectRequest(Path("s.zarr"), PLAN, 12, resume=True, again=(5, 2, 9))
    assert [target.index for target in request.to_press(8)] == [2, 5, 8, 9, 10, 11]


@pytest.mark.parametrize(
    ("targets", "switch", "control"),
    [(6, True, [0]), (240, True, [36]), (3, True, []), (6, False, [])],
)
def test_the_first_of_the_deepest_targets_is_pressed_again_at_the_end(
    targets: int, switch: bool, control: list[int]
) -> None:
    bench = replace(BenchFile.read(BENCHES / "gelsight.yaml").bench, control_press=switch)
    request = CollectRequest.of(bench, Path("s.zarr"), targets=targets)
    again = request.to_press(2)[targets - 2 :]
    every = list(request.plan.targets())
    assert list(again) == [replace(every[index], index=targets) for index in control]
    table = target_table(request.plan, targets, bench, request.control)
    assert table.pop("control").tolist() == [-1] * targets + control
    for column in table.values():
        np.testing.assert_array_equal(column[targets:], column[control])


def test_again_presses_targets_of_a_complete_session_though_nothing_is_open(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    pressed: list[int] = []

    class Idle:
        """A collector that records nothing."""

        def __init__(self, *_: object) -> None:
            pass

        def run(self, request: CollectRequest) -> int:
            pressed.extend(target.index for target in request.to_press(first=2))
            return 0

    monkeypatch.setattr(recording, "Collector", Idle)
    monkeypatch.setattr(recording, "logged_to", lambda _: nullcontext())
    monkeypatch.setattr(MockBench, "_start", lambda _: None)
    session = tmp_path / "s.zarr"
    pressed_session(session, PLAN, 2, 2, "complete", sensor="tacpalm", indenter="cone")
    resume = ["collect", "--sensor", "tacpalm", "--resume", str(session)]
    assert main(resume) == 0
    assert "complete: all 2 targets are done" in capsys.readouterr().out
    assert main([*resume, "--again", "3"]) == 2
    assert "--again: found 3; allowed: targets 1 to 2" in capsys.readouterr().err
    assert pressed == []
    assert main([*resume, "--again", "2,1"]) == 0
    assert pressed == [0, 1]


# The live line.

WHOLE = PressShear(3e-3, 4e-3, 0.3e-3, 1.2e-3, math.radians(30), 1e-3)


class FakeStreams:
    record = np.zeros(1, FORCE_LATEST)[0]
    record["value"][2] = -2.413
    _gauges, _handles = ("force",), {"force": SimpleNamespace(latest=lambda: FakeStreams.record)}
    pressing = Streams.pressing
    bench = SimpleNamespace(tip=lambda pose: pose, dome_radius=None)

    def __init__(self, clock: FakeClock) -> None:
        self.clock = clock

    def __getitem__(self, _: str) -> SimpleNamespace:
        return SimpleNamespace(latest=lambda: {"value": (0.0, 0.0, -0.84e-3)})

    def counters(self) -> dict[str, np.void]:
        count = np.zeros(1, COUNTERS)[0]
        count["rate_hz"], count["dropped"] = 59.9, 2
        return {"camera": count}


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


def live(out: Any, *, begun: bool = True, **options: Any) -> tuple[LiveLine, FakeClock]:
    """Return a live line on a clock of its own; `begun`: it is at the first target."""
    clock = FakeClock()
    streams: Any = FakeStreams(clock)
    line = LiveLine(streams, [2.0] * len(WHOLE), out=out, **options)
    if begun:
        line.at(next(WHOLE.targets()), None)
    return line, clock


@pytest.mark.parametrize(("columns", "has_rates"), [("200", True), ("80", False), ("40", False)])
def test_the_line_says_all_that_fits_into_one_row(
    columns: str, has_rates: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", columns)
    monkeypatch.setenv("NO_COLOR", "1")
    out, targets = Terminal(), list(WHOLE.targets())
    line, clock = live(out)
    for target in targets[:37]:
        line.at(target, WHOLE.moves(target)[1])
        clock.advance(1.0)
    line.tick()
    text = out.getvalue().removeprefix("\r").removesuffix("\x1b[K")
    # The depth is the measured one, beside that of the target.
    parts = ["target 37/240", "shear_inc ", "0.84 of 1.20 mm", "Fz  -2.41 N", "lost 2"]
    # 36 targets of 1 s, and 3 by the plan, which says 2 s; 203 remain.
    parts += ["3:39 min left", "camera 60 Hz"]
    assert "  ".join(parts).startswith(text)
    assert len(text) < int(columns)
    assert text.endswith("camera 60 Hz") == has_rates
    assert ("left" in text) == (columns != "40")
    line.end()
    assert out.getvalue().endswith("\n")


def test_the_remaining_time_is_known_from_the_first_second_and_falls() -> None:
    line, clock = live(Terminal(), begun=False)
    # No target has begun: 240 targets of 2 s by the plan.
    assert line.progress() == {"left": 480.0}
    left = []
    for target in WHOLE.targets():
        line.at(target, None)
        # Each takes a quarter longer, and one is held up for a minute.
        for _ in range(240 if target.index == 20 else 10):
            left.append(line.progress()["left"])
            clock.advance(0.25)
        if target.index == 30:
            line.waiting("paused by the page")
            clock.advance(600.0)
            line.waited()
    assert left[0] == 480.0
    assert all(later <= before for before, later in pairwise(left))
    assert left[31 * 10 + 230] == pytest.approx(2.5 * 209, rel=0.2)
    assert left[-1] < 3.0


def test_a_run_that_takes_twice_as_long_says_so() -> None:
    line, clock = live(Terminal(), begun=False)
    for target in list(WHOLE.targets())[:60]:
        line.at(target, None)
        clock.advance(4.0)
    assert line.progress()["left"] == pytest.approx(4.0 * 180, rel=0.2)


def test_a_resumed_run_counts_its_own_targets_only() -> None:
    order = [3, *range(200, len(WHOLE))]
    line, clock = live(Terminal(), begun=False, pressing=order)
    assert line.progress() == {"left": 82.0}
    line.at(list(WHOLE.targets())[200], None)
    clock.advance(1.0)
    assert line.progress()["left"] == 79.0


def test_a_doubt_is_said_once_and_a_control_press_is_no_target(
    caplog: pytest.LogCaptureFixture,
) -> None:
    found = [Finding("dark", "streams/camera", "row 3")]
    order = [*range(len(WHOLE)), len(WHOLE)]
    line, _ = live(Terminal(), pressing=order, new=lambda: [found.pop() for _ in found[:]])
    first = next(WHOLE.targets())
    for target in (first, replace(first, index=len(WHOLE))):
        line.at(target, None)
        line.ended(target, "done")
    assert [record.message.split()[0] for record in caplog.records] == ["dark"]
    progress = line.progress()
    assert (progress["target"], progress["ended"]) == (-1, {0: "done"})
    assert 1.0 < progress["left"] <= 2.0
    assert [each.code for each in progress["doubts"]] == ["dark"]


def test_a_terminal_that_is_gone_does_not_stop_the_arm(caplog: pytest.LogCaptureFixture) -> None:
    class Gone(Terminal):
        def write(self, text: str) -> int:
            raise OSError(5, "Input/output error")

    line, clock = live(Gone())
    with caplog.at_level(logging.INFO):
        line.tick()
        clock.advance(11.0)
        line.tick()
        line.end()
    assert len(caplog.records) == 1


def test_it_is_not_rewritten_faster_than_anybody_reads() -> None:
    out = Terminal()
    line, clock = live(out)
    for _ in range(100):
        line.tick()
        clock.advance(0.01)
    assert 4 <= out.getvalue().count("\r") <= 6


def test_without_a_terminal_it_is_a_log_line_every_ten_seconds(
    caplog: pytest.LogCaptureFixture,
) -> None:
    out = io.StringIO()
    line, clock = live(out)
    with caplog.at_level(logging.INFO):
        for _ in range(301):
            line.tick()
            clock.advance(0.1)
    assert out.getvalue() == ""
    assert len(caplog.records) == 4
