"""Run one long collection as a technician would and watch its processes."""

from __future__ import annotations

import subprocess
import sys
from bisect import bisect_left
from collections.abc import Callable
from dataclasses import dataclass, replace
from math import pi
from pathlib import Path

from benchmarks.endurance.processes import Track, look, role_of
from benchmarks.faults.processes import family
from recorder.settings import yaml_text
from rig.bench.bench import BenchFile
from rig.core.clock import SECOND_NS, SystemClock
from rig.core.errors import ConfigError
from trajectories import PressShear

# Interval between observations [s].
_EVERY = 5.0
_MOST_DIRECTIONS = 360


@dataclass(frozen=True, slots=True)
class LongRun:
    """Result of a long collection."""

    session: Path
    exit_code: int
    seconds: float
    """Wall time [s]."""
    targets: int
    """Number of targets in the plan."""
    tracks: tuple[Track, ...]
    """Processes observed."""
    output: str
    """Output of the collection."""


def long_bench(bench_file: Path, seconds: float, folder: Path) -> tuple[Path, int]:
    """Write a bench like `bench_file` with more shear directions, to take at least `seconds`.

    Returns:
        The file, in `folder`, and the number of targets in its plan.

    Raises:
        ConfigError: Not a mock bench, no press-shear plan, or `seconds` exceeds the longest plan.
    """
    bench = BenchFile.read(bench_file).bench
    plan = bench.trajectory
    if not bench.mock or not isinstance(plan, PressShear):
        raise ConfigError(f"{bench_file}: allowed: a mock bench with a press_shear trajectory")

    def length(directions: int) -> float:
        longer = replace(plan, angle_step=2 * pi / directions)
        return bench.dry_run(longer).duration

    most = length(_MOST_DIRECTIONS)
    if most < seconds:
        raise ConfigError(f"--minutes: {seconds / 60:g}; allowed: up to {most / 60:.0f}")
    directions = bisect_left(range(1, _MOST_DIRECTIONS), seconds, key=length) + 1
    path = folder / f"{bench.sensor}-long.yaml"
    content = {
        "extends": str(bench_file.resolve()),
        "trajectory": {"kind": "press_shear", "angle_step_deg": 360.0 / directions},
        "limits": {"duration_max_min": 2 * length(directions) / 60},
    }
    path.write_text(yaml_text(content))
    return path, len(replace(plan, angle_step=2 * pi / directions))


def run_long(
    bench_file: Path, session: Path, targets: int, progress: Callable[[float], None]
) -> LongRun:
    """Collect the plan of `bench_file` into `session` while observing its processes.

    Args:
        bench_file: Bench written by `long_bench`.
        session: Session to write.
        targets: Targets of the plan.
        progress: Called regularly with the seconds since the start.
    """
    clock = SystemClock()
    start_ns = clock.now_ns()
    command = [sys.executable, "-u", "-m", "tactile", "collect", "--bench", str(bench_file)]
    command += ["--calibrations", str(bench_file.parent / "none-measured")]
    printed = session.with_suffix(".out")
    tracks: dict[int, Track] = {}
    with printed.open("w") as out:
        process = subprocess.Popen(
            [*command, "--out", str(session)], stdout=out, stderr=subprocess.STDOUT
        )
        try:
            due_ns = start_ns
            while process.poll() is None:
                due_ns += round(_EVERY * SECOND_NS)
                clock.sleep_until(min(due_ns, clock.now_ns() + SECOND_NS))
                if clock.now_ns() < due_ns:
                    due_ns -= round(_EVERY * SECOND_NS)
                    continue
                seconds = (clock.now_ns() - start_ns) / SECOND_NS
                _look_at_all(process.pid, session, tracks, seconds)
                progress(seconds)
        except BaseException:
            # Ctrl-C also reached the collection, which retracts and closes its session.
            process.wait()
            raise
    kept = tuple(track for track in tracks.values() if track.role != "resource tracker")
    return LongRun(
        session,
        process.returncode,
        (clock.now_ns() - start_ns) / SECOND_NS,
        targets,
        kept,
        printed.read_text(),
    )


def _look_at_all(root: int, session: Path, tracks: dict[int, Track], seconds: float) -> None:
    for pid, command in family(root).items():
        if pid not in tracks:
            tracks[pid] = Track("collect" if pid == root else "?")
        track = tracks[pid]
        if track.role in ("?", "arm"):
            # A stream is identified by its files, which it opens some seconds after its start.
            track.role = role_of(pid, command, session)
        look(pid, track, seconds)
