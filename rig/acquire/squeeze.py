"""Collection of a hand's session: squeezes objects by a plan, and checks that each hold is steady.

The gripper opens only after somebody carries the object: on any error it stays where it is.
"""

import logging
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from recorder.session import SessionWriter, Stream, StreamWriter
from recorder.spec import OUTCOMES, PHASES, action_spec
from rig.acquire.collector import close_session, exit_code, show_session, software, states_of
from rig.acquire.control import InterruptFlag
from rig.acquire.plan_runner import reference_columns
from rig.acquire.streams import Streams, check_devices, notes_on
from rig.bench.pair import FINGERS, PairBench, PairFile
from rig.core.clock import SECOND_NS, ClockAnchor, SystemClock
from rig.core.errors import DeviceLost
from rig.core.load import explained
from rig.core.names import operator_name
from rig.devices.gripper.robotiq_wire import AT_POSITION, STOPPED_CLOSING
from trajectories import SqueezeStep

logger = logging.getLogger(__name__)

# Pictures compared of each part of a hold.
_PICTURES = 4
# Change of a signal over that at rest which is motion or contact, and the least one [grey levels or
# counts].
_MOVES, _LEAST = 3.0, {"camera": 0.3, "taxels": 2.0}
# Part of gravity along the grip axis from which one finger is above the other.
_ABOVE = 0.5
# Time until the gripper rests, and between two looks [s]; its object detection then.
_RESTS, _LOOK = 10.0, 0.02
_AT_REST = (AT_POSITION, STOPPED_CLOSING)

