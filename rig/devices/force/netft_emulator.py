"""Emulated ATI Net F/T box: RDT by UDP and settings pages by HTTP, of the World or a recording.

    python -m rig.mock.emulate netft '{"host": "127.0.0.5", "device": {"http_port": 8080}}'

Like the box, it streams only to the last client that requested a stream, and its sample clock never
stands still: a record that it is late for is sent with the next one. Its bias (0x42) lasts until
the process ends. `wrong_units` of rig.core.fault_injection sets pound-force as its unit.

The driver needs one record to open. Of a recording it gets the first row's values under the number
before, and counts on from there; the recorded rows follow under their recorded numbers.
"""

from __future__ import annotations

import contextlib
import select
import socket
from dataclasses import dataclass, field, replace
from functools import partial
from typing import TYPE_CHECKING, Any
from urllib.parse import SplitResult, parse_qs

import numpy as np
import numpy.typing as npt

from recorder.errors import SessionError
from rig.core.clock import Clock, Pacer
from rig.core.emulation import LATE_MOST, DeviceHandler, DeviceServer, Emulator, Served, SharedWorld
from rig.core.errors import ConfigError
from rig.core.fault_injection import FaultInjector, corrupted_bytes
from rig.core.playback import PlayableConfig, Playback, stated_rate
from rig.devices.force import netft_wire as wire
from rig.devices.force.emulated_noise import NOISE_ROWS, noise_table
from rig.devices.force.settings import NetFtConfig

if TYPE_CHECKING:
    from recorder.session import Stream

_INTERNAL_HZ = 7000
_WRONG_UNITS = ("lbf", "lbf-in")
# Rows of a recording under way: a socket of the default size holds 250 packets.
_WINDOW = 128
# Counts per component, or rows of them.
Counts = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]
Floats = npt.NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class NetFtEmulatorConfig(PlayableConfig):
    """Ports and settings of the emulated box."""

    device: NetFtConfig = field(default=NetFtConfig(http_port=8080))
    page: wire.Page = field(default=wire.Page(product="Net F/T emulator", serial="FT00000"))
    """Content of netftapi2.xml; comm.cgi changes its rate."""
    noise: float = field(default=0.0, metadata={"unit": "n"})
    """Standard deviation of the force components [N]."""


class NetFtEmulator(Emulator):
    """Emulated box: one thread sends records and receives commands, others answer HTTP."""

    def __init__(
        self, config: NetFtEmulatorConfig, source: SharedWorld | Playback, clock: Clock
    ) -> None:
        super().__init__()
        self.page = config.page
        self._config = config
        self._scale = np.repeat(config.page.scale(), 3)
        self.faults = FaultInjector[bytes](
            clock, spoil=corrupted_bytes, on_change=self._on_disturbance, seed=config.seed
        )
        self._source = source
        self._clock = clock
        self._udp: socket.socket | None = None
        self._http: DeviceServer | None = None
        self._peer: tuple[str, int] | None = None
        self._left = 0
        self._rdt_sequence = 0
        self._ft_sequence = 0
        self._bias = np.zeros(6)

    @property
    def address(self) -> str:
        """Host and UDP port, and the HTTP port."""
        c = self._config
        return f"{c.host}:{c.device.udp_port} http://{c.host}:{c.device.http_port}"

    def start(self) -> None:
        """Start serving."""
        self._udp = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        try:
            self._udp.bind((self._config.host, self._config.device.udp_port))
            self._udp.setblocking(False)
            address = (self._config.host, self._config.device.http_port)
            self._http = DeviceServer(address, _PageHandler, self)
        except OSError:
            self._udp.close()
            raise
        source = self._source
        serve = (
            partial(self._play, self._udp, source)
            if isinstance(source, Playback)
            else partial(self._stream, self._udp, source)
        )
        self._run_threads(serve, partial(self._http.serve_forever, 0.05))

    def _disconnect(self) -> None:
        if self._http is not None:
            self._http.shutdown()
            self._http.server_close()
            self._http = None

    def _release(self) -> None:
        if self._udp is not None:
            self._udp.close()
            self._udp = None

    def _on_disturbance(self) -> None:
        wrong, own = self.faults.wrong_units, self._config.page
        units = _WRONG_UNITS if wrong else (own.force_unit, own.torque_unit)
        self.page = replace(self.page, force_unit=units[0], torque_unit=units[1])
        self._scale = np.repeat(self.page.scale(), 3)

    def set_rate(self, rate_hz: int) -> None:
        """Set the rate as comm.cgi?comrdtrate= does; unsupported rates change nothing."""
        if 1 <= rate_hz <= _INTERNAL_HZ:
            self.page = replace(self.page, rate_hz=rate_hz)

    def _stream(self, udp: socket.socket, world: SharedWorld) -> None:
        noise = noise_table(self._config.seed, self._config.noise) / self._scale
        number, counts, scale = -1, np.zeros(6), self._scale
        while not self._ending.is_set():
            if self._peer is None:
                select.select([udp], [], [], 0.05)
                self._take_commands(udp, counts)
                pacer, rate_hz = None, 0
                continue
            if pacer is None or rate_hz != self.page.rate_hz:
                rate_hz = self.page.rate_hz
                pacer = Pacer(self._clock, rate_hz)
                stride = round(_INTERNAL_HZ / rate_hz)
            pacer.wait()
            self.missed += pacer.late
            newest, state = world.state()
            if newest != number or self._scale is not scale:
                number, scale, counts = newest, self._scale, state["wrench"] / self._scale
            self._take_commands(udp, counts)
            for _ in range(1 + min(pacer.late, LATE_MOST)):
                self._send_record(udp, counts, noise, stride)

    def _play(self, udp: socket.socket, playback: Playback) -> None:
        stream, rows = playback.recorded.stream, playback.recorded.rows
        part = slice(rows.start, rows.stop)
        counts = force_counts(stream.array("value")[part], force_bias(stream), self.page).tolist()
        counts = counts or [[0] * 6]
        numbers = stream.array("seq")[part].tolist() or [1]
        status = stream.array("status")[part].tolist() or [0]

        def packet(place: int, before: int = 0) -> bytes:
            number = (numbers[place] - before) & 0xFFFFFFFF
            return wire.RECORD.pack(number, number, status[place], *counts[place])

        def send(place: int) -> None:
            if self._peer is None:
                raise OSError("no client requested records")
            udp.sendto(packet(place), self._peer)

        def idle() -> None:
            if self._take_commands(udp, np.zeros(6)) and self._peer is not None:
                udp.sendto(packet(0, before=1), self._peer)

        playback.run(send, window=_WINDOW, ending=self._ending, idle=idle)

    def _send_record(self, udp: socket.socket, counts: Counts, noise: Counts, stride: int) -> None:
        """Send one record to the client, if one is listening."""
        if self._peer is None:
            return
        self._rdt_sequence = (self._rdt_sequence + 1) & 0xFFFFFFFF
        self._ft_sequence = (self._ft_sequence + stride) & 0xFFFFFFFF
        row = noise[self._ft_sequence % NOISE_ROWS]
        biased = np.rint(counts - self._bias + row).clip(-(2**31), 2**31 - 1).astype(np.int64)
        packet = wire.RECORD.pack(
            self._rdt_sequence, self._ft_sequence, self.page.runstat, *biased.tolist()
        )
        for sent in self.faults.passed(packet):
            # If the client has gone, the box continues to send to nobody.
            with contextlib.suppress(OSError):
                udp.sendto(sent, self._peer)
        self._left -= 1
        if self._left == 0:
            self._peer = None

    def _take_commands(self, udp: socket.socket, counts: Counts) -> bool:
        """Obey the commands received; return True if one started a stream."""
        started = False
        while True:
            try:
                packet, peer = udp.recvfrom(64)
            except OSError:
                return started
            request = wire.parse_request(packet)
            if request is None or self.faults.unplugged:
                continue
            command, samples = request
            if command == wire.COMMAND_REALTIME:
                self._peer, self._left, self._rdt_sequence = peer, samples, 0
                started = True
            elif command == wire.COMMAND_STOP:
                self._peer = None
            elif command == wire.COMMAND_BIAS:
                self._bias = counts


