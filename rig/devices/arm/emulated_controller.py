"""The emulated UR controller: registers, program, safety, and the 2 ms cycle. No sockets here.

Faults are methods, called by the fault port (`benchmarks faults`) or by a test in the process.
"""

from __future__ import annotations

import logging
import re
from collections.abc import Callable, Mapping
from functools import partial

import numpy as np

from rig.core.geometry import Array
from rig.devices.arm import rtde
from rig.devices.arm.emulated_arm import CYCLE, Movement, PoseError, Robot, Wrist

logger = logging.getLogger(__name__)

# The program that ur_rtde 1.6.5 uploads, reimplemented: one `next()` is one sync() of its script.
#
# The uploaded text is not interpreted. This code reproduces the behaviour visible to a client that
# moves in straight lines, as ours does; other movements are ignored, with a warning. A command runs
# once, register 0 holds 2 (done) until the client writes command 0, then 1 (ready);
# real-time commands run every cycle; register 2 is the asynchronous operation word.

READY, DONE = 1, 2
STOP_SCRIPT = 255
_REAL_TIME = frozenset({6, 9, 10, 11, 24, 25, 26, 27, 38, 58, 66, 67, 68, 69, 70, 71})
# stopj takes rad/s^2; the emulated arm converts it to TCP acceleration at this radius [m].
_STOPJ_REACH = 0.5


class Program:
    """One run of the uploaded script, from start to stop."""

    def __init__(self, controller: Controller) -> None:
        self._controller = controller
        self._robot = controller.robot
        self._threads: dict[str, Movement] = {}
        self._writes = 0
        self._operation = 0
        # 0 until the first asynchronous stop, then always 1: a defect of the script that makes a
        # synchronous stopL run stopj. Reproduced so that nobody relies on synchronous stops.
        self._stop_type = 0
        self._main = self._loop()
        self._commands: dict[int, Callable[[], Movement | None]] = {
            3: self._move,
            17: self._set_payload,
            25: lambda: controller.write_int(1, 0),
            26: lambda: controller.write_doubles(np.array([CYCLE, 0, 0, 0, 0, 0])),
            28: lambda: controller.write_doubles(self._robot.pose),
            29: lambda: self._robot.set_tcp(self._doubles(0)),
            31: lambda: controller.protective_stop("script function protective_stop()"),
            33: self._stop,
            34: self._stop,
            35: lambda: controller.set_watchdog(controller.read_double(0)),
            36: lambda: controller.write_int(1, self._robot.solve(self._doubles(0)) is not None),
            40: lambda: controller.write_doubles(self._robot.tcp),
            43: lambda: controller.write_doubles(self._robot.pose),
            47: lambda: controller.write_int(1, not self._robot.speed.any()),
        }

    def step(self) -> bool:
        """Run one cycle of the main thread, then of the others; return False at program end."""
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
        status = (self._operation << 24) + (self._writes << 16)
        if value >= 0:
            status += min(value, 0x7FFF) + 0x8000
        self._controller.write_int(2, status)

    def _doubles(self, start: int, count: int = 6) -> Array:
        return np.array([self._controller.read_double(start + k) for k in range(count)])

    def _signalled(self, movement: Movement) -> Movement:
        """Run a movement in its own thread, with start and end in the operation word."""
        self._signal(0)
        yield from movement
        self._signal(-1)

    def _move(self) -> Movement | None:
        speed, acceleration = self._doubles(6, 2).tolist()
        self._end_move()
        movement = self._robot.move_linear(self._doubles(0), acceleration, speed)
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

    def _set_payload(self) -> None:
        x, y, z = self._doubles(1, 3).tolist()
        self._controller.payload = self._controller.read_double(0)
        self._controller.payload_cog = (x, y, z)


# PolyScope version reported everywhere: the newest whose ur_rtde recipes stay small.
VERSION = (5, 12, 4, 1101661)

_GRAVITY = 9.81
# Contact force that triggers a protective stop [N].
_FORCE_MOST = 150.0

