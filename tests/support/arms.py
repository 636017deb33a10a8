"""Arms with the real ur_rtde in its supervised child, against the emulator in a process."""

from __future__ import annotations

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
