"""Format the measurements as a Markdown page."""

from __future__ import annotations

import platform
from collections.abc import Sequence
from dataclasses import dataclass
from importlib import metadata

from benchmarks.recording import criteria
from benchmarks.recording.alignment import Alignment
from benchmarks.recording.feed import Fed
from benchmarks.recording.lateness import Lateness
from benchmarks.recording.load import Cameras
from benchmarks.recording.markdown import ms, ratio, table
from benchmarks.recording.page_alignment import alignment
from benchmarks.recording.page_stores import stores
from benchmarks.recording.store_benchmark import StoreRow


@dataclass(frozen=True, slots=True)
class Results:
    """Measurements of a run; None for a part that was skipped."""

    machine: str
    """Text of `machine()`."""
    quick: bool
    stores: tuple[StoreRow, ...] | None = None
    share: tuple[Fed, ...] | None = None
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
    parts = [_head(results)]
    if results.stores is not None:
        parts.append(stores(results.stores))
    if results.share is not None:
        parts.append(_share(results.share))
    if results.lateness is not None:
        parts.append(_lateness(results.lateness))
    if results.cameras is not None:
        parts.append(_cameras(results.cameras))
    if results.full is not None:
        parts.append(_full(results.full, results.full_seconds))
    if results.alignment is not None:
        parts.append(alignment(results.alignment))
    return "\n".join(parts)


def criteria_of(results: Results) -> list[criteria.Criterion]:
    """Return the verdict on the goals that this run measured."""
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


def _head(results: Results) -> str:
    found = criteria_of(results)
    lines = [
        "# Cost of recording",
        "",
        "Made by `make bench-recorder`; run it on another machine to get that machine's numbers. "
        f"{results.machine}. The run took {results.seconds / 60:.1f} min.",
        "",
    ]
    if results.quick:
        lines += ["**A quick run: it shows that everything works; its numbers mean little.**", ""]
    if found:
        lines.append(
            table(
                ("goal", "measured", "reached"),
                [(one.text, one.measured, "yes" if one.met else "**no**") for one in found],
            )
        )
    return "\n".join(lines)


def _share(fed: Sequence[Fed]) -> str:
    return "\n".join(
        [
            "## CPU of one stream at its real rate",
            "",
            "Each by itself, from memory, in a process with the real-time settings of the rig "
            f"(SCHED_FIFO {'granted' if all(one.punctual for one in fed) else '**refused**'}); "
            "a thread takes the place of the driver's receiver.",
            "",
            _fed_table(fed),
        ]
    )


def _fed_table(fed: Sequence[Fed]) -> str:
    return table(
        (
            "stream",
            "rows",
            "dropped",
            "append began late",
            "CPU [% of a core]",
            "append p50 / p99 / max [ms]",
            "MB written",
        ),
        [
            (
                one.feed.title,
                f"{one.rows:,}",
                f"{one.dropped}",
                f"{one.late}",
                f"{100 * one.share:.1f}",
                ms(one.append, digits=3),
                f"{one.nbytes / 1e6:,.1f}",
            )
            for one in fed
        ],
    )


def _lateness(found: Sequence[Lateness]) -> str:
    granted = sorted({name for one in found if one.asked for name in one.granted})
    refused = not any("sched_fifo" in one.granted for one in found if one.asked)
    message = f"granted: {', '.join(granted) or 'nothing'}"
    plain = {(one.rate_hz, one.load): one for one in found if not one.asked}
    rows = []
    for one in found:
        if one.asked:
            other = plain[one.rate_hz, one.load]
            rows.append(
                (
                    one.load,
                    f"{one.rate_hz:g} Hz",
                    ms(other.late, digits=3),
                    f"{other.missed}",
                    ms(one.late, digits=3),
                    f"{one.missed}",
                    ratio(other.late.p99, one.late.p99),
                )
            )
    return "\n".join(
        [
            "## Wake-up latency of a loop",
            "",
            "The rig's `Pacer` against absolute deadlines, in a process that does nothing else; by "
            f"default, and after `enable_realtime` ({message}). Loaded by two busy processes, or "
            "by another thread that compresses a frame 60 times a second, which is why "
            "each stream has its own process.",
            ""
            if not refused
            else "\n**SCHED_FIFO was refused: the tail is due to the operating system.**\n",
            table(
                (
                    "load",
                    "loop",
                    "default: p50 / p99 / max [ms]",
                    "missed",
                    "real-time: p50 / p99 / max [ms]",
                    "missed",
                    "p99 default : real-time",
                ),
                rows,
            ),
        ]
    )


def _cameras(found: Sequence[Cameras]) -> str:
    lines = [
        "## Number of cameras",
        "",
        "640x480 at 60 Hz, each in its own process with the rig's inbox of 120 frames. A frame is "
        "dropped if the inbox was full, or if its tick had passed before the receiver waited for "
        "it (the camera would have overwritten its buffer). A frame whose append began after the "
        "next was due is late: it waited in the inbox.",
        "",
    ]
    for one in found:
        name = {"zstd": "lossless", "jpeg": "as the camera's JPEG"}[one.codec]
        held = f"{one.held}" if one.held < one.most else f"{one.held} (no more were tried)"
        lines += [f"**{held}** {name} without a drop.", ""]
        lines.append(
            table(
                ("cameras", "dropped", "late", "CPU [% of a core]", "append p99, worst [ms]"),
                [
                    (
                        f"{trial.cameras}",
                        f"{trial.dropped}",
                        f"{trial.late}",
                        f"{100 * trial.share:.0f}",
                        f"{1e3 * trial.append_p99:.2f}",
                    )
                    for trial in one.trials
                ],
            )
        )
    return "\n".join(lines)


def _full(fed: Sequence[Fed], seconds: float) -> str:
    start, end = sum(one.rss_start for one in fed), sum(one.rss_end for one in fed)
    return "\n".join(
        [
            "## Everything at once",
            "",
            f"For {seconds:g} s: CPU {100 * sum(one.share for one in fed):.0f} % of one core, "
            f"{sum(one.nbytes for one in fed) / 1e6:,.0f} MB written, memory of all processes "
            f"{start / 1e6:.0f} MB after a fifth of the time and {end / 1e6:.0f} MB at the end "
            f"({(end - start) / 1e6:+.1f} MB).",
            "",
            _fed_table(fed),
        ]
    )


def _version(name: str) -> str:
    try:
        return metadata.version(name)
    except metadata.PackageNotFoundError:
        return "?"
