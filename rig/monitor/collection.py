"""Live view of a collection: its progress, samples and quality, in the page's process."""

from __future__ import annotations

import threading
from collections import Counter
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from recorder.command_line.options import next_command
from rig.acquire.request import CollectRequest
from rig.bench.bench import Bench
from rig.core.clock import SECOND_NS, Clock
from rig.monitor.finished import LETTERS
from rig.monitor.live_state import LiveState
from rig.monitor.live_view import Backlog, LiveView
from rig.monitor.quality import LiveQuality, Quality
from trajectories import PressShear, Target, dome_height

# Commands of the page.
COMMANDS = ("pause", "resume", "abort")
# Final statuses.
ENDED = ("complete", "stopped", "gone")
# Interval between judgements of the quality [s].
QUALITY_PERIOD = 0.5
_LOG_LINES = 100


@dataclass(frozen=True, slots=True)
class CollectionJob:
    """Constant data of a collection, for its page."""

    bench: Bench
    """Bench whose streams and limits are shown."""
    folder: Path
    """Run folder for `<stream>.latest` and `<stream>.counters`."""
    session: Path
    """Session to be written."""
    targets: tuple[Target, ...]
    """Targets on the map."""
    directions: int
    """Shear directions of the plan; 1 without shear."""
    clearance: float
    """Height above the surface at which the tip waits before a press [m]."""

    @classmethod
    def of(cls, bench: Bench, folder: Path, request: CollectRequest) -> CollectionJob:
        """Return the job of a collection."""
        plan = request.plan
        targets = tuple(target for target in plan.targets() if target.index < request.total)
        radius = bench.dome_radius
        heights = [t.origin[2] - dome_height(radius, *t.origin[:2]) for t in targets]
        directions = plan.direction_count if isinstance(plan, PressShear) else 1
        clearance = min(heights, default=0.0)
        return cls(bench, folder, request.path, targets, directions, clearance)


@dataclass(frozen=True, slots=True)
class Snapshot:
    """Progress of the collection, sent to the page's process a few times per second."""

    status: str = "preparing"
    """preparing, collecting, paused, ending, or one of ENDED."""
    reason: str = ""
    """Reason of the end, or location of the result."""
    target: int = -1
    """Index of the current target; -1 before the first and after the last."""
    phase: str = ""
    """Current activity of the arm, as text."""
    outcomes: str = ""
    """One of LETTERS for every target."""
    left: float | None = None
    """Estimated remaining time [s], None before it is known."""
    elapsed: float = 0.0
    """Time since the collection was started [s]."""
    paused_by: tuple[str, ...] = ()
    """Sources of the current pause requests."""
    log: tuple[str, ...] = ()
    """Log lines since the previous snapshot."""


class CollectionView(LiveView):
    """Live view of a collection.

    Args:
        job: The collection.
        clock: Clock.
    """

    commands = COMMANDS

    def __init__(self, job: CollectionJob, clock: Clock) -> None:
        self._job = job
        self._clock = clock
        self._state = LiveState(job.bench, job.folder, job.session, clock.now_ns())
        self._snapshot = Snapshot(outcomes=LETTERS["open"] * len(job.targets))
        self._quality: list[Quality] = []
        self._log = Backlog[str](_LOG_LINES)

    def start(self) -> None:
        """Start to judge the quality."""
        threading.Thread(target=self._judge, name="quality", daemon=True).start()

    def sample(self) -> None:
        """Add the newest forces to the traces."""
        self._state.sample()

    def close(self) -> None:
        """Release all records; may be called twice."""
        self._state.close()

    def receive(self, message: Snapshot) -> None:
        """Receive the progress of the collection."""
        self._snapshot = message
        for line in message.log:
            self._log.add(line)
        self.ended = message.status in ENDED

    def lose(self) -> None:
        """Receive that the collecting process is gone."""
        if not self.ended:
            session = self._job.session
            command = next_command("session", "recover", session)
            reason = f"the collecting process is gone; recover {session} with: {command}"
            self.receive(Snapshot("gone", reason, outcomes=self._snapshot.outcomes))

    def hello(self) -> dict[str, Any]:
        """Return the data that stay constant during the collection."""
        job = self._job
        points = {t.point: [1e3 * t.origin[0], 1e3 * t.origin[1]] for t in job.targets}
        return {
            "live": "collection",
            "sensor": job.bench.sensor,
            "indenter": job.bench.indenter,
            "mock": job.bench.mock,
            "session": job.session.name,
            **self._state.constants(),
            "points": [{"point": point, "at": position} for point, position in points.items()],
            "targets": [[t.point, round(1e3 * t.depth, 4), t.direction] for t in job.targets],
            "directions": job.directions,
        }

    def news(self, sent: Counter[str], clients: Mapping[str, int]) -> list[dict[str, Any] | bytes]:
        """Return the state, with new points and log lines, and the new images."""
        now, live = self._snapshot, self._state
        state: dict[str, Any] = {
            "kind": "state",
            "status": now.status,
            "reason": now.reason,
            "target": now.target,
            "phase": now.phase,
            "outcomes": now.outcomes,
            "left": now.left,
            "elapsed": now.elapsed,
            "paused_by": list(now.paused_by),
            "streams": live.streams(self._clock.now_ns()),
            "forces": live.forces(),
            "tips": live.tips(),
            "taxels": live.taxels(),
            "quality": [asdict(each) for each in self._quality],
            "traces": {name: trace.news(sent, name) for name, trace in live.traces.items()},
            "log": self._log.news(sent, "log"),
            "images": live.images(),
            **clients,
        }
        return [state, *live.new_pictures(sent)]

    def _judge(self) -> None:
        """Judge the quality until the process ends, in a thread: clients need not wait for it."""
        job = self._job
        try:
            live = LiveQuality(job.bench, job.session, job.clearance, self._clock.now_ns())
            while True:
                self._quality = live.look()
                self._clock.sleep_until(self._clock.now_ns() + round(QUALITY_PERIOD * SECOND_NS))
        except Exception as error:
            # A list that no longer changes would look like that of a healthy recording.
            text = f"not judged any more: {type(error).__name__}: {error}"
            self._quality = [Quality("quality", "fault", text)]
            raise
