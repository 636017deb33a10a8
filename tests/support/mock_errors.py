"""Time errors of a mock session beside the World's truth and the uncertainty that it states."""

from collections.abc import Callable
from pathlib import Path

import numpy as np

from recorder import Session, Stream
from recorder.session import captured, sigmas_of
from rig.devices.camera.jpeg import frame_stamp
from rig.mock.world.truth import Truth

# The time error is fitted over windows of this length [s]. From single samples, noise would look
# like milliseconds, since the force only changes by some newtons per second.
_WINDOW = 0.25
# Slopes of the truth are taken over this distance to both sides.
_STEP_NS = 1_000_000


def within_stated(session_path: Path, truth_path: Path) -> dict[str, float]:
    """Return the fraction of time errors within twice the stated uncertainty, of each stream.

    Of `force` and `pose` by windows, of `camera` by images.
    """
    session, truth = Session(session_path), Truth(truth_path)
    # The emulators end after the streams, but the last states may not have reached the file.
    end_ns = truth.records["t_ns"][-1] - 2 * _STEP_NS
    found = {"camera": _camera(session.streams["camera"], _stated(session, "camera"))}
    for name, truth_at, slow in (
        ("force", lambda t: truth.wrench(t)[:, :3], 0.5),
        ("pose", truth.position, 1e-3),
    ):
        stream = session.streams[name]
        covered = stream.t_ns < end_ns
        values = np.asarray(stream.array("value"))[: len(stream.t_ns)][covered][:, :3]
        if name == "force":
            values = values + np.asarray(stream.attrs["bias"])[:3]
        sigma = _stated(session, name)[covered]
        found[name] = _of_windows(stream.t_ns[covered], values, truth_at, slow, sigma)
    return found


def _stated(session: Session, name: str) -> np.ndarray:
    """Return the stated uncertainty of each sample of a stream (n,) [s]."""
    found = []
    for run in range(max(len(session.runs), 1)):
        part, rows = sigmas_of(session, run)[name], session.rows_of_run(name, run)
        sigma = part.of(session.streams[name].t_ns[rows])
        found.append(np.hypot(sigma, part.exposure))
    return np.concatenate(found)


def _of_windows(
    times: np.ndarray,
    values: np.ndarray,
    truth_at: Callable[[np.ndarray], np.ndarray],
    slow: float,
    sigma: np.ndarray,
) -> float:
    """Compare the least-squares lag per window: values(t) = truth(t - lag), to first order.

    Windows whose slope is below `slow` (per second) cannot determine the time and are left out.
    """
    slope = (truth_at(times + _STEP_NS) - truth_at(times - _STEP_NS)) / (2e-9 * _STEP_NS)
    error = values - truth_at(times)
    window = (times - times[0]) // round(_WINDOW * 1e9)
    up = np.bincount(window, (error * slope).sum(axis=1))
    down = np.bincount(window, (slope**2).sum(axis=1))
    count = np.bincount(window)
    kept = down > slow**2 * np.maximum(count, 1)
    stated = np.sqrt(np.bincount(window, sigma**2)[kept] / count[kept])
    return float(np.mean(np.abs(up[kept] / down[kept]) <= 2 * stated))


def _camera(stream: Stream, sigma: np.ndarray) -> float:
    """Compare capture times with the state times that the emulator wrote into each JPEG."""
    capture, within = captured(stream), []
    for row in range(len(stream.t_ns)):
        stamp = frame_stamp(stream.jpeg(row) or b"")
        if stamp is not None:
            within.append(abs(int(capture[row]) - stamp[1]) * 1e-9 <= 2 * sigma[row])
    return float(np.mean(within))
