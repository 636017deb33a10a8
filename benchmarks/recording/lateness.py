"""Part `lateness`: how late a loop of the rig wakes up, idle and loaded."""

from __future__ import annotations

import contextlib
import itertools
import multiprocessing
import signal
import threading
from collections.abc import Iterator
from multiprocessing.connection import Connection
from typing import Any

from benchmarks.recording.frames import GelFrames
from benchmarks.recording.measure import answer_of, spawned, spread_ms
from benchmarks.report import Page, Run, table
from recorder.store import images
from rig.core.clock import SECOND_NS, Pacer, SystemClock
from rig.core.realtime import enable_realtime

RATES_HZ = (60.0, 500.0)
BUSY, ENCODING = "two busy processes", "encoding thread"
LOADS = ("idle", BUSY, ENCODING)
_TIMEOUT = 60.0
_ENCODE_HZ = 60.0


def measure(run: Run) -> list[dict[str, Any]]:
    """Measure every rate under every load, with and without real-time scheduling."""
    seconds, rates = (0.15, RATES_HZ[-1:]) if run.quick else (3.0, RATES_HZ)
    found: list[dict[str, Any]] = []
    for load in LOADS:
        with busy_processes(2 if load == BUSY else 0):
            for realtime, rate_hz in itertools.product((False, True), rates):
                run.progress(len(found) / (2 * len(LOADS) * len(rates)))
                found.append(_measured(rate_hz, load, realtime, seconds))
    return found


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


def _measured(rate_hz: float, load: str, realtime: bool, seconds: float) -> dict[str, Any]:
    with spawned(_run, rate_hz, load == ENCODING, realtime, seconds) as pipe:
        granted, missed, late = answer_of(pipe, seconds + _TIMEOUT, f"lateness at {rate_hz:g} Hz")
    about = {"rate_hz": rate_hz, "load": load, "realtime": realtime, "granted": granted}
    return about | {"missed": missed, "late_ms": spread_ms(late)}


def _run(rate_hz: float, encoding: bool, realtime: bool, seconds: float, pipe: Connection) -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    given = enable_realtime() if realtime else {}
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
    pipe.send(([name for name, yes in given.items() if yes], missed, late))


def _encode(ended: threading.Event) -> None:
    """Compress sixty frames per second, as a recorder without separate processes would."""
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


_ABOUT = """\
The rig's `Pacer` against absolute deadlines, in a process that does nothing else; by default, and
after `enable_realtime`. A thread that compresses a frame 60 times a second is why each stream has a
process of its own.""".replace("\n", " ")


def section(values: list[dict[str, Any]], page: Page) -> str:
    """Return the table of the loops."""
    granted = sorted({name for one in values for name in one["granted"]})
    cells = {(one["load"], one["rate_hz"], one["realtime"]): one for one in values}
    lines = []
    for load, rate_hz in dict.fromkeys((one["load"], one["rate_hz"]) for one in values):
        line = [load, f"{rate_hz:g} Hz"]
        for realtime in (False, True):
            one = cells[load, rate_hz, realtime]
            late = " / ".join(f"{one['late_ms'][name]:.2f}" for name in ("p50", "p99", "most"))
            line += [late, one["missed"]]
        lines.append(line)
    head = ["load", "loop", "default: p50 / p99 / max [ms]", "missed"]
    head += ["real-time: p50 / p99 / max [ms]", "missed"]
    return "\n\n".join(
        [
            "## Wake-up of a loop",
            f"{_ABOUT} Granted: {', '.join(granted) or 'nothing'}.",
            table(head, lines),
        ]
    )
