"""Collection of a hand's session: squeezes objects by a plan, and checks that each hold is steady.

The gripper opens only after somebody carries the object: on any error it stays where it is.
"""

import logging
import sys
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from recorder.command_line.errors import EXIT_DEVICE_LOST, EXIT_DONE
from recorder.errors import SessionError
from recorder.session import SessionWriter, Stream, StreamWriter
from recorder.spec import OUTCOMES, PHASES, action_spec
from rig.acquire.collector import EXIT_CODES, close_session, show_session, software, states_of
from rig.acquire.control import InterruptFlag
from rig.acquire.plan_runner import reference_columns
from rig.acquire.streams import Streams, check_devices, notes_on
from rig.bench.pair import FINGERS, PairBench, PairFile
from rig.core.clock import SECOND_NS, ClockAnchor, SystemClock
from rig.core.errors import DeviceLost
from rig.core.load import explained
from rig.core.names import operator_name
from rig.devices.gripper.robotiq_wire import AT_POSITION, MOVING, STOPPED_CLOSING
from trajectories import SqueezeStep

logger = logging.getLogger(__name__)

# Samples compared of each part of a hold, and of a rest without contact.
_SAMPLES = 4
# Change of a signal over its change at rest that is motion, or contact; and the least of both
# [grey levels or counts].
_MOTION, _CONTACT, _LEAST = 3.0, 3.0, {"camera": 0.3, "taxels": 2.0}
# Time until the gripper rests [s], and between two looks [ns].
_RESTS, _LOOK_NS = 10.0, 20_000_000


class Hands(Protocol):
    """Hands of the operator, or those of a mock's World."""

    def turn(self, down: tuple[float, float, float]) -> None:
        """Turn the empty hand until gravity points along `down` in its frame."""

    def place(self, number: int | None) -> None:
        """Hold an object between the fingers; None: take it away."""

    def carry(self, lifted: bool) -> None:
        """Leave the object to the fingers (True), or support it again."""


