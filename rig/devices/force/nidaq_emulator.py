"""Emulated NI card with an ATI DAQ F/T: NI-DAQmx over gRPC, the World's wrench as volts.

    python -m rig.mock.emulate nidaq '{"device": {"calibration": "benches/mock-nano17.cal"}}'

It answers the calls of one task of analog inputs, as the NI gRPC Device Server would: errors as
status UNKNOWN with the code in the trailing metadata `ni-error`. Voltages are the World's wrench
through the inverse of the calibration, clipped to the range and rounded to 16 bits. Faults of
rig.core.fault_injection act between the converter and the card's buffer.
"""

from __future__ import annotations

import random
import re
import threading
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NoReturn

import grpc
import numpy as np
import numpy.typing as npt
from nidaqmx._stubs import nidaqmx_pb2 as pb
from nidaqmx._stubs import nidaqmx_pb2_grpc as stubs

from rig.core.clock import Clock, Pacer
from rig.core.emulation import Emulator, EmulatorConfig, Served, SharedWorld
from rig.core.fault_injection import FaultInjector
from rig.core.packaged import BENCHES, packaged
from rig.devices.force.calibration import read_calibration
from rig.devices.force.emulated_noise import NOISE_ROWS, noise_table
from rig.devices.force.settings import NidaqConfig

# Inputs of an emulated task of an NI card, and the buffer filled by its sample clock.

Array = npt.NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Channel:
    """One analog input of a task."""

    name: str
    number: int
    """Gauge connected to the input."""
    low: float
    """Lower limit of the range [V]."""
    high: float
    """Upper limit of the range [V]."""


# NI-DAQmx calls answered by the emulated card: tasks of analog inputs, their settings, reading.
#
# Attribute numbers and values are NI-DAQmx's own (NIDAQmx.h); the messages come with the library.

_DIFFERENTIAL, _CONTINUOUS, _ANALOG_INPUT, _VOLTAGE, _BY_CHANNEL = 10106, 10123, 10100, 10322, 0
_NO_DEVICE, _NO_CHANNEL, _INVALID_VALUE = -200220, -200170, -200077
_OVERRUN, _NOT_YET, _NO_TASK, _NO_ACCESS = -200279, -200284, -200088, -201003
_TEXTS = {
    _NO_DEVICE: "Device identifier is invalid.",
    _NO_CHANNEL: "Physical channel specified does not exist on this device.",
    _INVALID_VALUE: "Requested value is not a supported value for this property.",
    _OVERRUN: "The application is not able to keep up with the hardware acquisition.",
    _NOT_YET: "Some or all of the samples requested have not yet been acquired.",
    _NO_ACCESS: "Device cannot be accessed.",
    _NO_TASK: "Task specified is invalid or does not exist.",
}
_INPUTS = 16
# Major, minor and update number.
_DRIVER_VERSION = {0x1272: 24, 0x1923: 8, 0x2F22: 0}
_CHANNELS = re.compile(r"(?P<device>[^/]+)/ai(?P<first>\d+)(?::(?:ai)?(?P<last>\d+))?")


class _Task:
    """Task set up by a client, with a buffer that the sample clock fills and the client empties."""

    def __init__(self) -> None:
        self.channels: list[Channel] = []
        self.rate_hz = 0.0
        self.capacity = 0
        self.clock: threading.Thread | None = None
        """Fills the buffer, until `stopped`."""
        self.stopped = threading.Event()
        self._changed = threading.Condition()
        self._empty()

    def _empty(self) -> None:
        self._rows: list[Array] = []
        self.acquired = self.delivered = 0
        self._overrun = False

    @property
    def names(self) -> str:
        return ", ".join(channel.name for channel in self.channels)

    def limit(self, request: Any) -> float:
        """Return a limit of the channel that a request names, else of the first [V]."""
        named = [each for each in self.channels if each.name == request.channel]
        channel = (named or self.channels)[0]
        return channel.high if request.attribute_raw == 0x17DD else channel.low

    def start(self, run: Callable[[_Task], None]) -> None:
        """Start the sample clock, if the client has set its rate."""
        if self.clock is None and self.rate_hz:
            self.stopped.clear()
            self.clock = threading.Thread(target=run, args=(self,), name="nidaq-emulator-clock")
            self.clock.start()

    def stop(self) -> None:
        """Stop the sample clock and empty the buffer; may be called twice."""
        self.stopped.set()
        with self._changed:
            self._changed.notify_all()
        if self.clock is not None:
            self.clock.join()
            self.clock = None
        self._empty()

    def put(self, rows: Array) -> None:
        """Add (n, channels); if the client is too late, every later `take` returns None."""
        with self._changed:
            self.acquired += len(rows)
            self._overrun = self._overrun or self.acquired - self.delivered > self.capacity
            if not self._overrun:
                self._rows.append(rows)
            self._changed.notify_all()

    def take(self, count: int, timeout: float) -> Array | None:
        """Return the next (count, channels), fewer after `timeout` [s]; None after an overrun."""
        with self._changed:
            self._changed.wait_for(
                lambda: self.acquired - self.delivered >= count or self.stopped.is_set(), timeout
            )
            if self._overrun:
                return None
            if not self._rows:
                return np.empty((0, 0))
            rows = np.concatenate(self._rows)
            self._rows = [rows[count:]] if len(rows) > count else []
            self.delivered += len(rows[:count])
            return rows[:count]


