"""Emulated `xela_server`: uSkin scans over WebSocket, of the World, a log, or a recording.

    python -m rig.mock.emulate xela '{"host": "127.0.0.6", "device": {"rate_hz": 100}}'
    python -m rig.mock.emulate xela '{"source": "trial.npy", "layout": "1.7"}'

A log is a (T, 3 x taxels) array, rounded to uint16 and played in a loop, one row per scan. Faults
are injected through rig.core.fault_injection; `wrong_units` drops the last hexadecimal digit of
each value.

The driver needs one scan to open. Of a recorded session it gets the first row's values under the
number before; the recorded rows follow under their recorded numbers and device times.
"""

import contextlib
import json
import math
import socket
import threading
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any, Literal
from urllib.parse import urlsplit

import numpy as np
import numpy.typing as npt
from websockets.exceptions import ConnectionClosed
from websockets.sync.server import Server, ServerConnection
from websockets.sync.server import serve as listen

from rig.core.clock import SECOND_NS, Clock, ClockAnchor, Pacer
from rig.core.emulation import Emulator, Newest, Served, SharedWorld
from rig.core.errors import ConfigError
from rig.core.fault_injection import FaultInjector, corrupted_text
from rig.core.playback import PlayableConfig, Playback, stated_rate
from rig.devices.taxels.settings import XelaConfig

Log = npt.NDArray[np.float64]
# Returns the counts (taxels, 3) of a WORLD_STATE.
View = Callable[[np.void], npt.NDArray[Any]]

# Scans kept for a client that falls behind, which gets them all in order, as from the server.
_BACKLOG = 512
# Rows of a recording under way; the driver keeps 10 000 scans for a late recorder.
_WINDOW = 128


@dataclass(frozen=True, slots=True)
class XelaEmulatorConfig(PlayableConfig):
    """Port, rate and message layout of the emulated server."""

    device: XelaConfig = field(default_factory=XelaConfig)
    layout: Literal["1.7", "1.8"] = "1.8"
    """Message layout."""
    noise: float = 0.0
    """Standard deviation of each value [counts]; a real patch without contact has about 2.1."""
    view: Path | None = None
    """JSON document of the World whose taxels to send; None: zeros."""
    true_rate_hz: float | None = None
    """Rate of the scans; None: as the device's settings expect it."""
    source: Path | None = None
    """Log of raw counts (.npy) to play in place of the World."""


def emit(
    number: int, seconds: float, counts: Sequence[int], *, layout: str, ups: float, axes: int = 3
) -> str:
    """Return the message of scan `number`; inverse of `rig.devices.taxels.xela_wire.parse`.

    Its time is in seconds since 1970, the counts are all axes of each taxel, 0 to 65535. Layout is
    1.7 or 1.8, which states the updates per second `ups` [Hz].
    """
    sensor: dict[str, Any] = {
        "data": ",".join([f"{value:X}" for value in counts]),
        "sensor": "1",
        "taxels": len(counts) // axes,
        "model": "XR1944" if layout == "1.7" else "uSPa44",
        "calibrated": None,
    }
    top: dict[str, Any] = {"message": number, "time": seconds, "sensors": 1}
    if layout != "1.7":
        top |= {"sendtime": seconds, "type": "routine"}
        sensor |= {"time": seconds, "tempraw": [33337], "temp": [307.5], "ups": [ups]}
    return json.dumps(top | {"1": sensor})