class Squeezing:
    """Runs the steps of a session whose streams record."""

    def __init__(
        self,
        bench: PairBench,
        streams: Streams,
        writer: SessionWriter,
        hands: Hands,
        interrupt: InterruptFlag,
    ) -> None:
        self._bench, self._plan = bench, bench.squeeze
        self._streams, self._writer = streams, writer
        self._hands, self._interrupt = hands, interrupt
        self._clock = SystemClock()
        self._action = StreamWriter.open(writer.stream_path("action"))
        self._signals = {name: Stream(writer.stream_path(name), live=True) for name in FINGERS}
        self._rest: dict[str, tuple[np.ndarray, float]] = {}
        self._lost = False
        self.done = self.unsteady = 0
        """Steps that were held, and those of them that were not steady."""
        self.aloft = False
        """True while only the fingers carry an object."""

    def close(self) -> None:
        """End the stream of commands; may be called twice."""
        self._action.close()

    def run(self, steps: list[SqueezeStep]) -> None:
        """Squeeze; release each object once it is supported."""
        for number, step in enumerate(steps):
            start_ns = self._clock.now_ns()
            self._go(self._width(step) - step.closing)
            if step.step == 0:
                self._hands.turn(step.turn)
            if step.lifted and not self.aloft:
                self._hands.carry(True)
                self.aloft = True
            self._wait(self._plan.settle)
            held_ns = self._clock.now_ns()
            means = [row.name for row in self._bench.of_kind("taxels")] if not step.step else []
            measured = self._streams.measure(self._plan.hold, *means) if means else {}
            self._wait(0.0 if means else self._plan.hold)
            end_ns = self._clock.now_ns()
            why = ""
            if step.step == 0:
                self._refer(step, measured, held_ns, end_ns)
            elif why := self._unsteady(held_ns, end_ns, step):
                self.unsteady += 1
                logger.warning("step %d: not steady: %s; it is kept and marked", number + 1, why)
            outcome = "unsteady" if why else "complete"
            self._segment(number, "normal_inc", outcome, start_ns, end_ns)
            self.done += 1
            if step.step == 0:
                self._hands.place(step.object)
            elif number + 1 == len(steps) or steps[number + 1].step == 0:
                self._release(number, step)

    def _width(self, step: SqueezeStep) -> float:
        return self._bench.objects[step.object].width

    def _refer(
        self, step: SqueezeStep, measured: dict[str, Any], start_ns: int, end_ns: int
    ) -> None:
        """Store the reference of an object at its turn."""
        self._lost = False
        self._writer.reference.append(
            **reference_columns(self._streams, measured), point=step.point, run=0, t_ns=end_ns
        )
        for name in FINGERS:
            first, last = self._parts(name, start_ns, end_ns)
            self._rest[name] = ((first + last) / 2, _rms(last - first))

    def _release(self, number: int, step: SqueezeStep) -> None:
        start_ns = self._clock.now_ns()
        if self.aloft:
            self._hands.carry(False)
            self.aloft = False
        self._go(self._width(step) + self._plan.clearance)
        self._segment(number, "normal_dec", "complete", start_ns, self._clock.now_ns())
        self._hands.place(None)

    def _segment(self, target: int, phase: str, outcome: str, start_ns: int, end_ns: int) -> None:
        codes = {"phase": PHASES.index(phase), "outcome": OUTCOMES.index(outcome)}
        self._writer.segments.append(
            target=target, run=0, start_ns=start_ns, end_ns=end_ns, **codes
        )

    def _go(self, opening: float) -> None:
        """Move the fingers and wait until they rest."""
        gripper, config = self._streams["gripper"], self._bench.gripper
        opening = config.opening(config.position(opening))
        command = {"value": opening, "speed": config.speed, "force": config.force}
        self._check()
        self._action.append(**command, by=0, t_ns=self._clock.now_ns())
        gripper.command(*command.values())
        deadline_ns = self._clock.now_ns() + round(_RESTS * SECOND_NS)
        while True:
            self._wait(_LOOK_NS / SECOND_NS)
            latest = gripper.latest()
            if latest is None or abs(latest["commanded"] - opening) > config.per_count / 2:
                state = MOVING
            else:
                state = int(latest["object"])
            if state in (AT_POSITION, STOPPED_CLOSING):
                return
            if self._clock.now_ns() > deadline_ns:
                raise DeviceLost(f"gripper: not at {1e3 * opening:.2f} mm after {_RESTS:g} s")

    def _wait(self, seconds: float) -> None:
        end_ns = self._clock.now_ns() + round(seconds * SECOND_NS)
        while (now_ns := self._clock.now_ns()) < end_ns:
            self._check()
            self._clock.sleep_until(min(now_ns + _LOOK_NS, end_ns))

    def _check(self) -> None:
        self._interrupt.check()
        self._streams.check()

    def _unsteady(self, start_ns: int, end_ns: int, step: SqueezeStep) -> str:
        """Return why a hold is no sample; empty if it is one."""
        for name in FINGERS:
            first, last = self._parts(name, start_ns, end_ns)
            rest, noise = self._rest[name]
            least = _LEAST[self._bench.row(name).kind]
            if _rms(last - first) > _MOTION * noise + least:
                return f"{name} moves"
            if self._lost or _rms(last - rest) < _CONTACT * noise + least:
                self._lost = self._lost or step.lifted
                return f"{name} touches nothing, or the object was lost before"
        gripper = Stream(self._writer.stream_path("gripper"), live=True)
        low, high = np.searchsorted(gripper.t_ns, (start_ns, end_ns))
        openings = gripper.array("value")[low:high]
        if not len(openings) or np.ptp(openings) > 0:
            return "the gripper moves"
        opening = self._width(step) - step.closing
        if abs(openings[0] - opening) > self._bench.gripper.per_count:
            return "the gripper stopped early"
        return ""

    def _parts(self, name: str, start_ns: int, end_ns: int) -> tuple[np.ndarray, np.ndarray]:
        """Return the mean of a finger's first and last samples between two times.

        Raises:
            DeviceLost: There are less than two.
        """
        stream = self._signals[name]
        stream.refresh()
        low, high = np.searchsorted(stream.t_ns, (start_ns, end_ns))
        if high - low < 2:
            raise DeviceLost(f"{name}: {high - low} samples in {(end_ns - start_ns) / 1e9:.1f} s")
        count = min(_SAMPLES, (high - low) // 2)
        if self._bench.row(name).kind == "camera":
            rows = [*range(low, low + count), *range(high - count, high)]
            values = stream.images(rows)
        else:
            values = stream.rows_between("value", int(low), int(high))
        first, last = values[:count], values[-count:]
        return first.mean(axis=0, dtype=float), last.mean(axis=0, dtype=float)


def _rms(change: np.ndarray) -> float:
    return float(np.sqrt(np.square(change).mean()))


def targets_of(bench: PairBench, steps: list[SqueezeStep]) -> dict[str, np.ndarray]:
    """Return the columns of `targets` of some steps, one row each."""
    objects = [bench.objects[step.object] for step in steps]
    widths = np.array([each.width for each in objects])
    return {
        "point": np.array([step.point for step in steps], np.int16),
        "object": np.array([step.object for step in steps], np.int16),
        "turn": np.array([step.turn for step in steps], float),
        "step": np.array([step.step for step in steps], np.int16),
        "opening": widths - np.array([step.closing for step in steps]),
        "width": widths,
        "mass": np.array([each.mass for each in objects]),
        "lifted": np.array([step.lifted for step in steps], np.int8),
    }


def collect_squeezes(
    file: PairFile,
    folder: Path,
    path: Path,
    hands: Hands,
    *,
    operator: str = "",
    most: int | None = None,
    watch: Callable[[], None] | None = None,
) -> int:
    """Record the squeezes of a bench whose devices are there, and return the exit code.

    Args:
        file: The bench, with the addresses of its devices.
        folder: Run folder for shared records.
        path: Session to write.
        hands: They turn the hand and hold the objects.
        operator: Name of the operator; empty: the login name.
        most: Number of steps to record; None: all.
        watch: Raises if an emulator is gone.
    """
    bench = file.bench
    steps = list(bench.squeeze.targets(len(bench.objects)))[:most]
    stop: BaseException | None = None
    with InterruptFlag() as interrupt, Streams(bench, folder, SystemClock(), watch) as streams:
        description, rates = check_devices(streams)
        interrupt.check()
        anchor = asdict(ClockAnchor.take())
        begun = {
            **anchor,
            "operator": operator_name(operator),
            "rates_hz": rates,
            "notes": notes_on(description, FINGERS, ()),
            "states": states_of(description),
            "bench": file.content,
            "devices": description,
        }
        writer = _created(file, path, steps, begun)
        writer.begin_run(begun)
        squeezing = Squeezing(bench, streams, writer, hands, interrupt)
        try:
            for handle in streams:
                handle.record(writer.stream_path(handle.name))
            squeezing.run(steps)
        except BaseException as error:
            # On any error the gripper stays as it is, and the session is closed.
            stop = explained(error, mock=bench.mock) if isinstance(error, DeviceLost) else error
            logger.error("stopping: %s", str(stop) or type(stop).__name__)
        interrupt.ignore()
        squeezing.close()
        reason = "" if stop is None else str(stop) or type(stop).__name__
        if squeezing.aloft:
            reason += "; THE HAND STILL HOLDS THE OBJECT: take it before the fingers open"
        status = "complete" if stop is None else "stopped"
        try:
            done = squeezing.done
            summaries = close_session(bench.rate_hz, streams, writer, status, reason, done)
        except SessionError as error:
            print(error, file=sys.stderr)
            return EXIT_DEVICE_LOST
    if stop is not None and not isinstance(stop, tuple(EXIT_CODES)):
        raise stop
    show_session(path, summaries)
    print(
        f"{status}: {done} of {len(steps)} steps, {squeezing.unsteady} not steady; {path}"
        + f" ({reason})" * bool(reason)
    )
    if stop is None:
        return EXIT_DONE
    return next(code for kind, code in EXIT_CODES.items() if isinstance(stop, kind))


def _created(
    file: PairFile, path: Path, steps: list[SqueezeStep], begun: dict[str, Any]
) -> SessionWriter:
    bench = file.bench
    names = [each.name for each in bench.objects]
    attrs = {
        "mock": bench.mock,
        "sensor": bench.sensor,
        "fingers": {name: finger.sensor for name, finger in bench.fingers.items()},
        "indenter": "-".join(names),
        "operator": begun["operator"],
        "plan": {"kind": bench.squeeze.KIND, **asdict(bench.squeeze), "objects": names},
        "targets_wanted": len(steps),
        "bench": file.content,
        "rate_hz": bench.rate_hz,
        "started_utc": f"{np.datetime64(begun['utc_ns'], 'ns')}Z",
        "clock": "CLOCK_MONOTONIC",
        "t0_ns": begun["t0_ns"],
        "software": software(),
    }
    rows = [row.spec(begun["devices"][row.name], row.rate_hz) for row in bench.rows]
    targets = targets_of(bench, steps)
    return SessionWriter.create(path, attrs=attrs, streams=[*rows, action_spec()], targets=targets)
