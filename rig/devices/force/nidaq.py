"""ATI DAQ F/T driver for an NI card: gauge voltages by NI-DAQmx, the wrench by the `.cal` file.

The card's own clock paces the samples, so sample k was taken at k / rate of the card's time, which
is converted to the host's clock. The bias is the rig's tare, in
newton: the map is linear, so that is the bias of the volts (rig/devices/force/calibration.py).

With a local driver the library is called directly; with `grpc`, it calls an NI gRPC Device Server,
which may be another computer or the emulator. Every call to a server has a deadline: the library
itself would wait forever.
"""

import contextlib
import logging
from collections import deque
from collections.abc import Iterator
from pathlib import Path
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

from rig.core.clock import SECOND_NS, Clock, Pacer
from rig.core.driver import ReceivingDriver
from rig.core.errors import ConfigError, DeviceLost
from rig.core.packaged import BENCHES, packaged
from rig.devices.force.calibration import TransducerCalibration, read_calibration
from rig.devices.force.settings import BEYOND_RATING, LOST_BEFORE, SATURATED, NidaqConfig

logger = logging.getLogger(__name__)

# Rate of reading the card: a block is 10 ms long, well inside the guard's 50 ms.
_POLL_HZ = 100.0
_CAPACITY = 60_000
_BLOCK_MAX = 2000
# Without a new sample for this long, or five periods of a slow clock, the clock has stopped [s].
_STANDSTILL = 0.1
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


# Number of seconds over which the smallest delay counts: long enough to contain a quick answer even
# on a busy machine, short enough to follow a card whose clock drifts (100 ppm are 0.4 ms in 4 s).
_BUCKETS = 4


class SampleTimeline:
    """Maps sample numbers to host time by the lower envelope of the observations.

    The host regularly reads the number of samples. Sample k cannot have been taken after the host
    learnt of it, and the quickest answer is the closest: with period p, sample 0 is at the smallest
    (host time - k p) of the last seconds. So the samples of one block do not all have the time at
    which the block was read, and a late read changes nothing.
    """

    def __init__(self, rate_hz: float) -> None:
        self._period_ns = SECOND_NS / rate_hz
        self._least: deque[tuple[int, int]] = deque(maxlen=_BUCKETS)
        self._last_ns = -1

    def observe(self, newest: int, now_ns: int) -> None:
        """Record that sample number `newest` existed at `now_ns`."""
        delay_ns = now_ns - round(newest * self._period_ns)
        second = now_ns // SECOND_NS
        if self._least and self._least[-1][0] == second:
            delay_ns = min(delay_ns, self._least.pop()[1])
        self._least.append((second, delay_ns))

    def time_ns(self, number: int) -> int:
        """Return the best current estimate of the time of sample `number` [ns]."""
        return min(delay_ns for _, delay_ns in self._least) + round(number * self._period_ns)

    def take(self, first: int, count: int) -> npt.NDArray[np.int64]:
        """Return times (count,) [ns] of samples from `first` on, later than all returned before."""
        numbers = np.arange(count, dtype=np.int64)
        regular = self.time_ns(first) + np.rint(numbers * self._period_ns).astype(np.int64)
        # A new quickest answer moves the envelope back, but not before times already returned.
        times: npt.NDArray[np.int64] = np.maximum(regular, self._last_ns + 1 + numbers)
        self._last_ns = int(times[-1])
        return times


class _Overrun(Exception):
    """The buffer overflowed before it was read: samples are lost, the task must be restarted."""


