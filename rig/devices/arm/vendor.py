"""Wrapper of ur_rtde's control interface: the few calls we make, with translated exceptions.

Only the supervised child process may use it: the library crashes its process when the connection
drops, and holds the GIL while it connects.

Every movement and stop is asynchronous. A synchronous stopL executes stopj until the first
asynchronous stop was made, and nothing can kick the watchdog during a synchronous move.
"""

import socket
from collections.abc import Callable
from typing import TypeVar

from rtde_control import RTDEControlInterface

from rig.core.errors import DeviceLost
from rig.core.realtime import ARM_PRIORITY, take_priority
from rig.devices.arm import dashboard, rtde
from rig.devices.arm.settings import ArmConfig

_PORTS = {rtde.PORT: "RTDE", 30003: "scripts", dashboard.PORT: "dashboard"}
# Rate of ur_rtde's own package stream: half the default, since its thread costs more than ours.
_RATE_HZ = 250.0
_T = TypeVar("_T")


def check_ready(host: str, timeout: float) -> None:
    """Check that the controller listens and may be moved, before ur_rtde connects to it."""
    for port, what in _PORTS.items():
        try:
            socket.create_connection((host, port), timeout).close()
        except OSError as error:
            raise DeviceLost(
                f"arm at {host}:{port} ({what}): {error}; is the controller on and its network "
                "cable in?"
            ) from error
    dashboard.check_ready(host, timeout)


class UrControl:
    """The program of ur_rtde running on the controller, with its watchdog armed."""

    def __init__(self, config: ArmConfig) -> None:
        self._host = config.host
        # Threads inherit it: one that receives answers must not wait for one that awaits them.
        take_priority(ARM_PRIORITY + 1)
        self._control = self._call(lambda: RTDEControlInterface(config.host, _RATE_HZ))
        take_priority(ARM_PRIORITY)
        tcp, cog = list(config.tcp), list(config.payload_cog)
        self._require("TCP", lambda: self._control.setTcp(tcp))
        self._require("payload", lambda: self._control.setPayload(config.payload, cog))
        self._require("watchdog", lambda: self._control.setWatchdog(config.watchdog_hz))

    def _call(self, action: Callable[[], _T]) -> _T:
        try:
            return action()
        except Exception as error:
            raise DeviceLost(f"arm at {self._host}: ur_rtde: {error}") from error

    def _require(self, what: str, action: Callable[[], bool]) -> None:
        if not self._call(action):
            raise DeviceLost(f"arm at {self._host}: the controller did not take the {what}")

    def kick(self) -> bool:
        """Kick the watchdog; return False when the program no longer runs."""
        return bool(self._call(self._control.kickWatchdog))

    def reaches(self, pose: list[float]) -> bool:
        """Return True if TCP pose (6,) is reachable and within the controller's safety planes."""
        return bool(self._call(lambda: self._control.isPoseWithinSafetyLimits(pose)))

    def start_move(self, pose: list[float], speed: float, acceleration: float) -> bool:
        """Start a straight move to TCP pose (6,) [m, rad, m/s, m/s^2]; return False if rejected."""
        return bool(self._call(lambda: self._control.moveL(pose, speed, acceleration, True)))

    def start_stop(self, deceleration: float) -> None:
        """Start to stop [m/s^2]."""
        self._call(lambda: self._control.stopL(deceleration, True))

    def operation(self) -> tuple[int, bool]:
        """Return the number of the newest asynchronous operation (7 bits), and True if it runs.

        Only a number that differs from the one before the call belongs to the call: the word may
        still be the previous one when an asynchronous call returns.
        """
        status = self._call(self._control.getAsyncOperationProgressEx)
        return int(status.operationId()), bool(status.isAsyncOperationRunning())

    def connected(self) -> bool:
        """Return True if ur_rtde is connected; without a connection a command can hang 300 s."""
        return bool(self._call(self._control.isConnected))

    def close(self) -> None:
        """End the program on the controller; the connection ends with this process."""
        # No disconnect(): it sleeps half a second, and the process exits without destructors.
        if self.connected():
            self._call(self._control.stopScript)
