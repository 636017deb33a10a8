"""The NI-DAQmx calls the emulated card answers: tasks of analog inputs, their settings, reading.

Attribute numbers and values are NI-DAQmx's own (NIDAQmx.h); the messages come with the library.
"""

from __future__ import annotations

import re
import threading
from dataclasses import dataclass, field
from typing import Any, NoReturn, Protocol

import grpc
import numpy as np
from nidaqmx._stubs import nidaqmx_pb2 as pb
from nidaqmx._stubs import nidaqmx_pb2_grpc as stubs

from rig.force.nidaq_buffer import Array, Buffer, Channel

_DIFFERENTIAL, _CONTINUOUS, _ANALOG_INPUT, _VOLTAGE, _BY_CHANNEL = 10106, 10123, 10100, 10322, 0
_NO_DEVICE, _NO_CHANNEL, _INVALID_VALUE = -200220, -200170, -200077
_OVERRUN, _NOT_YET, _NO_TASK, _GONE = -200279, -200284, -200088, -201003
_TEXTS = {
    _NO_DEVICE: "Device identifier is invalid.",
    _NO_CHANNEL: "Physical channel specified does not exist on this device.",
    _INVALID_VALUE: "Requested value is not a supported value for this property.",
    _OVERRUN: "The application is not able to keep up with the hardware acquisition.",
    _NOT_YET: "Some or all of the samples requested have not yet been acquired.",
    _GONE: "Device cannot be accessed.",
    _NO_TASK: "Task specified is invalid or does not exist.",
}
_INPUTS = 16
_DRIVER_VERSION = {0x1272: 24, 0x1923: 8, 0x2F22: 0}
# Major, minor and update number.
_CHANNELS = re.compile(r"(?P<device>[^/]+)/ai(?P<first>\d+)(?::(?:ai)?(?P<last>\d+))?")


@dataclass(slots=True)
class _Task:
    """What a client has set up."""

    channels: list[Channel] = field(default_factory=list)
    rate_hz: float = 0.0
    capacity: int = 0
    buffer: Buffer | None = None
    clock: threading.Thread | None = None

    def stop(self) -> None:
        if self.buffer is not None and self.clock is not None:
            self.buffer.stop()
            self.clock.join()
        self.buffer = self.clock = None


class Card(Protocol):
    """What the service needs of the emulated card."""

    config: Any

    @property
    def unplugged(self) -> bool:
        """Whether it is out of the computer."""

    def converted(self, channels: list[Channel]) -> Array:
        """The voltages of now, (1, channels)."""

    def run_clock(self, rate_hz: float, channels: list[Channel], buffer: Buffer) -> None:
        """Fill the buffer until it is stopped."""


