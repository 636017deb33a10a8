"""Emulated load cell board or scale on a pty, which weighs the World's force on the sensor.

    python -m rig.mock.emulate scale '{"device": {"protocol": "kern", "address": "/tmp/scale"}}'

Its reading follows the force through a filter of `lag`, as that of a scale does, and the unit is
missing while it moves. Faults are injected through rig.core.fault_injection.
"""

import math
import os
import select
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from rig.core.clock import Clock, Pacer
from rig.core.emulation import EmulatorConfig, PtyEmulator, Served, SharedWorld
from rig.core.fault_injection import FaultInjector, corrupted_bytes
from rig.devices.force.settings import ScaleConfig

_GRAMS_PER_N = 1e3 / 9.80665
# A scale shows its unit while the reading moves by less than this between two readings [N].
_STABLE = 0.003
# Standard deviation of a reading, relative to that of a sample.
_AVERAGED = 0.2
# The filter is computed this often [Hz].
_FILTER_HZ = 50.0


@dataclass(frozen=True, slots=True)
class ScaleEmulatorConfig(EmulatorConfig):
    """Port, protocol and filter of the emulated scale."""

    device: ScaleConfig
    """Its rate is that of a board that sends by itself."""
    noise: float = field(default=0.0, metadata={"unit": "n"})
    """Standard deviation of a sample of its load cell [N]; a reading is averaged over many."""
    lag: float = field(default=0.1, metadata={"unit": "ms"})
    """Time constant of the scale's filter [s]."""


class ScaleEmulator(PtyEmulator):
    """Emulated scale: one thread filters the force, takes commands and sends lines."""

    def __init__(self, config: ScaleEmulatorConfig, world: SharedWorld, clock: Clock) -> None:
        super().__init__(Path(config.device.address))
        self._config = config
        self.faults = FaultInjector[bytes](clock, spoil=corrupted_bytes, seed=config.seed)
        self._world = world
        self._clock = clock
        self._noise = _AVERAGED * config.noise
        self._rng = np.random.default_rng(config.seed)
        self._filtered = self._before = 0.0

    def _serve(self) -> None:
        pacer = Pacer(self._clock, _FILTER_HZ)
        device = self._config.device
        every = max(round(_FILTER_HZ / device.rate_hz), 1)
        decay = math.exp(-1 / (_FILTER_HZ * max(self._config.lag, 1e-6)))
        tick = 0
        while not self._ending.is_set():
            pacer.wait()
            self.missed = pacer.missed
            tick += 1
            force = -float(self._world.state()[1]["wrench"][2])
            self._filtered = decay * self._filtered + (1 - decay) * force
            count = self._requested_count()
            if device.protocol == "hx711":
                count = int(tick % every == 0)
            for _ in range(count):
                for content in self.faults.passed(self._line()):
                    self._send(content)

    def _requested_count(self) -> int:
        if not select.select([self._fd], [], [], 0.0)[0]:
            return 0
        typed = os.read(self._fd, 256)
        if self.faults.unplugged:
            return 0
        command = {"kern": b"w", "sartorius": b"\x1bP"}.get(self._config.device.protocol)
        return 0 if command is None else typed.count(command)

    def _line(self) -> bytes:
        device = self._config.device
        reading = self._filtered + self._rng.normal(0.0, self._noise)
        stable = abs(reading - self._before) < max(_STABLE, 4 * self._noise)
        self._before = reading
        if device.direction == "up":
            reading = -reading
        if device.protocol == "hx711":
            number = reading * (device.counts_per_n or _GRAMS_PER_N)
            text = f"{number:.0f}" if device.counts_per_n else f"{number:.2f}"
            return f"{text}\r\n".encode()
        grams = reading * _GRAMS_PER_N
        sign, unit = "-" if grams < 0 else "+", "g" if stable else ""
        if device.protocol == "kern":
            return f"{'-' if grams < 0 else ' '}{abs(grams):10.2f} {unit:<3}\r\n".encode()
        return f"{'N':<6}{sign}{abs(grams):10.2f} {unit:<3}\r\n".encode()


def emulate(settings: ScaleEmulatorConfig, clock: Clock) -> Served:
    """Return the emulated scale."""
    emulator = ScaleEmulator(settings, SharedWorld(settings.world), clock)
    return Served("scale", emulator, emulator.faults.inject)
