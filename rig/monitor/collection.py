"""The page of a collection: its live view in the page's process, fed by the collecting process.

The view reads the newest samples from shared records and the open image shard. Force is sampled at
40 Hz for the traces, only for display; the session stores it at its full rate.
"""

from __future__ import annotations

import contextlib
import json
import logging
import os
import threading
from collections import Counter, deque
from collections.abc import Callable, Iterator, Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np

from recorder.command_line.options import next_command
from recorder.errors import SessionError
from recorder.findings import Finding
from recorder.session import Session
from recorder.store import ImageTail, open_tail
from rig.acquire.collector import CollectRequest
from rig.acquire.control import Control
from rig.acquire.stream_process import COUNTERS
from rig.bench.bench import Bench
from rig.core.clock import SECOND_NS, Clock, SystemClock
from rig.core.config import from_si
from rig.core.geometry import invert, transform
from rig.core.guard import AXES
from rig.core.shared_memory import AwaitedRecord
from rig.monitor.access import AccessPolicy
from rig.monitor.lab import ADDRESS, FORCE_LIMITED, LETTERS, Folders, number
from rig.monitor.page_process import PageProcess
from rig.monitor.quality import LiveQuality, QualityRow
from rig.monitor.server import SAMPLE_RATE_HZ, Backlog, LiveView
from trajectories import PressShear, Target, dome_height

# Time that traces reach back [s].
TRACE_SECONDS = 20.0

# Most pictures and plots that the page shows; the table lists every stream.
MOST_PICTURES, MOST_PLOTS, MOST_ARMS = 6, 4, 4

# Time since the page's start [s] and Fx, Fy, Fz [N].
Point = tuple[float, float | None, float | None, float | None]


class ForceTrace(Backlog[Point]):
    """Force of one gauge during the last seconds."""

    def __init__(self) -> None:
        super().__init__(round(TRACE_SECONDS * SAMPLE_RATE_HZ))
        self._newest_ns = 0

    def sample(self, record: np.void, start_ns: int) -> None:
        """Add a sample, unless it is already there."""
        t_ns = int(record["t_ns"])
        if t_ns != self._newest_ns:
            self._newest_ns = t_ns
            x, y, z = (number(value) for value in record["value"][:3])
            self.add((round((t_ns - start_ns) / SECOND_NS, 3), x, y, z))


class Picture:
    """Newest image of one camera, from the open shard."""

    def __init__(self, group: Path) -> None:
        self._group = group
        self._tail: ImageTail | None = None
        self.row = -1
        """Row of the image; -1 before the first."""
        self.jpeg: bytes | None = None
        """Its JPEG bytes."""

    def look(self, newest: np.void | None) -> None:
        """Read the image of the newest sample, if it is another one."""
        row = -1 if newest is None else int(newest["row"])
        if row < 0 or row == self.row:
            return
        try:
            if self._tail is None:
                self._tail = open_tail(self._group)
            data = self._tail.jpeg(row)
        except (SessionError, OSError):
            # Affects the display only: corrupt sessions are reported by `check`, not by the page.
            return
        if data is not None:
            self.row, self.jpeg = row, data


# Commands of the page.
COMMANDS = ("pause", "resume", "abort")
# Final statuses.
ENDED = ("complete", "stopped", "gone")
# Interval between judgements of the quality [s].
QUALITY_PERIOD = 0.5
_LOG_LINES = 2000


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
    go_on: str = ""
    """Command that continues the session; empty: none."""

    @classmethod
    def of(cls, bench: Bench, folder: Path, request: CollectRequest) -> CollectionJob:
        """Return the job of a collection."""
        plan = request.plan
        targets = tuple(target for target in plan.targets() if target.index < request.total)
        radius = bench.dome_radius
        heights = [t.origin[2] - dome_height(radius, *t.origin[:2]) for t in targets]
        directions = plan.direction_count if isinstance(plan, PressShear) else 1
        clearance = min(heights, default=0.0)
        return cls(bench, folder, request.path, targets, directions, clearance, request.go_on)


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
    doubts: tuple[Finding, ...] = ()
    """Findings of the recording so far."""
    command: str = ""
    """Command that leads on from the end, if a session was kept."""


