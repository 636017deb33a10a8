"""Interlocks that do not record: the gripper that holds the indenter, and the foot pedal.

Each is watched by its own thread. `wake` notifies the plan runner, which then calls `check` and
acts. Their properties are in the session's run entry, under `devices`.
"""

from __future__ import annotations

import contextlib
import socket
from typing import TYPE_CHECKING, Any

from rig.acquire.control import Control
from rig.bench.bench import Bench
from rig.core.clock import Clock
from rig.core.errors import ConfigError, DeviceLost, SafetyStop, raise_all
from rig.devices.hid.settings import PedalConfig

if TYPE_CHECKING:
    from rig.devices.gripper.robotiq import GripWatch
    from rig.devices.hid.pedal import DeadMan, PedalState, PedalWatch

# Source of the pauses that the pedal requests.
PEDAL = "foot pedal"


class DeadManReleased(Exception):
    """The dead-man pedal is not held: the arm must not press."""


class Interlocks:
    """Interlocks of a bench, its gripper and its pedal, if any; a context manager.

    A pedal of mode `pause` pauses `control`.
    """

    def __init__(self, bench: Bench, control: Control, clock: Clock) -> None:
        self._timeout = bench.preflight.timeout
        self.control = control
        self._waker, self.wake = socket.socketpair()
        """Socket that becomes readable when `check` should be called."""
        for end in (self._waker, self.wake):
            end.setblocking(False)
        self._grip: GripWatch | None = None
        self._pedal: PedalWatch | None = None
        self._dead_man: DeadMan | None = None
        self._config: PedalConfig | None = bench.pedal
        # Imported here, so that a bench without them does not need their libraries.
        if bench.gripper is not None:
            from rig.devices.gripper.robotiq import GripWatch

            self._grip = GripWatch(bench.gripper, clock, self._tell)
        if bench.pedal is not None:
            from rig.devices.hid.pedal import PedalWatch

            self._pedal = PedalWatch(bench.pedal, clock, self._on_pedal)
            if bench.pedal.mode == "dead_man":
                from rig.devices.hid.pedal import DeadMan

                self._dead_man = DeadMan()

    def __enter__(self) -> Interlocks:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def open(self) -> dict[str, dict[str, Any]]:
        """Connect to all devices, start watching, and return their properties by device."""
        description: dict[str, dict[str, Any]] = {}
        failures: list[Exception] = []
        if self._grip is not None:
            try:
                description["gripper"] = self._grip.open(self._timeout)
            except (ConfigError, DeviceLost) as error:
                failures.append(error)
        if self._pedal is not None:
            try:
                description["pedal"] = self._pedal.open()
            except (ConfigError, DeviceLost) as error:
                failures.append(error)
        raise_all(failures)
        return description

    def check(self, *, pressing: bool = False) -> None:
        """Raise if an interlock forbids continuing.

        Args:
            pressing: True if the arm presses, or is about to: a dead-man pedal must be held.
        """
        with contextlib.suppress(BlockingIOError):
            while self.wake.recv(64):
                pass
        if self._grip is not None and self._grip.lost is not None:
            raise SafetyStop(self._grip.lost)
        self._check_pedal_is_in()
        if pressing and self._dead_man is not None and self._pedal is not None:
            state = self._pedal.state
            if not self._dead_man.held(state):
                done = "released" if state.out_since_ns is None else "unplugged"
                raise DeadManReleased(f"the foot pedal was {done}")

    def armed(self) -> bool:
        """Return True if the arm may press: no dead-man pedal, or a pedal that is pressed.

        The pedal must have been pressed after its last release, and after the last `disarm`.
        """
        dead_man, pedal = self._dead_man, self._pedal
        return dead_man is None or pedal is None or dead_man.armed(pedal.state)

    def disarm(self) -> None:
        """Require a new press; one made while the arm was still leaving does not count."""
        if self._dead_man is not None and self._pedal is not None:
            self._dead_man.disarm(self._pedal.state)

    @property
    def wish(self) -> str:
        """Instruction to the operator for arming a dead-man pedal, for the progress line."""
        if self._pedal is None or self._config is None:
            return ""
        if self._pedal.state.out_since_ns is not None:
            limit = self._config.unplugged_limit
            return f"the foot pedal is unplugged: plug it in (lost after {limit:g} s)"
        if self._pedal.state.down:
            return "let go of the foot pedal, then press and hold it"
        return "press and hold the foot pedal"

    def close(self) -> None:
        """Stop watching; may be called twice."""
        for watch in (self._grip, self._pedal):
            if watch is not None:
                watch.close()
        self._waker.close()
        self.wake.close()

    def _check_pedal_is_in(self) -> None:
        if self._pedal is None or self._config is None:
            return
        out = self._pedal.out_for
        if out is not None and out > self._config.unplugged_limit:
            raise DeviceLost(
                f"foot pedal at {self._config.device}: unplugged for {out:.1f} s; allowed: "
                f"{self._config.unplugged_limit:g} s"
            )

    def _on_pedal(self, before: PedalState, after: PedalState) -> None:
        if self._dead_man is None:
            if after.out_since_ns is not None:
                # A user who relies on the pedal must not find it missing when it is needed.
                self.control.pause(PEDAL)
            elif after.presses > before.presses:
                if PEDAL in self.control.paused_by:
                    self.control.resume(PEDAL)
                else:
                    self.control.pause(PEDAL)
        self._tell()

    def _tell(self) -> None:
        with contextlib.suppress(OSError):
            # Full: nothing has been read yet, and one byte suffices.
            self._waker.send(b"!")