class XelaEmulator(Emulator):
    """Emulated server: one thread produces scans, one per client sends the newest."""

    def __init__(
        self,
        config: XelaEmulatorConfig,
        source: SharedWorld | Log | Playback,
        clock: Clock,
        view: View | None = None,
    ) -> None:
        """Serve a source; of a World, the counts (taxels, 3) that `view` returns of its state."""
        super().__init__()
        self._config = config
        self._port = urlsplit(config.device.address).port or 80
        self._source, self._view = source, view
        self._rate_hz = config.true_rate_hz or config.device.rate_hz
        self._clock = clock
        self._anchor = ClockAnchor.take()
        self._rng = np.random.default_rng(config.seed)
        self._scans = Newest[str](_BACKLOG, self._ending)
        self._lead_in: tuple[str, ...] = ()
        self._lock = threading.Lock()
        self.faults = FaultInjector[str](
            clock,
            spoil=corrupted_text,
            mistake=_shortened,
            on_change=self._on_plug,
            seed=config.seed,
        )
        self._clients: set[ServerConnection] = set()
        self._server: Server | None = None

    @property
    def address(self) -> str:
        """WebSocket address."""
        return f"ws://{self._config.host}:{self._port}"

    def start(self) -> None:
        """Start serving."""
        source = self._source
        if isinstance(source, Playback):
            message = _recorded_messages(source, self._config)
            self._lead_in = (message(0, before=1),)
            make = partial(
                source.run,
                lambda place: self._scans.publish([message(place)]),
                window=_WINDOW,
                ending=self._ending,
            )
        else:
            make = partial(self._make_scans, source)
        self._server = listen(
            self._serve_client,
            self._config.host,
            self._port,
            compression=None,
            ping_interval=None,
            close_timeout=0.5,
        )
        self._run_threads(make, self._server.serve_forever)

    def _disconnect(self) -> None:
        self._scans.wake()
        if self._server is not None:
            self._server.shutdown()
            self._server = None

    def _on_plug(self) -> None:
        if not self.faults.unplugged:
            return
        with self._lock:
            clients = tuple(self._clients)
        for client in clients:
            _cut(client)

    def _make_scans(self, source: SharedWorld | Log) -> None:
        pacer = Pacer(self._clock, self._rate_hz)
        while not self._ending.is_set():
            pacer.wait()
            self.missed = pacer.missed
            counts = self._counts(source)
            now_ns = self._clock.now_ns() - self._anchor.t0_ns + self._anchor.utc_ns
            message = emit(
                self._scans.count + 1,
                now_ns / SECOND_NS,
                counts,
                layout=self._config.layout,
                ups=self._rate_hz,
                axes=self._config.device.axes,
            )
            self._scans.publish(self.faults.passed(message))

    def _counts(self, source: SharedWorld | Log) -> list[int]:
        if isinstance(source, np.ndarray):
            values = source[self._scans.count % len(source)]
        else:
            rows, columns, axes = self._config.device.shape
            values = np.zeros((rows * columns, 3))
            if self._view is not None:
                values = self._view(source.state()[1])
            # Z is the last axis.
            values = values[:, -axes:].reshape(-1)
        if self._config.noise > 0:
            values = values + self._rng.normal(0.0, self._config.noise, values.shape)
        whole: list[int] = np.rint(values).clip(0, 0xFFFF).astype(np.int64).tolist()
        return whole

    def _serve_client(self, connection: ServerConnection) -> None:
        if self.faults.unplugged:
            _cut(connection)
            return
        with self._lock:
            self._clients.add(connection)
        try:
            self._send_scans(connection)
        finally:
            with self._lock:
                self._clients.discard(connection)

    def _send_scans(self, connection: ServerConnection) -> None:
        with contextlib.suppress(ConnectionClosed):
            connection.send(json.dumps({"message": "Welcome"}))
            sent = self._scans.count
            for message in self._lead_in:
                connection.send(message)
            while not self._ending.is_set():
                sent, messages = self._scans.newer_than(sent)
                for message in messages:
                    connection.send(message)


def _recorded_messages(playback: Playback, config: XelaEmulatorConfig) -> Callable[..., str]:
    """Return the function that makes the message of a row; numbered `before` less, if given."""
    stream, rows = playback.recorded.stream, playback.recorded.rows
    part = slice(rows.start, rows.stop)
    value = stream.array("value")
    counts = value[part].reshape(len(rows), -1).tolist() or [[0] * math.prod(value.shape[1:])]
    numbers = stream.array("seq")[part].tolist() or [1]
    device_t = stream.array("device_t")[part].tolist() or [math.nan]

    def message(place: int, before: int = 0) -> str:
        return emit(
            numbers[place] - before,
            device_t[place],
            counts[place],
            layout=config.layout,
            ups=config.device.rate_hz,
            axes=config.device.axes,
        )

    return message


def _shortened(message: str) -> str:
    """Return the message without the last digit of every value."""
    content = json.loads(message)
    for part in content.values():
        if isinstance(part, dict):
            part["data"] = ",".join(value[:-1] or "0" for value in part["data"].split(","))
    return json.dumps(content)


def _cut(connection: ServerConnection) -> None:
    """Disconnect without a closing handshake, as when the cable is pulled."""
    with contextlib.suppress(OSError):
        connection.socket.shutdown(socket.SHUT_RDWR)


def load_log(path: Path) -> Log:
    """Load a log of raw counts from an .npy file, as (T, 3 x taxels): x y z of each taxel in turn.

    A file with x of all taxels, then y, then z, is reordered; its resting counts show that.
    """
    from recorder.convert import in_order, order_at_rest  # not needed to play the World

    log: Log = np.load(path, allow_pickle=False).astype(np.float64)
    if log.ndim != 2 or len(log) == 0 or log.shape[1] == 0 or log.shape[1] % 3:
        raise ValueError(f"{path.name}: shape {log.shape}; expected (T, 3 x taxels)")
    order, _counts = order_at_rest(log)
    return in_order(log, order or "taxel").reshape(log.shape)


def emulate(settings: XelaEmulatorConfig, clock: Clock) -> Served:
    """Return the emulated server."""
    source: SharedWorld | Log | Playback
    playback = settings.playback(clock)
    if playback is not None:
        stream = playback.recorded.stream
        described = stream.attrs.get("device") or {}
        layout: Literal["1.7", "1.8"] = "1.7" if described.get("layout") == "1.7" else "1.8"
        device = replace(settings.device, rate_hz=stated_rate(stream))
        settings, source = replace(settings, layout=layout, device=device), playback
    elif settings.source is not None:
        source = load_log(settings.source)
    else:
        source = SharedWorld(settings.world)
    view = None
    if settings.view is not None:
        from rig.mock.world import load_view

        view = load_view(settings.view, "taxels")
        rows, columns, _ = settings.device.shape
        found = len(view(source.state()[1])) if isinstance(source, SharedWorld) else 0
        if found != rows * columns:
            raise ConfigError(
                f"taxels: found {rows} rows x {columns} columns; allowed with this bench's world: "
                f"its {found} taxels"
            )
    emulator = XelaEmulator(settings, source, clock, view)
    return Served("xela", emulator, emulator.faults.inject, settings.priority)
