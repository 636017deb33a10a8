"""Live view of the forces that a model predicts, and its side in the predicting process."""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from rig.core.clock import SECOND_NS, Clock
from rig.core.finger import FingerForce
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
# gauge: three each [N], or None; latency [ms], contact, outside of what the model learned from,
# slip (of `LiveForce`).
Point = tuple[float, Any, Any, Any, Any, Any, float, bool, bool, str]


@dataclass(frozen=True, slots=True)
class ForcesJob:
    """Constant data of the live forces of a sensor."""

    sensor: str
    """Name of the sensor."""
    source: str
    """Kind of bench, or that a session is replayed."""
    model: str = ""
    """Name of the model, and its purpose."""
    warnings: tuple[str, ...] = ()
    """Differences between that and this sensor."""
    name: str = ""
    """Its name beside others; empty: that of the sensor."""


@dataclass(frozen=True, slots=True)
class _News:
    points: tuple[tuple[Point, ...], ...]
    """Points of each sensor."""
    forces: tuple[dict[str, Any], ...]
    """Messages for programs."""
    ended: bool
    """True if these are the last, and all that is to be shown."""


class ForcesView(LiveView):
    """Live view of the forces of one or more sensors."""

    def __init__(self, jobs: Sequence[ForcesJob], clock: Clock) -> None:
        self._jobs = jobs
        self._points = [Backlog[Point](_MOST) for _ in jobs]
        self._forces = Backlog[dict[str, Any]](_MOST)
        self._lost = False

    def receive(self, message: _News) -> None:
        """Receive new forces."""
        self.ended = message.ended
        for backlog, points in zip(self._points, message.points, strict=True):
            if message.ended:
                backlog.clear()
            for point in points:
                backlog.add(point)
        for force in message.forces:
            self._forces.add(force)

    def lose(self) -> None:
        """Receive that the predicting process is gone."""
        self._lost = not self.ended
        self.ended = True

    def hello(self) -> dict[str, Any]:
        """Return the constant data."""
        names = ", ".join(job.name or job.sensor for job in self._jobs)
        sensors = [asdict(job) for job in self._jobs]
        return {"live": "forces", "seconds": SECONDS, "sensor": names, "sensors": sensors}

    def news(self, sent: Counter[str], clients: Mapping[str, int]) -> list[dict[str, Any] | bytes]:
        """Return the status and the new forces; the last ones replace all others."""
        status = "gone" if self._lost else "complete" if self.ended else "watching"
        points = [one.news(sent, f"points {number}") for number, one in enumerate(self._points)]
        return [{"kind": "state", "status": status, "points": points, **clients}]

    def stream(self, sent: Counter[str]) -> list[dict[str, Any]]:
        """Return the messages that a program does not have."""
        return self._forces.news(sent, "forces")


class ForcesPage(PageProcess):
    """Context manager that shows the forces of one or more sensors on a page."""

    option = "--page"

    def __init__(self, access: AccessPolicy, folders: Folders, jobs: Sequence[ForcesJob]) -> None:
        super().__init__(access, folders, ForcesView, tuple(jobs))
        self._start_ns: int | None = None
        self._names = [job.name for job in jobs]
        self._shown = [job.name or job.sensor for job in jobs]
        # Forces at the end, when those of a mock bench's World are known.
        self._recent = [deque[tuple[int, Point]](maxlen=_MOST) for _ in jobs]
        self._unsent = [deque[Point](maxlen=_MOST) for _ in jobs]
        self._messages: deque[dict[str, Any]] = deque(maxlen=_MOST)

    def __enter__(self) -> ForcesPage:
        self.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def add(
        self,
        reading: LiveForce,
        t_ns: int,
        latency: float,
        gauge: Triple | None,
        name: str = "",
    ) -> None:
        """Show a frame's forces, its state's time [ns], latency [s] and newest gauge force [N].

        `name` is that of the sensor's job.
        """
        at = self._names.index(name)
        self._start_ns = t_ns if self._start_ns is None else self._start_ns
        low, high = reading.interval or (None, None)
        force, *others = map(_numbers, (reading.force, low, high, reading.before, gauge))
        t = round((t_ns - self._start_ns) / SECOND_NS, 3)
        flags = bool(reading.contact), bool(reading.outside), reading.slip
        point: Any = (t, force, *others, round(1e3 * latency, 1), *flags)
        self._recent[at].append((t_ns, point))
        self._unsent[at].append(point)
        felt = asdict(finger_force(self._shown[at], t_ns, reading))
        felt |= {key: _numbers(felt[key]) for key in ("force", "half_width")}
        self._messages.append(felt | {"slip": reading.slip or None})
        self.wake()

    def finish(self, true: Mapping[int, Sequence[float]], name: str = "") -> None:
        """Show the true forces [N] by time [ns], where they are only known at last."""
        at = self._names.index(name)
        self._recent[at] = deque(
            (t_ns, (*point[:5], _numbers(true.get(t_ns, point[5])), *point[6:]))
            for t_ns, point in self._recent[at]
        )

    def message(self) -> _News:
        """Return the new forces; at the end all that are to be shown."""
        forces, ended = _taken(self._messages), self._ending.is_set()
        if not ended:
            return _News(tuple(map(_taken, self._unsent)), forces, False)
        points = (tuple(point for _, point in one) for one in self._recent)
        return _News(tuple(points), forces, True)


def finger_force(name: str, t_ns: int, reading: LiveForce) -> FingerForce:
    """Return the force of a finger that a model has predicted, of a state's time [ns]."""
    low, high = np.array(reading.interval or np.full((2, 3), np.nan))
    x, y, z = (0.5 * (high - low)).tolist()
    slips = reading.slip == "gross"
    return FingerForce(name, t_ns, reading.force, (x, y, z), reading.outside, slips)


def _taken(items: deque[Any]) -> tuple[Any, ...]:
    """Return the items of a queue that another thread fills, and remove them."""
    return tuple(items.popleft() for _ in range(len(items)))


def _numbers(values: Any) -> list[float | None] | None:
    return None if values is None else [number(value, 4) for value in values]
