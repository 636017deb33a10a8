"""Moves the arm through the plan, phase by phase; each phase is a row of `segments`.

The progress line is rewritten in place on a terminal, else logged periodically. It is not drawn by
`recorder.progress`: the thread that moves the robot writes it, in about 2 us, for which rich takes
about 0.4 ms (500 redraws, 5 runs).
"""

import contextlib
import logging
import sys
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import partial
from itertools import accumulate
from pathlib import Path
from typing import Any, TextIO

import numpy as np

from recorder.command_line.terminal import paint
from recorder.errors import SessionError
from recorder.findings import Finding
from recorder.progress import CountDown, duration
from recorder.session import SessionWriter
from recorder.spec import OUTCOMES, frame_columns, reference_spec
from rig.acquire.control import DeadManReleased, Interlocks
from rig.acquire.streams import Streams, check_no_contact, no_mean, tip_position
from rig.bench.bench import AVERAGED
from rig.core.clock import SECOND_NS
from rig.core.errors import DeviceLost, SafetyStop
from rig.core.guard import Mode
from rig.core.paced_line import PacedLine
from rig.devices.arm.arm import Arm, MoveResult
from trajectories import PHASES, Move, Plan, Point, Target, dome_height

logger = logging.getLogger(__name__)

_ON_TERMINAL_NS = SECOND_NS // 5
_IN_LOG_NS = 10 * SECOND_NS
# Number of targets that the prediction counts for, and the most that one target may differ from it.
_PRIOR, _MOST = 3, 2.0