class Service(stubs.NiDAQmxServicer):  # type: ignore[misc]
    """The calls, each with its request and context; those of `_READ_BACK` are added below."""

    def __init__(self, card: NidaqEmulator) -> None:
        self._card = card
        self._tasks: dict[str, _Task] = {}
        self._lock = threading.Lock()
        self._named = 0

    def close(self) -> None:
        """Stop every task; may be called twice."""
        with self._lock:
            tasks, self._tasks = list(self._tasks.values()), {}
        for task in tasks:
            task.stop()

    def CreateTask(self, request: Any, context: Any) -> Any:  # noqa: D102, N802
        with self._lock:
            self._named += 1
            name = request.session_name or f"_unnamedTask<{self._named}>"
            self._tasks[name] = _Task()
        response = pb.CreateTaskResponse(status=0, new_session_initialized=True)
        response.task.name = name
        return response

    def CreateAIVoltageChan(self, request: Any, context: Any) -> Any:  # noqa: D102, N802
        task = self._task(request, context)
        match = _CHANNELS.fullmatch(request.physical_channel)
        if match is None:
            _fail(context, _NO_CHANNEL)
        if match["device"] != self._card.config.device.device:
            _fail(context, _NO_DEVICE)
        first, last = int(match["first"]), int(match["last"] or match["first"])
        if not first <= last < _INPUTS:
            _fail(context, _NO_CHANNEL)
        terminals = request.terminal_config_raw or request.terminal_config
        if terminals != _DIFFERENTIAL or not -10 <= request.min_val < request.max_val <= 10:
            _fail(context, _INVALID_VALUE)
        for number in range(first, last + 1):
            name = f"{match['device']}/ai{number}"
            gauge = len(task.channels) % 6
            task.channels.append(Channel(name, gauge, request.min_val, request.max_val))
        return pb.CreateAIVoltageChanResponse(status=0)

    def CfgSampClkTiming(self, request: Any, context: Any) -> Any:  # noqa: D102, N802
        task = self._task(request, context)
        if not 0 < request.rate <= self._card.config.rate_max_hz:
            _fail(context, _INVALID_VALUE)
        if (request.sample_mode_raw or request.sample_mode) != _CONTINUOUS:
            _fail(context, _INVALID_VALUE)
        task.rate_hz, task.capacity = request.rate, int(request.samps_per_chan)
        return pb.CfgSampClkTimingResponse(status=0)

    def StartTask(self, request: Any, context: Any) -> Any:  # noqa: D102, N802
        self._task(request, context).start(self._card.run_clock)
        return pb.StartTaskResponse(status=0)

    def StopTask(self, request: Any, context: Any) -> Any:  # noqa: D102, N802
        self._task(request, context).stop()
        return pb.StopTaskResponse(status=0)

    def ClearTask(self, request: Any, context: Any) -> Any:  # noqa: D102, N802
        with self._lock:
            task = self._tasks.pop(request.task.name, None)
        if task is not None:
            task.stop()
        return pb.ClearTaskResponse(status=0)

    def ReadAnalogF64(self, request: Any, context: Any) -> Any:  # noqa: D102, N802
        task = self._task(request, context)
        count, status = request.num_samps_per_chan, 0
        if task.clock is None:
            # A task without a sample clock takes one sample per call: software timed.
            rows = self._card.converted(task.channels)
        else:
            samples = task.take(count, request.timeout)
            if samples is None:
                _fail(context, _OVERRUN)
            rows = samples
            status = 0 if len(rows) == count else _NOT_YET
        values = rows.T if (request.fill_mode_raw or request.fill_mode) == _BY_CHANNEL else rows
        array = np.zeros(request.array_size_in_samps)
        array[: rows.size] = values.ravel()
        return pb.ReadAnalogF64Response(
            status=status, read_array=array, samps_per_chan_read=len(rows)
        )

    def GetDeviceAttributeString(self, request: Any, context: Any) -> Any:  # noqa: D102, N802
        self._check_device(request, context)
        return pb.GetDeviceAttributeStringResponse(status=0, value="NI card emulator")

    def GetDeviceAttributeUInt32(self, request: Any, context: Any) -> Any:  # noqa: D102, N802
        self._check_device(request, context)
        return pb.GetDeviceAttributeUInt32Response(status=0, value=0)

    def GetSystemInfoAttributeUInt32(self, request: Any, context: Any) -> Any:  # noqa: D102, N802
        value = _DRIVER_VERSION.get(request.attribute_raw, 0)
        return pb.GetSystemInfoAttributeUInt32Response(status=0, value=value)

    def GetErrorString(self, request: Any, context: Any) -> Any:  # noqa: D102, N802
        text = _TEXTS.get(request.error_code, "")
        return pb.GetErrorStringResponse(status=0, error_string=text)

    def _task(self, request: Any, context: Any) -> _Task:
        if self._card.faults.unplugged:
            _fail(context, _NO_ACCESS)
        task = self._tasks.get(request.task.name)
        if task is None:
            _fail(context, _NO_TASK)
        return task

    def _check_device(self, request: Any, context: Any) -> None:
        if request.device_name != self._card.config.device.device:
            _fail(context, _NO_DEVICE)
        if self._card.faults.unplugged:
            _fail(context, _NO_ACCESS)


