"""Emulated ATI stand-alone F/T controller on a pty, serving the World's wrench as counts.

    python -m rig.mock.emulate ati_serial '{"device": {"address": "/tmp/force", ...}}'

The address becomes a link to the pty, as udev's links name a lab's port. A pty has no
baud rate: the emulator sends no faster than the line would. As on a line without handshake, data
that nobody reads in time is lost, possibly in the middle of a record. Faults are injected through
rig.core.fault_injection; `unplug` is the RS-232 cable: the port stays, and is silent.
"""

from __future__ import annotations

import os
import select
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from rig.core.clock import Clock, Pacer
from rig.core.emulation import (
    LATE_MOST,
    EmulatorConfig,
    PtyEmulator,
    Served,
    SharedWorld,
    WorldReader,
)
from rig.core.fault_injection import FaultInjector, corrupted_bytes
from rig.devices.force.ati_serial_wire import PROMPT, SerialRecord, emit
from rig.devices.force.emulated_noise import NOISE_ROWS, noise_table
from rig.devices.force.settings import RECORD_BYTES, AtiSerialConfig

_COUNTS_MAX = 32767
# Error field when a count is at its limit.
_SATURATED = 1
_LINE_MAX = 80
_FORMS = {"CD A": "ascii", "CD B": "binary"}


@dataclass(frozen=True, slots=True)
class AtiSerialEmulatorConfig(EmulatorConfig):
    """Port and scale of the emulated controller."""

    device: AtiSerialConfig
    """Its rate is kept if the line is fast enough for the format that the client asks for."""
    noise: float = field(default=0.0, metadata={"unit": "n"})
    """Standard deviation of the force components [N]."""


class AtiSerialEmulator(PtyEmulator):
    """Emulated controller: one thread receives commands and sends records."""

    def __init__(self, config: AtiSerialEmulatorConfig, world: WorldReader, clock: Clock) -> None:
        super().__init__(Path(config.device.address))
        self._config = config
        self.faults = FaultInjector[bytes](clock, spoil=corrupted_bytes, seed=config.seed)
        self._world = world
        self._clock = clock
        device = config.device
        self._scale = np.repeat([device.counts_per_n, device.counts_per_n_mm * 1e3], 3)
        self._noise = noise_table(config.seed, config.noise) * self._scale
        self._row = 0
        self._form = "ascii"
        self._typed = b""
        self._streaming = False

    @property
    def rate_hz(self) -> float:
        """Records per second in the current format, limited by the line."""
        line_rate = self._config.device.baud / 10 / RECORD_BYTES[self._form]
        return min(self._config.device.rate_hz, line_rate)

    def records(self, content: bytes) -> Iterable[bytes]:
        """Return the content sent for one record; faults and tests lose or corrupt bytes here."""
        return self.faults.passed(content)

    def answer(self, command: str) -> bytes:
        """Return the answer to a command, between echo and prompt; tests reject commands here."""
        if command in _FORMS:
            self._form = _FORMS[command]
        elif command == "QR":
            return emit(self._record(), self._form)
        return b""

    def _serve(self) -> None:
        pacer: Pacer | None = None
        while not self._ending.is_set():
            if not self._streaming:
                pacer = None
                self._take_commands(0.05)
                continue
            if pacer is None:
                pacer = Pacer(self._clock, self.rate_hz)
            pacer.wait()
            self.missed += pacer.late
            self._take_commands(0.0)
            # The controller's clock never stands still: late records are sent all the same.
            due = 1 + min(pacer.late, LATE_MOST) if self._streaming else 0
            for _ in range(due):
                for content in self.records(emit(self._record(), self._form)):
                    self._send(content)

    def _record(self) -> SerialRecord:
        _, state = self._world.state()
        self._row = (self._row + 1) % NOISE_ROWS
        counts = np.rint(np.array(state["wrench"]) * self._scale + self._noise[self._row])
        error = _SATURATED if np.abs(counts).max() > _COUNTS_MAX else 0
        shown = counts.clip(-_COUNTS_MAX, _COUNTS_MAX).astype(int).tolist()
        return SerialRecord(error, tuple(shown))

    def _take_commands(self, timeout: float) -> None:
        if not select.select([self._fd], [], [], timeout)[0]:
            return
        typed = os.read(self._fd, 256)
        if self.faults.unplugged:
            return
        *lines, rest = (self._typed + typed).split(b"\r")
        self._typed = rest[-_LINE_MAX:]
        for line in lines:
            command = line.decode("ascii", "replace").strip()
            if self._streaming:
                # Any CR ends the stream; the text before it is ignored.
                self._streaming = False
                self._send(PROMPT)
            elif command == "QS":
                self._send(b"QS\r\n")
                self._streaming = True
            else:
                self._send(command.encode() + b"\r\n" + self.answer(command) + PROMPT)


def emulate(settings: AtiSerialEmulatorConfig, clock: Clock) -> Served:
    """Return the emulated controller."""
    emulator = AtiSerialEmulator(settings, SharedWorld(settings.world), clock)
    return Served("ati_serial", emulator, emulator.faults.inject)