class NidaqDriver(ReceivingDriver):
    """Stream of an ATI DAQ F/T transducer on an NI card.

    Columns: value (6,) float64 [N, N m] untared, seq int64 (number of the sample; lost samples
    leave a gap), status int64 (rig/devices/force/settings.py), t_ns.
    """

    def __init__(self, config: NidaqConfig, clock: Clock) -> None:
        super().__init__(config.address, clock, _CAPACITY)
        self._config = config
        self._exits = contextlib.ExitStack()
        self._deadline = _Deadline()
        self._task: nidaqmx.Task | None = None
        self._reader: AnalogMultiChannelReader | None = None
        self._calibration: TransducerCalibration | None = None
        self._facts: dict[str, Any] = {}
        self._rate_hz = config.rate_hz
        self._pacer = Pacer(clock, _POLL_HZ)
        self._timeline = SampleTimeline(config.rate_hz)
        self._samples_read = 0
        self._shift = 0
        self._broken_off_ns: int | None = None
        self.overruns = 0
        """Number of times the card's buffer overflowed before it was read."""

    def _connect(self, timeout: float) -> None:
        """Read the calibration, set up the card, verify its settings, wait for a first sample."""
        config = self._config
        calibration = read_calibration(packaged(Path(config.calibration), BENCHES))
        self._calibration = calibration.moved(config.tool)
        self._deadline.seconds = timeout
        options = None if config.grpc is None else self._served(config.grpc, timeout)
        with self._errors("setting up"):
            task = self._task = nidaqmx.Task(grpc_options=options)
            self._exits.callback(_clear, task)
            self._set_up(task, calibration.volts_range)
            card = Device(config.device, grpc_options=options)
            self._facts = {
                "product": str(card.product_type),
                "serial": f"{int(card.serial_num):08X}",
            }
            channels = list(task.ai_channels)
            limits = [(each.name, each.ai_min, each.ai_max, each.ai_term_cfg) for each in channels]
        if problem := _problem(config.rate_hz, self._rate_hz, calibration.volts_range, limits):
            raise ConfigError(f"{self._where}: {problem}")
        self._samples_read = self._shift = 0
        self._broken_off_ns = None
        self._start(task)
        self._timeline = SampleTimeline(self._rate_hz)
        self._pacer = Pacer(self._clock, _POLL_HZ)
        self._receive_first(f"started, but no sample within {timeout:g} s")
        self._deadline.seconds = config.silence

    def _served(self, address: str, timeout: float) -> Any:
        """Connect to a device server; return the library's options for it."""
        # A card on the bench is never behind a proxy, even if the environment sets one.
        channel = grpc.insecure_channel(address, options=(("grpc.enable_http_proxy", 0),))
        self._exits.callback(channel.close)
        start_ns = self._clock.now_ns()
        try:
            grpc.channel_ready_future(channel).result(timeout)
        except grpc.FutureTimeoutError:
            waited = (self._clock.now_ns() - start_ns) / SECOND_NS
            raise DeviceLost(
                f"{address}: no NI gRPC Device Server answers ({waited:.1f} s); check that it runs "
                "there and that no firewall blocks the port"
            ) from None
        return nidaqmx.GrpcSessionOptions(grpc.intercept_channel(channel, self._deadline), "")

    def _set_up(self, task: nidaqmx.Task, volts_range: tuple[float, float]) -> None:
        """Set up six differential voltages at the card's own sample clock."""
        low, high = volts_range
        rate_hz = self._config.rate_hz
        task.ai_channels.add_ai_voltage_chan(
            f"{self._config.device}/{self._config.channels}",
            terminal_config=TerminalConfiguration.DIFF,
            min_val=low,
            max_val=high,
        )
        task.timing.cfg_samp_clk_timing(
            rate_hz,
            sample_mode=AcquisitionType.CONTINUOUS,
            samps_per_chan=max(_BUFFER_MIN, round(_BUFFER_SECONDS * rate_hz)),
        )
        self._rate_hz = float(task.timing.samp_clk_rate)
        self._reader = AnalogMultiChannelReader(task.in_stream)
        self._reader.verify_array_shape = False

    def describe(self) -> dict[str, Any]:
        """Return card, range and rate as read back, and the calibration in use."""
        if self._task is None or self._calibration is None:
            raise self._not_open()
        return {
            "device": "ATI DAQ F/T on NI-DAQmx",
            "address": self._config.address,
            **self._facts,
            "rate_hz": self._rate_hz,
            "inputs": "differential",
            "volts_range": list(self._calibration.volts_range),
            "device_clock": "seq / rate_hz",
            "transducer": self._calibration.serial,
            "calibration": self._calibration.part,
            "matrix": self._calibration.matrix.tolist(),
            "rated": list(self._calibration.rated),
        }

    def _release(self) -> None:
        self._deadline.seconds = min(self._deadline.seconds, 1.0)
        self._exits.close()
        self._task = None

    def _start(self, task: nidaqmx.Task) -> None:
        """Start the sample clock; the first sample is number 0."""
        with self._errors("starting"):
            task.start()

    def _receive(self) -> None:
        if self._task is None or self._reader is None:
            raise self._not_open()
        self._pacer.wait()
        try:
            with self._errors("reading"):
                acquired = int(self._task.in_stream.total_samp_per_chan_acquired)
            now_ns = self._clock.now_ns()
            if acquired <= self._samples_read:
                self._wait()
                return
            self._waits = 0
            if self._broken_off_ns is not None:
                self._timeline = SampleTimeline(self._rate_hz)
            self._timeline.observe(acquired - 1, now_ns)
            while self._samples_read < acquired:
                # Samples (gauges, count) [V]; all of them are acquired already.
                volts = np.empty((_GAUGES, min(acquired - self._samples_read, _BLOCK_MAX)))
                with self._errors("reading"):
                    self._reader.read_many_sample(volts, volts.shape[1], timeout=_READ_TIMEOUT)
                self._keep(np.ascontiguousarray(volts.T))
        except _Overrun as error:
            logger.warning("%s: %s", self._config.address, error)
            self.overruns += 1
            self._break_off()
            # The count begins at 0 again.
            with contextlib.suppress(_Overrun), self._errors("stopping"):
                self._task.stop()
            self._start(self._task)
            self._shift += self._samples_read
            self._samples_read = 0

    def _wait(self) -> None:
        self._count_wait(
            1 / _POLL_HZ,
            self._config.silence,
            f"no sample for {self._config.silence:g} s; check the card and, if its clock is "
            "external, the clock",
        )
        if self._waits / _POLL_HZ >= max(_STANDSTILL, 5 / self._config.rate_hz):
            self._break_off()

    def _break_off(self) -> None:
        """Note that from here on the sample count does not measure the time that passes."""
        if self._broken_off_ns is None and self._samples_read:
            self._broken_off_ns = self._timeline.time_ns(self._samples_read)

    def _keep(self, volts: npt.NDArray[np.float64]) -> None:
        if self._calibration is None:
            raise self._not_open()
        count = len(volts)
        times = self._timeline.take(self._samples_read, count)
        wrench = self._calibration.wrench(volts)
        status = SATURATED * self._calibration.saturated(volts, self._config.saturated_at)
        status = status | BEYOND_RATING * self._calibration.beyond_rating(wrench)
        if self._broken_off_ns is not None:
            missing = (int(times[0]) - self._broken_off_ns) * self._rate_hz / 1e9
            self._shift += max(0, round(missing))
            self._gaps += max(0, round(missing))
            status[0] |= LOST_BEFORE
            self._broken_off_ns = None
        first = self._samples_read + self._shift
        for k, (t_ns, bits) in enumerate(zip(times.tolist(), status.tolist(), strict=True)):
            self._inbox.put({"value": wrench[k], "seq": first + k, "status": bits}, t_ns)
        self._samples_read += count

    @contextlib.contextmanager
    def _errors(self, doing: str) -> Iterator[None]:
        try:
            yield
        except DaqError as error:
            code = error.error_code
            text = " ".join(str(error).split())
            if code in _OVERRUN_CODES:
                raise _Overrun(text) from error
            if code in _LOST_CODES:
                raise DeviceLost(f"{self._where}: {text}; {_LOST_CODES[code]}") from error
            if doing == "setting up":
                raise ConfigError(f"{self._where}: the card refuses: {text}") from error
            raise DeviceLost(f"{self._where}: {doing}: {text}") from error
        except RpcError as error:
            raise DeviceLost(
                f"{self._where}: {doing}: {' '.join(str(error).split())}; check the device server"
            ) from error
        except Error as error:
            raise ConfigError(
                f"{self._where}: {' '.join(str(error).split())}; allowed: a computer with the "
                "NI-DAQmx driver, or `grpc` in the bench file"
            ) from error


