"""Part 1: our recorder and other stores, written, read and killed one after the other."""

from __future__ import annotations

import contextlib
import json
import math
import os
import shutil
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

import rig
from benchmarks.recording.measure import Scale, Spread
from benchmarks.recording.steps import Steps
from benchmarks.recording.store_child import RESULT
from benchmarks.recording.stores import STORES, Entry
from rig.core.clock import SECOND_NS, SystemClock

# The store whose CPU time is shown by part.
_OWN_JPEG = "ours-jpeg"
# Environment variable with the path of a Python that has LeRobot and torch.
INTERPRETER = "LEROBOT_PYTHON"
# Time to start an interpreter and import [s].
_START = 1.5
_TIMEOUT = 180.0
# Frames accepted before the kill: past one of our sealed shards, into the next.
_KILL_AFTER = (70, 150)
_KILL_TIMEOUT = 60.0
_POLL = 0.001


@dataclass(frozen=True, slots=True)
class Write:
    """Cost of writing."""

    frames: int
    seconds: float
    """Creating, appending and closing durably [s]."""
    cpu: float
    """CPU time used [s]."""
    append: Spread
    """Duration of one append [s]."""
    nbytes: int
    """Size of the store."""
    frame_bytes: int
    """Size of a frame as passed to the store."""


@dataclass(frozen=True, slots=True)
class Kill:
    """Content of a store after a kill -9."""

    accepted: int
    """Number of frames whose append had returned."""
    left: int | None
    """Number of correct frames that the ordinary reader finds; None if it does not open."""
    wrong: int
    """Number of frames found that nobody wrote: zeros, torn."""
    repaired: int | None
    """Number of correct frames after the store's own repair; None without one."""

    @property
    def lost(self) -> int:
        """Number of accepted frames that neither the reader nor the repair finds."""
        return self.accepted - max(self.left or 0, self.repaired or 0)


@dataclass(frozen=True, slots=True)
class StoreRow:
    """Results for one store."""

    key: str
    title: str
    missing: str = ""
    """Reason why it was not measured."""
    write: Write | None = None
    read: float = 0.0
    """Images per second in random windows of 16, one process."""
    read_cpu: float = 0.0
    """Images per second of CPU time in these windows, one process."""
    decode_cpu: float = 0.0
    """JPEGs decoded from memory per second of CPU time; 0 if the store keeps none."""
    read_two: float = 0.0
    """The same, two processes together."""
    read_failure: str = ""
    """Reason why it could not be read."""
    kills: tuple[Kill, ...] = ()
    parts: dict[str, float] = field(default_factory=dict)
    """CPU time of recording a frame by part [us]; only of our own store of JPEG frames."""

    @property
    def rate(self) -> float:
        """Frames per second written and closed; NaN if it was not measured."""
        return self.write.frames / self.write.seconds if self.write else math.nan

    @property
    def rate_cpu(self) -> float:
        """Frames written and closed per second of CPU time; NaN if it was not measured."""
        return self.write.frames / self.write.cpu if self.write else math.nan

    @property
    def survives(self) -> bool:
        """True if its reader or its repair found frames after every kill."""
        return bool(self.kills) and all(kill.lost < kill.accepted for kill in self.kills)


class ChildFailed(RuntimeError):
    """Raised if a measuring process did not answer, with its last output."""


def estimate(scale: Scale, entries: Sequence[Entry] = STORES) -> float:
    """Return the expected duration of `race` [s]."""
    return len(entries) * _row_seconds(scale)


def race(
    scale: Scale, place: Path, steps: Steps, entries: Sequence[Entry] = STORES
) -> tuple[StoreRow, ...]:
    """Measure every store in a separate folder below `place`, which is removed afterwards."""
    rows = []
    for entry in entries:
        steps.step(f"stores: {entry.title.replace('*', '')}", _row_seconds(scale))
        folder = place / entry.key
        folder.mkdir(parents=True)
        try:
            rows.append(measure(entry, scale, folder))
        finally:
            shutil.rmtree(folder)
    return tuple(rows)


def measure(entry: Entry, scale: Scale, folder: Path) -> StoreRow:
    """Measure one store: written, read by one process and by two, killed."""
    python = interpreter(entry)
    if python is None:
        return StoreRow(entry.key, entry.title, f"{INTERPRETER} is not set")
    path = folder / "store"
    try:
        options = {"seconds": scale.write, "most_bytes": scale.write_bytes}
        written = ask(python, entry, "write", path, options)
        if "missing" in written:
            extra = "not installed" if entry.foreign else "not installed: extra bench"
            return StoreRow(entry.key, entry.title, f"{written['missing']} {extra}")
        for number in range(1, scale.writes):
            again = folder / f"store-{number}"
            other = ask(python, entry, "write", again, options)
            written = min(written, other, key=lambda one: one["cpu"] / len(one["took_ns"]))
            shutil.rmtree(again) if again.is_dir() else again.unlink()
        took = written["took_ns"]
        write = Write(
            frames=len(took),
            seconds=written["seconds"],
            cpu=written["cpu"],
            append=Spread.of(took),
            nbytes=written["bytes"],
            frame_bytes=written["frame_bytes"],
        )
        kills: tuple[Kill, ...] = ()
        if not entry.lossy:
            kills = tuple(kill(python, entry, folder, seed) for seed in range(scale.kills))
    except ChildFailed as error:
        return StoreRow(entry.key, entry.title, f"failed: {error}")
    try:
        read, read_cpu = _read(python, entry, path, scale.read, processes=1)
        read_two, _ = _read(python, entry, path, scale.read, processes=2)
        decode_cpu, parts = 0.0, {}
        if entry.key == _OWN_JPEG:
            options = {"frames": len(took)}
            found = [ask(python, entry, "parts", folder / f"parts-{n}", options) for n in range(3)]
            parts = min(found, key=lambda one: sum(one.values()))
        if entry.takes == "jpeg":
            decoded = ask(python, entry, "decode", path, {"seconds": scale.read})
            decode_cpu = decoded["frames"] / decoded["cpu"]
    except ChildFailed as error:
        failure = str(error)
        return StoreRow(entry.key, entry.title, write=write, kills=kills, read_failure=failure)
    return StoreRow(
        entry.key,
        entry.title,
        write=write,
        read=read,
        read_cpu=read_cpu,
        decode_cpu=decode_cpu,
        read_two=read_two,
        kills=kills,
        parts=parts,
    )


