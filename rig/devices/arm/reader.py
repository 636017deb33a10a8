"""The arm's pose stream: our own RTDE client on port 30004, separate from ur_rtde's.

ur_rtde's receive interface returns only the newest package, skips those that arrive together and
repeats the last one forever when the controller falls silent. This client keeps every package,
counts the missing ones by the controller's own clock and reports the end of the stream.
"""

import math
import select
import socket
from collections.abc import Mapping
from typing import Any, ClassVar

import numpy as np

from rig.core.clock import SECOND_NS, Clock
from rig.core.driver import ReceivingDriver
from rig.core.errors import DeviceLost
from rig.devices.arm import rtde
from rig.devices.arm.settings import ArmConfig, ListenedConfig

# Columns of a sample by the variables that they hold; `t_ns` is added.
COLUMNS = {
    "timestamp": "device_t",
    "actual_TCP_pose": "value",
    "actual_TCP_speed": "speed",
    "speed_scaling": "speed_scaling",
    "target_speed_fraction": "speed_fraction",
    "runtime_state": "runtime_state",
    "safety_status_bits": "safety_status",
    "robot_mode": "robot_mode",
}

# Without a package for this long the controller counts as lost [s].
SILENCE = 1.0

# A package older than the newest by less than this is late; by more, it means a restart [s].
_LATE = 0.5
# Out of reach of any UR arm: a pose beyond this is not in metres [m].
_REACH = 3.0
# Above the length of any rotation vector: a pose beyond this is not in radians [rad].
_TURN = 4 * math.pi

# Samples kept for a late consumer.
_CAPACITY = 10_000
_CHECK = "is the controller on, its network cable in, and no firewall between?"


class RtdeLink:
    """One RTDE connection that streams poses; it has no thread.

    A sample is a dict: `t_ns` host arrival, `device_t` controller clock [s], `value` TCP pose (6,)
    in the base frame [m, rad], `speed` (6,) [m/s, rad/s], `speed_scaling` and `speed_fraction` (the
    slider) in 0..1, `runtime_state`, `safety_status` (bits), `robot_mode`; `more` are further
    variables and the names of their columns. The controller rounds the rate to 500 Hz divided by an
    integer.
    """

    def __init__(
        self, host: str, rate_hz: float, clock: Clock, more: Mapping[str, str] | None = None
    ) -> None:
        self._host = host
        self._columns = {**COLUMNS, **(more or {})}
        self._clock = clock
        self._period = 1 / rate_hz
        self._rate_hz = rate_hz
        self._socket: socket.socket | None = None
        self._buffer = bytearray()
        self._types: tuple[str, ...] = ()
        self._recipe = 0
        self._device_t: float | None = None
        self._heard_ns = 0
        self._failure: DeviceLost | None = None
        self.dropped = 0
        """Packages missing between two received ones, by the controller's clock."""
        self.rejected = {"repeated": 0, "late": 0}
        """Packages received twice, and after a later one, which are among `dropped`."""
        self.version: tuple[int, ...] = ()
        """Controller software: major, minor, bugfix, build."""

    @property
    def _where(self) -> str:
        return f"arm at {self._host}:{rtde.PORT} (RTDE)"

    def open(self, timeout: float) -> None:
        """Connect, negotiate the variables and start the stream within `timeout` [s]."""
        deadline_ns = self._clock.now_ns() + round(timeout * SECOND_NS)
        try:
            self._socket = socket.create_connection((self._host, rtde.PORT), timeout)
            self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            protocol = rtde.PROTOCOL.to_bytes(2, "big")
            if self._ask(rtde.Kind.PROTOCOL, protocol, deadline_ns) != b"\x01":
                raise ValueError("RTDE protocol version 2 refused")
            version = self._ask(rtde.Kind.CONTROLLER, b"", deadline_ns)
            self.version = tuple(
                int.from_bytes(version[k : k + 4], "big") for k in range(0, len(version), 4)
            )
            request = rtde.pack_output_request(self._rate_hz, list(self._columns))
            reply = self._ask(rtde.Kind.OUTPUTS, request, deadline_ns)
            self._recipe, types = rtde.unpack_recipe(reply)
            self._types = tuple(types)
            rtde.layout(self._types)
            if len(types) != len(self._columns):
                raise ValueError(f"{len(types)} types for {len(self._columns)} variables")
            if self._ask(rtde.Kind.START, b"", deadline_ns) != b"\x01":
                raise ValueError("the controller refused to start the stream")
        except OSError as error:
            self.close()
            raise DeviceLost(f"{self._where}: no connection ({error}); {_CHECK}") from error
        except ValueError as error:
            self.close()
            raise DeviceLost(f"{self._where}: {error}; is this a UR controller?") from error
        except DeviceLost:
            self.close()
            raise
        self._device_t = self._failure = None
        self._heard_ns = self._clock.now_ns()

    def _ask(self, kind: rtde.Kind, payload: bytes, deadline_ns: int) -> bytes:
        """Send a message and return the payload of the reply of the same type."""
        if self._socket is None:
            raise DeviceLost(f"{self._where}: not open")
        self._socket.sendall(rtde.pack_message(kind, payload))
        while True:
            for got, answer in rtde.split_messages(self._buffer):
                if got == kind:
                    return answer
            wait = (deadline_ns - self._clock.now_ns()) / SECOND_NS
            if wait <= 0:
                raise DeviceLost(f"{self._where}: connected but mute; restart the controller?")
            self._fill(wait)

    def _fill(self, timeout: float) -> bool:
        """Read the data that has arrived into the buffer; return False if none in `timeout` [s]."""
        if self._socket is None:
            raise DeviceLost(f"{self._where}: not open")
        try:
            if not select.select([self._socket], [], [], max(timeout, 0.0))[0]:
                return False
            received = self._socket.recv(1 << 16)
        except OSError as error:
            raise DeviceLost(f"{self._where}: connection lost ({error}); {_CHECK}") from error
        if not received:
            raise DeviceLost(f"{self._where}: the controller closed the connection; {_CHECK}")
        self._buffer += received
        return True

    def receive(self, timeout: float) -> list[dict[str, Any]]:
        """Return every sample that has arrived, waiting up to `timeout` [s] for one."""
        if self._failure is not None:
            raise self._failure
        if not self._fill(timeout):
            silent = (self._clock.now_ns() - self._heard_ns) / SECOND_NS
            if silent > SILENCE:
                raise DeviceLost(f"{self._where}: no package for {silent:.1f} s; {_CHECK}")
            return []
        t_ns = self._clock.now_ns()
        samples: list[dict[str, Any]] = []
        try:
            for kind, payload in rtde.split_messages(self._buffer):
                sample = self._sample(t_ns, payload) if kind == rtde.Kind.DATA else None
                if sample is not None:
                    samples.append(sample)
        except ValueError as error:
            self._failure = DeviceLost(f"{self._where}: {error}; is this a UR controller?")
            if not samples:
                raise self._failure from error
        if samples:
            self._heard_ns = t_ns
        return samples

    def _sample(self, t_ns: int, payload: bytes) -> dict[str, Any] | None:
        """Return the sample of a package; None if it is a duplicate or late."""
        if not payload or payload[0] != self._recipe:
            raise ValueError(f"RTDE package of a recipe that is not ours ({payload[:1].hex()})")
        values = rtde.unpack_values(self._types, payload[1:])
        sample = dict(zip(self._columns.values(), values, strict=True))
        device_t = float(sample["device_t"])  # type: ignore[arg-type]
        _require_plausible(sample["value"])  # type: ignore[arg-type]
        if self._device_t is not None:
            if not self._device_t - _LATE < device_t:
                raise ValueError(
                    f"controller clock went from {self._device_t:.3f} to {device_t:.3f} s"
                )
            steps = round((device_t - self._device_t) / self._period)
            if steps < 1:
                self.rejected["late" if steps else "repeated"] += 1
                return None
            self.dropped += steps - 1
        self._device_t = device_t
        return {"t_ns": t_ns, **sample}

    def close(self) -> None:
        """Close the connection; may be called twice."""
        if self._socket is not None:
            self._socket.close()
            self._socket = None
        self._buffer.clear()