def _problem(
    requested_hz: float,
    rate_hz: float,
    volts_range: tuple[float, float],
    channels: list[tuple[str, float, float, TerminalConfiguration]],
) -> str:
    """Return the difference of the settings read back from the requested ones; empty if none."""
    low, high = volts_range
    slack = _RANGE_TOLERANCE * (high - low)
    for name, least, most, terminals in reversed(channels):
        if not (low - slack <= least <= low and high <= most <= high + slack):
            return (
                f"{name}: asked {low:g} to {high:g} V, got {least:g} to {most:g} V; gauges would "
                "be cut off, or read coarsely"
            )
        if terminals is not TerminalConfiguration.DIFF:
            return f"{name}: asked differential inputs, got {terminals.name}"
    if len(channels) != _GAUGES:
        return f"channels: found {len(channels)}; allowed: {_GAUGES}, one per gauge"
    if abs(rate_hz - requested_hz) > _RATE_TOLERANCE * requested_hz:
        return f"rate_hz: asked {requested_hz:g} Hz, got {rate_hz:g} Hz"
    return ""


def _clear(task: nidaqmx.Task) -> None:
    # A task on a card or server that is gone needs no clearing.
    with contextlib.suppress(Error):
        task.close()


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

    seconds = 1.0

    def intercept_unary_unary(self, continuation: Any, details: Any, request: Any) -> Any:
        """Make the call with its deadline; see gRPC."""
        given = {name: getattr(details, name) for name in _CallDetails._fields}
        return continuation(_CallDetails(**{**given, "timeout": self.seconds}), request)
