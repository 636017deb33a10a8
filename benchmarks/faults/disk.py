"""Disk that fills up during a recording: a small tmpfs, which only root can mount."""

from __future__ import annotations

import contextlib
import shutil
import subprocess
from collections.abc import Iterator
from pathlib import Path

from benchmarks.faults.collection_run import CollectionRun, Hangs
from benchmarks.faults.judge import FaultResult
from benchmarks.faults.one_row import judge
from benchmarks.faults.quick import quick_bench
from benchmarks.faults.rows import Row
from recorder.command_line.errors import EXIT_DEVICE_LOST
from rig.core.clock import SECOND_NS, SystemClock

# Row of the fault table, in the fields that it shares with the others.
ROW = Row("disk", "full", (EXIT_DEVICE_LOST,), None, targets=20, needs_recover=True)

_SIZE_MB = 12
# With less free space than this, the next record does not fit [bytes].
_FULL = 1 << 16
_FILLING = 60.0


class CannotMount(Exception):
    """Raised if no tmpfs can be mounted, with the reason."""


def fill_disk(folder: Path, benches: Path) -> FaultResult:
    """Record onto a tmpfs until it is full, then judge the session once there is space again.

    Args:
        folder: Empty folder, in which the disk is mounted.
        benches: Folder of the bench files.

    Raises:
        CannotMount: Not root, or tmpfs is not available.
    """
    disk = folder / "disk"
    disk.mkdir()
    bench = quick_bench(folder, ROW.sensor, benches)
    with tmpfs(disk, _SIZE_MB), CollectionRun(disk / "s.zarr", *_arguments(bench)) as collection:
        try:
            collection.until_pressing()
            collection.until(lambda: shutil.disk_usage(disk).free < _FULL, "a full disk", _FILLING)
            collection.injected_ns = SystemClock().now_ns()
            code = collection.wait()
        except Hangs as error:
            if collection.process.poll() is None:
                words = ("did not end", *str(error).splitlines()[-3:])
                return FaultResult(None, collection.last_line, None, None, 0, 0, "not known", words)
            code = collection.wait()
        collection.seen()
        # A technician would make space, then recover.
        roomy = folder / "s.zarr"
        shutil.copytree(collection.session, roomy)
        collection.session = roomy
        return judge(ROW, collection, code)


def _arguments(bench: Path) -> tuple[str, ...]:
    return ("--bench", str(bench), "--targets", str(ROW.targets))


@contextlib.contextmanager
def tmpfs(folder: Path, megabytes: int) -> Iterator[None]:
    """Mount a disk of a few megabytes in a folder, for the time of the context.

    Raises:
        CannotMount: Not root, or tmpfs is not available.
    """
    mount = ["mount", "-t", "tmpfs", "-o", f"size={megabytes}m", "tmpfs", str(folder)]
    try:
        done = subprocess.run(mount, capture_output=True, text=True, check=False)
    except OSError as error:
        raise CannotMount(str(error)) from error
    if done.returncode != 0:
        raise CannotMount(done.stderr.strip() or f"mount ended with {done.returncode}")
    try:
        yield
    finally:
        _unmount(folder)


def _unmount(folder: Path) -> None:
    """Unmount, waiting up to 2 s for files that are still open."""
    clock = SystemClock()
    for _ in range(20):
        if subprocess.run(["umount", str(folder)], capture_output=True, check=False).returncode:
            clock.sleep_until(clock.now_ns() + SECOND_NS // 10)
        else:
            return
    subprocess.run(["umount", "-l", str(folder)], capture_output=True, check=False)
