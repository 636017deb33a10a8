"""A bench without processes on a clock that runs as fast as it is computed.

The code that decides is that of the rig: the procedure without a gauge, the plan runner, the mover
and its guards, the level of the signal. The arm's kinematics, the wrist and the World are those of
the mock bench. Replaced are only the connections: each sample arrives after a fixed delay, and is
published in the same shared records.
"""

from __future__ import annotations

import contextlib
import dataclasses
import itertools
import math
from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np

from rig.acquire.control import Control
from rig.acquire.plan_runner import PlanRunner, require_arrival, zero_stand_ins
from rig.acquire.signal_level import SignalLevel, grey
from rig.acquire.streams import check_clear, tip_position
from rig.bench.bench import Bench
from rig.bench.guards import guard_limits, guards_of
from rig.bench.worlds import AnalyticSpec
from rig.core.clock import SECOND_NS, FakeClock
from rig.core.errors import DeviceLost, SafetyStop
from rig.core.geometry import compose, matrix_from_vector
from rig.core.samples import FORCE_LATEST, SIGNAL_LATEST
from rig.core.shared_memory import SharedLatest
from rig.devices.arm.arm import MoveResult
from rig.devices.arm.emulated_arm import CYCLE, Robot, Wrist
from rig.devices.arm.messages import Move, Setup
from rig.devices.arm.mover import Mover, Watch
from rig.mock.world.analytic import AnalyticWorld, surface_of
from rig.mock.world.picture import MarkerCamera
from trajectories import Plan, Target

_CYCLE_NS = round(CYCLE * SECOND_NS)
# Delays of samples from the World to the guard [s]: exposure, transfer, decoding; 60 Hz taxels.
CAMERA_DELAY, TAXELS_DELAY, WRENCH_DELAY = 0.09, 0.03, 0.012
_START_HEIGHT = 0.012
# Above this height over everything, the World has nothing to compute [m].
_FREE = 1e-3
# Images are drawn in full and compared at a quarter: noise of a reduced pixel.
_REDUCED_NOISE = 0.25
# Records that a look of the guard can find, however long the simulated bench rested before.
_SLOTS = 4096


@dataclass(frozen=True, slots=True)
class Truth:
    """True state of the bench, which its file does not know."""

    world: AnalyticSpec
    """Sensor and indenter."""
    surface: float = 0.0
    """Height of the true surface above the stated one [m]."""
    tilt: tuple[float, float] = (0.0, 0.0)
    """Rotation of the surface about x and y of the contact frame [rad]."""
    longer: float = 0.0
    """Length of the indenter beyond the stated TCP [m]."""
    frozen_at: float = math.inf
    """Time after which the signal repeats its last sample [s]."""
    silent: bool = False
    """True if it sends nothing at all then."""
    wrist: Wrist | None = None
    """The arm's wrench; None for an arm without one."""
    seed: int = 0
    """Seed of the noise."""


