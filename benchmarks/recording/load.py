"""Part `load`: share of a core of each stream, number of cameras, and all streams at once."""

import shutil
from pathlib import Path
from typing import Any

from benchmarks.recording.feed import Feed, record
from benchmarks.report import Page, Run, table
from rig.core.errors import ConfigError

# Streams measured one at a time, and all at once with a second camera.
SINGLE = (
    Feed("camera", 60.0, "jpeg"),
    Feed("camera", 60.0, "zstd"),
    Feed("force", 1000.0),
    Feed("pose", 500.0),
    Feed("taxels", 60.0),
)
TOGETHER = (SINGLE[1], *SINGLE[1:])
# Bytes a second of a camera, and the free space required relative to the data to be written.
_RATE = {"zstd": 60 * 1.0e6, "jpeg": 60 * 1.0e5}
_FREE = 1.5
# Numbers of cameras that are tried, until a frame is dropped.
COUNTS = (1, 2, 4, 6, 8, 10, 12, 16, 24, 32)
# Largest time to append a frame (p99) [ms], and share of a core of all streams at once.
APPEND_MS, CORE = 5.0, 0.60


def measure(run: Run) -> dict[str, Any]:
    """Record each stream by itself, more and more cameras, and everything at once."""
    single, cameras, full = (0.6, 0.6, 1.5) if run.quick else (10.0, 6.0, 60.0)
    counts = COUNTS[:2] if run.quick else COUNTS
    alone = []
    for number, feed in enumerate(SINGLE):
        run.progress(0.3 * number / len(SINGLE))
        alone += record([feed], single, run.folder / f"alone-{number}")
    trials: dict[str, list[dict[str, Any]]] = {"zstd": [], "jpeg": []}
    for part, (codec, tried) in enumerate(trials.items()):
        for number, count in enumerate(counts):
            run.progress(0.3 + 0.2 * (part + number / len(counts)))
            require_room(run.folder, count * cameras * _RATE[codec])
            feeds = [Feed("camera", 60.0, codec)] * count
            tried.append(trial_of(record(feeds, cameras, run.folder / f"{codec}-{count}")))
            if tried[-1]["dropped"]:
                break
    run.progress(0.7)
    require_room(run.folder, full * 2 * _RATE["zstd"])
    at_once = record(TOGETHER, full, run.folder / "together")
    return {"alone": alone, "trials": trials, "together": at_once, "seconds": full}


def goals(values: dict[str, Any]) -> list[tuple[str, str, bool]]:
    """Return each goal of the streams, the values, and whether they reach it."""
    fed = values["together"]
    dropped = sum(one["dropped"] + bool(one["failure"]) for one in fed)
    p99 = max(one["append_ms"]["p99"] for one in fed)
    cores = sum(one["cpu"] for one in fed)
    what = "two lossless cameras, force 1 kHz, pose 500 Hz, taxels"
    return [
        (f"{what}: nothing dropped", f"{dropped} dropped", not dropped),
        (f"the same: append p99 below {APPEND_MS:g} ms", f"{p99:.2f} ms", p99 < APPEND_MS),
        (f"the same: below {100 * CORE:.0f} % of a core", f"{100 * cores:.0f} %", cores < CORE),
    ]


def capacity(values: dict[str, Any]) -> str:
    """Return the frames a second that were recorded without a drop, and the drops of the next."""
    held, lost = [], []
    for codec, words in (("zstd", "lossless"), ("jpeg", "as JPEG")):
        trials = values["trials"][codec]
        whole = [trial["cameras"] for trial in trials if not trial["dropped"]]
        most, more = max(whole, default=0), " or more" if len(whole) == len(trials) else ""
        held.append(f"{60 * most:,}{more} {words} ({most} cameras)")
        for trial in trials[len(whole) :]:
            late = ", so a process had its turn too late" if trial["cpu"] < CORE else ""
            dropped = f"{trial['cameras']} cameras {words} dropped {trial['dropped']}"
            lost.append(f"{dropped} at {100 * trial['cpu']:.0f} % of a core{late}")
    return f"""**Frames of 640x480 a second that were recorded without a drop, for some seconds, by
cameras of 60 Hz: {", ".join(held)}.** {f"Then {'; '.join(lost)}." if lost else ""}"""


def trial_of(fed: list[dict[str, Any]]) -> dict[str, float]:
    """Return the combined result of cameras that were recorded together; a failure is a drop."""
    return {
        "cameras": len(fed),
        "dropped": sum(one["dropped"] + bool(one["failure"]) for one in fed),
        "late": sum(one["late"] for one in fed),
        "cpu": sum(one["cpu"] for one in fed),
        "append_p99_ms": max(one["append_ms"]["p99"] for one in fed),
    }


def require_room(place: Path, nbytes: float) -> None:
    """Raise ConfigError on a disk without room."""
    free = shutil.disk_usage(place).free
    if free < _FREE * nbytes:
        raise ConfigError(
            f"TMPDIR {place}: found {free / 1e9:.1f} GB free; "
            f"allowed: {_FREE * nbytes / 1e9:.1f} GB or more"
        )


_ABOUT = """\
Streams from memory at their rates, each in a process with the rig's inbox and its real-time
settings. A frame is dropped if the inbox was full or the next one had come before the receiver
waited for it; it is late if its append began after the next one was due.""".replace("\n", " ")


def section(values: dict[str, Any], page: Page) -> str:
    """Return the tables of the streams."""
    fed = [*values["alone"], *values["together"]]
    granted = "granted" if all(one["punctual"] for one in fed) else "**refused**"
    cpu, start, end = (
        sum(one[key] for one in values["together"]) for key in ("cpu", "rss_start", "rss_end")
    )
    return "\n\n".join(
        [
            "## Load of the streams",
            f"{_ABOUT} SCHED_FIFO was {granted}. Each stream by itself:",
            _streams(values["alone"]),
            f"Two lossless cameras and everything else at once, for {values['seconds']:g} s: "
            f"{100 * cpu:.0f} % of a core; memory of all processes {start / 1e6:.0f} MB after a "
            f"fifth of the time and {end / 1e6:.0f} MB at the end.",
            _streams(values["together"]),
        ]
    )


def _streams(fed: list[dict[str, Any]]) -> str:
    lines = [
        [
            one["title"],
            f"{one['rows']:,}",
            one["dropped"] if not one["failure"] else one["failure"],
            one["late"],
            f"{100 * one['cpu']:.1f}",
            " / ".join(f"{one['append_ms'][name]:.2f}" for name in ("p50", "p99", "most")),
            f"{one['bytes'] / 1e6:.1f}",
        ]
        for one in fed
    ]
    head = ["stream", "rows", "dropped", "late", "% of a core", "append p50 / p99 / max [ms]", "MB"]
    return table(head, lines)
