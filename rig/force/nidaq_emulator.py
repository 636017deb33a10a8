"""Emulated NI card with an ATI DAQ F/T on it: NI-DAQmx by gRPC, the World's wrench as volts.

    python -m rig.force.nidaq_emulator --calibration benches/mock-nano17.cal --world PATH

It answers what a client needs for one task of analog inputs, as the NI gRPC Device Server would:
errors as status UNKNOWN with the code in the trailing metadata `ni-error`. Voltages are the World's
wrench through the inverse of the calibration, cut off at the range and rounded to 16 bits. Faults
come in through rig.disturbance: on the way from the converter into the card's buffer.
"""

from __future__ import annotations

import argparse
import logging
import random
import sys
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import grpc
import numpy as np
import numpy.typing as npt

from rig.clock import Clock, Pacer, SystemClock
from rig.disturbance import Disturbance
from rig.emulation import SharedWorld, World, add_arguments, fault_port, serve
from rig.errors import ConfigError
from rig.force.calibration import Calibration
from rig.force.calibration_file import read_calibration
from rig.force.nidaq_buffer import Buffer, Channel
from rig.force.nidaq_service import Service

logger = logging.getLogger(__name__)

Array = npt.NDArray[np.float64]

_NOISE_ROWS = 8192
_TORQUE_NOISE = 0.005
# N m of torque noise per N of force noise: the ratio of a Nano17's resolutions.
_BITS = 16


@dataclass(frozen=True, slots=True)
class NidaqEmulatorConfig:
    """Where the emulated card is reached and what hangs on it."""

    calibration: Calibration
    host: str = "127.0.0.1"
    port: int = 31763
    device: str = "Dev1"
    """Name of the card."""
    offset: tuple[float, ...] = (0.0,) * 6
    """Voltages of the gauges without a load [V]."""
    noise: float = 0.0
    """Standard deviation of the force components [N]."""
    seed: int = 0
    rate_max_hz: float = 250_000.0
    """Highest rate the card has."""


class NidaqEmulator:
    """The emulated card: a thread of its own is its sample clock, others answer calls."""

    def __init__(self, config: NidaqEmulatorConfig, world: World, clock: Clock) -> None:
        self.config = config
        self.disturbance = Disturbance[Array](clock, spoil=_spoilt, seed=config.seed)
        self._world = world
        self._clock = clock
        self._missed = 0
        self._server: grpc.Server | None = None
        self._pool: ThreadPoolExecutor | None = None
        rng = np.random.default_rng(config.seed)
        noise = rng.normal(0.0, config.noise, (_NOISE_ROWS, 6))
        noise[:, 3:] *= _TORQUE_NOISE
        self._noise = config.calibration.volts(noise)
        self._row = 0
        self._newest, self._volts = -1, np.zeros(6)
        self._service = Service(self)

    @property
    def address(self) -> str:
        """What a client connects to."""
        return f"{self.config.host}:{self.config.port}"

    @property
    def unplugged(self) -> bool:
        """Whether the card is out of the computer that serves it."""
        return self.disturbance.unplugged

    @property
    def missed(self) -> int:
        """Ticks of the sample clock at which this thread was late; the sample was repeated."""
        return self._missed

    def start(self) -> None:
        """Listen and serve.

        Raises:
            OSError: The address cannot be had.
        """
        # A few threads: a client that waits for samples holds one.
        self._pool = ThreadPoolExecutor(4, "nidaq-emulator")
        self._server = grpc.server(self._pool, options=(("grpc.so_reuseport", 0),))
        self._service.add_to(self._server)
        try:
            self._server.add_insecure_port(self.address)
        except RuntimeError as error:
            self._pool.shutdown()
            raise OSError(str(error)) from error
        self._server.start()

    def close(self) -> None:
        """Stop serving; safe twice."""
        self._service.close()
        if self._server is not None:
            self._server.stop(0.1).wait()
            self._server = None
        if self._pool is not None:
            self._pool.shutdown()
            self._pool = None

    def samples(self, volts: Array) -> Array:
        """What the converter puts into the buffer at one tick: (n, 6) [V]; n is 1 mostly.

        Where faults and tests stop the sample clock (no row) and spoil voltages.
        """
        passed = self.disturbance.passed(volts)
        return np.concatenate(passed) if passed else volts[:0]

    def converted(self, channels: Sequence[Channel]) -> Array:
        """The voltages of now, (1, channels): noise, the channels' ranges, 16 bits."""
        number, state = self._world.state()
        if number != self._newest:
            calibration = self.config.calibration
            volts = calibration.volts(np.array(state["wrench"], np.float64))
            self._newest, self._volts = number, volts + np.array(self.config.offset)
        self._row = (self._row + 1) % _NOISE_ROWS
        gauges = self._volts + self._noise[self._row]
        low = np.array([channel.low for channel in channels])
        high = np.array([channel.high for channel in channels])
        step = (high - low) / 2**_BITS
        volts = gauges[[channel.number for channel in channels]]
        codes = np.clip(np.rint((volts - low) / step), 0, 2**_BITS - 1)
        converted: Array = (low + codes * step)[np.newaxis]
        return converted

    def run_clock(self, rate_hz: float, channels: Sequence[Channel], buffer: Buffer) -> None:
        """The sample clock of one running task: fills `buffer` until it is stopped."""
        pacer = Pacer(self._clock, rate_hz)
        missed = 0
        while not buffer.stopped.is_set():
            pacer.wait()
            late, missed = pacer.missed - missed, pacer.missed
            self._missed += late
            # The card's clock never stands still: what came too late is there all the same.
            rows = self.samples(np.repeat(self.converted(channels), 1 + late, axis=0))
            if len(rows):
                buffer.put(rows)


def _spoilt(volts: Array, rng: random.Random) -> Array:
    """As many voltages, all of them random."""
    low, high = -10.0, 10.0
    return np.array([[rng.uniform(low, high) for _ in row] for row in volts])


def main(argv: Sequence[str] | None = None) -> int:
    """Serve until told to end; returns the exit code."""
    parser = argparse.ArgumentParser(prog="rig.force.nidaq_emulator", description=__doc__)
    add_arguments(parser)
    parser.add_argument("--port", type=int, default=31763, help="(%(default)s)")
    parser.add_argument(
        "--calibration", type=Path, required=True, help="the transducer's .cal file"
    )
    parser.add_argument("--device", default="Dev1", help="name of the card (%(default)s)")
    parser.add_argument("--noise", type=float, default=0.0, help="std of the force [N] (none)")
    args = parser.parse_args(argv)
    try:
        calibration = read_calibration(args.calibration)
    except ConfigError as error:
        parser.error(str(error))
    config = NidaqEmulatorConfig(
        calibration, args.host, args.port, args.device, noise=args.noise, seed=args.seed
    )
    world = SharedWorld(args.world)
    try:
        emulator = NidaqEmulator(config, world, SystemClock())
        return serve(
            "nidaq",
            emulator,
            until_stdin_closes=args.until_stdin_closes,
            faults=fault_port(args, emulator.disturbance.inject),
        )
    finally:
        world.close()


if __name__ == "__main__":
    sys.exit(main())
