"""Part 3: wake-up latency of a loop of the rig, idle and loaded, with and without real time."""

from __future__ import annotations

import contextlib
import multiprocessing
import signal
import threading
from collections.abc import Iterator
from dataclasses import dataclass
from multiprocessing.connection import Connection

from benchmarks.recording.measure import Scale, Spread
from benchmarks.recording.steps import Steps
from rig.core.clock import SECOND_NS, Pacer, SystemClock
from rig.core.errors import ConfigError
from rig.core.realtime import enable_realtime

RATES_HZ = (40.0, 60.0, 500.0)
LOADS = ("idle", "two busy processes", "encoding thread")
_START = 0.8
_TIMEOUT = 60.0
_ENCODE_HZ = 60.0


@dataclass(frozen=True, slots=True)
class Lateness:
    """Wake-ups of one loop."""

    rate_hz: float
    load: str
    """One of `LOADS`."""
    asked: bool
    """True if real-time scheduling was requested."""
    granted: tuple[str, ...]
    """Privileges that the system granted."""
    ticks: int
    missed: int
    """Number of ticks that had passed before the loop waited for them."""
    late: Spread
    """Wake-up minus deadline [s]."""


def estimate(scale: Scale) -> float:
    """Return the expected duration of `lateness` [s]."""
    return len(LOADS) * 2 * len(RATES_HZ) * (scale.lateness + _START)


def lateness(scale: Scale, steps: Steps) -> tuple[Lateness, ...]:
    """Measure every rate under every load, with and without real-time scheduling."""
    found = []
    for load in LOADS:
        with busy_processes(2 if load == LOADS[1] else 0):
            for asked in (False, True):
                for rate_hz in RATES_HZ:
                    title = f"lateness: {rate_hz:g} Hz, {load}{', punctual' if asked else ''}"
                    steps.step(title, scale.lateness + _START)
                    found.append(_measure(rate_hz, load, asked, scale.lateness))
    return tuple(found)


@contextlib.contextmanager
def busy_processes(count: int) -> Iterator[None]:
    """Keep `count` normal-priority processes busy."""
    context = multiprocessing.get_context("spawn")
    started = [context.Process(target=_spin, daemon=True) for _ in range(count)]
    try:
        for process in started:
            process.start()
        yield
    finally:
        for process in started:
            if process.pid is not None:
                process.kill()
                process.join()
            process.close()


def loop(rate_hz: float, seconds: float) -> tuple[int, list[int]]:
    """Return the missed ticks, and the delay of each wake-up [ns], of an otherwise empty loop."""
    clock = SystemClock()
    pacer = Pacer(clock, rate_hz)
    late: list[int] = []
    while len(late) + pacer.missed < round(seconds * rate_hz):
        deadline_ns = pacer.wait()
        late.append(clock.now_ns() - deadline_ns)
    return pacer.missed, late


def _measure(rate_hz: float, load: str, asked: bool, seconds: float) -> Lateness:
    context = multiprocessing.get_context("spawn")
    ours, theirs = context.Pipe()
    process = context.Process(
        target=_run, args=(rate_hz, load == LOADS[2], asked, seconds, theirs), daemon=True
    )
    process.start()
    theirs.close()
    try:
        if not ours.poll(seconds + _TIMEOUT):
            raise ConfigError(f"lateness at {rate_hz:g} Hz: no answer")
        granted, missed, late = ours.recv()
    finally:
        ours.close()
        process.join(5.0)
        if process.is_alive():
            process.kill()
            process.join()
        process.close()
    return Lateness(rate_hz, load, asked, granted, len(late), missed, Spread.of(late))


def _run(rate_hz: float, encoding: bool, asked: bool, seconds: float, pipe: Connection) -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    given = enable_realtime() if asked else {}
    ended = threading.Event()
    thread = threading.Thread(target=_encode, args=(ended,))
    if encoding:
        thread.start()
    try:
        missed, late = loop(rate_hz, seconds)
    finally:
        ended.set()
        if encoding:
            thread.join()
    pipe.send((tuple(name for name, yes in given.items() if yes), missed, late))


def _encode(ended: threading.Event) -> None:
    """Compress sixty frames per second, as a recorder without separate processes would."""
    from benchmarks.recording.frames import GelFrames
    from recorder.store import images

    frames, pacer, number = GelFrames(), Pacer(SystemClock(), _ENCODE_HZ), 0
    while not ended.is_set():
        pacer.wait()
        images.compress(frames.pixels(number).data.cast("B"))
        number += 1


def _spin() -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    parent = multiprocessing.parent_process()
    count = 0
    while parent is None or parent.is_alive():
        for _ in range(SECOND_NS // 1000):
            count += 1