# RTDE runtime_state.
STOPPED, PLAYING = 1, 2

# RTDE robot_mode.
RUNNING, POWER_OFF = 7, 3

_NORMAL, _PROTECTIVE, _EMERGENCY = 0x1, 0x404, 0x4C0
_SAFETY_MODES = {_NORMAL: 1, _PROTECTIVE: 3, _EMERGENCY: 7}
_COMMAND = "input_int_register_0"
# Deceleration when a program ends during a move, for any reason [m/s^2].
_BRAKING = 10.0


class Controller:
    """UR5e controller of version 5.12, at rest at `pose` with the `tcp` in the flange [m, rad]."""

    def __init__(self, pose: Array, tcp: Array) -> None:
        self.robot = Robot(pose, tcp)
        self.payload = 0.0
        self.payload_cog = (0.0, 0.0, 0.0)
        self.tool_mass: float | None = None
        """True mass on the flange [kg]; None: the payload that is set."""
        self.version = VERSION
        self.wrench = np.zeros(6)
        """On the sensor, from the World [N, N m]; reported as actual_TCP_force unrotated."""
        self.wrist: Wrist | None = None
        """Errors of that report; None: none."""
        self.pose_error: PoseError | None = None
        """Errors of the reported pose; None: it is exact."""
        self.tick = 0
        self.runtime_state = STOPPED
        self.safety_status = _NORMAL
        self.robot_mode = RUNNING
        self.remote_control = True
        self.uploads = 0
        """Number of programs received since start."""
        self.reason = "never started"
        """Reason why no program is running."""
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

    def lead(self, pose: Array) -> None:
        """Put the TCP at `pose` (6,) [m, rad], as a person in freedrive does."""
        if self._program is not None or self.robot.solve(pose) is None:
            raise ValueError("freedrive: allowed: without a program, to a pose in reach")
        self.robot.pose = np.array(pose, np.float64)

    # Registers, as accessed by the script.

    def read_int(self, register: int) -> int:
        """Read an input integer register."""
        return int(self._inputs[f"input_int_register_{register}"])  # type: ignore[arg-type]

    def read_double(self, register: int) -> float:
        """Read an input double register."""
        return float(self._inputs[f"input_double_register_{register}"])  # type: ignore[arg-type]

    def write_int(self, register: int, value: int) -> None:
        """Write an output integer register."""
        self._ints[register] = int(value)

    def write_doubles(self, values: Array) -> None:
        """Write output double registers from 0 on."""
        self._doubles[: len(values)] = [float(value) for value in values]

    def set_watchdog(self, min_frequency_hz: float) -> None:
        """Stop the program if the command register is written less often; ends with it."""
        self._watchdog_cycles = max(1, round(1 / (min_frequency_hz * CYCLE)))
        self._idle_cycles = 0

    def write_inputs(self, names: list[str], values: list[rtde.Value]) -> None:
        """Accept one data package from a client."""
        self._inputs.update(zip(names, values, strict=True))
        if _COMMAND in names:
            self._idle_cycles = 0
        if "speed_slider_mask" in names and self._inputs["speed_slider_mask"]:
            self.robot.slider = float(self._inputs["speed_slider_fraction"])  # type: ignore[arg-type]

    # Program and safety.

    def start_program(self, text: str) -> None:
        """Run an uploaded program; rejected while a safety stop is active."""
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
        """End the program; a moving arm brakes."""
        if self._program is not None or self.safety_status != _NORMAL:
            self.reason = reason
        if self._program is not None:
            logger.info("arm emulator: program stopped: %s", reason)
            self._braking = self.robot.stop(_BRAKING)
        self._program = None
        self._watchdog_cycles = None
        self.runtime_state = STOPPED

    def protective_stop(self, reason: str) -> None:
        """Stop as on an unexpected force, until `reset_safety`."""
        if self.safety_status == _NORMAL:
            self.safety_status = _PROTECTIVE
            self.stop_program(f"protective stop: {reason}")

    def emergency_stop(self) -> None:
        """Stop as if the emergency button was pressed: power off too."""
        self.safety_status = _EMERGENCY
        self.robot_mode = POWER_OFF
        self.stop_program("emergency stop")

    def reset_safety(self) -> None:
        """Unlock and power on, as a person does at the pendant. Starts nothing."""
        self.safety_status = _NORMAL
        self.robot_mode = RUNNING

    def cycle(self) -> None:
        """Advance by one cycle, 2 ms of controller time."""
        self.tick += 1
        before = self.robot.pose
        if self._program is not None:
            self._step_program()
        elif self._braking is not None and next(self._braking, True):
            self._braking = None
        self.robot.end_cycle(before)
        force = float(np.linalg.norm(self.wrench[:3]))
        if force > _FORCE_MOST:
            self.protective_stop(f"contact force {force:.1f} N above {_FORCE_MOST:.1f} N")

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

    # Variables that RTDE reports.

    def source(self, name: str) -> Callable[[], rtde.Value]:
        """Return the function that reads output variable `name`."""
        return self._sources[name]

    def _tcp_pose(self) -> rtde.Value:
        pose = self.robot.pose
        if self.pose_error is not None:
            pose = self.pose_error.reported(pose, self.tick)
        return tuple(pose.tolist())

    def report(self, recorded: Mapping[str, rtde.Value]) -> None:
        """Report variables as a mapping has them at the time, and a running program."""
        self.runtime_state = PLAYING
        self._sources |= {name: partial(recorded.__getitem__, name) for name in recorded}

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
        sources["target_TCP_pose"] = lambda: tuple(robot.pose.tolist())
        sources["actual_TCP_pose"] = self._tcp_pose
        for what in ("actual", "target"):
            sources[f"{what}_TCP_speed"] = lambda: tuple(robot.speed.tolist())
            sources[f"{what}_q"] = lambda: tuple(robot.joints.tolist())
        sources["timestamp"] = lambda: self.tick * CYCLE
        sources["actual_TCP_force"] = self._tcp_force
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

    def _tcp_force(self) -> rtde.Value:
        wrench = self.wrench
        if self.wrist is not None:
            wrench = self.wrist.reported(wrench, self.tick * CYCLE)
        if self.tool_mass is not None:
            wrench = wrench - (0, 0, _GRAVITY * (self.tool_mass - self.payload), 0, 0, 0)
        return tuple(wrench.tolist())


