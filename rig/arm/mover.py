"""One command at a time, to its end: move, halt, retract, each under the guard's eyes.

All movements are asynchronous, so that the watchdog is kicked and the guard asked while they last.
A move has ended when the controller's operation word says so, the TCP is at rest and at the target;
each of these waits is limited.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from rig.arm.guarding import Watch
from rig.arm.messages import Move, Outcome, Reply, Setup
from rig.arm.rotation import Array, invert, rotation_between, transform
from rig.arm.vendor import UrControl
from rig.clock import SECOND_NS, Clock, Pacer
from rig.errors import DeviceLost
from rig.guard import Kind, Mode, Verdict, outside_box

_LOOP_HZ = 250.0
_KICK_TICKS = 10
# 25 kicks a second: one may be late before a watchdog of 10 Hz stops the arm.
_AT_TARGET, _AT_ANGLE = 2e-4, 2e-3
"""What counts as arrived [m, rad]: several times the arm's repeatability (0.03 mm)."""
_ARRIVING = 1.0
"""After the controller calls a move finished it has this long to be at rest at the target [s]."""
_STOPPING = 3.0
"""A stop takes at most this long [s]: from 50 mm/s at 2 m/s^2 it takes 25 ms."""
_STEEPEST = 0.5
"""A turn of 1 rad may take as long as this many metres [m/rad]."""
_SAFETY: tuple[Kind, ...] = ("protective_stop", "emergency_stop")
_LOST: tuple[Kind, ...] = ("stale_force", "stale_pose")


