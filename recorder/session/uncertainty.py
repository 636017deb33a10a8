"""Uncertainty of the times of recorded samples, and of the rows aligned by them.

A sample is captured at its device, waits there, on the line and on the host, and is then stamped.
The stated uncertainty is a standard deviation: twice that value covers 95 % of the errors. It has
five parts, whose squares add up:

- latency: the interval of its calibration; without one, a prior from 0 to some periods; and how
  far the end of exposure is from a stamp at its start or middle, if the exposure is not known
- exposure: an image shows all of its exposure, a pose one moment of it
- clock: how far the promptest arrivals wander against the device's rate
- queue: how much longer than the promptest around it a sample waited, for each sample alone
- wander: how far the delay behind the arm, press by press, steps or ramps within a run
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from operator import itemgetter
from typing import Any

import numpy as np
from numpy.typing import NDArray

from recorder.command_line.options import next_command
from recorder.session.align import EXPOSURE, Source, Window
from recorder.session.columns import Columns, Stream
from recorder.session.delays import force_level, picture_level, press_delays, timed_phases
from recorder.session.loss import Losses, is_regular, lateness, witnesses
from recorder.session.presses import Phase, Presses
from recorder.session.reader import Session
from recorder.spec import STAMPS

Floats = NDArray[np.float64]
Times = NDArray[np.int64]

# Half of a 95 % interval in standard deviations.
_T_95 = 1.96
# Longest latency assumed without a calibration, by kind of stream: periods, and at least this [s].
# Images pass the exposure, a frame's transfer and the decoder; readings are small and sent at once.
PRIOR: Mapping[str, tuple[float, float]] = {
    "camera": (3.0, 0.03),
    "depth": (3.0, 0.03),
    "taxels": (2.0, 0.01),
    "force": (2.0, 0.004),
    "pose": (1.0, 0.004),
}
_PRIOR_OTHERS = (2.0, 0.01)
# A driver on the host's clock stamps a frame within this many periods of the end of exposure.
_PRIOR_STAMPED = 1.0
# Presses on either side of a step of the latency at least, and of a run that are looked at, at
# most; standard deviations from which a step or ramp counts, and its least size [s].
_SIDE, _MOST, _SIGNIFICANT, _LEAST = 2, 24, 3.5, 0.01


@dataclass(frozen=True, slots=True)
class TimeSigma:
    """Standard uncertainty of the times of one run of a stream."""

    latency: float
    """Part of the latency [s]."""
    exposure: float
    """Part of the exposure [s]; 0 for a stream without images."""
    clock: float
    """Part of the clock [s]."""
    queue: Floats
    """Part of the waiting of each sample (m,) [s], in the order of their rows."""
    wander: tuple[Times, Floats]
    """Part of a latency that differs from one part of the run to another [s], at moments [ns]."""
    prior: float | None
    """Longest latency assumed [s]; None if it was measured."""
    first: int
    """Row of the first sample in its stream."""

    def of(self, t_ns: Times, rows: NDArray[np.intp] | slice = slice(None)) -> Floats:
        """Return the uncertainty of samples (n,) [s], without the exposure.

        They arrived at `t_ns` (n,) [ns]; `rows` of the run.
        """
        moments, sizes = self.wander
        wander = np.interp(t_ns, moments, sizes) if len(moments) else 0.0
        return np.asarray(
            np.sqrt(self.latency**2 + self.clock**2 + self.queue[rows] ** 2 + wander**2)
        )

    def to_json(self) -> dict[str, Any]:
        """Return plain values for the attributes of `frames`."""
        queue = self.queue if len(self.queue) else np.zeros(1)
        return {
            "latency_s": self.latency,
            "exposure_s": self.exposure,
            "clock_s": self.clock,
            "queue_rms_s": float(np.sqrt(np.vdot(queue, queue) / len(queue))),
            "queue_longest_s": float(queue.max()),
            "wander_longest_s": float(self.wander[1].max(initial=0.0)),
            "calibrated": self.prior is None,
            **({} if self.prior is None else {"assumed_latency_s": [0.0, self.prior]}),
        }


def time_sigma(
    stream: Stream, rows: slice, losses: Losses, wander: tuple[Times, Floats]
) -> TimeSigma:
    """Return the uncertainty of the times in one run of a stream, whose latency may wander."""
    stamped = stream.traits.clock == "monotonic"
    latency, prior = latency_sigma(stream)
    t_ns = stream.rows("t_ns", rows)
    queue, clock = np.zeros(len(t_ns)), 0.0
    if not stamped and is_regular(stream):
        device_t = witnesses(stream, rows).get("device_t")
        queue, clock = lateness(t_ns, stream.rate_hz, losses, device_t)
    exposure = 0.0
    if stream.traits.kind == "camera":
        exposure = longest_exposure(stream)
        if stamped and stream.attrs.get("exposure") is None:
            # The end of the exposure lies anywhere from the stamp to a whole exposure after it.
            fraction = STAMPS[stream.traits.stamp]
            latency = float(np.hypot(latency, fraction * exposure / np.sqrt(3.0)))
    exposed = exposure / float(np.sqrt(12.0))
    return TimeSigma(latency, exposed, clock, queue, wander, prior, rows.start or 0)


def _wander(
    presses: Presses, stream: Stream, rows: slice, phases: list[Phase]
) -> tuple[Times, Floats]:
    """Return how far the latency is from its most likely one in a run (p,) [s], at moments [ns].

    Delays of presses, which tell it where no clock of a device does, are fitted by a step and by a
    ramp; the better one counts if it is beyond their scatter. The latency that is nearest to the
    stored times is taken for right.
    """
    still, count = (np.zeros(0, np.int64), np.zeros(0)), len(phases) // 2
    is_gauge = stream is presses.force and bool(presses.forces)
    is_camera = stream.traits.kind == "camera" and stream.name == presses.session.signal
    if count < 2 * _SIDE or not (is_gauge or is_camera):
        return still
    if stream.traits.clock == "monotonic" or "device_t" in witnesses(stream, rows):
        return still
    kept = {int(k) for k in np.linspace(0, count - 1, min(count, _MOST)).round()}
    phases = [one for k, one in enumerate(phases) if k // 2 in kept]
    level = force_level(presses) if is_gauge else picture_level(presses, stream, phases)
    found = [] if level is None else press_delays(presses, stream, level, phases)
    found = [one for one in found if np.isfinite(one.delay)]
    if len(found) < 2 * _SIDE:
        return still
    delays = since_shown(stream, [one.delay for one in found])
    significance, levels = _changed(delays)
    if significance < _SIGNIFICANT or np.ptp(levels) < _LEAST:
        return still
    apart = np.abs(levels - levels[np.abs(levels).argmin()])
    # A step lies anywhere between two presses: both sides of it take the larger.
    apart = np.maximum(apart, np.maximum(np.append(apart[1:], 0.0), np.append(0.0, apart[:-1])))
    return np.array([one.t_ns for one in found]), apart


def _changed(delays: Floats) -> tuple[float, Floats]:
    """Return the best step or ramp in delays (n,) over its uncertainty, and its levels (n,)."""
    number, best = np.arange(len(delays)), (0.0, delays)
    steps = [number >= k for k in range(_SIDE, len(delays) - _SIDE + 1)]
    for shape in (*steps, number):
        along = shape - shape.mean()
        levels = delays.mean() + along * (along @ delays) / (along @ along)
        scatter = np.sqrt(((delays - levels) ** 2).sum() / (len(delays) - 2)) + _LEAST / 4
        best = max(
            best, (np.linalg.norm(levels - delays.mean()) / scatter, levels), key=itemgetter(0)
        )
    return best


def since_shown(stream: Columns, delays: Sequence[float]) -> Floats:
    """Return delays of presses (n,) [s]; of an image, beside the middle of its exposure."""
    exposed = longest_exposure(stream) if stream.traits.kind == "camera" else 0.0
    return np.array(delays) - 0.5 * exposed


def longest_exposure(stream: Columns) -> float:
    """Return the exposure of a camera [s]; one that is not known lasts a period at most."""
    known = stream.attrs.get("exposure")
    return max(1.0 / stream.rate_hz, EXPOSURE) if known is None else float(known)


def row_sigma(
    window: Window, sources: Mapping[str, Source], parts: Mapping[str, TimeSigma]
) -> Floats:
    """Return the standard uncertainty of the alignment of each row (n,) [s].

    It is that of the signal's capture and that of the least certain stream with a role, added in
    squares; NaN where there is no signal. Streams and their uncertainties are by name.
    """
    signal = np.zeros(len(window.t_ns))
    if window.signal is not None:
        signal = _at(parts[window.signal], sources[window.signal], window.capture_ns)
        signal = np.hypot(signal, parts[window.signal].exposure)
        signal[window.signal_row < 0] = np.nan
    others = np.zeros(len(window.t_ns))
    for name, part in parts.items():
        if name != window.signal and window.streams[name].traits.roles:
            others = np.fmax(others, _at(part, sources[name], window.capture_ns))
    return np.asarray(np.hypot(signal, others))


def sigmas_of(session: Session) -> list[dict[str, TimeSigma]]:
    """Return the uncertainty of the times of every aligned stream of each run, by name.

    Raises:
        SessionError: A corrupt column.
    """
    presses = Presses(session)
    parts: list[dict[str, TimeSigma]] = []
    phases = timed_phases(presses)
    for run in range(max(len(session.runs), 1)):
        of_run = [one for one in phases if one.run == run]
        parts.append({})
        for name in session.columns:
            stream, rows = session.streams[name], session.rows_of_run(name, run)
            wander = _wander(presses, stream, rows, of_run)
            parts[-1][name] = time_sigma(stream, rows, session.losses(name, run), wander)
    return parts


def uncalibrated(stream: Columns) -> str | None:
    """Return a note for a signal whose latency was not measured; None for any other stream."""
    if "signal" not in stream.traits.roles:
        return None
    prior = latency_sigma(stream)[1]
    if prior is None:
        return None
    moment = f" at the {stream.traits.stamp} of exposure" if stream.traits.stamp != "end" else ""
    stamped = stream.traits.clock == "monotonic"
    own = f"; its driver stamps its frames{moment}" if stamped else ""
    return (
        f"{stream.name} latency not calibrated: 0 to {1e3 * prior:.0f} ms assumed{own} "
        f"({next_command('calibrate-latency')})"
    )


def time_lines(session: Session) -> list[str]:
    """Return a note on each signal whose latency was not measured, and the rows' uncertainty."""
    lines = []
    for name in session.order:
        note = uncalibrated(session.streams[name])
        if note is not None:
            lines.append(f"note         {note}")
    if "time_sigma" in session.frames and len(session.frames["time_sigma"]):
        sigma = session.frames["time_sigma"]
        finite = sigma[np.isfinite(sigma)]
        if len(finite):
            lines.append(
                f"time         rows are aligned within {2e3 * np.median(finite):.1f} ms (95 %, "
                f"median; worst {2e3 * finite.max():.1f} ms)"
            )
    return lines


