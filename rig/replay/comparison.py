"""Results of a replay: equality of the bytes, and deviation from the recorded times."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from recorder.session import Session
from rig.core.clock import SECOND_NS
from rig.core.playback import origin_ns, times_of_run

Ints = npt.NDArray[np.int64]


@dataclass(frozen=True, slots=True)
class Retiming:
    """Maps recorded times of one run to the clock of its replay."""

    origin_ns: int
    """Recorded time of the run's first sample [ns]."""
    start_ns: int
    """Time at which that sample was due in the replay [ns]."""
    speed: float
    """Multiple of the recorded speed; 0: the tables below are used instead."""
    recorded_ns: Ints
    """Recorded times of the rows of the run's densest stream (n,) [ns]."""
    replayed_ns: Ints
    """Replayed times of the same rows (n,) [ns]."""

    def __call__(self, t_ns: Ints) -> Ints:
        """Map `t_ns` (n,) to the replay's clock [ns], by offset and speed or between rows."""
        since = np.asarray(t_ns, np.int64) - self.origin_ns
        if self.speed == 1.0:
            return since + self.start_ns
        if self.speed > 0:
            return np.rint(since / self.speed).astype(np.int64) + self.start_ns
        if not len(self.recorded_ns):
            return since + self.start_ns
        # Differences from the first: float64 holds those to the nanosecond, not times since boot.
        first, first_new = self.recorded_ns[0], self.replayed_ns[0]
        recorded = np.maximum.accumulate(self.recorded_ns) - first
        mapped = np.interp(t_ns - first, recorded, self.replayed_ns - first_new)
        return np.asarray(np.rint(mapped).astype(np.int64) + first_new)


def retiming(
    source: Session, replay: Session, names: tuple[str, ...], run: int, start_ns: int, speed: float
) -> Retiming:
    """Return the map from a run's times in `source` to `replay`, as far as it was recorded."""
    densest = max(names, key=lambda name: len(times_of_run(source, name, run)))
    old, new = (times_of_run(session, densest, run) for session in (source, replay))
    count = min(len(old), len(new))
    return Retiming(origin_ns(source, names, run) or 0, start_ns, speed, old[:count], new[:count])


@dataclass(frozen=True, slots=True)
class Timing:
    """Arrival minus the recorded time on the replay's clock, over the rows of a stream [s]."""

    p50: float
    p99: float
    largest: float


def timing(
    source: Session, replay: Session, name: str, maps: Mapping[int, Retiming]
) -> Timing | None:
    """Return the timing error of a stream over all its runs, by their maps; None without rows."""
    errors = []
    for run, to_new in maps.items():
        old, new = (times_of_run(session, name, run) for session in (source, replay))
        count = min(len(old), len(new))
        errors.append((new[:count] - to_new(old[:count])) * 1e-9)
    every = np.concatenate(errors) if errors else np.zeros(0)
    if not every.size:
        return None
    p50, p99 = np.percentile(every, [50, 99])
    return Timing(float(p50), float(p99), float(every[np.abs(every).argmax()]))


def compared(
    source: Mapping[str, str], replay: Mapping[str, str], rows: Mapping[str, int]
) -> tuple[bool, list[str]]:
    """Return True if the digests of all streams are equal, and a line for each with its rows."""
    lines = []
    width = max(7, *(len(name) + 1 for name in source)) if source else 7
    for name, digest in source.items():
        equal = replay[name] == digest
        outcome = "equal" if equal else "DIFFERENT"
        lines.append(f"{name:<{width}}{rows[name]:>9} rows  sha256 {digest}  {outcome}")
        if not equal:
            lines.append(f"{'':<{width + 23}}{replay[name]}  in the replay")
    return all(replay[name] == digest for name, digest in source.items()), lines


def timing_line(name: str, error: Timing) -> str:
    """Return a line about the timing error of a stream."""
    return (
        f"{name:<7} arrival minus recorded time: p50 {1e3 * error.p50:+.3f} ms  "
        f"p99 {1e3 * error.p99:+.3f} ms  largest {1e3 * error.largest:+.3f} ms"
    )


def covered_ns(replay: Session, names: tuple[str, ...], run: int) -> int:
    """Return the time up to which every stream of a run has rows [ns]."""
    every = [times_of_run(replay, name, run) for name in names]
    return min(int(times[-1]) if len(times) else 0 for times in every)


def span(session: Session, names: tuple[str, ...], run: int) -> float:
    """Return the time from the first to the last row of a run in any stream [s]."""
    every = [times for name in names if len(times := times_of_run(session, name, run))]
    first = min((int(times.min()) for times in every), default=0)
    return (max((int(times.max()) for times in every), default=0) - first) / SECOND_NS
