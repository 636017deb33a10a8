"""Parts 2, 4 and 5: CPU share of each stream, maximum number of cameras, and all streams."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from benchmarks.recording.feed import Fed, Feed, record
from benchmarks.recording.measure import Scale
from benchmarks.recording.steps import Steps
from rig.core.errors import ConfigError

# Time to start and close one process [s].
_START = 1.5
# Streams measured one at a time.
SINGLE = (
    Feed("camera", 60.0, "jpeg"),
    Feed("camera", 60.0, "zstd"),
    Feed("force", 1000.0),
    Feed("pose", 500.0),
    Feed("taxels", 60.0),
)
# Streams measured at the same time.
TOGETHER = (
    Feed("camera", 60.0, "zstd"),
    Feed("camera", 60.0, "zstd"),
    Feed("force", 1000.0),
    Feed("pose", 500.0),
    Feed("taxels", 60.0),
)
CODECS = ("zstd", "jpeg")
# Approximate number of trials: doubling up to the first drop, then bisecting.
_TRIALS = 7
# Required free disk space, relative to the data to be written.
_FREE = 1.5


@dataclass(frozen=True, slots=True)
class LoadTest:
    """Result of recording a number of cameras at once."""

    cameras: int
    dropped: int
    """Number of frames lost, over all cameras."""
    late: int
    """Number of appends that began after the next frame was due."""
    cpu_share: float
    """CPU share of all cameras: 1 is a whole core."""
    append_p99: float
    """The worst camera's p99 append time [s]."""


@dataclass(frozen=True, slots=True)
class Cameras:
    """Maximum number of cameras."""

    codec: str
    held: int
    """Largest number that lost no frame."""
    most: int
    """Largest number that may be tried."""
    trials: tuple[LoadTest, ...]


def estimate_cpu_share(scale: Scale) -> float:
    """Return the expected duration of `cpu_share` [s]."""
    return len(SINGLE) * (scale.cpu_share + _START)


def cpu_share(scale: Scale, place: Path, steps: Steps) -> tuple[Fed, ...]:
    """Record each stream separately at its real rate."""
    found: list[Fed] = []
    for number, feed in enumerate(SINGLE):
        steps.step(f"CPU share: {feed.title}", scale.cpu_share + _START)
        found += record([feed], scale.cpu_share, place / f"cpu-{number}")
    return tuple(found)


def estimate_cameras(scale: Scale) -> float:
    """Return the expected duration of `cameras` [s]."""
    return len(CODECS) * _trials(scale) * (scale.cameras + 4 * _START)


def cameras(scale: Scale, place: Path, steps: Steps) -> tuple[Cameras, ...]:
    """Record more and more 640x480 cameras at 60 Hz until a frame is lost, lossless and as JPEG."""
    found = []
    for codec in CODECS:
        trials: list[LoadTest] = []

        def attempt(count: int, codec: str = codec, trials: list[LoadTest] = trials) -> bool:
            steps.step(f"cameras: {count} at 60 Hz, {codec}", scale.cameras + 4 * _START)
            need = count * scale.cameras * 60.0 * (1.0e6 if codec == "zstd" else 1.0e5)
            _require_room(place, need)
            fed = record(
                [Feed("camera", 60.0, codec)] * count,
                scale.cameras,
                place / f"cameras-{codec}-{count}",
            )
            trials.append(load_test_of(fed))
            return trials[-1].dropped == 0

        held = largest(attempt, scale.cameras_most)
        ordered = tuple(sorted(trials, key=lambda trial: trial.cameras))
        found.append(Cameras(codec, held, scale.cameras_most, ordered))
    return tuple(found)


def load_test_of(fed: tuple[Fed, ...]) -> LoadTest:
    """Return the combined result of cameras that were recorded together."""
    return LoadTest(
        cameras=len(fed),
        dropped=sum(one.dropped for one in fed) + sum(bool(one.failure) for one in fed),
        late=sum(one.late for one in fed),
        cpu_share=sum(one.cpu_share for one in fed),
        append_p99=max(one.append.p99 for one in fed),
    )


def largest(holds: Callable[[int], bool], most: int) -> int:
    """Return the largest count from 1 to `most` that holds, by doubling and then bisecting.

    Returns 0 if not even one holds. Assumes that if a count holds, all smaller counts hold.
    """
    good, bad, count = 0, most + 1, 1
    while count <= most:
        if not holds(count):
            bad = count
            break
        good = count
        if count == most:
            break
        count = min(2 * count, most)
    while bad - good > 1:
        middle = (good + bad) // 2
        if holds(middle):
            good = middle
        else:
            bad = middle
    return good


def estimate_full(scale: Scale) -> float:
    """Return the expected duration of `full_load` [s]."""
    return scale.full_load + len(TOGETHER) * _START


def full_load(scale: Scale, place: Path, steps: Steps) -> tuple[Fed, ...]:
    """Record two lossless cameras and every other stream at the same time.

    Raises:
        ConfigError: Too little disk space.
    """
    steps.step("everything at once", estimate_full(scale))
    _require_room(place, scale.full_load * 2 * 60 * 0.8e6)
    return record(TOGETHER, scale.full_load, place / "full")


def _trials(scale: Scale) -> int:
    return min(_TRIALS, 2 * scale.cameras_most)


def _require_room(place: Path, nbytes: float) -> None:
    free = shutil.disk_usage(place).free
    if free < _FREE * nbytes:
        raise ConfigError(
            f"--scratch {place}: found {free / 1e9:.1f} GB free; "
            f"allowed: {_FREE * nbytes / 1e9:.1f} GB or more"
        )