_SAFETY = {1: "NORMAL", 3: "PROTECTIVE_STOP", 7: "ROBOT_EMERGENCY_STOP"}


def dashboard_answer(controller: Controller, line: str) -> str:
    """Return the emulated server's answer to `line`, both without line end."""
    question = line.strip().lower()
    playing = controller.runtime_state == PLAYING
    safety = _SAFETY[int(controller.source("safety_mode")())]  # type: ignore[arg-type]
    if question == "stop":
        controller.stop_program("dashboard stop")
        return "Stopped"
    if question == "unlock protective stop":
        if safety == "PROTECTIVE_STOP":
            controller.reset_safety()
        return "Protective stop releasing"
    answers = {
        "polyscopeversion": f"URSoftware {'.'.join(map(str, controller.version))} (Jan 01 2024)",
        "get serial number": "20205500001",
        "get robot model": "UR5",
        "robotmode": f"Robotmode: {'RUNNING' if controller.robot_mode == RUNNING else 'POWER_OFF'}",
        "safetystatus": f"Safetystatus: {safety}",
        "safetymode": f"Safetymode: {safety}",
        "running": f"Program running: {str(playing).lower()}",
        "programstate": f"{'PLAYING' if playing else 'STOPPED'} <unnamed>",
        "quit": "Disconnected",
    }
    if controller.version >= (5, 6):  # the first that answers this
        answers["is in remote control"] = str(controller.remote_control).lower()
    return answers.get(question, f'could not understand: "{line.strip()}"')