class Service(stubs.NiDAQmxServicer):  # type: ignore[misc]
    """The calls; each takes a request of its name, and the call's context."""

    def __init__(self, card: Card) -> None:
        self._card = card
        self._tasks: dict[str, _Task] = {}
        self._lock = threading.Lock()
        self._named = 0

    def add_to(self, server: grpc.Server) -> None:
        """Serve these calls on `server`."""
        stubs.add_NiDAQmxServicer_to_server(self, server)

    def close(self) -> None:
        """Stop every task; safe twice."""
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
        if match["device"] != self._card.config.device:
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
        task = self._task(request, context)
        if task.buffer is None and task.rate_hz:
            task.buffer = Buffer(task.capacity)
            task.clock = threading.Thread(
                target=self._card.run_clock,
                args=(task.rate_hz, task.channels, task.buffer),
                name="nidaq-emulator-clock",
            )
            task.clock.start()
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
        if task.buffer is None:
            # A task without a sample clock takes one sample when it is asked: software timed.
            rows = self._card.converted(task.channels)
        else:
            taken = task.buffer.take(count, request.timeout)
            if taken is None:
                _fail(context, _OVERRUN)
            rows = taken
            status = 0 if len(rows) == count else _NOT_YET
        values = rows.T if (request.fill_mode_raw or request.fill_mode) == _BY_CHANNEL else rows
        array = np.zeros(request.array_size_in_samps)
        array[: rows.size] = values.ravel()
        return pb.ReadAnalogF64Response(
            status=status, read_array=array, samps_per_chan_read=len(rows)
        )

    def GetTaskAttributeString(self, request: Any, context: Any) -> Any:  # noqa: D102, N802
        task = self._task(request, context)
        names = ", ".join(channel.name for channel in task.channels)
        # 0x1276: name of the task; 0x1273: its channels.
        value = request.task.name if request.attribute_raw == 0x1276 else names
        return pb.GetTaskAttributeStringResponse(status=0, value=value)

    def GetTaskAttributeUInt32(self, request: Any, context: Any) -> Any:  # noqa: D102, N802
        task = self._task(request, context)
        return pb.GetTaskAttributeUInt32Response(status=0, value=len(task.channels))

    def GetReadAttributeString(self, request: Any, context: Any) -> Any:  # noqa: D102, N802
        task = self._task(request, context)
        names = ", ".join(channel.name for channel in task.channels)
        return pb.GetReadAttributeStringResponse(status=0, value=names)

    def GetReadAttributeUInt32(self, request: Any, context: Any) -> Any:  # noqa: D102, N802
        task = self._task(request, context)
        value = len(task.channels)
        if request.attribute_raw == 0x1223:  # samples that wait
            value = 0 if task.buffer is None else task.buffer.acquired - task.buffer.taken
        return pb.GetReadAttributeUInt32Response(status=0, value=value)

    def GetReadAttributeUInt64(self, request: Any, context: Any) -> Any:  # noqa: D102, N802
        buffer = self._task(request, context).buffer
        value = 0
        if buffer is not None:
            # 0x192A: acquired in all; 0x1221: where the next read begins.
            value = buffer.acquired if request.attribute_raw == 0x192A else buffer.taken
        return pb.GetReadAttributeUInt64Response(status=0, value=value)

    def GetBufferAttributeUInt32(self, request: Any, context: Any) -> Any:  # noqa: D102, N802
        task = self._task(request, context)
        return pb.GetBufferAttributeUInt32Response(status=0, value=task.capacity)

    def GetTimingAttributeDouble(self, request: Any, context: Any) -> Any:  # noqa: D102, N802
        task = self._task(request, context)
        return pb.GetTimingAttributeDoubleResponse(status=0, value=task.rate_hz)

    def GetTimingAttributeInt32(self, request: Any, context: Any) -> Any:  # noqa: D102, N802
        self._task(request, context)
        return pb.GetTimingAttributeInt32Response(status=0, value_raw=_CONTINUOUS)

    def GetChanAttributeInt32(self, request: Any, context: Any) -> Any:  # noqa: D102, N802
        self._task(request, context)
        # Terminals, kind of channel, kind of measurement.
        values = {0x1097: _DIFFERENTIAL, 0x187F: _ANALOG_INPUT, 0x695: _VOLTAGE}
        value = values.get(request.attribute_raw)
        if value is None:
            _fail(context, _INVALID_VALUE)
        return pb.GetChanAttributeInt32Response(status=0, value_raw=value)

    def GetChanAttributeDouble(self, request: Any, context: Any) -> Any:  # noqa: D102, N802
        channels = self._task(request, context).channels
        channel = next((one for one in channels if one.name == request.channel), channels[0])
        value = channel.high if request.attribute_raw == 0x17DD else channel.low
        return pb.GetChanAttributeDoubleResponse(status=0, value=value)

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
        if self._card.unplugged:
            _fail(context, _GONE)
        task = self._tasks.get(request.task.name)
        if task is None:
            _fail(context, _NO_TASK)
        return task

    def _check_device(self, request: Any, context: Any) -> None:
        if request.device_name != self._card.config.device:
            _fail(context, _NO_DEVICE)
        if self._card.unplugged:
            _fail(context, _GONE)


def _fail(context: Any, code: int) -> NoReturn:
    """End the call as the device server does: the error's number in the trailing metadata."""
    context.set_trailing_metadata((("ni-error", str(code)),))
    context.abort(grpc.StatusCode.UNKNOWN, _TEXTS[code])
    raise RuntimeError("a call that was aborted goes on")
