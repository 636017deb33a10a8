"""Progress: nothing at first, then the fraction done and the time left, as a bar or as lines."""

import io
import os
import pty
import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from recorder.progress import ItemProgress, Progress, duration


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


class Clock:
    now = 100.0

    def __call__(self) -> float:
        return self.now


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> Iterator[Clock]:
    monkeypatch.setenv("TERM", "xterm")
    monkeypatch.setenv("COLUMNS", "80")
    return Clock()


def seen(stream: io.StringIO) -> str:
    """Return the text written, without codes for colours and without the bar."""
    return re.sub(r"\x1b\[[\d;]*m|[━╸╺]", "", stream.getvalue())


def test_progress_is_silent_at_first_then_a_line_every_ten_seconds(clock: Clock) -> None:
    stream = io.StringIO()
    progress = Progress("press", stream, clock=clock)
    progress(0.0)
    for second in range(25):
        clock.now = 100.0 + second
        progress(second / 100)
        progress.look()
    assert stream.getvalue().splitlines() == [
        "press: 2 %, 2 s, 1:38 min left",
        "press: 12 %, 12 s, 1:28 min left",
        "press: 22 %, 22 s, 1:18 min left",
    ]


def test_progress_draws_one_bar_on_a_terminal_and_wipes_it(clock: Clock) -> None:
    stream = Terminal()
    with Progress("[loop]", stream, clock=clock) as progress:
        progress(0.0)
        progress.look()
        assert stream.getvalue() == ""
        clock.now += 90
        progress(0.5)
        progress.look()
    assert "━" in stream.getvalue()
    assert "[loop]  50 %, 1:30 min, 1:30 min left" in seen(stream)
    assert "\x1b[?25l" not in stream.getvalue()
    assert stream.getvalue().endswith("\x1b[1A\x1b[2K")


def test_a_thread_draws_while_the_caller_computes(clock: Clock) -> None:
    stream = io.StringIO()
    with Progress("loop", stream, clock=clock):
        clock.now += 3
        while not stream.getvalue():
            pass
    assert stream.getvalue() == "loop: 3 s\n"


def test_progress_says_that_kernels_are_compiled(clock: Clock, tmp_path: Path) -> None:
    progress = Progress("press", Terminal(), kernels=tmp_path, clock=clock)
    clock.now += 3
    assert progress.line() == "press: 3 s"
    (tmp_path / "wp_contact").mkdir()
    assert progress.line() == "press: compiling kernels, once ... 3 s"
    progress(0.1)
    assert "compiling" not in progress.line()


def test_progress_that_falls_back_begins_its_estimate_anew(clock: Clock) -> None:
    progress = Progress("press", io.StringIO(), clock=clock)
    progress(0.0)
    clock.now += 100
    progress(0.9)
    progress(0.1)
    clock.now += 10
    progress(0.2)
    assert progress.line() == "press: 20 %, 110 s, 1:20 min left"


def test_a_crawl_is_not_stretched_into_an_estimate(clock: Clock) -> None:
    progress = Progress("press", io.StringIO(), clock=clock)
    progress(0.5)
    clock.now += 60
    progress(0.505)
    assert progress.line() == "press: 50 %, 60 s"


def count(stream: io.StringIO, clock: Clock, seconds: list[float]) -> str:
    progress = ItemProgress("frames", stream, clock=clock)
    for number, now in enumerate(seconds, 1):
        clock.now = now
        progress(100 * number, 100 * len(seconds))
        progress.look()
    return seen(stream)


def test_items_done_quickly_show_nothing(clock: Clock) -> None:
    assert count(io.StringIO(), clock, [0.0, 0.5, 1.0]) == ""


def test_items_have_a_rate_and_a_line_every_ten_seconds(clock: Clock) -> None:
    assert count(io.StringIO(), clock, [0.0, 5.0, 10.0, 20.0, 25.0]) == (
        "200 of 500 frames, 20 a second, 15 s left\n400 of 500 frames, 15 a second, 7 s left\n"
    )


def test_the_bar_of_items_stays_when_all_are_done(clock: Clock) -> None:
    text = count(Terminal(), clock, [0.0, 5.0, 6.0, 10.0])
    assert "200 of 400 frames, 20 a second  50 %, 5 s, 10 s left" in text
    assert text.rpartition("\x1b[2K")[2] == "400 of 400 frames, 30 a second  100 %, 10 s\n"


def test_items_can_be_counted_again(clock: Clock) -> None:
    stream = io.StringIO()
    progress = ItemProgress("frames", stream, clock=clock)
    progress(0, 10)
    progress(10, 10)
    clock.now += 100
    progress(0, 10)
    progress.look()
    assert stream.getvalue() == ""
    clock.now += 10
    progress(5, 10)
    progress.look()
    assert stream.getvalue() == "5 of 10 frames, 2 s each, 10 s left\n"


def test_ctrl_c_leaves_a_clean_terminal_and_standard_output() -> None:
    program = """
import signal, sys
from recorder.progress import Progress
try:
    with Progress("loop", sys.stderr) as progress:
        progress(0.1)
        progress._begun -= 10
        while progress._bar is None:
            pass
        print("result", flush=True)
        signal.raise_signal(signal.SIGINT)
except KeyboardInterrupt:
    print("interrupted", file=sys.stderr)
"""
    ours, theirs = pty.openpty()
    done = subprocess.run(
        [sys.executable, "-c", program],
        stdout=subprocess.PIPE,
        stderr=theirs,
        env={**os.environ, "TERM": "xterm"},
        check=True,
    )
    os.close(theirs)
    text = os.read(ours, 1 << 16).decode()
    os.close(ours)
    assert done.stdout == b"result\n"
    assert "10 %, 1" in text
    assert text.endswith("\x1b[2Kinterrupted\r\n")


def test_no_command_imports_rich_at_its_start() -> None:
    root = Path(__file__).parents[2]
    for package in ("recorder", "rig", "sim", "learning", "tactile", "trajectories"):
        for path in (root / package).rglob("*.py"):
            assert not re.search(r"^(?:from|import) rich\b", path.read_text(), re.MULTILINE), path


@pytest.mark.parametrize(
    ("seconds", "text"), [(-3, "0 s"), (12.4, "12 s"), (185, "3:05 min"), (7800, "2:10 h")]
)
def test_durations_are_said_in_the_unit_that_fits(seconds: float, text: str) -> None:
    assert duration(seconds) == text
