"""Emulated sensor of a mock bench, pressed by an emulated finger instead of the arm.

Watching live forces moves no arm, so on a mock bench something else must touch the sensor: the
finger follows the bench's trajectory, target after target, once it is started.
"""

import itertools
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from rig.bench.bench import Bench, BenchFile
from rig.core.clock import SECOND_NS, Clock, Pacer, SystemClock
from rig.core.errors import DeviceLost
from rig.core.geometry import transform
from rig.core.mock_names import ARM_FILE, WORLD_FILE
from rig.core.samples import ARM_TRUTH, WORLD_STATE
from rig.core.shared_memory import SharedLatest
from rig.devices import registry
from rig.mock.bench import MockBench
from rig.mock.world.truth import Truth
from trajectories import Point

# Rate of a UR3's controller; motion between two states is a straight line.
_RATE_HZ = 125
# Step between the targets pressed: consecutive ones differ little, these in depth and direction.
_STRIDE = 37
_SENSORS = ("camera", "taxels")
# Longest time for the World's process to end [s].
_END_TIMEOUT = 5.0
# Longest time for the World's first state [s].
_FIRST_TIMEOUT = 10.0


class TouchedMock(MockBench):
    """Context manager for the emulated sensor of a mock bench and its World."""

    def __init__(self, file: BenchFile, folder: Path, *, rate_hz: float | None = None) -> None:
        self._truth_path = folder / "truth.log"
        super().__init__(_at_rate(file, rate_hz), folder, truth=self._truth_path, devices=_SENSORS)
        self._finger: _Finger | None = None

    def press(self) -> None:
        """Start the finger, which waits clear of the surface until then."""
        if self._finger is not None:
            self._finger.go.set()

    def wrench(self, t_ns: np.ndarray) -> np.ndarray:
        """Return the World's true wrench at times (n,) [ns]: (n, 6) [N, N m]. Ends the World."""
        # Its log is complete only after it has ended.
        world = self.processes["world"]
        world.terminate()
        world.wait(_END_TIMEOUT)
        return Truth(self._truth_path).wrench(t_ns)

    def close(self) -> None:
        """End finger and emulators; may be called twice."""
        if self._finger is not None:
            self._finger.close()
            self._finger = None
        super().close()

    def _start(self) -> None:
        super()._start()
        clock = SystemClock()
        self._finger = _Finger(self._folder / ARM_FILE, self.bench, clock)
        states = SharedLatest.attach(self._folder / WORLD_FILE, WORLD_STATE)
        # Before its first state an emulator would serve zeros, which are not valid counts.
        latest_ns = clock.now_ns() + round(_FIRST_TIMEOUT * SECOND_NS)
        while not states.count:
            if clock.now_ns() > latest_ns:
                raise DeviceLost(f"world: no state in {_FIRST_TIMEOUT:g} s")
            self.check()
            clock.sleep_until(clock.now_ns() + SECOND_NS // _RATE_HZ)
        states.close()


class _Finger:
    """Writes the tip's position in place of the emulated arm."""

    def __init__(self, arm: Path, bench: Bench, clock: Clock) -> None:
        self.go = threading.Event()
        """Set to start the finger."""
        self._arm = SharedLatest.attach(arm, ARM_TRUTH, writable=True)
        self._bench, self._clock = bench, clock
        self._ending = threading.Event()
        self._thread = threading.Thread(target=self._run, name="finger")
        self._thread.start()

    def close(self) -> None:
        """Stop; may be called twice."""
        self._ending.set()
        self._thread.join()
        self._arm.close()

    def _run(self) -> None:
        bench = self._bench
        way = _way(bench)
        tip, _ = next(way)
        goal, speed = next(way)
        pacer = Pacer(self._clock, _RATE_HZ)
        before_ns = self._clock.now_ns()
        pose = np.array([0.0, 0.0, 0.0, *bench.tool_rotation])
        while not self._ending.is_set():
            now_ns = pacer.wait()
            left = (now_ns - before_ns) / SECOND_NS if self.go.is_set() else 0.0
            before_ns = now_ns
            while left > 0:
                ahead = np.subtract(goal, tip)
                length = float(np.linalg.norm(ahead))
                if length > speed * left:
                    tip = tuple((tip + ahead * (speed * left / length)).tolist())
                    break
                tip, left = goal, left - length / speed
                goal, speed = next(way)
            pose[:3] = transform(bench.world_frame or bench.contact_frame, tip)
            self._arm.write((now_ns, pose, np.zeros(6)))


def _way(bench: Bench) -> Iterator[tuple[Point, float]]:
    """Yield the tip's goals [m] and speeds [m/s], endlessly; the tip waits at the first goal."""
    plan, arm = bench.trajectory, bench.arm
    targets = list(plan.targets())
    for count in itertools.count():
        target = targets[count * _STRIDE % len(targets)]
        yield target.origin, arm.travel_speed
        for move in plan.moves(target):
            yield move.end, arm.speed


def _at_rate(file: BenchFile, rate_hz: float | None) -> BenchFile:
    if rate_hz is None:
        return file
    content = file.content
    faster: dict[str, Any] = {
        name: {**content[name], "rate_hz": rate_hz}
        for name in _SENSORS
        if isinstance(content.get(name), dict)
    }
    if isinstance(streams := content.get("streams"), dict):
        faster["streams"] = {
            name: {**section, "rate_hz": rate_hz}
            if registry.device(section["kind"]).stream in _SENSORS
            else section
            for name, section in streams.items()
        }
    return BenchFile.of({**content, **faster}, file.path)
