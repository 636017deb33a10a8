"""Part `endurance`: memory, open files and losses of a long mock collection."""

import contextlib
import subprocess
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import psutil

from benchmarks.faults.collection_run import CollectionRun, quick_bench
from benchmarks.report import Page, Run, table
from recorder import Session, check, faults
from recorder.charts import BLUE, SKY, chart
from rig.bench.bench import BenchFile
from rig.core.clock import SECOND_NS, SystemClock

# Step between shear directions, and targets of a quick run.
ANGLE_STEP_DEG, QUICK_TARGETS = 9.0, 5
# Expected duration of a complete and of a quick run [s].
_EXPECTED = (1830.0, 30.0)
# Buffers, caches and the first shards fill during this time [s].
_WARM_UP, _QUICK_WARM_UP = 120.0, 5.0
# Interval between observations [s].
_EVERY, _QUICK_EVERY = 5.0, 1.0
_MIB = 2**20


@dataclass(slots=True)
class Track:
    """One process over time."""

    role: str = ""
    """Its task; empty: not identified."""
    rows: list[tuple[float, int, int]] = field(default_factory=list)
    """Time since the start [s], memory that no other process shares [bytes], and open files."""


def long_bench(folder: Path) -> Path:
    """Write a bench with a plan of half an hour, by more shear directions."""
    more = f"trajectory: {{angle_step_deg: {ANGLE_STEP_DEG}}}"
    return quick_bench(folder, "tacpalm", limits="{duration_max_min: 60}", more=more)


def watched(run: CollectionRun, every: float, progress: Callable[[float], None]) -> list[Track]:
    """Watch the processes of a collection to its end, every so often [s]; return them."""
    clock = SystemClock()
    start_ns = clock.now_ns()
    tracks: dict[int, Track] = {}
    while run.process.poll() is None:
        with contextlib.suppress(subprocess.TimeoutExpired):
            run.process.wait(every)
        seconds = (clock.now_ns() - start_ns) / SECOND_NS
        for pid, role in run.roles().items():
            track = tracks.setdefault(pid, Track())
            if track.role in ("", "arm"):
                track.role = role
            with contextlib.suppress(psutil.Error):
                process = psutil.Process(pid)
                track.rows.append((seconds, process.memory_full_info().uss, process.num_fds()))
        progress(seconds)
    return [track for track in tracks.values() if track.role and track.rows]


def growth_of(
    track: Track, warm_up: float = _WARM_UP, until: float = np.inf
) -> dict[str, Any] | None:
    """Return the growth of one process, None if it was observed too briefly.

    From `warm_up` to `until` [s]: medians of the first and last minute [bytes], slope of a line
    [bytes per hour], and open files at both ends.
    """
    rows = [row for row in track.rows if warm_up <= row[0] <= until]
    if len(rows) < 3:
        return None
    times, memory, files = np.array(rows).T
    line = np.polyfit(times, memory, 1)
    return {
        "role": track.role,
        "first": float(np.median(memory[times <= times[0] + 60])),
        "last": float(np.median(memory[times >= times[-1] - 60])),
        "slope": float(line[0]) * 3600,
        "files": [int(files[0]), int(files[-1])],
    }


def measure(run: Run) -> dict[str, Any]:
    """Run one long collection; return its rows, its losses, and the growth of its processes."""
    bench, session = long_bench(run.folder), run.folder / "long.zarr"
    targets = QUICK_TARGETS if run.quick else len(BenchFile.read(bench).bench.trajectory)
    words = ("--bench", str(bench), "--targets", str(targets))
    with CollectionRun.collect(session, *words) as collection:
        tracks = watched(
            collection,
            _QUICK_EVERY if run.quick else _EVERY,
            lambda so_far: run.progress(min(so_far / _EXPECTED[run.quick], 1.0)),
        )
        code, last = collection.wait(), collection.last_line
    if code != 0:
        run.failures.append(f"exit code {code}: {last}")
        return {"exit": code, "last": last}
    seconds = max(track.rows[-1][0] for track in tracks)
    # After recording, the session is closed and its frames are built, which needs memory.
    end = min(track.rows[-1][0] for track in tracks if track.role.endswith("stream"))
    warm_up = _QUICK_WARM_UP if run.quick else _WARM_UP
    growths = [growth_of(track, warm_up, end) for track in tracks]
    recorded = Session(session)
    return {
        "exit": code,
        "last": last,
        "targets": targets,
        "seconds": seconds,
        "bytes": sum(path.stat().st_size for path in session.rglob("*") if path.is_file()),
        "streams": {
            name: {"rows": len(stream.t_ns), **recorded.attrs["summary"][name]}
            for name, stream in recorded.streams.items()
        },
        "findings": [
            str(each).replace(str(session), session.name) for each in faults(check(session))
        ],
        "warm_up": warm_up,
        "growth": sorted(filter(None, growths), key=lambda each: str(each["role"])),
        "processes": [track.role for track in tracks],
    }


def section(values: dict[str, Any], page: Page) -> str:
    """Return the streams, the findings, and the memory of each process as table and chart."""
    if values["exit"] != 0:
        return f"## Endurance\n\nThe collection ended with exit code {values['exit']}."
    with chart(page.picture("memory"), 8, 0.8 + 0.25 * len(values["growth"])) as figure:
        axes = figure.subplots()
        for when, mark, colour in (("first", "o", SKY), ("last", "|", BLUE)):
            memory = {each["role"]: each[when] / _MIB for each in values["growth"]}
            axes.plot([*memory.values()], [*memory], mark, color=colour, ms=10, label=when)
        axes.set(xlabel="memory in the first and in the last minute [MiB]", xlim=(0, None))
        axes.legend()
    streams = [
        (name, each["rows"], each["dropped"], f"{1e3 * each['longest_gap']:.1f} ms")
        for name, each in values["streams"].items()
    ]
    findings = "\n".join(f"- {finding}" for finding in values["findings"]) or "nothing found"
    total = sum(each["slope"] for each in values["growth"]) / _MIB
    most = max(values["growth"], key=lambda each: float(each["slope"]))
    return f"""## Endurance

One mock collection of {values["targets"]} targets in {values["seconds"] / 60:.1f} minutes, its
processes observed regularly: {values["bytes"] / 1e6:.0f} MB, exit code 0. `tactile session check`:
{findings}

{table(("stream", "rows", "dropped", "longest gap"), streams)}

Private memory from {values["warm_up"]:.0f} s after the start to the end of recording grows by
{total:+.2f} MiB an hour in all processes together, most in {most["role"]}
({most["slope"] / _MIB:+.2f} MiB an hour).

{page.link("memory", "Memory of each process in the first and in the last minute")}"""
