"""Sensors to watch live: that of a lab bench, of a mock bench, or of a recorded session."""

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
from rig.core.errors import ConfigError
from rig.devices.camera.jpeg import frame_stamp
from rig.mock.presser import TouchedMock
from rig.mock.recorded_stream import ReplayedSensor

Times = np.ndarray


@dataclass(frozen=True, slots=True, eq=False)
class Watched:
    """Open sensor."""

    sensor: str
    """Name of the sensor."""
    stream: str
    """Name of its stream."""
    driver: Driver
    """Open driver."""
    no_contact: np.ndarray | None = None
    """Frames known to be without contact; None: the first to arrive must be."""
    begin: Callable[[], None] = lambda: None
    """Starts the presses of a mock bench; called after the frames without contact."""
    over: Callable[[], bool] = lambda: False
    """Returns True if no more frames will come."""
    check: Callable[[], None] = lambda: None
    """Raises DeviceLost if an emulator has ended."""
    shown_ns: Callable[[dict[str, Any]], int] = lambda sample: int(sample["t_ns"])
    """Returns the time of a sample for `wrench` [ns]."""
    wrench: Callable[[Times], np.ndarray] | None = None
    """Returns the true wrench (n, 6) [N, N m] at times (n,) [ns]; None if unknown."""


@contextlib.contextmanager
def lab_bench(bench: Bench, clock: Clock) -> Iterator[Watched]:
    """Open the sensor of a lab bench. Nothing moves: no connection is made to the arm.

    Raises:
        ConfigError, DeviceLost: The sensor rejects its settings or does not answer.
    """
    if bench.signal is None:
        raise ConfigError(f"{bench.sensor}: no camera and no taxels to watch")
    stream = bench.signal.name
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
    """Open the emulated sensor of a mock bench; a finger presses it once `begin` is called.

    Raises:
        ConfigError, DeviceLost: This is no mock bench, or an emulator does not start.
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
    """Open the sensor of a recorded session, played at the recorded times.

    Raises:
        SessionError, DeviceLost: The session cannot be played.
    """
    with ReplayedSensor(path, folder, clock) as source:
        no_contact = source.no_contact()
        source.play()
        yield Watched(
            source.sensor,
            source.stream,
            source.driver,
            no_contact,
            over=source.over,
            check=source.check,
            wrench=source.wrench,
        )


def _stamped(sample: dict[str, Any]) -> int:
    """Return the World's time shown by an emulated sensor; taxels are read when they are sent."""
    value = sample["value"]
    stamp = frame_stamp(value) if isinstance(value, bytes) else None
    return int(sample["t_ns"]) if stamp is None else stamp[1]
