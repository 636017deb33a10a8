"""Emulated ATI stand-alone F/T controller on a pty, serving the World's wrench as counts.

    python -m rig.devices.force.ati_serial_emulator --link /tmp/force --world PATH

A pty has no baud rate: the emulator sends no faster than the line would. As on a line without
handshake, data that nobody reads in time is lost, possibly in the middle of a record. Faults are
injected through rig.core.fault_injection; `unplug` is the RS-232 cable: the port stays, and is
silent.
"""

from __future__ import annotations

import argparse
import logging
import os
import select
import sys
import threading
import tty
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from rig.core.clock import Clock, Pacer, SystemClock
from rig.core.emulation import Served, SharedWorld, WorldReader, emulator_parser, run_emulator
from rig.core.errors import ConfigError
from rig.core.fault_injection import FaultInjector, corrupted_bytes
from rig.devices.force.ati_serial_wire import PROMPT, SerialRecord, emit
from rig.devices.force.settings import RECORD_BYTES

logger = logging.getLogger(__name__)

_NOISE_ROWS = 8192
# N m of torque noise per N of force noise: the ratio of a Nano17's resolutions.
_TORQUE_NOISE = 0.005
_COUNTS_MAX = 32767
# Error field when a count is at its limit.
_SATURATED = 1
_LINE_MAX = 80
_FORMS = {"CD A": "ascii", "CD B": "binary"}


@dataclass(frozen=True, slots=True)
class AtiSerialEmulatorConfig:
    """Port and scale of the emulated controller."""

    link: Path
    """Link to the pty, which the emulator creates."""
    counts_per_n: float = 1280.0
    """Roughly that of a Nano17: 17 N stay within 16 bits."""
    counts_per_n_mm: float = 256.0
    baud: int = 38400
    rate_hz: float = 200.0
    """Records per second, if the line is fast enough."""
    noise: float = 0.0
    """Standard deviation of the force components [N]."""
    seed: int = 0


class AtiSerialEmulator:
    """Emulated controller: one thread receives commands and sends records."""

    def __init__(self, config: AtiSerialEmulatorConfig, world: WorldReader, clock: Clock) -> None:
        self._config = config
        self.faults = FaultInjector[bytes](clock, spoil=corrupted_bytes, seed=config.seed)
        self._world = world
        self._clock = clock
        scale = np.repeat([config.counts_per_n, config.counts_per_n_mm * 1e3], 3)
        noise = np.random.default_rng(config.seed).normal(0.0, config.noise, (_NOISE_ROWS, 6))
        noise[:, 3:] *= _TORQUE_NOISE
        self._scale, self._noise = scale, noise * scale
        self._row = 0
        self.missed = 0
        """Number of records skipped as too late."""
        self._form = "ascii"
        self._typed = b""
        self._streaming = False
        self._ending = threading.Event()
        self._thread: threading.Thread | None = None
        self._ours = self._theirs = -1

    @property
    def address(self) -> str:
        """Link for a driver to open."""
        return str(self._config.link)

    @property
    def rate_hz(self) -> float:
        """Records per second in the current format, limited by the line."""
        carried = self._config.baud / 10 / RECORD_BYTES[self._form]
        return min(self._config.rate_hz, carried)

    def start(self) -> None:
        """Create the pty and the link to it, and serve.

        Raises:
            OSError: No pty is available, or the link cannot be created.
        """
        # The other end stays open here too, so that clients may come and go.
        self._ours, self._theirs = os.openpty()
        for end in (self._ours, self._theirs):
            tty.setraw(end)
        os.set_blocking(self._ours, False)
        link = self._config.link
        if link.is_symlink():
            link.unlink()
        try:
            link.symlink_to(os.ttyname(self._theirs))
        except OSError:
            self._close_pty()
            raise
        self._thread = threading.Thread(target=self._serve, name="ati-serial-emulator")
        self._thread.start()

    def close(self) -> None:
        """Stop serving, as if unplugged; may be called twice."""
        self._ending.set()
        if self._thread is not None:
            self._thread.join()
            self._thread = None
            self._config.link.unlink(missing_ok=True)
        self._close_pty()

    def _close_pty(self) -> None:
        for end in (self._ours, self._theirs):
            if end >= 0:
                os.close(end)
        self._ours = self._theirs = -1

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
                pacer, missed = Pacer(self._clock, self.rate_hz), self.missed
            pacer.wait()
            self.missed = missed + pacer.missed
            self._take_commands(0.0)
            if self._streaming:
                for content in self.records(emit(self._record(), self._form)):
                    self._send(content)

    def _record(self) -> SerialRecord:
        _, state = self._world.state()
        self._row = (self._row + 1) % _NOISE_ROWS
        counts = np.rint(np.array(state["wrench"]) * self._scale + self._noise[self._row])
        error = _SATURATED if np.abs(counts).max() > _COUNTS_MAX else 0
        shown = counts.clip(-_COUNTS_MAX, _COUNTS_MAX).astype(int).tolist()
        return SerialRecord(error, tuple(shown))

    def _take_commands(self, timeout: float) -> None:
        if not select.select([self._ours], [], [], timeout)[0]:
            return
        typed = os.read(self._ours, 256)
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

    def _send(self, content: bytes) -> None:
        try:
            os.write(self._ours, content)
        except BlockingIOError:
            # Nobody reads it: the line has no handshake, the bytes are lost.
            logger.debug("%d bytes lost: nobody reads", len(content))


def main(argv: Sequence[str] | None = None) -> int:
    """Serve until terminated; return the exit code."""
    parser = emulator_parser("rig.devices.force.ati_serial_emulator", __doc__)
    defaults = AtiSerialEmulatorConfig(Path())
    parser.add_argument("--link", type=Path, required=True, help="link to create to the pty")
    parser.add_argument(
        "--counts-per-n", type=float, default=defaults.counts_per_n, help="(%(default)s)"
    )
    parser.add_argument(
        "--counts-per-n-mm", type=float, default=defaults.counts_per_n_mm, help="(%(default)s)"
    )
    parser.add_argument("--baud", type=int, default=defaults.baud, help="(%(default)s)")
    parser.add_argument(
        "--rate-hz", type=float, default=defaults.rate_hz, help="records per second (%(default)s)"
    )
    parser.add_argument("--noise", type=float, default=0.0, help="std of the force [N] (none)")
    return run_emulator(parser, _make, argv)


def _make(args: argparse.Namespace, world: SharedWorld) -> Served:
    for name in ("counts_per_n", "counts_per_n_mm", "baud", "rate_hz"):
        if not getattr(args, name) > 0:
            raise ConfigError(f"{name}: found {getattr(args, name)}; allowed: above 0")
    config = AtiSerialEmulatorConfig(
        args.link,
        args.counts_per_n,
        args.counts_per_n_mm,
        args.baud,
        args.rate_hz,
        args.noise,
        args.seed,
    )
    emulator = AtiSerialEmulator(config, world, SystemClock())
    return Served("ati_serial", emulator, emulator.faults.inject)


if __name__ == "__main__":
    sys.exit(main())