def _require_plausible(pose: tuple[float, ...]) -> None:
    # Negated, so that NaN fails too.
    far, turned = math.hypot(*pose[:3]), math.hypot(*pose[3:])
    if not (far <= _REACH and turned <= _TURN):
        raise ValueError(
            f"a TCP {far:.6g} m away, turned by {turned:.6g} rad; allowed: {_REACH:g} m, "
            f"{_TURN:.3g} rad; are its units m and rad?"
        )


class RtdePoseDriver(ReceivingDriver):
    """Pose stream of a recording: an `RtdeLink`, with its columns, read by a dedicated thread."""

    MORE: ClassVar[Mapping[str, str]] = {}
    """Further variables to stream, and the names of their columns."""

    def __init__(self, config: ArmConfig | ListenedConfig, clock: Clock) -> None:
        super().__init__(f"arm at {config.host}", clock, _CAPACITY)
        self._config = config
        self._link = RtdeLink(config.host, config.rate_hz, clock, self.MORE)
        self.rejected = self._link.rejected

    @property
    def dropped(self) -> int:
        """Packages missing by the controller's clock, plus those not read in time."""
        return self._link.dropped + self._inbox.overflowed

    def describe(self) -> dict[str, Any]:
        """Return properties that the controller gave on opening."""
        return {
            "model": "UR e-Series, RTDE",
            "address": self._config.host,
            "controller_version": ".".join(map(str, self._link.version)),
            "rate_hz": self._config.rate_hz,
        }

    def _connect(self, timeout: float) -> None:
        self._link.open(timeout)

    def _receive(self) -> None:
        for sample in self._link.receive(0.1):
            self._inbox.put(sample, sample["t_ns"])

    def _release(self) -> None:
        self._link.close()


class RtdeWrenchDriver(RtdePoseDriver):
    """Stream of the arm's own estimate of the force at its tool, over a connection of its own.

    An e-Series arm measures it in its flange, to a few newtons; others estimate it from the
    currents of their joints. It detects a crash and is recorded, but no model learns from it.

    Columns: value (6,) float64 [N, N m] in the base frame, less the payload that is set in the
    controller, without any zero; device_t [s]; t_ns.
    """

    MORE: ClassVar[Mapping[str, str]] = {"actual_TCP_force": "wrench"}

    def read(self, timeout: float) -> list[dict[str, Any]]:
        """Return every sample since the last call, waiting up to `timeout` [s] for one."""
        return [
            {
                "value": np.array(sample["wrench"]),
                "device_t": sample["device_t"],
                "t_ns": sample["t_ns"],
            }
            for sample in super().read(timeout)
        ]

    def describe(self) -> dict[str, Any]:
        """Return properties that the controller gave on opening."""
        return {**super().describe(), "device": "wrench of the arm, RTDE actual_TCP_force"}
