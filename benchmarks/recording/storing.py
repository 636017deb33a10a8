"""Work that is measured of one store, each in a process of its own; answers are values of JSON."""

import os
import time
from pathlib import Path
from time import thread_time
from typing import Any

import numpy as np

from benchmarks.recording.frames import GelFrames, decoded
from benchmarks.recording.measure import WINDOW, cpu_seconds, files_of, spread_ms, tree_bytes
from benchmarks.recording.stores import STORES

# Least number of frames to write, regardless of the time.
FEWEST = 20


def write(key: str, path: Path, seconds: float, most_bytes: int) -> dict[str, Any]:
    """Append frames for `seconds` or until `most_bytes`, close durably; return the cost.

    The CPU time of making the frames, which takes a large part of that of storing a JPEG, is left
    out.
    """
    entry = STORES[key]
    frames = GelFrames(decoded=entry.frames == "decoded")
    make = frames.jpeg if entry.frames == "jpeg" else frames.pixels
    nbytes = len(bytes(make(0)))
    store = entry.make()
    took: list[int] = []
    making = 0.0
    cpu, began = cpu_seconds(), time.monotonic()
    store.create(path)
    end = time.monotonic() + seconds
    while len(took) < FEWEST or (len(took) * nbytes < most_bytes and time.monotonic() < end):
        making -= thread_time()
        frame = make(len(took))
        making += thread_time()
        before = time.monotonic_ns()
        store.append(frame, before)
        took.append(time.monotonic_ns() - before)
    store.close()
    for file in [] if entry.ours else files_of(path):
        with file.open("rb") as written:
            os.fsync(written.fileno())
    return {
        "frames": len(took),
        "seconds": time.monotonic() - began - making,
        "cpu": cpu_seconds() - cpu - making,
        "append_ms": spread_ms(took),
        "bytes": tree_bytes(path),
    }


def read(key: str, path: Path, seconds: float, seed: int) -> dict[str, Any]:
    """Read windows of 16 images at random places for `seconds`, the files in the page cache.

    With the key `decoder`, the camera's JPEGs are decoded from memory: no store that keeps them
    can read faster.
    """
    if key == "decoder":
        jpegs = [GelFrames().jpeg(number) for number in range(WINDOW)]
        return _repeated(WINDOW, lambda first, count: decoded(jpegs, count), seconds, seed)
    store = STORES[key].make()
    store.finish(path)
    for file in files_of(path):
        file.read_bytes()
    with store.reader(path) as opened:
        return _repeated(*opened, seconds, seed)


def _repeated(count: int, images: Any, seconds: float, seed: int) -> dict[str, Any]:
    """Read random windows of `count` images for `seconds`; return their number and the cost."""
    rng = np.random.default_rng(seed)
    window = min(WINDOW, count)
    images(0, window)
    done, cpu, began = 0, cpu_seconds(), time.monotonic()
    while time.monotonic() - began < seconds or not done:
        done += len(images(int(rng.integers(0, count - window + 1)), window))
    return {"frames": done, "seconds": time.monotonic() - began, "cpu": cpu_seconds() - cpu}


def append_until_killed(key: str, path: Path, accepted: Path) -> dict[str, Any]:
    """Append as fast as possible; after each accepted frame write the count into `accepted`."""
    frames, store, number = GelFrames(), STORES[key].make(), 0
    make = frames.jpeg if STORES[key].frames == "jpeg" else frames.pixels
    store.create(path)
    with accepted.open("r+b", buffering=0) as count:
        while True:
            store.append(make(number), time.monotonic_ns())
            number += 1
            os.pwrite(count.fileno(), number.to_bytes(8, "little"), 0)


def inspect(key: str, path: Path) -> dict[str, Any]:
    """Return the readable frames of a store whose writer was killed, before and after repair."""
    store = STORES[key].make()
    try:
        left, error = store.left(path), ""
    except Exception as fault:
        # Any exception of its reader is the result: the store does not open.
        left, error = None, f"{type(fault).__name__}: {fault}"[:200]
    return {"left": left, "error": error, "repaired": store.repaired(path)}