def _fail(context: Any, code: int) -> NoReturn:
    """End the call like the device server, with the error's number in the trailing metadata."""
    context.set_trailing_metadata((("ni-error", str(code)),))
    context.abort(grpc.StatusCode.UNKNOWN, _TEXTS[code])
    raise RuntimeError("an aborted call continued")


# What clients read of a task, by the call; numbers are those of attributes.
_READ_BACK: dict[str, Callable[[_Task, Any], Any]] = {
    # 0x1276: name of the task.
    "GetTaskAttributeString": lambda task, request: (
        request.task.name if request.attribute_raw == 0x1276 else task.names
    ),
    "GetTaskAttributeUInt32": lambda task, request: len(task.channels),
    "GetReadAttributeString": lambda task, request: task.names,
    # 0x1223: samples that wait.
    "GetReadAttributeUInt32": lambda task, request: (
        task.acquired - task.delivered if request.attribute_raw == 0x1223 else len(task.channels)
    ),
    # 0x192A: acquired in all; 0x1221: where the next read begins.
    "GetReadAttributeUInt64": lambda task, request: (
        task.acquired if request.attribute_raw == 0x192A else task.delivered
    ),
    "GetBufferAttributeUInt32": lambda task, request: task.capacity,
    "GetTimingAttributeDouble": lambda task, request: task.rate_hz,
    "GetTimingAttributeInt32": lambda task, request: _CONTINUOUS,
    # Terminals, kind of channel, kind of measurement.
    "GetChanAttributeInt32": lambda task, request: {
        0x1097: _DIFFERENTIAL,
        0x187F: _ANALOG_INPUT,
        0x695: _VOLTAGE,
    }.get(request.attribute_raw),
    "GetChanAttributeDouble": lambda task, request: task.limit(request),
}


def _reading(call: str) -> Callable[[Service, Any, Any], Any]:
    """Return the method of a call that reads of a task."""
    response = getattr(pb, f"{call}Response")
    field_ = "value_raw" if call.endswith("AttributeInt32") else "value"

    def read(self: Service, request: Any, context: Any) -> Any:
        value = _READ_BACK[call](self._task(request, context), request)
        if value is None:
            _fail(context, _INVALID_VALUE)
        return response(status=0, **{field_: value})

    return read


