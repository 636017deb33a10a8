"""A bench without processes on a clock that runs as fast as it is computed.

The code that decides is that of the rig: the procedure without a gauge, the plan runner, the mover
and its guards, the loops of the streams. The arm's kinematics, the wrist and the World are those of
the mock bench. Replaced are only the connections: each sample arrives after a fixed delay, and no
command passes through a pipe.
"""

from __future__ import annotations

import heapq
import math
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np

from benchmarks.fake_clock import FakeClock
from rig.acquire.control import Control, Interlocks
from rig.acquire.plan_runner import LiveLine, PlanRunner, rise_clear, zero_stand_ins
from rig.acquire.signal_level import grey
from rig.acquire.stream_process import COUNTERS, _StreamLoop
from rig.acquire.streams import StreamHandle, Streams, check_clear
from rig.bench.bench import Bench
from rig.bench.guards import guard_limits, guards_of
from rig.bench.worlds import Noise, WorldSpec
from rig.core.clock import SECOND_NS
from rig.core.geometry import compose, matrix_from_vector
from rig.core.samples import SIGNAL_LATEST
from rig.core.shared_memory import SharedLatest
from rig.devices.arm.arm import Arm
from rig.devices.arm.emulated_arm import CYCLE, Robot, Wrist
from rig.devices.arm.messages import Command, Order, Reply
from rig.devices.arm.mover import Mover, Watch
from rig.mock.world.ladder import LadderSurface, LadderWorld
from rig.mock.world.picture import MarkerPicture
from rig.mock.world.sensors import markers_of, pad_of
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
    """True state of the bench, which its file does not know: sensor, indenter, noise, and errors.

    The surface is higher than stated [m] and turned about x and y of the contact frame [rad], the
    indenter longer than the stated TCP [m]. After a time [s] the signal repeats its last sample, or
    is silent. `wrist` is the arm's wrench, None for an arm without one.
    """

    world: WorldSpec
    indenter: str = "cylinder"
    surface: float = 0.0
    tilt: tuple[float, float] = (0.0, 0.0)
    longer: float = 0.0
    frozen_at: float = math.inf
    silent: bool = False
    wrist: Wrist | None = None
    seed: int = 0


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
        self._world = LadderWorld(truth.world, truth.indenter, tuple(frame.tolist()))
        # The tool never turns, so the tip's true place differs by one constant.
        self._longer = np.zeros(6)
        self._longer[:3] = matrix_from_vector(start[3:])[:, 2] * truth.longer
        # Everything that can be touched lies below the plane through the true apex.
        self._origin, self._normal = frame[:3], matrix_from_vector(frame[3:])[:, 2]
        self._state: np.void | None = None
        self._picture = _Picture(bench, truth, np.random.default_rng(truth.seed))
        self._movement: Iterator[None] | None = None
        self._operation, self.largest = 0, 0.0
        self.streams: dict[str, _Stream] = {}
        """Streams that record now, by name."""
        self._fresh: list[dict[str, Any]] = []
        # Samples on their way: when they arrive [ns], number of the cycle, stream and value.
        self._under_way: list[tuple[int, int, str, np.ndarray]] = []
        self._ticks = 0
        self._last: np.ndarray | None = None
        signal = bench.signal
        self._delay = CAMERA_DELAY if signal and signal.kind == "camera" else TAXELS_DELAY
        self._signal_every = max(round(1 / (signal.rate_hz * CYCLE)), 1) if signal else 10**9

    def start_stream(self, name: str, bench: Bench, folder: Path) -> _Stream:
        """Record a stream from now on, in place of the one of that name."""
        self.streams[name] = _Stream(name, bench, folder, self)
        return self.streams[name]

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
        while self._under_way and self._under_way[0][0] <= self._now_ns:
            _, _, name, value = heapq.heappop(self._under_way)
            self.streams[name].take({"t_ns": self._now_ns, "value": value})
        if self._ticks % 2:
            return
        tip = self.robot.pose + self._longer
        if self._state is None or float((tip[:3] - self._origin) @ self._normal) < _FREE:
            self._state = self._world.step(self._now_ns, tip)
            force = float(np.linalg.norm(self._state["wrench"][:3]))
            self.largest = max(self.largest, force)
        seconds = self._now_ns / SECOND_NS
        sample = {"t_ns": self._now_ns, "value": self.robot.pose.copy(), "safety_status": 1}
        sample |= {"speed": self.robot.speed.tolist(), "speed_fraction": 1.0}
        self._fresh.append(sample)
        # Columns that nothing here reads.
        unread = {"device_t": seconds, "runtime_state": 0, "speed_scaling": 1.0}
        self.streams["pose"].take(sample | unread)
        if self._ticks % 4 == 0 and self.truth.wrist is not None:
            for row in self.bench.of_kind("arm_wrench"):
                wrench = self.truth.wrist.reported(self._state["wrench"], seconds)
                self._send(row.name, wrench, WRENCH_DELAY)
        if self.bench.signal is not None and self._ticks % (2 * (self._signal_every // 2)) == 0:
            frozen = seconds > self.truth.frozen_at
            if not frozen or self._last is None:
                self._last = self._picture.taken(self._state)
            if not (frozen and self.truth.silent):
                self._send(self.bench.signal.name, self._last, self._delay)

    def _send(self, name: str, value: np.ndarray, delay: float) -> None:
        due_ns = self._now_ns + round(delay * SECOND_NS)
        heapq.heappush(self._under_way, (due_ns, self._ticks, name, value))


class _Picture:
    """Readings of the sensor as `SignalLevel` takes them: counts, or a reduced grey image."""

    def __init__(self, bench: Bench, truth: Truth, rng: np.random.Generator) -> None:
        world, self._rng = truth.world, rng
        self._noise = (world.noise or Noise()).counts
        self._taxels = bench.taxels is not None
        if self._taxels:
            points, counts = pad_of(world)
            self._read: Callable[[np.ndarray], np.ndarray] = counts
        else:
            markers = markers_of(world)
            picture = MarkerPicture(background=world.background, ink=world.ink)
            points = markers.points
            self._read = lambda moved: grey(picture.image(markers.outlines(moved)))
        self._surface = LadderSurface(world, truth.indenter, points)
        self._rest: np.ndarray | None = None
        self._noises = rng.normal(0.0, _REDUCED_NOISE, (120 + 64, 160 + 64))

    def taken(self, state: np.void) -> np.ndarray:
        """Return the reading of a WORLD_STATE."""
        image = self._rest
        if image is None or state["depth"] > 0:
            image = self._read(self._surface(state))
        if state["depth"] <= 0:
            self._rest = image
        if self._taxels:
            noise = self._rng.normal(0.0, self._noise, image.shape)
            return np.asarray(np.rint(image + noise), np.float32)
        top, left = self._rng.integers(0, 64, 2)
        noise = self._noises[top : top + image.shape[0], left : left + image.shape[1]]
        return np.asarray(np.rint(image + noise), np.float32)


class _Stream(StreamHandle):
    """A stream whose loop takes its samples in this process."""

    def __init__(self, name: str, bench: Bench, folder: Path, clock: SimulatedBench) -> None:
        self.name, self.kind, self._clock = name, bench.row(name).kind, clock
        dtype = bench.row(name).latest
        self._latest = SharedLatest.create(folder / f"{name}.latest", dtype, _SLOTS)
        self._counters = SharedLatest.create(folder / f"{name}.counters", COUNTERS)
        self._signal = SharedLatest.create(folder / f"{name}.signal", SIGNAL_LATEST, _SLOTS)
        driver: Any = SimpleNamespace(dropped=0, rejected={})
        pipe: Any = SimpleNamespace(send=lambda message: None)
        self._loop = _StreamLoop(name, bench, folder, pipe, driver, clock)
        self._samples: list[dict[str, Any]] = []

    def take(self, sample: dict[str, Any]) -> None:
        """Record a sample and publish it."""
        self._samples.append(sample)
        self._loop._take(sample)

    def check(self) -> None:
        """Do nothing: no process can end."""

    def recorded(self) -> Any:
        """Return the samples, with the parts of a `Stream` that the procedure reads."""
        values = [sample["value"] for sample in self._samples]
        return SimpleNamespace(
            traits=SimpleNamespace(kind=self.kind),
            t_ns=np.array([sample["t_ns"] for sample in self._samples], np.int64),
            array=lambda name: values,
            jpeg=lambda row: None,
            images=lambda rows: np.zeros((1, 2, 2, 3), np.uint8),
        )

    def _send(self, command: str, argument: Any) -> None:
        getattr(self._loop, f"_on_{command}")(argument)

    def _answer(self, word: str, seconds: float) -> Any:
        window = self._loop._measurement
        if word != "measured" or window is None:
            return None
        self._clock.sleep_until(window.end_ns)
        return window.result()


class _Arm(Arm):
    """An arm whose mover runs in this process."""

    def __init__(self, clock: SimulatedBench, bench: Bench, folder: Path, contact: float) -> None:
        guards = guards_of(bench, folder, contact=contact)
        frame, limits = bench.contact_frame, guard_limits(bench)
        super().__init__(bench.arm, frame, limits, pose_path=None, guards=guards, clock=clock)
        world: Any = clock
        self._on_wait: Callable[[], None] | None = None
        self._looked_ns = 0
        watch = Watch(self._setup, world, clock)
        self._mover = Mover(self._setup, world, watch, clock, self._interrupted)
        self._mover.wait_for_pose(1.0)

    def check(self) -> None:
        """Do nothing: between two commands, no guard looks."""

    def _ask(
        self,
        make: Callable[[int], Command],
        timeout: float,
        on_wait: Callable[[], None] | None = None,
        wake: Any = None,
    ) -> Reply:
        command, self._on_wait = make(next(self._numbers)), on_wait
        if isinstance(command, Order):
            self._mover.halt()
            if command.what == "halt":
                return Reply(command.number, "done", 0, self._clock.now_ns())
            command = self._mover.retract_command(command.number)
        else:
            # The arm's process looks between its moves too; what it sees then stops no move.
            self._mover.step("retreat")
        return self._mover.move(command, lambda limit: None)

    def _interrupted(self) -> bool:
        now_ns = self._clock.now_ns()
        if self._on_wait is not None and now_ns - self._looked_ns > SECOND_NS // 20:
            self._looked_ns = now_ns
            self._on_wait()
        return False


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
        targets: Iterable[Target] | None = None,
    ) -> Any:
        """Press `targets` of `plan`, all by default, and return the recorded stage.

        It has the parts of a `Session` that the procedure reads. SafetyStop or DeviceLost is raised
        if the stage was stopped, after the arm has retracted; see `rig.acquire.no_gauge.Record`.
        """
        clock, self.stage = self._clock, what
        self._number += 1
        folder = clock.folder / str(self._number)
        folder.mkdir()
        bench = prepared(clock.bench)
        bench.check_limits(plan)
        streams = Streams(bench, folder, clock, start=clock.start_stream)
        rows: list[dict[str, Any]] = []

        def recorded() -> Any:
            names = ("target", "phase", "outcome", "start_ns", "end_ns")
            return SimpleNamespace(
                path=folder / "stage.zarr",
                segments={name: np.array([row[name] for row in rows]) for name in names},
                attrs={"contact_frame": list(bench.contact_frame)},
                signal=None if bench.signal is None else bench.signal.name,
                streams={name: stream.recorded() for name, stream in clock.streams.items()},
                first=lambda kind: bench.of_kind(kind)[0].name,
            )

        def after(target: Target) -> None:
            if after_target is not None:
                after_target(target, recorded())

        def zero() -> None:
            names = [row.name for row in bench.of_kind("arm_wrench")] or ["pose"]
            zero_stand_ins(streams, streams.measure(bench.preflight.tare_window, *names))

        writer: Any = SimpleNamespace(
            segments=SimpleNamespace(append=lambda **row: rows.append(row)),
            reference=SimpleNamespace(append=lambda **row: None),
        )
        live = LiveLine(streams, [0.0] * len(plan))
        with Interlocks(bench, Control(), clock) as interlocks:
            streams.measure(bench.preflight.rate_window)
            check_clear(streams)
            zero()
            arm = _Arm(clock, bench, folder, contact_change)
            runner = PlanRunner(
                streams, arm, interlocks, writer, live, plan, after_target=after, run=0, zeros={}
            )
            try:
                rise_clear(streams, arm, interlocks)
                zero()
                runner.press(plan.targets() if targets is None else targets)
            finally:
                arm.retract()
        return recorded()
