"""The program that ur_rtde 1.6.5 uploads, re-implemented: one `next()` is one sync() of its script.

The uploaded text is not interpreted. What is here follows it in what a client can see: a command
runs once, register 0 says 2 (done) until the client writes command 0, then 1 (ready); real-time
commands run every cycle; register 2 is the asynchronous operation word.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator
from typing import Protocol

import numpy as np

from rig.arm.robot import CYCLE, Movement, Robot
from rig.arm.rotation import Array

logger = logging.getLogger(__name__)

READY, DONE = 1, 2
STOP_SCRIPT = 255
_REAL_TIME = frozenset({6, 9, 10, 11, 24, 25, 26, 27, 38, 58, 66, 67, 68, 69, 70, 71})
_STOPJ_REACH = 0.5
"""stopj is given in rad/s^2; the emulated arm turns it into TCP terms at this radius [m]."""


class Registers(Protocol):
    """What the script reads and writes on its controller."""

    robot: Robot
    payload: float
    payload_cog: tuple[float, float, float]

    def read_int(self, register: int) -> int:
        """Input integer register."""

    def read_double(self, register: int) -> float:
        """Input double register."""

    def write_int(self, register: int, value: int) -> None:
        """Output integer register."""

    def write_doubles(self, values: Array) -> None:
        """Output double registers from 0 on."""

    def set_watchdog(self, min_frequency_hz: float) -> None:
        """Stop the program when input_int_register_0 is written less often than this."""

    def protective_stop(self, reason: str) -> None:
        """What the script function of that name does."""


class Program:
    """One run of the uploaded script, from start to stop.

    Args:
        controller: The controller it runs on.
    """

    def __init__(self, controller: Registers) -> None:
        self._controller = controller
        self._robot = controller.robot
        self._threads: dict[str, Movement] = {}
        self._writes = 0
        self._operation = 0
        # 0 until the first asynchronous stop, then 1 for ever: a defect of the script that makes a
        # synchronous stopL run stopj. Faithful, so that nobody relies on synchronous stops.
        self._stop_type = 0
        self._speed_goal: tuple[Array, float] = (np.zeros(6), 1.0)
        self._main = self._loop()
        self._commands: dict[int, Callable[[], Movement | None]] = {
            1: self._move,
            2: self._move,
            3: self._move,
            4: self._move,
            10: self._run_at,
            15: self._stop_running,
            16: self._stop_running,
            17: self._set_payload,
            25: lambda: controller.write_int(1, 0),
            26: lambda: controller.write_doubles(np.array([CYCLE, 0, 0, 0, 0, 0])),
            28: lambda: controller.write_doubles(self._robot.pose),
            29: lambda: self._robot.set_tcp(self._doubles(0)),
            30: self._inverse,
            31: lambda: controller.protective_stop("script function protective_stop()"),
            33: self._stop,
            34: self._stop,
            35: lambda: controller.set_watchdog(controller.read_double(0)),
            36: self._within_limits,
            40: lambda: controller.write_doubles(self._robot.tcp),
            43: lambda: controller.write_doubles(self._robot.pose),
            47: self._is_steady,
        }

    def step(self) -> bool:
        """Run one cycle of the main thread, then of the others; False when the program ended."""
        if next(self._main, True):
            return False
        for name in list(self._threads):
            thread = self._threads.get(name)
            if thread is not None and next(thread, True):
                self._threads.pop(name, None)
        return True

    def _loop(self) -> Movement:
        self._signal(-1)
        self._controller.write_int(0, READY)
        executed = False
        while True:
            command = self._controller.read_int(0)
            if command == 0:
                executed = False
                self._controller.write_int(0, READY)
            elif command in _REAL_TIME:
                self._execute(command)
                self._controller.write_int(0, READY)
            elif not executed:
                if command == STOP_SCRIPT:
                    return
                movement = self._execute(command)
                if movement is not None:
                    yield from movement
                self._controller.write_int(0, DONE)
                executed = True
            yield

    def _execute(self, command: int) -> Movement | None:
        action = self._commands.get(command)
        if action is None:
            logger.warning("arm emulator: script command %d is not emulated: ignored", command)
            return None
        return action()

    def _signal(self, value: int) -> None:
        """Write the asynchronous operation word: 0 starts one, above 0 is progress, -1 ends it."""
        self._writes = (self._writes + 1) % 128
        if value == 0:
            self._operation = (self._operation + 1) % 128
        word = (self._operation << 24) + (self._writes << 16)
        if value >= 0:
            word += min(value, 0x7FFF) + 0x8000
        self._controller.write_int(2, word)

    def _doubles(self, start: int, count: int = 6) -> Array:
        return np.array([self._controller.read_double(start + k) for k in range(count)])

    def _signalled(self, movement: Movement) -> Movement:
        """A movement in a thread of its own, its start and end told in the operation word."""
        self._signal(0)
        yield from movement
        self._signal(-1)

    def _move(self) -> Movement | None:
        read = self._controller.read_double
        command, values, speed, acceleration = (
            self._controller.read_int(0),
            self._doubles(0),
            read(6),
            read(7),
        )
        self._end_move()
        if "speed" in self._threads:
            raise RuntimeError("another thread is already controlling the robot")
        movement: Movement
        if command in (1, 2):
            joints = values if command == 1 else self._robot.solve(values)
            if joints is None:
                raise RuntimeError("no inverse kinematics solution")
            movement = self._robot.move_joints(joints, acceleration, speed)
        else:
            goal = values if command == 3 else self._robot.forward(values)
            movement = self._robot.move_linear(goal, acceleration, speed)
        if self._controller.read_int(1) != 1:
            return movement
        self._threads["move"] = self._signalled(movement)
        return None

    def _end_move(self) -> bool:
        if self._threads.pop("move", None) is None:
            return False
        self._signal(-1)
        return True

    def _stop(self) -> Movement | None:
        deceleration = self._controller.read_double(0)
        if self._threads.pop("stop", None) is not None:
            self._signal(-1)
        else:
            self._end_move()
        if self._controller.read_int(1) == 1:
            self._stop_type = 1
            self._threads["stop"] = self._signalled(self._robot.stop(deceleration))
            return None
        reach = 1.0 if self._stop_type == 1 else _STOPJ_REACH
        return self._robot.stop(deceleration * reach)

    def _run_at(self) -> None:
        self._speed_goal = (self._doubles(0), self._controller.read_double(6))
        if "speed" not in self._threads:
            self._threads["speed"] = self._running()

    def _running(self) -> Iterator[None]:
        # Like the script's `while True: speedl(...)`: it goes on when the client is gone.
        while True:
            self._robot.run_at(*self._speed_goal)
            yield

    def _stop_running(self) -> Movement:
        self._threads.pop("speed", None)
        return self._robot.stop(self._controller.read_double(0))

    def _set_payload(self) -> None:
        x, y, z = self._doubles(1, 3).tolist()
        self._controller.payload = self._controller.read_double(0)
        self._controller.payload_cog = (x, y, z)

    def _inverse(self) -> None:
        joints = self._robot.solve(self._doubles(0))
        if joints is not None:
            self._controller.write_doubles(joints)

    def _within_limits(self) -> None:
        self._controller.write_int(1, int(self._robot.solve(self._doubles(0)) is not None))

    def _is_steady(self) -> None:
        self._controller.write_int(1, int(not self._robot.speed.any()))
