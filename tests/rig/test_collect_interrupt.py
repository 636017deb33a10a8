"""Ctrl-C: the first requests a stop, the second forces it; ignored while the session closes."""

from __future__ import annotations

import signal
from collections.abc import Iterator

import pytest

from rig.acquire.control import Interrupted, InterruptFlag


@pytest.fixture(autouse=True)
def unheeded_hang_up() -> Iterator[None]:
    """Undo nohup, under which the tests may run."""
    before = signal.signal(signal.SIGHUP, signal.SIG_DFL)
    yield
    signal.signal(signal.SIGHUP, before)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_the_first_is_remembered_and_told_when_asked(number: signal.Signals) -> None:
    with InterruptFlag() as flag:
        flag.check()
        signal.raise_signal(number)
        assert flag.requested
        with pytest.raises(Interrupted, match=r"by the operator|terminal was closed"):
            flag.check()


def test_the_second_does_not_wait() -> None:
    with InterruptFlag():
        signal.raise_signal(signal.SIGINT)
        with pytest.raises(KeyboardInterrupt):
            signal.raise_signal(signal.SIGINT)


def test_nothing_interrupts_the_closing() -> None:
    with InterruptFlag() as flag:
        flag.ignore()
        for _ in range(3):
            signal.raise_signal(signal.SIGINT)


def test_the_handlers_before_are_back_afterwards() -> None:
    before = [signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)]
    with InterruptFlag():
        assert signal.getsignal(signal.SIGINT) != before[0]
    assert [signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)] == before


def test_a_closing_terminal_may_say_so_several_times() -> None:
    with InterruptFlag() as flag:
        for _ in range(3):
            signal.raise_signal(signal.SIGHUP)
        with pytest.raises(Interrupted, match="the terminal was closed"):
            flag.check()


def test_under_nohup_a_closed_terminal_stops_nothing() -> None:
    signal.signal(signal.SIGHUP, signal.SIG_IGN)
    with InterruptFlag() as flag:
        signal.raise_signal(signal.SIGHUP)
        flag.check()
