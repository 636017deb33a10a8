"""Progress shows the share done and the time left, and is silent for fast work."""

from __future__ import annotations

import io

from learning.progress import Progress, duration


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


def told(stream: io.StringIO, seconds: list[float]) -> str:
    clock = iter(seconds)
    progress = Progress("frames", stream, clock=lambda: next(clock))
    for number in range(len(seconds)):
        progress(100 * (number + 1), 100 * len(seconds))
    return stream.getvalue()


def test_quick_work_says_nothing() -> None:
    assert told(io.StringIO(), [0.0, 0.5, 1.0]) == ""


def test_a_line_comes_every_ten_seconds_with_rate_and_rest() -> None:
    assert told(io.StringIO(), [0.0, 5.0, 10.0, 20.0, 25.0]) == (
        "200 of 500 frames, 20 a second, 15 s left\n400 of 500 frames, 15 a second, 7 s left\n"
    )


def test_on_a_terminal_one_line_is_rewritten_and_ended() -> None:
    text = told(Terminal(), [0.0, 5.0, 5.1, 6.0])
    assert text.startswith("\r200 of 400 frames, 20 a second, 10 s left")
    assert text.count("\r") == 1
    assert text.endswith("\n")


def test_times_are_short_to_read() -> None:
    assert [duration(s) for s in (12, 185, 7800)] == ["12 s", "3:05 min", "2:10 h"]
