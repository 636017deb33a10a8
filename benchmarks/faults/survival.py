"""`python -m benchmarks survival`: kill programs that write, recover and resume; fill disks.

Every value of a session follows from its row, so that a lost, doubled or changed row is recognised.
Accepted rows are counted in memory that the killed process shares with this one.
"""

from __future__ import annotations

import argparse
import mmap
import multiprocessing
import os
import random
import shutil
import signal
import tempfile
import time
from collections import Counter
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.faults.disk import tmpfs
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
from recorder.command_line.errors import EXIT_DONE
from recorder.command_line.options import whole

# Programs that are killed, in turn.
PROGRAMS = ("writer", "recover", "resume")
_STREAMS = ("camera", "force")
_PIXELS = (48, 48, 3)
# A program is killed within this time from its start [s].
_LONGEST = 0.25
_CONTEXT = multiprocessing.get_context("fork")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of the command."""
    parser.description = (
        "Kills (SIGKILL, at random moments) programs that write, recover and resume sessions, and "
        "records onto disks until they are full. Exit code 1 if any accepted row is lost, doubled "
        "or changed, or a recovered session is not clean. Full disks need root, for a tmpfs."
    )
    parser.add_argument("--kills", type=whole(0), default=100, help="of each program (%(default)s)")
    parser.add_argument("--disks", type=whole(0), default=20, help="full disks (%(default)s)")
    parser.add_argument("--seed", type=int, default=0, help="random seed (%(default)s)")


def run(options: argparse.Namespace) -> int:
    """Kill, fill and print the counts; return 0, or 1 if anything was lost."""
    dice = random.Random(options.seed)
    wrong: list[str] = []
    killed: Counter[str] = Counter()
    rows = 0
    while (least := min(killed[name] for name in PROGRAMS)) < options.kills:
        rows += _in_scratch(partial(_chain, dice=dice, killed=killed), wrong)
        if (least + 1) % 25 == 0:
            print(f"{least + 1} chains of kills", flush=True)
    for number in range(options.disks):
        megabytes = dice.randint(2, 9)
        rows += _in_scratch(partial(_fill, megabytes=megabytes, dice=dice), wrong)
        print(f"full disk {number + 1}: {megabytes} MB", flush=True)
    kills = ", ".join(f"{killed[name]} of {name}" for name in PROGRAMS)
    for line in wrong:
        print(f"FAILED: {line}")
    print(f"kills: {kills}; full disks: {options.disks}; {rows:,} accepted rows looked for")
    print("nothing was lost" if not wrong else f"{len(wrong)} failures")
    return 1 if wrong else EXIT_DONE


def _in_scratch(act: Callable[[Path], int], wrong: list[str]) -> int:
    with tempfile.TemporaryDirectory(prefix="tactile-rig-survival-") as folder:
        try:
            return act(Path(folder))
        except (SessionError, Loss) as error:
            wrong.append(str(error))
            return 0


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


def _create(path: Path) -> None:
    specs = [camera_spec(60, height=_PIXELS[0], width=_PIXELS[1], codec="zstd"), force_spec(1000)]
    with SessionWriter.create(path, attrs={}, streams=specs, targets={}) as session:
        session.begin_run({"t0_ns": 0, "utc": "2026-01-01T00:00:00Z", "boot_id": "b"})


def _write(path: Path, accepted: mmap.mmap, limit: int = 1 << 30) -> None:
    """Append rows to both streams, as fast as possible, and count those that are accepted."""
    writers = [StreamWriter.open(path / "streams" / n, sync_interval=0.02) for n in _STREAMS]
    for _ in range(limit):
        for slot, (name, writer) in enumerate(zip(_STREAMS, writers, strict=True)):
            for _ in range(1 if name == "camera" else 16):
                row = writer.append(**_row(name, writer.rows))
                accepted[8 * slot : 8 * slot + 8] = (row + 1).to_bytes(8, "little")
    for writer in writers:
        writer.close()


def _resume(path: Path, accepted: mmap.mmap) -> None:
    with SessionWriter.resume(path) as session:
        session.begin_run({"t0_ns": 0, "utc": "2026-01-01T00:00:00Z", "boot_id": "b"})
        _write(path, accepted, limit=60)
        session.finish("complete", rate_hz=60)


def _killed(
    act: Callable[..., Any], *args: Any, within: float, begun: Callable[[], bool] | None = None
) -> bool:
    """Run a program in a process of its own and kill it; return False if it had ended before.

    Args:
        act: The program.
        args: Its arguments.
        within: Time until it is killed [s].
        begun: Condition from which this time counts; None counts it from the start.
    """
    child = _CONTEXT.Process(target=act, args=args)
    child.start()
    while begun is not None and not begun() and child.is_alive():
        time.sleep(0.001)
    time.sleep(within)
    os.kill(child.pid or 0, signal.SIGKILL)
    child.join()
    return child.exitcode == -signal.SIGKILL


def _chain(folder: Path, dice: random.Random, killed: Counter[str]) -> int:
    """Kill each program once on one session; return the number of accepted rows."""
    path, accepted = folder / "s.zarr", mmap.mmap(-1, 8 * len(_STREAMS))
    _create(path)
    killed["writer"] += _killed(
        *(_write, path, accepted),
        within=dice.uniform(0.0, _LONGEST),
        begun=lambda: min(_counted(accepted)) > 0,
    )
    _look(path, accepted, "writer")
    killed["recover"] += _killed(recover, path, within=dice.uniform(0.005, _LONGEST / 4))
    _look(path, accepted, "recover")
    killed["resume"] += _killed(_resume, path, accepted, within=dice.uniform(0.01, _LONGEST))
    _look(path, accepted, "resume")
    recover(path)
    _look(path, accepted, "recovery", clean=True)
    return sum(_counted(accepted))


def _counted(accepted: mmap.mmap) -> list[int]:
    return [int.from_bytes(accepted[8 * k : 8 * k + 8], "little") for k in range(len(_STREAMS))]


def _look(path: Path, accepted: mmap.mmap, after: str, *, clean: bool = False) -> None:
    """Look for every accepted row, through the reader.

    Raises:
        Loss: One is missing or differs, more rows than one in flight were added, or the session
            is not clean although it should be.
    """
    session = Session(path)
    for name, least in zip(_STREAMS, _counted(accepted), strict=True):
        stream = session.streams[name]
        found = len(stream)
        if not least <= found <= least + 1:
            raise Loss(f"after {after}: {name}: {least} rows accepted, {found} found")
        columns = {key: stream.array(key) for key in stream.small}
        columns |= {"value": stream.images(slice(None))} if name == "camera" else {}
        for number in range(found):
            for key, value in _row(name, number).items():
                if not np.array_equal(columns[key][number], value):
                    raise Loss(f"after {after}: {name}: row {number}: {key} differs")
    if clean and (damage := faults(check(path, quick=True))):
        raise Loss(f"after {after}: {damage[0]}")


def _fill(folder: Path, megabytes: int, dice: random.Random) -> int:
    """Record onto a disk until it is full, make space and recover; return the accepted rows."""
    disk, accepted = folder / "disk", mmap.mmap(-1, 8 * len(_STREAMS))
    disk.mkdir()
    with tmpfs(disk, megabytes):
        # Something else takes a part of the disk, so that it fills up at another moment.
        (disk / "other").write_bytes(bytes(dice.randint(0, 1 << 20)))
        _create(disk / "s.zarr")
        child = _CONTEXT.Process(target=_until_full, args=(disk / "s.zarr", accepted))
        child.start()
        child.join(120)
        if child.exitcode != 0:
            child.kill()
            child.join()
            raise Loss(f"{megabytes} MB: the writer ended with {child.exitcode}")
        _look(disk / "s.zarr", accepted, "a full disk")
        shutil.copytree(disk / "s.zarr", folder / "roomy.zarr")
    recover(folder / "roomy.zarr")
    _look(folder / "roomy.zarr", accepted, "a full disk and recovery", clean=True)
    return sum(_counted(accepted))


def _until_full(path: Path, accepted: mmap.mmap) -> None:
    try:
        _write(path, accepted)
    except (SessionError, OSError):
        os._exit(0)  # as a program that ends at its first error
    os._exit(1)
