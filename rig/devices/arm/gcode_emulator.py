"""Emulated stage of three axes with GRBL firmware on a pty, whose tip moves in the World.

    python -m rig.mock.emulate gcode '{"device": {"port": "/tmp/stage"}}'

It takes `G1` in millimetres and absolute coordinates, answers `ok` when a line is taken, reports at
`?`, holds at `!` and clears at 0x18. Besides the faults of rig.core.fault_injection there are
`alarm` (a limit switch), `unlock` after it, and `freedrive` with a `pose`: a person turns knobs.
"""

from __future__ import annotations

import math
import os
import re
import select
import threading
from collections import deque
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from rig.core.clock import Clock, Pacer
from rig.core.emulation import EmulatorConfig, PtyEmulator, Served
from rig.core.fault_injection import FaultInjector, corrupted_bytes
from rig.core.geometry import Array
from rig.core.samples import ARM_TRUTH
from rig.core.shared_memory import SharedLatest
from rig.devices.arm.emulator import Vector
from rig.devices.arm.settings import GcodeConfig

_TICK_HZ = 500.0
BANNER = b"\r\nGrbl 1.1h ['$' for help]\r\n"
VERSION = b"[VER:1.1h.20190825:]\r\n[OPT:V,15,128]\r\nok\r\n"
# Blocks that the planner holds; a further line waits for its `ok`.
_BLOCKS = 15
_WORD = re.compile(r"([A-Z])(-?\d+(?:\.\d*)?)")


@dataclass(frozen=True, slots=True)
class GcodeEmulatorConfig(EmulatorConfig):
    """Port, start and firmware settings of the emulated stage."""

    device: GcodeConfig
    state: Path | None = None
    """File to publish the pose in."""
    pose: Vector = (0.0, 0.0, 0.1, math.pi, 0.0, 0.0)
    """TCP at start, in the base frame: x y z [m] rx ry rz [rad]."""
    acceleration: float = field(default=0.1, metadata={"unit": "mm_s2"})
    """Of every axis, as $120 to $122 [m/s^2]."""
    homed: bool = True
    """False: in alarm until it is homed."""


