"""What is watched live: the sensor of a lab bench, of a mock bench, or of a recorded session."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from rig.bench.bench import Bench
from rig.bench.stream_kinds import make_driver
from rig.core.clock import Clock
from rig.core.driver import Driver
from rig.devices.camera.jpeg import frame_stamp
from rig.mock.presser import TouchedMock
from rig.mock.recorded_stream import ReplayedSensor

Times = np.ndarray


@dataclass(frozen=True, slots=True, eq=False)
class Watched:
    """An opened sensor."""

    sensor: str
    """Its name."""
    stream: str
    """camera or taxels."""
    driver: Driver
    """Opened."""
    untouched: np.ndarray | None = None
    """Frames that are known to be without contact; None: the first that come have to be."""
    begin: Callable[[], None] = lambda: None
    """Lets happen what there is to see, where somebody has to: an untouched moment comes first."""
    over: Callable[[], bool] = lambda: False
    """Whether nothing more will come."""
    check: Callable[[], None] = lambda: None
    """Notices emulators that ended; raises DeviceLost."""
    shown_ns: Callable[[dict[str, Any]], int] = lambda sample: int(sample["t_ns"])
    """Time that `wrench` is asked for, of a sample [ns]."""
    wrench: Callable[[Times], np.ndarray] | None = None
    """Wrench (n, 6) at times (n,) [ns], where it is known [N, N m]."""


@contextlib.contextmanager
def lab_bench(bench: Bench, clock: Clock) -> Iterator[Watched]:
    """The sensor of a lab bench. Nothing moves: the arm is not even asked.

    Raises:
        ConfigError, DeviceLost: It refuses, or does not answer.
    """
    stream = _stream(bench)
    driver = make_driver(bench, stream, clock)
    driver.open(bench.preflight.timeout)
    try:
        yield Watched(bench.sensor, stream, driver)
    finally:
        driver.close()


@contextlib.contextmanager
def mock_bench(
    content: dict[str, Any], where: str, folder: Path, clock: Clock, *, rate_hz: float | None
) -> Iterator[Watched]:
    """The emulated sensor of a mock bench, which a finger presses once `begin` is called.

    Raises:
        ConfigError, DeviceLost: A bench that is none, or an emulator that does not start.
    """
    with (
        TouchedMock(content, where, folder, rate_hz=rate_hz) as mock,
        lab_bench(mock.bench, clock) as opened,
    ):
        yield Watched(
            opened.sensor,
            opened.stream,
            opened.driver,
            begin=mock.press,
            check=mock.check,
            shown_ns=_stamped,
            wrench=mock.wrench,
        )


@contextlib.contextmanager
def replayed(path: Path, folder: Path, clock: Clock) -> Iterator[Watched]:
    """The sensor of a recorded session, at the recorded times.

    Raises:
        SessionError, DeviceLost: A session that cannot be played.
    """
    with ReplayedSensor(path, folder, clock) as tape:
        untouched = tape.untouched()
        tape.play()
        yield Watched(
            tape.sensor,
            tape.stream,
            tape.driver,
            untouched,
            over=tape.over,
            check=tape.check,
            wrench=tape.wrench,
        )


def _stream(bench: Bench) -> str:
    return "camera" if bench.camera is not None else "taxels"


def _stamped(sample: dict[str, Any]) -> int:
    """When the World was as an emulated sensor shows it: taxels are read when they are sent."""
    value = sample["value"]
    stamp = frame_stamp(value) if isinstance(value, bytes) else None
    return int(sample["t_ns"]) if stamp is None else stamp[1]
