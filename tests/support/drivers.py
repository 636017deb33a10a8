"""Drivers and emulators of devices for tests: a constant world, opening, reading and closing."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, Protocol, TypeVar

import numpy as np

from rig.core.emulation import SharedWorld
from rig.core.samples import WORLD_STATE


class _Emulator(Protocol):
    def start(self) -> None: ...
    def close(self) -> None: ...


class _Driver(Protocol):
    def open(self, timeout: float, /) -> None: ...
    def read(self, timeout: float, /) -> list[dict[str, Any]]: ...
    def close(self) -> None: ...


E = TypeVar("E", bound=_Emulator)
D = TypeVar("D", bound=_Driver)


class FixedWorld(SharedWorld):
    """A constant state with the given fields, until a test changes it."""

    def __init__(self, **fields: Any) -> None:
        super().__init__(None)
        self.record: Any = np.zeros(1, WORLD_STATE)[0]
        for name, value in fields.items():
            self.record[name] = value

    def state(self) -> tuple[int, np.void]:
        return 1, self.record


@contextmanager
def running(emulator: E) -> Iterator[E]:
    """Start an emulator and close it at the end."""
    emulator.start()
    try:
        yield emulator
    finally:
        emulator.close()


@contextmanager
def opening(driver: D, timeout: float = 60.0) -> Iterator[D]:
    """Open a driver and close it at the end."""
    driver.open(timeout)
    try:
        yield driver
    finally:
        driver.close()


def collect(driver: _Driver, count: int) -> list[dict[str, Any]]:
    """Read until there are at least `count` samples."""
    samples: list[dict[str, Any]] = []
    while len(samples) < count:
        samples += driver.read(1.0)
    return samples
