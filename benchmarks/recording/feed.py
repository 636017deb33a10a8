"""Streams recorded from memory at their real rates, each in its own process as in the rig.

A thread takes the place of the driver's receiver: at every tick of the stream it puts a sample into
the rig's own `Inbox`. The main thread takes samples from it and appends them with the
`StreamWriter`, as `rig.acquire.stream_process` does. A sample counts as dropped if the inbox is
full and, for a camera, if its tick had passed before the receiver waited for it, because the camera
would have overwritten its buffer. Data from a socket (force, pose, taxels) wait in the kernel for
a late receiver, so they count as late.
"""

from __future__ import annotations

import contextlib
import shutil
import signal
import threading
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.recording.frames import HEIGHT, WIDTH, GelFrames
from benchmarks.recording.measure import (
    answer_of,
    cpu_seconds,
    resident_bytes,
    spawned,
    spread_ms,
    tree_bytes,
)
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
        return {"force": force_spec, "pose": pose_spec, "taxels": taxels_spec}[self.kind](
            self.rate_hz
        )


def record(feeds: Sequence[Feed], seconds: float, place: Path) -> list[dict[str, Any]]:
    """Record all feeds at the same time for `seconds`, in sessions below `place`.

    The recordings are removed afterwards.

    Returns:
        For each stream its `title`, the `rows` stored, those `dropped` (frames that the receiver
        missed, samples that met a full inbox), those `late` (their append began after the next
        sample was due: queued, not lost), the share of a core, `cpu`, the time of an append, the
        size on the disk, and the memory after a fifth of the run and at its end [bytes].

    Raises:
        ConfigError: A process did not start.
    """
    place.mkdir(parents=True)
    with contextlib.ExitStack() as stack:
        stack.callback(shutil.rmtree, place, ignore_errors=True)
        pipes = [
            stack.enter_context(spawned(_run, feed, place / f"{number}.zarr"))
            for number, feed in enumerate(feeds)
        ]
        for feed, pipe in zip(feeds, pipes, strict=True):
            answer_of(pipe, _READY_TIMEOUT, feed.title)
        start_ns = SystemClock().now_ns() + round(_LEAD * SECOND_NS)
        for pipe in pipes:
            pipe.send((start_ns, seconds))
        return [
            answer_of(pipe, seconds + _READY_TIMEOUT, feed.title)
            for feed, pipe in zip(feeds, pipes, strict=True)
        ]


def _run(feed: Feed, path: Path, pipe: Connection) -> None:
    """Run the process of one stream."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    granted = enable_realtime()["sched_fifo"]
    sample = samples(feed)
    targets = {"point": np.zeros(0, np.int16)}
    with SessionWriter.create(path, attrs={}, streams=[feed.spec()], targets=targets) as session:
        writer = StreamWriter.open(session.stream_path(feed.kind))
        try:
            pipe.send("ready")
            start_ns, seconds = pipe.recv()
            fed = _feed(feed, sample, writer, start_ns, seconds)
            pipe.send(fed | {"punctual": granted, "bytes": tree_bytes(path)})
        except (EOFError, BrokenPipeError):
            return  # the measuring process is gone
        finally:
            writer.close()


def _feed(
    feed: Feed,
    sample: Callable[[int], dict[str, Any]],
    writer: StreamWriter,
    start_ns: int,
    seconds: float,
) -> dict[str, Any]:
    clock = SystemClock()
    inbox = Inbox(clock, CAPACITY[feed.kind])
    clock.sleep_until(start_ns)
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
        taken = inbox.take(_READ_TIMEOUT)
        if not taken and not alive:
            break
        for one in taken:
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


def samples(feed: Feed) -> Callable[[int], dict[str, Any]]:
    """Return a function that gives the columns of sample `number`, except its time."""
    rng = np.random.default_rng(0)
    nan = float("nan")
    if feed.kind == "camera":
        frames = GelFrames()
        make = frames.jpeg if feed.codec == "jpeg" else frames.pixels
        return lambda number: {"value": make(number), "device_t": nan}
    if feed.kind == "force":
        wrench = rng.normal(0.0, 1.0, (1024, 6))
        return lambda number: {"value": wrench[number % 1024], "seq": number, "status": 0}
    if feed.kind == "pose":
        poses = rng.normal(0.0, 0.1, (1024, 6))
        return lambda number: {
            "value": poses[number % 1024],
            "device_t": number / feed.rate_hz,
            "speed_scaling": 1.0,
        }
    counts = rng.integers(20_000, 40_000, (1024, 16, 3)).astype(np.int32)
    return lambda number: {
        "value": counts[number % 1024],
        "device_t": number / feed.rate_hz,
        "seq": number,
    }
