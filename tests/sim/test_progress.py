"""Progress output: nothing at first, then the share done and the time left."""

from __future__ import annotations

from pathlib import Path

import pytest

from sim.progress import Progress, duration


class _Stream:
    """A stream that may be a terminal, and the text written to it."""

    def __init__(self, *, terminal: bool) -> None:
        self.text, self._terminal = "", terminal

    def isatty(self) -> bool:
        return self._terminal

    def write(self, text: str) -> int:
        self.text += text
        return len(text)

    def flush(self) -> None:
        pass


class _Clock:
    now = 100.0

    def __call__(self) -> float:
        return self.now


@pytest.fixture
def clock() -> _Clock:
    return _Clock()


def test_progress_is_silent_at_first_then_a_line_every_ten_seconds(clock: _Clock) -> None:
    stream = _Stream(terminal=False)
    progress = Progress("press", stream, clock=clock)
    progress(0.0)
    for second in range(25):
        clock.now = 100.0 + second
        progress(second / 100)
        progress.look()
    assert stream.text.splitlines() == [
        "press: 2 %, 2 s, 1:38 min left",
        "press: 12 %, 12 s, 1:28 min left",
        "press: 22 %, 22 s, 1:18 min left",
    ]


def test_progress_rewrites_one_line_of_a_terminal_and_wipes_it(clock: _Clock) -> None:
    stream = _Stream(terminal=True)
    with Progress("loop", stream, clock=clock) as progress:
        progress(0.0)
        clock.now += 30
        progress(0.5)
        progress.look()
    assert "\rloop: 50 %, 30 s, 30 s left" in stream.text
    assert "\n" not in stream.text
    assert stream.text.endswith(" \r")


def test_progress_says_that_kernels_are_compiled(clock: _Clock, tmp_path: Path) -> None:
    progress = Progress("press", _Stream(terminal=True), kernels=tmp_path, clock=clock)
    clock.now += 3
    assert progress.line() == "press: 3 s"
    (tmp_path / "wp_contact").mkdir()
    assert progress.line() == "press: compiling kernels, once ... 3 s"
    progress(0.1)
    assert "compiling" not in progress.line()


def test_progress_that_falls_back_begins_its_estimate_anew(clock: _Clock) -> None:
    progress = Progress("press", _Stream(terminal=True), clock=clock)
    progress(0.0)
    clock.now += 100
    progress(0.9)
    progress(0.1)
    clock.now += 10
    progress(0.2)
    assert progress.line() == "press: 20 %, 110 s, 1:20 min left"


@pytest.mark.parametrize(("seconds", "text"), [(12.4, "12 s"), (185, "3:05 min"), (7800, "2:10 h")])
def test_durations_are_said_in_the_unit_that_fits(seconds: float, text: str) -> None:
    assert duration(seconds) == text


def test_a_crawl_is_not_stretched_into_an_estimate(clock: _Clock) -> None:
    progress = Progress("press", _Stream(terminal=True), clock=clock)
    progress(0.5)
    clock.now += 60
    progress(0.505)
    assert progress.line() == "press: 50 %, 60 s"