class Mover:
    """A connected arm that carries out one command after the other.

    Args:
        setup: What to hold.
        control: The running control program.
        watch: What is known of the arm and the sensors.
        clock: Paces the loop.
        interrupted: Asked in every turn of a move: True ends it by a halt. What it raises is
            passed on with the arm still moving.
    """

    def __init__(
        self,
        setup: Setup,
        control: UrControl,
        watch: Watch,
        clock: Clock,
        interrupted: Callable[[], bool],
    ) -> None:
        self._setup = setup
        self._config = setup.config
        self._control = control
        self._watch = watch
        self._clock = clock
        self._interrupted = interrupted
        self._pacer = Pacer(clock, _LOOP_HZ)
        self._tick = 0
        self.latched: Verdict | None = None
        """The safety stop after which nothing is commanded any more."""

    def wait_for_pose(self, timeout: float) -> None:
        """Turn the loop until the first pose has arrived.

        Raises:
            DeviceLost: None within `timeout` [s].
        """
        deadline_ns = self._clock.now_ns() + round(timeout * SECOND_NS)
        while self._watch.pose is None:
            self.step("retreat")
            if self._clock.now_ns() > deadline_ns:
                raise DeviceLost(f"arm at {self._config.host}: no pose for {timeout} s")

    def step(self, mode: Mode) -> Verdict | None:
        """One turn of the loop: wait, look at poses and forces, kick the watchdog.

        Raises:
            DeviceLost: The controller is silent, or no longer runs our program.
        """
        self._pacer.wait()
        verdict = self._watch.look(mode)
        if verdict is not None and verdict.kind in _SAFETY:
            self.latched = verdict
        self._tick += 1
        # Nothing is sent to a controller that has fallen silent: the call could hang for 300 s.
        due = self._tick % _KICK_TICKS == 0 and self.latched is None and self._watch.fresh()
        if due and not (self._control.connected() and self._control.kick()):
            # The safety status may reach us one package after the program's end.
            verdict = self._watch.look_again(0.1)
            if verdict is None:
                raise DeviceLost(
                    f"arm at {self._config.host}: the control program stopped on the controller: "
                    "stopped at the pendant, or commands came too slowly "
                    f"(watchdog {self._config.watchdog_hz:g} Hz)"
                )
            self.latched = verdict
        return verdict

    def halt(self) -> None:
        """Stop and wait for standstill; nothing after a safety stop, which stops by itself.

        Raises:
            DeviceLost: The controller is silent, or the arm did not stop in time.
        """
        if self.latched is not None:
            return
        self._watch.require_fresh()
        before, _ = self._control.operation()
        self._control.start_stop(self._config.stop_deceleration)
        deadline_ns = self._clock.now_ns() + round(_STOPPING * SECOND_NS)
        while self.latched is None:
            self.step("retreat")
            operation, running = self._control.operation()
            if operation != before and not running and self._watch.still():
                return
            if self._clock.now_ns() > deadline_ns:
                raise DeviceLost(f"arm at {self._config.host}: did not stop in {_STOPPING} s")

    def retract_command(self, number: int) -> Move:
        """The move that leaves along +z of the contact frame, up to the top of the box."""
        config = self._config
        pose = self._watch.pose
        if pose is None:
            raise DeviceLost(f"arm at {config.host}: no pose yet")
        frame = np.array(self._setup.contact_frame)
        place = transform(invert(frame), pose[:3])
        room = max(0.0, self._setup.limits.box[1][2] - float(place[2]))
        place[2] += min(config.retract, room)
        goal = (*transform(frame, place).tolist(), *pose[3:].tolist())
        return Move(number, goal, config.travel_speed, config.travel_acceleration, "retreat")

    def move(self, command: Move, on_start: Callable[[float], None]) -> Reply:
        """Carry out a move and say how it ended.

        Args:
            command: The move.
            on_start: Called as it begins with the longest it can take [s].

        Raises:
            DeviceLost: The controller is silent, or no longer runs our program.
        """
        start_ns = self._clock.now_ns()
        goal = np.array(command.pose)
        if command.mode != "retreat":
            self._watch.armed = True
            reason = outside_box(self._setup.limits, self._setup.contact_frame, goal[:3])
            if reason is not None:
                return self._reply(command, "safety_stop", start_ns, f"target: {reason}", "box")
        verdict = self.step(command.mode)
        if verdict is not None:
            return self._judged(command, start_ns, verdict)
        self._watch.require_fresh()
        if not self._control.reaches(goal.tolist()):
            return self._refused(command, start_ns, "finds the target out of reach")
        limit = self._time_limit(command, goal)
        on_start(limit + _STOPPING + 1.0)
        before, _ = self._control.operation()
        start_ns = self._clock.now_ns()
        if not self._control.start_move(goal.tolist(), command.speed, command.acceleration):
            return self._refused(command, start_ns, "refused the move")
        return self._follow(command, goal, before, start_ns, limit)

    def _refused(self, command: Move, start_ns: int, what: str) -> Reply:
        # A command also fails when a safety stop has just ended the program: then that is why.
        verdict = self._watch.look_again(0.05) or self.step(command.mode)
        if verdict is not None:
            return self._judged(command, start_ns, verdict)
        return self._reply(command, "stopped", start_ns, f"the controller {what}")

    def _follow(
        self, command: Move, goal: Array, before: int, start_ns: int, limit: float
    ) -> Reply:
        """Watch a move that has begun until it has ended."""
        deadline_ns = start_ns + round(limit * SECOND_NS)
        finished_ns: int | None = None
        while True:
            verdict = self.step(command.mode)
            if verdict is not None:
                self.halt()
                return self._judged(command, start_ns, verdict)
            if self._interrupted():
                self.halt()
                return self._reply(command, "stopped", start_ns, "halted by the operator")
            now_ns = self._clock.now_ns()
            operation, running = self._control.operation()
            # Only another number than before the call belongs to it: see UrControl.operation.
            if operation != before and not running:
                finished_ns = finished_ns or now_ns
                if self._watch.still() and self._watch.near(goal, _AT_TARGET, _AT_ANGLE):
                    return self._reply(command, "done", start_ns)
                if now_ns - finished_ns > round(_ARRIVING * SECOND_NS):
                    away = self._watch.distance(goal) * 1e3
                    why = f"came to rest {away:.2f} mm off its target"
                    return self._reply(command, "stopped", start_ns, why)
            elif now_ns > deadline_ns:
                self.halt()
                why = (
                    f"took longer than {limit:.1f} s: is the speed slider low, or the program "
                    "paused at the pendant?"
                )
                return self._reply(command, "stopped", start_ns, why)

    def _judged(self, command: Move, start_ns: int, verdict: Verdict) -> Reply:
        if verdict.kind in _SAFETY:
            self.latched = verdict
        outcome: Outcome = "safety_stop"
        if verdict.kind == "force_soft":
            outcome = "force_limited"
        elif verdict.kind in _LOST:
            outcome = "device_lost"
        return self._reply(command, outcome, start_ns, verdict.reason, verdict.kind)

    def _reply(
        self,
        command: Move,
        outcome: Outcome,
        start_ns: int,
        reason: str = "",
        kind: Kind | None = None,
    ) -> Reply:
        return Reply(command.number, outcome, start_ns, self._clock.now_ns(), reason, kind)

    def _time_limit(self, command: Move, goal: Array) -> float:
        """Half as long again as the move should take at the present slider, plus 2 s [s]."""
        pose = self._watch.pose
        angle = 0.0 if pose is None else float(np.linalg.norm(rotation_between(pose, goal)))
        length = max(self._watch.distance(goal), angle * _STEEPEST)
        ideal = length / command.speed + command.speed / command.acceleration
        return 2.0 + 1.5 * ideal / max(self._watch.speed_fraction, 0.05)
