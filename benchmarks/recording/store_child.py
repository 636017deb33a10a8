"""Process that writes or reads one store: `python -m benchmarks.recording.store_child JOB`.

A separate process, so that CPU time, memory and a kill concern only that store, and so that it may
run in another interpreter. The job is passed as JSON; the answer is one line of JSON on stdout.
"""

from __future__ import annotations

import json
import os
import sys
from pathlib import Path
from time import thread_time
from typing import Any

import numpy as np
import simplejpeg

from benchmarks.recording import parts, stores
from benchmarks.recording.frames import HEIGHT, WIDTH, GelFrames
from benchmarks.recording.measure import cpu_seconds, sync_tree, tree_bytes, warm
from rig.core.clock import SECOND_NS, SystemClock

# Number of images in a window.
WINDOW = 16
# Minimum number of frames to write, regardless of the time.
FEWEST = 20
# Prefix of the line with the answer.
RESULT = "RESULT "


def write(entry: stores.Entry, path: Path, *, seconds: float, most_bytes: int) -> dict[str, Any]:
    """Append frames for `seconds` or until `most_bytes`, close durably; return the cost.

    The CPU time of making the frames, which takes a large part of that of storing a JPEG, is left
    out.
    """
    clock, frames = SystemClock(), GelFrames(decoded=entry.takes == "decoded")
    make = frames.jpeg if entry.takes == "jpeg" else frames.pixels
    nbytes = len(frames.jpeg(0)) if entry.takes == "jpeg" else HEIGHT * WIDTH * 3
    store = entry.make()
    took: list[int] = []
    making = 0.0
    cpu, start = cpu_seconds(), clock.now_ns()
    appender = store.create(path)
    end = clock.now_ns() + round(seconds * SECOND_NS)
    while len(took) < FEWEST or (len(took) * nbytes < most_bytes and clock.now_ns() < end):
        making -= thread_time()
        frame = make(len(took))
        making += thread_time()
        before = clock.now_ns()
        appender.append(frame, before)
        took.append(clock.now_ns() - before)
    appender.close()
    sync_tree(path)
    return {
        "seconds": (clock.now_ns() - start) / SECOND_NS,
        "cpu": cpu_seconds() - cpu - making,
        "took_ns": took,
        "bytes": tree_bytes(path),
        "frame_bytes": nbytes,
    }


def read(entry: stores.Entry, path: Path, *, seconds: float, seed: int) -> dict[str, Any]:
    """Read windows of 16 images at random places for `seconds`, the files in the page cache."""
    clock, rng = SystemClock(), np.random.default_rng(seed)
    warm(path)
    with entry.make().reader(path) as (count, images):
        window = min(WINDOW, count)
        images(0, window)
        done, start, cpu = 0, clock.now_ns(), cpu_seconds()
        while clock.now_ns() - start < seconds * SECOND_NS:
            first = int(rng.integers(0, count - window + 1))
            done += len(images(first, window))
        took = clock.now_ns() - start
        return {"frames": done, "seconds": took / SECOND_NS, "cpu": cpu_seconds() - cpu}


def decode(entry: stores.Entry, path: Path, *, seconds: float) -> dict[str, Any]:
    """Decode the JPEGs of the frames from memory: no store that keeps them can read faster."""
    clock, frames = SystemClock(), GelFrames()
    jpegs = [frames.jpeg(number) for number in range(WINDOW)]
    out = np.empty((WINDOW, HEIGHT, WIDTH, 3), np.uint8)
    done, start, cpu = 0, clock.now_ns(), cpu_seconds()
    while clock.now_ns() - start < seconds * SECOND_NS:
        for image, jpeg in zip(out, jpegs, strict=True):
            simplejpeg.decode_jpeg(jpeg, buffer=image)
        done += WINDOW
    return {"frames": done, "cpu": cpu_seconds() - cpu}


def append_until_killed(entry: stores.Entry, path: Path, *, accepted: str) -> dict[str, Any]:
    """Append as fast as possible; after each accepted frame write the count into `accepted`."""
    frames = GelFrames()
    make = frames.jpeg if entry.takes == "jpeg" else frames.pixels
    fd = os.open(accepted, os.O_WRONLY | os.O_CREAT)
    appender, clock, number = entry.make().create(path), SystemClock(), 0
    while True:
        appender.append(make(number), clock.now_ns())
        number += 1
        os.pwrite(fd, number.to_bytes(8, "little"), 0)


def inspect(entry: stores.Entry, path: Path) -> dict[str, Any]:
    """Return the readable frames of a store whose writer was killed, before and after repair."""
    store = entry.make()
    answer: dict[str, Any] = {"left": None, "error": "", "repaired": None}
    try:
        answer["left"] = store.left(path)
    except Exception as error:
        # Any exception of its reader is the finding: the store does not open.
        answer["error"] = f"{type(error).__name__}: {error}"[:200]
    answer["repaired"] = store.repaired(path)
    return answer


_ACTIONS = {
    "write": write,
    "read": read,
    "decode": decode,
    "kill": append_until_killed,
    "inspect": inspect,
    "parts": parts.measure,
}


def main(argv: list[str]) -> int:
    """Run the job; return 0, or 1 with the reason if the store's library is missing or fails."""
    job = json.loads(argv[1])
    entry = stores.entry(job["store"])
    try:
        answer = _ACTIONS[job["action"]](entry, Path(job["path"]), **job["options"])  # type: ignore[operator]
    except ImportError as error:
        answer = {"missing": error.name or str(error)}
    print(RESULT + json.dumps(answer), flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv))