class LiveLine:
    """Progress of a collection: target, phase, depth, force, losses, and the time left.

    `planned` is the predicted duration of each target [s], of which this run presses those of
    `pressing`; a control press takes as long as the last. Their time changes the prediction for the
    rest, which counts like three targets; one that took much longer than the others changes it
    little. `new` returns new doubts.
    """

    def __init__(
        self,
        streams: Streams,
        planned: Sequence[float],
        *,
        pressing: Sequence[int] | None = None,
        out: TextIO | None = None,
        new: Callable[[], Iterable[Finding]] = tuple,
    ) -> None:
        self._streams, self._new = streams, new
        self.doubts: list[Finding] = []
        """Findings that were said."""
        self._clock = streams.clock
        self._line = PacedLine(
            out or sys.stdout, _ON_TERMINAL_NS, _IN_LOG_NS, partial(logger.info, "%s")
        )
        self.count = len(planned)
        """Number of targets; a control press has this one, counted from 0."""
        self._planned = [*planned, planned[-1]]
        order = range(len(planned)) if pressing is None else pressing
        # Predicted duration of the targets from each one on, in this run [s].
        took = accumulate(self._planned[each] for each in reversed(order))
        self._from = dict(zip(reversed(order), took, strict=True))
        # Predicted and measured duration of the targets that this run has pressed [s].
        prior = _PRIOR * sum(planned) / len(planned)
        self._predicted = self._measured = prior
        # Duration of the pauses, and the beginning of one that has not ended.
        self._paused_ns, self._pause_ns = 0, 0
        # Beginning of the current target, by `_worked_ns`.
        self._target_ns = self._worked_ns()
        self._count_down = CountDown()
        self._target: Target | None = None
        self._move: Move | None = None
        self._ended: dict[int, str] = {}
        self._waiting = ""

    def at(self, target: Target, move: Move | None) -> None:
        """Set the current target and move."""
        before, now_ns = self._target, self._worked_ns()
        if before is None or target.index != before.index:
            if before is not None:
                predicted = self._planned[before.index]
                took = (now_ns - self._target_ns) / SECOND_NS
                self._predicted += predicted
                self._measured += min(max(took, predicted / _MOST), predicted * _MOST)
            self._target_ns = now_ns
        self._target, self._move = target, move

    def waiting(self, why: str) -> None:
        """Show why nothing moves in place of the phase; a new reason is shown immediately."""
        if why != self._waiting:
            self._pause_ns = self._pause_ns or self._clock.now_ns()
            self._waiting = why
            self._line.hurry()

    def waited(self) -> None:
        """Continue after a pause, which the remaining time does not count."""
        self._waiting = ""
        self._line.hurry()
        self._paused_ns += self._clock.now_ns() - self._pause_ns
        self._pause_ns = 0

    def ended(self, target: Target, outcome: str) -> None:
        """Record the outcome of a target: done or limited."""
        if target.index < self.count:
            self._ended[target.index] = outcome
        self.tell()

    def tell(self) -> None:
        """Say new doubts."""
        for doubt in self._new():
            self.end()
            logger.warning("%s", doubt)
            self.doubts.append(doubt)

    def progress(self) -> dict[str, Any]:
        """Return the monitoring page's data: `Snapshot` fields, `ended`, `waiting`; thread-safe."""
        target, move = self._target, self._move
        if target is None:
            return {"left": self._seconds_left()}
        return {
            "target": target.index if target.index < self.count else -1,
            "phase": self._phase(move),
            "left": self._seconds_left(),
            "ended": dict(self._ended),
            "doubts": tuple(self.doubts),
            "waiting": bool(self._waiting),
        }

    def tick(self) -> None:
        """Write the line if it is due."""
        if self._target is not None and self._line.is_due(self._clock.now_ns()):
            self._line.show(*self._parts(self._target))

    def end(self) -> None:
        """End the line and leave it on the terminal."""
        self._line.end()

    def _parts(self, target: Target) -> list[str]:
        """Return the parts of the line, the most important ones first."""
        counters = self._streams.counters()
        lost = sum(int(count["dropped"]) for count in counters.values())
        x, y, z = tip_position(self._streams)
        depth = dome_height(self._streams.bench.dome_radius, x, y) - z
        return [
            f"target {min(target.index + 1, self.count)}/{self.count}",
            f"{self._phase(self._move):<10}",
            f"{1e3 * depth:.2f} of {1e3 * target.depth:.2f} mm",
            self._streams.pressing(),
            paint(f"lost {lost}", "fault") if lost else "",
            f"{duration(self._seconds_left())} left",
            *(f"{name} {count['rate_hz']:.0f} Hz" for name, count in counters.items()),
        ]

    def _phase(self, move: Move | None) -> str:
        return self._waiting or (PHASES[move.phase] if move is not None else "to point")

    def _worked_ns(self) -> int:
        """Return the time without pauses [ns]."""
        return (self._pause_ns or self._clock.now_ns()) - self._paused_ns

    def _seconds_left(self) -> float:
        """Return the remaining time [s], by the plan and the targets pressed in this run."""
        ratio = self._measured / self._predicted if self._predicted else 1.0
        if self._target is None:
            planned = next(iter(reversed(self._from.values())), 0.0)
        else:
            index, begun = self._target.index, (self._worked_ns() - self._target_ns) / SECOND_NS
            planned = self._from[index] - min(begun / ratio, self._planned[index])
        return self._count_down(ratio * planned, planned)


def last_line(
    status: str,
    reason: str,
    path: Path,
    *,
    done: int,
    limited: int,
    left_out: int = 0,
    total: int,
    seconds: float,
) -> str:
    """Return one line with the status, the number of targets and the path.

    `done` of `total` targets are finished and `left_out` are not pressed; `limited` of this run
    ended at the soft force limit; the run took `seconds` [s].
    """
    why = f" ({reason})" if reason else ""
    out = f", {left_out} left out," if left_out else ""
    ended = f", {limited} of them at the force limit," if limited else ""
    took = duration(seconds)
    return f"{status}{why}: {done} of {total} targets{out}{ended} in {took}; readable at {path}"


# Fraction of the largest signal above which a sensor without a gauge counts as touched.
CONTACT_FREE = 0.1
# Interval between checks of a pause.
_LOOK_NS = SECOND_NS // 20


