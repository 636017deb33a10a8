"""Process that writes or reads one store: `python -m benchmarks.recording.child JOB`.

A separate process, so that CPU time, memory and a kill concern only that store, and so that it may
run in another interpreter. The job is passed as JSON; the answer is one line of JSON on stdout.
"""

from __future__ import annotations

import contextlib
import json
import os
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from time import thread_time
from typing import Any

import numpy as np

from benchmarks.recording import stores
from benchmarks.recording.frames import HEIGHT, WIDTH, GelFrames
from benchmarks.recording.measure import cpu_seconds, spread_ms, sync_tree, tree_bytes, warm

# Number of images in a window.
WINDOW = 16
# Least number of frames to write, regardless of the time.
FEWEST = 20
RESULT = "RESULT "
_TIMEOUT = 300.0


class ChildFailed(RuntimeError):
    """Raised if a measuring process did not answer, with its last output."""


def started(module: str, words: Sequence[str], python: str = sys.executable) -> Any:
    """Start a module as a measuring process; the other interpreter finds this project by path."""
    source = str(Path(__file__).parents[2])
    environment = {**os.environ, "PYTHONPATH": source, "HF_HUB_OFFLINE": "1"}
    return subprocess.Popen(
        [python, "-m", module, *words],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env=environment,
    )


def answer(child: Any) -> dict[str, Any]:
    """Return the answer of a measuring process, which has then ended.

    Raises:
        ChildFailed: It gave none.
    """
    with contextlib.ExitStack() as stack:
        stack.callback(child.kill)
        try:
            out, err = child.communicate(timeout=_TIMEOUT)
        except subprocess.TimeoutExpired:
            raise ChildFailed(f"no answer within {_TIMEOUT:.0f} s") from None
    lines = [line for line in out.splitlines() if line.startswith(RESULT)]
    if not lines:
        last = [line for line in err.splitlines() if line.strip()][-1:]
        raise ChildFailed(last[0][:160] if last else "no output")
    return dict(json.loads(lines[-1].removeprefix(RESULT)))


def start(entry: stores.Entry, action: str, path: Path, **options: Any) -> Any:
    """Start the measuring process of a store."""
    job = {"store": entry.key, "action": action, "path": str(path), "options": options}
    return started("benchmarks.recording.child", [json.dumps(job)])


def write(entry: stores.Entry, path: Path, *, seconds: float, most_bytes: int) -> dict[str, Any]:
    """Append frames for `seconds` or until `most_bytes`, close durably; return the cost.

    The CPU time of making the frames, which takes a large part of that of storing a JPEG, is left
    out.
    """
    frames = GelFrames(decoded=entry.takes == "decoded")
    make = frames.jpeg if entry.takes == "jpeg" else frames.pixels
    nbytes = len(frames.jpeg(0)) if entry.takes == "jpeg" else HEIGHT * WIDTH * 3
    store = entry.make()
    took: list[int] = []
    making = 0.0
    cpu, began = cpu_seconds(), time.monotonic()
    appender = store.create(path)
    end = time.monotonic() + seconds
    while len(took) < FEWEST or (len(took) * nbytes < most_bytes and time.monotonic() < end):
        making -= thread_time()
        frame = make(len(took))
        making += thread_time()
        before = time.monotonic_ns()
        appender.append(frame, before)
        took.append(time.monotonic_ns() - before)
    appender.close()
    if not entry.ours:
        sync_tree(path)
    return {
        "frames": len(took),
        "seconds": time.monotonic() - began - making,
        "cpu": cpu_seconds() - cpu - making,
        "append_ms": spread_ms(took),
        "bytes": tree_bytes(path),
    }


def read(entry: stores.Entry, path: Path, *, seconds: float, seed: int) -> dict[str, Any]:
    """Read windows of 16 images at random places for `seconds`, the files in the page cache."""
    rng, store = np.random.default_rng(seed), entry.make()
    store.finish(path)
    warm(path)
    with store.reader(path) as (count, images):
        window = min(WINDOW, count)
        images(0, window)
        done, cpu, began = 0, cpu_seconds(), time.monotonic()
        while time.monotonic() - began < seconds or not done:
            first = int(rng.integers(0, count - window + 1))
            done += len(images(first, window))
        return {"frames": done, "seconds": time.monotonic() - began, "cpu": cpu_seconds() - cpu}


def decode(entry: stores.Entry, path: Path, *, seconds: float) -> dict[str, Any]:
    """Decode the JPEGs of the frames from memory: no store that keeps them can read faster."""
    import simplejpeg

    frames = GelFrames()
    jpegs = [frames.jpeg(number) for number in range(WINDOW)]
    done, cpu, began = 0, cpu_seconds(), time.monotonic()
    while time.monotonic() - began < seconds or not done:
        out = np.empty((WINDOW, HEIGHT, WIDTH, 3), np.uint8)
        for image, jpeg in zip(out, jpegs, strict=True):
            simplejpeg.decode_jpeg(jpeg, buffer=image)
        done += WINDOW
    return {"frames": done, "seconds": time.monotonic() - began, "cpu": cpu_seconds() - cpu}


def append_until_killed(entry: stores.Entry, path: Path, *, accepted: str) -> dict[str, Any]:
    """Append as fast as possible; after each accepted frame write the count into `accepted`."""
    frames = GelFrames()
    make = frames.jpeg if entry.takes == "jpeg" else frames.pixels
    fd = os.open(accepted, os.O_WRONLY | os.O_CREAT)
    appender, number = entry.make().create(path), 0
    while True:
        appender.append(make(number), time.monotonic_ns())
        number += 1
        os.pwrite(fd, number.to_bytes(8, "little"), 0)


def inspect(entry: stores.Entry, path: Path) -> dict[str, Any]:
    """Return the readable frames of a store whose writer was killed, before and after repair."""
    store = entry.make()
    found: dict[str, Any] = {"left": None, "error": ""}
    try:
        found["left"] = store.left(path)
    except Exception as error:
        # Any exception of its reader is the finding: the store does not open.
        found["error"] = f"{type(error).__name__}: {error}"[:200]
    return found | {"repaired": store.repaired(path)}


_ACTIONS = {
    "write": write,
    "read": read,
    "decode": decode,
    "kill": append_until_killed,
    "inspect": inspect,
}


def main(argv: list[str]) -> int:
    """Run the job; return 0, or 1 with the reason if the store's library is missing or fails."""
    job = json.loads(argv[1])
    entry = stores.entry(job["store"])
    try:
        found = _ACTIONS[job["action"]](entry, Path(job["path"]), **job["options"])  # type: ignore[operator]
    except ImportError as error:
        found = {"missing": f"{error.name or error} is not installed"}
    print(RESULT + json.dumps(found), flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv))