class GrblEmulator(PtyEmulator):
    """Emulated board: one thread takes lines, moves the tip and reports."""

    def __init__(self, config: GcodeEmulatorConfig, clock: Clock) -> None:
        super().__init__(Path(config.device.port))
        self._config = config
        self._clock = clock
        self.faults = FaultInjector[bytes](clock, spoil=corrupted_bytes, seed=config.seed)
        self._truth = SharedLatest.publish(config.state, ARM_TRUTH) if config.state else None
        self.place = np.array(config.pose[:3])
        """Position of the tip [m]."""
        self._speed, self._way = 0.0, np.zeros(3)
        self._blocks: deque[tuple[Array, float]] = deque()
        self._lines: deque[str] = deque()
        self._buffer = ""
        # Held for a cycle of the board, and while a fault is injected from another thread.
        self._cycle = threading.Lock()
        self.state = "Idle" if config.homed else "Alarm"
        """State of the firmware."""
        self.received: list[str] = []
        """Lines that were taken."""

    def apply(self, fault: str, **values: Any) -> dict[str, Any]:
        """Inject a fault, or act as a person at the stage; see the module."""
        with self._cycle:
            if fault == "alarm":
                self._clear("Alarm")
                self._answer(b"ALARM:1\r\n")
            elif fault == "unlock":
                self.state = "Idle"
            elif fault == "freedrive":
                self.place = np.array(values["pose"][:3], np.float64)
            elif fault != "state":
                return self.faults.inject(fault, **values)
            return {"state": self.state, "place": self.place.tolist()}

    def _serve(self) -> None:
        pacer = Pacer(self._clock, _TICK_HZ)
        self._answer(BANNER)
        while not self._ending.is_set():
            t_ns = pacer.wait()
            self.missed = pacer.missed
            with self._cycle:
                if select.select([self._fd], [], [], 0.0)[0]:
                    self._take(os.read(self._fd, 4096).decode("latin-1"))
                while self._lines and len(self._blocks) < _BLOCKS:
                    self._run_line(self._lines.popleft())
                before = self.place
                if self.state in ("Run", "Hold"):
                    self._move(1 / _TICK_HZ)
                if self._truth is not None:
                    speed = (self.place - before) * _TICK_HZ
                    pose = (*self.place, *self._config.device.rotation)
                    self._truth.write((t_ns, pose, (*speed, 0.0, 0.0, 0.0)))

    def _take(self, typed: str) -> None:
        if self.faults.unplugged:
            return
        for letter in typed:
            if letter == "?":
                x, y, z = 1e3 * self.place
                state = (
                    f"{self.state}:{int(self._speed > 0)}" if self.state == "Hold" else self.state
                )
                self._answer(f"<{state}|MPos:{x:.3f},{y:.3f},{z:.3f}|FS:0,0>\r\n".encode())
            elif letter == "!":
                self.state = "Hold" if self.state in ("Idle", "Run") else self.state
            elif letter == "~":
                self.state = "Run" if self.state == "Hold" else self.state
            elif letter == "\x18":
                # In motion, the position would be lost.
                lost = self._speed > 0 or self.state == "Alarm"
                self._clear("Alarm" if lost else "Idle")
                self._answer(BANNER)
            elif letter in "\r\n":
                self._lines.append(self._buffer)
                self._buffer = ""
            else:
                self._buffer += letter

    def _run_line(self, line: str) -> None:
        self.received.append(line)
        words = {letter: float(number) for letter, number in _WORD.findall(line)}
        if line == "$I":
            self._answer(VERSION if self.state in ("Idle", "Alarm") else b"error:8\r\n")
        elif line == "$H":
            self.state = "Idle"
            self._answer(b"ok\r\n")
        elif line and self.state == "Alarm":
            self._answer(b"error:9\r\n")
        elif words.get("G") == 1 and words.get("F", 0) > 0:
            last = self._blocks[-1][0] if self._blocks else self.place
            goal = [1e-3 * words.get(axis, 1e3 * last[k]) for k, axis in enumerate("XYZ")]
            self._blocks.append((np.array(goal), words["F"] / 6e4))
            self.state = "Run" if self.state == "Idle" else self.state
            self._answer(b"ok\r\n")
        elif not line or set(words) <= {"G"}:
            self._answer(b"ok\r\n")
        else:
            self._answer(b"error:20\r\n")

    def _move(self, seconds: float) -> None:
        """Move for a cycle, slowing down towards the end of the planned way, or to a hold."""
        slower = self._config.acceleration * seconds
        left, place = 0.0, self.place
        for goal, _ in self._blocks:
            left += float(np.linalg.norm(goal - place))
            place = goal
        most = self._blocks[0][1] if self._blocks else 0.0
        if self.state == "Hold":
            most = 0.0
        most = min(most, math.sqrt(2 * self._config.acceleration * left))
        self._speed = max(min(most, self._speed + slower), self._speed - slower, 0.0)
        if self.state == "Run" and self._speed <= slower and left > 0:
            self._speed = min(slower, left / seconds)
        step = self._speed * seconds
        while self._blocks and step > 0:
            way = self._blocks[0][0] - self.place
            length = float(np.linalg.norm(way))
            if length > step:
                self.place = self.place + way * (step / length)
                break
            self.place = self._blocks.popleft()[0]
            step -= length
        if not self._blocks:
            self._speed = 0.0
            self.state = "Idle" if self.state == "Run" else self.state

    def _clear(self, state: str) -> None:
        self._blocks.clear()
        self._lines.clear()
        self._buffer, self._speed, self.state = "", 0.0, state

    def _answer(self, content: bytes) -> None:
        for part in self.faults.passed(content):
            self._send(part)


def emulate(settings: GcodeEmulatorConfig, clock: Clock) -> Served:
    """Return the emulated stage."""
    emulator = GrblEmulator(settings, clock)
    return Served("arm", emulator, emulator.apply)
