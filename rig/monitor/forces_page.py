"""Live view of the forces that a model predicts, and its side in the predicting process."""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from rig.core.clock import SECOND_NS, Clock
from rig.monitor.access import AccessPolicy
from rig.monitor.lab import Folders, number
from rig.monitor.page_process import PageProcess
from rig.monitor.server import Backlog, LiveView

if TYPE_CHECKING:
    from rig.monitor.predictor import LiveForce
    from rig.monitor.watched import Triple

# Time that the page shows [s].
SECONDS = 20.0
# Most forces that are kept: those of this time at 200 Hz.
_MOST = 4000

# Time [s], forces predicted, ends of their intervals, forces before a transfer and those of the
# gauge: three each [N], or None; latency [ms], contact, outside of what the model learned from.
Point = tuple[float, Any, Any, Any, Any, Any, float, bool, bool]


@dataclass(frozen=True, slots=True)
class ForcesJob:
    """Constant data of live forces."""

    sensor: str
    """Name of the sensor."""
    source: str
    """Kind of bench, or that a session is replayed."""
    model: str = ""
    """Name of the model, and its purpose."""
    warnings: tuple[str, ...] = ()
    """Differences between that and this sensor."""


@dataclass(frozen=True, slots=True)
class _News:
    points: tuple[Point, ...]
    ended: bool
    """True if these are the last, and all that is to be shown."""


class ForcesView(LiveView):
    """Live view of forces."""

    def __init__(self, job: ForcesJob, clock: Clock) -> None:
        self._job = job
        self._points = Backlog[Point](_MOST)
        self._lost = False

    def receive(self, message: _News) -> None:
        """Receive new forces."""
        self.ended = message.ended
        if message.ended:
            self._points.clear()
        for point in message.points:
            self._points.add(point)

    def lose(self) -> None:
        """Receive that the predicting process is gone."""
        self._lost = not self.ended
        self.ended = True

    def hello(self) -> dict[str, Any]:
        """Return the constant data."""
        return {"live": "forces", "seconds": SECONDS, **asdict(self._job)}

    def news(self, sent: Counter[str], clients: Mapping[str, int]) -> list[dict[str, Any] | bytes]:
        """Return the status and the new forces; the last ones replace all others."""
        status = "gone" if self._lost else "complete" if self.ended else "watching"
        points = self._points.news(sent, "points")
        return [{"kind": "state", "status": status, "points": points, **clients}]


class ForcesPage(PageProcess):
    """Context manager that shows forces on a page."""

    option = "--page"

    def __init__(self, access: AccessPolicy, folders: Folders, job: ForcesJob) -> None:
        super().__init__(access, folders, ForcesView, job)
        self._start_ns: int | None = None
        # The forces that are shown with their times [ns], and those that were not sent yet.
        self._recent: deque[tuple[int, Point]] = deque(maxlen=_MOST)
        self._unsent: deque[Point] = deque(maxlen=_MOST)

    def __enter__(self) -> ForcesPage:
        self.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def add(self, reading: LiveForce, t_ns: int, latency: float, gauge: Triple | None) -> None:
        """Show a frame's forces, its state's time [ns], latency [s] and newest gauge force [N]."""
        self._start_ns = t_ns if self._start_ns is None else self._start_ns
        low, high = reading.interval or (None, None)
        force, *others = map(_numbers, (reading.force, low, high, reading.before, gauge))
        t = round((t_ns - self._start_ns) / SECOND_NS, 3)
        flags = bool(reading.contact), bool(reading.outside)
        point: Any = (t, force, *others, round(1e3 * latency, 1), *flags)
        self._recent.append((t_ns, point))
        self._unsent.append(point)

    def finish(self, wrench: Callable[[Any], np.ndarray] | None) -> None:
        """Show the true wrench (n, 6) [N, N m] at times (n,) [ns], if it is only known at last."""
        if wrench is None or not self._recent:
            return
        true = wrench(np.array([t_ns for t_ns, _ in self._recent], np.int64))[:, :3]
        self._recent = deque(
            (t_ns, (*point[:5], _numbers(force), *point[6:]))
            for (t_ns, point), force in zip(self._recent, true, strict=True)
        )

    def message(self) -> _News:
        """Return the new forces; at the end all that are to be shown."""
        if not self._ending.is_set():
            return _News(tuple(self._unsent.popleft() for _ in range(len(self._unsent))), False)
        return _News(tuple(point for _, point in self._recent), True)


def _numbers(values: Any) -> list[float | None] | None:
    return None if values is None else [number(value, 4) for value in values]
