"""Summary of an archive: its size, its presses without a solution, its marker check."""

import json
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from recorder.archive import MarkerArchive, marker_flags
from sim.arrays import Progress

# Most flagged frames, and most presses without a solution, that are listed one by one.
SHOWN = 5


def summary(
    path: Path, *, check: bool = True, progress: Progress = lambda fraction: None
) -> Iterator[str]:
    """Yield the summary of a complete archive, whose markers may be counted, 1 ms an image."""
    archive = MarkerArchive(path)
    images = sum(len(sensor) for sensor in archive.values())
    size = sum(sum(each.files.sizes(each.path).values()) for each in archive.values())
    yield f"{path}: {len(archive)} sensors, {images:,} images, {size / 1e6:,.1f} MB"
    yield from _presses(archive)
    if check:
        yield from _flags(archive, images, progress)


def _presses(archive: MarkerArchive) -> Iterator[str]:
    """Yield the presses that needed other settings than requested, and those without a solution."""
    again: dict[str, None] = {}
    lost: dict[str, None] = {}
    for sensor in archive.values():
        missing = {int(row) for row in sensor.table["source"][~sensor.table["valid"]]}
        for number, line in enumerate(sensor.sources):
            source = json.loads(line)
            if "failed" not in source:
                continue
            press = f"{source['indenter']}, target {source['target']} of {sensor.name}"
            if number in missing:
                lost[f"{press}: {source['failed'][-1]}"] = None
            else:
                again[f"{press}: solved with {source.get('again', 'a costlier choice')}"] = None
    yield from _some(f"{len(again)} presses were solved again in another way", list(again))
    yield from _some(f"{len(lost)} presses have no solution, their rows are not valid", list(lost))


def _flags(archive: MarkerArchive, images: int, progress: Progress) -> Iterator[str]:
    flagged: list[str] = []
    counted = 0
    for index, sensor in enumerate(archive.values()):
        flags = marker_flags(sensor)
        if sensor.attrs.get("marker_check") is not None:
            counted += int(np.count_nonzero(sensor.table["valid"]))
        flagged += [f"{sensor.name} {flag}" for flag in flags]
        progress((index + 1) / len(archive))
    fraction = f", {1e3 * len(flagged) / counted:.2f} in 1,000" if flagged else ""
    yield f"marker count: {len(flagged)} of {counted:,} images flagged{fraction}"
    yield from _some("", flagged)
    if counted < images:
        yield f"  ({images - counted:,} images have no markers to count, or are not valid)"


def _some(title: str, lines: list[str]) -> Iterator[str]:
    if not lines:
        return
    if title:
        yield title
    yield from (f"  {line}" for line in lines[:SHOWN])
    if len(lines) > SHOWN:
        yield f"  and {len(lines) - SHOWN} more: `tactile session check`, and `sources`"
