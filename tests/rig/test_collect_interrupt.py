"""Ctrl-C: the first requests a stop, the second forces it; ignored while the session closes."""

from __future__ import annotations

import signal

import pytest

from rig.acquire.control import Interrupted, InterruptFlag


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_the_first_is_remembered_and_told_when_asked(number: signal.Signals) -> None:
    with InterruptFlag() as flag:
        flag.check()
        signal.raise_signal(number)
        assert flag.requested
        with pytest.raises(Interrupted, match="operator"):
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