# Hands of the operator, or those of a mock's World: "turn" the empty hand until gravity points
# along `down` (3,) in its frame; "place" the object `number` between the fingers, None: take it
# away; "carry" it by the fingers alone if `lifted`.
Hands = Callable[..., object]


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
        self._bench, self._streams, self._writer = bench, streams, writer
        self._hands, self._interrupt = hands, interrupt
        self._clock = SystemClock()
        self._action = StreamWriter.open(writer.stream_path("action"))
        self._rest: dict[str, tuple[np.ndarray, float]] = {}
        self._lost = False
        self.done = self.unsteady = 0
        """Steps that were held, and those of them that were not steady."""
        self.aloft = False
        """True while only the fingers carry an object."""
        self.closed = False
        """True while the fingers are closed on an object, or may be."""

    def close(self) -> None:
        """End the stream of commands; may be called twice."""
        self._action.close()

    def run(self, steps: list[SqueezeStep]) -> None:
        """Squeeze each object, and release it once it is supported."""
        plan = self._bench.squeeze
        self._hands("carry", lifted=False)  # the fingers may hold one from before
        for number, step in enumerate(steps):
            start_ns = self._clock.now_ns()
            self.closed = step.step > 0
            self._go(self._bench.objects[step.object].width - step.closing)
            if not step.step:
                self._hands("turn", down=step.turn)
            elif step.lifted and not self.aloft:
                self._hands("carry", lifted=True)
                self.aloft = True
            self._wait(plan.settle)
            held_ns = self._clock.now_ns()
            self._wait(plan.hold)
            end_ns = self._clock.now_ns()
            why = self._unsteady(held_ns, end_ns, step) if step.step else ""
            if why:
                self.unsteady += 1
                logger.warning("step %d: not steady: %s; it is kept and marked", number + 1, why)
            self._segment(number, "normal_inc", "unsteady" if why else "complete", start_ns, end_ns)
            self.done += 1
            if not step.step:
                self._refer(held_ns, end_ns, step.point)
                self._hands("place", number=step.object)
            elif number + 1 == len(steps) or not steps[number + 1].step:
                self._release(number, step)

    def _release(self, number: int, step: SqueezeStep) -> None:
        start_ns = self._clock.now_ns()
        if self.aloft:
            self._hands("carry", lifted=False)
            self.aloft = False
        self._go(self._bench.objects[step.object].width + self._bench.squeeze.clearance)
        self.closed = False
        self._segment(number, "normal_dec", "complete", start_ns, self._clock.now_ns())
        self._hands("place", number=None)

    def _segment(self, target: int, phase: str, outcome: str, start_ns: int, end_ns: int) -> None:
        codes = {"phase": PHASES.index(phase), "outcome": OUTCOMES.index(outcome)}
        times = {"start_ns": start_ns, "end_ns": end_ns}
        self._writer.segments.append(target=target, run=0, **codes, **times)

    def _go(self, opening: float) -> None:
        """Move the fingers and wait until they rest."""
        gripper, config = self._streams["gripper"], self._bench.gripper
        opening = config.nearest(opening)
        command = {"value": opening, "speed": config.speed, "force": config.force}
        self._check()
        self._action.append(**command, by=0, t_ns=self._clock.now_ns())
        gripper.command(*command.values())
        for _ in range(round(_RESTS / _LOOK)):
            self._wait(_LOOK)
            if (latest := gripper.latest()) is None or latest["object"] not in _AT_REST:
                continue
            if abs(latest["commanded"] - opening) < config.per_count / 2:
                return
        raise DeviceLost(f"gripper: not at {1e3 * opening:.2f} mm after {_RESTS:g} s")

    def _wait(self, seconds: float) -> None:
        end_ns = self._clock.now_ns() + round(seconds * SECOND_NS)
        while (now_ns := self._clock.now_ns()) < end_ns:
            self._check()
            self._clock.sleep_until(min(now_ns + round(_LOOK * SECOND_NS), end_ns))

    def _check(self) -> None:
        self._interrupt.check()
        self._streams.check()

    def _refer(self, start_ns: int, end_ns: int, point: int) -> None:
        """Store what the fingers show without contact."""
        self._lost = False
        for name in FINGERS:
            first, last = self._parts(name, start_ns, end_ns)
            self._rest[name] = (first + last) / 2, _rms(last - first)
        means = {name: {"mean": rest} for name, (rest, _) in self._rest.items()}
        columns = reference_columns(self._streams, means)
        self._writer.reference.append(**columns, point=point, run=0, t_ns=end_ns)

    def _unsteady(self, start_ns: int, end_ns: int, step: SqueezeStep) -> str:
        """Return why a hold is no sample; empty if it is one."""
        for name in FINGERS:
            first, last = self._parts(name, start_ns, end_ns)
            rest, noise = self._rest[name]
            least = _MOVES * noise + _LEAST[self._bench.row(name).kind]
            if _rms(last - first) > least:
                return f"{name} moves"
            # A finger above an object that the other one bears may hardly touch it.
            above = step.lifted and step.turn[0] * (-1, 1)[FINGERS.index(name)] < -_ABOVE
            if self._lost or (_rms(last - rest) < least and not above):
                self._lost = self._lost or step.lifted
                return f"{name} touches nothing, or the object was lost before"
        gripper = Stream(self._writer.stream_path("gripper"), live=True)
        low, high = np.searchsorted(gripper.t_ns, (start_ns, end_ns))
        openings = gripper.array("value")[low:high]
        due = self._bench.objects[step.object].width - step.closing
        if not len(openings) or np.ptp(openings) > 0:
            return "the gripper moves"
        early = abs(openings[0] - due) > self._bench.gripper.per_count
        return "the gripper stopped early" if early else ""

    def _parts(self, name: str, start_ns: int, end_ns: int) -> tuple[np.ndarray, np.ndarray]:
        """Return the mean of a finger's first and of its last samples between two times."""
        stream = Stream(self._writer.stream_path(name), live=True)
        low, high = np.searchsorted(stream.t_ns, (start_ns, end_ns)).tolist()
        if (half := (high - low) // 2) < 1:
            raise DeviceLost(f"{name}: {high - low} samples in {(end_ns - start_ns) / 1e9:.1f} s")
        if self._bench.row(name).kind == "camera":
            half = min(half, _PICTURES)
            values = stream.images([*range(low, low + half), *range(high - half, high)])
        else:
            values = stream.rows_between("value", low, high)
        return values[:half].mean(axis=0), values[-half:].mean(axis=0)


def _rms(change: np.ndarray) -> float:
    return float(np.sqrt(np.square(change).mean()))


def collect_squeezes(
    file: PairFile,
    folder: Path,
    path: Path,
    hands: Callable[[Callable[[], None]], Hands],
    *,
    operator: str = "",
    most: int | None = None,
    watch: Callable[[], None] | None = None,
) -> int:
    """Record the squeezes of a bench whose devices are there, and return the exit code.

    `folder` is for shared records, `path` the session, `most` the number of steps to record, None
    for all; `watch` raises if an emulator is gone. `hands` is called with a function that raises
    once the operator has pressed Ctrl-C.
    """
    bench = file.bench
    steps = list(bench.squeeze.targets(len(bench.objects)))[:most]
    stop: BaseException | None = None
    with InterruptFlag() as interrupt, Streams(bench, folder, SystemClock(), watch) as streams:
        description, rates = check_devices(streams)
        interrupt.check()
        begun = {**asdict(ClockAnchor.take()), "operator": operator_name(operator)}
        begun |= {"rates_hz": rates, "notes": notes_on(description, FINGERS, ())}
        begun |= {"states": states_of(description), "bench": file.content, "devices": description}
        writer = session_of(file, path, steps, begun)
        writer.begin_run(begun)
        squeezing = Squeezing(bench, streams, writer, hands(interrupt.check), interrupt)
        try:
            for handle in streams:
                handle.record(writer.stream_path(handle.name))
            squeezing.run(steps)
        except BaseException as error:
            # On any error the gripper stays as it is, and the session is closed.
            stop = explained(error, mock=bench.mock) if isinstance(error, DeviceLost) else error
        interrupt.ignore()
        squeezing.close()
        reason = "" if stop is None else str(stop) or type(stop).__name__
        if squeezing.aloft:
            reason += "; THE HAND STILL HOLDS THE OBJECT: take it before the fingers open"
        elif squeezing.closed:
            reason += "; the fingers are still closed on the object"
        status, done = "complete" if stop is None else "stopped", squeezing.done
        summaries = close_session(bench.rate_hz, streams, writer, status, reason, done)
    code = exit_code(stop)
    show_session(path, summaries)
    of = f"{done} of {len(steps)} steps, {squeezing.unsteady} not steady"
    print(f"{status}: {of}; {path}" + f" ({reason})" * bool(reason))
    return code


def session_of(
    file: PairFile, path: Path, steps: list[SqueezeStep], begun: dict[str, Any]
) -> SessionWriter:
    """Create the session of some steps, a row of `targets` each; `begun` is its first run."""
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
    columns = {"point": "i2", "object": "i2", "turn": "f8", "step": "i2", "lifted": "i1"}
    targets = {n: np.array([getattr(s, n) for s in steps], kind) for n, kind in columns.items()}
    objects = [bench.objects[step.object] for step in steps]
    targets |= {n: np.array([getattr(each, n) for each in objects]) for n in ("width", "mass")}
    due = targets["width"] - [step.closing for step in steps]
    targets["opening"] = np.array([bench.gripper.nearest(opening) for opening in due])
    streams = [row.spec(begun["devices"][row.name], row.rate_hz) for row in bench.rows]
    return SessionWriter.create(
        path, attrs=attrs, streams=[*streams, action_spec()], targets=targets
    )