def require_arrival(result: MoveResult, *, pressing: bool) -> None:
    """Accept a move that arrived, or a press ended by the soft force limit."""
    if result.outcome == "stopped":
        raise DeviceLost(f"arm: {result.reason}")
    if result.outcome == "force_limited" and not pressing:
        raise SafetyStop(f"contact where none was expected: {result.reason}")


def rise_clear(streams: Streams, arm: Arm, interlocks: Interlocks) -> None:
    """Move up to the safe height with the tool upright; tare and travel happen there."""

    def look() -> None:
        interlocks.check()
        streams.check()

    bench = streams.bench
    x, y, z = tip_position(streams)
    result = arm.move(
        bench.tool_pose((x, y, max(bench.arm.retract, z))),
        speed=bench.arm.travel_speed,
        acceleration=bench.arm.travel_acceleration,
        mode="travel",
        on_wait=look,
        wake=interlocks.wake,
    )
    require_arrival(result, pressing=False)


class PlanRunner:
    """Presses the targets of a plan.

    The arm is started, its tip inside the box and clear of the surface. The interlocks are checked
    while it moves; their control is checked after every row, and for pauses before every target.
    `after_target` is called with the tip clear of the surface. `zeros` are the readings of the F/T
    sensors without contact after the tare (6,) [N, N m], by stream.
    """

    def __init__(
        self,
        streams: Streams,
        arm: Arm,
        interlocks: Interlocks,
        writer: SessionWriter,
        live: LiveLine,
        plan: Plan,
        *,
        after_target: Callable[[Target], None] | None = None,
        run: int,
        zeros: Mapping[str, np.ndarray],
    ) -> None:
        self._streams = streams
        self._bench, self._clock = streams.bench, streams.clock
        self._arm = arm
        self._interlocks = interlocks
        self._control = interlocks.control
        self._writer = writer
        self._live = live
        self._plan = plan
        self._after_target = after_target
        self._run = run
        self._zeros = zeros
        # Contact point at whose p0 the tip is; None: at none.
        self._point: int | None = None
        self.done = 0
        """Targets pressed to their end."""
        self.limited = 0
        """Targets among those that ended at the soft force limit."""

    def press(self, targets: Iterable[Target]) -> None:
        """Press targets of the plan, one after the other."""
        for target in targets:
            if target.index >= self._live.count:
                logger.info("control press: point %d again", target.point)
                self._point = None  # with another reference, after a similar rest
            self._live.at(target, None)
            limited = self.limited
            while not self._attempt(target):
                pass
            self.done += 1
            self._live.ended(target, "limited" if self.limited > limited else "done")
            if self._after_target is not None:
                self._live.end()
                self._after_target(target)

    def _attempt(self, target: Target) -> bool:
        """Press a target from its start; return False if the dead-man pedal was released."""
        self._hold()
        try:
            if target.point != self._point:
                self._go_to_point(target)
                self._point = target.point
            self._press_target(target)
        except DeadManReleased as released:
            self._live.end()
            logger.warning("target %d: halted: %s", target.index + 1, released)
            self._point = None
            self._live.at(target, None)
            # Straight up from the press, clear of the surface, to retract height.
            x, y, z = tip_position(self._streams)
            self._move((x, y, max(z, target.origin[2])), mode="retreat")
            self._move((x, y, max(z, self._bench.arm.retract)), mode="travel")
            self._interlocks.disarm()
            return False
        return True

    def _hold(self) -> None:
        """Wait while a pause is requested or the dead-man pedal is not held."""
        self._control.check()
        began_ns = now_ns = self._clock.now_ns()
        while (why := self._reason_to_wait()) is not None:
            self._wait()
            # Raises errors that the guard detects at standstill, such as a protective stop.
            self._arm.check()
            self._live.waiting(why)
            self._clock.sleep_until(now_ns + _LOOK_NS)
            now_ns = self._clock.now_ns()
            self._control.check()
        if now_ns > began_ns:
            self._live.waited()
            logger.info("continuing after a pause of %.1f s", (now_ns - began_ns) / SECOND_NS)

    def _reason_to_wait(self) -> str | None:
        paused_by = self._control.paused_by
        if paused_by:
            return f"paused by the {' and the '.join(paused_by)}"
        return None if self._interlocks.armed() else f"waiting: {self._interlocks.wish}"

    def _go_to_point(self, target: Target) -> None:
        """Move up, to the point at a safe height, down to p0, and take the point's reference."""
        x, y, clearance = target.origin
        approach = max(self._bench.approach, clearance)
        height = max(self._bench.arm.retract, approach)
        here_x, here_y, here_z = tip_position(self._streams)
        if here_z < height:
            self._move((here_x, here_y, height), mode="travel")
        self._move((x, y, height), mode="travel")
        self._move((x, y, approach), mode="travel")
        self._move((x, y, clearance), mode="guarded")
        self._take_reference(target.point)
        self._control.check()

    def _take_reference(self, point: int) -> None:
        """Store the values of the sensor, having checked that nothing touches it."""
        bench = self._bench
        measured = self._zero(point)
        for gauge in bench.of_kind("force"):
            if "mean" not in measured[gauge.name]:
                raise DeviceLost(f"{gauge.name}: {no_mean(gauge)} over point {point}")
        for gauge in bench.gauges:
            tared = measured[gauge.name]["mean"] - self._zeros[gauge.name]
            check_no_contact(bench, gauge, tared, point)
        ended_ns = max((int(each["t_ns"]) for each in measured.values()), default=0)
        self._writer.reference.append(
            **reference_columns(self._streams, measured),
            point=point,
            run=self._run,
            t_ns=ended_ns or self._clock.now_ns(),
        )
        for gauge in bench.of_kind("force"):
            logger.info(
                "point %d  %sdrift since the tare %s N",
                point,
                "" if gauge.name == "force" else f"{gauge.name}  ",
                " ".join(f"{value:+.3f}" for value in measured[gauge.name]["mean"][:3]),
            )

    def _zero(self, point: int) -> dict[str, dict[str, Any]]:
        """Return the streams' means above a point, and set the zero of guards that stand in."""
        self._check_signal(point)
        averaged = [row.name for row in self._bench.rows if row.kind in AVERAGED]
        if self._bench.no_gauge and not averaged:
            # The pose paces the wait for images without contact.
            averaged = ["pose"]
        waits = [row.settling for row in self._bench.rows]
        window = max(self._bench.preflight.point_window, *waits)
        measured = self._streams.measure(window, *averaged) if averaged else {}
        zero_stand_ins(self._streams, measured)
        return measured

    def _check_signal(self, point: int) -> None:
        """Reject a sensor that shows contact above a point: the next zero would hide it."""
        if not self._bench.no_gauge:
            return
        stand_ins, signal, _ = self._bench.without_gauge
        latest = self._streams[signal.name].signal()
        if latest is None:
            return
        motion, allowed = float(latest["motion"]), CONTACT_FREE * stand_ins.signal_max
        if motion > allowed:
            raise SafetyStop(
                f"point {point}: the signal of {self._bench.sensor} shows {motion:.3g} before the "
                f"press; allowed: {allowed:.3g}; is the surface where it was found?"
            )

    def _press_target(self, target: Target) -> None:
        for move in self._plan.moves(target):
            self._live.at(target, move)
            result = self._move(move.end, mode="guarded", record=move)
            if result.outcome == "force_limited":
                self.limited += 1
                self._live.end()
                logger.warning("target %d: %s", target.index + 1, result.reason)
                self._leave(target)
                return
            self._control.check()

    def _leave(self, target: Target) -> None:
        """Move straight up from a press at the soft limit, then to p0 for the next one."""
        x, y, z = tip_position(self._streams)
        self._move((x, y, max(z, target.origin[2])), mode="retreat")
        if self._bench.no_gauge:
            # What a soft sensor keeps of this press would end the next approach.
            self._zero(target.point)
        self._move(target.origin, mode="guarded")
        self._control.check()

    def _move(self, place: Point, *, mode: Mode, record: Move | None = None) -> MoveResult:
        bench, arm = self._bench, self._bench.arm
        travelling, pressing = mode == "travel", mode == "guarded"
        self._interlocks.check(pressing=pressing)
        asked_ns = self._clock.now_ns()
        pose = bench.tool_pose(place)
        try:
            result = self._arm.move(
                pose,
                speed=arm.travel_speed if travelling else arm.speed,
                acceleration=arm.travel_acceleration if travelling else arm.acceleration,
                mode=mode,
                on_wait=partial(self._wait, pressing=pressing),
                wake=self._interlocks.wake,
            )
        except (SafetyStop, DeviceLost, SessionError, KeyboardInterrupt, DeadManReleased) as error:
            ended_ns = self._clock.now_ns()
            released = isinstance(error, DeadManReleased)
            # A failed halt outweighs a released pedal; any other error came first.
            with contextlib.suppress(*(() if released else (SafetyStop, DeviceLost))):
                self._arm.halt()
            if record is not None:
                self._note(record, "interrupted" if released else "stopped", asked_ns, ended_ns)
            raise
        if record is not None:
            outcome = "complete" if result.outcome == "done" else result.outcome
            ended_ns = self._held(place) if outcome == "complete" else result.end_ns
            self._note(record, outcome, result.start_ns, max(ended_ns, result.end_ns))
        require_arrival(result, pressing=record is not None)
        return result

    def _held(self, place: Point) -> int:
        """Stay at a place in contact for the bench's `hold`; return the end [ns]."""
        now_ns = self._clock.now_ns()
        surface = dome_height(self._bench.dome_radius, place[0], place[1])
        end_ns = now_ns + round(self._bench.hold * SECOND_NS) if place[2] < surface else now_ns
        while now_ns < end_ns:
            self._wait(pressing=True)
            self._arm.check()
            self._clock.sleep_until(min(now_ns + _LOOK_NS, end_ns))
            now_ns = self._clock.now_ns()
        return now_ns

    def _wait(self, *, pressing: bool = False) -> None:
        # The interlocks first: they have to stop the arm soonest.
        self._interlocks.check(pressing=pressing)
        self._streams.check()
        self._live.tick()

    def _note(self, move: Move, outcome: str, start_ns: int, end_ns: int) -> None:
        self._writer.segments.append(
            target=move.target,
            phase=move.phase,
            outcome=OUTCOMES.index(outcome),
            run=self._run,
            start_ns=start_ns,
            end_ns=end_ns,
        )