class _PageHandler(DeviceHandler):
    timeout = 5.0

    def get(self, url: SplitResult) -> None:
        if url.path == "/netftapi2.xml":
            self.answer(wire.emit_page(self.server.emulator.page), "text/xml")
        elif url.path == "/comm.cgi":
            for text in parse_qs(url.query).get("comrdtrate", []):
                if text.isdecimal():
                    self.server.emulator.set_rate(int(text))
            self.answer(b"<html>ok</html>", "text/html")
        else:
            self.send_error(404)


# Recorded forces as the box that measured them would send them again.


def force_page(stream: Stream) -> wire.Page:
    """Return the settings of the F/T box that recorded a force stream; defaults if not stored."""
    device = stream.attrs.get("device") or {}
    names = ("product", "serial", "force_unit", "torque_unit")
    stated: dict[str, Any] = {name: str(device[name]) for name in names if device.get(name)}
    counts = ("counts_per_force", "counts_per_torque")
    stated |= {name: float(device[name]) for name in counts if device.get(name)}
    page = wire.Page(**stated, rate_hz=max(round(stated_rate(stream)), 1))
    try:
        page.scale()
    except ConfigError as error:
        raise SessionError(f"streams/{stream.name}: {error}") from None
    return page


def force_bias(stream: Stream) -> Floats:
    """Return the bias that was subtracted from every row of a force stream (6,) [N, N m]."""
    return np.array(stream.attrs.get("bias") or [0.0] * 6, np.float64)


def force_counts(value: Floats, bias: Floats, page: wire.Page, name: str = "force") -> Ints:
    """Return the counts (n, 6) from which the driver computes exactly `value`, by the box's page.

    Values are as stored: measured minus bias (6,), (n, 6) [N, N m].
    """
    scale = np.repeat(page.scale(), 3)
    whole = np.rint((value + bias) / scale)
    fits = (np.abs(whole) < 2**31).all(axis=1)
    counts = np.where(fits[:, None], whole, 0).astype(np.int64)
    # Repeats the driver's own arithmetic, to the last bit.
    again = counts.astype(np.float64) * scale - bias
    same = (again.view(np.int64) == np.ascontiguousarray(value).view(np.int64)).all(axis=1)
    bad = np.flatnonzero(~(fits & same))
    if bad.size:
        raise SessionError(
            f"streams/{name}: row {bad[0]}: {value[bad[0]].tolist()} is not a whole number of "
            f"counts of a box with {page.counts_per_force:g} counts per {page.force_unit} and "
            f"{page.counts_per_torque:g} per {page.torque_unit} ({bad.size} rows are not): "
            "it was not recorded from a Net F/T box, so its emulator cannot send it; replay the "
            f"other streams with --without {name}"
        )
    return counts


def emulate(settings: NetFtEmulatorConfig, clock: Clock) -> Served:
    """Return the emulated box."""
    playback = settings.playback(clock)
    if playback is not None:
        settings = replace(settings, page=force_page(playback.recorded.stream))
    emulator = NetFtEmulator(settings, playback or SharedWorld(settings.world), clock)
    return Served("netft", emulator, emulator.faults.inject, settings.priority)
