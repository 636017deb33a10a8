"""The live line shows progress and remaining time, and is not written to a file."""

from __future__ import annotations

import io
import logging
import math
from typing import Any

import numpy as np
import pytest

from rig.acquire.plan_runner import LiveLine
from rig.acquire.stream_process import COUNTERS
from rig.acquire.streams import Streams
from rig.core.clock import FakeClock
from rig.core.samples import FORCE_LATEST
from trajectories import PressShear

PLAN = PressShear(3e-3, 4e-3, 0.3e-3, 1.2e-3, math.radians(30), 1e-3)


class FakeHandle:
    def latest(self) -> np.void:
        record = np.zeros(1, FORCE_LATEST)[0]
        record["value"][2] = -2.413
        return record


class FakeStreams:
    _gauges, _handles = ("force",), {"force": FakeHandle()}
    pressing = Streams.pressing

    def __init__(self, clock: FakeClock) -> None:
        self.clock = clock

    def counters(self) -> dict[str, np.void]:
        count = np.zeros(1, COUNTERS)[0]
        count["rate_hz"], count["dropped"] = 59.9, 2
        return {"camera": count}


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


def live(out: Any, clock: FakeClock) -> LiveLine:
    return LiveLine(FakeStreams(clock), len(PLAN), planned=2.0, out=out)  # type: ignore[arg-type]


def test_the_line_says_all_a_technician_asks() -> None:
    out, clock = Terminal(), FakeClock()
    line = live(out, clock)
    targets = list(PLAN.targets())
    line.at(targets[0], None)
    clock.advance(35.0)
    line.at(targets[36], PLAN.moves(targets[36])[1])
    line.tick()
    text = out.getvalue()
    words = ("target 37/240", "shear_inc", "1.20 mm", "Fz  -2.41 N", "dropped 2")
    for word in words:
        assert word in text
    # 36 targets in 35 s, and 2 s by the plan: 1 s each; 204 remain, including the current one.
    assert "3:24 min left" in text
    assert "\n" not in text
    line.end()
    assert out.getvalue().endswith("\n")


@pytest.mark.parametrize(("columns", "has_rates"), [("200", True), ("60", False)])
def test_the_line_stays_in_one_row_of_the_terminal(
    columns: str, has_rates: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", columns)
    out, clock = Terminal(), FakeClock()
    line = live(out, clock)
    line.at(next(PLAN.targets()), None)
    line.tick()
    text = out.getvalue().removeprefix("\r").removesuffix("\x1b[K")
    assert len(text) < int(columns)
    assert "left" in text
    assert ("camera 60 Hz" in text) == has_rates


def test_the_remaining_time_is_known_from_the_first_second_and_falls() -> None:
    clock = FakeClock()
    line = live(Terminal(), clock)
    # No target has begun: 240 targets of 2 s by the plan.
    assert line.progress() == {"left": 480.0}
    targets = list(PLAN.targets())
    left = []
    for target in targets[:4]:
        line.at(target, None)
        for _ in range(8):
            left.append(line.progress()["left"])
            clock.advance(0.5)
    # Targets take 4 s, not 2 s: the estimate grows only when one has ended.
    assert left[0] == 480.0
    assert left[1] == 479.5
    # 1 planned and 3 measured targets of 4 s give 3.5 s for each of the 237 that remain.
    assert left[24] == pytest.approx(3.5 * 237)
    line.waiting("paused by the page")
    clock.advance(60.0)
    line.waited(60_000_000_000)
    line.at(targets[4], None)
    assert line.progress()["left"] == pytest.approx((2.0 + 16.0) / 5 * 236)


def test_a_resumed_run_counts_its_own_targets_only() -> None:
    clock = FakeClock()
    streams: Any = FakeStreams(clock)
    order = [3, *range(200, len(PLAN))]
    line = LiveLine(streams, len(PLAN), planned=2.0, pressing=order, out=Terminal())
    assert line.progress() == {"left": 82.0}
    line.at(list(PLAN.targets())[200], None)
    clock.advance(1.0)
    # One of the 41 targets is done, in no time: 1 s each.
    assert line.progress()["left"] == 39.0


def test_a_terminal_that_is_gone_does_not_stop_the_arm(caplog: pytest.LogCaptureFixture) -> None:
    class Gone(Terminal):
        def write(self, text: str) -> int:
            raise OSError(5, "Input/output error")

    clock = FakeClock()
    line = live(Gone(), clock)
    line.at(next(PLAN.targets()), None)
    with caplog.at_level(logging.INFO):
        line.tick()
        clock.advance(11.0)
        line.tick()
        line.end()
    assert len(caplog.records) == 1


def test_it_is_not_rewritten_faster_than_anybody_reads() -> None:
    out, clock = Terminal(), FakeClock()
    line = live(out, clock)
    line.at(next(PLAN.targets()), None)
    for _ in range(100):
        line.tick()
        clock.advance(0.01)
    assert 4 <= out.getvalue().count("\r") <= 6


def test_without_a_terminal_it_is_a_log_line_every_ten_seconds(
    caplog: pytest.LogCaptureFixture,
) -> None:
    out, clock = io.StringIO(), FakeClock()
    line = live(out, clock)
    line.at(next(PLAN.targets()), None)
    with caplog.at_level(logging.INFO):
        for _ in range(301):
            line.tick()
            clock.advance(0.1)
    assert out.getvalue() == ""
    assert len(caplog.records) == 4