def latency_sigma(stream: Columns) -> tuple[float, float | None]:
    """Return the standard uncertainty of the latency, and the longest assumed; None if measured."""
    period, stamped = 1.0 / stream.rate_hz, stream.traits.clock == "monotonic"
    interval = stream.attrs.get("latency_calibration", {}).get("interval_s")
    if stream.attrs.get("latency") is not None and interval is not None and not stamped:
        return (float(interval[1]) - float(interval[0])) / (2 * _T_95), None
    periods, least = PRIOR.get(stream.traits.kind, _PRIOR_OTHERS)
    longest = _PRIOR_STAMPED * period if stamped else max(periods * period, least)
    # Of a latency evenly distributed from 0 to the longest, about the recorded time.
    return longest / float(np.sqrt(3.0)), longest


def _at(part: TimeSigma, source: Source, moments: NDArray[np.int64]) -> Floats:
    """Return the larger uncertainty (n,) of the samples before and after each moment, or NaN."""
    times, values = source.times, part.of(source.times, source.rows - part.first)
    if not len(values):
        return np.full(len(moments), np.nan)
    after = np.searchsorted(times, moments, side="left")
    low = np.clip(after - 1, 0, len(values) - 1)
    high = np.clip(after, 0, len(values) - 1)
    exact = times[high] == moments
    return np.asarray(np.where(exact, values[high], np.maximum(values[low], values[high])))
