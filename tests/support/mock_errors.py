"""Deviation of a mock session from the World's truth: time error per stream, worst force error."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from recorder import Session, Stream
from recorder.session import captured, sigmas_of
from rig.core.errors import ConfigError
from rig.devices.camera.jpeg import frame_stamp
from rig.mock.world.truth import Truth

# The time error is fitted over windows of this length [s]. From single samples, noise would look
# like milliseconds, since the force only changes by some newtons per second.
_WINDOW = 0.25
# Slopes of the truth are taken over this distance to both sides.
_STEP_NS = 1_000_000


@dataclass(frozen=True, slots=True)
class TimeError:
    """Recorded time minus true time; positive is late [s]."""

    stream: str
    median: float
    worst: float
    count: int
    """Number of samples (camera) or windows (others) evaluated."""
    covered: float
    """Fraction of them within twice the uncertainty that the session states."""

    def __str__(self) -> str:
        return (
            f"{self.stream:<7} time error  median {1e3 * self.median:+6.2f} ms  "
            f"worst {1e3 * self.worst:+6.2f} ms  ({self.count}), "
            f"{100 * self.covered:.0f} % within the stated uncertainty"
        )


def compare(session_path: Path, truth_path: Path) -> list[str]:
    """Return the session's deviations from the truth as lines.

    Raises:
        ConfigError: There is no such truth, or it does not cover the session.
    """
    session = Session(session_path)
    if not truth_path.is_file():
        raise ConfigError(f"{truth_path}: no such file; allowed: a file from collect --truth")
    truth = Truth(truth_path)
    names = {kind: session.first(kind) for kind in ("force", "pose", "camera")}
    if names["force"] is None or names["pose"] is None:
        raise ConfigError(f"{session_path}: has no F/T sensor or no pose to compare")
    force, pose = session.streams[names["force"]], session.streams[names["pose"]]
    if len(truth.records) < 2 or truth.records["t_ns"][0] > force.t_ns[0]:
        raise ConfigError(f"{truth_path}: does not cover {session_path}")
    # The emulators end after the streams, but the last states may not have reached the file.
    covered = force.t_ns < truth.records["t_ns"][-1] - 2 * _STEP_NS
    times = force.t_ns[covered]
    wrench = np.asarray(force.array("value"))[: len(force.t_ns)][covered]
    wrench = wrench + np.asarray(force.attrs["bias"])
    true = truth.wrench(times)
    error = wrench - true
    contact = truth.depth(times) > 0
    axis = np.unravel_index(np.abs(error[:, :3]).argmax(), error[:, :3].shape)[1]
    lines = [
        f"force   worst error  {np.abs(error[:, :3]).max():.4f} N ({'xyz'[axis]}), rms "
        f"{np.sqrt((error[:, :3] ** 2).mean()):.4f} N, in contact "
        f"{np.sqrt((error[contact, :3] ** 2).mean()):.4f} N; largest force "
        f"{np.abs(true[:, :3]).max():.2f} N"
    ]
    sigma = _stated(session, names["force"])[covered]
    lag = _lag("force", times, wrench[:, :3], lambda t: truth.wrench(t)[:, :3], 0.5, sigma)
    lines.append(str(lag))
    covered = pose.t_ns < truth.records["t_ns"][-1] - 2 * _STEP_NS
    position = np.asarray(pose.array("value"))[: len(pose.t_ns)][covered][:, :3]
    sigma = _stated(session, names["pose"])[covered]
    lines.append(str(_lag("pose", pose.t_ns[covered], position, truth.position, 1e-3, sigma)))
    if names["camera"] is not None:
        stream = session.streams[names["camera"]]
        lines += _camera(stream, _stated(session, names["camera"]))
    return lines


def _stated(session: Session, name: str) -> np.ndarray:
    """Return the stated uncertainty of each sample of a stream (n,) [s]."""
    runs = range(max(len(session.runs), 1))
    parts = [sigmas_of(session, run)[name] for run in runs]
    return np.concatenate([np.hypot(part.each, part.exposure) for part in parts])


def _lag(
    name: str,
    times: np.ndarray,
    values: np.ndarray,
    truth_at: Callable[[np.ndarray], np.ndarray],
    slow: float,
    sigma: np.ndarray,
) -> TimeError:
    """Return the least-squares time error per window: values(t) = truth(t - lag), to first order.

    Windows whose slope is below `slow` (per second) cannot determine the time and are left out.
    """
    slope = (truth_at(times + _STEP_NS) - truth_at(times - _STEP_NS)) / (2e-9 * _STEP_NS)
    error = values - truth_at(times)
    window = (times - times[0]) // round(_WINDOW * 1e9)
    up = np.bincount(window, (error * slope).sum(axis=1))
    down = np.bincount(window, (slope**2).sum(axis=1))
    count = np.bincount(window)
    kept = down > slow**2 * np.maximum(count, 1)
    if not kept.any():
        return TimeError(name, float("nan"), float("nan"), 0, float("nan"))
    lags = -up[kept] / down[kept]
    worst = lags[np.abs(lags).argmax()]
    stated = np.sqrt(np.bincount(window, sigma**2)[kept] / count[kept])
    within = float(np.mean(np.abs(lags) <= 2 * stated))
    return TimeError(name, float(np.median(lags)), float(worst), int(kept.sum()), within)


def _camera(stream: Stream, sigma: np.ndarray) -> list[str]:
    """Compare arrival times with the state times that the emulator wrote into each JPEG."""
    late: list[float] = []
    within: list[bool] = []
    capture = captured(stream)
    numbers: list[int] = []
    for row, t_ns in enumerate(stream.t_ns):
        jpeg = stream.jpeg(row)
        stamp = frame_stamp(jpeg) if jpeg is not None else None
        if stamp is not None:
            numbers.append(stamp[0])
            late.append((int(t_ns) - stamp[1]) * 1e-9)
            within.append(abs(int(capture[row]) - stamp[1]) * 1e-9 <= 2 * sigma[row])
    if not late:
        return ["camera  no emulator timestamps in its images"]
    worst = max(late, key=abs)
    missing = int((np.diff(numbers) - 1).sum())
    return [
        str(TimeError("camera", float(np.median(late)), worst, len(late), float(np.mean(within)))),
        f"camera  {missing} of the emulator's frames missing",
    ]
