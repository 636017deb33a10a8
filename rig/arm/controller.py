"""The emulated UR controller: registers, program, safety, and the 2 ms cycle. No sockets here.

Faults are methods: what a test or `make faults` injects through the fault port, a test in the same
process may call.
"""

from __future__ import annotations

import logging
import re
from collections.abc import Callable
from functools import partial

import numpy as np

from rig.arm import rtde
from rig.arm.robot import CYCLE, Movement, Robot
from rig.arm.rotation import Array
from rig.arm.script import Program

logger = logging.getLogger(__name__)

VERSION = (5, 12, 4, 1101661)
"""PolyScope version answered everywhere: the newest whose ur_rtde recipes stay small."""

STOPPED, PLAYING = 1, 2
"""RTDE runtime_state."""

RUNNING, POWER_OFF = 7, 3
"""RTDE robot_mode."""

_NORMAL, _PROTECTIVE, _EMERGENCY = 0x1, 0x404, 0x4C0
_SAFETY_MODES = {_NORMAL: 1, _PROTECTIVE: 3, _EMERGENCY: 7}
_COMMAND = "input_int_register_0"
_BRAKING = 10.0
"""Deceleration when a program ends under way, whoever ended it [m/s^2]."""


class Controller:
    """A UR5e controller of version 5.12 with the arm standing at `pose`.

    Args:
        pose: TCP pose (6,) in the base frame at start [m, rad].
        tcp: TCP (6,) in the flange frame set in the installation [m, rad].
        force_limit: Contact force that triggers a protective stop [N].

    Raises:
        ValueError: The UR5e cannot reach `pose`.
    """

    def __init__(self, pose: Array, tcp: Array, *, force_limit: float = 150.0) -> None:
        self.robot = Robot(pose, tcp)
        self.payload = 0.0
        self.payload_cog = (0.0, 0.0, 0.0)
        self.force_limit = force_limit
        self.wrench = np.zeros(6)
        """On the sensor, as the World says [N, N m]; reported as actual_TCP_force unrotated."""
        self.tick = 0
        self.runtime_state = STOPPED
        self.safety_status = _NORMAL
        self.robot_mode = RUNNING
        self.remote_control = True
        self.uploads = 0
        """Programs received since start."""
        self.reason = "never started"
        """Why no program is running."""
        self._inputs: dict[str, rtde.Value] = {
            name: (0.0,) * 6 if kind == "VECTOR6D" else 0 for name, kind in rtde.INPUTS.items()
        }
        self._ints = [0] * 48
        self._doubles = [0.0] * 48
        self._program: Program | None = None
        self._braking: Movement | None = None
        self._watchdog_cycles: int | None = None
        self._idle_cycles = 0
        self._sources = self._make_sources()

    # Registers, as the script sees them.

    def read_int(self, register: int) -> int:
        """Input integer register."""
        return int(self._inputs[f"input_int_register_{register}"])  # type: ignore[arg-type]

    def read_double(self, register: int) -> float:
        """Input double register."""
        return float(self._inputs[f"input_double_register_{register}"])  # type: ignore[arg-type]

    def write_int(self, register: int, value: int) -> None:
        """Output integer register."""
        self._ints[register] = value

    def write_doubles(self, values: Array) -> None:
        """Output double registers from 0 on."""
        self._doubles[: len(values)] = [float(value) for value in values]

    def set_watchdog(self, min_frequency_hz: float) -> None:
        """Stop the program when the command register is written less often; gone with it."""
        self._watchdog_cycles = max(1, round(1 / (min_frequency_hz * CYCLE)))
        self._idle_cycles = 0

    def write_inputs(self, names: list[str], values: list[rtde.Value]) -> None:
        """Take one data package from a client."""
        self._inputs.update(zip(names, values, strict=True))
        if _COMMAND in names:
            self._idle_cycles = 0
        if "speed_slider_mask" in names and self._inputs["speed_slider_mask"]:
            self.robot.slider = float(self._inputs["speed_slider_fraction"])  # type: ignore[arg-type]

    # Program and safety.

    def start_program(self, text: str) -> None:
        """Run an uploaded program; refused while a safety stop is active."""
        self.uploads += 1
        name = re.search(r"^def (\w+)\(\)", text, re.MULTILINE)
        if self.safety_status != _NORMAL or self.robot_mode != RUNNING:
            logger.warning("arm emulator: program refused: not in normal mode")
            return
        if name is None or name[1] != "rtde_control":
            logger.warning("arm emulator: only ur_rtde's program is emulated, not %s", name)
            return
        self._watchdog_cycles = None
        self._braking = None
        self._program = Program(self)
        self.runtime_state = PLAYING

    def stop_program(self, reason: str) -> None:
        """End the program; an arm under way brakes."""
        if self._program is not None or self.safety_status != _NORMAL:
            self.reason = reason
        if self._program is not None:
            logger.info("arm emulator: program stopped: %s", reason)
            self._braking = self.robot.stop(_BRAKING)
        self._program = None
        self._watchdog_cycles = None
        self.runtime_state = STOPPED

    def protective_stop(self, reason: str) -> None:
        """Stop as on an unexpected force; stays until `reset_safety`."""
        if self.safety_status == _NORMAL:
            self.safety_status = _PROTECTIVE
            self.stop_program(f"protective stop: {reason}")

    def emergency_stop(self) -> None:
        """As when somebody hits the red button: power off too."""
        self.safety_status = _EMERGENCY
        self.robot_mode = POWER_OFF
        self.stop_program("emergency stop")

    def reset_safety(self) -> None:
        """What a person does at the pendant after looking: unlock, power on. Nothing starts."""
        self.safety_status = _NORMAL
        self.robot_mode = RUNNING

    def cycle(self) -> None:
        """Two milliseconds of controller time."""
        self.tick += 1
        before = self.robot.pose
        if self._program is not None:
            self._step_program()
        elif self._braking is not None and next(self._braking, True):
            self._braking = None
        self.robot.end_cycle(before)
        force = float(np.linalg.norm(self.wrench[:3]))
        if force > self.force_limit:
            self.protective_stop(f"contact force {force:.1f} N above {self.force_limit:.1f} N")

    def _step_program(self) -> None:
        self._idle_cycles += 1
        if self._watchdog_cycles is not None and self._idle_cycles > self._watchdog_cycles:
            self.stop_program(f"watchdog: {_COMMAND} not written for {self._idle_cycles} cycles")
            return
        program = self._program
        try:
            if program is not None and not program.step() and self._program is program:
                self.stop_program("end of program")
        except RuntimeError as error:
            self.stop_program(f"script exception: {error}")

    # What RTDE reports.

    def source(self, name: str) -> Callable[[], rtde.Value]:
        """The function that gives output variable `name` its value now."""
        return self._sources[name]

    def _make_sources(self) -> dict[str, Callable[[], rtde.Value]]:
        robot = self.robot
        sources: dict[str, Callable[[], rtde.Value]] = {}
        zeros: dict[str, rtde.Value] = {
            "VECTOR6D": (0.0,) * 6,
            "VECTOR3D": (0.0,) * 3,
            "VECTOR6INT32": (0,) * 6,
        }
        for name, kind in rtde.OUTPUTS.items():
            sources[name] = partial(zeros.__getitem__, kind) if kind in zeros else int
        for k in range(48):
            sources[f"output_int_register_{k}"] = partial(self._ints.__getitem__, k)
            sources[f"output_double_register_{k}"] = partial(self._doubles.__getitem__, k)
        for what in ("actual", "target"):
            sources[f"{what}_TCP_pose"] = lambda: tuple(robot.pose.tolist())
            sources[f"{what}_TCP_speed"] = lambda: tuple(robot.speed.tolist())
            sources[f"{what}_q"] = lambda: tuple(robot.joints.tolist())
        sources["timestamp"] = lambda: self.tick * CYCLE
        sources["actual_TCP_force"] = lambda: tuple(self.wrench.tolist())
        sources["tcp_offset"] = lambda: tuple(robot.tcp.tolist())
        sources["robot_mode"] = lambda: self.robot_mode
        sources["joint_mode"] = lambda: (253,) * 6
        sources["safety_mode"] = lambda: _SAFETY_MODES[self.safety_status]
        sources["safety_status_bits"] = lambda: self.safety_status
        sources["robot_status_bits"] = lambda: (
            int(self.robot_mode == RUNNING) | int(self.runtime_state == PLAYING) << 1
        )
        sources["runtime_state"] = lambda: self.runtime_state
        sources["speed_scaling"] = lambda: robot.slider if self.runtime_state == PLAYING else 0.0
        sources["target_speed_fraction"] = lambda: robot.slider
        sources["payload"] = lambda: self.payload
        sources["payload_cog"] = lambda: self.payload_cog
        return sources