def zero_stand_ins(streams: Streams, measured: Mapping[str, Mapping[str, Any]]) -> None:
    """Zero the guards that stand in for an F/T sensor, by the streams' means without contact."""
    bench = streams.bench
    if not bench.no_gauge:
        return
    for row in bench.of_kind("arm_wrench"):
        if "mean" not in measured.get(row.name, {}):
            raise DeviceLost(f"{row.name}: no sample without contact")
        streams[row.name].zero(measured[row.name]["mean"])
    if bench.signal is not None:
        streams[bench.signal.name].zero(None)


def reference_columns(
    streams: Streams, measured: Mapping[str, Mapping[str, Any]]
) -> dict[str, Any]:
    """Return the columns of `reference` by mean and std of streams; NaN or -1 without them."""
    bench = streams.bench
    specs = [row.empty_spec() for row in bench.rows]
    columns = {column.name: column for column in reference_spec(specs).columns[1:-2]}
    values: dict[str, Any] = {
        name: np.full(column.shape, np.nan) if column.shape else -1
        for name, column in columns.items()
    }
    for name, column_name in frame_columns([(row.name, row.traits) for row in bench.rows]).items():
        if bench.row(name).kind == "camera":
            latest = streams[name].latest()
            values[column_name] = int(latest["row"]) if latest is not None else -1
        elif column_name in columns and "mean" in measured.get(name, {}):
            values[column_name] = measured[name]["mean"]
            if f"{column_name}_std" in columns:
                values[f"{column_name}_std"] = measured[name]["std"]
    return values
