"""Drivers and emulators of devices for tests: a constant world, opening, reading and closing."""

from collections.abc import Iterator
from contextlib import closing, contextmanager
from typing import Any, TypeVar

import numpy as np

from rig.core.driver import Driver
from rig.core.emulation import Emulator, SharedWorld
from rig.core.samples import WORLD_STATE

E = TypeVar("E", bound=Emulator)
D = TypeVar("D", bound=Driver)


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
    with closing(emulator):
        emulator.start()
        yield emulator


@contextmanager
def opening(driver: D, timeout: float = 60.0) -> Iterator[D]:
    """Open a driver and close it at the end, if it could be opened."""
    driver.open(timeout)
    with closing(driver):
        yield driver


def collect(driver: Driver, count: int) -> list[dict[str, Any]]:
    """Read until there are at least `count` samples."""
    samples: list[dict[str, Any]] = []
    while len(samples) < count:
        samples += driver.read(1.0)
    return samples
