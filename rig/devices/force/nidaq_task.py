"""Access to NI-DAQmx, in this module only: six hardware-timed voltages, errors translated.

With a local driver the library is called directly; with `grpc`, it calls an NI gRPC Device Server,
which may be another computer or the emulator. Every call to a server has a deadline: the library
itself would wait forever.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from typing import Any, NamedTuple

import grpc
import nidaqmx
import numpy as np
import numpy.typing as npt
from nidaqmx.constants import AcquisitionType, TerminalConfiguration
from nidaqmx.error_codes import DAQmxErrors
from nidaqmx.errors import DaqError, Error, RpcError
from nidaqmx.stream_readers import AnalogMultiChannelReader
from nidaqmx.system import Device

from rig.core.clock import SECOND_NS, Clock
from rig.core.errors import ConfigError, DeviceLost

_GAUGES = 6
_BUFFER_SECONDS = 10.0
_BUFFER_MIN = 10_000
# A card may use a range wider than requested by this fraction: some cover 10 V with 10.5 V.
_RANGE_TOLERANCE = 0.1
_RATE_TOLERANCE = 0.01
# Only samples already counted are requested, so at most they are still in transit [s].
_READ_TIMEOUT = 0.1

_OVERRUN_CODES = (
    DAQmxErrors.SAMPLES_NO_LONGER_AVAILABLE.value,
    DAQmxErrors.INPUT_FIFO_OVERFLOW_2.value,
    DAQmxErrors.ACQ_STOPPED_DRIVER_CANT_XFER_DATA_FAST_ENOUGH.value,
)
_LOST_CODES = {
    DAQmxErrors.INVALID_DEVICE_ID.value: "check its name in NI MAX, its cable and power",
    DAQmxErrors.DEV_CANNOT_BE_ACCESSED.value: "check its cable and power",
    DAQmxErrors.DEVICE_REMOVED.value: "check its cable and power",
    DAQmxErrors.PAL_DEVICE_NOT_FOUND.value: "check its cable and power",
    DAQmxErrors.PAL_RESOURCE_RESERVED.value: "another program is using it",
}


class Overrun(Exception):
    """The buffer overflowed before it was read: samples are lost, the task must be restarted."""


class AnalogTask:
    """Six differential voltages at the card's own sample clock, with settings read back.

    Args:
        device: Name of the card.
        channels: Its six inputs, in NI's notation (`ai0:5`).
        rate_hz: Samples per second.
        volts_range: Lowest and highest voltage [V].
        server: host:port of an NI gRPC Device Server, or None.
        clock: Clock for `timeout`.
        timeout: Time limit for each answer of the device server [s].
    """

    def __init__(
        self,
        device: str,
        channels: str,
        rate_hz: float,
        volts_range: tuple[float, float],
        *,
        server: str | None,
        clock: Clock,
        timeout: float,
    ) -> None:
        self._place = f"{device}/{channels}" if server is None else f"{server} {device}/{channels}"
        self._exits = contextlib.ExitStack()
        self._deadline = _Deadline(timeout)
        try:
            options = None if server is None else self._connect(server, clock, timeout)
            with self._errors("setting up"):
                self._task = nidaqmx.Task(grpc_options=options)
                self._exits.callback(self._clear)
                self._set_up(f"{device}/{channels}", rate_hz, volts_range)
                card = Device(device, grpc_options=options)
                self.product = str(card.product_type)
                """Model of the card."""
                self.serial = f"{int(card.serial_num):08X}"
                """Serial number of the card."""
        except BaseException:
            self.close()
            raise
        self._check(rate_hz, volts_range)

    def _connect(self, address: str, clock: Clock, timeout: float) -> Any:
        # A card on the bench is never behind a proxy, even if the environment sets one.
        channel = grpc.insecure_channel(address, options=(("grpc.enable_http_proxy", 0),))
        self._exits.callback(channel.close)
        start_ns = clock.now_ns()
        try:
            grpc.channel_ready_future(channel).result(timeout)
        except grpc.FutureTimeoutError:
            waited = (clock.now_ns() - start_ns) / SECOND_NS
            raise DeviceLost(
                f"{address}: no NI gRPC Device Server answers ({waited:.1f} s); check that it runs "
                "there and that no firewall blocks the port"
            ) from None
        return nidaqmx.GrpcSessionOptions(grpc.intercept_channel(channel, self._deadline), "")

    def _set_up(self, channels: str, rate_hz: float, volts_range: tuple[float, float]) -> None:
        low, high = volts_range
        self._task.ai_channels.add_ai_voltage_chan(
            channels,
            terminal_config=TerminalConfiguration.DIFF,
            min_val=low,
            max_val=high,
        )
        self._task.timing.cfg_samp_clk_timing(
            rate_hz,
            sample_mode=AcquisitionType.CONTINUOUS,
            samps_per_chan=max(_BUFFER_MIN, round(_BUFFER_SECONDS * rate_hz)),
        )
        stream = self._task.in_stream
        self._count = int(stream.num_chans)
        self.rate_hz = float(self._task.timing.samp_clk_rate)
        """Samples per second, as stated by the card."""
        self.buffer = int(stream.input_buf_size)
        """Number of samples per channel buffered for a late reader."""
        self._found = [
            (str(each.name), float(each.ai_min), float(each.ai_max), each.ai_term_cfg)
            for each in self._task.ai_channels
        ]
        self._reader = AnalogMultiChannelReader(stream)
        self._reader.verify_array_shape = False

    def _check(self, rate_hz: float, volts_range: tuple[float, float]) -> None:
        """Check the settings read back against the requested ones."""
        problem = ""
        low, high = volts_range
        slack = _RANGE_TOLERANCE * (high - low)
        if self._count != _GAUGES:
            problem = f"channels: found {self._count}; allowed: {_GAUGES}, one per gauge"
        elif abs(self.rate_hz - rate_hz) > _RATE_TOLERANCE * rate_hz:
            problem = f"rate_hz: asked {rate_hz:g} Hz, got {self.rate_hz:g} Hz"
        for name, least, most, terminals in self._found:
            if not (low - slack <= least <= low and high <= most <= high + slack):
                problem = (
                    f"{name}: asked {low:g} to {high:g} V, got {least:g} to {most:g} V; gauges "
                    "would be cut off, or read coarsely"
                )
            elif terminals is not TerminalConfiguration.DIFF:
                problem = f"{name}: asked differential inputs, got {terminals.name}"
        if problem:
            self.close()
            raise ConfigError(f"{self._place}: {problem}")

    def start(self) -> None:
        """Start the sample clock; the first sample is number 0."""
        with self._errors("starting"):
            self._task.start()

    def restart(self) -> None:
        """Stop and start after an overrun; the count begins at 0 again."""
        with contextlib.suppress(Overrun), self._errors("stopping"):
            self._task.stop()
        self.start()

    def answer_within(self, seconds: float) -> None:
        """Treat the device server as lost if a call takes longer than `seconds` [s] from now on."""
        self._deadline.seconds = seconds

    def acquired(self) -> int:
        """Return the number of samples per channel since the start."""
        with self._errors("reading"):
            return int(self._task.in_stream.total_samp_per_chan_acquired)

    def read(self, count: int) -> npt.NDArray[np.float64]:
        """Return the next `count` samples (count, 6) [V], which must already be acquired."""
        volts = np.empty((_GAUGES, count))
        with self._errors("reading"):
            self._reader.read_many_sample(volts, count, timeout=_READ_TIMEOUT)
        return np.ascontiguousarray(volts.T)

    def close(self) -> None:
        """Release the card; may be called twice."""
        self._deadline.seconds = min(self._deadline.seconds, 1.0)
        self._exits.close()

    def _clear(self) -> None:
        # A task on a card or server that is gone needs no clearing.
        with contextlib.suppress(Error):
            self._task.close()

    @contextlib.contextmanager
    def _errors(self, doing: str) -> Iterator[None]:
        try:
            yield
        except DaqError as error:
            code = error.error_code
            text = " ".join(str(error).split())
            if code in _OVERRUN_CODES:
                raise Overrun(text) from error
            if code in _LOST_CODES:
                raise DeviceLost(f"{self._place}: {text}; {_LOST_CODES[code]}") from error
            if doing == "setting up":
                raise ConfigError(f"{self._place}: the card refuses: {text}") from error
            raise DeviceLost(f"{self._place}: {doing}: {text}") from error
        except RpcError as error:
            raise DeviceLost(
                f"{self._place}: {doing}: {' '.join(str(error).split())}; check the device server"
            ) from error
        except Error as error:
            raise ConfigError(
                f"{self._place}: {' '.join(str(error).split())}; allowed: a computer with the "
                "NI-DAQmx driver, or `grpc` in the bench file"
            ) from error


class _CallDetails(NamedTuple):
    """Details of a call, as required by gRPC."""

    method: str
    timeout: float | None
    metadata: Any
    credentials: Any
    wait_for_ready: Any
    compression: Any


class _Deadline(grpc.UnaryUnaryClientInterceptor):  # type: ignore[misc]
    """Interceptor that limits every call to `seconds` [s]."""

    def __init__(self, seconds: float) -> None:
        self.seconds = seconds

    def intercept_unary_unary(self, continuation: Any, details: Any, request: Any) -> Any:
        """Make the call with its deadline; see gRPC."""
        timed = _CallDetails(
            details.method,
            self.seconds,
            details.metadata,
            details.credentials,
            details.wait_for_ready,
            details.compression,
        )
        return continuation(timed, request)