for _call in _READ_BACK:
    setattr(Service, _call, _reading(_call))

_BITS = 16
# Address of a device server by NI's default, for a card without one.
_GRPC = "loopback:31763"


@dataclass(frozen=True, slots=True)
class NidaqEmulatorConfig(EmulatorConfig):
    """Emulated card, and the transducer connected to it."""

    device: NidaqConfig
    """Its `grpc` has the port."""
    offset: tuple[float, float, float, float, float, float] = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    """Gauge voltages without a load [V]."""
    noise: float = field(default=0.0, metadata={"unit": "n"})
    """Standard deviation of the force components [N]."""
    rate_max_hz: float = 250_000.0
    """Highest rate of the card."""


class NidaqEmulator(Emulator):
    """Emulated card: one thread is its sample clock, others answer calls."""

    def __init__(self, config: NidaqEmulatorConfig, world: SharedWorld, clock: Clock) -> None:
        super().__init__()
        self.config = config
        self.faults = FaultInjector[Array](clock, spoil=_corrupt, seed=config.seed)
        self._world = world
        self._clock = clock
        self._server: grpc.Server | None = None
        self._pool: ThreadPoolExecutor | None = None
        calibration = packaged(Path(config.device.calibration), BENCHES)
        self._calibration = read_calibration(calibration)
        self._noise = self._calibration.volts(noise_table(config.seed, config.noise))
        self._row = 0
        self._newest, self._volts = -1, np.zeros(6)
        self._service = Service(self)

    @property
    def address(self) -> str:
        """Address for clients."""
        _, _, port = (self.config.device.grpc or _GRPC).rpartition(":")
        return f"{self.config.host}:{port}"

    def start(self) -> None:
        """Start serving."""
        # Several threads: a client that waits for samples occupies one.
        self._pool = ThreadPoolExecutor(4, "nidaq-emulator")
        self._server = grpc.server(self._pool, options=(("grpc.so_reuseport", 0),))
        stubs.add_NiDAQmxServicer_to_server(self._service, self._server)
        try:
            self._server.add_insecure_port(self.address)
        except RuntimeError as error:
            self._pool.shutdown()
            raise OSError(str(error)) from error
        self._server.start()

    def _disconnect(self) -> None:
        self._service.close()
        if self._server is not None:
            self._server.stop(0.1).wait()
            self._server = None
        if self._pool is not None:
            self._pool.shutdown()
            self._pool = None

    def converted(self, channels: Sequence[Channel]) -> Array:
        """Return the current voltages (1, channels), with noise, range limits and 16 bits."""
        number, state = self._world.state()
        if number != self._newest:
            volts = self._calibration.volts(np.array(state["wrench"], np.float64))
            self._newest, self._volts = number, volts + np.array(self.config.offset)
        self._row = (self._row + 1) % NOISE_ROWS
        gauges = self._volts + self._noise[self._row]
        low = np.array([channel.low for channel in channels])
        high = np.array([channel.high for channel in channels])
        step = (high - low) / 2**_BITS
        volts = gauges[[channel.number for channel in channels]]
        codes = np.clip(np.rint((volts - low) / step), 0, 2**_BITS - 1)
        return np.asarray((low + codes * step)[np.newaxis])

    def run_clock(self, task: _Task) -> None:
        """Run the sample clock of a task: fill its buffer until it is stopped."""
        pacer = Pacer(self._clock, task.rate_hz)
        while not task.stopped.is_set():
            pacer.wait()
            self.missed += pacer.late
            # The card's clock never stands still: late samples are added all the same.
            volts = np.repeat(self.converted(task.channels), 1 + pacer.late, axis=0)
            for rows in self.faults.passed(volts):
                task.put(rows)


def _corrupt(volts: Array, rng: random.Random) -> Array:
    low, high = -10.0, 10.0
    return np.array([[rng.uniform(low, high) for _ in row] for row in volts])


def emulate(settings: NidaqEmulatorConfig, clock: Clock) -> Served:
    """Return the emulated card."""
    emulator = NidaqEmulator(settings, SharedWorld(settings.world), clock)
    return Served("nidaq", emulator, emulator.faults.inject)
