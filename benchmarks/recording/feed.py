"""Streams recorded from memory at their real rates, each in its own process as in the rig.

A thread takes the place of the driver's receiver: at every tick of the stream it puts a sample into
the rig's own `Inbox`. The main thread takes samples from it and appends them with the
`StreamWriter`, as `rig.acquire.stream_process` does. A sample counts as dropped if the inbox is
full and, for a camera, if its tick had passed before the receiver waited for it, because the camera
would have overwritten its buffer. Data from a socket (force, pose, taxels) wait in the kernel for
a late receiver, so they count as late.
"""

import shutil
import threading
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from multiprocessing import get_context
from pathlib import Path
from threading import Barrier
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.recording.frames import HEIGHT, WIDTH, GelFrames
from benchmarks.recording.measure import cpu_seconds, resident_bytes, spread_ms, tree_bytes
from recorder import (
    SessionError,
    SessionWriter,
    StreamSpec,
    StreamWriter,
    camera_spec,
    force_spec,
    pose_spec,
    taxels_spec,
)
from recorder.processes import Workers
from rig.core.clock import SECOND_NS, Pacer, SystemClock
from rig.core.driver import Inbox
from rig.core.realtime import enable_realtime

_READ_TIMEOUT = 0.05
# Time between the last process being ready and the first tick [s].
_LEAD = 0.3
_READY_TIMEOUT = 120.0
# Fraction of the run after which memory is first measured.
_SETTLE = 0.2
# Capacity of the drivers' inboxes [samples].
CAPACITY = {"camera": 120, "force": 60_000, "pose": 60_000, "taxels": 10_000}


@dataclass(frozen=True, slots=True)
class Feed:
    """One stream to be recorded."""

    kind: str
    """`camera`, `force`, `pose` or `taxels`."""
    rate_hz: float
    codec: str = "zstd"
    """Codec of a camera: `jpeg` or `zstd`."""

    @property
    def title(self) -> str:
        """Title of the stream on the page."""
        how = {"jpeg": ", JPEG", "zstd": ", lossless"}[self.codec] if self.kind == "camera" else ""
        return f"{self.kind}{how}, {self.rate_hz:g} Hz"

    def spec(self) -> StreamSpec:
        """Return the storage layout of the stream."""
        if self.kind == "camera":
            return camera_spec(self.rate_hz, height=HEIGHT, width=WIDTH, codec=self.codec)
        specs = {"force": force_spec, "pose": pose_spec, "taxels": taxels_spec}
        return specs[self.kind](self.rate_hz)

    def samples(self) -> Callable[[int], dict[str, Any]]:
        """Return a function that gives the columns of sample `number`, except its time."""
        rng = np.random.default_rng(0)
        if self.kind == "camera":
            frames = GelFrames()
            make = frames.jpeg if self.codec == "jpeg" else frames.pixels
            return lambda number: {"value": make(number), "device_t": float("nan")}
        values: NDArray[Any]
        if self.kind == "taxels":
            values = rng.integers(20_000, 40_000, (1024, 16, 3)).astype(np.int32)
        else:
            values = rng.normal(0.0, 1.0, (1024, 6))
        others: dict[str, Callable[[int], dict[str, Any]]] = {
            "force": lambda number: {"seq": number, "status": 0},
            "pose": lambda number: {"device_t": number / self.rate_hz, "speed_scaling": 1.0},
            "taxels": lambda number: {"device_t": number / self.rate_hz, "seq": number},
        }
        other = others[self.kind]
        return lambda number: {"value": values[number % 1024]} | other(number)


# All processes of one recording wait here until each is ready; set in each of them.
_ready: Barrier


