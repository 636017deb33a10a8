"""Arms for tests: simulated ones, and the real ur_rtde in its child against an emulator."""

import json
import os
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from support.waiting import until

from rig.core import emulation
from rig.core.clock import SystemClock
from rig.core.geometry import compose
from rig.core.guard import GuardLimits
from rig.core.mock_names import PORTS
from rig.devices.arm.arm import Arm
from rig.devices.arm.emulated_arm import POSTURE, flange_pose
from rig.devices.arm.emulated_controller import Controller
from rig.devices.arm.settings import ArmConfig

ROOT = Path(__file__).resolve().parents[2]
HOST = f"127.{110 + os.getpid() // 250 % 100}.{1 + os.getpid() % 250}.1"
# Loopback addresses by process, so that parallel runs do not collide.
TCP = (0.0, 0.0, 0.1, 0.0, 0.0, 0.0)
START = compose(flange_pose(np.array(POSTURE)), TCP)
FRAME = (*(START[:3] - [0.0, 0.0, 0.03]), 0.0, 0.0, 0.0)
LIMITS = GuardLimits(
    force_rating=(10.0, 10.0, 10.0, 1.0, 1.0, 1.0),
    box=((-0.05, -0.05, -0.005), (0.05, 0.05, 0.06)),
    # Generous: delays of the machine must not look like a lost sensor.
    stale_force=2.0,
    stale_pose=2.0,
)
# A child that is delayed by a quarter of a second must not count as dead here.
CONFIG = ArmConfig(host=HOST, tcp=TCP, payload=0.7, retract=0.01, watchdog_hz=2.0)
CLOCK = SystemClock()
# What ur_rtde uploads, and numbers and flags in the registers.
SCRIPT = "def rtde_control():\n  x\nend\n"
MOVE_L, STOP_L = 3, 33
RUNNING = 0x8000


def inject(fault: str = "state", **values: Any) -> dict[str, Any]:
    return emulation.inject(HOST, PORTS["arm"], fault, **values)


def at(x: float, y: float, z: float, vector: Any = START[3:]) -> np.ndarray:
    """Return the TCP pose at a position in the contact frame, which is parallel to the base."""
    return np.array([FRAME[0] + x, FRAME[1] + y, FRAME[2] + z, *vector])


def height() -> float:
    return inject()["pose"][2] - FRAME[2]


def moving() -> bool:
    return any(abs(speed) > 1e-3 for speed in inject()["speed"])


def stands_still() -> bool:
    """Return True if the pose is constant over at least 50 controller cycles."""
    before = inject()
    until(lambda: inject()["tick"] >= before["tick"] + 50)
    return inject()["pose"] == before["pose"]


@contextmanager
def emulated() -> Iterator[subprocess.Popen[str]]:
    """Yield an emulator at HOST with the arm at START."""
    tcp = {"position_mm": [1e3 * metre for metre in TCP[:3]]}
    settings = {"host": HOST, "pose": START.tolist(), "device": {"host": HOST, "tcp": tcp}}
    command = [sys.executable, "-m", "rig.mock.emulate", "ur", json.dumps(settings)]
    command += ["--until-stdin-closes"]
    with subprocess.Popen(
        command, cwd=ROOT, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == f"ready arm {HOST}\n"
        yield process
        process.kill()


def make(**options: Any) -> Arm:
    return Arm(
        options.pop("config", CONFIG),
        FRAME,
        options.pop("limits", LIMITS),
        guards=options.pop("guards", {}),
        pose_path=options.pop("pose_path", None),
    )


@contextmanager
def started(**options: Any) -> Iterator[Arm]:
    """Yield an arm that accepts commands."""
    arm = make(**options)
    arm.start(20.0)
    yield arm
    arm.close()
    arm.close()


def back_at_start(arm: Arm) -> Arm:
    """Return a shared arm to the state in which the first test received it."""
    inject("slider", fraction=1.0)
    assert arm.move(START, mode="travel").outcome == "done"
    return arm


class Once:
    """An `on_wait` that acts once, as soon as the arm moves."""

    def __init__(self, action: Callable[[], object]) -> None:
        self._action = action
        self.done = False

    def __call__(self) -> None:
        if not self.done and moving():
            self.done = True
            self._action()


class Client:
    """Emulates ur_rtde's use of the registers, one controller cycle at a time."""

    def __init__(self, controller: Controller) -> None:
        self.controller = controller
        controller.start_program(SCRIPT)
        self.run(2)

    def run(self, cycles: int) -> None:
        for _ in range(cycles):
            self.controller.cycle()

    def write(self, command: int, doubles=(), flag: int = 0) -> None:
        names = ["input_int_register_0", "input_int_register_1"]
        names += [f"input_double_register_{k}" for k in range(len(doubles))]
        self.controller.write_inputs(names, [command, flag, *map(float, doubles)])

    def command(self, command: int, doubles=(), flag: int = 0, *, cycles: int = 5000) -> int:
        """Run a command to its end, and return the number of cycles."""
        self.write(command, doubles, flag)
        for took in range(cycles):
            self.controller.cycle()
            if self.state == 2:
                self.write(0)
                self.run(1)
                assert self.state == 1
                return took + 1
        raise AssertionError(f"command {command} not done in {cycles} cycles")

    @property
    def state(self) -> int:
        return self.controller.source("output_int_register_0")()

    @property
    def result(self) -> int:
        return self.controller.source("output_int_register_1")()

    @property
    def word(self) -> tuple[int, int, bool]:
        word = self.controller.source("output_int_register_2")()
        return word >> 24, word >> 16 & 0x7F, bool(word & RUNNING)