def interpreter(entry: Entry) -> str | None:
    """Return the Python that measures a store; None if it needs another that is not set."""
    return os.environ.get(INTERPRETER) or None if entry.foreign else sys.executable


def kill(python: str, entry: Entry, folder: Path, seed: int) -> Kill:
    """Kill a writer with SIGKILL at a random time and count the remaining frames.

    Raises:
        ChildFailed: It ended by itself, or the result could not be inspected.
    """
    clock, rng = SystemClock(), np.random.default_rng(seed)
    path, count = folder / f"killed-{seed}", folder / f"accepted-{seed}"
    count.write_bytes(bytes(8))
    wanted = int(rng.integers(*_KILL_AFTER))
    child = _start(python, entry, "kill", path, {"accepted": str(count)})
    deadline = clock.now_ns() + round(_KILL_TIMEOUT * SECOND_NS)
    try:
        while _accepted(count) < wanted and child.poll() is None and clock.now_ns() < deadline:
            clock.sleep_until(clock.now_ns() + round(_POLL * SECOND_NS))
        if child.poll() is not None:
            raise ChildFailed(_last_words(child.communicate()[1]))
        clock.sleep_until(clock.now_ns() + int(rng.integers(0, SECOND_NS // 200)))
    finally:
        child.kill()
        child.communicate()
    accepted = _accepted(count)
    found = ask(python, entry, "inspect", path, {})
    left, repaired = found["left"], found["repaired"]
    return Kill(
        accepted=accepted,
        left=None if left is None else len(_right(left, accepted)),
        wrong=0 if left is None else _wrong(left),
        repaired=None if repaired is None else len(_right(repaired, accepted)),
    )


def ask(
    python: str, entry: Entry, action: str, path: Path, options: dict[str, Any]
) -> dict[str, Any]:
    """Run an action in a measuring process and return its answer.

    Raises:
        ChildFailed: It did not answer.
    """
    return _answer(_start(python, entry, action, path, options))


def _right(numbers: list[int | None], accepted: int) -> list[int]:
    """Return the frames that are in their place and whose append had returned."""
    return [n for place, n in enumerate(numbers) if n == place and place < accepted]


def _wrong(numbers: list[int | None]) -> int:
    return sum(n != place for place, n in enumerate(numbers))


def _accepted(count: Path) -> int:
    return int.from_bytes(count.read_bytes(), "little")


def _read(
    python: str, entry: Entry, path: Path, seconds: float, *, processes: int
) -> tuple[float, float]:
    """Return images per second of all processes together, and per second of CPU time."""
    children = []
    try:
        for seed in range(processes):
            options = {"seconds": seconds, "seed": seed}
            children.append(_start(python, entry, "read", path, options))
        answers = [_answer(child) for child in children]
    finally:
        for child in children:
            child.kill()
            child.communicate()
    images = sum(answer["frames"] for answer in answers)
    rate = sum(answer["frames"] / answer["seconds"] for answer in answers)
    return float(rate), float(images / sum(answer["cpu"] for answer in answers))


def _start(
    python: str, entry: Entry, action: str, path: Path, options: dict[str, Any]
) -> subprocess.Popen[str]:
    job = {"store": entry.key, "action": action, "path": str(path), "options": options}
    # The other interpreter has LeRobot but not this project, which it finds by path.
    source = str(Path(rig.__file__).parent.parent)
    environment = {**os.environ, "PYTHONPATH": source, "HF_HUB_OFFLINE": "1"}
    return subprocess.Popen(
        [python, "-m", "benchmarks.recording.store_child", json.dumps(job)],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env=environment,
    )


def _answer(child: subprocess.Popen[str]) -> dict[str, Any]:
    with contextlib.ExitStack() as stack:
        stack.callback(child.kill)
        try:
            out, err = child.communicate(timeout=_TIMEOUT)
        except subprocess.TimeoutExpired:
            raise ChildFailed(f"no answer within {_TIMEOUT:.0f} s") from None
    lines = [line for line in out.splitlines() if line.startswith(RESULT)]
    if not lines:
        raise ChildFailed(_last_words(err))
    answer: dict[str, Any] = json.loads(lines[-1].removeprefix(RESULT))
    return answer


def _last_words(stderr: str) -> str:
    lines = [line for line in stderr.splitlines() if line.strip()]
    return lines[-1][:160] if lines else "no output"


def _row_seconds(scale: Scale) -> float:
    kills = scale.kills * (2 * _START + 1.0)
    return scale.writes * (_START + scale.write + 1.0) + _START + 2 * scale.read + kills
