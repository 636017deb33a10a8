"""Independent record of the state that a running collection publishes.

The newest sample of a stream appears in shared memory after it was appended: once recording has
begun, every sample seen here was accepted and must be readable afterwards. The position of the arm
is read from its emulator's fault port, independently of the rig.
"""

import threading
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from rig.acquire.stream_process import COUNTERS
from rig.bench.bench import SPECS
from rig.core import emulation
from rig.core.clock import SystemClock
from rig.core.config import build, read_yaml
from rig.core.geometry import compose, invert
from rig.core.mock_names import PORTS
from rig.core.samples import latest_dtype
from rig.core.shared_memory import AwaitedRecord
from rig.mock.world import WorldConfig

_PERIOD = 0.02
_ARM_EVERY = 3


@dataclass(frozen=True, slots=True)
class ArmState:
    """State reported by the arm's emulator: time [ns], height of the tip [m] and speed [m/s]."""

    t_ns: int
    height: float
    speed: float


@dataclass(slots=True)
class Observed:
    """Observations of one run."""

    shown: dict[str, set[int]] = field(default_factory=dict)
    """t_ns of samples that each stream published while it was recording [ns]."""
    rows: dict[str, int] = field(default_factory=dict)
    """Highest number of stored rows that each stream reported in this run."""
    arm: ArmState | None = None
    """Last state of the arm."""
    arm_silent_ns: int | None = None
    """Time of the first question after that state, which got no answer; None: none [ns]."""


class Observer:
    """Polls a collection about 50 times a second on its own thread until closed.

    Records are shared in the run `folder`; `host` is the address of the mock bench.
    """

    def __init__(self, folder: Path, host: str) -> None:
        self.observed = Observed()
        self._host = host
        world = folder / "world.json"
        self._frame = np.array(build(WorldConfig, read_yaml(world), str(world)).contact_frame)
        self._clock = SystemClock()
        self._records = {
            name: (
                AwaitedRecord(folder / f"{name}.latest", latest_dtype(name, (16, 3))),
                AwaitedRecord(folder / f"{name}.counters", COUNTERS),
            )
            for name in SPECS
        }
        self._stopping = threading.Event()
        self._thread = threading.Thread(target=self._run, name="observer", daemon=True)
        self._thread.start()

    def close(self) -> Observed:
        """Observe a last time, stop, and return the observations. May be called twice."""
        if not self._stopping.is_set():
            self._stopping.set()
            self._thread.join()
            self._look()
        return self.observed

    def _run(self) -> None:
        tick = 0
        while not self._stopping.wait(_PERIOD):
            self._look()
            tick += 1
            if tick % _ARM_EVERY == 0:
                self._ask_arm()

    def _look(self) -> None:
        rows, shown = self.observed.rows, self.observed.shown
        for name, records in self._records.items():
            newest, count = (record.read() for record in records)
            if count is not None:
                rows[name] = max(rows.get(name, 0), int(count["rows"]))
            if newest is not None and rows.get(name, 0) > 0:
                shown.setdefault(name, set()).add(int(newest["t_ns"]))

    def _ask_arm(self) -> None:
        try:
            state = emulation.inject(self._host, PORTS["arm"], "state")
        except (OSError, ValueError):
            # The controller is gone, so the last state heard stays, with its time.
            if self.observed.arm_silent_ns is None:
                self.observed.arm_silent_ns = self._clock.now_ns()
            return
        self.observed.arm_silent_ns = None
        height = float(compose(invert(self._frame), state["pose"])[2])
        speed = float(np.linalg.norm(state["speed"][:3]))
        self.observed.arm = ArmState(self._clock.now_ns(), height, speed)
