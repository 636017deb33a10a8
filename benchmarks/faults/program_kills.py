"""Kill programs that write, recover and resume sessions, and fill disks.

Every value of a session follows from its row, so that a lost, doubled or changed row is recognised.
Accepted rows are counted in memory that the killed process shares with this one.
"""

import contextlib
import multiprocessing
import os
import random
import shutil
import signal
import subprocess
import time
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from recorder import (
    Session,
    SessionError,
    SessionWriter,
    StreamWriter,
    camera_spec,
    check,
    faults,
    force_spec,
    recover,
)

# Programs that are killed, in turn.
PROGRAMS = ("writer", "recover", "resume")
# Streams, and the rows that each gets in turn.
_STREAMS = {"camera": 1, "force": 16}
_PIXELS = (48, 48, 3)
# A program is killed within this time from its start [s].
_LONGEST = 0.25
# A disk is full within this time [s].
_FILLING = 120.0
_CONTEXT = multiprocessing.get_context("fork")
_RUN = {"t0_ns": 0, "utc": "2026-01-01T00:00:00Z", "boot_id": "b"}


class Loss(Exception):
    """Raised if accepted rows are missing or differ from those written."""


def _row(name: str, number: int) -> dict[str, Any]:
    """Return the row of a stream that follows from its number."""
    t_ns = 10**15 + number
    if name == "camera":
        # Noise, so that it cannot be compressed and a disk fills up soon.
        value = np.random.default_rng(number).integers(0, 256, _PIXELS, np.uint8)
        return {"value": value, "device_t": float(number), "t_ns": t_ns}
    return {"value": np.full(6, number + 0.5), "seq": number + 1, "status": 7, "t_ns": t_ns}


class Numbered:
    """A new session of two streams whose rows follow from their numbers."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.accepted = _CONTEXT.RawArray("q", len(_STREAMS))
        """Rows that each stream accepted, in whichever process."""
        specs = [
            camera_spec(60, height=_PIXELS[0], width=_PIXELS[1], codec="zstd"),
            force_spec(1000),
        ]
        with SessionWriter.create(path, attrs={}, streams=specs, targets={}) as session:
            session.begin_run(_RUN)

    def write(self, limit: int = 1 << 30) -> None:
        """Append rows to both streams, as fast as possible, and count those that are accepted."""
        folder = self.path / "streams"
        writers = [StreamWriter.open(folder / name, sync_interval=0.02) for name in _STREAMS]
        for _ in range(limit):
            for slot, (name, count) in enumerate(_STREAMS.items()):
                for _ in range(count):
                    row = writers[slot].append(**_row(name, writers[slot].rows))
                    self.accepted[slot] = row + 1
        for writer in writers:
            writer.close()

    def resume(self) -> None:
        """Resume the session, write some rows and close it."""
        with SessionWriter.resume(self.path) as session:
            session.begin_run(_RUN)
            self.write(limit=60)
            session.finish("complete", rate_hz=60)

    def compare(self, after: str, *, clean: bool = False, path: Path | None = None) -> None:
        """Look for every accepted row, through the reader, in this session or a copy of it.

        Loss is raised if one is missing or differs, if more rows than one in flight were added, or
        if the session is not clean although it should be.
        """
        session = Session(path or self.path)
        for name, least in zip(_STREAMS, self.accepted, strict=True):
            stream = session.streams[name]
            rows = len(stream)
            if not least <= rows <= least + 1:
                raise Loss(f"after {after}: {name}: {least} rows accepted, {rows} stored")
            columns = {key: stream.array(key) for key in stream.small}
            columns |= {"value": stream.images(slice(None))} if name == "camera" else {}
            for number in range(rows):
                for key, value in _row(name, number).items():
                    if not np.array_equal(columns[key][number], value):
                        raise Loss(f"after {after}: {name}: row {number}: {key} differs")
        if clean and (damage := faults(check(session.path, quick=True))):
            raise Loss(f"after {after}: {damage[0]}")


def killed(act: Callable[[], Any], within: float, begun: Callable[[], bool] = lambda: True) -> bool:
    """Run a program in a process and kill it; return False if it had ended before.

    It is killed after the time `within` [s], which counts from the condition `begun`.
    """
    child = _CONTEXT.Process(target=act)
    child.start()
    while not begun() and child.is_alive():
        time.sleep(0.001)
    child.join(within)
    child.kill()
    child.join()
    return child.exitcode == -signal.SIGKILL


def kill_in_turn(folder: Path, dice: random.Random, kills: Counter[str]) -> int:
    """Kill each program once on one session; return the number of accepted rows."""
    session = Numbered(folder / "s.zarr")
    within = dice.uniform(0.0, _LONGEST)
    kills["writer"] += killed(session.write, within, lambda: min(session.accepted) > 0)
    session.compare("writer")
    within = dice.uniform(0.005, _LONGEST / 4)
    kills["recover"] += killed(lambda: recover(session.path), within)
    session.compare("recover")
    kills["resume"] += killed(session.resume, dice.uniform(0.01, _LONGEST))
    session.compare("resume")
    recover(session.path)
    session.compare("recovery", clean=True)
    return sum(session.accepted)


class CannotMount(Exception):
    """Raised if no tmpfs can be mounted, with the reason."""


@contextlib.contextmanager
def tmpfs(folder: Path, megabytes: int) -> Iterator[None]:
    """Mount a disk of a few megabytes in a new folder, for the time of the context."""
    folder.mkdir()
    mount = ["mount", "-t", "tmpfs", "-o", f"size={megabytes}m", "tmpfs", str(folder)]
    try:
        subprocess.run(mount, capture_output=True, text=True, check=True)
    except OSError as error:
        raise CannotMount(str(error)) from error
    except subprocess.CalledProcessError as error:
        raise CannotMount(error.stderr.strip() or str(error)) from error
    try:
        yield
    finally:
        # Lazily: files may still be open for a moment.
        subprocess.run(["umount", "--lazy", str(folder)], check=False)


def fill_disk(folder: Path, dice: random.Random) -> int:
    """Record onto a disk until it is full, make space and recover; return the accepted rows."""
    disk, roomy, megabytes = folder / "disk", folder / "roomy.zarr", dice.randint(2, 9)
    with tmpfs(disk, megabytes):
        # Something else takes a part of the disk, so that it fills up at another moment.
        (disk / "other").write_bytes(bytes(dice.randint(0, 1 << 20)))
        session = Numbered(disk / "s.zarr")
        child = _CONTEXT.Process(target=_until_full, args=(session,))
        child.start()
        child.join(_FILLING)
        if child.exitcode != 0:
            child.kill()
            child.join()
            raise Loss(f"{megabytes} MB: the writer ended with {child.exitcode}")
        session.compare("a full disk")
        shutil.copytree(session.path, roomy)
    recover(roomy)
    session.compare("a full disk and recovery", clean=True, path=roomy)
    return sum(session.accepted)


def _until_full(session: Numbered) -> None:
    try:
        session.write()
    except (SessionError, OSError):
        os._exit(0)  # as a program that ends at its first error
    os._exit(1)
