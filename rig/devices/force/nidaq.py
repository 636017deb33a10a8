"""ATI DAQ F/T driver for an NI card: gauge voltages by NI-DAQmx, the wrench by the `.cal` file.

The card's own clock paces the samples, so sample k was taken at k / rate of the card's time;
rig/devices/force/sample_clock.py converts it to the host's clock. The bias is the rig's tare, in
newton: the map is linear, so that is the bias of the volts (rig/devices/force/calibration.py).
"""

from __future__ import annotations

import logging
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from rig.core.clock import Clock, Pacer
from rig.core.driver import ReceivingDriver
from rig.core.errors import ConfigError
from rig.core.packaged import BENCHES, packaged
from rig.devices.force.calibration import TransducerCalibration, read_calibration
from rig.devices.force.sample_clock import BEYOND_RATING, LOST_BEFORE, SATURATED, SampleTimeline
from rig.devices.force.settings import NidaqConfig

if TYPE_CHECKING:
    from rig.devices.force.nidaq_task import AnalogTask

logger = logging.getLogger(__name__)

# Rate of reading the card: a block is 10 ms long, well inside the guard's 50 ms.
_POLL_HZ = 100.0
_CAPACITY = 60_000
_BLOCK_MAX = 2000
# Without a new sample for this long, or five periods of a slow clock, the clock has stopped [s].
_STANDSTILL = 0.1


class NidaqDriver(ReceivingDriver):
    """Stream of an ATI DAQ F/T transducer on an NI card.

    Columns: value (6,) float64 [N, N m] untared, seq int64 (number of the sample; lost samples
    leave a gap), status int64 (rig/devices/force/sample_clock.py), t_ns.
    """

    def __init__(self, config: NidaqConfig, clock: Clock) -> None:
        super().__init__(config.address, clock, _CAPACITY)
        self._config = config
        self._task: AnalogTask | None = None
        self._calibration: TransducerCalibration | None = None
        self._pacer = Pacer(clock, _POLL_HZ)
        self._timeline = SampleTimeline(config.rate_hz)
        self._taken = 0
        self._shift = 0
        self._broken_off_ns: int | None = None
        self.overruns = 0
        """Number of times the card's buffer overflowed before it was read."""

    def _connect(self, timeout: float) -> None:
        """Read the calibration, set up the card, verify its settings, wait for a first sample."""
        config = self._config
        calibration = read_calibration(packaged(Path(config.calibration), BENCHES))
        self._calibration = calibration.moved(config.tool)
        try:
            from rig.devices.force.nidaq_task import AnalogTask
        except ImportError as error:
            raise ConfigError(
                f"force: {error.name} is not installed; install the extra: "
                "pip install 'tactile-rig[nidaq]'"
            ) from None
        task = AnalogTask(
            config.device,
            config.channels,
            config.rate_hz,
            calibration.volts_range,
            server=config.grpc,
            clock=self._clock,
            timeout=timeout,
        )
        self._task = task
        self._taken = self._shift = 0
        self._broken_off_ns = None
        task.start()
        self._timeline = SampleTimeline(task.rate_hz)
        self._pacer = Pacer(self._clock, _POLL_HZ)
        self._receive_first(f"started, but no sample within {timeout:g} s")
        task.answer_within(config.silence)

    def describe(self) -> dict[str, Any]:
        """Return card, range and rate as read back, and the calibration in use."""
        if self._task is None or self._calibration is None:
            raise self._not_open()
        return {
            "device": "ATI DAQ F/T on NI-DAQmx",
            "address": self._config.address,
            "product": self._task.product,
            "serial": self._task.serial,
            "rate_hz": self._task.rate_hz,
            "inputs": "differential",
            "volts_range": list(self._calibration.volts_range),
            "device_clock": "seq / rate_hz",
            "transducer": self._calibration.serial,
            "calibration": self._calibration.part,
            "matrix": self._calibration.matrix.tolist(),
            "rated": list(self._calibration.rated),
        }

    def _release(self) -> None:
        if self._task is not None:
            self._task.close()
            self._task = None

    def _receive(self) -> None:
        from rig.devices.force.nidaq_task import Overrun

        if self._task is None:
            raise self._not_open()
        self._pacer.wait()
        try:
            acquired = self._task.acquired()
            now_ns = self._clock.now_ns()
            fresh = acquired - self._taken
            if fresh <= 0:
                self._wait()
                return
            self._waits = 0
            self._date(acquired, now_ns)
            while self._taken < acquired:
                count = min(acquired - self._taken, _BLOCK_MAX)
                self._keep(self._task.read(count))
        except Overrun as error:
            logger.warning("%s: %s", self._config.address, error)
            self.overruns += 1
            self._break_off()
            self._task.restart()
            self._shift += self._taken
            self._taken = 0

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
        if self._broken_off_ns is None and self._taken:
            self._broken_off_ns = self._timeline.time_ns(self._taken)

    def _date(self, acquired: int, now_ns: int) -> None:
        if self._broken_off_ns is not None and self._task is not None:
            self._timeline = SampleTimeline(self._task.rate_hz)
        self._timeline.observe(acquired - 1, now_ns)

    def _keep(self, volts: npt.NDArray[np.float64]) -> None:
        if self._calibration is None or self._task is None:
            raise self._not_open()
        count = len(volts)
        times = self._timeline.take(self._taken, count)
        wrench = self._calibration.wrench(volts)
        status = SATURATED * self._calibration.saturated(volts, self._config.saturated_at)
        status = status | BEYOND_RATING * self._calibration.beyond_rating(wrench)
        if self._broken_off_ns is not None:
            missing = (int(times[0]) - self._broken_off_ns) * self._task.rate_hz / 1e9
            self._shift += max(0, round(missing))
            self._gaps += max(0, round(missing))
            status[0] |= LOST_BEFORE
            self._broken_off_ns = None
        first = self._taken + self._shift
        for k, (t_ns, bits) in enumerate(zip(times.tolist(), status.tolist(), strict=True)):
            self._inbox.put({"value": wrench[k], "seq": first + k, "status": bits}, t_ns)
        self._taken += count