class CollectionView(LiveView):
    """Live view of a collection."""

    commands = COMMANDS

    def __init__(self, job: CollectionJob, clock: Clock) -> None:
        self._job, self._clock = job, clock
        self._bench = bench = job.bench
        self._start_ns = clock.now_ns()
        self._latest = {
            row.name: AwaitedRecord(job.folder / f"{row.name}.latest", row.latest)
            for row in bench.rows
        }
        self._counters = {
            name: AwaitedRecord(job.folder / f"{name}.counters", COUNTERS) for name in self._latest
        }
        self._to_contact = invert(bench.contact_frame)
        self._dome_radius = bench.dome_radius
        of_kind = {
            kind: [row.name for row in bench.of_kind(kind)]
            for kind in ("camera", "taxels", "force", "pose")
        }
        signal = None if bench.signal is None else bench.signal.name
        signals = sorted([*of_kind["camera"], *of_kind["taxels"]], key=lambda name: name != signal)
        self.kinds = {name: bench.row(name).kind for name in signals[:MOST_PICTURES]}
        """Kind of each stream that is shown as a picture; the first stands large on the page."""
        self._gauges = of_kind["force"][:MOST_PLOTS]
        self._arms = of_kind["pose"][:MOST_ARMS]
        self.pictures = {
            name: Picture(job.session / "streams" / name)
            for name, kind in self.kinds.items()
            if kind == "camera"
        }
        """Newest image of each camera that is shown."""
        self._no_contact: dict[str, np.ndarray] = {}
        self.traces = {name: ForceTrace() for name in self._gauges}
        """Trace of each gauge that is shown."""
        self._snapshot = Snapshot(outcomes=LETTERS["open"] * len(job.targets))
        self._quality: list[QualityRow] = []
        self._log = Backlog[str](_LOG_LINES)

    def start(self) -> None:
        """Start to judge the quality."""
        threading.Thread(target=self._judge, name="quality", daemon=True).start()

    def sample(self) -> None:
        """Add the newest forces to the traces."""
        for name, trace in self.traces.items():
            record = self._latest[name].read()
            if record is not None:
                trace.sample(record, self._start_ns)

    def streams(self, now_ns: int) -> dict[str, dict[str, Any]]:
        """Return rate, expected rate [Hz], dropped, longest gap and age [ms] of every stream."""
        rows = {}
        for name, shared in self._counters.items():
            counters = shared.read()
            newest = self._latest[name].read()
            row: dict[str, Any] = {"expected": self._bench.row(name).rate_hz}
            if counters is not None:
                row |= {
                    "rate": number(counters["rate_hz"], 1),
                    "rows": int(counters["rows"]),
                    "dropped": int(counters["dropped"]),
                    "gap": number(1e3 * counters["longest_gap"], 1),
                }
            if newest is not None:
                row["age"] = max(round((now_ns - int(newest["t_ns"])) / 1e6), 0)
            rows[name] = row
        return rows

    def forces(self) -> dict[str, dict[str, Any]]:
        """Return the wrench [N, N mm] of each gauge, and the fraction of each rating."""
        ratings = self._bench.force_rating
        forces = {}
        for name in self._gauges:
            record = self._latest[name].read()
            if record is None:
                continue
            wrench = [float(value) for value in record["value"]]
            values = (*wrench[:3], *(from_si(value, "n_mm") for value in wrench[3:]))
            pairs = zip(wrench, ratings, strict=True)
            forces[name] = {
                "wrench": [number(value) for value in values],
                "load": [number(abs(value) / rating) for value, rating in pairs],
                "guards": any(gauge.name == name for gauge in self._bench.gauges),
            }
        return forces

    def tips(self) -> dict[str, list[float | None]]:
        """Return each arm's tip (3,) [mm]: x and y in the contact frame, z above the surface."""
        tips = {}
        for name in self._arms:
            record = self._latest[name].read()
            if record is not None:
                tip = transform(self._to_contact, record["value"][:3])
                tip[2] -= dome_height(self._dome_radius, *tip[:2].tolist())
                tips[name] = [number(from_si(float(value), "mm")) for value in tip]
        return tips

    def taxels(self) -> dict[str, list[list[int]]]:
        """Return counts (taxels, axes) of each array that is shown, minus the first ones read."""
        counts = {}
        for name in self.kinds:
            record = self._latest[name].read() if name not in self.pictures else None
            if record is not None:
                no_contact = self._no_contact.setdefault(name, record["value"].copy())
                counts[name] = (record["value"] - no_contact).tolist()
        return counts

    def images(self) -> dict[str, int]:
        """Read the newest image of each camera that is shown; return their rows."""
        for name, picture in self.pictures.items():
            picture.look(self._latest[name].read())
        return {name: picture.row for name, picture in self.pictures.items()}

    def new_pictures(self, sent: Counter[str]) -> Iterator[bytes]:
        """Yield the number of a picture, as a byte, and its JPEG, if it is new to a client.

        These are the first camera, and one of the others in turn, so that the data sent in one
        period do not grow with the number of cameras.
        """
        sent["turn"] += 1
        first, *others = [*self.pictures] or [""]
        for name in (first, *others[sent["turn"] % max(len(others), 1) :][:1]):
            picture = self.pictures.get(name)
            if picture and picture.jpeg is not None and picture.row + 1 != sent[f"image {name}"]:
                sent[f"image {name}"] = picture.row + 1
                yield bytes([list(self.kinds).index(name)]) + picture.jpeg

    def close(self) -> None:
        """Release all records; may be called twice."""
        for record in (*self._latest.values(), *self._counters.values()):
            record.close()

    def receive(self, message: Snapshot) -> None:
        """Receive the progress of the collection."""
        for line in message.log:
            self._log.add(line)
        self.ended = message.status in ENDED
        if self.ended and (session := self._job.session).exists():
            commands = {
                "complete": next_command("page", session.parent),
                "stopped": self._job.go_on,
                "gone": next_command("session", "recover", session),
            }
            message = replace(message, command=commands[message.status])
        self._snapshot = message

    def lose(self) -> None:
        """Receive that the collecting process is gone."""
        if not self.ended:
            reason = "the collecting process is gone"
            self.receive(Snapshot("gone", reason, outcomes=self._snapshot.outcomes))

    def hello(self) -> dict[str, Any]:
        """Return the data that stay constant during the collection."""
        job = self._job
        limits, rating = self._bench.limits, self._bench.force_rating
        box = (limits.box_x, limits.box_y, (-limits.depth_max, limits.height_max))
        points = {t.point: [1e3 * t.origin[0], 1e3 * t.origin[1]] for t in job.targets}
        return {
            "live": "collection",
            "sensor": job.bench.sensor,
            "indenter": job.bench.indenter,
            "mock": job.bench.mock,
            "session": job.session.name,
            "pictures": self.kinds,
            "plots": self._gauges,
            "arms": self._arms,
            "seconds": TRACE_SECONDS,
            "limits": {
                "axes": [name for name, _ in AXES],
                "ratings": [*rating[:3], *(from_si(torque, "n_mm") for torque in rating[3:])],
                "soft": limits.soft_fraction,
                "hard": limits.hard_fraction,
                "box": [[from_si(value, "mm") for value in pair] for pair in box],
            },
            "points": [{"point": point, "at": position} for point, position in points.items()],
            "targets": [[t.point, round(1e3 * t.depth, 4), t.direction] for t in job.targets],
            "directions": job.directions,
        }

    def news(self, sent: Counter[str], clients: Mapping[str, int]) -> list[dict[str, Any] | bytes]:
        """Return the state, with new points and log lines, and the new images."""
        now = self._snapshot
        doubts = [QualityRow(each.code, "watch", each.message) for each in now.doubts]
        state: dict[str, Any] = {
            "kind": "state",
            **asdict(now),
            "streams": self.streams(self._clock.now_ns()),
            "forces": self.forces(),
            "tips": self.tips(),
            "taxels": self.taxels(),
            "quality": [asdict(each) for each in (*self._quality, *doubts)],
            "traces": {name: trace.news(sent, name) for name, trace in self.traces.items()},
            "log": self._log.news(sent, "log"),
            "images": self.images(),
            **clients,
        }
        return [state, *self.new_pictures(sent)]

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
            self._quality = [QualityRow("quality", "fault", text)]
            raise