class SimulatedBench(FakeClock):
    """Arm, World and streams, driven by the clock: every wait advances all of them.

    `bench` is as its file describes it, `truth` as it is; `folder`, empty, is for shared records.
    """

    def __init__(self, bench: Bench, truth: Truth, folder: Path) -> None:
        super().__init__(SECOND_NS)
        self.bench, self.truth, self.folder = bench, truth, folder
        start = bench.tool_pose((0.0, 0.0, _START_HEIGHT))
        self.robot = Robot(start, np.array(bench.arm.tcp))
        place = (0.0, 0.0, truth.surface, *truth.tilt, 0.0)
        frame = compose(bench.contact_frame, place)
        # Counts are computed when they are sampled, the force at every step.
        stepped = dataclasses.replace(truth.world, taxels=None)
        self._world = AnalyticWorld(stepped, tuple(frame.tolist()))
        # The tool never turns, so the tip's true place differs by one constant.
        self._longer = np.zeros(6)
        self._longer[:3] = matrix_from_vector(start[3:])[:, 2] * truth.longer
        # Everything that can be touched lies below the plane through the true apex.
        self._origin, self._normal = frame[:3], matrix_from_vector(frame[3:])[:, 2]
        self._reach = _FREE
        self._state: np.void | None = None
        self._rng = np.random.default_rng(truth.seed)
        self._picture = _Picture(truth.world, self._rng)
        self._movement: Iterator[None] | None = None
        self._operation, self.largest = 0, 0.0
        self.poses: list[tuple[int, np.ndarray]] = []
        self.signals: list[tuple[int, np.ndarray]] = []
        self.wrenches: list[tuple[int, np.ndarray]] = []
        self._fresh: list[dict[str, Any]] = []
        self._under_way: deque[tuple[int, Callable[[int], None]]] = deque()
        self._ticks = 0
        self._last: np.ndarray | None = None
        signal = bench.signal
        self._delay = CAMERA_DELAY if signal and signal.kind == "camera" else TAXELS_DELAY
        self._signal_every = max(round(1 / (signal.rate_hz * CYCLE)), 1) if signal else 10**9
        self.level = SignalLevel(is_image=bool(signal and signal.kind == "camera"))
        self.zeros = np.zeros(6)
        self._published: dict[str, SharedLatest] = {}
        self._fresh_ns = 0

    def publish_in(self, folder: Path) -> None:
        """Create the shared records of a stage."""
        folder.mkdir()
        signal = self.bench.signal
        names = {f"{signal.name}.signal": SIGNAL_LATEST} if signal else {}
        names |= {f"{row.name}.latest": FORCE_LATEST for row in self.bench.of_kind("arm_wrench")}
        for record in self._published.values():
            record.close()
        self._published = {
            name: SharedLatest.create(folder / name, dtype, _SLOTS) for name, dtype in names.items()
        }
        self.level = SignalLevel(is_image=bool(signal and signal.kind == "camera"))

    def sleep_until(self, deadline_ns: int) -> None:
        """Advance arm, World and streams to `deadline_ns`."""
        while self._now_ns + _CYCLE_NS <= deadline_ns:
            self._now_ns += _CYCLE_NS
            self._cycle()
        self._now_ns = max(self._now_ns, deadline_ns)

    # The calls of `RtdeLink` and of `UrControl`.

    def receive(self, timeout: float) -> list[dict[str, Any]]:
        """Return the poses since the last call, after `timeout` [s]."""
        self.sleep_until(self._now_ns + round(timeout * SECOND_NS))
        poses, self._fresh = self._fresh, []
        return poses

    def kick(self, *_: Any) -> bool:
        """Return True: the watchdog is never late, no pose out of reach, no line broken."""
        return True

    connected = reaches = kick

    def start_move(self, pose: list[float], speed: float, acceleration: float) -> bool:
        """Begin a linear move."""
        self._operation += 1
        self._movement = self.robot.move_linear(np.array(pose), acceleration, speed)
        return True

    def start_stop(self, deceleration: float) -> None:
        """Begin to stop."""
        self._operation += 1
        self._movement = self.robot.stop(deceleration)

    def operation(self) -> tuple[int, bool]:
        """Return the number of the newest move or stop, and True while it runs."""
        return self._operation, self._movement is not None

    def _cycle(self) -> None:
        self._ticks += 1
        before = self.robot.pose
        if self._movement is not None and next(self._movement, True):
            self._movement = None
        self.robot.end_cycle(before)
        now_ns = self._now_ns
        while self._under_way and self._under_way[0][0] <= now_ns:
            self._under_way.popleft()[1](now_ns)
        if self._ticks % 2:
            return
        tip = self.robot.pose + self._longer
        if self._state is None or float((tip[:3] - self._origin) @ self._normal) < self._reach:
            self._state = self._world.step(now_ns, tip)
            force = float(np.linalg.norm(self._state["wrench"][:3]))
            self.largest = max(self.largest, force)
        state = self._state
        sample = {"t_ns": now_ns, "value": tuple(self.robot.pose.tolist()), "safety_status": 1}
        sample |= {"speed": tuple(self.robot.speed.tolist()), "speed_fraction": 1.0}
        self._fresh.append(sample)
        self.poses.append((now_ns, self.robot.pose.copy()))
        if self._ticks % 4 == 0 and self.truth.wrist is not None:
            wrench = self.truth.wrist.reported(state["wrench"], now_ns / SECOND_NS)
            self._later(WRENCH_DELAY, lambda t_ns: self._take_wrench(t_ns, wrench))
        if self._ticks % (2 * (self._signal_every // 2)) == 0:
            self._capture(state)

    def _capture(self, state: np.void) -> None:
        frozen = self._now_ns / SECOND_NS > self.truth.frozen_at
        if frozen and self.truth.silent:
            return
        if not frozen or self._last is None:
            self._last = self._picture.taken(state)
        reading = self._last
        self._later(self._delay, lambda t_ns: self._take_signal(t_ns, reading))

    def _later(self, delay: float, action: Callable[[int], None]) -> None:
        due_ns = self._now_ns + round(delay * SECOND_NS)
        self._under_way.append((due_ns, action))
        # Delays differ by stream.
        self._under_way = deque(sorted(self._under_way, key=lambda each: each[0]))

    def _take_wrench(self, t_ns: int, wrench: np.ndarray) -> None:
        self.wrenches.append((t_ns, wrench))
        for name, record in self._published.items():
            if name.endswith(".latest"):
                record.write((t_ns, 0, wrench - self.zeros))

    def _take_signal(self, t_ns: int, reading: np.ndarray) -> None:
        self.signals.append((t_ns, reading))
        level = self.level.of(reading)
        self._fresh_ns = t_ns if level.fresh else self._fresh_ns
        for name, record in self._published.items():
            if name.endswith(".signal"):
                record.write((t_ns, self._fresh_ns, level.change, level.motion))

    def newest_signal(self) -> np.void | None:
        """Return the newest SIGNAL_LATEST."""
        return next(
            (rec.read() for name, rec in self._published.items() if name.endswith(".signal")), None
        )


class _Picture:
    """Readings of the sensor as `SignalLevel` takes them: counts, or a reduced grey image."""

    def __init__(self, world: AnalyticSpec, rng: np.random.Generator) -> None:
        self._world, self._rng = world, rng
        self._noise = world.noise
        self._camera = None if world.markers is None else MarkerCamera(world.markers)
        self._rest: np.ndarray | None = None
        self._noises = rng.normal(0.0, _REDUCED_NOISE, (120 + 64, 160 + 64))

    def taken(self, state: np.void) -> np.ndarray:
        """Return the reading of a WORLD_STATE."""
        if self._camera is None:
            taxels = self._world.taxels
            if taxels is None:
                raise ValueError("found a World without camera and taxels")
            counts = 0.0 if self._noise is None else self._noise.counts
            noise = self._rng.normal(0.0, counts, (16, 3))
            moved = surface_of(self._world, state).displacement(taxels.positions())
            return np.asarray(np.rint(taxels.counts(moved) + noise), np.float32)
        image = self._rest if state["depth"] <= 0 else None
        if image is None:
            image = grey(self._camera.image(surface_of(self._world, state)))
        if state["depth"] <= 0:
            self._rest = image
        top, left = self._rng.integers(0, 64, 2)
        noise = self._noises[top : top + image.shape[0], left : left + image.shape[1]]
        return np.asarray(np.rint(image + noise), np.float32)


class _Arm:
    """The calls of `Arm` that the plan runner makes, on a real `Mover`."""

    def __init__(self, clock: SimulatedBench, bench: Bench, folder: Path, contact: float) -> None:
        frame, guards = tuple(bench.contact_frame), guards_of(bench, folder, contact=contact)
        setup = Setup(bench.arm, frame, guard_limits(bench), None, tuple(guards.items()))
        world: Any = clock
        self._on_wait: Callable[[], None] | None = None
        self._clock, self._looked_ns = clock, 0
        self._mover = Mover(setup, world, Watch(setup, world, clock), clock, self._interrupted)
        self._mover.wait_for_pose(1.0)

    def _interrupted(self) -> bool:
        now_ns = self._clock.now_ns()
        if self._on_wait is not None and now_ns - self._looked_ns > SECOND_NS // 20:
            self._looked_ns = now_ns
            self._on_wait()
        return False

    def move(
        self,
        pose: Any,
        *,
        speed: float,
        acceleration: float,
        mode: Any,
        on_wait: Callable[[], None] | None = None,
        wake: Any = None,
    ) -> MoveResult:
        self._on_wait = on_wait
        target = tuple(np.asarray(pose, np.float64).tolist())
        # The arm's process looks between its moves too; what it sees then stops no move.
        self._mover.step("retreat")
        reply = self._mover.move(Move(2, target, speed, acceleration, mode), lambda limit: None)
        if reply.outcome == "device_lost":
            raise DeviceLost(reply.reason)
        if reply.outcome == "safety_stop":
            raise SafetyStop(reply.reason)
        return MoveResult(reply.outcome, reply.start_ns, reply.end_ns, reply.reason)

    def halt(self) -> None:
        self._mover.halt()

    def check(self) -> None:
        return

    def retract(self) -> None:
        """Move away, as after every stop."""
        self._on_wait = None
        self._mover.halt()
        if self._mover.latched is None:
            self._mover.move(self._mover.retract_command(3), lambda limit: None)


class _Streams:
    """All streams, as the plan runner uses them."""

    def __init__(self, clock: SimulatedBench, bench: Bench) -> None:
        self._clock = self.clock = clock
        self.bench = bench

    def __getitem__(self, name: str) -> Any:
        clock = self._clock

        def latest() -> Any:
            if clock.bench.row(name).kind == "pose":
                return {"value": clock.robot.pose, "t_ns": clock.now_ns()}
            return {"row": len(clock.signals) - 1, "t_ns": clock.now_ns()}

        def zero(value: np.ndarray | None) -> None:
            if value is None:
                clock.level.zero()
            else:
                clock.zeros = np.asarray(value)

        return SimpleNamespace(name=name, latest=latest, signal=clock.newest_signal, zero=zero)

    def check(self) -> None:
        return

    def measure(self, seconds: float, *names: str) -> dict[str, dict[str, Any]]:
        clock = self._clock
        start_ns = clock.now_ns()
        clock.sleep_until(start_ns + round(seconds * SECOND_NS))
        found: dict[str, dict[str, Any]] = {}
        for name in names:
            found[name] = {"t_ns": clock.now_ns()}
            rows = clock.wrenches if clock.bench.row(name).kind == "arm_wrench" else clock.signals
            values = [value for t_ns, value in rows[-400:] if t_ns > start_ns]
            if values and clock.bench.row(name).kind != "pose":
                found[name]["mean"] = np.mean(values, axis=0)
                found[name]["std"] = np.std(values, axis=0)
        return found


def _recorded(
    clock: SimulatedBench, bench: Bench, rows: list[dict[str, Any]], since: tuple[int, int]
) -> Any:
    """Return a stage, with the parts of a `Session` that the procedure reads.

    `rows` are its phases, and `since` the numbers of its first pose and signal.
    """
    names = rows[0] if rows else ("target", "phase", "outcome")
    signal = bench.signal
    name, kind = (None, "taxels") if signal is None else (signal.name, signal.kind)
    return SimpleNamespace(
        path=clock.folder / "stage.zarr",
        segments={name: np.array([row[name] for row in rows]) for name in names},
        attrs={"contact_frame": list(bench.contact_frame)},
        signal=name,
        streams={
            "pose": _column("pose", clock.poses[since[0] :]),
            str(name): _column(kind, clock.signals[since[1] :]),
        },
        first=lambda kind: "pose" if kind == "pose" else None,
    )


def _column(kind: str, samples: list[tuple[int, np.ndarray]]) -> Any:
    return SimpleNamespace(
        traits=SimpleNamespace(kind=kind),
        t_ns=np.array([t_ns for t_ns, _ in samples], np.int64),
        array=lambda name: [value for _, value in samples],
        jpeg=lambda row: None,
        images=lambda rows: np.zeros((1, 2, 2, 3), np.uint8),
    )


class Stages:
    """Records stages on a simulated bench; a `rig.acquire.no_gauge.Record`."""

    def __init__(self, clock: SimulatedBench) -> None:
        self._clock, self._number = clock, 0
        self.stage = ""
        """Stage that runs or ran last."""

    def __call__(
        self,
        what: str,
        plan: Plan,
        prepared: Callable[[Bench], Bench],
        *,
        contact_change: float = math.inf,
        after_target: Callable[[Target, Any], None] | None = None,
        total: int | None = None,
    ) -> Any:
        """Press `plan` and return the recorded stage; see `rig.acquire.no_gauge.Record`.

        Raises:
            SafetyStop, DeviceLost: The stage was stopped, and the arm has retracted.
        """
        clock, self.stage = self._clock, what
        self._number += 1
        folder = clock.folder / str(self._number)
        bench = prepared(clock.bench)
        bench.check_limits(plan)
        clock.publish_in(folder)
        since = (len(clock.poses), len(clock.signals))
        streams: Any = _Streams(clock, bench)
        rows: list[dict[str, Any]] = []

        def idle(*_: Any, **__: Any) -> None:
            return

        segments = SimpleNamespace(append=lambda **row: rows.append(row))
        writer: Any = SimpleNamespace(segments=segments, reference=SimpleNamespace(append=idle))
        calls = ("at", "ended", "end", "tick", "waiting", "waited")
        live: Any = SimpleNamespace(**dict.fromkeys(calls, idle))
        interlocks: Any = SimpleNamespace(
            control=Control(), check=idle, armed=lambda: True, disarm=idle, wake=None, wish=""
        )
        names = [row.name for row in bench.of_kind("arm_wrench")] or ["pose"]
        window = bench.preflight.tare_window
        streams.measure(bench.preflight.rate_window)
        check_clear(streams)
        zero_stand_ins(streams, streams.measure(window, *names))
        arm = _Arm(clock, bench, folder, contact_change)

        def after(target: Target) -> None:
            if after_target is not None:
                after_target(target, _recorded(clock, bench, rows, since))

        driven: Any = arm
        runner = PlanRunner(
            streams, driven, interlocks, writer, live, plan, after_target=after, run=0, zeros={}
        )
        try:
            x, y, z = tip_position(streams)
            pose, settings = bench.tool_pose((x, y, max(bench.arm.retract, z))), bench.arm
            speed, acceleration = settings.travel_speed, settings.travel_acceleration
            result = arm.move(pose, speed=speed, acceleration=acceleration, mode="travel")
            require_arrival(result, pressing=False)
            zero_stand_ins(streams, streams.measure(window, *names))
            runner.press(itertools.islice(plan.targets(), total))
        finally:
            with contextlib.suppress(SafetyStop, DeviceLost):
                arm.retract()
        return _recorded(clock, bench, rows, since)
