"""Write the measurements as a Markdown page."""

from __future__ import annotations

import math
import platform
from dataclasses import dataclass, fields
from importlib import metadata
from pathlib import Path

from benchmarks.recording import criteria, motion
from benchmarks.recording.alignment import Alignment
from benchmarks.recording.feed import Fed
from benchmarks.recording.lateness import Lateness
from benchmarks.recording.load import Cameras
from benchmarks.recording.measure import FULL, QUICK, Spread
from benchmarks.recording.store_benchmark import StoreRow
from benchmarks.recording.stores import STORES
from recorder import pages
from recorder.store.layout import CHUNKS_PER_SHARD, JPEGS_PER_SHARD

# Files of the charts, in images/ next to the page.
STORES_CHART, ALIGNMENT_CHART = "recording-stores.png", "recording-alignment.png"
# LeRobot 0.4.4 on two cores in another run, for a page made without LeRobot.
QUOTED = {
    "lerobot-image": "17 frames/s, 450 KB and 101 ms CPU a frame, 144 images/s in windows",
    "lerobot-video": "26 frames/s, 4.3 KB and 44 ms CPU a frame, 208 images/s in windows, lossy",
}
# In place of our own store, if it was not measured.
_NONE = StoreRow("", "")


@dataclass(frozen=True, slots=True)
class Results:
    """Measurements of a run; None for a part that was skipped."""

    machine: str
    """Text of `machine()`."""
    quick: bool
    stores: tuple[StoreRow, ...] | None = None
    cpu: tuple[Fed, ...] | None = None
    lateness: tuple[Lateness, ...] | None = None
    cameras: tuple[Cameras, ...] | None = None
    full: tuple[Fed, ...] | None = None
    full_seconds: float = 0.0
    alignment: Alignment | None = None
    seconds: float = 0.0
    """Wall time of the run [s]."""


def machine(cores: int) -> str:
    """Return the number of cores and the versions that the numbers belong to."""
    found = ", ".join(f"{name} {_version(name)}" for name in ("zarr", "numpy", "numcodecs"))
    return f"{cores} cores, Python {platform.python_version()}, {found}"


def render(results: Results) -> str:
    """Return the page as Markdown."""
    stores = {row.key: row for row in results.stores or ()}
    asked = [one for one in results.lateness or () if one.asked]
    default = {(one.rate_hz, one.load): one for one in results.lateness or () if not one.asked}
    pairs = [(default[one.rate_hz, one.load], one) for one in asked]
    return pages.render(
        Path(__file__).with_suffix(".md"),
        **{field.name: getattr(results, field.name) for field in fields(results)}
        | {"lateness": results.lateness and pairs},
        criteria=criteria_of(results),
        goal=criteria.WINDOW_IMAGES,
        base_of=lambda row: stores.get("ours-jpeg" if "jpeg" in row.key else "ours-zstd", _NONE),
        elsewhere=QUOTED,
        checksums={entry.key: entry.checksum for entry in STORES},
        writes=(QUICK if results.quick else FULL).writes,
        kept=kept,
        granted=sorted({name for one in asked for name in one.granted}),
        jpegs=JPEGS_PER_SHARD,
        pixels=CHUNKS_PER_SHARD,
        motion=motion,
        ms=ms,
        ratio=ratio,
        stores_chart=STORES_CHART,
        alignment_chart=ALIGNMENT_CHART,
    )


def kept(row: StoreRow) -> str:
    """Return the frames that a killed writer of a store leaves, in words."""
    if not row.kills:
        return "not measured"
    if not row.survives:
        return "none"
    lost = max(kill.lost for kill in row.kills)
    return "all" if lost <= 1 else f"all but up to {lost}"


def ms(spread: Spread, digits: int = 2) -> str:
    """Return p50, p99 and maximum [ms]."""
    return " / ".join(
        f"{1e3 * value:.{digits}f}" for value in (spread.p50, spread.p99, spread.most)
    )


def ratio(first: float, second: float, form: str = ".1f") -> str:
    """Return `first` divided by `second`, or a dash if that is undefined."""
    return pages.number(first / second if second > 0 else math.nan, form, "-")


def criteria_of(results: Results) -> list[criteria.Criterion]:
    """Return the goals that this run measured, and whether it met them."""
    found: list[criteria.Criterion] = []
    if results.full is not None:
        found += criteria.of_full_load(results.full)
    if results.cameras is not None:
        found += criteria.of_cameras(results.cameras)
    if results.stores is not None:
        found += criteria.of_stores(results.stores)
    if results.alignment is not None:
        found += criteria.of_alignment(results.alignment)
    return found


def _version(name: str) -> str:
    try:
        return metadata.version(name)
    except metadata.PackageNotFoundError:
        return "?"