def record(feeds: Sequence[Feed], seconds: float, place: Path) -> list[dict[str, Any]]:
    """Record all feeds at the same time for `seconds`, in sessions below `place`.

    The recordings are removed afterwards.

    Returns:
        For each stream its `title`, the `rows` stored, those `dropped` (frames that the receiver
        missed, samples that met a full inbox), those `late` (their append began after the next
        sample was due: queued, not lost), the share of a core, `cpu`, the time of an append, the
        size on the disk, and the memory after a fifth of the run and at its end [bytes].

    Raises:
        BrokenBarrierError: A process was not ready in time.
    """
    place.mkdir(parents=True)
    barrier = get_context("spawn").Barrier(len(feeds))
    try:
        with Workers(len(feeds), _begin, barrier) as workers:
            tasks = [
                workers.submit(_run, feed, place / f"{number}.zarr", seconds)
                for number, feed in enumerate(feeds)
            ]
            return [task.result() for task in tasks]
    finally:
        shutil.rmtree(place, ignore_errors=True)


def _begin(barrier: Barrier) -> None:
    global _ready
    _ready = barrier


def _run(feed: Feed, path: Path, seconds: float) -> dict[str, Any]:
    """Record one stream, in its process."""
    granted = enable_realtime()["sched_fifo"]
    sample = feed.samples()
    targets = {"point": np.zeros(0, np.int16)}
    with SessionWriter.create(path, attrs={}, streams=[feed.spec()], targets=targets) as session:
        writer = StreamWriter.open(session.stream_path(feed.kind))
        try:
            _ready.wait(_READY_TIMEOUT)
            fed = _feed(feed, sample, writer, seconds)
        finally:
            writer.close()
    return fed | {"punctual": granted, "bytes": tree_bytes(path)}


def _feed(
    feed: Feed, sample: Callable[[int], dict[str, Any]], writer: StreamWriter, seconds: float
) -> dict[str, Any]:
    clock = SystemClock()
    inbox = Inbox(clock, CAPACITY[feed.kind])
    clock.sleep_until(clock.now_ns() + round(_LEAD * SECOND_NS))
    pacer = Pacer(clock, feed.rate_hz)
    ticks = max(round(seconds * feed.rate_hz), 1)
    buffered = feed.kind != "camera"
    receiver = threading.Thread(target=_receive, args=(pacer, inbox, sample, ticks, buffered))
    cpu, began = cpu_seconds(), clock.now_ns()
    receiver.start()
    took: list[int] = []
    late, failure, rss_start = 0, "", 0
    period_ns = SECOND_NS / feed.rate_hz
    settled_ns = began + round(_SETTLE * seconds * SECOND_NS)
    while True:
        alive = receiver.is_alive()
        received = inbox.take(_READ_TIMEOUT)
        if not received and not alive:
            break
        for one in received:
            before = clock.now_ns()
            late += before - one["t_ns"] > period_ns
            if not failure:
                try:
                    writer.append(**one)
                except (OSError, SessionError) as error:
                    failure = str(error)
            took.append(clock.now_ns() - before)
            if not rss_start and before >= settled_ns:
                rss_start = resident_bytes()
    receiver.join()
    wall = (clock.now_ns() - began) / SECOND_NS
    rss_end = resident_bytes()
    writer.close()
    return {
        "title": feed.title,
        "rows": writer.rows,
        "dropped": inbox.overflowed + (0 if buffered else pacer.missed),
        "late": late,
        "cpu": (cpu_seconds() - cpu) / wall,
        "append_ms": spread_ms(took),
        "rss_start": rss_start,
        "rss_end": rss_end,
        "failure": failure,
    }


def _receive(
    pacer: Pacer, inbox: Inbox, sample: Callable[[int], dict[str, Any]], ticks: int, buffered: bool
) -> None:
    """Put one sample per tick until `ticks` have passed; if buffered, missed ticks' samples too."""
    number = waited = 0
    while waited + pacer.missed < ticks:
        pacer.wait()
        waited += 1
        due = waited + pacer.missed if buffered else waited
        while number < due:
            inbox.put(sample(number))
            number += 1