logger = logging.getLogger(__name__)

_WHO = "page"


class _LogLines(logging.Handler):
    """Keeps the newest lines until the page's thread fetches them."""

    def __init__(self) -> None:
        super().__init__(logging.INFO)
        self.setFormatter(logging.Formatter("%(asctime)s %(message)s", "%H:%M:%S"))
        self._lines: deque[str] = deque(maxlen=_LOG_LINES)

    def emit(self, record: logging.LogRecord) -> None:
        self._lines.append(self.format(record))

    def fetch(self) -> tuple[str, ...]:
        """Return the lines since the last call."""
        return tuple(self._lines.popleft() for _ in range(len(self._lines)))


class CollectionPage(PageProcess):
    """Context manager that serves the page while a collection runs."""

    option = "--watch"

    def __init__(self, access: AccessPolicy, folders: Folders, job: CollectionJob) -> None:
        super().__init__(access, folders, CollectionView, job)
        self._clock = SystemClock()
        self._start_ns = self._clock.now_ns()
        self._snapshot = Snapshot(outcomes=LETTERS["open"] * len(job.targets))
        self._outcomes = list(self._snapshot.outcomes)
        self._progress: Callable[[], Mapping[str, Any]] | None = None
        self._control: Control | None = None
        self._log = _LogLines()
        # By this file `tactile page` finds the page of a collection.
        self._address = job.session.parent / ADDRESS
        self._session = job.session.name

    def __enter__(self) -> CollectionPage:
        self.start()
        content = {"port": self.port, "session": self._session, "pid": os.getpid()}
        # The collection does not depend on it.
        with contextlib.suppress(OSError):
            self._address.write_text(json.dumps(content))
        logging.getLogger().addHandler(self._log)
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        if self._snapshot.status not in ENDED:
            reason = str(error) or type(error).__name__ if error is not None else ""
            self.say("stopped", reason)
        self.close()

    def begin(
        self, control: Control, progress: Callable[[], Mapping[str, Any]], session: Path, first: int
    ) -> None:
        """Show a running collection; see `rig.acquire.control.Onlooker`."""
        self._control, self._progress = control, progress
        if first:
            segments = Session(session).segments
            limited = segments["target"][segments["outcome"] == FORCE_LIMITED]
            for target in range(first):
                self._outcomes[target] = LETTERS["limited" if target in limited else "done"]
        self.say("collecting")

    def say(self, status: str, reason: str = "") -> None:
        """Show a status; one of ENDED is the last."""
        self._snapshot = replace(self._snapshot, status=status, reason=reason)

    def close(self) -> None:
        """Send the final state, wait until it arrives, end the process; may be called twice."""
        logging.getLogger().removeHandler(self._log)
        with contextlib.suppress(OSError):
            self._address.unlink(missing_ok=True)
        super().close()

    def lost(self) -> None:
        """Note that the page's process is gone."""
        logger.warning("the monitoring page is gone; the collection continues without it")
        if self._control is not None and _WHO in self._control.paused_by:
            # The person who paused may be at the bench: motion must not resume by itself.
            logger.warning("the pause it requested stays: end with Ctrl-C, then resume")

    def obey(self, command: str) -> None:
        """Pause, resume or abort the collection."""
        if self._control is not None and command in COMMANDS:
            getattr(self._control, command)(_WHO)

    def message(self) -> Snapshot:
        """Return the progress of the collection."""
        fields = dict(self._progress()) if self._progress is not None else {}
        for target, outcome in fields.pop("ended", {}).items():
            self._outcomes[target] = LETTERS[outcome]
        base = self._snapshot
        if fields.pop("waiting", False) and base.status == "collecting":
            base = replace(base, status="paused")
        if base.status in ENDED:
            fields = {"target": -1, "phase": "", "left": None}
        return replace(
            base,
            **fields,
            outcomes="".join(self._outcomes),
            elapsed=round((self._clock.now_ns() - self._start_ns) / SECOND_NS, 1),
            paused_by=self._control.paused_by if self._control is not None else (),
            log=self._log.fetch(),
        )
