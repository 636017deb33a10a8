"""Streams recorded from memory at their real rates, each in its own process as in the rig.

A thread takes the place of the driver's receiver: at every tick of the stream it puts a sample into
the rig's own `Inbox`. The main thread takes samples from it and appends them with the
`StreamWriter`, as `rig.acquire.stream_process` does. A sample counts as dropped if the inbox is
full and, for a camera, if its tick had passed before the receiver waited for it, because the camera
would have overwritten its buffer. Data from a socket (force, pose, taxels) wait in the kernel for
a late receiver, so they count as late.
"""

from __future__ import annotations

import multiprocessing
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
from benchmarks.recording.measure import Spread, cpu_seconds, resident_bytes, tree_bytes
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
from rig.core.errors import ConfigError
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


@dataclass(frozen=True, slots=True)
class Fed:
    """Measurements of recording one stream."""

    feed: Feed
    rows: int
    """Number of rows stored."""
    dropped: int
    """Number of frames that the receiver missed and of samples that met a full inbox."""
    late: int
    """Number of rows whose append began after the next sample was due: queued, not lost."""
    cpu_share: float
    """CPU time over wall time: 1 is a whole core."""
    append: Spread
    """Duration of one append [s]."""
    nbytes: int
    """Size on disk."""
    rss_start: int
    """Memory after a fifth of the run [bytes]."""
    rss_end: int
    """Memory at the end of the run [bytes]."""
    punctual: bool
    """True if SCHED_FIFO was granted."""
    failure: str = ""
    """Reason for an early end, if any."""


def record(feeds: Sequence[Feed], seconds: float, place: Path) -> tuple[Fed, ...]:
    """Record all feeds at the same time for `seconds`, in sessions below `place`.

    The recordings are removed afterwards.

    Raises:
        ConfigError: A process did not start.
    """
    context = multiprocessing.get_context("spawn")
    children: list[tuple[Any, Connection]] = []
    place.mkdir(parents=True)
    try:
        for number, feed in enumerate(feeds):
            ours, theirs = context.Pipe()
            path = place / f"{number}.zarr"
            process = context.Process(target=_run, args=(feed, path, theirs), daemon=True)
            process.start()
            theirs.close()
            children.append((process, ours))
        for feed, (_, pipe) in zip(feeds, children, strict=True):
            _answer(feed, pipe, _READY_TIMEOUT)
        start_ns = SystemClock().now_ns() + round(_LEAD * SECOND_NS)
        for _, pipe in children:
            pipe.send((start_ns, seconds))
        found = [
            _answer(feed, pipe, seconds + _READY_TIMEOUT)
            for feed, (_, pipe) in zip(feeds, children, strict=True)
        ]
    finally:
        for process, pipe in children:
            pipe.close()
            process.join(5.0)
            if process.is_alive():
                process.kill()
                process.join()
            process.close()
        shutil.rmtree(place, ignore_errors=True)
    return tuple(found)


def _answer(feed: Feed, pipe: Connection, timeout: float) -> Any:
    try:
        if pipe.poll(timeout):
            return pipe.recv()
    except EOFError:
        pass
    raise ConfigError(f"{feed.title}: its process ended or did not answer")


def _run(feed: Feed, path: Path, pipe: Connection) -> None:
    """Run the process of one stream."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    granted = enable_realtime()
    sample = samples(feed)
    targets = {"point": np.zeros(0, np.int16)}
    with SessionWriter.create(path, attrs={}, streams=[feed.spec()], targets=targets) as session:
        writer = StreamWriter.open(session.stream_path(feed.kind))
        try:
            pipe.send("ready")
            start_ns, seconds = pipe.recv()
            pipe.send(_feed(feed, sample, writer, start_ns, seconds, path, granted["sched_fifo"]))
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
    path: Path,
    punctual: bool,
) -> Fed:
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
    return Fed(
        feed=feed,
        rows=writer.rows,
        dropped=inbox.overflowed + (0 if buffered else pacer.missed),
        late=late,
        cpu_share=(cpu_seconds() - cpu) / wall,
        append=Spread.of(took),
        nbytes=tree_bytes(path),
        rss_start=rss_start,
        rss_end=rss_end,
        punctual=punctual,
        failure=failure,
    )


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
